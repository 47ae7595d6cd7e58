"""Reads a results folder: the records of its runs, and the plans of its sweeps, whose cells must have a run each."""

import json
from dataclasses import asdict, dataclass, field, fields
from datetime import datetime
from pathlib import Path
from typing import Any

from bench.records.files import decoded, to_json, write_text
from bench.records.record import NOT_RUN, SCHEMA, Record, now, read_record, started

PLAN = "plan.json"


@dataclass(frozen=True)
class PlannedCell:
    """A cell of a sweep: the name of its run folder, what it overrides, and its resolved configuration."""

    id: str
    overrides: list[str]
    task: str
    renderer: str
    dataset: str
    seed: int
    config: dict[str, Any]
    method: str = ""


@dataclass(frozen=True)
class Plan:
    """All cells of a sweep, in their order."""

    name: str
    results_dir: Path
    cells: list[PlannedCell]
    asked: str = field(default_factory=now)

    @property
    def folder(self) -> Path:
        """The folder of the plan; the same sweep has the same folder."""
        return self.results_dir / "sweeps" / self.name

    def write(self) -> None:
        """Writes `plan.json`."""
        self.folder.mkdir(parents=True, exist_ok=True)
        plain = {"schema": SCHEMA, "name": self.name, "asked": self.asked, "cells": [asdict(c) for c in self.cells]}
        write_text(self.folder / PLAN, to_json(plain))

    def record(self, cell: PlannedCell) -> dict[str, Any] | None:
        """The record of a cell, if it was requested since the plan was made and has ended."""
        try:
            record = read_record(self.results_dir / "runs" / cell.id)
        except (OSError, ValueError, RecursionError):
            return None
        return record if record.get("ended") and record.get("asked", "") >= self.asked else None


def read_plans(results_dir: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """All plans of a results folder as plain data, and an error message for each that cannot be read."""
    plans, problems = [], []
    for path in sorted((results_dir / "sweeps").glob(f"*/{PLAN}")):
        try:
            plan = json.loads(path.read_text(encoding="utf-8"))
            if plan["schema"] != SCHEMA:
                raise ValueError(f"schema must be {SCHEMA}, found {plan['schema']!r}")
            datetime.fromisoformat(plan["asked"])
            names = [item.name for item in fields(PlannedCell)]
            cells = [{"method": ""} | {name: cell[name] for name in names if name in cell} for cell in plan["cells"]]
            if any(len(cell) < len(names) for cell in cells):
                raise ValueError(f"each cell must have {', '.join(names)}")
            plans.append({"name": plan["name"], "asked": plan["asked"], "cells": cells})
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            problems.append(f"sweeps/{path.parent.name}/{PLAN}: {error!r}")
    return plans, problems


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


def curve_lines(folder: Path) -> list[dict[str, Any]] | None:
    """The lines of `curve.jsonl`, empty for those that cannot be read; None where there is no such file."""
    try:
        text = (folder / "curve.jsonl").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    return [_line(line) for line in text.splitlines()]


def _line(text: str) -> dict[str, Any]:
    try:
        found = decoded(json.loads(text))
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _not_run(cell: dict[str, Any], plan: dict[str, Any]) -> dict[str, Any]:
    """A record in place of a planned cell's run that does not exist."""
    given = {name: cell[name] for name in ("id", "task", "renderer", "dataset", "seed", "config", "method")}
    reason = f"planned by sweep {plan['name']}; the same command runs it"
    record = Record(**given, started=plan["asked"], asked=plan["asked"], status=NOT_RUN, reason=reason)
    return asdict(record) | {"folder": cell["id"]}
