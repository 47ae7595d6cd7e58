"""The usual mistakes in files of cameras: each is undone, and the one whose cameras then fit the masks is named."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from datasets.files.captures.frames import AXES, OPENGL, PIXEL_CENTRE, Frame
from datasets.files.captures.hull import MIN_VIEW_FRACTION
from datasets.files.captures.image import image_size
from datasets.files.captures.pairing import natural_key
from datasets.files.captures.sphere import PARALLEL_SPREAD, nearest_to_lines
from datasets.shot import Shot

MIN_FIT, MIN_GAIN = 0.9, 0.1  # a correction must fit so well, and so much better than the stated cameras
TIE_TOLERANCE = 0.02  # if fits differ by less, the first correction counts
MAX_VIEWS, RAYS_PER_VIEW, SAMPLES_PER_RAY = 16, 48, 48
OTHER_FOCALS = np.geomspace(0.4, 2.5, 9)[[0, 1, 2, 3, 5, 6, 7, 8]]  # divided by the stated focal length
# With right cameras, masks of made scenes and three real captures gain at most 0.005 by another focal length.
MIN_FOCAL_GAIN, FOCAL_RAYS_PER_VIEW = 0.04, 192
SEARCH_RADIUS_FACTOR = 1.5  # the searched radius divided by the radius of the masks' cones
MAX_BEHIND_FRACTION = 0.25  # if more cameras look away from the object, they do not fit
IMPOSSIBLE_FOCAL_TO_WIDTH, SHORT_FOCAL_TO_WIDTH = 0.05, 0.3  # shorter focal lengths are wrong, or are doubtful
MAX_FOCAL_SHARE, MAX_CENTRE_SHARE = 10.0, 1.5  # larger numbers are no shares of an image; half a pixel may be added
FOCAL_TO_WIDTH = np.geomspace(0.4, 6.4, 26)
MAX_CENTRE_OFFSET = 0.25  # from a principal point to the middle, relative to the image's sides
ROLLED = np.diag([-1.0, -1.0, 1.0, 1.0])  # turns a camera by 180 degrees about its optical axis
CENTRES = "rotations and translations are not of the same matrix: in [R | t], t is -R times the camera's position"
TRANSPOSED = "the rotations are transposed, and the translations are right: transpose the rotations"


@dataclass(frozen=True)
class Views:
    """The cameras and masks of photographs."""

    intrinsics: Float[np.ndarray, "n 3 3"]
    world_to_camera: Float[np.ndarray, "n 4 4"]
    masks: tuple[Bool[np.ndarray, "_ _"], ...]


class IntrinsicsFault(NamedTuple):
    """Why intrinsics are no pixels of their image, with the remedy: as they seem, and if they are no shares either."""

    text: str
    text_without_shares: str


def intrinsics_fault(frame: Frame, min_focal_to_width: float = IMPOSSIBLE_FOCAL_TO_WIDTH) -> IntrinsicsFault | None:
    """What intrinsics are, if they cannot be pixels of the image; None for others."""
    (fx, _, cx), (_, fy, cy), _ = frame.intrinsics
    height, width = frame.size or image_size(frame.image)[::-1]
    if min(fx / width, fy / height) >= min_focal_to_width:
        return None
    if np.allclose((fx, fy), 1) and max(cx, cy) <= MAX_CENTRE_SHARE:
        text = "the focal length is 1 pixel, as without intrinsics: write K @ [R | t], not [R | t]"
        return IntrinsicsFault(text, text)
    if max(fx, fy) < MAX_FOCAL_SHARE and max(cx, cy) <= MAX_CENTRE_SHARE:
        text = f"the intrinsics (fx={fx:.4g}, fy={fy:.4g}, cx={cx:.4g}, cy={cy:.4g}) are no pixels"
        shares = f"but shares of the image: multiply fx and cx by {width}, fy and cy by {height}"
        return IntrinsicsFault(f"{text}, {shares}", f"{text}, and no shares of its sides: store pixels")
    text = f"the focal length ({fx:.4g}) is short for {width} pixels, as one in millimetres: multiply it by {width} / "
    return IntrinsicsFault(f"{text}the sensor's width", f"{text}the sensor's width")


def likely_mistake(shots: Sequence[Shot], frames: Sequence[Frame], axes: str) -> str:
    """The mistake whose correction makes cameras fit masks, with the remedy; "" if there is none.

    Args:
        shots: with masks, and with cameras in the world of their file.
        frames: the files of the photographs.
        axes: of the cameras, as in `AXES`.
    """
    views = _views(shots)
    fault = intrinsics_fault(frames[0], SHORT_FOCAL_TO_WIDTH)
    corrections = [*_intrinsics_corrections(views, frames, fault), *_pose_corrections(views, axes), *_mirrored(views)]
    corrections += [*_turned(views), *_order_corrections(views, [shot.name for shot in shots])]
    fits = [(text, hull_fit(corrected)) for text, corrected in corrections]
    best = max(fit for _, fit in fits)
    if best < max(MIN_FIT, hull_fit(views) + MIN_GAIN):
        return ""
    text, fit = next((text, fit) for text, fit in fits if fit >= best - TIE_TOLERANCE)
    return f"{text}. Then hull and masks fit by {fit:.0%}"


def focal_doubt(shots: Sequence[Shot]) -> str:
    """A doubt about the stated focal length, if masks fit clearly better with another one; "" if not.

    The masks of a sphere, of few views and of distant cameras fit with any focal length.
    """
    views = _views(shots)
    stated, fits = hull_fit(views, FOCAL_RAYS_PER_VIEW), []
    for factor in OTHER_FOCALS:
        scaled = replace(views, intrinsics=views.intrinsics * [[factor, 1, 1], [1, factor, 1], [1, 1, 1]])
        fits.append(hull_fit(scaled, FOCAL_RAYS_PER_VIEW))
    if max(fits) < max(MIN_FIT, stated + MIN_FOCAL_GAIN):
        return ""
    return (
        f"the focal length may be wrong: with {OTHER_FOCALS[np.argmax(fits)]:.1f} times it, {max(fits):.0%} of mask "
        f"pixels see the hull, and {stated:.0%} as it is. Check that it is in pixels of these images"
    )


def _views(shots: Sequence[Shot]) -> Views:
    return Views(
        np.stack([shot.camera.intrinsics.double().numpy() for shot in shots]),
        np.stack([shot.camera.world_to_camera.double().numpy() for shot in shots]),
        tuple(np.asarray(shot.mask) for shot in shots),
    )


def hull_fit(views: Views, rays_per_view: int = RAYS_PER_VIEW) -> float:
    """The fraction of a mask's pixels that see the visual hull of all masks, as a median over at most `MAX_VIEWS`.

    The hull is sampled along rays about the point that all masks surround. Cameras that look away from it, or in
    parallel, do not fit: without parallax, all poses would.
    """
    chosen = np.unique(np.linspace(0, len(views.masks) - 1, MAX_VIEWS).round().astype(int))
    intrinsics, motions = views.intrinsics[chosen], views.world_to_camera[chosen]
    masks = [views.masks[i] for i in chosen]
    origins = -np.einsum("nji,nj->ni", motions[:, :3, :3], motions[:, :3, 3])
    rays = np.stack([_mask_rays(*view, rays_per_view) for view in zip(intrinsics, motions, masks, strict=True)])
    middles = rays.mean(axis=1)
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    centre, spread = nearest_to_lines(origins, middles)
    distances = ((centre - origins) * middles).sum(axis=1)
    if np.mean(distances <= 0) > MAX_BEHIND_FRACTION or spread < PARALLEL_SPREAD:
        return 0.0
    cosines = np.einsum("nri,ni->nr", rays, middles).min(axis=1).clip(1e-3, 1)
    radius = SEARCH_RADIUS_FACTOR * np.median(distances * np.sqrt(1 / cosines**2 - 1))
    along = (distances[:, None] + np.linspace(-radius, radius, SAMPLES_PER_RAY)).clip(min=0)
    points = origins[:, None, None] + rays[:, :, None] * along[:, None, :, None]
    inside, views_of_point = np.ones(points.shape[:-1], dtype=bool), np.zeros(points.shape[:-1])
    for matrix, motion, mask in zip(intrinsics, motions, masks, strict=True):
        in_mask, is_shown = _in_mask(points[inside] @ motion[:3, :3].T + motion[:3, 3], matrix, mask)
        views_of_point[inside] += is_shown
        inside[inside] = in_mask
    inside &= views_of_point >= MIN_VIEW_FRACTION * len(masks)
    return float(np.median(inside.any(axis=-1).mean(axis=-1)))


def _mask_rays(
    intrinsics: Float[np.ndarray, "3 3"],
    motion: Float[np.ndarray, "4 4"],
    mask: Bool[np.ndarray, "height width"],
    count: int,
) -> Float[np.ndarray, "rays 3"]:
    """Unit directions through evenly spaced pixels of a mask, in world axes."""
    rows, columns = np.nonzero(mask)
    chosen = np.linspace(0, len(rows) - 1, count).round().astype(int)
    pixels = np.stack([columns[chosen] + 0.5, rows[chosen] + 0.5, np.ones(count)])
    directions = np.linalg.solve(intrinsics, pixels).T @ motion[:3, :3]
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _in_mask(
    points: Float[np.ndarray, "n 3"], intrinsics: Float[np.ndarray, "3 3"], mask: Bool[np.ndarray, "height width"]
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Whether points in camera axes are on a mask or ahead and outside of its image, and whether the image has them."""
    projected = points @ intrinsics.T
    is_ahead = projected[:, 2] > 0
    pixels = np.floor(projected[:, :2] / np.where(is_ahead, projected[:, 2], 1.0)[:, None])
    is_shown = is_ahead & ((pixels >= 0) & (pixels < mask.shape[::-1])).all(axis=1)
    columns, rows = np.where(is_shown[:, None], pixels, 0).astype(int).T
    return is_ahead & (mask[rows, columns] | ~is_shown), is_shown


def _intrinsics_corrections(
    views: Views, frames: Sequence[Frame], fault: IntrinsicsFault | None
) -> Iterator[tuple[str, Views]]:
    """Intrinsics in pixels, instead of those that have a fault, or a principal point in the middle.

    Without a fault, the focal length stays. With a fault, the numbers are shares of the image, or of an unknown unit.
    """
    sizes = np.array([mask.shape[::-1] for mask in views.masks])
    stated, centres = np.stack([frame.intrinsics[:2] for frame in frames]), views.intrinsics[:, :2, 2] / sizes
    if (np.abs(centres - 0.5) > MAX_CENTRE_OFFSET).any():
        centres = np.full_like(centres, 0.5)
    if fault is not None:
        options = [(fault.text, stated[:, [0, 1], [0, 1]], stated[:, :, 2] - shift) for shift in (0, PIXEL_CENTRE)]
        options += [(fault.text_without_shares, ratio * sizes[:, :1] / sizes, centres) for ratio in FOCAL_TO_WIDTH]
    else:
        text = "the principal point is wrong: check that cx and cy are not exchanged; the image's middle fits better"
        options = [(text, views.intrinsics[:, [0, 1], [0, 1]] / sizes, np.full_like(centres, 0.5))]
    for text, focal_shares, centre_shares in options:
        intrinsics = np.tile(np.eye(3), (len(sizes), 1, 1))
        intrinsics[:, [0, 1], [0, 1]], intrinsics[:, :2, 2] = focal_shares * sizes, centre_shares * sizes
        yield text, replace(views, intrinsics=intrinsics)


def _pose_corrections(views: Views, axes: str) -> Iterator[tuple[str, Views]]:
    """Poses instead of the stated ones. Turns of the whole world are left out, since they change no fit."""
    stated, identity = views.world_to_camera, np.eye(4)
    other_axes = next(name for name in AXES if name != axes)
    poses = [(f"the cameras have other axes: set dataset.axes={other_axes}", OPENGL @ stated)]
    inverse = (
        "the poses are inverse (world_to_camera for camera_to_world, or the reverse): store the inverses, with the "
        "other dataset.axes if they need it"
    )
    poses += [(inverse, turn @ np.linalg.inv(stated)) for turn in (identity, OPENGL)]
    rolled = "the cameras are turned by 180 degrees about their viewing direction: reverse their axes x and y"
    poses += [(rolled, turn @ stated) for turn in (ROLLED, OPENGL @ ROLLED)]
    for turn in (identity, OPENGL):  # the camera axes of the file
        rotations, shifts = (turn @ stated)[:, :3, :3], (turn @ stated)[:, :3, 3]
        centres, transposed = -_products(rotations.transpose(0, 2, 1), shifts), rotations.transpose(0, 2, 1)
        poses += [
            (text, turn @ np.block([[changed, translations[..., None]], [np.tile(identity[3:], (len(stated), 1, 1))]]))
            for text, changed, translations in (
                (TRANSPOSED, transposed, shifts), (TRANSPOSED, transposed, -_products(transposed, centres)),
                (CENTRES, rotations, centres), (CENTRES, rotations, -_products(rotations, shifts)),
            )
        ]  # fmt: skip
    return ((text, replace(views, world_to_camera=changed)) for text, changed in poses)


def _products(rotations: Float[np.ndarray, "n 3 3"], vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return np.einsum("nij,nj->ni", rotations, vectors)


def _mirrored(views: Views) -> Iterator[tuple[str, Views]]:
    """Images upside down, or a mirrored world, in each of the axes."""
    text = "the images are upside down, or the world is mirrored (left-handed, as Unity's): mirror one of them"
    mirrored, masks = views.intrinsics.copy(), tuple(mask[::-1] for mask in views.masks)
    mirrored[:, 1, 2] = [len(mask) - row for mask, row in zip(masks, mirrored[:, 1, 2], strict=True)]
    for turn in (np.eye(4), OPENGL, ROLLED, OPENGL @ ROLLED):
        for intrinsics in (views.intrinsics, mirrored):
            yield text, Views(intrinsics, turn @ views.world_to_camera, masks)


def _turned(views: Views) -> Iterator[tuple[str, Views]]:
    """Images turned by 180 degrees: their principal points are mirrored too, unlike those of turned cameras."""
    text = "the images are turned by 180 degrees: turn them back"
    masks = tuple(mask[::-1, ::-1] for mask in views.masks)
    for turn in (np.eye(4), OPENGL):
        yield text, Views(views.intrinsics, turn @ views.world_to_camera, masks)


def _order_corrections(views: Views, names: Sequence[str]) -> Iterator[tuple[str, Views]]:
    """Each camera with the mask of another image."""
    count = len(names)
    by_number = sorted(range(count), key=lambda i: natural_key(names[i]))
    orders = {"cameras follow the numbers in the images' names: give these leading zeros": by_number}
    for word, shift in (("next", -1), ("previous", 1)):
        orders[f"cameras are those of the {word} images: check which image is missing"] = np.roll(range(count), shift)
    for text, order in orders.items():
        yield text, replace(views, masks=tuple(views.masks[i] for i in order))
