"""Which part of a gap between two renderers is their loss of the mask, and what each loss changes."""

from typing import Any

import pandas as pd

from bench.records import format
from bench.report.data.experiments import Experiment
from bench.report.data.subjects.completions import ERROR, EVERY, FAILURE
from bench.report.data.subjects.crossing import CROSSING, LOSSES, Crossed
from bench.report.data.subjects.wins import excluding_one
from bench.report.write.answer import Answer, excluding
from bench.report.write.result import Result
from bench.report.write.table import Column, text, to_data, to_table, whole

PLACE = 33
PLACE_LOSSES = 34
READS = (CROSSING,)
REFERENCE = "dist"  # the renderer with which the others are compared
OWN = "own"  # the column of two renderers under their own papers' losses
RENDERER, LOSS = "renderer", "loss"  # the columns of what the gap under own losses is made of
RATIO = (
    "A ratio is that of geometric means over shapes, of each shape's geometric mean over all numbers of points; below "
    "1 the first is better. Behind it: the number of shapes on which the first is better, ties half."
)
PARTS = (
    "“Own losses”: each renderer under its own paper's loss, as methods are compared. That ratio is the product of the "
    "next two: “the renderer”, its mean effect under either of the two losses, and “the loss”, its mean effect with "
    "either of the two renderers (geometric means; the Shapley values of the logarithm). The last columns: both "
    "renderers under one loss."
)
Line = dict[str, Any]  # names, and a Gap or None for each compared pair


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per pair of renderers and family: their gap under own losses and under each one."""
    crossed = Crossed(experiment)
    others = [renderer for renderer in crossed.renderers if renderer != REFERENCE]
    pairs = [(renderer, REFERENCE) for renderer in others if REFERENCE in crossed.renderers]
    lines = [_of_renderers(crossed, *pair, name) for pair in pairs for name in (EVERY, *crossed.runs.families)]
    compared = {OWN: "Own losses", RENDERER: "of it the renderer", LOSS: "of it the loss"}
    losses = {loss: crossed.labels[loss] for loss in crossed.losses}
    compared |= losses
    return Result(
        experiment,
        "Which part of a gap between renderers is their loss of the mask.",
        "Ratio of two renderers' errors, each under its own paper's loss and both under one.",
        interval="95 % intervals over shapes (Student's, of logarithms)",
        estimates=_ratios(lines, compared),
        remarks=(*_verdicts(lines, losses), RATIO, PARTS, *LOSSES, ERROR, FAILURE),
        data=to_data(_columns(compared), lines),
        table=to_table(_columns(compared), lines),
    )


def make_losses(experiment: Experiment) -> Result:
    """Makes the page of the losses, with a line per pair of losses and family: their gap with each renderer."""
    crossed = Crossed(experiment)
    first, *others = crossed.losses
    rows = {crossed.labels[renderer]: renderer for renderer in crossed.renderers}
    lines = [
        {"compared": f"{crossed.labels[loss]} over {crossed.labels[first]}", "family": name}
        | {row: crossed.gap(name, ((renderer, loss),), ((renderer, first),)) for row, renderer in rows.items()}
        for loss in others
        for name in (EVERY, *crossed.runs.families)
    ]
    labels = {row: row for row in rows}
    return Result(
        experiment,
        "What the loss of the mask changes, with each renderer.",
        "Ratio of the errors under two losses, with the same renderer.",
        interval="95 % intervals over shapes (Student's, of logarithms)",
        estimates=_ratios(lines, labels),
        remarks=(RATIO, *LOSSES, ERROR, FAILURE),
        data=to_data(_columns(labels), lines),
        table=to_table(_columns(labels), lines),
    )


def _of_renderers(crossed: Crossed, first: str, second: str, name: str) -> Line:
    """The line of two renderers in a family: their gap under own losses, its two parts, and that under each loss."""
    line: Line = {"compared": f"{crossed.labels[first]} over {crossed.labels[second]}", "family": name}
    line |= {loss: crossed.gap(name, ((first, loss),), ((second, loss),)) for loss in crossed.losses}
    mine, other = (crossed.own.get(renderer, "") for renderer in (first, second))
    own = ((first, mine),), ((second, other),)
    by_renderer = ((first, mine), (first, other)), ((second, mine), (second, other))
    by_loss = ((first, mine), (second, mine)), ((first, other), (second, other))
    return line | {key: crossed.gap(name, *of) for key, of in ((OWN, own), (RENDERER, by_renderer), (LOSS, by_loss))}


def _columns(compared: dict[str, str]) -> list[Column]:
    """Names, shapes, and for each compared pair its gap; the CSV has its numbers."""
    shapes = Column(
        "shapes", "Shapes", lambda line: max(of.shapes if of else 0 for of in map(line.get, compared)), whole
    )
    numbers = {
        "": lambda of: of.ratio.value,
        "_low": lambda of: of.ratio.low,
        "_high": lambda of: of.ratio.high,
        "_better": lambda of: of.better,
    }
    return [
        *(text("compared", "Compared"), text("family", "Family"), shapes),
        *(text("", label, lambda line, key=key: line[key]) for key, label in compared.items()),
        *(
            Column(f"{key}{end}", value=lambda line, key=key, get=get: get(line[key]) if line[key] else None)
            for key in compared
            for end, get in numbers.items()
        ),
    ]


def _ratios(lines: list[Line], compared: dict[str, str]) -> list[Any]:
    return [line[key].ratio for line in lines for key in compared if line[key] is not None]


def _verdicts(lines: list[Line], losses: dict[str, str]) -> list[str]:
    """What the gaps over all families say: of renderers that both have a loss of their own, and under one loss."""
    pooled = [line for line in lines if line["family"] == EVERY]
    own = [
        f"{line['compared']}, each under its own loss: {line[OWN].ratio} times the error; of it the renderer "
        f"{line[RENDERER].ratio}, the loss {line[LOSS].ratio}."
        for line in pooled
        if line[OWN] is not None and line[LOSS] is not None
    ]
    under_one = [
        (f"{line['compared']} under {label}, {line[loss].ratio}", line[loss].ratio)
        for line in pooled
        for loss, label in losses.items()
        if line[loss] is not None
    ]
    return [*own, *excluding_one(under_one, "over all families", said="Under one loss, the interval")]


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The largest gap over all families, and its parts."""
    whole = data[data["family"] == EVERY]
    gap = whole.loc[whole["own"].idxmax()]
    said = (
        f"{gap['compared']}: *{format.number(gap['own'])}* {format.interval(gap['own_low'], gap['own_high'])} "
        f"times the error; of it "
    )
    parts = f"the renderer {format.number(gap['renderer'])}, the loss {format.number(gap['loss'])}."
    return Answer("Which part of a gap between two methods is the renderer, and which their loss?", said + parts)


def answer_losses(data: pd.DataFrame, notes: list[str]) -> Answer:
    """How many ratios of losses exclude 1 over all families."""
    whole = data[data["family"] == EVERY]
    names = [name for name in data.columns[3:] if f"{name}_low" in data]
    sure, known = excluding(whole, names)
    largest = max((row[name], name, row["compared"]) for _, row in whole.iterrows() for name in names)
    said = (
        f"The interval excludes 1 for *{sure} of {known}* ratios over all families; the largest is "
        f"{format.number(largest[0])} "
    )
    return Answer(
        "What does another loss of the mask change, with the same renderer?", f"{said}({largest[1]}: {largest[2]})."
    )
