"""Marches that remove finished rays only now and then, as on a GPU, which has to be waited for."""

from dataclasses import replace

import torch
from torch import Tensor

from bench.config import load
from renderers.boundary import RENDERING_TENSORS, render_checked
from renderers.field import Coarse, Counts, Flops, Kind, Meter
from renderers.fields.analytic import torus
from renderers.rendering import Renderer, Rendering, with_empty_memory
from renderers.tracing import waits
from tests.looped import each
from tests.tiny import camera_of

COARSE_ERROR = 0.002
MARCHED = ("dist", "dist_keinert", "dist_auto_relaxed", "idr", "relaxed_boundary", "edge_sampling", "newton")
SETTINGS = {
    "dist_keinert": {"n_gradient_samples": 3},
    "idr": {"steps": 13},
    "relaxed_boundary": {"sphere_radius": 0.7, "band": 0.05},
}


class Ring:
    """A rippled torus that is NaN in a region of space; it counts its evaluated points."""

    kind = Kind.DISTANCE
    lipschitz: float | None = None
    flops: Flops | None = None

    def __init__(self) -> None:
        self.evaluated, self.furthest, self.radius = 0, 0.0, torch.tensor(0.2, requires_grad=True)

    def __call__(self, points: Tensor) -> Tensor:
        self.evaluated += points.numel() // 3
        self.furthest = max(self.furthest, *points.detach().norm(dim=-1).reshape(-1).tolist(), 0.0)
        shaking = torus(0.5, self.radius)(points) + 0.02 * torch.sin(20 * points[..., 0])
        return torch.where(points[..., 1] > 0.55, torch.nan, shaking)


class CoarseRing(Ring):
    """The same torus, with coarse values."""

    @property
    def coarse(self) -> Coarse:
        return Coarse(
            lambda points: self(points).detach() + COARSE_ERROR * torch.cos(90 * points[..., 1]), COARSE_ERROR
        )


def measured(renderer: Renderer, field: Ring) -> tuple[Rendering, Counts, Tensor]:
    """A rendering of 32 x 32 rays, its counts, and a gradient."""
    meter = Meter(field)
    rendering = render_checked(with_empty_memory(renderer), meter, camera_of(32, angles=(30.0, 25.0)).rays())
    loss = torch.where(rendering.hit, rendering.distance, 0.0).sum() + rendering.closest.sum()
    return rendering, meter.counts, torch.autograd.grad(loss, field.radius)[0]


@each("name", [*MARCHED, "coarse dist_coarse", "coarse newton"])
def test_the_interval_of_removing_finished_rays_changes_no_number(name, monkeypatch):
    field = CoarseRing if name.startswith("coarse ") else Ring
    renderer = load("renderer", name.removeprefix("coarse "), **SETTINGS.get(name, {}))
    plain, shape = field(), field()
    first, counts, gradient = measured(renderer, plain)
    with monkeypatch.context() as patch:
        patch.setitem(waits.COMPACTION_INTERVALS, "cpu", 8)
        second, second_counts, second_gradient = measured(renderer, shape)
    for tensor in RENDERING_TENSORS:
        assert torch.equal(getattr(first, tensor), getattr(second, tensor)), tensor
    assert torch.equal(gradient, second_gradient)
    assert counts == replace(second_counts, masked=0) and counts.hits > 100
    assert counts.masked == 0 < second_counts.masked
    assert shape.evaluated == second_counts.value + second_counts.coarse + second_counts.masked
    assert shape.furthest <= plain.furthest + 1e-4  # a field may be undefined outside the sphere
