"""Fig. 19 of DIST: a reconstructed shape with colours, in several sizes, from several sides, under several lights."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.report.data.experiments import Experiment
from bench.report.data.records import Record, grouped, row_of
from bench.report.pages.images import dvr_table2
from bench.report.write import pictures
from bench.report.write.gallery import Block, Cell, draw, shown_alone
from bench.report.write.result import Result
from bench.report.write.shapes import scene_of
from bench.report.write.table import FAMILY, IDENTITY, metrics, to_data

PLACE = 49
READS = dvr_table2.READS
PRESET = "rgb_dist"  # the row that is shown, where it has a run that ended ok; else the first that has
MOST_SCENES = 3
SIZES = ("size_0_", "size_1_", "size_2_")  # of images.npz, see `bench.reconstruct.pictures`
TURNED = {"turned_0_": "turned by 120°", "turned_1_": "turned by 240°"}  # about the vertical axis, likewise
LIGHTS = {  # towards the light; axes to the right, up, towards the camera
    "light from the left": (-0.8, 0.3, 0.5),
    "light from above": (0.0, 0.9, 0.45),
    "light from the right": (0.8, 0.3, 0.5),
}
AMBIENT = 0.25  # of a light; the rest falls off with the cosine
NOTES = (
    "The shape was learnt from photographs alone, by {row}; scenes are the first ones, not chosen ones. The photograph "
    "was held out, and sizes and lights are seen by its camera; the turns are about the vertical axis.",
    f"Lights: the learnt colours times {AMBIENT:g} + {1 - AMBIENT:g} max(normal · light, 0), without shadows.",
    "DIST, Fig. 19, renders a network of textures with codes; here colours are a network of position, normal and view.",
)
RUNS = (FAMILY, *IDENTITY, *metrics("seen_chamfer_l1", "psnr"))


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per scene."""
    rows = experiment.rows()
    ended = [row for row, runs in rows.items() if any(run["status"] == "ok" for run in runs)] or list(rows)
    row = next((row for row in ended if row.preset == PRESET), ended[0])
    of_row = grouped([record for record in experiment.records if row_of(record) == row], scene_of)
    kept = [records[0] for records in of_row.values()][:MOST_SCENES]
    shown = replace(experiment, records=kept, left_out=experiment.left_out + len(experiment.records) - len(kept))
    lines, missing, columns = {}, [], []
    for record in kept:
        names, lines[scene_of(record)], why = _line(record, shown.folder(record))
        columns = names or columns
        missing += [f"No pictures of {row.name}, {scene_of(record)}: {why}."] if why else []
    return Result(
        shown,
        "A reconstructed shape, rendered again.",
        f"The shape of {row.name} in several sizes, from other sides, and under other lights.",
        remarks=(*(note.format(row=row.name) for note in NOTES), *missing),
        data=to_data(RUNS, kept),
        figure=draw([Block("", columns, lines)], across=1),
    )


def _line(record: Record, folder: Path) -> tuple[list[str], list[Cell], str]:
    """The names of a line's columns, its cells, and why there are none."""
    parts = [f"{prefix}{part}" for prefix in (*SIZES, *TURNED) for part in ("colours", "normals", "hit")]
    found, why = pictures.arrays(folder, ("photograph", *parts))
    status = "" if record["status"] == "ok" else record["status"]
    if why:
        return [], [Cell(note=status or "no picture")], why
    hits = {prefix: found[f"{prefix}hit"] for prefix in (*SIZES, *TURNED)}
    last = SIZES[-1]
    columns = {"photograph": shown_alone(found["photograph"].astype(float), hits[last])}
    for prefix in (*SIZES, *TURNED):
        name = TURNED.get(prefix, f"{max(hits[prefix].shape)} pixels")
        columns[name] = shown_alone(_on_white(found[f"{prefix}colours"], hits[prefix]), hits[prefix])
    for name, light in LIGHTS.items():
        lit = found[f"{last}colours"] * _shade(found[f"{last}normals"].astype(float), light)
        columns[name] = shown_alone(_on_white(lit, hits[last]), hits[last])
    return [*columns], [Cell((picture,), status) for picture in columns.values()], ""


def _on_white(colours: np.ndarray, hit: np.ndarray) -> np.ndarray:
    return np.where(hit[..., None], colours.astype(float), 1.0).clip(0, 1)


def _shade(normals: np.ndarray, light: tuple[float, float, float]) -> np.ndarray:
    towards = np.array(light) / np.linalg.norm(light)
    return AMBIENT + (1 - AMBIENT) * (normals @ towards).clip(0)[..., None]
