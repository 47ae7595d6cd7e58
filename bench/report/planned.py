"""The cells of all plans that have no record: rows too, so that a sweep that was cut short shows what it lacks."""

import json
from datetime import datetime
from pathlib import Path
from typing import Any

SCHEMA = 1
NOT_RUN = "not_run"


def read_planned(results_dir: Path, known: set[str]) -> tuple[list[dict[str, Any]], list[str]]:
    """What stands for each planned cell without a folder in `known`, and a line for each plan that was not read.

    A stand-in has the fields of a record, with status `not_run` and no numbers.
    """
    missing: dict[str, dict[str, Any]] = {}
    problems = []
    for path in sorted((results_dir / "sweeps").glob("*/plan.json")):
        try:
            plan = json.loads(path.read_text(encoding="utf-8"))
            if plan["schema"] != SCHEMA:
                raise ValueError(f"schema must be {SCHEMA}, found {plan['schema']!r}")
            datetime.fromisoformat(plan["asked"])
            missing |= {cell["id"]: _stand_in(cell, plan) for cell in plan["cells"] if cell["id"] not in known}
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            problems.append(f"sweeps/{path.parent.name}/plan.json: {error!r}")
    return list(missing.values()), problems


def _stand_in(cell: dict[str, Any], plan: dict[str, Any]) -> dict[str, Any]:
    empty: dict[str, Any] = {key: {} for key in ("metrics", "metrics_start", "definitions", "evaluations", "seconds")}
    return {
        **{name: cell[name] for name in ("id", "task", "renderer", "dataset", "seed", "config")},
        **empty,
        **dict.fromkeys(("peak_memory_bytes", "flops", "gemm_fraction")),
        "environment": {},
        "folder": cell["id"],
        "status": NOT_RUN,
        "reason": f"planned by sweep {plan['name']}; the same command runs it",
        "started": plan["asked"],
        "asked": plan["asked"],
        "reused": False,
        "notes": [],
    }
