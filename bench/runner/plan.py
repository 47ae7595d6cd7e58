"""The plan of a sweep, and the check of all its runs before the first one starts.

A check builds the configuration with the same code as the run, `bench.setup.inputs.prepare_run`.
"""

import io
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from bench.config import Isolation
from bench.records.folder import reusable_record
from bench.records.record import digest
from bench.records.results import Plan, PlannedRun
from bench.runner.messages import reason_of
from bench.runner.process import run_in_child


def plan_of(cells: list[PlannedRun]) -> Plan:
    """The plan of a sweep of these runs."""
    first = cells[0]
    name = f"{first.config['experiment'] or first.task}-{digest([cell.id for cell in cells])}"
    return Plan(name, Path(first.config["results_dir"]), cells)


def reused_ids(cells: Sequence[PlannedRun]) -> set[str]:
    """The ids of the runs that exist, are finished, and will be reused."""
    return {cell.id for cell in cells if reusable_record(cell) is not None}


def refusal_reason(config: Mapping[str, Any], built: dict[str, Any] | None = None) -> str:
    """Why the run of a configuration would be refused; empty if it would start, or fail in another way."""
    from bench.setup.inputs import prepare_run  # it imports torch

    try:
        with redirect_stdout(io.StringIO()):  # classes of the user may print
            prepare_run(config, built)
    except (ValueError, OSError) as error:
        return reason_of(error)
    except (Exception, SystemExit):  # noqa: BLE001 - a class of the user; the run will record the error
        return ""
    return ""


def refusal_reasons(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """For each configuration, why its run would be refused; empty if it would not be.

    Torch is loaded only in the process of runs, unless a run takes place in this process.
    """
    if not configs or any(config["isolation"] == Isolation.off for config in configs):
        return _refusal_reasons(configs)
    # A class that ends its process gives no reasons here, and will end the process of its run.
    return run_in_child(_refusal_reasons, configs) or [""] * len(configs)


def _refusal_reasons(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    built: dict[str, Any] = {}  # shared objects
    return [refusal_reason(config, built) for config in configs]


def check_plan(plan: Plan, reused: set[str], *, is_local: bool) -> None:
    """Checks all cells of a sweep before its plan is written.

    Args:
        reused: ids of cells whose finished run will be reused, which are not checked.
        is_local: whether the runs are on this machine; those on another one may use a GPU that this one lacks.

    Raises:
        ValueError: if a cell is invalid; the message has the cell and the reason.
    """
    device_override = {} if is_local else {"device": "cpu"}
    cells = [cell for cell in plan.cells if cell.id not in reused]
    reasons = refusal_reasons([cell.config | device_override for cell in cells])
    refused = [(cell, reason) for cell, reason in zip(cells, reasons, strict=True) if reason]
    if refused:
        raise ValueError(_refusal_message(plan, *refused[0], len(refused)))


def _refusal_message(plan: Plan, cell: PlannedRun, reason: str, count: int) -> str:
    """The message for a refused sweep: its first invalid cell, the reason, and the number of invalid cells."""
    if count == len(plan.cells):
        return reason
    where = " ".join(plan.distinct_overrides(cell)) or cell.id
    others = f"; {count} of {len(plan.cells)} cells are invalid" if count > 1 else ""
    return f"cell {plan.cells.index(cell) + 1} of {len(plan.cells)} ({where}): {reason}{others}; nothing was run"
