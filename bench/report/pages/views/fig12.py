"""After Fig. 12 of DIST: shape from many views where the initial similarity is wrong, and is optimised as well."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pandas as pd

from bench.report.data.conditions import Condition, cells, middle
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import ONE_WAY, SCALE, Record, Row, error, grouped, row_of, setting, solid
from bench.report.data.statistics import Interval, share
from bench.report.write.answer import Answer
from bench.report.write.conditions import draw
from bench.report.write.result import Result
from bench.report.write.table import (
    FAMILY,
    IDENTITY,
    configured,
    counted,
    estimate,
    metrics,
    text,
    to_data,
    to_table,
)

PLACE = 55
CONDITIONS = (
    Condition("shift", "shift (scene units)", 0.0),
    Condition("degrees", "rotation (degrees)", 0.0),
    Condition("scale", "size / true size", 1.0),
)
READS = (Selection("fig12", ("multiview",), ("dataset", "task"), (*(one.key for one in CONDITIONS), "similarity")),)
SUCCESS = 1.0  # squared scene units x 1000, about what DIST publishes in its Table 3
NOTES = (
    f"A success ended ok with an error below {SUCCESS:g}; its interval is Clopper and Pearson's, over shapes.",
    "One condition varies, the others are neutral. The shift's direction and the rotation's axis are random, the same "
    "for every method and size. At zero displacement a similarity is optimised as well; “place known” is without one, "
    "and has no point in the figure: what lies between the two is what it costs to seek a similarity.",
    "The initial code is random, too. A run that did not end ok counts as infinite, drawn at the upper edge.",
    "The paper (Fig. 12) shows pictures of real chairs and no numbers; here shapes and photographs are synthetic.",
)
RUNS = (
    *(FAMILY, *(configured(one.key, "task", one.key) for one in CONDITIONS), *IDENTITY),
    configured("similarity", "task", "similarity"),
    *metrics(ONE_WAY, "chamfer_l2"),
)
COLUMNS = (
    *(text("family", "Family"), text("method", "Method"), text("condition", "Condition"), text("success", "Success")),
    *estimate("error", "Median"),
)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per family, method and value of a condition."""
    sought = [record for record in experiment.records if not place_known(record)]
    of_cell = cells(replace(experiment, records=sought), CONDITIONS)
    errors = {cell: middle(records) for cell, records in of_cell.items()}
    lines = [
        _line(name, row, f"{one.label}: {value:g}", of_cell[name, row, one, value], found)
        for (name, row, one, value), found in errors.items()
    ]
    for name, records in experiment.families().items():
        for row, known in grouped(filter(place_known, records), row_of).items():
            lines.append(_line(name, row, "place known", known, middle(known)))
    return Result(
        experiment,
        "Shape from many views, misplaced at the start.",
        "Runs that succeeded, and median Chamfer distance from truth to prediction (squared scene units, times 1000), "
        "over the displacement.",
        interval="95 % bootstrap intervals over {shapes and seeds}",
        estimates=errors.values(),
        remarks=NOTES,
        data=to_data(RUNS, experiment.records),
        table=to_table(COLUMNS, lines),
        figure=draw(errors, CONDITIONS, success=SUCCESS) if errors else None,
    )


def place_known(record: Record) -> bool:
    """Whether a run began in place, and no similarity was optimised."""
    return not setting(record["config"], "task", "similarity") and all(
        one.of(record) == one.neutral for one in CONDITIONS
    )


def _line(name: str, row: Row, condition: str, records: Sequence[Record], found: Interval) -> dict[str, Any]:
    told = {"family": name, "method": row.name, "condition": condition, "success": _successes(records)}
    return told | {"error": found}


def _successes(records: Sequence[Record]) -> str:
    of_shape = [[_succeeded(run) for run in runs] for runs in grouped(records, solid).values()]
    rate: Interval = share([sum(runs) for runs in of_shape], [len(runs) for runs in of_shape])
    return counted(sum(map(sum, of_shape)), len(records), rate)


def _succeeded(record: Record) -> bool:
    return record["status"] == "ok" and SCALE * error(record, ONE_WAY) < SUCCESS


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The shares of successes of each row, over all conditions but known places."""
    off = pd.concat([data[one.key] != one.neutral for one in CONDITIONS], axis=1).any(axis=1)
    data = data[off | data["similarity"].eq(True)]
    right = (data["status"] == "ok") & (SCALE * data[ONE_WAY] < SUCCESS)
    counts = right.groupby(data["row"], sort=False).agg(["sum", "count"])
    said = "; ".join(f"{row} *{int(own['sum'])} of {own['count']}*" for row, own in counts.iterrows())
    return Answer("Is a shape found from a wrong similarity?", f"Runs with an error below {SUCCESS:g}: {said}.")
