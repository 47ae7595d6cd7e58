"""The version that drew a page, where this version cannot draw it again."""

import subprocess
from pathlib import Path

UNKNOWN = "unknown"


def drawn_by(path: Path) -> str:
    """The version that drew a file: the last commit that changed it, with its date."""
    command = ["git", "log", "-1", "--format=%h of %cs", "--", path.name]
    try:
        log = subprocess.run(command, cwd=path.parent, capture_output=True, text=True, check=True, timeout=10)
    except (OSError, subprocess.SubprocessError):
        return UNKNOWN
    return log.stdout.strip() or UNKNOWN


def head(version: str) -> str:
    """The head of a page that this version cannot draw; empty if no other version drew it."""
    if not version:
        return ""
    return f"Drawn by version {version}, with its statistics; this version cannot draw it without the run folders."
