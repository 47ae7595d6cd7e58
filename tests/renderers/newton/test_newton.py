"""Hits, gradients and evaluations of Newton, also in cases that the march alone would get wrong."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from torch import Tensor

from bench.config import load
from renderers.camera import Camera, Rays, sphere_span
from renderers.field import Kind, Meter
from renderers.fields.analytic import Shape, box, capsule, plane, sphere, torus
from renderers.newton.packed_march import CLEARANCE_THRESHOLD, MAX_OVERSTEP, RayTable, Stop, Stride, march_table
from renderers.newton.tracer import SLOPE_PAIR_COUNT
from renderers.rendering import Rendering, Status
from tests.looped import each
from tests.renderers.analytic_cases import beam, sheet
from tests.tiny import camera_of

NEWTON, DIST = load("renderer", "newton"), load("renderer", "dist")
STEADY = replace(DIST, epsilon=1e-12, alpha=1.0, extra_step_cap=None, coarse_to_fine=False, steps=2000)
SHAPES = {
    "ball": sphere(0.6),
    "ring": torus(0.5, 0.2),
    "brick": box((0.5, 0.4, 0.3)),
    "rod": capsule((-0.5, -0.3, 0.0), (0.5, 0.3, 0.1), 0.1),
}
by_shape = each("shape", list(SHAPES.values()))


def camera(size: int = 64) -> Camera:
    """The unit sphere from 2.5 away."""
    return camera_of(size, angles=(30.0, 25.0))


@cache
def exact(shape: Shape, size: int = 64) -> Rendering:
    """The rendering of DIST in float64 with plain steps: its hits are as exact as the field."""
    return STEADY.render(shape, camera(size).double().rays())


@by_shape
def test_hits_are_exact_and_cost_no_more_evaluations_than_those_of_dist(shape):
    truth, renderings, meters = exact(shape), {}, {}
    for name, renderer in (("newton", NEWTON), ("dist", DIST)):
        meters[name] = Meter(shape)
        with torch.no_grad():
            renderings[name] = renderer.render(meters[name], camera().rays())
    rendering, counts = renderings["newton"], meters["newton"].counts
    both = truth.hit & rendering.hit
    error = (rendering.distance - truth.distance)[both].abs()
    hits = int(truth.hit.sum())
    assert int((truth.hit ^ rendering.hit).sum()) <= max(1, int((truth.hit ^ renderings["dist"].hit).sum()))
    assert error.median() < 5e-7  # the precision of float32 at distances near 2
    assert error.quantile(0.99) < 2e-4 and hits <= counts.gradient <= 1.25 * hits
    assert counts.value <= 1.05 * (meters["dist"].counts.value + counts.gradient)


def test_a_ray_that_passes_an_edge_by_less_than_near_hits_what_is_behind():
    ball_and_wall = sphere(0.3, (0.0, 0.0, -0.3)) | plane((0, 0, -1), -0.4)
    offsets = [0.3 + NEWTON.march_epsilon * share for share in (0.05, 0.2, 0.5, 0.9)]
    rays = beam(*((x, 0.0, -2.0) for x in offsets))
    rendering = NEWTON.render(ball_and_wall, rays)
    assert rendering.hit.all() and rendering.distance.tolist() == pytest.approx([2.4] * 4, abs=1e-6)


def test_a_ray_that_passes_a_surface_by_less_than_near_does_not_hit_it():
    rays = beam(*((0.5 + NEWTON.march_epsilon * share, 0.0, -2.0) for share in (0.05, 0.2, 0.5, 0.9)))
    rendering = NEWTON.render(sphere(0.5), rays)
    assert (rendering.status == Status.MISS).all() and (rendering.closest > 0).all()


def test_the_dense_search_hits_at_a_grazing_angle():
    ground, angle = plane((0, 1, 0), 0.0), torch.tensor(2.0, dtype=torch.float64).deg2rad()
    direction = torch.stack([angle.cos(), -angle.sin(), torch.zeros_like(angle)])
    rays = Rays((-0.9 * direction)[None], direction[None])
    without = replace(NEWTON, steps=300).render(ground, rays)
    meter = Meter(ground)
    rendering = replace(NEWTON, steps=6).render(meter, rays)
    assert rendering.hit.all() and without.hit.all()
    assert rendering.distance.item() == pytest.approx(0.9, abs=1e-6)
    searched = 2 * NEWTON.search_samples + NEWTON.search_steps
    assert meter.counts.value <= 2 * SLOPE_PAIR_COUNT + 6 + searched + NEWTON.newton_steps


def test_a_sheet_between_two_samples_is_hit_near_the_least_sample():
    sheet = box((0.9, 0.9, 0.004)) | plane((0, 0, -1), -0.9)
    tilted = sheet.rotate(torch.linalg.matrix_exp(torch.tensor([[0, 0, 0.6], [0, 0, 0], [-0.6, 0, 0]]).double()))
    rays = beam((0.01, 0.0, -0.99), (0.05, 0.1, -0.98), (-0.07, 0.1, -0.98))
    searching = replace(NEWTON, steps=1)
    truth = STEADY.render(tilted, rays)
    rendering = searching.render(tilted, rays)
    assert truth.hit.all()
    torch.testing.assert_close(rendering.distance, truth.distance, rtol=0, atol=1e-6)


WRONG_FIELDS = {  # fields with the zero set of a distance d, and the most evaluations per ray
    "weak": (lambda d: 0.25 * d, 18),
    "strong": (lambda d: 1.5 * d, 4.5),
    "far too strong": (lambda d: 20 * d, 4.5),
    "saturated": (lambda d: torch.tanh(d / 0.2), 4.5),
}


@each("share", [0.3, 0.45])
def test_the_search_brackets_a_plate_between_samples_if_values_are_below_half_their_spacing(share):
    rays, number = beam((0.0, 0.0, -2.0)), torch.tensor([0])
    spacing = 2 / (NEWTON.search_samples - 1)
    middle = -1 + 7.5 * spacing
    plate = Shape(lambda p: (p[..., 2] - middle).abs() - (0.5 - share) * spacing, Kind.DISTANCE, 1.0)
    crossing, bracket = NEWTON._search(plate, rays, RayTable.on_sphere(rays, 1.0), number)
    assert crossing.tolist() == [0]
    front = 2 + middle - (0.5 - share) * spacing
    assert bracket.near.item() < front < bracket.far.item() < front + spacing / 8


@each("change, most", WRONG_FIELDS.values())
def test_values_that_are_wrong_by_a_factor_lose_few_hits(change, most):
    ring = SHAPES["ring"]
    truth, wrong = exact(ring), Meter(Shape(lambda p: change(ring(p))))
    rendering = NEWTON.render(wrong, camera().rays())
    both = truth.hit & rendering.hit
    assert (truth.hit ^ rendering.hit).sum() <= 0.01 * truth.hit.sum()
    assert (rendering.distance - truth.distance)[both].abs().quantile(0.9) < 1e-5
    assert wrong.counts.value <= most * truth.hit.numel()


@each("share, most", [(0.5, 24), (0.2, 50)])
def test_a_bound_that_is_a_fraction_of_the_distance_needs_no_search(share, most):
    """All rays hit the plate. A march that ran out of steps would sample the rest of the ray."""
    plate, generator = box((0.5, 0.5, 0.01)), torch.Generator().manual_seed(0)
    origins = torch.nn.functional.normalize(torch.randn(6000, 3, generator=generator), dim=-1)
    targets = torch.rand(6000, 3, generator=generator) - 0.5
    rays = Rays(origins, torch.nn.functional.normalize(targets * torch.tensor([0.9, 0.9, 0.0]) - origins, dim=-1))
    bound = Meter(Shape(lambda p: share * plate(p), Kind.BOUND))
    rendering = NEWTON.render(bound, rays)
    assert rendering.hit.all() and (rendering.points.abs() - torch.tensor([0.5, 0.5, 0.01])).amax(-1).abs().max() < 3e-4
    assert bound.counts.value <= most * len(origins)


def test_residuals_and_closest_values_of_a_steep_field_are_not_normalised():
    ring, rays = SHAPES["ring"], camera().rays()
    plain, steep = (NEWTON.render(Shape(lambda p, k=times: k * ring(p)), rays) for times in (1, 4))
    missed = ~plain.hit & ~steep.hit & sphere_span(rays)[2] & (plain.closest < 0.1)
    ratio = (steep.closest / plain.closest)[missed]
    assert len(ratio) > 100 and ratio.median().item() == pytest.approx(4.0, rel=0.05)
    inside = Rays(torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]]))
    ball = Shape(lambda p: 4 * SHAPES["ball"](p))
    assert NEWTON.render(ball, inside).residual.item() == pytest.approx(4 * -0.6)


def test_a_field_that_jumps_has_no_hit_and_nan_values_leave_other_rays_alone():
    """The contract has the test of finite renderings."""
    ball = sphere(0.5)
    jump = Shape(lambda p: 0 * ball(p) + torch.where(ball(p) > 0, 0.2, -0.2), Kind.BOUND)
    rays = beam((0.2, 0.0, -2.0), (-0.2, 0.0, -2.0))
    assert (NEWTON.render(jump, rays).status == Status.OUT_OF_STEPS).all()
    half = Shape(lambda p: torch.where(p[..., 0] > 0, ball(p), torch.nan), Kind.BOUND)
    assert NEWTON.render(half, rays).status.tolist() == [Status.HIT, Status.OUT_OF_STEPS]


def test_the_silhouette_loss_evaluates_only_missed_rays():
    rays, radius = camera(24).rays(), torch.tensor(0.6, requires_grad=True)
    meter = Meter(sphere(radius))
    rendering = NEWTON.render(meter, rays)
    for other, missed, sign in ((0.6, False, 0), (0.7, True, -1), (0.5, False, 1)):
        mask = exact(sphere(other), 24).hit
        before = meter.counts.value
        loss = NEWTON.silhouette_loss(meter, rays, rendering, mask)
        assert meter.counts.value - before == int((mask & ~rendering.hit).sum())
        assert bool((mask & ~rendering.hit).any()) == missed
        if sign:
            (gradient,) = torch.autograd.grad(loss, radius, retain_graph=True)
            assert gradient.item() == pytest.approx(sign)  # the mean over rays that violate the mask


def converging() -> Rays:
    """An image of rays that meet just before the end of the unit sphere."""
    origins = sheet(*[torch.linspace(-0.8, 0.8, 16, dtype=torch.float64)] * 2).origins
    focus = torch.tensor([0.0, 0.0, 0.98], dtype=torch.float64)
    return Rays(origins, torch.nn.functional.normalize(focus - origins, dim=-1), image=True)


CENTRES = torch.tensor([[-0.1, 0.1, -0.6], [0.2, -0.2, -0.5], [0.05, 0.0, -0.45], [-0.2, -0.25, -0.65]]).double()
IMAGES = [
    *((replace(NEWTON, steps=steps), sphere(0.6), camera(48).rays()) for steps in (1, 7)),
    *((replace(NEWTON, unseen=unseen), shape, camera(48).rays()) for unseen in (NEWTON.unseen, 1e-4)
      for shape in (sphere(0.995), plane((0, 0, 1), -0.9), plane((0, 0, 1), -0.95))),
    *((NEWTON, sphere(0.05, centre), converging()) for centre in CENTRES.tolist()),
]  # fmt: skip


@each("renderer, shape, rays", IMAGES)
def test_an_image_has_the_hits_of_its_rays_each_alone(renderer, shape, rays):
    """With few steps, near the bounding sphere, and with converging rays."""
    together, alone = renderer.render(shape, rays), renderer.render(shape, rays.flat())
    truth = STEADY.render(shape, Rays(rays.origins.double(), rays.directions.double()))
    allowed = int(renderer.steps < NEWTON.steps)
    assert truth.hit.sum() > 1 and int((together.hit.flatten() ^ alone.hit).sum()) <= allowed
    assert int((truth.hit & ~together.hit).sum()) <= allowed
    assert not ((together.status == Status.MISS) & (together.closest < 0)).any()


@by_shape
def test_the_field_is_large_up_to_the_restart_distance(shape):
    rays = camera().rays()
    table, _ = NEWTON.trace(shape, rays)
    assert ((table.restart_distance >= table.entry) & (table.restart_distance <= table.leave)).all()
    assert (table.restart_distance > table.entry).sum() > 300
    shares = torch.linspace(0, 1, 100)
    before = rays.flat().at_each(table.entry[:, None] + shares * (table.restart_distance - table.entry)[:, None])
    assert shape(before).min() > CLEARANCE_THRESHOLD - 0.01


def marched(*values: float) -> RayTable:
    """The state of a ray that begins in the centre of the sphere and evaluates to these values."""
    rays, remaining = beam((0.0, 0.0, 0.0)), iter(values)
    table, stride = RayTable.on_sphere(rays, 1.0), NEWTON.stride()
    march_table(lambda points: points.new_full(points.shape[:-1], next(remaining)), rays, table, stride, len(values))
    return table


def advance(table: RayTable, value: float, stride: Stride) -> None:
    """Moves a ray that begins in the centre of the sphere by one step, with this value."""
    march_table(lambda points: points.new_full((1,), value), beam((0.0, 0.0, 0.0)), table, stride, 1)


def test_a_ray_leaves_if_its_empty_sphere_reaches_the_end_of_its_span():
    assert marched(0.4, 0.58).stopped(Stop.MARCHING).item()  # at 0.4025: the step would end behind the span
    assert marched(0.4, 0.6).stopped(Stop.LEFT).item()
    taken_back = marched(0.4, 0.58, 0.005)
    assert taken_back.stopped(Stop.MARCHING).item()
    assert taken_back.distance.item() == pytest.approx(0.4025 + 0.58)
    assert marched(-NEWTON.march_epsilon / 2).stopped(Stop.INSIDE).item()  # however close to the surface


def test_a_finer_ray_begins_at_the_end_of_the_empty_spheres_of_its_coarse_ray():
    parent, apart, fine = torch.tensor([0]), torch.tensor([0.03]).double(), beam((0.03, 0.0, 0.0))
    for values, end in [((0.4, -0.1), 0.4), ((0.4, 5e-5), 0.4025), ((0.4, 0.2), 0.6025)]:
        table = marched(*values)
        finer = table.split(parent, apart, RayTable.on_sphere(fine, 1.0), error=0.002)
        assert finer.distance.item() == pytest.approx(end - 0.03 - 0.002)
    passed = marched(0.4, 0.62).split(parent, apart, RayTable.on_sphere(fine, 1.0), error=0.002)
    assert passed.distance.item() < 1.0 and passed.stopped(Stop.MARCHING).item()
    passed = marched(0.4, 0.7).split(parent, apart, RayTable.on_sphere(fine, 1.0), error=0.002)
    assert passed.stopped(Stop.LEFT).item()


def test_a_step_whose_empty_spheres_do_not_meet_is_taken_back():
    table = RayTable.on_sphere(beam((0.0, 0.0, 0.0)), 1.0)
    advance(table, 0.4, Stride(1e-3, 0.005))
    assert table.distance.item() == pytest.approx(0.4025)  # (2 0.4 + 0.005) / (1 + 1)
    advance(table, 0.2, Stride(1e-3, 0.005))
    assert table.distance.item() == pytest.approx(0.4025 + 0.2 + MAX_OVERSTEP)
    free, free_value = table.free.item(), table.free_value.item()
    advance(table, 0.005, Stride(1e-3, 0.005))  # MAX_OVERSTEP - 0.005 is more than 1.5 0.005
    assert table.distance.item() == pytest.approx(0.4025 + 0.2)
    assert (table.free.item(), table.free_value.item()) == (free, free_value)
    advance(table, 0.1, Stride(1e-3, 0.005))
    slope = 0.1 / 0.2
    assert table.distance.item() == pytest.approx(0.6025 + min(0.205 / (1 + slope), 0.1 + MAX_OVERSTEP))


@each("thickness", [0.008, 0.02])
def test_a_step_into_a_wall_does_not_pass_the_plate_before_it(thickness):
    """Rays over a floor take long steps towards a plate with a wall behind it."""
    for index in range(0, 12, 3):
        front = 0.1 + 0.007 * index
        plate = box((0.5, 0.5, thickness / 2)).translate((0.0, 0.0, front + thickness / 2))
        scene = plane((0, 1, 0), 0.0) | plate | plane((0, 0, -1), -(front + thickness + 0.005))
        rendering = replace(NEWTON, steps=200).render(scene, beam(*((0.0, 0.03 + x / 400, -2.0) for x in range(20))))
        torch.testing.assert_close(rendering.distance, torch.full((20,), 2.0 + front).double(), rtol=0, atol=1e-6)


@each("pitch", [0.001, 0.008])
def test_finer_rays_do_not_pass_a_plate_that_their_coarse_ray_missed(pitch):
    x = pitch * torch.arange(32).double()
    rays = sheet(x, 0.03 + x)
    for index in range(0, 8, 2):
        front = 0.0137 * 5 * index - 0.4
        plate = box((0.5, 0.5, 0.006)).translate((0.0, 0.0, front + 0.006))
        rendering = replace(NEWTON, steps=200).render(plane((0, 1, 0), 0.0) | plate | plane((0, 0, -1), -0.6), rays)
        assert (rendering.distance - 2.0 - front).abs().max() < 1e-6


@each("half_side", [0.02, 0.05, 0.2])
def test_rays_that_cut_an_edge_closely_hit_it(half_side):
    """The chord of a ray at the depth d behind the edge is 2.08 d."""
    turned = torch.tensor([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]], dtype=torch.float64)
    edge, shape = 1.4 * half_side, box((half_side, half_side, half_side)).rotate(turned)
    rays = beam(*((edge - depth, 0.0, -2.0 - x / 977) for x in range(20) for depth in (0.0005, 0.0007, 0.001)))
    assert NEWTON.render(shape, rays).hit.all()


def test_the_tip_of_a_cone_is_hit_and_spoils_no_gradient():
    height = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)

    def cone(points: Tensor) -> Tensor:
        return 0.6 * points[..., :2].square().sum(-1).sqrt() + 0.8 * (-points[..., 2] - height)

    rays = beam((0.0, 0.0, -2.0), (0.1, 0.0, -2.0), (0.0, 0.2, -2.0))
    rendering = NEWTON.render(Shape(cone, Kind.BOUND), rays)
    assert rendering.hit.all() and rendering.distance.tolist() == pytest.approx([1.7, 1.775, 1.85], abs=1e-6)
    (gradient,) = torch.autograd.grad(rendering.distance[1:].sum(), height)
    assert gradient.item() == pytest.approx(-2.0)
