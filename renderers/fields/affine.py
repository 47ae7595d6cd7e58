"""Affine arithmetic through a ReLU network: bounds of its values on straight segments, for every point of them."""

import torch
from jaxtyping import Float
from torch import Tensor

SLACK = 8.0  # times the precision of float64, by which each number of a layer may be off through rounding
EVALUATED = 64.0  # times that of the values themselves, by which a network's evaluation may be off
SEGMENTS = 512  # at a time: keeps the activations in cache

Layer = tuple[Tensor, Tensor]


@torch.no_grad()
def segment_bounds(
    hidden: tuple[Layer, ...], last: Layer, skip: int, middle: Float[Tensor, "n 3"], half: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Bounds of a network's values on the segments from `middle - half` to `middle + half`.

    A number is a line along the segment and an error: base + slope s + error e, for s and e between -1 and 1. Affine
    layers keep slopes exactly and add errors up; a ReLU that changes along the segment becomes the line between its
    ends, moved by half of its distance from them. All in float64: rounding grows with the weights of every layer, and
    in float32 it would hide a deep network's surface. The deeper and wider a network, the looser its bounds.

    Source: Sharp and Jacobson 2022, "Spelunking the Deep" (arXiv 2202.02444), Sec. 3, with the slope along the segment
        kept and all else as one error ("affine-fixed").

    Args:
        hidden, last: weights and biases.
        skip: index of the hidden layer that takes the points again; 0 for none.
    """
    given = middle.dtype
    layers = [(weight.double(), bias.double()) for weight, bias in (*hidden, last)]
    parts = [
        _bounds(layers, skip, *some) for some in zip(*(x.double().split(SEGMENTS) for x in (middle, half)), strict=True)
    ]
    low, high = (torch.cat(part) for part in zip(*parts, strict=True))
    off = EVALUATED * torch.finfo(given).eps * (1 + torch.maximum(low.abs(), high.abs()))
    return (low - off).to(given), (high + off).to(given)


def _bounds(layers: list[Layer], skip: int, middle: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    base, slope, error = middle, half, torch.zeros_like(middle)
    for index, (weight, bias) in enumerate(layers[:-1]):
        if index == skip and index:
            base, slope = torch.cat([base, middle], -1), torch.cat([slope, half], -1)
            error = torch.cat([error, torch.zeros_like(middle)], -1)
        base, slope, error = _rectified(*_affine(base, slope, error, weight, bias))
    base, slope, error = (part.squeeze(-1) for part in _affine(base, slope, error, *layers[-1]))
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
