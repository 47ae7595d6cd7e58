"""Galleries: pictures of runs in a grid with names of rows and columns; failed runs show their status."""

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

from bench.pictures import figure_style, style
from bench.records.format import plural
from bench.report.data.records import Record, family, grouped, index, row_of
from bench.report.data.runs import Runs

MAX_PICTURE_INCHES, MAX_COMPARED_INCHES = 0.9, 1.5  # the second if the figure has a colour bar
MAX_ROW_NAME_INCHES, COLOUR_BAR_INCHES, MARGIN_INCHES = 1.35, 0.7, 0.05
ROW_NAME_LETTERS, HEADING_LETTERS_PER_INCH = 18, 19
FRAME_COLOUR = "#d9d9d9"
# Prefixes and views of the arrays in images.npz, see `bench.pictures.run_figures.save_gallery`.
PREDICTED, GROUND_TRUTH, START = "found_", "true_", "start_"
SHAPES = tuple(kind + array for kind in (START, PREDICTED, GROUND_TRUTH) for array in ("normals", "hit"))
FRONT, BEHIND = 0, 1
REFERENCE = ("normals", "reference_normals", "hit", "reference_hit")  # see `bench.pictures.run_figures.save_images`
COUNT_KEYS = ("size", "hits", "lost", "false", "angle_median", "angle_p99", "angle_max")
NORMALS_PHRASE = "Normals are red, green and blue (right, up, towards the camera) of the mesh that is judged"
Arrays = dict[str, np.ndarray]
Window = tuple[float, float, float]  # see `style.window`
Paint = Callable[[Arrays], Sequence[np.ndarray]]  # a picture [height, width, 3] per view; none without a surface


@dataclass(frozen=True)
class Cell:
    """Pictures side by side, each with its shown window (None: all of it), and a note; by default blank."""

    pictures: Sequence[tuple[np.ndarray, Window | None]] = ()
    note: str = ""


@dataclass(frozen=True)
class Block:
    """Rows of cells by name, with the names of the columns. A shorter row ends with blank cells."""

    title: str
    columns: list[str]
    rows: Mapping[str, Sequence[Cell]]


def read_arrays(folder: Path, names: Iterable[str]) -> tuple[Arrays, str]:
    """Reads arrays of a run folder's images.npz by name. If one cannot be read, returns none and the reason."""
    path = folder / "images.npz"
    if not path.is_file():
        return {}, "no images.npz"
    try:
        # Opened here, as numpy does not close a file that it cannot read.
        with path.open("rb") as raw, np.lib.npyio.NpzFile(raw, allow_pickle=False) as file:
            arrays_by_name = {name: np.asarray(file[name]) for name in names}
    except KeyError as error:
        return {}, f"images.npz lacks an array: {error.args[0]}"
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error):
        return {}, "images.npz cannot be read"
    return {name: array.astype(bool if name.endswith("hit") else float) for name, array in arrays_by_name.items()}, ""


class Scene:
    """The pictures of runs of one scene. All show the same window, which contains the shapes of all runs."""

    def __init__(self, runs: Runs, records: Iterable[Record], names: Iterable[str]):
        """Reads the named arrays; `reasons` says why runs have none."""
        read = {record["folder"]: read_arrays(runs.folder(record), tuple(names)) for record in records}
        self.reasons = [reason for _, reason in read.values() if reason]
        self.arrays = {folder: arrays for folder, (arrays, _) in read.items() if arrays}
        named = [pair for arrays in self.arrays.values() for pair in arrays.items()]
        views = [hit.reshape(-1, *hit.shape[-2:]) for name, hit in named if name.endswith("hit")]
        self.windows = [style.window([hit[view] for hit in views]) for view in range(min(map(len, views), default=1))]

    def cell(self, record: Record | None, paint: Paint, views: Sequence[int] = (FRONT,)) -> Cell:
        if record is None:
            return Cell(note="no run")
        arrays, note = self.arrays.get(record["folder"]), record["status"] if record["status"] != "ok" else ""
        pictures = paint(arrays) if arrays else ()
        if not len(pictures):
            return Cell(note=note or ("no surface" if arrays else "no picture"))
        return Cell([(pictures[view], self.windows[view]) for view in views], note)

    def shared(self, records: Iterable[Record], paint: Paint, views: Sequence[int] = (FRONT,)) -> Cell:
        """Pictures that all records share, such as the ground truth, from the first record that has them."""
        record = next((record for record in records if record["folder"] in self.arrays), None)
        return Cell() if record is None else self.cell(record | {"status": "ok"}, paint, views)

    def full_picture(self, records: Iterable[Record], name: str) -> Cell:
        """A picture that all records share and that is not cropped, as another camera took it."""
        arrays = next((self.arrays[record["folder"]] for record in records if record["folder"] in self.arrays), None)
        return Cell() if arrays is None else Cell([(arrays[name], None)])


def on_white(colours: np.ndarray, hit: np.ndarray) -> np.ndarray:
    return np.where(hit[..., None], np.nan_to_num(colours), 1.0).clip(0, 1)


def normals(prefix: str = "") -> Paint:
    """Paints the normals of a shape: right, up and towards the camera are red, green and blue."""

    def paint(arrays: Arrays) -> Sequence[np.ndarray]:
        hit = arrays[f"{prefix}hit"]
        shown = on_white(arrays[f"{prefix}normals"] / 2 + 0.5, hit)
        return list(shown.reshape(-1, *shown.shape[-3:])) if hit.any() else []

    return paint


def colours(prefix: str = "") -> Paint:
    return lambda arrays: [on_white(arrays[f"{prefix}colours"], arrays[f"{prefix}hit"])]


def depth(arrays: Arrays) -> Sequence[np.ndarray]:
    depths = arrays["given"][np.isfinite(arrays["given"])]
    low, high = (depths.min(), depths.max()) if depths.size else (0.0, 1.0)
    shown = colormaps["viridis_r"].with_extremes(bad=style.PAPER)
    return [shown(np.ma.masked_invalid((arrays["given"] - low) / max(high - low, 1e-6)))[..., :3]]


def angles(arrays: Arrays) -> np.ndarray:
    """Angles to the reference's normals in degrees; nan unless both hit and have unit normals."""
    predicted, true = arrays["normals"], arrays["reference_normals"]
    with np.errstate(invalid="ignore"):
        sine = np.linalg.norm(np.cross(predicted, true), axis=-1)  # the cosine alone is inexact for small angles
        cosine = (predicted * true).sum(-1)
        is_defined = arrays["hit"] & arrays["reference_hit"] & (np.hypot(sine, cosine) > 0.5)
        return np.where(is_defined, np.degrees(np.arctan2(sine, cosine)), np.nan)


def count_pixels(arrays: Arrays) -> dict[str, Any]:
    """The size, the number of pixels of each kind, and angles in degrees, by `COUNT_KEYS`."""
    hit, reference_hit, all_angles = arrays["hit"], arrays["reference_hit"], angles(arrays)
    finite = all_angles[np.isfinite(all_angles)]
    percentiles = [float(x) for x in np.percentile(finite, (50, 99, 100))] if finite.size else [None] * 3
    masks = (reference_hit, reference_hit & ~hit, hit & ~reference_hit)
    return dict(zip(COUNT_KEYS, [len(hit), *(int(mask.sum()) for mask in masks), *percentiles], strict=True))


def difference_pictures(largest: float) -> Paint:
    """Paints angles to the reference's normals, up to `largest` degrees, and missed and spurious pixels."""

    def paint(arrays: Arrays) -> Sequence[np.ndarray]:
        shown = figure_style.error_colours()(np.ma.masked_invalid(angles(arrays)) / largest)[..., :3]
        shown[arrays["reference_hit"] & ~arrays["hit"]] = to_rgb(style.MISSED)
        shown[arrays["hit"] & ~arrays["reference_hit"]] = to_rgb(style.SPURIOUS)
        return [shown]

    return paint


@dataclass(frozen=True)
class ComparedPictures:
    """Runs compared with a reference: pictures, counts per run, notes, and the largest angle of the scale."""

    blocks: list[Block]
    counts: list[dict[str, Any]]
    missing: list[str]
    largest: float


def compare_with_reference(runs: Runs, max_columns: int) -> ComparedPictures:
    """Compares the runs of one scene with its reference: normals above, differences below.

    The scale of angles ends at the 99th percentile, rounded up. The reference is of the largest picture; the heading of
    a smaller picture names its size.
    """
    records = runs.records
    scene = Scene(runs, records, REFERENCE)
    arrays_of_runs = [scene.arrays.get(record["folder"], {}) for record in records]
    counts = [count_pixels(arrays) if arrays else {} for arrays in arrays_of_runs]
    all_angles = np.concatenate([np.empty(0), *(angles(arrays).ravel() for arrays in arrays_of_runs if arrays)])
    finite = all_angles[np.isfinite(all_angles)]
    largest = figure_style.rounded_up(float(np.percentile(finite, 99))) if finite.size else 90.0
    sizes = [arrays.get("size", 0) for arrays in counts]
    by_size = sorted(zip(sizes, range(len(records)), strict=True), key=lambda pair: (-pair[0], pair[1]))
    named = zip(runs.names(), sizes, strict=True)
    headings = [f"{name}, {size} px" if 0 < size < by_size[0][0] else name for name, size in named]
    reference = scene.shared([records[index] for _, index in by_size], normals("reference_"))
    rows = {
        "normals": [reference, *(scene.cell(record, normals()) for record in records)],
        "difference": [Cell(), *(scene.shared([record], difference_pictures(largest)) for record in records)],
    }
    headings, columns = ["reference", *headings], -(-(len(headings) + 1) // -(-(len(headings) + 1) // max_columns))
    spans = [slice(start, start + columns) for start in range(0, len(headings), columns)]  # few blocks of equal length
    blocks = [Block("", headings[span], {name: cells[span] for name, cells in rows.items()}) for span in spans]
    return ComparedPictures(blocks, counts, missing_notes([scene]), largest)


def missing_notes(scenes: Iterable[Scene]) -> list[str]:
    reasons = Counter(reason for scene in scenes for reason in scene.reasons)
    return [f"No pictures of {plural(count, 'run')}: {reason}." for reason, count in reasons.items()]


def first_shapes(runs: Runs, max_shapes: int, presets: Sequence[str] = ()) -> Runs:
    """The runs of the first shapes of each family, with its least seed; of `presets` only, if any of these was run."""
    records_of_presets = [record for record in runs.records if row_of(record).preset in presets] or runs.records
    chosen = []
    for records in grouped(records_of_presets, family).values():
        numbers = sorted({index(record) for record in records})[:max_shapes]
        seed = min(record["seed"] for record in records)
        chosen += [record for record in records if index(record) in numbers and record["seed"] == seed]
    return runs.only(chosen)


@figure_style.styled
def draw(blocks: Sequence[Block], *, across: int = 1, largest: float | None = None) -> Figure:
    """Draws blocks one above the other, with `across` pictures in a cell; `largest` ends the scale of angles."""
    bar = 0.0 if largest is None else COLOUR_BAR_INCHES
    lengths = [min(len(name), ROW_NAME_LETTERS) for block in blocks for name in block.rows]
    names = MAX_ROW_NAME_INCHES * max(lengths, default=0) / ROW_NAME_LETTERS
    columns = max([1, *(len(block.columns) for block in blocks)])
    inches = min(
        (figure_style.WIDTH - bar - names) / (columns * across), MAX_COMPARED_INCHES if bar else MAX_PICTURE_INCHES
    )
    wide = max(round(inches * across * HEADING_LETTERS_PER_INCH), 6)
    blocks = [replace(block, columns=[_wrapped(name, wide) for name in block.columns]) for block in blocks]
    heads = [0.33 + 0.12 * max((name.count("\n") for name in block.columns), default=0) for block in blocks]
    lines = [max(len(block.rows), 1) * inches for block in blocks]
    height = sum(heads) + sum(lines) + (0.1 if largest is None else 0.4)
    figure = Figure(figsize=(names + columns * across * inches + bar, height), layout="constrained")
    axes = figure.subplots(max(len(blocks), 1), 1, squeeze=False, height_ratios=lines or [1])[:, 0].tolist()
    figure.get_layout_engine().set(w_pad=MARGIN_INCHES, h_pad=MARGIN_INCHES, wspace=0.01, hspace=0.01)
    for axis, block in zip(axes, blocks, strict=False):
        fill(axis, block, inches, across)
    if largest is not None:
        _explain(figure, axes, largest)
    figure.draw_without_rendering()  # the first layout ignores that titles are above the names of columns
    return figure


def fill(axis: Axes, block: Block, inches: float, across: int = 1) -> None:
    """Draws a block, with pictures of `inches`, into one pair of axes, as a figure of many axes takes seconds."""
    style.bare(axis)
    columns, rows = max(len(block.columns), 1), max(len(block.rows), 1)
    axis.set(xlim=(0, columns * across), ylim=(rows, 0), aspect="equal")
    axis.set_xticks([across * (column + 0.5) for column in range(len(block.columns))], block.columns)
    axis.set_yticks(np.arange(len(block.rows)) + 0.5, [_wrapped(name, ROW_NAME_LETTERS) for name in block.rows])
    axis.tick_params(length=0, top=False, bottom=False, labeltop=True, labelbottom=False, labelsize=6)
    axis.set_title(block.title, fontsize=7, loc="left")
    axis.vlines([across * column for column in range(1, columns)], 0, rows, color=FRAME_COLOUR, lw=1)
    axis.hlines(range(1, rows), 0, columns * across, color=FRAME_COLOUR, lw=1)
    for line, cells in enumerate(block.rows.values()):
        for column, cell in enumerate(cells):
            left = column * across + (across - len(cell.pictures)) / 2
            for picture, window in cell.pictures:
                _show(axis, picture, window, (left, line), inches)
                left += 1
            position = (across * (column + 0.5), line + (0.88 if cell.pictures else 0.5))
            axis.text(*position, cell.note, ha="center", va="center", fontsize=5, color=style.MISSED)


def _show(axis: Axes, picture: np.ndarray, window: Window | None, corner: tuple[float, float], inches: float) -> None:
    """Draws a picture so that its window, or all of it, fills the unit square at a corner."""
    height, width = (length / max(picture.shape[:2]) for length in picture.shape[:2])
    (top, left, side), (x, y) = window or ((height - 1) / 2, (width - 1) / 2, 1.0), corner
    edges = (x - left / side, x + (width - left) / side, y + (height - top) / side, y - top / side)
    # Large pictures are averaged, so that single pixels stay visible; small ones keep their pixels.
    sharp = side * max(picture.shape[:2]) <= inches * figure_style.RC["savefig.dpi"]
    shown = axis.imshow(picture, extent=edges, interpolation="nearest" if sharp else "auto")
    shown.set_clip_path(Rectangle((x + 0.01, y + 0.01), 0.98, 0.98, transform=axis.transData))


def _explain(figure: Figure, axes: Sequence[Axes], largest: float) -> None:
    colours = ScalarMappable(Normalize(0, largest), figure_style.error_colours())
    label = "angle between\nnormals (degrees)"
    figure.colorbar(colours, ax=axes, label=label, shrink=0.9 / len(axes), aspect=25, extend="max", pad=0.01)
    missed = Patch(color=style.MISSED, label="missed: only the reference hits")
    spurious = Patch(color=style.SPURIOUS, label="spurious: only the renderer hits")
    figure.legend(handles=[missed, spurious], loc="outside lower center", ncols=2)


def _wrapped(text: str, letters: int) -> str:
    return "\n".join(piece for line in text.split("\n") for piece in textwrap.wrap(line, letters) or [""])
