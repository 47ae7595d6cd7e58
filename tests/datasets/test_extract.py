"""From fields with a known zero set to meshes."""

import numpy as np
import pytest
import torch

from datasets.mesh import extract
from renderers.field import Kind, Meter
from renderers.fields.analytic import Shape, box, sphere
from tests.looped import each

CENTRE = (0.3, -0.1, 0.2)


def test_a_sphere_has_its_radius_its_place_and_faces_that_wind_outward():
    mesh = extract(sphere(0.5, CENTRE), grid=48, reach=1.05)
    assert mesh is not None
    out = mesh.vertices - CENTRE
    radii = (out**2).sum(1) ** 0.5
    assert radii.min() > 0.499
    assert radii.max() < 0.501
    assert mesh.watertight
    assert mesh.volume == pytest.approx(4 / 3 * torch.pi * 0.5**3, rel=0.01)
    assert ((out[mesh.faces[:, 0]] * mesh.crosses).sum(1) > 0).all()


def test_each_axis_keeps_its_own_size():
    mesh = extract(box((0.2, 0.4, 0.7)), grid=41, reach=1.0)
    assert mesh is not None
    assert mesh.vertices.max(0) == pytest.approx([0.2, 0.4, 0.7], abs=1e-5)
    assert mesh.vertices.min(0) == pytest.approx([-0.2, -0.4, -0.7], abs=1e-5)


@each("value", [1.0, -1.0, float("nan")])
def test_values_of_one_sign_have_no_surface(value):
    assert extract(Shape(lambda p: torch.full_like(p[..., 0], value)), grid=8, reach=1.0) is None


def test_a_surface_that_leaves_the_cube_is_left_open():
    mesh = extract(sphere(1.0), grid=24, reach=0.9)
    assert mesh is not None
    assert not mesh.watertight


@each("scale", [0.2, 1.0, 3.0])
def test_only_the_neighbourhood_of_the_surface_is_asked_and_nothing_of_it_is_lost(scale):
    # a thin plate and a small ball apart from it; a field three times too steep is followed from block to block
    shape = box((0.8, 0.03, 0.6)) | sphere(0.1, (0.0, 0.7, 0.0))
    counted = Meter(Shape(lambda p: scale * shape(p), Kind.BOUND))
    near = extract(counted, grid=96, reach=1.05)
    everywhere = extract(Shape(lambda p: scale * shape(p), Kind.LEVEL), grid=96, reach=1.05)
    assert np.array_equal(near.vertices, everywhere.vertices) and np.array_equal(near.faces, everywhere.faces)
    assert scale < 1 or counted.counts.value < 96**3 / 8


def test_a_surface_that_leads_out_of_the_asked_blocks_is_followed():
    # a plate between the middles of blocks; its values are distances at one end, and jump by more and more to the other
    plate = box((0.8, 0.04, 0.6)).translate((0.0, 0.133, 0.0))

    def jumping(points):
        return plate(points) + plate(points).sign() * 0.4 * (points[..., 0] + 0.6).clamp(0, 1)

    near, everywhere = (extract(Shape(jumping, kind), grid=64, reach=1.05) for kind in (Kind.BOUND, Kind.LEVEL))
    assert near.vertices[:, 0].max() == pytest.approx(0.8, abs=0.04)
    assert len(near.faces) > 0.98 * len(everywhere.faces)


def test_small_parts_are_found_by_values_that_are_far_too_large():
    for place in np.random.default_rng(0).uniform(-0.7, 0.7, (6, 3)).tolist():
        ball = sphere(0.07, tuple(place))
        counted = Meter(Shape(lambda p, ball=ball: 20 * ball(p), Kind.BOUND))
        assert extract(counted, grid=64, reach=1.05) is not None
        assert counted.counts.value < 64**3 / 20
