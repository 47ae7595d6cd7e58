"""DVR and IDR: hits, misses, gradients and silhouette losses, worked out by hand."""

from dataclasses import replace
from math import exp, log, log1p, nan

import pytest
import torch
from torch import Tensor
from torch.nn.functional import softplus

from bench.config import load
from bench.shape_prior import initialise_to_sphere
from renderers.camera import Rays
from renderers.field import Kind
from renderers.fields.analytic import Shape, box, sphere
from renderers.fields.mlp import Decoder
from renderers.gradients import attach_implicit_gradient
from renderers.rendering import RayObservation, Rendering, Status, at_iteration
from renderers.silhouette import Own
from tests.looped import each
from tests.renderers.analytic_cases import CASES, Case, along_z, vector
from tests.tiny import camera_of

DVR = load("renderer", "dvr", mask_weight=1.0)
IDR = load("renderer", "idr", epsilon=1e-11, steps=300)
NEWTON = load("renderer", "newton", march_epsilon=1e-6)
EXACT = {"dvr": replace(DVR, refinement_steps=60), "idr": IDR, "newton": NEWTON}
by_case = each("case", CASES)
by_name = each("name", EXACT)


@each("samples", [8, 17, 64])
def test_a_slab_thinner_than_the_spacing_may_be_missed(samples):
    spacing = 2 / (samples - 1)
    renderer = replace(DVR, n_ray_samples=samples)
    # Two slabs in the middle of an interval: slightly thinner and slightly thicker than the spacing.
    middle = -1 + spacing * (samples // 2 - 0.5)
    thin, thick = (box((2.0, 2.0, share * spacing / 2)).translate((0.0, 0.0, middle)) for share in (0.98, 1.02))
    assert renderer.render(thin, along_z(0.0)).status.tolist() == [Status.MISS]
    assert renderer.render(thick, along_z(0.0)).status.tolist() == [Status.HIT]


def test_dvr_memory_does_not_grow_with_samples():
    """DVR, Sec. 3.3: the samples of the search need no memory. NeuS keeps its samples, so that the test can fail."""

    def kept_bytes(name: str, **settings) -> int:
        """The bytes of all tensors that a rendering keeps for its backward pass."""
        storages: dict[int, int] = {}

        def keep(tensor: Tensor) -> Tensor:
            storages[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
            return tensor

        torch.manual_seed(0)
        decoder = Decoder(layers=3, width=32, code_length=1, skip=1, narrow=False)
        initialise_to_sphere(decoder, radius=0.5)
        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            rendering = load("renderer", name, **settings).render(decoder.at(torch.zeros(1)), camera_of(32).rays())
            rendering.distance[rendering.hit].sum()
        return sum(storages.values())

    few, many = (kept_bytes("dvr", n_ray_samples=n, doublings=[]) for n in (16, 128))
    assert many == pytest.approx(few, rel=0.01)
    assert kept_bytes("neus", samples=64) > 1.1 * kept_bytes("neus", samples=16)


def test_samples_double_on_schedule_up_to_all():
    renderer = replace(DVR, n_ray_samples=128, doublings=(50, 150, 250))
    assert [renderer.at_iteration(i).n_ray_samples for i in (0, 49, 50, 149, 150, 249, 250, 10_000)] == [
        16, 16, 32, 32, 64, 64, 128, 128,
    ]  # fmt: skip
    assert at_iteration(renderer, 0).n_ray_samples == 16
    assert at_iteration(replace(renderer, doublings=()), 0).n_ray_samples == 128
    assert at_iteration(IDR, 0) is IDR  # IDR has no schedule


@by_name
@by_case
def test_the_implicit_gradient_is_exact(name, case: Case):
    parameter = torch.tensor(case.parameter, dtype=torch.float64, requires_grad=True)
    rays = case.rays()
    origins, directions = rays.origins.requires_grad_(True), rays.directions.requires_grad_(True)
    distance = EXACT[name].render(case.shape(parameter), Rays(origins, directions)).distance
    by_parameter, by_origin, by_direction = torch.autograd.grad(distance.sum(), (parameter, origins, directions))
    near = 1e-4 if name == "newton" else 1e-7  # Newton differentiates the point before its last step
    assert by_parameter.item() == pytest.approx(case.parameter_rate, rel=near)
    torch.testing.assert_close(by_origin[0], case.origin_rate, rtol=near, atol=near)
    # A rotation of the ray moves its end by the distance times the effect of the origin.
    torch.testing.assert_close(by_direction[0], case.distance * case.origin_rate, rtol=near, atol=near)


@each("slope, used", [(-2e-4, -1e-3), (2e-4, 1e-3), (-0.5, -0.5), (0.5, 0.5), (0.0, -1e-3)])
def test_a_flat_slope_keeps_its_sign(slope, used):
    offset = torch.tensor(0.0, dtype=torch.float64, requires_grad=True)
    field = Shape(lambda p: slope * p[..., 2] + offset, Kind.LEVEL, None)
    distance = attach_implicit_gradient(field, along_z(0.0), vector((2.0,)), least_slope=1e-3)
    (gradient,) = torch.autograd.grad(distance.sum(), offset)
    assert gradient.item() == pytest.approx(-1 / used)  # Eq. 8


def masks(renderer, field, rays: Rays, mask: list[bool], seed: int = 0) -> tuple[Tensor, Rendering, Tensor]:
    """The silhouette loss for a seed, the rendering, and the fractions of the rays' chords that the seed draws."""
    rendering = renderer.render(field, rays)
    torch.manual_seed(seed)
    loss = renderer.silhouette_loss(field, rays, rendering, torch.tensor(mask))
    torch.manual_seed(seed)
    return loss, rendering, torch.rand(rays.shape, dtype=torch.float64)


def test_dvr_mask_losses_by_hand():
    # A correct hit costs nothing. A spurious hit costs log 2, at the surface (Eq. 14). A missed ray is evaluated at the
    # drawn point, as free (Eq. 14) or as occupied (Eq. 15). A ray that misses the unit sphere costs nothing.
    width, rays = 0.1, along_z(0.0, 0.0, 0.8, 0.8, 1.5, 1.5)
    renderer = replace(DVR, occupancy_width=width, refinement_steps=40)
    loss, rendering, fractions = masks(renderer, sphere(0.5), rays, [True, False, False, True, True, False])
    assert rendering.hit.tolist() == [True, True, False, False, False, False]
    values = []
    for fraction in fractions[2:4].tolist():
        z = 0.6 * (2 * fraction - 1)  # the chord at height 0.8 goes from -0.6 to 0.6
        values.append((0.64 + z**2) ** 0.5 - 0.5)
    free, occupied = (softplus(torch.tensor(sign * v / width)).item() for sign, v in ((-1, values[0]), (1, values[1])))
    assert loss.item() == pytest.approx((log(2) + free + occupied) / 6, rel=1e-6)


@each("name", ["own", "occupancy"])
def test_a_missed_pixel_with_a_depth_makes_the_sphere_grow(name):
    """The loss of a missed pixel is the cross entropy at its observed distance, worked out by hand."""
    width, rays = 0.1, along_z(0.6)
    dvr = replace(DVR, occupancy_width=width, occupied_at="depth")
    loss = Own() if name == "own" else load("silhouette", name, width=width, weight=1.0, occupied_at="depth")
    radius = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    rendering = dvr.render(sphere(radius), rays)
    observation = RayObservation(torch.tensor([True]), torch.tensor([1.9], dtype=torch.float64))
    cost = loss(dvr, sphere(radius), rays, rendering, observation)
    value = ((0.6**2 + 0.1**2) ** 0.5 - 0.5) / width  # at z = -0.1
    assert cost.item() == pytest.approx(log1p(exp(value)), rel=1e-9)
    (slope,) = torch.autograd.grad(cost, radius)
    assert slope.item() == pytest.approx(-1 / (1 + exp(-value)) / width, rel=1e-9)


def observed_losses(renderer, mask: list[bool], distances: list[float], *heights: float) -> list[float]:
    """The loss with observed distances and the loss of the mask alone, from the same random numbers."""
    rays, losses = along_z(*heights), []
    rendering = renderer.render(sphere(0.5), rays)
    observation = RayObservation(torch.tensor(mask), torch.tensor(distances, dtype=torch.float64))
    for observed in (observation, RayObservation(observation.mask)):
        torch.manual_seed(0)
        losses.append(renderer.observed_loss(sphere(0.5), rays, rendering, observed).item())
    torch.manual_seed(0)
    assert renderer.silhouette_loss(sphere(0.5), rays, rendering, observation.mask).item() == losses[1]
    return losses


def test_a_point_is_drawn_if_no_distance_within_the_sphere_is_observed():
    """A chord at height 0.6 goes from distance 1.2 to 2.8."""
    at_depth, at_random = (replace(DVR, occupied_at=choice) for choice in ("depth", "random"))
    for mask, distance in ((True, nan), (True, 1.0), (True, 3.0), (False, 2.0)):  # unknown, before, behind, background
        with_depth, without = observed_losses(at_depth, [mask], [distance], 0.6)
        assert with_depth == without
    with_depth, without = observed_losses(at_random, [True, True, False], [1.5, 2.0, 2.0], 0.0, 0.6, 0.8)
    assert with_depth == without
    with_depth, without = observed_losses(at_depth, [True, True, False], [1.5, 2.0, 2.0], 0.0, 0.6, 0.8)
    assert with_depth != without


def test_idr_mask_loss_by_hand():
    rays = along_z(0.0, 0.0, 0.8, 0.9)
    renderer = load("renderer", "idr", mask_sharpness=20.0, mask_weight=1.0)
    loss, rendering, _ = masks(renderer, sphere(0.5), rays, [True, False, False, True])
    entropies = [softplus(-20 * rendering.closest[i]) for i in (1, 2)] + [softplus(20 * rendering.closest[3])]
    assert rendering.closest[2].item() == pytest.approx(0.3, abs=0.1)
    assert loss.item() == pytest.approx(sum(e.item() for e in entropies) / (20 * 4), rel=1e-9)
