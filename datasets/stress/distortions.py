"""Distortions of a distance field, as by a network, quantisation or an error. All still claim to be distances.

A distortion takes a field, a severity in the units of conf/stress, and a random generator.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from renderers.field import Field
from renderers.fields.analytic import Shape

Distortion = Callable[[Field, float, np.random.Generator], Field]
RIPPLES = 15.0  # radians per scene unit
WAVES = 32  # random cosines that make a perturbation


def scaled(field: Field, severity: float, draw: np.random.Generator) -> Field:
    """A cube whose distance is multiplied by a factor."""
    return Shape(lambda points: severity * field(points))


def ripples(field: Field, severity: float, draw: np.random.Generator) -> Field:
    """A cube whose distance is multiplied by 1 + a sin(15 x) sin(15 y) sin(15 z): same surface, wrong steps."""
    return Shape(lambda points: field(points) * (1 + severity * torch.sin(RIPPLES * points).prod(dim=-1)))


def perturbed(field: Field, severity: float, draw: np.random.Generator) -> Field:
    """A cube with a smooth random field of a standard deviation, in scene units, added: a network's error."""
    frequencies, phases = (
        torch.from_numpy(10 * draw.normal(size=(3, WAVES))),
        torch.from_numpy(draw.uniform(0, 6.28, WAVES)),
    )

    def value(points: Tensor) -> Tensor:
        waves = torch.cos(points @ frequencies.to(points) + phases.to(points))
        return field(points) + severity * (2 / WAVES) ** 0.5 * waves.sum(-1)

    return Shape(value)


def coarse_floats(field: Field, severity: float, draw: np.random.Generator) -> Field:
    """A cube with points and values rounded to `severity` bits of mantissa: float32 has 24, bfloat16 has 8."""
    bits = round(severity)

    def rounded(numbers: Tensor) -> Tensor:
        mantissa, exponent = torch.frexp(numbers.detach())
        scale = 2.0**bits
        return numbers + (torch.ldexp(torch.round(mantissa * scale) / scale, exponent) - numbers).detach()

    return Shape(lambda points: rounded(field(rounded(points))))


def quantised(field: Field, severity: float, draw: np.random.Generator) -> Field:
    """A cube whose distance is a multiple of a step, in scene units: 8 bits over -1 to 1 have a step of 0.0078."""

    def value(points: Tensor) -> Tensor:
        exact = field(points)
        return exact + (severity * torch.round(exact / severity) - exact).detach()

    return Shape(value)


def truncated(field: Field, severity: float, draw: np.random.Generator) -> Field:
    """A cube whose distance is cut off at a magnitude, in scene units, as DeepSDF's is at 0.1."""
    return Shape(lambda points: field(points).clamp(-severity, severity))


def saturated(field: Field, severity: float, draw: np.random.Generator) -> Field:
    """A cube as tanh(distance / width), a width in scene units: steep at the surface, 1 away from it."""
    return Shape(lambda points: torch.tanh(field(points) / severity))


DISTORTIONS: dict[str, Distortion] = {
    "scaled": scaled,
    "ripples": ripples,
    "perturbed": perturbed,
    "coarse_floats": coarse_floats,
    "quantised": quantised,
    "truncated": truncated,
    "saturated": saturated,
}
