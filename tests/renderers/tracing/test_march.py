"""The stepping loops: evaluations, steps and statuses counted by hand, and the kept samples."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bench.config import load
from renderers.camera import Rays
from renderers.field import Kind, Meter
from renderers.fields.analytic import Shape, capsule, plane, sphere, torus
from renderers.rendering import Status
from renderers.tracing.march import RayFront, Stepping, march_coarse_to_fine, march_front, ray_pyramid
from tests.looped import each
from tests.renderers.analytic_cases import beam, sheet, sphere_hits, vector
from tests.tiny import camera_of

PLAIN = Stepping(epsilon=5e-5)
AGGRESSIVE = replace(PLAIN, alpha=1.5)
WALL = plane((0, 0, -1), 0.0)  # solid beyond z = 0: at z the value is -z
NAIVE = load("renderer", "naive")
FINE = load("renderer", "dist", coarse_to_fine=False)
COARSE = replace(FINE, coarse_to_fine=True)


def square(height: int, width: int, *batch: int, pitch: float = 0.0) -> Rays:
    """An image of rays along z, `pitch` apart; with the default pitch all rays run through the centre."""
    x, y = (pitch * (torch.arange(count, dtype=torch.float64) - (count - 1) / 2) for count in (width, height))
    return sheet(x, y, *batch)


def trace(field: Shape, rays: Rays, stepping: Stepping, *, steps: int = 50, samples: int = 1) -> tuple[RayFront, int]:
    """The front and its number of evaluations. An image is marched coarse to fine."""
    meter = Meter(field)
    if rays.image:
        front = march_coarse_to_fine(meter, rays, stepping, steps=steps, radius=1.0, samples=samples)
    else:
        front = RayFront.on_sphere(rays, radius=1.0, samples=samples)
        march_front(meter, rays, front, stepping, steps)
    assert meter.counts.gradient == 0
    return front, meter.counts.value


def constant(value: float) -> Shape:
    return Shape(lambda p: torch.full_like(p[..., 0], value))


HEAD_ON = beam((0, 0, -2))
VIEW = camera_of(64).double().rays()  # an image of the whole unit sphere
UPRIGHT = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # rotates the axis of a torus from y to z


def test_aggressive_steps_halve_the_distance_and_change_side():
    # Values 1, -1/2, 1/4, ...: the first below 5e-5 is 2^-15, the 16th. The last moves without alpha (Eq. 1).
    front, count = trace(WALL, HEAD_ON, AGGRESSIVE, samples=4)
    assert count == 16 and front.distance.item() == 2
    assert front.value.item() == -(2**-15)
    assert front.sample_value.tolist() == [[-(2**-15), 2**-14, -(2**-13), 2**-12]]


@each("alpha, cap, clamp, expected", [
    (1.0, None, None, [1, 0.1, 0, -0.1, -1]), (1.5, None, None, [1.5, 0.15, 0, -0.15, -1.5]),
    (1.5, 0.25, None, [1.25, 0.15, 0, -0.15, -1.25]),
    (1.5, None, 0.125, [0.1875, 0.15, 0, -0.15, -0.1875]),  # the value is clamped, then multiplied
    (1.5, 0.2, 0.5, [0.7, 0.15, 0, -0.15, -0.7]),
])  # fmt: skip
def test_a_step_by_cap_and_clamp(alpha, cap, clamp, expected):
    stepping = replace(PLAIN, alpha=alpha, extra_step_cap=cap, step_clamp=clamp)
    assert stepping.length(vector((1, 0.1, 0, -0.1, -1))).tolist() == pytest.approx(expected)


FOUR_RAYS = beam((0, 0, -2), (0.6, 0, -2), (2, 0, -2), (0, 0, 2))  # head on; in at z = -0.8; two misses


def test_finished_rays_are_evaluated_only_without_active_only():
    active, count = trace(WALL, FOUR_RAYS, PLAIN, steps=20, samples=2)
    assert count == 2 + 2
    all_rays, count = trace(WALL, FOUR_RAYS, replace(PLAIN, active_only=False), steps=20, samples=2)
    assert count == 2 * 20  # rays that miss the sphere are never evaluated
    for name in ("distance", "status", "value", "sample_distance", "sample_value"):
        torch.testing.assert_close(getattr(active, name), getattr(all_rays, name), rtol=0, atol=0)
    assert active.status.tolist() == [Status.HIT, Status.HIT, Status.MISS, Status.MISS]


@each("size, steps, evaluations", [
    ((8, 8), 2, 2 * 4), ((8, 8), 4, 12 + 16), ((8, 8), 10, 12 + 48 + 4 * 64),
    ((5, 6), 8, 12 + 3 * 9 + 2 * 30), ((5, 6, 2), 8, 2 * (12 + 3 * 9 + 2 * 30)),
])  # fmt: skip
def test_coarse_to_fine_marches_blocks_of_16_then_of_4_then_pixels(size, steps, evaluations):
    # 8 x 8 pixels: 2 x 2 rays for three steps, 4 x 4 for three, then 8 x 8. With steps of 0.01 no ray ends.
    front, count = trace(constant(0.01), square(*size), PLAIN, steps=steps)
    assert count == evaluations and (front.status == Status.OUT_OF_STEPS).all()
    assert front.distance.tolist() == pytest.approx([1 + 0.01 * steps] * len(front.distance))


def test_a_ray_continues_the_coarse_ray_that_covers_it():
    for level, (columns, across) in zip(ray_pyramid(square(7, 10, pitch=0.1)), [(5, 3), (10, 5)], strict=True):
        for ray, parent in enumerate(level.parent.tolist()):
            assert parent == ray // columns // 2 * across + ray % columns // 2


def test_a_careful_split_keeps_the_outline_that_a_plain_split_loses():
    shape = torus(0.6, 0.1).rotate(UPRIGHT)
    fine = FINE.render(shape, VIEW).status
    assert torch.equal(COARSE.render(shape, VIEW).status, fine)
    plain = replace(COARSE, careful_split=False).render(shape, VIEW).status
    assert 0 < (plain != fine).sum() < 0.1 * (fine == Status.HIT).sum()


@each("apart, careful, start", [
    (0.02, True, 2.0),  # 0.05 is more than twice 0.02: the coarse ray passed at a safe distance
    (0.03, True, 1.2),  # the finer ray may hit what the coarse ray passed: back to its closest sample
    (0.03, False, 2.0),
])  # fmt: skip
def test_where_a_split_ray_goes_on(apart, careful, start):
    # The coarse ray stands at 2.0, and had its least value, 0.05, at 1.2. The unit sphere begins at 1.
    front = RayFront.on_sphere(HEAD_ON, radius=1.0, samples=2)
    front.distance, front.not_evaluated = vector((2.0,)), torch.tensor([False])
    front.sample_distance, front.sample_value = vector((1.2, 1.9))[None], vector((-0.05, 0.07))[None]
    rays = beam((apart, 0, -2), (0.8, 0, -2))
    child = front.split(torch.zeros(2, dtype=torch.long), HEAD_ON, rays, radius=1.0, careful=careful)
    assert child.distance[0].item() == start and child.active.all() and not child.not_evaluated.any()
    # A ray far apart enters the sphere at 1.4 only.
    assert child.distance[1].item() == pytest.approx(1.4 if careful else 2.0)


def nan_beyond(limit: float) -> Shape:
    """A wall whose values are NaN beyond the plane z = limit."""
    return Shape(lambda p: torch.where(p[..., 2] > limit, torch.nan, WALL(p)))


@each("renderer", [NAIVE, FINE, COARSE])
@each("field, origin, steps, status, distance",
    [
        (sphere(0.5), (0, 0, -2), 50, Status.HIT, 1.5),
        (sphere(0.2, (0, 0.5, 0)), (0, 0, -2), 50, Status.MISS, 3),  # leaves the unit sphere
        (sphere(0.5), (0, 0, 2), 50, Status.MISS, None),  # behind the camera
        (sphere(0.5), (0, 0, 0.1), 50, Status.STARTED_INSIDE, 0),
        (sphere(1.5), (0, 0, -2), 50, Status.STARTED_INSIDE, 1),  # the shape sticks out of the unit sphere
        (sphere(0.5), (0.49, 0, -2), 3, Status.OUT_OF_STEPS, None),  # grazing, with few steps
        (constant(0.001), (0, 0, -2), 50, Status.OUT_OF_STEPS, None),
        (plane((0, 0, -1), -1.5), (0, 0, -2), 50, Status.MISS, 3),  # the wall is behind the unit sphere
        (nan_beyond(-5.0), (0, 0, -2), 50, Status.OUT_OF_STEPS, 1),  # NaN from the start
        (constant(torch.inf), (0, 0, -2), 50, Status.OUT_OF_STEPS, 1),
        (plane((0, 0, -1), 1 - 2e-5), (0, 0, -2), 50, Status.HIT, 1 + 2e-5),  # a hit at the first evaluation,
        (plane((0, 0, -1), 1 + 2e-5), (0, 0, -2), 50, Status.HIT, 1 - 2e-5),  # also just before the sphere
    ],
)  # fmt: skip
def test_how_rays_end(renderer, field, origin, steps, status, distance):
    rays = beam(*[origin] * 16)
    rays = Rays(rays.origins.view(4, 4, 3), rays.directions.view(4, 4, 3), image=True)
    rendering = replace(renderer, steps=steps).render(field, rays)
    assert rendering.status.unique().tolist() == [status] and rendering.hit.all() == (status == Status.HIT)
    if distance is not None:
        assert rendering.distance[0, 0].item() == pytest.approx(distance, abs=1e-9)
    for tensor in (rendering.distance, rendering.points, rendering.residual, rendering.closest):
        assert tensor.isfinite().all()
    torch.testing.assert_close(rendering.points, rays.at(rendering.distance))


@each("renderer", [NAIVE, replace(FINE, alpha=1.0)])
def test_closest_is_the_value_of_least_magnitude_with_its_sign(renderer):
    """The fields are a rod, uneven values that jump across zero at z = 0.2, and a sphere from inside."""

    def bumpy(p: Tensor) -> Tensor:
        return (0.08 + 0.05 * torch.sin(17 * p[..., 2] + 5 * p[..., 0])) * torch.sign(0.2 - p[..., 2])

    rod, signs = capsule((0.2, -1, 0), (0.2, 1, 0), 0.1), set()
    for function, ray in ((rod.function, beam((0, 0.01, -2))), *((bumpy, beam((x / 10, 0, -2))) for x in range(5))):
        recorded = []
        recording = Shape(lambda p, f=function, to=recorded: to.append(f(p)) or to[-1], Kind.BOUND)
        closest = renderer.render(recording, ray).closest.item()
        assert closest == pytest.approx(min(torch.cat(recorded).tolist(), key=abs))
        signs.add(closest > 0)
    assert signs == {False, True}
    assert renderer.render(sphere(0.5), beam((0.3, 0, 0))).closest.item() == pytest.approx(-0.2)


def marched(field: Shape, rays: Rays, stepping: Stepping, steps: int = 50) -> RayFront:
    front = RayFront.on_sphere(rays, radius=1.0, samples=1)
    march_front(field, rays, front, stepping, steps)
    return front


def plate(middle: float, thickness: float) -> Shape:
    """A plate across z, about its middle."""
    return plane((0, 0, -1), thickness / 2 - middle) & plane((0, 0, 1), thickness / 2 + middle)


@each("middle", [0.0, -0.5, 0.85])
def test_a_step_over_a_plate_is_taken_back(middle):
    rays, thin = beam((0, 0, -2)), plate(middle, 0.04)
    assert marched(thin, rays, AGGRESSIVE).status.item() == Status.MISS
    kept = marched(thin, rays, replace(AGGRESSIVE, step_back=True))
    assert kept.status.item() == Status.HIT
    assert kept.distance.item() == pytest.approx(2 + middle - 0.02, abs=1e-4)


def test_a_least_step_brings_a_grazing_ray_to_its_surface():
    direction = torch.nn.functional.normalize(vector((1.0, -0.05, 0.0)), dim=-1)
    origin = -1.5 * direction
    rays = Rays(origin[None], direction[None])  # hits the plane y = 0 at the origin, at 2.9 degrees
    ground = plane((0, 1, 0), 0.0)
    assert marched(ground, rays, PLAIN).status.item() == Status.OUT_OF_STEPS
    floored = marched(ground, rays, replace(PLAIN, least_step=0.05))
    assert floored.status.item() == Status.HIT and floored.distance.item() == pytest.approx(1.5, abs=2e-3)


def test_a_step_is_the_value_divided_by_the_slope():
    steep = Shape(lambda points: 4 * sphere(0.5)(points))
    assert marched(steep, HEAD_ON, replace(PLAIN, slope=4.0)).distance.item() == pytest.approx(1.5, abs=1e-4)
    assert marched(steep, HEAD_ON, PLAIN).status.item() != Status.HIT


def test_relaxed_steps_are_fewer_and_have_the_same_hits():
    """The image includes the outline, where most steps are spent."""
    rays, counts = camera_of(48).double().rays(), {}
    truth, hit = sphere_hits(rays, 0.6)
    for name in ("dist_dynamic", "dist_keinert", "dist_auto_relaxed"):
        meter = Meter(sphere(0.6))
        rendering = load("renderer", name, steps=400).render(meter, rays)
        assert torch.equal(rendering.hit, hit), name
        assert (rendering.distance - truth)[hit].abs().median() < 1e-4
        counts[name] = meter.counts.value
    assert counts["dist_keinert"] < counts["dist_dynamic"]
    assert counts["dist_auto_relaxed"] < 0.9 * counts["dist_dynamic"]


def test_a_relaxed_step_towards_a_plane_touches_its_next_empty_sphere():
    """On a plane at 60 degrees the slope is -1/2, and the steps become 4/3 of the value."""
    field, ray = plane((0.0, 1.0, 0.0), -0.5), Rays(vector((-1.4, 0.3, 0))[None], vector((3**0.5 / 2, -0.5, 0))[None])
    front = RayFront.on_sphere(ray, radius=2.0, samples=1)
    front.distance[:] = 0.0
    stepping = replace(PLAIN, step_back=True, relaxation=1.0)
    for steps in (1, 2):
        before = front.distance.clone()
        value = field(ray.at(before))
        march_front(field, ray, front, stepping, 1)
        assert (front.distance - before).item() == pytest.approx(value.item() * (1.0 if steps == 1 else 4 / 3))
