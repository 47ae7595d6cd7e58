"""A scene: one shape, one camera, and the camera's view of it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol, runtime_checkable
from zlib import crc32

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from datasets.dataset import Dataset, Split, seed_of
from datasets.mesh import Mesh
from datasets.range_scans import Scanned
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
    """A true shape and one view of it.

    Args:
        name: of the dataset and the shape.
        mesh: the true shape.
        view: its true images.
        formula: gives the shape as a field, where it has a formula.
        measured: camera z that a scanner measured at the view's pixels, 0 where it measured none; None without one.
    """

    name: str
    mesh: Mesh
    view: View
    formula: Callable[[], Field] | None = None
    measured: Float[Tensor, "height width"] | None = None

    def given(self, *, exact: bool = False) -> tuple[View, Bool[Tensor, "height width"]]:
        """The view whose depths may be given to a task, and the pixels that have one.

        Args:
            exact: True for the mesh's depths also where a scanner measured others, at the same pixels.
        """
        if self.measured is None:
            return self.view, self.view.mask
        known = self.view.mask & (self.measured > 0)
        return self.view if exact else replace(self.view, depth=self.measured), known

    @property
    def on_depths(self) -> list[str]:
        """How many depths a scanner measured, and how good they are, in words; empty without one."""
        if self.measured is None:
            return []
        both = self.view.mask & (self.measured > 0)
        off = (self.measured - self.view.depth)[both].abs()
        beside = int((self.measured > 0).sum()) - len(off)
        note = f"measured: {len(off)} of the shape's {int(self.view.mask.sum())} pixels"
        if len(off):
            half, most = off.quantile(torch.tensor([0.5, 0.95])).tolist()
            note += f"; half of their depths are within {half:.2g} scene units of the mesh, 95 % within {most:.2g}"
        return [f"{note}; {beside} beside its outline are left out"]

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
    scanned = dataset if isinstance(dataset, Scanned) else None
    camera = views.towards(scanned.towards_scanner(index)) if scanned else views.draw(seed_of(split, index))
    view = see(Truth(mesh), camera)
    if not bool(view.mask.any()):
        repaired = f" (repaired: {'; '.join(mesh.repairs)})" if mesh.repairs else ""
        what = f"the camera sees nothing of {dataset.name} {index}{repaired}"
        raise BadInput(f"{what}: widen view.field_of_view or distance")
    formula = partial(dataset.formula, split, index) if isinstance(dataset, Formulas) else None
    measured = see(Truth(scanned.seen(index), closed=False), camera).depth if scanned else None
    return Scene(scene_name(dataset, split, index), mesh, view, formula, measured)


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
