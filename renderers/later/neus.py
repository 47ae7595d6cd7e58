"""NeuS: volume rendering whose weights are largest at the surface (Wang et al., NeurIPS 2021)."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import logsigmoid

from renderers.later.volumes import SharpenedVolume


@dataclass(frozen=True)
class NeuS(SharpenedVolume):
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
        samples, rounds, round_samples, round_sharpness, first_sharpness: see `volumes.SharpenedVolume`.
        sharpness: s, of the sigmoid; the blur of the surface is a few times its inverse.
        sharpening, mask_weight, sphere_radius: see `integrate.VolumeRenderer`.
    """

    def _log_transmittance(
        self, value: Float[Tensor, "n samples"], distance: Float[Tensor, "n samples"]
    ) -> Float[Tensor, "n intervals"]:
        """The logarithm of 1 minus the opacity of Eq. 13, at most 0."""
        log_sigmoid = logsigmoid(self.sharpness * value)
        return (log_sigmoid[:, 1:] - log_sigmoid[:, :-1]).clamp_max(0.0)
