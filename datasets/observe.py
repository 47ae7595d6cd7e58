"""What is given of a view: how much of its depth."""

import torch
from jaxtyping import Bool
from torch import Tensor

from datasets.scene import View


def observed_pixels(view: View, points: str | int, seed: int) -> Bool[Tensor, "height width"]:
    """True on the foreground pixels whose depth is given.

    Args:
        view: its mask says what the foreground is.
        points: "dense" for all, "10%" for a share, 100 for a number.
        seed: of the draw, without replacement.

    Raises:
        ValueError: for anything else, or for more points than the foreground has.
    """
    foreground = view.mask.flatten().nonzero().squeeze(-1)
    count = _count(str(points).strip(), foreground.numel())
    order = torch.randperm(foreground.numel(), generator=torch.Generator().manual_seed(seed))
    observed = torch.zeros(view.mask.numel(), dtype=torch.bool)
    observed[foreground[order[:count]].to("cpu")] = True
    return observed.view(view.mask.shape)


def _count(points: str, available: int) -> int:
    remedy = 'write "dense", a share such as "10%", or a number such as 100'
    if points == "dense":
        return available
    number = points.removesuffix("%")
    try:
        value = float(number) if points.endswith("%") else int(number)
    except ValueError:
        raise ValueError(f"points must be an amount, not {points!r}: {remedy}") from None
    if value <= 0:
        raise ValueError(f"points must be positive, not {points!r}: {remedy}")
    if points.endswith("%"):
        if value > 100:
            raise ValueError(f"points must be at most 100%, not {points!r}: {remedy}")
        return max(1, round(available * value / 100))
    if value > available:
        raise ValueError(f"points must be at most the {available} pixels of the shape, not {points}: raise resolution")
    return int(value)
