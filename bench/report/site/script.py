"""Writes data as scripts that a page from a file can load, in which no text of a record can act as code."""

import json
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from bench.records.files import plain

# Within a JSON text these occur in strings only. Escaped, no string can end a script element or a line.
UNSAFE = re.compile("[<>&\u2028\u2029\x7f]")
KEY = re.compile(r"[0-9a-f]{16}\.js")  # of the files with details
ENCODER = json.JSONEncoder(allow_nan=False, ensure_ascii=True, separators=(",", ":"), default=str)


def to_script(kind: str, key: str, data: Any) -> str:
    """A script that hands data to the page: `implicitBench.receive(kind, key, data)`, in ASCII.

    Numbers that are not finite are the strings "inf", "-inf" and "nan".
    """
    parts = (safe_json(part) for part in (kind, key, data))
    return f"implicitBench.receive({', '.join(parts)});\n"


def safe_json(data: Any) -> str:
    """JSON in ASCII that can stand within a script element."""
    try:
        text = ENCODER.encode(data)
    except ValueError:  # a number that is not finite
        text = ENCODER.encode(plain(data))
    return UNSAFE.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def remove_others(folder: Path, keys: Iterable[str]) -> None:
    """Removes the scripts of what is gone."""
    kept = {f"{key}.js" for key in keys}
    if folder.is_dir():
        with os.scandir(folder) as found:
            gone = [one.name for one in found if one.name not in kept and KEY.fullmatch(one.name)]
        for name in gone:
            (folder / name).unlink(missing_ok=True)


def write_script(path: Path, text: str) -> None:
    """Writes a script, unless the file has that text already."""
    content = text.encode("ascii")
    try:
        if not path.is_symlink() and path.read_bytes() == content:  # what a link leads to may change
            return
    except OSError:
        pass
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = path.with_name(f".{path.name}.{os.getpid()}")
    scratch.write_bytes(content)
    scratch.replace(path)
