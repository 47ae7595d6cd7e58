"""Fields: callables from points to values, negative inside; their properties; normals; the Meter; moved fields."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from functools import lru_cache
from math import log
from typing import Protocol, cast, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from renderers.camera import rigid
from renderers.waits import Late, active_among

PRODUCTS = 3  # of a network's weights for bounds on a segment, where a value takes one; see `fields.affine`
GRADIENT, COARSE = 2.0, 0.125  # what a gradient and a coarse value count in `Counts.cost`
PATIENT = 2  # times as many steps are made on coarse values, since these are shorter near the surface
STEEPEST_MARGIN = 1.2  # over the steepest gradient found: the field may be steeper between the points


class Kind(Enum):
    """What the values of a field mean, the strongest meaning first.

    DISTANCE: the signed distance to the surface. BOUND: its magnitude never exceeds the distance, so that a step of
    that length passes no surface. LEVEL: only the sign and the zero set mean anything.
    """

    DISTANCE = "distance"
    BOUND = "bound"
    LEVEL = "level"


@dataclass(frozen=True)
class Flops:
    """Floating-point operations per point: of its value, and of its backward pass."""

    value: int
    gradient: int


@runtime_checkable
class Field(Protocol):
    """Points [*batch, 3] to values [*batch], negative inside.

    `lipschitz` bounds the length of the gradient, and `flops` gives the operations per point, where that is known.
    """

    kind: Kind
    lipschitz: float | None
    flops: Flops | None

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]: ...


Values = Callable[[Tensor], Tensor]  # points [*batch, 3] to values [*batch]: a field, or its coarse values


@dataclass(frozen=True)
class Coarse:
    """Cheaper values of a field, to march on; what they leave in doubt is decided by the field itself.

    Args:
        values: without a gradient.
        error: most that one of them is off, in field units, stated or measured; near the surface, where it matters.
    """

    values: Values
    error: float

    def noted(self, note: Callable[[int], None]) -> "Coarse":
        """The same; `note` is told of how many points values are asked for, before they are evaluated."""

        def values(points: Tensor) -> Tensor:
            note(points.numel() // 3)
            return self.values(points)

        return replace(self, values=values)


def coarse_of(field: Field) -> Coarse | None:
    """The cheaper values that a field offers as `coarse`; None where it offers none."""
    return getattr(field, "coarse", None)


def values_to_march_on(field: Field, steps: int, *, epsilon: float, coarse: bool) -> tuple[Values, int]:
    """The values that a march of at most `steps` steps asks for, and how many steps it makes on them.

    With `coarse` these are what is certain of the coarse values that the field offers, and `PATIENT` times the steps.
    They are nearer to 0 by their error, so that no step is longer than the field's own value would have it. Where no
    more than that error or `epsilon`, below which a ray hits, is left, or the coarse value is not finite, the field
    itself is asked: a hit is one of its own.
    """
    offered = coarse_of(field) if coarse else None
    if offered is None:
        return field, steps

    def values(points: Tensor) -> Tensor:
        found = offered.values(points).to(points.dtype)
        certain = found.abs() - offered.error
        near = ~((certain > max(offered.error, epsilon)) & certain.isfinite())
        active = active_among(len(near))
        near = (near if active is None else near & active).nonzero().squeeze(-1)
        return found.sign().mul_(certain).index_copy_(0, near, field(points.index_select(0, near)))

    return values, PATIENT * steps


# From the middles of segments and the vectors to their ends, both [n, 3], to bounds of the values there: low and high.
Bounds = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


def bounds_of(field: Field) -> Bounds | None:
    """The bounds of its values on segments that a field offers as `bounds`, without a graph; None where it does not."""
    return getattr(field, "bounds", None)


def noted_bounds(field: Field, note: Callable[[int], None]) -> Bounds | None:
    """The same; `note` is told of as many values as cost as much, before they are evaluated."""
    offered = bounds_of(field)
    if offered is None:
        return None

    def bounds(middle: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
        note(PRODUCTS * len(middle))
        return offered(middle, half)

    return bounds


@dataclass
class Counts:
    """Evaluations counted by a Meter: points whose value, and points whose gradient, was computed.

    `coarse` are points whose value was computed by `Coarse`; they are not in `value`. `masked` are in none of these:
    points of rays that had ended, whose values, coarse or not, were thrown away; see `waits.values_where`. `hits` are
    those of the renderings of the metered field that `boundary.rendered` has checked.
    """

    value: int = cast(int, Late())
    gradient: int = cast(int, Late())
    hits: int = field(default=cast(int, Late()), repr=False, compare=False)
    coarse: int = cast(int, Late())
    masked: int = field(default=cast(int, Late()), repr=False, compare=False)

    def add(self, name: str, points: int) -> None:
        """Adds to `value` or `coarse` those of so many points that are asked for, and the others to `masked`."""
        active = active_among(points)
        asked = points if active is None else active.count_nonzero()
        Late.add(self, name, asked)
        Late.add(self, "masked", points - asked)

    @property
    def cost(self) -> float:
        """These evaluations as so many values: a gradient counts as two of them, a coarse value as an eighth."""
        return self.value + GRADIENT * self.gradient + COARSE * self.coarse

    def flops(self, field: Field) -> int | None:
        """The floating-point operations of these evaluations, without coarse ones; None where the field has none."""
        if field.flops is None:
            return None
        return field.flops.value * self.value + field.flops.gradient * self.gradient

    def coarse_flops(self, field: Field) -> int:
        """The operations of coarse evaluations, each of which has as many as one that is not; 0 if none are stated."""
        return field.flops.value * self.coarse if field.flops else 0

    def over_bound(self, field: Field) -> float | None:
        """The work of these evaluations, divided by that of one value and one gradient per hit; None without hits.

        No renderer can do with less, if every hit has a gradient. Of a field that does not state its operations, a
        gradient counts as much as a value. A coarse value counts as much as any.
        """
        cost = field.flops or Flops(1, 1)
        least = (cost.value + cost.gradient) * self.hits
        work = cost.value * (self.value + self.coarse) + cost.gradient * self.gradient
        return work / least if least else None

    def __sub__(self, other: "Counts") -> "Counts":
        names = [one.name for one in fields(self)]
        return Counts(**{name: getattr(self, name) - getattr(other, name) for name in names})


class Wrapper(ABC):
    """A Field that does something beside evaluating the field that it wraps, whose properties it has."""

    inner: Field

    @property
    def kind(self) -> Kind:
        return self.inner.kind

    @property
    def lipschitz(self) -> float | None:
        return self.inner.lipschitz

    @property
    def flops(self) -> Flops | None:
        return self.inner.flops

    @abstractmethod
    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]: ...


@dataclass(frozen=True)
class Meter(Wrapper):
    """A Field that counts the evaluations of the field that it wraps, so that no renderer can under-report.

    A value evaluation is one point passed to the field. A gradient evaluation is one point through whose value a
    gradient other than zero was propagated back, counted when the backward pass arrives there.
    """

    inner: Field
    counts: Counts = field(default_factory=Counts)

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        values = self.inner(points)
        self._count_value(values.numel())
        if values.requires_grad:
            values.register_hook(self._count_backward)
        return values

    @property
    def coarse(self) -> Coarse | None:
        """The coarse values of the field, counted apart."""
        offered = coarse_of(self.inner)
        return offered and offered.noted(self._count_coarse)

    @property
    def bounds(self) -> Bounds | None:
        """The bounds that the field offers; each counts as the products of weights that it takes."""
        return noted_bounds(self.inner, self._count_value)

    def _count_value(self, points: int) -> None:
        self.counts.add("value", points)

    def _count_coarse(self, points: int) -> None:
        self.counts.add("coarse", points)

    def _count_backward(self, gradient: Tensor) -> None:
        Late.add(self.counts, "gradient", gradient.count_nonzero())


@dataclass(frozen=True)
class Moved(Wrapper):
    """A shape that was scaled, then moved: world = M (scale * local); values stay distances.

    Args:
        inner: the shape in its own axes.
        similarity: the six numbers of the rigid motion M, see `renderers.camera.rigid`, and the natural logarithm of
            the scale.
    """

    inner: Field
    similarity: Float[Tensor, "7"]

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        scale, motion = self._parts
        return scale * self.inner((points - motion[:3, 3]) @ motion[:3, :3] / scale)

    @property
    def bounds(self) -> Bounds | None:
        """The bounds that the field offers, moved as it is."""
        offered = bounds_of(self.inner)
        if offered is None:
            return None
        scale, motion = (part.detach() for part in self._parts)

        def bounds(middle: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
            turned = motion[:3, :3] / scale
            low, high = offered((middle - motion[:3, 3]) @ turned, half @ turned)
            return scale * low, scale * high

        return bounds

    @property
    def _parts(self) -> tuple[Tensor, Tensor]:
        return self.similarity[6].exp(), rigid(self.similarity[:6])


def carries_gradient(field: Field, like: Float[Tensor, "*batch 3"]) -> bool:
    """Whether the field's values have a gradient towards its parameters; asked at no points, so that it costs nothing.

    Args:
        field: asked where gradients are enabled.
        like: points of the dtype and device at which the field is evaluated.
    """
    return field(like.detach().reshape(-1, 3)[:0]).requires_grad


def autograd_normals(field: Field, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Unit gradients of the field by automatic differentiation; zero where the gradient vanishes."""
    return torch.nn.functional.normalize(autograd_gradients(field, points), dim=-1)


def autograd_gradients(field: Values, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Gradients of the field by automatic differentiation, of any length; without a graph."""
    return values_and_gradients(field, points)[1]


def values_and_gradients(
    field: Values, points: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
    """Values of the field and its gradients by automatic differentiation, of one evaluation; without a graph."""
    with torch.enable_grad():
        leaf = points.detach().requires_grad_(True)
        value = field(leaf)
        (gradient,) = torch.autograd.grad(value.sum(), leaf)
    return value.detach(), gradient


def steepest(field: Field, *, radius: float, samples: int = 20_000, like: Tensor | None = None) -> float:
    """An estimate of the field's Lipschitz bound: the longest gradient at points drawn in the sphere, with a margin.

    Args:
        radius: of the sphere about the origin.
        samples: how many points, the same ones each time.
        like: a tensor of the dtype and device at which the field is evaluated; None for float64 on the CPU.
    """
    points = radius * points_in_sphere(samples, like)
    gradients = autograd_gradients(field, points)
    return STEEPEST_MARGIN * float(torch.linalg.vector_norm(gradients, dim=-1).nan_to_num(0.0).max())


def points_in_sphere(count: int, like: Tensor | None = None) -> Float[Tensor, "count 3"]:
    """Points drawn evenly in the unit sphere about the origin, the same ones each time.

    Args:
        like: a tensor of the dtype and device of the points; None for float64 on the CPU.
    """
    where = (torch.float64, torch.device("cpu")) if like is None else (like.dtype, like.device)
    return _drawn_in_sphere(count, *where).clone()


@lru_cache(maxsize=8)  # a renderer may ask at every rendering
def _drawn_in_sphere(count: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "count 3"]:
    draws = {"generator": torch.Generator("cpu").manual_seed(0), "dtype": torch.float64, "device": "cpu"}
    direction = torch.nn.functional.normalize(torch.randn(count, 3, **draws), dim=-1)
    return (torch.rand(count, 1, **draws) ** (1 / 3) * direction).to(device, dtype)


@dataclass(frozen=True)
class OccupancyField:
    """The level set p = threshold (DVR, Sec. 3.1) as a field: logit(threshold) - logit(p), negative where p is above.

    Args:
        logits: logit(p) at points.
        threshold: DVR's tau, between 0 and 1; 0.5 in the paper.
        flops: operations per point, where that is known.
    """

    logits: Values
    threshold: float
    flops: Flops | None = None
    kind: Kind = Kind.LEVEL
    lipschitz: float | None = None

    def __post_init__(self) -> None:
        if not 0 < self.threshold < 1:
            raise ValueError(f"threshold must lie between 0 and 1, not {self.threshold}: DVR uses 0.5")

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return log(self.threshold / (1 - self.threshold)) - self.logits(points)


def occupancy_logits(field: Field, values: Float[Tensor, "*batch"], *, width: float) -> Float[Tensor, "*batch"]:
    """Logits of occupancy from a field's values; 0 on the surface, also where the threshold is not 0.5.

    Args:
        values: of the field.
        width: length over which a distance or a bound changes the logit by 1, in scene units, positive. A level set
            has no length: its values are negated only.
    """
    if not 0 < width < float("inf"):
        raise ValueError(f"width must be positive, not {width}: 0.02 suits distances in the unit sphere")
    return -values if field.kind is Kind.LEVEL else -values / width
