"""Draws rows as pictures: the normals of each row, and below them the angles to the reference's normals."""

import textwrap
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure, SubFigure
from matplotlib.image import AxesImage
from matplotlib.patches import Patch

from bench.pictures import style
from bench.report.data.records import Record
from bench.report.write import chart

LARGEST_SHARP = 256  # most pixels per side at which a picture is drawn without averaging
CLOSE = {"w_pad": 0.02, "h_pad": 0.02, "wspace": 0.01, "hspace": 0.01}  # layout of a figure of pictures
NAMES = ("normals", "reference_normals", "hit", "reference_hit")
COUNTED = ("size", "hits", "lost", "false", "angle_median", "angle_p99", "angle_max")


@dataclass(frozen=True)
class Images:
    """The arrays of one row: normals [size, size, 3] (right, up, towards the camera), hits [size, size]."""

    normals: np.ndarray
    reference_normals: np.ndarray
    hit: np.ndarray
    reference_hit: np.ndarray

    @property
    def missed(self) -> np.ndarray:
        """Pixels at which the reference hits and the row does not."""
        return self.reference_hit & ~self.hit

    @property
    def spurious(self) -> np.ndarray:
        """Pixels at which the row hits and the reference does not."""
        return self.hit & ~self.reference_hit

    def angles(self) -> np.ndarray:
        """Angles between the normals in degrees; nan where not both hit, or a normal is not of unit length."""
        found, true = self.normals, self.reference_normals
        with np.errstate(invalid="ignore"):
            sine = np.linalg.norm(np.cross(found, true), axis=-1)  # the cosine alone is inexact for small angles
            cosine = (found * true).sum(-1)
            sound = self.hit & self.reference_hit & (np.hypot(sine, cosine) > 0.5)
            return np.where(sound, np.degrees(np.arctan2(sine, cosine)), np.nan)

    def counted(self) -> dict[str, Any]:
        """The size, the number of pixels of each kind, and angles in degrees, by the names in `COUNTED`."""
        angles = self.angles()
        found = angles[np.isfinite(angles)]
        spread = [float(x) for x in np.percentile(found, (50, 99, 100))] if found.size else [None] * 3
        counts = [int(mask.sum()) for mask in (self.reference_hit, self.missed, self.spurious)]
        return dict(zip(COUNTED, [self.hit.shape[0], *counts, *spread], strict=True))


@dataclass(frozen=True)
class Cell:
    """A column of pictures, of a row or of the reference; where `images` is None, a text in their place."""

    title: str
    images: Images | None
    reference: bool = False


def arrays(folder: Path, names: tuple[str, ...]) -> tuple[dict[str, np.ndarray], str]:
    """Arrays of a run folder's images.npz by name; none, and the reason, where one is missing or cannot be read."""
    path = folder / "images.npz"
    if not path.is_file():
        return {}, "no images.npz"
    try:
        # Opened here, since numpy does not close a file that it cannot read.
        with path.open("rb") as raw, np.lib.npyio.NpzFile(raw, allow_pickle=False) as file:
            return {name: np.asarray(file[name]) for name in names}, ""
    except KeyError as error:
        return {}, f"images.npz lacks an array: {error.args[0]}"
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error):
        return {}, "images.npz cannot be read"


def load(folder: Path) -> tuple[Images | None, str]:
    """The pictures of a run folder, or None and the reason."""
    found, why = arrays(folder, NAMES)
    if why:
        return None, why
    shape = found["hit"].shape
    if len(shape) != 2 or 0 in shape or any(a.shape not in (shape, (*shape, 3)) for a in found.values()):
        return None, "images.npz holds arrays of different sizes"
    kinds = {name: bool if name.endswith("hit") else np.float64 for name in NAMES}
    return Images(**{name: array.astype(kinds[name]) for name, array in found.items()}), ""


def cells(records: list[Record], folders: list[Path]) -> tuple[list[Cell], list[str]]:
    """The reference of the largest picture, then a cell for each record; and a note for each without pictures.

    A cell's title is the record's `name`; where the run did not end ok, with its status and the size that is shown.
    """
    found = [load(folder) for folder in folders]
    largest = max((images for images, _ in found if images), key=lambda images: images.hit.size, default=None)
    rows = [Cell(_title(record, images), images) for record, (images, _) in zip(records, found, strict=True)]
    notes = [f"No pictures of {r['name']}: {why}." for r, (images, why) in zip(records, found, strict=True) if why]
    return [Cell("reference", largest, reference=True), *rows], notes


def _title(record: Record, images: Images | None) -> str:
    lines = textwrap.wrap(record["name"], 20)
    if record["status"] != "ok":
        size = f", shown at {images.hit.shape[0]} px" if images is not None else ""
        lines.append(f"({record['status']}{size})")
    return "\n".join(lines)


def coloured(normals: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """Normals as red, green and blue on white."""
    return np.where(hit[..., None], np.nan_to_num(normals) / 2 + 0.5, 1.0).clip(0, 1)


def draw(figure: Figure | SubFigure, shown: list[Cell], columns: int) -> None:
    """Draws normals above and differences below, with a colour bar of the angle and a legend of wrong pixels.

    All pictures show the square part that contains all hits, with a margin. The scale of angles ends at the 99th
    percentile over all pixels, rounded up.
    """
    blocks = -(-len(shown) // columns)
    axes = figure.subplots(2 * blocks, columns, squeeze=False)
    known = [cell.images for cell in shown if cell.images is not None]
    top, left, side = style.window([images.hit | images.reference_hit for images in known]) if known else (0, 0, 1)
    angles = [cell.images.angles() for cell in shown if cell.images is not None and not cell.reference]
    together = np.concatenate([a[np.isfinite(a)] for a in angles]) if angles else np.empty(0)
    largest = style.rounded_up(float(np.percentile(together, 99))) if together.size else 90.0
    for axis in axes.flat:
        axis.axis("off")
    image = None
    for place, cell in enumerate(shown):
        row, column = 2 * (place // columns), place % columns
        above, below = axes[row : row + 2, column]
        above.set_title(cell.title, fontsize=7)
        image = _pair(above, below, cell, largest) or image
        for axis in (above, below) if cell.images is not None else ():
            axis.set(xlim=(left, left + side), ylim=(top + side, top))
    if image is not None:
        label = "angle between\nnormals (degrees)"
        figure.colorbar(image, ax=axes, label=label, shrink=0.9 / blocks, aspect=25, extend="max", pad=0.01)


def _pair(above: Any, below: Any, cell: Cell, largest: float) -> AxesImage | None:
    """Draws the normals, and below them the angles, which it gives; below the reference's a legend."""
    images = cell.images
    style.bare(above).axis("on")
    if cell.reference:
        how = {"handlelength": 0.9, "handletextpad": 0.4, "borderpad": 0, "borderaxespad": 0, "fontsize": 6.5}
        missed = Patch(color=style.MISSED, label="missed: only the\nreference hits")
        spurious = Patch(color=style.SPURIOUS, label="spurious: only\nthe row hits")
        below.legend(handles=[missed, spurious], loc="upper left", **how).set_in_layout(False)
    if images is None:
        chart.say(above, "no picture", color="#777777")
        above.set_box_aspect(1)
        return None
    # A large picture is averaged, so that single pixels stay visible.
    sharp = "nearest" if images.hit.shape[0] <= LARGEST_SHARP else "auto"
    where = {"extent": (0, 1, 1, 0), "interpolation": sharp}
    if cell.reference:
        above.imshow(coloured(images.reference_normals, images.reference_hit), **where)
        return None
    above.imshow(coloured(images.normals, images.hit), **where)
    style.bare(below).axis("on")
    shown = below.imshow(images.angles(), cmap=style.error_colours(), vmin=0, vmax=largest, **where)
    for mask, colour in ((images.missed, style.MISSED), (images.spurious, style.SPURIOUS)):
        below.imshow(np.where(mask[..., None], to_rgba(colour), 0.0), **where)
    return shown
