"""How much model each scene needs: the recommended rung of each scene's ladder, and what it saves."""

import math
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.report import format, style
from bench.report.caption import counted_outcome, joined, omitted, setup
from bench.report.experiments import Experiment
from bench.report.ladder import AXES, KINDS, panel
from bench.report.parsimony_runs import SCALE, SceneRun, asked, factor, scene_runs, spread
from bench.report.tables import Result

FITTED = (
    "Each scene's ladder of fields is fitted to depth and silhouettes of {fitted:g} views, every rung to the same rays "
    "for {iterations:g} iterations. Error: over held-out rays, of {held_out:g} other views and {percent:g} % of the "
    "fitted views', the mean distance along the field's normal between the observed and the rendered point, at most 10 "
    "half pixels, which is also what a ray costs that only one of them hits; ± is one standard error, by the jackknife "
    "over views. Half a pixel is that of the nearest that a shape may be."
)
RULE = (
    "Recommended is the rung of the fewest free numbers whose error is within one standard error (s.e.) of the best "
    "rung's, or under half a pixel."
)
TABLE = (
    "Seeds: of {seeds:g} draws of {drawn:g} views that no choice has seen, the share on which the recommended rung is "
    "within one standard error of the draw's best; held also counts those on which it is under half a pixel. Saved: "
    "the papers' network (8 layers of 512, without a code) over the recommended rung; seconds of their fits, – where "
    "the network was not fitted. Chamfer distance to the truth judges afterwards and takes no part in the choice; as "
    "points are drawn on both surfaces, the true shape does not have 0."
)
PANELS = (
    "A panel a scene, the least need first, each with its own scale of errors; a cross at the upper edge is a rung "
    "whose fit failed, a word in the place of a panel what became of a run that did not end ok."
)
COLUMNS = [
    *("Scene", "Needs", "Free numbers", "Error × 1000", "Half a pixel × 1000", "Why", "Best rung"),
    *("Best rung's error × 1000", "Seeds within 1 s.e.", "Seeds held", "Saved numbers", "Saved FLOPs a query"),
    *("Saved bytes", "Saved fit seconds", "Chamfer × 1000", "Failed rungs"),
]
MOST = 4  # panels in a row


def make(experiment: Experiment) -> Result:
    """A row a scene: what it needs, why, and what that saves; a panel a scene over free numbers."""
    runs = scene_runs(experiment)
    return Result(
        name="parsimony",
        title="How much model each scene needs.",
        caption=joined(
            setup(experiment, network=False),
            (FITTED + " " + RULE + " " + TABLE + " " + PANELS).format(**asked(experiment)),
            counted_outcome(experiment),
            omitted(experiment),
        ),
        data=pd.DataFrame([row for run in runs for row in _raw(run)], dtype=object),
        table=pd.DataFrame([_told(run) for run in runs], columns=COLUMNS),
        notes=[note for run in runs for note in _failures(run)],
        figure=draw(runs, "parameters"),
    )


def flops(experiment: Experiment) -> Result:
    """The same panels over what a value costs."""
    runs = scene_runs(experiment)
    keys = ("flops_per_query", "error", "standard_error", "failed")
    rows = [
        {**run.identity, "footprint": run.number("footprint"), **columns}
        for run in runs
        for columns in _rungs(run, keys)
    ]
    return Result(
        name="parsimony_flops",
        title="Error over what a query of the field costs.",
        caption=joined(
            setup(experiment, network=False),
            (FITTED + " " + RULE + " " + PANELS).format(**asked(experiment)),
            "A query is a value of the field; its floating-point operations are counted for networks, and estimated "
            "for formulas and grids.",
            counted_outcome(experiment),
            omitted(experiment),
        ),
        data=pd.DataFrame(rows, dtype=object),
        figure=draw(runs, "flops_per_query"),
    )


@style.styled
def draw(runs: list[SceneRun], key: str) -> Figure:
    """A panel a scene; the legend stands in a place that is left over, or below."""
    columns = min(MOST, len(runs))
    lines = math.ceil(len(runs) / columns)
    left_over = lines * columns - len(runs)
    figure = Figure(figsize=(style.WIDTH, 1.75 * lines + (0.25 if left_over else 0.65)), layout="constrained")
    axes = list(figure.subplots(lines, columns, squeeze=False, sharex=True).flat)
    for axis, run in zip(axes, runs, strict=False):
        (_panel if run.ok else _lost)(axis, run, key)
    for axis in axes[len(runs) :]:
        axis.axis("off")
    for axis in axes:  # all: they share the margins of x
        axis.margins(x=0.1, y=0.12)
    for axis in axes[len(runs) - columns : len(runs)]:
        axis.tick_params(labelbottom=True)
        axis.set_xlabel(AXES[key])
    figure.supylabel("held-out error (scene units)", fontsize=style.RC["axes.labelsize"])
    named = style.labelled(*axes)
    kinds = [label for label, _, _ in KINDS.values()]
    labels = sorted(named, key=lambda label: kinds.index(label) if label in kinds else len(kinds))
    handles = [named[label] for label in labels]
    if left_over:
        axes[-1].legend(handles, labels, loc="center")
    else:
        figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


def _panel(axis: Axes, run: SceneRun, key: str) -> None:
    panel(axis, run.ladder, key)
    axis.set_title(f"{run.name}\nneeds {run.ladder.chosen.label}")
    lost = [rung for rung in run.ladder.rungs if rung.error is None]
    for rung in lost:
        axis.plot(rung.numbers[key], 0.97, "x", color=KINDS[rung.kind][1], transform=axis.get_xaxis_transform())
    if lost:
        axis.plot([], [], "x", color="#444444", label="failed fit")


def _lost(axis: Axes, run: SceneRun, key: str) -> None:
    """A run without a ladder."""
    axis.set_title(f"{run.name}\n")
    axis.tick_params(left=False, labelleft=False)
    axis.grid(False)
    axis.text(0.5, 0.5, run.status, ha="center", va="center", color="#666666", transform=axis.transAxes)


def _told(run: SceneRun) -> list[str]:
    chosen, best = run.ladder.chosen, run.ladder.best
    if not run.ok or chosen is None or best is None:
        return [run.name, run.status, *[format.MISSING] * (len(COLUMNS) - 2)]
    errors = [spread(rung.error, rung.numbers.get("standard_error")) for rung in (chosen, best)]
    return [
        run.name,
        chosen.label,
        f"{chosen.numbers['parameters']:,}",
        errors[0],
        format.number(run.ladder.footprint, SCALE),
        _why(run),
        best.label,
        errors[1],
        *(_percent(run.number(f"held_out_seeds_{name}")) for name in ("within", "held")),
        *(factor(run.number(f"saved_{name}")) for name in ("parameters", "flops_per_query", "bytes", "seconds")),
        format.number(run.number("chamfer_l2"), SCALE),
        f"{sum(rung.error is None for rung in run.ladder.rungs)} of {len(run.ladder.rungs)}",
    ]


def _why(run: SceneRun) -> str:
    within, enough = (run.number(f"recommended_{name}") for name in ("within", "enough"))
    if within and enough:
        return "both"
    return "within 1 s.e." if within else "under half a pixel"


def _percent(share: float | None) -> str:
    return format.MISSING if share is None else f"{100 * share:.0f} %"


def _failures(run: SceneRun) -> list[str]:
    """A line for each rung whose fit failed."""
    lost = [rung for rung in run.ladder.rungs if rung.error is None]
    return [f"{run.name}, {rung.label}: fit {rung.numbers.get('failed', 'failed')}" for rung in lost]


def _raw(run: SceneRun) -> list[dict[str, Any]]:
    """A line a rung with all its numbers, and the scene's own on each; one line for a run without a ladder."""
    names = ("footprint", "chamfer_l2", "recommended_within", "recommended_enough")
    saved = [f"saved_{name}" for name in ("parameters", "flops_per_query", "bytes", "seconds")]
    seeds = ("held_out_seeds", "held_out_seeds_within", "held_out_seeds_held")
    own = {**run.identity, **{name: run.number(name) for name in (*names, *seeds, *saved)}}
    spent = ("seconds", "evaluations", "flops")
    keys = ("parameters", "bytes", "flops_per_query", "error", "standard_error", *spent, "failed")
    return [{**own, **columns} for columns in _rungs(run, (*keys, *(f"{name}_at_auto" for name in spent)))]


def _rungs(run: SceneRun, keys: tuple[str, ...]) -> list[dict[str, Any]]:
    """The columns of each rung; a line of empty ones for a run without a ladder."""
    if not run.ok:
        return [dict.fromkeys(("rung", "kind", "recommended", "best", *keys))]
    chosen, best = run.ladder.chosen, run.ladder.best
    return [
        {
            **{"rung": rung.name, "kind": KINDS[rung.kind][0], "recommended": rung is chosen, "best": rung is best},
            **{key: rung.numbers.get(key) for key in keys},
        }
        for rung in run.ladder.rungs
    ]
