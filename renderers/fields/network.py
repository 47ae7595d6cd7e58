"""A field of any network from points, and perhaps a code, to values; what its values mean is measured."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from renderers.checks import BadInput
from renderers.field import (
    LIPSCHITZ_SAFETY_FACTOR,
    Bounds,
    Coarse,
    Field,
    Flops,
    Kind,
    PointFunction,
    autograd_gradients,
    coarse_version,
    field_bounds,
    points_in_sphere,
)
from renderers.fields.analytic import Shape
from renderers.fields.mlp import Decoder, flops_of, passes

DRAWN = 2**14  # points in the unit sphere at which values and slopes are measured
AROUND, FEW = 4096, 512  # points on the unit sphere; those for another code
NEAR = 0.1  # share of the points, those of least magnitude, whose slopes say whether values are distances
EVEN = 0.25  # near its surface a distance has a slope of 1, up to this, at four of five points
ANY_SLOPE = 1.5  # and in the sphere no steeper one, but for one point of a hundred; our trained priors are within both


@dataclass(frozen=True)
class Facts:
    """What the values of a field are like in the unit sphere, at points drawn there.

    Args:
        least, most: of the values.
        inside: share of the sphere that is inside, where values are negative.
        extent: of what is inside, along each axis.
        leaves: share of the unit sphere's surface that is inside.
        flattest, steepest: slopes, the lengths of the gradient.
        near: 10th, 50th and 90th percentile of the slope near the surface.
        nearly_all: 99th percentile of the slope.
    """

    least: float
    most: float
    inside: float
    extent: tuple[float, float, float]
    leaves: float
    flattest: float
    steepest: float
    near: tuple[float, float, float]
    nearly_all: float

    @property
    def kind(self) -> Kind:
        """DISTANCE where slopes near the surface are nearly 1 and none is much steeper; others can be made a BOUND."""
        low, _, high = self.near
        even = low >= 1 - EVEN and high <= 1 + EVEN and self.nearly_all <= ANY_SLOPE
        return Kind.DISTANCE if even else Kind.BOUND

    @property
    def in_words(self) -> str:
        """The facts in one line."""
        low, middle, high = self.near
        lies, out = "it lies in the unit sphere", f"{self.leaves:.1%} of the unit sphere's surface is inside"
        return (
            f"slopes from {self.flattest:.3g} to {self.steepest:.3g}, near the surface {middle:.3g} "
            f"({low:.3g} to {high:.3g}); {self.inside:.1%} of the sphere is inside, "
            f"{' x '.join(f'{side:.2f}' for side in self.extent)} in extent; {out if self.leaves else lies}"
        )


@dataclass(frozen=True)
class Meaning:
    """What values mean: `factor * (value - level)` is negative inside, and of a kind.

    Args:
        facts: of values that are negative inside, before a bound is divided.
        kind: of the field.
        divisor: by which a bound is divided; 1 of others.
        factor: the scale over the divisor; negative where values above the level are inside.
    """

    facts: Facts
    kind: Kind
    divisor: float
    factor: float

    @property
    def lipschitz(self) -> float | None:
        """The bound of the slope: 1 of a bound; a distance is not known to be one exactly."""
        return 1.0 if self.kind is Kind.BOUND else None


def measured(
    field: PointFunction,
    like: Tensor,
    *,
    kind: Kind | None = None,
    sign: float | None = None,
    level: float = 0.0,
    scale: float = 1.0,
    others: Sequence[PointFunction] = (),
) -> Meaning:
    """What the values of a field mean, by values and slopes in the unit sphere.

    Args:
        like: a tensor of the dtype and device at which it is evaluated.
        kind: what is said of it; None measures it. A bound is divided by its steepest slope with a margin of 20 %, and
            so is what is no distance: it is a bound as far as no slope between the points is steeper.
        sign: 1 where values below the level are inside, -1 where those above it are; None takes those that are rarer
            on the unit sphere, of this field or of most of the others.
        level: of the surface.
        scale: what values are multiplied by.
        others: fields of the same network at other codes, whose sign and bound are the same.

    Raises:
        BadInput: where values are not finite.
    """
    points = points_in_sphere(DRAWN, like)
    surface = nn.functional.normalize(points[:AROUND], dim=-1)
    with torch.no_grad():
        values = torch.cat([field(some) for some in points.split(AROUND)]).double() - level
        around = [field(surface).double() - level, *(other(surface[:FEW]) - level for other in others)]
    if unknown := int((~values.isfinite()).sum()):
        raise BadInput(f"its value is not finite at {unknown} of {DRAWN} points of the unit sphere: check its weights")
    slopes = scale * torch.cat([_slopes(field, some) for some in points.split(AROUND)])
    if sign is None:
        above = sum(float((found > 0).double().mean()) >= 0.5 for found in around)
        sign = 1.0 if 2 * above >= len(around) else -1.0
    facts = _facts(points, sign * scale * values, sign * around[0], slopes)
    kind, divisor = kind or facts.kind, 1.0
    if kind is Kind.BOUND:
        steepest = max(others, key=lambda other: float(_slopes(other, points[:FEW]).max()), default=field)
        divisor = LIPSCHITZ_SAFETY_FACTOR * max(facts.steepest, scale * float(_slopes(steepest, points[:AROUND]).max()))
    return Meaning(facts, kind, divisor, sign * scale / divisor)


def _slopes(field: PointFunction, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    return torch.linalg.vector_norm(autograd_gradients(field, points), dim=-1).double()


def _facts(points: Tensor, values: Tensor, around: Tensor, slopes: Tensor) -> Facts:
    """The facts of values and slopes at points, and of values on the unit sphere; negative inside."""
    near = slopes[values.abs() <= values.abs().quantile(NEAR)].quantile(slopes.new_tensor([0.1, 0.5, 0.9]))
    low, middle, high = near.tolist()
    inside = points[values < 0]
    x, y, z = (inside.amax(0) - inside.amin(0)).tolist() if len(inside) else (0.0, 0.0, 0.0)
    return Facts(
        least=float(values.min()),
        most=float(values.max()),
        inside=float((values < 0).double().mean()),
        extent=(x, y, z),
        leaves=float((around < 0).double().mean()),
        flattest=float(slopes.min()),
        steepest=float(slopes.max()),
        near=(low, middle, high),
        nearly_all=float(slopes.quantile(0.99)),
    )


def from_module(network: Callable[[Tensor], Tensor], *, kind: Kind | None = None, like: Tensor | None = None) -> Shape:
    """A field of a network that takes points [n, 3] and gives values [n] or [n, 1], negative inside.

    >>> field = from_module(nn.Sequential(nn.Linear(3, 32), nn.Softplus(100), nn.Linear(32, 1)))

    Args:
        network: an nn.Module, or any such function.
        kind: what its values mean; None measures it; see `measured`.
        like: a tensor of the dtype and device at which the network works; None takes its first parameter, or float32.

    Raises:
        BadInput: where values are not finite, or not negative inside and positive about it.
    """
    parameters = list(network.parameters()) if isinstance(network, nn.Module) else []
    like = (parameters or [torch.zeros(())])[0] if like is None else like
    dtype = parameters[0].dtype if parameters else None

    def values(points: Tensor) -> Tensor:
        return network(points.reshape(-1, 3).to(dtype or points.dtype)).reshape(points.shape[:-1]).to(points.dtype)

    meaning = measured(values, like, kind=kind, sign=1.0)
    if not meaning.facts.least < 0 < meaning.facts.most or meaning.facts.leaves == 1:
        raise BadInput(
            f"its values in the unit sphere, from {meaning.facts.least:.3g} to {meaning.facts.most:.3g}, are no shape "
            "that is negative inside: negate them, subtract the level of the surface, or scale the points"
        )
    flops = flops_of(network) if isinstance(network, nn.Module) else None
    return Shape(lambda points: meaning.factor * values(points), meaning.kind, meaning.lipschitz, flops)


class Coded(nn.Module):
    """A network `body(points [n, 3], code [length]) -> values [n]`, bound to one code before rendering.

    Args:
        body: the network; with `code_length` 0 it gets a code without numbers.
        code_length: of its code. Without one, the code is the place of the shape: three numbers by which it is moved.
        width: neurons per layer.
    """

    scale: Tensor

    def __init__(self, body: nn.Module, *, code_length: int, width: int) -> None:
        super().__init__()
        self.body, self.placed, self.width = body, code_length == 0, width
        self.code_length = code_length or 3
        self.register_buffer("scale", torch.ones(()))

    def at(self, code: Float[Tensor, " code_length"]) -> Shape:
        """The values at one code, as a field."""
        if code.shape != (self.code_length,):
            raise ValueError(f"code must have {self.code_length} numbers, not the shape {list(code.shape)}")
        values = AtCode(self.body, code, self.scale, self.width, self.placed)
        return Shape(values, Kind.LEVEL, None, getattr(self.body, "flops", None) or flops_of(self.body))


@dataclass(frozen=True)
class AtCode:
    """The values of a `Coded` at one code; see there."""

    body: nn.Module
    code: Float[Tensor, " code_length"]
    scale: Float[Tensor, ""]
    width: int
    placed: bool

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        flat = points.reshape(-1, 3)
        flat = (flat - self.code if self.placed else flat) / self.scale
        given = self.code[:0] if self.placed else self.code
        found = [self.body(some, given) for some in passes(flat, self.width)]
        return torch.cat(found).view(points.shape[:-1])


@dataclass(frozen=True)
class Adjusted:
    """A field `factor * (tanh(inner) - level)`, with `squash` times tanh; it offers what the inner one does."""

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
        return self._of(self.inner(points))

    @property
    def coarse(self) -> Coarse | None:
        """The inner field's coarse values; a tanh has no slope above 1."""
        offered = coarse_version(self.inner)
        if offered is None:
            return None
        return Coarse(lambda points: self._of(offered.values(points)), float(self.factor.abs()) * offered.error)

    @property
    def bounds(self) -> Bounds | None:
        """The inner field's bounds; the values rise or fall with its own."""
        offered = field_bounds(self.inner)
        if offered is None:
            return None

        def bounds(middle: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
            low, high = map(self._of, offered(middle, half))
            return torch.minimum(low, high), torch.maximum(low, high)

        return bounds

    def _of(self, values: Tensor) -> Tensor:
        for _ in range(self.squash):
            values = values.tanh()
        return self.factor * (values - self.level)


class Published(nn.Module):
    """A network at whose codes fields are `Adjusted`."""

    factor: Tensor
    level: Tensor
    kind: Kind
    lipschitz: float | None

    def __init__(self, inner: Decoder | Coded, squash: int = 0) -> None:
        super().__init__()
        self.inner, self.squash, self.kind, self.lipschitz = inner, squash, Kind.LEVEL, None
        self.code_length, self.width, self.placed = inner.code_length, inner.width, inner.placed
        self.register_buffer("factor", torch.ones(()))
        self.register_buffer("level", torch.zeros(()))

    def at(self, code: Float[Tensor, " code_length"]) -> Adjusted:
        """The field of one code."""
        field = cast(Field, self.inner.at(code))
        return Adjusted(field, self.squash, self.factor, self.level, self.kind, self.lipschitz)


def settled(network: Published, meaning: Meaning, *, level: float) -> Decoder | Published:
    """The network with the fields that were measured to be meant; changed in place.

    A decoder without a tanh takes them into its last layer, and stays a decoder, with all that it offers.
    """
    inner, factor = network.inner, meaning.factor
    if isinstance(inner, Decoder) and not network.squash:
        with torch.no_grad():
            inner.last.weight.mul_(factor)
            inner.last.bias.sub_(level).mul_(factor)
        inner.kind, inner.lipschitz = meaning.kind, meaning.lipschitz
        return inner
    network.factor.fill_(factor)
    network.level.fill_(level)
    network.kind, network.lipschitz = meaning.kind, meaning.lipschitz
    return network


@torch.no_grad()
def enlarged(network: Decoder | Coded, scale: float) -> None:
    """Makes the shapes of a network `scale` times as large, without a change of its values."""
    if isinstance(network, Coded):
        network.scale.mul_(scale)
        return
    for index, layer in enumerate(network.hidden):
        assert isinstance(layer, nn.Linear)
        if index in (0, network.skip):
            layer.weight[:, -3:].div_(scale)
