"""Samples that follow the thinnest part of the shape: how thick it is, how many that takes, and what it must not do."""

from dataclasses import replace
from math import inf

import pytest
import torch

from bench.config import load
from bench.records.record import Record
from bench.run.execute import execute
from bench.run.process import Job
from bench.setup.auto import samples
from renderers.adaptive_samples import Following, Seen, at_max_samples, follow, thickness, thinnest
from renderers.field import Kind, Meter
from renderers.fields.analytic import Shape, box, sphere
from renderers.rendering import Observed, Renderer, Scheduled, Status, at_iteration, final_notes, fresh
from tests.renderers.analytic_cases import vector
from tests.tiny import camera_of, cell_from, plain, silent

DVR = load("renderer", "dvr", doublings=[])
PLATE = box((0.5, 0.5, 0.025))
RAYS = camera_of(32).rays()
OBLIQUE = camera_of(32, angles=(30.0, 25.0)).rays()
RUN = ("renderer=dvr", "renderer.n_ray_samples=auto", "dataset=sphere", "scale=smoke")


def hits_of(shape, rays, n=128):
    return DVR.with_samples(n).render(shape, rays)


@pytest.mark.parametrize(
    ("thickness", "radius", "n"),
    [(inf, 1.0, 16), (0.5, 1.0, 16), (0.1, 1.0, 41), (0.1, 2.0, 81), (0.0625, 1.0, 65), (0.03, 1.0, 128)],
)
def test_two_samples_lie_in_the_thinnest_part(thickness, radius, n):
    assert samples(thickness, radius) == n
    if 16 < n < 128:
        assert 2 * radius / (n - 1) <= thickness / 2 + 1e-12 < 2 * radius / (n - 2)


def test_the_thickness_is_that_along_the_normal():
    faces = torch.stack([vector((x, 0.1, 0.025)) for x in (0.0, 0.3, -0.45)])
    assert thickness(PLATE, faces, radius=1.0).tolist() == pytest.approx([0.05] * 3, abs=1e-9)
    side = vector((0.5, 0.0, 0.01))[None]
    assert thickness(PLATE, side, radius=1.0).item() == pytest.approx(1.0, rel=0.05)
    outline = torch.nn.functional.normalize(torch.stack([vector((1, 0, 0)), vector((0.99, 0, 0.14))]), dim=1) * 0.6
    assert thickness(sphere(0.6), outline, radius=1.0).tolist() == pytest.approx([1.2, 1.2], rel=1e-6)


def test_the_thickness_is_that_of_the_first_part_and_of_any_level_set():
    shelf = box((0.5, 0.5, 0.03)).translate((0.0, 0.0, 0.3)) | box((0.5, 0.5, 0.2))
    level = Shape(lambda p: torch.tanh(8 * shelf(p)), Kind.LEVEL, None)
    for field, error in ((shelf, 1e-9), (level, 0.005)):
        assert thickness(field, vector((0.1, 0.0, 0.33))[None], radius=1.0).item() == pytest.approx(0.06, abs=error)


def test_thickness_below_the_least_spacing_or_without_end_or_normal():
    at = vector((0.0, 0.0, 0.0))[None]
    sheet, everywhere = (
        box((0.5, 0.5, 1e-3)).translate((0.0, 0.0, -1e-3)),
        box((9.0, 9.0, 9.0)).translate((0.0, 0.0, -9.0)),
    )
    flat = Shape(lambda p: 0 * p.sum(-1) + 1, Kind.LEVEL, None)
    assert thickness(sheet, at, radius=1.0).item() == pytest.approx(2 / 127)
    assert thickness(everywhere, at, radius=1.0).item() == inf
    assert thickness(flat, at, radius=1.0).item() == inf
    assert thinnest(sphere(0.1), hits_of(sphere(0.1), RAYS.coarser(32)), radius=1.0) == pytest.approx(0.2, abs=1e-3)
    assert thinnest(flat, hits_of(flat, RAYS), radius=1.0) == inf


@pytest.mark.parametrize("rays", [RAYS, OBLIQUE], ids=["frontal", "oblique"])
def test_a_plate_that_few_samples_miss_is_found_at_the_second_rendering(rays):
    few, all_of_them = (hits_of(PLATE, rays, n).hit for n in (16, 128))
    following = follow(DVR)
    renderer = at_iteration(following, 0)
    assert torch.equal(renderer.render(PLATE, rays).hit, few)
    assert int((all_of_them & ~few).sum()) > 0.45 * int(all_of_them.sum())
    found = renderer.render(PLATE, rays).hit
    rim = 0 if rays is RAYS else 2  # pixels whose rays cross an edge, through less than the plate is thick
    assert int((all_of_them & ~found).sum()) <= rim
    assert following.n_ray_samples in (81, 82)  # 4 R / 0.05 + 1


def test_a_sphere_keeps_the_fewest_samples_whatever_grazes_it():
    rays = camera_of(64).rays()
    following = follow(DVR)
    for iteration in range(3):
        found = following.at_iteration(iteration).render(sphere(0.6), rays)
    assert following.n_ray_samples == 16
    assert following.seen.thinnest == pytest.approx(1.2, rel=1e-3)
    assert int((hits_of(sphere(0.6), rays).hit & ~found.hit).sum()) <= 0.02 * int(found.hit.sum())


def test_a_shape_that_swells_keeps_the_samples_that_its_thinnest_part_took():
    following = follow(DVR)
    renderer = following.at_iteration(0)
    for shape in (PLATE, sphere(0.6)):
        renderer.render(shape, RAYS)
    assert following.n_ray_samples == 81


def test_measurements_are_counted_at_the_field_and_have_no_graph():
    size = torch.tensor(0.6, requires_grad=True)
    shape = sphere(size)
    plain, looked = Meter(shape), Meter(shape)
    before = DVR.with_samples(16).render(plain, RAYS)
    after = follow(DVR).at_iteration(0).render(looked, RAYS)
    assert torch.equal(before.distance, after.distance)
    spent = looked.counts - plain.counts
    assert (spent.value, spent.gradient) == (128 * 16, 128)  # 128 hits, 15 values and a normal each
    for rendering in (before, after):
        (rendering.distance[rendering.hit].sum()).backward()
    assert looked.counts.gradient - 128 == plain.counts.gradient
    assert size.grad is not None


def test_renderings_for_evaluation_and_pictures_change_nothing():
    following = follow(DVR)
    assert torch.equal(following.render(PLATE, RAYS).distance, hits_of(PLATE, RAYS, 16).distance)
    assert following.n_ray_samples == 16
    following.at_iteration(0).render(PLATE, RAYS)
    assert torch.equal(following.render(PLATE, RAYS).distance, hits_of(PLATE, RAYS, 81).distance)


def test_it_is_a_renderer_with_the_loss_and_the_schedule_of_the_inner_one():
    following = follow(DVR)
    assert isinstance(following, Renderer) and isinstance(following, Scheduled)
    assert following.capabilities == DVR.capabilities
    rendering, mask = hits_of(PLATE, RAYS), torch.ones(32, 32, dtype=torch.bool)
    losses, at_depth = [], replace(DVR, occupied_at="depth")
    nothing = replace(rendering, status=torch.full_like(rendering.status, Status.MISS))
    given = Observed(mask, torch.full_like(rendering.distance, 2.0))
    for renderer in (DVR, following, at_depth, follow(at_depth)):
        torch.manual_seed(0)
        losses.append([renderer.silhouette_loss(PLATE, RAYS, rendering, mask)])
        losses[-1] += [renderer.observed_loss(PLATE, RAYS, nothing, given)]
    assert losses[0] == losses[1] and losses[2] == losses[3]
    assert losses[0][0] == losses[2][0] and losses[0][1] != losses[2][1]

    class Turning(type(DVR)):
        def at_iteration(self, iteration):
            return replace(self, mask_weight=float(iteration))

    turning = Following(Turning(**vars(DVR)), Seen())
    assert turning.at_iteration(7).inner.mask_weight == 7.0


def test_other_samples_and_many_optimisations_are_refused(compose_config):
    for name in ("dist", "naive"):
        config = compose_config(f"renderer={name}", "+renderer.n_ray_samples=auto")
        with pytest.raises(ValueError, match=r"renderer has no key 'n_ray_samples': did you mean n_gradient_samples"):
            cell_from(config)
        with pytest.raises(
            ValueError, match=r"renderer\.n_gradient_samples=auto has no equation: only epsilon, steps, n_ray"
        ):
            cell_from(compose_config(f"renderer={name}", "renderer.n_gradient_samples=auto"))
        with pytest.raises(ValueError, match=r"for samples spaced along the ray .* has no with_samples that sets them"):
            follow(load("renderer", name))
    with pytest.raises(ValueError, match=r"follows one optimisation, and a stress has many trials"):
        cell_from(compose_config(*RUN, "task=stability", "stress=thin_plate"))


def test_a_number_is_left_as_it_is(compose_config):
    stage = cell_from(compose_config("renderer=dvr")).inputs()
    assert (type(stage.renderer), stage.notes, stage.last_notes) == (type(DVR), (), [])


def test_a_run_notes_the_first_and_the_final_number(compose_config, tmp_path):
    config = compose_config(
        *RUN, "task=pose", "task.shape=formula", "task.optimiser.iterations=3", "view.resolution=16",
        "evaluation.picture=null", "device=cpu",
    )  # fmt: skip
    record = Record("id", "pose", "dvr", "sphere", 0, plain(config))
    execute(Job(tmp_path, record), progress=silent, checkpoint=lambda record: None)
    assert record.status in ("ok", "not_reached"), record.reason
    first, last = (note for note in record.notes if note.startswith("renderer.n_ray_samples=auto"))
    assert first == "renderer.n_ray_samples=auto begins with 16, and follows the thinnest part that is seen"
    assert last.startswith("renderer.n_ray_samples=auto ends with 16, for a part 1.") and last.endswith(
        " scene units thick"
    )


def test_each_of_several_fits_measures_its_own_shape_and_all_are_evaluated_alike():
    shared = follow(DVR)
    assert final_notes(shared) == final_notes(DVR) == []
    plate, ball = fresh(shared), fresh(shared)
    for renderer, shape in ((plate, PLATE), (ball, sphere(0.6)), (plate, PLATE)):
        at_iteration(renderer, 0).render(shape, RAYS)
    assert [renderer.n_ray_samples for renderer in (shared, plate, ball)] == [16, 81, 16]
    assert final_notes(plate) == ["renderer.n_ray_samples=auto ends with 81, for a part 0.05 scene units thick"]
    for renderer in (shared, plate, ball):
        assert torch.equal(at_max_samples(renderer).render(PLATE, RAYS).hit, hits_of(PLATE, RAYS, 128).hit)
    assert at_max_samples(DVR) is fresh(DVR) is DVR
