"""Objects as volumes: attenuation by an opaque solid with a random surface (Miller et al., CVPR 2024)."""

from dataclasses import dataclass
from math import pi

import torch
from jaxtyping import Float
from torch import Tensor
from torch.special import erfcx, log_ndtr

from renderers.later.volumes import SharpenedVolume

# Standard deviations. A smaller change between two samples is rounding: the rate at their mean value replaces it.
MIN_CHANGE = 1e-2
MAX_CLEARANCE = 8.0  # standard deviations from the mean surface: the density beyond is 1e-14, and is not evaluated
MIN_DEVIATIONS = -1e3  # below, the derivatives of log_ndtr are wrong in float32


@dataclass(frozen=True)
class Opaque(SharpenedVolume):
    """Attenuation by a solid whose surface has a Gaussian distance from the field's, and a distribution of normals.

    The attenuation is a product. Its first factor is the density of the surface divided by the probability of free
    space. Its second factor is the area of the surface that faces the ray, of a mixture of normals.

    Source: "Objects as Volumes" (Miller et al. 2024, arXiv 2312.15406): attenuation coefficient of an implicit function
        with Gaussian noise, and linear mixture of a delta and a uniform distribution of normals. Samples by importance
        as in NeuS (Wang et al. 2021, supplement).
    Differentiable in: field parameters and rays, through the samples' weights. Rays that pass close to the surface have
        a gradient too, so a visibility gradient exists, as wide as the noise.
    Needs: a distance inside the sphere. Of a bound, the surface is the same, but uniform normals attenuate less.
    Deviates from the paper: noise and anisotropy are equal at all points, and not learnt; the noise follows a schedule;
        an interval's attenuation is exact for values that are linear in it; the field's slope counts as 1; samples lie
        at midpoints of equal fractions and are not random; the background is empty.

    Args:
        samples, rounds, round_samples, round_sharpness, first_sharpness: see `volumes.SharpenedVolume`.
        sharpness: inverse of the standard deviation of the surface, per scene unit.
        anisotropy: weight of the delta distribution: 1 has the field's normals only, 0 has all normals equally.
        sharpening, mask_weight, sphere_radius: see `integrate.VolumeRenderer`.
    """

    anisotropy: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.anisotropy <= 1:
            raise ValueError(f"anisotropy must lie between 0 (uniform) and 1 (delta), not {self.anisotropy}")

    def _log_transmittance(
        self, value: Float[Tensor, "n samples"], distance: Float[Tensor, "n samples"]
    ) -> Float[Tensor, "n intervals"]:
        """Minus the integral of the attenuation over each interval, exact for values that are linear in it.

        The delta distribution attenuates by the change of the logarithm of the probability of free space. The uniform
        one attenuates by half of the mean rate, which is that change per change of the value, times the length.
        """
        deviations = self.sharpness * value
        log_free = log_ndtr(deviations.clamp_min(MIN_DEVIATIONS))
        change, first, second = log_free[:, 1:] - log_free[:, :-1], deviations[:, :-1], deviations[:, 1:]
        is_steep = (second - first).abs() > MIN_CHANGE
        steepness = torch.where(is_steep, second - first, 1.0)
        rate = torch.where(is_steep, change / steepness, _attenuation_rate((first + second) / 2))
        facing = self.anisotropy * change.abs()
        uniform = (1 - self.anisotropy) / 2 * self.sharpness * rate * (distance[:, 1:] - distance[:, :-1])
        return -(facing + uniform)


def _attenuation_rate(deviations: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """The density of a standard normal distribution divided by its cumulative probability, free of overflow."""
    return (2 / pi) ** 0.5 / erfcx(-deviations.clamp_max(MAX_CLEARANCE) / 2**0.5)
