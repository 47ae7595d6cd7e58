"""Rank correlations of loss and Chamfer distance during an optimisation."""

from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from bench.pictures import style
from bench.report.data import statistics
from bench.report.data.curves import history_of, spearman
from bench.report.data.experiments import Experiment
from bench.report.data.records import Row, by_shape, run_key
from bench.report.data.subjects.speed import COMPLETION, SEED, Setting, main_settings, settings, sizes
from bench.report.write import chart
from bench.report.write.answer import Answer
from bench.report.write.result import Result
from bench.report.write.table import Column, shown, text, to_data, to_table

PLACE = 110
READS = (COMPLETION.selection,)
NOTES = (
    "Within a run: the median over runs. All together: over the checkpoints of all runs of a row (as in DIST, Fig. 5, "
    "right). Checkpoints of one run are not independent: this is no test of significance.",
)
COLUMNS = (
    *(text("row", "Setting"), text("renderer"), text("runs", "Runs")),
    *(Column("within", "Within a run"), Column("low"), Column("high")),
    shown("95 % interval", lambda line: line["spread"].ends() if line["spread"] else ""),
    *(Column("together", "All together"), Column("looks")),
)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per setting: its rank correlation within runs and over all runs."""
    rows = settings(experiment, COMPLETION)
    histories = {row.row: [history_of(experiment, record).dropna() for record in row.records] for row in rows}
    lines = [_line(row, histories[row.row]) for row in rows]
    clouds = {row: pd.concat(of_row, ignore_index=True) for row, of_row in histories.items()}
    return Result(
        experiment,
        "Correlation of loss and Chamfer distance.",
        "Spearman's rank correlation of loss and Chamfer distance over the checkpoints of a run.",
        interval="95 % bootstrap intervals over {shapes and seeds}",
        estimates=[line["spread"] for line in lines if line["spread"]],
        remarks=(sizes(rows), *NOTES),
        data=to_data(COLUMNS, lines),
        table=to_table(COLUMNS, lines),
        figure=draw(main_settings(rows), clouds),
    )


def _line(row: Setting, histories: list[pd.DataFrame]) -> dict[str, Any]:
    within = {run_key(record): spearman(h) for record, h in zip(row.records, histories, strict=True)}
    groups = by_shape({run: rho for run, rho in within.items() if rho is not None})
    spread = statistics.bootstrap(groups, statistics.median, seed=SEED) if groups else None
    numbers = {"within": spread.value, "low": spread.low, "high": spread.high} if spread else {}
    cloud = pd.concat(histories, ignore_index=True)
    pooled = {"together": spearman(cloud), "looks": len(cloud), "runs": sum(rho is not None for rho in within.values())}
    return {"row": row.name, "renderer": row.renderer, "spread": spread, **numbers, **pooled}


@style.styled
def draw(rows: list[Setting], clouds: dict[Row, pd.DataFrame]) -> Figure:
    """Draws the error over the loss of each renderer's main setting."""
    figure, ((axis,),) = chart.sheet(3.0, width=0.6 * style.WIDTH)
    for row in rows:
        cloud = clouds[row.row]
        chart.points(axis, row.renderer, cloud["loss"], cloud["error"], ms=3, alpha=0.7, label=row.name)
    for letter, column in (("x", "loss"), ("y", "error")):
        style.log_axis(axis, letter, [x for row in rows for x in clouds[row.row][column]])
    axis.set(xlabel="weighted loss", ylabel=COMPLETION.heading)
    figure.legend(loc="outside right upper")
    return figure


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The rows whose loss follows the error most and least."""
    known = data.dropna(subset="within").sort_values("within")
    if not len(known):
        return Answer("Does a falling loss mean a falling error?")
    least, most = known.iloc[0], known.iloc[-1]
    said = (
        f"Within a run loss and error correlate with ρ = *{least['within']:.2f}* ({least['row']}) to "
        f"{most['within']:.2f} ({most['row']})."
    )
    return Answer("Does a falling loss mean a falling error?", said)
