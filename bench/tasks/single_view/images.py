"""Images of many shapes from random views, with masks and depths: rendered once per dataset, then read from a file."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from bench.progress import Report
from bench.records.record import digest
from bench.shape_prior import load_or_make
from bench.tasks.reconstruction.pixels import Pixels
from bench.tasks.reconstruction.subject import hull_distances
from datasets.files.captures.hull import carve
from datasets.mesh import Mesh
from datasets.photographs import BACKGROUND_GREY, Photography
from datasets.scene import Dataset, Split, Truth, sample_surface, scene_name, see, seed_of
from datasets.shot import Shot, mask_iou
from datasets.views import ViewSampler
from renderers.camera import Camera, sphere_span
from renderers.checks import BadInput

VERSION = 1  # raise it when the images or points change, so that no old file is used
OCCUPANCY_POINTS = 8192  # per shape: half in the cube, half near the surface
NEAR_SURFACE_STD = 0.05  # scene units, from the surface
NEAR_HULL_STD = 0.07  # scene units, from points in the visual hull
CUBE_HALF_SIDE = 1.0
MIN_MASK_OVERLAP = 0.85  # median IoU of masks and mesh over a shape's images
MAX_INTRINSICS_DIFFERENCE = 1e-2  # pixels
PER_VIEW_FIELDS = ("motions", "colours", "masks", "depths")
STACKED_FIELDS = (*PER_VIEW_FIELDS, "points", "inside")  # a file stacks them over shapes


@runtime_checkable
class Pictured(Protocol):
    """A dataset that includes rendered images of its shapes."""

    def shots(self, split: Split, index: int, longest: int) -> tuple[Shot, ...] | None:
        """A shape's images with cameras in its mesh's world, `longest` pixels per side at most; None without any."""


@dataclass(frozen=True)
class ShapeImages:
    """Images of one shape.

    Args:
        intrinsics, motions: `Camera.intrinsics` of all cameras and `Camera.world_to_camera` of each camera.
        colours: 0 to 255.
        masks: true on the shape.
        depths: camera z, in scene units; 0 on the background.
        points: in space, near the surface or anywhere.
        inside: whether each point lies in the shape.
    """

    intrinsics: Float[Tensor, "3 3"]
    motions: Float[Tensor, "views 4 4"]
    colours: UInt8[Tensor, "views height width 3"]
    masks: Bool[Tensor, "views height width"]
    depths: Float[Tensor, "views height width"]
    points: Float[Tensor, "points 3"]
    inside: Bool[Tensor, " points"]

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        height, width = self.masks.shape[1:]
        return tuple(Camera(self.intrinsics, motion, height, width) for motion in self.motions)

    def image(self, view: int) -> Float[Tensor, "4 height width"]:
        return as_input(self.colours[view].float() / 255, self.masks[view])

    def images(self) -> Float[Tensor, "views 4 height width"]:
        return torch.stack([self.image(view) for view in range(len(self.cameras))])

    def first(self, views: int) -> "ShapeImages":
        """The first `views` images, with all points."""
        return replace(self, **{name: getattr(self, name)[:views] for name in PER_VIEW_FIELDS})

    def shots(self) -> tuple[Shot, ...]:
        images = zip(self.cameras, self.colours, self.masks, self.depths, strict=True)
        return tuple(
            Shot(str(index), camera, colours.float() / 255, mask, depth)
            for index, (camera, colours, mask, depth) in enumerate(images)
        )

    def hull_samples(self, seed: int) -> tuple[Float[Tensor, "points 3"], Bool[Tensor, " points"]]:
        """Points in the cube and points near the visual hull of the masks, and whether each lies in the hull."""
        draw, shots = torch.Generator().manual_seed(seed), self.shots()
        uniform = CUBE_HALF_SIDE * (2 * torch.rand(2 * OCCUPANCY_POINTS, 3, generator=draw, device="cpu") - 1)
        inside = carve(shots, uniform) < 0
        sources = uniform[inside] if bool(inside.any()) else uniform
        near = sources[torch.randint(len(sources), (OCCUPANCY_POINTS,), generator=draw, device="cpu")]
        near = near + NEAR_HULL_STD * torch.randn(OCCUPANCY_POINTS, 3, generator=draw, device="cpu")
        points = torch.cat([uniform[:OCCUPANCY_POINTS], near])
        return points, torch.cat([inside[:OCCUPANCY_POINTS], carve(shots, near) < 0])

    @cached_property
    def distances_to_hull(self) -> list[Float[Tensor, "height width"]]:
        """Distances along the rays of each image to the visual hull of the masks; NaN for rays that miss it."""
        return hull_distances([replace(shot, depth=None) for shot in self.shots()])

    def pixels(
        self, view: int, count: int, generator: torch.Generator, device: torch.device, *, hull: bool = False
    ) -> Pixels:
        """Random pixels of an image whose rays intersect the unit sphere, with colours, mask and depth.

        Args:
            hull: whether the silhouette loss uses the distance to the visual hull, not the observed distance.
        """
        camera = self.cameras[view]
        rays = camera.rays().flat()
        candidates = sphere_span(rays)[2].nonzero().squeeze(-1)
        chosen = candidates[torch.randint(len(candidates), (count,), generator=generator, device="cpu")]
        depth_per_distance = camera.depth(torch.ones_like(self.depths[view])).flatten()[chosen]
        mask, depth = self.masks[view].flatten()[chosen], self.depths[view].flatten()[chosen]
        distance = torch.where(mask, depth / depth_per_distance, torch.nan)
        return Pixels(
            rays[chosen].to(device),
            (self.colours[view].reshape(-1, 3)[chosen].float() / 255).to(device),
            depth_per_distance.to(device),
            mask.to(device),
            distance.to(device),
            (self.distances_to_hull[view].flatten()[chosen] if hull else distance).to(device),
            None,
        )


def as_input(
    colours: Float[Tensor, "height width 3"], mask: Bool[Tensor, "height width"]
) -> Float[Tensor, "4 height width"]:
    """An image as encoder input: colours from 0 to 1, grey outside of the mask, and the mask."""
    channels = torch.where(mask[..., None], colours, BACKGROUND_GREY).permute(2, 0, 1)
    return torch.cat([channels, mask[None].float()])


@dataclass(frozen=True)
class Imaging:
    """Settings of the images."""

    photography: Photography
    sampler: ViewSampler

    def images(self, dataset: Dataset, split: Split, count: int, cache: Path, progress: Report) -> list[ShapeImages]:
        """The images of the first `count` shapes of a split, from `cache` if it has them."""
        settings = {"dataset": dataset.identity(), "split": split, "count": count, "version": VERSION}
        key = digest({**settings, "photography": asdict(self.photography), "sampler": self.sampler.identity})

        def make() -> dict[str, Tensor]:
            images = []
            for index in range(count):
                progress("rendering images", index, count)
                images.append(self.shape_images(dataset, split, index))
            _check_same_intrinsics([shape.intrinsics for shape in images], dataset.name)
            progress("rendering images", count, count)
            tensors = {name: torch.stack([getattr(shape, name) for shape in images]) for name in STACKED_FIELDS}
            return tensors | {"intrinsics": images[0].intrinsics}

        tensors = load_or_make(cache, f"images-{dataset.name}-{split}-{key}", make)
        rows = zip(*(tensors[name] for name in STACKED_FIELDS), strict=True)
        return [ShapeImages(tensors["intrinsics"], *row) for row in rows]

    def shape_images(self, dataset: Dataset, split: Split, index: int) -> ShapeImages:
        """The images of one shape: of its dataset if that has images, else rendered with new cameras and textures."""
        mesh, seed = dataset.mesh(split, index), seed_of(split, index)
        truth, pixels = Truth(mesh), self.sampler.resolution
        shots = dataset.shots(split, index, pixels) if isinstance(dataset, Pictured) else None
        if shots is None:
            views = self.photography.views
            cameras = [self.sampler.draw(seed * views + view) for view in range(views)]
            shots = self.photography.take_from(truth, cameras, seed=seed)
        else:
            shots = self._check_shots(shots, truth, scene_name(dataset, split, index))
        points = _points(mesh, seed)
        return ShapeImages(
            shots[0].camera.intrinsics,
            torch.stack([shot.camera.world_to_camera for shot in shots]),
            torch.stack([(255 * shot.colours).round().to(torch.uint8) for shot in shots]),
            torch.stack([shot.mask for shot in shots if shot.mask is not None]),
            torch.stack([shot.depth for shot in shots if shot.depth is not None]),
            torch.from_numpy(points).float(),
            torch.from_numpy(truth.signed_distance(points) < 0),
        )

    def _check_shots(self, shots: Sequence[Shot], truth: Truth, name: str) -> list[Shot]:
        """The first images of a dataset, with the mesh's depths for images without depths.

        Raises:
            BadInput: there are too few images, they have another size, or they do not show the mesh.
        """
        views, pixels = self.photography.views, self.sampler.resolution
        camera, shots = shots[0].camera, shots[:views]
        masks = [shot.mask for shot in shots if shot.mask is not None and shot.mask.shape == (pixels, pixels)]
        if len(masks) < views:
            raise BadInput(
                f"{name} has {len(shots)} images, the first of {camera.width} x {camera.height} pixels, not {views} of "
                f"{pixels} x {pixels} with masks: set task.images.views, task.views, task.image_pixels to what it has"
            )
        _check_same_intrinsics([shot.camera.intrinsics for shot in shots], name)
        true_views = [see(truth, shot.camera) for shot in shots]
        overlap = np.median([mask_iou(m.numpy(), view.mask.numpy()) for m, view in zip(masks, true_views, strict=True)])
        if overlap < MIN_MASK_OVERLAP:
            raise BadInput(
                f"the images of {name} do not show its mesh: masks overlap by {overlap:.0%}; those of DVR and NMR show "
                "ShapeNetCore v1 with dataset.normalised=onet"
            )
        pairs = zip(shots, true_views, strict=True)
        return [replace(shot, depth=view.depth) if shot.depth is None else shot for shot, view in pairs]


def _check_same_intrinsics(intrinsics: Sequence[Float[Tensor, "3 3"]], name: str) -> None:
    if any((matrix - intrinsics[0]).abs().max() > MAX_INTRINSICS_DIFFERENCE for matrix in intrinsics):
        raise BadInput(f"the images of {name} must have one focal length: leave those with another out")


def _points(mesh: Mesh, seed: int) -> Float[np.ndarray, "points 3"]:
    """Points in the cube, then points near the surface."""
    draw = np.random.default_rng([seed, 3])
    half, side = OCCUPANCY_POINTS // 2, CUBE_HALF_SIDE
    near = sample_surface(mesh, half, seed).points + NEAR_SURFACE_STD * draw.standard_normal((half, 3))
    return np.concatenate([draw.uniform(-side, side, (OCCUPANCY_POINTS - half, 3)), near])
