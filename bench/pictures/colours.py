"""Pictures of shapes with colours: of any, as arrays; of a code of shape and colour, beside its mesh."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.figure import Figure
from torch import Tensor

from bench.evaluate.evaluate import render_image
from bench.evaluate.state import State
from bench.pictures.run_figures import at_size, picture_normals, save_arrays
from bench.pictures.style import SCREEN, bare, save
from bench.setup.inputs import RunContext
from datasets.photographs import turned
from datasets.scene import Scene, View, see, unshaded_image
from renderers.camera import Camera

Seen = Callable[[Camera], tuple[View, Float[Tensor, "height width 3"]]]  # a camera's view of a shape, and its colours
SMALLER = (8, 4, 1)  # by which the largest size of a rendering is divided
TURNS = (120.0, 240.0)  # degrees about the vertical axis
KINDS = {"": "code of the image", "trained_": "code of training", "true_": "mesh"}  # by their prefix in images.npz
DEFINITIONS = {
    "code_bytes": "Of the code of shape and colour, 4 per number.",
    "mesh_bytes": "Of the true mesh, 12 per vertex and per triangle.",
    "texture_bytes": "Of the true colours, 3 per pixel of the file's images; without images, per vertex of the mesh.",
    "network_bytes": "Of the prior's network, which all codes share, 4 per weight.",
}


def note_colours(run: RunContext, state: State) -> None:
    """Notes the sizes of code, mesh and texture, and writes colours.png and, for galleries, images.npz.

    Args:
        run: its scene has a texture, its prior colours.
        state: whose field is that of the code that was found.
    """
    inputs, prior, scene = run.inputs, run.inputs.prior, run.inputs.scene
    texels = getattr(scene.texture, "texels", None) or len(scene.mesh.vertices)
    run.record.metrics |= {
        "code_bytes": 4 * prior.decoder.code_length,
        "mesh_bytes": 12 * (len(scene.mesh.vertices) + len(scene.mesh.faces)),
        "texture_bytes": 3 * texels,
        "network_bytes": 4 * sum(weights.numel() for weights in prior.decoder.parameters()),
    }
    run.record.definitions |= DEFINITIONS
    shown: dict[str, Seen] = {"": lambda camera: render_image(state.field, camera, inputs)}
    if inputs.prior_choice.scene_code is not None:
        known = prior.decoder.at(prior.codes[inputs.prior_choice.scene_code].to(inputs.device))
        shown["trained_"] = lambda camera: render_image(known, camera, inputs)
    shown["true_"] = lambda camera: _of_mesh(scene, camera)
    camera, evaluation = scene.view.camera, inputs.evaluation
    given = _of_mesh(scene, camera)[1].where(scene.view.mask[..., None], 1.0)
    if evaluation.picture is not None:
        _draw(run.folder, given, shown, at_size(camera, evaluation.picture))
    if evaluation.gallery is not None:
        again = {prefix: rendered_again(seen, camera, evaluation.gallery) for prefix, seen in shown.items()}
        arrays = {prefix + name: array for prefix, arrays in again.items() for name, array in arrays.items()}
        save_arrays(run.folder, {"photograph": given, **arrays})


def _of_mesh(scene: Scene, camera: Camera) -> tuple[View, Float[Tensor, "height width 3"]]:
    view = see(scene.raycaster, camera)
    return view, unshaded_image(view, scene.texture)


def rendered_again(seen: Seen, camera: Camera, largest: int) -> dict[str, Tensor]:
    """Pictures of a shape in several sizes, size_0_... and so on, and at the last from other sides, turned_0_..."""
    cameras = {f"size_{place}_": at_size(camera, largest // smaller) for place, smaller in enumerate(SMALLER)}
    at_last = at_size(camera, largest)
    cameras |= {f"turned_{place}_": turned(at_last, np.radians(angle)) for place, angle in enumerate(TURNS)}
    return {k: v for prefix, one in cameras.items() for k, v in seen_arrays(seen, one, prefix).items()}


def seen_arrays(seen: Seen, camera: Camera, prefix: str = "") -> dict[str, Tensor]:
    """The colours, normals and hits that a camera sees, by names with a prefix."""
    view, image = seen(camera)
    parts = {"colours": image, "normals": picture_normals(view), "hit": view.mask}
    return {prefix + name: part for name, part in parts.items()}


@rc_context(SCREEN)
def _draw(folder: Path, given: Float[Tensor, "height width 3"], shown: dict[str, Seen], camera: Camera) -> None:
    """Writes colours.png: the image as it was given, and a row per shape, from its camera and turned."""
    cameras = [camera, *(turned(camera, np.radians(angle)) for angle in TURNS)]
    figure = Figure(figsize=(8.0, 2.1 * len(shown)), layout="constrained")
    axes = figure.subplots(len(shown), 1 + len(cameras), squeeze=False)
    for (first, *others), (prefix, seen) in zip(axes, shown.items(), strict=True):
        bare(first).set_visible(not prefix)
        others[0].set_ylabel(KINDS[prefix])
        for axis, one in zip(others, cameras, strict=True):
            view, image = seen(one)
            bare(axis).imshow(torch.where(view.mask[..., None], image, 1.0).clamp(0, 1).numpy())
    axes[0, 0].imshow(given.numpy(), interpolation="nearest")
    axes[0, 0].set_title("given")
    save(figure, folder / "colours.png")
