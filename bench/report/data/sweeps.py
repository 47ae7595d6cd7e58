"""The runs of each sweep in rows by what varies, and the numbers of a row: medians over its shapes and seeds."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.records import metrics
from bench.records.names import differences
from bench.records.read import read_plans
from bench.report.data.records import (
    Record,
    RunKey,
    by_shape,
    error,
    grouped,
    loop_seconds,
    measured,
    median_of_known,
    run_key,
    value_evaluations,
)
from bench.report.data.runs import Runs, Selection
from bench.report.data.statistics import Interval, bootstrap, median, paired_bootstrap, share

OK = "ok"


@dataclass(frozen=True)
class SweepRuns:
    """The runs of a sweep, one per planned cell.

    Args:
        name: of the sweep, which is that of the folder of its plan.
        swept: the keys that the command swept over, with their values.
        runs: the records, each with the name of its row; of a cell that was not run, one without numbers.
    """

    name: str
    swept: dict[str, list[str]]
    runs: Runs

    def rows(self) -> dict[str, list[Record]]:
        """The records of each row, in the order of the plan."""
        return grouped(self.runs.records, lambda record: record["row"])

    def metrics(self) -> list[str]:
        """The names of all metrics that some run has as a number, those that tables show first."""
        found = {name: None for run in self.runs.records for name in run["metrics"] if measured(run, name) is not None}
        return [*(name for name in metrics.SHOWN if name in found), *(n for n in found if n not in metrics.SHOWN)]


@dataclass(frozen=True)
class RowNumbers:
    """The numbers of a row.

    Args:
        name: of the row.
        medians: of each metric that its runs have, over shapes and seeds; a run that failed is the worst.
        failed: how many of its runs did not end ok, with the interval of their share.
        ratio: the median of the first metric over that of the first row, paired by shape; None where there is none.
    """

    name: str
    runs: int
    medians: dict[str, Interval]
    failed: int
    rate: Interval
    reasons: tuple[str, ...]
    loop: float | None
    values: float | None
    ratio: Interval | None = None


def read_sweeps(records: list[Record], results_dir: Path, tabled: Iterable[str] = ()) -> list[SweepRuns]:
    """The sweeps of a results folder, but those of experiments that have pages, whose names are `tabled`."""
    known = {record["folder"]: record for record in records}
    plans = [plan for plan in read_plans(results_dir)[0] if any(cell["id"] in known for cell in plan["cells"])]
    found = [runs_of(plan, known, results_dir) for plan in plans]
    return [sweep for sweep in found if sweep.runs.selection.experiment not in tabled]


def runs_of(plan: dict[str, Any], known: dict[str, Record], results_dir: Path) -> SweepRuns:
    """The sweep of a plan, some of whose runs are known; cells that differ in nothing that counts have one run."""
    cells = {cell["id"]: cell for cell in plan["cells"] if cell["id"] in known}
    runs = [known[name] for name in cells]
    asked = [_asked(cell["overrides"]) for cell in cells.values()]
    keys = dict.fromkeys(key for one in asked for key in one)
    swept = {key: list(dict.fromkeys(one[key] for one in asked if key in one)) for key in keys}
    swept = {key: values for key, values in swept.items() if len(values) > 1}
    found = differences(runs, apart=_apart, asked=[{k: one[k] for k in one if k in swept} for one in asked])
    named = [run | {"row": name} for run, name in zip(runs, found.names, strict=True)]
    experiment = plan["cells"][0]["config"].get("experiment") or ""
    selection = Selection(experiment, setup=("scenes", "pixels", "machine"))
    return SweepRuns(plan["name"], swept, Runs(selection, results_dir, named))


def _asked(overrides: list[str]) -> dict[str, str]:
    """The keys and values of a cell's overrides; a sign that adds a key is no part of it."""
    pairs = [override.partition("=") for override in overrides if "=" in override]
    return {key.lstrip("+"): value for key, _, value in pairs}


def _apart(record: Record) -> RunKey:
    """What a row is averaged over: shape, view and seed; a stress is no shape."""
    solid, view, seed = run_key(record)
    return (solid[1] if record["config"].get("stress") else solid, view, seed)


def numbers(sweep: SweepRuns) -> list[RowNumbers]:
    """The numbers of each row."""
    rows, names = sweep.rows(), sweep.metrics()
    first = next(iter(rows.values()))
    lead = names[0] if names and metrics.better(names[0]) == "lower" else ""
    return [_numbers(name, runs, names, _ratio(runs, first, lead) if lead else None) for name, runs in rows.items()]


def _numbers(name: str, runs: list[Record], names: list[str], ratio: Interval | None) -> RowNumbers:
    shapes = grouped(runs, lambda record: run_key(record)[0]).values()
    failures = [[record["status"] != OK for record in of_shape] for of_shape in shapes]
    ended = [record for record in runs if record["status"] == OK]
    reasons = Counter(f"{run['status']}: {run['reason']}".rstrip(": ") for run in runs if run["status"] != OK)
    medians = {metric: middle for metric in names if (middle := median_of(runs, metric)) is not None}
    return RowNumbers(
        name,
        len(runs),
        medians,
        len(runs) - len(ended),
        share([sum(failed) for failed in failures], [len(failed) for failed in failures]),
        tuple(f"{reason} ({count} runs)" if count > 1 else reason for reason, count in reasons.items()),
        median_of_known(map(loop_seconds, ended)),
        median_of_known(map(value_evaluations, ended)),
        ratio,
    )


def median_of(runs: list[Record], metric: str) -> Interval | None:
    """The median of a metric over shapes and seeds with its interval, a failed run as the worst value.

    Where it is not known which direction of the metric is better, it is that of the runs that have the metric. None
    where a run that ended ok lacks it, or no run has it.
    """
    better = metrics.better(metric)
    lacking = [run for run in runs if run["status"] == OK and measured(run, metric) is None]
    if lacking or all(measured(run, metric) is None for run in runs):
        return None
    if better == "lower":
        return _middle({run_key(run): error(run, metric) for run in runs})
    if better == "higher":
        return _negated(_middle({run_key(run): _shortfall(run, metric) for run in runs}))
    known = {run_key(run): value for run in runs if (value := measured(run, metric)) is not None}
    finite = all(value == value and value > float("-inf") for value in known.values())
    return _middle(known) if finite else None


def _middle(values: dict[RunKey, float]) -> Interval:
    return bootstrap(by_shape(values), median, seed=0)


def _shortfall(run: Record, metric: str) -> float:
    """A metric of which more is better, as an error; that of a run that failed is 0, the least such metrics can be."""
    value = measured(run, metric) if run["status"] == OK else None
    return 0.0 if value is None or value != value else -value


def _negated(interval: Interval) -> Interval:
    return Interval(-interval.value, -interval.high, -interval.low, tuple(-point for point in interval.points))


def _ratio(runs: list[Record], first: list[Record], metric: str) -> Interval | None:
    """The ratio of medians to those of the first row over the same shapes and seeds; None for that row itself."""
    mine, theirs = ({run_key(run): error(run, metric) for run in row} for row in (runs, first))
    if runs is first or set(mine) != set(theirs):
        return None
    return paired_bootstrap(by_shape(mine), by_shape({key: theirs[key] for key in mine}), median, seed=0)
