"""The breakdowns of renderers on the axes of the stress test, as a table of cells, and the mean ranks of renderers.

An axis is a kind of stress. Its level is 0 at the mildest severity of its sweep and 1 at the severest.
"""

import math
from typing import Any

import numpy as np
import pandas as pd

from bench.records import format
from bench.report.data import records, statistics
from bench.report.data.runs import Runs, Selection

# Settings of fits change no rendering, so that these are read together.
CONDITIONS = ("task.stress", "task.fit", "task.fit_search")
SELECTION = Selection("stability", CONDITIONS, setup=("machine",), alike=("task",))
GROUP_TITLES = {
    "geometry": "shape", "viewing": "camera", "field": "field", "network": "network", "fit": "fitted shape",
    "observation": "observations", "optimisation": "settings",
}  # fmt: skip
SEVERE_WORDS = {  # the severe case, for axes whose names do not say it
    "alpha": "large alpha", "bumps": "fine bumps", "coarse_floats": "few bits of the field",
    "coarse_weights": "few bits of the weights", "csg_difference": "thin hollow walls", "epsilon": "large epsilon",
    "gap": "narrow gap", "gradient_samples": "many gradient samples", "learning_rate": "large learning rate",
    "nan_region": "undefined region", "nested_shells": "nested thin shells", "perturbed": "noisy distances",
    "quantised": "distances in steps", "ripples": "rippled distances", "saturated": "saturated distances",
    "strong_distance": "distances too large", "truncated": "truncated distances",
    "weak_distance": "distances too small", "wires": "thin wires",
}  # fmt: skip
ENDS = ("mild", "severe")
SUCCESS = (
    "Success: {hits:g} of the true hits lie within the footprint of a pixel, and spurious hits are at most "
    "{false_hits:g} of them. A gradient has a cosine of at least {cosine:g} and a relative length within {scale:g} of "
    "1. A fit is within {surface_error:g} scene units of the surface."
)  # of a trial, by `criteria`
TARGET = ("renderer", "_target_")
NUMBERS = (
    *("level", "level_low", "level_high", "breakdown", "breakdown_low", "breakdown_high"),
    *("trials", "grid_trials", "evaluations_per_ray"),
    *(f"{end}_{name}" for end in ENDS for name in ("successes", "trials")),
)


def cells_of(runs: Runs) -> pd.DataFrame:
    """A line per run: axis, row, whether its search finished, and its breakdown as number, shade and text."""
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
        mark=[_mark(cell) for cell in cells.itertuples()],
    )


def criteria(runs: Runs) -> dict[str, float]:
    names, task = ("hits", "false_hits", "cosine", "scale", "surface_error"), runs.requested().get("task")
    return {name: float(records.setting(task, "criteria", name) or math.nan) for name in names}


def axes_of(cells: pd.DataFrame) -> pd.DataFrame:
    """The axes as index, with their group, measure and unit: in the order of `GROUP_TITLES`, the hardest first."""
    axes = cells.drop_duplicates("axis").set_index("axis")
    groups = list(dict.fromkeys([*GROUP_TITLES, *axes["group"]]))
    mean = cells.groupby("axis")["shade"].mean().reindex(axes.index).fillna(1.0)
    return axes.iloc[np.lexsort((mean, axes["group"].map(groups.index)))]


def title(axis: str) -> str:
    return SEVERE_WORDS.get(axis, axis.replace("_", " "))


def group_title(group: str) -> str:
    return GROUP_TITLES.get(group, group)


def grid(cells: pd.DataFrame, axes: pd.DataFrame, values: str) -> pd.DataFrame:
    """A column of the cells as a table of axes and rows; missing for rows that were not run."""
    return cells.pivot(index="axis", columns="row", values=values).reindex(axes.index, columns=cells["row"].unique())


def ranked_rows(runs: Runs) -> list[str]:
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


def ranks_of(cells: pd.DataFrame) -> tuple[dict[str, statistics.Interval], pd.DataFrame]:
    """The mean rank of each row, and the cells that it is made of: those of renderings, without lacking settings."""
    rendered = cells[cells["measure"] == "rendering"]
    unsupported = set(rendered.loc[(rendered["status"] == "unsupported") & rendered["is_setting"], "axis"])
    shared = rendered[~rendered["axis"].isin(unsupported)]
    # A failed, missing or unsupported run has no shade, so it ranks last.
    shades = shared.pivot(index="axis", columns="row", values="shade").reindex(columns=cells["row"].unique())
    errors = {str(row): (1.0 - row_shades).to_dict() for row, row_shades in shades.items()}
    return statistics.rank(errors), shared


def _mark(cell: Any) -> str:
    """The mark of a cell in the heat map, see `MARKS`; "?" for a run that failed."""
    if not cell.is_measured:
        return "–" if cell.status == "unsupported" else "?"
    return "↑" if cell.rises else "×" if cell.at_once else ""


def _breakdown_texts(cell: Any, unit: str) -> tuple[str, str]:
    """The breakdown as a short text, and as a text with its interval or the failures at an end of the sweep."""
    mild, severe = (_failures(cell, end) for end in ENDS)
    low, high = ("" if math.isnan(end) else format.number(end) for end in (cell.breakdown_low, cell.breakdown_high))
    if not cell.is_measured:
        return (format.MISSING if cell.status == "unsupported" else cell.status,) * 2
    if cell.rises:
        return "rises", f"success rises with severity (mild: {mild}; severe: {severe})"
    if cell.at_once:
        return "mildest", f"breaks at the mildest ({mild}{f'; interval to {high}{unit}' if high else ''})"
    if cell.never:
        return "never", f"survives the severest ({severe}{f'; interval from {low}{unit}' if low else ''})"
    short = format.number(cell.breakdown)
    interval = "one trial" if cell.one_trial else f"{low or 'beyond'} to {high or 'beyond'}"
    return short, f"{short}{unit} ({interval})"


def failed_trials(cell: Any, end: str) -> str:
    successes, trials = (getattr(cell, f"{end}_{name}") for name in ("successes", "trials"))
    return f"{trials - successes:.0f} of {trials:.0f} trials failed"


def _failures(cell: Any, end: str) -> str:
    """The number of failed trials at an end of the sweep; with repeats, the interval of their probability too."""
    successes, trials = (getattr(cell, f"{end}_{name}") for name in ("successes", "trials"))
    if not trials > 0:
        return "not tried"
    rate = statistics.clopper_pearson(1 - successes / trials, trials)
    share = "" if cell.one_trial else f", {100 * rate.low:.0f}-{100 * rate.high:.0f} %"
    return f"{failed_trials(cell, end)}{share}"
