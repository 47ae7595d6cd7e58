"""Writes plain data to files: JSON with non-finite numbers, atomic writes, locks, and hashes."""

import hashlib
import json
import math
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock

# JSON has no infinity: these strings stand for the floats.
_NON_FINITE = {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}


def file_lock(folder: Path, name: str) -> FileLock:
    """A lock between processes on a name in a folder: one process holds it, the others wait."""
    locks = folder / ".locks"
    locks.mkdir(parents=True, exist_ok=True)
    return FileLock(locks / name)


def leads_out(path: Path, root: Path) -> bool:
    """Whether a path lies outside of a folder once links are followed; a results folder may be somebody else's."""
    return not path.resolve().is_relative_to(root.resolve())


def link_out(folder: Path, root: Path) -> str:
    """The name of the first link that leads out of `root`: the folder's own, or one in it at any depth; else empty."""
    if folder.is_symlink() and leads_out(folder, root):
        return folder.name
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                if entry.is_symlink():
                    if leads_out(Path(entry), root):
                        return entry.name
                elif entry.is_dir(follow_symlinks=False) and (found := link_out(Path(entry), root)):
                    return f"{entry.name}/{found}"
    except OSError:  # who reads it will say why it cannot be read
        return ""
    return ""


def is_plain_name(text: Any) -> bool:
    """Whether it can be the name of a file or folder in a given folder, and of nothing elsewhere."""
    return isinstance(text, str) and re.fullmatch(r"[^./\\\0][^/\\\0]*", text) is not None


def digest(data: Any) -> str:
    """A hash of plain data, the same whatever the order of its keys."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:12]


def write_text(path: Path, text: str) -> None:
    """Writes a file atomically, flushed to the disk."""
    write_bytes(path, text.encode("utf-8"), flushed=True)


def write_bytes(path: Path, content: bytes, *, flushed: bool = False) -> None:
    """Writes a file atomically: under a temporary name in the same folder, then renamed; a link is replaced."""
    scratch = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with scratch.open("wb") as file:
            file.write(content)
            if flushed:
                file.flush()
                os.fsync(file.fileno())
        scratch.replace(path)
    except BaseException:
        scratch.unlink(missing_ok=True)
        raise


@contextmanager
def curve_file(folder: Path) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Opens `folder/curve.jsonl` and gives a function that writes a line; each line is in the file at once."""
    with (folder / "curve.jsonl").open("w", buffering=1, encoding="utf-8") as curve:
        yield lambda line: curve.write(json.dumps(plain(line), allow_nan=False) + "\n")


def to_json(data: Any) -> str:
    """JSON text of some data, with non-finite floats as the strings "inf", "-inf" and "nan"."""
    return json.dumps(plain(data), indent=1, allow_nan=False, ensure_ascii=False, default=str) + "\n"


def plain(value: Any) -> Any:
    """The same data with non-finite floats, which JSON lacks, as the strings "inf", "-inf" and "nan"."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if not isinstance(value, str | int | float | None) and hasattr(value, "item"):
        value = value.item()  # a NumPy or PyTorch scalar
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def decoded(value: Any) -> Any:
    """The same data with the strings "inf", "-inf" and "nan" as floats: the inverse of `plain`."""
    if isinstance(value, dict):
        return {name: decoded(inner) for name, inner in value.items()}
    return _NON_FINITE.get(value, value) if isinstance(value, str) else value
