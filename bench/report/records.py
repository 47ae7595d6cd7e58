"""Reads the records of all run folders; what cannot be read is named, never fatal and never hidden."""

import json
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

SCHEMA = 1
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
    under `folder`. A line gives the folder's name and why it was not read. Hidden folders are passed over.

    Raises:
        ValueError: if `results_dir` is not a folder.
    """
    if not results_dir.is_dir():
        raise ValueError(f"results_dir must be an existing folder, found {results_dir}; make a run there first.")
    records, problems = [], []
    for folder in sorted((results_dir / "runs").glob("*")):
        if not folder.is_dir() or folder.name.startswith("."):
            continue
        try:
            records.append(_read(folder))
        except FileNotFoundError:
            problems.append(f"{folder.name}: no record.json; the run has not finished, or its record was removed")
        except (OSError, ValueError, RecursionError) as error:
            problems.append(f"{folder.name}: {error}")
    records.sort(key=started, reverse=True)
    return records, problems


def _read(folder: Path) -> dict[str, Any]:
    try:
        record = json.loads((folder / "record.json").read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"record.json is not JSON in UTF-8 ({error})") from error
    if not isinstance(record, dict):
        raise ValueError(f"record.json must hold an object, found {type(record).__name__}")
    if record.get("schema") != SCHEMA:
        raise ValueError(f"record.json must have schema {SCHEMA}, found {record.get('schema')!r}")
    record.setdefault("notes", [])
    record |= {name: decoded(record[name]) for name in _NUMERIC if name in record}
    for name, kind in _FIELDS.items():
        if name not in record:
            raise ValueError(f"record.json must have the field {name!r}, found none")
        if not isinstance(record[name], kind):
            raise ValueError(f"{name} in record.json has the wrong type, found {type(record[name]).__name__}")
    started(record)  # a time that cannot be read is found here, not in the sort
    return record | {"folder": folder.name}


def decoded(value: Any) -> Any:
    """The same data with the strings "inf", "-inf" and "nan" as the floats that they stand for."""
    if isinstance(value, dict):
        return {name: decoded(inner) for name, inner in value.items()}
    return _NON_FINITE.get(value, value) if isinstance(value, str) else value


def started(record: dict[str, Any]) -> datetime:
    """When the run started; a time without an offset is UTC."""
    time = datetime.fromisoformat(record["started"])
    return time if time.tzinfo else time.replace(tzinfo=UTC)
