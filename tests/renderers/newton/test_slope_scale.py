"""The measured slope of fields, and values normalised by it."""

import pytest
import torch
from torch import Tensor

from renderers.field import Coarse, Kind, Meter
from renderers.fields.analytic import Shape, box, sphere, torus
from renderers.newton.tracer import (
    MAX_DISTANCE_SLOPE,
    SLOPE_PAIR_COUNT,
    SlopeNormalised,
    measure_slope_scale,
    normalise_slope,
)
from tests.looped import each

LIKE = torch.zeros(0, 3)
RING, BALL = torus(0.5, 0.2), sphere(0.5)


def slope_scale(values, radius: float = 1.0) -> float:
    return measure_slope_scale(values, LIKE, radius=radius)


@each("change", [lambda d: 1.1 * d, lambda d: d, lambda d: 0.1 * d, lambda d: 0.4 * torch.sin(d / 0.4)])
def test_the_scale_of_a_field_hardly_steeper_than_a_distance_is_1(change):
    assert slope_scale(lambda p: change(RING(p))) == 1.0


@each("factor", [1.5, 100.0])
@each("shape", [RING, box((0.4, 0.3, 0.2))])
def test_the_scale_of_a_multiple_of_a_distance_is_the_factor(shape, factor):
    assert slope_scale(lambda p: factor * shape(p)) == pytest.approx(factor, rel=0.08)


@each("spoilt", [torch.nan, torch.inf])
def test_the_scale_is_measured_at_finite_values(spoilt):
    assert slope_scale(lambda p: torch.where(p[..., 0] > 0.2, spoilt, 4 * BALL(p))) == pytest.approx(4.0, rel=0.1)
    assert slope_scale(lambda p: torch.full_like(p[..., 0], spoilt)) == 1.0


@each("radius", [0.05, 30.0])
def test_the_scale_is_measured_at_points_in_the_sphere(radius):
    evaluated: list[Tensor] = []

    def values(points: Tensor) -> Tensor:
        evaluated.append(points)
        return 4 * sphere(radius / 2)(points)

    assert slope_scale(values, radius) == pytest.approx(4.0, rel=0.1)
    (points,) = evaluated
    assert len(points) == 2 * SLOPE_PAIR_COUNT and points.norm(dim=-1).max() <= radius


def test_values_and_coarse_values_of_a_normalised_field_are_divided_and_counted():
    class WithCoarse:
        kind, lipschitz, flops = Kind.DISTANCE, None, None
        coarse = Coarse(lambda points: 4 * BALL(points) + 0.2, 0.2)

        def __call__(self, points):
            return 4 * BALL(points)

    meter, points = Meter(WithCoarse()), torch.randn(7, 3)
    field = normalise_slope(meter, 4.0)
    assert isinstance(field, SlopeNormalised) and field.kind is Kind.DISTANCE
    torch.testing.assert_close(field(points), BALL(points))
    assert field.coarse is not None and field.coarse.error == pytest.approx(0.05)
    torch.testing.assert_close(field.coarse.values(points), BALL(points) + 0.05)
    assert (meter.counts.value, meter.counts.coarse) == (7, 7) and normalise_slope(meter, 1.0) is meter
    assert normalise_slope(Shape(lambda p: p[..., 0]), MAX_DISTANCE_SLOPE) is not meter
