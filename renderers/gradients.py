"""The gradient rules. A rule attaches a gradient to distances that were found without a graph."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from renderers.camera import Rays
from renderers.field import Field, carries_gradient
from renderers.march import Front
from renderers.rendering import Rendering, Status, assemble


def approximate(
    field: Field,
    rays: Rays,
    distance: Float[Tensor, " n"],
    *,
    alpha: float,
    sample_distance: Float[Tensor, "n samples"],
    sample_value: Float[Tensor, "n samples"],
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """DIST's approximate gradient: the field at the K samples of least magnitude, evaluated again with a graph.

    Source: DIST, Eq. 4 (first term only) and B.2. The derivative of the distance is alpha times the sum of the
    field's derivatives at these fixed samples, so memory does not grow with the number of steps.

    Bias: by implicit differentiation the truth is -(d field)/(grad field . direction). On a true distance, at angle
    theta between the ray and the inward normal, this rule gives alpha * K * cos(theta) times the truth: the direction
    is right for each pixel, the scale is not. Rays that met fewer than K samples count those that they have.

    Args:
        rays: n rays whose distance is to get a gradient.
        distance: where they ended.
        alpha: the factor of the marching step.
        sample_distance, sample_value: the samples of least magnitude, in rising order; value infinite where missing.

    Returns:
        the distances with their gradient, and the field's value at each ray's first sample; without a graph that is
        the value of the march, which coarse to fine may have evaluated on a neighbour's ray.
    """
    if not torch.is_grad_enabled():
        return distance, sample_value[:, 0]
    exists = sample_value.isfinite()
    ray, _ = exists.nonzero(as_tuple=True)
    values = field(rays.origins[ray] + sample_distance[exists][:, None] * rays.directions[ray])
    table = torch.zeros_like(sample_value).masked_scatter(exists, values)
    total = table.sum(dim=1)
    return distance + alpha * (total - total.detach()), table[:, 0]


def approximate_front(field: Field, rays: Rays, front: Front, *, alpha: float, radius: float) -> Rendering:
    """The rendering of a front with the approximate gradient, which its samples carry, where a ray has hit.

    Args:
        rays: of any leading shape; the front has them in one row.
        front: after the march.
        alpha: the factor of the marching step.
        radius: of the sphere about the origin that holds the shape.
    """
    flat = rays.flat()
    hit = front.status == Status.HIT
    queried = front.sample_value[:, 0].isfinite().nonzero().squeeze(-1)
    wanted = front.sample_value[queried].clone()
    wanted[~hit[queried], 1:] = torch.inf  # a ray without a hit needs only its closest sample
    carried, least = approximate(
        field,
        flat[queried],
        front.distance[queried],
        alpha=alpha,
        sample_distance=front.sample_distance[queried],
        sample_value=wanted,
    )
    return assemble(
        rays,
        radius,
        distance=torch.where(hit, front.distance.index_put((queried,), carried), front.distance),
        status=front.status,
        residual=front.value,
        closest=(queried, least),
    )


def fixed_samples(
    field: Field, rays: Rays, distance: Float[Tensor, " n"], value: Float[Tensor, " n"]
) -> Float[Tensor, " n"]:
    """The field's values at fixed distances along rays, `value`, evaluated again where a gradient is wanted."""
    return field(rays.at(distance.detach())) if torch.is_grad_enabled() else value


@dataclass(frozen=True)
class Crossing:
    """The field where n rays may cross its surface.

    Args:
        value: of the field there; without a graph.
        slope: of the field along the ray, in field units per scene unit; negative where the ray enters, 0 where the
            field has no finite gradient.
        change: zero, with the derivative of `value` towards the field's parameters and the rays, where that is wanted.
    """

    value: Float[Tensor, " n"]
    slope: Float[Tensor, " n"]
    change: Float[Tensor, " n"]


def crossing(field: Field, rays: Rays, distance: Float[Tensor, " n"], *, towards_field: bool) -> Crossing:
    """The value and the slope of the field at `distance` along n rays, for one evaluation and one gradient each.

    Args:
        towards_field: whether the field's parameters are to get a gradient; see `field.carries_gradient`.
    """
    reached = rays.at(distance.detach())
    with torch.enable_grad():
        leaf = reached.detach().requires_grad_(True)
        value = field(leaf)
        (gradient,) = torch.autograd.grad(value.sum(), leaf, retain_graph=towards_field)
    gradient = gradient.nan_to_num(0.0, 0.0, 0.0)  # one point without a gradient must not spoil that of all others
    slope = (gradient * rays.directions.detach()).sum(-1)
    change = torch.zeros_like(slope)
    if reached.requires_grad:
        change = (gradient * (reached - reached.detach())).sum(-1)
    if towards_field:
        change = change + change_of(value)
    return Crossing(value.detach(), slope, change)


def change_of(value: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Zero, with the derivative of a value; without one where the value is not finite."""
    return (value - value.detach()).nan_to_num(0.0)


def implicit(field: Field, rays: Rays, distance: Float[Tensor, " n"], *, least_slope: float) -> Float[Tensor, " n"]:
    """The gradient of the distance to a level set, by implicit differentiation.

    Source: DVR, Eqs. 8 and 11. On the ray o + d w, the level set stays under the ray's end if
    d distance = -(d field + grad field . d(o + d w)) / (grad field . w): towards the field's parameters by its first
    term, towards the ray by its second one. Exact at a root; where the distance is off, it is the gradient of a
    neighbouring level set. The surface must be crossed: what comes into view or leaves it has no part in this gradient.

    Args:
        rays: n rays whose distance is to get a gradient.
        distance: where they cross the surface.
        least_slope: least magnitude of the field's slope along the ray, grad field . w, in field units per scene unit.
            A flatter crossing is divided by this, with the slope's own sign; rays enter, so zero counts as negative.
    """
    if not torch.is_grad_enabled():
        return distance
    towards_field = carries_gradient(field, rays.origins)
    if not (towards_field or rays.origins.requires_grad or rays.directions.requires_grad):
        return distance
    at = crossing(field, rays, distance, towards_field=towards_field)
    slope = at.slope
    slope = torch.where(slope > 0, slope.clamp_min(least_slope), slope.clamp_max(-least_slope))
    return distance.detach() - at.change / slope


def implicit_front(field: Field, rays: Rays, front: Front, *, least_slope: float, radius: float) -> Rendering:
    """The rendering of a front with one sample a ray, whose hits have the implicit gradient; see `approximate_front`.

    Args:
        least_slope: see `implicit`.
    """
    flat = rays.flat()
    hit = (front.status == Status.HIT).nonzero().squeeze(-1)
    queried = front.sample_value[:, 0].isfinite().nonzero().squeeze(-1)
    found = implicit(field, flat[hit], front.distance[hit], least_slope=least_slope)
    least = fixed_samples(field, flat[queried], front.sample_distance[queried, 0], front.sample_value[queried, 0])
    return assemble(
        rays,
        radius,
        distance=front.distance.index_put((hit,), found),
        status=front.status,
        residual=front.value,
        closest=(queried, least),
    )
