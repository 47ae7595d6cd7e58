"""Fields: callables from points to values, negative inside; their properties; normals; the Meter; moved fields."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from functools import lru_cache, partial
from typing import Any, ClassVar, Protocol, cast, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from renderers.camera import rigid
from renderers.tracing.waits import active_mask

GRADIENT_COST, COARSE_COST = 2.0, 0.125  # as multiples of a field evaluation; see `Counts.cost`
COARSE_STEP_FACTOR = 2  # marches on coarse values may take more steps, since these are shorter near the surface
LIPSCHITZ_SAFETY_FACTOR = 1.2  # the field may be steeper between the sampled points


class Kind(Enum):
    """What the values of a field mean, the strongest meaning first.

    DISTANCE: the signed distance to the surface. BOUND: the magnitude never exceeds the distance, so that a step of
    that length passes no surface. LEVEL: only the sign and the zero set have a meaning.
    """

    DISTANCE = "distance"
    BOUND = "bound"
    LEVEL = "level"


@dataclass(frozen=True)
class Flops:
    """Floating-point operations per point: of a field evaluation, and of its backward pass."""

    value: int
    gradient: int


@runtime_checkable
class Field(Protocol):
    """A function from points [*batch, 3] to values [*batch], negative inside.

    `lipschitz` bounds the length of the gradient, and `flops` gives the operations per point; None if unknown.
    """

    kind: Kind
    lipschitz: float | None
    flops: Flops | None

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]: ...


Vectors = Float[Tensor, "*batch 3"]


@runtime_checkable
class Coloured(Field, Protocol):
    """A field whose surface has colours."""

    def colours(
        self,
        points: Float[Tensor, "*batch 3"],
        normals: Float[Tensor, "*batch 3"],
        directions: Float[Tensor, "*batch 3"],
    ) -> Float[Tensor, "*batch 3"]:
        """Red, green and blue from 0 to 1.

        Args:
            points: on the surface.
            normals: the field's gradients at the points; through their graph, colours have a gradient to the shape.
            directions: unit directions of the rays that hit the points.
        """
        ...


@runtime_checkable
class LatentDecoder(Protocol):
    """A module whose latent codes are shapes; `code_is_position` if the code is a point in space, not learnt."""

    code_length: int
    width: int
    code_is_position: bool

    def at(self, code: Float[Tensor, "*shapes code_length"]) -> Field:
        """The field of one code, or of a batch of codes."""
        ...


PointFunction = Callable[[Tensor], Tensor]  # points [*batch, 3] to values [*batch]: a field, or its coarse values


@dataclass(frozen=True)
class Coarse:
    """Cheaper values of a field, to march on; the field itself decides about doubtful rays.

    Args:
        values: without a gradient.
        error: maximum error of a value near the surface, in field units, stated or measured.
    """

    values: PointFunction
    error: float

    def with_counter(self, on_evaluate: Callable[[int], None]) -> "Coarse":
        """The same values; before each evaluation, `on_evaluate` is called with the number of points."""

        def values(points: Tensor) -> Tensor:
            on_evaluate(points.numel() // 3)
            return self.values(points)

        return replace(self, values=values)


def coarse_version(field: Field) -> Coarse | None:
    """The cheaper values that a field has as `coarse`; None if it has none."""
    return getattr(field, "coarse", None)


def marching_values(field: Field, steps: int, *, epsilon: float, coarse: bool) -> tuple[PointFunction, int]:
    """The function to march on, and the maximum number of steps.

    With `coarse`, the function returns the coarse value with its magnitude reduced by its error, so that no step is
    longer than the exact value allows. Where the reduced magnitude is at most the error or `epsilon`, the threshold of
    a hit, or not finite, the exact field is evaluated. A hit is therefore always a hit of the exact field. Coarse
    marching may take `COARSE_STEP_FACTOR` times as many steps.
    """
    cheaper = coarse_version(field) if coarse else None
    if cheaper is None:
        return field, steps

    def values(points: Tensor) -> Tensor:
        coarse_value = cheaper.values(points).to(points.dtype)
        safe_magnitude = coarse_value.abs() - cheaper.error
        near = ~((safe_magnitude > max(cheaper.error, epsilon)) & safe_magnitude.isfinite())
        active = active_mask(len(near))
        near = (near if active is None else near & active).nonzero().squeeze(-1)
        return coarse_value.sign().mul_(safe_magnitude).index_copy_(0, near, field(points.index_select(0, near)))

    return values, COARSE_STEP_FACTOR * steps


class LateInt:
    """An attribute of a dataclass that may be a tensor on a GPU: reading it waits, `Counts.add` does not.

    See "descriptor-typed fields" in Python's documentation of dataclasses. The default is 0.
    """

    def __set_name__(self, owner: type, name: str) -> None:
        self.stored_name = f"_{name}"

    def __get__(self, counts: Any, owner: type) -> int:
        return 0 if counts is None else int(getattr(counts, self.stored_name))

    def __set__(self, counts: Any, number: int | Tensor) -> None:
        setattr(counts, self.stored_name, number)


@dataclass
class Counts:
    """Evaluations counted by a Meter: points whose value, and points whose gradient, was computed.

    `coarse` are points whose value was computed by `Coarse`; `value` does not include them. `masked` are points of
    finished rays, whose values, coarse or not, were thrown away (`tracing.waits.evaluate_masked`); no other count
    includes them. `hits` are the hits of all renderings of the metered field by `boundary.render_checked`.
    """

    value: int = cast(int, LateInt())
    gradient: int = cast(int, LateInt())
    hits: int = cast(int, LateInt())
    coarse: int = cast(int, LateInt())
    masked: int = cast(int, LateInt())

    def add(self, name: str, number: int | Tensor) -> None:
        """Adds to a count, without waiting for a GPU that computes the number."""
        vars(self)[f"_{name}"] += number

    def add_points(self, name: str, points: int) -> None:
        """Adds the active points to the count `name`, and the points of finished rays to `masked`."""
        active = active_mask(points)
        active_points = points if active is None else active.count_nonzero()
        self.add(name, active_points)
        self.add("masked", points - active_points)

    @property
    def cost(self) -> float:
        """The cost in field evaluations: a gradient counts as two, a coarse evaluation as an eighth."""
        return self.value + GRADIENT_COST * self.gradient + COARSE_COST * self.coarse

    def flops(self, field: Field) -> int | None:
        """The floating-point operations, without coarse evaluations; None if the field does not state them."""
        if field.flops is None:
            return None
        return field.flops.value * self.value + field.flops.gradient * self.gradient

    def coarse_flops(self, field: Field) -> int:
        """The operations of coarse evaluations, each with as many as an exact one; 0 if the field states none."""
        return field.flops.value * self.coarse if field.flops else 0

    def over_bound(self, field: Field) -> float | None:
        """The work of these evaluations, divided by one value and one gradient per hit; None without hits.

        No renderer can do less work, if every hit has a gradient. If the field does not state its operations, a
        gradient counts as much as a value. A coarse value counts as much as an exact one.
        """
        cost = field.flops or Flops(1, 1)
        minimum_work = (cost.value + cost.gradient) * self.hits
        work = cost.value * (self.value + self.coarse) + cost.gradient * self.gradient
        return work / minimum_work if minimum_work else None

    def __sub__(self, other: "Counts") -> "Counts":
        return Counts(**{each.name: getattr(self, each.name) - getattr(other, each.name) for each in fields(self)})


class Wrapper(ABC):
    """A Field that evaluates the field `inner`, has its properties, and does something more."""

    inner: Field
    keeps_values: ClassVar[bool] = False  # whether its values are those of `inner`

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

    def count_work(self, evaluations: int) -> None:  # noqa: B027 - a wrapper that counts nothing
        """Counts work that is not an evaluation at points, as the number of field evaluations that cost as much."""


@dataclass(frozen=True)
class Meter(Wrapper):
    """A Field that counts the evaluations of the field `inner`; bounds are counted as the renderer reports them.

    A value evaluation is one point passed to the field. A gradient evaluation is one point through whose value a
    non-zero gradient was propagated back; it is counted during the backward pass.
    """

    inner: Field
    counts: Counts = field(default_factory=Counts)
    keeps_values: ClassVar[bool] = True

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        values = self.inner(points)
        self.counts.add_points("value", values.numel())
        if values.requires_grad:
            values.register_hook(self._count_backward)
        return values

    @property
    def coarse(self) -> Coarse | None:
        """The coarse values of the field, counted separately."""
        uncounted = coarse_version(self.inner)
        return uncounted and uncounted.with_counter(partial(self.counts.add_points, "coarse"))

    def count_work(self, evaluations: int) -> None:
        self.counts.add("value", evaluations)

    def _count_backward(self, gradient: Tensor) -> None:
        self.counts.add("gradient", gradient.count_nonzero())


@dataclass(frozen=True)
class Moved(Wrapper):
    """A field that was scaled, then moved: world = M (scale * local); values stay distances.

    Args:
        inner: the field in local coordinates.
        similarity: the six numbers of the rigid motion M, see `renderers.camera.rigid`, and the natural logarithm of
            the scale.
    """

    inner: Field
    similarity: Float[Tensor, "7"]

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        scale, motion = self.scale_and_motion
        return scale * self.inner((points - motion[:3, 3]) @ motion[:3, :3] / scale)

    @property
    def scale_and_motion(self) -> tuple[Tensor, Tensor]:
        """The scale, and the rigid motion M as a matrix [4, 4]."""
        return self.similarity[6].exp(), rigid(self.similarity[:6])


def carries_gradient(field: Field, like: Float[Tensor, "*batch 3"]) -> bool:
    """Whether the field's values have a gradient towards its parameters. Evaluates no points, so it costs nothing.

    Args:
        like: points of the dtype and device at which the field is evaluated.
    """
    return field(like.detach().reshape(-1, 3)[:0]).requires_grad


def autograd_normals(field: Field, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Unit gradients of the field by automatic differentiation; zero where the gradient vanishes."""
    return torch.nn.functional.normalize(autograd_gradients(field, points), dim=-1)


def autograd_gradients(field: PointFunction, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Gradients of the field by automatic differentiation, not normalised; without a graph."""
    return values_and_gradients(field, points)[1]


def values_and_gradients(
    field: PointFunction, points: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
    """Values of the field and its gradients by automatic differentiation, from one evaluation; without a graph."""
    with torch.enable_grad():
        leaf = points.detach().requires_grad_(True)
        value = field(leaf)
        (gradient,) = torch.autograd.grad(value.sum(), leaf)
    return value.detach(), gradient


def gradients_at(field: Field, points: Float[Tensor, "n 3"], *, graph: bool = True) -> Float[Tensor, "n 3"]:
    """The field's gradients at points, with `graph` differentiable in its parameters and the points.

    They are central differences if the field has a `slope_width`.
    """
    if width := getattr(field.inner if isinstance(field, Meter) else field, "slope_width", 0.0):
        return central_differences(field, points, width)
    points = points if points.requires_grad else points.detach().requires_grad_(True)
    with torch.enable_grad():  # also if the caller needs the loss alone
        return torch.autograd.grad(field(points).sum(), points, create_graph=graph)[0]


def central_differences(field: Field, points: Float[Tensor, "n 3"], width: float) -> Float[Tensor, "n 3"]:
    """The field's gradients at points, by central differences over `width`.

    The gradient of a ReLU network at a point is the same for all codes that open the same ReLUs, so it has no
    derivative in the code. These differences have one, by the ReLUs between the two points.
    """
    moves = width / 2 * torch.eye(3, dtype=points.dtype, device=points.device)
    neighbours = points[:, None, None] + torch.stack([moves, -moves])
    ahead, behind = field(neighbours).unbind(dim=1)
    return (ahead - behind) / width


def estimate_lipschitz(field: Field, *, radius: float, samples: int = 20_000, like: Tensor | None = None) -> float:
    """Estimates the field's Lipschitz constant: the longest gradient at points in the sphere, with a safety factor.

    Args:
        radius: of the sphere about the origin.
        samples: number of points, the same points in each call.
        like: a tensor of the dtype and device at which the field is evaluated; None for float64 on the CPU.
    """
    points = radius * points_in_sphere(samples, like)
    gradients = autograd_gradients(field, points)
    return LIPSCHITZ_SAFETY_FACTOR * float(torch.linalg.vector_norm(gradients, dim=-1).nan_to_num(0.0).max())


def points_in_sphere(count: int, like: Tensor | None = None) -> Float[Tensor, "count 3"]:
    """Uniform random points in the unit sphere about the origin, the same points in each call.

    Args:
        like: a tensor of the dtype and device of the points; None for float64 on the CPU.
    """
    dtype, device = (torch.float64, torch.device("cpu")) if like is None else (like.dtype, like.device)
    return _draw_in_sphere(count, dtype, device).clone()


@lru_cache(maxsize=8)  # a renderer may draw in every rendering
def _draw_in_sphere(count: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "count 3"]:
    options = {"generator": torch.Generator("cpu").manual_seed(0), "dtype": torch.float64, "device": "cpu"}
    direction = torch.nn.functional.normalize(torch.randn(count, 3, **options), dim=-1)
    return (torch.rand(count, 1, **options) ** (1 / 3) * direction).to(device, dtype)


def occupancy_logits(field: Field, values: Float[Tensor, "*batch"], *, width: float) -> Float[Tensor, "*batch"]:
    """Logits of occupancy from a field's values; 0 on the surface, also if the threshold is not 0.5.

    Args:
        values: of the field.
        width: distance over which the logit of a distance or a bound changes by 1, in scene units, positive. Values of
            a level set have no unit: they are only negated.
    """
    if not 0 < width < float("inf"):
        raise ValueError(f"width must be positive, not {width}: 0.02 suits distances in the unit sphere")
    return -values if field.kind is Kind.LEVEL else -values / width
