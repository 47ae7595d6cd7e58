"""The sphere about the object that becomes the unit sphere: about the masks' hull, or about what the cameras view."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from datasets.files.captures.hull import carve
from datasets.files.captures.mask import is_inverted
from datasets.shot import Shot
from renderers.camera import Camera
from renderers.checks import BadInput

SEARCH_SAMPLES_PER_AXIS = 48
SHRINK_ROUNDS = 4  # the sampled cube shrinks to the hull in each round
HULL_RADIUS_FRACTION = 0.9  # the hull's radius in the unit sphere
PARALLEL_SPREAD, NARROW_SPREAD = 1e-4, 3e-3  # squared radians between optical axes that do not, or hardly, converge
MIN_SIZE_RATIO, ASPECT_TOLERANCE = 1.3, 0.15  # smaller or unequal ratios of width and height do not matter
MAX_OUT_OF_RANGE_FRACTION = 0.5  # if the viewed point is out of range in more photographs, it is not the centre


class UnfitCameras(BadInput):
    """Cameras that cannot be those of the photographs."""


@dataclass(frozen=True)
class Sphere:
    """A sphere about the object, in the world of the cameras, and how it was found, in words."""

    centre: Float[np.ndarray, "3"]
    radius: float
    source: str


def in_world(shot: Shot, to_world: Float[np.ndarray, "4 4"]) -> Shot:
    """The photograph in another world, in single precision; `to_world` maps from there to its world."""
    depth = None if shot.depth is None else shot.depth / float(np.linalg.norm(to_world[:3, 0]))
    return replace(shot, camera=camera_in_world(shot.camera, to_world), depth=depth)


def camera_in_world(camera: Camera, to_world: Float[np.ndarray, "4 4"]) -> Camera:
    """The camera in another world, in single precision; the similarity `to_world` maps from there to its world."""
    motion = camera.world_to_camera.double() @ torch.from_numpy(to_world)
    motion[:3] /= float(np.linalg.norm(to_world[:3, 0]))
    return replace(camera, intrinsics=camera.intrinsics.float(), world_to_camera=motion.float())


def hull_sphere(shots: Sequence[Shot], start: Sphere) -> Sphere:
    """The sphere about the visual hull of the masks, searched in a cube about `start`.

    Raises:
        UnfitCameras: the hull is empty.
    """
    centre, half_side = start.centre, start.radius
    for _ in range(SHRINK_ROUNDS):
        axis = torch.linspace(-half_side, half_side, SEARCH_SAMPLES_PER_AXIS, dtype=torch.float64)
        points = torch.from_numpy(centre) + torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
        inside = points[carve(shots, points) < 0].numpy()
        if len(inside) == 0:
            raise UnfitCameras("the visual hull of the masks is empty: no point is inside of all masks")
        spacing = 2 * half_side / (SEARCH_SAMPLES_PER_AXIS - 1)
        low, high = inside.min(axis=0) - spacing, inside.max(axis=0) + spacing
        centre, half_side = (low + high) / 2, float((high - low).max()) / 2
    radius = float(np.linalg.norm(inside - centre, axis=1).max()) + spacing
    return Sphere(centre, radius / HULL_RADIUS_FRACTION, "about the visual hull of the masks")


def likely_cause(shots: Sequence[Shot]) -> str:
    """The likely cause why cameras and masks do not fit: inverted masks, or the size of the images; "" if unknown."""
    if white := [shot.name for shot in shots if shot.mask is not None and is_inverted(shot.mask.numpy())]:
        which = f"{len(white)} of the masks, such as that of {white[0]}, are"
        return f"{which} white along the border, as inverted ones: make the object white, and the rest black"
    cameras = [shot.camera for shot in shots]
    centres = [(camera.intrinsics[0, 2] / camera.width, camera.intrinsics[1, 2] / camera.height) for camera in cameras]
    across, down = 2 * np.median(np.array(centres), axis=0)
    if min(across, down) <= 0 or abs(across / down - 1) > ASPECT_TOLERANCE or max(across, 1 / across) < MIN_SIZE_RATIO:
        return ""
    return (
        f"the principal point lies where it would be in images about {across:.2g} times as wide and high: scale the "
        "intrinsics as the images were, or give the images of the cameras' size"
    )


def viewed_sphere(shots: Sequence[Shot], depth_ranges: Sequence[tuple[float, float] | None]) -> Sphere:
    """A sphere about what the cameras look at; for parallel cameras, about the depth ranges or the masks.

    Args:
        depth_ranges: the nearest and the farthest depth in each photograph, or None.

    Raises:
        BadInput: the cameras look in parallel, and neither depth ranges nor masks are complete.
    """
    poses = np.stack([shot.camera.camera_to_world.double().numpy() for shot in shots])
    centre, spread = nearest_to_lines(poses[:, :3, 3], poses[:, :3, 2])
    depths = ((centre - poses[:, :3, 3]) * poses[:, :3, 2]).sum(axis=1)
    ranges = np.array([limits for limits in depth_ranges if limits is not None and 0 < limits[0] < limits[1]])
    if len(ranges) == len(shots):
        near, far = ranges.T
        out_of_range = np.mean((depths < near) | (depths > far)) > MAX_OUT_OF_RANGE_FRACTION
        if out_of_range or spread < PARALLEL_SPREAD:
            centre = np.mean(poses[:, :3, 3] + poses[:, :3, 2] * ((near + far) / 2)[:, None], axis=0)
            radius = max(_visible_radius(shots, centre), float(np.median(far - near)) / 2)
            return Sphere(centre, radius, "about the middle of the depths that the format states")
    elif spread < PARALLEL_SPREAD and all(shot.mask is not None for shot in shots):
        means = [shot.camera.rays().directions[shot.mask].mean(dim=0) for shot in shots]  # to the masks' middles
        directions = [torch.nn.functional.normalize(mean, dim=0).double().numpy() for mean in means]
        centre, _ = nearest_to_lines(poses[:, :3, 3], np.stack(directions))
    elif spread < PARALLEL_SPREAD:
        raise BadInput(
            f"the cameras look in parallel ({np.degrees(spread**0.5):.2g} degrees apart), so that nothing says how far "
            "away the object is: give masks, or cameras from more sides"
        )
    source = "about the point that the cameras look at, as far as most of them see"
    if np.mean(depths < 0) > MAX_OUT_OF_RANGE_FRACTION:
        source += "; but that lies behind most of them: try flipped axes (stated ones, where they are flipped)"
    elif spread < NARROW_SPREAD:
        angle = np.degrees(spread**0.5)
        source += f"; they look from within {angle:.2g} degrees, so that it is hardly known how far away"
    return Sphere(centre, _visible_radius(shots, centre), source)


def nearest_to_lines(
    positions: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "3"], float]:
    """The point nearest to all lines, and the mean squared angle between the lines, in squared radians."""
    projections = [np.eye(3) - np.outer(direction, direction) for direction in directions]
    projected = np.sum([matrix @ point for matrix, point in zip(projections, positions, strict=True)], axis=0)
    centre = np.linalg.lstsq(np.sum(projections, axis=0), projected, rcond=None)[0]
    return centre, max(float(np.linalg.eigvalsh(np.mean(projections, axis=0))[0]), 0.0)


def _visible_radius(shots: Sequence[Shot], centre: Float[np.ndarray, "3"]) -> float:
    """Half of the width that the narrower side of the median image shows at the distance of a point."""
    cameras = [shot.camera for shot in shots]
    distances = [np.linalg.norm(camera.center.double().numpy() - centre) for camera in cameras]
    half_widths = [min(camera.width, camera.height) / 2 / camera.intrinsics[0, 0].item() for camera in cameras]
    return float(np.median(np.array(distances) * np.array(half_widths)))
