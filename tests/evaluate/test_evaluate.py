"""What a field is worth against a scene whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from bench.config import EvaluationSettings, load
from bench.evaluate.evaluate import DEFINITIONS, evaluate, picture_view, render_view
from bench.setup.fields import FieldChoice
from bench.setup.inputs import RunInputs
from bench.shape_prior.autodecoder import Prior
from datasets.mesh import Mesh
from datasets.scene import Scene, see
from datasets.truth import Truth
from datasets.views import ViewSampler
from renderers.field import Kind, Meter
from renderers.fields.analytic import Shape, sphere
from renderers.fields.mlp import Decoder

VIEWS = ViewSampler(distance=2.5, field_of_view=50.0, azimuth=(0.0, 0.0), elevation=(0.0, 0.0), resolution=24)
RADIUS = 0.6


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> RunInputs:
    """A sphere as the truth, judged with 3,000 samples."""
    made = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    mesh = Mesh(np.array(made.vertices), np.array(made.faces))
    renderer = load("renderer", "naive", steps=40, epsilon=1e-4)
    decoder = Decoder(layers=1, width=2, code_length=0, skip=0, narrow=False)
    return RunInputs(
        renderer=renderer,
        scene_name="sphere test 0",
        make_scene=lambda: Scene("sphere test 0", mesh, see(Truth(mesh), VIEWS.camera(30.0, 20.0))),
        views=VIEWS,
        make_prior=lambda: Prior(decoder, torch.zeros(1, 0)),
        evaluation=EvaluationSettings(
            grid=48, points=3000, fscore_threshold=0.05, picture=16, gallery=None, every=None, film=None
        ),
        seed=0,
        device=torch.device("cpu"),
        cache=tmp_path_factory.mktemp("cache"),
        field=FieldChoice("prior", None),
    )


def test_the_truth_itself_scores_best(inputs):
    judgement = evaluate(sphere(RADIUS), inputs)
    metrics = judgement.metrics
    assert set(metrics) == set(DEFINITIONS)
    floor = 0.5 * (4 * np.pi * RADIUS**2 / 3000) ** 0.5  # mean distance to the nearest of so many even samples
    assert metrics["accuracy"] == pytest.approx(floor, rel=0.15)
    assert metrics["completeness"] == pytest.approx(floor, rel=0.15)
    assert metrics["fscore"] > 0.99
    assert metrics["normal_consistency"] > 0.99
    assert metrics["depth_mae"] < 3e-3
    assert metrics["mask_iou"] > 0.98
    assert np.linalg.norm(judgement.mesh.vertices, axis=1) == pytest.approx(RADIUS, abs=2e-3)


def test_a_larger_sphere_is_off_by_the_difference(inputs):
    metrics = evaluate(sphere(RADIUS + 0.2), inputs).metrics
    assert metrics["accuracy"] == pytest.approx(0.2, abs=0.01)
    assert metrics["completeness"] == pytest.approx(0.2, abs=0.01)
    assert metrics["chamfer_l2"] == pytest.approx(2 * 0.2**2, rel=0.1)
    assert metrics["fscore"] == 0.0
    assert metrics["mask_iou"] < 0.7


def test_no_renderer_judges_itself(inputs):
    """One that sees a fattened outline, as a large epsilon does, changes its own metrics and no other."""
    fat = replace(inputs, renderer=load("renderer", "idr", epsilon=0.05))
    thin, found = evaluate(sphere(RADIUS), inputs).metrics, evaluate(sphere(RADIUS), fat).metrics
    differing = {name for name in thin if found[name] != thin[name]}
    assert differing == {"own_mask_iou", "own_depth_mae", "own_depth_error_capped"}
    assert found["own_mask_iou"] < 0.95 < thin["own_mask_iou"]


def test_a_field_is_not_evaluated_outside_the_unit_sphere(inputs):
    corner = sphere(0.3, (1.0, 1.0, 1.0))
    spoilt = evaluate(sphere(RADIUS) | corner, inputs)
    assert spoilt.metrics == pytest.approx(evaluate(sphere(RADIUS), inputs).metrics)
    assert np.linalg.norm(spoilt.mesh.vertices, axis=1).max() < 1.0


@pytest.mark.parametrize("value", [1.0, float("nan")])
def test_a_field_without_a_surface_scores_worst(inputs, value):
    judgement = evaluate(Shape(lambda p: torch.full_like(p[..., 0], value) + 0 * p.sum(-1)), inputs)
    assert judgement.mesh is None
    assert judgement.metrics["chamfer_l2"] == judgement.metrics["depth_mae"] == np.inf
    assert judgement.metrics["fscore"] == judgement.metrics["mask_iou"] == 0.0


def test_evaluation_depends_on_the_seed(inputs):
    first, again = evaluate(sphere(0.5), inputs).metrics, evaluate(sphere(0.5), inputs).metrics
    assert first == again
    assert evaluate(sphere(0.5), replace(inputs, seed=1)).metrics["accuracy"] != first["accuracy"]


def test_pictures_of_a_distance_ask_for_few_values_whatever_renderer_is_under_test(inputs):
    slow = replace(inputs, renderer=load("renderer", "dvr"))
    camera, counts = inputs.scene.view.camera, []
    for view in (picture_view, render_view):
        meter = Meter(sphere(RADIUS))
        seen = view(meter, camera, slow)
        counts.append(meter.counts.value / seen.mask.numel())
        assert (seen.mask ^ inputs.scene.view.mask).sum() < 0.03 * seen.mask.sum()
    assert counts[0] < 6 < 30 < counts[1]


def test_pictures_of_a_level_set_are_those_of_the_renderer_under_test(inputs):
    level = Shape(lambda points: 9 * sphere(RADIUS)(points), Kind.LEVEL)
    slow = replace(inputs, renderer=load("renderer", "dvr"))
    by = [view(level, inputs.scene.view.camera, slow).depth for view in (picture_view, render_view)]
    assert torch.equal(*by)


def test_a_rendered_view_is_that_of_the_mesh(inputs):
    seen, truth = render_view(sphere(RADIUS), inputs.scene.view.camera, inputs), inputs.scene.view
    both = seen.mask & truth.mask
    assert both.sum() > 0.97 * truth.mask.sum()
    assert (seen.depth - truth.depth)[both].abs().max() < 0.02
    assert (seen.normals * truth.normals).sum(-1)[both].min() > 0.98
    assert seen.depth[~seen.mask].abs().sum() == 0
    assert seen.normals[~seen.mask].abs().sum() == 0
