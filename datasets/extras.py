"""Optional libraries: versions and install commands, without imports; and the files that a mesh file references."""

import re
import shlex
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def version(library: str) -> str | None:
    """The version of a library; None if it is not installed."""
    try:
        return metadata.version(library)
    except metadata.PackageNotFoundError:
        return None


def install_command(extra: str, root: Path = ROOT) -> str:
    """The command that installs an extra: in this checkout, or for the installed package.

    Args:
        extra: its name in pyproject.toml.
        root: the folder that holds our packages.
    """
    if not (root / "pyproject.toml").is_file():  # site-packages
        return f"pip install 'implicit-bench[{extra}]'"
    folder = "." if root == Path.cwd() else str(root)
    return f"pip install -e {shlex.quote(f'{folder}[{extra}]')}"


def referenced_files(path: Path) -> list[Path]:
    """The .mtl files that an .obj references, and the images that these reference; files may not exist."""
    libraries = material_files(path)
    return [*libraries, *(image for file in libraries if file.is_file() for image in _referenced(file, "map_Kd"))]


def material_files(path: Path) -> list[Path]:
    """The .mtl files that an .obj references; files may not exist."""
    return _referenced(path, "mtllib") if path.suffix.lower() == ".obj" else []


def named_image(path: Path, line: str) -> Path:
    """The image of a line `map_Kd FILE` in the file `path`; options such as `-s 1 1 1` may precede FILE."""
    name = line.strip().split(None, 1)[1]
    return path.parent / (name.split()[-1] if name.startswith("-") else name).replace("\\", "/")


def _referenced(path: Path, key: str) -> list[Path]:
    pattern = rf"^[ \t]*{key}[ \t]+.*\S"  # does not cross lines: a file may have many blank ones
    lines = re.findall(pattern, path.read_text(errors="replace"), re.MULTILINE | re.IGNORECASE)
    return [named_image(path, line) for line in dict.fromkeys(lines)]
