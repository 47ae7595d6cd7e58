"""Groups runs into Slurm jobs by their expected seconds; see conf/hydra/launcher/slurm.yaml."""

from collections.abc import Mapping, Sequence
from math import ceil, inf
from statistics import median
from typing import Any

from bench.records.format import plural
from bench.records.results import Plan, PlannedRun
from bench.runner.plan import duration_group, durations_of_similar_runs

CLUSTERS = ("slurm", "local")
POSITIVE_KEYS = ("minutes_per_job", "minutes_per_run", "array_size", "tasks_per_node")


def check_jobs(cells: Sequence[PlannedRun], settings: Mapping[str, Any]) -> None:
    """Checks the settings of a launcher for the cells to run.

    Raises:
        ValueError: if a value is out of range, or a job may end before a run reaches its time limit.
    """
    for key in (key for key in (*POSITIVE_KEYS, "timeout_min") if key in settings):
        if not (isinstance(settings[key], int | float) and settings[key] > 0):
            raise ValueError(f"hydra.launcher.{key} must be positive, not {settings[key]}: leave it out")
    timeout = settings.get("timeout_min", inf)
    limit = max((cell.config["time_limit"] or 0 for cell in cells), default=0)
    if limit > 60 * timeout:
        raise ValueError(
            f"hydra.launcher.timeout_min={timeout} ends a job before time_limit={limit:g} seconds end its run: set "
            f"hydra.launcher.timeout_min={ceil(limit / 60)} or more, or time_limit={60 * timeout} or less"
        )
    if settings.get("minutes_per_job", 0) > timeout:
        raise ValueError(
            f"hydra.launcher.minutes_per_job={settings['minutes_per_job']:g} is more than hydra.launcher.timeout_min="
            f"{timeout}, which ends a job: set hydra.launcher.minutes_per_job={timeout / 4:g}, since some take longer"
        )
    if settings.get("cluster", "slurm") not in CLUSTERS:
        raise ValueError(f"hydra.launcher.cluster must be {' or '.join(CLUSTERS)}, not {settings['cluster']!r}")


def split_into_jobs(plan: Plan, settings: Mapping[str, Any], reused: set[str]) -> list[list[PlannedRun]]:
    """The cells of each job, without reused cells."""
    measured, default = durations_of_similar_runs(plan, reused), [60 * settings["minutes_per_run"]]
    cells = [cell for cell in plan.cells if cell.id not in reused]
    limits = [cell.config["time_limit"] or inf for cell in cells]
    expected = [median(measured[duration_group(vars(cell))] or default) for cell in cells]
    expected = [min(duration, limit) for duration, limit in zip(expected, limits, strict=True)]
    groups = group_by_duration(expected, 60 * settings["minutes_per_job"] * settings["tasks_per_node"])
    return [[cells[index] for index in group] for group in groups]


def group_by_duration(seconds: Sequence[float], max_seconds: float) -> list[list[int]]:
    """The indices of the runs of each job, in order: as many as fit into `max_seconds`, but at least one."""
    jobs, remaining = list[list[int]](), 0.0
    for index, duration in enumerate(seconds):
        if not jobs or duration > remaining:
            jobs.append([])
            remaining = max_seconds
        jobs[-1].append(index)
        remaining -= duration
    return jobs


def describe_jobs(jobs: Sequence[Sequence[PlannedRun]], settings: Mapping[str, Any]) -> str:
    """The number of runs and jobs, as text."""
    text = f"{plural(sum(map(len, jobs)), 'run')} in {plural(len(jobs), 'job')}"
    at_once = f", {settings['tasks_per_node']} at a time in each" if settings["tasks_per_node"] > 1 else ""
    return f"{text}{at_once}, by hydra.launcher.minutes_per_job={settings['minutes_per_job']:g}"
