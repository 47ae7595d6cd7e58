"""Points that match between photographs of a textured sphere: they lie on it and within the masks."""

import re
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from bench.tasks.reconstruction import stereo
from bench.tasks.reconstruction.stereo import Cloud, Matching, stereo_clouds
from datasets.extras import install_command
from datasets.files.captures.sphere import in_world
from datasets.scene import Truth
from datasets.shot import Shot
from renderers.checks import BadInput
from tests.datasets.test_photographs import PHOTOGRAPHY
from tests.looped import each
from tests.tasks.reconstruction.test_losses import ball, shot_of
from tests.tiny import camera_of, icosphere

RADIUS = 0.7
PIXELS = 64
TOLERANCE = 0.03  # scene units
ALL = Matching(3, 45.0)
SETTINGS = replace(PHOTOGRAPHY, texture_size=0.15)


@pytest.fixture(scope="module")
def sphere() -> Truth:
    pytest.importorskip("cv2", reason="points of photographs need OpenCV")
    return Truth(icosphere(RADIUS))


def taken(sphere: Truth, *angles: tuple[float, float]) -> list[Shot]:
    """Photographs from these angles in degrees, about the vertical axis and above the horizon."""
    cameras = [camera_of(PIXELS, angles=pair) for pair in angles]
    return SETTINGS.take_from(sphere, cameras, seed=0)


def points_of(shots: list[Shot]) -> np.ndarray:
    return np.concatenate([cloud.points for cloud in stereo_clouds(shots, ALL)])


def test_points_lie_on_the_sphere_where_photographs_see_it(sphere):
    shots = taken(sphere, (100.0, 20.0), (115.0, 20.0), (108.0, 35.0))
    clouds = stereo_clouds(shots, ALL)
    expected = [shot.camera.center.tolist() for shot in shots for _ in shots[1:]]
    assert [cloud.camera.center.tolist() for cloud in clouds] == expected
    for cloud in clouds:
        off = np.abs(np.linalg.norm(cloud.points, axis=1) - RADIUS)
        assert len(off) > 1000 and (off < TOLERANCE).mean() > 0.9, (len(off), (off < TOLERANCE).mean())
        towards = cloud.points / np.linalg.norm(cloud.points, axis=1, keepdims=True)
        facing = towards @ cloud.camera.center.double().numpy() / 2.5
        assert (facing > 0.2).mean() > 0.95  # on the visible side
        assert np.median(facing) < 0.97  # not only the middle


def test_points_outside_one_of_two_photographs_are_not_matched(sphere):
    """The sphere is larger than either photograph. Once, points beyond a border were matched with black."""
    cameras = [camera_of(PIXELS, field_of_view=20.0, angles=(turn, 20.0)) for turn in (100.0, 115.0)]
    shots = SETTINGS.take_from(sphere, cameras, seed=0)
    for cloud in stereo_clouds(shots, ALL):
        points = torch.from_numpy(cloud.points).float()
        assert len(points) > 1000
        for camera in cameras:
            pixels, depth = camera.project(points)
            assert (depth > 0).all() and pixels.min() > -1e-3 and pixels.max() < PIXELS + 1e-3


@each("matching, pairs", [
    (Matching(2, 45.0), ["0-10", "0-25", "1-10", "1-25", "10-1", "10-0", "25-10", "25-1", "60-25"]),
    (Matching(1, 45.0), ["0-10", "1-10", "10-1", "25-10", "60-25"]),
    (Matching(4, 12.0), ["0-10", "1-10", "10-1", "10-0"]), (Matching(4, 5.0), []),
])  # fmt: skip
def test_neighbours_are_the_nearest_by_angle_within_bounds(sphere, monkeypatch, matching, pairs):
    shots = [shot_of(ball(), camera_of(8, angles=(turn, 0.0)), f"{turn:g}") for turn in (0.0, 1.0, 10.0, 25.0, 60.0)]
    matched_pairs = []

    def matched(shot: Shot, other: Shot) -> Cloud:
        matched_pairs.append(f"{shot.name}-{other.name}")
        return Cloud(np.zeros((0, 3)), shot.camera)

    monkeypatch.setattr(stereo, "_match", matched)
    clouds = stereo_clouds(shots, matching)
    assert matched_pairs == pairs and len(clouds) == len(pairs)


def test_a_photograph_is_unchanged_by_the_identity(sphere):
    """The centre of the first pixel is at (0, 0) in OpenCV, half a pixel less than here."""
    (shot,) = taken(sphere, (10.0, 20.0))
    pinhole = shot.camera.intrinsics.double().numpy() - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    turned = stereo._rectify(shot, shot.camera.world_to_camera.double().numpy()[:3, :3], pinhole, PIXELS)
    np.testing.assert_allclose(turned.astype(float), 255 * shot.colours.numpy(), atol=2)


def test_points_outside_of_a_mask_are_left_out(sphere):
    shots = taken(sphere, (0.0, 0.0), (15.0, 0.0))
    free = points_of([replace(shot, mask=None) for shot in shots])
    upper = torch.zeros(PIXELS, PIXELS, dtype=torch.bool)
    upper[: PIXELS // 2] = True
    halved = points_of([replace(shots[0], mask=None), replace(shots[1], mask=upper)])
    above = free[:, 1] > 0  # y is up, and both cameras look along the horizon
    assert 0.3 < above.mean() < 0.7
    np.testing.assert_allclose(halved, free[above])


def test_points_outside_of_the_unit_sphere_are_left_out(sphere):
    """In a world that is half as large, the same photographs show a sphere of radius 1.4."""
    shots = [in_world(shot, np.diag([0.5, 0.5, 0.5, 1.0])) for shot in taken(sphere, (0.0, 0.0), (15.0, 0.0))]
    assert all((np.linalg.norm(cloud.points, axis=1) < 1).all() for cloud in stereo_clouds(shots, ALL))


def test_without_opencv_the_error_has_a_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    shots = [shot_of(ball(), camera_of(8, angles=(turn, 0.0))) for turn in (0.0, 10.0)]
    with pytest.raises(BadInput, match=re.escape(f"task=stereo needs OpenCV: type {install_command('stereo')}")):
        stereo_clouds(shots, ALL)
