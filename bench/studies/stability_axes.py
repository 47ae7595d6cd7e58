"""All breakdowns of the stress test as numbers, the mean ranks of renderers over their cost, and curves of success."""

import math
from typing import Any

import numpy as np
import pandas as pd

from bench.records.results import curve_lines
from bench.report.study import Result, Runs, breakdowns, chart, format, records, statistics, table

PLACE = 121
READS = (breakdowns.SELECTION,)
COST_AXES = ("field evaluations per ray at the mildest severity, median", "mean rank over axes (1 is best)")
AXES_NOTES = (
    "The adaptive search makes {share:.0f} % of the trials of a full grid. Every renderer gets the same trials at a "
    "severity. Renderings have {resolution}×{resolution} pixels.",
    "A renderer survives if its breakdown lies beyond the severest severity. A breakdown at an end of the axis has the "
    "failed trials there, and the interval of their probability (Clopper and Pearson). “–”: the renderer lacks that "
    "setting.",
    "If success rises with severity, there is no breakdown. “One trial”: repeats cannot differ, and the breakdown is "
    "between two neighbouring severities.",
    "If a disturbance moves the surface, the moved surface is the ground truth. The CSV of the page “stability” has "
    "the distance, and the kinds of failed trials.",
    breakdowns.SUCCESS,
)
MIN_CORRELATED = 7  # renderers: with fewer, the p value is too small
COST_NOTES = (
    "An axis is a kind of stress. The axes are those of renderings, without settings that some renderer lacks. Rank 1 "
    "is the best, and equal breakdowns share their mean rank. A failed or missing run has the worst rank, and so has a "
    "renderer that refuses the field.",
    "Intervals are 95 % bootstrap intervals over axes. Two renderers cannot be distinguished if the interval of the "
    "difference of their ranks contains 0. Each renderer has one preset; the page “stability_axes” has all presets.",
    "A renderer survives an axis if it does not break at the severest severity.",
)
CURVE_NOTES = (
    "The CSV has the trials and successes at each severity. If repeats can differ, it also has the interval of the "
    "success rate (Clopper and Pearson).",
    "On the interactive page, a cell of the atlas opens the curves of its axis.",
)
SHARE_COLUMNS = ("level", "severity", "successes", "trials", "share", "low", "high")
COST_COLUMNS = (
    *(table.text("row", "Renderer"), table.Column("axes"), *table.estimate("rank", "Mean rank")),
    *table.columns(table.word, at_once="Axes broken at the mildest", never="Axes survived"),
    table.Column("without", "Axes refused or failed"),
    *(table.Column("cost", "Field evaluations per ray"), table.PRESET),
)


def make_axes(runs: Runs) -> Result:
    runs = runs.of_newest_scene()
    cells = breakdowns.cells_of(runs)
    axes, rows = breakdowns.axes_of(cells), list(cells["row"].unique())
    task, trials = runs.requested().get("task"), cells["trials"].sum()
    settings: dict[str, Any] = {**breakdowns.criteria(runs)}
    settings["resolution"] = records.setting(task, "resolution")
    settings["share"] = 100 * trials / max(cells["grid_trials"].sum(), 1)
    survived = table.extremes(
        "Kinds of stress that do not break a renderer at any tested severity",
        cells.groupby("row", sort=False)["never"].sum().to_dict(),
        f"{trials:.0f} trials on {len(axes)} axes",
        show=table.integer,
        largest_first=True,
    )
    words = breakdowns.grid(cells, axes, "words").fillna("").reset_index(drop=True)
    words.insert(0, "Axis", [breakdowns.title(axis) for axis in axes.index])
    words.insert(1, "Unit", list(axes["unit"]))
    return Result(
        runs,
        "The severity at which each renderer breaks.",
        "The severity at which half of the trials succeed, on each axis (kind of stress).",
        question="Which kinds of stress does each renderer survive, and at which severity do the others break it?",
        verdict=f"{survived} {_breaking(cells)}".strip(),
        n=f"{trials:.0f} trials in all, of {len(axes)} axes and {len(rows)} renderers",
        interval="95 % credible intervals, the milder end first",
        remarks=[note.format(**settings) for note in AXES_NOTES],
        columns=[table.text(name, name) for name in words],
        lines=words.to_dict("records"),
    )


def _breaking(cells: pd.DataFrame) -> str:
    """A sentence on the severities at which renderers break; empty if none breaks inside an axis."""
    measured = cells[cells["is_measured"]]
    inside = measured.loc[~measured["at_once"] & ~measured["never"] & ~measured["rises"], "shade"]
    if inside.empty:
        return ""
    return (
        f"Of {len(measured)} pairs of renderer and axis, {measured['never'].sum()} have no breakdown, "
        f"{measured['at_once'].sum()} have it at the mildest severity, and {len(inside)} have it inside the axis, at "
        f"*{table.percent(inside.median())}* (median; 0 % is the mildest severity)."
    )


def make_cost(runs: Runs) -> Result:
    runs = runs.of_newest_scene()
    cells = breakdowns.cells_of(runs)
    cells = cells[cells["row"].isin(breakdowns.ranked_rows(runs))]
    ranks, shared = breakdowns.ranks_of(cells)
    lines = pd.DataFrame([_cost(shared[shared["row"] == row], row, rank) for row, rank in ranks.items()])
    lines["preset"] = list(cells.drop_duplicates("row")["preset"])
    means = lines["rank"].map(lambda rank: rank.value)
    lines["behind"] = lines.groupby(["cost", means]).cumcount()  # points at the same position are drawn smaller
    ranked = lines[["cost"]].assign(rank=means).dropna()
    points = [
        chart.series(line.row, line.preset, [line.cost], [line.rank], size=12 / (1 + 0.4 * line.behind))
        for line in lines.loc[ranked.index].itertuples()
    ]
    costs = [f"{line.row}, {format.number(line.cost)}" for line in lines.itertuples()]
    title = "Mean rank (1 is best) and field evaluations per ray"
    ends = table.extremes(title, dict(zip(costs, means, strict=True)), f"{shared['axis'].nunique()} axes")
    panel = chart.panel_data("", *COST_AXES, points, height=420)
    panel["y"] = {"title": COST_AXES[1], "log": False, "reversed": True}
    return Result(
        runs,
        "Robustness over cost.",
        "Mean rank of a renderer's breakdowns, over its median of field evaluations per ray at the mildest severity.",
        question="Do robust renderers cost more field evaluations?",
        verdict=f"{_related(ranked)} {ends} {_alike(ranks)}".strip(),
        n=f"{shared['axis'].nunique()} axes and {len(lines)} renderers",
        remarks=[*COST_NOTES, _power(len(ranked))],
        columns=COST_COLUMNS,
        lines=lines.to_dict("records"),
        figure=chart.draw([panel], 3.6),
        chart={"panels": [panel]},
    )


def make_curves(runs: Runs) -> Result:
    """The fraction of successes at each severity; a panel of the page's atlas per axis."""
    runs = runs.of_newest_scene()
    cells = breakdowns.cells_of(runs)
    shares = [_shares(runs, record, cell) for record, cell in zip(runs.records, cells.to_dict("records"), strict=True)]
    data = pd.concat(shares, ignore_index=True)
    panels = []
    for axis, axis_data in data.groupby("axis", sort=False):
        lines = []
        for (row, preset), points in axis_data.groupby(["row", "preset"], sort=False):
            trials = [f"{x.successes:.0f} of {x.trials:.0f} succeed" for x in points.itertuples()]
            texts = [f"{x} at {format.number(level)}" for x, level in zip(trials, points["severity"], strict=True)]
            lines.append(chart.curve(row, preset, points["severity"], 100 * points["share"], size=5, text=texts))
        title = breakdowns.title(axis)
        panels.append(chart.panel_data(title, "severity", "successes (%)", lines, height=300, axis=axis))
    return Result(
        runs,
        "Probability of success over severity.",
        "The fraction of successful trials at each severity, in the CSV and on the interactive page.",
        n=f"{cells['axis'].nunique()} axes and {cells['row'].nunique()} renderers",
        interval="95 % intervals (Clopper and Pearson)",
        remarks=CURVE_NOTES,
        data=data,
        chart={"panels": panels},
    )


def _related(ranked: pd.DataFrame) -> str:
    """A sentence on the correlation of the columns "cost" and "rank"; empty with few renderers."""
    if len(ranked) < MIN_CORRELATED:
        return ""
    rho, p = statistics.rank_correlation(ranked["cost"], ranked["rank"])
    if math.isnan(rho):
        return ""
    answer = "No significant correlation" if p >= statistics.ALPHA else "Yes" if rho < 0 else "No, they cost fewer"
    return f"{answer}: Spearman's correlation of rank and cost is *{rho:.2f}* (p = {p:.2g}, {len(ranked)} renderers)."


def _power(count: int) -> str:
    """A sentence on the correlations that could be significant; empty with few renderers."""
    if count < MIN_CORRELATED:
        return ""
    smallest = statistics.smallest_significant_correlation(count)
    return f"With {count} renderers, only correlations beyond ±{smallest:.2f} are significant."


def _alike(ranks: dict[str, statistics.Interval]) -> str:
    """A sentence on the rows that cannot be distinguished from the best rank; empty without intervals."""
    best = min(ranks, key=lambda row: ranks[row].value)
    if not ranks[best].has_ends:
        return ""
    similar = statistics.tied_with_best(ranks, best)
    if not similar:
        return f"All others can be distinguished from {best}."
    listed = f"*{len(similar)}* of the {len(ranks) - 1} others ({'; '.join(similar)})"
    return f"Also, {listed} cannot be distinguished from {best}."


def _cost(cells: pd.DataFrame, row: str, rank: statistics.Interval) -> dict[str, Any]:
    """The line of a renderer on the shared axes. Its cost leaves out axes on which it breaks at once."""
    ends = {name: int(cells[name].sum()) for name in ("at_once", "never")}
    cost = cells["evaluations_per_ray"][~cells["at_once"]].median()
    without = int((~cells["is_measured"]).sum())
    return {"row": row, "axes": len(cells), "rank": rank, **ends, "without": without, "cost": cost}


def _shares(runs: Runs, record: records.Record, cell: dict[str, Any]) -> pd.DataFrame:
    """The successes, trials, their ratio and its interval at each level of a finished search, mild to severe."""
    lines = curve_lines(runs.folder(record)) if cell["is_measured"] else None
    tried = pd.DataFrame(lines or [], columns=["level", "severity", "success"])
    numbers = tried[["level", "severity"]].apply(pd.to_numeric, errors="coerce").astype(float)
    tried = numbers.assign(success=tried["success"].eq(True))
    levels = tried[np.isfinite(tried["level"] + tried["severity"])].groupby("level", as_index=False)
    counts = levels.agg(severity=("severity", "first"), successes=("success", "sum"), trials=("success", "size"))
    rates = [statistics.clopper_pearson(k / n, n) for k, n in zip(counts["successes"], counts["trials"], strict=True)]
    ends = {end: [math.nan if cell["one_trial"] else getattr(rate, end) for rate in rates] for end in ("low", "high")}
    identity = {key: cell[key] for key in ("axis", "row", "preset")}
    counts = counts.assign(**identity, share=[rate.value for rate in rates], **ends)
    return counts[[*identity, *SHARE_COLUMNS]]


PAGES = {"stability_axes": make_axes, "stability_cost": make_cost, "stability_curves": make_curves}
