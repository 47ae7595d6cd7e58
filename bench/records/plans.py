"""The plan of a sweep: a list of all its cells, written before the first one starts, so that none is lost."""

import json
from dataclasses import asdict, dataclass, field, fields
from datetime import datetime
from pathlib import Path
from typing import Any

from bench.records.files import to_json, write_text
from bench.records.record import SCHEMA, now, read_record

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
