"""How steep fields are, and what becomes of their values."""

import pytest
import torch
from torch import Tensor

from renderers.field import Coarse, Kind, Meter
from renderers.fields.analytic import Shape, box, sphere, torus
from renderers.tracer import MAX_DISTANCE_SLOPE, SLOPE_PAIR_COUNT, SlopeNormalised, measure_slope_scale, normalise_slope
from tests.looped import each

LIKE = torch.zeros(0, 3)
RING, BALL = torus(0.5, 0.2), sphere(0.5)


def slope_scale(values, radius: float = 1.0) -> float:
    return measure_slope_scale(values, LIKE, radius=radius)


@each("of", [lambda d: 1.1 * d, lambda d: d, lambda d: 0.1 * d, lambda d: 0.4 * torch.sin(d / 0.4)])
def test_a_field_that_is_hardly_steeper_than_a_distance_is_taken_for_one(of):
    assert slope_scale(lambda p: of(RING(p))) == 1.0


@each("times", [1.5, 100.0])
@each("shape", [RING, box((0.4, 0.3, 0.2))])
def test_distances_times_a_factor_are_steep_by_it(shape, times):
    assert slope_scale(lambda p: times * shape(p)) == pytest.approx(times, rel=0.08)


@each("spoilt", [torch.nan, torch.inf])
def test_it_is_measured_where_values_are_finite(spoilt):
    assert slope_scale(lambda p: torch.where(p[..., 0] > 0.2, spoilt, 4 * BALL(p))) == pytest.approx(4.0, rel=0.1)
    assert slope_scale(lambda p: torch.full_like(p[..., 0], spoilt)) == 1.0


@each("radius", [0.05, 30.0])
def test_it_asks_points_in_the_sphere(radius):
    asked: list[Tensor] = []

    def values(points: Tensor) -> Tensor:
        asked.append(points)
        return 4 * sphere(radius / 2)(points)

    assert slope_scale(values, radius) == pytest.approx(4.0, rel=0.1)
    (points,) = asked
    assert len(points) == 2 * SLOPE_PAIR_COUNT and points.norm(dim=-1).max() <= radius


def test_a_normalised_field_is_counted_and_divided_with_its_coarse_values():
    class Offering:
        kind, lipschitz, flops = Kind.DISTANCE, None, None
        coarse = Coarse(lambda points: 4 * BALL(points) + 0.2, 0.2)

        def __call__(self, points):
            return 4 * BALL(points)

    meter, points = Meter(Offering()), torch.randn(7, 3)
    field = normalise_slope(meter, 4.0)
    assert isinstance(field, SlopeNormalised) and field.kind is Kind.DISTANCE
    torch.testing.assert_close(field(points), BALL(points))
    assert field.coarse is not None and field.coarse.error == pytest.approx(0.05)
    torch.testing.assert_close(field.coarse.values(points), BALL(points) + 0.05)
    assert (meter.counts.value, meter.counts.coarse) == (7, 7)
    assert (
        normalise_slope(meter, 1.0) is meter
        and normalise_slope(Shape(lambda p: p[..., 0]), MAX_DISTANCE_SLOPE) is not meter
    )
