"""Fig. 4 of DIST: the images of each strategy of sphere tracing compared with the reference."""

import pandas as pd

from bench.report import gallery
from bench.report.data.experiments import Experiment, Selection
from bench.report.write.answer import Answer
from bench.report.write.result import Result
from bench.report.write.table import IDENTITY, Column, metric, through, to_data

PLACE = 210
READS = (Selection("fig4", ("ablation",)),)
NOTES = (
    "Pictures are cropped to the part with hits. A row that did not finish at the requested size is shown at the "
    "largest size at which it did.",
)
MOST_COLUMNS = 5
COLUMNS = (  # of a record and the counts of its picture
    *through(lambda line: line[0], *IDENTITY),
    *through(lambda line: line[1], *map(Column, gallery.COUNTED)),
    *through(lambda line: line[0], metric("depth_error_median")),
)


def make(experiment: Experiment) -> Result:
    """Makes the page, with the reference and a column per row; rows without pictures keep their place."""
    chosen = experiment.of_newest_scene()
    found = gallery.compared(chosen, chosen.names(), MOST_COLUMNS)
    return Result(
        chosen,
        "Errors of each strategy in the image.",
        "Above, normals (right, up, towards the camera as red, green, blue); below, the angle to the reference's "
        "normals.",
        remarks=(*found.missing, *NOTES),
        data=to_data(COLUMNS, zip(chosen.records, found.counts, strict=True)),
        figure=gallery.draw(found.blocks, largest=found.largest),
    )


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The rows with most and least wrong pixels."""
    wrong = (data["lost"] + data["false"]).dropna()
    if not len(wrong):
        return Answer("Which pixels does each strategy get wrong?")
    most, least = data.loc[wrong.idxmax()], data.loc[wrong.idxmin()]
    said = (
        f"Missed and spurious pixels: *{wrong.min():.0f}* ({least['row']}) to {wrong.max():.0f} ({most['row']}) "
        f"of {most['hits']:,.0f}."
    )
    return Answer("Which pixels does each strategy get wrong?", said)
