"""The crossing of renderers and losses of the mask: which part of a gap between two methods is their loss."""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report.data import statistics
from bench.report.data.completions import ERROR, heading
from bench.report.data.crossing import CROSSING, Crossed, geometric_mean, shape_medians
from bench.report.data.experiments import Experiment
from bench.report.data.records import by_shape
from bench.report.write import chart
from bench.report.write.result import Result
from bench.report.write.table import (
    FAMILY,
    IDENTITY,
    LOOP,
    Column,
    configured,
    metrics,
    percent,
    text,
    to_data,
    to_table,
    whole,
)

PLACE = 32
PLACE_GAPS = 33
PLACE_LOSSES = 34
PLACE_FRONT = 35
READS = (CROSSING,)
SEED = 0  # of the bootstrap
REFERENCE = "dist"  # the renderer with which the others are compared
PLOTTED = "Median error of each renderer under each loss of the mask."
NOTES = (
    "Every renderer has every loss, with the numbers of conf/silhouette, the same weight of the task and the same "
    "settings otherwise. Under its own paper's loss: {own}.",
    "Small points are shapes, large ones their medians, from left to right in the order of the legend.",
)
GAP_NOTES = (
    "A ratio is that of geometric means over shapes, of each shape's geometric mean over all numbers of points; "
    "behind it on how many shapes the first is better, ties half. Below 1 the first is better.",
    "“Own losses”: each renderer under its own paper's loss, as methods are compared; the other columns: both under "
    "one loss. The share of the gap due to the loss is 1 - log(ratio under one loss) / log(ratio under own losses), "
    "with the geometric mean of the ratios under one loss; above 100 % the order is reversed, below 0 % the gap grows.",
)
RUNS = (
    *(FAMILY, configured("points", "task", "points"), configured("loss", "silhouette", "_label_"), *IDENTITY),
    *metrics("chamfer_l2", "chamfer_l1", "normal_consistency", "mask_iou"),
    *LOOP,
)
EVERY = "all families"
NOTHING = statistics.Interval(math.inf, math.nan, math.nan)
Pair = tuple[tuple[str, str], tuple[str, str]]  # two settings: renderer and loss


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per family, renderer and loss: the median at each number of points."""
    runs = Crossed(experiment)
    columns = [
        *(text("family", "Family"), text("renderer", "Renderer"), text("loss", "Loss of the mask")),
        *(Column(points, heading(points)) for points in runs.points),
        Column("cost", "Evaluations", show=format.count),
        text("failed", "Failed"),
    ]
    own = "; ".join(f"{runs.labels[renderer]}: {runs.labels.get(loss, loss)}" for renderer, loss in runs.own.items())
    return Result(
        experiment,
        "Every renderer under every loss of the mask.",
        PLOTTED,
        remarks=(ERROR, *(note.format(own=own) for note in NOTES)),
        data=to_data(RUNS, experiment.records),
        table=to_table(columns, _lines(runs)),
        figure=draw(runs),
    )


def _lines(runs: Crossed) -> list[dict[str, Any]]:
    lines = []
    for name in runs.families:
        for renderer in runs.renderers:
            for loss in runs.losses:
                cells = {p: (name, p, renderer, loss) for p in runs.points if runs.cell(name, p, renderer, loss)}
                failed, planned = (sum(counts[c] for c in cells.values()) for counts in (runs.failed, runs.planned))
                lines.append(
                    {"family": name, "renderer": runs.labels[renderer], "loss": runs.labels[loss]}
                    | {points: runs.median(*cell) for points, cell in cells.items()}
                    | {"cost": runs.cost(renderer, loss), "failed": f"{failed} of {planned}"}
                )
    return lines


@style.styled
def draw(runs: Crossed) -> Figure:
    """Draws a panel per number of points and family: each shape's error and the medians, by loss and renderer."""
    figure, axes = chart.sheet(
        2.0 * len(runs.points) + 0.8, len(runs.points), len(runs.families), sharey=True, sharex=True
    )
    for line, points in zip(axes, runs.points, strict=True):
        for axis, name in zip(line, runs.families, strict=True):
            _panel(axis, runs, name, points)
            axis.set_title(f"{name}, {heading(points)}")
        line[0].set_ylabel("Chamfer × 1000 (scene units²)")
    for axis in axes[-1]:
        axis.set_xlabel("loss of the mask")
    style.log_axis(axes[0, 0], "y", [e for errors in runs.errors.values() for e in errors.values()])
    style.legend_below(figure, axes[0, 0])
    return figure


def _panel(axis: Axes, runs: Crossed, name: str, points: str) -> None:
    step = 0.8 / len(runs.renderers)
    for place, renderer in enumerate(runs.renderers):
        x = np.arange(len(runs.losses)) - 0.4 + step * (place + 0.5)
        for at, loss in zip(x, runs.losses, strict=True):
            errors = style.finite(runs.cell(name, points, renderer, loss).values())
            chart.points(axis, renderer, np.full(len(errors), at), errors, ms=2, alpha=0.45, mew=0)
        medians = style.finite(runs.median(name, points, renderer, loss) for loss in runs.losses)
        chart.points(axis, renderer, x, medians, ms=5, label=runs.labels[renderer])
    short = [runs.labels[loss].removesuffix(" mask loss") for loss in runs.losses]
    axis.set_xticks(range(len(short)), short)
    axis.grid(False, axis="x")


def make_front(experiment: Experiment) -> Result:
    """Makes the page of the front, with a line per loss and renderer: its error over all families, and its cost."""
    runs = Crossed(experiment)
    lines = []
    for loss in runs.losses:
        points = [_placed(runs, renderer, loss) for renderer in runs.renderers]
        beaten = statistics.dominated([p["evaluations"] for p in points], [p["error"] for p in points])
        lines += [point | {"front": "" if inside else "yes"} for point, inside in zip(points, beaten, strict=True)]
    columns = [
        *(text("loss", "Loss of the mask"), text("renderer", "Renderer")),
        Column("evaluations", "Evaluations", show=format.count),
        Column("error", "Error × 1000", words=lambda line: str(line["interval"])),
        *(
            Column("low", value=lambda line: line["interval"].low),
            Column("high", value=lambda line: line["interval"].high),
        ),
        text("front", "On the front"),
    ]
    return Result(
        experiment,
        "Error over cost, under one loss at a time.",
        "Geometric mean of the errors of all shapes and numbers of points over the median number of a run's values.",
        interval="95 % bootstrap intervals over {shapes and seeds}",
        estimates=[line["interval"] for line in lines if line["interval"] is not NOTHING],
        remarks=(
            ERROR,
            "On the front: under the same loss no other renderer has a smaller error for fewer values.",
        ),
        data=to_data(columns, lines),
        table=to_table(columns, lines),
        figure=draw_front(runs, lines),
    )


def _placed(runs: Crossed, renderer: str, loss: str) -> dict[str, Any]:
    errors = by_shape(runs.over_points(renderer, loss))
    found = statistics.bootstrap(errors, geometric_mean, seed=SEED) if errors else NOTHING
    cost = runs.cost(renderer, loss)
    names = {"preset": renderer, "renderer": runs.labels[renderer], "loss": runs.labels[loss]}
    return names | {"interval": found, "error": found.value, "evaluations": math.inf if cost is None else cost}


@style.styled
def draw_front(runs: Crossed, lines: list[dict[str, Any]]) -> Figure:
    """Draws a panel per loss, with a point per renderer; filled points are on the front."""
    figure, (axes,) = chart.sheet(2.9, 1, len(runs.losses), sharey=True, sharex=True)
    edge = 2 * max((line["error"] for line in lines if math.isfinite(line["error"])), default=1.0)
    for axis, loss in zip(axes, runs.losses, strict=True):
        for line in (line for line in lines if line["loss"] == runs.labels[loss]):
            how = {"ls": "none", "ms": 5, "label": line["renderer"]} | ({} if line["front"] else {"mfc": "none"})
            found = [line["interval"].below(edge)] if math.isfinite(line["error"]) else []
            chart.estimates(axis, line["preset"], [line["evaluations"]][: len(found)], found, bars=True, **how)
        axis.set(title=runs.labels[loss], xlabel="field values per run")
    axes[0].set_ylabel("Chamfer × 1000 (scene units²)")
    style.log_axis(axes[0], "x", [line["evaluations"] for line in lines])
    style.log_axis(axes[0], "y", [line["error"] for line in lines])
    style.legend_below(figure, axes[0])
    return figure


def make_gaps(experiment: Experiment) -> Result:
    """Makes the page of the gaps between renderers: a line per pair and family, under own losses and under each one."""
    runs = Crossed(experiment)
    others = [renderer for renderer in runs.renderers if renderer != REFERENCE]
    pairs = [(renderer, REFERENCE) for renderer in others if REFERENCE in runs.renderers]
    lines = [_renderers_gap(runs, pair, name) for pair in pairs for name in (EVERY, *runs.families)]
    under = {"own": "Own losses", **{loss: runs.labels[loss] for loss in runs.losses}}
    ends = [Column(f"{key}_{end}") for key in under for end in ("low", "high", "better")]
    columns = [
        *(text("compared", "Compared"), text("family", "Family"), Column("shapes", "Shapes", show=whole)),
        *(Column(key, label, words=lambda line, key=key: _words(line, key)) for key, label in under.items()),
        Column("share", "Due to the loss", show=percent),
        *ends,
    ]
    return Result(
        experiment,
        "Which part of a gap between renderers is their loss of the mask.",
        "Ratio of two renderers' errors, each under its own paper's loss and both under one.",
        interval="95 % bootstrap intervals over {shapes and seeds}",
        estimates=[line[f"{key}_of"] for line in lines for key in under if f"{key}_of" in line],
        remarks=(_explained(runs), *_verdicts(lines, runs.losses), *GAP_NOTES, ERROR),
        data=to_data(columns, lines),
        table=to_table(columns, lines),
    )


def make_losses(experiment: Experiment) -> Result:
    """Makes the page of the gaps between losses: a line per pair and family, with each renderer."""
    runs = Crossed(experiment)
    first, *others = runs.losses
    lines = [
        {"compared": f"{runs.labels[loss]} over {runs.labels[first]}", "family": name}
        | _gaps(runs, name, {renderer: ((renderer, loss), (renderer, first)) for renderer in runs.renderers})
        for loss in others
        for name in (EVERY, *runs.families)
    ]
    columns = [
        *(text("compared", "Compared"), text("family", "Family"), Column("shapes", "Shapes", show=whole)),
        *(Column(r, runs.labels[r], words=lambda line, r=r: _words(line, r)) for r in runs.renderers),
        *(Column(f"{renderer}_{end}") for renderer in runs.renderers for end in ("low", "high", "better")),
    ]
    return Result(
        experiment,
        "What the loss of the mask changes, with each renderer.",
        "Ratio of the errors under two losses, with the same renderer.",
        interval="95 % bootstrap intervals over {shapes and seeds}",
        estimates=[line[f"{renderer}_of"] for line in lines for renderer in runs.renderers if f"{renderer}_of" in line],
        remarks=(_explained(runs), GAP_NOTES[0], ERROR),
        data=to_data(columns, lines),
        table=to_table(columns, lines),
    )


def _renderers_gap(runs: Crossed, pair: tuple[str, str], name: str) -> dict[str, Any]:
    """The line of two renderers in a family: their ratio under own losses and under each, and the share of the loss."""
    settings: dict[str, Pair] = {loss: ((pair[0], loss), (pair[1], loss)) for loss in runs.losses}
    own = [runs.own.get(renderer) for renderer in pair]
    if all(loss in runs.losses for loss in own):
        settings["own"] = ((pair[0], str(own[0])), (pair[1], str(own[1])))
    line = _gaps(runs, name, settings)
    line["share"] = _share(line.get("own"), [line[loss] for loss in runs.losses]) if own[0] != own[1] else None
    return {"compared": " over ".join(runs.labels[renderer] for renderer in pair), "family": name} | line


def _gaps(runs: Crossed, name: str, settings: dict[str, Pair]) -> dict[str, Any]:
    """The ratio of two settings' errors for each key, with its interval, and on how many shapes the first is better."""
    line: dict[str, Any] = {"shapes": 0}
    for key, (first, second) in settings.items():
        mine, other = runs.pair(first, second, None if name == EVERY else name)
        line[key] = None
        if mine:
            ratio = statistics.paired_bootstrap(mine, other, geometric_mean, seed=SEED)
            better = sum((a < b) + 0.5 * (a == b) for a, b in zip(*map(shape_medians, (mine, other)), strict=True))
            line |= {key: ratio.value, f"{key}_low": ratio.low, f"{key}_high": ratio.high}
            line |= {f"{key}_of": ratio, f"{key}_better": better, "shapes": len(mine)}
    return line


def _words(line: dict[str, Any], key: str) -> str:
    """A ratio, its interval, and on how many shapes the first is better."""
    if line.get(key) is None:
        return format.MISSING
    return f"{line[f'{key}_of']}; {line[f'{key}_better']:g} of {line['shapes']}"


def _share(own: float | None, under: list[float | None]) -> float | None:
    """The share of the logarithm of a ratio that vanishes under one loss; None where a ratio is not above 0, finite."""
    ratios = [ratio for ratio in (own, *under) if ratio is not None and 0 < ratio < math.inf]
    if len(ratios) < 1 + len(under) or ratios[0] == 1:
        return None
    return 1 - float(np.mean(np.log(ratios[1:]))) / math.log(ratios[0])


def _verdicts(lines: list[dict[str, Any]], losses: list[str]) -> list[str]:
    """What the gaps over all families say, a sentence for each pair whose own losses differ."""
    verdicts = []
    for line in (line for line in lines if line["family"] == EVERY and line.get("share") is not None):
        under = [line[loss] for loss in losses]
        mean, ends = geometric_mean(np.array(under)), f"{format.number(min(under))} to {format.number(max(under))}"
        verdicts.append(
            f"{line['compared']}: {format.number(line['own'])} times the error under own losses, "
            f"{format.number(mean)} times under one loss (geometric mean of the {len(under)}; {ends}); the loss is "
            f"{percent(line['share'])} of the gap, over {line['shapes']} shapes."
        )
    return verdicts


def _explained(runs: Crossed) -> str:
    """A note on what explains the differences between the settings."""
    shares, count = runs.shares()
    if not shares:
        return ""
    return (
        f"Of the variance between the {len(runs.renderers) * len(runs.losses)} settings' mean logarithmic errors the "
        f"loss explains {percent(shares['loss'])}, the renderer {percent(shares['renderer'])}, and what only both "
        f"together explain is {percent(shares['both'])} (two-way analysis of variance of the means over the {count} "
        "shapes and seeds on which no setting failed)."
    )
