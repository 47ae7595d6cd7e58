"""Pictures of a run: its input, the shape before and after, and the truth. Never drawn within a timed phase."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import atan2, degrees
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from bench.evaluate.refined import refined_view
from bench.evaluate.state import State, empty_view
from bench.pictures import style
from bench.pictures.style import MISSED, SCREEN, SPURIOUS, bare, save, silhouette_image
from bench.records.metrics import TABLE_METRICS, Metric
from bench.records.results import NOT_LOSS_TERMS
from bench.setup.inputs import RunInputs
from datasets.mesh import Mesh
from datasets.scene import Scene, Truth, View, see
from renderers.camera import Camera

LIGHT = np.array([-0.35, 0.6, 0.72])  # from the camera's upper left; axes point right, up, to the camera
BACK_AZIMUTH_DEGREES = 160.0  # about the vertical axis, from the scene's camera to the one behind
BACK_ELEVATION_DEGREES = 25.0
MAX_PHOTOGRAPHS = 4  # shown in two rows
INPUT_AXES_INCHES = 2.0


@dataclass(frozen=True)
class ViewPair:
    """Views of one shape."""

    title: str
    front: View  # by the scene's camera, in the size of pictures
    back: View | None  # from behind; None if only the front is known, which then has no normals
    mask: Bool[Tensor, "height width"]  # for the scene's camera, in the size in which metrics compare silhouettes


@dataclass(frozen=True)
class InputView:
    """The input of a run: depths of a view, or photographs."""

    view: View
    observed: Bool[np.ndarray, "height width"]  # pixels with a given depth
    photographs: Float[np.ndarray, "views height width 3"] | None = None
    mask: bool = True  # whether the silhouette was given too
    coloured: bool = False  # whether colours were given too

    @property
    def summary(self) -> str:
        if self.photographs is not None:
            return f"{len(self.photographs)} photographs"
        names = {"mask": self.mask, "colours": self.coloured, f"{int(self.observed.sum())} depths": self.observed.any()}
        return " and ".join(name for name, is_given in names.items() if is_given) or "distances"


@rc_context(SCREEN)
def draw_run(
    folder: Path, states: tuple[State, State], view: InputView, curve: list[dict[str, Any]], title: str
) -> None:
    """Writes summary.png and curve.png from a run's states before and after, in the size of pictures."""
    inputs = states[0].inputs
    scene, (front, back) = inputs.scene, _cameras(inputs, inputs.evaluation.picture)
    pairs = (
        *(
            ViewPair(
                name, refined_view(state, front), refined_view(state, back), state.view_from(scene.view.camera).mask
            )
            for name, state in zip(("before", "after"), states, strict=True)
        ),
        ViewPair(
            "measured" if scene.is_partial else "truth",
            true_view(scene, front),
            None if scene.is_partial else see(scene.raycaster, back),
            scene.view.mask,
        ),
    )
    save(_summary(pairs, view, title), folder / "summary.png")
    draw_curve(folder / "curve.png", curve)


@rc_context(SCREEN)
def draw_curve(path: Path, curve: list[dict[str, Any]]) -> None:
    """Writes the terms of a loss over iterations and, if checkpoints have an error, the error over seconds."""
    terms = dict.fromkeys(name for line in curve for name in line if name not in NOT_LOSS_TERMS)
    errors = [name for name in TABLE_METRICS if any(name in line for line in curve)][:1]
    figure = Figure(figsize=(8.0, 3.2), layout="constrained")
    axes = figure.subplots(1, 1 + len(errors), squeeze=False)[0]
    for axis, key, names in zip(axes, ("iteration", "seconds"), (terms, errors), strict=False):
        for name in names:
            metric = TABLE_METRICS.get(name, Metric(name))
            # The axis has no zero.
            points = [(line[key], metric.factor * line[name]) for line in curve if line.get(name, 0) > 0]
            if points:
                axis.plot(*zip(*points, strict=True), marker="." if name in errors else "", label=metric.label, lw=1.4)
        style.log_axis(axis, "y", [value for line in axis.lines for value in line.get_ydata()])
    axes[0].set(xlabel="iteration", ylabel="weighted loss")
    axes[0].xaxis.set_major_locator(MaxNLocator(integer=True))
    if axes[0].lines:
        axes[0].legend(frameon=False)
    for axis in axes[1:]:
        axis.set(xlabel="seconds in the loop", ylabel=f"{TABLE_METRICS[errors[0]].label} at checkpoints")
    save(figure, path)


@rc_context(SCREEN)
def draw_against(path: Path, view: View, reference: View, *, title: str) -> None:
    """Writes a picture that compares a view with the true one: normals of both, missed and spurious pixels."""
    pairs = ViewPair("rendered", view, None, view.mask), ViewPair("reference", reference, None, reference.mask)
    figure = Figure(figsize=(9.2, 3.5), layout="constrained")
    axes = figure.subplots(1, 3)
    for axis, pair in zip(axes, pairs, strict=False):
        _show_normals(axis, pair, pairs)
        axis.set_title(f"normals, {pair.title}")
    _show_silhouette(axes[2], pairs[0], pairs)
    axes[2].set_title("silhouette error")
    figure.suptitle(title)
    save(figure, path)


def save_images(folder: Path, view: View, true: View) -> None:
    """Writes `folder/images.npz`: normals [h, w, 3] and hits [h, w] of both."""
    normals = {"normals": picture_normals(view), "reference_normals": picture_normals(true)}
    save_arrays(folder, normals | {"hit": view.mask, "reference_hit": true.mask})


def save_gallery(
    folder: Path, inputs: RunInputs, observed: Bool[Tensor, "height width"], meshes: dict[str, Mesh | None]
) -> None:
    """Writes `images.npz` for galleries: observed depths, else NaN, and meshes from the scene's camera and from behind.

    Meshes by name and the truth, "true", have NAME_normals [2, h, w, 3], NAME_hit [2, h, w]; None shows nothing.
    """
    cameras = _cameras(inputs, inputs.evaluation.gallery)
    arrays = {"given": torch.where(observed.cpu(), inputs.scene.observed_view()[0].depth, torch.nan)}
    for name, mesh in {**meshes, "true": inputs.scene.mesh}.items():
        truth = None if mesh is None else Truth(mesh, closed=False)
        views = [empty_view(camera) if truth is None else see(truth, camera) for camera in cameras]
        arrays[f"{name}_normals"] = torch.stack([picture_normals(view) for view in views])
        arrays[f"{name}_hit"] = torch.stack([view.mask for view in views])
    save_arrays(folder, arrays)


def save_arrays(folder: Path, arrays: dict[str, Tensor]) -> None:
    """Writes images.npz, with numbers in half precision."""
    stored = {name: (array if array.dtype == torch.bool else array.half()).numpy() for name, array in arrays.items()}
    np.savez_compressed(folder / "images.npz", **stored)  # type: ignore[arg-type]


def true_view(scene: Scene, camera: Camera) -> View:
    """The true shape in a camera's size; for a partial truth the measured pixels, without normals, others NaN."""
    if not scene.is_partial:
        return see(scene.raycaster, camera)
    view, measured = scene.observed_view()
    return enlarged(replace(view, depth=view.depth.where(measured, torch.nan), normals=0 * view.normals), camera)


def enlarged(view: View, camera: Camera) -> View:
    """The same pixels in the size of a camera."""
    images = [in_size(image, camera) for image in (view.depth, view.normals, view.mask)]
    return View(camera, *images)


def in_size(image: Tensor, camera: Camera) -> Tensor:
    """The pixels of an image [height, width, ...] in the size of a camera."""
    rows = torch.arange(camera.height) * image.shape[0] // camera.height
    columns = torch.arange(camera.width) * image.shape[1] // camera.width
    return image[rows][:, columns]


def picture_normals(view: View) -> Float[Tensor, "height width 3"]:
    """Normals for pictures, with axes that point right, up and to the camera."""
    rotation = view.camera.world_to_camera[:3, :3].to(view.normals.dtype)
    return (view.normals @ rotation.T) * torch.tensor([1, -1, -1])


def shaded(view: View) -> Float[np.ndarray, "height width"]:
    """The brightness of a grey surface under `LIGHT`, from 0 to 1; meaningless outside the mask."""
    return 0.25 + 0.75 * (picture_normals(view).numpy() @ (LIGHT / np.linalg.norm(LIGHT))).clip(0, 1)


def _cameras(inputs: RunInputs, size: int) -> tuple[Camera, Camera]:
    """The scene's camera with `size` pixels per side, and one behind the shape."""
    camera = inputs.scene.view.camera
    x, _, z = camera.center.tolist()
    views = replace(inputs.views, resolution=size)
    behind = views.camera(degrees(atan2(x, z)) + BACK_AZIMUTH_DEGREES, BACK_ELEVATION_DEGREES)
    return camera.resized(size, size), behind


def at_size(camera: Camera, longer_side: int) -> Camera:
    """The camera with `longer_side` pixels on the longer side."""
    factor = longer_side / max(camera.height, camera.width)
    return camera.resized(round(factor * camera.height), round(factor * camera.width))


def _summary(pairs: tuple[ViewPair, ...], shown: InputView, title: str) -> Figure:
    columns = {
        "depth": _show_depth,
        "normals": _show_normals,
        "silhouette error": _show_silhouette,
        "from behind": _show_shaded,
    }
    figure = Figure(figsize=(9.2, 7.4), layout="constrained")
    axes = figure.subplots(3, 4)
    for row, pair in zip(axes, pairs, strict=True):
        for axis, (name, show) in zip(row, columns.items(), strict=True):
            if pair is pairs[2] and name == "silhouette error":
                _show_input(axis, shown)
                axis.set_xlabel(f"given: {shown.summary}")
            elif pair.back is None and name in ("normals", "from behind"):
                axis.set_axis_off()
            else:
                image = show(axis, pair, pairs)
            if pair is pairs[0]:
                axis.set_title(name)
            if name == "depth":
                axis.set_ylabel(pair.title, weight="bold")
                depth_image = image
    figure.colorbar(depth_image, ax=axes[:, 0], location="bottom", shrink=0.85, pad=0.02, label="camera z, scene units")
    figure.suptitle(title)
    return figure


def _show_depth(axis: Any, pair: ViewPair, pairs: tuple[ViewPair, ...]) -> Any:
    depths = np.concatenate([other.front.depth.numpy()[other.front.mask.numpy()] for other in pairs])
    low, high = (np.nanmin(depths), np.nanmax(depths)) if depths.size else (0.0, 1.0)
    shown = np.where(pair.front.mask.numpy(), pair.front.depth.numpy(), np.nan)
    square = window([other.front.mask.numpy() for other in pairs])
    return bare(axis).imshow(shown[square], cmap="viridis_r", vmin=low, vmax=high, interpolation="nearest")


def _show_normals(axis: Any, pair: ViewPair, pairs: tuple[ViewPair, ...]) -> Any:
    square = window([other.front.mask.numpy() for other in pairs])
    return bare(axis).imshow(normals_image(pair.front)[square])


def _show_shaded(axis: Any, pair: ViewPair, pairs: tuple[ViewPair, ...]) -> Any:
    views = {other.title: other.back for other in pairs if other.back is not None}
    shown = np.where(views[pair.title].mask.numpy(), shaded(views[pair.title]), 1.0)
    square = window([view.mask.numpy() for view in views.values()])
    return bare(axis).imshow(shown[square], cmap="gray", vmin=0, vmax=1)


def _show_silhouette(axis: Any, pair: ViewPair, pairs: tuple[ViewPair, ...]) -> None:
    """Compares a silhouette with the true one, that of the last pair."""
    rendered, true = pair.mask.numpy(), pairs[-1].mask.numpy()
    missed, spurious = (100 * pixels.sum() / max(true.sum(), 1) for pixels in (true & ~rendered, rendered & ~true))
    square = window([other.mask.numpy() for other in pairs])
    bare(axis).imshow(silhouette_image(rendered, true)[square], interpolation="nearest")
    label = {"transform": axis.transAxes, "fontsize": 8, "bbox": {"facecolor": "white", "lw": 0, "pad": 1.5}}
    axis.text(0.02, 0.10, f"missed {missed:.1f} %", color=MISSED, **label)
    axis.text(0.02, 0.02, f"spurious {spurious:.1f} %", color=SPURIOUS, **label)


def _show_input(axis: Any, shown: InputView) -> None:
    """Shows photographs, or else the mask with a square of a pixel's size per depth."""
    if shown.photographs is not None:
        indices = np.linspace(0, len(shown.photographs), MAX_PHOTOGRAPHS, endpoint=False).astype(int)
        chosen = shown.photographs[indices]
        bare(axis).imshow(np.concatenate([np.concatenate(chosen[:2], 1), np.concatenate(chosen[2:], 1)], 0))
        return
    mask, depths = shown.view.mask.numpy(), shown.view.depth.numpy()
    rows, columns = window([mask])
    bare(axis).imshow(np.where(mask, 0.85, 1.0), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    axis.set_xlim(columns.start - 0.5, columns.stop - 0.5)
    axis.set_ylim(rows.stop - 0.5, rows.start - 0.5)
    pixels = np.nonzero(shown.observed)
    size = (72 * INPUT_AXES_INCHES / (rows.stop - rows.start)) ** 2  # of a marker, in square points of 1/72 inch
    axis.scatter(pixels[1], pixels[0], c=depths[pixels], s=size, cmap="viridis_r", marker="s", linewidths=0)


def window(masks: Sequence[Bool[np.ndarray, "height width"]]) -> tuple[slice, slice]:
    """The smallest square part of an image that holds all masks, with a margin, as slices of its pixels."""
    top, left, side = (round(max(masks[0].shape) * edge) for edge in style.window(masks, margin=0.12))
    return slice(top, top + side), slice(left, left + side)


def normals_image(view: View) -> Float[np.ndarray, "height width 3"]:
    """The normals of `picture_normals` as red, green, blue; white where the view has no surface."""
    return torch.where(view.mask[..., None], picture_normals(view) / 2 + 0.5, 1.0).clamp(0, 1).numpy()
