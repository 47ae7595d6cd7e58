"""Checks configurations before anything runs: a value that cannot be is told at once, with its cell.

The checks are those of a run itself, `bench.run.execute.built`. They need the classes, and so torch: they take place in
a process that branches off from the server of processes, as runs do, or with isolation=off in this one.
"""

import json
import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from typing import Any

from omegaconf import DictConfig, OmegaConf

from bench.config import Isolation, build, built_once, check_top_level
from bench.records.folder import Identity
from bench.records.read import Plan, PlannedCell
from bench.rows import register_resolvers
from bench.run.process import BOOT, RunLimits, fork_server, raise_if_stopped, signals_delayed
from bench.targets import OURS

Config = dict[str, Any]  # resolved, as plain data
HERE = ("basic", "joblib", "workers")  # launchers whose runs are on this machine
UNREAD = (
    "seed",
    "label",
    "experiment",
    "sizes",
    "draw",
    "results_dir",
    "verbose",
    "rerun",
    "isolation",
    "tracker",
    "plan",
)
INTERVAL = 0.1  # seconds between two looks at whether the user stopped it


def warm_up(modules: Sequence[str] = ()) -> None:
    """Starts the server of processes, which loads what is slow while this process does something else.

    Args:
        modules: that it loads; none are all that runs import.
    """
    fork_server(modules)
    with signals_delayed():
        forkserver.ensure_running()


def needed(config: Config) -> list[str]:
    """Modules that the check of a configuration takes: half of what its run takes, and a second or two sooner there."""
    parts = [config.get(name) for name in ("task", "renderer", "dataset")]
    paths = [str(part.get("_target_")) for part in parts if isinstance(part, dict)]
    modules = [path.rpartition(".")[0] for path in paths if path.split(".")[0] in OURS]
    return ["bench", "bench.run.execute", *modules]


def check_apart(config: DictConfig) -> None:
    """Checks what needs no torch: values of the top level, limits, and the tracker.

    Raises:
        ValueError: for a value that cannot be.
    """
    check_top_level(config)
    RunLimits(config.time_limit, config.memory_limit)
    build(config.tracker, "tracker", list(config.packages))


def refusals(configs: list[Config], isolation: Isolation | str) -> list[str]:
    """Why each configuration would be refused by its run; empty for those that can be, or that could not be checked."""
    if not configs:
        return []
    if isolation == Isolation.off:
        return list(_reasons(configs))
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


def check_plan(plan: Plan, launcher: str, reused: set[str]) -> None:
    """Checks all cells of a sweep, before it is written down.

    Args:
        plan: the sweep.
        launcher: the choice of `hydra/launcher`; another machine may have a GPU where this one has none.
        reused: ids of the cells whose finished run is there already, so that they need not be checked.

    Raises:
        ValueError: where a cell cannot be, with the cell and what is wrong with it.
    """
    cells = [cell for cell in plan.cells if cell.id not in reused]
    away = {} if launcher in HERE else {"device": "cpu"}
    found = refusals([cell.config | away for cell in cells], plan.cells[0].config["isolation"])
    bad = [(cell, reason) for cell, reason in zip(cells, found, strict=True) if reason]
    if bad:
        cell, reason = bad[0]
        raise ValueError(refusal(plan, cell, reason, len(bad)))


def refusal(plan: Plan, cell: PlannedCell, reason: str, count: int) -> str:
    """One line on a sweep that is refused: its first cell that cannot be, why, and how many cannot."""
    if count == len(plan.cells):
        return reason
    where = " ".join(plan.differing(cell)) or cell.id
    others = f"; {count} of {len(plan.cells)} cells cannot be" if count > 1 else ""
    return f"cell {plan.cells.index(cell) + 1} of {len(plan.cells)} ({where}): {reason}{others}; nothing was run"


def identity_of(cell: PlannedCell) -> Identity:
    """The identity of a planned cell's run."""
    choices = {name: getattr(cell, name) for name in ("task", "renderer", "dataset", "method")}
    return Identity(choices, cell.config)


def _answer(configs: list[Config], channel: Connection) -> None:
    """Sends the reasons one by one, in a process of its own, which prints nothing."""
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)
    os.dup2(nothing, 2)
    register_resolvers()
    with suppress(BrokenPipeError):
        for reason in _reasons(configs):
            channel.send(reason)


def _reasons(configs: list[Config]) -> Iterator[str]:
    """The reasons, each part and each combination of parts built once."""
    from bench.run.execute import built  # it imports torch
    from renderers.checks import BadInput

    nodes, known = _Nodes(), dict[str, str]()
    with built_once():
        for config in configs:
            key = json.dumps({k: v for k, v in config.items() if k not in UNREAD}, sort_keys=True, default=str)
            if key not in known:
                known[key] = ""
                try:
                    built(nodes.config(config), lambda *_: None)
                except BadInput as error:
                    known[key] = str(error)
                except Exception:  # noqa: BLE001 - of a class of the user's; the run records it
                    known[key] = ""
            yield known[key]


class _Nodes:
    """Makes configurations of plain data; those that are equal in a part share its node."""

    def __init__(self) -> None:
        self.nodes: dict[str, Any] = {}

    def config(self, plain: Config) -> DictConfig:
        """A configuration whose parts are not copied."""
        config = OmegaConf.create({}, flags={"no_deepcopy_set_nodes": True})
        for key, value in plain.items():
            config[key] = self._node(key, value) if isinstance(value, dict | list) else value
        return config

    def _node(self, key: str, value: Any) -> Any:
        text = f"{key} {json.dumps(value, sort_keys=True, default=str)}"
        if text not in self.nodes:
            self.nodes[text] = OmegaConf.create(value)
        return self.nodes[text]
