"""The plan of a sweep: all its cells, written before the first one starts, so that none can be lost."""

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from bench.identity import identify
from bench.progress import display
from bench.records import digest, now, to_json, write_text
from bench.report.format import number, seconds
from bench.report.records import read_record

SCHEMA = 1
PLAN = "plan.json"
TOLD = (  # metric, what it is called, factor
    ("recommended_field", "needs", 1.0),
    ("chamfer_l2", "Chamfer (x1000)", 1000.0),
    ("rotation_error_deg", "rotation error (degrees)", 1.0),
)
LOOK = 0.5  # seconds between two looks at what has ended


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


@dataclass(frozen=True)
class Plan:
    """All cells of a sweep, in their order."""

    name: str
    results_dir: Path
    cells: list[PlannedCell]
    asked: str = field(default_factory=now)

    @property
    def folder(self) -> Path:
        """Where the plan is kept; the same sweep has the same one."""
        return self.results_dir / "sweeps" / self.name

    def write(self) -> None:
        """Writes `plan.json`."""
        self.folder.mkdir(parents=True, exist_ok=True)
        plain = {"schema": SCHEMA, "name": self.name, "asked": self.asked, "cells": [asdict(c) for c in self.cells]}
        write_text(self.folder / PLAN, to_json(plain))

    def record(self, cell: PlannedCell) -> dict[str, Any] | None:
        """The record of a cell, if it was asked for since the plan was made and has come to an end."""
        try:
            record = read_record(self.results_dir / "runs" / cell.id)
        except (OSError, ValueError, RecursionError):
            return None
        return record if record.get("ended") and record.get("asked", "") >= self.asked else None


class Refused(BaseException):
    """A sweep that cannot be planned. Not an Exception, since Hydra makes a warning of those that callbacks raise."""

    def __init__(self, why: Exception) -> None:
        super().__init__(str(why))
        self.why = why


class Sweep:
    """The sweep that this process drives, if it drives one."""

    plan: Plan | None = None
    shown = ExitStack()

    @classmethod
    def start(cls, plan: Plan) -> None:
        """Keeps the plan, and shows how the sweep gets on."""
        plan.write()
        cls.plan = plan
        cls.shown.enter_context(followed(plan))

    @classmethod
    def end(cls) -> Plan | None:
        """The plan of the sweep that has ended, if there was one."""
        cls.shown.close()
        plan, cls.plan = cls.plan, None
        return plan


class Planner(Callback):
    """Hydra's callback that writes the plan before a sweep's first cell; see conf/config.yaml."""

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Plans the sweep, and starts it."""
        try:
            Sweep.start(make_plan(config))
        except Exception as error:
            raise Refused(error) from error


def make_plan(config: DictConfig) -> Plan:
    """All cells of the sweep that a command line asks for.

    Raises:
        HydraException, OmegaConfBaseException: where a cell of it cannot be composed.
    """
    loader = GlobalHydra.instance().config_loader()
    params = OmegaConf.select(config, "hydra.sweeper.params") or {}
    texts = [*(f"{key}={value}" for key, value in params.items()), *config.hydra.overrides.task]
    overrides = OverridesParser.create(config_loader=loader).parse_overrides(texts)
    cells: list[PlannedCell] = []
    for cell in BasicSweeper.split_arguments(overrides, None)[0]:
        composed = loader.load_sweep_config(config, cell)
        identity = identify(_without_hydra(composed), composed.hydra.runtime.choices)
        cells.append(
            PlannedCell(identity.name, cell, **identity.choices, seed=identity.config["seed"], config=identity.config)
        )
    if not cells:
        raise ValueError(f"the sweep has no cell: {' '.join(config.hydra.overrides.task)}")
    first = cells[0].config
    name = f"{first['experiment'] or cells[0].task}-{digest([cell.id for cell in cells])}"
    return Plan(name, Path(first["results_dir"]), cells)


def _without_hydra(config: DictConfig) -> DictConfig:
    plain = config.copy()
    OmegaConf.set_struct(plain, False)
    del plain["hydra"]
    return plain


@contextmanager
def followed(plan: Plan) -> Iterator[None]:
    """Prints a line for each of the plan's cells as it ends, whatever process it runs in.

    On a terminal it shows, too, how many have ended, how many of them failed, and the time left.
    """
    with display() as shown:
        progress = shown.add_task("sweep", total=len(plan.cells), said="")
        pending, failed, stop = {cell.id: cell for cell in plan.cells}, 0, threading.Event()

        common = set.intersection(*(set(cell.overrides) for cell in plan.cells))

        def look() -> None:
            nonlocal failed
            for cell in list(pending.values()):
                if record := plan.record(cell):
                    del pending[cell.id]
                    failed += record["status"] != "ok"
                    own = [override for override in cell.overrides if override not in common]
                    print(line(plan.results_dir / "runs" / cell.id, record, " ".join(own)), flush=True)
            shown.update(progress, completed=len(plan.cells) - len(pending), said=f"{failed} failed")

        def follow() -> None:
            while not stop.wait(max(LOOK, 1e-3 * len(pending))):
                look()

        thread = threading.Thread(target=follow, daemon=True)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()
            look()
            shown.remove_task(progress)


def line(folder: Path, record: dict[str, Any], own: str) -> str:
    """What a cell came to, in a line that ends with its folder; `own` is what tells it from the others."""
    name, spent = record["config"].get("label") or record["renderer"], record["seconds"]
    loop = spent.get("forward", 0.0) + spent.get("backward", 0.0) or spent.get("total")
    parts = [
        record["status"] + (" (reused)" if record["reused"] else ""),
        own,
        ", ".join((record["task"], name, record["scene"] or record["dataset"])),
        seconds(loop),
    ]
    known = record["metrics"]
    parts += [f"{told} {number(known[name], factor)}" for name, told, factor in TOLD if name in known]
    if "level" in known:
        parts.append(breakdown(record))
    return "  ".join(part for part in [*parts, record["reason"], str(folder)] if part)


def breakdown(record: dict[str, Any]) -> str:
    """Where a run of the stability task broke, in words."""
    level, unit = record["metrics"]["level"], record["config"]["task"]["stress"]["sweep"]["unit"]
    if level is None or 0 <= level <= 1:
        return f"breaks at {number(record['metrics']['breakdown'])} {unit}"
    return "breaks at once" if level < 0 else "does not break in the sweep"
