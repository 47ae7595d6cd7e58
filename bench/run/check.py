"""Checks configurations before anything runs: an invalid value is reported at once, with its cell.

A configuration is built by the code that its run builds it with, `bench.setup.inputs.cell_of`.
"""

import io
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from multiprocessing.connection import Connection
from typing import Any

from bench.config import Isolation, is_foreign
from bench.records.read import Plan, PlannedCell
from bench.run.process import BOOT, fork_server, reason_of, signals_delayed, warm_up

HERE = ("basic", "joblib", "workers")  # launchers whose runs are on this machine


def refusals(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Why the run of each configuration would be refused; empty where it would not, or where that was not found out.

    Classes of the user's are built in a process of their own: one that hangs, or ends its process, does so in its run.

    Args:
        configs: resolved, as plain data.
    """
    if any(config["isolation"] == Isolation.process and is_foreign(config) for config in configs):
        return _in_a_child(configs)
    built: dict[str, Any] = {}  # what they share
    return [refusal(config, built) for config in configs]


def _in_a_child(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    warm_up()
    context = fork_server()
    ours, childs = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(configs, childs), daemon=True)
    with signals_delayed():  # a request that breaks off would end the server
        process.start()
        childs.close()
    try:
        return ours.recv() if ours.poll(BOOT) else [""] * len(configs)
    except EOFError:  # a class of the user's ended the process: its run will say how
        return [""] * len(configs)
    finally:
        process.kill()
        process.join()
        ours.close()


def _answer(configs: Sequence[Mapping[str, Any]], channel: Connection) -> None:
    built: dict[str, Any] = {}
    channel.send([refusal(config, built) for config in configs])


def refusal(config: Mapping[str, Any], built: dict[str, Any] | None = None) -> str:
    """Why the run of a configuration would be refused; empty where it would not, or would fail in another way.

    Args:
        config: resolved, as plain data.
        built: what cells of a sweep share; see `cell_of`.
    """
    from bench.setup.inputs import cell_of  # it imports torch

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
        ValueError: for an invalid cell, with the cell and what is wrong with it.
    """
    away = {} if launcher in HERE else {"device": "cpu"}
    cells = [cell for cell in plan.cells if cell.id not in reused]
    found = refusals([cell.config | away for cell in cells])
    bad = [(cell, reason) for cell, reason in zip(cells, found, strict=True) if reason]
    if bad:
        raise ValueError(_of_sweep(plan, *bad[0], len(bad)))


def _of_sweep(plan: Plan, cell: PlannedCell, reason: str, count: int) -> str:
    """One line on a sweep that is refused: its first invalid cell, why, and how many are invalid."""
    if count == len(plan.cells):
        return reason
    where = " ".join(plan.differing(cell)) or cell.id
    others = f"; {count} of {len(plan.cells)} cells are invalid" if count > 1 else ""
    return f"cell {plan.cells.index(cell) + 1} of {len(plan.cells)} ({where}): {reason}{others}; nothing was run"
