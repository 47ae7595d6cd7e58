"""Reads the records of all run folders; what cannot be read is named, never fatal and never hidden."""

import json
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bench.report.planned import read_planned

SCHEMA = 1
# Keys of a configuration that change no result, and are left out of its hash.
NEUTRAL_KEYS = frozenset(
    ("results_dir", "priors_dir", "verbose", "isolation", "time_limit", "memory_limit", "rerun", "tracker")
)
_NUMBER = (int, float, type(None))
_FIELDS: dict[str, type | tuple[type, ...]] = {
    "id": str,
    "task": str,
    "renderer": str,
    "dataset": str,
    "seed": (int, type(None)),
    "status": str,
    "reason": str,
    "started": str,
    "asked": str,
    "config": dict,
    "metrics": dict,
    "metrics_start": dict,
    "definitions": dict,
    "evaluations": dict,
    "seconds": dict,
    "peak_memory_bytes": _NUMBER,
    "flops": _NUMBER,
    "gemm_fraction": _NUMBER,
    "environment": dict,
    "reused": bool,
    "notes": list,
}
# JSON has no infinity: these strings stand for the floats, in these fields only.
_NON_FINITE = {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}
_NUMERIC = (
    "metrics",
    "metrics_start",
    "evaluations",
    "seconds",
    "peak_memory_bytes",
    "flops",
    "gemm_fraction",
)


def read_records(results_dir: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """The records of `results_dir/runs/*/record.json`, newest first, and one line for each that was not read.

    A record is as written, with non-finite numbers as floats, `notes` always there, and the name of its folder
    under `folder`. A line gives the folder's name and why it was not read. Hidden folders are passed over. Cells that
    a sweep planned and that have no folder stand among the records, with the status `not_run`.

    Raises:
        ValueError: if `results_dir` is not a folder.
    """
    if not results_dir.is_dir():
        raise ValueError(f"results_dir must be an existing folder, found {results_dir}; make a run there first.")
    records, problems = [], []
    folders = [f for f in sorted((results_dir / "runs").glob("*")) if f.is_dir() and not f.name.startswith(".")]
    for folder in folders:
        try:
            records.append(read_record(folder))
        except FileNotFoundError:
            problems.append(f"{folder.name}: no record.json; the run has not finished, or its record was removed")
        except (OSError, ValueError, RecursionError) as error:
            problems.append(f"{folder.name}: {error}")
    planned, unread = read_planned(results_dir, {record["folder"] for record in records})
    records, problems = records + planned, problems + unread
    records.sort(key=started, reverse=True)
    return records, problems


def read_record(folder: Path) -> dict[str, Any]:
    """The record of one run folder, as `read_records` gives it.

    Raises:
        OSError, ValueError, RecursionError: where it cannot be read; the message says why.
    """
    try:
        record = json.loads((folder / "record.json").read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"record.json is not JSON in UTF-8 ({error})") from error
    if not isinstance(record, dict):
        raise ValueError(f"record.json must hold an object, found {type(record).__name__}")
    if record.get("schema") != SCHEMA:
        raise ValueError(f"record.json must have schema {SCHEMA}, found {record.get('schema')!r}")
    record.setdefault("notes", [])
    record.setdefault("asked", record.get("started"))
    record |= {name: decoded(record[name]) for name in _NUMERIC if name in record}
    for name, kind in _FIELDS.items():
        if name not in record:
            raise ValueError(f"record.json must have the field {name!r}, found none")
        if not isinstance(record[name], kind):
            raise ValueError(f"{name} in record.json has the wrong type, found {type(record[name]).__name__}")
    started(record), asked(record)  # a time that cannot be read is found here, not in the sort
    return record | {"folder": folder.name}


def decoded(value: Any) -> Any:
    """The same data with the strings "inf", "-inf" and "nan" as the floats that they stand for."""
    if isinstance(value, dict):
        return {name: decoded(inner) for name, inner in value.items()}
    return _NON_FINITE.get(value, value) if isinstance(value, str) else value


def asked(record: dict[str, Any]) -> datetime:
    """When the run was last asked for, which for a reused one is not when it ran."""
    return _time(record["asked"])


def started(record: dict[str, Any]) -> datetime:
    """When the run started; a time without an offset is UTC."""
    return _time(record["started"])


def _time(text: str) -> datetime:
    time = datetime.fromisoformat(text)
    return time if time.tzinfo else time.replace(tzinfo=UTC)
