"""Model selection: each candidate's error over its size, and the smallest sufficient one of each scene."""

import math
from collections.abc import Sequence
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.pictures.size_chart import AXES, FLOPS, KINDS, CandidateResult, panel
from bench.records import format
from bench.report.data.experiments import Experiment
from bench.report.data.subjects.parsimony import (
    PARSIMONY,
    SIZES,
    SceneRun,
    factor,
    failures,
    measure_note,
    measure_of,
    named_settings,
    scene_runs,
    spread,
)
from bench.report.write import chart
from bench.report.write.answer import Answer
from bench.report.write.result import Result
from bench.report.write.table import IDENTITY, Column, percent, shown, text, thousandfold, through, to_data, to_table

PLACE = 160
READS = (PARSIMONY,)
INTERVAL = "± and bars are one standard error, by the jackknife over views"
NOTES = (
    "All candidate fields are fitted to depth and silhouettes of {fitted:g} views, with the same rays and "
    "{iterations:g} iterations. Error: over held-out rays, of {held_out:g} other views and {percent:g} % of the fitted "
    "views', the mean distance along the field's normal between the observed and the rendered point, at most 10 half "
    "pixels, which also counts for a ray that only one of them hits. Half a pixel is measured at the smallest distance "
    "that a shape can have.",
    "Recommended is the smallest candidate by {size} whose error is within one standard error (s.e.) of the best "
    "candidate's, or under half a pixel.",
    "Free numbers are those that the optimiser may change; stored ones are those that a file must hold so that the "
    "field can be evaluated, of a grid all its samples; bytes are of that file, in float32.",
    "Panels are sorted by the size of the recommended candidate, each with its own scale of errors; a cross at the "
    "upper edge is a candidate whose fit failed; a run that did not end ok has its status in place of the points.",
)
TABLE = (
    "Seeds: the share of {seeds:g} draws of {drawn:g} further views on which the recommended candidate is within one "
    "standard error of the draw's best; held also counts those on which it is under half a pixel.",
    "Of a grid, a file with the fitted samples, a bit per sample and the previous field would do as well, since the "
    "other samples are computed from that field: sparse_bytes in the CSV; no choice uses it.",
    "Saved: the papers' network (8 layers of 512, without a code) over the recommended candidate; for seconds of the "
    "fits, – where the network was not fitted.",
    "Chamfer distance to the true surface is computed afterwards and takes no part in the choice; as points are "
    "sampled on both surfaces, it is not 0 for the true shape.",
)
MOST = 4  # most panels in a row


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line and a panel per scene: its recommended candidate, the reason, and the savings."""
    runs = scene_runs(experiment)
    size = AXES[measure_of(runs)]
    return Result(
        experiment,
        f"The smallest sufficient field for each scene, by {size}.",
        f"Held-out error of each candidate over its {size}, by which the choice is made, a panel per scene.",
        interval=INTERVAL,
        remarks=(measure_note(runs), *_notes(experiment, size, *NOTES, *TABLE), *failures(runs, _failed)),
        data=to_data(CANDIDATES, _candidate_lines(runs)),
        table=scene_table(COLUMNS, runs),
        figure=draw(runs, measure_of(runs)),
    )


def _notes(experiment: Experiment, size: str, *notes: str) -> list[str]:
    """The notes with the experiment's settings and the measure of size in words."""
    return [note.format(**named_settings(experiment), size=size) for note in notes]


def _candidate_lines(runs: list[SceneRun]) -> list[tuple[SceneRun, CandidateResult | None]]:
    """A line of the CSV for each candidate of each run; one with None for a run that did not end ok."""
    return [(run, result) for run in runs for result in (run.candidates.results if run.ok else [None])]


def _of_candidate(line: tuple[SceneRun, CandidateResult | None]) -> dict[str, Any]:
    """The name, kind and numbers of a line's candidate; empty where it has none."""
    run, result = line
    if result is None:
        return {}
    marks = {"recommended": result is run.candidates.chosen, "best": result is run.candidates.best}
    return {**result.numbers, "rung": result.name, "kind": KINDS[result.kind][0], **marks}


def scene_table(columns: Sequence[Column], runs: list[SceneRun]) -> pd.DataFrame:
    """The readable table of all runs; those that did not end ok come last, with their status and no numbers."""
    table = to_table(columns, [run for run in runs if run.ok])
    rest = [[run.name, run.status, *[format.MISSING] * (table.shape[1] - 2)] for run in runs if not run.ok]
    return pd.DataFrame([*table.to_numpy().tolist(), *rest], columns=table.columns)


@style.styled
def draw(runs: list[SceneRun], key: str) -> Figure:
    """Draws a panel per scene; the legend is in a free place of the grid, or below."""
    columns = min(MOST, len(runs))
    lines = math.ceil(len(runs) / columns)
    left_over = lines * columns - len(runs)
    figure, axes = chart.sheet(1.75 * lines + (0.25 if left_over else 0.65), lines, columns, sharex=True)
    axes = list(axes.flat)
    for axis, run in zip(axes, runs, strict=False):
        _panel(axis, run, key)
    for axis in axes[len(runs) :]:
        axis.axis("off")
    for axis in axes:  # all of them, since they share x
        axis.margins(x=0.1, y=0.12)
    for axis in axes[len(runs) - columns : len(runs)]:
        axis.tick_params(labelbottom=True)
        axis.set_xlabel(AXES[key])
    figure.supylabel("held-out error (scene units)", fontsize=style.RC["axes.labelsize"])
    named = style.labelled(*axes)
    kinds = [label for label, _, _ in KINDS.values()]
    labels = sorted(named, key=lambda label: kinds.index(label) if label in kinds else len(kinds))
    named = {label: named[label] for label in labels}
    if left_over:
        axes[-1].legend(named.values(), named.keys(), loc="center")
    else:
        style.legend_of(figure, named)
    return figure


def _panel(axis: Axes, run: SceneRun, key: str) -> None:
    """Draws the candidates of a run; where it did not end ok, writes its status."""
    if not run.ok:
        axis.set_title(f"{run.name}\n")
        axis.tick_params(left=False, labelleft=False)
        axis.grid(False)
        chart.say(axis, run.status, color="#666666")
        return
    panel(axis, run.candidates, key)
    axis.set_title(f"{run.name}\nneeds {run.candidates.chosen.label}")
    failed = _failed_fits(run)
    for result in failed:
        axis.plot(result.numbers[key], 0.97, "x", color=KINDS[result.kind][1], transform=axis.get_xaxis_transform())
    if failed:
        axis.plot([], [], "x", color="#444444", label="failed fit")


def _failed_fits(run: SceneRun) -> list[CandidateResult]:
    return [result for result in run.candidates.results if result.error is None]


def _failed(run: SceneRun) -> dict[str, str | None]:
    return {result.label: f"fit {result.numbers.get('failed', 'failed')}" for result in _failed_fits(run)}


def _why(run: SceneRun) -> str:
    within, enough = (run.number(f"recommended_{name}") for name in ("within", "enough"))
    if within and enough:
        return "both"
    return "within 1 s.e." if within else "under half a pixel"


def _error(result: CandidateResult) -> str:
    return spread(result.error, result.numbers.get("standard_error"))


SAVED = ("stored", "free", "bytes", "flops_per_query", "seconds")
SPENT = ("seconds", "evaluations", "flops")
OF_SCENE = ("footprint", "chamfer_l2", "recommended_within", "recommended_enough")
SEEDS = ("held_out_seeds", "held_out_seeds_within", "held_out_seeds_held")
# Columns that identify a scene, for runs, and a candidate, for dictionaries.
SCENE = (text("scene", "Scene", lambda run: run.name), *through(lambda run: run.record, *IDENTITY))
CANDIDATE = tuple(map(Column, ("rung", "kind", "recommended", "best")))
_CANDIDATE_NUMBERS = (*SIZES, "sparse_bytes", FLOPS, "error", "standard_error", *SPENT, "failed")
CANDIDATES = (
    *through(lambda line: line[0], *SCENE, *map(Column, (*OF_SCENE, *SEEDS, *(f"saved_{name}" for name in SAVED)))),
    *through(_of_candidate, *CANDIDATE, *map(Column, (*_CANDIDATE_NUMBERS, *(f"{name}_at_auto" for name in SPENT)))),
)
COLUMNS = (
    SCENE[0],
    shown("Recommended", lambda run: run.candidates.chosen.label),
    shown("Stored numbers", lambda run: f"{run.candidates.chosen.numbers['stored']:,}"),
    shown("Free numbers", lambda run: f"{run.candidates.chosen.numbers['free']:,}"),
    shown("Size of the file", lambda run: format.size(run.candidates.chosen.numbers["bytes"])),
    shown("Error × 1000", lambda run: _error(run.candidates.chosen)),
    Column("footprint", "Half a pixel × 1000", show=thousandfold),
    shown("Why", _why),
    shown("Best candidate", lambda run: run.candidates.best.label),
    shown("Best error × 1000", lambda run: _error(run.candidates.best)),
    Column("held_out_seeds_within", "Seeds within 1 s.e.", show=percent),
    Column("held_out_seeds_held", "Seeds held", show=percent),
    Column("saved_stored", "Saved stored numbers", show=factor),
    Column("saved_free", "Saved free numbers", show=factor),
    Column("saved_flops_per_query", "Saved FLOPs per query", show=factor),
    Column("saved_seconds", "Saved fit seconds", show=factor),
    Column("chamfer_l2", "Chamfer × 1000", show=thousandfold),
    shown("Failed candidates", lambda run: f"{len(_failed_fits(run))} of {len(run.candidates.results)}"),
)


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """What suffices for how many scenes."""
    chosen = data[data["recommended"].astype(str) == "True"]
    if not len(chosen):
        return Answer("How little model does a shape need?")
    simple, large = int(chosen["kind"].eq("one part").sum()), chosen.loc[chosen["stored"].idxmax()]
    said = (
        f"A single part suffices for *{simple} of {len(chosen)}* scenes; the most is {large['rung']} of "
        f"{large['stored']:,.0f} stored numbers, for {large['scene']}."
    )
    return Answer("How little model does a shape need?", said)
