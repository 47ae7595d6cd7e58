"""The pixels of photographs of any sizes in one row, and random ones of them."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bench.reconstruct.subject import given_distances
from datasets.shot import Shot
from renderers.camera import Rays, sphere_span
from renderers.checks import BadInput


@dataclass(frozen=True)
class Pixels:
    """What is known of pixels, each with its ray.

    Args:
        rays: through their centres.
        colours: RGB from 0 to 1.
        at_one: the depth of the point at distance 1 along the ray.
        mask: true on the object; None where masks are not given.
        distance: given distances along the rays, NaN where there is none; None without any.
        guide: distances that a silhouette loss may use, in the same way.
        normals: given normals, 0 where there is none; None without any.
    """

    rays: Rays
    colours: Float[Tensor, "n 3"]
    at_one: Float[Tensor, " n"]
    mask: Bool[Tensor, " n"] | None
    distance: Float[Tensor, " n"] | None
    guide: Float[Tensor, " n"] | None
    normals: Float[Tensor, "n 3"] | None

    def __getitem__(self, index: Int[Tensor, " m"]) -> "Pixels":
        parts = {part.name: getattr(self, part.name) for part in fields(self)}
        return Pixels(**{name: None if part is None else part[index] for name, part in parts.items()})


@dataclass(frozen=True)
class Stack:
    """All pixels of photographs, and those whose rays meet the unit sphere.

    Args:
        pixels: of one photograph after the other, by rows.
        useful: the places of those that may be drawn.
        corners: the same of the upper left pixels of patches of 2 x 2.
        width: of the photograph that a pixel belongs to.
    """

    pixels: Pixels
    useful: Int[Tensor, " m"]
    corners: Int[Tensor, " k"]
    width: Int[Tensor, " n"]

    @staticmethod
    def of(shots: Sequence[Shot], guide: Sequence[Float[Tensor, "_ _"]] | None, device: torch.device) -> "Stack":
        """The pixels of photographs that are alike in what is known of them; `guide` has the distances of each."""
        ones = [shot.camera.depth(torch.ones(shot.colours.shape[:2])) for shot in shots]
        rays = [shot.camera.rays().flat() for shot in shots]
        together = Rays(torch.cat([one.origins for one in rays]), torch.cat([one.directions for one in rays]))
        distances = given_distances(shots) if any(shot.depth is not None for shot in shots) else []
        masks = [shot.mask.flatten() for shot in shots if shot.mask is not None]
        normals = [shot.normals.reshape(-1, 3) for shot in shots if shot.normals is not None]
        pixels = Pixels(
            together.to(device),
            torch.cat([shot.colours.reshape(-1, 3) for shot in shots]).to(device),
            torch.cat([one.flatten() for one in ones]).to(device),
            torch.cat(masks).to(device) if masks else None,
            torch.cat([one.flatten() for one in distances]).to(device) if distances else None,
            torch.cat([one.flatten() for one in guide]).to(device) if guide else None,
            torch.cat(normals).to(device) if normals else None,
        )
        meets = sphere_span(together)[2]
        inner = torch.cat([_upper_left(shot) for shot in shots])
        width = torch.cat([torch.full((one.numel(),), one.shape[1]) for one in ones])
        if not bool((meets & inner).any()):
            raise BadInput("no ray meets the unit sphere: the cameras do not look at the object")
        useful, corners = meets.nonzero().squeeze(-1), (meets & inner).nonzero().squeeze(-1)
        return Stack(pixels, useful.to(device), corners.to(device), width.to(device))

    def drawn(self, count: int, *, patches: bool, seed: int) -> Pixels:
        """That many random pixels, or in patches of 2 x 2: four after one another, by rows; drawn on their device."""
        places = self.corners if patches else self.useful
        draws = {"generator": torch.Generator(places.device).manual_seed(seed), "device": places.device}
        chosen = places[torch.randint(len(places), (count // 4 if patches else count,), **draws)]
        if patches:
            corner = torch.arange(4, device=places.device)
            right, below = corner % 2, corner // 2
            chosen = (chosen[:, None] + right + below * self.width[chosen, None]).flatten()
        return self.pixels[chosen]


def _upper_left(shot: Shot) -> Bool[Tensor, " pixels"]:
    """True for pixels that have another one to the right and below."""
    inner = torch.zeros(shot.camera.height, shot.camera.width, dtype=torch.bool)
    inner[:-1, :-1] = True
    return inner.flatten()
