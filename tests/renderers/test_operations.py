"""Operations of one step of an optimisation, as a GPU would feel them, so that a change that adds to them is seen."""

import pytest
import torch

from bench.config import load
from bench.shape_prior import initialise_to_sphere
from datasets.views import ViewSampler
from renderers import boundary
from renderers.field import Counts, Meter
from renderers.fields import mlp
from renderers.fields.mlp import Decoder
from renderers.rendering import Observed
from tests.operations import Operations

MOST = {  # launches, waits
    "neus": (750, 18),
    "unisurf": (850, 22),
    "volsdf": (3000, 37),
}


@pytest.mark.parametrize("name", MOST)
def test_a_step_of_a_gpu_has_few_launches_and_waits(name, monkeypatch):
    monkeypatch.setattr(mlp, "CACHED", mlp.AT_ONCE)
    torch.manual_seed(0)
    decoder = Decoder(layers=4, width=32, code_length=4, skip=2, narrow=False)
    initialise_to_sphere(decoder, radius=0.5)
    code = torch.full((4,), 0.1, requires_grad=True)
    field = Meter(decoder.requires_grad_(False).at(code), Counts())
    rays = ViewSampler(2.5, 50.0, (0.0, 360.0), (15.0, 35.0), 24).camera(30.0, 25.0).rays()
    observed = Observed(torch.rand(rays.shape) > 0.5)
    renderer = load("renderer", name)
    with Operations() as counted:
        rendering = boundary.rendered(renderer, field, rays)
        loss = torch.where(rendering.hit, rendering.distance, 0.0).sum()
        (loss + boundary.silhouette_loss(renderer, field, rays, rendering, observed)).backward()
    launches, waits = MOST[name]
    assert rendering.hit.any() and code.grad is not None and field.counts.gradient
    assert counted.launches <= launches
    assert counted.waits.total() <= waits, dict(counted.waits)
