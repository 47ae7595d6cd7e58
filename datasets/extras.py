"""Libraries that not everybody needs: whether they are installed, and how extras of this project are."""

import shlex
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def version(library: str) -> str | None:
    """The version of a library; None where it is not installed, as PyMeshLab may not be."""
    try:
        return metadata.version(library)
    except metadata.PackageNotFoundError:
        return None


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
