"""Photographs from one side: what renderers make of the side that none of them shows, and where their weights lie."""

import math

import pandas as pd

from bench.report import gallery
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import Record, definitions, grouped, row_of
from bench.report.gallery import Block, Cell, Scene
from bench.report.write.answer import Answer
from bench.report.write.result import Result
from bench.report.write.shapes import COST, lines_of, scene_of
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
MOST_SCENES = 3  # of the figure
BACK = "back_"  # prefix of arrays of the view from behind
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
    every = grouped(experiment.records, scene_of)
    arrays = [BACK + part for part in ("truth", "colours", "normals", "hit")]
    scenes = {name: Scene(experiment, every[name], arrays) for name in list(every)[:MOST_SCENES]}
    return Result(
        experiment,
        "Photographs from one side, and the back that none shows.",
        f"Medians over {len(every)} scene{'s' if len(every) > 1 else ''}, distances in scene units, times 1000; in "
        "the figure, colours above and normals below, from behind.",
        remarks=(*NOTES, *definitions(experiment.records, DEFINED), *gallery.missing(scenes.values())),
        data=to_data(RUNS, experiment.records),
        table=to_table(COLUMNS, lines_of(experiment, NAMES)),
        figure=gallery.draw([_block(name, experiment, every[name], scene) for name, scene in scenes.items()]),
    )


def _block(name: str, experiment: Experiment, records: list[Record], scene: Scene) -> Block:
    """The colours of each row from behind, and normals below, beside the true ones."""
    rows, at = list(experiment.rows()), {row_of(record): record for record in records}
    colours = [scene.cell(at.get(row), gallery.colours(BACK)) for row in rows]
    normals = [scene.cell(at.get(row), gallery.normals(BACK)) for row in rows]
    truth = scene.shared(records, lambda found: [found["back_truth"]])
    names = ["truth", *(row.name for row in rows)]
    return Block(name, names, {"colours": [Cell(), *colours], "normals": [truth, *normals]})


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """Renderers and losses of the mask whose unseen sides are no bumpier than the truth's, and the bumpiest one."""
    bumps = data["unseen_roughness"].where(data["status"] == "ok", math.inf).dropna()
    medians = bumps.groupby(data["row"], sort=False).median()
    smooth = list(medians.index[medians <= 0])
    said = [f"No bumpier than the truth, by their medians: {'; '.join(smooth)}."] if smooth else []
    if 0 < medians.max() < math.inf:
        said.append(f"The bumpiest, by *{medians.max():.1f}°* more than the truth: {medians.idxmax()}.")
    return Answer("What leaves bumps on the side that no photograph shows?", " ".join(said))
