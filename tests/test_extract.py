"""From fields with a known zero set to meshes."""

import pytest
import torch

from datasets.extract import extract
from renderers.fields.analytic import Shape, box, sphere
from renderers.fields.mlp import Decoder

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


@pytest.mark.parametrize("value", [1.0, -1.0, float("nan")])
def test_values_of_one_sign_have_no_surface(value):
    assert extract(Shape(lambda p: torch.full_like(p[..., 0], value)), grid=8, reach=1.0) is None


def test_a_surface_that_leaves_the_cube_is_left_open():
    mesh = extract(sphere(1.0), grid=24, reach=0.9)
    assert mesh is not None
    assert not mesh.watertight


def test_a_network_is_sampled_without_a_graph():
    torch.manual_seed(0)
    decoder = Decoder(layers=2, width=8, code_length=0, skip=0, narrow=False)
    field = decoder.at(torch.zeros(0))
    middle = field(torch.zeros(1, 3)).item()
    assert extract(Shape(lambda p: field(p) - middle), grid=12, reach=1.0) is not None
