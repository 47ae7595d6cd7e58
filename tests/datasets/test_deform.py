"""Deformations: seeded, the identity at strength 0, smooth and without folds."""

import numpy as np
import pytest

from datasets.files.deform import MAX_LOG_SCALE, MAX_TAPER, MAX_TWIST_RADIANS, Deformation
from tests.looped import each
from tests.tiny import icosphere

BALL = icosphere(1.0, subdivisions=2).vertices


def jacobians(deformation: Deformation, points: np.ndarray) -> np.ndarray:
    step = 1e-5
    steps = step * np.eye(3)
    columns = [(deformation.apply(points + shift) - deformation.apply(points - shift)) / (2 * step) for shift in steps]
    return np.stack(columns, axis=-1)


def test_strength_zero_is_the_identity_and_strength_scales_the_same_kind():
    assert np.array_equal(Deformation.draw(5, 0.0).apply(BALL), BALL)
    weak, strong = Deformation.draw(5, 0.5), Deformation.draw(5, 1.0)
    assert strong == Deformation.draw(5, 1.0) and 0.05 < np.abs(strong.apply(BALL) - BALL).max() < 1
    assert weak.twist == pytest.approx(strong.twist / 2) and weak.twist_axis == strong.twist_axis


def test_the_parameters_fill_their_ranges():
    drawn = [Deformation.draw(seed) for seed in range(200)]
    for values, limit in [
        ([deformation.stretch for deformation in drawn], MAX_LOG_SCALE),
        ([deformation.taper for deformation in drawn], MAX_TAPER),
        ([deformation.twist for deformation in drawn], MAX_TWIST_RADIANS),
    ]:
        assert 0.95 * limit < np.max(values) <= limit and -limit <= np.min(values) < -0.95 * limit
    assert {deformation.twist_axis for deformation in drawn} == {0, 1, 2}


def test_orientation_is_kept_in_the_unit_sphere():
    points = np.random.default_rng(0).normal(size=(300, 3))
    points /= np.maximum(1, np.linalg.norm(points, axis=1, keepdims=True))
    determinants = [np.linalg.det(jacobians(Deformation.draw(seed), points)) for seed in range(30)]
    assert np.min(determinants) > 0.1


@each("axis", [0, 1, 2])
def test_taper_scales_cross_sections_and_stretch_scales_axes(axis):
    point = np.full(3, 0.4)
    tapered = Deformation(taper=0.25, taper_axis=axis).apply(point)
    assert tapered == pytest.approx(np.where(np.arange(3) == axis, 0.4, 0.44))
    stretch = tuple(0.2 * np.eye(3)[axis])
    assert Deformation(stretch=stretch).apply(point) == pytest.approx(0.4 * np.exp(stretch))


@each("axis", [0, 1, 2])
def test_twist_keeps_volume_and_bend_turns_the_axis_into_an_arc(axis):
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (50, 3))
    assert np.linalg.det(jacobians(Deformation(twist=0.4, twist_axis=axis), points)) == pytest.approx(1)
    along = np.zeros((50, 3))
    along[:, axis] = np.linspace(-1, 1, 50)
    arc = Deformation(bend=0.25, bend_axis=axis).apply(along)
    centre = 4 * np.eye(3)[(axis + 1) % 3]
    assert np.linalg.norm(arc - centre, axis=1) == pytest.approx(4)
    lengths = np.linalg.norm(np.diff(arc, axis=0), axis=1)
    assert lengths.sum() == pytest.approx(2, rel=1e-3)
