"""Checks configurations before anything runs: an invalid value is reported at once, with its cell.

A configuration is built by the code that its run builds it with, `bench.run.cell.cell_of`.
"""

import io
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from typing import Any

from omegaconf import DictConfig

from bench.config import build, check_draw, check_label, check_names, check_top_level
from bench.records.folder import Identity, identify
from bench.records.read import Plan, PlannedCell
from bench.run.messages import reason_of
from bench.run.process import RunLimits
from bench.targets import check_targets
from bench.trackers import Tracker

HERE = ("basic", "joblib", "workers")  # launchers whose runs are on this machine


def identified(config: DictConfig, runtime: DictConfig, overrides: Sequence[str], typed: Sequence[str]) -> Identity:
    """The run that a configuration describes, after all that can be told of it without torch has been checked.

    Args:
        config: without Hydra's own node.
        runtime: `hydra.runtime`.
        overrides: of the run.
        typed: those that the command line has, by which alone packages are named.

    Raises:
        ValueError: for a value that cannot be.
    """
    check_draw(config)
    identity = identify(config, runtime)
    check_names(identity.config)
    check_label(identity.config, overrides)
    check_targets(identity.config, typed, identity.choices["renderer"])
    check_top_level(identity.config)
    RunLimits.of(identity.config)
    tracker_of(identity.config)
    return identity


def tracker_of(config: Mapping[str, Any]) -> Tracker:
    """The tracker that a run is exported to."""
    return build(config["tracker"], "tracker", config["packages"])


def refusal(config: Mapping[str, Any], built: dict[str, Any] | None = None) -> str:
    """Why the run of a configuration would be refused; empty where it would not, or would fail in another way.

    Args:
        config: resolved, as plain data.
        built: what cells of a sweep share; see `cell_of`.
    """
    from bench.run.cell import cell_of  # it imports torch

    try:
        with redirect_stdout(io.StringIO()):  # of classes of the user's
            cell_of(config, built)
    except (ValueError, OSError) as error:
        return reason_of(error)
    except Exception:  # noqa: BLE001 - of a class of the user's; the run records it
        return ""
    return ""


def check_plan(plan: Plan, launcher: str, reused: set[str]) -> None:
    """Checks all cells of a sweep, before it is written down.

    Args:
        plan: the sweep.
        launcher: the choice of `hydra/launcher`; another machine may have a GPU where this one has none.
        reused: ids of the cells whose finished run is there already, so that they need not be checked.

    Raises:
        ValueError: where a cell cannot be, with the cell and what is wrong with it.
    """
    away, built = {} if launcher in HERE else {"device": "cpu"}, {}
    found = [(cell, refusal(cell.config | away, built)) for cell in plan.cells if cell.id not in reused]
    bad = [(cell, reason) for cell, reason in found if reason]
    if bad:
        raise ValueError(_of_sweep(plan, *bad[0], len(bad)))


def _of_sweep(plan: Plan, cell: PlannedCell, reason: str, count: int) -> str:
    """One line on a sweep that is refused: its first cell that cannot be, why, and how many cannot."""
    if count == len(plan.cells):
        return reason
    where = " ".join(plan.differing(cell)) or cell.id
    others = f"; {count} of {len(plan.cells)} cells are invalid" if count > 1 else ""
    return f"cell {plan.cells.index(cell) + 1} of {len(plan.cells)} ({where}): {reason}{others}; nothing was run"
