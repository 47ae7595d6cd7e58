"""Galleries: pictures of runs in a grid with names of rows and columns, in which failures are shown as such."""

import textwrap
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from bench.pictures import style
from bench.records.format import plural
from bench.report.data.records import Record, Row, family, grouped, index, row_of
from bench.report.data.runs import Runs

LARGEST, LARGEST_COMPARED = 0.9, 1.5  # inches of a picture's side at most, and of one beside a colour bar
NAMES, BAR, MARGIN = 1.35, 0.7, 0.05  # inches of the names of rows at most, of a colour bar, and to the edges
LETTERS = 18  # of a line of a row's name
LETTERS_PER_INCH = 19  # of names of columns
FRAME = "#d9d9d9"
FOUND, TRUE, START = "found_", "true_", "start_"  # of images.npz, see `bench.pictures.run_figures.save_gallery`
SHAPES = tuple(kind + part for kind in (START, FOUND, TRUE) for part in ("normals", "hit"))
FRONT, BEHIND = 0, 1  # its views
REFERENCE = ("normals", "reference_normals", "hit", "reference_hit")  # see `bench.pictures.run_figures.save_images`
COUNTED = ("size", "hits", "lost", "false", "angle_median", "angle_p99", "angle_max")
JUDGED = "Normals are red, green and blue (right, up, towards the camera) of the mesh that is judged"  # of notes
Arrays = dict[str, np.ndarray]
Window = tuple[float, float, float]  # see `style.window`
Paint = Callable[[Arrays], Sequence[np.ndarray]]  # a picture [height, width, 3] per view; none without a surface


@dataclass(frozen=True)
class Cell:
    """Pictures side by side, each with the part of it that is shown, or None, and a note; without any, a blank."""

    pictures: Sequence[tuple[np.ndarray, Window | None]] = ()
    note: str = ""


@dataclass(frozen=True)
class Block:
    """Cells by the name of their row, with the names of their columns; what a row lacks at its end is blank."""

    title: str
    columns: list[str]
    rows: Mapping[str, Sequence[Cell]]


def arrays(folder: Path, names: Iterable[str]) -> tuple[Arrays, str]:
    """Arrays of a run folder's images.npz by name; none, and the reason, where one is missing or cannot be read."""
    path = folder / "images.npz"
    if not path.is_file():
        return {}, "no images.npz"
    try:
        # Opened here, since numpy does not close a file that it cannot read.
        with path.open("rb") as raw, np.lib.npyio.NpzFile(raw, allow_pickle=False) as file:
            found = {name: np.asarray(file[name]) for name in names}
    except KeyError as error:
        return {}, f"images.npz lacks an array: {error.args[0]}"
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error):
        return {}, "images.npz cannot be read"
    return {name: array.astype(bool if name.endswith("hit") else float) for name, array in found.items()}, ""


class Scene:
    """The pictures of runs of one scene, of which all show the same part: that with the shapes of all runs."""

    def __init__(self, runs: Runs, records: Iterable[Record], names: Iterable[str]):
        """Reads the arrays of those names; `reasons` are why runs have none."""
        found = {record["folder"]: arrays(runs.folder(record), tuple(names)) for record in records}
        self.reasons = [why for _, why in found.values() if why]
        self.arrays = {folder: known for folder, (known, _) in found.items() if known}
        hits = [a for known in self.arrays.values() for name, a in known.items() if name.endswith("hit")]
        views = [hit.reshape(-1, *hit.shape[-2:]) for hit in hits]
        self.windows = [style.window([hit[view] for hit in views]) for view in range(min(map(len, views), default=1))]

    def cell(self, record: Record | None, paint: Paint, views: Sequence[int] = (FRONT,)) -> Cell:
        """The pictures of a run in some views, with its status where it did not end ok."""
        if record is None:
            return Cell(note="no run")
        known, note = self.arrays.get(record["folder"]), record["status"] if record["status"] != "ok" else ""
        pictures = paint(known) if known else ()
        if not len(pictures):
            return Cell(note=note or ("no surface" if known else "no picture"))
        return Cell([(pictures[view], self.windows[view]) for view in views], note)

    def shared(self, records: Iterable[Record], paint: Paint, views: Sequence[int] = (FRONT,)) -> Cell:
        """What all runs of some records share, as the first of them with pictures has it."""
        known = next((record for record in records if record["folder"] in self.arrays), None)
        return Cell() if known is None else self.cell(known | {"status": "ok"}, paint, views)

    def whole(self, records: Iterable[Record], name: str) -> Cell:
        """A whole picture that all runs of some records share, of another camera than the others."""
        known = next((self.arrays[r["folder"]] for r in records if r["folder"] in self.arrays), None)
        return Cell() if known is None else Cell([(known[name], None)])


def coloured(colours: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """Colours [..., 3] where something is hit, on white."""
    return np.where(hit[..., None], np.nan_to_num(colours), 1.0).clip(0, 1)


def normals(prefix: str = "") -> Paint:
    """Pictures of the normals of a shape: right, up and towards the camera as red, green and blue."""

    def paint(found: Arrays) -> Sequence[np.ndarray]:
        hit = found[f"{prefix}hit"]
        shown = coloured(found[f"{prefix}normals"] / 2 + 0.5, hit)
        return list(shown.reshape(-1, *shown.shape[-3:])) if hit.any() else []

    return paint


def colours(prefix: str = "") -> Paint:
    """Pictures of the colours of a shape."""
    return lambda found: [coloured(found[f"{prefix}colours"], found[f"{prefix}hit"])]


def colours_above_normals(
    scene: Scene,
    title: str,
    rows: Iterable[Row],
    records: Sequence[Record],
    first: tuple[str, Paint],
) -> Block:
    """A block with the colours of each row and its normals below.

    `first` is the heading of the column before them, and its picture, beside the colours.
    """
    at = {row_of(record): record for record in records}
    heading, paint = first
    cells = {
        "colours": [scene.shared(records, paint), *(scene.cell(at.get(row), colours()) for row in rows)],
        "normals": [Cell(), *(scene.cell(at.get(row), normals()) for row in rows)],
    }
    return Block(title, [heading, *(row.name for row in rows)], cells)


def depth(found: Arrays) -> Sequence[np.ndarray]:
    """A picture of given depths, near ones yellow."""
    known = found["given"][np.isfinite(found["given"])]
    low, high = (known.min(), known.max()) if known.size else (0.0, 1.0)
    shown = colormaps["viridis_r"].with_extremes(bad=style.PAPER)
    return [shown(np.ma.masked_invalid((found["given"] - low) / max(high - low, 1e-6)))[..., :3]]


def angles(found: Arrays) -> np.ndarray:
    """Angles between normals and the reference's, in degrees; nan where not both hit, or one is not of unit length."""
    ours, true = found["normals"], found["reference_normals"]
    with np.errstate(invalid="ignore"):
        sine = np.linalg.norm(np.cross(ours, true), axis=-1)  # the cosine alone is inexact for small angles
        cosine = (ours * true).sum(-1)
        sound = found["hit"] & found["reference_hit"] & (np.hypot(sine, cosine) > 0.5)
        return np.where(sound, np.degrees(np.arctan2(sine, cosine)), np.nan)


def counted(found: Arrays) -> dict[str, Any]:
    """The size, the number of pixels of each kind, and angles in degrees, by the names in `COUNTED`."""
    hit, true, of = found["hit"], found["reference_hit"], angles(found)
    known = of[np.isfinite(of)]
    spread = [float(x) for x in np.percentile(known, (50, 99, 100))] if known.size else [None] * 3
    return dict(
        zip(COUNTED, [len(hit), *(int(m.sum()) for m in (true, true & ~hit, hit & ~true)), *spread], strict=True)
    )


def differences(largest: float) -> Paint:
    """Pictures of angles to the reference's normals, up to so many degrees, and of missed and spurious pixels."""

    def paint(found: Arrays) -> Sequence[np.ndarray]:
        shown = style.error_colours()(np.ma.masked_invalid(angles(found)) / largest)[..., :3]
        shown[found["reference_hit"] & ~found["hit"]] = to_rgb(style.MISSED)
        shown[found["hit"] & ~found["reference_hit"]] = to_rgb(style.SPURIOUS)
        return [shown]

    return paint


@dataclass(frozen=True)
class Compared:
    """Runs beside a reference: their pictures, the counts of each run, and the end of the scale of angles."""

    blocks: list[Block]
    counts: list[dict[str, Any]]
    missing: list[str]
    largest: float


def compared(runs: Runs, most: int) -> Compared:
    """Compares the runs of one scene with its reference: normals above, differences below, at most so many columns.

    The scale of angles ends at the 99th percentile over all pixels, rounded up. The reference is of the largest
    picture; the name of a run with a smaller one says so.
    """
    records = runs.records
    scene = Scene(runs, records, REFERENCE)
    found = [scene.arrays.get(record["folder"], {}) for record in records]
    counts = [counted(one) if one else {} for one in found]
    together = np.concatenate([np.empty(0), *(angles(one).ravel() for one in found if one)])
    known = together[np.isfinite(together)]
    largest = style.rounded_up(float(np.percentile(known, 99))) if known.size else 90.0
    sizes = [one.get("size", 0) for one in counts]
    best = sorted(zip(sizes, range(len(records)), strict=True), key=lambda pair: (-pair[0], pair[1]))
    heads = [f"{n}, {s} px" if 0 < s < best[0][0] else n for n, s in zip(runs.names(), sizes, strict=True)]
    true = scene.shared([records[place] for _, place in best], normals("reference_"))
    rows = {
        "normals": [true, *(scene.cell(record, normals()) for record in records)],
        "difference": [Cell(), *(scene.shared([record], differences(largest)) for record in records)],
    }
    heads, columns = ["reference", *heads], -(-(len(heads) + 1) // -(-(len(heads) + 1) // most))
    starts = range(0, len(heads), columns)  # of as few blocks as possible, of equal length
    blocks = [Block("", heads[at : at + columns], {n: c[at : at + columns] for n, c in rows.items()}) for at in starts]
    return Compared(blocks, counts, missing([scene]), largest)


def missing(scenes: Iterable[Scene]) -> list[str]:
    """A note per reason why runs have no pictures."""
    reasons = Counter(why for scene in scenes for why in scene.reasons)
    return [f"No pictures of {plural(count, 'run')}: {why}." for why, count in reasons.items()]


def first_shapes(runs: Runs, most: int, presets: Sequence[str] = ()) -> Runs:
    """The runs of the first shapes of each family, of the least seed each; of some presets, where these were run."""
    wanted = [record for record in runs.records if row_of(record).preset in presets] or runs.records
    kept = []
    for records in grouped(wanted, family).values():
        numbers = sorted({index(record) for record in records})[:most]
        seed = min(record["seed"] for record in records)
        kept += [r for r in records if index(r) in numbers and r["seed"] == seed]
    return replace(runs, records=kept, left_out=runs.left_out + len(runs.records) - len(kept))


@style.styled
def draw(blocks: Sequence[Block], *, across: int = 1, largest: float | None = None) -> Figure:
    """Draws blocks one above the other.

    Args:
        across: pictures side by side in a cell.
        largest: degrees at the end of the scale of `differences`, which then has a colour bar and a legend.
    """
    bar = 0.0 if largest is None else BAR
    lengths = [min(len(name), LETTERS) for block in blocks for name in block.rows]
    names = NAMES * max(lengths, default=0) / LETTERS
    columns = max([1, *(len(block.columns) for block in blocks)])
    inches = min((style.WIDTH - bar - names) / (columns * across), LARGEST_COMPARED if bar else LARGEST)
    wide = max(round(inches * across * LETTERS_PER_INCH), 6)
    blocks = [replace(block, columns=[_wrapped(name, wide) for name in block.columns]) for block in blocks]
    heads = [0.33 + 0.12 * max((name.count("\n") for name in block.columns), default=0) for block in blocks]
    lines = [max(len(block.rows), 1) * inches for block in blocks]
    height = sum(heads) + sum(lines) + (0.1 if largest is None else 0.4)
    figure = Figure(figsize=(names + columns * across * inches + bar, height), layout="constrained")
    axes = figure.subplots(max(len(blocks), 1), 1, squeeze=False, height_ratios=lines or [1])[:, 0].tolist()
    figure.get_layout_engine().set(w_pad=MARGIN, h_pad=MARGIN, wspace=0.01, hspace=0.01)
    for axis, block in zip(axes, blocks, strict=False):
        fill(axis, block, inches, across)
    if largest is not None:
        _explain(figure, axes, largest)
    figure.draw_without_rendering()  # the first layout does not know that titles stand above the columns' names
    return figure


def fill(axis: Axes, block: Block, inches: float, across: int = 1) -> None:
    """Draws a block into axes, with pictures of so many inches.

    All pictures are in one pair of axes, since a figure of many axes takes seconds.
    """
    style.bare(axis)
    wide, high = max(len(block.columns), 1), max(len(block.rows), 1)
    axis.set(xlim=(0, wide * across), ylim=(high, 0), aspect="equal")
    axis.set_xticks([across * (place + 0.5) for place in range(len(block.columns))], block.columns)
    axis.set_yticks([line + 0.5 for line in range(len(block.rows))], [_wrapped(name, LETTERS) for name in block.rows])
    axis.tick_params(length=0, top=False, bottom=False, labeltop=True, labelbottom=False, labelsize=6)
    axis.set_title(block.title, fontsize=7, loc="left")
    axis.vlines([across * place for place in range(1, wide)], 0, high, color=FRAME, lw=1)
    axis.hlines(range(1, high), 0, wide * across, color=FRAME, lw=1)
    for line, cells in enumerate(block.rows.values()):
        for place, cell in enumerate(cells):
            left = place * across + (across - len(cell.pictures)) / 2
            for picture, window in cell.pictures:
                _show(axis, picture, window, (left, line), inches)
                left += 1
            where = (across * (place + 0.5), line + (0.88 if cell.pictures else 0.5))
            axis.text(*where, cell.note, ha="center", va="center", fontsize=5, color=style.MISSED)


def _show(axis: Axes, picture: np.ndarray, window: Window | None, place: tuple[float, float], inches: float) -> None:
    """Draws a picture so that the part of it in the window fills the square at a place; all of it without a window."""
    height, width = (length / max(picture.shape[:2]) for length in picture.shape[:2])
    (top, left, side), (x, y) = window or ((height - 1) / 2, (width - 1) / 2, 1.0), place
    edges = (x - left / side, x + (width - left) / side, y + (height - top) / side, y - top / side)
    # A large picture is averaged, so that single pixels stay visible; the pixels of others stay as they are.
    sharp = side * max(picture.shape[:2]) <= inches * style.RC["savefig.dpi"]
    shown = axis.imshow(picture, extent=edges, interpolation="nearest" if sharp else "auto")
    shown.set_clip_path(Rectangle((x + 0.01, y + 0.01), 0.98, 0.98, transform=axis.transData))


def _explain(figure: Figure, axes: Sequence[Axes], largest: float) -> None:
    """Draws the colour bar and the legend of `differences`."""
    colours = ScalarMappable(Normalize(0, largest), style.error_colours())
    label = "angle between\nnormals (degrees)"
    figure.colorbar(colours, ax=axes, label=label, shrink=0.9 / len(axes), aspect=25, extend="max", pad=0.01)
    missed = Patch(color=style.MISSED, label="missed: only the reference hits")
    spurious = Patch(color=style.SPURIOUS, label="spurious: only the renderer hits")
    figure.legend(handles=[missed, spurious], loc="outside lower center", ncols=2)


def _wrapped(text: str, letters: int) -> str:
    """The text in lines of so many letters, besides those that it has."""
    return "\n".join(part for line in text.split("\n") for part in textwrap.wrap(line, letters) or [""])
