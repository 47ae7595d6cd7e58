"""Positions of cameras, and the choice of pixels whose depth is observed."""

from dataclasses import asdict, dataclass
from math import asin, atan2, degrees, inf, isqrt, nan, radians, tan
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderers.camera import Camera
from renderers.checks import BadInput, check_at_least, check_positive

MAX_ELEVATION_DEGREES = 89.0


def check_elevation(name: str, degrees: tuple[float, float]) -> None:
    """Raises ValueError for a range that does not rise between the poles."""
    if not -90 < degrees[0] <= degrees[1] < 90:
        raise ValueError(f"{name} must rise within -90 to 90 degrees, not {list(degrees)}")


@dataclass(frozen=True)
class ViewSampler:
    """Draws cameras that look at the origin, world y up.

    Args:
        distance: from the origin, in scene units.
        field_of_view: full angle of the image's height, in degrees.
        azimuth, elevation: least and largest angle, in degrees; azimuth 0 looks along -z, elevation 0 is level.
        resolution: height and width of the image, in pixels.
        rays_per_pixel: a square number of rays that a loss compares in each pixel; see `bench.solve.pixel_area`.
    """

    distance: float
    field_of_view: float
    azimuth: tuple[float, float]
    elevation: tuple[float, float]
    resolution: int
    rays_per_pixel: int = 1

    def __post_init__(self) -> None:
        check_positive("view.distance", self.distance, "2.5 sees the whole unit sphere at 50 degrees")
        check_at_least("view.resolution", self.resolution, 4, "set scale.resolution=64 or view.resolution=64")
        if not 0 < self.field_of_view < 180:
            raise ValueError(f"view.field_of_view must lie between 0 and 180 degrees, not {self.field_of_view}")
        if not -inf < self.azimuth[0] <= self.azimuth[1] < inf:
            raise ValueError(f"view.azimuth must rise and be finite, in degrees, not {list(self.azimuth)}")
        check_elevation("view.elevation", self.elevation)
        if self.rays_per_pixel < 1 or isqrt(self.rays_per_pixel) ** 2 != self.rays_per_pixel:
            raise ValueError(f"view.rays_per_pixel must be 1, 4, 9, 16, ..., not {self.rays_per_pixel}")

    @property
    def identity(self) -> dict[str, Any]:
        """The settings on which images depend, as plain data."""
        return {name: value for name, value in asdict(self).items() if name != "rays_per_pixel"}

    @property
    def focal_length(self) -> float:
        """The focal length in pixels: f R / S in DIST, Eq. 10."""
        return self.resolution / 2 / tan(radians(self.field_of_view) / 2)

    def draw(self, seed: int) -> Camera:
        """The random camera of a seed; its draws are independent of the shape with the same seed."""
        generator = np.random.default_rng([seed, 1])
        return self.camera(generator.uniform(*self.azimuth), generator.uniform(*self.elevation))

    def towards(self, direction: Float[Tensor, "3"]) -> Camera:
        """The camera in a direction from the origin, with an elevation of at most `MAX_ELEVATION_DEGREES`."""
        x, y, z = torch.nn.functional.normalize(direction, dim=0).tolist()
        elevation = min(max(degrees(asin(y)), -MAX_ELEVATION_DEGREES), MAX_ELEVATION_DEGREES)
        return self.camera(degrees(atan2(x, z)), elevation)

    def camera(self, azimuth: float, elevation: float) -> Camera:
        """The camera at these angles, in degrees."""
        across, up = radians(azimuth), radians(elevation)
        toward = [np.cos(up) * np.sin(across), np.sin(up), np.cos(up) * np.cos(across)]
        eye = self.distance * torch.tensor(toward, dtype=torch.float32)
        focal = self.focal_length
        middle = self.resolution / 2
        intrinsics = torch.tensor([[focal, 0, middle], [0, focal, middle], [0, 0, 1]])
        return Camera(intrinsics, look_at(eye, torch.zeros(3)), self.resolution, self.resolution)


def look_at(eye: Float[Tensor, "3"], target: Float[Tensor, "3"]) -> Float[Tensor, "4 4"]:
    """The world_to_camera of a camera at `eye` with `target` in the middle of its image and world y up.

    Raises:
        ValueError: the camera looks straight up or down, or is at its target.
    """
    up = torch.tensor([0.0, 1.0, 0.0])
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    right = torch.linalg.cross(forward, up)
    if right.norm() < 1e-6:
        raise ValueError(f"eye must not lie on, above or below target, not {eye.tolist()}: lower the elevation")
    right = torch.nn.functional.normalize(right, dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    motion = torch.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation, -rotation @ eye
    return motion


def pixel_of_each_block(height: int, width: int, side: int, generator: torch.Generator) -> Int[Tensor, " blocks"]:
    """Indices of pixels by rows: a random one of each block of `side` x `side`; blocks at an edge are smaller."""
    rows, columns = (torch.arange(0, length, side) for length in (height, width))
    drawn = torch.rand(2, len(rows), len(columns), generator=generator)
    row = rows[:, None] + (drawn[0] * (height - rows).clamp_max(side)[:, None]).long()
    column = columns + (drawn[1] * (width - columns).clamp_max(side)).long()
    return (row * width + column).flatten()


def observed_pixels(mask: Bool[Tensor, "height width"], points: str | int, seed: int) -> Bool[Tensor, "height width"]:
    """Mask of the foreground pixels whose depth is observed.

    Args:
        points: "dense" for all, "10%" for a fraction, 100 for a number.
        seed: of the draw, without replacement.

    Raises:
        ValueError: another text, or more points than the foreground has.
    """
    foreground = mask.flatten().nonzero().squeeze(-1)
    available = foreground.numel()
    amount, is_share = parse_amount(points)
    count = max(1, round(available * amount)) if is_share else round(amount)
    if count > available:
        message = f"points must be at most the {available} pixels of the shape, not {points}"
        raise BadInput(f"{message}: give fewer, or raise view.resolution")
    order = torch.randperm(available, generator=torch.Generator().manual_seed(seed))
    observed = torch.zeros(mask.numel(), dtype=torch.bool)
    observed[foreground[order[:count]]] = True
    return observed.view(mask.shape)


def parse_amount(points: str | int) -> tuple[float, bool]:
    """Parses an amount such as "dense", "10%" or 100; also returns whether it is a fraction.

    Raises:
        ValueError: another text.
    """
    text = "100%" if points == "dense" else str(points).strip()
    is_share = text.endswith("%")
    try:
        value = float(text.removesuffix("%")) / 100 if is_share else float(int(text))
    except ValueError:
        value = nan
    if not value > 0 or (is_share and value > 1):
        raise ValueError(f'points must be "dense", a share up to "100%", or a number such as 100, not {text!r}')
    return value, is_share
