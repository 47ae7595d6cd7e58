"""What a field is worth against a scene whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from bench.config import load
from bench.evaluate.evaluate import DEFINITIONS, evaluate, picture_view, render_view
from bench.setup.inputs import RunInputs
from renderers.field import Meter
from renderers.fields.analytic import Shape, sphere
from tests.tiny import ball_prior, camera_of, run_of, scene_of

RADIUS = 0.6


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> RunInputs:
    """A sphere as the truth, judged with 3,000 samples."""
    camera = camera_of(24, angles=(30.0, 20.0))
    scene = scene_of(trimesh.creation.icosphere(subdivisions=4, radius=RADIUS), camera)
    renderer = load("renderer", "naive", steps=40, epsilon=1e-4)
    found = run_of(tmp_path_factory.mktemp("run"), renderer, ball_prior(), camera, make_scene=lambda: scene).inputs
    return replace(found, evaluation=replace(found.evaluation, grid=48, points=3000, fscore_threshold=0.05))


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


def test_no_renderer_judges_itself(inputs):
    """One that sees a fattened outline, as a large epsilon does, changes its own metrics and no other."""
    fat = replace(inputs, renderer=load("renderer", "idr", epsilon=0.05))
    thin, found = evaluate(sphere(RADIUS), inputs).metrics, evaluate(sphere(RADIUS), fat).metrics
    differing = {name for name in thin if found[name] != thin[name]}
    assert differing == {"own_mask_iou", "own_depth_mae"}
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


def test_pictures_of_a_distance_ask_for_few_values_whatever_renderer_is_under_test(inputs):
    slow = replace(inputs, renderer=load("renderer", "dvr"))
    camera, counts = inputs.scene.view.camera, []
    for view in (picture_view, render_view):
        meter = Meter(sphere(RADIUS))
        seen = view(meter, camera, slow)
        counts.append(meter.counts.value / seen.mask.numel())
        assert (seen.mask ^ inputs.scene.view.mask).sum() < 0.03 * seen.mask.sum()
    assert counts[0] < 6 < 30 < counts[1]


def test_a_rendered_view_is_that_of_the_mesh(inputs):
    seen, truth = render_view(sphere(RADIUS), inputs.scene.view.camera, inputs), inputs.scene.view
    both = seen.mask & truth.mask
    assert both.sum() > 0.97 * truth.mask.sum()
    assert (seen.depth - truth.depth)[both].abs().max() < 0.02
    assert (seen.normals * truth.normals).sum(-1)[both].min() > 0.98
    assert seen.depth[~seen.mask].abs().sum() == 0
    assert seen.normals[~seen.mask].abs().sum() == 0
