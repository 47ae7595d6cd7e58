"""Pictures of a reconstruction: held-out photographs next to the shape with its colours. Not part of any runtime."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib import colormaps, rc_context
from matplotlib.figure import Figure
from torch import Tensor

from bench.evaluate.colours import colours_in_view
from bench.evaluate.refined import refined_view
from bench.evaluate.state import State
from bench.pictures.colours import RenderColours, view_arrays
from bench.pictures.run_figures import at_size, draw_curve, normals_image, save_arrays
from bench.pictures.style import SCREEN, bare, save
from bench.setup.inputs import RunContext, RunInputs
from bench.solve.optimise import History
from bench.solve.solve import failure_of, note_result
from bench.tasks.reconstruction.judge import judge_mesh, judged_pixels
from bench.tasks.reconstruction.subject import Subject
from bench.tasks.reconstruction.surfaces import painter
from datasets.mesh import Mesh
from datasets.photographs import turned
from datasets.scene import Truth, View, see
from datasets.shot import Shot
from renderers.camera import Camera
from renderers.field import Field

MAX_HELD_OUT_SHOWN, MAX_INPUTS_SHOWN = 3, 12
ERROR_COLOURS = colormaps["magma_r"].with_extremes(bad="0.85")  # pixels that are not compared are grey
MAX_ERROR = 0.3  # a larger mean difference of colours has the same, darkest colour


def draw_reconstruction(folder: Path, state: State, subject: Subject, curve: list[dict[str, Any]], title: str) -> None:
    """Writes summary.png, input.png, images.npz and, if `curve` is not empty, curve.png of a field with colours."""
    if curve:
        draw_curve(folder / "curve.png", curve)

    def render(camera: Camera) -> tuple[View, Float[Tensor, "height width 3"]]:
        view = refined_view(state, camera)
        return view, colours_in_view(state, view)

    _save(folder, render, state.inputs, subject, title)


def note_surface(
    run: RunContext,
    mesh: Mesh | None,
    subject: Subject,
    scores: dict[str, float],
    history: History | None = None,
    field: Field | None = None,
) -> None:
    """Evaluates a mesh with colours, records the result, and writes summary.png, input.png and images.npz.

    Args:
        mesh: None if no surface was found.
        history: the history of the optimisation that gave the mesh, if any.
        field: the field whose surface the mesh is, if any.
    """
    after = judge_mesh(mesh, subject, run.inputs)
    failure = after.failure if history is None else failure_of(history, after)
    note_result(run, replace(after, metrics=after.metrics | scores, failure=failure, field=field))
    if run.inputs.evaluation.picture is not None and mesh is not None:
        _save(run.folder, painter(mesh), run.inputs, subject, run.record.outcome)


def draw_picture(
    folder: Path, mesh: Mesh, picture: Float[Tensor, "4 height width"], camera: Camera, size: int, title: str
) -> None:
    """Writes summary.png: a picture as the encoder receives it, and a mesh from the most similar and other views."""
    render = painter(mesh)
    camera = camera.resized(size, size)
    views = [render(turned(camera, angle)) for angle in (0.0, np.pi / 2, np.pi)]
    with rc_context(SCREEN):
        figure = Figure(figsize=(9.6, 2.9), layout="constrained")
        axes = figure.subplots(1, 5)
        axes[0].imshow(picture[:3].permute(1, 2, 0).numpy(), interpolation="nearest")
        for axis, (view, image) in zip(axes[1:4], views, strict=True):
            axis.imshow(np.where(view.mask[..., None], image.numpy(), 1.0).clip(0, 1))
        axes[4].imshow(normals_image(views[0][0]))
        names = ("given, as the encoder sees it", "view most alike", "turned by 90°", "turned by 180°", "its normals")
        for axis, name in zip(axes, names, strict=True):
            bare(axis)
            axis.set_title(name, fontsize=8)
        figure.suptitle(title)
        save(figure, folder / "summary.png")


def _save(folder: Path, render: RenderColours, inputs: RunInputs, subject: Subject, title: str) -> None:
    with rc_context(SCREEN):
        figures = {"summary": _summary(render, inputs, subject, title), "input": _input(subject)}
        for name, figure in figures.items():
            save(figure, folder / f"{name}.png")
    shot = subject.held_out[len(subject.held_out) // 2]
    arrays = {"photograph": shot.colours} | view_arrays(render, at_size(shot.camera, inputs.evaluation.picture))
    if len(subject.input_shots) == 1:
        arrays["given"] = subject.input_shots[0].colours
    if subject.truth is not None:
        behind = turned(at_size(shot.camera, inputs.evaluation.picture), np.pi)
        true = normals_image(see(Truth(subject.truth, closed=False), behind))
        arrays |= view_arrays(render, behind, "back_") | {"back_truth": torch.from_numpy(true)}
    save_arrays(folder, arrays)


def _summary(render: RenderColours, inputs: RunInputs, subject: Subject, title: str) -> Figure:
    """A row per held-out photograph: photograph, rendering, error at the photograph's size, normals."""
    shots = evenly_spaced(subject.held_out, MAX_HELD_OUT_SHOWN)
    aspect = shots[0].camera.height / shots[0].camera.width
    figure = Figure(figsize=(9.6, 2.35 * aspect * len(shots) + 1.2), layout="compressed")
    axes = figure.subplots(len(shots), 4, squeeze=False)
    for row, shot in zip(axes, shots, strict=True):
        view, image = render(at_size(shot.camera, inputs.evaluation.picture))
        row[0].imshow(shot.colours.numpy(), interpolation="nearest")
        row[1].imshow(np.where(view.mask[..., None], image.numpy(), 1.0).clip(0, 1))
        error = row[2].imshow(_error(render, shot), cmap=ERROR_COLOURS, vmin=0, vmax=MAX_ERROR, interpolation="nearest")
        row[3].imshow(normals_image(view))
        row[0].set_ylabel(Path(shot.name).stem if Path(shot.name).suffix else f"photograph {shot.name}")
        for axis in row:
            bare(axis)
    for axis, name in zip(axes[0], ("held-out photograph", "rendering", "difference", "normals"), strict=True):
        axis.set_title(name)
    scale_axis = axes[-1, 2].inset_axes((0.05, -0.1, 0.9, 0.05))
    scale = figure.colorbar(error, cax=scale_axis, orientation="horizontal", extend="max")
    scale.set_label("mean error of colours, 0 to 1")
    figure.suptitle(title)
    return figure


def _error(render: RenderColours, shot: Shot) -> Float[np.ndarray, "height width"]:
    """The mean difference of colours at the photograph's size, as in `judge.IMAGE_SCORES`; NaN at other pixels."""
    image = render(shot.camera)[1]
    judged, photographed = judged_pixels(shot)
    error = (image - shot.colours * photographed[..., None]).abs().mean(-1)
    return torch.where(judged, error, torch.nan).numpy()


def _input(subject: Subject) -> Figure:
    shots = evenly_spaced(subject.input_shots, MAX_INPUTS_SHOWN)
    columns = min(len(shots), 4)
    rows = -(-len(shots) // columns)
    aspect = shots[0].camera.height / shots[0].camera.width
    figure = Figure(figsize=(1.6 * max(columns, 2), 1.6 * aspect * rows + 0.4), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    for axis, shot in zip(axes.flat, shots, strict=False):
        axis.imshow(shot.colours.numpy())
    figure.suptitle(
        "the given photograph" if columns == 1 else f"{len(shots)} of {len(subject.input_shots)} given photographs"
    )
    return figure


def evenly_spaced(shots: tuple[Shot, ...], max_count: int) -> list[Shot]:
    """At most `max_count` photographs, evenly spaced in their order."""
    indices = np.linspace(0, len(shots) - 1, min(max_count, len(shots))).round().astype(int)
    return [shots[index] for index in indices]
