"""The user's depth image as a dataset: one object, seen by one camera, of known or unknown true shape."""

from dataclasses import dataclass, replace
from functools import cached_property
from math import cos, radians, sin
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from datasets.files.captures.depth import read_depth_file
from datasets.files.captures.image import open_image
from datasets.files.captures.mask import load_mask
from datasets.files.meshes import load_mesh
from datasets.files.range_scans import join_neighbours
from datasets.mesh import Mesh
from datasets.scene import Scene, Split, Truth, View, see
from datasets.shot import camera_in_world
from datasets.views import look_at
from renderers.camera import Camera
from renderers.checks import BadInput, check_positive

OBJECT_RADIUS = 0.75  # scene units, of the visible surface, so that the hidden part also fits the unit sphere
OUTLIER_FRACTION = 0.01  # on each side, such as stray points behind an outline
DEFAULT_PITCH_DEGREES = 25.0  # assumed angle at which a camera without camera_to_world looks down
MARGIN_FRACTION = 0.1  # image margin around the object, relative to the object's extent
MIN_DEPTH_PIXELS = 20
MAX_CENTRE_OFFSET = 0.3  # from the image centre to the principal point, relative to half the image
MAX_TRUTH_DISTANCE = 0.15  # scene units; median distance of the visible surface from the truth
MATRIX_SYNTAX = "write [fx,fy,cx,cy] or [[fx,0,cx],[0,fy,cy],[0,0,1]], and [4, 4] numbers for a rigid motion"


@dataclass(frozen=True)
class DepthImage:
    """One depth image with the camera that took it.

    Args:
        path: camera z, 0 or not finite at unknown pixels: an `.npy`; an `.npz` with one array or an array `depth`; a
            PNG of 16 bits; or another file that OpenCV reads, such as an EXR.
        intrinsics: fx, fy, cx, cy, or a matrix [3, 3], in pixels; the first pixel's centre is (0.5, 0.5).
        scale: units of the file's world per stored number, such as 0.001 for a PNG in millimetres.
        mask_path: an image of the same size, white on the object; None: all pixels with a depth show the object.
        camera_to_world: matrix [4, 4] into the file's world, whose y points up; x of a camera points right, y down, z
            forward. None: the world's axes are the camera's axes.
        truth: a mesh in the file's world, the ground truth of results; None: the visible surface is the truth.
    """

    path: str
    intrinsics: list[Any]
    scale: float
    mask_path: str | None
    camera_to_world: list[Any] | None
    truth: str | None

    def __post_init__(self) -> None:
        check_positive("dataset.scale", self.scale, "0.001 is of a PNG in millimetres, where the world is in metres")
        for name, path in (("path", self.path), ("mask_path", self.mask_path), ("truth", self.truth)):
            if path is not None and not Path(path).is_file():
                raise ValueError(f"dataset.{name}={path} is no file: check the path")
        _ = self.camera

    @property
    def name(self) -> str:
        """The name of the file, without suffix."""
        return Path(self.path).stem

    @cached_property
    def camera(self) -> Camera:
        """The camera in the file's world, in float64, with a size of one pixel.

        Raises:
            ValueError: intrinsics or camera_to_world are not valid.
        """
        try:
            pinhole = np.array(self.intrinsics, dtype=np.float64)
            if pinhole.shape == (4,):
                fx, fy, cx, cy = pinhole
                pinhole = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
            motion = np.eye(4) if self.camera_to_world is None else np.array(self.camera_to_world, dtype=np.float64)
            return Camera(torch.from_numpy(pinhole), torch.from_numpy(np.linalg.inv(motion)), 1, 1)
        except (TypeError, ValueError, np.linalg.LinAlgError) as error:
            raise ValueError(f"dataset.intrinsics, dataset.camera_to_world: {error}; {MATRIX_SYNTAX}") from None

    def mesh(self, split: Split, index: int) -> Mesh:
        """Raises BadInput: a depth image shows one object."""
        raise BadInput("a depth image is no set of shapes: set task=completion")

    def identity(self) -> dict[str, Any]:
        """The file; runs are distinguished by the contents of the files."""
        return {"name": "depth_image", "path": self.path}

    def placed(self, resolution: int) -> Scene:
        """See `datasets.scene.OneView`.

        Raises:
            BadInput: a file cannot be read, or shows too little of the object.
        """
        depth = self.scale * _read_depths(Path(self.path))
        mask = depth > 0 if self.mask_path is None else load_mask(Path(self.mask_path))
        if mask.shape != depth.shape:
            sizes = " and ".join(f"{width} x {height}" for height, width in (mask.shape, depth.shape))
            raise BadInput(f"{self.mask_path} and {self.path} must have one size, not {sizes} pixels")
        warning = self._principal_point_warning(*depth.shape)
        depth, mask, intrinsics = _crop_and_subsample(depth, mask, self.camera.intrinsics.numpy(), resolution)
        measured = (depth > 0) & mask
        if measured.sum() < MIN_DEPTH_PIXELS:
            raise BadInput(
                f"{self.path} has {measured.sum()} depths on the object at view.resolution={resolution}, and "
                f"{MIN_DEPTH_PIXELS} are the fewest: check dataset.mask_path, or raise view.resolution"
            )
        to_world, camera = self._fit_to_sphere(torch.from_numpy(depth), measured, torch.from_numpy(intrinsics))
        scene_depth = torch.from_numpy(depth * mask / np.linalg.norm(to_world[:3, 0])).float()
        points = camera.rays().at(camera.distance(scene_depth)).double().numpy()[measured]
        if self.truth is None:
            mesh = join_neighbours(np.argwhere(measured)[:, ::-1] * (1, -1), points)  # faces look at the camera
            truth_note = "judged by what is seen, since there is no dataset.truth"
        else:
            mesh, truth_note = load_mesh(self.truth).moved(np.linalg.inv(to_world)), f"the true shape is '{self.truth}'"
            gap = float(np.median(Truth(mesh).distance(points)))
            if gap > MAX_TRUTH_DISTANCE:
                raise BadInput(
                    f"what {self.path} shows lies {gap / OBJECT_RADIUS:.2g} of its radius from dataset.truth (median): "
                    "give both in one world, by dataset.camera_to_world and dataset.scale, and check dataset.intrinsics"
                )
        surface = see(Truth(mesh, closed=False), camera)
        view = View(camera, surface.depth, surface.normals, torch.from_numpy(mask))
        mesh = replace(mesh, repairs=(*filter(None, (truth_note, warning)), *mesh.repairs))
        return Scene(self.name, mesh, view, scene_depth, to_world, is_partial=self.truth is None)

    def _principal_point_warning(self, height: int, width: int) -> str:
        """A warning about a principal point far from the middle of the image; "" for others."""
        across, down = self.camera.intrinsics[:2, 2].tolist()
        if max(abs(2 * across / width - 1), abs(2 * down / height - 1)) <= MAX_CENTRE_OFFSET:
            return ""
        return (
            f"the principal point ({across:.4g}, {down:.4g}) is far from the middle of the {width} x {height} pixels: "
            "unless it was cut so, give dataset.intrinsics=[fx,fy,cx,cy] of an image of this size"
        )

    def _fit_to_sphere(
        self, depth: Float[Tensor, "n n"], measured: Bool[np.ndarray, "n n"], intrinsics: Float[Tensor, "3 3"]
    ) -> tuple[Float[np.ndarray, "4 4"], Camera]:
        """The map from the scene to the file's world, and the camera in the scene.

        Args:
            depth: in units of the file's world.
            measured: true at the object's pixels that have a depth.
            intrinsics: of these pixels.
        """
        to_world = np.eye(4)
        if self.camera_to_world is None:
            eye = torch.tensor([0.0, sin(radians(DEFAULT_PITCH_DEGREES)), cos(radians(DEFAULT_PITCH_DEGREES))])
            to_world[:3, :3] = look_at(eye, torch.zeros(3))[:3, :3].numpy()
        camera = Camera(intrinsics, self.camera.world_to_camera, *measured.shape)
        points = camera.rays().at(camera.distance(depth)).numpy()[measured] @ to_world[:3, :3]
        low, high = np.quantile(points, [OUTLIER_FRACTION, 1 - OUTLIER_FRACTION], axis=0)
        centre = (low + high) / 2
        to_world[:3, 3] = to_world[:3, :3] @ centre
        to_world[:3, :3] *= np.quantile(np.linalg.norm(points - centre, axis=1), 1 - OUTLIER_FRACTION) / OBJECT_RADIUS
        return to_world, camera_in_world(camera, to_world)


def _read_depths(path: Path) -> Float[np.ndarray, "h w"]:
    """The numbers of a file of depths, 0 at pixels without depth."""
    suffix = path.suffix.lower()
    if suffix == ".png":
        with open_image(path) as image:
            depths = np.asarray(image, np.float64)
    elif suffix in (".npy", ".npz"):
        try:
            with path.open("rb") as file:
                loaded = np.load(file)
                name = None if suffix == ".npy" else "depth" if "depth" in loaded else loaded.files[0]
                depths = np.asarray(loaded if name is None else loaded[name], np.float64)
        except (OSError, EOFError, TypeError, ValueError, IndexError, BadZipFile) as error:
            raise BadInput(f"{path} cannot be read as depths ({error}): save one array [height, width]") from None
    else:
        depths = read_depth_file(path, "save them as .npy")
    if depths.squeeze().ndim != 2:
        raise BadInput(f"{path} must hold one number for a pixel, not an array of shape {list(depths.shape)}")
    return np.where(np.isfinite(depths) & (depths > 0), depths, 0.0).squeeze()


def _crop_and_subsample(
    depth: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"], intrinsics: Float[np.ndarray, "3 3"], largest: int
) -> tuple[Float[np.ndarray, "n n"], Bool[np.ndarray, "n n"], Float[np.ndarray, "3 3"]]:
    """Cuts depth and mask to a square about the object of at most `largest` pixels per side, and moves the intrinsics.

    Depths are not averaged, since a mean across an outline lies on neither side.
    """
    if not mask.any():
        raise BadInput("the depth image shows no object: its mask is empty, or it has no depth above 0")
    rows, columns = np.nonzero(mask)
    low, high = np.array([rows.min(), columns.min()]), np.array([rows.max(), columns.max()]) + 1
    side = int(np.ceil((high - low).max() * (1 + 2 * MARGIN_FRACTION)))
    stride = -(-side // largest)
    count = -(-side // stride)
    before = (count * stride - (high - low)) // 2
    padding = list(zip(before, count * stride - (high - low) - before, strict=True))
    step = slice(stride // 2, None, stride)
    depth, mask = (np.pad(pixels[low[0] : high[0], low[1] : high[1]], padding)[step, step] for pixels in (depth, mask))
    cropped = intrinsics.copy()
    cropped[:2, 2] -= (low - before + stride // 2)[::-1] + 0.5
    cropped[:2] /= stride
    cropped[:2, 2] += 0.5
    return depth, mask, cropped
