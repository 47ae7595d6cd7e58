"""Fig. 5 of DIST: loss and Chamfer distance over iterations and time, and their rank correlation."""

import math
from dataclasses import dataclass
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report.data import curves
from bench.report.data.experiments import Experiment, Selection, shared_loss
from bench.report.data.records import SCALE, Record, Row, setting
from bench.report.write import chart
from bench.report.write.answer import Answer, chart_panel, presets_of, series
from bench.report.write.result import Result
from bench.report.write.table import IDENTITY, to_data

PLACE = 220
READS = (Selection("fig5", ("completion",)),)
# Plotted columns of a curve: labels and scales.
QUANTITIES = {"total": "weighted loss", "chamfer_l2": "Chamfer × 1000 (scene units²)"}
SCALES = {"total": 1.0, "chamfer_l2": SCALE}
NOTES = (
    "Chamfer distance is chamfer_l2, in squared scene units, times 1000; it is measured during the optimisation, but "
    "not used by it. Seconds are those of the optimisation loop.",
    "ρ is Spearman's rank correlation between loss and Chamfer over the n iterations of a row's runs that have both; "
    "points of one run are not independent, so it is no test of significance.",
)


@dataclass(frozen=True)
class Strategy:
    """All runs of one row: their curves, the medians over them, and the rank correlation of loss and Chamfer."""

    row: Row
    runs: int
    points: pd.DataFrame
    medians: dict[str, pd.DataFrame]
    correlation: float | None


def make(experiment: Experiment) -> Result:
    """Makes the page, with a curve per row, the median over its runs."""
    found = {record["folder"]: curves.read(experiment.folder(record)) for record in experiment.records}
    unread = [f"{r['name']}: {why}." for r in experiment.named() if (why := found[r["folder"]][1])]
    lines = {folder: line for folder, (line, _) in found.items()}
    strategies = [_strategy(row, records, lines) for row, records in experiment.rows().items()]
    several = max(strategy.runs for strategy in strategies) > 1
    runs = ", ".join(f"{strategy.row.name} {strategy.runs}" for strategy in strategies)
    about = f"Lines are medians over a row's runs; after its end a failed run counts as infinite. Runs per row: {runs}."
    return Result(
        experiment,
        "Loss and Chamfer distance as shapes are completed.",
        "Loss and Chamfer distance over iterations and seconds, and Chamfer distance over loss.",
        interval="bands are the minimum and maximum over runs" if several else "one run per row, no interval",
        remarks=(*unread, about if several else "", _loss(experiment), *NOTES),
        data=_data(experiment.records, lines, strategies),
        figure=draw(strategies),
    )


def _loss(experiment: Experiment) -> str:
    """A note on the terms of the loss, and on whether those of different rows can be compared."""
    compared = (
        "It is the same for every row, so that rows can be compared by it."
        if shared_loss(experiment.records)
        else "Each row's loss contains the silhouette loss of its renderer (the paper's in the rows with a plus), so "
        "losses of different rows cannot be compared; Chamfer distances can."
    )
    weight = setting(experiment.requested(), "task", "normal_weight")
    if weight:
        width = setting(experiment.requested(), "task", "normal_width")
        terms = f"depths, normals over {width} scene units (weight {weight:g}) and the silhouette"
        said = f"{terms}, as the paper's Fig. 5; at a point, normals of a ReLU network would move no code"
    else:
        said = "depths and the silhouette; the paper's Fig. 5 has normals as well"
    return f"The loss has {said}. {compared}"


@style.styled
def draw(strategies: list[Strategy]) -> Figure:
    """Draws loss above and Chamfer below, over iterations and seconds; at the right Chamfer over loss, and a legend."""
    figure, axes = chart.sheet(4.6, 2, 3)
    for row, quantity in zip(axes, QUANTITIES, strict=True):
        for axis, along in zip(row, ("iteration", "seconds"), strict=False):
            _panel(axis, strategies, quantity, along)
    for strategy in strategies:
        loss, chamfer = (style.finite(strategy.points[quantity] * SCALES[quantity]) for quantity in QUANTITIES)
        label = f"{strategy.row.name}\n  ρ = {format.number(strategy.correlation)} (n = {len(strategy.points)})"
        chart.points(axes[0, 2], strategy.row.preset, loss, chamfer, alpha=0.75, ms=3, label=label)
    axes[0, 2].set(xlabel=QUANTITIES["total"], ylabel=QUANTITIES["chamfer_l2"])
    for letter, quantity in (("x", "total"), ("y", "chamfer_l2")):
        style.log_axis(axes[0, 2], letter, [SCALES[quantity] * x for s in strategies for x in s.points[quantity]])
    axes[1, 2].axis("off")
    how = {"borderaxespad": 0, "labelspacing": 0.7, "markerscale": 1.5, "fontsize": 6.5}
    axes[1, 2].legend(*axes[0, 2].get_legend_handles_labels(), loc="upper left", **how)
    return figure


def _panel(axis: Axes, strategies: list[Strategy], quantity: str, along: str) -> None:
    """Draws a quantity; the axis of seconds is logarithmic where some rows are much faster than others."""
    scale = SCALES[quantity]
    for strategy in strategies:
        shown = strategy.medians[quantity]
        middle, low, high = ([scale * x for x in style.finite(shown[name])] for name in ("median", "low", "high"))
        how = {"band": (low, high) if strategy.runs > 1 else None, "markevery": max(len(shown) // 6, 1), "ms": 3.5}
        chart.line(axis, strategy.row.preset, style.finite(shown[along]), middle, **how)
    axis.set(xlabel="time (seconds)" if along == "seconds" else "iteration", ylabel=QUANTITIES[quantity])
    everything = pd.concat([strategy.medians[quantity] for strategy in strategies])
    style.log_axis(axis, "y", scale * everything["median"])
    if along == "seconds" and style.needs_log(s.medians[quantity]["seconds"].max() for s in strategies):
        style.log_axis(axis, "x", everything["seconds"])


def _strategy(row: Row, records: list[Record], lines: dict[str, pd.DataFrame]) -> Strategy:
    failed = [record["status"] != "ok" for record in records]
    runs = [lines[record["folder"]] for record in records]
    points = pd.concat(runs, ignore_index=True).dropna(subset=["total", "chamfer_l2"])
    medians = {quantity: curves.median(runs, failed, quantity) for quantity in QUANTITIES}
    return Strategy(row, len(records), points, medians, curves.spearman(points, *QUANTITIES))


def _data(records: list[Record], lines: dict[str, pd.DataFrame], strategies: list[Strategy]) -> pd.DataFrame:
    """The CSV, with three kinds of lines: of runs, of medians over a row's runs, and of a row's rank correlation."""
    rows: list[dict[str, Any]] = []
    identities = to_data(IDENTITY, records).to_dict("records")
    for record, identity in zip(records, identities, strict=True):
        points = _points(lines[record["folder"]]) or [{}]
        rows += [{"kind": "run", **identity, **point} for point in points]
    for strategy in strategies:
        identity = {"row": strategy.row.name, "n": strategy.runs}
        for quantity, shown in strategy.medians.items():
            names = {"median": quantity, "low": f"{quantity}_low", "high": f"{quantity}_high"}
            rows += [{"kind": "median", **identity, **point} for point in _points(shown.rename(columns=names))]
        rho = {"n": len(strategy.points), "spearman": strategy.correlation}
        rows.append({"kind": "correlation", "row": strategy.row.name, **rho})
    return pd.DataFrame(rows, dtype=object)


def _points(line: pd.DataFrame) -> list[dict[str, Any]]:
    """The lines of a curve, with counts as integers."""
    whole = ("iteration", "value_evaluations")
    return [
        {name: int(x) if name in whole and math.isfinite(x) else x for name, x in point.items()}
        for point in line.to_dict("records")
    ]


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The row with the lowest median error at the end, and the medians as a chart."""
    medians = data[data["kind"] == "median"].dropna(subset="chamfer_l2")
    ends = medians.sort_values("iteration").groupby("row", sort=False)["chamfer_l2"].last().sort_values()
    if not len(ends):
        return Answer("What is gained in each iteration?")
    fewest, most = int(medians["n"].min()), int(medians["n"].max())
    more = f" at least, {most} at most" if most > fewest else ""
    said = (
        f"{ends.index[0]} ends with the lowest median error, *{format.number(ends.iloc[0], SCALE)}* (Chamfer × "
        f"1000), {ends.index[-1]} with {format.number(ends.iloc[-1], SCALE)}; n = {fewest} runs a row{more}."
    )
    panels, presets = [], presets_of(data)
    for value, label, factor in (("total", "loss", 1.0), ("chamfer_l2", "Chamfer × 1000", SCALE)):
        found = data[data["kind"] == "median"].dropna(subset=[value, "seconds"])
        lines = [
            series(row, presets[row], own["seconds"], factor * own[value], dash="-", symbol="")
            for row, own in found.groupby("row", sort=False)
        ]
        panels.append(chart_panel("", "time in the loop (seconds)", label, lines))
    return Answer("What is gained in each iteration?", said, {"panels": panels})
