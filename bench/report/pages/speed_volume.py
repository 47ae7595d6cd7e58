"""The hypervolume that the settings of each renderer dominate in the plane of error and time."""

from typing import Any

import numpy as np

from bench.records import format
from bench.report.data import statistics
from bench.report.data.experiments import Experiment, together
from bench.report.data.speed import SEED, TRIALS, Setting, settings, sizes
from bench.report.write.caption import captioned
from bench.report.write.result import Result
from bench.report.write.table import Column, shown, text, to_data, to_table

PLACE = 100
READS = tuple(trial.selection for trial in TRIALS)
COLUMNS = (
    *(text("trial", "Trial"), text("renderer", "Renderer"), text("settings", "Settings")),
    *(Column("hypervolume", "Hypervolume"), Column("low"), Column("high")),
    shown("95 % interval", lambda line: format.interval(line["low"], line["high"])),
    *(Column("reference_seconds"), Column("reference_error")),
)


def make(completion: Experiment | None, rendering: Experiment | None) -> Result:
    """Makes the page, with a line per renderer: the area that its settings dominate, with its interval."""
    trials = [settings(runs, trial) for runs, trial in zip((completion, rendering), TRIALS, strict=True)]
    lines = [line for rows in trials for line in _lines(rows)]
    return Result(
        title="Area that each renderer dominates in the plane of error and time.",
        **captioned(
            together(completion, rendering),
            "Area dominated by the medians of a renderer's settings, in powers of ten of seconds times powers of ten "
            "of error, up to twice the largest finite median of either; larger is better.",
            interval="95 % bootstrap intervals over shapes and seeds",
            notes=(
                "More settings can only add to the area: it does not rank renderers with different numbers of "
                "settings.",
                sizes(*trials),
            ),
        ),
        data=to_data(COLUMNS, lines),
        table=to_table(COLUMNS, lines),
    )


def _lines(rows: list[Setting]) -> list[dict[str, Any]]:
    """The lines of a trial, one per renderer; none where all medians are infinite."""
    finite = np.array([row.point for row in rows if np.isfinite(row.point).all()])
    if not len(finite):
        return []
    reference = tuple(float(x) for x in 2 * finite.max(axis=0))
    lines = []
    for renderer in dict.fromkeys(row.renderer for row in rows):
        points = [(row.costs, row.errors) for row in rows if row.renderer == renderer]
        area = statistics.hypervolume_interval(points, reference=reference, seed=SEED)
        identity = {"trial": rows[0].trial.title, "renderer": renderer, "settings": len(points)}
        numbers = {"hypervolume": area.value, "low": area.low, "high": area.high}
        lines.append({**identity, **numbers, "reference_seconds": reference[0], "reference_error": reference[1]})
    return lines
