"""Shape from many views of a ball, by a prior of balls."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from bench.config import load
from bench.shape_prior import Prior
from bench.solve.latent_code import CodePenalty
from bench.solve.optimise import CannotContinue, History, OptimiserSettings, optimise
from bench.tasks.multiview import Multiview, PhotometricLoss, blur, sample
from bench.tasks.reconstruction.subject import HULL_RADIUS
from bench.tasks.single_view.encoder import EncoderSettings
from datasets.files.meshes import read_mesh
from datasets.mesh import extract
from datasets.scene import Scene, Truth
from renderers.camera import Rays
from renderers.field import Meter
from renderers.fields.analytic import sphere
from tests.datasets.test_photographs import PHOTOGRAPHY
from tests.looped import each
from tests.made_photographs import CENTRE, RADIUS, idr
from tests.runner.driving import command, record_of
from tests.tiny import CPU, altered, ball_prior, camera_of, icosphere, phases_of, run_of, scene_of

RENDERER = load("renderer", "dist")
CAMERA = camera_of(16, angles=(0.0, 20.0))
PRIOR = ball_prior(radius=0.5)
SETTINGS = Multiview(
    images=PHOTOGRAPHY, longest=24, held_out=5, masks=True, focal=1.0, views_per_step=4, neighbour=1,
    visible=1e-3, photometric_weight=5.0, code=CodePenalty(0.0, "sum"), start_scale=0.0,
    starts=1, trial=3, coarse_blur=0.0,
    scale=1.0, degrees=0.0, shift=0.0, similarity=False, rotations=2,
    silhouette=load("silhouette", "cross_entropy_sharp"), silhouette_weight=0.0,
    optimiser=OptimiserSettings(30, 0.01, "constant"),
)  # fmt: skip


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A ball of radius 0.5, the prior's mean shape."""
    return scene_of(icosphere(0.5), CAMERA)


def problem_of(scene, **changed):
    return replace(SETTINGS, **changed).problem(scene, PRIOR, RENDERER, seed=0, device=CPU)


def overrides(scene, **changed) -> PhotometricLoss:
    settings = replace(SETTINGS, **changed)
    return PhotometricLoss(settings, RENDERER, settings.images.take(Truth(scene.mesh), CAMERA, seed=0), CPU)


def test_the_truth_costs_least(scene):
    photographs = overrides(scene)
    losses = [photographs.compare(sphere(radius), 0)["photometric"].item() for radius in (0.35, 0.45, 0.5, 0.55, 0.65)]
    assert losses.index(min(losses)) == 2 and losses[2] < 0.5 * min(losses[0], losses[4])


def test_masks_are_compared_where_their_loss_has_a_weight_and_hold_what_a_shape_leaves_free(scene):
    smaller = sphere(0.4)
    assert set(overrides(scene).compare(smaller, 0)) == {"photometric"}
    masked = overrides(scene, silhouette_weight=10.0)
    assert masked.compare(smaller, 0)["silhouette"] > 3 * masked.compare(sphere(0.5), 0)["silhouette"]


def test_drawn_pixels_are_compared_as_among_all(scene):
    """A neighbour's depths are interpolated as among all pixels, but only the needed pixels are rendered."""
    everything, drawn = overrides(scene), overrides(scene, pixel_block=2, silhouette_weight=10.0)
    assert drawn.draw.pixels(0).tolist() != drawn.draw.pixels(1).tolist() and len(drawn.draw.pixels(0)) == 8 * 8
    errors = [drawn.compare(sphere(0.5), iteration)["photometric"].item() for iteration in range(0, 32, 8)]
    whole = [everything.compare(sphere(0.5), iteration)["photometric"].item() for iteration in range(0, 32, 8)]
    assert np.mean(errors) == pytest.approx(np.mean(whole), rel=0.3)
    costs = []
    for photographs in (everything, drawn):
        field = Meter(sphere(0.5))
        photographs.compare(field, 0)
        costs.append(field.counts.cost)
    assert costs[1] < 0.9 * costs[0]
    assert drawn.compare(sphere(0.4), 0)["silhouette"] > 3 * drawn.compare(sphere(0.5), 0)["silhouette"]
    problem = problem_of(scene, pixel_block=2)
    assert problem.rays_per_iteration * 4 == problem_of(scene).rays_per_iteration


@each("rays, fractions", [(1, None), (4, None), (1, True), (4, False)])
@each("block", [1, 2])
@each("name", ["dist", "relaxed_boundary", "edge_sampling"])
def test_several_rays_per_pixel_compare_fractions_and_the_truth_costs_least(scene, name, block, rays, fractions):
    silhouette = load("silhouette", "cross_entropy_sharp" if name == "dist" else "area")
    settings = {"silhouette_weight": 10.0, "silhouette": silhouette, "pixel_block": block, "fractions": fractions}
    problem = replace(SETTINGS, **settings).problem(
        replace(scene, rays_per_pixel=rays), PRIOR, load("renderer", name), seed=0, device=CPU
    )
    assert problem.rays_per_iteration == (rays + 1) * 4 * (16 // block) ** 2
    draws = range(1, 1 + len(problem.photographs))
    terms = [[problem.compare(sphere(radius), draw) for draw in draws] for radius in (0.4, 0.5, 0.6)]
    for term in ("photometric", "silhouette"):
        costs = [sum(of_draw[term].item() for of_draw in of_radius) for of_radius in terms]
        ratio = 1 if fractions is False else 0.7  # a mask is not what several rays observe
        assert costs[1] < ratio * min(costs[0], costs[2]), (term, costs)
    radius = torch.tensor(0.4, requires_grad=True)
    (slope,) = torch.autograd.grad(problem.compare(sphere(radius), 1)["silhouette"], radius)
    if rays == 4 or name == "dist":
        assert slope < 0  # a larger sphere covers more
    later = problem.compare(sphere(0.5), 1 + len(problem.photographs))["photometric"]  # of the same views
    centres = rays == 1 and not fractions
    assert (centres and block == 1) == (later.item() == terms[1][0]["photometric"].item())


def test_a_pixel_is_compared_if_all_its_rays_hit_and_half_are_seen(scene, monkeypatch):
    """By the mean over the seen rays; all images show their columns, which are interpolated exactly."""
    photographs = SETTINGS.images.take(Truth(scene.mesh), CAMERA, seed=0)
    loss = PhotometricLoss(SETTINGS, RENDERER, photographs, CPU, rays_per_pixel=4)
    visible, columns, errors = loss._visible, torch.arange(16.0).expand(16, 16), []

    def partly_visible(renderer, field, rendering, neighbours, is_drawn):
        draw = torch.Generator().manual_seed(1)
        keep = visible(renderer, field, rendering, neighbours, is_drawn) & (
            torch.rand(4, 16, 16, 4, generator=draw) < 0.6
        )
        for k, other in enumerate(neighbours):
            shown = rendering.hit[k].all(-1) & (keep[k].sum(-1) >= 2)
            at = loss.cameras[other].project(rendering.points[k])[0][..., 0] - 0.5
            mean = (at * keep[k]).sum(-1) / keep[k].sum(-1)
            errors.append((mean - columns)[shown].abs())
        return keep

    monkeypatch.setattr(loss, "_visible", partly_visible)
    monkeypatch.setattr(loss, "images_at", lambda _: columns[..., None].expand(len(photographs), 16, 16, 3))
    compared = loss.compare(sphere(0.5), 0)["photometric"].item() / SETTINGS.photometric_weight
    assert len(torch.cat(errors)) > 20
    assert compared == pytest.approx(torch.cat(errors).mean().item(), rel=1e-4)


def test_a_draw_that_both_views_see_nowhere_is_no_failure(scene):
    """Of a small shape, 4 pixels of 256 seldom show it; all pixels do, and without it a run cannot continue."""
    drawn, small = overrides(scene, pixel_block=8), sphere(0.3)
    losses = [drawn.compare(small, iteration)["photometric"].item() for iteration in range(20)]
    assert losses.count(0.0) > 5 and np.isfinite(losses).all()
    assert drawn.compare_at(small, 0)["photometric"] > 0
    several = problem_of(replace(scene, rays_per_pixel=4), pixel_block=8)
    assert 0.0 in [several.compare(small, iteration)["photometric"].item() for iteration in range(20)]
    with pytest.raises(CannotContinue):
        drawn.compare_at(sphere(0.001).translate((0.9, 0.9, 0.0)), 0)


def test_drawn_pixels_are_seen_by_the_neighbour_as_among_all(scene):
    drawn = overrides(scene, pixel_block=2)
    views, neighbours = map(list, zip(*drawn.pairs(0), strict=True))
    image, pixels = drawn._stack_rays(views), drawn.draw.pixels(0)
    sparse = Rays(image.origins.flatten(1, 2)[:, pixels], image.directions.flatten(1, 2)[:, pixels])
    fields = sphere(0.5), sphere(0.5) | sphere(0.2).translate((0.5, 0.2, 0.5))
    for field in fields:
        seen = [
            drawn._visible(RENDERER, field, RENDERER.render(field, rays), neighbours, rays is sparse)
            for rays in (image, sparse)
        ]
        assert seen[1].equal(seen[0].flatten(1)[:, pixels]) and seen[1].any() and not seen[1].all()


def test_views_move_on_and_are_spread_evenly(scene):
    photographs = overrides(scene)
    assert photographs.pairs(0) == [(0, 1), (2, 3), (4, 5), (6, 7)]
    assert photographs.pairs(3) == [(3, 4), (5, 6), (7, 0), (1, 2)]
    assert overrides(scene, views_per_step=99, neighbour=2).pairs(0) == [(i, (i + 2) % 8) for i in range(8)]


def test_it_finds_the_ball(scene):
    problem = problem_of(scene)
    problem.code.data += torch.tensor([0.0, 0.05, 0.0, 0.15])  # higher and larger
    optimise(problem, OptimiserSettings(30, 0.05, "cosine"), CPU, history=History(), on_step=lambda line: None)
    assert problem.code.detach().norm().item() < 0.01  # of 0.16
    assert problem.counts.value > 0


def test_random_starts_differ_and_share_the_budget(scene):
    problem = problem_of(scene, starts=3, start_scale=1.0)
    assert len(problem.parameters) == 3 and not torch.equal(problem.codes[0], problem.codes[1])
    before = [code.detach().clone() for code in problem.codes]
    history = History()
    optimise(problem, OptimiserSettings(14, 0.01, "constant"), CPU, history=history, on_step=lambda line: None)
    kept = problem.starts.best()
    assert torch.equal(problem.code, problem.codes[kept])
    moved = [(code.detach() - old).norm().item() for code, old in zip(problem.codes, before, strict=True)]
    assert all(distance > 0 for distance in moved)
    ends = [np.mean([line["total"] for line in history.curve[start:9:3]]) for start in range(3)]
    assert kept == int(np.argmin(ends))


@pytest.mark.slow
def test_an_encoder_is_trained_once_and_gives_the_code_about_which_starts_are_drawn(tmp_path):
    prior, camera = Prior(PRIOR.decoder, 3 * PRIOR.codes), CAMERA
    encoder = EncoderSettings((8,), 1, 16, 6, 4, 8, OptimiserSettings(80, 0.01, "cosine"))
    scene = scene_of(extract(prior.decoder.at(prior.codes[0]), grid=24, reach=1.0), camera)
    task = replace(SETTINGS, optimiser=OptimiserSettings(1, 1e-9, "constant"))
    run = run_of(tmp_path, RENDERER, prior, camera, make_scene=lambda: scene)
    run = altered(run, {"inputs.evaluation.points": 500})
    task.execute(run)
    at_zero = run.record.metrics_start["chamfer_l1"]
    trained = ["training the encoder" in phases_of(run, replace(task, encoder=encoder)) for _ in range(2)]
    assert trained == [True, False]  # the second one reads it
    assert run.record.metrics_start["chamfer_l1"] < 0.6 * at_zero


@pytest.mark.slow
def test_a_misplaced_ball_is_put_back(scene):
    problem = problem_of(scene, shift=0.1, scale=1.1, degrees=5.0)
    first = problem.similarity.clone()
    assert first[:3].norm().item() == pytest.approx(0.1) and first[6].exp().item() == pytest.approx(1.1)
    problem.codes[0].requires_grad_(False)  # a ball that moves could be put back by its code as well
    optimise(problem, OptimiserSettings(24, 0.02, "cosine"), CPU, history=History(), on_step=lambda line: None)
    assert problem.similarity[:3].norm() < 0.3 * first[:3].norm()
    assert problem.similarity[6].abs() < 0.3 * first[6]
    assert problem.field()(torch.tensor([[0.0, 0, 0.5]])).abs().item() < 0.02


def test_a_similarity_is_sought_in_place_where_that_is_asked_for(scene):
    assert problem_of(scene).similarities == []
    problem = problem_of(scene, similarity=True)
    assert problem.similarity.tolist() == [0.0] * 7 and problem.similarities[0].requires_grad


def test_coarse_images_come_first(scene):
    photographs = overrides(scene, coarse_blur=0.0625)
    roughness = [photographs.images_at(i).diff(dim=1).abs().mean().item() for i in (0, 8, 15, 29)]
    assert roughness[0] < roughness[1] < roughness[2] == roughness[3]
    assert torch.equal(photographs.images_at(15), photographs.colours)


def test_blurring_keeps_what_is_constant_and_the_mean():
    flat = torch.full((2, 9, 7, 3), 0.3)
    assert torch.allclose(blur(flat, 1.5), flat, atol=1e-6)
    spot = torch.zeros(1, 21, 21, 3)
    spot[0, 10, 10] = 1.0
    soft = blur(spot, 1.5)
    assert soft.sum().item() == pytest.approx(3.0, rel=1e-4)
    variance = (soft[0, :, :, 0].sum(1) * (torch.arange(21) - 10) ** 2).sum().item()
    assert variance == pytest.approx(1.5**2, rel=0.05)
    assert blur(torch.rand(1, 2, 2, 3), 5.0).isfinite().all()  # wider than the image


def test_views_that_share_no_point_end_the_run_with_the_reason(scene):
    with pytest.raises(CannotContinue, match="no point of the shape is seen by two neighbouring views"):
        level = replace(PHOTOGRAPHY, views=2).take(Truth(scene.mesh), camera_of(32), seed=0)  # from opposite sides
        PhotometricLoss(SETTINGS, RENDERER, level, CPU).compare(sphere(0.5), 0)
    with pytest.raises(CannotContinue):
        overrides(scene).compare(sphere(1e-3, (0.0, 0.0, 0.9)), 0)


@each("changed", [{"neighbour": 8}, {"scale": 1.5}, {"shift": 0.5}, {"starts": 10}])
def test_what_cannot_be_is_told(changed):
    with pytest.raises(ValueError, match=r"neighbour=8 compares|scale must lie|shift be 0.2 at most|must be more than"):
        replace(SETTINGS, **changed)


def test_a_linear_image_is_sampled_exactly_and_nothing_outside_is_read():
    rows, columns = torch.meshgrid(torch.arange(6) + 0.5, torch.arange(8) + 0.5, indexing="ij")
    image = (2 * columns + 3 * rows + 1)[..., None]
    pixels = torch.rand(500, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([10.0, 8.0]) - 1
    colours, inside = sample(image, pixels)
    assert torch.equal(
        inside, (pixels[:, 0] >= 0.5) & (pixels[:, 0] <= 7.5) & (pixels[:, 1] >= 0.5) & (pixels[:, 1] <= 5.5)
    )
    expected = 2 * pixels[:, 0] + 3 * pixels[:, 1] + 1
    assert torch.allclose(colours[inside, 0], expected[inside], atol=1e-4) and (colours[~inside] == 0).all()
    assert not sample(image, torch.tensor([[float("nan"), 1.0]]))[1].any()


def test_gradients_reach_the_pixels():
    image = torch.rand(5, 5, 2, generator=torch.Generator().manual_seed(1)).double()
    positions = (0.7 + 3.5 * torch.rand(20, 2, generator=torch.Generator().manual_seed(2))).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda p: sample(image, p)[0], positions)


@pytest.mark.slow
def test_photographs_of_ones_own_are_set_upright_about_their_hull_and_a_prior_is_put_there(tmp_path):
    idr(tmp_path)
    overrides = ("task=multiview", "dataset=photos", f"dataset.path={tmp_path}", "scale=smoke", "threads=1")
    message = command(*overrides, f"results_dir={tmp_path}").err
    assert "set prior.of=sofa" in message and "none with task=reconstruction" in message
    assert "depth image" not in message
    encoded = command(*overrides, "+method=multiview_encoder", "prior.of=car", f"results_dir={tmp_path}")
    assert "take +method=multiview_dist" in encoded.err
    small = ("task.longest=24", "task.rotations=2", "task.optimiser.iterations=40", "evaluation.grid=24")
    result = command(*overrides, *small, "prior.of=car", "isolation=off", f"results_dir={tmp_path}")
    record, folder = record_of(result.out), Path(result.out.splitlines()[-1])
    assert record["status"] == "ok", record["reason"]
    assert record["metrics"]["mask_iou"] > record["metrics_start"]["mask_iou"]
    to_world = np.loadtxt(folder / "to_world.txt")
    radius = np.linalg.norm(to_world[:3, 0]) * HULL_RADIUS
    assert to_world[:3, 3] == pytest.approx(CENTRE, abs=0.1 * RADIUS) and 1 < radius / RADIUS < 1.3
    assert to_world[:3, 1] / np.linalg.norm(to_world[:3, 1]) == pytest.approx([0.0, 1.0, 0.0], abs=0.03)
    vertices = read_mesh(folder / "mesh_world.ply").vertices - CENTRE
    assert np.abs(vertices.mean(axis=0)).max() < 0.3 * RADIUS and np.linalg.norm(vertices, axis=1).max() < 1.5 * RADIUS
    assert (folder / "summary.png").is_file() and (folder / "curve.png").is_file()
