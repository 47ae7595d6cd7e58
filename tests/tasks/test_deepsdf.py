"""Completion from samples and the fit of a prior, on planes and balls whose distances are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bench.config import load
from bench.shape_prior import Prior
from bench.solve.latent_code import CodePenalty
from bench.solve.optimise import History, OptimiserSettings, optimise
from bench.tasks.baselines import prior_fit
from bench.tasks.baselines.deepsdf import DeepSDF
from bench.tasks.baselines.prior_fit import PriorFit
from datasets.mesh import extract
from datasets.scene import Scene, Truth, View, see
from tests.looped import each
from tests.tiny import CPU, TRIANGLE, altered, ball_prior, camera_of, plane_decoder, run_of

PRIOR = ball_prior()
RENDERER = load("renderer", "dist")  # neither task renders with it
SETTINGS = DeepSDF(
    points="dense", offset=0.1, distance_weight=2.0, code=CodePenalty(0.5, "sum"),
    optimiser=OptimiserSettings(5, 0.01, "constant"),
)  # fmt: skip
FIT = PriorFit(
    distances=2000, batch=500, surface_width=0.05, code=CodePenalty(0.0, "sum"),
    optimiser=OptimiserSettings(80, 0.05, "cosine"),
)  # fmt: skip


@pytest.fixture
def wall() -> Scene:
    """The plane z = 0.2, seen head-on by 4 x 4 pixels, all within the unit sphere."""
    camera = camera_of(4, field_of_view=20.0)
    depth = torch.full((4, 4), 2.3)
    normals = torch.tensor([0.0, 0, 1]).expand(4, 4, 3).clone()
    return Scene("wall", TRIANGLE, View(camera, depth, normals, torch.ones(4, 4, dtype=torch.bool)))


def plane(height: float) -> Prior:
    """The field z - height - code, whose code is one number."""
    return Prior(plane_decoder((0.0, 0, 1), (-1.0,), height).float(), torch.zeros(2, 1))


def problem_of(scene, prior, **changed):
    return replace(SETTINGS, **changed).problem(scene, prior, RENDERER, seed=0, device=CPU)


def test_a_shifted_plane_costs_its_shift_at_every_sample(wall):
    problem = problem_of(wall, plane(0.25))
    assert problem.loss(0)["distance"].item() == pytest.approx(2.0 * 0.05, rel=1e-4)
    problem.loss(0)["total"].backward()
    assert problem.code.grad.item() == pytest.approx(2.0, rel=1e-4)  # both samples of a point are off to one side


def test_free_space_before_the_surface_must_not_be_inside(wall):
    recorded = []
    problem_of(wall, plane(0.2), free_space=3.0).compare(lambda points: recorded.append(points) or points[..., 2], 0)
    heights = recorded[1][..., 2]
    assert heights.shape == (16, 8) and 0.3 < heights.min() < 0.4 and 0.9 < heights.max() < 1.0
    within = torch.relu(0.7 - heights).mean().item()  # of the field z - 0.7
    problem = problem_of(wall, plane(0.7), free_space=3.0)
    assert problem.loss(0)["free_space"].item() == pytest.approx(3 * within, rel=1e-4) and within > 0.1
    assert problem.rays_per_iteration == 32 + 128
    assert problem_of(wall, plane(0.2), free_space=3.0).loss(0)["free_space"].item() == 0


def test_it_finds_the_plane_and_counts_its_samples(wall):
    problem = problem_of(wall, plane(0.4), code=CodePenalty(0.0, "sum"))
    assert problem.rays_per_iteration == 32
    optimise(problem, OptimiserSettings(200, 0.02, "cosine"), CPU, history=History(), on_step=lambda line: None)
    assert problem.code.item() == pytest.approx(-0.2, abs=2e-3)
    assert problem.counts.value == 201 * 32  # the warm-up too


@pytest.fixture
def ball(wall) -> Scene:
    """The polyhedron of the first code of a prior of balls, seen in 24 x 24 pixels."""
    mesh = extract(PRIOR.decoder.at(PRIOR.codes[0]), grid=32, reach=1.0)
    return replace(wall, mesh=mesh, view=see(Truth(mesh), camera_of(24)))


@each("task", [replace(SETTINGS, code=CodePenalty(0.0, "sum"), optimiser=OptimiserSettings(60, 0.02, "cosine")), FIT])
def test_a_prior_that_can_show_a_shape_is_fitted_to_it_and_the_record_is_filled(
    ball, tmp_path_factory, monkeypatch, task
):
    recorded = []
    gradients = prior_fit.autograd_gradients
    monkeypatch.setattr(
        prior_fit, "autograd_gradients", lambda f, points: recorded.append(points) or gradients(f, points)
    )
    run = run_of(tmp_path_factory.mktemp("run"), RENDERER, PRIOR, ball.view.camera, make_scene=lambda: ball)
    task.execute(altered(run, {"inputs.evaluation.points": 500}))
    record, images = run.record, run.folder / "images.npz"
    assert (record.status, record.reason) == ("ok", "")
    assert record.metrics["chamfer_l2"] < 0.5 * record.metrics_start["chamfer_l2"]
    assert set(record.metrics) <= set(record.definitions) and images.is_file() == (task is FIT)
    if task is FIT:
        assert 0 < record.metrics["floor_chamfer_l2"] < record.metrics_start["chamfer_l2"]
        assert record.metrics["slope_median"] == pytest.approx(1.0, abs=0.25)
        assert record.metrics["distance_error"] < 0.012
        assert Truth(ball.mesh).distance(recorded[0].numpy()).max() < prior_fit.MAX_OFFSET + 1e-4
        with np.load(images) as arrays:
            assert arrays["normals"].shape == (8, 8, 3)
