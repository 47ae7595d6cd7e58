"""NeuS: volume rendering whose weights are largest at the surface (Wang et al., NeurIPS 2021)."""

from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import logsigmoid

from renderers.camera import Rays
from renderers.checks import check_at_least, check_positive
from renderers.field import Field
from renderers.later.volumes import Samples, VolumeRenderer, render_volume, resample, schedule, weights
from renderers.rendering import Rendering, check_kind
from renderers.tracing.bracket import equally_spaced


@dataclass(frozen=True)
class NeuS(VolumeRenderer):
    """Opacity of an interval from the decrease of a sigmoid of the distance.

    Source: NeuS (Wang et al. 2021, arXiv 2106.10689), Eq. 13 (opacity of an interval), Sec. 3.2 and supplement
        (samples by importance, each round with a sigmoid twice as sharp; the mask's cross entropy).
    Differentiable in: field parameters and rays, through the samples' weights. Rays that pass close to the surface have
        a gradient too, so a visibility gradient exists, as wide as the sigmoid.
    Needs: a distance or a bound inside the sphere.
    Deviates from the paper: the sharpness follows a schedule and is not learnt; samples lie at midpoints of equal
        fractions and are not random; importance follows Eq. 13, not an estimate from slopes; the background is empty;
        the cosine is not annealed, as in the first sixth of the official code's iterations without masks.

    Args:
        samples: equally spaced from the ray's entry into the sphere to its exit, both included.
        rounds: of further samples by importance.
        round_samples: in each round.
        round_sharpness: of the sigmoid in the first round, per scene unit; it doubles with each round.
        sharpness: s, of the sigmoid; the blur of the surface is a few times its inverse.
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
        """The renderer at an iteration, with a sharpness between `first_sharpness` and `sharpness`."""
        return replace(self, sharpness=schedule(self.first_sharpness, self.sharpness, self.sharpening, iteration))

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Samples where the sigmoid decreases, then sums with a graph."""
        check_kind(self, field)
        return render_volume(field, rays, self._search, self._log_transmittance, radius=self.sphere_radius)

    def _search(self, field: Field, rays: Rays, entry: Tensor, leave: Tensor) -> Samples:
        """Equally spaced samples, then rounds of further ones where the weight is largest."""
        samples = Samples.of(field, rays, equally_spaced(entry, leave, self.samples))
        for index in range(self.rounds):
            importance = weights(_sigmoid_log_transmittance(samples.value, self.round_sharpness * 2**index))
            distance = resample(samples.distance, importance, self.round_samples)
            samples = samples.merge(Samples.of(field, rays, distance))
        return samples

    def _log_transmittance(self, value: Tensor, distance: Tensor) -> Tensor:
        return _sigmoid_log_transmittance(value, self.sharpness)


def _sigmoid_log_transmittance(value: Float[Tensor, "n samples"], sharpness: float) -> Float[Tensor, "n intervals"]:
    """The logarithm of the fraction of light that passes each interval: 1 minus the opacity of Eq. 13, at most 1."""
    log_sigmoid = logsigmoid(sharpness * value)
    return (log_sigmoid[:, 1:] - log_sigmoid[:, :-1]).clamp_max(0.0)
