"""The gradient rules, each once. A rule attaches a gradient to distances that were found without a graph."""

import torch
from jaxtyping import Float
from torch import Tensor

from renderers.camera import Rays
from renderers.field import Field


def approximate(
    field: Field,
    rays: Rays,
    distance: Float[Tensor, "n"],
    *,
    alpha: float,
    sample_distance: Float[Tensor, "n samples"],
    sample_value: Float[Tensor, "n samples"],
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """DIST's approximate gradient: the field at the K samples of least magnitude, asked again with a graph.

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
        the distances with their gradient, and the field's value at each ray's first sample.
    """
    exists = sample_value.isfinite()
    ray, _ = exists.nonzero(as_tuple=True)
    values = field(rays.origins[ray] + sample_distance[exists][:, None] * rays.directions[ray])
    table = torch.zeros_like(sample_value).masked_scatter(exists, values)
    total = table.sum(dim=1)
    return distance + alpha * (total - total.detach()), table[:, 0]
