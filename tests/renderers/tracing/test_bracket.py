"""The first crossing between samples, and the refinement of a bracket around a root."""

import pytest
import torch

from renderers.camera import Rays
from renderers.field import Kind, Meter
from renderers.fields.analytic import Shape, plane, sphere
from renderers.tracing.bracket import REFINEMENTS, Bracket, first_crossing, narrow, refine
from tests.looped import each
from tests.renderers.analytic_cases import vector

NAN = float("nan")
WALL = plane((0, 0, -1), 0.0)  # solid beyond z = 0: along a ray from z = -2 the value is 2 - distance


def rays(count: int) -> Rays:
    directions = vector((0, 0, 1)).expand(count, 3)
    return Rays(-2 * directions, directions)


def bracket(*ends: tuple[float, float]) -> Bracket:
    """The bracket of the wall between two distances for each ray."""
    near, far = vector(tuple(end[0] for end in ends)), vector(tuple(end[1] for end in ends))
    return Bracket(near, far, 2 - near, 2 - far)


@each("values, first", [
    ((3, 1, -1, -2), 1), ((3, -1, 2, -2), 0),  # the first of two
    ((3, 1, 0, 1), 1),  # zero is occupied
    ((-1, 2, -1, 3), 1),  # out of the shape, and in again
    ((3, 2, 1, 0.5), None), ((-3, -2, -1, -1), None), ((-1, 1, 2, 3), None),  # leaving is no crossing
    ((0, -1, -1, -1), None),  # no sample is free
    ((3, NAN, -1, -1), None),  # a crossing may lie between, or none
    ((3, NAN, 1, -1), 2),
])  # fmt: skip
def test_the_first_fall_from_free_to_occupied(values, first):
    distances = vector((0, 10, 20, 30))[None]
    crosses, ends = first_crossing(distances, vector(values)[None])
    assert crosses.tolist() == [first is not None]
    if first is not None:
        assert (ends.near.item(), ends.far.item()) == (10 * first, 10 * first + 10)
        assert (ends.near_value.item(), ends.far_value.item()) == (values[first], values[first + 1])


def test_rays_with_a_crossing_have_a_bracket():
    values = torch.stack([vector((1, -1)), vector((1, 1)), vector((2, -3))])
    crosses, ends = first_crossing(vector((0, 1)).expand(3, 2), values)
    assert crosses.tolist() == [True, False, True]
    assert ends.select(crosses.nonzero().squeeze(-1)).far_value.tolist() == [-1, -3]
    crosses_empty, empty = first_crossing(torch.zeros(0, 4), torch.zeros(0, 4))
    assert (crosses_empty.shape, empty.near.shape) == ((0,), (0,))


@each("steps", [0, 1, 5])
def test_bisection_halves_the_bracket_with_one_evaluation_per_step(steps):
    meter = Meter(WALL)
    closer = narrow(meter, rays(2), bracket((1, 2.5), (0.5, 2.25)), method="bisection", steps=steps)
    assert (closer.far - closer.near).tolist() == pytest.approx([1.5 / 2**steps, 1.75 / 2**steps])
    assert meter.counts.value == 2 * steps and ((closer.near < 2) & (closer.far >= 2)).all()
    assert torch.equal(closer.near_value, 2 - closer.near)


def test_the_secant_of_a_line_is_its_root():
    meter = Meter(WALL)
    distance, residual = refine(meter, rays(1), bracket((0.7, 2.9)), method="secant", steps=0)
    assert distance.item() == pytest.approx(2, abs=1e-15)
    assert residual.item() == pytest.approx(2 - 2.9)  # at the nearer end, since the field was not evaluated
    assert meter.counts.value == 0
    _, residual = refine(WALL, rays(1), bracket((0.7, 2.9)), method="secant", steps=1)
    assert abs(residual.item()) < 1e-15


@each("method", REFINEMENTS)
def test_the_root_stays_in_the_bracket_and_comes_closer(method):
    ball = sphere(0.5)
    start = Bracket(*(vector((x,)) for x in (1.3, 1.9, 0.2, -0.4)))
    errors = []
    for steps in range(0, 12, 3):
        closer = narrow(ball, rays(1), start, method=method, steps=steps)
        assert closer.near.item() <= 1.5 <= closer.far.item()
        assert closer.near_value.item() >= 0 >= closer.far_value.item()
        distance, _ = refine(ball, rays(1), start, method=method, steps=steps)
        assert 1.3 <= distance.item() <= 1.9
        errors.append(abs(distance.item() - 1.5))
    assert errors[-1] < 1e-3 and errors[-1] <= errors[0]


@each("method", REFINEMENTS)
def test_a_hole_in_the_field_counts_as_occupied(method):
    holed = Shape(lambda p: torch.where(p[..., 2] > -0.5, NAN, -p[..., 2]), Kind.LEVEL, None)
    distance, residual = refine(holed, rays(1), bracket((1.0, 3.0)), method=method, steps=40)
    assert distance.isfinite().all() and residual.isfinite().all()
    assert distance.item() == pytest.approx(1.5, abs=0.05 if method == "bisection" else 0.6)
