"""The contract of renderers: the Rendering that they return, and their capabilities."""

from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int, Int8
from torch import Tensor

from renderers.camera import Rays, distance_to_origin
from renderers.field import Field, Kind

NON_FINITE_VALUE = 1.0  # replaces a value that is not finite: far from any surface


class Status(IntEnum):
    """How a ray ended. A ray that fails is data."""

    HIT = 0
    MISS = 1
    STARTED_INSIDE = 2
    OUT_OF_STEPS = 3


@dataclass(frozen=True)
class Deferred:
    """The samples of `closest` on rays without a gradient; `closest_values` evaluates them again, with a graph.

    Args:
        distance: along each ray to the sample.
        left_out: the rays whose value has no gradient yet.
    """

    distance: Float[Tensor, "*rays"]
    left_out: Bool[Tensor, "*rays"]


@dataclass(frozen=True)
class Volume:
    """What rays see if that is more than one hit: samples, and their weights in sums along the ray.

    Args:
        ray: of each sample, the index of its ray among the flattened rays.
        distance: along the ray to the sample, in scene units.
        weight: of the sample; the weights of a ray sum to its opacity, from 0 to 1. Differentiable.
    """

    ray: Int[Tensor, " samples"]
    distance: Float[Tensor, " samples"]
    weight: Float[Tensor, " samples"]

    def weighted_sum(self, values: Float[Tensor, " samples *channels"], n: int) -> Float[Tensor, " n *channels"]:
        """The weighted sum of the samples' values for each of n rays."""
        weight = self.weight.view(-1, *[1] * (values.dim() - 1))
        return values.new_zeros(n, *values.shape[1:]).index_add(0, self.ray, weight * values)


@dataclass(frozen=True)
class Rendering:
    """Where each ray ended, in tensors of the rays' leading shape; all values are finite.

    Args:
        distance: along the ray to its end; on a surface only if `hit`. Differentiable as the renderer states.
        status: of each ray, a Status as int8.
        points: the points at `distance`.
        residual: the field value that the renderer reports as its remaining error: at the hit, or at the last or
            closest sample. Not differentiable.
        closest: the field's value, with its sign, at the sample of smallest magnitude on the ray. Its magnitude minus a
            threshold is DIST's soft silhouette (Sec. 3.3, A.3). Differentiable, except on deferred rays.
        deferred: the rays whose `closest` has no gradient yet, since most losses need it on few rays; else None.
        volume: what the rays see, for renderers that show more than hits; else None.
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
        """The opacity of each ray, from 0 to 1: the sum of its weights; without a volume, 1 for a hit, else 0."""
        if self.volume is None:
            return self.hit.to(self.distance.dtype)
        ones = torch.ones_like(self.volume.weight)
        return self.volume.weighted_sum(ones, self.status.numel()).view(self.status.shape)

    @property
    def hit(self) -> Bool[Tensor, "*rays"]:
        """True where the ray ended on a surface."""
        return self.status == Status.HIT


@dataclass(frozen=True)
class Capabilities:
    """A renderer's capabilities.

    Args:
        needs: the kinds of field that it can render; any one suffices.
        field_gradient, ray_gradient: whether `distance` and the silhouette loss have a gradient towards the field's
            parameters and the rays; checked in `boundary`.
    """

    needs: tuple[Kind, ...]
    field_gradient: bool
    ray_gradient: bool


DISTANCE_CAPABILITIES = Capabilities(needs=(Kind.DISTANCE, Kind.BOUND), field_gradient=True, ray_gradient=True)
LEVEL_SET_CAPABILITIES = Capabilities(needs=tuple(Kind), field_gradient=True, ray_gradient=True)


class Unsupported(Exception):
    """A renderer lacks a capability that this run needs; the message names it."""


@dataclass(frozen=True)
class RayObservation:
    """What is observed along rays: a mask, and distances on some or no rays.

    Args:
        mask: true on the foreground.
        distance: along each ray to the observed surface, in scene units; NaN if unknown. None if unknown on all rays.
        covered: if the rays are several in each pixel, [*pixels, n]: the fraction of the pixel on the foreground.
    """

    mask: Bool[Tensor, "*rays"]
    distance: Float[Tensor, "*rays"] | None = None
    covered: Float[Tensor, "*pixels"] | None = None

    def __post_init__(self) -> None:
        if self.mask.dtype != torch.bool:
            raise ValueError(f"mask must be boolean, not {self.mask.dtype}: compare a picture with a threshold")
        if self.distance is not None and self.distance.shape != self.mask.shape:
            shapes = f"{list(self.mask.shape)}, not {list(self.distance.shape)}"
            raise ValueError(f"distance must have the mask's shape {shapes}: give NaN where no distance is known")


@runtime_checkable
class Renderer(Protocol):
    """Finds surfaces along rays. It never times, logs or draws, and knows no task.

    It waits for a GPU only where it needs a number of rays.
    """

    capabilities: ClassVar[Capabilities]

    def render(self, field: Field, rays: Rays) -> Rendering:
        """The rendering of the field along the rays.

        Raises:
            Unsupported: the renderer cannot render this kind of field.
        """
        ...

    def silhouette_loss(
        self, field: Field, rays: Rays, rendering: Rendering, mask: Bool[Tensor, "*rays"]
    ) -> Float[Tensor, ""]:
        """The loss of the renderer's paper between its rendering and a binary mask, true on the foreground."""
        ...


def check_kind(renderer: Renderer, field: Field) -> None:
    """Raises Unsupported if the renderer cannot render this kind of field."""
    needs = renderer.capabilities.needs
    if field.kind not in needs:
        names = " or ".join(need.value for need in needs)
        bound = ", or make it a bound by renderers.fields.networks.network.from_module" if Kind.BOUND in needs else ""
        raise Unsupported(
            f"{type(renderer).__name__} needs a {names} field, not a {field.kind.value} field: take another "
            f"renderer{bound}"
        )


@runtime_checkable
class Scheduled(Protocol):
    """A renderer whose settings change during an optimisation."""

    def at_iteration(self, iteration: int) -> Renderer:
        """The renderer with the settings of an iteration, counted from 0; schedules use its `schedule_position`."""
        ...


@runtime_checkable
class Stateful(Protocol):
    """A renderer with a memory of one optimisation.

    The loop begins with a rendering that is not counted. A renderer that is also scheduled clears its memory at
    iteration 0.
    """

    def with_empty_memory(self) -> Renderer:
        """The same renderer for another optimisation."""
        ...

    def final_notes(self) -> list[str]:
        """Notes on the memory for the record; none before it was used."""
        ...


@runtime_checkable
class UsesDistances(Protocol):
    """A renderer whose silhouette loss can use observed distances; its `silhouette_loss` uses the mask alone."""

    def observed_loss(
        self, field: Field, rays: Rays, rendering: Rendering, observed: RayObservation
    ) -> Float[Tensor, ""]:
        """The loss of the renderer's paper between its rendering, and a mask with the observed distances."""
        ...


@runtime_checkable
class Blurred(Renderer, Protocol):
    """A renderer whose visibility gradient is spread over a length."""

    @property
    def blur(self) -> float:
        """The length, in scene units: over which an opacity falls, or of a band about the outline."""
        ...

    def with_blur(self, blur: float) -> "Blurred":
        """The same renderer with another length, at every iteration."""
        ...


def at_iteration(renderer: Renderer, iteration: int) -> Renderer:
    """The renderer with the settings of an iteration; the renderer itself, unless it is Scheduled."""
    return renderer.at_iteration(iteration) if isinstance(renderer, Scheduled) else renderer


def with_empty_memory(renderer: Renderer) -> Renderer:
    """The renderer for another optimisation; the renderer itself, unless it is Stateful."""
    return renderer.with_empty_memory() if isinstance(renderer, Stateful) else renderer


def final_notes(renderer: Renderer) -> list[str]:
    """Notes on the renderer's memory for the record of an optimisation; none unless it is Stateful."""
    return renderer.final_notes() if isinstance(renderer, Stateful) else []


def closest_values(
    field: Field, rays: Rays, rendering: Rendering, wanted: Bool[Tensor, "*rays"]
) -> Float[Tensor, "*rays"]:
    """`rendering.closest`, with its gradient on the `wanted` rays, by one field evaluation on each deferred one.

    These values are new samples of the ray; coarse to fine may have sampled `rendering.closest` on its coarse ray.
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
    """The rendering of rays of any leading shape, from tensors with one entry per flattened ray.

    A field value that is not finite becomes 0 as a residual, and `NON_FINITE_VALUE` as `closest`.

    Args:
        rays: all n rays.
        radius: of the sphere about the origin that contains the shape.
        distance, status, residual: as in Rendering.
        closest: the rays on which the field was evaluated, and its value of smallest magnitude on each. For the other
            rays, `closest` is their distance from the sphere (DIST, A.3).
    """
    queried, smallest = closest
    distance_to_sphere = distance_to_origin(rays.flat()) - radius
    smallest = smallest.nan_to_num(NON_FINITE_VALUE, NON_FINITE_VALUE, NON_FINITE_VALUE)
    shaped = distance.view(rays.shape)
    return Rendering(
        distance=shaped,
        status=status.view(rays.shape),
        points=rays.at(shaped),
        residual=residual.detach().nan_to_num(0.0, 0.0, 0.0).view(rays.shape),
        closest=distance_to_sphere.index_put((queried,), smallest).view(rays.shape),
    )
