"""Shape from one image, by the renderer whose gradients taught the network: the same training, another renderer."""

import math
from dataclasses import replace
from typing import Any

import pandas as pd

from bench.records import format
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import RunKey
from bench.report.pages.single_view.dvr_table1 import COMPARED, INTERVAL, RATIOS, RUNS, compared_lines, draw, over
from bench.report.write.answer import Answer
from bench.report.write.result import Result
from bench.report.write.table import Column, shown, text, thousandfold, to_data, to_table

PLACE = 39
READS = (Selection("single_view_renderers", ("single_view",), ("dataset", "task", "supervision"), setup=("machine",)),)
BASELINES = ("Mean shape", "Nearest image")  # labels of rows without a training
FIRST, TEACHER = "single_view_by_newton", "newton"  # the row that others are compared with, and its renderer
NOTES = (
    "The same network, shapes, images, rays, number of steps and losses, IDR's cross entropy of the mask included; no "
    "step learns from the visual hull. All are judged by the same shapes, which no training has seen.",
    "“Over ...”: the ratio of geometric means of Chamfer-L1 to that row over the same shapes; below 1 is better. A "
    "failed run counts as infinite.",
    "“Trained in” and “field values”: of the training, once for the family, beside another training.",
)
COLUMNS = (
    *(text("family", "Family"), text("method", "Renderer"), Column("iou", "IoU")),
    Column("chamfer_l1", "Chamfer-L1", show=thousandfold),
    INTERVAL,
    shown("Over Newton", lambda line: str(line[FIRST]) if line.get(FIRST) else ""),
    *RATIOS,
    *(Column("normal_consistency", "Normals"), Column("psnr", "PSNR")),
    Column("training", "Trained in", show=format.seconds),
    Column("training_values", "Field values", show=format.count),
    text("failed", "Failed"),
)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per family and row."""
    lines: list[dict[str, Any]] = []
    for name, records in experiment.families().items():
        lines += compared_lines(name, replace(experiment, records=records), (FIRST, *COMPARED))
    return Result(
        experiment,
        "Shape from one image, by the renderer of the training.",
        "Chamfer-L1 in scene units, times 1000; medians over shapes.",
        interval="95 % bootstrap intervals over shapes",
        estimates=[line["interval"] for line in lines],
        remarks=NOTES,
        data=to_data(RUNS, experiment.records),
        table=to_table(COLUMNS, lines),
        figure=draw(experiment),
    )


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """In each family the renderer with the least ratio of the error to that of the first row, paired by shape."""
    said = [text for name, runs in data.groupby("family", sort=False) if (text := _least(str(name), runs))]
    trained = ", one training each" if data["seed"].nunique() == 1 else ""
    verdict = f"Chamfer-L1 over that of the network that Newton taught, on the same unseen shapes{trained}: "
    verdict += f"{'; '.join(said)}."
    return Answer("Does it matter which renderer teaches a network of one image?", verdict if said else "")


def _least(family: str, runs: pd.DataFrame) -> str:
    """The least ratio of a family, of how many; empty where there is nothing to compare."""
    taught = runs[~runs["row"].isin(BASELINES)]
    errors = taught["chamfer_l1"].where(taught["status"] == "ok", math.inf)
    of_rows: dict[str, dict[RunKey, float]] = {}
    for row, index, seed, value in zip(taught["row"], taught["index"], taught["seed"], errors, strict=True):
        of_rows.setdefault(str(row), {})[index, 0, seed] = value
    newton = taught.loc[taught["renderer"] == TEACHER, "row"].astype(str).tolist()
    if not newton:
        return ""
    first = of_rows.pop(newton[0])
    ratios = {row: ratio for row, own in of_rows.items() if (ratio := over(own, first)) is not None}
    if not ratios:
        return ""
    row, least = min(ratios.items(), key=lambda item: item[1].value)
    among = f", the least of {len(ratios)}" if len(ratios) > 1 else ""
    value, _, rest = str(least).partition(" ")
    return f"{family}: {row} *{value}*" + (f" {rest}" if rest else "") + among
