"""From fields with a known zero set to meshes."""

from collections.abc import Callable

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
    assert ((out[mesh.faces[:, 0]] * mesh.area_normals).sum(1) > 0).all()


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


def balls(count: int, largest: float) -> Shape:
    """Small balls at random places, many of them between the samples."""
    draw = np.random.default_rng(0)
    places, radii = torch.from_numpy(draw.uniform(-0.9, 0.9, (count, 3))).float(), draw.uniform(0, largest, count)
    return Shape(lambda p: (torch.cdist(p, places) - torch.from_numpy(radii).float()).amin(-1))


def noise(points: torch.Tensor) -> torch.Tensor:
    """A number from -1 to 1 of each point, which says nothing of its neighbours'."""
    return torch.sin(1e4 * (points * torch.tensor([12.9898, 78.233, 37.719])).sum(-1))


PLATE = box((0.8, 0.03, 0.6)) | sphere(0.1, (0.0, 0.7, 0.0))
BALLS = balls(40, 0.05)
NESTED = (sphere(0.8) - sphere(0.76)) | (sphere(0.5) - sphere(0.47)) | sphere(0.02)
JUMP = box((0.8, 0.04, 0.6)).translate((0.0, 0.133, 0.0))  # between samples
FIELDS = {
    "thin": PLATE,
    "nested": NESTED,
    "solid": sphere(0.8),
    "small, and twice as steep as a distance": Shape(lambda p: 2 * BALLS(p)),
    "small, and twenty times as steep": Shape(lambda p: 20 * BALLS(p)),
    "a bound": Shape(lambda p: 0.2 * PLATE(p)),
    "noisy": Shape(lambda p: NESTED(p) + 0.05 * noise(p)),
    "noise alone": Shape(noise),
    "values that jump at the surface": Shape(lambda p: JUMP(p) + JUMP(p).sign() * 0.4 * (p[..., 0] + 0.6).clamp(0, 1)),
    "infinite far away": Shape(lambda p: torch.where(PLATE(p) > 0.5, torch.inf, PLATE(p))),
}


@each("name", [*FIELDS])
@each("grid", [64, 41])
def test_only_the_neighbourhood_of_the_surface_is_asked_and_nothing_of_it_is_lost(name, grid):
    field = FIELDS[name]
    counted = Meter(Shape(field, Kind.BOUND))
    near = extract(counted, grid=grid, reach=0.95)
    everywhere = extract(Shape(field, Kind.LEVEL), grid=grid, reach=0.95)
    assert np.array_equal(near.vertices, everywhere.vertices) and np.array_equal(near.faces, everywhere.faces)
    assert counted.counts.value < grid**3 / 3 or name not in ("thin", "solid") or grid < 64


def unknown_where(shape: Shape, place: Callable[[torch.Tensor], torch.Tensor], kind: Kind) -> Shape:
    return Shape(lambda p: torch.where(place(p), torch.nan, shape(p)), kind)


@each("kind", [Kind.DISTANCE, Kind.LEVEL])
@each("name", ["thin", "nested", "noisy"])
def test_samples_that_are_nan_away_from_the_surface_change_nothing_but_a_note(name, kind):
    shape = FIELDS[name]
    plain = extract(Shape(shape, kind), grid=64, reach=0.95)
    mesh = extract(unknown_where(shape, lambda p: (p > 0.75).all(-1), kind), grid=64, reach=0.95)
    assert np.array_equal(mesh.vertices, plain.vertices) and np.array_equal(mesh.faces, plain.faces)
    (note,) = mesh.repairs
    assert plain.repairs == () and note.startswith("warning: the field is NaN at ")
    assert kind is Kind.DISTANCE or " 343 samples" in note  # 7 along each axis


@each("kind", [Kind.DISTANCE, Kind.LEVEL])
def test_a_surface_is_open_where_its_field_is_nan_and_as_it_was_elsewhere(kind):
    mesh = extract(unknown_where(sphere(0.8), lambda p: p[..., 0] > 0.4, kind), grid=64, reach=1.0)
    assert not mesh.watertight and mesh.holes == 1
    assert 0.35 < mesh.vertices[:, 0].max() <= 0.4
    assert np.linalg.norm(mesh.vertices, axis=1) == pytest.approx(0.8, abs=1e-3)


def test_a_surface_of_which_no_cell_is_known_is_none():
    hidden = unknown_where(sphere(0.5), lambda p: (p.norm(dim=-1) - 0.5).abs() < 0.2, Kind.LEVEL)
    assert extract(hidden, grid=32, reach=1.0) is None


def test_a_field_without_any_number_is_not_asked_further():
    counted = Meter(Shape(lambda p: torch.full_like(p[..., 0], torch.nan), Kind.DISTANCE))
    assert extract(counted, grid=64, reach=1.0) is None
    assert counted.counts.value < 64**3 / 50


def test_a_dip_that_is_twice_as_steep_as_a_distance_is_found_wherever_it_is():
    far = sphere(0.3, (-0.5, -0.5, -0.5))
    for place in np.random.default_rng(0).uniform(0.0, 0.7, (12, 3)).tolist():
        dip = sphere(0.022, tuple(place))  # whose values are below those of the rest next to it alone
        field = Shape(lambda p, dip=dip: torch.minimum(far(p).clamp(max=0.1), 2 * dip(p)))
        near, everywhere = (extract(Shape(field, kind), grid=81, reach=1.0) for kind in (Kind.BOUND, Kind.LEVEL))
        assert near.parts.max() == 1 and np.array_equal(near.vertices, everywhere.vertices)


def test_small_parts_are_found_by_values_that_are_far_too_large():
    for place in np.random.default_rng(0).uniform(-0.7, 0.7, (6, 3)).tolist():
        ball = sphere(0.07, tuple(place))
        counted = Meter(Shape(lambda p, ball=ball: 20 * ball(p), Kind.BOUND))
        assert extract(counted, grid=64, reach=1.05) is not None
        assert counted.counts.value < 64**3 / 20
