"""Savings of `field=auto` over the papers' network, and of a fit at pixel precision over the plain fit."""

from collections.abc import Callable
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.pictures.size_chart import KINDS
from bench.records import format
from bench.report.data.experiments import Experiment
from bench.report.data.subjects import parsimony
from bench.report.data.subjects.parsimony import (
    COSTS,
    FAILED,
    NOT_REACHED,
    PARSIMONY,
    REACHED,
    SceneRun,
    factor,
    measure_note,
    scene_runs,
)
from bench.report.pages.parsimony.parsimony import SCENE, scene_table
from bench.report.write import chart
from bench.report.write.answer import Answer
from bench.report.write.result import Result
from bench.report.write.table import Column, percent, text, thousandfold, to_data

PLACE = 190
READS = (PARSIMONY,)
TARGET = 2.0  # largest overhead of field=auto by design
NOTES = (
    "field=auto tries candidates in order of size, as long as the held-out error falls; its costs are those of all "
    f"that it tried. Its overhead is their seconds over those of its final fit, about {TARGET:g} at most by design; "
    "with evaluation: including the evaluations of held-out rays on which it decides, and the start of each fit. The "
    "choice among all candidates costs the fits of all.",
    "The papers' network (8 layers of 512, without a code): its costs at the first checkpoint with the error of "
    "field=auto, or less than a standard error more. Checkpoints are after the warm start, 4, 16, 64, … iterations and "
    "the end, and their cost is not counted; the network starts from the best smaller candidate, whose cost is not "
    "counted either.",
    "“Not reached”: the network did not have this error by the end of its fit; the cost of the whole fit is in "
    "brackets and is a lower bound of the ratios, which are the network's costs over those of field=auto; – is where "
    "it was not fitted.",
    "Pixel precision: the recommended candidate fitted again with renderer.epsilon=auto, renderer.steps=auto and a "
    "number of rays that follows the loss, over its plain fit; errors in half pixels. Both fits are evaluated at the "
    "renderer's configured precision. Right: a triangle is hollow where the error is above half a pixel.",
    "Rendering: the held-out rays of the recommended candidate rendered at pixel precision, over the configured "
    "epsilon and steps; hits of only the latter are missed, of only the former gained: with a larger epsilon outlines "
    "grow by up to half a pixel.",
)
AUTO, EVALUATIONS, ERROR = ("#111111", "o"), ("#6a3d9a", "D"), ("#cc79a7", "^")  # colour and marker
LABELS = {  # labels of the papers' network
    REACHED: "papers' network",
    NOT_REACHED: "papers' network, not reached in its fit",
    FAILED: "papers' network, fit failed",
}
_HOLLOW: dict[str, Any] = {"mfc": "none", "mew": 1.1}


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per scene."""
    runs = scene_runs(experiment)
    return Result(
        experiment,
        "Savings of field=auto and of pixel precision.",
        "Costs of field=auto and of the papers' network to the same error, and costs and error of a fit at pixel "
        "precision over those of the plain fit.",
        interval="± is one standard error, by the jackknife over views",
        remarks=(_held(runs), measure_note(runs), *NOTES, *parsimony.failures(runs, _failed)),
        data=to_data(COLUMNS, runs),
        table=scene_table(COLUMNS, runs),
        figure=draw(runs),
    )


def _held(runs: list[SceneRun]) -> str:
    """The number of scenes on which field=auto kept its budget, without and with evaluation, as a note."""
    known = [run for run in runs if run.number("auto.overhead") is not None]
    names = ("auto.overhead", "auto.overhead_judged")
    held = [sum((run.number(name) or 0) <= TARGET for run in known) for name in names]
    return f"The overhead is at most {TARGET:g} on {held[0]} of {len(known)} scenes; with evaluation, on {held[1]}."


@style.styled
def draw(runs: list[SceneRun]) -> Figure:
    """Draws, left, operations of field=auto and the network to the same error; right, the fit at pixel precision."""
    figure, ((left, right),) = chart.sheet(0.24 * len(runs) + 1.5, 1, 2, sharey=True, width_ratios=(1.25, 1))
    for place, run in enumerate(runs):
        if run.ok:
            _operations(left, run, place)
            _precision(right, run, place)
        else:
            _note(left, place, run.status)
    reach = [x for run in runs for x in (run.number("auto.flops"), run.network["flops"]) if x]
    style.log_axis(left, "x", reach)
    ratios = [run.get(f"frugal_over_plain.{name}") for run in runs for name in ("evaluations", "error")]
    style.log_axis(right, "x", [x for x in ratios if x])
    left.margins(x=0.1)
    right.axvline(1, color="#777777", lw=0.9)
    left.set(xlabel="FLOPs to the error of field=auto", ylim=(len(runs) - 0.5, -0.5))
    right.set(xlabel="fit at pixel precision / plain fit")
    left.set_yticks(range(len(runs)), [run.name for run in runs])
    for axis, side, columns in ((left, "left", 2), (right, "right", 1)):
        named = dict(sorted(style.labelled(axis).items()))
        style.legend_of(figure, named, columns=columns, side=side)
    return figure


def _operations(axis: Axes, run: SceneRun, place: int) -> None:
    auto, network = run.number("auto.flops"), run.network["flops"]
    if not run.state or auto is None:
        return _note(axis, place, f"field=auto failed: {run.failure('auto')}")
    _, colour, marker = KINDS["network"]
    if network is None:
        _note(axis, place, "network not fitted")
    else:
        axis.plot([auto, network], [place, place], color="#bbbbbb", lw=1, zorder=1)
        label = LABELS[run.state]
        how = {} if run.state == REACHED else _HOLLOW
        axis.plot(network, place, marker if run.state != FAILED else "x", color=colour, ls="none", label=label, **how)
    if run.state == NOT_REACHED:
        arrow = {"arrowstyle": "<-", "color": colour, "lw": 0.9, "shrinkA": 0, "shrinkB": 3}
        axis.annotate("", (network, place), (14, 0), textcoords="offset points", arrowprops=arrow)
    axis.plot(auto, place, AUTO[1], color=AUTO[0], ls="none", label="field=auto, all trials")
    return None


def _precision(axis: Axes, run: SceneRun, place: int) -> None:
    evaluations, error = (run.get(f"frugal_over_plain.{name}") for name in ("evaluations", "error"))
    if evaluations is None or error is None:
        return _note(axis, place, f"fit at pixel precision failed: {run.failure('frugal')}")
    axis.plot([evaluations, error], [place, place], color="#bbbbbb", lw=1, zorder=1)
    axis.plot(evaluations, place, EVALUATIONS[1], color=EVALUATIONS[0], ls="none", label="evaluations")
    above = (run.errors[1] or 0) > 1
    label = f"error, {'above' if above else 'under'} half a pixel"
    axis.plot(error, place, ERROR[1], color=ERROR[0], ls="none", ms=5, label=label, **(_HOLLOW if above else {}))
    return None


def _note(axis: Axes, place: int, text: str) -> None:
    """Writes a text above a scene's line."""
    how = {"xycoords": axis.get_yaxis_transform(), "textcoords": "offset points", "ha": "right", "va": "bottom"}
    axis.annotate(text, (0.99, place), (0, 4), fontsize=6, color="#666666", **how)


def _network(cost: str, show: Callable[[Any], str]) -> Callable[[SceneRun], str]:
    """The text of the network's cost, with its state where it did not reach the error."""

    def words(run: SceneRun) -> str:
        spent = show(run.network[cost])
        return f"{run.state} ({spent})" if run.state in (NOT_REACHED, FAILED) else spent

    return words


def _ratio(cost: str) -> Callable[[SceneRun], str]:
    return lambda run: factor(run.ratios[f"ratio.{cost}"], above=run.state == NOT_REACHED)


def _auto_error(run: SceneRun) -> str:
    return parsimony.spread(run.number("auto.error"), run.number("auto.standard_error"))


def _errors(run: SceneRun) -> str:
    plain, pixel_precise = run.errors
    return f"{format.number(plain)}, {run.failure('frugal') or format.number(pixel_precise)}"


def _field(name: str | None) -> str:
    return (name or format.MISSING).replace("_", " ")


def _failed(run: SceneRun) -> dict[str, str | None]:
    fits = {"field=auto": "auto", "the fit at pixel precision": "frugal", "the papers' network": parsimony.NETWORK}
    return {fit: run.get(f"{name}.failed") for fit, name in fits.items()}


COLUMNS = (  # of a run
    *SCENE,
    Column("auto.field", "Choice of field=auto", show=_field),
    *(Column("auto.error", "Error × 1000", words=_auto_error), Column("auto.standard_error")),
    Column("recommended_field", "Recommended among all", show=_field),
    Column("recommended_error", "Its error × 1000", show=thousandfold),
    Column("footprint", "Half a pixel × 1000", show=thousandfold),
    Column("auto.seconds", "Seconds", show=format.seconds),
    Column("auto.flops", "FLOPs", show=format.count),
    Column("auto.evaluations", "Evaluations", show=format.count),
    *(Column("auto.overhead", "Overhead"), Column("auto.overhead_judged", "Overhead with evaluation")),
    text("network", value=lambda run: run.state),
    Column("network.seconds", "Network: seconds", words=_network("seconds", format.seconds)),
    Column("network.flops", "Network: FLOPs", words=_network("flops", format.count)),
    Column("network.evaluations", "Network: evaluations", words=_network("evaluations", format.count)),
    Column("ratio.seconds", "Ratio of seconds", words=_ratio("seconds")),
    *(Column("ratio.flops", "Ratio of FLOPs", words=_ratio("flops")), Column("ratio.evaluations")),
    *(Column(f"frugal.{name}") for name in ("standard_error", *COSTS)),
    Column("frugal_over_plain.evaluations", "Pixel precision: evaluations", show=factor),
    Column("frugal_over_plain.seconds", "Pixel precision: seconds", show=factor),
    Column("frugal_over_plain.error"),
    Column("frugal.error", "Error in half pixels: plain, pixel precision", words=_errors),
    Column("precision.saved", "Rendering: evaluations saved", show=percent),
    *(Column("precision.evaluations"), Column("precision.evaluations_auto")),
    Column("precision.lost", "Hits missed", show=format.count),
    Column("precision.gained", "Hits gained", show=format.count),
    Column("precision.hits", "Hits", show=format.count),
)


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The overhead of the choice, and what pixel precision saves."""
    known = data["auto.overhead"].dropna()
    if not len(known):
        return Answer("What does field=auto cost?")
    said = (
        f"field=auto takes *{format.number(float(known.median()))}* times the seconds of its final fit (median; "
        f"at most {format.number(float(known.max()))})"
    )
    saved = data["frugal_over_plain.evaluations"].dropna()
    rest = (
        f"; pixel precision needs {format.number(float(saved.median()))} times the field values of a plain fit"
        if len(saved)
        else ""
    )
    return Answer("What does field=auto cost, and what does pixel precision save?", f"{said}{rest}.")
