"""The user's depth image as a dataset: one object, seen by one camera, of known or unknown true shape."""

from dataclasses import dataclass, replace
from functools import cached_property
from math import cos, radians, sin
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from datasets.files.captures.depth import check_object_depths, missing_note, read_depths
from datasets.files.captures.frames import AXES, Frame, homogeneous_matrix
from datasets.files.captures.mask import is_inverted, load_mask
from datasets.files.captures.sphere import camera_in_world
from datasets.files.coincidence import compare_surfaces, settled
from datasets.files.meshes import load_mesh
from datasets.files.range_scans import join_neighbours
from datasets.mesh import Mesh
from datasets.scene import Scene, Split, Truth, View, see
from datasets.views import look_at
from renderers.camera import Camera
from renderers.checks import BadInput, check_choice, check_positive

OBJECT_RADIUS = 0.75  # scene units, of the visible surface, so that the hidden part also fits the unit sphere
OUTLIER_FRACTION = 0.01  # on each side, such as stray points behind an outline
DEFAULT_PITCH_DEGREES = 25.0  # assumed angle at which a camera without camera_to_world looks down
MARGIN_FRACTION = 0.1  # image margin around the object, relative to the object's extent
MIN_DEPTH_PIXELS = 20
MAX_CENTRE_OFFSET = 0.3  # from the image centre to the principal point, relative to half the image
MIN_FOCAL_TO_SIDE_RATIO = 0.2  # a pinhole camera of this ratio sees 136 degrees
MAX_UP_COMPONENT = 0.09  # upwards, of the camera axis that points down in the image: the sine of 5 degrees
LEVEL_TOLERANCE = 0.005  # vertical part of the axis to the right, for a camera that is level
MIN_VERTICAL_COMPONENT = 0.3  # less: the camera looks straight down or up
MAX_PORTRAIT_COMPONENT = 0.99  # upwards, of the axis to the right; a camera turned to portrait format has more
MATRIX_SYNTAX = "write [fx,fy,cx,cy] or [[fx,0,cx],[0,fy,cy],[0,0,1]], and [4, 4] numbers for a rigid motion"
DEPTH_KINDS = ("z", "ray")
Z_UP_TO_Y_UP = "[[1,0,0,0],[0,0,1,0],[0,-1,0,0],[0,0,0,1]]"


@dataclass(frozen=True)
class DepthImage:
    """One depth image with the camera that took it.

    Args:
        path: a file of depths; see `datasets.files.captures.depth.read_depths`.
        depth: "z" for camera z, or "ray" for the distance along the ray of each pixel.
        intrinsics: fx, fy, cx, cy, or a matrix [3, 3], in pixels; the first pixel's centre is (0.5, 0.5).
        scale: units of the file's world per stored number, such as 0.001 for a PNG in millimetres.
        mask_path: an image of the same size, white on the object; None: all pixels with a depth show the object.
        camera_to_world: matrix [4, 4] into the file's world, whose y points up; x of a camera points right, y down, z
            forward. None: the world's axes are the camera's axes.
        axes: "stated", as above, or "flipped": the camera's y points up and its z backward, as in OpenGL.
        truth: a mesh in the file's world, the ground truth of results; None: the visible surface is the truth.
        unchecked: use a truth that lies elsewhere, with a note.
    """

    path: str
    depth: str
    intrinsics: list[Any]
    scale: float
    mask_path: str | None
    camera_to_world: list[Any] | None
    axes: str
    truth: str | None
    unchecked: bool

    def __post_init__(self) -> None:
        check_positive("dataset.scale", self.scale, "0.001 is of a PNG in millimetres, where the world is in metres")
        for name, path in (("path", self.path), ("mask_path", self.mask_path), ("truth", self.truth)):
            if path is not None and not Path(path).is_file():
                raise ValueError(f"dataset.{name}={path} is no file: check the path")
        check_choice("dataset.depth", self.depth, DEPTH_KINDS)
        check_choice("dataset.axes", self.axes, tuple(AXES))
        self._check_upright()

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
            world_to_camera = AXES[self.axes] @ np.linalg.inv(motion)
            camera = Camera(torch.from_numpy(pinhole), torch.from_numpy(world_to_camera), 1, 1)
            homogeneous_matrix(motion, "camera_to_world")  # this and the next have the checks of photographs
            Frame(Path(self.path), pinhole, world_to_camera)
            return camera
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
        depths = read_depths(Path(self.path))
        mask = self._mask(depths.values)
        check_object_depths(depths.values[mask & (depths.values > 0)], Path(self.path))
        self._check_units_of_intrinsics(*mask.shape)
        notes = (self._principal_point_warning(*mask.shape), *missing_note(depths.missing))
        depth, mask, intrinsics = _crop_and_subsample(
            self.scale * depths.values, mask, self.camera.intrinsics.numpy(), resolution
        )
        measured = (depth > 0) & mask
        if measured.sum() < MIN_DEPTH_PIXELS:
            raise BadInput(
                f"{self.path} has {measured.sum()} depths on the object at view.resolution={resolution}, and "
                f"{MIN_DEPTH_PIXELS} are the fewest: check dataset.mask_path, or raise view.resolution"
            )
        pixel_camera = Camera(torch.from_numpy(intrinsics), self.camera.world_to_camera, *measured.shape)
        if self.depth == "ray":
            depth = pixel_camera.depth(torch.from_numpy(depth)).numpy()
        to_world, camera = self._fit_to_sphere(torch.from_numpy(depth), measured, pixel_camera)
        scene_depth = torch.from_numpy(depth * mask / np.linalg.norm(to_world[:3, 0])).float()
        points = camera.rays().at(camera.distance(scene_depth)).double().numpy()[measured]
        if self.truth is None:
            mesh = join_neighbours(np.argwhere(measured)[:, ::-1] * (1, -1), points)  # faces look at the camera
            truth_note = "judged by what is seen, since there is no dataset.truth"
        else:
            mesh, truth_note = load_mesh(self.truth), f"the true shape is '{self.truth}'"
            visible_points = points @ to_world[:3, :3].T + to_world[:3, 3]
            comparison = compare_surfaces(mesh, visible_points, is_partial=True)
            doubt = (
                f"{comparison.text('dataset.truth', f'what {self.path} shows')}: give both in one world, by "
                "dataset.camera_to_world, dataset.axes and dataset.scale, and check dataset.intrinsics"
            )
            notes += settled(comparison, doubt, unchecked=self.unchecked)
            mesh = mesh.moved(np.linalg.inv(to_world))
        surface = see(Truth(mesh, closed=False), camera)
        view = View(camera, surface.depth, surface.normals, torch.from_numpy(mask))
        mesh = replace(mesh, repairs=(*filter(None, (truth_note, *notes)), *mesh.repairs))
        return Scene(self.name, mesh, view, scene_depth, to_world, is_partial=self.truth is None)

    def _mask(self, depths: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
        """The pixels that show the object."""
        if self.mask_path is None:
            return depths > 0
        mask = load_mask(Path(self.mask_path))
        if mask.shape != depths.shape:
            sizes = " and ".join(f"{width} x {height}" for height, width in (mask.shape, depths.shape))
            raise BadInput(f"{self.mask_path} and {self.path} must have one size, not {sizes} pixels")
        if is_inverted(mask):
            raise BadInput(
                f"dataset.mask_path={self.mask_path} is white along the border, as an inverted mask: make the object "
                "white and the rest black, or leave it out if all depths are the object's"
            )
        return mask

    def _check_upright(self) -> None:
        """Raises ValueError if the world's z points up, or the camera is upside down, as with OpenGL's axes."""
        if self.camera_to_world is None:
            return
        right, down, _ = self.camera.world_to_camera[:3, :3].tolist()
        other_axes = f"dataset.axes={next(name for name in AXES if name != self.axes)}"
        is_tilted = MAX_UP_COMPONENT < abs(right[1]) < MAX_PORTRAIT_COMPONENT
        if is_tilted and abs(right[2]) < LEVEL_TOLERANCE and abs(down[2]) > MIN_VERTICAL_COMPONENT:
            flipped = f", and set {other_axes}" if down[2] > 0 else ""
            raise ValueError(
                "dataset.camera_to_world must be into a world whose y points up, and its camera is level in a world "
                f"whose z points up: give the product {Z_UP_TO_Y_UP} @ camera_to_world{flipped}; turn dataset.truth too"
            )
        if down[1] > MAX_UP_COMPONENT:
            raise ValueError(
                "dataset.camera_to_world holds a camera that is upside down in a world whose y points up: set "
                f"{other_axes} (flipped: camera axes of OpenGL, Blender, nerfstudio and ARKit), or turn the image and "
                "the camera by 180 degrees"
            )

    def _check_units_of_intrinsics(self, height: int, width: int) -> None:
        """Raises BadInput if the intrinsics are no pixels of the image."""
        (fx, _, cx), (_, fy, cy), _ = self.camera.intrinsics.tolist()
        if min(fx / width, fy / height) < MIN_FOCAL_TO_SIDE_RATIO or (0 < cx < 1 and 0 < cy < 1):
            raise BadInput(
                f"dataset.intrinsics must be pixels, not fx={fx:.4g}, fy={fy:.4g}, cx={cx:.4g}, cy={cy:.4g} for "
                f"{width} x {height} pixels: multiply shares of the image by {width} (fx, cx) and {height} (fy, cy), "
                f"or millimetres by {width} / the sensor's width"
            )

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
        self, depth: Float[Tensor, "n n"], measured: Bool[np.ndarray, "n n"], camera: Camera
    ) -> tuple[Float[np.ndarray, "4 4"], Camera]:
        """The map from the scene to the file's world, and the camera in the scene.

        Args:
            depth: in units of the file's world.
            measured: true at the object's pixels that have a depth.
            camera: of these pixels, in the file's world.
        """
        to_world = np.eye(4)
        if self.camera_to_world is None:
            eye = torch.tensor([0.0, sin(radians(DEFAULT_PITCH_DEGREES)), cos(radians(DEFAULT_PITCH_DEGREES))])
            to_world[:3, :3] = AXES[self.axes][:3, :3] @ look_at(eye, torch.zeros(3))[:3, :3].numpy()
        points = camera.rays().at(camera.distance(depth)).numpy()[measured] @ to_world[:3, :3]
        low, high = np.quantile(points, [OUTLIER_FRACTION, 1 - OUTLIER_FRACTION], axis=0)
        centre = (low + high) / 2
        to_world[:3, 3] = to_world[:3, :3] @ centre
        to_world[:3, :3] *= np.quantile(np.linalg.norm(points - centre, axis=1), 1 - OUTLIER_FRACTION) / OBJECT_RADIUS
        return to_world, camera_in_world(camera, to_world)


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
