"""The front of error against time, with how probably each setting is on it, and what each renderer dominates."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bench.report import format, interactive, statistics, style
from bench.report.caption import joined, omitted, setup
from bench.report.experiments import Experiment, setting
from bench.report.speed import SEED, TRIALS, Placed, Setting, Trial, front_line, left_out, settings, sizes
from bench.report.tables import Result


def make(experiment: Experiment) -> Result:
    """A point a setting: median error against median seconds, and how probably it is on the front."""
    panels = [place(trial, settings(experiment, trial)) for trial in TRIALS]
    panels = [panel for panel in panels if panel]
    data = [_row(point) for panel in panels for point in panel]
    table = [
        [
            row["trial"],
            row["setting"],
            format.seconds(row["seconds"]),
            format.count(row["evaluations"]),
            format.number(row["error"]),
            f"{row['failed']} of {row['runs']}" + (f", {row['missing']} missing" if row["missing"] else ""),
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
            sizes(experiment),
            "Medians over shapes and seeds: error at the end of a completion against the seconds of its loop, and "
            "depth error of one rendering (95 % of the reference's pixels have less, lost ones are infinite) against "
            "its seconds. A run that did not end ok is infinite in both. Filled points are on the front, hollow ones "
            "are dominated, and a cross stands at the edge for a median that is infinite. In brackets and in the last "
            "column, the probability of being on the front, over 2,000 bootstrap draws of shapes and seeds, the same "
            "for all settings. A run that others have and a setting lacks is infinite, too. Settings that differ in "
            "what only an optimisation uses render alike; chance decides between them.",
            left_out(experiment),
            omitted(experiment),
        ),
        data=pd.DataFrame(data, dtype=object),
        table=pd.DataFrame(table, columns=columns),
        figure=draw(panels),
        page=interactive.front(panels),
    )


def place(trial: Trial, rows: list[Setting]) -> list[Placed]:
    """Where the settings of a trial stand in the chart; what is infinite stands a little beyond all else."""
    if not rows:
        return []
    points = np.array([row.point for row in rows])
    finite = np.isfinite(points)
    largest = np.where(finite, points, 0.0).max(axis=0)
    shown = np.where(finite, points, np.where(largest > 0, 1.5 * largest, 1.0))
    beaten = statistics.dominated(*points.T)
    chances = statistics.front([(row.costs, row.errors) for row in rows], seed=SEED)
    return [
        Placed(row, float(x), float(y), lost=not sound, dominated=bool(inside), chance=chance)
        for row, (x, y), sound, inside, chance in zip(rows, shown, finite.all(axis=1), beaten, chances, strict=True)
    ]


@style.styled
def draw(panels: list[list[Placed]]) -> Figure:
    """A panel a trial."""
    figure = Figure(figsize=(style.WIDTH, 3.9), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for axis, panel in zip(axes, panels, strict=True):
        middle = np.exp(np.mean(np.log([min(point.x for point in panel), max(point.x for point in panel)])))
        for number, point in enumerate(sorted(panel, key=lambda point: point.x)):
            look = style.look(point.row.renderer)
            fill = look.colour if point.on_front else "none"
            axis.plot(
                point.x, point.y, "x" if point.lost else look.marker, color=look.colour, mfc=fill, ls="none", ms=5
            )
            how = {"textcoords": "offset points", "fontsize": 5.5}
            if point.lost:
                axis.annotate(point.label, (point.x, point.y), (2, 4), rotation=30, **how)
            elif point.on_front:
                side = "left" if point.x < middle else "right"
                at = (4 if side == "left" else -4, 4 if number % 2 else -8)
                axis.annotate(point.label, (point.x, point.y), at, ha=side, **how)
        line = front_line(panel)
        axis.step(
            [point.x for point in line], [point.y for point in line], where="post", color="#999999", lw=0.8, zorder=0
        )
        trial = panel[0].row.trial
        for letter in ("x", "y"):
            style.log_axis(axis, letter, [getattr(point, letter) for point in panel])
        axis.margins(x=0.08, y=0.1)
        axis.set(xlabel="time (seconds)", ylabel=trial.heading, title=trial.title)
    for renderer in dict.fromkeys(point.row.renderer for panel in panels for point in panel):
        look = style.look(renderer)
        axes[0].plot([], [], look.marker, color=look.colour, ls="none", label=renderer)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5)
    return figure


def _row(point: Placed) -> dict[str, Any]:
    row = point.row
    cost, error = row.point
    spread = statistics.bootstrap(row.errors, statistics.interquartile_mean, seed=SEED)
    config = row.records[0]["config"]
    return {
        **{"trial": row.trial.title, "setting": row.name, "renderer": row.renderer},
        **{"seconds": cost, "evaluations": float(statistics.median(np.concatenate(row.evaluations)))},
        "error": error,
        **{"error_iqm": spread.value, "error_low": spread.low, "error_high": spread.high},
        **{"failed": row.failed, "runs": len(row.records), "missing": row.missing},
        **{"on_front": point.chance, "dominated": point.dominated},
        **{f"renderer.{key}": value for key, value in (config.get("renderer") or {}).items() if key[0] != "_"},
        "resolution": setting(config, "view", "resolution"),
    }


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
            sizes(experiment),
            "Area dominated by the medians of a renderer's settings, in powers of ten of seconds times powers of ten "
            "of error, up to twice the largest finite median of either; larger is better. More settings can only add "
            "to it: it does not rank renderers with different numbers of settings. 95 % bootstrap intervals over "
            "shapes and seeds.",
            omitted(experiment),
        ),
        data=pd.DataFrame(data, dtype=object),
        table=pd.DataFrame(table, columns=["Trial", "Renderer", "Settings", "Hypervolume", "95 % interval"]),
    )
