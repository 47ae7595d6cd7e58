"""The rows that a shipped table is drawn from: `paper/EXPERIMENT.runs.csv`, a line a run, which outlives its folder.

A line is a record without what its folder alone has (curves, pictures). A column is a field by its dotted name, a cell
its value as JSON, or as it is where that is no JSON. An empty cell is that of the first line, and `-` says that the run
has no such field.

A row with the field `restored` was made from the CSV of a page whose run folders are gone. It has of the settings what
that page shows, starts at the time of the page's commit, and has one number for the seconds of its loop.
"""

import csv
import json
from collections.abc import Iterable, Iterator
from io import StringIO
from pathlib import Path
from typing import Any

from bench.records.record import decoded, plain, started, write_text
from bench.report.data.records import Record, grouped, setting
from bench.tables import nested

SUFFIX = ".runs.csv"
KEPT = "kept"  # marks a record that was read here
UNFINISHED = ("not_run", "killed")  # statuses of runs that say nothing of a row
NO_ATTEMPTS = (*UNFINISHED, "refused")  # those of runs that did not measure what they were to measure
HERE = ("log", "overrides", "environment.diff", "environment.platform", KEPT)
HERE += ("config.results_dir", "config.priors_dir")  # what is of the machine, or can be looked up
SAME, NONE = "", "-"


def join(records: Iterable[Record], kept: Iterable[Record]) -> list[Record]:
    """One record of each run: the newest that measured something; of the same the one that has its folder."""
    ordered = sorted([*kept, *records], key=lambda record: (record["status"] not in NO_ATTEMPTS, started(record)))
    return sorted({record["id"]: record for record in ordered}.values(), key=started, reverse=True)


def write_rows(records: Iterable[Record], experiments: Iterable[str], folder: Path) -> list[Path]:
    """Writes the runs of each experiment to a folder, but planned ones and those of scale=smoke; gives the files."""
    measured = (one for one in records if one["status"] not in NO_ATTEMPTS)
    sound = (one for one in measured if setting(one["config"], "scale", "name") != "smoke")
    of = grouped(sound, lambda record: record["config"].get("experiment"))
    return [_write(folder / f"{name}{SUFFIX}", of[name]) for name in dict.fromkeys(experiments) if name in of]


def read_rows(folder: Path) -> list[Record]:
    """The records of all such files of a folder.

    Raises:
        ValueError: where one cannot be read, with its name.
    """
    found = list[Record]()
    for path in sorted(folder.glob(f"[!.]*{SUFFIX}")):
        try:
            with path.open(encoding="utf-8", newline="") as file:
                found += _read(csv.DictReader(file))
        except (OSError, ValueError, KeyError, TypeError, AttributeError, csv.Error) as error:
            raise ValueError(f"{path} cannot be read, mend it or move it away: {error!r}") from error
    return found


def _cells(value: Any, name: str = "") -> dict[str, str]:
    if isinstance(value, dict) and value and not any("." in key for key in value):
        inner = [_cells(one, f"{name}.{key}".lstrip(".")) for key, one in value.items()]
        return {key: cell for cells in inner for key, cell in cells.items()}
    if isinstance(value, str) and name.startswith("config.") and value.startswith("/"):
        value = "/".join(["", *Path(value).parts[-2:]])  # which name the family of a folder of data
    bare = isinstance(value, str) and value not in (SAME, NONE) and _value(value) == value
    return {} if name in HERE else {name: str(value) if bare else json.dumps(plain(value))}


def _value(cell: str) -> Any:
    try:
        return decoded(json.loads(cell))
    except ValueError:
        return cell


def _write(path: Path, records: list[Record]) -> Path:
    lines = [_cells(record) for record in sorted(records, key=lambda record: (started(record), record["id"]))]
    columns = sorted({name for line in lines for name in line})  # so that a file that is written again is the same
    first = {name: lines[0].get(name, NONE) for name in columns}
    text = StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerows([columns, list(first.values())])
    for line in lines[1:]:
        cells = {name: line.get(name, NONE) for name in columns}
        table.writerow([SAME if cell == first[name] else cell for name, cell in cells.items()])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, text.getvalue())
    return path


def _read(lines: Iterable[dict[str, str]]) -> Iterator[Record]:
    first: dict[str, str] = {}
    for line in lines:
        first = first or line
        cells = {name: cell if cell != SAME else first[name] for name, cell in line.items()}
        record: Record = nested({name: _value(cell) for name, cell in cells.items() if cell != NONE})
        if lacking := {"id", "status", "config"} - record.keys():
            raise ValueError(f"a line has no {', '.join(sorted(lacking))}")
        started(record)
        yield record | {KEPT: True, "log": []}
