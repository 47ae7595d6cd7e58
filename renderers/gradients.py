"""The gradient rules. A rule attaches a gradient to distances that were found without a graph."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from renderers.camera import Rays
from renderers.field import Field, carries_gradient
from renderers.rendering import Rendering, Status, assemble
from renderers.tracing.march import RayFront


def attach_approximate_gradient(
    field: Field,
    rays: Rays,
    distance: Float[Tensor, " n"],
    *,
    alpha: float,
    sample_distance: Float[Tensor, "n samples"],
    sample_value: Float[Tensor, "n samples"],
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Attaches DIST's approximate gradient: evaluates the K samples of smallest magnitude again, with a graph.

    Source: DIST, Eq. 4 (first term only) and B.2. The derivative of the distance is alpha times the sum of the
    field's derivatives at these fixed samples, so memory does not grow with the number of steps.

    Bias: by implicit differentiation the truth is -(d field)/(grad field . direction). On a true distance, at angle
    theta between the ray and the inward normal, this rule gives alpha * K * cos(theta) times the truth: the direction
    is right for each pixel, the scale is not. For rays with fewer than K samples, K is the number of their samples.

    Args:
        rays: n rays whose distance gets a gradient.
        distance: to where they ended.
        alpha: the factor of the marching step.
        sample_distance, sample_value: the samples of smallest magnitude, in rising order; value infinite if missing.

    Returns:
        the distances with their gradient, and the field's value at each ray's first sample. Without a graph, the latter
        is the value of the march, which coarse to fine may have evaluated on a neighbour's ray.
    """
    if not torch.is_grad_enabled():
        return distance, sample_value[:, 0]
    has_sample = sample_value.isfinite()
    ray, _ = has_sample.nonzero(as_tuple=True)
    values = field(rays.origins[ray] + sample_distance[has_sample][:, None] * rays.directions[ray])
    table = torch.zeros_like(sample_value).masked_scatter(has_sample, values)
    total = table.sum(dim=1)
    return distance + alpha * (total - total.detach()), table[:, 0]


def approximate_rendering(field: Field, rays: Rays, front: RayFront, *, alpha: float, radius: float) -> Rendering:
    """The rendering of a marched front, whose hits have the approximate gradient.

    Args:
        rays: of any leading shape; the front has them flattened.
        front: after the march.
        alpha: the factor of the marching step.
        radius: of the sphere about the origin that contains the shape.
    """
    flat = rays.flat()
    hit = front.status == Status.HIT
    queried = front.sample_value[:, 0].isfinite().nonzero().squeeze(-1)
    sample_value = front.sample_value[queried].clone()
    sample_value[~hit[queried], 1:] = torch.inf  # a ray without a hit needs only its closest sample
    distance, smallest = attach_approximate_gradient(
        field,
        flat[queried],
        front.distance[queried],
        alpha=alpha,
        sample_distance=front.sample_distance[queried],
        sample_value=sample_value,
    )
    return assemble(
        rays,
        radius,
        distance=torch.where(hit, front.distance.index_put((queried,), distance), front.distance),
        status=front.status,
        residual=front.value,
        closest=(queried, smallest),
    )


def reevaluate_with_graph(
    field: Field, rays: Rays, distance: Float[Tensor, " n"], value: Float[Tensor, " n"]
) -> Float[Tensor, " n"]:
    """The field's values at fixed distances along rays: `value`, evaluated again with a graph if gradients are on."""
    return field(rays.at(distance.detach())) if torch.is_grad_enabled() else value


@dataclass(frozen=True)
class Crossing:
    """The field where n rays may cross its surface.

    Args:
        value: of the field; without a graph.
        slope: of the field along the ray, in field units per scene unit; negative if the ray enters, 0 if the field has
            no finite gradient.
        change: zero, with the derivative of `value` towards the field's parameters and the rays, if requested.
    """

    value: Float[Tensor, " n"]
    slope: Float[Tensor, " n"]
    change: Float[Tensor, " n"]


def evaluate_crossing(field: Field, rays: Rays, distance: Float[Tensor, " n"], *, towards_field: bool) -> Crossing:
    """The value and the slope of the field at `distance` along n rays, by one evaluation and one gradient per ray.

    Args:
        towards_field: whether the field's parameters get a gradient; see `field.carries_gradient`.
    """
    points = rays.at(distance.detach())
    with torch.enable_grad():
        leaf = points.detach().requires_grad_(True)
        value = field(leaf)
        (gradient,) = torch.autograd.grad(value.sum(), leaf, retain_graph=towards_field)
    gradient = gradient.nan_to_num(0.0, 0.0, 0.0)  # one point without a gradient must not spoil all others
    slope = (gradient * rays.directions.detach()).sum(-1)
    change = torch.zeros_like(slope)
    if points.requires_grad:
        change = (gradient * (points - points.detach())).sum(-1)
    if towards_field:
        change = change + zero_with_gradient(value)
    return Crossing(value.detach(), slope, change)


def zero_with_gradient(value: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Zero, with the derivative of a value; without a derivative if the value is not finite."""
    return (value - value.detach()).nan_to_num(0.0)


def attach_implicit_gradient(
    field: Field, rays: Rays, distance: Float[Tensor, " n"], *, least_slope: float
) -> Float[Tensor, " n"]:
    """Attaches the gradient of the distance to a level set, by implicit differentiation.

    Source: DVR, Eqs. 8 and 11. On the ray o + d w, the end of the ray stays on the level set if
    d distance = -(d field + grad field . d(o + d w)) / (grad field . w): towards the field's parameters by its first
    term, towards the ray by its second one. Exact at a root; otherwise it is the gradient of a neighbouring level set.
    The ray must cross the surface: this gradient lacks the visibility gradient.

    Args:
        rays: n rays whose distance gets a gradient.
        distance: to where they cross the surface.
        least_slope: minimum magnitude of the field's slope along the ray, grad field . w, in field units per scene
            unit. A flatter crossing is divided by this, with the slope's sign; rays enter, so 0 counts as negative.
    """
    if not torch.is_grad_enabled():
        return distance
    towards_field = carries_gradient(field, rays.origins)
    if not (towards_field or rays.origins.requires_grad or rays.directions.requires_grad):
        return distance
    crossing = evaluate_crossing(field, rays, distance, towards_field=towards_field)
    slope = crossing.slope
    slope = torch.where(slope > 0, slope.clamp_min(least_slope), slope.clamp_max(-least_slope))
    return distance.detach() - crossing.change / slope


def implicit_rendering(field: Field, rays: Rays, front: RayFront, *, least_slope: float, radius: float) -> Rendering:
    """The rendering of a front with one sample per ray and the implicit gradient; see `approximate_rendering`.

    Args:
        least_slope: see `attach_implicit_gradient`.
    """
    flat = rays.flat()
    hit = (front.status == Status.HIT).nonzero().squeeze(-1)
    queried = front.sample_value[:, 0].isfinite().nonzero().squeeze(-1)
    distance = attach_implicit_gradient(field, flat[hit], front.distance[hit], least_slope=least_slope)
    samples = front.sample_distance[queried, 0], front.sample_value[queried, 0]
    return assemble(
        rays,
        radius,
        distance=front.distance.index_put((hit,), distance),
        status=front.status,
        residual=front.value,
        closest=(queried, reevaluate_with_graph(field, flat[queried], *samples)),
    )
