"""Plans a sweep before its first cell starts, and prints a line as each cell ends."""

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from hydra._internal.config_repository import CachingConfigRepository
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from hydra.plugins.sweeper import Sweeper
from omegaconf import DictConfig, OmegaConf

from bench.config import Isolation, Rerun, check_label, check_names
from bench.progress import display, notice
from bench.records.expected import Remaining
from bench.records.files import digest
from bench.records.folder import identify, reusable
from bench.records.format import number, seconds
from bench.records.metrics import SHOWN, Metric
from bench.records.read import Plan, PlannedCell
from bench.records.record import row_name
from bench.run.check import check_apart, check_plan, identity_of, warm_up
from bench.run.plan import Shown, remaining, show_plan
from bench.targets import check_targets

IN_LINE = {  # metrics in the line of a cell
    "recommended_field": Metric("recommended"),
    **{name: SHOWN[name] for name in ("chamfer_l2", "rotation_error_deg")},
}
INTERVAL = 0.5  # seconds between two checks of which cells have ended
COMPOSED = 0.1  # seconds that composing a cell takes
SILENT = 3.0  # seconds above which a sweep says how long it plans


class Refused(BaseException):
    """A sweep cannot be planned. Not an Exception, since Hydra turns those that callbacks raise into warnings."""

    def __init__(self, why: Exception) -> None:
        super().__init__(str(why))
        self.why = why


class ReadOnce(CachingConfigRepository):
    """The files of the configuration, each read once for all cells; Hydra's own repository is copied for each cell."""

    def __deepcopy__(self, memo: dict[int, Any]) -> "ReadOnce":
        return self


class Sweep:
    """The sweep that this process drives; `plan` is None where it drives none, or one whose cells are no runs.

    `other` gets each cell of a sweep whose cells are no runs (`bench.train`, `bench.prior`); else it is None.
    """

    plan: Plan | None = None
    other: Callable[[DictConfig], None] | None = None
    shown = ExitStack()

    @classmethod
    def start(cls, plan: Plan, left: Remaining) -> None:
        """Writes and keeps the plan, and shows the sweep's progress from now on."""
        plan.write()
        cls.plan = plan
        cls.shown.enter_context(followed(plan, left))

    @classmethod
    def end(cls) -> None:
        """Shows no more of the sweep, which has ended."""
        cls.shown.close()
        cls.plan = None


class Planner(Callback):
    """Hydra's callback that writes the plan before a sweep's first cell; see conf/config.yaml.

    The plan composes every cell, which takes `COMPOSED` each; Hydra's own check would do so once more.
    """

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Plans the sweep and starts to follow it."""
        if Sweep.other is not None:
            if config.plan:
                self.list_others(config, Sweep.other)
            return
        try:
            if config.isolation == Isolation.process:
                warm_up()
            plan, launcher = make_plan(config), config.hydra.runtime.choices["hydra/launcher"]
            reused, workers = {cell.id for cell in plan.cells if is_reused(plan, cell)}, workers_of(config)
            check_plan(plan, launcher, reused)
            if config.plan:
                show_plan(plan, reused, workers)
                raise Shown
            Sweep.start(plan, remaining(plan, reused, workers))
        except Exception as error:
            raise Refused(error) from error
        self.check, Sweeper.validate_batch_is_legal = Sweeper.validate_batch_is_legal, lambda self, batch: None

    def list_others(self, config: DictConfig, tell: Callable[[DictConfig], None]) -> None:
        """Lists the cells of a sweep that are no runs, in this process."""
        try:
            for cell in make_plan(config).cells:
                tell(OmegaConf.create(cell.config))
        except Exception as error:
            raise Refused(error) from error
        raise Shown

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Gives Hydra its own check back."""
        if Sweep.other is None:
            Sweeper.validate_batch_is_legal = self.check


def make_plan(config: DictConfig) -> Plan:
    """All cells of the sweep that the command line describes.

    Raises:
        HydraException, OmegaConfBaseException: where a cell cannot be composed.
        ValueError: where the sweep has no cell.
    """
    loader: Any = GlobalHydra.instance().config_loader()
    loader.repository = ReadOnce(loader.repository)
    params = OmegaConf.select(config, "hydra.sweeper.params") or {}
    typed = {_key(override) for override in config.hydra.overrides.task}  # what params sweep over may be of a YAML
    cells: list[PlannedCell] = []
    swept = combinations([*(f"{key}={value}" for key, value in params.items()), *config.hydra.overrides.task])
    if len(swept) * COMPOSED > SILENT:
        notice(f"planning {len(swept)} cells, about {seconds(len(swept) * COMPOSED)}")
    for cell in swept:
        composed = loader.load_sweep_config(config, cell)
        plain = _without_hydra(composed)
        check_names(plain)
        check_label(plain, cell)
        by_hand = [override for override in cell if _key(override) in typed]
        check_targets(plain, by_hand, composed.hydra.runtime.choices.get("renderer", ""))
        try:
            check_apart(plain)
        except ValueError as error:
            raise ValueError(f"cell {len(cells) + 1} ({' '.join(cell)}): {error}; nothing was run") from error
        identity = identify(plain, composed.hydra.runtime)
        cells.append(
            PlannedCell(identity.name, cell, **identity.choices, seed=identity.config["seed"], config=identity.config)
        )
    if not cells:
        raise ValueError(f"the sweep has no cell: {' '.join(config.hydra.overrides.task)}")
    first = cells[0].config
    name = f"{first['experiment'] or cells[0].task}-{digest([cell.id for cell in cells])}"
    return Plan(name, Path(first["results_dir"]), cells)


def is_reused(plan: Plan, cell: PlannedCell) -> bool:
    """Whether a cell's finished run is there already, and will be reused."""
    folder = plan.results_dir / "runs" / cell.id
    return reusable(folder, identity_of(cell), Rerun(cell.config["rerun"])) is not None


def workers_of(config: DictConfig) -> int:
    """How many cells the launcher runs at a time, as far as its settings say so."""
    for key in ("n_jobs", "array_parallelism"):  # of joblib, and of submitit
        if (count := OmegaConf.select(config, f"hydra.launcher.{key}")) is not None:
            return max(int(count), 1) if count > 0 else os.cpu_count() or 1
    return 1


def combinations(texts: list[str]) -> list[list[str]]:
    """The overrides of each cell, from those of a sweep, such as `seed=0,1`, in the order in which Hydra runs them.

    Together with `Planner` and `ReadOnce` it is all that uses what is internal to Hydra's sweeps.
    """
    parser = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader())
    return BasicSweeper.split_arguments(parser.parse_overrides(texts), None)[0]


def _key(override: str) -> str:
    return override.partition("=")[0].lstrip("+~")


def _without_hydra(config: DictConfig) -> DictConfig:
    plain = config.copy()
    OmegaConf.set_struct(plain, False)
    del plain["hydra"]
    return plain


@contextmanager
def followed(plan: Plan, left: Remaining) -> Iterator[None]:
    """Prints a line for each of the plan's cells as it ends, in whichever process it runs.

    It also shows how many have ended and the time left, on a terminal at any time, else in front of each cell's line.
    """
    with display() as shown:
        progress = shown.add_task("sweep", total=len(plan.cells), said="", left=left.left(0.0))
        pending, failed, stop = {cell.id: cell for cell in plan.cells}, 0, threading.Event()
        begun = time.monotonic()

        def place(time_left: float | None) -> str:
            """What stands in front of a cell's line where there is no terminal."""
            if not shown.disable:
                return ""
            parts = [f"{len(plan.cells) - len(pending)}/{len(plan.cells)}"]
            if time_left is not None and pending:
                parts.append(f"{seconds(time_left)} left")
            return f"[{', '.join(parts)}] "

        def update() -> None:
            nonlocal failed
            for cell in list(pending.values()):
                if record := plan.record(cell):
                    del pending[cell.id]
                    failed += record["status"] != "ok"
                    left.ended(cell.id, record, time.monotonic() - begun)
                    text = line(plan.results_dir / "runs" / cell.id, record, " ".join(plan.differing(cell)))
                    print(place(left.left(time.monotonic() - begun)) + text, flush=True)
            ended = len(plan.cells) - len(pending)
            shown.update(progress, completed=ended, said=f"{failed} failed", left=left.left(time.monotonic() - begun))

        def follow() -> None:
            while not stop.wait(max(INTERVAL, 1e-3 * len(pending))):
                update()

        thread = threading.Thread(target=follow, daemon=True)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()
            update()
            shown.remove_task(progress)


def line(folder: Path, record: dict[str, Any], differing: str) -> str:
    """The outcome of a cell in a line that ends with its folder; `differing` are overrides that not all cells have."""
    name, spent = row_name(record["config"], record["renderer"]), record["seconds"]
    loop = spent.get("forward", 0.0) + spent.get("backward", 0.0) or spent.get("total")
    parts = [
        record["status"] + (" (reused)" if record["reused"] else ""),
        differing,
        ", ".join((record["task"], name, record["scene"] or record["dataset"])),
        seconds(loop),
    ]
    known = record["metrics"]
    parts += [f"{m.label} {number(known[name], m.factor)}" for name, m in IN_LINE.items() if name in known]
    if "level" in known:
        parts.append(breakdown(record))
    return "  ".join(part for part in [*parts, record["reason"], str(folder)] if part)


def breakdown(record: dict[str, Any]) -> str:
    """The breakdown of a run of the stability task, in words."""
    level, unit = record["metrics"]["level"], record["config"]["task"]["stress"]["sweep"]["unit"]
    if level is None or 0 <= level <= 1:
        return f"breaks at {number(record['metrics']['breakdown'])} {unit}"
    return "breaks at once" if level < 0 else "does not break in the sweep"
