"""The pixels of photographs of any sizes as one list, and random draws from it."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bench.solve.pixel_area import random_offsets
from bench.tasks.reconstruction.subject import given_distances
from datasets.shot import Shot
from renderers.camera import Rays, sphere_span
from renderers.checks import BadInput

FILLED = 0.98  # a pixel above this covered fraction counts as filled: compressed and undistorted masks have noise


@dataclass(frozen=True)
class Pixels:
    """Pixels with their rays and observations.

    Args:
        rays: rays [n] through the pixels' centres, or several [n, count] of each pixel.
        colours: RGB from 0 to 1.
        depth_per_distance: the depth of the point at distance 1 along the ray.
        mask: true on the object; None without masks.
        distance: given distances along the rays, NaN for pixels without one; None if no pixel has one.
        guide: distances that a silhouette loss may use, in the same format.
        normals: given normals, 0 for pixels without one; None if no pixel has one.
        photograph: index of each pixel's photograph; None if they share a camera.
        covered: the fraction of each pixel on the object; None if it is unknown.
    """

    rays: Rays
    colours: Float[Tensor, "n 3"]
    depth_per_distance: Float[Tensor, " n"]
    mask: Bool[Tensor, " n"] | None
    distance: Float[Tensor, " n"] | None
    guide: Float[Tensor, " n"] | None
    normals: Float[Tensor, "n 3"] | None
    photograph: Int[Tensor, " n"] | None = None
    covered: Float[Tensor, " n"] | None = None

    @property
    def several(self) -> bool:
        """Whether each pixel has several rays."""
        return len(self.rays.shape) > 1

    def inside(self, hit: Bool[Tensor, " *rays"]) -> Bool[Tensor, " *rays"]:
        """The rays of `hit` in pixels of the object: by masks or, with several rays per pixel, in filled pixels."""
        if self.mask is None:
            return hit
        return hit & (self.covered > FILLED)[:, None] if self.several else hit & self.mask

    def __getitem__(self, index: Int[Tensor, " m"]) -> "Pixels":
        tensors = {column.name: getattr(self, column.name) for column in fields(self)}
        return Pixels(**{name: None if tensor is None else tensor[index] for name, tensor in tensors.items()})


@dataclass(frozen=True)
class Stack:
    """All pixels of photographs, and the indices of pixels whose rays intersect the unit sphere.

    Args:
        pixels: the pixels of one photograph after the other, by rows.
        useful: indices of pixels that may be drawn.
        corners: indices of pixels that may be drawn as the upper left pixel of a 2 x 2 patch.
        width: width of each pixel's photograph.
        steps: world vectors [photograph, right or down, xyz] between centres of neighbouring pixels at camera z 1.
    """

    pixels: Pixels
    useful: Int[Tensor, " m"]
    corners: Int[Tensor, " k"]
    width: Int[Tensor, " n"]
    steps: Float[Tensor, "photographs 2 3"]

    @staticmethod
    def build(shots: Sequence[Shot], guide: Sequence[Float[Tensor, "_ _"]] | None, device: torch.device) -> "Stack":
        """The pixels of photographs with the same kinds of observations; `guide` has the distances of each."""
        depths_at_one = [shot.camera.depth(torch.ones(shot.colours.shape[:2])) for shot in shots]
        rays = [shot.camera.rays().flat() for shot in shots]
        all_rays = Rays(torch.cat([r.origins for r in rays]), torch.cat([r.directions for r in rays]))
        distances = given_distances(shots) if any(shot.depth is not None for shot in shots) else []
        masks = [shot.mask.flatten() for shot in shots if shot.mask is not None]
        normals = [shot.normals.reshape(-1, 3) for shot in shots if shot.normals is not None]
        areas = [shot.covered.flatten() for shot in shots if shot.covered is not None]
        pixels = Pixels(
            all_rays.to(device),
            torch.cat([shot.colours.reshape(-1, 3) for shot in shots]).to(device),
            torch.cat([depth.flatten() for depth in depths_at_one]).to(device),
            torch.cat(masks).to(device) if masks else None,
            torch.cat([distance.flatten() for distance in distances]).to(device) if distances else None,
            torch.cat([distance.flatten() for distance in guide]).to(device) if guide else None,
            torch.cat(normals).to(device) if normals else None,
            torch.cat([torch.full((ray.shape[0],), index) for index, ray in enumerate(rays)]).to(device),
            torch.cat(areas).to(device) if areas else None,
        )
        in_sphere = sphere_span(all_rays)[2]
        inner = [torch.zeros(shot.camera.height, shot.camera.width, dtype=torch.bool) for shot in shots]
        for image in inner:  # pixels with a neighbour to the right and below
            image[:-1, :-1] = True
        useful, corners = in_sphere.nonzero().squeeze(-1), in_sphere & torch.cat([image.flatten() for image in inner])
        width = torch.cat([torch.full((depth.numel(),), depth.shape[1]) for depth in depths_at_one])
        if not bool(corners.any()):
            raise BadInput("no ray meets the unit sphere: the cameras do not look at the object")
        cameras = [(torch.linalg.inv(shot.camera.intrinsics), shot.camera.camera_to_world) for shot in shots]
        steps = torch.stack([inverse[:, :2].T @ pose[:3, :3].T for inverse, pose in cameras])
        corners = corners.nonzero().squeeze(-1)
        return Stack(pixels, useful.to(device), corners.to(device), width.to(device), steps.to(device))

    def draw(self, count: int, *, patches: bool, seed: int) -> Pixels:
        """Draws `count` random pixels on their device; with `patches`, as groups of four: 2 x 2 pixels by rows."""
        candidates = self.corners if patches else self.useful
        random = {"generator": torch.Generator(candidates.device).manual_seed(seed), "device": candidates.device}
        chosen = candidates[torch.randint(len(candidates), (count // 4 if patches else count,), **random)]
        if patches:
            corner = torch.arange(4, device=candidates.device)
            right, below = corner % 2, corner // 2
            chosen = (chosen[:, None] + right + below * self.width[chosen, None]).flatten()
        return self.pixels[chosen]

    def with_rays(self, pixels: Pixels, count: int, generator: torch.Generator) -> Pixels:
        """Pixels with `count` random rays in the area of each, see `bench.solve.pixel_area`."""
        at_unit_depth = pixels.rays.directions / pixels.depth_per_distance[:, None]
        offsets = random_offsets((len(at_unit_depth),), count, generator).to(at_unit_depth)
        directions = at_unit_depth[:, None] + offsets @ self.steps[pixels.photograph].to(at_unit_depth)
        origins = pixels.rays.origins[:, None].expand_as(directions)
        return replace(pixels, rays=Rays(origins, torch.nn.functional.normalize(directions, dim=-1)))
