"""The front of error over time: completing a shape, and rendering an image, by every setting of each renderer."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any
from urllib.parse import urlencode

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from bench.pictures import style
from bench.records import format
from bench.report.data import records as of
from bench.report.data import statistics
from bench.report.data.records import SCALE, Record, Row, grouped, measured, row_of, run_key
from bench.report.data.runs import Runs, Selection, together
from bench.report.data.statistics import Groups
from bench.report.write import chart
from bench.report.write.caption import undefined
from bench.report.write.chart import panel_data, series
from bench.report.write.result import Result
from bench.report.write.table import Column, defined, shown, text, to_data, to_table

PLACE = 80
READS = (Selection("speed_completion"), Selection("speed_rendering"))
SEED = 0  # of the bootstrap
NEAR = 7  # points of a front that are nearer to each other, in points of type, have their numbers together
LEAST = 1e-9  # smaller errors are raised to this, so that their logarithms are bounded
NOTES = (
    "Left: final error of a completion over the seconds of its loop; right: depth error of one rendering (95th "
    "percentile over pixels, missed and spurious ones infinite) over its seconds.",
    "A run that did not end ok is infinite in both, and so is one that others have and a setting lacks.",
    "Filled points are on the front, numbered from the fastest; hollow ones are dominated; a cross at the edge is an "
    "infinite median; below six shapes small points are the medians of each shape.",
    "In brackets is the probability of being on the front, over 2,000 bootstrap draws of {shapes and seeds}; settings "
    "that compute the same share their times.",
)
POINT = "Filled points are on the front, hollow ones are dominated. A point opens the runs of its setting."
Line = dict[str, Any]  # of a setting
Value = Callable[[Record], float | None]
NAMES = {  # of renderers' classes, in the legend
    **{"dist": "DIST", "dvr": "DVR", "idr": "IDR", "neus": "NeuS", "volsdf": "VolSDF", "unisurf": "UNISURF"},
    **{"relaxedboundary": "Relaxed boundary", "rangeanalysis": "Range analysis", "meshproxy": "Mesh proxy"},
}


@dataclass(frozen=True)
class Trial:
    """A task of the chart: its error metric, and functions that read a run's seconds and field values."""

    title: str
    error: str
    heading: str
    seconds: Value
    values: Value


def _queries(record: Record) -> float | None:
    """The number of field values of one rendering, coarse ones included; None where the record does not have it."""
    queries = measured(record, "queries")
    return None if queries is None else queries + (measured(record, "coarse_queries") or 0)


COMPLETION = Trial(
    *("completing a shape", "chamfer_l2", "Chamfer × 1000 (scene units²)", of.loop_seconds, of.value_evaluations)
)
RENDERING = Trial(
    *("rendering an image", "error_p95", "depth error, 95th percentile × 1000 (scene units)"),
    *(lambda record: measured(record, "forward_seconds"), _queries),
)


def make(completion: Runs | None, rendering: Runs | None) -> Result:
    """A point per setting: its median error and seconds, and its probability on the front."""
    panels = {t: points(runs, t) for runs, t in ((completion, COMPLETION), (rendering, RENDERING)) if runs is not None}
    lines = [line for panel in panels.values() for line in panel]
    own = dict.fromkeys(key for line in lines for key in line if key.startswith("renderer."))
    others = 0 if rendering is None else len(rendering.records) - len(_compared(rendering, RENDERING))
    return Result(
        together(completion, rendering),
        "Error over time.",
        "Median error of each setting over its median time, over {shapes and seeds}.",
        question="What does accuracy cost in time?",
        verdict=_verdict(panels),
        interval="in the CSV, 95 % bootstrap intervals of interquartile means over {shapes and seeds}",
        estimates=[line["middle"] for line in lines],
        remarks=(
            f"Not shown: {others} renderings of another size." if others else "",
            *NOTES,
            undefined(line["on_front"] for line in lines),
        ),
        data=to_data([*COLUMNS, *map(Column, own), text("resolution")], lines),
        table=to_table(COLUMNS, lines),
        figure=draw(panels),
        chart={"panels": [_panel(trial, panel) for trial, panel in panels.items()], "note": POINT},
    )


def points(runs: Runs, trial: Trial) -> list[Line]:
    """A line per setting, in the order of their runs; x and y are where it is drawn, at the edge where infinite."""
    rows = grouped(_compared(runs, trial), row_of)
    keys = sorted({run_key(record) for records in rows.values() for record in records}, key=str)
    groups = _groups(rows, keys, trial)
    medians = np.array([[float(statistics.median(statistics.flat(g))) for g in own] for own in groups.values()])
    finite = np.isfinite(medians)
    largest = np.where(finite, medians, 0.0).max(axis=0)
    drawn = np.where(finite, medians, np.where(largest > 0, 1.5 * largest, 1.0))
    beaten = statistics.dominated(*medians.T[:2])
    chances = statistics.front([own[:2] for own in groups.values()], seed=SEED)
    lines = []
    for i, (row, (costs, errors, _)) in enumerate(groups.items()):
        records = rows[row]
        config = (records[0]["config"].get("renderer") or {}).items()
        lines.append(
            {"trial": trial.title, "setting": row.name, "renderer": of.base_renderer(records[0])}
            | dict(zip(("seconds", "error", "evaluations"), medians[i].tolist(), strict=True))
            | {"middle": statistics.bootstrap(errors, statistics.interquartile_mean, seed=SEED)}
            | {"failed": sum(record["status"] != "ok" for record in records), "runs": len(records)}
            | {"missing": len(keys) - len({*map(run_key, records)}), "resolution": _resolution(records[0])}
            | {"on_front": chances[i], "dominated": bool(beaten[i]), "infinite": not finite[i, :2].all()}
            | {"x": drawn[i, 0], "y": drawn[i, 1], "shapes": [*map(statistics.shape_medians, (costs, errors))]}
            | {f"renderer.{key}": value for key, value in config if key[0] != "_"}
        )
    return lines


def _groups(rows: dict[Row, list[Record]], keys: list[Any], trial: Trial) -> dict[Row, tuple[Groups, Groups, Groups]]:
    """The seconds, errors and field values of each row, per shape; infinite what did not end ok or is missing.

    Rows of a renderer with equal errors after equal numbers of field values compute the same: they share their times,
    or else noise would rank them.
    """
    values = (trial.seconds, lambda record: SCALE * max(of.error(record, trial.error), LEAST), trial.values)
    tables = {row: np.array([_aligned(records, keys, value) for value in values]) for row, records in rows.items()}
    found = {}
    for row, table in tables.items():
        same = [
            other
            for name, other in tables.items()
            if of.base_renderer(rows[name][0]) == of.base_renderer(rows[row][0])
            and np.array_equal(other[1:], table[1:])
            and np.isfinite(table[1:]).any()
        ]
        pooled = np.median(same or [table], axis=0)
        found[row] = tuple(of.by_shape(dict(zip(keys, quantity, strict=True))) for quantity in pooled)
    return found


def _aligned(records: list[Record], keys: list[Any], value: Value) -> list[float]:
    """A quantity of the runs in the order of the keys."""
    numbers = {run_key(record): value(record) if record["status"] == "ok" else None for record in records}
    known = {key: float(x) for key, x in numbers.items() if x is not None and not math.isnan(x)}
    return [known.get(key, math.inf) for key in keys]


def _compared(runs: Runs, trial: Trial) -> list[Record]:
    """The records, of renderings those of the most frequent size."""
    (size, _), *_ = Counter(map(_resolution, runs.records)).most_common(1)
    return [record for record in runs.records if trial is COMPLETION or _resolution(record) == size]


def _resolution(record: Record) -> int | None:
    """Pixels per side that were requested."""
    return of.setting(record["config"], "view", "resolution")


def _front(panel: list[Line]) -> list[Line]:
    """The lines on the front, from the fastest to the best."""
    return sorted(
        (point for point in panel if not (point["infinite"] or point["dominated"])), key=lambda point: point["x"]
    )


def _verdict(panels: dict[Trial, list[Line]]) -> str:
    """The ends of the front of the first trial that has one; empty where none has."""
    for trial, panel in panels.items():
        if front := _front(panel):
            ends = [
                f"{p['setting']} (*{format.seconds(p['seconds'])}*, error × 1000 {format.number(p['error'])})"
                for p in (front[0], *front[1:][-1:])
            ]
            n = len(panel[0]["shapes"][0])
            return (
                f"On the front of {trial.title}: {len(front)} of {len(panel)} settings, {' to '.join(ends)}; n = {n} "
                f"shape{'s' * (n > 1)}."
            )
    return ""


@style.styled
def draw(panels: dict[Trial, list[Line]]) -> Figure:
    """Draws a panel per trial; the settings on the front have numbers, which lead to their names below."""
    figure, (axes,) = chart.sheet(4.4, 1, len(panels))
    for axis, (trial, panel) in zip(axes, panels.items(), strict=True):
        front = _front(panel)
        for point in panel:
            how = {"marker": "x"} if point["infinite"] else {"mfc": "none"} if point["dominated"] else {}
            chart.points(axis, point["renderer"], point["x"], point["y"], ms=5, **how)
            if not point["middle"].known and len(point["shapes"][0]) > 1:
                shapes = map(style.finite, point["shapes"])
                chart.points(axis, point["renderer"], *shapes, ms=2, alpha=0.5, zorder=1.5)
        how = {"where": "post", "color": "#999999", "lw": 0.8, "zorder": 0}
        axis.step([point["x"] for point in front], [point["y"] for point in front], **how)
        for letter in ("x", "y"):
            style.log_axis(axis, letter, [point[letter] for point in panel])
        axis.margins(x=0.08, y=0.1)
        axis.set(xlabel="time (seconds)", ylabel=trial.heading, title=trial.title)
        names = [axis.plot([], [], ls="none", label=f"{i} {_name(point)}")[0] for i, point in enumerate(front, 1)]
        below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.16), "ncols": 2}
        axis.legend(handles=names, **below, handlelength=0, handletextpad=0, fontsize=6)
    looks = {point["renderer"]: style.look(point["renderer"]) for panel in panels.values() for point in panel}
    handles = {name: Line2D([], [], color=look.colour, marker=look.marker, ls="none") for name, look in looks.items()}
    style.legend_of(figure, {NAMES.get(name, name.capitalize()): drawn for name, drawn in handles.items()}, columns=5)
    for axis, panel in zip(axes, panels.values(), strict=True):
        _number(axis, [(point["x"], point["y"]) for point in _front(panel)])
    return figure


def _number(axis: Axes, front: list[tuple[float, float]]) -> None:
    """Numbers the points of a front, each below and left of its point, where no point can be; near ones together."""
    if not front:
        return
    axis.figure.draw_without_rendering()  # places the axes
    places = axis.transData.transform(front) * 72 / axis.figure.dpi  # in points of type
    far = [0, *(i for i in range(1, len(places)) if np.abs(places[i] - places[i - 1]).max() > NEAR), len(places)]
    for first, last in pairwise(far):
        told = f"{first + 1}" if last == first + 1 else f"{first + 1}–{last}"
        how = {"textcoords": "offset points", "ha": "right", "va": "top", "fontsize": 6}
        axis.annotate(told, front[first], (-2, -3), **how)


def _name(point: Line) -> str:
    """The setting, and the probability of being on the front where there is one."""
    return point["setting"] + ("" if math.isnan(point["on_front"]) else f" ({point['on_front']:.2f})")


def _panel(trial: Trial, panel: list[Line]) -> dict[str, Any]:
    """A series per renderer of what is on the front, one of what is dominated, and the line of the front."""
    drawn, finite = [], [point for point in panel if not point["infinite"]]
    for (renderer, dominated), own in grouped(finite, lambda p: (p["renderer"], p["dominated"])).items():
        look = {"text": [*map(_hover, own)], "link": [_runs_of(p["setting"]) for p in own], "size": 11}
        look |= {"hollow": True} if dominated else {}
        drawn.append(series(renderer, renderer, *([p[at] for p in own] for at in "xy"), **look))
    line = {"colour": "#888888", "symbol": "", "dash": "-", "step": True, "quiet": True}
    drawn.append(series("front", "", *([p[at] for p in _front(panel)] for at in "xy"), **line))
    return panel_data(trial.title, "time (seconds)", trial.heading, drawn, height=440)


def _runs_of(setting: str) -> str:
    """The address of the runs of a setting in the page's list."""
    return "#/runs?" + urlencode({"task": "all", "view": "runs", "q": setting})


def _hover(point: Line) -> list[str]:
    """What the mouse is told of a setting."""
    costs = f"{format.seconds(point['seconds'])}, error × 1000 {format.number(point['error'])}"
    chance = point["on_front"]
    known = [] if math.isnan(chance) else [f"on the front with probability {chance:.2f}"]
    return [point["setting"], costs, f"failed {_failed(point)}", *known]


def _failed(line: Line) -> str:
    return f"{line['failed']} of {line['runs']}" + (f", {line['missing']} missing" if line["missing"] else "")


COLUMNS = (  # of a line
    *(text("trial", "Trial"), text("setting", "Setting"), text("renderer")),
    *(Column("seconds", "Time", show=format.seconds), Column("evaluations", "Evaluations", show=format.count)),
    *(Column("error", "Error × 1000"), Column("error_iqm", value=lambda line: line["middle"].value)),
    *(Column(f"error_{end}", value=lambda line, end=end: getattr(line["middle"], end)) for end in ("low", "high")),
    *(*map(Column, ("failed", "runs", "missing")), shown("Failed", _failed)),
    *(Column("on_front", "P(on the front)", show=defined), Column("dominated")),
)

PAGES = {"speed_front": make}
