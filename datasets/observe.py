"""Chooses the pixels of a view whose depth is given."""

import torch
from jaxtyping import Bool
from torch import Tensor

from renderers.checks import BadInput


def observed_pixels(mask: Bool[Tensor, "height width"], points: str | int, seed: int) -> Bool[Tensor, "height width"]:
    """True on the foreground pixels whose depth is given.

    Args:
        mask: true on the foreground.
        points: "dense" for all, "10%" for a share, 100 for a number.
        seed: of the draw, without replacement.

    Raises:
        ValueError: for anything else, or for more points than the foreground has.
    """
    foreground = mask.flatten().nonzero().squeeze(-1)
    available = foreground.numel()
    amount, is_share = parse_amount(points)
    count = max(1, round(available * amount)) if is_share else round(amount)
    if count > available:
        most = f"points must be at most the {available} pixels of the shape, not {points}"
        raise BadInput(f"{most}: give fewer, or raise view.resolution")
    order = torch.randperm(available, generator=torch.Generator().manual_seed(seed))
    observed = torch.zeros(mask.numel(), dtype=torch.bool)
    observed[foreground[order[:count]]] = True
    return observed.view(mask.shape)


def parse_amount(points: str | int) -> tuple[float, bool]:
    """An amount such as "dense", "10%" or 100, and whether it is a share of what there is.

    Raises:
        ValueError: for anything else.
    """
    text, remedy = str(points).strip(), 'write "dense", a share such as "10%", or a number such as 100'
    if text == "dense":
        return 1.0, True
    is_share = text.endswith("%")
    try:
        value = float(text.removesuffix("%")) / 100 if is_share else float(int(text))
    except ValueError:
        raise ValueError(f"points must be an amount, not {text!r}: {remedy}") from None
    if not value > 0:
        raise ValueError(f"points must be positive, not {text!r}: {remedy}")
    if is_share and value > 1:
        raise ValueError(f"points must be at most 100%, not {text!r}: {remedy}")
    return value, is_share
