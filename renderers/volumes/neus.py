"""NeuS: volume rendering whose weights are greatest at the surface (Wang et al., NeurIPS 2021)."""

from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import logsigmoid

from renderers.bracket import equally_spaced
from renderers.camera import Rays
from renderers.checks import check_at_least, check_positive
from renderers.field import Field
from renderers.rendering import Rendering, check_kind
from renderers.volumes.integrate import Samples, VolumeRenderer, by_importance, render_volume, scheduled, weights


@dataclass(frozen=True)
class NeuS(VolumeRenderer):
    """Opacity from how a sigmoid of the distance falls from one sample to the next.

    Source: NeuS (Wang et al. 2021, arXiv 2106.10689), Eq. 13 (opacity of an interval), Sec. 3.2 and supplement
        (samples by importance, each round with a sigmoid twice as sharp; the mask's cross entropy).
    Differentiable in: field parameters and rays, by the samples' weights, also of rays that pass close by: what comes
        into view or leaves it has a part, as wide as the sigmoid.
    Needs: a distance or a bound inside the sphere.
    Deviates from the paper: the sharpness follows a schedule, and is not learnt; samples lie at the middles of equal
        shares, and are not drawn; importance follows Eq. 13, not an estimate from slopes; the background is empty;
        the cosine is not annealed, as the official code does over its first sixth where it has no masks.

    Args:
        samples: equally spaced between where a ray enters and leaves the sphere, its ends among them.
        rounds: of more samples by importance.
        round_samples: in each of them.
        round_sharpness: of the sigmoid in the first round, for a length of one scene unit; it doubles with each.
        sharpness: s, of the sigmoid; the blur of the surface is some times its inverse.
        first_sharpness: at the first iteration of an optimisation.
        sharpening, mask_weight, sphere_radius: see `integrate.VolumeRenderer`.
    """

    samples: int
    rounds: int
    round_samples: int
    round_sharpness: float
    sharpness: float
    first_sharpness: float

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least("samples", self.samples, 2, "the paper uses 64")
        check_at_least("rounds", self.rounds, 0, "the official code uses 4")
        check_at_least("round_samples", self.round_samples, 1, "the official code uses 16")
        check_positive("round_sharpness", self.round_sharpness, "the official code begins at 64")
        check_positive("sharpness", self.sharpness, "1000 blurs the surface over .004 of the unit sphere")
        check_positive("first_sharpness", self.first_sharpness, "the official code begins at 20")

    @property
    def blur(self) -> float:
        """The inverse of the sharpness, in scene units."""
        return 1 / self.sharpness

    def with_blur(self, blur: float) -> "NeuS":
        return replace(self, sharpness=1 / blur, sharpening=0)

    def at_iteration(self, iteration: int) -> "NeuS":
        """The renderer of an iteration, on the way from `first_sharpness` to `sharpness`."""
        return replace(self, sharpness=scheduled(self.first_sharpness, self.sharpness, self.sharpening, iteration))

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Samples where the sigmoid falls, then sums with a graph."""
        check_kind(self, field)
        return render_volume(field, rays, self._search, self._passing, radius=self.sphere_radius)

    def _search(self, field: Field, rays: Rays, entry: Tensor, leave: Tensor) -> Samples:
        """Equally spaced samples, then rounds of more, where the last found most weight."""
        found = Samples.of(field, rays, equally_spaced(entry, leave, self.samples))
        for number in range(self.rounds):
            importance = weights(_falling(found.value, self.round_sharpness * 2**number))
            more = by_importance(found.distance, importance, self.round_samples)
            found = found.joined(Samples.of(field, rays, more))
        return found

    def _passing(self, value: Tensor, distance: Tensor) -> Tensor:
        return _falling(value, self.sharpness)


def _falling(value: Float[Tensor, "n samples"], sharpness: float) -> Float[Tensor, "n intervals"]:
    """The logarithm of the share of light that passes each interval: 1 less the opacity of Eq. 13, at most 1."""
    logs = logsigmoid(sharpness * value)
    return (logs[:, 1:] - logs[:, :-1]).clamp_max(0.0)
