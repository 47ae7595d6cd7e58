"""Fig. 19 of DIST: a reconstructed shape with colours, in several sizes, from several sides, under several lights."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.pictures import style
from bench.report import gallery
from bench.report.data.experiments import Experiment
from bench.report.data.records import Record, grouped, row_of
from bench.report.gallery import Arrays, Block, Cell, coloured
from bench.report.pages.images import dvr_table2
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
        figure=gallery.draw([Block("", columns, lines)]),
    )


def _line(record: Record, folder: Path) -> tuple[list[str], list[Cell], str]:
    """The names of a line's columns, its cells, and why there are none."""
    status = "" if record["status"] == "ok" else record["status"]
    seen, why = {}, ""
    for prefix in (*SIZES, *TURNED):
        seen[prefix], said = gallery.arrays(folder, [prefix + part for part in ("colours", "normals", "hit")])
        why = why or said
    photograph, said = gallery.arrays(folder, ["photograph"])
    if why or said:
        return [], [Cell(note=status or "no picture")], why or said
    last = seen[SIZES[-1]], SIZES[-1]
    shown = {"photograph": (photograph["photograph"], last[0][f"{last[1]}hit"])}
    for prefix, found in seen.items():
        name = TURNED.get(prefix, f"{max(found[f'{prefix}hit'].shape)} pixels")
        shown[name] = _lit(found, prefix)
    shown |= {name: _lit(*last, light) for name, light in LIGHTS.items()}
    return [*shown], [Cell([(picture, style.window([hit]))], status) for picture, hit in shown.values()], ""


def _lit(found: Arrays, prefix: str, light: tuple[float, float, float] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The picture of a shape, as it is or under a light, and its hits."""
    colours, normals, hit = (found[prefix + part] for part in ("colours", "normals", "hit"))
    return coloured(colours if light is None else colours * _shade(normals, light), hit), hit


def _shade(normals: np.ndarray, light: tuple[float, float, float]) -> np.ndarray:
    towards = np.array(light) / np.linalg.norm(light)
    return AMBIENT + (1 - AMBIENT) * (normals @ towards).clip(0)[..., None]
