"""Fields: distances by hand, bounds, kinds, normals, gradients, and the counts of the Meter."""

from math import sqrt

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from renderers.field import Counts, Field, Flops, Kind, Meter, autograd_normals
from renderers.fields.analytic import Shape, box, capsule, cylinder, plane, rounded_box, smooth_union, sphere, torus
from tests.looped import each
from tests.renderers.analytic_cases import CASES, vector

PRIMITIVES = {
    "sphere": sphere(0.5, (0.1, -0.2, 0.3)),
    "box": box((0.3, 0.5, 0.7)),
    "rounded_box": rounded_box((0.3, 0.5, 0.7), 0.1),
    "torus": torus(0.6, 0.2),
    "capsule": capsule((-0.3, 0.1, 0.2), (0.4, 0.3, -0.5), 0.15),
    "cylinder": cylinder(0.4, 0.6),
    "plane": plane((1.0, 2.0, -2.0), 0.2),
}
A, B = PRIMITIVES["box"], PRIMITIVES["sphere"]
COMBINATIONS = {
    "union": A | B,
    "intersection": A & B,
    "difference": A - B,
    "smooth_union": smooth_union(A, B, radius=0.2),
    "chain": ((A | PRIMITIVES["torus"]) - PRIMITIVES["capsule"]) & PRIMITIVES["cylinder"],
    "translate": A.translate((0.2, -0.1, 0.3)),
    "scale": A.scale(1.7),
    "stretch": PRIMITIVES["torus"].stretch((0.5, 1.5, 0.8)),
}
LEVEL = Shape(lambda p: p.square().sum(-1) - 0.25, Kind.LEVEL, None)
QUARTER_TURN = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)  # about z: x to y


def value(shape: Field, *point: float) -> float:
    return shape(vector(point)).item()


BOX, ROUNDED, TORUS, CYLINDER = box((1, 2, 3)), rounded_box((1, 2, 3), 0.5), torus(1, 0.25), cylinder(1, 2)
CAPSULE = capsule((0, 0, 0), (0, 2, 0), 0.5)


@each("shape, point, distance",
    [
        (sphere(0.5, (1, 0, 0)), (1, 0, 0), -0.5),
        (sphere(), (3, 4, 0), 4),
        (BOX, (0, 1.75, 0), -0.25),  # inside, closest to a face that is not the closest face to the centre
        (BOX, (-4, -6, 0), 5),  # off an edge by 3 and 4
        (BOX, (2, -4, 5), 3),  # off a corner by 1, 2 and 2
        (BOX, (-1, 2, -3), 0),  # on a corner
        (ROUNDED, (3, 0, 0), 2),  # rounding does not change the overall size
        (ROUNDED, (3.5, 5.5, 0), 4.5),  # 3 and 4 off the core's edge, less the rounding
        (ROUNDED, (1, 2, 3), sqrt(0.75) - 0.5),  # the corner that was rounded away
        (TORUS, (0, 0, 0), 0.75),
        (TORUS, (1, 0, 0), -0.25),
        (TORUS, (4, 4, 0), 4.75),  # 3 and 4 off the ring
        (CAPSULE, (0, 1, 0), -0.5),
        (CAPSULE, (0, 3, 0), 0.5),  # beyond the end
        (CAPSULE, (0, -1, 0), 0.5),  # before the start
        (CAPSULE, (0, 6, -3), 4.5),  # 3 and 4 off the end
        (capsule((1, 0, 0), (1, 0, 4), 1), (1, 3, 2), 2),
        (CYLINDER, (0, 1.75, 0), -0.25),
        (CYLINDER, (0, 0, -3), 2),
        (CYLINDER, (4, -6, 0), 5),  # 3 and 4 off the rim
        (CYLINDER, (0, 2, 1), 0),  # on the rim
        (plane((0, 1, 0), 0.5), (7, -1, 3), -1.5),
        (plane((3, 0, 4)), (1, 5, 1), 1.4),  # the normal is normalised
        (plane((0, 2, 0), 1), (3, 2.5, 4), 2),  # the offset belongs to the normal before it is normalised
    ],
)  # fmt: skip
def test_distances_worked_out_by_hand(shape, point, distance):
    assert value(shape, *point) == pytest.approx(distance, abs=1e-12) and shape.kind is Kind.DISTANCE


@each("shape", [*PRIMITIVES.values(), *COMBINATIONS.values()])
@each("size", [1e-4, 1e-2, 1.0])
def test_the_lipschitz_constant_of_each_shape_is_at_most_1(shape, size):
    generator = torch.Generator().manual_seed(0)
    first = torch.rand(2000, 3, dtype=torch.float64, generator=generator) * 3 - 1.5
    second = first + size * torch.randn(2000, 3, dtype=torch.float64, generator=generator)
    assert shape.lipschitz == 1
    assert ((shape(first) - shape(second)).abs() <= (first - second).norm(dim=-1) + 1e-12).all()


def test_the_inside_of_a_combination_follows_from_its_shapes():
    """Together with a Lipschitz constant of 1, no step overshoots the surface of a combination."""
    points = 3 * torch.rand(2000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 1.5
    in_box, in_sphere = A(points) < 0, B(points) < 0
    assert torch.equal((A | B)(points) < 0, in_box | in_sphere)
    assert torch.equal((A & B)(points) < 0, in_box & in_sphere)
    assert torch.equal((A - B)(points) < 0, in_box & ~in_sphere)
    assert (in_box & in_sphere).any() and (in_box & ~in_sphere).any() and (in_sphere & ~in_box).any()


def test_a_smooth_union_fills_the_seam_by_a_quarter_of_its_radius_and_is_the_union_elsewhere():
    # On the seam of two spheres both distances are 0.1, so the fillet takes 0.25 * 0.2; a radius apart, nothing.
    blend = smooth_union(sphere(0.5, (-0.6, 0, 0)), sphere(0.5, (0.6, 0, 0)), radius=0.2)
    for x, expected in ((0.0, 0.1 - 0.05), (-0.1, 0.0), (0.05, 0.05 - 0.25 * 0.2 * 0.5**2)):  # the last half overlaps
        assert value(blend, x, 0, 0) == pytest.approx(expected)


def test_every_shape_states_its_kind():
    def changed(shape: Shape, other: Shape) -> tuple[list[Shape], list[Shape]]:
        """Motions, which keep the kind, and combinations, which make a bound of a distance."""
        motions = [shape.translate((1.0, 0, 0)), shape.rotate(QUARTER_TURN), shape.scale(2.0)]
        smooth = smooth_union(shape, other, radius=0.1)
        return motions, [shape | other, other & shape, other - shape, smooth, shape.stretch((1, 2, 3))]

    motions, combinations = changed(A, B)
    assert {shape.kind for shape in (*PRIMITIVES.values(), *motions)} == {Kind.DISTANCE}
    assert {shape.kind for shape in combinations} == {Kind.BOUND} == {(A - B).scale(2.0).kind}
    levels = [shape for shapes in changed(LEVEL, A) for shape in shapes]
    assert {(shape.kind, shape.lipschitz) for shape in levels} == {(Kind.LEVEL, None)}
    steep = Shape(A.function, Kind.LEVEL, 3.0)
    assert (steep | A).lipschitz == (A - steep).lipschitz == steep.scale(2.0).lipschitz == 3.0
    assert all(isinstance(shape, Field) for shape in (A, LEVEL, Meter(A)))


@settings(max_examples=10)
@given(angle=st.floats(-3, 3), shift=st.tuples(*[st.floats(-2, 2)] * 3), factor=st.floats(0.3, 3))
def test_a_moved_shape_has_the_distances_of_the_shape_at_the_points_moved_back(angle, shift, factor):
    points = torch.randn(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    turn = rotation(torch.tensor(angle, dtype=torch.float64))
    moved = BOX.rotate(turn).scale(factor).translate(shift)(factor * points @ turn.T + vector(shift))
    torch.testing.assert_close(moved, factor * BOX(points), rtol=1e-9, atol=1e-9)


def test_a_stretched_shape_is_a_bound():
    stretched = sphere(1.0).stretch((1, 2, 4))
    assert [value(stretched, *p) for p in ((1, 0, 0), (0, 2, 0), (0, 0, 4))] == pytest.approx([0, 0, 0])
    assert value(stretched, 3, 0, 0) == pytest.approx(2)  # exact along the least stretched axis
    assert value(stretched, 0, 0, 8) == pytest.approx(1)  # a bound along the most stretched


def tensor(*numbers: float) -> torch.Tensor:
    return torch.tensor(numbers if len(numbers) > 1 else numbers[0], dtype=torch.float64, requires_grad=True)


@each("make, parameters", [
    (sphere, (tensor(0.5), tensor(0.1, 0.2, 0.3))), (plane, (tensor(1.0, 2.0, 0.5), tensor(0.2))),
    (box, (tensor(0.3, 0.4, 0.5),)), (rounded_box, (tensor(0.3, 0.4, 0.5), tensor(0.1))),
    (torus, (tensor(0.5), tensor(0.2))), (capsule, (tensor(-0.3, 0.1, 0.2), tensor(0.4, 0.3, -0.5), tensor(0.15))),
    (cylinder, (tensor(0.4), tensor(0.3))), (lambda offset: A.translate(offset), (tensor(0.1, 0.2, 0.3),)),
    (lambda factor: A.scale(factor), (tensor(1.5),)), (lambda factors: B.stretch(factors), (tensor(0.5, 1.5, 2.0),)),
    (lambda angle: A.rotate(rotation(angle)), (tensor(0.3),)),
    (lambda radius: smooth_union(A, B, radius=radius), (tensor(0.4),)),
    (lambda radius: A - sphere(radius), (tensor(0.4),)),
])  # fmt: skip
def test_gradients_flow_to_tensor_parameters(make, parameters):
    points = torch.randn(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3)).requires_grad_(True)
    assert torch.autograd.gradcheck(lambda p, *rest: make(*rest)(p), (points, *parameters))
    gradients = torch.autograd.grad(make(*parameters)(points).abs().sum(), parameters)
    assert all(gradient.abs().sum() > 0 for gradient in gradients)


def rotation(angle: torch.Tensor) -> torch.Tensor:
    zero, ones = torch.zeros_like(angle), torch.ones_like(angle)
    return torch.stack([angle.cos(), -angle.sin(), zero, angle.sin(), angle.cos(), zero, zero, zero, ones]).view(3, 3)


@each("name", [*PRIMITIVES, *COMBINATIONS])
def test_gradients_are_finite_where_a_length_is_zero(name):
    # The centres, the capsule's axis, the torus' ring and axis, faces and edges.
    points = vector((0, 0, 0, 0.1, -0.2, 0.3, -0.3, 0.1, 0.2, 0.6, 0, 0, 0.3, 0.5, 0.7, 0.3, 0, 0, 0.4, 0.6, 0))
    points = points.view(-1, 3).requires_grad_(True)
    (gradient,) = torch.autograd.grad((PRIMITIVES | COMBINATIONS)[name](points).sum(), points)
    assert gradient.isfinite().all()


@each("case", CASES)
def test_fields_agree_with_the_closed_form_cases(case):
    parameter = torch.tensor(case.parameter, dtype=torch.float64, requires_grad=True)
    rays = case.rays()
    point = rays.at(vector((case.distance,)))
    values = case.shape(parameter)(point)
    assert values.item() == pytest.approx(0, abs=1e-12)
    (gradient,) = torch.autograd.grad(values.sum(), parameter)
    assert gradient.item() == pytest.approx(-1)  # as `analytic_cases` states for each field
    assert -(rays.directions @ vector(case.normal)).item() == pytest.approx(case.cosine)
    before = rays.at(torch.linspace(0, case.distance - 1e-6, 500, dtype=torch.float64)[:, None])
    assert (case.field()(before) > 0).all()  # the hit is the first surface on the ray
    assert autograd_normals(case.field(), point)[0].tolist() == pytest.approx(list(case.normal))
    # Central differences are off by the third derivative times delta squared.
    ahead, behind = (case.field()(point + side * 1e-4 * torch.eye(3, dtype=point.dtype)) for side in (1, -1))
    numeric = torch.nn.functional.normalize(ahead - behind, dim=0)
    assert numeric.tolist() == pytest.approx(list(case.normal), abs=1e-6)


def test_normals_keep_leading_shapes_leave_no_graph_and_vanish_with_the_gradient():
    with torch.no_grad():
        normals = autograd_normals(A, torch.randn(2, 5, 3))
    assert normals.norm(dim=-1).allclose(torch.ones(2, 5)) and not normals.requires_grad
    assert autograd_normals(A, torch.randn(2, 0, 3)).shape == (2, 0, 3)
    assert autograd_normals(Shape(lambda p: 0 * p.sum(-1)), torch.randn(3)).tolist() == [0, 0, 0]


@each("shape", [(), (0,), (7,), (2, 3, 5)])
def test_the_meter_counts_points_and_leaves_values_and_gradients_as_they_are(shape):
    points = torch.randn(*shape, 3, requires_grad=True)
    meter = Meter(B)
    values = meter(points)
    assert torch.equal(values, B(points))
    count = values.numel()
    assert meter.counts == Counts(value=count)
    (metered,) = torch.autograd.grad(values.square().sum(), points)
    (plain,) = torch.autograd.grad(B(points).square().sum(), points)
    assert torch.equal(metered, plain) and meter.counts == Counts(value=count, gradient=count)


def test_the_meter_counts_each_backward_pass_once():
    meter, points = Meter(B), torch.randn(5, 3, requires_grad=True)
    values = meter(points)
    (values.sum() + values.square().mean()).backward(retain_graph=True)  # two uses of the values, one pass
    assert meter.counts == Counts(5, 5)
    values[:2].sum().backward()
    assert meter.counts == Counts(5, 7)  # the others have a gradient of zero
    with torch.no_grad():
        meter(points)
    meter(points.detach())
    assert meter.counts == Counts(15, 7)
    radius = torch.tensor(0.5, requires_grad=True)
    Meter(sphere(radius), meter.counts)(points.detach()).sum().backward()  # meters can share counts
    assert meter.counts == Counts(20, 12)


def test_the_meter_has_the_attributes_of_its_field_and_gives_its_cost():
    shape = Shape(A.function, Kind.LEVEL, 2.5, flops=Flops(10, 20))
    meter = Meter(shape)
    assert (meter.kind, meter.lipschitz, meter.flops) == (Kind.LEVEL, 2.5, Flops(10, 20))
    # A value with its gradient costs as much as three values.
    assert Counts(value=5, gradient=2).flops(meter) == 10 * 5 + 20 * 2 and Counts(5, 2).flops(A) is None
    assert Counts(5, 7) - Counts(1, 2) == Counts(4, 5)


def test_cost_is_relative_to_one_evaluation_and_one_gradient_per_hit():
    shape = Shape(A.function, Kind.LEVEL, 2.5, flops=Flops(10, 20))
    assert Counts(12, 3, hits=3).over_bound(shape) == (12 * 10 + 3 * 20) / (3 * 30)
    assert Counts(12, 3, hits=3).over_bound(A) == 15 / 6  # without stated operations a gradient costs one evaluation
    assert Counts(12, 3, hits=3, coarse=6).over_bound(shape) == ((12 + 6) * 10 + 3 * 20) / (3 * 30)
    assert Counts(12, 3).over_bound(shape) is None
    assert (Counts(12, 3, hits=9) - Counts(2, 1, hits=4)).hits == 5
