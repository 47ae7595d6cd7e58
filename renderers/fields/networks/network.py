"""A field from any network of points, with or without a code. The kind of its values is measured."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from renderers.checks import BadInput
from renderers.field import (
    LIPSCHITZ_SAFETY_FACTOR,
    Coarse,
    Field,
    Flops,
    Kind,
    PointFunction,
    autograd_gradients,
    coarse_version,
    points_in_sphere,
)
from renderers.fields.analytic import Shape
from renderers.fields.mlp import Decoder, split_into_passes
from renderers.fields.networks.forward import check_forward

SAMPLES = 2**14  # points in the unit sphere, for values and slopes
SPHERE_POINTS, OTHER_CODE_POINTS = 4096, 512  # points on the unit sphere, for the field and for each other code
# Values are distances if two limits hold, as for our trained priors. Near the surface, at this fraction of the points,
# the middle 80 % of the slopes are 1 up to this deviation. Of all slopes, 99 % are at most MAX_SLOPE.
NEAR_SURFACE_FRACTION, MAX_SLOPE_DEVIATION, MAX_SLOPE = 0.1, 0.25, 1.5


@dataclass(frozen=True)
class FieldStatistics:
    """Statistics of a field's values at random points of the unit sphere. A slope is the length of a gradient.

    Args:
        min_value, max_value: of the values.
        fraction_inside: of the volume of the unit sphere, inside meaning negative values.
        extent: of the part that is inside, along each axis.
        sphere_fraction_inside: of the surface of the unit sphere.
        min_slope, max_slope: of the slopes.
        near_slopes: 10th, 50th and 90th percentile of the slope near the surface.
        slope_p99: 99th percentile of the slope.
    """

    min_value: float
    max_value: float
    fraction_inside: float
    extent: tuple[float, float, float]
    sphere_fraction_inside: float
    min_slope: float
    max_slope: float
    near_slopes: tuple[float, float, float]
    slope_p99: float

    @property
    def kind(self) -> Kind:
        """DISTANCE if slopes are close to 1 near the surface and nowhere much larger, else BOUND, after division."""
        low, _, high = self.near_slopes
        is_distance = low >= 1 - MAX_SLOPE_DEVIATION and high <= 1 + MAX_SLOPE_DEVIATION and self.slope_p99 <= MAX_SLOPE
        return Kind.DISTANCE if is_distance else Kind.BOUND

    @property
    def summary(self) -> str:
        """The statistics in one line."""
        low, middle, high = self.near_slopes
        where = f"{self.sphere_fraction_inside:.1%} of the unit sphere's surface is inside"
        where = where if self.sphere_fraction_inside else "it lies in the unit sphere"
        return (
            f"slopes from {self.min_slope:.3g} to {self.max_slope:.3g}, near the surface {middle:.3g} "
            f"({low:.3g} to {high:.3g}); {self.fraction_inside:.1%} of the sphere is inside, "
            f"{' x '.join(f'{side:.2f}' for side in self.extent)} in extent; {where}"
        )


@dataclass(frozen=True)
class FieldInterpretation:
    """How to read a network's values: the field is `factor * (value - level)`, negative inside, and of a kind.

    Args:
        statistics: of values that are negative inside, before the division of a bound.
        kind: of the field.
        divisor: of a bound; 1 for other kinds.
        factor: the scale over the divisor; negative if values above the level are inside.
    """

    statistics: FieldStatistics
    kind: Kind
    divisor: float
    factor: float

    @property
    def lipschitz(self) -> float | None:
        """1 for a bound; None for a distance, whose slope is only close to 1."""
        return 1.0 if self.kind is Kind.BOUND else None


def measure_field(
    field: PointFunction,
    like: Tensor,
    *,
    kind: Kind | None = None,
    sign: float | None = None,
    level: float = 0.0,
    scale: float = 1.0,
    others: Sequence[PointFunction] = (),
) -> FieldInterpretation:
    """Measures the interpretation of a field's values, from values and slopes in the unit sphere.

    Args:
        like: a tensor with the dtype and the device of the evaluations.
        kind: None measures it. Values of a bound, and values that are not distances, are divided by the largest slope
            plus a margin of 20 %. They are then a bound if no slope between the points is larger.
        sign: 1 if values below the level are inside, -1 if values above it are. None takes the sign for which less of
            the unit sphere is inside, by a majority of this field and the others.
        level: the value on the surface.
        scale: a factor of the values.
        others: fields of the same network at other codes, with the same sign and the same divisor.

    Raises:
        BadInput: if values or gradients are not finite.
    """
    points = points_in_sphere(SAMPLES, like)
    surface = nn.functional.normalize(points[:SPHERE_POINTS], dim=-1)
    with torch.no_grad():
        values = torch.cat([field(chunk) for chunk in points.split(SPHERE_POINTS)]).double() - level
        sphere_values = [field(surface).double() - level]
        sphere_values += [other(surface[:OTHER_CODE_POINTS]) - level for other in others]
    slopes = scale * torch.cat([_slopes(field, chunk) for chunk in points.split(SPHERE_POINTS)])
    for name, numbers in (("value", values), ("gradient", slopes)):
        if count := int((~numbers.isfinite()).sum()):
            message = f"its {name} is not finite at {count} of {SAMPLES} points of the unit sphere"
            raise BadInput(f"{message}: check its weights")
    if sign is None:
        votes = sum(float((field_values > 0).double().mean()) >= 0.5 for field_values in sphere_values)
        sign = 1.0 if 2 * votes >= len(sphere_values) else -1.0
    statistics = _measure_statistics(points, sign * scale * values, sign * sphere_values[0], slopes)
    kind, divisor = kind or statistics.kind, 1.0
    if kind is Kind.BOUND:
        few = points[:OTHER_CODE_POINTS]
        steepest = max(others, key=lambda other: float(_slopes(other, few).max()), default=field)
        other_slope = scale * float(_slopes(steepest, points[:SPHERE_POINTS]).max())
        divisor = LIPSCHITZ_SAFETY_FACTOR * max(statistics.max_slope, other_slope)
    return FieldInterpretation(statistics, kind, divisor, sign * scale / divisor)


def _slopes(field: PointFunction, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    return torch.linalg.vector_norm(autograd_gradients(field, points), dim=-1).double()


def _measure_statistics(points: Tensor, values: Tensor, sphere_values: Tensor, slopes: Tensor) -> FieldStatistics:
    """The statistics of values and slopes at points, and of values on the unit sphere; negative inside."""
    near = values.abs() <= values.abs().quantile(NEAR_SURFACE_FRACTION)
    low, middle, high = slopes[near].quantile(slopes.new_tensor([0.1, 0.5, 0.9])).tolist()
    inside = points[values < 0]
    x, y, z = (inside.amax(0) - inside.amin(0)).tolist() if len(inside) else (0.0, 0.0, 0.0)
    return FieldStatistics(
        min_value=float(values.min()),
        max_value=float(values.max()),
        fraction_inside=float((values < 0).double().mean()),
        extent=(x, y, z),
        sphere_fraction_inside=float((sphere_values < 0).double().mean()),
        min_slope=float(slopes.min()),
        max_slope=float(slopes.max()),
        near_slopes=(low, middle, high),
        slope_p99=float(slopes.quantile(0.99)),
    )


def from_module(network: Callable[[Tensor], Tensor], *, kind: Kind | None = None, like: Tensor | None = None) -> Shape:
    """A field from a network of points [n, 3] with values [n] or [n, 1], negative inside.

    >>> field = from_module(nn.Sequential(nn.Linear(3, 32), nn.Softplus(100), nn.Linear(32, 1)))

    Args:
        network: an nn.Module, or any such function.
        kind: of the values; None measures it; see `measure_field`.
        like: a tensor with the network's dtype and device; None takes its first parameter, or float32 on the CPU.

    Raises:
        BadInput: if the network fails or has no gradient, see `check_forward`; if values are not finite, or not
            negative inside and positive outside.
    """
    parameters = list(network.parameters()) if isinstance(network, nn.Module) else []
    like = (parameters or [torch.zeros(())])[0] if like is None else like
    checked = check_forward(network, like)

    def values(points: Tensor) -> Tensor:
        return checked(points.reshape(-1, 3)).reshape(points.shape[:-1])

    interpretation = measure_field(values, like, kind=kind, sign=1.0)
    low, high = interpretation.statistics.min_value, interpretation.statistics.max_value
    if not low < 0 < high or interpretation.statistics.sphere_fraction_inside == 1:
        raise BadInput(
            f"its values in the unit sphere, from {low:.3g} to {high:.3g}, are no shape "
            "that is negative inside: negate them, subtract the level of the surface, or scale the points"
        )
    flops = flops_of(network) if isinstance(network, nn.Module) else None
    factor = interpretation.factor
    return Shape(lambda points: factor * values(points), interpretation.kind, interpretation.lipschitz, flops)


class Coded(nn.Module):
    """A network `body(points [n, 3], code [length]) -> values [n]`, bound to one code before rendering.

    Args:
        body: the network; with `code_length` 0 its code is empty.
        code_length: of the network's code; 0 makes the code the position of the shape, a translation by three numbers.
        width: neurons per layer.
    """

    scale: Tensor

    def __init__(self, body: nn.Module, *, code_length: int, width: int) -> None:
        super().__init__()
        self.body, self.code_is_position, self.width = body, code_length == 0, width
        self.code_length = code_length or 3
        self.register_buffer("scale", torch.ones(()))

    def at(self, code: Float[Tensor, " code_length"]) -> Shape:
        """The values at one code, as a field."""
        if code.shape != (self.code_length,):
            raise ValueError(f"code must have {self.code_length} numbers, not the shape {list(code.shape)}")
        values = AtCode(self.body, code, self.scale, self.width, self.code_is_position)
        return Shape(values, Kind.LEVEL, None, getattr(self.body, "flops", None) or flops_of(self.body))


@dataclass(frozen=True)
class AtCode:
    """The values of a `Coded` at one code; `placed` means that the code is a position."""

    body: nn.Module
    code: Float[Tensor, " code_length"]
    scale: Float[Tensor, ""]
    width: int
    placed: bool

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        flat = points.reshape(-1, 3)
        flat = (flat - self.code if self.placed else flat) / self.scale
        code = self.code[:0] if self.placed else self.code
        values = [self.body(chunk, code) for chunk in split_into_passes(flat, self.width)]
        return torch.cat(values).view(points.shape[:-1])


@dataclass(frozen=True)
class Adjusted:
    """A field `factor * (tanh(inner) - level)`, with `squash` applications of tanh."""

    inner: Field
    squash: int
    factor: Float[Tensor, ""]
    level: Float[Tensor, ""]
    kind: Kind
    lipschitz: float | None

    @property
    def flops(self) -> Flops | None:
        return self.inner.flops

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return self.adjust(self.inner(points))

    @property
    def coarse(self) -> Coarse | None:
        """The inner field's coarse values. A tanh does not raise their error, as its slope is at most 1."""
        inner = coarse_version(self.inner)
        if inner is None:
            return None
        return Coarse(lambda points: self.adjust(inner.values(points)), float(self.factor.abs()) * inner.error)

    def adjust(self, values: Tensor) -> Tensor:
        """The values of this field from those of the inner one; monotonic."""
        for _ in range(self.squash):
            values = values.tanh()
        return self.factor * (values - self.level)


class Published(nn.Module):
    """A published network; its field at a code is `Adjusted`.

    Args:
        inner: the network.
        squash: number of tanh after it.
        assumption: of the values, which the file does not state; for notes and messages.
    """

    factor: Tensor
    level: Tensor
    kind: Kind
    lipschitz: float | None

    def __init__(self, inner: Decoder | Coded, squash: int = 0, assumption: str = "") -> None:
        super().__init__()
        self.assumption = assumption
        self.inner, self.squash, self.kind, self.lipschitz = inner, squash, Kind.LEVEL, None
        self.code_length, self.width, self.code_is_position = inner.code_length, inner.width, inner.code_is_position
        self.register_buffer("factor", torch.ones(()))
        self.register_buffer("level", torch.zeros(()))

    def at(self, code: Float[Tensor, " code_length"]) -> Adjusted:
        """The field of one code."""
        field = cast(Field, self.inner.at(code))
        return Adjusted(field, self.squash, self.factor, self.level, self.kind, self.lipschitz)


def interpret(network: Published, interpretation: FieldInterpretation, *, level: float) -> Decoder | Published:
    """Changes a network in place, so that its fields follow the interpretation, and returns it.

    A decoder without a tanh stays a decoder: the level and the factor are merged into its last layer.
    """
    inner, factor = network.inner, interpretation.factor
    if isinstance(inner, Decoder) and not network.squash:
        with torch.no_grad():
            inner.last.weight.mul_(factor)
            inner.last.bias.sub_(level).mul_(factor)
        inner.kind, inner.lipschitz = interpretation.kind, interpretation.lipschitz
        return inner
    network.factor.fill_(factor)
    network.level.fill_(level)
    network.kind, network.lipschitz = interpretation.kind, interpretation.lipschitz
    return network


@torch.no_grad()
def scale_shapes(network: Decoder | Coded, scale: float) -> None:
    """Makes the shapes of a network `scale` times as large; values are not scaled."""
    if isinstance(network, Coded):
        network.scale.mul_(scale)
        return
    for index, layer in enumerate(network.hidden):
        assert isinstance(layer, nn.Linear)
        if index in (0, network.skip):
            layer.weight[:, -3:].div_(scale)


def flops_of(network: nn.Module) -> Flops:
    """A multiplication and an addition per weight of matrices; the gradient costs as much, or twice with weights."""
    value = 2 * sum(weight.numel() for weight in network.parameters() if weight.dim() > 1)
    has_gradient = any(weight.requires_grad for weight in network.parameters())
    return Flops(value, 2 * value if has_gradient else value)
