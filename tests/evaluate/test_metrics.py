import re
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.evaluate.distances import subsample
from bench.evaluate.evaluate import (
    DEFINITIONS,
    IMAGE_DEFINITIONS,
    RENDERER_DEFINITIONS,
    WORST_SURFACE,
    surface_metrics,
    view_metrics,
)
from datasets.scene import Surface, View
from tests.tiny import camera_of


def surface(points, normals) -> Surface:
    return Surface(
        np.array(points, dtype=np.float64).reshape(-1, 3), np.array(normals, dtype=np.float64).reshape(-1, 3)
    )


def random_surface(seed: int, count: int) -> Surface:
    generator = np.random.default_rng(seed)
    return Surface(generator.standard_normal((count, 3)), generator.standard_normal((count, 3)))


def test_worked_example():
    # Truth:      A (0,0,0) normal +z,   B (1,0,0) normal +z.
    # Prediction: P (0,0,0.1) normal -z, Q (1,0,0.3) normal (0,3,4)/5, R (1,0.2,0) normal +x.
    # Prediction -> truth: P-A 0.1, Q-B 0.3, R-B 0.2; cosines 1, 0.8, 0.
    #   mean 0.6/3 = 0.2; mean square (0.01 + 0.09 + 0.04)/3 = 0.14/3; mean cosine 1.8/3 = 0.6.
    # Truth -> prediction: A-P 0.1, B-R 0.2; cosines 1, 0.
    #   mean 0.15; mean square (0.01 + 0.04)/2 = 0.025; mean cosine 0.5.
    # Threshold 0.15: precision 1/3, recall 1/2, F = 2 * (1/6) / (5/6) = 0.4.
    truth = surface([[0, 0, 0], [1, 0, 0]], [[0, 0, 1], [0, 0, 1]])
    predicted = surface([[0, 0, 0.1], [1, 0, 0.3], [1, 0.2, 0]], [[0, 0, -1], [0, 0.6, 0.8], [1, 0, 0]])
    assert surface_metrics(predicted, truth, threshold=0.15) == pytest.approx(
        {
            "chamfer_l2": 0.14 / 3 + 0.025,
            "chamfer_l1": 0.175,
            "chamfer_gt_to_pred": 0.025,
            "accuracy": 0.2,
            "completeness": 0.15,
            "fscore": 0.4,
            "normal_consistency": 0.55,
        }
    )


def test_a_distance_equal_to_the_threshold_does_not_count():
    # Both ways the distances are 1/2 and 1/4; below 1/2 lies one of two, so precision, recall and F are 1/2.
    truth = surface([[0, 0, 0], [4, 0, 0]], [[0, 0, 1], [0, 0, 1]])
    predicted = surface([[0, 0, 0.5], [4, 0, 0.25]], [[0, 0, 1], [0, 0, 1]])
    assert surface_metrics(predicted, truth, threshold=0.5)["fscore"] == 0.5


def test_swapping_the_surfaces():
    first, second = random_surface(1, 40), random_surface(2, 70)
    forth = surface_metrics(first, second, threshold=0.5)
    back = surface_metrics(second, first, threshold=0.5)
    for name in ("chamfer_l2", "chamfer_l1", "fscore", "normal_consistency"):
        assert forth[name] == pytest.approx(back[name])
    assert forth["accuracy"] == back["completeness"] != forth["completeness"]


def test_length_and_sign_of_normals_do_not_count_and_zero_scores_zero():
    truth = surface([[0, 0, 0]], [[0, 0, 1]])
    for normal, expected in (([0, 0, -7], 1), ([0, 3, 4], 0.8), ([0, 0, 0], 0)):
        measured = surface_metrics(surface([[0, 0, 0]], [normal]), truth, threshold=0.01)
        assert measured["normal_consistency"] == pytest.approx(expected)


def test_no_prediction_scores_worst():
    for predicted in (None, surface([], [])):
        measured = surface_metrics(predicted, random_surface(0, 5), threshold=0.01)
        assert measured.pop("fscore") == measured.pop("normal_consistency") == 0
        assert set(measured.values()) == {np.inf}
    with pytest.raises(ValueError, match="truth must have points, found 0"):
        surface_metrics(None, surface([], []), threshold=0.1)


# Powers of two scale floating-point numbers exactly, so even the threshold comparison may not change.
@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**16), exponent=st.integers(-12, 12), count=st.integers(1, 20))
def test_scaling_the_scene_scales_the_distances(seed, exponent, count):
    first, second, scale = random_surface(seed, count), random_surface(seed + 1, 9), 2.0**exponent
    plain = surface_metrics(first, second, threshold=0.5)
    scaled = surface_metrics(
        Surface(first.points * scale, first.normals),
        Surface(second.points * scale, second.normals),
        threshold=0.5 * scale,
    )
    power = {"chamfer_l2": 2, "chamfer_gt_to_pred": 2, "fscore": 0, "normal_consistency": 0}
    assert scaled == pytest.approx({name: plain[name] * scale ** power.get(name, 1) for name in plain})


def view(depth: np.ndarray, mask: np.ndarray) -> View:
    return View(camera_of(8), torch.from_numpy(depth), torch.zeros(*depth.shape, 3), torch.from_numpy(mask))


def test_image_worked_example():
    # Foreground in both: two pixels, with errors 0.5 and 0.25; in at least one: three.
    predicted_depth = np.array([[1.5, 2.0], [9.0, np.inf]], dtype=np.float32)
    truth_depth = np.array([[1.0, 2.25], [np.nan, 0.0]], dtype=np.float32)
    predicted_mask, truth_mask = np.array([[True, True], [True, False]]), np.array([[True, True], [False, False]])
    measured = view_metrics(view(predicted_depth, predicted_mask), view(truth_depth, truth_mask))
    assert measured == pytest.approx({"depth_mae": 0.375, "depth_bias": 0.125, "mask_iou": 2 / 3})


def test_image_edges():
    depth, none, every = np.ones((2, 3)), np.zeros((2, 3), dtype=bool), np.ones((2, 3), dtype=bool)

    def measured(depth: np.ndarray, mask: np.ndarray, true_mask: np.ndarray) -> tuple[float, ...]:
        return tuple(view_metrics(view(depth, mask), view(np.ones((2, 3)), true_mask)).values())

    def equal(*expected: float) -> Any:
        return pytest.approx(expected, nan_ok=True)

    assert measured(depth, every, every) == equal(0, 0, 1)
    assert measured(depth / 2, every, every) == equal(0.5, -0.5, 1)  # in front
    assert measured(depth, none, every) == equal(np.inf, np.nan, 0)
    assert measured(depth, none, none) == equal(np.inf, np.nan, 1)
    assert measured(depth * np.nan, every, every) == equal(np.inf, np.nan, 1)
    unknown = np.array([[1.0, 0, 0], [1, 1, 1]])  # 0 is no depth
    assert view_metrics(view(depth, every), view(unknown, every)) == {"depth_mae": 0, "depth_bias": 0, "mask_iou": 1}


def test_drawn_points_are_different_ones():
    points = np.arange(300.0).reshape(100, 3)
    some = subsample(points, 60, seed=0)
    assert len(np.unique(some, axis=0)) == 60 and np.isin(some, points).all()
    assert np.array_equal(subsample(points, 100, seed=0), points)


def test_every_metric_has_one_sentence():
    assert set(DEFINITIONS) == {*WORST_SURFACE, *IMAGE_DEFINITIONS, *RENDERER_DEFINITIONS}
    for sentence in DEFINITIONS.values():
        assert re.fullmatch(r"[A-Z][^\n]*\.", sentence)
        assert re.search(r"scene units|from 0 to 1", sentence)
