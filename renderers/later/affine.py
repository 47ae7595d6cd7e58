"""Bounds that hold for a field's values at every point of segments: affine arithmetic through a ReLU network."""

from collections.abc import Callable
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from renderers.field import Field, Moved, Wrapper
from renderers.fields.mlp import BoundDecoder
from renderers.fields.networks.network import Adjusted

# Assumed rounding errors, in units of the precision: of each number of a layer in these bounds, which are computed in
# float64, and of the network's own values, in the precision of the points.
ROUNDING_FACTOR, EVALUATION_ROUNDING_FACTOR = 8.0, 64.0
SEGMENTS_PER_BATCH = 512  # keeps the activations in cache
EVALUATIONS_PER_BOUND = 3  # a bound multiplies by the weights three times

Layer = tuple[Tensor, Tensor]
# From the middles of segments and the vectors to their ends, both [n, 3], to bounds of the values there: low and high.
Bounds = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


def field_bounds(field: Field) -> Bounds | None:
    """The bounds of a field's values on segments, without a graph; None if it has none.

    A decoder has bounds, also within wrappers, which count each bound as `EVALUATIONS_PER_BOUND` field evaluations. Any
    other field may have a method `bounds`.
    """
    if isinstance(field, BoundDecoder):
        return partial(segment_bounds, field.hidden, field.last, field.skip)
    if not isinstance(field, Wrapper | Adjusted):
        return getattr(field, "bounds", None)
    if not isinstance(field, Moved | Adjusted) and not field.keeps_values:
        return None
    inner = field_bounds(field.inner)
    return None if inner is None else partial(_wrapped_bounds, field, inner)


def _wrapped_bounds(field: Wrapper | Adjusted, inner: Bounds, middle: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """The bounds of a field that has an inner field with bounds."""
    if isinstance(field, Adjusted):  # which is monotonic
        low, high = map(field.adjust, inner(middle, half))
        return torch.minimum(low, high), torch.maximum(low, high)
    if isinstance(field, Moved):
        scale, motion = (tensor.detach() for tensor in field.scale_and_motion)
        to_local = motion[:3, :3] / scale
        low, high = inner((middle - motion[:3, 3]) @ to_local, half @ to_local)
        return scale * low, scale * high
    field.count_work(EVALUATIONS_PER_BOUND * len(middle))
    return inner(middle, half)


@torch.no_grad()
def segment_bounds(
    hidden: tuple[Layer, ...], last: Layer, skip: int, middle: Float[Tensor, "n 3"], half: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Bounds of a network's values on the segments from `middle - half` to `middle + half`.

    Each activation is bounded by base + slope s + error e, for s and e between -1 and 1: a line along the segment and
    an error. Affine layers keep slopes exactly and add up errors. A ReLU whose input changes sign becomes the line
    between its two ends, lowered by half of its largest gap to the ReLU; the other half is an error. All is computed in
    float64: rounding grows with the weights of every layer, and in float32 it would hide a deep network's surface. The
    bounds become looser with depth and width.

    Source: Sharp and Jacobson 2022, "Spelunking the Deep" (arXiv 2202.02444), Sec. 3, with the slope along the segment
        kept and everything else merged into one error ("affine-fixed").

    Args:
        hidden, last: weights and biases.
        skip: index of the hidden layer that also takes the points; 0 for none.
    """
    dtype = middle.dtype
    layers = [(weight.double(), bias.double()) for weight, bias in (*hidden, last)]
    batches = zip(*(x.double().split(SEGMENTS_PER_BATCH) for x in (middle, half)), strict=True)
    low, high = map(torch.cat, zip(*(_bounds(layers, skip, *batch) for batch in batches), strict=True))
    rounding = EVALUATION_ROUNDING_FACTOR * torch.finfo(dtype).eps * (1 + torch.maximum(low.abs(), high.abs()))
    return (low - rounding).to(dtype), (high + rounding).to(dtype)


def _bounds(layers: list[Layer], skip: int, middle: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    base, slope, error = middle, half, torch.zeros_like(middle)
    for index, (weight, bias) in enumerate(layers[:-1]):
        if index == skip and index:
            base, slope = torch.cat([base, middle], -1), torch.cat([slope, half], -1)
            error = torch.cat([error, torch.zeros_like(middle)], -1)
        base, slope, error = _relu(*_affine(base, slope, error, weight, bias))
    base, slope, error = (tensor.squeeze(-1) for tensor in _affine(base, slope, error, *layers[-1]))
    radius = slope.abs() + error
    return base - radius, base + radius


def _affine(base: Tensor, slope: Tensor, error: Tensor, weight: Tensor, bias: Tensor) -> tuple[Tensor, ...]:
    linear, precision = torch.nn.functional.linear, ROUNDING_FACTOR * torch.finfo(base.dtype).eps
    error = error + precision * (base.abs() + slope.abs())
    return linear(base, weight, bias), linear(slope, weight), linear(error, weight.abs(), precision * bias.abs())


def _relu(base: Tensor, slope: Tensor, error: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    radius = slope.abs() + error
    low, high = base - radius, base + radius
    factor = (high / (high - low).clamp_min(torch.finfo(base.dtype).tiny)).clamp(0, 1)  # slope between the two ends
    factor = torch.where(low >= 0, 1.0, torch.where(high <= 0, 0.0, factor))
    half_gap = torch.where((low < 0) & (high > 0), -factor * low / 2, 0.0)
    return factor * base + half_gap, factor * slope, factor * error + half_gap
