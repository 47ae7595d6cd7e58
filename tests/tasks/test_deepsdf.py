"""Completion from samples and the fit of a prior, on planes and balls whose distances are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bench.config import load
from bench.shape_prior import Prior, sample_distances
from bench.solve.latent_code import CodePenalty
from bench.solve.optimise import History, OptimiserSettings, optimise
from bench.tasks.deepsdf import DeepSDF
from bench.tasks.prior_fit import PriorFit
from datasets.mesh import Mesh
from datasets.scene import Scene, View
from tests.run.driving import command, record_of
from tests.tiny import CPU, ball_prior, camera_of, plane_decoder

RENDERER = load("renderer", "dist")  # neither task renders with it
SETTINGS = DeepSDF(
    points="dense", offset=0.1, distance_weight=2.0, code=CodePenalty(0.5, "sum"),
    optimiser=OptimiserSettings(5, 0.01, "constant"),
)  # fmt: skip
FIT = PriorFit(
    distances=2000, batch=500, surface_width=0.05, code=CodePenalty(0.0, "sum"),
    optimiser=OptimiserSettings(200, 0.02, "cosine"),
)  # fmt: skip


@pytest.fixture
def wall() -> Scene:
    """The plane z = 0.2, seen head-on by 4 x 4 pixels, all within the unit sphere."""
    camera = camera_of(4, field_of_view=20.0)
    depth = torch.full((4, 4), 2.3)
    normals = torch.tensor([0.0, 0, 1]).expand(4, 4, 3).clone()
    corners = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 2, 1]]))
    return Scene("wall", corners, View(camera, depth, normals, torch.ones(4, 4, dtype=torch.bool)))


def plane(height: float) -> Prior:
    """The field z - height - code, whose code is one number."""
    return Prior(plane_decoder((0.0, 0, 1), (-1.0,), height).float(), torch.zeros(2, 1))


def problem_of(scene, prior, **changed):
    return replace(SETTINGS, **changed).problem(scene, prior, RENDERER, seed=0, device=CPU)


def test_the_true_plane_costs_nothing(wall):
    terms = problem_of(wall, plane(0.2)).loss(0)
    assert {name: term.item() for name, term in terms.items()} == pytest.approx(
        {"total": 0, "distance": 0, "code": 0}, abs=1e-6
    )


def test_a_shifted_plane_costs_its_shift_at_every_sample(wall):
    problem = problem_of(wall, plane(0.25))
    assert problem.loss(0)["distance"].item() == pytest.approx(2.0 * 0.05, rel=1e-4)
    problem.loss(0)["total"].backward()
    assert problem.code.grad.item() == pytest.approx(2.0, rel=1e-4)  # both samples of a point are off to one side


def test_the_samples_lie_on_both_sides_at_the_offset(wall):
    asked = []
    problem_of(wall, plane(0.2)).compare(lambda points: asked.append(points) or points[:, 2], 0)
    assert asked[0][:, 2].sort().values.tolist() == pytest.approx([0.1] * 16 + [0.3] * 16, abs=1e-5)


def test_it_finds_the_plane_and_counts_its_samples(wall):
    problem = problem_of(wall, plane(0.4), code=CodePenalty(0.0, "sum"))
    assert problem.rays_per_iteration == 32
    optimise(problem, OptimiserSettings(200, 0.02, "cosine"), CPU, history=History(), on_step=lambda line: None)
    assert problem.code.item() == pytest.approx(-0.2, abs=2e-3)
    assert problem.counts.value == 201 * 32  # the warm-up too


def test_a_prior_that_can_show_a_shape_is_fitted_to_it(wall):
    from datasets.mesh import extract

    prior = ball_prior()
    true = prior.decoder.at(prior.codes[0])
    scene = replace(wall, mesh=extract(true, grid=32, reach=1.0))
    problem = FIT.problem(scene, prior, RENDERER, seed=0, device=CPU)
    optimise(problem, FIT.optimiser, CPU, history=History(), on_step=lambda line: None)
    points, distances = sample_distances(scene.mesh, 1000, 5)
    near = distances.abs() < 0.05
    error = (problem.field()(points[near]) - distances[near]).abs().mean()
    before = (prior.decoder.at(torch.zeros(4))(points[near]) - distances[near]).abs().mean()
    assert error < 0.012
    assert error < before / 4


def test_both_run_from_the_command_line_and_fill_their_records(tmp_path):
    small = ("scale=smoke", "evaluation.picture=24", "evaluation.grid=32", "evaluation.points=500", "isolation=off")
    for task, more in (
        ("deepsdf", ("task.points=50", "evaluation.picture=null")),
        ("prior_fit", ("task.distances=2000",)),
    ):
        few = ("task.optimiser.iterations=30", "evaluation.every=null", "threads=1", f"results_dir={tmp_path / 'r'}")
        code, out, err = command(f"task={task}", *small, *few, *more)
        assert (code, err) == (0, "")
        record = record_of(out)
        assert record["metrics"]["chamfer_l2"] < record["metrics_start"]["chamfer_l2"]
        assert set(record["metrics"]) <= set(record["definitions"])
    folder = next((tmp_path / "r" / "runs").glob("prior_fit-*"))
    assert 0 < record["metrics"]["floor_chamfer_l2"] < record["metrics"]["chamfer_l2"]
    assert record["metrics"]["slope_median"] == pytest.approx(1.0, abs=0.25)
    assert record["metrics"]["distance_error"] < 0.03
    with np.load(folder / "images.npz") as images:
        assert images["normals"].shape == (24, 24, 3)
        assert np.median(images["gradient_length"]) == pytest.approx(record["metrics"]["slope_median"], rel=1e-3)
