"""Rows as pictures: the normals that a row found, and below them how they differ from the reference's."""

import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure, SubFigure
from matplotlib.image import AxesImage
from matplotlib.patches import Patch

from bench.report import style

LARGEST_SHARP = 256  # pixels a side that a picture of a column shows without leaving any out
NAMES = ("normals", "reference_normals", "hit", "reference_hit")


@dataclass(frozen=True)
class Images:
    """The pictures of one row; normals [size, size, 3] to the right, up, to the camera, hits [size, size]."""

    normals: np.ndarray
    reference_normals: np.ndarray
    hit: np.ndarray
    reference_hit: np.ndarray

    @property
    def lost(self) -> np.ndarray:
        """Pixels at which the reference hits and the row does not."""
        return self.reference_hit & ~self.hit

    @property
    def false(self) -> np.ndarray:
        """Pixels at which the row hits and the reference does not."""
        return self.hit & ~self.reference_hit

    def angles(self) -> np.ndarray:
        """Between the normals, in degrees; nan where not both hit or a normal is not one."""
        found, true = self.normals, self.reference_normals
        with np.errstate(invalid="ignore"):
            sine = np.linalg.norm(np.cross(found, true), axis=-1)  # the cosine alone is blind to small angles
            cosine = (found * true).sum(-1)
            sound = self.hit & self.reference_hit & (np.hypot(sine, cosine) > 0.5)
            return np.where(sound, np.degrees(np.arctan2(sine, cosine)), np.nan)


@dataclass(frozen=True)
class Cell:
    """A column of pictures: a row's, or the reference's own. `images` None leaves `missing` in their place."""

    title: str
    images: Images | None
    missing: str = ""
    reference: bool = False


def load(folder: Path) -> tuple[Images | None, str]:
    """The pictures of a run folder, or None and why there are none."""
    path = folder / "images.npz"
    if not path.is_file():
        return None, "no images.npz"
    try:
        # Opened here, since numpy leaves a file open that turns out not to be one of its own.
        with path.open("rb") as raw, np.lib.npyio.NpzFile(raw, allow_pickle=False) as file:
            arrays = {name: np.asarray(file[name]) for name in NAMES}
    except KeyError as error:
        return None, f"images.npz lacks an array: {error.args[0]}"
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error):
        return None, "images.npz cannot be read"
    shape = arrays["hit"].shape
    if len(shape) != 2 or 0 in shape or any(a.shape not in (shape, (*shape, 3)) for a in arrays.values()):
        return None, "images.npz holds arrays of different sizes"
    kinds = {name: bool if name.endswith("hit") else np.float64 for name in NAMES}
    return Images(**{name: array.astype(kinds[name]) for name, array in arrays.items()}), ""


def cells(names: list[str], folders: list[Path]) -> tuple[list[Cell], list[str]]:
    """The reference, of the largest picture, then a cell for each row; and a remark for each row without pictures."""
    found = [load(folder) for folder in folders]
    largest = max((images for images, _ in found if images), key=lambda images: images.hit.size, default=None)
    rows = [Cell(name, images, why) for name, (images, why) in zip(names, found, strict=True)]
    remarks = [f"No pictures of {cell.title}: {cell.missing}." for cell in rows if cell.images is None]
    return [Cell("reference", largest, "no pictures", reference=True), *rows], remarks


def draw(figure: Figure | SubFigure, shown: list[Cell], columns: int) -> None:
    """Normals above, differences below, with a colour bar of the angle and a legend of lost and false pixels."""
    blocks = -(-len(shown) // columns)
    axes = figure.subplots(2 * blocks, columns, squeeze=False)
    window, top = _window(shown), _top(shown)
    for axis in axes.flat:
        axis.axis("off")
    image = None
    for place, cell in enumerate(shown):
        row, column = 2 * (place // columns), place % columns
        above, below = axes[row, column], axes[row + 1, column]
        above.set_title(cell.title, fontsize=7)
        image = _pair(above, below, cell, window, top) or image
    if image is not None:
        label = "angle between\nnormals (degrees)"
        figure.colorbar(image, ax=axes, label=label, shrink=0.9 / blocks, aspect=25, extend="max", pad=0.01)


def _pair(above: Any, below: Any, cell: Cell, window: dict[str, Any], top: float) -> AxesImage | None:
    images = cell.images
    if cell.reference:
        how = {"handlelength": 0.9, "handletextpad": 0.4, "borderpad": 0, "borderaxespad": 0, "fontsize": 6.5}
        below.legend(handles=_legend(), loc="upper left", **how).set_in_layout(False)
    if images is None:
        style.bare(above).axis("on")
        above.text(0.5, 0.5, "no picture", ha="center", va="center", color="#777777", transform=above.transAxes)
        above.set_box_aspect(1)
        return None
    normals, hit = images.normals, images.hit
    if cell.reference:
        normals, hit = images.reference_normals, images.reference_hit
    colours = np.where(hit[..., None], np.nan_to_num(normals) / 2 + 0.5, 1.0).clip(0, 1)
    style.bare(above).axis("on")
    above.imshow(colours, **_placed(images))
    above.set(**window)
    return None if cell.reference else _difference(below, images, window, top)


def _difference(axis: Any, images: Images, window: dict[str, Any], top: float) -> AxesImage:
    style.bare(axis).axis("on")
    where = _placed(images)
    shown = axis.imshow(images.angles(), cmap=style.error_colours(), vmin=0, vmax=top, **where)
    for mask, colour in ((images.lost, style.LOST), (images.false, style.FALSE)):
        red, green, blue = (int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5))
        axis.imshow(np.where(mask[..., None], (red, green, blue, 1.0), 0.0), **where)
    axis.set(**window)
    return shown


def _placed(images: Images) -> dict[str, Any]:
    """Where a picture stands. A large one is averaged when it shrinks, lest single pixels get lost."""
    how = "nearest" if images.hit.shape[0] <= LARGEST_SHARP else "auto"
    return {"extent": (0, 1, 1, 0), "interpolation": how}


def _legend() -> list[Patch]:
    return [
        Patch(color=style.LOST, label="lost: only the\nreference hits"),
        Patch(color=style.FALSE, label="false: only\nthe row hits"),
    ]


def _window(shown: list[Cell]) -> dict[str, Any]:
    """Limits of the square part, in shares of the picture, that holds every hit, with a margin."""
    spans = []
    for cell in shown:
        if cell.images is not None and (together := cell.images.hit | cell.images.reference_hit).any():
            for axis in (0, 1):
                at = np.nonzero(together.any(1 - axis))[0]
                spans.append((axis, at[0] / together.shape[axis], (at[-1] + 1) / together.shape[axis]))
    if not spans:
        return {"xlim": (0, 1), "ylim": (1, 0)}
    low, high = (
        np.array([pick(s[i] for s in spans if s[0] == axis) for axis in (0, 1)]) for pick, i in ((min, 1), (max, 2))
    )
    size = min(1.0, float((high - low).max()) * 1.08)
    start = np.clip((low + high - size) / 2, 0, 1 - size)
    return {"xlim": (start[1], start[1] + size), "ylim": (start[0] + size, start[0])}


def _top(shown: list[Cell]) -> float:
    """Where the scale of angles ends: what 99 % of the pixels stay below, rounded up."""
    angles = [cell.images.angles() for cell in shown if cell.images is not None and not cell.reference]
    together = np.concatenate([a[np.isfinite(a)] for a in angles]) if angles else np.empty(0)
    return style.rounded_up(float(np.percentile(together, 99))) if together.size else 90.0
