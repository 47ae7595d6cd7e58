"""Distortions of a cube's distance field, such as by a network, quantisation or an error, and of trained networks.

A distortion takes the cube, a severity in the units of conf/stresses.yaml, and a random generator. It returns the
field, which still claims to be a distance, and the truth. The truth is the cube, or the moved surface, solved in
float64, so that a renderer is judged by the surface of its field. The distortion of a network takes the network, whose
weights it changes, and a latent code. It returns the code. `CHANGES_OF_VALUES` change the values of a network instead.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from bench.tasks.stability.solids import ReferenceTruth, Solid, Truth, box
from renderers.field import Field
from renderers.fields.analytic import Shape
from renderers.fields.mlp import Decoder
from renderers.fields.networks.network import Published

CUBE_HALF_SIDE = 0.5
RIPPLE_FREQUENCY = 15.0  # radians per scene unit
WAVE_COUNT = 32  # random cosines of a perturbation
MIN_RESOLVED_THICKNESS = 5e-4  # scene units along a ray; the truth may miss thinner parts of a perturbed cube

Distortion = Callable[[Solid, float, np.random.Generator], tuple[Field, Truth]]


def _change_values(change: Callable[[Tensor, Tensor, float], Tensor]) -> Distortion:
    """A cube with other field values and the same surface; `change` takes distances, points and the severity."""

    def distortion(cube: Solid, severity: float, draw: np.random.Generator) -> tuple[Field, Truth]:
        return Shape(lambda points: change(cube.field(points), points, severity)), cube

    return distortion


def perturbed(cube: Solid, severity: float, draw: np.random.Generator) -> tuple[Field, Truth]:
    """A cube plus a smooth random field, like a network's error; the severity is its standard deviation, scene units.

    The frequencies and phases are float32 numbers, so that the field is the same function in float64. A ray can cross
    the moved surface often. The truth is the first crossing, except of parts thinner than `MIN_RESOLVED_THICKNESS`.
    """
    frequencies = torch.from_numpy(10 * draw.normal(size=(3, WAVE_COUNT))).float()
    phases = torch.from_numpy(draw.uniform(0, 6.28, WAVE_COUNT)).float()
    amplitude = severity * (2 / WAVE_COUNT) ** 0.5

    def value(points: Tensor) -> Tensor:
        waves = torch.cos(points @ frequencies.to(points) + phases.to(points))
        return cube.field(points) + amplitude * waves.sum(-1)

    lipschitz = 1 + amplitude * float(frequencies.norm(dim=0).sum())
    return Shape(value), ReferenceTruth(Shape(value), lipschitz, MIN_RESOLVED_THICKNESS)


def coarse_floats(cube: Solid, severity: float, draw: np.random.Generator) -> tuple[Field, Truth]:
    """A cube with points and values rounded to `severity` bits of mantissa: float32 has 24, bfloat16 has 8.

    A point is inside if its rounded coordinates are at most `CUBE_HALF_SIDE`, a power of two. Such a coordinate exceeds
    `CUBE_HALF_SIDE` by at most half the spacing of rounded numbers, so the surface is the one of a larger cube.
    """
    bits = round(severity)
    rounded_cube = box((CUBE_HALF_SIDE + 0.5 * 2.0**-bits,) * 3)
    return Shape(lambda points: _round_mantissa(cube.field(_round_mantissa(points, bits)), bits)), rounded_cube


def _round_mantissa(numbers: Tensor, bits: int) -> Tensor:
    """Rounds numbers to `bits` bits of mantissa; the gradient ignores the rounding."""
    mantissa, exponent = torch.frexp(numbers.detach())
    return numbers + (torch.ldexp(torch.round(mantissa * 2.0**bits) / 2.0**bits, exponent) - numbers).detach()


def quantised(cube: Solid, severity: float, draw: np.random.Generator) -> tuple[Field, Truth]:
    """A cube whose distance is rounded to multiples of a step, in scene units: 0.0078 for 8 bits over -1 to 1.

    The distance is 0 in a layer about the cube's surface. The truth is the entry into this layer, half a step outside.
    """

    def value(points: Tensor) -> Tensor:
        exact = cube.field(points)
        return exact + (severity * torch.round(exact / severity) - exact).detach()

    layer = Shape(lambda points: cube.field(points) - severity / 2)
    return Shape(value), ReferenceTruth(layer, lipschitz=1.0, thinnest=MIN_RESOLVED_THICKNESS)


DISTORTIONS: dict[str, Distortion] = {
    "scaled": _change_values(lambda distance, points, factor: factor * distance),
    "ripples": _change_values(lambda d, points, a: d * (1 + a * torch.sin(RIPPLE_FREQUENCY * points).prod(dim=-1))),
    "truncated": _change_values(lambda distance, points, limit: distance.clamp(-limit, limit)),  # DeepSDF: at 0.1
    "saturated": _change_values(lambda distance, points, width: torch.tanh(distance / width)),
    "perturbed": perturbed,
    "coarse_floats": coarse_floats,
    "quantised": quantised,
}


def noisy_weights(network: Decoder | Published, code: Tensor, severity: float, draw: np.random.Generator) -> Tensor:
    """Adds Gaussian noise to each matrix and bias; the severity is relative to the root mean square."""
    for weight in network.parameters():
        weight += severity * weight.square().mean().sqrt() * torch.from_numpy(draw.normal(size=weight.shape)).to(weight)
    return code


def coarse_weights(network: Decoder | Published, code: Tensor, severity: float, draw: np.random.Generator) -> Tensor:
    """Rounds all weights to `severity` bits of mantissa; the field is evaluated in float32."""
    for weight in network.parameters():
        weight.copy_(_round_mantissa(weight, round(severity)))
    return code


def far_code(network: Decoder | Published, code: Tensor, severity: float, draw: np.random.Generator) -> Tensor:
    """Multiplies a code of the training shapes."""
    return severity * code


def truncated_network(network: Decoder | Published, code: Tensor, severity: float, draw: np.random.Generator) -> Tensor:
    """Truncates the values of a network, as in DeepSDF's training (Eq. 4: at 0.1); see `CHANGES_OF_VALUES`."""
    return code


NETWORK_DISTORTIONS = {
    change.__name__: change for change in (noisy_weights, coarse_weights, far_code, truncated_network)
}
CHANGES_OF_VALUES: dict[str, Callable[[Tensor, float], Tensor]] = {
    truncated_network.__name__: lambda values, limit: values.clamp(-limit, limit)
}
