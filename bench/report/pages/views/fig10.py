"""Fig. 10 of DIST: shape from many views under other focal lengths and other noise in the initial code."""

import numpy as np
import pandas as pd

from bench.records import format
from bench.report.data.conditions import Condition, cells, middle
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import ONE_WAY
from bench.report.write.answer import Answer
from bench.report.write.conditions import draw
from bench.report.write.result import Result
from bench.report.write.table import FAMILY, IDENTITY, configured, estimate, metrics, text, to_data, to_table

PLACE = 50
CONDITIONS = (
    Condition("focal", "focal length / the scene's", 1.0),
    Condition("start_scale", "noise in the initial code (prior's σ)", 1.0),
)
READS = (Selection("fig10", ("multiview",), ("dataset", "task"), tuple(one.key for one in CONDITIONS)),)
NOTES = (
    "One condition varies, the other is at 1. The noise is that of a random code, in standard deviations of the "
    "prior's training codes: 0 is the mean shape.",
    "A run that did not end ok counts as infinite, drawn at the upper edge. The paper (Fig. 10, a chart without "
    "numbers) finds its method robust to both.",
)
RUNS = (
    *(FAMILY, *(configured(one.key, "task", one.key) for one in CONDITIONS), *IDENTITY),
    *metrics(ONE_WAY, "chamfer_l2"),
)
COLUMNS = (
    *(text("family", "Family"), text("method", "Method"), text("condition", "Condition")),
    *estimate("error", "Median"),
)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per family, method and value of a condition."""
    errors = {cell: middle(records) for cell, records in cells(experiment, CONDITIONS).items()}
    lines = [
        {"family": name, "method": row.name, "condition": f"{one.label}: {value:g}", "error": error}
        for (name, row, one, value), error in errors.items()
    ]
    return Result(
        experiment,
        "Shape from many views under other focal lengths and starts.",
        "Median Chamfer distance from truth to prediction (squared scene units, times 1000).",
        interval="95 % bootstrap intervals over {shapes and seeds}",
        estimates=errors.values(),
        remarks=NOTES,
        data=to_data(RUNS, experiment.records),
        table=to_table(COLUMNS, lines),
        figure=draw(errors, CONDITIONS),
    )


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The conditions of a row between which its median error changes most."""
    keys = [one.key for one in CONDITIONS]
    errors = data["chamfer_gt_to_pred"].where(data["status"] == "ok", np.inf)
    medians = errors.groupby([data["row"], data["family"], *(data[key] for key in keys)], sort=False).median()
    spread = (medians.groupby(level=[0, 1]).max() / medians.groupby(level=[0, 1]).min()).sort_values()
    if not len(spread):
        return Answer("Does another focal length or start change the shape that is found?")
    row, family = spread.index[-1]
    ratio = "∞" if np.isinf(spread.iloc[-1]) else format.number(spread.iloc[-1])
    said = f"Over all conditions the median error changes by a factor of up to *{ratio}* ({row}, {family})."
    return Answer("Does another focal length or start change the shape that is found?", said)
