"""The silhouette loss of methods whose soft silhouette is the least field value on a ray (DIST, Eq. 11)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def hinge_silhouette_loss(
    closest: Float[Tensor, "*rays"],
    mask: Bool[Tensor, "*rays"],
    *,
    epsilon: float,
    signed: bool,
    average: str,
) -> Float[Tensor, ""]:
    """DIST, Eq. 11: the soft silhouette should be at most 0 on the foreground and at least 0 on the background.

    Args:
        closest: the field's value of least magnitude on each ray, with its sign.
        mask: true on the foreground.
        epsilon: the threshold between them, in scene units.
        signed: False takes the magnitude of `closest`, as the paper does. A background ray that stops just inside the
            shape is then pushed deeper. True keeps the sign, which avoids that.
        average: over "all" rays, or over those that are "violating". With all, a missed pixel weighs next to nothing,
            and an optimiser can lower the depth loss by losing hits.
    """
    soft = (closest if signed else closest.abs()) - epsilon
    violation = torch.where(mask, soft, -soft).clamp_min(0)
    count = torch.full_like(mask, True) if average == "all" else violation > 0
    return violation.sum() / count.sum().clamp_min(1)
