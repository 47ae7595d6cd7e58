"""Pictures of a run: what was given, what was found before and after, what is true. Off every clock."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure

from datasets.scene import View

STYLE = {"font.size": 9, "axes.titlesize": 10, "axes.spines.top": False, "axes.spines.right": False}
LOST, FALSE, BOTH, PAPER = (0.84, 0.15, 0.16), (0.12, 0.47, 0.71), (0.82, 0.82, 0.82), (1.0, 1.0, 1.0)
LIGHT = np.array([-0.35, -0.6, -0.72])  # from the camera's upper left, in camera axes
TERMS = {
    "total": "#222222",
    "depth": "#1f77b4",
    "photometric": "#1f77b4",
    "silhouette": "#d62728",
    "normals": "#2ca02c",
    "code": "#7f7f7f",
}
MOST_PHOTOGRAPHS = 4  # that are shown, in two rows


@dataclass(frozen=True)
class Looks:
    """The same two cameras' views of one shape: the given one, and one from behind."""

    title: str
    front: View
    back: View


@dataclass(frozen=True)
class Given:
    """What a run was given: depths of a view, or photographs.

    Args:
        view: the scene's.
        observed: its pixels whose depth was given.
        photographs: all of them, or None.
        mask: whether the silhouette was given, too.
    """

    view: View
    observed: Bool[np.ndarray, "height width"]
    photographs: Float[np.ndarray, "views height width 3"] | None = None
    mask: bool = True

    @property
    def told(self) -> str:
        """What it was, in words."""
        if self.photographs is not None:
            return f"{len(self.photographs)} photographs"
        return f"{'mask and ' if self.mask else ''}{int(self.observed.sum())} depths"


def draw_all(
    folder: Path,
    *,
    looks: tuple[Looks, Looks, Looks],
    given: Given,
    curve: list[dict[str, Any]],
    title: str,
) -> None:
    """Writes the pictures of a run: summary.png and its parts.

    Args:
        folder: the run folder.
        looks: before, after, truth.
        given: what the run was given.
        curve: lines of curve.jsonl.
        title: of the summary.
    """
    matplotlib.use("Agg")
    with matplotlib.rc_context(STYLE):
        figures = {
            "input": _input(given),
            "depth": _row(looks, _show_depth, "Depth (camera z, scene units)"),
            "normals": _row(looks, _show_normals, "Normals (right, up, towards the camera as red, green, blue)"),
            "silhouette": _row(looks[:2], _show_silhouette(looks[2]), "Silhouette error"),
            "curve": _curve(curve),
            "summary": _summary(looks, given, title),
        }
        for name, figure in figures.items():
            figure.savefig(folder / f"{name}.png", dpi=110, bbox_inches="tight")


def draw_curve(path: Path, curve: list[dict[str, Any]]) -> None:
    """Writes the terms of a loss over iterations and seconds."""
    matplotlib.use("Agg")
    with matplotlib.rc_context(STYLE):
        _curve(curve).savefig(path, dpi=110, bbox_inches="tight")


def draw_against(path: Path, found: View, true: View, *, title: str) -> None:
    """Writes a picture of a view beside the true one: normals of both, and what was lost and what is false."""
    matplotlib.use("Agg")
    pair = Looks("rendered", found, found), Looks("reference", true, true)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.2, 3.5), layout="constrained")
        axes = figure.subplots(1, 3)
        for axis, look in zip(axes, pair, strict=False):
            _show_normals(axis, look, pair)
            axis.set_title(f"normals, {look.title}")
        _show_silhouette(pair[1])(axes[2], pair[0], pair)
        axes[2].set_title("silhouette error")
        figure.suptitle(title)
        figure.savefig(path, dpi=110, bbox_inches="tight")


def _summary(looks: tuple[Looks, ...], given: Given, title: str) -> Figure:
    columns = {
        "depth": _show_depth,
        "normals": _show_normals,
        "silhouette error": _show_silhouette(looks[2]),
        "from behind": _show_shaded,
    }
    figure = Figure(figsize=(9.2, 7.4), layout="constrained")
    axes = figure.subplots(3, 4)
    for row, look in zip(axes, looks, strict=True):
        for axis, (name, show) in zip(row, columns.items(), strict=True):
            if look is looks[2] and name == "silhouette error":
                _show_given(axis, given)
                axis.set_xlabel(f"given: {given.told}")
            else:
                image = show(axis, look, looks)
            if look is looks[0]:
                axis.set_title(name)
            if name == "depth":
                axis.set_ylabel(look.title, weight="bold")
                depth_image = image
    figure.colorbar(depth_image, ax=axes[:, 0], location="bottom", shrink=0.85, pad=0.02, label="camera z, scene units")
    figure.suptitle(title)
    return figure


def _row(looks: tuple[Looks, ...], show: Any, title: str) -> Figure:
    figure = Figure(figsize=(3.2 * len(looks) + 0.6, 3.5), layout="constrained")
    axes = figure.subplots(1, len(looks))
    for axis, look in zip(axes, looks, strict=True):
        image = show(axis, look, looks)
        axis.set_title(look.title)
    if show is _show_depth:
        figure.colorbar(image, ax=axes, shrink=0.8)
    figure.suptitle(title)
    return figure


def _input(given: Given) -> Figure:
    figure = Figure(figsize=(4.6, 4.0), layout="constrained")
    axis = figure.subplots()
    points = _show_given(axis, given, inches=3.5)
    if given.photographs is None:
        figure.colorbar(points, ax=axis, label="depth (scene units)", shrink=0.8)
    axis.set_title(f"Given: {given.told}")
    return figure


def _curve(curve: list[dict[str, Any]]) -> Figure:
    figure = Figure(figsize=(8.0, 3.2), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for axis, (key, label) in zip(axes, (("iteration", "iteration"), ("seconds", "seconds in the loop")), strict=True):
        for name, colour in TERMS.items():
            values = [line[name] for line in curve if name in line]
            if any(value > 0 for value in values):
                axis.semilogy([line[key] for line in curve], values, label=name, color=colour, lw=1.4)
        axis.set_xlabel(label)
    figure.axes[0].set_ylabel("weighted loss")
    if figure.axes[0].lines:
        figure.axes[0].legend(frameon=False)
    return figure


def _show_depth(axis: Any, look: Looks, looks: tuple[Looks, ...]) -> Any:
    low, high = _depth_range(looks)
    shown = np.where(look.front.mask.numpy(), look.front.depth.numpy(), np.nan)
    part = window([other.front.mask.numpy() for other in looks])
    return bare(axis).imshow(shown[part], cmap="viridis_r", vmin=low, vmax=high, interpolation="nearest")


def _show_normals(axis: Any, look: Looks, looks: tuple[Looks, ...]) -> Any:
    flipped = _camera_normals(look.front) * [1, -1, -1]  # to right, up, towards the camera
    shown = np.where(look.front.mask.numpy()[..., None], flipped / 2 + 0.5, 1.0).clip(0, 1)
    return bare(axis).imshow(shown[window([other.front.mask.numpy() for other in looks])])


def _show_shaded(axis: Any, look: Looks, looks: tuple[Looks, ...]) -> Any:
    shade = 0.25 + 0.75 * (_camera_normals(look.back) @ (LIGHT / np.linalg.norm(LIGHT))).clip(0, 1)
    shown = np.where(look.back.mask.numpy(), shade, 1.0)
    part = window([other.back.mask.numpy() for other in looks])
    return bare(axis).imshow(shown[part], cmap="gray", vmin=0, vmax=1)


def _show_silhouette(truth: Looks) -> Any:
    def show(axis: Any, look: Looks, looks: tuple[Looks, ...]) -> None:
        found, true = look.front.mask.numpy(), truth.front.mask.numpy()
        image = silhouette_image(found, true)
        lost, false = (100 * part.sum() / max(true.sum(), 1) for part in (true & ~found, found & ~true))
        part = window([other.front.mask.numpy() for other in (*looks, truth)])
        bare(axis).imshow(image[part], interpolation="nearest")
        label = {"transform": axis.transAxes, "fontsize": 8, "bbox": {"facecolor": "white", "lw": 0, "pad": 1.5}}
        axis.text(0.02, 0.10, f"lost {lost:.1f} %", color=LOST, **label)
        axis.text(0.02, 0.02, f"false {false:.1f} %", color=FALSE, **label)

    return show


def _show_given(axis: Any, given: Given, inches: float = 2.0) -> Any:
    """Some photographs; or the mask and a square of a pixel's size for each depth, on axes `inches` wide."""
    if given.photographs is not None:
        places = np.linspace(0, len(given.photographs), MOST_PHOTOGRAPHS, endpoint=False).astype(int)
        chosen = given.photographs[places]
        return bare(axis).imshow(np.concatenate([np.concatenate(chosen[:2], 1), np.concatenate(chosen[2:], 1)], 0))
    mask = given.view.mask.numpy()
    rows, columns = window([mask])
    bare(axis).imshow(np.where(mask, 0.85, 1.0), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    axis.set_xlim(columns.start - 0.5, columns.stop - 0.5)
    axis.set_ylim(rows.stop - 0.5, rows.start - 0.5)
    at = np.nonzero(given.observed)
    size = (72 * inches / (rows.stop - rows.start)) ** 2  # of a marker, in square points of 1/72 inch
    return axis.scatter(
        at[1], at[0], c=given.view.depth.numpy()[at], s=size, cmap="viridis_r", marker="s", linewidths=0
    )


def window(masks: list[Bool[np.ndarray, "height width"]]) -> tuple[slice, slice]:
    """The square part of an image that holds all masks, with a margin."""
    together = np.any(masks, axis=0)
    if not together.any():
        return slice(0, together.shape[0]), slice(0, together.shape[1])
    low = np.array([np.nonzero(together.any(1 - axis))[0][0] for axis in (0, 1)])
    high = np.array([np.nonzero(together.any(1 - axis))[0][-1] + 1 for axis in (0, 1)])
    size = min(int((high - low).max() * 1.12) + 2, min(together.shape))
    start = np.clip((low + high - size) // 2, 0, np.array(together.shape) - size)
    return slice(start[0], start[0] + size), slice(start[1], start[1] + size)


def _camera_normals(view: View) -> Float[np.ndarray, "height width 3"]:
    return view.normals.numpy() @ view.camera.world_to_camera[:3, :3].numpy().T


def _depth_range(looks: tuple[Looks, ...]) -> tuple[float, float]:
    depths = np.concatenate([look.front.depth.numpy()[look.front.mask.numpy()] for look in looks])
    return (float(depths.min()), float(depths.max())) if depths.size else (0.0, 1.0)


def silhouette_image(
    found: Bool[np.ndarray, "height width"], true: Bool[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width 3"]:
    """What two masks share in grey, what is lost in red, what is false in blue."""
    cases = [(found & true)[..., None], (true & ~found)[..., None], (found & ~true)[..., None]]
    return np.select(cases, [BOTH, LOST, FALSE], PAPER)


def bare(axis: Any) -> Any:
    """An axis of a picture: a thin frame, no ticks."""
    axis.set_xticks([])
    axis.set_yticks([])
    for spine in axis.spines.values():
        spine.set_visible(True)
        spine.set_color("#bbbbbb")
    return axis
