"""Checks configurations before anything runs: an invalid value is reported at once, with its cell.

A configuration is built by the code that its run builds it with, `bench.run.cell.cell_of`.
"""

import io
import os
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout, suppress
from multiprocessing.connection import Connection
from typing import Any

from omegaconf import DictConfig

from bench.config import Isolation, build, check_draw, check_label, check_names, check_top_level
from bench.records.folder import Identity, identify
from bench.records.read import Plan, PlannedCell
from bench.run.messages import reason_of
from bench.run.process import BOOT, INTERVAL, RunLimits, fork_server, raise_if_stopped, signals_delayed, warm_up
from bench.targets import check_targets, has_foreign
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


def refusals(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Why the run of each configuration would be refused; empty where it would not, or where that was not found out.

    Classes of the user's are built in a process of their own: one that hangs, or ends its process, does so in its run.

    Args:
        configs: resolved, as plain data.
    """
    if any(config["isolation"] == Isolation.process and has_foreign(config) for config in configs):
        return _in_a_child(configs)
    built: dict[str, Any] = {}  # what they share
    return [refusal(config, built) for config in configs]


def _in_a_child(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    warm_up()
    context = fork_server()
    ours, childs = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(configs, childs), daemon=True)
    reasons: list[str] = []
    try:
        with signals_delayed():  # a request that breaks off would end the server
            process.start()
            childs.close()
        waited = 0.0
        while len(reasons) < len(configs) and waited < BOOT:
            raise_if_stopped()
            waited = 0.0 if ours.poll(INTERVAL) else waited + INTERVAL
            if not waited:
                reasons.append(ours.recv())
    except (EOFError, OSError):  # a class of the user's ended the process: its run will say how
        pass
    finally:
        ours.close()
        if process.pid is not None:
            process.kill()
            process.join()
    return reasons + [""] * (len(configs) - len(reasons))


def _answer(configs: Sequence[Mapping[str, Any]], channel: Connection) -> None:
    """Sends the reasons one by one, in a process of its own, which prints nothing."""
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)
    os.dup2(nothing, 2)
    built: dict[str, Any] = {}
    with suppress(BrokenPipeError):
        for config in configs:
            channel.send(refusal(config, built))


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
    away = {} if launcher in HERE else {"device": "cpu"}
    cells = [cell for cell in plan.cells if cell.id not in reused]
    found = refusals([cell.config | away for cell in cells])
    bad = [(cell, reason) for cell, reason in zip(cells, found, strict=True) if reason]
    if bad:
        raise ValueError(_of_sweep(plan, *bad[0], len(bad)))


def _of_sweep(plan: Plan, cell: PlannedCell, reason: str, count: int) -> str:
    """One line on a sweep that is refused: its first cell that cannot be, why, and how many cannot."""
    if count == len(plan.cells):
        return reason
    where = " ".join(plan.differing(cell)) or cell.id
    others = f"; {count} of {len(plan.cells)} cells are invalid" if count > 1 else ""
    return f"cell {plan.cells.index(cell) + 1} of {len(plan.cells)} ({where}): {reason}{others}; nothing was run"
