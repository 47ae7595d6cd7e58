"""What tuning is worth: the expected test error of the best of some draws, and what each setting changes."""

from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report.compare import CHAMFER
from bench.report.data import statistics
from bench.report.data.experiments import Experiment
from bench.report.data.subjects.tuning import TUNING, Tuning, left_out, tunings, unfinished
from bench.report.write import chart
from bench.report.write.answer import Answer
from bench.report.write.result import Result
from bench.report.write.table import (
    FAMILY,
    IDENTITY,
    LOOP,
    Column,
    configured,
    metrics,
    text,
    to_data,
    to_table,
    whole,
    word,
)

PLACE = 36
PLACE_SETTINGS = 37
READS = (TUNING,)
PLOTTED = "Geometric mean of the test errors, if the best of so many drawn settings on the validation shapes is taken."
NOTES = (
    "Every method has the same number of Sobol draws from its own search space (conf/methods.yaml), even in the "
    "logarithm of each setting, and is judged on the same shapes; the draw with the smallest geometric mean of errors "
    "on the validation shapes is taken. The expectation is over all choices of so many of the draws.",
    f"{CHAMFER} A run that did not end ok has the largest finite error of any draw of any method on its shape; of two "
    "draws that with fewer failures is better. Validation runs: {validation} per draw; test runs: {test} per draw.",
    "The interval is over test shapes, for these draws and this choice: other draws and other validation shapes would "
    "add to it.",
    "{waiting} planned runs have not ended: draws and shapes that some method lacks are left out.",
)
EFFECT_NOTES = (
    "ρ is Spearman's rank correlation between the setting and the geometric mean of errors on the validation shapes, "
    "over the draws: below 0 larger values are better. For 16 draws a |ρ| above 0.50 has p < 0.05 for one setting "
    "alone.",
)
RUNS = (
    *(FAMILY, configured("split", "split"), configured("draw", "draw"), *IDENTITY),
    *metrics("chamfer_l2", "chamfer_l1", "mask_iou"),
    *LOOP,
)
DRAWN = {"least": "Least drawn", "most": "Most drawn", "chosen": "Chosen"}


def as_drawn(value: float | int) -> str:
    """A drawn value as text; whole numbers have no decimals."""
    return word(value) if isinstance(value, int) else format.number(value)


EFFECTS = (
    *(text("method", "Method"), text("setting", "Setting")),
    *(Column(key, heading, show=as_drawn) for key, heading in DRAWN.items()),
    *(Column("rho", "ρ"), Column("n", "Draws", show=whole)),
)
Curve = dict[int, statistics.Interval]  # by the number of draws


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per method: the expected test error at each budget."""
    methods = [method for method in tunings(experiment) if method.test_runs]
    curves = {method.label: _curve(method) for method in methods}
    budgets = sorted({k for curve in curves.values() for k in curve})
    columns = [
        text("method", "Method"),
        *(Column(str(k), f"Best of {k}", words=lambda line, k=k: _words(line["curve"], k)) for k in budgets),
        Column("evaluations", "Evaluations of the best", show=format.count),
        text("failed", "Failed"),
    ]
    lines = [
        {"method": method.label, "curve": curves[method.label], "failed": f"{method.failed} of {method.runs}"}
        | {"evaluations": method.evaluations[method.best]}
        for method in methods
    ]
    waiting = unfinished(experiment)
    sizes = {"validation": methods[0].validation.shape[1], "test": len(methods[0].test_runs)} if methods else {}
    notes = [note.format(waiting=waiting, **sizes) for note in (NOTES if waiting else NOTES[:-1])] if methods else []
    notes = [*verdicts(methods), *notes, *(left_out(experiment, methods) if methods else [])]
    return Result(
        experiment,
        "What tuning is worth.",
        PLOTTED,
        interval="95 % intervals over test shapes (Student's, of logarithms)",
        estimates=[found for curve in curves.values() for found in curve.values()],
        remarks=notes or ("No draw has a run that ended on every shape, of every method.",),
        data=to_data(RUNS, experiment.records),
        table=to_table(columns, lines),
        figure=draw(methods, curves),
    )


def verdicts(methods: list[Tuning]) -> list[str]:
    """How much each method owes to tuning, and how the others compare with the best one, in words."""
    budgets = set.intersection(*(set(method.budgets) for method in methods)) if methods else set()
    if len(budgets) < 2:
        return []
    most = max(budgets)
    best = min(methods, key=lambda method: statistics.geometric(method.expected(most)).value)
    said = []
    for method in methods:
        worth = statistics.geometric_ratio(method.expected(most), method.expected(1))
        said.append(f"{method.label}: the best of {most} draws has {worth} times the error of one draw.")
    for method in methods:
        if method is not best:
            one, tuned = (statistics.geometric_ratio(method.expected(k), best.expected(k)) for k in (1, most))
            said.append(f"{method.label} over {best.label}: {one} times the error from one draw, {tuned} of {most}.")
    return said


def _curve(method: Tuning) -> Curve:
    return {k: statistics.geometric(method.expected(k)) for k in method.budgets}


def _words(curve: Curve, k: int) -> str:
    return str(curve[k]) if k in curve else format.MISSING


@style.styled
def draw(methods: list[Tuning], curves: dict[str, Curve]) -> Figure:
    """Draws a line per method: the expected test error over the number of draws."""
    figure, axes = chart.sheet(3.2, width=4.6)
    axis = axes[0, 0]
    for method in methods:
        curve = curves[method.label]
        chart.estimates(axis, method.method, list(curve), [*curve.values()], label=method.label)
    axis.set(
        xlabel="drawn settings, of which the best on validation shapes is taken", ylabel="Chamfer × 1000 (scene units²)"
    )
    found = [x for curve in curves.values() for x in curve.values()]
    everything = [end for x in found for end in (x.low, x.value, x.high, *(() if x.known else x.points))]
    style.log_axis(axis, "y", everything)
    ticks = sorted({k for curve in curves.values() for k in curve})
    axis.set_xscale("log", base=2)
    axis.set_xticks(ticks, [str(k) for k in ticks])
    style.legend_below(figure, axis, columns=2)
    return figure


def make_settings(experiment: Experiment) -> Result:
    """Makes the page of the settings, with a line per method and setting: its range, choice and effect."""
    lines: list[dict[str, Any]] = [
        {"method": method.label} | effect for method in tunings(experiment) for effect in method.effects()
    ]
    return Result(
        experiment,
        "What each setting changes, and which was chosen.",
        "Rank correlation of each drawn setting with the validation error, and its value in the chosen draw.",
        remarks=EFFECT_NOTES,
        data=to_data(EFFECTS, lines),
        table=to_table(EFFECTS, lines),
    )


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """What the best draw is worth, as the notes have it of each method."""
    gains = [note for note in notes if ": the best of " in note and "times the error of one draw" in note]
    factors = [(float(note.split(" has ")[1].split()[0]), note.split(":")[0]) for note in gains]
    if not factors:
        return Answer("What is tuning worth?")
    (least, first), (most, last) = min(factors), max(factors)
    draws = gains[0].split("the best of ")[1].split()[0]
    said = (
        f"The best of {draws} draws has *{format.number(least)}* ({first}) to *{format.number(most)}* ({last}) "
        f"times the error of one"
    )
    return Answer("What is tuning worth?", f"{said}.")


def answer_settings(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The setting that goes most with the error."""
    best = data.loc[data["rho"].abs().idxmax()]
    said = (
        f"{best['setting']} of {best['method']} goes most with the validation error: ρ = *{best['rho']:.2f}* "
        f"over {best['n']:.0f} draws."
    )
    return Answer("Which settings matter?", said)
