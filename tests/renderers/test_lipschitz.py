"""Networks of slope 1: their bound, marches on them, and the loss of labels."""

from dataclasses import replace

import pytest
import torch

from bench.config import load
from renderers.field import Kind, autograd_gradients
from renderers.fields.analytic import Shape, torus
from renderers.fields.networks.lipschitz import LipschitzNetwork, label_loss
from tests.looped import each
from tests.tiny import camera_of

SEEDS = (0, 1, 2)
REFERENCE = load("renderer", "dvr", n_ray_samples=512, doublings=[])


def random_network(seed: int, size: float = 1.0) -> LipschitzNetwork:
    """A network with random weights of a size, scales and offset, in float64; its surface passes the origin."""
    network, draw = LipschitzNetwork.new(3, 12, seed=seed), torch.Generator().manual_seed(seed)
    layers = [
        replace(layer, weight=size * layer.weight, log_scale=torch.randn(12, generator=draw))
        for layer in network.layers
    ]
    network = replace(network, layers=tuple(layers))
    return replace(network, offset=-network(torch.zeros(1, 3)).squeeze())


@each("seed", SEEDS)
@each("size", [0.1, 1.0, 30.0])
def test_no_value_changes_by_more_than_the_distance_of_the_points(seed, size):
    network, draw = random_network(seed, size), torch.Generator().manual_seed(7)
    first, second = (2 * torch.rand(2, 3000, 3, generator=draw, dtype=torch.float64) - 1).unbind()
    change = (network(first) - network(second)).abs()
    assert (change <= (first - second).norm(dim=-1) * (1 + 1e-9)).all()
    slope = autograd_gradients(network, first).norm(dim=-1)
    assert slope.max() <= 1 + 1e-9 and slope.max() > 0.2
    assert network.kind is Kind.BOUND and network.lipschitz == 1.0


@pytest.mark.slow
@each("seed", SEEDS)
@each("name", ["naive", "idr", "dist"])
def test_a_march_with_alpha_1_loses_no_pixel(seed, name):
    """Of the pixels that 512 samples per ray hit; and none stops behind the first surface, up to 1e-3."""
    network = random_network(seed)
    settings = {"steps": 2000} | ({"alpha": 1.0} if name == "dist" else {})
    renderer, rays = load("renderer", name, **settings), camera_of(24, angles=(30.0, 25.0)).double().rays()
    if network(rays.origins[0, 0]) < 0:  # the camera is outside
        network = replace(network, last=-network.last, offset=-network.offset)
    with torch.no_grad():
        reference, marched = REFERENCE.render(network, rays), renderer.render(network, rays)
    hit = reference.hit
    assert hit.sum() > 50 and not (hit & ~marched.hit).any()
    assert (marched.distance[hit] <= reference.distance[hit] + 1e-3).all()


def test_a_march_on_a_field_that_is_too_steep_loses_pixels():
    """The test above can fail: a torus whose values are four times its distance is passed by a march."""
    renderer, rays = load("renderer", "idr"), camera_of(24, angles=(30.0, 25.0)).double().rays()
    ring = torus(0.6, 0.1)
    steep = Shape(lambda p: 4 * ring(p), Kind.BOUND)
    hit = REFERENCE.render(ring, rays).hit
    assert (hit & ~renderer.render(steep, rays).hit).sum() > 5


def test_the_loss_of_labels_worked_out_by_hand():
    values, inside = torch.tensor([0.3, 0.1, -0.5, 0.2]), torch.tensor([0.0, 0.0, 1.0, 1.0])
    expected = 10 * (0.1 + 0.4) / 4 - (0.3 + 0.1 + 0.5 - 0.2) / 4  # the second is within the margin, the last is wrong
    assert label_loss(values, inside, margin=0.2, hinge_weight=10.0).item() == pytest.approx(expected)


def test_labels_alone_bring_the_values_closer_to_the_distance():
    truth, network = torus(0.55, 0.25), LipschitzNetwork.new(3, 24, seed=0)
    parameters = [tensor.requires_grad_() for tensor in network.parameters]
    optimiser, draw = torch.optim.Adam(parameters, lr=0.02), torch.Generator().manual_seed(1)
    points = 2 * torch.rand(4000, 3, generator=draw) - 1
    inside, errors = (truth(points) < 0).float(), []
    for _ in range(120):
        values = network(points)
        errors.append((values - truth(points)).abs().mean().item())
        optimiser.zero_grad()
        label_loss(values, inside, margin=0.05, hinge_weight=50.0).backward()
        optimiser.step()
    wrong = ((network(points) < 0) != (inside > 0)).float().mean().item()
    assert errors[-1] < errors[0] / 3 and wrong < inside.mean().item() / 2


def test_a_network_has_a_layer_and_room_for_a_feature():
    for layers, width in ((0, 8), (2, 3)):
        with pytest.raises(ValueError, match="layers must be at least 1 and width at least 4"):
            LipschitzNetwork.new(layers, width, seed=0)
