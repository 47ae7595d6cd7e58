"""How the extras of this project are installed, which bring libraries that not everybody needs."""

import shlex
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def install(extra: str, root: Path = ROOT) -> str:
    """The command that installs an extra: into the checkout that this is part of, or beside the installed package.

    Args:
        extra: its name in pyproject.toml.
        root: the folder that holds our packages.
    """
    if not (root / "pyproject.toml").is_file():  # site-packages
        return f"pip install 'implicit-bench[{extra}]'"
    folder = "." if root == Path.cwd() else str(root)
    return f"pip install -e {shlex.quote(f'{folder}[{extra}]')}"
