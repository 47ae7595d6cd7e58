"""A depth image of one's own as a dataset: one object, seen by one camera, whose true shape may not be known."""

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

from datasets.captures.depth import stored_depths
from datasets.captures.image import opened
from datasets.captures.mask import opened_mask
from datasets.mesh import Mesh
from datasets.meshes import load_mesh
from datasets.range_scans import joined
from datasets.scene import Scene, Split, Truth, View, see
from datasets.shot import camera_within
from datasets.views import look_at
from renderers.camera import Camera
from renderers.checks import BadInput, check_positive

PLACED = 0.75  # scene units: radius of the sphere about what is seen, so that the whole object fits the unit sphere
TRIMMED = 0.01  # share of the points on each side that do not count for it, such as those that fly behind an outline
DOWN = 25.0  # degrees by which a camera of unknown place is taken to look down
MARGIN = 0.1  # share of the object's extent in the image that is shown around it
FEWEST = 20  # pixels with a depth
OFF = 0.3  # of half the image: a principal point that lies farther from its middle is told
APART = 0.15  # scene units: median distance of what is seen from a truth, beyond which it is that of something else
FORMS = "write [fx,fy,cx,cy] or [[fx,0,cx],[0,fy,cy],[0,0,1]], and [4, 4] numbers for a rigid motion"


@dataclass(frozen=True)
class DepthImage:
    """One depth image with the camera that took it.

    Args:
        path: camera z, 0 or not finite where it is not known: an `.npy`; an `.npz` with one array or one that is called
            `depth`; a PNG of 16 bits; or what OpenCV reads, such as an EXR.
        intrinsics: fx, fy, cx, cy, or a matrix [3, 3], in pixels; the first pixel's centre is (0.5, 0.5).
        scale: units of the file's world for a step of the file's numbers, such as 0.001 of a PNG in millimetres.
        mask_path: an image that is white on the object, of the same size; None: the pixels with a depth are the object.
        camera_to_world: matrix [4, 4] into the file's world, whose y points up; x of a camera points right, y down, z
            forward. None: the camera's own axes are the file's world.
        truth: a mesh in the file's world, by which results are judged; None: they are judged by what is seen.
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
        """The file's name, without suffix."""
        return Path(self.path).stem

    @cached_property
    def camera(self) -> Camera:
        """The camera in the file's world, in float64; its size is not that of the image.

        Raises:
            ValueError: where intrinsics or camera_to_world are no such matrices.
        """
        try:
            pinhole = np.array(self.intrinsics, dtype=np.float64)
            if pinhole.shape == (4,):
                fx, fy, cx, cy = pinhole
                pinhole = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
            motion = np.eye(4) if self.camera_to_world is None else np.array(self.camera_to_world, dtype=np.float64)
            return Camera(torch.from_numpy(pinhole), torch.from_numpy(np.linalg.inv(motion)), 1, 1)
        except (TypeError, ValueError, np.linalg.LinAlgError) as error:
            raise ValueError(f"dataset.intrinsics, dataset.camera_to_world: {error}; {FORMS}") from None

    def mesh(self, split: Split, index: int) -> Mesh:
        """Raises BadInput: a depth image shows one object."""
        raise BadInput("a depth image is no set of shapes: set task=completion")

    def identity(self) -> dict[str, Any]:
        """The file; runs are told apart by the contents of its files."""
        return {"name": "depth_image", "path": self.path}

    def placed(self, resolution: int) -> Scene:
        """See `datasets.scene.OneView`.

        Raises:
            BadInput: where a file cannot be read, or shows too little.
        """
        depth = self.scale * _stored(Path(self.path))
        mask = depth > 0 if self.mask_path is None else opened_mask(Path(self.mask_path))
        if mask.shape != depth.shape:
            sizes = " and ".join(f"{width} x {height}" for height, width in (mask.shape, depth.shape))
            raise BadInput(f"{self.mask_path} and {self.path} must have one size, not {sizes} pixels")
        doubt = self._off(*depth.shape)
        depth, mask, intrinsics = _cut_out(depth, mask, self.camera.intrinsics.numpy(), resolution)
        known = (depth > 0) & mask
        if known.sum() < FEWEST:
            raise BadInput(
                f"{self.path} has {known.sum()} depths on the object at view.resolution={resolution}, and {FEWEST} are "
                "the fewest: check dataset.mask_path, or raise view.resolution"
            )
        to_world, camera = self._placed(torch.from_numpy(depth), known, torch.from_numpy(intrinsics))
        measured = torch.from_numpy(depth * mask / np.linalg.norm(to_world[:3, 0])).float()
        points = camera.rays().at(camera.distance(measured)).double().numpy()[known]
        if self.truth is None:
            mesh = joined(np.argwhere(known)[:, ::-1] * (1, -1), points)  # faces look at the camera
            note = "judged by what is seen, since there is no dataset.truth"
        else:
            mesh, note = load_mesh(self.truth).moved(np.linalg.inv(to_world)), f"the true shape is '{self.truth}'"
            apart = float(np.median(Truth(mesh).distance(points)))
            if apart > APART:
                raise BadInput(
                    f"what {self.path} shows lies {apart / PLACED:.2g} of its radius from dataset.truth (median): give "
                    "both in one world, by dataset.camera_to_world and dataset.scale, and check dataset.intrinsics"
                )
        seen = see(Truth(mesh, closed=False), camera)
        view = View(camera, seen.depth, seen.normals, torch.from_numpy(mask))
        mesh = replace(mesh, repairs=(*filter(None, (note, doubt)), *mesh.repairs))
        return Scene(self.name, mesh, view, measured, to_world, is_partial=self.truth is None)

    def _off(self, height: int, width: int) -> str:
        """What is said of a principal point far from the middle of the image; "" of others."""
        across, down = self.camera.intrinsics[:2, 2].tolist()
        if max(abs(2 * across / width - 1), abs(2 * down / height - 1)) <= OFF:
            return ""
        return (
            f"the principal point ({across:.4g}, {down:.4g}) is far from the middle of the {width} x {height} pixels: "
            "unless it was cut so, give dataset.intrinsics=[fx,fy,cx,cy] of an image of this size"
        )

    def _placed(
        self, depth: Float[Tensor, "n n"], known: Bool[np.ndarray, "n n"], intrinsics: Float[Tensor, "3 3"]
    ) -> tuple[Float[np.ndarray, "4 4"], Camera]:
        """The map from the scene to the file's world, and the camera in the scene.

        Args:
            depth: in units of the file's world.
            known: the pixels on the object that have one.
            intrinsics: of these pixels.
        """
        to_world = np.eye(4)
        if self.camera_to_world is None:
            eye = torch.tensor([0.0, sin(radians(DOWN)), cos(radians(DOWN))])
            to_world[:3, :3] = look_at(eye, torch.zeros(3))[:3, :3].numpy()
        camera = Camera(intrinsics, self.camera.world_to_camera, *known.shape)
        points = camera.rays().at(camera.distance(depth)).numpy()[known] @ to_world[:3, :3]
        low, high = np.quantile(points, [TRIMMED, 1 - TRIMMED], axis=0)
        centre = (low + high) / 2
        to_world[:3, 3] = to_world[:3, :3] @ centre
        to_world[:3, :3] *= np.quantile(np.linalg.norm(points - centre, axis=1), 1 - TRIMMED) / PLACED
        return to_world, camera_within(camera, to_world)


def _stored(path: Path) -> Float[np.ndarray, "h w"]:
    """The numbers of a file of depths, 0 where it has none."""
    suffix = path.suffix.lower()
    if suffix == ".png":
        with opened(path) as image:
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
        depths = stored_depths(path, "save them as .npy")
    if depths.squeeze().ndim != 2:
        raise BadInput(f"{path} must hold one number for a pixel, not an array of shape {list(depths.shape)}")
    return np.where(np.isfinite(depths) & (depths > 0), depths, 0.0).squeeze()


def _cut_out(
    depth: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"], intrinsics: Float[np.ndarray, "3 3"], most: int
) -> tuple[Float[np.ndarray, "n n"], Bool[np.ndarray, "n n"], Float[np.ndarray, "3 3"]]:
    """A square of at most `most` pixels about the object, of every so many pixels of the images, and its intrinsics.

    Depths are not averaged, since a mean across an outline lies on neither side.
    """
    if not mask.any():
        raise BadInput("the depth image shows no object: its mask is empty, or it has no depth above 0")
    rows, columns = np.nonzero(mask)
    low, high = np.array([rows.min(), columns.min()]), np.array([rows.max(), columns.max()]) + 1
    side = int(np.ceil((high - low).max() * (1 + 2 * MARGIN)))
    stride = -(-side // most)
    count = -(-side // stride)
    before = (count * stride - (high - low)) // 2
    around = list(zip(before, count * stride - (high - low) - before, strict=True))
    every = slice(stride // 2, None, stride)
    depth, mask = (np.pad(one[low[0] : high[0], low[1] : high[1]], around)[every, every] for one in (depth, mask))
    moved = intrinsics.copy()
    moved[:2, 2] -= (low - before + stride // 2)[::-1] + 0.5
    moved[:2] /= stride
    moved[:2, 2] += 0.5
    return depth, mask, moved
