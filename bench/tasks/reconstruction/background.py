"""What rays see that pass the object, for photographs without masks."""

from math import pi

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import linear, softplus

from renderers.camera import Rays
from renderers.fields.networks.coloured import positional_encoding

NONE, SPHERE = "none", "sphere"
GREYS = {"black": 0.0, "grey": 0.5, "white": 1.0}
CHOICES = (NONE, *GREYS, SPHERE)
NETWORK_WIDTH, NETWORK_OCTAVES, SAMPLES_PER_RAY = 64, 4, 16
SPEED = 10.0


class OneColour(nn.Module):
    """A background of one grey value."""

    def __init__(self, grey: float) -> None:
        super().__init__()
        self.grey = grey

    def forward(self, rays: Rays) -> Float[Tensor, "n 3"]:
        return torch.full_like(rays.directions, self.grey)


class _FastLinear(nn.Linear):
    """A layer whose weights learn `SPEED` times faster than others: Adam's steps do not depend on a scale.

    At the rate of the field, the field paints the room on its surface before the background is learnt.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs)
        with torch.no_grad():
            self.weight /= SPEED
            self.bias /= SPEED

    def forward(self, values: Float[Tensor, "*n inputs"]) -> Float[Tensor, "*n outputs"]:
        return linear(values, SPEED * self.weight, SPEED * self.bias)


class OutsideSphere(nn.Module):
    """A radiance field outside of the unit sphere, of direction and inverse radius; opaque at infinity.

    Source: the inverted sphere of NeRF++ (Zhang et al. 2020, arXiv 2010.07492), Sec. 4, as NeuS without masks.
    Deviates: two hidden layers; colours do not depend on the view direction; the samples of a ray are evenly spaced in
        inverse radius, from where it leaves the sphere or, if it misses the sphere, passes nearest to the origin.
    """

    def __init__(self) -> None:
        super().__init__()
        layers = [
            _FastLinear(4 + 8 * NETWORK_OCTAVES, NETWORK_WIDTH),
            nn.ReLU(),
            _FastLinear(NETWORK_WIDTH, NETWORK_WIDTH),
            nn.ReLU(),
        ]
        self.network = nn.Sequential(*layers, _FastLinear(NETWORK_WIDTH, 4))

    def forward(self, rays: Rays) -> Float[Tensor, "n 3"]:
        approach = -(rays.origins * rays.directions).sum(-1)
        nearest = torch.linalg.vector_norm(rays.at(approach), dim=-1)
        share = (torch.arange(SAMPLES_PER_RAY, dtype=nearest.dtype, device=nearest.device) + 0.5) / SAMPLES_PER_RAY
        inverse_radius = (1 - share) / nearest.clamp_min(1.0)[:, None]
        half_chord = (inverse_radius.pow(-2) - nearest.square()[:, None]).clamp_min(1e-6).sqrt()
        distances = (approach[:, None] + half_chord).clamp_min(0.0)  # of a ray that looks away: its origin
        directions = torch.nn.functional.normalize(rays.at_each(distances), dim=-1)
        encoded = positional_encoding(
            torch.cat([directions, inverse_radius[..., None]], dim=-1) * pi / 2, NETWORK_OCTAVES
        )
        density, colours = self.network(encoded).split([1, 3], dim=-1)
        transparency = (-softplus(density[..., 0])).exp()
        transparency = torch.cat([transparency[:, :-1], torch.zeros_like(transparency[:, -1:])], dim=-1)
        passing = torch.nn.functional.pad(transparency[:, :-1], (1, 0), value=1.0).cumprod(-1)
        return ((passing * (1 - transparency))[..., None] * colours.sigmoid()).sum(1)


Background = OneColour | OutsideSphere  # gives RGB from 0 to 1 along n rays


def make(name: str) -> Background | None:
    """The background of a name in `CHOICES`; None for "none"."""
    if name == SPHERE:
        return OutsideSphere()
    return None if name == NONE else OneColour(GREYS[name])
