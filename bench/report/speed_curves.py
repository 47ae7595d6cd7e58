"""Error over time and evaluations, the time to a target, and whether the loss tells of the error."""

import math
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import spearmanr

from bench.report import curves, format, interactive, statistics, style
from bench.report.caption import joined, omitted, setup
from bench.report.experiments import Experiment, family, identity, measured
from bench.report.speed import SCALE, SEED, TARGET, TRIALS, Setting, own, seconds, settings, shape_of, sizes
from bench.report.tables import Result

ALONG = {"seconds": "time (seconds)", "value_evaluations": "field values"}
Reached = tuple[float, bool]  # seconds, and whether that is when the target was reached


def make(experiment: Experiment) -> Result:
    """Error over seconds and over evaluations, and the share of runs that have not reached the target yet."""
    rows = settings(experiment, TRIALS[0])
    shown = {row.name: [_course(experiment, record) for record in row.records] for row in rows}
    data = []
    for row in rows:
        for record, course in zip(row.records, shown[row.name], strict=True):
            data += [{**identity(record), "family": family(record), **point} for point in course.to_dict("records")]
    times = {row.name: [_time_to(course, record) for course, record in _pairs(shown, row)] for row in rows}
    table = []
    for row in rows:
        reached = [time for time, hit in times[row.name] if hit]
        table.append(
            [
                row.name,
                str(len(row.records)),
                str(len(reached)),
                format.seconds(float(np.median(reached))) if reached else "–",
            ]
        )
    return Result(
        name="speed_curves",
        title="Error over time and over evaluations.",
        caption=joined(
            setup(experiment),
            sizes(experiment),
            "Left and middle: Chamfer distance times 1000 on the way, medians over the runs of each renderer's own "
            "setting; bands hold the middle half. A run that did not end ok is infinite past its end. Right: the share "
            f"of runs not yet at {SCALE * TARGET:g} × 10⁻³ (Kaplan and Meier); a run that ended above it is censored, "
            "one that failed stays to the end. "
            "The table has all settings, "
            "and the median time of the runs that reached it.",
            omitted(experiment),
        ),
        data=pd.DataFrame(data, dtype=object),
        table=pd.DataFrame(table, columns=["Setting", "Runs", "Reached", "Median time of these"]),
        figure=draw_curves(own(rows), shown, times),
        page=interactive.curves(rows, shown),
    )


@style.styled
def draw_curves(rows: list[Setting], shown: dict[str, list[pd.DataFrame]], times: dict[str, list[Reached]]) -> Figure:
    """Error over seconds, over evaluations, and survival."""
    figure = Figure(figsize=(style.WIDTH, 2.9), layout="constrained")
    axes = figure.subplots(1, 3)
    for axis, (along, label) in zip(axes, ALONG.items(), strict=False):
        everything: list[float] = []
        for row in rows:
            where, low, middle, high = band(shown[row.name], [r["status"] != "ok" for r in row.records], along)
            look = style.look(row.renderer)
            axis.plot(where, style.finite(middle), color=look.colour, ls=look.line, label=row.name)
            axis.fill_between(where, style.finite(low), style.finite(high), color=look.colour, alpha=0.15, lw=0)
            everything += [*where]
        style.log_axis(axis, "x", everything)
        style.log_axis(axis, "y", [x for row in rows for course in shown[row.name] for x in course["error"]])
        axis.set(xlabel=label, ylabel=TRIALS[0].heading)
    _survival(axes[2], {row: times[row.name] for row in rows})
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5)
    return figure


def _survival(axis: Axes, times: dict[Setting, list[Reached]]) -> None:
    """The share of each row's runs that are not at the target yet; a tick where one ended before it got there."""
    known = [time for row in times.values() for time, _ in row if math.isfinite(time)]
    latest = max(known, default=1.0)
    for row, reached in times.items():
        look = style.look(row.renderer)
        left = survival(reached, latest)
        end = max(min(time, latest) for time, _ in reached)
        where, share = np.append(left.times, end), np.append(left.remaining, left.remaining[-1])
        axis.step(where, share, where="post", color=look.colour)
        ticks = [time for time, hit in reached if not hit and math.isfinite(time)]
        at = [left.remaining[np.searchsorted(left.times, time, side="right") - 1] for time in ticks]
        axis.plot(ticks, at, "|", color=look.colour, ms=6)
    axis.set(xlabel="time (seconds)", ylabel=f"share not yet at {SCALE * TARGET:g}", ylim=(-0.03, 1.03))
    style.log_axis(axis, "x", known)


def survival(reached: list[Reached], latest: float) -> statistics.Survival:
    """Kaplan and Meier's curve of runs, of which those with an infinite time, which failed, stay to the latest."""
    return statistics.kaplan_meier([min(time, latest) for time, _ in reached], [hit for _, hit in reached])


def band(
    runs: list[pd.DataFrame], failed: list[bool], along: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Places, and the quartiles of the error there: a run's error is that of its last look, infinite before the first
    and past the end of a run that failed."""
    ends = [run[along].iloc[-1] for run in runs if len(run)]
    starts = [run[along][run[along] > 0].min() for run in runs if len(run) > 1]
    if not starts:
        return (np.empty(0),) * 4
    where = np.geomspace(min(starts), max(ends), 60)
    values = np.full((len(runs), len(where)), np.inf)
    for row, (run, over) in enumerate(zip(runs, failed, strict=True)):
        last = np.searchsorted(run[along].to_numpy(), where, side="right") - 1
        known = last >= 0
        values[row, known] = run["error"].to_numpy()[last[known]]
        if over and len(run):
            values[row, where > run[along].iloc[-1]] = np.inf
    low, high = (np.quantile(values, q, axis=0, method="nearest") for q in (0.25, 0.75))
    return where, low, np.median(values, axis=0), high


def _course(experiment: Experiment, record: dict[str, Any]) -> pd.DataFrame:
    """A run's error over seconds and evaluations: its looks on the way, and the end.

    A line of a curve tells of the parameters before its step, but of the costs after it: the costs of the line before
    are what the look had cost.
    """
    lines = curves.read(experiment.folder(record))[0].sort_values("iteration")
    costs = lines[["seconds", "value_evaluations"]].shift(1, fill_value=0.0)
    course = costs.assign(iteration=lines["iteration"], error=SCALE * lines["chamfer_l2"], loss=lines["total"])
    course = course.dropna(subset=["error"])
    if record["status"] == "ok" and len(lines) and (error := measured(record, "chamfer_l2")) is not None:
        last = lines.iloc[-1]
        end = {"seconds": last["seconds"], "value_evaluations": last["value_evaluations"]}
        end |= {"iteration": last["iteration"] + 1, "error": SCALE * error, "loss": math.nan}
        course = pd.concat([course, pd.DataFrame([end])], ignore_index=True)
    return course[["iteration", "seconds", "value_evaluations", "error", "loss"]]


def _pairs(shown: dict[str, list[pd.DataFrame]], row: Setting) -> Any:
    return zip(shown[row.name], row.records, strict=True)


def _time_to(course: pd.DataFrame, record: dict[str, Any]) -> Reached:
    """When a run was first seen at the target; or else when it ended, and infinite where it failed or was not run.

    A run that failed would never have come there: it stays among those that have not, to the end.
    """
    if record["status"] != "ok":
        return math.inf, False
    below = course[course["error"] <= SCALE * TARGET]
    if len(below):
        return float(below["seconds"].iloc[0]), True
    return seconds(record) or 0.0, False


def correlation(experiment: Experiment) -> Result:
    """Whether the loss tells of the error: rank correlation over the looks of each run, and over all runs of a row."""
    rows = settings(experiment, TRIALS[0])
    data, clouds = [], {}
    for row in rows:
        courses = [_course(experiment, record).dropna() for record in row.records]
        within: dict[Any, list[float]] = {}
        for record, course in zip(row.records, courses, strict=True):
            if (rho := _spearman(course)) is not None:
                within.setdefault(shape_of(record), []).append(rho)
        together = pd.concat(courses, ignore_index=True)
        clouds[row.name] = together
        groups = [np.array(values) for values in within.values()]
        spread = statistics.bootstrap(groups, statistics.median, seed=SEED) if groups else None
        numbers = {"within": spread.value, "low": spread.low, "high": spread.high} if spread else {}
        pooled = {"together": _spearman(together), "looks": len(together), "runs": sum(map(len, groups))}
        data.append({"row": row.name, "renderer": row.renderer, **numbers, **pooled})
    table = [
        [
            row["row"],
            str(row["runs"]),
            format.number(row.get("within")),
            format.interval(row.get("low"), row.get("high")),
            format.number(row["together"]),
        ]
        for row in data
    ]
    return Result(
        name="loss_chamfer",
        title="Does the loss tell of the Chamfer distance?",
        caption=joined(
            setup(experiment),
            sizes(experiment),
            "Spearman's rank correlation of loss and Chamfer distance over the looks on the way: within each run, the "
            "median over runs with its 95 % bootstrap interval, and over the looks of all runs of a row together "
            "(DIST, Fig. 5, right, shows such a cloud). Looks of one run follow each other: no test of significance.",
            omitted(experiment),
        ),
        data=pd.DataFrame(data, dtype=object),
        table=pd.DataFrame(table, columns=["Setting", "Runs", "Within a run", "95 % interval", "All together"]),
        figure=draw_correlation(own(rows), clouds),
    )


@style.styled
def draw_correlation(rows: list[Setting], clouds: dict[str, pd.DataFrame]) -> Figure:
    """Loss against error of each renderer's own setting."""
    figure = Figure(figsize=(style.WIDTH * 0.6, 3.0), layout="constrained")
    axis = figure.subplots()
    for row in rows:
        look, cloud = style.look(row.renderer), clouds[row.name]
        axis.plot(
            cloud["loss"], cloud["error"], look.marker, color=look.colour, ls="none", ms=3, alpha=0.7, label=row.name
        )
    for letter, column in (("x", "loss"), ("y", "error")):
        style.log_axis(axis, letter, [x for row in rows for x in clouds[row.name][column]])
    axis.set(xlabel="weighted loss", ylabel=TRIALS[0].heading)
    figure.legend(loc="outside right upper")
    return figure


def _spearman(cloud: pd.DataFrame) -> float | None:
    varied = len(cloud) > 2 and all(cloud[column].nunique() > 1 for column in ("loss", "error"))
    return float(spearmanr(cloud["loss"], cloud["error"]).statistic) if varied else None
