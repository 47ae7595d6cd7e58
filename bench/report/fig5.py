"""Figure 5: loss and Chamfer distance over iterations and time, and whether the one tells of the other."""

import math
from dataclasses import dataclass
from typing import Any

import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import spearmanr

from bench.report import curves, format, style
from bench.report.caption import joined, omitted, outcome, setup
from bench.report.experiments import Experiment, identity, row_name
from bench.report.tables import Result

TITLE = "Loss and Chamfer distance as shapes are completed."
QUANTITIES = {"total": "weighted loss", "chamfer_l2": "Chamfer × 1000 (scene units²)"}
SCALE = {"total": 1.0, "chamfer_l2": 1000.0}
CAPTION = (
    "Chamfer distance (chamfer_l2, squared scene units) times 1000; the truth is only watched, it steers nothing. "
    "Each row's loss holds its own silhouette loss (the paper's in the rows with a plus), so that losses of different "
    "rows do not compare; Chamfer does. Seconds are those of the optimisation loop. ρ is Spearman's rank correlation "
    "between loss and Chamfer over the n iterations of a row's runs that have both; points of one run follow each "
    "other, so it is no test of significance."
)


@dataclass(frozen=True)
class Strategy:
    """All runs of one row: their curves, the medians over them, and the rank correlation of loss and Chamfer."""

    name: str
    runs: int
    points: pd.DataFrame
    medians: dict[str, pd.DataFrame]
    correlation: float | None


def make(experiment: Experiment) -> Result:
    """Curves of each row, medians over its runs."""
    found = [curves.read(experiment.folder(record)) for record in experiment.records]
    pairs = zip(experiment.names(), found, strict=True)
    remarks = [f"{name}: {remark}." for name, (_, remark) in pairs if remark]
    lines = [line for line, _ in found]
    rows = list(dict.fromkeys(row_name(record) for record in experiment.records))
    strategies = [_strategy(row, experiment.records, lines) for row in rows]
    several = max(strategy.runs for strategy in strategies) > 1
    interval = (
        "Lines are medians over a row's runs, bands reach from the least to the largest; past its end a failed run "
        "counts as infinite. Runs a row: " + ", ".join(f"{s.name} {s.runs}" for s in strategies) + "."
    )
    return Result(
        name="fig5",
        title=TITLE,
        caption=joined(
            setup(experiment),
            CAPTION,
            interval if several else "One run a row, so no interval.",
            outcome(experiment),
            omitted(experiment),
            *remarks,
        ),
        data=_data(experiment.records, lines, strategies),
        figure=draw(strategies),
    )


@style.styled
def draw(strategies: list[Strategy]) -> Figure:
    """Loss above and Chamfer below over iterations and seconds; at the right one against the other, and the legend."""
    figure = Figure(figsize=(style.WIDTH, 4.6), layout="constrained")
    axes = figure.subplots(2, 3)
    for row, quantity in zip(axes, QUANTITIES, strict=True):
        for axis, along in zip(row, ("iteration", "seconds"), strict=False):
            for strategy in strategies:
                _line(axis, strategy, quantity, along)
            axis.set(xlabel="time (seconds)" if along == "seconds" else "iteration", ylabel=QUANTITIES[quantity])
            _scale(axis, strategies, quantity, along)
    for strategy in strategies:
        look, points = style.look(strategy.name), strategy.points
        loss, chamfer = (style.finite(points[quantity] * SCALE[quantity]) for quantity in QUANTITIES)
        axes[0, 2].plot(loss, chamfer, look.marker, color=look.colour, alpha=0.75, markersize=3, label=_entry(strategy))
    axes[0, 2].set(xlabel=QUANTITIES["total"], ylabel=QUANTITIES["chamfer_l2"])
    for letter, quantity in (("x", "total"), ("y", "chamfer_l2")):
        style.log_axis(axes[0, 2], letter, [SCALE[quantity] * x for s in strategies for x in s.points[quantity]])
    axes[1, 2].axis("off")
    handles, labels = axes[0, 2].get_legend_handles_labels()
    axes[1, 2].legend(
        handles, labels, loc="upper left", borderaxespad=0, labelspacing=0.7, markerscale=1.5, fontsize=6.5
    )
    return figure


def _line(axis: Any, strategy: Strategy, quantity: str, along: str) -> None:
    shown, look, scale = strategy.medians[quantity], style.look(strategy.name), SCALE[quantity]
    middle, low, high = ([scale * x for x in style.finite(shown[name])] for name in ("median", "low", "high"))
    places = style.finite(shown[along])
    every = max(len(places) // 6, 1)
    axis.plot(places, middle, linestyle=look.line, color=look.colour, marker=look.marker, markevery=every, ms=3.5)
    if strategy.runs > 1:
        axis.fill_between(places, low, high, color=look.colour, alpha=0.15, lw=0)


def _scale(axis: Any, strategies: list[Strategy], quantity: str, along: str) -> None:
    """A logarithmic axis of values; of seconds only where some rows are much faster than others."""
    style.log_axis(axis, "y", [x for s in strategies for x in s.medians[quantity]["median"] * SCALE[quantity]])
    ends = [s.medians[quantity]["seconds"].max() for s in strategies if len(s.medians[quantity])]
    if along == "seconds" and style.needs_log(ends):
        style.log_axis(axis, "x", [x for s in strategies for x in s.medians[quantity]["seconds"]])


def _strategy(name: str, records: list[dict[str, Any]], lines: list[pd.DataFrame]) -> Strategy:
    own = [(r, line) for r, line in zip(records, lines, strict=True) if row_name(r) == name]
    failed = [record["status"] != "ok" for record, _ in own]
    runs = [line for _, line in own]
    points = pd.concat(runs, ignore_index=True).dropna(subset=["total", "chamfer_l2"])
    medians = {quantity: curves.median(runs, failed, quantity) for quantity in QUANTITIES}
    varied = len(points) > 2 and all(points[quantity].nunique() > 1 for quantity in QUANTITIES)
    correlation = float(spearmanr(points["total"], points["chamfer_l2"]).statistic) if varied else None
    return Strategy(name, len(own), points, medians, correlation)


def _entry(strategy: Strategy) -> str:
    return f"{strategy.name}\n  ρ = {format.number(strategy.correlation)} (n = {len(strategy.points)})"


def _data(records: list[dict[str, Any]], lines: list[pd.DataFrame], strategies: list[Strategy]) -> pd.DataFrame:
    """Lines of three kinds: of a run, of the median over a row's runs, and of a row's rank correlation."""
    rows = []
    for record, line in zip(records, lines, strict=True):
        rows += [{"kind": "run", **identity(record), **point} for point in _points(line)]
        if not len(line):
            rows.append({"kind": "run", **identity(record)})
    for strategy in strategies:
        for quantity, shown in strategy.medians.items():
            for point in _points(shown):
                values = {
                    f"{quantity}{end}": point[n] for end, n in (("", "median"), ("_low", "low"), ("_high", "high"))
                }
                where = {"iteration": point["iteration"], "seconds": point["seconds"]}
                rows.append({"kind": "median", "row": strategy.name, "n": strategy.runs, **where, **values})
        rho = {"n": len(strategy.points), "spearman": strategy.correlation}
        rows.append({"kind": "correlation", "row": strategy.name, **rho})
    return pd.DataFrame(rows, dtype=object)


def _points(line: pd.DataFrame) -> list[dict[str, Any]]:
    """The lines of a curve, with whole numbers where it counts something."""
    whole = ("iteration", "value_evaluations")
    return [
        {name: int(x) if name in whole and math.isfinite(x) else x for name, x in point.items()}
        for point in line.to_dict("records")
    ]
