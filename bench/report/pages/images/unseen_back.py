"""Photographs from one side: what renderers make of the side that none of them shows, and where their weights lie."""

import math

import pandas as pd

from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import definitions, grouped
from bench.report.write.answer import Answer
from bench.report.write.result import Result
from bench.report.write.shapes import COST, draw_pictures, lines_of, scene_of
from bench.report.write.table import (
    FAMILY,
    IDENTITY,
    LOOP,
    Column,
    metrics,
    percent,
    text,
    thousandfold,
    to_data,
    to_table,
)

PLACE = 51
READS = (Selection("unseen_back", ("reconstruction",), ("dataset", "task", "silhouette"), setup=("scenes", "machine")),)
NAMES = ("seen_roughness", "unseen_roughness", "own_early_weight", "seen_chamfer_l1", "chamfer_l1", "mask_iou")
DEFINED = {"seen_roughness": "Roughness", "unseen_roughness": "Roughness", "own_early_weight": "Early weight"}
MOST_SCENES, MOST_COLUMNS = 3, 9  # of the figure: the truth, and four renderers under two losses of the mask
NOTES = (
    "Users of NeuS report weights in front of the surface and a bumpy back where no photograph looks. All photographs "
    "are from within 45 degrees of one direction; pictures are from the opposite one.",
    "All rows share one field (4 layers of 128, a distance). A row's name says its loss of the mask; without one it is "
    "the renderer's own. Two rows that differ in both compare both at once: read a renderer under two losses, or two "
    "renderers under one.",
    "The early weight is that of held-out photographs, which are from the same side, and with masks: weights in front "
    "of the surface where no photograph looks are not in it.",
)
COLUMNS = (
    text("method", "Method"),
    Column("seen_roughness", "Roughness, seen (degrees)"),
    Column("unseen_roughness", "unseen"),
    Column("own_early_weight", "Early weight", show=percent),
    Column("seen_chamfer_l1", "Chamfer-L1, seen", show=thousandfold),
    Column("chamfer_l1", "all", show=thousandfold),
    Column("mask_iou", "Mask IoU"),
    *COST,
)
RUNS = (FAMILY, *IDENTITY, *metrics(*NAMES), *LOOP)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per row and pictures from behind."""
    scenes = list(grouped(experiment.records, scene_of))
    rows, shown = list(experiment.rows()), {"back_truth": "true normals"}
    figure, missing = draw_pictures(experiment, rows, scenes[:MOST_SCENES], shown, MOST_COLUMNS, side="back_")
    return Result(
        experiment,
        "Photographs from one side, and the back that none shows.",
        f"Medians over {len(scenes)} scene{'s' if len(scenes) > 1 else ''}, distances in scene units, times 1000; in "
        "the figure, colours above and normals below, from behind.",
        remarks=(*NOTES, *definitions(experiment.records, DEFINED), *missing),
        data=to_data(RUNS, experiment.records),
        table=to_table(COLUMNS, lines_of(experiment, NAMES)),
        figure=figure,
    )


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """Renderers and losses of the mask whose unseen sides are no bumpier than the truth's, and the bumpiest one."""
    bumps = data["unseen_roughness"].where(data["status"] == "ok", math.inf).dropna()
    medians = bumps.groupby(data["row"], sort=False).median()
    smooth = list(medians.index[medians <= 0])
    said = [f"No bumpier than the truth, by their medians: {'; '.join(smooth)}."] if smooth else []
    if 0 < medians.max() < math.inf:
        said.append(f"The bumpiest, by *{medians.max():.1f}°* more than the truth: {medians.idxmax()}.")
    return Answer("What leaves bumps on the side that no photograph shows?", " ".join(said))
