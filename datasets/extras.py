"""Which optional libraries are installed, and the files that a mesh file names; imports none of them."""

import re
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


def named_files(path: Path) -> list[Path]:
    """The .mtl files that an .obj names, and the images that these name, whether they are there or not."""
    libraries = _named(path, "mtllib") if path.suffix.lower() == ".obj" else []
    return [*libraries, *(image for file in libraries if file.is_file() for image in _named(file, "map_Kd"))]


def _named(path: Path, key: str) -> list[Path]:
    """The files that lines of a key name, beside `path`; an option such as `-s 1 1 1` stands before the name."""
    line = rf"^[ \t]*{key}[ \t]+(.+?)[ \t]*$"  # of no blank lines, of which a file may have many
    lines = re.findall(line, path.read_text(errors="replace"), re.MULTILINE | re.IGNORECASE)
    names = [line.split()[-1] if line.startswith("-") else line for line in dict.fromkeys(lines)]
    return [path.parent / name.replace("\\", "/") for name in names]
