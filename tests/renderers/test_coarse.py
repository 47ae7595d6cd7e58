"""Coarse values: what a renderer that marches on them may miss, what they cost, and those of a network."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from bench.config import load
from bench.machine.limits import LimitReached, Limits
from renderers.boundary import render_checked
from renderers.camera import Rays
from renderers.field import Coarse, Counts, Field, Meter, Wrapper, coarse_version, points_in_sphere
from renderers.fields import mlp
from renderers.fields.analytic import box, capsule, plane, sphere, torus
from renderers.fields.mlp import Decoder
from renderers.rendering import Status, at_iteration, with_empty_memory
from tests.looped import each
from tests.renderers.analytic_cases import sheet
from tests.renderers.newton.test_newton import camera, exact

NEWTON = load("renderer", "newton")
MARCHES = {"newton": NEWTON, **{name: load("renderer", f"{name}_coarse") for name in ("dist", "idr")}}
ERROR = 2.5e-3  # of the coarse values below, as of a network of 8 layers of 512; a sixth of a pixel
SHAPES = {"ring": torus(0.5, 0.2), "rod": capsule((-0.5, -0.3, 0.0), (0.5, 0.3, 0.1), 0.1)}
ERRORS: dict[str, Callable[[Tensor], Tensor]] = {
    "too large": lambda points: torch.full_like(points[..., 0], ERROR),
    "too small": lambda points: torch.full_like(points[..., 0], -ERROR),
    "rippled": lambda points: ERROR * (200.0 * points.sum(-1)).sin(),
    "not a number": lambda points: torch.where(points[..., 0] > 0, torch.nan, 0.0),
    "infinite": lambda points: torch.where(points[..., 0] > 0, torch.inf, 0.0),
}


@dataclass(frozen=True)
class Offering(Wrapper):
    """A shape that offers coarse values, which are off as `off` says."""

    inner: Field
    off: Callable[[Tensor], Tensor]

    def __call__(self, points: Tensor) -> Tensor:
        return self.inner(points)

    @property
    def coarse(self) -> Coarse:
        """The coarse values."""
        return Coarse(lambda points: self.inner(points) + self.off(points), ERROR)


@each("name", MARCHES)
def test_coarse_values_may_be_of_another_type(name):
    class Single(Offering):
        @property
        def coarse(self) -> Coarse:
            return Coarse(lambda points: self.inner(points.float()), ERROR)

    rays = camera().rays()
    doubled = Rays(rays.origins.double(), rays.directions.double())
    with torch.no_grad():
        assert MARCHES[name].render(Single(SHAPES["ring"], ERRORS["too large"]), doubled).hit.any()


@each("off", ERRORS.values())
@each("shape", SHAPES.values())
# Without coarse values the median of Newton's is 5e-7: its last steps are longer.
@each("name, median, most", [("newton", 5e-6, 2e-4), ("dist", 2e-5, 8e-4), ("idr", 3e-5, 8e-4)])
def test_a_surface_is_found_where_it_is_whatever_coarse_values_say(shape, off, name, median, most):
    truth = exact(shape)
    with torch.no_grad():
        rendering = MARCHES[name].render(Offering(shape, off), camera().rays())
    error = (rendering.distance - truth.distance)[truth.hit & rendering.hit].abs()
    assert int((truth.hit ^ rendering.hit).sum()) <= 2
    assert error.median() < median
    assert error.quantile(0.99) < most


@each("shape", SHAPES.values())
@each("name, share, more, gradients", [("newton", 0.6, 1.0, 2), ("dist", 0.5, 1.1, 0), ("idr", 0.35, 1.1, 0)])
def test_the_field_is_asked_near_the_surface_alone(shape, name, share, more, gradients):
    meter, plain = Meter(Offering(shape, ERRORS["rippled"])), Meter(shape)
    with torch.no_grad():
        hits = int(render_checked(MARCHES[name], meter, camera().rays()).hit.sum())
        render_checked(MARCHES[name], plain, camera().rays())
    assert meter.counts.value < share * plain.counts.value
    assert min(gradients, 1) * hits <= meter.counts.gradient <= gradients * hits
    assert meter.counts.coarse <= more * plain.counts.value


@each("name", [*MARCHES])
def test_a_thin_plate_is_lost_no_more_often_than_without_coarse_values(name):
    """A plate of four times the error of the values, seen at a slant, in front of a wall."""
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, 0.0, 0.7], [0.0, 0.0, 0.0], [-0.7, 0.0, 0.0]]))
    scene = box((0.5, 0.5, 2 * ERROR)).rotate(turn) | plane((0.0, 0.0, -1.0), -0.8)
    truth = exact(scene)

    def lost(field: Field) -> int:
        with torch.no_grad():
            rendering = MARCHES[name].render(field, camera().rays())
        return int((truth.hit & ~(rendering.hit & (rendering.distance < truth.distance + 0.01))).sum())

    assert all(lost(Offering(scene, off)) <= lost(scene) + 1 for off in ERRORS.values())


@each("name", [*MARCHES])
@each("x, status", [(0.0, Status.STARTED_INSIDE), (0.602, Status.MISS)])
def test_the_field_decides_whether_a_camera_is_inside_the_shape(x, status, name):
    """Beside the surface, where coarse values say that it is inside, it looks away."""
    away = camera().rays()
    origins, directions = (torch.tensor([offset, 0.0, 0.0]).expand_as(away.origins) for offset in (x, 1.0))
    away = replace(away, origins=origins, directions=directions)
    with torch.no_grad():
        rendering = MARCHES[name].render(Offering(sphere(0.6), ERRORS["too small"]), away)
    assert (rendering.status == status).all()


def test_an_optimisation_begins_warm_on_coarse_values_too():
    """A ball grows, and another one enters from the side."""
    rays, warm = camera().rays(), with_empty_memory(NEWTON)
    for iteration in range(8):
        shape = sphere(0.4 + 0.004 * iteration) | sphere(0.2, (1.3 - 0.06 * iteration, 0.0, 0.0))
        meter = Meter(Offering(shape, ERRORS["rippled"]))
        rendering = render_checked(at_iteration(warm, iteration), meter, rays)
        cold = load("renderer", "newton", warm=False).render(shape, rays)
        apart = (rendering.distance - cold.distance).abs() > 5e-4
        assert int(((rendering.hit != cold.hit) | (cold.hit & apart)).sum()) <= 2
        assert meter.counts.coarse > 0


@each("behind", [2.0, 0.06])
@each("name", [*MARCHES])
def test_what_a_coarse_ray_passed_is_decided_for_its_pixels_too(behind, name):
    """The edge of a small ball, before a wall, so near that coarse rays lie closer than coarse values are exact."""
    near = sheet(1e-4 * torch.arange(64), 0.047 + 1e-4 * torch.arange(64))
    scene = sphere(0.05) | plane((0.0, 0.0, -1.0), -behind)
    with torch.no_grad():
        rendering = MARCHES[name].render(Offering(scene, ERRORS["too large"]), near)
    inside = near.origins[..., :2].norm(dim=-1) < 0.05
    on_ball = rendering.hit & (rendering.distance < 2.05)
    assert inside.sum() > 1000
    assert (on_ball ^ inside).sum() <= (0.02 if name == "newton" else 0.03) * inside.sum()  # a ring of epsilon has 0.02


def test_coarse_values_are_counted_apart_and_limited():
    offering = Offering(sphere(0.5), ERRORS["rippled"])
    meter = Meter(Limits(values=200, memory=4).watch(offering, torch.device("cpu")))
    values = coarse_version(meter)
    assert values is not None and values.error == ERROR
    values.values(torch.zeros(5, 20, 3))
    assert meter.counts == Counts(coarse=100)
    assert meter.counts - Counts(coarse=30) == Counts(coarse=70)
    with pytest.raises(LimitReached, match="more than 200 field values"):
        values.values(torch.zeros(101, 3))


@pytest.fixture
def wide(monkeypatch) -> Decoder:
    """A network that offers coarse values on any machine, slowly where they do not pay."""
    monkeypatch.setattr(mlp, "bfloat16_is_faster", lambda device: True)
    monkeypatch.setattr(mlp, "ERROR_SAMPLE_POINTS", 2**11)  # an eighth of both, for speed
    monkeypatch.setattr(mlp, "MIN_NEAR_SURFACE_POINTS", 12)
    torch.manual_seed(0)
    return Decoder(layers=4, width=256, code_length=8, skip=2, narrow=True).requires_grad_(False)


def test_instructions_that_take_more_time_do_not_pay(monkeypatch):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True}, raising=False)
    for seconds in (0.5, 2.0):
        taken = {torch.float32: 1.0, torch.bfloat16: seconds}
        monkeypatch.setattr(mlp, "_product_seconds", taken.get)
        assert mlp.bfloat16_is_faster.__wrapped__(torch.device("cpu")) is (seconds < 1)


def points(count: int = 3000) -> Tensor:
    return 2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(1)) - 1


def test_the_coarse_values_of_a_network_are_off_by_no_more_than_they_say(wide):
    for code in (torch.zeros(8), torch.randn(8, generator=torch.Generator().manual_seed(2))):
        field = wide.at(code)
        coarse = coarse_version(field)
        assert coarse is not None
        off = (coarse.values(points()) - field(points())).abs()
        assert 0 < off.max() <= coarse.error
        assert coarse.values(torch.zeros(2, 5, 3)).shape == (2, 5) and coarse.values(torch.zeros(0, 3)).shape == (0,)
        assert off.max() > coarse.error / 10


def test_a_network_with_hardly_a_surface_states_the_error_of_all_its_coarse_values(wide):
    """Of no value that is near 0, or of few of them, nothing could be measured."""
    drawn = points_in_sphere(mlp.ERROR_SAMPLE_POINTS, torch.zeros(()))
    for least in (mlp.NEAR_SURFACE_VALUE + 0.01, mlp.NEAR_SURFACE_VALUE - 0.01):
        wide.last.weight.mul_(10.0)
        wide.last.bias.sub_(wide.at(torch.zeros(8))(drawn).min() - least)
        field = wide.at(torch.zeros(8))
        assert (field.coarse.values(drawn).abs() <= mlp.NEAR_SURFACE_VALUE).sum() < mlp.MIN_NEAR_SURFACE_POINTS
        off = (field.coarse.values(drawn) - field(drawn)).abs().max()
        assert field.coarse.error == pytest.approx(mlp.COARSE_ERROR_FACTOR * off.item())


def test_their_error_is_measured_once_for_each_state_of_the_weights(wide, monkeypatch):
    measured = []
    largest = mlp._largest_error
    monkeypatch.setattr(mlp, "_largest_error", lambda *arguments: measured.append(1) or largest(*arguments))
    for code in torch.eye(8)[:3]:
        assert wide.at(code).coarse
    assert len(measured) == 1
    wide.last.weight.mul_(2.0)
    assert wide.at(torch.zeros(8)).coarse
    assert len(measured) == 2


def test_without_the_private_names_of_torch_they_are_the_same(wide, monkeypatch):
    packed = wide.at(torch.zeros(8)).coarse.values(points())
    monkeypatch.setattr(torch.ops, "mkldnn", object())
    plain = wide.at(torch.zeros(8)).coarse.values(points())
    assert (packed - plain).abs().max() < 0.3 * wide.at(torch.zeros(8)).coarse.error


def test_what_does_not_pay_or_changes_offers_none(wide, monkeypatch):
    code = torch.zeros(8)
    narrow = Decoder(layers=4, width=128, code_length=8, skip=2, narrow=False).requires_grad_(False)
    assert narrow.at(code).coarse is None
    assert wide.at(torch.zeros(2, 8)).coarse is None
    assert wide.double().at(code.double()).coarse is None
    wide.float()
    wide.last.weight.requires_grad_(True)
    assert wide.at(code).coarse is None
    wide.requires_grad_(False)
    monkeypatch.setattr(mlp, "bfloat16_is_faster", lambda device: False)
    assert wide.at(code).coarse is None


@each("name", [*MARCHES])
def test_the_gradient_of_a_network_is_that_of_its_field(wide, name):
    """A network near a ball's distance: with coarse values and without, hits and their gradient towards the code."""
    from bench.shape_prior import initialise_to_sphere

    initialise_to_sphere(wide, radius=0.5)
    codes = [torch.zeros(8, requires_grad=True) for _ in range(2)]
    coarse, plain = (
        replace(MARCHES[name], coarse=use).render(wide.at(code), camera(24).rays())
        for use, code in zip((True, False), codes, strict=True)
    )
    both = coarse.hit & plain.hit
    assert both.any()
    assert int((plain.hit & ~coarse.hit).sum()) <= 1
    assert (coarse.distance - plain.distance)[both].abs().median() < (1e-6 if name == "newton" else 2e-5)
    first, second = (
        torch.autograd.grad(rendering.distance[both].sum(), code)[0]
        for rendering, code in zip((coarse, plain), codes, strict=True)
    )
    assert (first - second).norm() < 0.01 * second.norm()
