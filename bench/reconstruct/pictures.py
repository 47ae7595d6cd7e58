"""Pictures of a reconstruction: held-out photographs beside the shape with its colours. Not part of any timing."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib import colormaps, rc_context
from matplotlib.figure import Figure
from torch import Tensor

from bench.evaluate.state import State
from bench.pictures.colours import RenderColours, view_arrays
from bench.pictures.run_figures import at_size, draw_curve, normals_image, save_arrays
from bench.pictures.style import SCREEN, bare, save
from bench.reconstruct.judge import judge_mesh, judged_pixels
from bench.reconstruct.subject import Subject
from bench.reconstruct.surfaces import painter
from bench.setup.inputs import RunContext, RunInputs
from bench.solve.optimise import History
from bench.solve.solve import failure_of, note_result
from datasets.mesh import Mesh
from datasets.photographs import turned
from datasets.scene import Truth, View, see
from datasets.shot import Shot
from renderers.camera import Camera
from renderers.field import Field

MOST_HELD_OUT, MOST_GIVEN = 3, 12  # photographs in a picture
ERRORS = colormaps["magma_r"].with_extremes(bad="0.85")  # grey where nothing is judged
WORST = 0.3  # mean difference of colours that is shown darkest


def draw_reconstruction(folder: Path, state: State, subject: Subject, curve: list[dict[str, Any]], title: str) -> None:
    """Writes summary.png, input.png, images.npz and, of a loop, curve.png, of a field with colours."""
    if curve:
        draw_curve(folder / "curve.png", curve)

    def seen(camera: Camera) -> tuple[View, Float[Tensor, "height width 3"]]:
        view = state.refined_view(camera)
        return view, state.colours(view)

    _save(folder, seen, state.inputs, subject, title)


def note_surface(
    run: RunContext,
    mesh: Mesh | None,
    subject: Subject,
    scores: dict[str, float],
    history: History | None = None,
    field: Field | None = None,
) -> None:
    """Judges a mesh with colours, notes the result, and writes summary.png, input.png and images.npz.

    Args:
        mesh: None where no surface was found.
        history: of the loop that found it, where there was one.
        field: whose surface it is, where it is that of one.
    """
    after = judge_mesh(mesh, subject, run.inputs)
    failure = after.failure if history is None else failure_of(history, after)
    note_result(run, replace(after, metrics=after.metrics | scores, failure=failure, field=field))
    if run.inputs.evaluation.picture is not None and mesh is not None:
        _save(run.folder, painter(mesh), run.inputs, subject, run.record.outcome)


def draw_picture(
    folder: Path, mesh: Mesh, given: Float[Tensor, "4 height width"], camera: Camera, size: int, title: str
) -> None:
    """Writes summary.png: a picture as the encoder is given it, and a mesh from the most alike and from other views."""
    seen = painter(mesh)
    camera = camera.resized(size, size)
    views = [seen(turned(camera, angle)) for angle in (0.0, np.pi / 2, np.pi)]
    with rc_context(SCREEN):
        figure = Figure(figsize=(9.6, 2.9), layout="constrained")
        axes = figure.subplots(1, 5)
        axes[0].imshow(given[:3].permute(1, 2, 0).numpy(), interpolation="nearest")
        for axis, (view, image) in zip(axes[1:4], views, strict=True):
            axis.imshow(np.where(view.mask[..., None], image.numpy(), 1.0).clip(0, 1))
        axes[4].imshow(normals_image(views[0][0]))
        names = ("given, as the encoder sees it", "view most alike", "turned by 90°", "turned by 180°", "its normals")
        for axis, name in zip(axes, names, strict=True):
            bare(axis)
            axis.set_title(name, fontsize=8)
        figure.suptitle(title)
        save(figure, folder / "summary.png")


def _save(folder: Path, seen: RenderColours, inputs: RunInputs, subject: Subject, title: str) -> None:
    with rc_context(SCREEN):
        figures = {"summary": _summary(seen, inputs, subject, title), "input": _input(subject)}
        for name, figure in figures.items():
            save(figure, folder / f"{name}.png")
    shot = subject.held_out[len(subject.held_out) // 2]
    arrays = {"photograph": shot.colours} | view_arrays(seen, at_size(shot.camera, inputs.evaluation.picture))
    if len(subject.given) == 1:
        arrays["given"] = subject.given[0].colours
    if subject.truth is not None:
        behind = turned(at_size(shot.camera, inputs.evaluation.picture), np.pi)
        true = normals_image(see(Truth(subject.truth, closed=False), behind))
        arrays |= view_arrays(seen, behind, "back_") | {"back_truth": torch.from_numpy(true)}
    save_arrays(folder, arrays)


def _summary(seen: RenderColours, inputs: RunInputs, subject: Subject, title: str) -> Figure:
    """A row per held-out photograph: it, the rendering at the pictures' size, the error at its own, the normals."""
    shots = spread(subject.held_out, MOST_HELD_OUT)
    tall = shots[0].camera.height / shots[0].camera.width
    figure = Figure(figsize=(9.6, 2.35 * tall * len(shots) + 1.2), layout="compressed")
    axes = figure.subplots(len(shots), 4, squeeze=False)
    for row, shot in zip(axes, shots, strict=True):
        view, image = seen(at_size(shot.camera, inputs.evaluation.picture))
        row[0].imshow(shot.colours.numpy(), interpolation="nearest")
        row[1].imshow(np.where(view.mask[..., None], image.numpy(), 1.0).clip(0, 1))
        shown = row[2].imshow(_error(seen, shot), cmap=ERRORS, vmin=0, vmax=WORST, interpolation="nearest")
        row[3].imshow(normals_image(view))
        row[0].set_ylabel(Path(shot.name).stem if Path(shot.name).suffix else f"photograph {shot.name}")
        for axis in row:
            bare(axis)
    for axis, name in zip(axes[0], ("held-out photograph", "rendering", "difference", "normals"), strict=True):
        axis.set_title(name)
    below = axes[-1, 2].inset_axes((0.05, -0.1, 0.9, 0.05))
    scale = figure.colorbar(shown, cax=below, orientation="horizontal", extend="max")
    scale.set_label("mean error of colours, 0 to 1")
    figure.suptitle(title)
    return figure


def _error(seen: RenderColours, shot: Shot) -> Float[np.ndarray, "height width"]:
    """The mean difference of colours at the photograph's own size, as `judge.IMAGES` has it; NaN elsewhere."""
    image = seen(shot.camera)[1]
    judged, known = judged_pixels(shot)
    error = (image - shot.colours * known[..., None]).abs().mean(-1)
    return torch.where(judged, error, torch.nan).numpy()


def _input(subject: Subject) -> Figure:
    """Some of the given photographs."""
    shots = spread(subject.given, MOST_GIVEN)
    columns = min(len(shots), 4)
    rows = -(-len(shots) // columns)
    tall = shots[0].camera.height / shots[0].camera.width
    figure = Figure(figsize=(1.6 * max(columns, 2), 1.6 * tall * rows + 0.4), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    for axis, shot in zip(axes.flat, shots, strict=False):
        axis.imshow(shot.colours.numpy())
    figure.suptitle(
        "the given photograph" if columns == 1 else f"{len(shots)} of {len(subject.given)} given photographs"
    )
    return figure


def spread(shots: tuple[Shot, ...], most: int) -> list[Shot]:
    """Evenly spaced ones, at most so many."""
    places = np.linspace(0, len(shots) - 1, min(most, len(shots))).round().astype(int)
    return [shots[place] for place in places]
