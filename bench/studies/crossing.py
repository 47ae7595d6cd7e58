"""The crossing: every renderer under every loss of the mask, what part of a gap is the loss, and error over cost."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report.compare import (
    ERROR,
    EVERY,
    FAILURE,
    INTERVAL,
    LABEL,
    RATIO,
    Compared,
    Gap,
    excluding_one,
    heading,
)
from bench.report.data import statistics
from bench.report.data.records import setting
from bench.report.data.runs import Runs, Selection
from bench.report.write import chart
from bench.report.write.chart import panel_data, series
from bench.report.write.result import Result
from bench.report.write.table import (
    COMPLETION,
    FAMILY,
    LOOP,
    PRESET,
    Column,
    configured,
    estimate,
    text,
    to_data,
    to_table,
    whole,
)

PLACE = 32
READS = (Selection("crossing", ("task.points",)),)
REFERENCE = "dist"  # the renderer with which the others are compared
OWN = {  # the loss of each renderer's paper; the naive one and newton have that of DIST
    "renderers.DIST": "Hinge",
    "renderers.IDR": "CrossEntropy",
    "renderers.DVR": "Occupancy",
    "renderers.Naive": "Hinge",
    "renderers.Newton": "Hinge",
}
LOSSES = (
    "Losses have the numbers of conf/losses.yaml, as printed or chosen on validation shapes; DVR's puts the points of "
    "Eq. 15 at random depths, where its paper has the given depth (`occupied_at`)."
)
PARTS = (
    "The gap under own losses is the product of the renderer's part and the loss's: each is the mean effect under "
    "either of the two others (Shapley values of the logarithm)."
)
RUNS = (
    *(FAMILY, configured("points", "task", "points"), configured("loss", "silhouette", "_label_")),
    *(*COMPLETION, *LOOP),
)
Line = dict[str, Any]


class Crossed(Compared):
    """The completions, whose rows are settings: a renderer, by its preset, and a loss, by its class."""

    @property
    def settings(self) -> dict[tuple[str, str], tuple[str, str]]:
        """The row of each renderer and loss."""
        return {
            (record["renderer"], _class(record, "silhouette")): row
            for record, row in zip(self.runs.records, zip(self.cells.preset, self.cells.row, strict=True), strict=True)
        }

    @property
    def labels(self) -> dict[str, str]:
        """The names of renderers and losses for readers."""
        found: dict[str, str] = {}
        for record in self.runs.records:
            for name, part in ((record["renderer"], "renderer"), (_class(record, "silhouette"), "silhouette")):
                found[name] = str(setting(record["config"], part, "_label_") or name)
        return found

    @property
    def own(self) -> dict[str, str]:
        """The loss of each renderer's paper, where it is known."""
        targets = {r["renderer"]: str(setting(r["config"], "renderer", "_target_")) for r in self.runs.records}
        return {renderer: OWN[target] for renderer, target in targets.items() if target in OWN}

    @property
    def renderers(self) -> list[str]:
        """All renderers."""
        return list(dict.fromkeys(renderer for renderer, _ in self.settings))

    @property
    def losses(self) -> list[str]:
        """All losses."""
        return list(dict.fromkeys(loss for _, loss in self.settings))

    def between(self, family: str, first: list[tuple[str, str]], second: list[tuple[str, str]]) -> Gap | None:
        """The gap between two groups of settings; None where one of them was not run."""
        known = self.settings
        if not {*first, *second} <= {*known}:
            return None
        return self.gap_of(family, [known[key] for key in first], [known[key] for key in second])


def _class(record: dict[str, Any], part: str) -> str:
    return str(setting(record["config"], part, "_target_") or "").rpartition(".")[2]


def make(runs: Runs) -> Result:
    """A line per family, renderer and loss: the median at each number of points."""
    found = Crossed(runs)
    labels, by_row = found.labels, {row: key for key, row in found.settings.items()}
    lines = [
        {"renderer": labels[by_row[row][0]], "loss": labels[by_row[row][1]]} | line
        for line in found.lines
        if line["family"] in found.families and (row := (line["preset"], line["row"]))
    ]
    columns = [
        *(text("family", "Family"), text("renderer", "Renderer"), text("loss", "Loss of the mask")),
        *(Column(at, heading(at)) for at in found.conditions),
        *(Column("evaluations", "Evaluations", show=format.count), text("failed", "Failed")),
    ]
    own = "; ".join(f"{labels[renderer]}: {labels.get(loss, loss)}" for renderer, loss in found.own.items())
    return Result(
        runs,
        "Every renderer under every loss of the mask.",
        "Median error of each renderer under each loss of the mask.",
        question="Which renderer is best under which loss of the mask?",
        verdict=found.best("errors × 1000"),
        remarks=(ERROR, f"Under its own paper's loss: {own}.", LOSSES),
        data=to_data(RUNS, runs.records),
        table=to_table(columns, lines),
        figure=draw(found),
    )


@style.styled
def draw(found: Crossed) -> Figure:
    """Draws a panel per number of points and family: each shape's error, small, and the medians, by loss."""
    points, families = found.conditions, found.families
    figure, axes = chart.sheet(2.0 * len(points) + 0.8, len(points), len(families), sharey=True, sharex=True)
    for line, given in zip(axes, points, strict=True):
        for axis, name in zip(line, families, strict=True):
            _panel(axis, found, name, given)
            axis.set_title(f"{name}, {heading(given)}")
        line[0].set_ylabel(LABEL)
    for axis in axes[-1]:
        axis.set_xlabel("loss of the mask")
    style.log_axis(axes[0, 0], "y", found.cells.error)
    style.legend_below(figure, axes[0, 0])
    return figure


def _panel(axis: Axes, found: Crossed, family: str, points: str) -> None:
    step = 0.8 / len(found.renderers)
    for place, renderer in enumerate(found.renderers):
        x = np.arange(len(found.losses)) - 0.4 + step * (place + 0.5)
        rows = [found.settings.get((renderer, loss)) for loss in found.losses]
        for at, row in zip(x, rows, strict=True):
            errors = style.finite(found.part(family, row, points).error) if row else []
            chart.points(axis, renderer, np.full(len(errors), at), errors, ms=2, alpha=0.45, mew=0)
        medians = style.finite(found.median(family, row, points) if row else None for row in rows)
        chart.points(axis, renderer, x, medians, ms=5, label=found.labels[renderer])
    axis.set_xticks(range(len(found.losses)), [found.labels[loss].removesuffix(" mask loss") for loss in found.losses])
    axis.grid(False, axis="x")


def make_gaps(runs: Runs) -> Result:
    """A line per pair of renderers and family: their gap under own losses, its two parts, and that under each loss."""
    found = Crossed(runs)
    others = [renderer for renderer in found.renderers if renderer != REFERENCE and REFERENCE in found.renderers]
    lines = [_gaps(found, renderer, name) for renderer in others for name in (EVERY, *found.families)]
    compared = {"own": "Own losses", "renderer": "of it the renderer", "loss": "of it the loss"}
    compared |= {loss: found.labels[loss] for loss in found.losses}
    return Result(
        runs,
        "Which part of a gap between renderers is their loss of the mask.",
        "Ratio of two renderers' errors, each under its own paper's loss and both under one.",
        question="Which part of a gap between two methods is the renderer, and which their loss?",
        verdict=_verdict(found, [line for line in lines if line["family"] == EVERY]),
        interval=INTERVAL,
        estimates=[line[key].ratio for line in lines for key in compared if line[key] is not None],
        remarks=(RATIO, PARTS, LOSSES, ERROR, FAILURE),
        data=to_data(_columns(compared), lines),
        table=to_table(_columns(compared), lines),
    )


def _gaps(found: Crossed, renderer: str, family: str) -> Line:
    mine, other = (found.own.get(one, "") for one in (renderer, REFERENCE))
    compared = {
        **{loss: ([(renderer, loss)], [(REFERENCE, loss)]) for loss in found.losses},
        "own": ([(renderer, mine)], [(REFERENCE, other)]),
        "renderer": ([(renderer, mine), (renderer, other)], [(REFERENCE, mine), (REFERENCE, other)]),
        "loss": ([(renderer, mine), (REFERENCE, mine)], [(renderer, other), (REFERENCE, other)]),
    }
    names = {"compared": f"{found.labels[renderer]} over {found.labels[REFERENCE]}", "family": family}
    return names | {key: found.between(family, *of) for key, of in compared.items()}


def _columns(compared: dict[str, str]) -> list[Column]:
    """Names, shapes, and for each compared pair its gap; the CSV has its numbers."""
    numbers = {
        "": lambda of: of.ratio.value,
        "_low": lambda of: of.ratio.low,
        "_high": lambda of: of.ratio.high,
        "_better": lambda of: of.better,
    }
    return [
        *(text("compared", "Compared"), text("family", "Family")),
        Column("shapes", "Shapes", lambda line: max(line[key].shapes if line[key] else 0 for key in compared), whole),
        *(text("", label, lambda line, key=key: line[key]) for key, label in compared.items()),
        *(
            Column(f"{key}{end}", value=lambda line, key=key, get=get: get(line[key]) if line[key] else None)
            for key in compared
            for end, get in numbers.items()
        ),
    ]


def _verdict(found: Crossed, pooled: list[Line]) -> str:
    """The largest gap with its parts, and how many gaps under one loss exclude 1."""
    known = [line for line in pooled if line["own"] is not None and line["loss"] is not None]
    under_one = [(f"{x['compared']} under {found.labels[loss]}", x[loss]) for x in pooled for loss in found.losses]
    said = [excluding_one(under_one, "under one loss")]
    if known:
        line = max(known, key=lambda line: line["own"].ratio.value)
        value, ends = format.number(line["own"].ratio.value), line["own"].ratio.ends()
        parts = f"of it the renderer {line['renderer'].ratio}, the loss {line['loss'].ratio}"
        said.insert(0, f"{line['compared']}: *{value}* {ends} times the error; {parts}.")
    return " ".join(filter(None, said))


def make_front(runs: Runs) -> Result:
    """A line per loss and renderer: its error over all families, its cost, and whether none is better for less."""
    found = Crossed(runs)
    lines = [line for loss in found.losses for line in _placed(found, loss)]
    columns = [
        *(text("loss", "Loss of the mask"), text("renderer", "Renderer")),
        Column("evaluations", "Evaluations", show=format.count),
        *estimate("error", "Error × 1000"),
        *(text("front", "Best for its cost"), PRESET),
    ]
    on: dict[str, int] = {}
    for line in lines:
        if line["front"]:
            on[line["renderer"]] = on.get(line["renderer"], 0) + 1
    told = "; ".join(
        f"{name} under *{n} of {len(found.losses)}*" for name, n in sorted(on.items(), key=lambda x: -x[1])
    )
    return Result(
        runs,
        "Error over cost, under one loss at a time.",
        "Geometric mean of the errors of all shapes and numbers of points over the median number of a run's values.",
        question="Under one loss, does a renderer with fewer field values pay with a larger error?",
        verdict=f"No other renderer has less error for fewer values: {told} losses." if on else "",
        interval=INTERVAL,
        estimates=[line["error"] for line in lines],
        remarks=(ERROR, FAILURE),
        data=to_data(columns, lines),
        table=to_table(columns, lines),
        figure=draw_front(found, lines),
        chart={"panels": [_chart(found.labels[loss], lines) for loss in found.losses]},
    )


def _placed(found: Crossed, loss: str) -> list[Line]:
    """The renderers under a loss that have an error and a cost."""
    rows = {renderer: row for (renderer, of), row in found.settings.items() if of == loss}
    known = {(line["preset"], line["row"]): line for line in found.pooled}
    lines = [
        {"loss": found.labels[loss], "renderer": found.labels[renderer]}
        | {key: known[row][key] for key in ("preset", "error", "evaluations")}
        for renderer, row in rows.items()
        if known[row]["error"].points and known[row]["evaluations"] is not None
    ]
    front = statistics.on_front([line["evaluations"] for line in lines], [line["error"].value for line in lines])
    return [line | {"front": "yes" if on else ""} for line, on in zip(lines, front, strict=True)]


@style.styled
def draw_front(found: Crossed, lines: list[Line]) -> Figure:
    """Draws a panel per loss, with a point per renderer; filled points are the best for their cost."""
    figure, (axes,) = chart.sheet(2.9, 1, len(found.losses), sharey=True, sharex=True)
    finite = [line for line in lines if np.isfinite(line["error"].value)]
    for axis, loss in zip(axes, found.losses, strict=True):
        own = [line for line in finite if line["loss"] == found.labels[loss]]
        rows, errors = [(line["preset"], line["renderer"]) for line in own], [line["error"] for line in own]
        chart.front(axis, rows, [line["evaluations"] for line in own], errors, [line["front"] for line in own])
        axis.set(title=found.labels[loss], xlabel="field values per run")
    axes[0].set_ylabel(LABEL)
    style.log_axis(axes[0], "x", [line["evaluations"] for line in finite])
    style.log_axis(axes[0], "y", [line["error"].value for line in finite])
    style.legend_below(figure, *axes)
    return figure


def _chart(loss: str, lines: list[Line]) -> dict[str, Any]:
    points = [
        series(
            *(line["renderer"], line["preset"], [line["evaluations"]], [line["error"].value]),
            **{"low": [line["error"].low], "high": [line["error"].high], "size": 9},
        )
        for line in lines
        if line["loss"] == loss
    ]
    return panel_data(loss, "field values of a run", "error × 1000", points)


PAGES = {"crossing": make, "crossing_gaps": make_gaps, "crossing_front": make_front}
