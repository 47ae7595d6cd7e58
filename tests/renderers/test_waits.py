"""Marches that leave out the rays that have ended only now and then, as on a device that is waited for."""

import torch
from torch import Tensor

from bench.config import load
from renderers import waits
from renderers.boundary import RENDERING_TENSORS, render_checked
from renderers.field import Coarse, Counts, Flops, Kind, Meter
from renderers.fields.analytic import torus
from renderers.rendering import Renderer, Rendering, with_empty_memory
from tests.looped import each
from tests.tiny import camera_of

ERROR = 0.002
MARCHED = ("dist", "dist_keinert", "dist_auto_relaxed", "idr", "relaxed_boundary", "newton")
MORE = {
    "dist_keinert": {"n_gradient_samples": 3},
    "idr": {"steps": 13},
    "relaxed_boundary": {"sphere_radius": 0.7, "band": 0.05},
}


class Ring:
    """A torus that shakes and has no values in a part of space; counts the points at which it is asked."""

    kind = Kind.DISTANCE
    lipschitz: float | None = None
    flops: Flops | None = None

    def __init__(self) -> None:
        self.asked, self.furthest, self.radius = 0, 0.0, torch.tensor(0.2, requires_grad=True)

    def __call__(self, points: Tensor) -> Tensor:
        self.asked += points.numel() // 3
        self.furthest = max(self.furthest, *points.detach().norm(dim=-1).reshape(-1).tolist(), 0.0)
        shaking = torus(0.5, self.radius)(points) + 0.02 * torch.sin(20 * points[..., 0])
        return torch.where(points[..., 1] > 0.55, torch.nan, shaking)


class Coarsely(Ring):
    """The same, with coarse values."""

    @property
    def coarse(self) -> Coarse:
        return Coarse(lambda points: self(points).detach() + ERROR * torch.cos(90 * points[..., 1]), ERROR)


def found(renderer: Renderer, field: Ring) -> tuple[Rendering, Counts, Tensor]:
    """A rendering of 32 x 32 rays, what it counts, and a gradient."""
    meter = Meter(field)
    rendering = render_checked(with_empty_memory(renderer), meter, camera_of(32, angles=(30.0, 25.0)).rays())
    loss = torch.where(rendering.hit, rendering.distance, 0.0).sum() + rendering.closest.sum()
    return rendering, meter.counts, torch.autograd.grad(loss, field.radius)[0]


@each("name", [*MARCHED, "coarse dist_coarse", "coarse newton"])
def test_when_ended_rays_are_left_out_changes_no_number(name, monkeypatch):
    field = Coarsely if name.startswith("coarse ") else Ring
    renderer = load("renderer", name.removeprefix("coarse "), **MORE.get(name, {}))
    plain, shape = field(), field()
    one, counts, gradient = found(renderer, plain)
    with monkeypatch.context() as elsewhere:
        elsewhere.setitem(waits.COMPACTION_INTERVALS, "cpu", 8)
        other, seldom, same = found(renderer, shape)
    for part in RENDERING_TENSORS:
        assert torch.equal(getattr(one, part), getattr(other, part)), part
    assert torch.equal(gradient, same)
    assert counts == seldom and counts.hits == seldom.hits > 100
    assert counts.masked == 0 < seldom.masked
    assert shape.asked == seldom.value + seldom.coarse + seldom.masked
    assert shape.furthest <= plain.furthest + 1e-4  # a field may have no values outside of the sphere
