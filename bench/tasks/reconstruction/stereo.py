"""Points on which neighbouring photographs agree (semi-global matching): a baseline without a renderer."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import acos, degrees

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import distance_transform_edt

from datasets.extras import install_command
from datasets.shot import Shot
from renderers.camera import Camera
from renderers.checks import BadInput, check_at_least, check_positive

IMAGE_SCALE = 4  # rectified images are larger by this factor: in small images, disparities are only a few pixels
BLOCK_PIXELS = 5  # side of the matched block
MIN_DEGREES = 2.0  # neighbours at a smaller angle have almost no baseline
UNIQUENESS_PERCENT, SPECKLE_PIXELS, SPECKLE_DISPARITIES = 10, 100, 2  # see OpenCV's StereoSGBM
MIN_DEPTH = 0.1  # scene units
DISPARITIES_PER_PIXEL = 16  # OpenCV's fixed-point unit; numDisparities must also be a multiple of 16


@dataclass(frozen=True)
class Cloud:
    """Points of a surface, and the camera that saw them."""

    points: Float[np.ndarray, "n 3"]
    camera: Camera


@dataclass(frozen=True)
class Matching:
    """The choice of photographs that are matched.

    Args:
        neighbours: number of photographs that each one is matched with, the nearest by angle.
        most_degrees: largest angle between the view directions of neighbours.
    """

    neighbours: int
    most_degrees: float

    def __post_init__(self) -> None:
        check_at_least("task.matching.neighbours", self.neighbours, 1, "3 leave few holes")
        check_positive("task.matching.most_degrees", self.most_degrees, "40 share most of what they see")


def stereo_clouds(shots: Sequence[Shot], matching: Matching) -> list[Cloud]:
    """The matched points of each photograph and its neighbours, inside the unit sphere and all masks, if any.

    Raises:
        BadInput: if OpenCV is not installed.
    """
    try:
        import cv2  # noqa: F401
    except ImportError:
        raise BadInput(f"task=stereo needs OpenCV: type {install_command('stereo')}") from None
    clouds = [_match(shot, other) for shot in shots for other in _neighbours(shot, shots, matching)]
    kept = []
    for cloud in clouds:
        points, inside = torch.from_numpy(cloud.points).float(), np.linalg.norm(cloud.points, axis=1) < 1
        for shot in shots:
            inside &= allowed_by_mask(shot, points).numpy()
        kept.append(Cloud(cloud.points[inside], cloud.camera))
    return kept


def _neighbours(shot: Shot, shots: Sequence[Shot], matching: Matching) -> list[Shot]:
    """The photographs at the smallest angles about the origin."""
    centres = [torch.nn.functional.normalize(s.camera.center.double(), dim=0) for s in (shot, *shots)]
    angles = np.array([degrees(acos(min(max(float(centre @ centres[0]), -1), 1))) for centre in centres[1:]])
    indices = [index for index in np.argsort(angles) if MIN_DEGREES < angles[index] < matching.most_degrees]
    return [shots[index] for index in indices[: matching.neighbours]]


def _match(shot: Shot, other: Shot) -> Cloud:
    """The points visible in two photographs, by OpenCV's semi-global matching.

    Both images are turned so that rows of pixels lie along the baseline, and shifted so that the origin is in their
    middle. A point at depth Z then has the disparity f B (1 / Z - 1 / Z0). OpenCV's own rectification would leave the
    image if distant cameras look at the same point.
    """
    import cv2

    side = IMAGE_SCALE * max(shot.camera.height, shot.camera.width)
    centres = [photograph.camera.center.double().numpy() for photograph in (shot, other)]
    baseline = float(np.linalg.norm(centres[1] - centres[0]))
    axes = _axes(centres[1] - centres[0], -(centres[0] + centres[1]))
    focal = IMAGE_SCALE * float(shot.camera.intrinsics[0, 0])
    middle = float(axes[2] @ -centres[0])  # Z0, the origin's depth, in both images
    images, projections = [], []
    for photograph, centre in zip((shot, other), centres, strict=True):
        across, down = focal * (axes[:2] @ -centre) / middle
        projection = np.array([[focal, 0, side / 2 - across], [0, focal, side / 2 - down], [0, 0, 1]])
        images.append(_rectify(photograph, axes, projection, side))
        projections.append(projection)
    scale = focal * baseline
    disparity_range = [scale * (1 / max(depth, MIN_DEPTH) - 1 / middle) for depth in (middle + 1, middle - 1)]
    lowest = int(np.floor(disparity_range[0]))
    matcher = cv2.StereoSGBM_create(
        minDisparity=lowest,
        numDisparities=int(-((lowest - disparity_range[1]) // DISPARITIES_PER_PIXEL)) * DISPARITIES_PER_PIXEL,
        blockSize=BLOCK_PIXELS,
        P1=8 * 3 * BLOCK_PIXELS**2,
        P2=32 * 3 * BLOCK_PIXELS**2,
        disp12MaxDiff=1,
        uniquenessRatio=UNIQUENESS_PERCENT,
        speckleWindowSize=SPECKLE_PIXELS,
        speckleRange=SPECKLE_DISPARITIES,
    )
    disparity = matcher.compute(*images) / DISPARITIES_PER_PIXEL
    rows, columns = np.nonzero(disparity >= lowest)
    depth = 1 / (disparity[rows, columns] / scale + 1 / middle)
    pixels = np.stack([columns, rows, np.ones_like(rows)])
    points = (np.linalg.inv(projections[0]) @ pixels * depth).T @ axes + centres[0]
    positions = torch.from_numpy(points).float()
    inside = shot.camera.shows(positions) & other.camera.shows(positions)  # outside, pixels were matched with black
    return Cloud(points[inside.numpy()], shot.camera)


def _axes(baseline: Float[np.ndarray, "3"], forward: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The right, down and forward axes of a camera whose rows lie along a baseline, in world coordinates."""
    right = baseline / np.linalg.norm(baseline)
    forward = forward - (forward @ right) * right
    forward = forward / np.linalg.norm(forward)
    return np.stack([right, np.cross(forward, right), forward])


def _rectify(
    shot: Shot, axes: Float[np.ndarray, "3 3"], projection: Float[np.ndarray, "3 3"], side: int
) -> UInt8[np.ndarray, "side side 3"]:
    """The image of a camera at the photograph's centre with other axes."""
    import cv2

    intrinsics = shot.camera.intrinsics.double().numpy().copy()
    intrinsics[:2, 2] -= 0.5  # OpenCV has the first pixel's centre at (0, 0)
    rotation = axes @ shot.camera.world_to_camera.double().numpy()[:3, :3].T
    maps = cv2.initUndistortRectifyMap(intrinsics, None, rotation, projection, (side, side), cv2.CV_32FC1)
    image = (255 * shot.colours.numpy().clip(0, 1)).astype(np.uint8)
    return cv2.remap(image, *maps, cv2.INTER_LINEAR)


def allowed_by_mask(shot: Shot, points: Float[torch.Tensor, "n 3"], margin: float = 0.0) -> Bool[torch.Tensor, " n"]:
    """True for points in world coordinates that are out of view, or at most `margin` pixels outside of the mask."""
    allowed = torch.ones(len(points), dtype=torch.bool)
    if shot.mask is not None:
        points = points.to(shot.camera.intrinsics.dtype)
        shown, (height, width) = shot.camera.shows(points), shot.mask.shape
        columns, rows = shot.camera.project(points[shown])[0].long().unbind(-1)
        mask = distance_transform_edt(~shot.mask.numpy()) <= margin if margin else shot.mask.numpy()
        allowed[shown] = torch.from_numpy(mask)[rows.clamp(max=height - 1), columns.clamp(max=width - 1)]
    return allowed
