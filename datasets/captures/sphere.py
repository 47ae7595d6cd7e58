"""The sphere about the object that becomes the unit sphere: of the masks' hull, or of what the cameras look at."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from datasets.captures.hull import carve
from datasets.shot import Shot
from renderers.camera import Camera
from renderers.checks import BadInput

SAMPLES = 48  # per axis, while the hull is looked for
ROUNDS = 4  # in which the part of the world that is sampled shrinks to the hull
FILLED = 0.9  # of the unit sphere's radius that the hull takes
PARALLEL, NARROW = 1e-4, 3e-3  # squares of radians between optical axes: below, no point is where they meet; hardly one
RESIZED, ALIKE = 1.3, 0.15  # an image's size that differs more from its camera's is told; the same in both directions
UNKNOWN = (
    "Try flipped axes (stated ones, where they are flipped), check the order of the images and that masks are white on "
    "the object"
)
BESIDE = 0.5  # share of the photographs in whose range of depths a point must not lie, to be looked for elsewhere


@dataclass(frozen=True)
class Sphere:
    """A sphere about the object, in the world of the cameras, and how it was found."""

    centre: Float[np.ndarray, "3"]
    radius: float
    found: str


def hull_sphere(shots: Sequence[Shot], start: Sphere) -> Sphere:
    """The sphere about the visual hull of the masks, looked for in a cube about `start`.

    Raises:
        BadInput: where the hull is empty.
    """
    centre, half = start.centre, start.radius
    for _ in range(ROUNDS):
        axis = torch.linspace(-half, half, SAMPLES, dtype=torch.float64)
        points = torch.from_numpy(centre) + torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
        inside = points[carve(shots, points) < 0].numpy()
        if len(inside) == 0:
            raise BadInput(
                "the visual hull of the masks is empty: no point is inside of all masks, so that cameras do not fit "
                f"the masks. {doubt_of(shots).capitalize() or UNKNOWN}"
            )
        spacing = 2 * half / (SAMPLES - 1)
        low, high = inside.min(axis=0) - spacing, inside.max(axis=0) + spacing
        centre, half = (low + high) / 2, float((high - low).max()) / 2
    radius = float(np.linalg.norm(inside - centre, axis=1).max()) + spacing
    return Sphere(centre, radius / FILLED, "about the visual hull of the masks")


def doubt_of(shots: Sequence[Shot]) -> str:
    """What may be wrong with photographs that do not fit: the size of their images, or inverted masks; "" else."""
    masked = [(shot.name, shot.mask) for shot in shots if shot.mask is not None]
    sides = [(name, (mask[0], mask[-1], mask[:, 0], mask[:, -1])) for name, mask in masked]
    if white := [name for name, four in sides if all(bool(side.float().mean() > 0.5) for side in four)]:
        which = f"{len(white)} of the masks, such as that of {white[0]}, are"
        return f"{which} white along the border, as inverted ones: make the object white, and the rest black"
    return _size_doubt([shot.camera for shot in shots])


def _size_doubt(cameras: Sequence[Camera]) -> str:
    """What is said of cameras whose principal point lies as if their images had another size; "" of others."""
    middles = [(one.intrinsics[0, 2] / one.width, one.intrinsics[1, 2] / one.height) for one in cameras]
    across, down = 2 * np.median(np.array(middles), axis=0)
    if min(across, down) <= 0 or abs(across / down - 1) > ALIKE or max(across, 1 / across) < RESIZED:
        return ""
    return (
        f"the principal point lies where it would be in images about {across:.2g} times as wide and high: scale the "
        "intrinsics as the images were, or give the images of the cameras' size"
    )


def looked_at(shots: Sequence[Shot], spans: Sequence[tuple[float, float] | None]) -> Sphere:
    """A sphere about what the cameras look at; where they look in parallel, about the range of depths or the masks.

    Args:
        spans: the nearest and the farthest depth in each photograph, where the format states them.

    Raises:
        BadInput: where the cameras look in parallel, and depths are not known.
    """
    motions = np.stack([shot.camera.camera_to_world.double().numpy() for shot in shots])
    centre, spread = _nearest(motions[:, :3, 3], motions[:, :3, 2])
    depths = ((centre - motions[:, :3, 3]) * motions[:, :3, 2]).sum(axis=1)
    known = np.array([span for span in spans if span is not None and 0 < span[0] < span[1]])
    if len(known) == len(shots):
        near, far = known.T
        beside = np.mean((depths < near) | (depths > far)) > BESIDE
        if beside or spread < PARALLEL:
            centre = np.mean(motions[:, :3, 3] + motions[:, :3, 2] * ((near + far) / 2)[:, None], axis=0)
            radius = max(_shown(shots, centre), float(np.median(far - near)) / 2)
            return Sphere(centre, radius, "about the middle of the depths that the format states")
    elif spread < PARALLEL and all(shot.mask is not None for shot in shots):
        centre, _ = _nearest(motions[:, :3, 3], np.stack([_towards_mask(shot) for shot in shots]))
    elif spread < PARALLEL:
        raise BadInput(
            f"the cameras look in parallel ({np.degrees(spread**0.5):.2g} degrees apart), so that nothing says how far "
            "away the object is: give masks, or cameras from more sides"
        )
    found = "about the point that the cameras look at, as far as most of them see"
    if np.mean(depths < 0) > BESIDE:
        found += "; but that lies behind most of them: try flipped axes (stated ones, where they are flipped)"
    elif spread < NARROW:
        angle = np.degrees(spread**0.5)
        found += f"; they look from within {angle:.2g} degrees, so that it is hardly known how far away"
    return Sphere(centre, _shown(shots, centre), found)


def _nearest(
    places: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "3"], float]:
    """The point nearest to all lines, and the mean square of the angle by which these differ, in radians."""
    across = [np.eye(3) - np.outer(direction, direction) for direction in directions]
    pulled = np.sum([one @ place for one, place in zip(across, places, strict=True)], axis=0)
    centre = np.linalg.lstsq(np.sum(across, axis=0), pulled, rcond=None)[0]
    return centre, max(float(np.linalg.eigvalsh(np.mean(across, axis=0))[0]), 0.0)


def _towards_mask(shot: Shot) -> Float[np.ndarray, "3"]:
    """The direction of the middle of a mask."""
    assert shot.mask is not None
    return torch.nn.functional.normalize(shot.camera.rays().directions[shot.mask].mean(dim=0), dim=0).double().numpy()


def _shown(shots: Sequence[Shot], centre: Float[np.ndarray, "3"]) -> float:
    """Half the width that the narrower side of most images shows at the distance of a point."""
    cameras = [shot.camera for shot in shots]
    away = [np.linalg.norm(one.center.double().numpy() - centre) for one in cameras]
    shown = np.array([min(one.width, one.height) / 2 / one.intrinsics[0, 0].item() for one in cameras])
    return float(np.median(np.array(away) * shown))
