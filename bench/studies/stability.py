"""What breaks each renderer first: a heat map of renderers and axes.

An axis is a kind of stress. Its level is 0 at the mildest severity of its sweep and 1 at the severest.
"""

import math
import re
import shlex
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from bench.records.results import curve_lines
from bench.report.study import (
    NoFolder,
    Result,
    Runs,
    breakdowns,
    chart,
    figure_style,
    format,
    records,
    table,
)

PLACE = 120
READS = (breakdowns.SELECTION,)
DEFAULT_SCALE = "desk"
LEVEL_TEXT = re.compile(r"[01]\.\d{6}")  # as draw_breakdown writes it
FAILED = "failed_"  # prefix of the metrics that count failed trials by kind
SURVIVED = LinearSegmentedColormap.from_list("survived", ["#fbf4e6", "#c9d7e2", "#7ba0bd", "#2f6690", "#0b2f4f"])
AT_ONCE_COLOUR, MARK_COLOUR = "#b3261e", "#8a8a8a"
MARKS = {
    "×": "breaks at the mildest",
    "↑": "fails at the mildest, survives the severest",
    "–": "lacks the setting, or refuses the field",
    "": "not run",
}
GROUP_GAP_COLUMNS = 0.7
MIN_EQUAL_AXES = 5  # with fewer, equal breakdowns may be chance
LINE_INCHES, LABEL_INCHES = 0.155, 1.15  # the height of a renderer, and of the labels above the heat map
NOTES = (
    breakdowns.SUCCESS,
    "A breakdown is the severity at which half of the trials fail, as a percentage of the axis: 0 % is the mildest "
    "severity, 100 % the severest. In brackets: its interval, or the failed trials at that end of the axis. A renderer "
    "survives if its breakdown lies beyond the severest severity, even if a few trials fail there.",
    "A renderer that refuses a field, or was not run on an axis, ranks last there: compare renderers on the same axes. "
    "Rows without fits have breakdowns of renderings only.",
    "“Breaks first” and “Then” are the axes with the lowest breakdowns. Among equal ones, the axis on which the median "
    "renderer survives most is shown. “Best on” is the axis on which the renderer is farthest above the median "
    "renderer. Settings of renderers are left out.",
    "An interval is that of the shown axis. It does not cover the choice of the axis. The mean rank is over the "
    "{ranked_axes} axes that judge renderings, with its bootstrap interval over axes.",
    "Each renderer has one preset. The page “stability_axes” has all presets and all numbers.",
)


def make(runs: Runs) -> Result:
    """A line per renderer: the axes on which it breaks first, the axis on which it is best, and its mean rank."""
    runs = runs.of_newest_scene()
    cells = breakdowns.cells_of(runs)
    cells = cells.assign(ray=_rays(runs, cells), pictures=[record.get("pictures") for record in runs.records])
    axes, ranked = breakdowns.axes_of(cells), cells[cells["row"].isin(breakdowns.ranked_rows(runs))]
    ranks, shared = breakdowns.ranks_of(ranked)
    rows = sorted(ranks, key=lambda row: (math.isnan(ranks[row].value), ranks[row].value))
    compared = ranked[ranked["is_measured"] & ~ranked["is_setting"] & ~ranked["rises"]]
    medians = compared.groupby("axis")["shade"].median()
    compared = compared.assign(median=compared["axis"].map(medians))
    ranked_axes, equal = shared["axis"].nunique(), _equal_rows(shared)
    lines = [_extremes_of(compared[compared["row"] == row]) | {"row": row, "rank": ranks[row]} for row in rows]
    return Result(
        runs.where(cells["row"].isin(rows)),
        "What breaks each renderer first.",
        "Per renderer and axis (kind of stress), the severity at which half of the trials succeed.",
        question="What breaks each renderer first?",
        verdict=_hardest_axis(compared),
        n=f"{ranked['trials'].sum():.0f} trials in all, of {len(axes)} axes and {len(rows)} renderers",
        interval="95 % credible intervals of breakdowns",
        remarks=[*(note.format(**breakdowns.criteria(runs), ranked_axes=ranked_axes) for note in NOTES), *equal],
        data=_data(runs, cells, axes),
        columns=FIRST_COLUMNS,
        lines=lines,
        figure=draw(ranked, axes, rows),
        atlas=_atlas(ranked, axes, rows),
    )


def _data(runs: Runs, cells: pd.DataFrame, axes: pd.DataFrame) -> pd.DataFrame:
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


def _atlas(cells: pd.DataFrame, axes: pd.DataFrame, rows: list[str]) -> dict[str, Any]:
    """The heat map for the page: axes, rows, and each cell's breakdown as text, mark, shade and run."""
    shown = cells[["full", "mark", "status", "reason", "shade", "folder", "ray", "pictures"]].astype({"shade": object})
    shown["shade"] = shown["shade"].where(shown["shade"].notna(), None)
    cell_data = dict(zip(zip(cells["axis"], cells["row"], strict=True), shown.to_dict("records"), strict=True))
    return {
        "axes": [
            {"axis": a.Index, "title": breakdowns.title(a.Index), "group": breakdowns.group_title(a.group)}
            | {"unit": a.unit}
            for a in axes.itertuples()
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
    """Levels of which the outcome of the first trial is certain, which is the trial that bench.ray shows.

    They are those of the curve, or without it those of the pictures and the ends of the sweep.
    """
    metrics, tried = record["metrics"], dict[float, bool]()
    for level, end in zip((0.0, 1.0), breakdowns.ENDS, strict=True):
        successes, trials = (metrics.get(f"{end}_{name}") for name in ("successes", "trials"))
        if trials and successes in (0, trials):
            tried[level] = successes == trials
    pictures = record.get("pictures") or {}
    for name, success in (("works", True), ("breaks", False)):
        if LEVEL_TEXT.fullmatch(text := str(pictures.get(f"{name}_level"))):
            tried[float(text)] = success
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
def draw(cells: pd.DataFrame, axes: pd.DataFrame, rows: list[str]) -> Figure:
    shades, marks = (breakdowns.grid(cells, axes, name).reindex(columns=rows) for name in ("shade", "mark"))
    blocks = _in_two([list(names) for names in axes.groupby("group", sort=False).groups.values()])
    widest = max(sum(map(len, block)) + GROUP_GAP_COLUMNS * (len(block) - 1) for block in blocks)
    figure, panels = chart.sheet(len(blocks) * (LINE_INCHES * len(rows) + LABEL_INCHES) + 0.5, lines=len(blocks))
    for panel, block in zip(panels[:, 0], blocks, strict=True):
        _draw_block(panel, block, shades, marks)
        panel.set(xlim=(-0.5, widest - 0.5), ylim=(len(rows) + 0.6, -0.5))
        for name, x in _group_titles(block, axes["group"]):
            panel.text(x, len(rows) - 0.2, name, ha="center", va="top", fontsize=7, fontweight="bold")
    bar = figure.colorbar(ScalarMappable(cmap=SURVIVED), ax=panels, location="bottom", shrink=0.4, aspect=30, pad=0.02)
    bar.set_ticks([0.0, 0.5, 1.0], labels=["0 %: mildest", "50 %", "100 %: severest"])
    bar.set_label("breakdown, as a percentage of the axis", fontsize=7)
    bar.ax.tick_params(length=0)
    shown = [mark for mark in MARKS if (marks.eq(mark) if mark else marks.isna()).any(axis=None)]
    figure.legend(
        [_mark_handle(mark) for mark in shown],
        [MARKS[mark] for mark in shown],
        loc="outside lower center",
        ncols=len(shown) or 1,
    )
    return figure


def _mark_handle(mark: str) -> tuple[Line2D, Line2D]:
    """A mark for the legend, on the shade on which it stands in the heat map."""
    shade = {"×": 0.0, "↑": 1.0}.get(mark)
    cell = SURVIVED(shade) if shade is not None else "white"
    sign = Line2D([], [], ls="none", marker=f"${mark}$" if mark else "", color=_mark_colour(mark, shade or 0), ms=5)
    edge = "#cccccc" if mark in ("", "–") else cell
    return Line2D([], [], ls="none", marker="s", color=cell, markeredgecolor=edge, markeredgewidth=0.6, ms=8), sign


def _draw_block(panel: Axes, groups: list[list[str]], shades: pd.DataFrame, marks: pd.DataFrame) -> None:
    start, positions = 0.0, []
    for names in groups:
        image = np.ma.masked_invalid(shades.loc[names].to_numpy(float).T)
        edges = np.arange(len(names) + 1) + start - 0.5
        lines = np.arange(image.shape[0] + 1) - 0.5
        panel.pcolormesh(edges, lines, image, cmap=SURVIVED, vmin=0, vmax=1, edgecolors="white", linewidth=0.8)
        for column, line in np.argwhere(marks.loc[names].fillna("").ne("").to_numpy()):
            mark, shade = marks.loc[names[column]].iloc[line], shades.loc[names[column]].iloc[line]
            how = {"color": _mark_colour(mark, shade), "fontsize": 7, "fontweight": "bold" if mark == "×" else "normal"}
            panel.text(start + column, line, mark, ha="center", va="center_baseline", **how)
        positions += [start + column for column in range(len(names))]
        start += len(names) + GROUP_GAP_COLUMNS
    panel.set_xticks(positions, [breakdowns.title(name) for names in groups for name in names], rotation=48, ha="left")
    panel.set_xticks(panel.get_xticks(), panel.get_xticklabels(), rotation_mode="anchor")
    panel.xaxis.tick_top()
    panel.set_yticks(range(shades.shape[1]), list(shades))
    panel.tick_params(length=0, labelsize=6.5, pad=2)
    panel.grid(False)
    panel.spines[:].set_visible(False)


def _mark_colour(mark: str, shade: float) -> str:
    if mark == "×":
        return AT_ONCE_COLOUR
    return "white" if shade > 0.6 else MARK_COLOUR


def _in_two(groups: list[list[str]]) -> list[list[list[str]]]:
    """The groups in two blocks of similar widths, in their order; one block for few axes."""
    total = sum(map(len, groups))
    if total < 12 or len(groups) < 2:
        return [groups]
    split = min(range(len(groups) - 1, 0, -1), key=lambda i: abs(2 * sum(map(len, groups[:i])) - total))
    return [groups[:split], groups[split:]]


def _group_titles(groups: list[list[str]], group_of: pd.Series) -> list[tuple[str, float]]:
    starts = np.cumsum([0.0, *(len(names) + GROUP_GAP_COLUMNS for names in groups)])
    keys = [str(group_of[names[0]]) for names in groups]
    middles = [start + (len(names) - 1) / 2 for start, names in zip(starts, groups, strict=False)]
    return [(breakdowns.group_title(key), middle) for key, middle in zip(keys, middles, strict=True)]


def _extremes_of(cells: pd.DataFrame) -> dict[str, Any]:
    breaking = cells[~cells["never"]].sort_values(["shade", "median"], ascending=[True, False])
    first, second, *_ = [*breaking.itertuples(), None, None]
    lead = cells.assign(lead=cells["shade"] - cells["median"]).sort_values(["lead", "shade"], ascending=False)
    return {"first": first, "then": second, "best": next(lead.itertuples(), None)}


def _share_words(key: str) -> Callable[[dict[str, Any]], str]:
    def words(line: dict[str, Any]) -> str:
        if (cell := line[key]) is None:
            return format.MISSING
        if cell.at_once or cell.never:
            word, end = ("mildest", "mild") if cell.at_once else ("survives", "severe")
            return f"{breakdowns.title(cell.axis)}, {word} ({breakdowns.failed_trials(cell, end)})"
        low, high = (100 * min(max(end, 0.0), 1.0) for end in (cell.level_low, cell.level_high))
        interval = "(one trial)" if cell.one_trial else f"[{low:.0f}, {high:.0f}]"
        return f"{breakdowns.title(cell.axis)}, {100 * cell.shade:.0f} % {interval}"

    return words


FIRST_COLUMNS = (
    table.text("row", "Renderer"),
    table.shown("Breaks first", _share_words("first")),
    table.shown("Then", _share_words("then")),
    table.shown("Best on", _share_words("best")),
    *table.estimate("rank", "Mean rank"),
)


def _equal_rows(cells: pd.DataFrame) -> list[str]:
    """Sentences on renderers with the same breakdowns inside the sweeps, `MIN_EQUAL_AXES` or more of them."""
    inside = cells[cells["is_measured"] & cells["level"].between(0, 1, inclusive="neither")]
    groups: dict[frozenset[tuple[str, float]], list[str]] = {}
    for row, breakdowns_of_row in inside.groupby("row", sort=False):
        pairs = zip(breakdowns_of_row["axis"], breakdowns_of_row["level"], strict=True)
        groups.setdefault(frozenset(pairs), []).append(str(row))
    return [
        f"Equal breakdowns in all renderings: {'; '.join(rows)}."
        for pairs, rows in groups.items()
        if len(rows) > 1 and len(pairs) >= MIN_EQUAL_AXES
    ]


def _hardest_axis(cells: pd.DataFrame) -> str:
    """A sentence on the axis that breaks the largest share of renderers at the mildest severity; empty if none does."""
    counts = cells.groupby("axis")["at_once"].agg(["sum", "size"])
    shares = (counts["sum"] / counts["size"]).sort_values(ascending=False, kind="stable")
    if shares.empty or not shares.iloc[0] > 0:
        return ""
    hardest = [str(axis) for axis in shares.index[shares == shares.iloc[0]]]
    names = " and ".join(breakdowns.title(axis) for axis in hardest)
    verb = "break" if len(hardest) > 1 or names.endswith("s") else "breaks"
    broken = " and ".join(f"*{counts.loc[axis, 'sum']} of {counts.loc[axis, 'size']}*" for axis in hardest)
    where = f"At the mildest severity, {names} {verb} the largest share of renderers: {broken}"
    return (
        f"{where}. The table shows what breaks each renderer first, of {format.plural(len(shares), 'kind')} of stress."
    )


PAGES = {"stability": make}
