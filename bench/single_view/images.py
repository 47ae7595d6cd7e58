"""Images of many shapes from random views, with masks and depths: made once for a dataset, then read from a file."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from bench.progress import Report
from bench.reconstruct.pixels import Pixels
from bench.reconstruct.subject import hull_distances
from bench.records.record import digest
from bench.shape_prior import kept
from datasets.captures.hull import carve
from datasets.mesh import Mesh
from datasets.photographs import BACKGROUND_GREY, Photography
from datasets.scene import Dataset, Split, Truth, sample_surface, scene_name, see, seed_of
from datasets.shot import Pictured, Shot, mask_iou
from datasets.views import ViewSampler
from renderers.camera import Camera, sphere_span
from renderers.checks import BadInput

VERSION = 1  # raise it when the images or points change, so that no file of the old ones is used
POINTS = 8192  # of known occupancy per shape: half in the cube, half near the surface
NEAR = 0.05  # scene units: standard deviation of the latter from the surface
NEAR_HULL = 0.07  # the same, from points in the visual hull
CUBE = 1.0  # half the side of the cube
SHOWN = 0.85  # least overlap of masks and mesh, the median over a shape's images
ALIKE = 1e-2  # pixels by which intrinsics may differ
OF_VIEWS = ("motions", "colours", "masks", "depths")
PARTS = (*OF_VIEWS, "points", "inside")  # of `ImagesOf`, stacked over shapes in a file


@dataclass(frozen=True)
class ImagesOf:
    """Images of one shape.

    Args:
        intrinsics, motions: of the cameras, `Camera.intrinsics` of all and `Camera.world_to_camera` of each.
        colours: 0 to 255.
        masks: true on the shape.
        depths: camera z, in scene units; 0 on the background.
        points: in space.
        inside: whether each lies in the shape.
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
        """The camera of each image."""
        height, width = self.masks.shape[1:]
        return tuple(Camera(self.intrinsics, motion, height, width) for motion in self.motions)

    def image(self, view: int) -> Float[Tensor, "4 height width"]:
        """An image as encoders take it; see `as_input`."""
        return as_input(self.colours[view].float() / 255, self.masks[view])

    def images(self) -> Float[Tensor, "views 4 height width"]:
        """All of them as encoders take them."""
        return torch.stack([self.image(view) for view in range(len(self.cameras))])

    def first(self, views: int) -> "ImagesOf":
        """The first images; the points stay."""
        return replace(self, **{name: getattr(self, name)[:views] for name in OF_VIEWS})

    def shots(self) -> tuple[Shot, ...]:
        """The images as photographs."""
        parts = zip(self.cameras, self.colours, self.masks, self.depths, strict=True)
        return tuple(
            Shot(str(place), camera, colours.float() / 255, mask, depth)
            for place, (camera, colours, mask, depth) in enumerate(parts)
        )

    def in_hull(self, seed: int) -> tuple[Float[Tensor, "points 3"], Bool[Tensor, " points"]]:
        """Points in the cube and points near the visual hull of the masks, and whether each lies in the hull."""
        draw, shots = torch.Generator().manual_seed(seed), self.shots()
        anywhere = CUBE * (2 * torch.rand(2 * POINTS, 3, generator=draw, device="cpu") - 1)
        inside = carve(shots, anywhere) < 0
        found = anywhere[inside] if bool(inside.any()) else anywhere
        near = found[torch.randint(len(found), (POINTS,), generator=draw, device="cpu")]
        near = near + NEAR_HULL * torch.randn(POINTS, 3, generator=draw, device="cpu")
        return torch.cat([anywhere[:POINTS], near]), torch.cat([inside[:POINTS], carve(shots, near) < 0])

    @cached_property
    def to_hull(self) -> list[Float[Tensor, "height width"]]:
        """Distances along the rays of each image to the visual hull of the masks; NaN beside it."""
        return hull_distances([replace(shot, depth=None) for shot in self.shots()])

    def pixels(
        self, view: int, count: int, generator: torch.Generator, device: torch.device, *, hull: bool = False
    ) -> Pixels:
        """Random pixels of an image whose rays meet the unit sphere, with colours, mask and depth.

        Args:
            hull: whether the distance that a loss of the mask may use is that to the visual hull, not the given one.
        """
        camera = self.cameras[view]
        rays = camera.rays().flat()
        meets = sphere_span(rays)[2].nonzero().squeeze(-1)
        chosen = meets[torch.randint(len(meets), (count,), generator=generator, device="cpu")]
        at_one = camera.depth(torch.ones_like(self.depths[view])).flatten()[chosen]
        mask, depth = self.masks[view].flatten()[chosen], self.depths[view].flatten()[chosen]
        distance = torch.where(mask, depth / at_one, torch.nan)
        return Pixels(
            rays[chosen].to(device),
            (self.colours[view].reshape(-1, 3)[chosen].float() / 255).to(device),
            at_one.to(device),
            mask.to(device),
            distance.to(device),
            (self.to_hull[view].flatten()[chosen] if hull else distance).to(device),
            None,
        )


def as_input(
    colours: Float[Tensor, "height width 3"], mask: Bool[Tensor, "height width"]
) -> Float[Tensor, "4 height width"]:
    """An image as encoders take it: colours from 0 to 1, grey outside of the mask, and the mask."""
    channels = torch.where(mask[..., None], colours, BACKGROUND_GREY).permute(2, 0, 1)
    return torch.cat([channels, mask[None].float()])


@dataclass(frozen=True)
class Imaging:
    """How images are made.

    Args:
        photography: texture, light, noise.
        sampler: of the cameras.
    """

    photography: Photography
    sampler: ViewSampler

    def images(self, dataset: Dataset, split: Split, count: int, cache: Path, progress: Report) -> list[ImagesOf]:
        """The images of the first `count` shapes of a split, from `cache` where they were made before."""
        settings = {"dataset": dataset.identity(), "split": split, "count": count, "version": VERSION}
        key = digest({**settings, "photography": asdict(self.photography), "sampler": asdict(self.sampler)})

        def make() -> dict[str, Tensor]:
            made = []
            for index in range(count):
                progress("rendering images", index, count)
                made.append(self.of_shape(dataset, split, index))
            _check_alike([one.intrinsics for one in made], dataset.name)
            progress("rendering images", count, count)
            parts = {name: torch.stack([getattr(one, name) for one in made]) for name in PARTS}
            return parts | {"intrinsics": made[0].intrinsics}

        tensors = kept(cache, f"images-{dataset.name}-{split}-{key}", make)
        parts = zip(*(tensors[name] for name in PARTS), strict=True)
        return [ImagesOf(tensors["intrinsics"], *one) for one in parts]

    def of_shape(self, dataset: Dataset, split: Split, index: int) -> ImagesOf:
        """The images of one shape that its dataset has, or else from cameras and with a texture of its own."""
        mesh, seed = dataset.mesh(split, index), seed_of(split, index)
        truth, pixels = Truth(mesh), self.sampler.resolution
        shots = dataset.shots(split, index, pixels) if isinstance(dataset, Pictured) else None
        if shots is None:
            places = [seed * self.photography.views + view for view in range(self.photography.views)]
            shots = self.photography.take_from(truth, [self.sampler.draw(place) for place in places], seed=seed)
        else:
            shots = self._checked(shots, truth, scene_name(dataset, split, index))
        points = _points(mesh, seed)
        return ImagesOf(
            shots[0].camera.intrinsics,
            torch.stack([shot.camera.world_to_camera for shot in shots]),
            torch.stack([(255 * shot.colours).round().to(torch.uint8) for shot in shots]),
            torch.stack([shot.mask for shot in shots if shot.mask is not None]),
            torch.stack([shot.depth for shot in shots if shot.depth is not None]),
            torch.from_numpy(points).float(),
            torch.from_numpy(truth.signed_distance(points) < 0),
        )

    def _checked(self, shots: Sequence[Shot], truth: Truth, name: str) -> list[Shot]:
        """The first images of a dataset's own, with the mesh's depths where they have none.

        Raises:
            BadInput: where they are too few or of another size, or do not show the mesh.
        """
        views, pixels = self.photography.views, self.sampler.resolution
        camera, shots = shots[0].camera, shots[:views]
        masks = [shot.mask for shot in shots if shot.mask is not None and shot.mask.shape == (pixels, pixels)]
        if len(masks) < views:
            raise BadInput(
                f"{name} has {len(shots)} images, the first of {camera.width} x {camera.height} pixels, not {views} of "
                f"{pixels} x {pixels} with masks: set task.images.views, task.views, task.image_pixels to what it has"
            )
        _check_alike([shot.camera.intrinsics for shot in shots], name)
        seen = [see(truth, shot.camera) for shot in shots]
        overlap = np.median([mask_iou(m.numpy(), view.mask.numpy()) for m, view in zip(masks, seen, strict=True)])
        if overlap < SHOWN:
            raise BadInput(
                f"the images of {name} do not show its mesh: masks overlap by {overlap:.0%}; those of DVR and NMR show "
                "ShapeNetCore v1 with dataset.normalised=onet"
            )
        pairs = zip(shots, seen, strict=True)
        return [replace(shot, depth=view.depth) if shot.depth is None else shot for shot, view in pairs]


def _check_alike(intrinsics: Sequence[Float[Tensor, "3 3"]], name: str) -> None:
    if any((one - intrinsics[0]).abs().max() > ALIKE for one in intrinsics):
        raise BadInput(f"the images of {name} must have one focal length: leave those with another out")


def _points(mesh: Mesh, seed: int) -> Float[np.ndarray, "points 3"]:
    """Points in the cube, then points near the surface."""
    draw = np.random.default_rng([seed, 3])
    near = sample_surface(mesh, POINTS // 2, seed).points + NEAR * draw.standard_normal((POINTS // 2, 3))
    return np.concatenate([draw.uniform(-CUBE, CUBE, (POINTS - len(near), 3)), near])
