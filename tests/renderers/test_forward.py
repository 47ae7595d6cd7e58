"""A user's forward pass: what is converted, and what is refused, over forms, types and containers that are drawn."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import make_dataclass
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

from renderers.checks import BadInput
from renderers.field import autograd_gradients, points_in_sphere
from renderers.fields.networks.forward import check_forward, check_module
from renderers.fields.networks.network import from_module
from tests.looped import each

POINTS = points_in_sphere(40, torch.zeros(()))
DTYPES = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
FORMS = ((-1,), (-1, 1), (1, -1), (1, -1, 1))
WORDS = st.text("abcxyz_", min_size=1, max_size=5).map(lambda text: f"k{text}")
Forward = Callable[["Made", Tensor], Any]


class Made(nn.Module):
    """A sphere of radius `radius`, whose values a function makes the output of `forward`."""

    def __init__(self, output: Forward, dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        self.radius, self.output = nn.Parameter(torch.tensor(0.5, dtype=dtype)), output

    def values(self, points: Tensor) -> Tensor:
        return points.norm(dim=-1, keepdim=True) - self.radius

    def forward(self, points: Tensor) -> Any:
        return self.output(self, points)


def sphere(points: Tensor) -> Tensor:
    return points.norm(dim=-1) - 0.5


@st.composite
def containers(draw: Any) -> Callable[[Tensor, Tensor], Any]:
    """How values and points, which are no values, are given back."""
    kind, keys = (
        draw(st.sampled_from(["tensor", "tuple", "list", "dict", "data", "nested"])),
        draw(st.sets(WORDS, min_size=2)),
    )
    first, second, *_ = sorted(keys)
    if draw(st.booleans()):
        first, second = second, first
    return {
        "tensor": lambda values, _: values,
        "tuple": lambda values, points: (points, values) if first < second else (values, points, None),
        "list": lambda values, points: [values, 3, points],
        "dict": lambda values, points: {first: points, second: values},
        "data": lambda values, points: make_dataclass("Given", [first, second])(values, points),
        "nested": lambda values, points: ({first: {second: values}}, [points]),
    }[kind]


@given(container=containers(), form=st.sampled_from(FORMS), weights=st.sampled_from(DTYPES),
       result=st.sampled_from(DTYPES), in_place=st.booleans(), batched=st.booleans())  # fmt: skip
def test_types_shapes_and_containers_are_converted(container, form, weights, result, in_place, batched):
    def output(made: Made, points: Tensor) -> Any:
        if batched:
            _, count, _ = points.shape
            points = points.reshape(count, 3)
        if in_place:
            points *= 2
            points /= 2
        return container(made.values(points).to(result).reshape(form), points)

    checked = check_forward(Made(output, weights), torch.zeros(()))
    coarse = max(torch.finfo(dtype).eps for dtype in (weights, result, torch.float32))
    for count in (0, 1, 3, 40):
        points = POINTS[:count].clone()
        values = checked(points)
        assert values.shape == (count,) and values.dtype == torch.float32 and torch.equal(points, POINTS[:count])
        torch.testing.assert_close(values, sphere(points), rtol=0, atol=8 * coarse)
    slopes = autograd_gradients(checked, POINTS)
    torch.testing.assert_close(slopes, autograd_gradients(sphere, POINTS), rtol=0, atol=16 * coarse)
    assert bool(checked.note) == (container(POINTS, POINTS) is not POINTS or result.itemsize < 4)


class Casting(nn.Module):
    """A sphere through a matrix that is no parameter, in a type that the class needs; it keeps a computed tensor."""

    def __init__(self, dtype: torch.dtype) -> None:
        super().__init__()
        self.radius, self.matrix = nn.Parameter(torch.tensor([0.5], dtype=dtype)), torch.eye(3, dtype=dtype)

    def forward(self, points: Tensor) -> Tensor:
        self.kept = points.to(self.matrix.dtype) @ self.matrix
        return torch.dot(self.radius, torch.ones(1, dtype=self.matrix.dtype)).neg() + self.kept.norm(dim=-1)


@given(dtype=st.sampled_from(DTYPES), later=st.sampled_from((torch.float32, torch.float64)))
def test_a_class_that_needs_its_types_keeps_them(dtype, later):
    checked = check_module(Casting(dtype))
    limit = 8 * max(torch.finfo(dtype).eps, torch.finfo(torch.float32).eps)
    for version in (checked, deepcopy(checked).to(later)):
        for points in (POINTS.clone(), POINTS.double()):
            values = version(points.requires_grad_())
            assert values.dtype == points.dtype
            torch.testing.assert_close(values.detach().float(), sphere(POINTS), rtol=0, atol=limit)


@torch.no_grad()
def without_gradients(made: Made, points: Tensor) -> Tensor:
    return made.values(points)


@torch.inference_mode()
def in_inference_mode(made: Made, points: Tensor) -> Tensor:
    return made.values(points)


def with_a_saved_value_changed(made: Made, points: Tensor) -> Tensor:
    squares = points.sum(-1).exp()
    squares += 1
    return squares - made.radius


@each("forward, remedy", [
    (without_gradients, "remove detach, .data, no_grad and inference_mode"),
    (in_inference_mode, "remove detach, .data, no_grad and inference_mode"),
    (lambda made, points: made.values(points.detach()), "remove detach"),
    (lambda made, points: made.values(points.clone().detach().requires_grad_()), "make no new leaf"),
    (lambda made, points: made.values(points.detach()) + 0 * points.sum(-1, keepdim=True), "remove detach"),
    (lambda made, points: made.values(points.detach()) + 0.5 * made.values(points), "remove detach"),
    (lambda made, points: (made.values(points) > 0).float(), "remove detach"),
    (lambda made, points: made.values(points).sign(), "return values before sign, round or a threshold"),
    (with_a_saved_value_changed, "use no in-place operation"),
    (lambda made, points: made.values(points) + torch.randn(len(points), 1), "draw nothing at random"),
    (lambda made, points: nn.functional.dropout(made.values(points)), "call eval()"),
    (lambda made, points: made.values(points - points.mean(0)), "normalise by constants"),
    (lambda made, points: made.values(points) > 0, "bool [n, 1]: forward must take points [n, 3]"),
    (lambda made, points: made.values(points).to(torch.complex64), "complex64 [n, 1]: forward must take"),
    (lambda made, points: None, "gives None: forward must take points [n, 3] and give one value per point"),
    (lambda made, points: made.values(points).detach().numpy(), "gives a ndarray: forward must take"),
    (lambda made, points: made.values(points).mean(), "float32 []: forward must take"),
    (lambda made, points: made.values(points) - made.values(points).T, "float32 [n, n]: forward must take"),
    (lambda made, points: points["coords"], "fails at points [n, 3]"),
    (lambda made, points: points @ torch.eye(4), "forward must take points [n, 3]"),
])  # fmt: skip
def test_a_wrong_forward_pass_is_refused_with_class_cause_and_remedy(forward, remedy):
    with pytest.raises(BadInput) as error:
        check_forward(Made(forward), torch.zeros(()))
    assert "Made.forward" in str(error.value) and remedy in str(error.value)


@given(columns=st.integers(2, 9), keys=st.lists(WORDS, min_size=2, max_size=4, unique=True), many=st.booleans())
def test_columns_and_several_values_are_named(columns, keys, many):
    def output(made: Made, points: Tensor) -> Any:
        values = made.values(points)
        return dict.fromkeys(keys, values) if many else values.expand(-1, columns) * torch.ones(columns)

    with pytest.raises(BadInput) as error:
        check_forward(Made(output), torch.zeros(()))
    for word in [f"{key}: float32 [n, 1]" for key in keys] if many else [f"[n, {columns}]", "values[:, :1]"]:
        assert word in str(error.value)


def test_an_argument_besides_the_points_is_named():
    class Coded(Made):
        def forward(self, points: Tensor, latent: Tensor, scale: float = 1.0) -> Tensor:
            return self.values(points)

    with pytest.raises(BadInput, match=r"Coded\.forward wants points, latent: .*Give the others a default"):
        from_module(Coded(without_gradients))
