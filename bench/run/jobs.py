"""Slurm jobs of many runs each, by the seconds that runs are expected to take: conf/hydra/launcher/slurm.yaml."""

from collections.abc import Mapping, Sequence
from math import ceil, inf
from statistics import median
from typing import Any

from bench.records.format import plural
from bench.records.read import Plan, PlannedCell
from bench.run.plan import kind, times

CLUSTERS = ("slurm", "local")
POSITIVE = ("minutes_per_job", "minutes_per_run", "array_size", "tasks_per_node")


def check_jobs(cells: Sequence[PlannedCell], settings: Mapping[str, Any]) -> None:
    """Checks the settings of a launcher for the cells that are to run.

    Raises:
        ValueError: for a value out of range, and where a job may end before a run reaches its limit.
    """
    for key in (key for key in (*POSITIVE, "timeout_min") if key in settings):
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


def packed(plan: Plan, settings: Mapping[str, Any], reused: set[str]) -> list[list[PlannedCell]]:
    """The cells of a plan that each job makes, without those that are reused."""
    measured, unmeasured = times(plan, reused), [60 * settings["minutes_per_run"]]
    cells = [cell for cell in plan.cells if cell.id not in reused]
    limits = [cell.config["time_limit"] or inf for cell in cells]
    expected = [
        min(median(measured[kind(vars(cell))] or unmeasured), limit) for cell, limit in zip(cells, limits, strict=True)
    ]
    groups = grouped(expected, 60 * settings["minutes_per_job"] * settings["tasks_per_node"])
    return [[cells[index] for index in group] for group in groups]


def grouped(seconds: Sequence[float], most: float) -> list[list[int]]:
    """The indices of runs in each job: in their order, as many as `most` seconds hold, and one at least."""
    jobs, left = list[list[int]](), 0.0
    for index, each in enumerate(seconds):
        if not jobs or each > left:
            jobs.append([])
            left = most
        jobs[-1].append(index)
        left -= each
    return jobs


def in_words(jobs: Sequence[Sequence[PlannedCell]], settings: Mapping[str, Any]) -> str:
    """How many jobs there are, and how long they take."""
    text = f"{plural(sum(map(len, jobs)), 'run')} in {plural(len(jobs), 'job')}"
    at_once = f", {settings['tasks_per_node']} at a time in each" if settings["tasks_per_node"] > 1 else ""
    return f"{text}{at_once}, by hydra.launcher.minutes_per_job={settings['minutes_per_job']:g}"
