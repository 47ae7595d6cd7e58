"""The breakdown of each renderer on each axis of the stress test: as an atlas, over cost, and as curves."""

import math
import shlex
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bench.records.results import curve_lines
from bench.report.study import (
    NoFolder,
    Result,
    Runs,
    Selection,
    chart,
    figure_style,
    format,
    records,
    statistics,
    table,
)

PLACE = 120
READS = (Selection("stability", ("task.stress",), setup=("machine",), alike=("task",)),)
DEFAULT_SCALE = "desk"
FAILED = "failed_"  # prefix of the metrics that count failed trials by kind
ENDS = ("mild", "severe")
COST_AXES = ("field evaluations per ray at the mildest severity, median", "mean rank over axes (1 is best)")
NOTES = (
    "The adaptive search makes {share:.0f} % of the trials of a full grid. Every renderer gets the same trials at a "
    "severity. Renderings have {resolution}×{resolution} pixels.",
    "“At once”: breaks at the mildest severity. “None”: does not break at the severest. Both have the failed trials "
    "and the interval of their fraction (Clopper and Pearson). “–”: the renderer lacks that setting.",
    "“Rises”: more trials succeed at the severest than at the mildest severity, so there is no breakdown. “One trial”: "
    "repeats cannot differ, and the breakdown is between two neighbouring severities.",
    "If a disturbance moves the surface, the moved surface is the ground truth. The CSV has the distance, and the "
    "kinds of failed trials.",
    "Success: {hits:g} of the true hits lie within the footprint of a pixel, and spurious hits are at most "
    "{false_hits:g} of them. A gradient has a cosine of at least {cosine:g} and a relative length within {scale:g} of "
    "1. A fit is within {surface_error:g} scene units of the surface.",
)
COST_NOTES = (
    "An axis is a kind of stress. The axes are those of renderings, without settings that some renderer lacks. Rank 1 "
    "is the best, and equal breakdowns share their mean rank. A failed or missing run has the worst rank, and so has a "
    "renderer that refuses the field.",
    "Intervals are 95 % bootstrap intervals over axes. Two renderers cannot be distinguished if the interval of the "
    "difference of their ranks contains 0. Each renderer has one preset; the page “stability” has all presets.",
    "At once: axes on which it breaks at the mildest severity. None: axes on which it does not break at the severest.",
)
CURVE_NOTES = (
    "The CSV has the trials and successes at each severity. If repeats can differ, it also has the interval of the "
    "success rate (Clopper and Pearson).",
    "On the interactive page, a cell of the atlas opens the curves of its axis.",
)
TARGET = ("renderer", "_target_")
CRITERIA = ("hits", "false_hits", "cosine", "scale", "surface_error")
NUMBERS = (
    *("level", "breakdown", "breakdown_low", "breakdown_high", "trials", "grid_trials", "evaluations_per_ray"),
    *(f"{end}_{name}" for end in ENDS for name in ("successes", "trials")),
)
SHARE_COLUMNS = ("level", "severity", "successes", "trials", "share", "low", "high")
COST_COLUMNS = (
    *(table.text("row", "Renderer"), table.Column("axes"), *table.estimate("rank", "Mean rank")),
    *table.columns(table.word, at_once="At once", never="None"),
    *(table.Column("cost", "Field evaluations per ray"), table.PRESET),
)


def make(runs: Runs) -> Result:
    """A line per axis and a column per renderer."""
    runs = runs.of_newest_scene()
    cells = cells_of(runs)
    axes, rows = axes_of(cells), list(cells["row"].unique())
    task, trials = runs.requested().get("task"), cells["trials"].sum()
    settings = {name: float(records.setting(task, "criteria", name) or math.nan) for name in CRITERIA}
    settings["resolution"] = records.setting(task, "resolution")
    settings["share"] = 100 * trials / max(cells["grid_trials"].sum(), 1)
    words = _grid(cells, axes, "words").fillna("").reset_index(drop=True)
    words.insert(0, "Axis", [title(axis) for axis in axes.index])
    words.insert(1, "Unit", list(axes["unit"]))
    return Result(
        runs,
        "The severity at which each renderer breaks.",
        "The severity at which half of the trials succeed, on each axis (kind of stress).",
        question="At which severity of stress does each renderer break?",
        verdict=table.extremes(
            "Axes on which a renderer does not break",
            cells.groupby("row", sort=False)["never"].sum().to_dict(),
            f"{trials:.0f} trials on {len(axes)} axes",
            show=table.integer,
            largest_first=True,
        ),
        n=f"{trials:.0f} trials in all, of {len(axes)} axes and {len(rows)} renderers",
        interval="95 % credible intervals, the milder end first",
        remarks=[note.format(**settings) for note in NOTES],
        data=_data(runs, cells, axes),
        columns=[table.text(name, name) for name in words],
        lines=words.to_dict("records"),
        figure=draw(cells, axes),
        atlas=_atlas(cells.assign(ray=_rays(runs, cells)), axes),
    )


def make_cost(runs: Runs) -> Result:
    """A line and a point per renderer: its mean rank over the axes, and its field values per ray."""
    runs = runs.of_newest_scene()
    cells = cells_of(runs)
    cells = cells[cells["row"].isin(_ranked(runs))]
    rendered = cells[cells["measure"] == "rendering"]
    unsupported = set(rendered.loc[(rendered["status"] == "unsupported") & rendered["is_setting"], "axis"])
    shared = rendered[~rendered["axis"].isin(unsupported)]
    # A failed, missing or unsupported run has no shade, so it ranks last.
    shades = shared.pivot(index="axis", columns="row", values="shade").reindex(columns=cells["row"].unique())
    ranks = statistics.rank({str(row): (1.0 - row_shades).to_dict() for row, row_shades in shades.items()})
    lines = pd.DataFrame([_cost(shared[shared["row"] == row], row, ranks[row]) for row in shades])
    lines["preset"] = list(cells.drop_duplicates("row")["preset"])
    means = lines["rank"].map(lambda rank: rank.value)
    lines["behind"] = lines.groupby(["cost", means]).cumcount()  # points at the same position are drawn smaller
    points = [
        chart.series(line.row, line.preset, [line.cost], [line.rank], size=12 / (1 + 0.4 * line.behind))
        for line in lines[lines["cost"].notna() & means.notna()].itertuples()
    ]
    costs = [f"{line.row}, {format.number(line.cost)}" for line in lines.itertuples()]
    title = "Mean rank (1 is best) and field evaluations per ray"
    ends = table.extremes(title, dict(zip(costs, means, strict=True)), f"{len(shades)} axes")
    panel = chart.panel_data("", *COST_AXES, points, height=420)
    panel["y"] = {"title": COST_AXES[1], "log": False, "reversed": True}
    return Result(
        runs,
        "Robustness over cost.",
        "Mean rank of a renderer's breakdowns, over its median of field evaluations per ray at the mildest severity.",
        question="Do robust renderers cost more field evaluations?",
        verdict=f"{ends} {_alike(ranks)}".strip(),
        n=f"{len(shades)} axes and {len(lines)} renderers",
        remarks=COST_NOTES,
        columns=COST_COLUMNS,
        lines=lines.to_dict("records"),
        figure=chart.draw([panel], 3.6),
        chart={"panels": [panel]},
    )


def make_curves(runs: Runs) -> Result:
    """The fraction of successes at each severity; a panel of the page's atlas per axis."""
    runs = runs.of_newest_scene()
    cells = cells_of(runs)
    shares = [_shares(runs, record, cell) for record, cell in zip(runs.records, cells.to_dict("records"), strict=True)]
    data = pd.concat(shares, ignore_index=True)
    panels = []
    for axis, axis_data in data.groupby("axis", sort=False):
        lines = []
        for (row, preset), points in axis_data.groupby(["row", "preset"], sort=False):
            texts = [
                f"{x.successes:.0f} of {x.trials:.0f} succeed at {format.number(x.severity)}"
                for x in points.itertuples()
            ]
            lines.append(chart.curve(row, preset, points["severity"], 100 * points["share"], size=5, text=texts))
        panels.append(chart.panel_data(title(axis), "severity", "successes (%)", lines, height=300, axis=axis))
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


def title(axis: str) -> str:
    return axis.replace("_", " ")


def cells_of(runs: Runs) -> pd.DataFrame:
    """A line per run: axis, row, whether its search finished, and its breakdown as number, shade and text.

    A level is 0 at the mild end of the sweep and 1 at the severe end; the shade is the level clipped to 0 and 1.
    """
    cells = runs.frame[["row", "preset"]].assign(
        axis=runs.frame["dataset"].astype(object),
        **{key: [record[key] for record in runs.records] for key in ("status", "reason", "folder")},
        **{key: runs.setting(f"task.stress.{key}") for key in ("group", "measure")},
        unit=runs.setting("task.stress.sweep.unit"),
        is_setting=runs.setting("task.stress.setting").ne(""),
        one_trial=runs.setting("task.stress.repeats") == "1",
        **{key: runs.number(key) for key in NUMBERS},
    )
    level = cells["level"]
    is_measured = cells["status"].eq("ok") & level.notna() & cells["unit"].ne("")
    mild, severe = ((cells[f"{end}_successes"] / cells[f"{end}_trials"]).fillna(0) for end in ENDS)
    cells = cells.assign(is_measured=is_measured, at_once=is_measured & (level < 0), never=is_measured & (level > 1))
    cells = cells.assign(shade=level.clip(0, 1).where(is_measured), rises=is_measured & (severe > mild))
    return cells.assign(
        short=[_breakdown_texts(cell, "")[0] for cell in cells.itertuples()],
        words=[_breakdown_texts(cell, "")[1] for cell in cells.itertuples()],
        full=[_breakdown_texts(cell, f" {cell.unit}")[1] for cell in cells.itertuples()],
    )


def axes_of(cells: pd.DataFrame) -> pd.DataFrame:
    """The axes as index, with their group, measure and unit; groups in the order of their runs."""
    axes = cells.drop_duplicates("axis").set_index("axis")
    groups = list(axes["group"].unique())
    return axes.iloc[np.argsort([groups.index(group) for group in axes["group"]], kind="stable")]


def _breakdown_texts(cell: Any, unit: str) -> tuple[str, str]:
    """The breakdown as a short text, and as a text with its interval or the failures at an end of the sweep."""
    mild, severe = (_failures(cell, end) for end in ENDS)
    low, high = ("" if math.isnan(end) else format.number(end) for end in (cell.breakdown_low, cell.breakdown_high))
    if not cell.is_measured:
        return (format.MISSING if cell.status == "unsupported" else cell.status,) * 2
    if cell.rises:
        return "rises", f"success rises with severity (mild: {mild}; severe: {severe})"
    if cell.at_once:
        return "at once", f"at once ({mild}{f', up to {high}{unit}' if high else ''})"
    if cell.never:
        return "none", f"none ({severe}{f', from {low}{unit}' if low else ''})"
    short = format.number(cell.breakdown)
    interval = "one trial" if cell.one_trial else f"{low or 'beyond'} to {high or 'beyond'}"
    return short, f"{short}{unit} ({interval})"


def _failures(cell: Any, end: str) -> str:
    """The number of failed trials at an end of the sweep; with repeats, the interval of their fraction too."""
    successes, trials = (getattr(cell, f"{end}_{name}") for name in ("successes", "trials"))
    if not trials > 0:
        return "not tried"
    rate = statistics.clopper_pearson(1 - successes / trials, trials)
    share = "" if cell.one_trial else f", {100 * rate.low:.0f}-{100 * rate.high:.0f} %"
    return f"{trials - successes:.0f} of {trials:.0f} failed{share}"


def _grid(cells: pd.DataFrame, axes: pd.DataFrame, values: str) -> pd.DataFrame:
    """A column of the cells as a table of axes and rows; missing for rows that were not run."""
    return cells.pivot(index="axis", columns="row", values=values).reindex(axes.index, columns=cells["row"].unique())


def _data(runs: Runs, cells: pd.DataFrame, axes: pd.DataFrame) -> pd.DataFrame:
    """A line per axis and renderer with all metrics, axis by axis."""
    names = dict.fromkeys(name for record in runs.records for name in record["metrics"])
    metrics = {name: [record["metrics"].get(name) for record in runs.records] for name in names if FAILED not in name}
    kinds = [
        "; ".join(
            f"{n:.0f} {name.removeprefix(FAILED).replace('_', ' ')}"
            for name, n in sorted(record["metrics"].items())
            if name.startswith(FAILED)
        )
        for record in runs.records
    ]
    leading, rows = cells[["axis", "group", "unit", "short", "full"]], list(cells["row"].unique())
    data = pd.concat([leading, table.to_data(table.IDENTITY, runs.records)], axis=1).assign(**metrics, failures=kinds)
    order = np.lexsort((cells["row"].map(rows.index), cells["axis"].map(axes.index.get_loc)))
    return data.iloc[order].reset_index(drop=True)


def _atlas(cells: pd.DataFrame, axes: pd.DataFrame) -> dict[str, Any]:
    """The grid for the page: axes, rows, and each cell's breakdown as text, shade and run."""
    rows = list(cells["row"].unique())
    shown = cells[["short", "full", "status", "reason", "shade", "folder", "ray"]].astype({"shade": object})
    shown["shade"] = shown["shade"].where(shown["shade"].notna(), None)
    cell_data = dict(zip(zip(cells["axis"], cells["row"], strict=True), shown.to_dict("records"), strict=True))
    return {
        "axes": [
            {"axis": a.Index, "title": title(a.Index), "group": a.group, "unit": a.unit} for a in axes.itertuples()
        ],
        "rows": rows,
        "cells": [[cell_data.get((axis, row)) for row in rows] for axis in axes.index],
    }


def _rays(runs: Runs, cells: pd.DataFrame) -> list[dict[str, Any] | None]:
    """For each cell, the command that draws a ray, with the levels nearest to the breakdown that fail and succeed.

    None for fits and settings of a renderer, which have no scene, and without such a level.
    """
    rays = []
    for record, cell in zip(runs.records, cells.itertuples(), strict=True):
        tried, level = first_trials(runs, record), cell.level
        breaks = min((x for x, success in tried.items() if not success and x >= level), default=None)
        works = max((x for x, success in tried.items() if success and x <= level), default=None)
        has_scene = cell.measure != "fit" and not cell.is_setting and not cell.rises
        command = {"command": _ray_command(record), "breaks": breaks, "works": works}
        rays.append(command if has_scene and (breaks, works) != (None, None) else None)
    return rays


def first_trials(runs: Runs, record: records.Record) -> dict[float, bool]:
    """Levels of which the outcome of the first trial is certain, which is the trial that bench.ray shows."""
    metrics, tried = record["metrics"], dict[float, bool]()
    for level, end in zip((0.0, 1.0), ENDS, strict=True):
        successes, trials = (metrics.get(f"{end}_{name}") for name in ("successes", "trials"))
        if trials and successes in (0, trials):
            tried[level] = successes == trials
    try:
        lines = curve_lines(runs.folder(record)) or []
    except NoFolder:
        lines = []
    for line in reversed(lines):  # the first trial of a level is the last one that is noted
        if isinstance(level := line.get("level"), float) and math.isfinite(level):
            tried[level] = line.get("success") is True
    return tried


def _ray_command(record: records.Record) -> str:
    """The command of a ray of a run's scene, without its level."""
    scale = records.setting(record["config"], "scale", "name")
    settings = [str(text) for text in record.get("overrides") or []]
    settings = [text for text in settings if text.lstrip("+").startswith(("renderer.", "task."))]
    stress, renderer = f"stress={record['dataset']}", f"renderer={record['renderer']}"
    scales = [f"scale={scale}"] if scale not in (None, DEFAULT_SCALE) else []
    return shlex.join(["python", "-m", "bench.ray", "task=stability", stress, renderer, *settings, *scales])


@figure_style.styled
def draw(cells: pd.DataFrame, axes: pd.DataFrame) -> Figure:
    """Draws the heat map: red if a renderer breaks at a mild severity, blue if it does not break."""
    shades, words = (_grid(cells, axes, name) for name in ("shade", "short"))
    rows, n = list(shades.columns), len(axes)
    width = max(figure_style.WIDTH, 0.39 * len(rows) + 2.2)  # inches: a number has room in its cell
    figure, ((panel,),) = chart.sheet(0.19 * n + 1.7, width=width)
    image = panel.imshow(np.ma.masked_invalid(shades.to_numpy(float)), cmap="RdYlBu", vmin=0, vmax=1, aspect="auto")
    panel.set_facecolor("#f2f2f2")
    for line, column in np.argwhere((words.notna() & ~words.isin(["at once", "none"])).to_numpy()):
        text, shade = words.iloc[line, column], shades.iloc[line, column]
        how = {"color": "white" if shade < 0.1 or shade > 0.9 else "black", "fontsize": 5.5 if len(text) < 8 else 4.5}
        panel.text(column, line, text, ha="center", va="center", **how)
    panel.set_xticks(range(len(rows)), rows, rotation=35, ha="left", rotation_mode="anchor")
    panel.xaxis.tick_top()
    panel.set_yticks(range(n), [f"{title(axis.Index)} ({axis.unit})" for axis in axes.itertuples()])
    panel.tick_params(length=0, labelsize=6)
    panel.grid(False)
    for line in np.flatnonzero(axes["group"].to_numpy()[1:] != axes["group"].to_numpy()[:-1]):
        panel.axhline(line + 0.5, color="#222222", lw=0.8)
    bar = figure.colorbar(image, ax=panel, location="bottom", shrink=0.5, aspect=40, pad=0.02)
    bar.set_ticks([0, 1], labels=["at once: breaks at the mildest", "none: not at the severest"])
    return figure


def _ranked(runs: Runs) -> list[str]:
    """One row of each renderer of this project, by its default preset or else the first; all rows of the user's."""
    firsts = [records_of_row[0] for records_of_row in runs.rows().values()]
    is_ours = {
        record["row"]: str(records.setting(record["config"], *TARGET)).startswith(records.OURS) for record in firsts
    }
    of_renderer = records.grouped([record for record in firsts if is_ours[record["row"]]], records.base_renderer)
    chosen = [
        next((record for record in group if record["renderer"].replace("_", "") == renderer), group[0])["row"]
        for renderer, group in of_renderer.items()
    ]
    return [name for name, is_our_row in is_ours.items() if not is_our_row or name in chosen]


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
    return {"row": row, "axes": len(cells), "rank": rank, **ends, "cost": cost}


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
    counts = counts.assign(
        axis=cell["axis"], row=cell["row"], preset=cell["preset"], share=[rate.value for rate in rates]
    )
    return counts.assign(**ends)[["axis", "row", "preset", *SHARE_COLUMNS]]


PAGES = {"stability": make, "stability_cost": make_cost, "stability_curves": make_curves}
