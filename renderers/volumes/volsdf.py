"""VolSDF: density from the distance, and samples that bound the error of the opacity (Yariv et al., NeurIPS 2021)."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import log
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderers.bracket import equally_spaced
from renderers.camera import Rays
from renderers.checks import check_at_least, check_positive
from renderers.field import Field, Kind
from renderers.rendering import Capabilities, Rendering, check_kind
from renderers.volumes.integrate import Samples, VolumeRenderer, by_importance, render_volume, scheduled, weights

HALVINGS = 10  # of the interval in which the least width is searched, as in the paper
MOST_LOG = 14.0  # of the error's exponential: larger ones are all the same


@dataclass(frozen=True)
class VolSDF(VolumeRenderer):
    """Density from the Laplace distribution's cumulative function of the distance.

    Source: VolSDF (Yariv et al. 2021, arXiv 2106.12052), Eqs. 2, 3 (density), Theorem 1 and Eq. 14 (bound on the error
        of the opacity), Algorithm 1 (samples).
    Differentiable in: field parameters and rays, by the samples' weights, also of rays that pass close by: what comes
        into view or leaves it has a part, as wide as the density's fall.
    Needs: a distance inside the sphere; Theorem 1 holds for no other.
    Deviates from the paper: the width follows a schedule, and is not learnt; samples lie at the middles of equal
        shares, and are not drawn; rays whose bound holds are not sampled again; the background is empty.

    Args:
        samples: equally spaced at first, and as many more with each round, where the bound is greatest.
        rounds: at most, beside the first.
        error: epsilon, most that the opacity may be off at the samples.
        fine_samples: by the weights of the opacity that was found.
        extra_samples: beside these, of the samples that bound the error, every so many, as in the official code.
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
        """The renderer of an iteration, on the way from `first_width` to `width`."""
        return replace(self, width=scheduled(self.first_width, self.width, self.sharpening, iteration))

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Samples until the opacity's error is bounded, then sums with a graph."""
        check_kind(self, field)
        return render_volume(field, rays, self._search, self._passing, radius=self.sphere_radius)

    def bounded(
        self, field: Field, rays: Rays, entry: Tensor, leave: Tensor
    ) -> Iterator[tuple[Int[Tensor, " k"], Samples, Float[Tensor, "k 1"]]]:
        """Algorithm 1 up to its last step, in groups of rays that need equally many rounds.

        Gives the places of these rays, their samples, and the width of each ray for which they bound the error.
        """
        index = torch.arange(len(entry), device=entry.device)
        found = Samples.of(field, rays, equally_spaced(entry, leave, self.samples))
        square = _spacing(found.distance).square().sum(dim=1, keepdim=True)
        width = (square / (4 * log(1 + self.error))).sqrt().clamp_min(self.width)  # Lemma 2, of any spacing
        for number in range(self.rounds + 1):
            bound = Bound.of(found)
            width = self._least_width(bound, width)
            ends = (width <= self.width).squeeze(1) | (number == self.rounds)
            ended, on = _parted(ends)
            yield index[ended], found.of_rays(ended), width[ended]
            if not len(on):
                return
            index, found, width, bound = index[on], found.of_rays(on), width[on], bound.of_rays(on)
            more = by_importance(found.distance, bound.errors(width), self.samples)
            found = found.joined(Samples.of(field, rays[index], more))

    def _search(self, field: Field, rays: Rays, entry: Tensor, leave: Tensor) -> Samples:
        """Algorithm 1: samples by the weights at the least width whose error is bounded, and some of those before."""
        distance = entry.new_empty(len(entry), self.fine_samples + self.extra_samples)
        for index, found, width in self.bounded(field, rays, entry, leave):
            importance = weights(_passing(found.value, found.distance, width))[:, :-1]
            fine = by_importance(found.distance, importance, self.fine_samples)
            every = torch.linspace(0, found.distance.shape[1] - 1, self.extra_samples, device=entry.device).long()
            distance[index] = torch.cat([fine, found.distance[:, every]], dim=1).sort(dim=1)[0]
        return Samples.of(field, rays, distance)

    def _passing(self, value: Tensor, distance: Tensor) -> Tensor:
        return _passing(value, distance, torch.full_like(value[:, :1], self.width))

    def _least_width(self, bound: "Bound", width: Float[Tensor, "n 1"]) -> Float[Tensor, "n 1"]:
        """The least width from `self.width` to `width` whose error is bounded, by halving; `width` where none is."""
        least = torch.full_like(width, self.width)
        rest = (bound.greatest(least) > self.error).nonzero().squeeze(-1)
        bound, low, high = bound.of_rays(rest), least[rest], width[rest]
        for _ in range(HALVINGS if len(rest) else 0):
            middle = (low + high) / 2
            holds = bound.greatest(middle)[:, None] <= self.error
            low, high = torch.where(holds, low, middle), torch.where(holds, middle, high)
        return least.index_put((rest,), high)


@dataclass(frozen=True)
class Bound:
    """The bound on the error of the opacity along n rays, for any width (Theorem 1, Eq. 14).

    Of each interval `magnitude` is that of the value with which it begins, `inside` its length where that value is not
    positive, else 0, `tail` half the length with the value's sign, `square` a quarter of the length's square, and
    `clearance` how far it is from the surface at least.
    """

    magnitude: Float[Tensor, "n intervals"]
    inside: Float[Tensor, "n intervals"]
    tail: Float[Tensor, "n intervals"]
    square: Float[Tensor, "n intervals"]
    clearance: Float[Tensor, "n intervals"]

    @staticmethod
    def of(found: Samples) -> "Bound":
        """The bound of the rays' samples."""
        value, spacing = found.value[:, :-1], _spacing(found.distance)
        free = value > 0
        inside = torch.where(free, 0.0, spacing)
        return Bound(value.abs(), inside, spacing / 2 - inside, spacing.square() / 4, _clearance(found))

    def of_rays(self, index: Tensor) -> "Bound":
        """That of some of the rays, by their places."""
        return Bound(*(part[index] for part in vars(self).values()))

    def errors(self, width: Float[Tensor, "n 1"]) -> Float[Tensor, "n intervals"]:
        """Of the opacity at each interval (Theorem 1)."""
        rate = -1 / width
        stopped = torch.addcmul(self.inside, self.tail, (self.magnitude * rate).exp_())  # `density` by length and width
        before = (stopped.cumsum(dim=1) - stopped).mul_(rate)
        error = (self.clearance * rate).exp_().mul_(self.square).cumsum(dim=1).mul_(rate.square())
        return before.exp_().mul_(error.clamp_max_(MOST_LOG).expm1_())

    def greatest(self, width: Float[Tensor, "n 1"]) -> Float[Tensor, " n"]:
        """The greatest of each ray (Eq. 14)."""
        return self.errors(width).amax(dim=1)


def density(value: Float[Tensor, "n samples"], width: Float[Tensor, "n 1"]) -> Float[Tensor, "n samples"]:
    """Eqs. 2, 3: the share of a Laplace distribution that lies below minus the value, over its width."""
    tail = torch.exp(-value.abs() / width) / 2
    return torch.where(value > 0, tail, 1 - tail) / width


def _parted(which: Bool[Tensor, " n"]) -> tuple[Int[Tensor, " k"], Int[Tensor, " rest"]]:
    """The places where it is true, and the others, in one wait for the device."""
    order, count = (~which).to(torch.uint8).argsort(stable=True), int(which.sum())
    return order[:count], order[count:]


def _spacing(distance: Float[Tensor, "n samples"]) -> Float[Tensor, "n intervals"]:
    return distance[:, 1:] - distance[:, :-1]


def _passing(value: Tensor, distance: Tensor, width: Float[Tensor, "n 1"]) -> Float[Tensor, "n samples"]:
    """The logarithm of the share of light that passes each sample: by its density up to the next; all, the last one."""
    return torch.nn.functional.pad(-density(value[:, :-1], width) * _spacing(distance), (0, 1))


def _clearance(found: Samples) -> Float[Tensor, "n intervals"]:
    """d*: how far each interval is from the surface at least, by the empty spheres about its ends (Eq. 12)."""
    side = _spacing(found.distance)
    first, second = found.value[:, :-1].abs(), found.value[:, 1:].abs()
    half = (side + first + second) / 2
    area = (half * (half - side) * (half - first) * (half - second)).clamp_min(0).sqrt()
    least = 2 * area / side.clamp_min(torch.finfo(side.dtype).tiny)
    least = torch.where(first.square() >= side.square() + second.square(), second, least)
    least = torch.where(second.square() >= side.square() + first.square(), first, least)
    crosses = (found.value[:, :-1] > 0) != (found.value[:, 1:] > 0)
    return torch.where(crosses | (first + second <= side), 0.0, least)
