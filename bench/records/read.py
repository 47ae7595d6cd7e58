"""Reads all records of a results folder; a record that cannot be read gives an error message and stops nothing."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from bench.records.plans import read_plans
from bench.records.record import NOT_RUN, Record, read_record, started


def read_records(results_dir: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """The records of `results_dir/runs/*/record.json`, newest first, and a message for each that cannot be read.

    A message gives the folder's name and the reason. Hidden folders are ignored. Cells that a sweep planned and that
    have no folder are among the records, with the status `not_run` and no numbers.

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
    known = {record["folder"] for record in records}
    plans, unread = read_plans(results_dir)
    missing = {cell["id"]: _not_run(cell, plan) for plan in plans for cell in plan["cells"] if cell["id"] not in known}
    records.extend(missing.values())
    records.sort(key=started, reverse=True)
    return records, problems + unread


def _not_run(cell: dict[str, Any], plan: dict[str, Any]) -> dict[str, Any]:
    """A record in place of a planned cell's run that does not exist."""
    given = {name: cell[name] for name in ("id", "task", "renderer", "dataset", "seed", "config", "method")}
    reason = f"planned by sweep {plan['name']}; the same command runs it"
    record = Record(**given, started=plan["asked"], asked=plan["asked"], status=NOT_RUN, reason=reason)
    return asdict(record) | {"folder": cell["id"]}
