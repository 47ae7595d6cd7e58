"""Coarse evaluations: what a renderer that marches on them may miss, their cost, and those of a network."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from bench.config import load
from bench.machine.limits import LimitReached, Limits
from renderers.boundary import render_checked
from renderers.camera import Rays
from renderers.field import Coarse, Counts, Field, Kind, Meter, Wrapper, coarse_version, points_in_sphere
from renderers.fields import mlp
from renderers.fields.analytic import Shape, box, capsule, plane, sphere, torus
from renderers.fields.mlp import Decoder
from renderers.packed_march import Stop
from renderers.rendering import Status, at_iteration, with_empty_memory
from tests.looped import each
from tests.renderers.test_newton import camera, exact

NEWTON = load("renderer", "newton")
MARCHES = {"newton": NEWTON, **{name: load("renderer", f"{name}_coarse") for name in ("dist", "idr")}}
COARSE_ERROR = 2.5e-3  # as of a network of 8 layers of 512; a sixth of a pixel
SHAPES = {"ring": torus(0.5, 0.2), "rod": capsule((-0.5, -0.3, 0.0), (0.5, 0.3, 0.1), 0.1)}
COARSE_ERRORS: dict[str, Callable[[Tensor], Tensor]] = {
    "too large": lambda points: torch.full_like(points[..., 0], COARSE_ERROR),
    "too small": lambda points: torch.full_like(points[..., 0], -COARSE_ERROR),
    "rippled": lambda points: COARSE_ERROR * (200.0 * points.sum(-1)).sin(),
    "not a number": lambda points: torch.where(points[..., 0] > 0, torch.nan, 0.0),
    "infinite": lambda points: torch.where(points[..., 0] > 0, torch.inf, 0.0),
}


@dataclass(frozen=True)
class WithCoarse(Wrapper):
    """A shape with coarse values, which differ from its values by `off`."""

    inner: Field
    off: Callable[[Tensor], Tensor]

    def __call__(self, points: Tensor) -> Tensor:
        return self.inner(points)

    @property
    def coarse(self) -> Coarse:
        """The coarse values."""
        return Coarse(lambda points: self.inner(points) + self.off(points), COARSE_ERROR)


@each("name", ["dist", "idr"])
def test_a_hit_is_confirmed_by_the_field_also_if_its_threshold_exceeds_the_coarse_error(name):
    renderer = replace(MARCHES[name], epsilon=2 * COARSE_ERROR)
    with torch.no_grad():
        rendering = renderer.render(WithCoarse(SHAPES["ring"], COARSE_ERRORS["too small"]), camera().rays())
    assert rendering.residual[rendering.hit].abs().max() < 2 * COARSE_ERROR


@each("name", MARCHES)
def test_coarse_values_may_be_of_another_type(name):
    class Single(WithCoarse):
        @property
        def coarse(self) -> Coarse:
            return Coarse(lambda points: self.inner(points.float()), COARSE_ERROR)

    rays = camera().rays()
    doubled = Rays(rays.origins.double(), rays.directions.double())
    with torch.no_grad():
        assert MARCHES[name].render(Single(SHAPES["ring"], COARSE_ERRORS["too large"]), doubled).hit.any()


@each("off", COARSE_ERRORS.values())
@each("shape", SHAPES.values())
# Without coarse values the median of Newton's is 5e-7: its last steps are longer.
@each("name, median, most", [("newton", 5e-6, 2e-4), ("dist", 2e-5, 8e-4), ("idr", 3e-5, 8e-4)])
def test_errors_of_coarse_values_do_not_move_hits(shape, off, name, median, most):
    truth = exact(shape)
    with torch.no_grad():
        rendering = MARCHES[name].render(WithCoarse(shape, off), camera().rays())
    error = (rendering.distance - truth.distance)[truth.hit & rendering.hit].abs()
    assert int((truth.hit ^ rendering.hit).sum()) <= 2 and error.median() < median
    assert error.quantile(0.99) < most


@each("shape", SHAPES.values())
@each("name, share, more, gradients", [("newton", 0.6, 1.0, 2), ("dist", 0.5, 1.1, 0), ("idr", 0.35, 1.1, 0)])
def test_the_field_is_evaluated_only_near_the_surface(shape, name, share, more, gradients):
    meter, plain = Meter(WithCoarse(shape, COARSE_ERRORS["rippled"])), Meter(shape)
    with torch.no_grad():
        hits = int(render_checked(MARCHES[name], meter, camera().rays()).hit.sum())
        render_checked(MARCHES[name], plain, camera().rays())
    assert meter.counts.value < share * plain.counts.value
    assert min(gradients, 1) * hits <= meter.counts.gradient <= gradients * hits
    assert meter.counts.coarse <= more * plain.counts.value


@each("name", [*MARCHES])
def test_a_thin_plate_is_lost_no_more_often_than_without_coarse_values(name):
    """A plate four times as thick as the coarse error, at a slant, in front of a wall."""
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, 0.0, 0.7], [0.0, 0.0, 0.0], [-0.7, 0.0, 0.0]]))
    scene = box((0.5, 0.5, 2 * COARSE_ERROR)).rotate(turn) | plane((0.0, 0.0, -1.0), -0.8)
    truth = exact(scene)

    def lost_hits(field: Field) -> int:
        with torch.no_grad():
            rendering = MARCHES[name].render(field, camera().rays())
        return int((truth.hit & ~(rendering.hit & (rendering.distance < truth.distance + 0.01))).sum())

    assert all(lost_hits(WithCoarse(scene, off)) <= lost_hits(scene) + 1 for off in COARSE_ERRORS.values())


@each("name", [*MARCHES])
@each("x, status", [(0.0, Status.STARTED_INSIDE), (0.602, Status.MISS)])
def test_the_field_decides_whether_a_camera_is_inside_the_shape(x, status, name):
    """The camera looks away from the surface, also from just outside, where coarse values are negative."""
    away = camera().rays()
    origin, direction = (torch.tensor([first, 0.0, 0.0]).expand_as(away.origins) for first in (x, 1.0))
    away = replace(away, origins=origin, directions=direction)
    with torch.no_grad():
        rendering = MARCHES[name].render(WithCoarse(sphere(0.6), COARSE_ERRORS["too small"]), away)
    assert (rendering.status == status).all()


def test_an_optimisation_begins_warm_on_coarse_values_too():
    """A sphere grows, and another sphere enters from the side."""
    rays, warm = camera().rays(), with_empty_memory(NEWTON)
    for iteration in range(8):
        shape = sphere(0.4 + 0.004 * iteration) | sphere(0.2, (1.3 - 0.06 * iteration, 0.0, 0.0))
        meter = Meter(WithCoarse(shape, COARSE_ERRORS["rippled"]))
        rendering = render_checked(at_iteration(warm, iteration), meter, rays)
        cold = load("renderer", "newton", warm=False).render(shape, rays)
        apart = (rendering.distance - cold.distance).abs() > 5e-4
        assert int(((rendering.hit != cold.hit) | (cold.hit & apart)).sum()) <= 2 and meter.counts.coarse > 0


def test_rays_in_doubt_go_on_along_a_bound_without_a_search():
    """Coarse values are NaN for half of the rays. A bound of a twentieth of the distance needs many steps."""
    rod = capsule((-0.5, -0.3, 0.0), (0.5, 0.3, 0.1), 0.02)
    bound = Meter(WithCoarse(Shape(lambda p: 0.05 * rod(p), Kind.BOUND), COARSE_ERRORS["not a number"]))
    with torch.no_grad():
        rendering, truth = NEWTON.render(bound, camera().rays()), exact(rod)
    assert truth.hit.sum() > 20 and torch.equal(rendering.hit, truth.hit)
    assert bound.counts.value < 19.5 * rendering.hit.numel()  # 18.0; 21.7 with a search of those that ran out of steps


@each("shape", SHAPES.values())
def test_the_clearance_of_a_path_is_at_most_the_field_at_its_closest_point(shape):
    rays = camera().rays()
    table, _ = NEWTON.tracer.trace(WithCoarse(shape, COARSE_ERRORS["too large"]), rays)
    left = table.stopped(Stop.LEFT) & table.least.isfinite()
    values = shape(rays.flat().at(table.least_distance))
    assert left.sum() > 1000 and (table.path_clearance <= values + 1e-5)[left].all()


@each("behind", [2.0, 0.06])
@each("name", [*MARCHES])
def test_an_outline_between_coarse_rays_is_exact_per_pixel(behind, name):
    """The edge of a small sphere before a wall, so near that the spacing of coarse rays is below the coarse error."""
    y, x = torch.meshgrid(0.047 + 1e-4 * torch.arange(64), 1e-4 * torch.arange(64), indexing="ij")
    origins = torch.stack([x, y, torch.full_like(x, -2.0)], dim=-1)
    near = Rays(origins, torch.tensor([0.0, 0.0, 1.0]).expand_as(origins), image=True)
    scene = sphere(0.05) | plane((0.0, 0.0, -1.0), -behind)
    with torch.no_grad():
        rendering = MARCHES[name].render(WithCoarse(scene, COARSE_ERRORS["too large"]), near)
    inside = x.square() + y.square() < 0.05**2
    on_sphere = rendering.hit & (rendering.distance < 2.05)
    assert inside.sum() > 1000
    most = 0.02 if name == "newton" else 0.03  # a ring as wide as epsilon has 0.02
    assert (on_sphere ^ inside).sum() <= most * inside.sum()


def test_coarse_evaluations_are_counted_separately_and_limited():
    offering = WithCoarse(sphere(0.5), COARSE_ERRORS["rippled"])
    meter = Meter(Limits(values=200, memory=4).watch(offering, torch.device("cpu")))
    values = coarse_version(meter)
    assert values is not None and values.error == COARSE_ERROR
    values.values(torch.zeros(5, 20, 3))
    assert meter.counts == Counts(coarse=100) and meter.counts - Counts(coarse=30) == Counts(coarse=70)
    with pytest.raises(LimitReached, match="more than 200 field values"):
        values.values(torch.zeros(101, 3))


@pytest.fixture
def wide(monkeypatch) -> Decoder:
    """A network that has coarse values on any machine, also where they are slower."""
    monkeypatch.setattr(mlp, "bfloat16_is_faster", lambda device: True)
    torch.manual_seed(0)
    return Decoder(layers=4, width=256, code_length=8, skip=2, narrow=True).requires_grad_(False)


def test_bfloat16_is_used_only_if_its_product_is_faster(monkeypatch):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True}, raising=False)
    for seconds in (0.5, 2.0):
        product_seconds = {torch.float32: 1.0, torch.bfloat16: seconds}
        monkeypatch.setattr(mlp, "_product_seconds", product_seconds.get)
        assert mlp.bfloat16_is_faster.__wrapped__(torch.device("cpu")) is (seconds < 1)


def points(count: int = 3000) -> Tensor:
    return 2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(1)) - 1


def test_the_stated_error_of_coarse_values_is_an_upper_bound(wide):
    for code in (torch.zeros(8), torch.randn(8, generator=torch.Generator().manual_seed(2))):
        field = wide.at(code)
        coarse = coarse_version(field)
        assert coarse is not None
        off = (coarse.values(points()) - field(points())).abs()
        assert 0 < off.max() <= coarse.error
        assert coarse.values(torch.zeros(2, 5, 3)).shape == (2, 5) and coarse.values(torch.zeros(0, 3)).shape == (0,)
        assert off.max() > coarse.error / 10


def test_a_network_with_hardly_a_surface_states_the_error_of_all_its_coarse_values(wide):
    """With few or no values near 0 there is too little to measure."""
    drawn = points_in_sphere(mlp.DRAWN, torch.zeros(()))
    for least in (mlp.NEAR + 0.01, mlp.NEAR - 0.01):
        wide.last.weight.mul_(10.0)
        wide.last.bias.sub_(wide.at(torch.zeros(8))(drawn).min() - least)
        field = wide.at(torch.zeros(8))
        assert (field.coarse.values(drawn).abs() <= mlp.NEAR_SURFACE_VALUE).sum() < mlp.MIN_NEAR_SURFACE_POINTS
        off = (field.coarse.values(drawn) - field(drawn)).abs().max()
        assert field.coarse.error == pytest.approx(mlp.COARSE_ERROR_FACTOR * off.item())


def test_the_coarse_error_is_measured_once_for_each_state_of_the_weights(wide, monkeypatch):
    measured = []
    largest = mlp._largest_error
    monkeypatch.setattr(mlp, "_largest_error", lambda *arguments: measured.append(1) or largest(*arguments))
    for code in torch.eye(8)[:3]:
        assert wide.at(code).coarse
    assert len(measured) == 1
    wide.last.weight.mul_(2.0)
    assert wide.at(torch.zeros(8)).coarse and len(measured) == 2


def test_coarse_values_are_the_same_without_private_names_of_torch(wide, monkeypatch):
    packed = wide.at(torch.zeros(8)).coarse.values(points())
    monkeypatch.setattr(torch.ops, "mkldnn", object())
    plain = wide.at(torch.zeros(8)).coarse.values(points())
    assert (packed - plain).abs().max() < 0.3 * wide.at(torch.zeros(8)).coarse.error


def test_networks_that_are_narrow_batched_double_or_trained_have_no_coarse_values(wide, monkeypatch):
    code = torch.zeros(8)
    narrow = Decoder(layers=4, width=128, code_length=8, skip=2, narrow=False).requires_grad_(False)
    assert narrow.at(code).coarse is None and wide.at(torch.zeros(2, 8)).coarse is None
    assert wide.double().at(code.double()).coarse is None
    wide.float()
    wide.last.weight.requires_grad_(True)
    assert wide.at(code).coarse is None
    wide.requires_grad_(False)
    monkeypatch.setattr(mlp, "bfloat16_is_faster", lambda device: False)
    assert wide.at(code).coarse is None


@each("name", [*MARCHES])
def test_coarse_values_do_not_change_the_gradient_of_a_network(wide, name):
    """Hits and their gradient with respect to the code are compared with and without coarse values."""
    from bench.shape_prior import initialise_to_sphere

    initialise_to_sphere(wide, radius=0.5)
    codes = [torch.zeros(8, requires_grad=True) for _ in range(2)]
    coarse, plain = (
        replace(MARCHES[name], coarse=use).render(wide.at(code), camera().rays())
        for use, code in zip((True, False), codes, strict=True)
    )
    both = coarse.hit & plain.hit
    assert both.any() and int((plain.hit & ~coarse.hit).sum()) <= 1
    assert (coarse.distance - plain.distance)[both].abs().median() < (1e-6 if name == "newton" else 2e-5)
    coarse_gradient, plain_gradient = (
        torch.autograd.grad(rendering.distance[both].sum(), code)[0]
        for rendering, code in zip((coarse, plain), codes, strict=True)
    )
    assert (coarse_gradient - plain_gradient).norm() < 0.01 * plain_gradient.norm()
