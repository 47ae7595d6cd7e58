"""VolSDF: density from the distance, and samples that bound the error of the opacity (Yariv et al., NeurIPS 2021)."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import log
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderers.camera import Rays
from renderers.checks import check_at_least, check_positive
from renderers.field import Field, Kind
from renderers.later.volumes import Samples, VolumeRenderer, render_volume, resample, schedule, weights
from renderers.rendering import Capabilities, Rendering, check_kind
from renderers.tracing.bracket import equally_spaced

BISECTION_STEPS = 10  # for the least width, as in the paper
MAX_EXPONENT = 14.0  # clamps the error bound: larger bounds need not be distinguished


@dataclass(frozen=True)
class VolSDF(VolumeRenderer):
    """Density from the cumulative distribution function of a Laplace distribution, of the distance.

    Source: VolSDF (Yariv et al. 2021, arXiv 2106.12052), Eqs. 2, 3 (density), Theorem 1 and Eq. 14 (bound on the error
        of the opacity), Algorithm 1 (samples).
    Differentiable in: field parameters and rays, through the samples' weights. Rays that pass close to the surface have
        a gradient too, so a visibility gradient exists, as wide as the density's fall.
    Needs: a distance inside the sphere; Theorem 1 holds for distances only.
    Deviates from the paper: the width follows a schedule and is not learnt; samples lie at midpoints of equal
        fractions and are not random; rays whose bound holds are not sampled again; the background is empty.

    Args:
        samples: equally spaced in the first round; as many in each further round, where the bound is largest.
        rounds: maximum number after the first.
        error: epsilon, the maximum error of the opacity at the samples.
        fine_samples: by the weights of the opacity.
        extra_samples: in addition, evenly selected from the samples that bound the error, as in the official code.
        width: beta, in scene units; the density deep inside is its inverse.
        first_width: at the first iteration of an optimisation.
        sharpening, mask_weight, sphere_radius: see `integrate.VolumeRenderer`.
    """

    samples: int
    rounds: int
    error: float
    fine_samples: int
    extra_samples: int
    width: float
    first_width: float

    capabilities: ClassVar[Capabilities] = Capabilities(needs=(Kind.DISTANCE,), field_gradient=True, ray_gradient=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least("samples", self.samples, 2, "the paper uses 128")
        check_at_least("rounds", self.rounds, 0, "4 are the five of the paper")
        check_positive("error", self.error, "the paper uses 0.1")
        check_at_least("fine_samples", self.fine_samples, 1, "the paper uses 64")
        check_at_least("extra_samples", self.extra_samples, 2, "the official code uses 32")
        check_positive("width", self.width, "0.001 blurs the surface over .004 of the unit sphere")
        check_positive("first_width", self.first_width, "the paper begins at 0.1")

    @property
    def blur(self) -> float:
        """The width, in scene units."""
        return self.width

    def with_blur(self, blur: float) -> "VolSDF":
        return replace(self, width=blur, sharpening=0)

    def at_iteration(self, iteration: int) -> "VolSDF":
        """The renderer at an iteration, with a width between `first_width` and `width`."""
        return replace(self, width=schedule(self.first_width, self.width, self.sharpening, iteration))

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Adds samples until the opacity's error is bounded, then sums with a graph."""
        check_kind(self, field)
        return render_volume(field, rays, self._search, self._log_transmittance, radius=self.sphere_radius)

    def bounded_samples(
        self, field: Field, rays: Rays, entry: Tensor, leave: Tensor
    ) -> Iterator[tuple[Int[Tensor, " k"], Samples, Float[Tensor, "k 1"]]]:
        """Algorithm 1 except its last step, in groups of rays that need the same number of rounds.

        Yields the indices of these rays, their samples, and per ray the width for which the error is bounded.
        """
        index = torch.arange(len(entry), device=entry.device)
        samples = Samples.of(field, rays, equally_spaced(entry, leave, self.samples))
        square = _spacing(samples.distance).square().sum(dim=1, keepdim=True)
        width = (square / (4 * log(1 + self.error))).sqrt().clamp_min(self.width)  # Lemma 2, of any spacing
        for round_index in range(self.rounds + 1):
            bound = OpacityErrorBound.of(samples)
            width = self._least_width(bound, width)
            is_last = (width <= self.width).squeeze(1) | (round_index == self.rounds)
            ended, active = _split_indices(is_last)
            yield index[ended], samples.select(ended), width[ended]
            if not len(active):
                return
            index, samples, width, bound = index[active], samples.select(active), width[active], bound.select(active)
            distance = resample(samples.distance, bound.errors(width), self.samples)
            samples = samples.merge(Samples.of(field, rays[index], distance))

    def _search(self, field: Field, rays: Rays, entry: Tensor, leave: Tensor) -> Samples:
        """Algorithm 1: samples by the weights at the least width with a bounded error, and some of the earlier ones."""
        distance = entry.new_empty(len(entry), self.fine_samples + self.extra_samples)
        for index, samples, width in self.bounded_samples(field, rays, entry, leave):
            importance = weights(_log_transmittance(samples.value, samples.distance, width))[:, :-1]
            fine = resample(samples.distance, importance, self.fine_samples)
            columns = torch.linspace(0, samples.distance.shape[1] - 1, self.extra_samples, device=entry.device).long()
            distance[index] = torch.cat([fine, samples.distance[:, columns]], dim=1).sort(dim=1)[0]
        return Samples.of(field, rays, distance)

    def _log_transmittance(self, value: Tensor, distance: Tensor) -> Tensor:
        return _log_transmittance(value, distance, torch.full_like(value[:, :1], self.width))

    def _least_width(self, bound: "OpacityErrorBound", width: Float[Tensor, "n 1"]) -> Float[Tensor, "n 1"]:
        """The least width from `self.width` to `width` with a bounded error, by bisection; else `width`."""
        least = torch.full_like(width, self.width)
        unbounded = (bound.max_error(least) > self.error).nonzero().squeeze(-1)
        bound, low, high = bound.select(unbounded), least[unbounded], width[unbounded]
        for _ in range(BISECTION_STEPS if len(unbounded) else 0):
            middle = (low + high) / 2
            holds = bound.max_error(middle)[:, None] <= self.error
            low, high = torch.where(holds, low, middle), torch.where(holds, middle, high)
        return least.index_put((unbounded,), high)


@dataclass(frozen=True)
class OpacityErrorBound:
    """The bound on the error of the opacity along n rays, for any width (Theorem 1, Eq. 14).

    For each interval, `magnitude` is that of the value at its start. `inside` is its length if that value is not
    positive, else 0. `tail` is half of its length with the value's sign. `square` is a quarter of its squared length.
    `clearance` is a lower bound of its distance to the surface.
    """

    magnitude: Float[Tensor, "n intervals"]
    inside: Float[Tensor, "n intervals"]
    tail: Float[Tensor, "n intervals"]
    square: Float[Tensor, "n intervals"]
    clearance: Float[Tensor, "n intervals"]

    @staticmethod
    def of(samples: Samples) -> "OpacityErrorBound":
        """The bound of the rays' samples."""
        value, spacing = samples.value[:, :-1], _spacing(samples.distance)
        free = value > 0
        inside = torch.where(free, 0.0, spacing)
        return OpacityErrorBound(value.abs(), inside, spacing / 2 - inside, spacing.square() / 4, _clearance(samples))

    def select(self, index: Tensor) -> "OpacityErrorBound":
        """The bound of the rays at `index`."""
        return OpacityErrorBound(*(tensor[index] for tensor in vars(self).values()))

    def errors(self, width: Float[Tensor, "n 1"]) -> Float[Tensor, "n intervals"]:
        """Bounds on the error of the opacity at each interval (Theorem 1)."""
        rate = -1 / width
        absorbed = torch.addcmul(self.inside, self.tail, (self.magnitude * rate).exp_())  # `density` * length * width
        before = (absorbed.cumsum(dim=1) - absorbed).mul_(rate)
        error = (self.clearance * rate).exp_().mul_(self.square).cumsum(dim=1).mul_(rate.square())
        return before.exp_().mul_(error.clamp_max_(MAX_EXPONENT).expm1_())

    def max_error(self, width: Float[Tensor, "n 1"]) -> Float[Tensor, " n"]:
        """The largest bound of each ray (Eq. 14)."""
        return self.errors(width).amax(dim=1)


def density(value: Float[Tensor, "n samples"], width: Float[Tensor, "n 1"]) -> Float[Tensor, "n samples"]:
    """Eqs. 2, 3: the probability below minus the value, of a Laplace distribution, divided by its width."""
    tail = torch.exp(-value.abs() / width) / 2
    return torch.where(value > 0, tail, 1 - tail) / width


def _split_indices(mask: Bool[Tensor, " n"]) -> tuple[Int[Tensor, " k"], Int[Tensor, " rest"]]:
    """The indices of True and of False, with only one synchronisation of the device."""
    order, count = (~mask).to(torch.uint8).argsort(stable=True), int(mask.sum())
    return order[:count], order[count:]


def _spacing(distance: Float[Tensor, "n samples"]) -> Float[Tensor, "n intervals"]:
    return distance[:, 1:] - distance[:, :-1]


def _log_transmittance(value: Tensor, distance: Tensor, width: Float[Tensor, "n 1"]) -> Float[Tensor, "n samples"]:
    """The logarithm of the fraction of light that passes from each sample to the next; everything passes the last."""
    return torch.nn.functional.pad(-density(value[:, :-1], width) * _spacing(distance), (0, 1))


def _clearance(samples: Samples) -> Float[Tensor, "n intervals"]:
    """d*: a lower bound of each interval's distance to the surface, by the empty spheres about its ends (Eq. 12)."""
    side = _spacing(samples.distance)
    first, second = samples.value[:, :-1].abs(), samples.value[:, 1:].abs()
    half = (side + first + second) / 2
    area = (half * (half - side) * (half - first) * (half - second)).clamp_min(0).sqrt()
    least = 2 * area / side.clamp_min(torch.finfo(side.dtype).tiny)
    least = torch.where(first.square() >= side.square() + second.square(), second, least)
    least = torch.where(second.square() >= side.square() + first.square(), first, least)
    crosses = (samples.value[:, :-1] > 0) != (samples.value[:, 1:] > 0)
    return torch.where(crosses | (first + second <= side), 0.0, least)
