"""A scene: one shape, one camera, and the camera's view of it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol, runtime_checkable
from zlib import crc32

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from datasets.dataset import Dataset, Split, seed_of
from datasets.mesh import Mesh
from datasets.truth import Truth
from datasets.views import ViewSampler
from renderers.camera import Camera
from renderers.checks import BadInput
from renderers.field import Field


@dataclass(frozen=True)
class View:
    """A camera and its true images.

    Args:
        camera: its resolution is that of the images.
        depth: camera z, in scene units; 0 on the background.
        normals: unit, in world coordinates; 0 on the background.
        mask: true on the foreground.
    """

    camera: Camera
    depth: Float[Tensor, "height width"]
    normals: Float[Tensor, "height width 3"]
    mask: Bool[Tensor, "height width"]


@dataclass(frozen=True)
class Scene:
    """A true shape and one view of it; `formula` gives the shape as a field, where it has a formula."""

    name: str
    mesh: Mesh
    view: View
    formula: Callable[[], Field] | None = None

    def seed(self, seed: int) -> int:
        """A run's seed combined with the scene's name, so that draws for different scenes are independent."""
        return crc32(self.name.encode()) ^ seed


@runtime_checkable
class Formulas(Protocol):
    """A dataset whose shapes are formulas."""

    def formula(self, split: Split, index: int) -> Field:
        """Shape number `index` of a split as a field."""
        ...


def make_scene(dataset: Dataset, views: ViewSampler, *, split: Split, index: int) -> Scene:
    """The scene of shape number `index` of a split, with the camera of that number."""
    mesh = dataset.mesh(split, index)
    view = see(Truth(mesh), views.draw(seed_of(split, index)))
    if not bool(view.mask.any()):
        repaired = f" (repaired: {'; '.join(mesh.repairs)})" if mesh.repairs else ""
        what = f"the camera sees nothing of {dataset.name} {index}{repaired}"
        raise BadInput(f"{what}: widen view.field_of_view or distance")
    formula = partial(dataset.formula, split, index) if isinstance(dataset, Formulas) else None
    return Scene(scene_name(dataset, split, index), mesh, view, formula)


def scene_name(dataset: Dataset, split: Split, index: int) -> str:
    """The name of a dataset's shape."""
    return f"{dataset.name} {split} {index}"


def see(truth: Truth, camera: Camera) -> View:
    """The true images of a mesh, by casting a ray through each pixel's centre."""
    rays = camera.rays()
    flat = rays.flat()
    hits = truth.cast(flat.origins.numpy().astype(np.float64), flat.directions.numpy().astype(np.float64))
    mask = torch.from_numpy(hits.hit).view(rays.shape)
    distance = torch.from_numpy(np.where(hits.hit, hits.distance, 0.0).astype(np.float32)).view(rays.shape)
    normals = torch.from_numpy(np.where(hits.hit[:, None], hits.normals, 0.0).astype(np.float32))
    return View(camera, camera.depth(distance), normals.view(*rays.shape, 3), mask)
