"""Pictures of shapes with colours: as arrays for any shape, and as a figure that compares a code with its mesh."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.figure import Figure
from torch import Tensor

from bench.evaluate.colours import render_image
from bench.evaluate.state import State
from bench.pictures.run_figures import at_size, picture_normals, save_arrays
from bench.pictures.style import SCREEN, bare, save
from bench.setup.inputs import RunContext
from datasets.photographs import turned
from datasets.scene import Scene, View, see, unshaded_image
from renderers.camera import Camera

RenderColours = Callable[[Camera], tuple[View, Float[Tensor, "height width 3"]]]  # view and colours
SIZE_DIVISORS = (8, 4, 1)  # divide the largest size of a rendering
TURN_DEGREES = (120.0, 240.0)  # about the vertical axis
ROW_LABELS = {"": "code of the image", "trained_": "code of training", "true_": "mesh"}  # from prefixes in images.npz
DEFINITIONS = {
    "code_bytes": "Of the code of shape and colour, 4 per number.",
    "mesh_bytes": "Of the true mesh, 12 per vertex and per triangle.",
    "texture_bytes": "Of the true colours, 3 per pixel of the file's images; without images, per vertex of the mesh.",
    "network_bytes": "Of the prior's network, which all codes share, 4 per weight.",
}


def note_colours(run: RunContext, state: State) -> None:
    """Notes the sizes of code, mesh and texture of a run, and writes colours.png and, for galleries, images.npz."""
    inputs, prior, scene = run.inputs, run.inputs.prior, run.inputs.scene
    texels = getattr(scene.texture, "texels", None) or len(scene.mesh.vertices)
    run.record.metrics |= {
        "code_bytes": 4 * prior.decoder.code_length,
        "mesh_bytes": 12 * (len(scene.mesh.vertices) + len(scene.mesh.faces)),
        "texture_bytes": 3 * texels,
        "network_bytes": 4 * sum(weights.numel() for weights in prior.decoder.parameters()),
    }
    run.record.definitions |= DEFINITIONS
    renderers: dict[str, RenderColours] = {"": lambda camera: render_image(state.field, camera, inputs)}
    if inputs.prior_choice.scene_code is not None:
        trained_field = prior.decoder.at(prior.codes[inputs.prior_choice.scene_code].to(inputs.device))
        renderers["trained_"] = lambda camera: render_image(trained_field, camera, inputs)
    renderers["true_"] = lambda camera: _render_mesh(scene, camera)
    camera, evaluation = scene.view.camera, inputs.evaluation
    photograph = _render_mesh(scene, camera)[1].where(scene.view.mask[..., None], 1.0)
    if evaluation.picture is not None:
        _draw(run.folder, photograph, renderers, at_size(camera, evaluation.picture))
    if evaluation.gallery is not None:
        arrays = {"photograph": photograph}
        for prefix, render in renderers.items():
            pictures = picture_arrays(render, camera, evaluation.gallery)
            arrays |= {prefix + name: array for name, array in pictures.items()}
        save_arrays(run.folder, arrays)


def _render_mesh(scene: Scene, camera: Camera) -> tuple[View, Float[Tensor, "height width 3"]]:
    view = see(scene.raycaster, camera)
    return view, unshaded_image(view, scene.texture)


def picture_arrays(render: RenderColours, camera: Camera, largest: int) -> dict[str, Tensor]:
    """Pictures of a shape in several sizes, size_0_..., and in the largest size from other sides, turned_0_..."""
    cameras = {f"size_{i}_": at_size(camera, largest // divisor) for i, divisor in enumerate(SIZE_DIVISORS)}
    camera = at_size(camera, largest)
    cameras |= {f"turned_{i}_": turned(camera, np.radians(angle)) for i, angle in enumerate(TURN_DEGREES)}
    return {k: v for prefix, camera in cameras.items() for k, v in view_arrays(render, camera, prefix).items()}


def view_arrays(render: RenderColours, camera: Camera, prefix: str = "") -> dict[str, Tensor]:
    view, image = render(camera)
    arrays = {"colours": image, "normals": picture_normals(view), "hit": view.mask}
    return {prefix + name: array for name, array in arrays.items()}


@rc_context(SCREEN)
def _draw(folder: Path, photograph: Tensor, renderers: dict[str, RenderColours], camera: Camera) -> None:
    """Writes colours.png: the input photograph, and a row per shape, from its camera and from other sides."""
    cameras = [camera, *(turned(camera, np.radians(angle)) for angle in TURN_DEGREES)]
    figure = Figure(figsize=(8.0, 2.1 * len(renderers)), layout="constrained")
    axes = figure.subplots(len(renderers), 1 + len(cameras), squeeze=False)
    for (first, *others), (prefix, render) in zip(axes, renderers.items(), strict=True):
        bare(first).set_visible(not prefix)
        others[0].set_ylabel(ROW_LABELS[prefix])
        for axis, viewpoint in zip(others, cameras, strict=True):
            view, image = render(viewpoint)
            bare(axis).imshow(torch.where(view.mask[..., None], image, 1.0).clamp(0, 1).numpy())
    axes[0, 0].imshow(photograph.numpy(), interpolation="nearest")
    axes[0, 0].set_title("given")
    save(figure, folder / "colours.png")
