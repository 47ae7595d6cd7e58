"""The table and chart of each sweep that no study shows: medians over shapes and seeds, failures and costs."""

import math
import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import Any

from bench.records import format
from bench.records.metrics import HIGHER, LISTED_METRICS, LOWER, Metric, better_direction
from bench.records.names import differences
from bench.records.read import read_plans
from bench.records.record import as_number
from bench.records.results import Plan
from bench.report.data import records
from bench.report.data.kept import UNFINISHED
from bench.report.data.records import Record, RunKey, by_shape, definitions, error, grouped, measured, run_key
from bench.report.data.runs import Runs, Selection
from bench.report.data.statistics import Interval, bootstrap, median, ratio, share
from bench.report.suite.attempts import portable_overrides
from bench.report.write import chart
from bench.report.write.caption import FEW, VARYING
from bench.report.write.chart import Panel, Series
from bench.report.write.paper import RECORD_ERRORS, SWEEPS, TABLE, studies, write_paper
from bench.report.write.result import Result, read_shown, write
from bench.report.write.table import Column, count_with_interval, ends, extremes, text

ARROWS = {LOWER: " ↓", HIGHER: " ↑", "": ""}  # after a heading: the better direction
MAX_LISTED_VALUES = 6  # per swept key
MAX_DATASET_COLUMNS = 8
MAX_FALLBACK_METRICS = 8  # columns of a task that measures none of `LISTED_METRICS`
COST, RUNTIME = "field evaluations (a gradient counts as two)", "runtime of the loop (s)"
PANEL_HEIGHT_INCHES, LEGEND_HEIGHT_INCHES = 2.3, 0.6
LINE_ENDS_OVER_COSTS = (0.9, 1.1)
AVERAGED_KEYS = ("index", "seed", "dataset")  # a sweep over their numbers is no axis of a chart
METHOD_KEYS = ("renderer", "label", "method", "silhouette", "task.optimiser")  # the runs still solve the same problems
FAILURE = (
    "A run that did not end ok is counted as failed, and has the worst value of each metric: an infinite error, or 0 "
    "of what is better higher. So medians are ∞ where half of the runs failed, – where all did."
)
POINTS = "Large points are medians of rows, small points are runs. "
CROSS = "A cross at the upper edge: half of the runs failed. "
SMALL_POINTS = (
    "In the figure, small points are runs. A row of which half of the runs failed has a cross, or no point on a curve. "
    "Costs are medians over runs that ended ok."
)
FRONT = "Grey steps: the front, of the rows for which no other is both cheaper and better."
RATIO = "A ratio is the median over shapes of ratios of medians over seeds; its interval is of the sign test."
UNDIRECTED = "Of metrics of which neither direction is better, medians are of the runs that have them."


@dataclass(frozen=True)
class Sweep:
    """The runs of a sweep, one per planned cell, each with the name of its row; and the swept keys with their values.

    If only one swept setting is a number, it is the `axis`: each run has its value as `position`, and the name of its
    row without it as `curve`.
    """

    name: str
    swept: dict[str, list[str]]
    runs: Runs
    missing: int  # cells that were not run, or killed; they are in `runs` only if no cell ended
    axis: str
    command: str

    @property
    def metrics(self) -> list[str]:
        """The names of all metrics that are a number in some run; those that tables show come first."""
        names = {name: None for run in self.runs.records for name in run["metrics"] if measured(run, name) is not None}
        listed = [name for name in LISTED_METRICS if name in names]
        return [*listed, *(name for name in names if name not in LISTED_METRICS)]

    @property
    def datasets(self) -> list[str]:
        """The data sets of which every row has runs; empty if there is only one, or too many."""
        rows = grouped(self.runs.records, itemgetter("row")).values()
        sets, names = [{*map(records.family, runs)} for runs in rows], map(records.family, self.runs.records)
        shared = [name for name in dict.fromkeys(names) if all(name in datasets for datasets in sets)]
        return shared if 1 < len(shared) <= MAX_DATASET_COLUMNS else []


def write_sweeps(records: list[Record], results_dir: Path, problems: list[str]) -> list[Path]:
    """Writes `results_dir/sweeps/NAME/table.*` of each sweep without a study; returns the CSVs. See `write_sweep`."""
    by_folder, studied, written = {record["folder"]: record for record in records}, _studied(), list[Path]()
    for plan in read_plans(results_dir)[0]:
        if plan.cells[0].config.get("experiment") not in studied:
            written += _write_plan(plan, by_folder, problems)
    return written


def write_sweep(plan: Plan, records: list[Record], problems: list[str]) -> list[Path]:
    """Writes the tables of a finished sweep: those of the study named as its experiment, or its own; returns the CSVs.

    `problems` gets a line for a table that cannot be made.
    """
    if (experiment := plan.cells[0].config.get("experiment")) in _studied():
        return write_paper(records, plan.results_dir, problems=problems, only=experiment)
    return _write_plan(plan, {record["folder"]: record for record in records}, problems)


def _write_plan(plan: Plan, by_folder: dict[str, Record], problems: list[str]) -> list[Path]:
    """Writes the table of a plan; returns the path of its CSV, or none without runs or if it cannot be made."""
    if not any(cell.id in by_folder for cell in plan.cells):
        return []
    try:
        table = table_of(of_plan(plan, by_folder))
        return [write(table, table.shown(), plan.folder / TABLE, name=plan.name)[0]]
    except RECORD_ERRORS as error:
        problems.append(f"not made: {SWEEPS}/{plan.name} ({type(error).__name__}: {error})")
        return []


def summary_lines(tables: Sequence[Path]) -> list[str]:
    lines = []
    for path in tables:
        shown = read_shown(path.with_suffix(".json"))
        lines += [f"answer: {shown.verdict.replace('*', '')}"] if shown.verdict else []
        lines += [f"table: {path.with_suffix('.md')}"]
        lines += [f"picture: {picture}"] if (picture := path.with_suffix(".png")).is_file() else []
    return lines


def of_plan(plan: Plan, record_by_id: dict[str, Record]) -> Sweep:
    """The sweep of a plan with its known records. Equivalent cells share one run."""
    cells = {cell.id: cell for cell in plan.cells if cell.id in record_by_id}
    runs = [record_by_id[name] for name in cells]
    pairs = [[text.partition("=") for text in cell.overrides if "=" in text] for cell in cells.values()]
    overrides = [{key.lstrip("+"): value for key, _, value in of_cell} for of_cell in pairs]
    keys = dict.fromkeys(key for values in overrides for key in values)
    swept = {key: list(dict.fromkeys(values[key] for values in overrides if key in values)) for key in keys}
    swept = {key: values for key, values in swept.items() if len(values) > 1}
    overrides = [{key: values[key] for key in values if key in swept} for values in overrides]
    names = differences(runs, distinguished_by=_average_key, swept=overrides)
    numeric = [key for key, texts in swept.items() if key not in AVERAGED_KEYS and None not in map(_number, texts)]
    axis = numeric[0] if len(numeric) == 1 else ""
    runs = [run | {"position": _number(values.get(axis, ""))} for run, values in zip(runs, overrides, strict=True)]
    curves = differences(runs, distinguished_by=lambda run: (_average_key(run), run["position"]), swept=overrides)
    command = shlex.join(["python", "-m", "bench", "-m", *_command_overrides(plan, swept)])
    runs = [run | {"row": name, "curve": curve} for run, name, curve in zip(runs, names, curves, strict=True)]
    selection = Selection(plan.cells[0].config.get("experiment") or "", setup=("scenes", "pixels", "machine"))
    ended = [run for run in runs if run["status"] not in UNFINISHED]
    missing = len(runs) - len(ended)
    return Sweep(plan.name, swept, Runs(selection, plan.results_dir, ended or runs), missing, axis, command)


def lines(sweep: Sweep) -> list[dict[str, Any]]:
    """A line per row: its counts, its costs, each metric's median with its interval, and the ratio of the first metric.

    The ratio is to the first row, paired by shape, or None. Data sets that all rows have get medians of the first
    metric.
    """
    rows, names = grouped(sweep.runs.records, itemgetter("row")), sweep.metrics
    first = next(iter(rows.values()))
    lead = names[0] if names and better_direction(names[0]) == LOWER else ""
    sweep_lines = [_line(row, runs, names) | {"ratio": _ratio(runs, first, lead)} for row, runs in rows.items()]
    for dataset in sweep.datasets if names else ():
        for line, runs in zip(sweep_lines, rows.values(), strict=True):
            dataset_runs = [run for run in runs if records.family(run) == dataset]
            line[_on(names[0], dataset)] = median_of(dataset_runs, names[0])
    return sweep_lines


def _on(metric: str, dataset: str) -> str:
    return f"{metric}, {dataset}"


def _line(row: str, runs: list[Record], names: list[str]) -> dict[str, Any]:
    shapes = grouped(runs, lambda record: run_key(record)[0]).values()
    failures = [[record["status"] != "ok" for record in of_shape] for of_shape in shapes]
    ended = _ended_ok(runs)
    reasons = Counter(f"{run['status']}: {run['reason']}".rstrip(": ") for run in runs if run["status"] != "ok")
    rate = share([sum(failed) for failed in failures], [len(failed) for failed in failures])
    return {
        **{"row": row, "preset": records.row_of(runs[0]).preset, "rate": rate},
        **{"runs": len(runs), "failed": len(runs) - len(ended)},
        "reasons": "; ".join(f"{reason} ({count} runs)" if count > 1 else reason for reason, count in reasons.items()),
        "loop_seconds": records.median_or_none(map(records.loop_seconds, ended)),
        "value_evaluations": records.median_or_none(map(records.value_evaluations, ended)),
        "evaluations_cost": records.median_or_none(map(records.cost, ended)),
        **{name: median_of(runs, name) for name in names},
    }


def median_of(runs: list[Record], metric: str) -> Interval | None:
    """The median of a metric over shapes and seeds with its interval; a failed run counts as the worst value.

    If neither direction is better, only runs that have it count. None if a run that ended ok lacks it, or no run has
    it.
    """
    values = {run_key(run): value for run in runs if (value := measured(run, metric)) is not None}
    if not values or any(run["status"] == "ok" and run_key(run) not in values for run in runs):
        return None
    if better_direction(metric) == LOWER:
        return _middle({run_key(run): error(run, metric) for run in runs})
    if better_direction(metric) == HIGHER:  # a failed run counts as 0, the lowest value of such metrics
        ended = {run_key(run): run["status"] == "ok" for run in runs}
        negated = {key: -values[key] if ok and values[key] == values[key] else 0.0 for key, ok in ended.items()}
        interval = _middle(negated)
        return Interval(-interval.value, -interval.high, -interval.low, tuple(-point for point in interval.points))
    return _middle(values) if all(value > -math.inf for value in values.values()) else None


def _middle(values: dict[RunKey, float]) -> Interval:
    return bootstrap(by_shape(values), median)


def _ratio(runs: list[Record], first: list[Record], metric: str) -> Interval | None:
    """The ratio of errors to those of the first row on the same shapes and seeds; None for the first row itself."""
    mine, theirs = ({run_key(run): error(run, metric) for run in row} for row in (runs, first))
    if not metric or runs is first or set(mine) != set(theirs):
        return None
    return ratio(by_shape(mine), by_shape({key: theirs[key] for key in mine}), of_shape=median)


def table_of(sweep: Sweep) -> Result:
    table_lines, names = lines(sweep), sweep.metrics
    headings = {name: LISTED_METRICS[name] for name in names if name in LISTED_METRICS}
    headings = headings or {name: Metric(name) for name in names[:MAX_FALLBACK_METRICS]}
    csv_only = [name for name in names if name not in headings]
    has_interval = [line[name].has_ends for line in table_lines for name in headings if line[name] is not None]
    has_ratio = any(line["ratio"] is not None for line in table_lines)
    kinds = {"95 % bootstrap intervals over shapes": any(has_interval), f"{FEW}: no interval": not all(has_interval)}
    lead = names[0] if names and names[0] in headings and better_direction(names[0]) else ""
    panels = [_panels(sweep, dataset, lead, headings[lead]) for dataset in sweep.datasets or [""]] if lead else []
    rows = sum(map(bool, panels))
    panels, height = [*chain(*panels)], PANEL_HEIGHT_INCHES * rows + LEGEND_HEIGHT_INCHES
    series = [each for panel in panels for each in panel["series"]]
    note = POINTS + CROSS * any(math.inf in each["y"] for each in series)
    note += FRONT * any(each["name"] == "front" for each in series)
    return Result(
        sweep.runs,
        f"Sweep over {', '.join(sweep.swept)}, {sweep.name}." if sweep.swept else f"Sweep {sweep.name}.",
        f"Medians over {VARYING}; swept over {_listed(sweep)}.",
        **_answer(sweep, table_lines, lead, headings),
        command=sweep.command,
        folders={
            row: [run["folder"] for run in runs] for row, runs in grouped(sweep.runs.records, itemgetter("row")).items()
        },
        n=f"{len(sweep.runs.records)} runs" if any(run["config"].get("stress") for run in sweep.runs.records) else "",
        interval="; ".join(text for text, is_shown in kinds.items() if is_shown) if headings else "",
        figure=chart.draw(panels, height, rows, legend=3) if panels else None,
        chart={"panels": panels, "note": note} if panels else None,
        remarks=(
            SMALL_POINTS if panels else "",
            FAILURE,
            f"Left out: {sweep.missing} that were not run; the same command runs them." if sweep.missing else "",
            RATIO * has_ratio,
            UNDIRECTED if any(not better_direction(name) for name in headings) else "",
            f"The CSV also has {', '.join(csv_only)}." if csv_only else "",
            *definitions(sweep.runs.records, {name: metric.label for name, metric in headings.items()}),
        ),
        columns=_columns(sweep, headings, several=has_ratio),
        lines=table_lines,
    )


def _panels(sweep: Sweep, dataset: str, lead: str, metric: Metric) -> list[Panel]:
    """The first metric over the swept number, if there is one, and over each cost that the runs have."""
    runs = [run for run in sweep.runs.records if not dataset or records.family(run) == dataset]
    axes = {COST: records.cost} | ({RUNTIME: records.loop_seconds} if sweep.runs.timed else {})
    if sweep.axis:
        axes = {sweep.axis: itemgetter("position")} | axes
    same_problems = all(key.startswith(METHOD_KEYS) for key in sweep.swept if key not in AVERAGED_KEYS)
    panels = [
        _panel(runs, (dataset, title), number_of, (lead, metric), same_problems and title != sweep.axis)
        for title, number_of in axes.items()
    ]
    return [panel for panel in panels if panel["series"]]


def _panel(
    runs: list[Record],
    titles: tuple[str, str],
    number_of: Callable[[Record], float | None],
    lead: tuple[str, Metric],
    has_front: bool,
) -> Panel:
    """A point per row, joined along the swept number; the initial error if all rows have it; the front if wanted."""
    (dataset, title), (key, metric) = titles, lead
    curves, fronts = list[Series](), list[Series]()
    for name, of_curve in grouped(runs, itemgetter("curve")).items():
        rows = grouped(of_curve, itemgetter("row")).values()
        ordered = sorted(rows, key=lambda of_row: of_row[0]["position"] or 0.0)
        costs = [records.median_or_none(map(number_of, _ended_ok(of_row) or of_row)) for of_row in ordered]
        pairs = zip(costs, [median_of(of_row, key) for of_row in ordered], strict=True)
        points = [(x, estimate.times(metric.factor)) for x, estimate in pairs if x is not None and estimate is not None]
        pairs = [(number_of(run), measured(run, key)) for run in _ended_ok(of_curve)]
        dots = [[x, metric.factor * value] for x, value in pairs if x is not None and value is not None]
        if points:
            make = chart.curve if len(points) > 1 else chart.series
            preset = records.row_of(of_curve[0]).preset
            curves.append(make(name, preset, *zip(*points, strict=True), shapes=dots))
    positions = [x for each in curves for x in each["x"]]
    of_rows = grouped(runs, itemgetter("row")).values()
    if curves and has_front and metric.better == LOWER:
        fronts.append(chart.front(positions, [y for each in curves for y in each["y"]]))
    costs = [*positions, *(x for dots in curves for x, _ in dots["shapes"])]
    span = [LINE_ENDS_OVER_COSTS[0] * min(costs, default=1.0), LINE_ENDS_OVER_COSTS[1] * max(costs, default=1.0)]
    for name, field, dash in (("initial", "metrics_start", "--"), ("best possible", "metrics_best", ":")):
        value = _shared_median([run.get(field, {}).get(key) for run in row] for row in of_rows)
        if curves and value and math.isfinite(value):
            line = f"{name} {'error' if metric.better == LOWER else 'value'}, median"
            fronts.append(chart.level(line, span, metric.factor * value, dash=dash))
    return chart.panel_data(dataset, title, metric.label, [*fronts, *curves])


def _shared_median(of_rows: Iterable[list[Any]]) -> float | None:
    """The median of the values of each row, if it is the same for all rows that have one; else None."""
    medians = [records.median_or_none(map(as_number, row)) for row in of_rows]
    median = records.median_or_none(medians)
    same = all(value is None or (median and math.isclose(value, median, rel_tol=0.01)) for value in medians)
    return median if same else None


def _answer(sweep: Sweep, lines: list[dict[str, Any]], lead: str, headings: dict[str, Metric]) -> dict[str, str]:
    """The question and the verdict on the first metric; empty with fewer than two rows to compare."""
    interval_by_row = {line["row"]: line[lead] for line in lines if lead and line[lead] is not None}
    if len(interval_by_row) < 2:
        return {}
    metric, is_higher_better = headings[lead], better_direction(lead) == HIGHER
    values = {row: metric.factor * interval.value for row, interval in interval_by_row.items()}
    shapes = format.plural(len({records.solid(run) for run in sweep.runs.records}), "shape")
    verdict = [extremes(f"Median {metric.label}", values, shapes, largest_first=is_higher_better)]
    question = f"Which has the {'highest' if is_higher_better else 'lowest'} {metric.label.split(' (')[0]}?"
    if not verdict[0]:  # half of the runs of every row failed
        return {"question": question}
    best = dict[str, str]()
    for dataset in sweep.datasets:
        intervals = {line["row"]: line[_on(lead, dataset)] for line in lines}
        medians = {row: interval.value for row, interval in intervals.items() if interval is not None}
        best |= {dataset: (max if is_higher_better else min)(medians, key=medians.__getitem__)} if medians else {}
    if len({*best.values()}) > 1:
        verdict.append(f"Best by data set: {', '.join(f'{dataset} {row}' for dataset, row in best.items())}.")
    verdict.append(_doubt(sweep, interval_by_row, is_higher_better=is_higher_better))
    costs = {line["row"]: line["evaluations_cost"] for line in lines if line["evaluations_cost"] and not line["failed"]}
    ordered = sorted(costs, key=lambda row: costs[row])
    counts = [format.count(costs[row]) for row in ordered]
    if len({*counts}) > 1:
        verdict.append(f"Field evaluations: {counts[0]} ({ordered[0]}) to {counts[-1]} ({ordered[-1]}).")
    return {"question": question, "verdict": " ".join(filter(None, verdict))}


def _doubt(sweep: Sweep, intervals: dict[str, Interval], *, is_higher_better: bool) -> str:
    """Why the order of the rows is not certain; empty if the best interval overlaps with no other."""
    rows = grouped(sweep.runs.records, itemgetter("row"))
    if len({frozenset(map(records.solid, rows[name])) for name in intervals}) > 1:
        return "The rows have different shapes, so their medians do not compare."
    if not all(interval.has_ends for interval in intervals.values()):
        return f"With {FEW}, the order is not certain."
    best, *others = sorted(intervals, key=lambda row: intervals[row].value, reverse=is_higher_better)
    low, high = intervals[best].low, intervals[best].high
    overlaps = [row for row in others if intervals[row].low <= high and low <= intervals[row].high]
    return f"The interval of {best} overlaps with those of {', '.join(overlaps)}." if overlaps else ""


def _failed(line: dict[str, Any]) -> str:
    count, total = line["failed"], line["runs"]
    return count_with_interval(count, total, line["rate"]) if line["rate"].has_ends else f"{count:g} of {total}"


def _columns(sweep: Sweep, headings: dict[str, Metric], *, several: bool) -> list[Column]:
    names, first = sweep.metrics, next(iter(headings.values()), Metric(""))
    to_first = Metric(f"{first.label.split(' (')[0]}, ratio to the first row" if several else "")
    labels = {_on(names[0], dataset): f"{dataset}: {first.label}" for dataset in sweep.datasets if names}
    return [
        text("row", "Row"),
        *(column for name, label in labels.items() for column in _estimate(name, first._replace(label=label))),
        *(column for name in names for column in _estimate(name, headings.get(name, Metric("")))),
        *_estimate("ratio", to_first),
        Column("runs"),
        Column("failed", "Failed", words=_failed),
        *ends("failed", lambda line: line["rate"]),
        text("reasons"),
        Column("loop_seconds", "Runtime", show=format.seconds),
        *(Column("evaluations_cost", "Field evaluations", show=format.count), Column("value_evaluations")),
    ]


def _estimate(key: str, shown: Metric) -> list[Column]:
    """The columns of an estimate, which may be None, and of its interval ends; in the CSV in scene units."""

    def words(line: dict[str, Any]) -> str:
        if line[key] is None:
            return format.MISSING
        scaled = line[key].times(shown.factor)
        return str(scaled) if scaled.has_ends else scaled.alone()  # the caption has n

    heading, value = f"{shown.label}{ARROWS[shown.better]}", lambda line: getattr(line[key], "value", None)
    return [Column(key, heading, value, words=words, better=shown.better), *ends(key, lambda line: line[key])]


def _listed(sweep: Sweep) -> str:
    key_texts = [
        f"{key} ({', '.join(values) if len(values) <= MAX_LISTED_VALUES else f'{len(values)} values'})"
        for key, values in sweep.swept.items()
    ]
    return ", ".join(key_texts) or "nothing"


def _ended_ok(runs: list[Record]) -> list[Record]:
    return [run for run in runs if run["status"] == "ok"]


def _command_overrides(plan: Plan, swept: dict[str, list[str]]) -> list[str]:
    """The overrides of a sweep's command: a swept key has all its values. Without the results folder."""
    overrides = dict[str, str]()
    for override in portable_overrides(override for cell in plan.cells for override in cell.overrides):
        key = override.partition("=")[0]
        values = swept.get(key.lstrip("+"))
        overrides[key] = f"{key}={','.join(values)}" if values else override
    return [*overrides.values()]


def _number(value: str) -> float | None:
    try:
        return float(value)
    except ValueError:
        return None


def _average_key(record: Record) -> RunKey:
    """What a row is averaged over: shape, view and seed. A stress is not part of the shape."""
    solid, view, seed = run_key(record)
    return (solid[1] if record["config"].get("stress") else solid, view, seed)


def _studied() -> set[str]:
    return {selection.experiment for study in studies() for selection in study.reads}
