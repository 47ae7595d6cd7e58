"""A sweep: its cells are composed, checked, planned, made by an executor, and followed by a line as each ends."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from bench.config import Isolation
from bench.progress import display, notice
from bench.records.folder import Identity
from bench.records.format import number, plural, seconds
from bench.records.metrics import TABLE_METRICS, Metric
from bench.records.read import Plan
from bench.records.record import RunStatus, row_name
from bench.run.compose import Composer
from bench.run.executors import Launcher, execute
from bench.run.job import Interrupted, reason_of
from bench.run.jobs import check_jobs, in_words, packed
from bench.run.plan import check_plan, identity_of, is_reused, plan_of, planned, show_plan
from bench.run.process import stopped_by, warm_up
from bench.run.run import run_cell

IN_LINE = {  # metrics in the line of a cell
    "recommended_field": Metric("recommended"),
    **{name: TABLE_METRICS[name] for name in ("chamfer_l2", "rotation_error_deg")},
}
INTERVAL = 0.5  # seconds between two checks of which cells have ended


class LauncherStopped(RuntimeError):
    """An executor cannot go on: a cluster that is not there, a process that is lost."""


@dataclass(frozen=True)
class Once:
    """Makes the run of a cell that has not ended since its sweep was planned: a job that is requeued goes on so."""

    plan: Plan

    def __call__(self, identity: Identity) -> list[str]:
        """Gives a message where it leaves no record."""
        record = self.plan.record(planned(identity))
        return run_cell(identity) if record is None or record["status"] == RunStatus.KILLED else []


def run_sweep(composer: Composer, config: DictConfig, summarise: Callable[[Plan], list[str]]) -> list[str]:
    """Makes the runs of a sweep, and gives their statuses; with plan=true lists them.

    Args:
        config: what all cells share; see `Composer.whole`.
        summarise: writes and prints what a plan came to, also after a signal; gives the statuses.

    Raises:
        Interrupted, KeyboardInterrupt: after Ctrl-C or SIGTERM, the first where runs had begun.
        ValueError: for a sweep that cannot be.
        OSError: where the results folder cannot be written.
        LauncherStopped: where the executor cannot go on.
    """
    swept, launcher = composer.swept(config), Launcher.of(config)
    if not config.plan:
        how = "many to a job" if launcher.packs else f"{launcher.at_once} at a time"
        runs = f"{plural(len(swept), 'run')}, {how} (hydra/launcher={launcher.name})"
        notice(f"sweep: {runs}; a line follows as each ends")
    if config.isolation == Isolation.process:
        warm_up()
    plan = plan_of(composer.cells(swept))
    _say_where(swept[0], plan)
    reused = {cell.id for cell in plan.cells if is_reused(plan, cell)}
    check_jobs([cell for cell in plan.cells if cell.id not in reused], launcher.settings)
    check_plan(plan, launcher.executor, reused)
    if config.plan:
        _list(plan, reused, launcher)
        return []
    plan.write()
    try:
        with followed(plan, reused):
            _make(plan, reused, launcher)
    finally:
        statuses = summarise(plan)
    return statuses


def _say_where(overrides: list[str], plan: Plan) -> None:
    """Says of overrides that not all cells have, how many do."""
    for key in (text.partition("=")[0] for text in overrides):
        having = sum(any(text.startswith(f"{key}=") for text in cell.overrides) for cell in plan.cells)
        if having < len(plan.cells):
            notice(f"sweep: {key} goes to {having} of {plural(len(plan.cells), 'run')}, which have this key")


def _list(plan: Plan, reused: set[str], launcher: Launcher) -> None:
    """Prints the cells, and the jobs where a launcher makes some."""
    if not launcher.packs or not (jobs := packed(plan, launcher.settings, reused)):
        return show_plan(plan, reused, launcher.at_once)
    show_plan(plan, reused, min(launcher.at_once, len(jobs) * launcher.settings["tasks_per_node"]))
    print(in_words(jobs, launcher.settings))


def _make(plan: Plan, reused: set[str], launcher: Launcher) -> None:
    """Has an executor make all runs of a plan; reused ones are marked as asked for by this process."""
    make, jobs = Once(replace(plan, cells=[])), [[cell] for cell in plan.cells]
    try:
        if launcher.executor != "basic":
            execute(
                make, [[identity_of(cell) for cell in plan.cells if cell.id in reused]], replace(launcher, settings={})
            )
            jobs = [[cell] for cell in plan.cells if cell.id not in reused]
        if launcher.packs and (jobs := packed(plan, launcher.settings, reused)):
            notice(in_words(jobs, launcher.settings))
        execute(make, [[*map(identity_of, job)] for job in jobs], launcher)
    except (ValueError, OSError):
        raise
    except (KeyboardInterrupt, Exception) as error:
        if stopped := stopped_by(error):
            raise Interrupted(stopped) from error
        raise LauncherStopped(f"the launcher stopped: {reason_of(error)}; the same command goes on") from error


def do_each(composer: Composer, config: DictConfig, job: Callable[[Identity], object]) -> bool:
    """Does a job, which is no run, for each cell of a sweep; gives whether all were done.

    Raises:
        KeyboardInterrupt: after Ctrl-C or SIGTERM.
        ValueError: for a sweep that cannot be.
    """
    cells = composer.cells(composer.swept(config))
    return execute(partial(_attempted, job), [[cell] for cell in cells], Launcher.of(config))


def _attempted(job: Callable[[Identity], object], identity: Identity) -> list[str]:
    try:
        job(identity)
    except (OSError, ValueError) as error:
        return [reason_of(error)]
    return []


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
                    text = line(plan.results_dir / "runs" / cell.id, record, " ".join(plan.distinct_overrides(cell)))
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


def line(folder: Path, record: dict[str, Any], distinct_overrides: str) -> str:
    """The outcome of a cell in a line that ends with its folder; `differing` are overrides that not all cells have."""
    name, spent = row_name(record["config"], record["renderer"]), record["seconds"]
    loop = spent.get("forward", 0.0) + spent.get("backward", 0.0) or spent.get("total")
    parts = [
        record["status"] + (" (reused)" if record["reused"] else ""),
        distinct_overrides,
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
