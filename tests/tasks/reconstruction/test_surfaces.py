"""Surfaces without a renderer, on spheres in closed form: points, Poisson, colours."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bench.evaluate.colours import DEFAULT_VERTEX_COLOUR
from bench.tasks.reconstruction import surfaces
from bench.tasks.reconstruction.stereo import Cloud
from bench.tasks.reconstruction.surfaces import fuse_clouds, given_clouds, poisson, with_colours
from tests.looped import each
from tests.tasks.reconstruction.test_judge import CENTRE
from tests.tasks.reconstruction.test_judge import painted as coloured_ball
from tests.tasks.reconstruction.test_losses import ball, shot_of
from tests.tiny import camera_of, icosphere

RADIUS = 0.6
FRONT, BACK = camera_of(24), camera_of(24, angles=(180.0, 0.0))  # at z = 2.5 and at z = -2.5


def directions(count: int) -> np.ndarray:
    """Evenly spaced unit vectors."""
    heights = 1 - (2 * np.arange(count) + 1) / count
    turns, flat = np.pi * (3 - 5**0.5) * np.arange(count), np.sqrt(1 - heights**2)
    return np.stack([flat * np.cos(turns), flat * np.sin(turns), heights], axis=1)


def halves(points: np.ndarray, front=FRONT, back=BACK) -> list[Cloud]:
    """The points of each side with the camera of their side."""
    return [Cloud(points[points[:, 2] > 0], front), Cloud(points[points[:, 2] <= 0], back)]


def off_sphere(points: np.ndarray) -> np.ndarray:
    return np.abs(np.linalg.norm(points, axis=1) - RADIUS)


def test_observed_depths_become_points_of_the_surface():
    shot = shot_of(ball(), camera_of(24, angles=(30.0, 20.0)))
    partial = replace(shot, depth=shot.depth * (torch.arange(24) < 12))
    clouds = given_clouds([replace(shot, depth=None), partial])
    assert [cloud.camera for cloud in clouds] == [shot.camera]
    assert len(clouds[0].points) == int((partial.depth > 0).sum()) > 50
    assert off_sphere(clouds[0].points - np.array(CENTRE)).max() < 1e-4


@each("outward", [True, False])
def test_normals_look_at_the_camera_of_their_cloud(outward):
    towards = directions(600)
    cameras = (FRONT, BACK) if outward else (BACK, FRONT)
    points, normals = fuse_clouds(halves(RADIUS * towards, *cameras))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    cosines = (normals * points).sum(axis=1) / RADIUS * (1 if outward else -1)
    steep = np.abs(points[:, 2]) > 0.3  # where the plane of the neighbours is clearly in front of or behind a camera
    assert steep.mean() > 0.4 and cosines[steep].min() > 0.98


def test_too_few_points_have_no_surface():
    few = surfaces.NORMAL_NEIGHBOURS - 1
    for clouds, count in (([], 0), ([Cloud(directions(few), FRONT)], few)):
        points, normals = fuse_clouds(clouds)
        assert points.shape == normals.shape == (count, 3) and not normals.any()
        assert poisson(points, normals, depth=4, trim=0.0) is None


def test_points_of_a_sphere_give_a_sphere():
    towards = directions(1500)
    centre = np.array(CENTRE)
    mesh = poisson(RADIUS * towards + centre, towards, depth=5, trim=0.0)
    assert mesh is not None and mesh.watertight and off_sphere(mesh.vertices - centre).max() < 0.02
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.03)  # positive: wound outward


def test_trimming_removes_what_no_point_supports():
    towards = directions(3000)
    upper = towards[towards[:, 2] > 0]
    untrimmed, trimmed = (poisson(RADIUS * upper, upper, depth=5, trim=trim) for trim in (0.0, 4.0))
    assert untrimmed is not None and trimmed is not None
    assert untrimmed.vertices[:, 2].min() < -0.2 and trimmed.vertices[:, 2].min() > -0.15
    assert set(np.unique(trimmed.faces)) == set(range(len(trimmed.vertices)))  # no vertex is left unused
    assert trimmed.vertices[:, 2].max() == pytest.approx(RADIUS, abs=0.02)
    above = trimmed.vertices[:, 2] > 0.05
    assert off_sphere(trimmed.vertices[above]).max() < 0.03
    area = trimmed.area / (2 * np.pi * RADIUS**2)
    assert 0.9 < area < 1.3 and poisson(RADIUS * upper, upper, depth=5, trim=99.0) is None


def test_vertices_have_the_colours_of_photographs_or_are_grey_if_unseen():
    shape, mesh = coloured_ball(), icosphere(RADIUS, CENTRE)
    cameras = [camera_of(96, angles=(across, 0.0)) for across in (-40.0, 0.0, 40.0)]
    coloured = with_colours(mesh, [shot_of(shape, camera) for camera in cameras])
    assert coloured.colours is not None and coloured.faces is mesh.faces
    points, normals = torch.from_numpy(mesh.vertices).float(), (mesh.vertices - CENTRE) / RADIUS
    expected = shape.colours(points, points, points).numpy()
    cosines = []
    for camera in cameras:
        towards = camera.center.numpy() - mesh.vertices
        cosines.append((normals * towards).sum(axis=1) / np.linalg.norm(towards, axis=1))
    best = np.max(cosines, axis=0)
    visible, unseen = best > 0.3, best < -0.1
    assert visible.sum() > 1000 and unseen.sum() > 400
    assert expected[visible].std(axis=0)[1:].min() > 0.1  # a wrong position would have a wrong colour
    assert np.abs(coloured.colours - expected)[visible].max() < 0.02
    assert (coloured.colours[unseen] == DEFAULT_VERTEX_COLOUR).all()


def test_a_photograph_that_a_vertex_faces_counts_most():
    mesh = icosphere(RADIUS)
    front, aside = (shot_of(ball(RADIUS, (0.0, 0.0, 0.0)), camera_of(32, angles=(turn, 0.0))) for turn in (0.0, 60.0))
    white, black = (replace(shot, colours=torch.full((32, 32, 3), c)) for shot, c in ((front, 1.0), (aside, 0.0)))
    colours = with_colours(mesh, [white, black]).colours
    assert colours is not None
    nearest = np.argmax(mesh.vertices[:, 2])
    middle = np.argmax(mesh.vertices @ [np.sin(np.radians(30)), 0, np.cos(np.radians(30))])
    other = np.argmax(mesh.vertices @ aside.camera.center.numpy())
    assert 0.9 < colours[nearest, 0] < 1 and 0 < colours[other, 0] < 0.1
    assert colours[middle, 0] == pytest.approx(0.5, abs=0.1)
