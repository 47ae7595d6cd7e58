"""The records that shipped tables are drawn from: `paper/EXPERIMENT.runs.csv.gz`, a line per run.

A line is a record without the other files of its run folder (curves, pictures), and outlives the folder. A column is a
field by its dotted name, such as `metrics.NAME` or `config.KEY.KEY`. A cell is the value as JSON; text that is not also
JSON stands without quotes. An empty cell means that the run has no such field.
"""

import csv
import gzip
import json
import zlib
from collections.abc import Iterable
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any

from bench.records.record import started, write_bytes
from bench.records.shipped import CONFIG, SUFFIX, cell_value
from bench.report.data.records import Record, grouped, setting

FROM_RUNS_CSV = "kept"  # the field that marks a record read from such a file
UNFINISHED = ("not_run", "killed")
UNMEASURED = (*UNFINISHED, "refused")  # statuses that say nothing about a renderer
READ_ERRORS = (OSError, ValueError, TypeError, KeyError, RecursionError, csv.Error)
LOCAL_FIELDS = ("log", "overrides", "environment.diff", "environment.platform", FROM_RUNS_CSV)
LOCAL_FIELDS += ("config.results_dir", "config.priors_dir")  # they depend on the machine, or follow from other fields


def join(records: Iterable[Record], kept: Iterable[Record]) -> list[Record]:
    """One record per run: the newest that measured something; of equal ones, the one with a run folder."""
    ordered = sorted([*kept, *records], key=lambda record: (record["status"] not in UNMEASURED, started(record)))
    return sorted({record["id"]: record for record in ordered}.values(), key=started, reverse=True)


def write_rows(records: Iterable[Record], experiments: Iterable[str], folder: Path) -> list[Path]:
    """Writes the measured runs of each experiment, except those of scale=smoke; returns the files."""
    measured = (record for record in records if record["status"] not in UNMEASURED)
    sound = (record for record in measured if setting(record["config"], "scale", "name") != "smoke")
    groups = grouped(sound, lambda record: record["config"].get("experiment"))
    return [_write(folder / f"{name}{SUFFIX}", groups[name]) for name in dict.fromkeys(experiments) if name in groups]


def read_rows(folder: Path, experiment: str = "[!.]*") -> list[Record]:
    """Reads the records of such files, of the experiments of that pattern; raises ValueError for a damaged file."""
    records = list[Record]()
    for path in sorted(folder.glob(f"{experiment}{SUFFIX}")):
        try:
            with gzip.open(path, "rt", encoding="utf-8", newline="") as file:
                records += map(_record, csv.DictReader(file))
        except (*READ_ERRORS, AttributeError, EOFError, zlib.error) as error:
            raise ValueError(f"{path} cannot be read, mend it or move it away: {error!r}") from error
    return records


def _write(path: Path, records: list[Record]) -> Path:
    """Writes records to a file, sorted and without a date, so that the same records give the same bytes."""
    lines = [_cells(record) for record in sorted(records, key=lambda record: (started(record), record["id"]))]
    names = sorted(dict.fromkeys(name for line in lines for name in line), key=_rank)
    text = StringIO()
    table = csv.DictWriter(text, names, lineterminator="\n")
    table.writeheader()
    table.writerows(lines)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, gzip.compress(text.getvalue().encode(), mtime=0), flushed=True)
    return path


def _rank(name: str) -> str:
    """The sort key of a column: settings are sorted by name; other fields, such as metrics, keep their order."""
    return name if name.startswith(CONFIG) else name.partition(".")[0]


def _cells(value: Any, name: str = "") -> dict[str, str]:
    if _has_columns(value, name):
        inner = [_cells(item, f"{name}.{key}".lstrip(".")) for key, item in value.items()]
        return {column: cell for cells in inner for column, cell in cells.items()}
    if isinstance(value, str) and name.startswith(CONFIG) and value.startswith("/"):
        value = "/".join(["", *Path(value).parts[-2:]])  # the last two parts name the family
    bare = isinstance(value, str) and value and cell_value(value) == value
    return {} if name in LOCAL_FIELDS else {name: value if bare else json.dumps(value)}


def _has_columns(value: Any, name: str) -> bool:
    """Whether each key of a value has a column: settings at any depth, other fields only at the first level."""
    if not isinstance(value, dict) or not value:
        return False
    return not any("." in key for key in value) if f"{name}.".startswith(CONFIG) else "." not in name


@cache
def _split(name: str) -> tuple[str, str]:
    """The parts of a column's name: that of the node that has the value, and the value's key."""
    if not name.startswith(CONFIG):
        first, _, rest = name.partition(".")
        return (first, rest) if rest else ("", first)
    parent, _, key = name.rpartition(".")
    return parent, key


def _node(nodes: dict[str, Any], name: str) -> dict[str, Any]:
    if name not in nodes:
        parent, _, key = name.rpartition(".")
        nodes[name] = _node(nodes, parent).setdefault(key, {})
    return nodes[name]


def _record(cells: dict[str, str]) -> Record:
    record: Record = {}
    nodes: dict[str, Any] = {"": record}  # by the name of their column, without the last part
    for name, cell in cells.items():
        if cell != "":
            parent, key = _split(name)
            (nodes.get(parent) or _node(nodes, parent))[key] = cell_value(cell)
    if lacking := {"id", "status", "config"} - record.keys():
        raise ValueError(f"a line has no {', '.join(sorted(lacking))}")
    started(record)
    return record | {FROM_RUNS_CSV: True, "log": []}
