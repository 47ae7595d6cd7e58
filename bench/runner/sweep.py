"""A sweep: composes, checks and plans its cells, runs them by an executor, and prints a line as each ends."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from bench.config import Isolation
from bench.progress import display, notice
from bench.records.format import breakdown, number, plural, seconds
from bench.records.metrics import TABLE_METRICS, Metric
from bench.records.record import row_name
from bench.records.results import Plan, PlannedRun
from bench.runner.compose import Composer
from bench.runner.executors import Launcher, execute, launcher_of, print_errors, run_in_turn
from bench.runner.messages import Interrupted, reason_of
from bench.runner.plan import check_plan, plan_of, reused_ids
from bench.runner.process import stopped_by, warm_up
from bench.runner.run import run_cell
from bench.tables import extension

CELL_LINE_METRICS = {
    "recommended_field": Metric("recommended"),
    **{name: TABLE_METRICS[name] for name in ("chamfer_l2", "rotation_error_deg")},
}
FOLLOW_INTERVAL_SECONDS = 0.5


class LauncherStopped(RuntimeError):
    """An executor cannot go on, because a cluster is missing or a process is lost."""


def run_sweep(composer: Composer, config: DictConfig, summarise: Callable[[Plan], list[str]]) -> list[str]:
    """Makes the runs of a sweep and returns their statuses; with plan=true only lists them.

    Args:
        config: the configuration that all cells share; see `Composer.shared_config`.
        summarise: writes and prints the summary of a plan, also after a signal; returns the statuses.

    Raises:
        Interrupted: after Ctrl-C or SIGTERM, if runs have started, else KeyboardInterrupt.
        ValueError: if the sweep is invalid.
        OSError: if the results folder cannot be written.
        LauncherStopped: if the executor cannot go on.
    """
    swept, launcher = composer.swept(config), launcher_of(config)
    if not config.plan:
        runs = f"{plural(len(swept), 'run')}, {launcher.rate} (hydra/launcher={launcher.name})"
        notice(f"sweep: {runs}; a line follows as each ends")
    if config.isolation == Isolation.process:
        warm_up()
    plan = plan_of(composer.cells(swept))
    _print_partial_overrides(swept[0], plan)
    reused = reused_ids(plan.cells)
    launcher.check([cell for cell in plan.cells if cell.id not in reused])
    check_plan(plan, reused, is_local=launcher.is_local)
    if config.plan:
        _print_plan(plan, reused, launcher)
        return []
    plan.write()
    try:
        with follow_progress(plan, reused):
            _run_all(plan, reused, launcher)
    finally:
        statuses = summarise(plan)
    return statuses


def _print_partial_overrides(overrides: list[str], plan: Plan) -> None:
    """Prints the number of cells for each override that only some cells have."""
    for key in (text.partition("=")[0] for text in overrides):
        count = sum(any(text.startswith(f"{key}=") for text in cell.overrides) for cell in plan.cells)
        if count < len(plan.cells):
            notice(f"sweep: {key} goes to {count} of {plural(len(plan.cells), 'run')}, which have this key")


def _print_plan(plan: Plan, reused: set[str], launcher: Launcher) -> None:
    """Prints the cells, and the number of jobs if the launcher has jobs."""
    jobs = launcher.jobs(plan, reused)
    extension("show_plan")(plan, reused, min(launcher.concurrency, len(jobs) * launcher.runs_per_job))
    if jobs and (text := launcher.describe(jobs)):
        print(text)


def _run_all(plan: Plan, reused: set[str], launcher: Launcher) -> None:
    """Makes all runs of a plan by the executor; this process marks the reused runs as requested."""
    make, jobs = partial(run_cell, planned_at=plan.asked), launcher.jobs(plan, reused)
    try:
        in_jobs = {cell.id for job in jobs for cell in job}
        print_errors(run_in_turn(make, [cell for cell in plan.cells if cell.id not in in_jobs]))
        if jobs and (text := launcher.describe(jobs)):
            notice(text)
        execute(make, jobs, launcher)
    except (ValueError, OSError):
        raise
    except (KeyboardInterrupt, Exception) as error:
        if stopped := stopped_by(error):
            raise Interrupted(stopped) from error
        raise LauncherStopped(f"the launcher stopped: {reason_of(error)}; the same command goes on") from error


def work_per_cell(composer: Composer, config: DictConfig, work: Callable[[PlannedRun], object]) -> bool:
    """Does work that is not a run, for each cell of a sweep; returns whether all succeeded.

    Raises:
        KeyboardInterrupt: after Ctrl-C or SIGTERM.
        ValueError: if the sweep is invalid.
    """
    cells = composer.cells(composer.swept(config))
    return execute(partial(_work, work), [[cell] for cell in cells], launcher_of(config))


def _work(work: Callable[[PlannedRun], object], cell: PlannedRun) -> list[str]:
    try:
        work(cell)
    except (OSError, ValueError) as error:
        return [reason_of(error)]
    return []


@contextmanager
def follow_progress(plan: Plan, reused: set[str]) -> Iterator[None]:
    """Prints a line for each of the plan's cells as it ends, in any process.

    It also shows the number of ended cells and the time left: on a terminal always, else before each cell's line.

    Args:
        reused: ids of cells that take no time, because their finished run is reused.
    """
    pending, failed, stop, start = {cell.id: cell for cell in plan.cells}, 0, threading.Event(), time.monotonic()
    count = len(plan.cells)
    with display() as live:
        task = live.add_task("sweep", total=count - len(reused), status="")

        def progress_prefix() -> str:
            """The text before a cell's line if there is no terminal."""
            parts = [f"{count - len(pending)}/{count}"]
            if (finished := count - len(reused | pending.keys())) and (to_run := len(pending.keys() - reused)):
                parts.append(f"{seconds((time.monotonic() - start) / finished * to_run)} left")
            return f"[{', '.join(parts)}] " if live.disable else ""

        def update() -> None:
            nonlocal failed
            for cell in [*pending.values()]:
                if record := plan.record(cell):
                    del pending[cell.id]
                    failed += record["status"] != "ok"
                    overrides = " ".join(plan.distinct_overrides(cell))
                    line = cell_line(plan.results_dir / "runs" / cell.id, record, overrides)
                    print(progress_prefix() + line, flush=True)
            live.update(task, completed=count - len(reused | pending.keys()), status=f"{failed} failed")

        def follow() -> None:
            while not stop.wait(max(FOLLOW_INTERVAL_SECONDS, 1e-3 * len(pending))):
                update()

        thread = threading.Thread(target=follow, daemon=True)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()
            update()
            live.remove_task(task)


def cell_line(folder: Path, record: dict[str, Any], overrides: str) -> str:
    """A line on a cell: status, overrides that not all cells share, names, results, and its folder last."""
    name, spent = row_name(record["config"], record["renderer"]), record["seconds"]
    duration = spent.get("forward", 0.0) + spent.get("backward", 0.0) or spent.get("total")
    parts = [
        record["status"] + (" (reused)" if record["reused"] else ""),
        overrides,
        ", ".join((record["task"], name, record["scene"] or record["dataset"])),
        seconds(duration),
    ]
    metrics = record["metrics"]
    shown = [(metric, metrics[name]) for name, metric in CELL_LINE_METRICS.items() if name in metrics]
    parts += [f"{metric.label} {number(value, metric.factor)}" for metric, value in shown]
    if "level" in metrics:
        parts.append(breakdown(metrics, record["config"]["task"]["stress"]["sweep"]))
    return "  ".join(text for text in [*parts, record["reason"], str(folder)] if text)
