"""Galleries: pictures of shapes in a grid with names of rows and columns, in which failures are shown as such."""

import textwrap
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.report.data.experiments import Experiment
from bench.report.data.records import Record, family, grouped, index, row_of
from bench.report.write import chart, pictures

TILE = 160  # pixels of a picture's side in a gallery
GAP = 4  # pixels between cells
NAMES = 1.3  # inches beside the pictures, for the names of rows
LETTERS = 18  # of a line of such a name
LETTERS_PER_INCH = 19  # of names of columns
LARGEST = 0.9  # inches of a picture's side
FRAME = 0.85  # grey between cells
FOUND, TRUE, START = "found", "true", "start"  # of images.npz, see `bench.pictures.run_figures.save_gallery`
FRONT, BEHIND = 0, 1  # its views
Window = tuple[float, float, float]  # see `style.window`


@dataclass(frozen=True)
class Cell:
    """Pictures [height, width, 3] side by side, from 0 to 1, and what is written over them; without any, a blank."""

    pictures: tuple[np.ndarray, ...] = ()
    note: str = ""


@dataclass(frozen=True)
class Block:
    """Cells by the name of their row, with the names of their columns."""

    title: str
    columns: list[str]
    rows: dict[str, list[Cell]]  # what a row lacks at its end is blank


class Scene:
    """The runs of one scene, all of which are seen in the same part of their pictures."""

    def __init__(self, experiment: Experiment, records: Sequence[Record], kinds: tuple[str, ...] = (FOUND, TRUE)):
        """Reads the pictures.

        Args:
            experiment: with the run folders.
            records: of the scene.
            kinds: of the shapes that are shown.
        """
        names = ("given", *(f"{kind}_{part}" for kind in kinds for part in ("normals", "hit")))
        self._arrays = {r["folder"]: pictures.arrays(experiment.folder(r), names) for r in records}
        hits = [found[f"{kind}_hit"] for found, _ in self._arrays.values() if found for kind in kinds]
        self._windows = [style.window([hit[view] for hit in hits]) for view in (FRONT, BEHIND)]

    def missing(self, name: str) -> list[str]:
        """Notes on runs of the scene of that name without pictures, one for each reason."""
        reasons = Counter(why for _, why in self._arrays.values() if why)
        return [f"No pictures of {count} runs, {name}: {why}." for why, count in reasons.items()]

    def shape(self, record: Record, kind: str = FOUND, views: tuple[int, ...] = (FRONT, BEHIND)) -> Cell:
        """A shape of a run, with the run's status where it did not end ok and the shape is what it found."""
        found, _ = self._arrays[record["folder"]]
        note = record["status"] if record["status"] != "ok" and kind == FOUND else ""
        if not found:
            return Cell(note=note or "no picture")
        if not found[f"{kind}_hit"].any():
            return Cell(note=note or "no surface")
        normals, hit = found[f"{kind}_normals"].astype(float), found[f"{kind}_hit"]
        return Cell(tuple(tile(pictures.coloured(normals[v], hit[v]), self._windows[v]) for v in views), note)

    def any(self, records: Sequence[Record], kind: str, views: tuple[int, ...] = (FRONT, BEHIND)) -> Cell:
        """A shape that all of some runs share, of the first run with pictures."""
        return next((self.shape(r, kind, views) for r in records if self._arrays[r["folder"]][0]), Cell())

    def given(self, record: Record) -> Cell:
        """The depths that a run was given, near ones yellow."""
        found, why = self._arrays[record["folder"]]
        if not found:
            return Cell(note="no picture" if why else "")
        depth = found["given"].astype(float)
        known = depth[np.isfinite(depth)]
        low, high = (known.min(), known.max()) if known.size else (0.0, 1.0)
        colours = colormaps["viridis_r"].with_extremes(bad=style.PAPER)
        shown = colours(np.ma.masked_invalid((depth - low) / max(high - low, 1e-6)))[..., :3]
        return Cell((tile(shown, self._windows[FRONT]),))


def first_shapes(experiment: Experiment, most: int, presets: Sequence[str] = ()) -> Experiment:
    """The runs of the first shapes of each family, of the least seed each; of some presets, where these were run."""
    wanted = [record for record in experiment.records if row_of(record).preset in presets] or experiment.records
    kept = []
    for records in grouped(wanted, family).values():
        numbers = sorted({index(record) for record in records})[:most]
        seed = min(record["seed"] for record in records)
        kept += [r for r in records if index(r) in numbers and r["seed"] == seed]
    return replace(experiment, records=kept, left_out=experiment.left_out + len(experiment.records) - len(kept))


def shown_alone(picture: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """A tile with the part of a picture that shows a shape."""
    return tile(picture, style.window([hit]))


def tile(picture: np.ndarray, window: Window) -> np.ndarray:
    """The part of a picture [height, width, 3] in a window, at the size of a tile, with its pixels as they are."""
    top, left, side = window
    places = (np.arange(TILE) + 0.5) / TILE * side
    larger = max(picture.shape[:2])
    rows, columns = (
        ((places + start) * larger).astype(int).clip(0, length - 1)
        for start, length in zip((top, left), picture.shape[:2], strict=True)
    )
    return picture[rows][:, columns]


@style.styled
def draw(blocks: Sequence[Block], across: int) -> Figure:
    """Draws blocks one above the other.

    Args:
        blocks: of as many columns each.
        across: pictures side by side in a cell.
    """
    columns = max([1, *(len(block.columns) for block in blocks)])
    inches = min((style.WIDTH - NAMES) / (columns * across), LARGEST)  # of a picture
    wide = max(round(inches * across * LETTERS_PER_INCH), 6)
    blocks = [replace(block, columns=[_wrapped(name, wide) for name in block.columns]) for block in blocks]
    heads = [0.33 + 0.12 * max((name.count("\n") for name in block.columns), default=0) for block in blocks]
    lines = [max(len(block.rows), 1) * inches for block in blocks]
    size = {"width": NAMES + columns * across * inches, "height_ratios": lines or [1]}
    figure, axes = chart.sheet(sum(heads) + sum(lines) + 0.1, max(len(blocks), 1), 1, **size)
    figure.get_layout_engine().set(**pictures.CLOSE)
    for axis in axes.flat:
        axis.axis("off")
    for axis, block in zip(axes.flat, blocks, strict=False):
        _draw_block(axis, block, across)
    return figure


def _wrapped(text: str, letters: int) -> str:
    """The text in lines of so many letters, besides those that it has."""
    return "\n".join(part for line in text.split("\n") for part in textwrap.wrap(line, letters) or [""])


def _draw_block(axis: Axes, block: Block, across: int) -> None:
    """Draws a block as one image, since a figure of many axes takes seconds, with the notes of its cells over it."""
    axis.axis("on")
    style.bare(axis)
    columns = max(len(block.columns), 1)
    lines = [[*cells, *[Cell()] * (columns - len(cells))] for cells in block.rows.values()]
    rows = [[_pasted(cell, across) for cell in cells] for cells in lines]
    montage = np.concatenate([np.concatenate(row, axis=1) for row in rows])
    axis.imshow(montage, interpolation="none")
    height, width = TILE + GAP, across * TILE + GAP
    axis.set_xticks([width * (place + 0.5) for place in range(len(block.columns))], block.columns)
    names = [_wrapped(name, LETTERS) for name in block.rows]
    axis.set_yticks([height * (place + 0.5) for place in range(len(names))], names)
    axis.tick_params(length=0, top=False, bottom=False, labeltop=True, labelbottom=False, labelsize=6)
    axis.set_title(block.title, fontsize=7, loc="left")
    for line, cells in enumerate(lines):
        for place, cell in enumerate(cells):
            where = (width * (place + 0.5), height * (line + (0.88 if cell.pictures else 0.5)))
            axis.text(*where, cell.note, ha="center", va="center", fontsize=5, color=style.MISSED)


def _pasted(cell: Cell, across: int) -> np.ndarray:
    """The pictures of a cell in the middle of its place, with a frame to the right and below."""
    place = np.ones((TILE + GAP, across * TILE + GAP, 3))
    place[-GAP:], place[:, -GAP:] = FRAME, FRAME
    if cell.pictures:
        pasted = np.concatenate(cell.pictures, axis=1)
        left = (across * TILE - pasted.shape[1]) // 2
        place[:TILE, left : left + pasted.shape[1]] = pasted
    return place
