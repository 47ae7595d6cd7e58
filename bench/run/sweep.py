"""Plans a sweep before its first cell starts, and prints a line as each cell ends."""

import os
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from hydra.plugins.sweeper import Sweeper
from omegaconf import DictConfig, OmegaConf

from bench.config import Isolation, Rerun
from bench.progress import display, notice
from bench.records.folder import reusable
from bench.records.format import number, plural, seconds
from bench.records.metrics import SHOWN, Metric
from bench.records.read import Plan, PlannedCell
from bench.records.record import row_name
from bench.run.compose import identity_of, make_plan, swept_over
from bench.run.pack import check_jobs, in_words, packed, packs
from bench.run.plan import Shown, check_plan, show_plan
from bench.run.process import warm_up

IN_LINE = {  # metrics in the line of a cell
    "recommended_field": Metric("recommended"),
    **{name: SHOWN[name] for name in ("chamfer_l2", "rotation_error_deg")},
}
INTERVAL = 0.5  # seconds between two checks of which cells have ended


class Refused(BaseException):
    """A sweep cannot be planned. Not an Exception, since Hydra turns those that callbacks raise into warnings."""

    def __init__(self, why: Exception) -> None:
        super().__init__(str(why))
        self.why = why


class Sweep:
    """The sweep that this process drives; `plan` is None where it drives none, or one whose cells are no runs."""

    plan: Plan | None = None
    reused = frozenset[str]()  # ids of its cells whose finished run was there already
    runs = True  # whether its cells are runs: those of `bench.train` and `bench.prior` are not
    shown = ExitStack()

    @classmethod
    def start(cls, plan: Plan, reused: set[str]) -> None:
        """Writes and keeps the plan, and shows the sweep's progress from now on."""
        plan.write()
        cls.plan, cls.reused = plan, frozenset(reused)
        cls.shown.enter_context(followed(plan, reused))

    @classmethod
    def end(cls) -> None:
        """Shows no more of the sweep, which has ended."""
        cls.shown.close()
        cls.plan = None


class Planner(Callback):
    """Hydra's callback that writes the plan before a sweep's first cell; see conf/config.yaml.

    The plan composes every cell; Hydra's own check, which would do so once more, is left out.
    """

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Plans the sweep and starts to follow it."""
        if not Sweep.runs:
            return
        try:
            swept, workers = swept_over(config), workers_of(config)
            launcher, settings = config.hydra.runtime.choices["hydra/launcher"], config.hydra.launcher
            if not config.plan:
                how = "many to a job" if packs(settings) else f"{workers} at a time"
                runs = f"{plural(len(swept), 'run')}, {how} (hydra/launcher={launcher})"
                notice(f"sweep: {runs}; a line follows as each ends")
            if config.isolation == Isolation.process:
                warm_up()
            plan = make_plan(config, swept)
            reused = {cell.id for cell in plan.cells if is_reused(plan, cell)}
            check_jobs([cell for cell in plan.cells if cell.id not in reused], settings)
            check_plan(plan, launcher, reused)
            if config.plan:
                jobs = packed(plan, settings, reused) if packs(settings) else []
                show_plan(plan, reused, min(workers, len(jobs) * settings.tasks_per_node) if jobs else workers)
                if jobs:
                    print(in_words(jobs, settings))
                raise Shown
            Sweep.start(plan, reused)
        except Exception as error:
            raise Refused(error) from error
        self.check, Sweeper.validate_batch_is_legal = Sweeper.validate_batch_is_legal, lambda self, batch: None

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Gives Hydra its own check back."""
        if Sweep.runs:
            Sweeper.validate_batch_is_legal = self.check


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


@contextmanager
def followed(plan: Plan, reused: set[str]) -> Iterator[None]:
    """Prints a line for each of the plan's cells as it ends, in whichever process it runs.

    It also shows how many have ended and the time left, on a terminal at any time, else in front of each cell's line.

    Args:
        reused: ids of cells that take no time, since their finished run is there already.
    """
    with display() as shown:
        progress = shown.add_task("sweep", total=len(plan.cells) - len(reused), said="")
        pending, failed, stop = {cell.id: cell for cell in plan.cells}, 0, threading.Event()
        begun = time.monotonic()

        def place(run: int) -> str:
            """What stands in front of a cell's line where there is no terminal; `run` cells were run."""
            if not shown.disable:
                return ""
            parts = [f"{len(plan.cells) - len(pending)}/{len(plan.cells)}"]
            if run and (to_run := len(pending.keys() - reused)):
                parts.append(f"{seconds((time.monotonic() - begun) / run * to_run)} left")
            return f"[{', '.join(parts)}] "

        def run_by_now() -> int:
            return len(plan.cells) - len(reused | pending.keys())

        def update() -> None:
            nonlocal failed
            for cell in list(pending.values()):
                if record := plan.record(cell):
                    del pending[cell.id]
                    failed += record["status"] != "ok"
                    text = line(plan.results_dir / "runs" / cell.id, record, " ".join(plan.differing(cell)))
                    print(place(run_by_now()) + text, flush=True)
            shown.update(progress, completed=run_by_now(), said=f"{failed} failed")

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
