"""The warm start: a rendering that begins at the hits of the last one has the same hits as a cold rendering."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch

from bench.config import load
from renderers.boundary import render_checked
from renderers.camera import Rays
from renderers.field import Field, Kind, Meter
from renderers.fields.analytic import Shape, box, capsule, sphere
from renderers.newton import warm as warm_module
from renderers.newton.warm import AUDIT_STRIDE, MIN_AUDITED_RAYS, Memory
from renderers.rendering import Rendering, at_iteration, final_notes, with_empty_memory
from renderers.silhouette import Hinge
from tests.tiny import camera_of

SIZE = 48  # pixels per side
RAYS = camera_of(SIZE, angles=(30.0, 25.0)).rays()
COLD = load("renderer", "newton", warm=False)
SMALL_SPHERE = sphere(0.01, (0.0, 0.9, 0.0))


@pytest.fixture
def warm():
    return load("renderer", "newton", warm=True)


def in_turn(renderer, fields, rays: Rays = RAYS) -> list[tuple[Rendering, int]]:
    """The rendering of each field in an optimisation, and its evaluations."""
    renderings = []
    for iteration, field in enumerate(fields):
        meter = Meter(field)
        renderings.append((render_checked(at_iteration(renderer, iteration), meter, rays), meter.counts.value))
    return renderings


def differing(rendering: Rendering, field: Field, rays: Rays = RAYS) -> int:
    """The number of rays with another hit in a cold rendering."""
    cold = COLD.render(field, rays)
    apart = (rendering.distance - cold.distance).abs() > 2e-4
    return int(((rendering.hit != cold.hit) | (rendering.hit & apart)).sum())


def first_evaluations() -> int:
    """The evaluations of the first rendering of the sphere in an optimisation."""
    return in_turn(with_empty_memory(load("renderer", "newton", warm=True)), [ball(0.5)])[0][1]


def ball(radius: float, x: float = 0.0) -> Shape:
    return sphere(radius, (x, 0.0, 0.0))


SEQUENCES = {  # fields of an optimisation, the most rays with another hit, and the evaluations as a share of cold ones
    "a shape that moves": ([ball(0.5 + 0.0005 * i, x=0.001 * i) for i in range(8)], 1, 0.7),
    # A fifth of the distance needs five times the steps. A ray that ran out of steps would be sampled densely.
    "a bound": ([Shape(lambda p, r=0.5 + 0.002 * i: 0.2 * ball(r)(p), Kind.BOUND) for i in range(6)], 1, 0.66),
    "a shape that enters": ([ball(0.4, x=-0.4) | sphere(0.2, (0.3, 1.3 - 0.03 * i, 0.2)) for i in range(16)], 1, 2),
    "a shape that shrinks": ([ball(0.4 - 0.04 * i) for i in range(10)], 1, 2),
    "a jump to a box": ([ball(0.5), box((0.6, 0.3, 0.4))], 0, 2),
    "a jump to a small sphere": ([ball(0.5), SMALL_SPHERE], 0, 2),
    "a jump to two spheres": ([ball(0.5), ball(0.3) | ball(0.3, x=-0.6)], 0, 2),
}


@pytest.mark.parametrize("name", SEQUENCES)
def test_an_optimisation_has_the_hits_of_cold_renderings(warm, name):
    fields, most, share = SEQUENCES[name]
    renderings = in_turn(warm, fields)
    differences = [differing(rendering, field) for (rendering, _), field in zip(renderings, fields, strict=True)]
    assert max(differences) <= most
    assert sum(values for _, values in renderings) < share * sum(values for _, values in in_turn(COLD, fields))


@pytest.mark.slow
def test_a_field_that_becomes_steep_loses_nothing(warm):
    rod = capsule((-0.5, 0.5, 0.0), (0.5, 0.5, 0.0), 0.03) | box((0.3, 0.01, 0.3))
    fields = [Shape(lambda p, k=k: k * rod(p)) for k in torch.linspace(1, 4, 48).tolist()]
    hits = [int(rendering.hit.sum()) for rendering, _ in in_turn(warm, fields)]
    assert min(hits[16:]) >= 0.9 * hits[0] > 28  # from a slope of 2 on; a smaller slope counts as a distance


def test_the_audit_detects_a_surface_that_appears_without_measured_movement(warm, monkeypatch):
    monkeypatch.setattr(warm_module, "PROBE_STRIDE", SIZE * SIZE)  # movement is measured on the first ray only
    plate = ball(0.5) | box((0.9, 0.9, 0.01)).translate((0.0, 0.0, 0.7))

    def values(points):
        """The sphere and the plate, whose values show only near the plate."""
        return torch.where(points[..., 2] > 0.6, plate(points), ball(0.5)(points))

    field = Shape(values, Kind.BOUND, None)
    flat, through_the_middle = RAYS.flat(), SIZE * SIZE // 2 + SIZE // 2
    rays = Rays(flat.origins.roll(-through_the_middle, 0), flat.directions.roll(-through_the_middle, 0))
    at_iteration(warm, 0).render(ball(0.5), rays)
    rendering = at_iteration(warm, 1).render(field, rays)
    assert differing(rendering, field, rays) == 0 and "had another answer" in final_notes(warm)[0]


def test_after_too_many_disagreements_nothing_is_taken_from_memory(warm):
    in_turn(warm, [ball(0.5)] * 2)
    warm.memory.audited, warm.memory.differed = MIN_AUDITED_RAYS, MIN_AUDITED_RAYS
    assert warm.memory.disabled and "nothing was taken from memory" in final_notes(warm)[0]
    meter = Meter(ball(0.5))
    at_iteration(warm, 2).render(meter, RAYS)
    assert meter.counts.value == first_evaluations()


def test_the_audit_takes_another_hundredth_of_the_rays_each_time(warm, monkeypatch):
    taken, compare = torch.zeros(SIZE * SIZE), warm_module._differing

    def recorded(kept, marched, audited):
        taken.add_(audited)
        return compare(kept, marched, audited)

    monkeypatch.setattr(warm_module, "_differing", recorded)
    in_turn(warm, [ball(0.5)] * 11)
    assert taken.max() == 1 and taken.sum() == warm.memory.audited
    assert 9.5 < warm.memory.audited / (SIZE * SIZE / AUDIT_STRIDE) < 10.5
    (note,) = final_notes(warm)
    assert note.startswith(f"renderer.warm: 0 of {warm.memory.audited} audited rays had another answer")


def test_another_optimisation_remembers_nothing(warm):
    in_turn(warm, [ball(0.5)] * 3)
    assert in_turn(warm, [ball(0.5)])[0][1] == first_evaluations()
    in_turn(warm, [ball(0.5)] * 2)
    assert with_empty_memory(warm).memory == Memory(thread=warm.memory.thread) != warm.memory
    assert final_notes(with_empty_memory(warm)) == final_notes(COLD) == []


def test_renderings_outside_an_optimisation_neither_use_nor_change_the_memory(warm):
    in_turn(warm, [ball(0.5)] * 2)
    before = [cache.renderings for *_, cache in warm.memory.cached.values()]
    meter, cold = Meter(ball(0.5)), Meter(ball(0.5))
    warm.render(meter, RAYS)
    COLD.render(cold, RAYS)
    assert meter.counts.value == cold.counts.value
    assert [cache.renderings for *_, cache in warm.memory.cached.values()] == before == [2]


def test_a_moved_camera_is_another_image_and_deleted_rays_are_forgotten(warm):
    at_iteration(warm, 0).render(ball(0.5), RAYS)
    moved = camera_of(SIZE, angles=(40.0, 25.0)).rays()
    rendering = at_iteration(warm, 1).render(ball(0.5), moved)
    assert differing(rendering, ball(0.5), moved) == 0 and len(warm.memory.cached) == 2
    del moved, rendering
    assert len(warm.memory.cached) == 1


def test_rays_with_a_gradient_are_not_remembered(warm):
    rays = replace(RAYS, origins=RAYS.origins.clone().requires_grad_(True))
    assert all(rendering.distance.requires_grad for rendering, _ in in_turn(warm, [ball(0.5)] * 2, rays))
    assert not warm.memory.cached


def test_a_batch_of_views(warm):
    other = camera_of(SIZE, angles=(120.0, 25.0)).rays()
    views = Rays(
        torch.stack([RAYS.origins, other.origins]), torch.stack([RAYS.directions, other.directions]), image=True
    )
    fields = [ball(0.5, x=0.01 * i) for i in range(4)]
    for (rendering, _), field in zip(in_turn(warm, fields, views), fields, strict=True):
        assert rendering.distance.shape == (2, SIZE, SIZE) and differing(rendering, field, views) <= 1


def test_a_field_that_is_nan_somewhere(warm):
    def values(points):
        inner = ball(0.5)(points)
        return torch.where(points[..., 0] > 0.3, torch.nan, inner)

    broken = Shape(values, Kind.BOUND, None)
    for field in (broken, ball(0.5), broken, broken, ball(0.5)):
        rendering = render_checked(at_iteration(warm, 1), field, RAYS)
        for tensor in (rendering.distance, rendering.closest, rendering.residual):
            assert tensor.isfinite().all()
    assert differing(rendering, ball(0.5)) == 0


def test_in_another_thread_nothing_is_remembered(warm):
    in_turn(warm, [ball(0.5)] * 2)

    def values() -> int:
        meter = Meter(ball(0.5))
        at_iteration(warm, 2).render(meter, RAYS)
        return meter.counts.value

    cold = in_turn(COLD, [ball(0.5)])[0][1]
    with ThreadPoolExecutor(1) as pool:
        in_thread = pool.submit(values).result()
    assert values() < in_thread == cold


def test_the_gradient_is_that_of_a_cold_rendering(warm):
    mask = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    mask[8:38, 9:45] = True
    loss = Hinge(5e-5, signed=True, average="violating")
    for iteration in range(4):
        gradients = []
        for renderer in (at_iteration(warm, iteration), COLD):
            radius = torch.tensor(0.4 + 0.004 * iteration, requires_grad=True)
            field = Shape(lambda points, radius=radius: points.norm(dim=-1) - radius, Kind.DISTANCE, None)
            rendering = renderer.render(field, RAYS)
            (rendering.distance[rendering.hit].sum() + loss.of_rendering(field, RAYS, rendering, mask)).backward()
            gradients.append(radius.grad.item())
        assert gradients[0] == pytest.approx(gradients[1], rel=0.01)
