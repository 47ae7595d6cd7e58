"""The contract of renderers: the Rendering that they return, and their capabilities."""

from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int, Int8
from torch import Tensor

from renderers.camera import Rays, distance_to_origin
from renderers.field import Field, Kind

OUTSIDE = 1.0  # stands for a value that is not finite: far from any surface


class Status(IntEnum):
    """How a ray ended. A ray that fails is data."""

    HIT = 0
    MISS = 1
    STARTED_INSIDE = 2
    OUT_OF_STEPS = 3


@dataclass(frozen=True)
class Deferred:
    """Where a rendering sampled its `closest` values, if it leaves their gradient to `closest_values`.

    Args:
        distance: along each ray to the sample.
        left_out: the rays whose value has no gradient yet.
    """

    distance: Float[Tensor, "*rays"]
    left_out: Bool[Tensor, "*rays"]


@dataclass(frozen=True)
class Volume:
    """What rays see where that is more than one hit: samples, and the weights with which their values are summed.

    Args:
        ray: of each sample, the place of its ray in one row.
        distance: along the ray to the sample, in scene units.
        weight: of the sample; those of a ray add up to its opacity, from 0 to 1. Differentiable.
    """

    ray: Int[Tensor, " samples"]
    distance: Float[Tensor, " samples"]
    weight: Float[Tensor, " samples"]

    def summed(self, values: Float[Tensor, " samples *channels"], count: int) -> Float[Tensor, " count *channels"]:
        """The weighted sums of the samples' values for each of `count` rays."""
        weight = self.weight.view(-1, *[1] * (values.dim() - 1))
        return values.new_zeros(count, *values.shape[1:]).index_add(0, self.ray, weight * values)


@dataclass(frozen=True)
class Rendering:
    """One answer per ray, all of the rays' leading shape, all finite.

    Args:
        distance: along the ray to where it ended; a surface only where `hit`. Differentiable as the renderer states.
        status: of each ray, a Status as int8.
        points: the points at `distance`.
        residual: the last field value on the ray, a measure of the remaining error. Not differentiable.
        closest: the field's value, with its sign, at the sample of least magnitude on the ray. Its magnitude less a
            threshold is DIST's soft silhouette (Sec. 3.3, A.3). Differentiable, but for rays that are deferred.
        deferred: where `closest` has no gradient yet, since most losses need it on few rays; None where it has.
        volume: what the rays see, of a renderer for which that is more than their hits; else None.
    """

    distance: Float[Tensor, "*rays"]
    status: Int8[Tensor, "*rays"]
    points: Float[Tensor, "*rays 3"]
    residual: Float[Tensor, "*rays"]
    closest: Float[Tensor, "*rays"]
    deferred: Deferred | None = None
    volume: Volume | None = None

    @property
    def opacity(self) -> Float[Tensor, "*rays"]:
        """How much each ray sees of the shape, from 0 to 1: 1 on hits and 0 elsewhere, unless there is a volume."""
        if self.volume is None:
            return self.hit.to(self.distance.dtype)
        ones = torch.ones_like(self.volume.weight)
        return self.volume.summed(ones, self.status.numel()).view(self.status.shape)

    @property
    def hit(self) -> Bool[Tensor, "*rays"]:
        """True where the ray ended on a surface."""
        return self.status == Status.HIT


@dataclass(frozen=True)
class Capabilities:
    """A renderer's capabilities.

    Args:
        needs: the kinds of field that it is meant for.
        field_gradient, ray_gradient: whether `distance` and the silhouette loss have a gradient towards the field's
            parameters and the rays; checked in `boundary`.
    """

    needs: tuple[Kind, ...]
    field_gradient: bool
    ray_gradient: bool


OF_LENGTHS = Capabilities(needs=(Kind.DISTANCE, Kind.BOUND), field_gradient=True, ray_gradient=True)
OF_LEVELS = Capabilities(needs=tuple(Kind), field_gradient=True, ray_gradient=True)


class Unsupported(Exception):
    """A renderer lacks what is asked of it; the message says what."""


@dataclass(frozen=True)
class Observed:
    """What is observed of rays: a mask, and distances where they are given.

    Args:
        mask: true on the foreground.
        distance: along each ray to the observed surface, in scene units; NaN where it is not given. None where no ray
            has one.
    """

    mask: Bool[Tensor, "*rays"]
    distance: Float[Tensor, "*rays"] | None = None

    def __post_init__(self) -> None:
        if self.mask.dtype != torch.bool:
            raise ValueError(f"mask must be boolean, not {self.mask.dtype}: compare a picture with a threshold")
        if self.distance is not None and self.distance.shape != self.mask.shape:
            shapes = f"{list(self.mask.shape)}, not {list(self.distance.shape)}"
            raise ValueError(f"distance must have the mask's shape {shapes}: give NaN where no distance is known")


@runtime_checkable
class Renderer(Protocol):
    """Finds surfaces along rays. It never times, logs, draws or synchronises, and knows no task."""

    capabilities: ClassVar[Capabilities]

    def render(self, field: Field, rays: Rays) -> Rendering:
        """The rendering of the field along the rays; calls `check_kind` first."""
        ...

    def silhouette_loss(
        self, field: Field, rays: Rays, rendering: Rendering, mask: Bool[Tensor, "*rays"]
    ) -> Float[Tensor, ""]:
        """The method's own loss between its rendering and a binary mask, true on the foreground."""
        ...


def check_kind(renderer: Renderer, field: Field) -> None:
    """Raises Unsupported where a field is not of a kind that the renderer is meant for."""
    needs = renderer.capabilities.needs
    if field.kind not in needs:
        names = " or ".join(need.value for need in needs)
        bound = ", or make it a bound by renderers.fields.network.from_module" if Kind.BOUND in needs else ""
        raise Unsupported(
            f"{type(renderer).__name__} needs a {names} field, not a {field.kind.value} field: take another "
            f"renderer{bound}"
        )


@runtime_checkable
class Scheduled(Protocol):
    """A renderer whose settings change as an optimisation goes on."""

    def at_iteration(self, iteration: int) -> Renderer:
        """The renderer as it is at an iteration, counted from 0."""
        ...


@runtime_checkable
class Remembering(Protocol):
    """A renderer that remembers something of the optimisation that it serves."""

    def fresh(self) -> Renderer:
        """The renderer for another optimisation, with nothing remembered."""
        ...

    def final_notes(self) -> list[str]:
        """What a reader of the record should know of what it remembers; none before it was used."""
        ...


@runtime_checkable
class Guided(Protocol):
    """A renderer whose own silhouette loss takes given distances as well; the mask alone is `silhouette_loss`."""

    def observed_loss(self, field: Field, rays: Rays, rendering: Rendering, observed: Observed) -> Float[Tensor, ""]:
        """The method's own loss between its rendering, and a mask and the distances that are given."""
        ...


@runtime_checkable
class Blurred(Renderer, Protocol):
    """A renderer whose gradient of visibility is spread over a length."""

    @property
    def blur(self) -> float:
        """That length, in scene units: of the fall of an opacity, or of a band about the outline."""
        ...

    def with_blur(self, blur: float) -> "Blurred":
        """The renderer with another one, all else left, at every iteration."""
        ...


def at_iteration(renderer: Renderer, iteration: int) -> Renderer:
    """The renderer as it is at an iteration of an optimisation: itself, unless it has a schedule."""
    return renderer.at_iteration(iteration) if isinstance(renderer, Scheduled) else renderer


def fresh(renderer: Renderer) -> Renderer:
    """The renderer for one of several optimisations: itself, unless it remembers something."""
    return renderer.fresh() if isinstance(renderer, Remembering) else renderer


def final_notes(renderer: Renderer) -> list[str]:
    """What is to be noted of an optimisation that a renderer served; none unless it remembers something."""
    return renderer.final_notes() if isinstance(renderer, Remembering) else []


def closest_values(
    field: Field, rays: Rays, rendering: Rendering, wanted: Bool[Tensor, "*rays"]
) -> Float[Tensor, "*rays"]:
    """`rendering.closest`, with its gradient on the `wanted` rays, for one value on each of them that was deferred.

    The value there is that of the ray itself; coarse to fine may have sampled `rendering.closest` on its coarse ray.
    """
    if rendering.deferred is None or not torch.is_grad_enabled():
        return rendering.closest
    index = (wanted & rendering.deferred.left_out).flatten().nonzero().squeeze(-1)
    values = field(rays.flat()[index].at(rendering.deferred.distance.flatten()[index]))
    return rendering.closest.flatten().index_put((index,), values).view(rays.shape)


def assemble(
    rays: Rays,
    radius: float,
    *,
    distance: Float[Tensor, " n"],
    status: Int8[Tensor, " n"],
    residual: Float[Tensor, " n"],
    closest: tuple[Int[Tensor, " m"], Float[Tensor, " m"]],
) -> Rendering:
    """The rendering of rays of any leading shape, from one answer per ray in one row.

    A field value that is not finite decides nothing: as a residual it is 0, and as `closest` it is `OUTSIDE`.

    Args:
        rays: all n of them.
        radius: of the sphere about the origin that holds the shape.
        distance, status, residual: as in Rendering.
        closest: the rays on which the field was evaluated, and its value of least magnitude on these. For the others,
            `closest` is their distance from the sphere (DIST, A.3).
    """
    queried, least = closest
    passing_by = distance_to_origin(rays.flat()) - radius
    shaped = distance.view(rays.shape)
    return Rendering(
        distance=shaped,
        status=status.view(rays.shape),
        points=rays.at(shaped),
        residual=residual.detach().nan_to_num(0.0, 0.0, 0.0).view(rays.shape),
        closest=passing_by.index_put((queried,), least.nan_to_num(OUTSIDE, OUTSIDE, OUTSIDE)).view(rays.shape),
    )
