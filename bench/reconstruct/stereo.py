"""Points that neighbouring photographs agree on (semi-global matching), as a user without a renderer finds them."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import acos, degrees

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from datasets.extras import install_command
from datasets.shot import Shot
from renderers.camera import Camera
from renderers.checks import BadInput, check_at_least, check_positive

LARGER = 4  # times: the rectified images, since disparities in small ones are few pixels
BLOCK = 5  # pixels along each side that are matched
LEAST_DEGREES = 2.0  # between neighbours: nearer ones have no baseline
UNIQUE, SPECKLE, SPECKLE_RANGE = 10, 100, 2  # per cent; pixels; disparities: see OpenCV's StereoSGBM
LEAST_DEPTH = 0.1  # scene units: of a point that is matched
SIXTEENTHS = 16  # of a pixel, in which disparities are given; their number is a multiple of it as well


@dataclass(frozen=True)
class Cloud:
    """Points of a surface, and the camera that saw them."""

    points: Float[np.ndarray, "n 3"]
    camera: Camera


@dataclass(frozen=True)
class Matching:
    """Which photographs are matched.

    Args:
        neighbours: that each photograph is matched with, the nearest by angle.
        most_degrees: largest angle between the view directions of neighbours.
    """

    neighbours: int
    most_degrees: float

    def __post_init__(self) -> None:
        check_at_least("task.matching.neighbours", self.neighbours, 1, "3 leave few holes")
        check_positive("task.matching.most_degrees", self.most_degrees, "40 share most of what they see")


def stereo_clouds(shots: Sequence[Shot], matching: Matching) -> list[Cloud]:
    """The points that each photograph and its neighbours show in the unit sphere and, where there are any, all masks.

    Raises:
        BadInput: where OpenCV is not installed.
    """
    try:
        import cv2  # noqa: F401
    except ImportError:
        raise BadInput(f"task=stereo needs OpenCV: type {install_command('stereo')}") from None
    clouds = [_matched(shot, other) for shot in shots for other in _neighbours(shot, shots, matching)]
    return [Cloud(cloud.points[_within(shots, cloud.points)], cloud.camera) for cloud in clouds]


def _neighbours(shot: Shot, shots: Sequence[Shot], matching: Matching) -> list[Shot]:
    """The photographs at the least angles about the origin."""
    towards = [torch.nn.functional.normalize(one.camera.center.double(), dim=0) for one in (shot, *shots)]
    angles = np.array([degrees(acos(min(max(float(there @ towards[0]), -1), 1))) for there in towards[1:]])
    near = [place for place in np.argsort(angles) if LEAST_DEGREES < angles[place] < matching.most_degrees]
    return [shots[place] for place in near[: matching.neighbours]]


def _matched(shot: Shot, other: Shot) -> Cloud:
    """The points that two photographs show, by OpenCV's semi-global matching.

    Both are turned so that rows of pixels lie along the baseline, and shifted so that the origin is in their middle: a
    point at depth Z then has the disparity f B (1 / Z - 1 / Z0). OpenCV's own rectification leaves the image where
    cameras look at one point from far apart.
    """
    import cv2

    side = LARGER * max(shot.camera.height, shot.camera.width)
    centres = [one.camera.center.double().numpy() for one in (shot, other)]
    baseline = float(np.linalg.norm(centres[1] - centres[0]))
    axes = _axes(centres[1] - centres[0], -(centres[0] + centres[1]))
    focal = LARGER * float(shot.camera.intrinsics[0, 0])
    middle = float(axes[2] @ -centres[0])  # Z0, the origin's depth, in both
    images, columns = [], []
    for one, centre in zip((shot, other), centres, strict=True):
        across, down = focal * (axes[:2] @ -centre) / middle
        projection = np.array([[focal, 0, side / 2 - across], [0, focal, side / 2 - down], [0, 0, 1]])
        images.append(_turned(one, axes, projection, side))
        columns.append(projection)
    scale = focal * baseline
    ends = [scale * (1 / max(depth, LEAST_DEPTH) - 1 / middle) for depth in (middle + 1, middle - 1)]
    low = int(np.floor(ends[0]))
    matcher = cv2.StereoSGBM_create(
        minDisparity=low,
        numDisparities=int(-((low - ends[1]) // SIXTEENTHS)) * SIXTEENTHS,
        blockSize=BLOCK,
        P1=8 * 3 * BLOCK**2,
        P2=32 * 3 * BLOCK**2,
        disp12MaxDiff=1,
        uniquenessRatio=UNIQUE,
        speckleWindowSize=SPECKLE,
        speckleRange=SPECKLE_RANGE,
    )
    disparity = matcher.compute(*images) / SIXTEENTHS
    rows, places = np.nonzero(disparity >= low)
    depth = 1 / (disparity[rows, places] / scale + 1 / middle)
    pixels = np.stack([places, rows, np.ones_like(rows)])
    points = (np.linalg.inv(columns[0]) @ pixels * depth).T @ axes + centres[0]
    places = torch.from_numpy(points).float()
    shown = shot.camera.shows(places) & other.camera.shows(places)  # what is beyond a border was matched with black
    return Cloud(points[shown.numpy()], shot.camera)


def _axes(baseline: Float[np.ndarray, "3"], forward: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Right, down and forward of a camera whose rows lie along a baseline, in world coordinates."""
    right = baseline / np.linalg.norm(baseline)
    forward = forward - (forward @ right) * right
    forward = forward / np.linalg.norm(forward)
    return np.stack([right, np.cross(forward, right), forward])


def _turned(
    shot: Shot, axes: Float[np.ndarray, "3 3"], projection: Float[np.ndarray, "3 3"], side: int
) -> UInt8[np.ndarray, "side side 3"]:
    """A photograph as a camera at its place with other axes sees it."""
    import cv2

    intrinsics = shot.camera.intrinsics.double().numpy().copy()
    intrinsics[:2, 2] -= 0.5  # OpenCV has the first pixel's centre at (0, 0)
    turn = axes @ shot.camera.world_to_camera.double().numpy()[:3, :3].T
    maps = cv2.initUndistortRectifyMap(intrinsics, None, turn, projection, (side, side), cv2.CV_32FC1)
    image = (255 * shot.colours.numpy().clip(0, 1)).astype(np.uint8)
    return cv2.remap(image, *maps, cv2.INTER_LINEAR)


def _within(shots: Sequence[Shot], points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Points in the unit sphere that no mask excludes."""
    places, inside = torch.from_numpy(points).float(), torch.from_numpy(np.linalg.norm(points, axis=1) < 1)
    for shot in shots:
        inside &= shot.allows(places)
    return inside.numpy()
