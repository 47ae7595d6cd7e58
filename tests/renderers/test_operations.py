"""The number of operations of a step without those of the field, and of its waits for results on a GPU.

The limits are a few percent above the present numbers: a change that needs more must raise them here.
"""

import pytest
import torch
from torch import Tensor

from bench.config import load
from renderers.boundary import render_checked
from renderers.fields.analytic import Shape, torus
from renderers.rendering import at_iteration, with_empty_memory
from renderers.tracing import waits
from tests.looped import each
from tests.operations import Operations
from tests.tiny import camera_of

LIMITS = {  # operations and waits of a rendering of 64 x 64 rays, its loss and its backward pass
    "dist": (1650, 12),
    "idr": (1280, 9),
    "newton": (3550, 22),
    "dvr_64": (320, 3),
    "relaxed_boundary": (4200, 40),
    "neus": (470, 5),
    "opaque": (650, 5),
    "unisurf": (440, 6),
    "volsdf": (2550, 15),
}


def step(name: str, warm: int) -> Operations:
    """The operations of a step of an optimisation, after `warm` renderings that a renderer may remember."""
    count, radius = Operations(), torch.tensor(0.2, requires_grad=True)

    def ring(points: Tensor) -> Tensor:
        with count.pause():
            return torus(0.5, radius)(points)

    renderer, rays = with_empty_memory(load("renderer", name)), camera_of(64, angles=(30.0, 25.0)).rays()
    for iteration in range(warm):
        render_checked(at_iteration(renderer, iteration), Shape(ring), rays)
    with count:
        rendering = render_checked(at_iteration(renderer, warm) if warm else renderer, Shape(ring), rays)
        (torch.where(rendering.hit, rendering.distance, 0.0).sum() + rendering.closest.sum()).backward()
    return count


@pytest.mark.parametrize("names", [["dist", "newton", "neus"], pytest.param([*LIMITS], marks=pytest.mark.slow)])
@each("warm", [0, 3])
def test_a_step_takes_no_more_operations_and_waits_than_it_did(names, warm, monkeypatch):
    monkeypatch.setitem(waits.COMPACTION_INTERVALS, "cpu", waits.DEFAULT_COMPACTION_INTERVAL)
    for name in names:
        most_operations, most_waits = LIMITS[name]
        count = step(name, warm)
        assert count.launches <= most_operations and count.waits.total() <= most_waits, name
