"""Weight before the surface and bumps that no photograph sees, on spheres whose errors are known."""

from dataclasses import replace

import numpy as np
import pytest

from bench.config import load
from bench.evaluate.evaluate import Surface
from bench.reconstruct.judge import mesh_views
from bench.reconstruct.subject import Subject
from bench.reconstruct.symptoms import early_weight, roughness, roughness_scores
from tests.reconstruct.test_judge import inputs, painted, subject  # noqa: F401, fixtures


def plane(tilt: float, *, count: int = 2000, side: float = 1.0) -> Surface:
    """Points of a plane whose normals lean by so many degrees to one side or the other, in turn."""
    points = np.random.default_rng(0).uniform(0, side, (count, 3)) * (1, 1, 0)
    lean = np.radians(tilt) * np.where(np.arange(count) % 2, 1, -1)
    return Surface(points, np.stack([np.sin(lean), 0 * lean, np.cos(lean)], axis=1))


def test_roughness_is_the_mean_angle_of_neighbours():
    assert roughness(plane(0)) == 0
    assert roughness(plane(5)) == pytest.approx(5, rel=0.05)  # half of the pairs are 10 degrees apart
    flipped = replace(plane(0), normals=plane(0).normals * np.where(np.arange(2000) % 3, 1, -1)[:, None])
    assert roughness(flipped) == 0
    assert roughness(plane(5, count=20, side=100.0)) is None  # no neighbours
    assert roughness(plane(5, count=1)) is None


def test_roughness_is_over_the_seen_and_the_unseen_part_and_less_that_of_the_truth():
    bumpy, smooth = plane(8), plane(2)
    seen = bumpy.points[:, 0] < 0.5
    normals = np.where(seen[:, None], smooth.normals, bumpy.normals)
    scores = roughness_scores((replace(bumpy, normals=normals), seen), (smooth, seen))
    assert scores["seen_roughness"] == pytest.approx(0, abs=1e-9)
    assert scores["unseen_roughness"] == pytest.approx(6, rel=0.05)
    whole = np.ones_like(seen)  # without a side that is unseen
    assert roughness_scores((smooth, whole), (smooth, seen))["unseen_roughness"] == np.inf
    assert roughness_scores((smooth, whole), (smooth, whole))["unseen_roughness"] == 0
    assert roughness_scores(None, (smooth, seen)) == {"seen_roughness": np.inf, "unseen_roughness": np.inf}


@pytest.mark.parametrize(("sharpness", "least", "most"), [(400.0, 0.0, 0.01), (20.0, 0.2, 0.6)])
def test_a_wide_blur_has_weight_before_the_surface(subject: Subject, inputs, sharpness, least, most):  # noqa: F811
    views = mesh_views(subject.truth, subject.held_out[:1])
    neus = load("renderer", "neus", sharpness=sharpness, sharpening=0)
    found = early_weight(painted(), views, replace(inputs, renderer=neus))
    assert least <= found["own_early_weight"] < most


def test_a_renderer_of_hits_has_no_weight_before_the_surface(subject: Subject, inputs):  # noqa: F811
    assert early_weight(painted(), mesh_views(subject.truth, subject.held_out[:1]), inputs) == {}
    assert early_weight(painted(), mesh_views(None, subject.held_out), inputs) == {}
