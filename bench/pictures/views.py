"""Views for a run's pictures, rendered at a higher resolution than in the run, and their arrays for the report."""

from dataclasses import replace
from math import atan2, degrees
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bench.evaluate.evaluate import render_view
from bench.pictures.run_figures import Given, ViewPair, draw_all
from bench.setup.inputs import RunInputs
from datasets.scene import View, see
from datasets.truth import Truth
from renderers.camera import Camera
from renderers.field import Field

BEHIND = 160.0  # degrees about the vertical axis from the given camera to the one behind
BEHIND_ELEVATION = 25.0  # degrees


def draw_run(
    folder: Path,
    inputs: RunInputs,
    fields: tuple[Field, Field],
    given: Given,
    curve: list[dict[str, Any]],
    title: str,
) -> None:
    """Writes the pictures of a run.

    Args:
        folder: the run folder.
        inputs: of the run.
        fields: before and after the optimisation.
        given: the observations.
        curve: lines of curve.jsonl.
        title: of the summary.
    """
    front, back = _cameras(inputs)
    found = [
        ViewPair(name, render_view(field, front, inputs), render_view(field, back, inputs))
        for name, field in zip(("before", "after"), fields, strict=True)
    ]
    truth = Truth(inputs.scene.mesh)
    pairs = (found[0], found[1], ViewPair("truth", see(truth, front), see(truth, back)))
    draw_all(folder, pairs=pairs, given=given, curve=curve, title=title)


def _cameras(inputs: RunInputs) -> tuple[Camera, Camera]:
    """The scene's camera at the pictures' resolution, and one behind the shape."""
    camera, size = inputs.scene.view.camera, inputs.evaluation.picture
    x, _, z = camera.center.tolist()
    views = replace(inputs.views, resolution=size)
    behind = views.camera(degrees(atan2(x, z)) + BEHIND, BEHIND_ELEVATION)
    return camera.resized(size, size), behind


def save_images(folder: Path, found: View, true: View, **more: np.ndarray) -> None:
    """Writes `folder/images.npz`: normals of both [h, w, 3], hits of both and the depth error [h, w], and `more`."""
    arrays = {
        "normals": picture_normals(found).half(),
        "reference_normals": picture_normals(true).half(),
        "hit": found.mask,
        "reference_hit": true.mask,
        "depth_error": torch.where(found.mask & true.mask, (found.depth - true.depth).abs(), torch.nan),
    }
    plain = {name: array.numpy() for name, array in arrays.items()}
    np.savez_compressed(folder / "images.npz", **plain, **more)  # type: ignore[arg-type]


def picture_normals(view: View) -> Float[Tensor, "height width 3"]:
    """Normals with axes to the right, up and towards the camera, as pictures show them."""
    rotation = view.camera.world_to_camera[:3, :3].to(view.normals.dtype)
    return (view.normals @ rotation.T) * torch.tensor([1, -1, -1])
