"""Meshes of fields with a known zero set."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from datasets.files.repair import count_holes
from datasets.mesh import extract
from renderers.field import Kind, Meter
from renderers.fields.analytic import Shape, box, sphere
from tests.looped import each

CENTRE = (0.3, -0.1, 0.2)


def test_an_ellipsoid_has_its_sizes_its_centre_and_outward_faces():
    sizes = np.array([0.2, 0.4, 0.7])
    mesh = extract(sphere(1.0).stretch(tuple(sizes)).translate(CENTRE), grid=64, reach=1.05)
    assert mesh is not None
    out = (mesh.vertices - CENTRE) / sizes
    assert np.linalg.norm(out, axis=1) == pytest.approx(1, abs=0.01)
    assert mesh.watertight and mesh.volume == pytest.approx(4 / 3 * torch.pi * sizes.prod(), rel=0.02)
    assert ((out[mesh.faces[:, 0]] * mesh.area_normals).sum(1) > 0).all()


@each("value", [1.0, -1.0, float("nan")])
def test_values_of_one_sign_have_no_surface(value):
    assert extract(Shape(lambda p: torch.full_like(p[..., 0], value)), grid=8, reach=1.0) is None


def balls(count: int, largest: float) -> Shape:
    """Small spheres at random positions, many of them between the samples."""
    draw = np.random.default_rng(0)
    centres, radii = torch.from_numpy(draw.uniform(-0.9, 0.9, (count, 3))).float(), draw.uniform(0, largest, count)
    return Shape(lambda p: (torch.cdist(p, centres) - torch.from_numpy(radii).float()).amin(-1))


def noise(points: torch.Tensor) -> torch.Tensor:
    """A number from -1 to 1 for each point, without relation to its neighbours."""
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
def test_extraction_evaluates_near_the_surface_and_loses_nothing(name, grid):
    field = FIELDS[name]
    meter = Meter(Shape(field, Kind.BOUND))
    near = extract(meter, grid=grid, reach=0.95)
    everywhere = extract(Shape(field, Kind.LEVEL), grid=grid, reach=0.95)
    assert np.array_equal(near.vertices, everywhere.vertices) and np.array_equal(near.faces, everywhere.faces)
    assert meter.counts.value < grid**3 / 3 or name not in ("thin", "solid") or grid < 64


def with_nan(shape: Shape, region: Callable[[torch.Tensor], torch.Tensor], kind: Kind) -> Shape:
    return Shape(lambda p: torch.where(region(p), torch.nan, shape(p)), kind)


@each("kind", [Kind.DISTANCE, Kind.LEVEL])
@each("name", ["thin", "nested", "noisy"])
def test_samples_that_are_nan_away_from_the_surface_change_nothing_but_a_note(name, kind):
    shape = FIELDS[name]
    plain = extract(Shape(shape, kind), grid=64, reach=0.95)
    mesh = extract(with_nan(shape, lambda p: (p > 0.75).all(-1), kind), grid=64, reach=0.95)
    assert np.array_equal(mesh.vertices, plain.vertices) and np.array_equal(mesh.faces, plain.faces)
    (note,) = mesh.repairs
    assert plain.repairs == () and note.startswith("warning: the field is NaN at ")
    assert kind is Kind.DISTANCE or " 343 samples" in note  # 7 along each axis


@each("kind", [Kind.DISTANCE, Kind.LEVEL])
def test_nan_values_leave_a_hole_and_the_other_surface_unchanged(kind):
    mesh = extract(with_nan(sphere(0.8), lambda p: p[..., 0] > 0.4, kind), grid=64, reach=1.0)
    assert not mesh.watertight and count_holes(mesh) == 1 and 0.35 < mesh.vertices[:, 0].max() <= 0.4
    assert np.linalg.norm(mesh.vertices, axis=1) == pytest.approx(0.8, abs=1e-3)


def test_a_surface_with_nan_in_each_cell_is_none():
    hidden = with_nan(sphere(0.5), lambda p: (p.norm(dim=-1) - 0.5).abs() < 0.2, Kind.LEVEL)
    assert extract(hidden, grid=32, reach=1.0) is None


def test_a_field_of_nan_alone_takes_few_evaluations():
    meter = Meter(Shape(lambda p: torch.full_like(p[..., 0], torch.nan), Kind.DISTANCE))
    assert extract(meter, grid=64, reach=1.0) is None and meter.counts.value < 64**3 / 50


def test_a_dip_twice_as_steep_as_a_distance_is_extracted_at_each_position():
    far = sphere(0.3, (-0.5, -0.5, -0.5))
    for centre in np.random.default_rng(0).uniform(0.0, 0.7, (12, 3)).tolist():
        dip = sphere(0.022, tuple(centre))  # its values are the smaller ones only next to it
        field = Shape(lambda p, dip=dip: torch.minimum(far(p).clamp(max=0.1), 2 * dip(p)))
        near, everywhere = (extract(Shape(field, kind), grid=81, reach=1.0) for kind in (Kind.BOUND, Kind.LEVEL))
        assert near.parts.max() == 1 and np.array_equal(near.vertices, everywhere.vertices)
