"""A full turn of a shape in pictures: colours, normals and depth side by side."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib import colormaps
from torch import Tensor

from bench.evaluate.colours import painted
from bench.pictures.run_figures import LIGHT, normals_image, picture_normals
from datasets.mesh import Mesh
from datasets.scene import View, see
from datasets.truth import Truth
from datasets.views import ViewSampler

PARTS = ("colours", "normals", "depth")  # of a frame
DISTANCE, FIELD_OF_VIEW = 2.5, 50.0  # scene units, degrees: the whole unit sphere is in the picture
FINER = 2  # pixels that are rendered, along each side of one that is written
SMALLEST, LARGEST = 16, 1024  # pixels of a part's side
MOST = 720  # frames
STEEPEST = 89  # degrees of elevation: a camera that looks straight down has no upper edge
THINNEST = 1e-6  # scene units of depth that the scale spans at least


@dataclass(frozen=True)
class Turn:
    """How a shape is shown.

    Args:
        frames: of a full turn.
        size: of each part, in pixels.
        elevation: of the camera, in degrees.
        show: parts of a frame, from left to right.
    """

    frames: int
    size: int
    elevation: float
    show: tuple[str, ...]

    def __post_init__(self) -> None:
        if not 2 <= self.frames <= MOST:
            raise ValueError(f"--frames must be 2 to {MOST}, found {self.frames}; 36 is a good number")
        if not SMALLEST <= self.size <= LARGEST:
            raise ValueError(f"--size must be {SMALLEST} to {LARGEST} pixels, found {self.size}; 256 is a good size")
        if not -STEEPEST <= self.elevation <= STEEPEST:
            raise ValueError(
                f"--elevation must be {-STEEPEST} to {STEEPEST} degrees, found {self.elevation:g}; 20 is a good angle"
            )
        wrong = [part for part in self.show if part not in PARTS]
        if wrong or len(set(self.show)) < len(self.show):
            raise ValueError(
                f"--show must be some of {','.join(PARTS)}, each once, found '{','.join(self.show)}'; "
                "type for example --show colours,normals"
            )

    def views(self, truth: Truth) -> Iterator[View]:
        """The views of a full turn, finer than written; a mesh may be wound inward, so all normals face the camera."""
        level = (self.elevation, self.elevation)
        sampler = ViewSampler(DISTANCE, FIELD_OF_VIEW, (0.0, 360.0), level, FINER * self.size)
        for frame in range(self.frames):
            view = see(truth, sampler.camera(360.0 * frame / self.frames, self.elevation))
            away = (view.normals * view.camera.rays().directions).sum(-1, keepdim=True) > 0
            yield replace(view, normals=torch.where(away, -view.normals, view.normals))


def turntable(mesh: Mesh, turn: Turn) -> list[UInt8[np.ndarray, "height width 3"]]:
    """The frames of a full turn of a mesh in the unit sphere: its parts side by side.

    Raises:
        ValueError: where the mesh is too small to be seen.
    """
    truth = Truth(mesh, closed=False)
    columns: dict[str, list[UInt8[np.ndarray, "height width 3"]]] = {part: [] for part in turn.show}
    depths: list[Float[Tensor, "fine_height fine_width"]] = []
    seen = False
    for view in turn.views(truth):
        seen = seen or bool(view.mask.any())
        if "colours" in columns:
            shown = _shaded(view) if mesh.colours is None else painted(mesh, truth, view.camera)
            columns["colours"].append(_written(np.where(view.mask[..., None], shown, 1.0)))
        if "normals" in columns:
            columns["normals"].append(_written(normals_image(view)))
        if "depth" in columns:
            depths.append(torch.where(view.mask, view.depth, torch.nan))
    if not seen:
        raise ValueError(f"the mesh must be large enough to be seen, found {mesh.diagonal:.3g} across; scale it to 1")
    if "depth" in columns:
        columns["depth"] = _depth_images(depths)
    return [np.concatenate(parts, axis=1) for parts in zip(*columns.values(), strict=True)]


def _depth_images(depths: list[Float[Tensor, "fine_height fine_width"]]) -> list[UInt8[np.ndarray, "height width 3"]]:
    """Depths, nan where nothing is seen, as colours on one scale: near yellow, far violet, nothing white."""
    known = [depth[depth.isfinite()] for depth in depths]
    low = min(float(depth.min()) for depth in known if depth.numel())
    high = max(float(depth.max()) for depth in known if depth.numel())
    colours = colormaps["viridis_r"].with_extremes(bad="white")
    return [_written(colours(((depth - low) / max(high - low, THINNEST)).numpy())[..., :3]) for depth in depths]


def _shaded(view: View) -> Float[np.ndarray, "height width 3"]:
    shade = 0.25 + 0.75 * (picture_normals(view).numpy() @ (LIGHT / np.linalg.norm(LIGHT))).clip(0, 1)
    return np.repeat(shade[..., None], 3, axis=-1)


def _written(image: Float[np.ndarray, "fine_height fine_width 3"]) -> UInt8[np.ndarray, "height width 3"]:
    """The mean of each square of pixels."""
    height, width = image.shape[0] // FINER, image.shape[1] // FINER
    return (255 * image.reshape(height, FINER, width, FINER, 3).mean(axis=(1, 3))).round().astype(np.uint8)
