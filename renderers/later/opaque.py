"""Objects as volumes: attenuation by an opaque solid with a random surface (Miller et al., CVPR 2024)."""

from dataclasses import dataclass, replace
from math import pi

import torch
from jaxtyping import Float
from torch import Tensor
from torch.special import erfcx, log_ndtr

from renderers.camera import Rays
from renderers.checks import check_at_least, check_positive
from renderers.field import Field
from renderers.later.volumes import Samples, VolumeRenderer, render_volume, resample, schedule, weights
from renderers.rendering import Rendering, check_kind
from renderers.tracing.bracket import equally_spaced

# Standard deviations. A smaller change between two samples is rounding: the rate at their mean value replaces it.
MIN_CHANGE = 1e-2
MAX_CLEARANCE = 8.0  # standard deviations from the mean surface: the density beyond is 1e-14, and is not evaluated
MIN_DEVIATIONS = -1e3  # below, the derivatives of log_ndtr are wrong in float32


@dataclass(frozen=True)
class Opaque(VolumeRenderer):
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
        samples: equally spaced from the ray's entry into the sphere to its exit, both included.
        rounds: of further samples by importance.
        round_samples: in each round.
        round_sharpness: sharpness in the first round, per scene unit; it doubles with each round.
        sharpness: inverse of the standard deviation of the surface, per scene unit.
        first_sharpness: at the first iteration of an optimisation.
        anisotropy: weight of the delta distribution: 1 has the field's normals only, 0 has all normals equally.
        sharpening, mask_weight, sphere_radius: see `integrate.VolumeRenderer`.
    """

    samples: int
    rounds: int
    round_samples: int
    round_sharpness: float
    sharpness: float
    first_sharpness: float
    anisotropy: float

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least("samples", self.samples, 2, "the official code uses 64")
        check_at_least("rounds", self.rounds, 0, "the official code of NeuS uses 4")
        check_at_least("round_samples", self.round_samples, 1, "the official code of NeuS uses 16")
        for name in ("round_sharpness", "sharpness", "first_sharpness"):
            check_positive(name, getattr(self, name), "conf/renderer/opaque.yaml has values that work")
        if not 0 <= self.anisotropy <= 1:
            raise ValueError(f"anisotropy must lie between 0 (uniform) and 1 (delta), not {self.anisotropy}")

    @property
    def blur(self) -> float:
        """The standard deviation of the surface, in scene units."""
        return 1 / self.sharpness

    def with_blur(self, blur: float) -> "Opaque":
        return replace(self, sharpness=1 / blur, sharpening=0)

    def at_iteration(self, iteration: int) -> "Opaque":
        """The renderer at an iteration, with a sharpness between `first_sharpness` and `sharpness`."""
        return replace(self, sharpness=schedule(self.first_sharpness, self.sharpness, self.sharpening, iteration))

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Samples where the solid absorbs light, then sums with a graph."""
        check_kind(self, field)
        return render_volume(field, rays, self._search, self._log_transmittance, radius=self.sphere_radius)

    def _search(self, field: Field, rays: Rays, entry: Tensor, leave: Tensor) -> Samples:
        """Equally spaced samples, then rounds of further ones where the weight is largest."""
        samples = Samples.of(field, rays, equally_spaced(entry, leave, self.samples))
        for index in range(self.rounds):
            sharper = replace(self, sharpness=self.round_sharpness * 2**index)
            importance = weights(sharper._log_transmittance(samples.value, samples.distance))
            distance = resample(samples.distance, importance, self.round_samples)
            samples = samples.merge(Samples.of(field, rays, distance))
        return samples

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
