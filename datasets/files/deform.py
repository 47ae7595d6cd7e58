"""Seeded smooth deformations that make many shapes from one mesh."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

MAX_LOG_SCALE = 0.25  # about -22 % to +28 % along an axis
MAX_TAPER = 0.25  # relative change of the cross-section at |position| = 1 along the axis
MAX_TWIST_RADIANS = np.radians(25)  # at |position| = 1
MAX_CURVATURE = 0.25  # 1 / scene unit


@dataclass(frozen=True)
class Deformation:
    """Stretch, then taper, twist and bend, each along an axis of the frame; the identity if all are zero.

    Axes are 0, 1, 2 for x, y, z. Every part preserves orientation within the unit sphere.
    """

    stretch: tuple[float, float, float] = (0.0, 0.0, 0.0)  # logs of the scales
    taper: float = 0.0  # relative growth of the cross-section per unit along its axis
    taper_axis: int = 0
    twist: float = 0.0  # radians per unit along its axis
    twist_axis: int = 0
    bend: float = 0.0  # curvature of the bent axis, towards the axis after it
    bend_axis: int = 0

    @classmethod
    def draw(cls, seed: int, strength: float = 1.0) -> "Deformation":
        """Draws a deformation uniformly within the limits above, multiplied by `strength`.

        Args:
            seed: the same seed gives the same deformation; another strength scales it.
            strength: from 0, the identity, to 1.
        """
        if not 0 <= strength <= 1:
            raise ValueError(f"strength: must be from 0 to 1, found {strength}; 1 is the strongest that cannot fold")
        generator = np.random.default_rng(seed)
        amounts = strength * generator.uniform(-1, 1, 6)
        axes = generator.integers(0, 3, 3).tolist()
        stretch = tuple((MAX_LOG_SCALE * amounts[:3]).tolist())
        taper, twist, bend = (np.array([MAX_TAPER, MAX_TWIST_RADIANS, MAX_CURVATURE]) * amounts[3:]).tolist()
        return cls(stretch, taper, axes[0], twist, axes[1], bend, axes[2])

    def apply(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Moves points of the unit sphere; the result is not normalised again."""
        points = np.asarray(points, dtype=np.float64) * np.exp(self.stretch)
        points = _taper(points, self.taper, self.taper_axis)
        points = _twist(points, self.twist, self.twist_axis)
        return _bend(points, self.bend, self.bend_axis)


def _taper(points: np.ndarray, rate: float, axis: int) -> np.ndarray:
    scales = np.repeat(1 + rate * points[..., [axis]], 3, axis=-1)
    scales[..., axis] = 1
    return points * scales


def _twist(points: np.ndarray, rate: float, axis: int) -> np.ndarray:
    first, second = (axis + 1) % 3, (axis + 2) % 3
    cosine, sine = np.cos(rate * points[..., axis]), np.sin(rate * points[..., axis])
    twisted = points.copy()
    twisted[..., first] = cosine * points[..., first] - sine * points[..., second]
    twisted[..., second] = sine * points[..., first] + cosine * points[..., second]
    return twisted


def _bend(points: np.ndarray, curvature: float, axis: int) -> np.ndarray:
    """Bends the axis into an arc of a circle; planes across it turn without changing shape."""
    if curvature == 0:
        return points
    towards = (axis + 1) % 3
    angle, radius = curvature * points[..., axis], 1 / curvature - points[..., towards]
    bent = points.copy()
    bent[..., axis] = radius * np.sin(angle)
    bent[..., towards] = 1 / curvature - radius * np.cos(angle)
    return bent
