"""The front of error against time, with how probably each setting is on it, and what each renderer dominates."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.report import format, interactive, statistics, style
from bench.report.caption import joined, omitted, setup
from bench.report.experiments import Experiment, setting
from bench.report.speed import SEED, TRIALS, Setting, Trial, evaluations, settings
from bench.report.tables import Result


def make(experiment: Experiment) -> Result:
    """A point a setting: median error against median seconds, and how probably it is on the front."""
    found = [(trial, settings(experiment, trial)) for trial in TRIALS]
    found = [(trial, rows) for trial, rows in found if rows]
    chances = {
        trial.task: statistics.front([(row.costs, row.errors) for row in rows], seed=SEED) for trial, rows in found
    }
    data = [
        _front_row(row, chance, inside)
        for trial, rows in found
        for row, chance, inside in zip(rows, chances[trial.task], _dominated(rows), strict=True)
    ]
    table = [
        [
            row["trial"],
            row["setting"],
            format.seconds(row["seconds"]),
            format.count(row["evaluations"]),
            format.number(row["error"]),
            f"{row['failed']} of {row['runs']}",
            format.number(row["on_front"]),
        ]
        for row in data
    ]
    columns = ["Trial", "Setting", "Time", "Evaluations", "Error × 1000", "Failed", "P(on the front)"]
    return Result(
        name="speed_front",
        title="Error against the time that it takes.",
        caption=joined(
            setup(experiment),
            "Medians over shapes and seeds: error at the end of a completion against the seconds of its loop, and "
            "depth error of one rendering against its seconds. A run that did not end ok is infinite in both; a "
            "setting whose median is, stands at the right edge. Filled points are on the front, hollow ones dominated. "
            "The probability of being on the front is over 2,000 bootstrap draws of shapes and seeds, the same for all "
            "settings.",
            omitted(experiment),
        ),
        data=pd.DataFrame(data, dtype=object),
        table=pd.DataFrame(table, columns=columns),
        figure=draw_front(found, chances),
        page=interactive.front(found, chances),
    )


@style.styled
def draw_front(found: list[tuple[Trial, list[Setting]]], chances: dict[str, list[float]]) -> Figure:
    """A panel a trial."""
    figure = Figure(figsize=(style.WIDTH, 3.9), layout="constrained")
    axes = figure.subplots(1, len(found), squeeze=False)[0]
    for axis, (trial, rows) in zip(axes, found, strict=True):
        points = np.array([row.point for row in rows])
        edge = _edge(points)
        inside = _dominated(rows)
        for row, point, hollow, chance in zip(rows, points, inside, chances[trial.task], strict=True):
            look = style.look(row.renderer)
            lost = not np.isfinite(point).all()
            x, y = np.where(np.isfinite(point), point, edge)
            fill = "none" if hollow or lost else look.colour
            axis.plot(x, y, "x" if lost else look.marker, color=look.colour, mfc=fill, ls="none", ms=5)
            if not hollow or lost:
                note = row.name.removeprefix(f"{row.renderer}, ") + ("" if lost else f" ({chance:.2f})")
                axis.annotate(note, (x, y), xytext=(3, 3), textcoords="offset points", fontsize=5.5)
        _step(axis, points[~inside & np.isfinite(points).all(axis=1)])
        for letter, values in (("x", points[:, 0]), ("y", points[:, 1])):
            style.log_axis(axis, letter, values)
        axis.set(xlabel="time (seconds)", ylabel=trial.heading, title=trial.title)
    for renderer in dict.fromkeys(row.renderer for _, rows in found for row in rows):
        look = style.look(renderer)
        axes[0].plot([], [], look.marker, color=look.colour, ls="none", label=renderer)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5)
    return figure


def _front_row(row: Setting, chance: float, inside: bool) -> dict[str, Any]:
    cost, error = row.point
    asked = [evaluations(record) for record in row.records if record["status"] == "ok"]
    known = [x for x in asked if x is not None]
    spread = statistics.bootstrap(row.errors, statistics.interquartile_mean, seed=SEED)
    config = row.records[0]["config"]
    return {
        **{"trial": row.trial.title, "setting": row.name, "renderer": row.renderer},
        **{"seconds": cost, "evaluations": float(np.median(known)) if known else None, "error": error},
        **{"error_iqm": spread.value, "error_low": spread.low, "error_high": spread.high},
        **{"failed": row.failed, "runs": len(row.records), "on_front": chance, "dominated": bool(inside)},
        **{f"renderer.{key}": value for key, value in (config.get("renderer") or {}).items() if key[0] != "_"},
        "resolution": setting(config, "view", "resolution"),
    }


def _dominated(rows: list[Setting]) -> np.ndarray:
    costs, errors = np.array([row.point for row in rows]).T
    return statistics.dominated(costs, errors) | ~np.isfinite(costs) | ~np.isfinite(errors)


def _edge(points: np.ndarray) -> np.ndarray:
    """Where what is infinite is drawn: a little beyond the largest finite values."""
    finite = np.where(np.isfinite(points), points, 0.0).max(axis=0)
    return np.where(finite > 0, 1.5 * finite, 1.0)


def _step(axis: Axes, points: np.ndarray) -> None:
    ordered = points[np.argsort(points[:, 0])]
    if len(ordered):
        axis.step(ordered[:, 0], ordered[:, 1], where="post", color="#999999", lw=0.8, zorder=0)


def volume(experiment: Experiment) -> Result:
    """The area that each renderer's settings dominate, with its interval."""
    data = []
    for trial in TRIALS:
        rows = settings(experiment, trial)
        finite = np.array([row.point for row in rows if np.isfinite(row.point).all()])
        if not len(finite):
            continue
        reference = tuple(float(x) for x in 2 * finite.max(axis=0))
        for renderer in dict.fromkeys(row.renderer for row in rows):
            points = [(row.costs, row.errors) for row in rows if row.renderer == renderer]
            area = statistics.hypervolume_interval(points, reference=reference, seed=SEED)
            where = {"reference_seconds": reference[0], "reference_error": reference[1]}
            numbers = {"hypervolume": area.value, "low": area.low, "high": area.high}
            data.append({"trial": trial.title, "renderer": renderer, "settings": len(points), **numbers, **where})
    table = [
        [
            row["trial"],
            row["renderer"],
            str(row["settings"]),
            format.number(row["hypervolume"]),
            format.interval(row["low"], row["high"]),
        ]
        for row in data
    ]
    return Result(
        name="speed_volume",
        title="How much of the plane of error and time each renderer reaches.",
        caption=joined(
            setup(experiment),
            "Area dominated by the medians of a renderer's settings, in powers of ten of seconds times powers of ten "
            "of error, up to twice the largest finite median of either; larger is better. More settings can only add "
            "to it. 95 % bootstrap intervals over shapes and seeds.",
            omitted(experiment),
        ),
        data=pd.DataFrame(data, dtype=object),
        table=pd.DataFrame(table, columns=["Trial", "Renderer", "Settings", "Hypervolume", "95 % interval"]),
    )
