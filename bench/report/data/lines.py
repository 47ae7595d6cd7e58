"""Writes dataclasses as lines of a CSV file: text unchanged, other values as JSON."""

import csv
import json
from collections.abc import Iterable
from dataclasses import asdict, fields
from io import StringIO
from pathlib import Path
from typing import Any, TypeVar

from bench.records.record import from_json_values, to_json_values, write_text

Item = TypeVar("Item")
READ_ERRORS = (OSError, ValueError, TypeError, KeyError, RecursionError, csv.Error)


def write_lines(path: Path, kind: type, items: Iterable[Any]) -> Path:
    """Writes one line per item of a dataclass."""
    text = StringIO()
    table = csv.DictWriter(text, [field.name for field in fields(kind)], lineterminator="\n")
    table.writeheader()
    for item in items:
        cells = asdict(item).items()
        row = {name: cell if isinstance(cell, str) else json.dumps(to_json_values(cell)) for name, cell in cells}
        table.writerow(row)
    write_text(path, text.getvalue())
    return path


def read_lines(path: Path, kind: type[Item]) -> list[Item]:
    """Reads the items of a dataclass from a file.

    Raises:
        one of READ_ERRORS: the file is damaged, or its columns are not the fields of the dataclass.
    """
    with path.open(encoding="utf-8", newline="") as file:
        return [kind(**{f.name: _value(line[f.name], f.type) for f in fields(kind)}) for line in csv.DictReader(file)]


def _value(cell: str, kind: Any) -> Any:
    return cell if kind is str else from_json_values(json.loads(cell))
