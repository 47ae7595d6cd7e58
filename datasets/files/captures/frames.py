"""The result of reading a folder of photographs: image files with their cameras, the same for all formats.

Axes and pixels are those of `renderers.camera`: x right, y down, z forward, the first pixel's centre at (0.5, 0.5).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.linalg import rq

from datasets.files.captures.lenses import Lens
from renderers.checks import BadInput

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # axes x right, y up, z backward
AXES = {"stated": np.eye(4), "flipped": OPENGL}  # names are values of dataset.axes
PIXEL_CENTRE = 0.5  # pixels; some formats have the first pixel's centre at 0
LAST_ROW = (0.0, 0.0, 0.0, 1.0)
ROTATION_TOLERANCE = 5e-3  # largest accepted deviation of the axes from unit length and right angles
ROUNDING_TOLERANCE = 1e-5  # a larger deviation comes from few digits in the file; the nearest rotation is used then


@dataclass(frozen=True)
class Frame:
    """The file of an image and its camera.

    Args:
        image: the file.
        intrinsics: in pixels of an image of `size`.
        world_to_camera: rigid motion.
        mask: the file of its mask; None without one, or if the image has an alpha channel.
        size: height and width for which the intrinsics hold; None: the size of the image file.
        lens: its distortion.
        depth_range: the nearest and the farthest visible depth, if the format states them.
        depth: the file of its depths, and the factor that makes them camera z in units of the world; None without one.
    """

    image: Path
    intrinsics: Float[np.ndarray, "3 3"]
    world_to_camera: Float[np.ndarray, "4 4"]
    mask: Path | None = None
    size: tuple[int, int] | None = None
    lens: Lens = field(default_factory=Lens)
    depth_range: tuple[float, float] | None = None
    depth: tuple[Path, float] | None = None

    def __post_init__(self) -> None:
        numbers = np.concatenate([self.intrinsics.ravel(), self.world_to_camera.ravel(), self.lens.coefficients])
        if not np.isfinite(numbers).all() or not (self.intrinsics[[0, 1], [0, 1]] > 0).all():
            raise BadInput(
                f"the camera of {self.image} must have finite numbers and positive focal lengths: export it again"
            )
        if self.size is not None and min(self.size) < 1:
            raise BadInput(f"the camera of {self.image} must be of one pixel or more, not {self.size}: export it again")
        if max(np.abs(self.intrinsics[2] - (0, 0, 1)).max(), abs(self.intrinsics[1, 0])) > ROTATION_TOLERANCE:
            raise BadInput(
                f"the intrinsics of {self.image} must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]], not "
                f"{self.intrinsics.tolist()}: they may be transposed"
            )
        rotation = self.world_to_camera[:3, :3]
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
            lengths = ", ".join(f"{length:.4g}" for length in np.linalg.norm(rotation, axis=1))
            mirrored = " and it mirrors" if np.linalg.det(rotation) < 0 else ""
            raise BadInput(
                f"the camera of {self.image} must have a rotation, but its axes have lengths {lengths} and products up "
                f"to {np.abs(np.triu(rotation @ rotation.T, 1)).max():.2g}{mirrored}: export it as a rigid motion"
            )


@dataclass(frozen=True)
class Layout:
    """The contents of a folder of photographs.

    Args:
        format: its name.
        frames: the images that have a camera, by name.
        sphere: centre and radius of the sphere about the object, if the format states it.
        notes: how images, cameras and masks were paired, if not by equal names, and what was left out.
        points_sphere: a sphere about most of the reconstructed points, if the format has points.
        world: the map from the cameras' world to the file's world.
        example_image: the first image that the format names, for the message about missing images.
        doubt: a cause in the file of cameras why photographs may not fit each other; empty without one.
    """

    format: str
    frames: tuple[Frame, ...]
    sphere: tuple[Float[np.ndarray, "3"], float] | None = None
    notes: tuple[str, ...] = ()
    points_sphere: tuple[Float[np.ndarray, "3"], float] | None = None
    world: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    example_image: str = ""
    doubt: str = ""


@dataclass(frozen=True)
class Format:
    """A format of photographs with cameras. A file of `captures/formats` defines one, with the name FORMAT.

    Args:
        name: the name in messages.
        rank: formats of lower rank are tried first, if a folder has the files of several formats.
        camera_files: patterns of the files of cameras in a folder.
        description: these files and the folders of images, for messages.
        read: gives the layout of a folder, from the folder, the files found and whether masks are read. If
            `takes_images`, it takes the folder of images too, as `images`.
    """

    name: str
    rank: int
    camera_files: Sequence[str]
    description: str
    read: Callable[..., "Layout"]
    takes_images: bool = False


def require_key(settings: Mapping[str, Any], key: str, where: str) -> Any:
    """The value of a key; raises BadInput that names `where` if the key is missing."""
    if key not in settings:
        raise BadInput(f"{where} has no {key}: export it again, with {key}")
    return settings[key]


def decompose(projection: Float[np.ndarray, "3 4"]) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "4 4"]]:
    """Intrinsics and world_to_camera of an invertible projection that has the first pixel's centre at (0, 0)."""
    projection = projection * np.sign(np.linalg.det(projection[:, :3]))
    upper, rotation = rq(projection[:, :3])
    signs = np.diag(np.sign(np.diag(upper)))
    upper, rotation = upper @ signs, signs @ rotation
    return shift_pixels(upper / upper[2, 2]), rigid_matrix(rotation, np.linalg.solve(upper, projection[:, 3]))


def rigid_matrix(rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """The matrix of a rigid motion: the rotation, followed by the translation."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


def nearest_rigid_matrix(world_to_camera: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """world_to_camera with the nearest exact rotation and the same centre; unchanged if the rotation is exact."""
    rotation = world_to_camera[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() < ROUNDING_TOLERANCE:
        return world_to_camera
    left, _, right = np.linalg.svd(rotation)
    return rigid_matrix(left @ right, left @ right @ np.linalg.solve(rotation, world_to_camera[:3, 3]))


def homogeneous_matrix(matrix: Float[np.ndarray, "rows columns"], where: str) -> Float[np.ndarray, "4 4"]:
    """The matrix as 4 x 4; raises BadInput unless it is invertible and its fourth row is 0 0 0 1 or missing."""
    if matrix.shape not in ((4, 4), (3, 4)):
        shape = " x ".join(map(str, matrix.shape))
        raise BadInput(f"{where} must be 4 x 4, not {shape}: export it again")
    if not np.isfinite(matrix).all():
        raise BadInput(f"{where} must have finite numbers: export it again")
    if np.linalg.matrix_rank(matrix[:3, :3]) < 3:
        raise BadInput(f"{where} must be invertible, in its left 3 x 3 numbers: export it again")
    if np.abs(matrix[3:] - LAST_ROW).max(initial=0) > ROUNDING_TOLERANCE:
        fourth_row = " ".join(f"{value:.6g}" for value in matrix[3])
        row, column = (np.abs(vector).max() > ROUNDING_TOLERANCE for vector in (matrix[3, :3], matrix[:3, 3]))
        transposed = "it may be transposed; " if row and not column else ""
        raise BadInput(f"{where} must have 0 0 0 1 as its fourth row, not {fourth_row}: {transposed}export it again")
    return np.vstack([matrix[:3], LAST_ROW])


def shift_pixels(intrinsics: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Intrinsics with the first pixel's centre at (0.5, 0.5), from intrinsics with it at (0, 0)."""
    return intrinsics + np.array([[0, 0, PIXEL_CENTRE], [0, 0, PIXEL_CENTRE], [0, 0, 0]])
