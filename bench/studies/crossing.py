"""The crossing: every renderer under every loss of the mask, and what part of a gap is the loss."""

from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure

from bench.report.study import Result, Runs, Selection, chart, compare, format, records, table

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
    *(table.FAMILY, table.configured("points", "task", "points"), table.configured("loss", "silhouette", "_label_")),
    *(*table.COMPLETION, *table.LOOP),
)
Line = dict[str, Any]
Setting = tuple[str, str]  # a renderer, by its preset, and a loss, by its class


@dataclass(frozen=True)
class Crossed:
    """The comparison of all settings.

    Args:
        found: their errors.
        rows: the row of each setting.
        labels: the names of renderers and losses for readers.
        own: the loss of each renderer's paper, where it is known.
    """

    found: compare.Compared
    rows: dict[Setting, records.Row]
    labels: dict[str, str]
    own: dict[str, str]

    @property
    def renderers(self) -> list[str]:
        return list(dict.fromkeys(renderer for renderer, _ in self.rows))

    @property
    def losses(self) -> list[str]:
        return list(dict.fromkeys(loss for _, loss in self.rows))

    def gap(self, family: str, first: list[Setting], second: list[Setting]) -> compare.Gap | None:
        """The gap between two groups of settings; None where one of them was not run."""
        absent = records.Row("", "")
        return self.found.gap(family, *([self.rows.get(key, absent) for key in of] for of in (first, second)))


def crossed(runs: Runs) -> Crossed:
    """The settings of the runs."""
    found = compare.Compared(runs)
    rows, labels, own = {}, {}, {}
    for record in runs.records:
        target, mask = (
            str(records.setting(record["config"], part, "_target_") or "") for part in ("renderer", "silhouette")
        )
        renderer, loss = record["renderer"], mask.rpartition(".")[2]
        rows[renderer, loss] = records.row_of(record)
        for name, part in ((renderer, "renderer"), (loss, "silhouette")):
            labels[name] = str(records.setting(record["config"], part, "_label_") or name)
        if target in OWN:
            own[renderer] = OWN[target]
    return Crossed(found, rows, labels, own)


def make(runs: Runs) -> Result:
    """A line per family, renderer and loss, all families first."""
    settings = crossed(runs)
    labels = settings.labels
    own = "; ".join(f"{labels[renderer]}: {labels.get(loss, loss)}" for renderer, loss in settings.own.items())
    return settings.found.result(
        "Every renderer under every loss of the mask.",
        "Which renderer is best under which loss of the mask?",
        ratio="",
        remarks=(compare.ERROR, compare.FAILURE, f"Under its own paper's loss: {own}.", LOSSES),
        run_columns=RUNS,
        figure=draw(settings),
    )


def draw(settings: Crossed) -> Figure:
    """Draws a panel per family: the median error of each renderer by loss."""
    losses, renderers, panels = settings.losses, settings.renderers, []
    for family in settings.found.families:
        drawn = []
        for place, renderer in enumerate(renderers):
            at = {x: row for x, loss in enumerate(losses) if (row := settings.rows.get((renderer, loss)))}
            beside = [x + 0.8 * ((place + 0.5) / len(renderers) - 0.5) for x in at]
            errors = [settings.found.error(family, row) for row in at.values()]
            drawn.append(chart.series(settings.labels[renderer], renderer, beside, errors))
        names = [settings.labels[loss].removesuffix(" mask loss") for loss in losses]
        panels.append(chart.panel_data(family, "loss of the mask", compare.LABEL, drawn, ticks=names))
    return chart.draw(panels, 2.8, sharey=True)


def make_gaps(runs: Runs) -> Result:
    """A line per pair of renderers and family: their gap under own losses, its two parts, and that under each loss."""
    settings = crossed(runs)
    others = [one for one in settings.renderers if one != REFERENCE and REFERENCE in settings.renderers]
    lines = [_gaps(settings, one, name) for one in others for name in (compare.EVERY, *settings.found.families)]
    compared = {"own": "Own losses", "renderer": "of it the renderer", "loss": "of it the loss"}
    compared |= {loss: settings.labels[loss] for loss in settings.losses}
    return Result(
        runs,
        "Which part of a gap between renderers is their loss of the mask.",
        "Ratio of two renderers' errors, each under its own paper's loss and both under one.",
        question="Which part of a gap between two methods is the renderer, and which their loss?",
        verdict=_verdict(settings, [line for line in lines if line["family"] == compare.EVERY]),
        interval=compare.INTERVAL,
        estimates=[line[key].ratio for line in lines for key in compared if line[key] is not None],
        remarks=(compare.RATIO, PARTS, LOSSES, compare.ERROR, compare.FAILURE),
        columns=_columns(compared),
        lines=lines,
    )


def _gaps(settings: Crossed, renderer: str, family: str) -> Line:
    mine, other = (settings.own.get(one, "") for one in (renderer, REFERENCE))
    compared = {
        **{loss: ([(renderer, loss)], [(REFERENCE, loss)]) for loss in settings.losses},
        "own": ([(renderer, mine)], [(REFERENCE, other)]),
        "renderer": ([(renderer, mine), (renderer, other)], [(REFERENCE, mine), (REFERENCE, other)]),
        "loss": ([(renderer, mine), (REFERENCE, mine)], [(renderer, other), (REFERENCE, other)]),
    }
    names = {"compared": f"{settings.labels[renderer]} over {settings.labels[REFERENCE]}", "family": family}
    return names | {key: settings.gap(family, *of) for key, of in compared.items()}


def _columns(compared: dict[str, str]) -> list[table.Column]:
    """Names, shapes, and for each compared pair its gap; the CSV has its numbers."""
    numbers = {
        "": lambda of: of.ratio.value,
        "_low": lambda of: of.ratio.low,
        "_high": lambda of: of.ratio.high,
        "_better": lambda of: of.better,
    }
    return [
        *(table.text("compared", "Compared"), table.text("family", "Family")),
        table.Column(
            "shapes", "Shapes", lambda line: max(line[key].shapes if line[key] else 0 for key in compared), table.whole
        ),
        *(table.text("", label, lambda line, key=key: line[key]) for key, label in compared.items()),
        *(
            table.Column(f"{key}{end}", value=lambda line, key=key, get=get: get(line[key]) if line[key] else None)
            for key in compared
            for end, get in numbers.items()
        ),
    ]


def _verdict(settings: Crossed, pooled: list[Line]) -> str:
    """The largest gap with its parts, and how many gaps under one loss differ from 1."""
    known = [line for line in pooled if line["own"] is not None and line["loss"] is not None]
    names = settings.labels
    under_one = [
        (f"{line['compared']} under {names[loss]}", compare.ratio_of(line[loss]))
        for line in pooled
        for loss in settings.losses
    ]
    said = [compare.differing(under_one, "under one loss")]
    if known:
        line = max(known, key=lambda line: line["own"].ratio.value)
        value, ends = format.number(line["own"].ratio.value), line["own"].ratio.ends()
        parts = f"of it the renderer {line['renderer'].ratio}, the loss {line['loss'].ratio}"
        said.insert(0, f"{line['compared']}: *{value}* {ends} times the error; {parts}.")
    return " ".join(filter(None, said))


PAGES = {"crossing": make, "crossing_gaps": make_gaps}
