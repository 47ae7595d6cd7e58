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
    libraries = material_files(path)
    return [*libraries, *(image for file in libraries if file.is_file() for image in _named(file, "map_Kd"))]


def material_files(path: Path) -> list[Path]:
    """The .mtl files that an .obj names, whether they are there or not."""
    return _named(path, "mtllib") if path.suffix.lower() == ".obj" else []


def named_image(path: Path, line: str) -> Path:
    """The file that a line `map_Kd FILE` of the file `path` names; options such as `-s 1 1 1` stand before it."""
    name = line.strip().split(None, 1)[1]
    return path.parent / (name.split()[-1] if name.startswith("-") else name).replace("\\", "/")


def _named(path: Path, key: str) -> list[Path]:
    lines = rf"^[ \t]*{key}[ \t]+.*\S"  # of no blank lines, of which a file may have many
    named = re.findall(lines, path.read_text(errors="replace"), re.MULTILINE | re.IGNORECASE)
    return [named_image(path, line) for line in dict.fromkeys(named)]
