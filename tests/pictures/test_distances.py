"""The picture of distances: its curves, its colours where a mesh is wrong, and surfaces without points."""

import csv

import numpy as np
import pytest
from matplotlib.image import imread

from bench.evaluate.distances import Distances, measure_distances
from bench.pictures.distances import PIXELS, _brightness, _camera_axes, _splat, draw_distances
from tests.tiny import icosphere


def made(mesh_to_truth, truth_to_mesh, **more) -> Distances:
    points = [np.random.default_rng(0).uniform(-1, 1, (len(values), 3)) for values in (mesh_to_truth, truth_to_mesh)]
    settings = {"unit": "mm", "threshold": 0.2, "up": np.array([0.0, 1.0, 0.0]), "colour_end": 1.0} | more
    return Distances(points[0], np.array(mesh_to_truth), points[1], np.array(truth_to_mesh), **settings)


def test_shares_are_of_points_closer_than_a_limit():
    distances = made([0.1, 0.2, 0.3, np.inf], [0.05, 0.5])
    precision, recall, fscore = distances.shares(np.array([0.01, 0.2, 0.31, 9.0]))
    assert precision.tolist() == [0, 0.25, 0.75, 0.75] and recall.tolist() == [0, 0.5, 0.5, 1]
    assert fscore == pytest.approx([0, 1 / 3, 0.6, 6 / 7])


def test_surfaces_are_compared_in_both_directions():
    small, large = icosphere(1.0, np.zeros(3), 4), icosphere(1.3, np.zeros(3), 4)
    distances = measure_distances(small, large, count=4000, seed=0, threshold=0.2, unit="m")
    assert np.median(distances.mesh_to_truth) == pytest.approx(0.3, abs=0.01)
    assert distances.shares(np.array([0.2]))[0] == 0
    limited = measure_distances(small, large, count=4000, seed=0, threshold=0.2, unit="m", limit=0.25)
    assert limited.mesh_to_truth == pytest.approx(np.minimum(distances.mesh_to_truth, 0.25))
    cloud = measure_distances(small, large.vertices, count=4000, seed=0, threshold=0.2, unit="m")
    assert {*map(tuple, cloud.truth)} <= {*map(tuple, large.vertices)}


def test_the_nearest_point_is_seen_and_gaps_between_points_close(monkeypatch):
    monkeypatch.setattr("bench.pictures.distances.PIXELS", PIXELS)  # tests have fewer
    grid = np.stack(np.meshgrid(np.arange(-150, 150, 4.0), np.arange(-90, 90, 4.0)), axis=-1).reshape(-1, 2)
    near, far = (np.column_stack([grid, np.full(len(grid), depth)]) for depth in (10.0, 90.0))
    index, depth = _splat(np.concatenate([far, near, [[1e6, 0, 0]]]))
    covered = index[PIXELS // 2 - 80 : PIXELS // 2 + 80, PIXELS // 2 - 140 : PIXELS // 2 + 140]
    assert (covered >= len(far)).all() and (index == -1).mean() > 0.5
    assert set(np.unique(depth)) == {10.0, np.inf}
    assert _brightness(depth)[PIXELS // 2, PIXELS // 2] == 1.0


@pytest.mark.parametrize("up", [(0, 1, 0), (0, 0, -3), (0.2, 0.1, 0.9)])
def test_a_view_is_upright_seen_from_above_and_not_mirrored(up):
    up = np.array(up, dtype=float)
    right, down, away = _camera_axes(made([0.1] * 50, [0.1] * 50, up=up), 35.0).T
    assert np.linalg.det([right, down, away]) == pytest.approx(1)
    assert right @ up == pytest.approx(0, abs=1e-9) and down @ up < 0 and away @ up < 0


@pytest.mark.slow
def test_a_picture_is_grey_where_the_mesh_is_missing_and_its_curves_are_written(tmp_path):
    truth = icosphere(1.0, np.zeros(3), 5)
    lacking = np.where(truth.vertices[:, 2] > 0, 5.0, 0.01)
    zeros = np.full(len(truth.vertices), 0.01)
    settings = {"unit": "mm", "threshold": 0.2, "up": np.array([0.0, 1.0, 0.0]), "colour_end": 1.0}
    shares = {}
    for name, values in (("whole", zeros), ("half", lacking)):
        distances = Distances(truth.vertices, zeros, truth.vertices, values, **settings)
        draw_distances(distances, "a sphere", tmp_path / f"{name}.png", distances)
        pixels = imread(tmp_path / f"{name}.png")[..., :3]
        shares[name] = ((np.ptp(pixels, axis=2) < 0.02) & (abs(pixels[..., 0] - 0.353) < 0.03)).mean()
    assert shares["half"] > shares["whole"] + 0.01  # of the picture, which has four views
    with (tmp_path / "half.csv").open() as file:
        rows = [*csv.reader(file)]
    assert rows[0] == ["distance_mm", "precision", "recall", "fscore"]
    assert float(rows[-1][1]) == 1 and float(rows[-1][2]) == pytest.approx((lacking < 1).mean())


def test_a_mesh_without_points_that_count_has_a_picture(tmp_path):
    draw_distances(made([], [0.1, 0.2, 0.4], threshold=None), "empty", tmp_path / "empty.png")
    assert (tmp_path / "empty.png").stat().st_size > 5000
