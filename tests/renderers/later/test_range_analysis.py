"""Bounds of a network on segments, and ray casting with these bounds, which misses no hit."""

from dataclasses import replace

import pytest
import torch
from torch.nn.functional import normalize

from bench.config import load
from bench.machine.limits import Limits
from renderers.camera import Rays
from renderers.field import Counts, Kind, Meter, Moved, estimate_lipschitz
from renderers.fields.analytic import Shape, box, sphere
from renderers.fields.mlp import BoundDecoder, Decoder
from renderers.later.affine import field_bounds, segment_bounds
from renderers.newton.tracer import normalise_slope
from renderers.rendering import Status
from renderers.tracing.reference import trace
from tests.looped import each
from tests.renderers.analytic_cases import vector

RENDERER = load("renderer", "range_analysis")


def network(seed: int, *, layers: int = 4, width: int = 24, skip: int = 2, scale: float = 1.5) -> BoundDecoder:
    """A random network in float64, about as steep as a distance and far from a distance."""
    torch.manual_seed(seed)
    decoder = Decoder(layers=layers, width=width, code_length=3, skip=skip, narrow=False).double().requires_grad_(False)
    for layer in decoder.hidden:
        layer.weight.mul_(scale * 1.5)
    field = decoder.at(torch.randn(3).double())
    weight, bias = field.last
    values = field(normalize(torch.randn(2000, 3).double(), dim=-1))
    spread = values.std()
    return replace(field, last=(weight / spread, (bias - values.median()) / spread + 0.4))


def segments(count: int, length: float) -> tuple[torch.Tensor, torch.Tensor]:
    middle = torch.rand(count, 3, dtype=torch.float64) * 2 - 1
    return middle, length / 2 * normalize(torch.randn(count, 3, dtype=torch.float64), dim=-1)


@each("length", [1.0, 0.01])
@each("seed", range(2))
def test_all_values_of_a_segment_lie_within_its_bounds(seed, length):
    field = network(seed)
    middle, half = segments(200, length)
    low, high = field_bounds(field)(middle, half)
    along = torch.linspace(-1, 1, 101, dtype=torch.float64)
    values = field(middle[:, None] + along[:, None] * half[:, None])
    assert (values >= low[:, None]).all() and (values <= high[:, None]).all()


def from_all_sides(count: int) -> Rays:
    generator = torch.Generator().manual_seed(3)
    origins = 2 * normalize(torch.randn(count, 3, dtype=torch.float64, generator=generator), dim=-1)
    targets = 0.5 * torch.randn(count, 3, dtype=torch.float64, generator=generator)
    return Rays(origins, normalize(targets - origins, dim=-1))


@each("seed, lost", [(0, 74), (1, 52)])
def test_no_first_hit_of_a_network_is_missed(seed, lost):
    """The values of the network are no distances. Sphere tracing loses hits, and the certificate loses none."""
    field, rays = network(seed), from_all_sides(400)
    truth = trace(field, rays, lipschitz=2.5 * estimate_lipschitz(field, radius=1.0), least_step=1e-4, radius=1.0)
    counts, marching = Counts(), Counts()
    rendering = RENDERER.render(Meter(field, counts), rays)
    hits = truth.status == Status.HIT
    assert hits.sum() > 30 and (rendering.status[hits] == Status.HIT).all()
    assert (rendering.distance - truth.distance)[hits].abs().max() < 1e-7
    assert not (rendering.hit & ~hits & (truth.status != Status.STARTED_INSIDE)).any()
    marched = load("renderer", "idr").render(Meter(field, marching), rays)
    off = (marched.distance - truth.distance).abs() > 0.01
    assert int((hits & (off | ~marched.hit)).sum()) == pytest.approx(lost, abs=2)
    assert 6 < counts.value / marching.value < 8.5


def test_a_thin_plate_is_hit():
    rays = Rays(vector((0.01, 0.02, -2)).expand(5, 3), normalize(vector((0.02, 0.03, 1)).expand(5, 3), dim=-1))
    for thickness in (0.1, 0.01, 0.002):
        rendering = RENDERER.render(box((0.5, 0.5, thickness / 2)), rays)
        assert rendering.hit.all()


@each("scale", [4.0, 0.05])
def test_a_scaled_plate_is_hit_if_its_lipschitz_constant_is_stated(scale):
    """Half of the shortest segment is worth more or less than half of the plate."""
    thickness = 0.02
    plate = Shape(lambda p: scale * box((0.5, 0.5, thickness / 2))(p), Kind.BOUND, scale)
    rays = from_all_sides(400)
    truth = RENDERER.render(box((0.5, 0.5, thickness / 2)), rays)
    rendering = RENDERER.render(plate, rays)
    assert truth.hit.sum() > 50 and torch.equal(rendering.hit, truth.hit)
    torch.testing.assert_close(rendering.distance[rendering.hit], truth.distance[rendering.hit], rtol=0, atol=1e-6)


def test_rounded_values_give_hits_at_their_change_of_sign(step=0.002):
    """A rounded value is 0 at the end of a segment that was certified to be empty."""
    exact = sphere(0.5)
    rounded = Shape(lambda p: (exact(p) / step).round() * step, exact.kind, exact.lipschitz)
    rendering, truth = RENDERER.render(rounded, from_all_sides(400)), RENDERER.render(exact, from_all_sides(400))
    assert rendering.hit.sum() > 100
    assert (rendering.hit == truth.hit).sum() > 395  # all rays except at the outline
    assert exact(rendering.points[rendering.hit]).abs().max() <= step


def test_bounds_are_counted_by_their_matrix_products():
    field, counts = network(0), Counts()
    meter = Meter(field, counts)
    assert field_bounds(meter) is not None
    field_bounds(meter)(*segments(10, 0.1))
    assert counts.value == 30 and field_bounds(Meter(sphere(0.5))) is None


def test_a_wrapped_network_is_cast_by_the_same_bounds():
    """The wrappers count, limit or move the network. Without its bounds the certificate would be lost silently."""
    field, rays = network(2), from_all_sides(200)
    plain = RENDERER.render(field, rays)
    still = Moved(field, torch.zeros(7).double())
    limits = Limits(values=10**9, memory=64)
    for wrapped in (Meter(field), limits.watch(field, torch.device("cpu")), still, Meter(still)):
        torch.testing.assert_close(RENDERER.render(wrapped, rays).distance, plain.distance, rtol=0, atol=1e-9)
    assert field_bounds(normalise_slope(field, 2.0)) is None  # its values are others
    moved = Moved(field, vector((0.1, -0.2, 0.3, 0.05, 0.1, -0.1, -0.7)))
    middle, half_segment = segments(200, 0.1)
    low, high = field_bounds(moved)(middle, half_segment)
    values = moved(middle[:, None] + torch.linspace(-1, 1, 51).double()[:, None] * half_segment[:, None])
    assert (values >= low[:, None]).all() and (values <= high[:, None]).all()


def test_rounding_does_not_blur_the_bounds_of_a_deep_network_in_float32():
    torch.manual_seed(0)
    field = Decoder(layers=8, width=256, code_length=0, skip=4, narrow=False).requires_grad_(False).at(torch.zeros(0))
    middle, half = (vectors.float() for vectors in segments(50, 1e-3))
    low, high = field_bounds(field)(middle, half)
    exact = segment_bounds(field.hidden, field.last, field.skip, middle.double(), half.double())
    assert ((high - low) - (exact[1] - exact[0])).abs().max() < 1e-4


def test_values_of_a_network_of_large_weights_lie_within_its_bounds_in_float32():
    """The segments are so short that only rounding separates the bounds from the value."""
    torch.manual_seed(0)
    decoder = Decoder(layers=4, width=128, code_length=0, skip=2, narrow=False).requires_grad_(False)
    for layer in decoder.hidden:
        layer.weight.mul_(6.0)
    field = decoder.at(torch.zeros(0))
    middle, half = (vectors.float() for vectors in segments(1000, 2e-7))
    low, high = field_bounds(field)(middle, half)
    values = field(middle)
    assert values.abs().max() > 10 and ((low <= values) & (values <= high)).all()


def test_too_few_segments_are_out_of_steps():
    rendering = replace(RENDERER, most_segments=3).render(network(0), from_all_sides(50))
    assert (rendering.status == Status.OUT_OF_STEPS).any() and rendering.distance.isfinite().all()
