"""Affine arithmetic through a ReLU network: bounds of its values on straight segments that hold for every point."""

import torch
from jaxtyping import Float
from torch import Tensor

SLACK = 8.0  # times the machine precision, by which each number of a layer may be off through rounding

Layer = tuple[Tensor, Tensor]


def segment_bounds(
    hidden: tuple[Layer, ...], last: Layer, skip: int, middle: Float[Tensor, "n 3"], half: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Bounds of a network's values on the segments from `middle - half` to `middle + half`.

    A number is a line along the segment and an error: base + slope s + error e, for s and e between -1 and 1. Affine
    layers keep slopes exactly and add errors up; a ReLU that changes along the segment becomes the line between its
    ends, moved by half of its distance from them.

    Source: Sharp and Jacobson 2022, "Spelunking the Deep" (arXiv 2202.02444), Sec. 3, with the slope along the segment
        kept and all else as one error ("affine-fixed").

    Args:
        hidden, last: weights and biases.
        skip: index of the hidden layer that takes the points again; 0 for none.
    """
    base, slope, error = middle, half, torch.zeros_like(middle)
    for index, (weight, bias) in enumerate(hidden):
        if index == skip and index:
            base, slope = torch.cat([base, middle], -1), torch.cat([slope, half], -1)
            error = torch.cat([error, torch.zeros_like(middle)], -1)
        base, slope, error = _rectified(*_affine(base, slope, error, weight, bias))
    base, slope, error = (part.squeeze(-1) for part in _affine(base, slope, error, *last))
    reach = slope.abs() + error
    return base - reach, base + reach


def _affine(base: Tensor, slope: Tensor, error: Tensor, weight: Tensor, bias: Tensor) -> tuple[Tensor, ...]:
    linear, precision = torch.nn.functional.linear, SLACK * torch.finfo(base.dtype).eps
    off = error + precision * (base.abs() + slope.abs())
    return linear(base, weight, bias), linear(slope, weight), linear(off, weight.abs(), precision * bias.abs())


def _rectified(base: Tensor, slope: Tensor, error: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    reach = slope.abs() + error
    low, high = base - reach, base + reach
    share = (high / (high - low).clamp_min(torch.finfo(base.dtype).tiny)).clamp(0, 1)  # of the line between the ends
    share = torch.where(low >= 0, 1.0, torch.where(high <= 0, 0.0, share))
    above = torch.where((low < 0) & (high > 0), -share * low / 2, 0.0)
    return share * base + above, share * slope, share * error + above
