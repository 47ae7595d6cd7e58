"""What pages of before `bench.studies` read: to go with the last of them."""

from typing import Any

from bench.report.data import runs
from bench.report.data.runs import Runs as Experiment
from bench.report.data.runs import choose, shared_loss, together

__all__ = ["Experiment", "Selection", "choose", "shared_loss", "together"]


def Selection(
    experiment: str,
    tasks: Any = (),
    varies: tuple[str, ...] = (),
    cell: tuple[str, ...] = (),
    setup: tuple[str, ...] = ("scenes", "pixels", "network", "machine"),
    splits: bool = False,
) -> runs.Selection:
    """A selection of before."""
    conditions = tuple(f"task.{name}" for name in cell) + ("split",) * splits
    alike = tuple(part for part in ("dataset", "view", "prior", "task") if part not in varies) if not varies else ()
    return runs.Selection(experiment, conditions, setup, alike + (("task",) if varies and "task" not in varies else ()))
