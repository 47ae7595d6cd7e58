"""Distortions of a cube's distance, as by a network, quantisation or an error, and of trained networks.

A distortion takes the cube, a severity in the units of conf/stresses.yaml, and a random generator. It gives the field,
which still claims to be a distance, and the truth: the cube, or where the surface is moved, the moved one, solved in
float64, so that a renderer is judged by the surface of the field that it was given. That of a network takes the
network, whose weights it changes, and a code; it gives the code.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from datasets.stress.solids import ReferenceTruth, Solid, Truth, box
from renderers.field import Field
from renderers.fields.analytic import Shape
from renderers.fields.mlp import Decoder
from renderers.fields.network import Published

CUBE = 0.5  # half the side length of the cube
RIPPLES = 15.0  # radians per scene unit
WAVES = 32  # random cosines that make a perturbation
THINNEST = 5e-4  # scene units: parts of a perturbed cube that are thinner along a ray may be missed by the truth

Distortion = Callable[[Solid, float, np.random.Generator], tuple[Field, Truth]]


def _revalued(change: Callable[[Tensor, Tensor, float], Tensor]) -> Distortion:
    """A cube with other values and the same surface; `change` takes its distances, the points and the severity."""

    def distortion(cube: Solid, severity: float, draw: np.random.Generator) -> tuple[Field, Truth]:
        return Shape(lambda points: change(cube.field(points), points, severity)), cube

    return distortion


def perturbed(cube: Solid, severity: float, draw: np.random.Generator) -> tuple[Field, Truth]:
    """A cube with a smooth random field of a standard deviation, in scene units, added: a network's error.

    The frequencies and phases are numbers of float32, so that the field is the same function in float64. A ray can
    cross the moved surface often: the truth is the first crossing, but for parts thinner than `THINNEST`.
    """
    frequencies = torch.from_numpy(10 * draw.normal(size=(3, WAVES))).float()
    phases = torch.from_numpy(draw.uniform(0, 6.28, WAVES)).float()
    height = severity * (2 / WAVES) ** 0.5

    def value(points: Tensor) -> Tensor:
        waves = torch.cos(points @ frequencies.to(points) + phases.to(points))
        return cube.field(points) + height * waves.sum(-1)

    steepest = 1 + height * float(frequencies.norm(dim=0).sum())
    return Shape(value), ReferenceTruth(Shape(value), steepest, THINNEST)


def coarse_floats(cube: Solid, severity: float, draw: np.random.Generator) -> tuple[Field, Truth]:
    """A cube with points and values rounded to `severity` bits of mantissa: float32 has 24, bfloat16 has 8.

    A point belongs to it where its coordinates, rounded, are at most `CUBE`, a power of two. Such a coordinate is above
    `CUBE` by at most half the spacing of the numbers there, so that its surface is that of a larger cube.
    """
    bits = round(severity)
    larger = box((CUBE + 0.5 * 2.0**-bits,) * 3)
    return Shape(lambda points: _rounded(cube.field(_rounded(points, bits)), bits)), larger


def _rounded(numbers: Tensor, bits: int) -> Tensor:
    """Numbers with so many bits of mantissa; their gradient is as if they were not rounded."""
    mantissa, exponent = torch.frexp(numbers.detach())
    return numbers + (torch.ldexp(torch.round(mantissa * 2.0**bits) / 2.0**bits, exponent) - numbers).detach()


def quantised(cube: Solid, severity: float, draw: np.random.Generator) -> tuple[Field, Truth]:
    """A cube whose distance is a multiple of a step, in scene units: 8 bits over -1 to 1 have a step of 0.0078.

    It is 0 in a layer about the cube's surface. The truth is where a ray enters this layer, half a step outside.
    """

    def value(points: Tensor) -> Tensor:
        exact = cube.field(points)
        return exact + (severity * torch.round(exact / severity) - exact).detach()

    layer = Shape(lambda points: cube.field(points) - severity / 2)
    return Shape(value), ReferenceTruth(layer, lipschitz=1.0, thinnest=THINNEST)


DISTORTIONS: dict[str, Distortion] = {
    "scaled": _revalued(lambda distance, points, factor: factor * distance),
    "ripples": _revalued(lambda distance, points, a: distance * (1 + a * torch.sin(RIPPLES * points).prod(dim=-1))),
    "truncated": _revalued(lambda distance, points, most: distance.clamp(-most, most)),  # as DeepSDF's is at 0.1
    "saturated": _revalued(lambda distance, points, width: torch.tanh(distance / width)),
    "perturbed": perturbed,
    "coarse_floats": coarse_floats,
    "quantised": quantised,
}


def noisy_weights(network: Decoder | Published, code: Tensor, severity: float, draw: np.random.Generator) -> Tensor:
    """Adds Gaussian noise to each matrix and bias, of a standard deviation in shares of its root mean square."""
    for weight in network.parameters():
        weight += severity * weight.square().mean().sqrt() * torch.from_numpy(draw.normal(size=weight.shape)).to(weight)
    return code


def coarse_weights(network: Decoder | Published, code: Tensor, severity: float, draw: np.random.Generator) -> Tensor:
    """Rounds all weights to `severity` bits of mantissa; values are computed in float32."""
    for weight in network.parameters():
        weight.copy_(_rounded(weight, round(severity)))
    return code


def far_code(network: Decoder | Published, code: Tensor, severity: float, draw: np.random.Generator) -> Tensor:
    """Multiplies a code of the training."""
    return severity * code


OF_NETWORKS = {change.__name__: change for change in (noisy_weights, coarse_weights, far_code)}
