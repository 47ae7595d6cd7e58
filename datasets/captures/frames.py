"""What a folder of photographs is read as: files with cameras, whichever the format.

Axes and pixels are those of `renderers.camera`: x right, y down, z forward, the first pixel's centre at (0.5, 0.5).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.linalg import rq

from datasets.captures.lenses import Lens
from renderers.checks import BadInput

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # axes x right, y up, z backward
HALF = 0.5  # pixels: where the first pixel's centre is at whole numbers, the principal point moves by this
LAST = (0.0, 0.0, 0.0, 1.0)  # row of a matrix
RIGID = 5e-3  # most by which a rotation's axes may differ from unit and orthogonal ones
ROUNDED = 1e-5  # those that differ more are replaced by the nearest rotation: the file has few digits


@dataclass(frozen=True)
class Frame:
    """The file of an image, and its camera.

    Args:
        image: the file.
        intrinsics: in pixels of an image of `size`.
        world_to_camera: rigid motion.
        mask: the file of its mask; None where there is none, or the image has an alpha channel.
        size: height and width for which the intrinsics hold; None for those of the file.
        lens: its distortion.
        span: the nearest and the farthest depth of what it shows, where the format states them.
        depth: the file of its depths, and what makes them camera z in units of the world; None where there is none.
    """

    image: Path
    intrinsics: Float[np.ndarray, "3 3"]
    world_to_camera: Float[np.ndarray, "4 4"]
    mask: Path | None = None
    size: tuple[int, int] | None = None
    lens: Lens = field(default_factory=Lens)
    span: tuple[float, float] | None = None
    depth: tuple[Path, float] | None = None

    def __post_init__(self) -> None:
        numbers = np.concatenate([self.intrinsics.ravel(), self.world_to_camera.ravel(), self.lens.numbers])
        if not np.isfinite(numbers).all() or not (self.intrinsics[[0, 1], [0, 1]] > 0).all():
            raise BadInput(
                f"the camera of {self.image} must have finite numbers and positive focal lengths: export it again"
            )
        if self.size is not None and min(self.size) < 1:
            raise BadInput(f"the camera of {self.image} must be of one pixel or more, not {self.size}: export it again")
        if np.abs(self.intrinsics[2] - (0, 0, 1)).max() > RIGID or abs(self.intrinsics[1, 0]) > RIGID:
            raise BadInput(
                f"the intrinsics of {self.image} must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]], not "
                f"{self.intrinsics.tolist()}: they may be transposed"
            )
        rotation = self.world_to_camera[:3, :3]
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > RIGID or np.linalg.det(rotation) < 0:
            lengths = ", ".join(f"{length:.4g}" for length in np.linalg.norm(rotation, axis=1))
            mirrored = " and it mirrors" if np.linalg.det(rotation) < 0 else ""
            raise BadInput(
                f"the camera of {self.image} must have a rotation, but its axes have lengths {lengths} and products up "
                f"to {np.abs(np.triu(rotation @ rotation.T, 1)).max():.2g}{mirrored}: export it as a rigid motion"
            )


@dataclass(frozen=True)
class Layout:
    """What lies in a folder of photographs.

    Args:
        format: its name.
        frames: the images that have a camera, by name.
        sphere: centre and radius of the sphere about the object, where the format states it.
        notes: how images, cameras and masks were paired, where that is not plain, and what was left out.
        points: a sphere about most of the reconstructed points, where the format has them.
        world: from the cameras' world into that of the file.
        missing: the first image that it names, for what is said where none is there.
    """

    format: str
    frames: tuple[Frame, ...]
    sphere: tuple[Float[np.ndarray, "3"], float] | None = None
    notes: tuple[str, ...] = ()
    points: tuple[Float[np.ndarray, "3"], float] | None = None
    world: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    missing: str = ""


def need(known: Mapping[str, Any], key: str, where: str) -> Any:
    """The value of a key; raises BadInput that names what lacks it."""
    if key not in known:
        raise BadInput(f"{where} has no {key}: export it again, with {key}")
    return known[key]


def decomposed(projection: Float[np.ndarray, "3 4"]) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "4 4"]]:
    """Intrinsics and world_to_camera of an invertible projection whose first pixel's centre is at whole numbers."""
    projection = projection * np.sign(np.linalg.det(projection[:, :3]))
    upper, rotation = rq(projection[:, :3])
    signs = np.diag(np.sign(np.diag(upper)))
    upper, rotation = upper @ signs, signs @ rotation
    return centred(upper / upper[2, 2]), motion(rotation, np.linalg.solve(upper, projection[:, 3]))


def motion(rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """The rigid motion that turns first."""
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = rotation, translation
    return moved


def nearest_motion(moved: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """world_to_camera with a rotation that is exact, about the same centre; itself where it is nearly exact."""
    rotation = moved[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() < ROUNDED:
        return moved
    left, _, right = np.linalg.svd(rotation)
    return motion(left @ right, left @ right @ np.linalg.solve(rotation, moved[:3, 3]))


def whole(matrix: Float[np.ndarray, "rows columns"], where: str) -> Float[np.ndarray, "4 4"]:
    """A matrix that can be inverted, whose fourth row is 0 0 0 1 or missing; else BadInput that names where it is."""
    if matrix.shape not in ((4, 4), (3, 4)):
        shape = " x ".join(map(str, matrix.shape))
        raise BadInput(f"{where} must be 4 x 4, not {shape}: export it again")
    if not np.isfinite(matrix).all():
        raise BadInput(f"{where} must have finite numbers: export it again")
    if np.linalg.matrix_rank(matrix[:3, :3]) < 3:
        raise BadInput(f"{where} must be invertible, in its left 3 x 3 numbers: export it again")
    if np.abs(matrix[3:] - LAST).max(initial=0) > ROUNDED:
        found = " ".join(f"{value:.6g}" for value in matrix[3])
        row, column = (np.abs(part).max() > ROUNDED for part in (matrix[3, :3], matrix[:3, 3]))
        transposed = "it may be transposed; " if row and not column else ""
        raise BadInput(f"{where} must have 0 0 0 1 as its fourth row, not {found}: {transposed}export it again")
    return np.vstack([matrix[:3], LAST])


def centred(intrinsics: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Intrinsics with the first pixel's centre at (0.5, 0.5), from those with it at (0, 0)."""
    return intrinsics + np.array([[0, 0, HALF], [0, 0, HALF], [0, 0, 0]])
