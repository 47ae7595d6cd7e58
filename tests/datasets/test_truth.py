"""Ground truth of meshes against closed forms of the box and the sphere."""

import numpy as np
import pytest
import trimesh

from datasets.mesh import Mesh
from datasets.scene import Truth, sample_surface
from tests.tiny import mesh_of


@pytest.fixture(scope="module")
def box() -> Mesh:
    return mesh_of(trimesh.creation.box((1, 1, 1)))


def box_distance(points: np.ndarray) -> np.ndarray:
    over = np.abs(points) - 0.5
    return np.linalg.norm(np.maximum(over, 0), axis=-1) + np.minimum(over.max(axis=-1), 0)


def test_rays_hit_a_box_where_they_must(box):
    origins = np.array([[0.1, 0.2, -2], [0.1, 0.2, -2], [2, 0.1, 0.2], [0.1, 0.2, 0.3]])
    directions = np.array([[0.0, 0, 1], [0, 0, -1], [-3, 0, 0], [0, 5, 0]])  # ahead, away, not unit, from inside
    hits = Truth(box).cast(origins, directions)
    assert hits.hit.tolist() == [True, False, True, True]
    assert hits.distance[hits.hit] == pytest.approx([1.5, 1.5, 0.3], abs=1e-6) and hits.distance[1] == np.inf
    assert hits.normals[hits.hit] == pytest.approx(np.array([[0, 0, -1], [1, 0, 0], [0, 1, 0]]), abs=1e-6)
    assert {hits.distance.dtype, hits.normals.dtype} == {np.dtype(np.float32)}


def test_no_rays_give_no_hits(box):
    assert Truth(box).cast(np.zeros((0, 3)), np.zeros((0, 3))).distance.shape == (0,)


def test_signed_distance_of_a_box_is_exact_also_in_line_with_edges_and_keeps_leading_shape(box):
    aligned = np.stack(np.meshgrid(*[np.linspace(-0.75, 0.75, 7)] * 3), axis=-1)
    for points in (np.random.default_rng(0).uniform(-1, 1, (20, 50, 3)), aligned):
        distance = Truth(box).signed_distance(points)
        assert distance.dtype == np.float32 and distance == pytest.approx(box_distance(points), abs=1e-5)


def test_samples_lie_on_the_surface_evenly_by_area_with_outward_normals():
    mesh = mesh_of(trimesh.creation.box((1, 2, 4)))
    sampled = sample_surface(mesh, 20000, seed=0)
    points, normals = sampled.points, sampled.normals
    assert np.abs(Truth(mesh).signed_distance(points)).max() < 1e-6
    assert Truth(mesh).signed_distance(points + 0.01 * normals).min() > 0.009
    fractions = np.abs(normals).mean(axis=0)
    assert fractions == pytest.approx(np.array([8, 4, 2]) / 14, abs=0.02)
    assert points.mean(axis=0) == pytest.approx([0, 0, 0], abs=0.05)
    assert points.std(axis=0)[2] == pytest.approx(np.sqrt((12 * 16 / 12 + 2 * 4) / 14), abs=0.03)


def test_samples_follow_the_seed(box):
    assert np.array_equal(sample_surface(box, 10, seed=1).points, sample_surface(box, 10, seed=1).points)
    assert not np.array_equal(sample_surface(box, 10, seed=1).points, sample_surface(box, 10, seed=2).points)
    assert sample_surface(box, 0, seed=1).points.shape == (0, 3)


def test_the_distance_to_an_open_mesh_has_no_sign():
    square = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    distances = Truth(square, closed=False).distance(np.array([[0.5, 0.5, 0.3], [0.5, 0.5, -0.3], [2.0, 0.5, 0.0]]))
    assert distances == pytest.approx([0.3, 0.3, 1.0], abs=1e-6)
