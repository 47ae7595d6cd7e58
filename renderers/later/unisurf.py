"""UNISURF: occupancy as the opacity of samples in an interval about the surface (Oechsle et al., ICCV 2021)."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from renderers.camera import Rays
from renderers.checks import check_at_least, check_positive
from renderers.field import Field, occupancy_logits
from renderers.later.volumes import Samples, VolumeRenderer, render_volume, schedule
from renderers.rendering import Rendering, check_kind
from renderers.tracing.bracket import equally_spaced, first_crossing, refine


@dataclass(frozen=True)
class UNISURF(VolumeRenderer):
    """DVR's search for the surface, then occupancies as opacities within an interval about it.

    Source: UNISURF (Oechsle et al. 2021, arXiv 2104.10078), Eq. 5 (weights), Sec. 3.3 and Eq. 9 (the interval).
    Differentiable in: field parameters and rays, through the samples' weights. Rays that pass close to the surface have
        a gradient too, so a visibility gradient exists, as wide as the occupancy's fall.
    Needs: a distance or a bound inside the sphere; the occupancy is its sigmoid. The paper's occupancy network learns
        its slope. A level set has no unit of length and is refused.
    Deviates from the paper: see Needs; samples are equally spaced and not random; the background is empty; the
        smoothness of normals is a loss of the task, and off. Without space in front of the interval, free samples get
        the value of free space. `distance` is the weighted mean: while the interval is wide, it lies in front of the
        surface, where samples of low occupancy absorb light.

    Args:
        search_samples: equally spaced samples, for the search of the first change from free to occupied.
        search_steps: of the secant method, for each change.
        samples: within the interval about the surface; equally spaced on rays without a surface.
        free_samples: from the ray's entry into the sphere to the interval.
        interval: half of its length, in scene units.
        first_interval: at the first iteration of an optimisation.
        occupancy_width: scene units over which the occupancy falls from occupied to free.
        first_occupancy_width: at the first iteration.
        sharpening, mask_weight, sphere_radius: see `integrate.VolumeRenderer`.
    """

    search_samples: int
    search_steps: int
    samples: int
    free_samples: int
    interval: float
    first_interval: float
    occupancy_width: float
    first_occupancy_width: float

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least("search_samples", self.search_samples, 2, "the paper uses 256")
        check_at_least("search_steps", self.search_steps, 0, "the paper uses 8")
        check_at_least("samples", self.samples, 2, "the paper uses 64")
        check_at_least("free_samples", self.free_samples, 1, "the paper uses 32")
        for name in ("interval", "first_interval", "occupancy_width", "first_occupancy_width"):
            check_positive(name, getattr(self, name), "conf/renderer/unisurf.yaml has values that work")

    @property
    def blur(self) -> float:
        """The occupancy's width, in scene units."""
        return self.occupancy_width

    def with_blur(self, blur: float) -> "UNISURF":
        """See `Blurred`; the interval keeps its proportion to the width."""
        interval = self.interval * blur / self.occupancy_width
        return replace(self, occupancy_width=blur, interval=interval, sharpening=0)

    def at_iteration(self, iteration: int) -> "UNISURF":
        """The renderer at an iteration, with an interval and a width between the first and the last ones."""
        names = ("interval", "occupancy_width")
        settings = {
            name: schedule(getattr(self, f"first_{name}"), getattr(self, name), self.sharpening, iteration)
            for name in names
        }
        return replace(self, **settings)

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Searches the surface, samples around it, then sums with a graph."""
        check_kind(self, field)

        def log_transmittance(value: Tensor, distance: Tensor) -> Tensor:
            return logsigmoid(-occupancy_logits(field, value, width=self.occupancy_width))

        return render_volume(field, rays, self._search, log_transmittance, radius=self.sphere_radius)

    def _search(self, field: Field, rays: Rays, entry: Tensor, leave: Tensor) -> Samples:
        """Equally spaced samples in front of and in the interval; on the whole ray if it has no surface."""
        coarse = Samples.of(field, rays, equally_spaced(entry, leave, self.search_samples))
        has_surface, bracket = first_crossing(coarse.distance, coarse.value)
        hit = has_surface.nonzero().squeeze(-1)
        root, _ = refine(field, rays[hit], bracket.select(hit), method="secant", steps=self.search_steps)
        near = torch.maximum(root - self.interval, entry[hit])
        far = torch.minimum(root + self.interval, leave[hit])
        distance = equally_spaced(entry, leave, self.free_samples + self.samples)
        near_surface = [
            equally_spaced(entry[hit], near, self.free_samples + 1)[:, :-1],
            equally_spaced(near, far, self.samples),
        ]
        samples = Samples.of(field, rays, distance.index_put((hit,), torch.cat(near_surface, dim=1)))
        no_free_space = torch.zeros_like(has_surface).index_put((hit,), near <= entry[hit])  # free samples coincide
        samples.value[:, : self.free_samples].masked_fill_(no_free_space[:, None], self.sphere_radius)
        return samples
