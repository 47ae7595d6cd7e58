"""The subject of a reconstruction: held-out photographs, observed depths, visibility, and hull distances."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.ndimage import binary_dilation

from bench.tasks.reconstruction.baselines import Hull
from bench.tasks.reconstruction.subject import (
    HULL_SAMPLES,
    VISIBILITY_TOLERANCE,
    Depths,
    Subject,
    given_distances,
    hull_distances,
)
from datasets.files.meshes import concatenate_meshes
from datasets.mesh import Mesh
from datasets.photographs import around
from datasets.scene import Surface, sample_surface
from renderers.checks import BadInput
from tests.datasets.test_photographs import PHOTOGRAPHY
from tests.looped import each
from tests.tasks.reconstruction.test_losses import RENDERERS, ball, shot_of
from tests.tiny import ball_prior, camera_of, icosphere, run_of, scene_of

NO_DEPTHS = Depths("none", 0.0)
CAMERA = camera_of(24, angles=(0.0, 20.0))
IMAGES = replace(PHOTOGRAPHY, places="sphere", views=9)


@pytest.fixture
def inputs(tmp_path):
    scene = scene_of(icosphere(0.6), CAMERA)
    return run_of(tmp_path, RENDERERS["idr"], ball_prior(), CAMERA, make_scene=lambda: scene).inputs


def subject_of(
    inputs, depths: Depths = NO_DEPTHS, *, longest: int = 16, held_out: int = 4, masks: bool = True
) -> Subject:
    return Hull(IMAGES, longest, held_out, masks, depths, samples=8).subject(inputs)


def test_every_nth_photograph_is_held_out(inputs):
    subject = subject_of(inputs, held_out=3)
    assert [shot.name for shot in subject.held_out] == ["0", "3", "6"]
    assert [shot.name for shot in subject.input_shots] == ["1", "2", "4", "5", "7", "8"]
    assert subject.truth is inputs.scene.mesh
    assert "9 rendered photographs of 16 x 16 pixels" in subject.summary
    assert subject.summary.endswith(f"{len(subject.held_out)} of them are held out")
    assert all(shot.colours.shape == (16, 16, 3) for shot in subject.input_shots)
    blind = subject_of(inputs, masks=False)
    assert all(shot.mask is None for shot in blind.input_shots)
    assert all(shot.mask is not None for shot in blind.held_out)


def test_too_few_photographs_are_refused(inputs):
    few = replace(IMAGES, views=4)
    with pytest.raises(BadInput, match="4 photographs with every 2th held out leave 2: give more"):
        Hull(few, 16, 2, True, NO_DEPTHS, samples=8).subject(inputs)
    assert len(Hull(few, 16, 4, True, NO_DEPTHS, samples=8).subject(inputs).input_shots) == 3


@each("points, count", [("dense", None), ("25%", None), ("30", 30)])
def test_the_number_of_observed_depths_follows_the_setting(points, count):
    shot = shot_of(ball(), CAMERA)
    depth = Depths(points, 0.0).apply(shot, (0, 3)).depth
    assert shot.mask is not None and depth is not None and shot.depth is not None
    foreground = int(shot.mask.sum())
    expected = count or round(foreground * (0.25 if "%" in points else 1))
    observed = depth > 0
    assert int(observed.sum()) == expected and not (observed & ~shot.mask).any()
    assert torch.equal(depth[observed], shot.depth[observed])
    again, other = (Depths(points, 0.0).apply(shot, (0, seed)).depth for seed in (3, 4))
    assert torch.equal(depth, again) and torch.equal(depth, other) == (points == "dense")


def test_depths_have_noise_of_the_standard_deviation():
    shot = shot_of(ball(), camera_of(64))
    assert shot.mask is not None and shot.depth is not None
    depth = Depths("dense", 0.05).apply(shot, (0, 0)).depth
    assert depth is not None and (depth[~shot.mask] == 0).all()
    off = (depth - shot.depth)[shot.mask]
    assert off.std().item() == pytest.approx(0.05, rel=0.1) and abs(off.mean().item()) < 0.01
    assert NO_DEPTHS.apply(shot, (0, 0)).depth is None
    with pytest.raises(ValueError, match=r"task\.depths\.noise must be at least 0"):
        Depths("dense", -0.1)


def visible_to(*cameras, surface: Mesh, points: np.ndarray) -> np.ndarray:
    shots = tuple(shot_of(ball(), camera) for camera in cameras)
    return Subject(shots, (), surface, "").visible_points(
        surface, Surface(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)))
    )


def test_points_behind_a_surface_or_outside_the_image_are_not_visible():
    front, back = icosphere(0.3, (0.0, 0.0, 0.6)), icosphere(0.25, (0.0, 0.0, -0.5))
    both = concatenate_meshes([front, back])
    towards = np.array(
        [[0.0, 0.0, 0.9], [0.05, 0.0, -0.5 + np.sqrt(0.25**2 - 0.05**2)]]
    )  # one point on each, towards the camera
    camera, aside = camera_of(16), camera_of(16, angles=(60.0, 0.0))
    assert visible_to(camera, surface=both, points=towards).tolist() == [True, False]
    assert visible_to(camera, surface=back, points=towards[1:]).tolist() == [True]
    assert visible_to(camera, aside, surface=both, points=towards).tolist() == [True, True]
    narrow = camera_of(16, field_of_view=10.0)  # 0.16 to each side at this height
    points = np.array([[0.1, 0.0, 0.6 + np.sqrt(0.3**2 - 0.1**2)], [0.2, 0.0, 0.6 + np.sqrt(0.3**2 - 0.2**2)]])
    assert visible_to(narrow, surface=front, points=points).tolist() == [True, False]
    assert visible_to(camera, surface=front, points=points).tolist() == [True, True]
    within = points[:1] - [0.0, 0.0, 5 * VISIBILITY_TOLERANCE]
    assert visible_to(narrow, surface=front, points=within).tolist() == [False]


@each("wound", [1, -1])
def test_the_far_side_of_a_thin_plate_is_not_visible_for_either_winding(wound):
    box = trimesh.creation.box(extents=(0.8, 0.8, 0.9 * VISIBILITY_TOLERANCE))
    plate = Mesh(box.vertices, box.faces[:, ::wound])
    sampled = sample_surface(plate, 2000, 0)
    towards = sampled.points[:, 2] > 0
    sides = (
        np.abs(sampled.points[:, :2]).max(axis=1) < 0.38
    )  # away from the rim, which the tolerance lets a camera see through
    for angle, expected in ((0.0, towards), (45.0, towards), (180.0, ~towards)):
        visible = Subject((shot_of(ball(), camera_of(16, angles=(angle, 0.0))),), (), plate, "").visible_points(
            plate, sampled
        )
        assert np.array_equal(visible[sides], expected[sides])


@pytest.fixture(scope="module")
def shots():
    """Exact photographs of a sphere from all around, without depths."""
    return [replace(shot_of(ball(), camera), depth=None) for camera in around(camera_of(32), 12)]


def test_the_hull_lies_in_front_of_the_surface_and_only_within_the_mask(shots):
    spacing = 2 / (HULL_SAMPLES - 1)
    pixel = 2.5 * 2 * np.tan(np.radians(25)) / 32  # in scene units, at the sphere
    for shot, hull in zip(shots, hull_distances(shots), strict=True):
        true = ball().distance(shot.camera.double().rays())
        assert (hull.isfinite() & shot.mask).sum() > 0.9 * shot.mask.sum()
        inner = torch.from_numpy(~binary_dilation(~shot.mask.numpy(), iterations=3))  # rays that are not grazing
        assert int(inner.sum()) > 20 and hull[inner].isfinite().all()
        behind = (hull - true)[inner]
        assert behind.max() < pixel / 2 + spacing  # a mask is known up to half a pixel
        assert behind.min() > -4 * pixel and behind.mean() < pixel / 4
        outside = torch.from_numpy(~binary_dilation(shot.mask.numpy()))
        assert hull[outside].isnan().all()


def test_observed_depths_override_the_hull(shots):
    plain = hull_distances(shots)
    assert shots[2].mask is not None
    row, column = (int(coordinate) for coordinate in shots[2].mask.nonzero()[40])
    depth = torch.zeros(32, 32)
    depth[row, column] = 1.7
    mixed_shots = [*shots[:2], replace(shots[2], depth=depth), *shots[3:]]
    mixed = hull_distances(mixed_shots)
    expected = plain[2].clone()
    expected[row, column] = shots[2].camera.distance(depth)[row, column]
    torch.testing.assert_close(mixed[2], expected, equal_nan=True)
    torch.testing.assert_close(mixed[3], plain[3], equal_nan=True)
    alone = given_distances(mixed_shots)
    assert alone[0].isnan().all() and int(alone[2].isfinite().sum()) == 1
    assert alone[2][row, column] == expected[row, column]


def test_missing_masks_and_an_empty_hull_are_errors_with_a_remedy(shots):
    blind = [*shots[:3], replace(shots[3], mask=None)]
    empty = [replace(shot, mask=torch.zeros(32, 32, dtype=torch.bool)) for shot in shots[:4]]
    for wrong in (blind, empty):
        with pytest.raises(BadInput, match=r"the visual hull needs a mask of each .*, or set task\.guide=none"):
            hull_distances(wrong)
