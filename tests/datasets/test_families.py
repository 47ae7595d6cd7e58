"""The procedural families in conf/shapes.yaml."""

from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from bench.config import load
from bench.records.record import digest
from bench.tables import CONF, choices_of
from datasets.families import BUILDERS, CUBE_HALF_SIDE, Family
from datasets.scene import SPLIT_STRIDE, Split, seed_of
from renderers.field import Kind, autograd_gradients
from tests.looped import each

ROWS = {name for name, choice in choices_of(CONF)["dataset"].items() if choice.row is not None}
NAMES = sorted(name for name in ROWS if not name.startswith("_"))


FAMILY = [replace(load("dataset", name), resolution=32) for name in NAMES]
by_family = each("family", FAMILY)


@pytest.fixture
def sofa() -> Family:
    return load("dataset", "sofa")


def inside(family: Family, parameters: dict[str, float], points: torch.Tensor) -> torch.Tensor:
    """The points inside the shape before it is scaled, as booleans."""
    return BUILDERS[family.name](SimpleNamespace(**parameters))(points) < 0


def test_each_builder_is_configured_under_its_name():
    assert sorted(BUILDERS) == NAMES


@by_family
def test_shapes_are_closed_solids_that_touch_their_sphere_and_always_the_same(family):
    meshes = [family.mesh(split, 0) for split in Split]
    for mesh in meshes:
        assert mesh.watertight and mesh.volume > 0.02
        assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(family.radius, abs=1e-9)
        assert (mesh.vertices.max(0) + mesh.vertices.min(0)) == pytest.approx([0, 0, 0], abs=1e-9)
    assert len({round(mesh.volume, 9) for mesh in meshes}) == 3
    assert np.array_equal(meshes[-1].vertices, replace(family).mesh(Split.TEST, 0).vertices)


@by_family
def test_draws_fill_their_ranges_and_no_two_are_alike(family):
    drawn = [family.draw(split, index) for split in Split for index in range(100)]
    for name, (low, high) in family.ranges.items():
        values = np.array([parameters[name] for parameters in drawn])
        assert low <= values.min() < low + 0.05 * (high - low)
        assert high >= values.max() > high - 0.05 * (high - low) and len(np.unique(values)) == len(drawn)


@pytest.mark.slow
@by_family
def test_each_parameter_changes_the_shape(family):
    points = torch.empty(50_000, 3).uniform_(-1.2, 1.2, generator=torch.Generator().manual_seed(0))
    middle = {name: (low + high) / 2 for name, (low, high) in family.ranges.items()}
    for name, (low, high) in family.ranges.items():
        least, most = (inside(family, middle | {name: value}, points) for value in (low, high))
        assert (least != most).sum() > 5, f"{name} of {family.name} does nothing"


@by_family
def test_shapes_stay_clear_of_the_sampled_cube(family):
    faces = torch.empty(20_000, 3).uniform_(-CUBE_HALF_SIDE, CUBE_HALF_SIDE, generator=torch.Generator().manual_seed(0))
    rows = torch.arange(len(faces))
    faces[rows, rows % 3] = CUBE_HALF_SIDE * faces[rows, rows % 3].sign()
    widest = {name: high for name, (_, high) in family.ranges.items()}
    for parameters in (widest, *(family.draw(Split.TRAIN, index) for index in range(10))):
        assert not inside(family, parameters, faces).any()


def corners(family: Family, n: int) -> list[dict[str, float]]:
    """Parameters at random ends of their ranges; the first set has the largest values."""
    draw = np.random.default_rng(0)
    ends = [np.ones(len(family.ranges), dtype=int), *draw.integers(0, 2, (n - 1, len(family.ranges)))]
    return [{name: family.ranges[name][end] for name, end in zip(family.ranges, row, strict=True)} for row in ends]


@by_family
def test_a_formula_is_nowhere_steeper_than_its_bound(family):
    generator = torch.Generator().manual_seed(0)
    shapes = [*corners(family, 10), *(family.draw(Split.TRAIN, index) for index in range(10))]
    for parameters in shapes:
        field = BUILDERS[family.name](SimpleNamespace(**parameters))
        points = torch.empty(5_000, 3, dtype=torch.float64).uniform_(-1.2, 1.2, generator=generator)
        slopes = autograd_gradients(field, points).norm(dim=-1)
        assert slopes.max() <= field.lipschitz + 1e-6
        assert field.lipschitz <= 1 or field.kind is Kind.LEVEL


def test_splits_share_no_seed():
    first_and_last = [seed_of(split, index) for split in Split for index in (0, 1, SPLIT_STRIDE - 1)]
    assert len(set(first_and_last)) == len(first_and_last)
    ordered = sorted(first_and_last)
    for split in Split:
        low, high = seed_of(split, 0), seed_of(split, SPLIT_STRIDE - 1)
        assert ordered.index(high) - ordered.index(low) == 2  # no seed of another split lies between


@by_family
def test_the_identity_changes_with_each_setting_of_the_shapes(family):
    def key(**changed):
        return digest(replace(family, **changed).identity())

    name = next(iter(family.ranges))
    low, high = family.ranges[name]
    others = [
        key(ranges=family.ranges | {name: [low, high + 0.01]}),
        key(resolution=family.resolution + 1),
        key(radius=0.9),
        key(name=next(other for other in NAMES if other != family.name)),
    ]
    assert key() == digest(Family(**asdict(family)).identity()) and len({key(), *others}) == 5


def test_a_shape_that_fills_the_cube_is_refused(sofa):
    huge = sofa.ranges | {name: [9.0, 9.0] for name in ("width", "depth", "seat_height", "back_height")}
    huge |= {"leg_height": [-4.0, -4.0]}
    with pytest.raises(ValueError, match=r"sofa test 0 has no surface: check dataset.ranges"):
        replace(sofa, ranges=huge, resolution=16).mesh(Split.TEST, 0)


@by_family
def test_values_have_a_gradient_towards_each_parameter(family):
    numbers = {name: torch.tensor(x, requires_grad=True) for name, x in family.draw(Split.TRAIN, 1).items()}
    points = torch.rand(2000, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    shape = BUILDERS[family.name](SimpleNamespace(**numbers))
    assert isinstance(shape.lipschitz, float) and shape.lipschitz > 0
    gradients = torch.autograd.grad(shape(points).square().sum(), [*numbers.values()])
    assert all(gradient != 0 for gradient in gradients)
