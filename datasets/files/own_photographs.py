"""The user's photographs as a dataset: one object, moved into the unit sphere, of unknown true shape."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from datasets.files.captures.frames import AXES, Frame, Layout, nearest_rigid_matrix, rigid_matrix
from datasets.files.captures.hull import MaskFit, measure_mask_fit
from datasets.files.captures.layouts import find_layout
from datasets.files.captures.mistakes import focal_doubt, intrinsics_fault, likely_mistake
from datasets.files.captures.sphere import Sphere, UnfitCameras, hull_sphere, in_world, likely_cause, viewed_sphere
from datasets.files.captures.take import exif_notes, read_shots
from datasets.mesh import Mesh
from datasets.scene import Split
from datasets.shot import Shot
from renderers.checks import BadInput, check_at_least, check_choice

MIN_PHOTOS = 3
GOOD_OVERLAP, WARN_BELOW, REFUSE_BELOW = 0.9, 0.8, 0.5  # overlap of hull and masks, or visible fraction of the hull
PHOTOS_HINT = "python -m bench.photos shows it"
MISTAKE_PIXELS = 96  # maximum along the longer side of photographs in which mistakes are searched
GENERIC_HINT = "Check the order of the images, and that masks are white on the object"
SAME_POSITION_TOLERANCE = 1e-9  # relative to the coordinates of the cameras


@dataclass(frozen=True)
class Capture:
    """Photographs of one object, which lies in the unit sphere.

    Args:
        masks: the source of the masks, in words; empty without masks.
        sphere_source: how the unit sphere was found, in words.
        to_world: the similarity from the world of the unit sphere to the file's world.
        notes: how files were paired, if not by equal names; what was left out, changed, or is doubtful.
        fit: of cameras and masks; None without masks.
    """

    format: str
    shots: tuple[Shot, ...]
    masks: str
    sphere_source: str
    to_world: Float[np.ndarray, "4 4"]
    notes: tuple[str, ...]
    fit: MaskFit | None

    @property
    def sphere(self) -> Sphere:
        return Sphere(self.to_world[:3, 3], float(np.linalg.norm(self.to_world[:3, 0])), self.sphere_source)

    @property
    def summary(self) -> str:
        """The photographs, masks and unit sphere in one sentence."""
        sizes = sorted({(shot.camera.width, shot.camera.height) for shot in self.shots})
        pixels = " and ".join(f"{width} x {height}" for width, height in sizes)
        masks = f"masks from {self.masks}" if self.masks else "no masks"
        centre = ", ".join(str(float(value)) for value in self.sphere.centre)  # all digits, since it may be far away
        return (
            f"{self.format}: {len(self.shots)} photographs of {pixels} pixels, {masks}; the unit sphere has its centre "
            f"at ({centre}) and radius {self.sphere.radius}, {self.sphere_source}"
        )


@dataclass(frozen=True)
class OwnPhotographs:
    """Photographs of one object with their cameras, in a folder; see `datasets/README.md` for the formats.

    Args:
        path: the folder with the photographs and their cameras.
        masks: False ignores masks.
        axes: "stated", as in the format, or "flipped": y and z of each camera are reversed.
        images: the folder of COLMAP's images; None for the usual folders in `path`.
        unchecked: use photographs and a truth although cameras hardly fit masks, sizes or the truth.
        truth: a mesh or a cloud of points in the cameras' world, or DTU's folder; None without ground truth.
        scan: number of the scan of DTU's folder; None takes the number at the end of the photographs' folder.
    """

    path: str
    masks: bool
    axes: str
    images: str | None
    unchecked: bool
    truth: str | None = None
    scan: int | None = None

    def __post_init__(self) -> None:
        check_choice("dataset.axes", self.axes, tuple(AXES))
        if not Path(self.path).is_dir():
            raise ValueError(f"dataset.path={self.path} is no folder: give the folder that has the photographs")
        if self.truth is not None and not Path(self.truth).exists():
            raise ValueError(
                f"dataset.truth={self.truth} is not there: give a mesh, a folder of its pieces, a cloud of "
                "points, or DTU's folder"
            )

    @property
    def dtu_scan(self) -> int | None:
        """The number of the scan of DTU whose folder is the truth; None for another truth.

        Raises:
            BadInput: neither `scan` nor the folder's name states the number.
        """
        if self.truth is None or not Path(self.truth, "Points").is_dir():
            return None
        return scan_number(self.name) if self.scan is None else self.scan

    @property
    def name(self) -> str:
        return Path(self.path).resolve().name

    def capture(self, longest: int, held_out: int) -> Capture:
        settings = ReadSettings(longest, self.masks, self.axes, held_out, self.images, self.unchecked)
        return read_capture(Path(self.path), settings)

    def mesh(self, split: Split, index: int) -> Mesh:
        """Raises BadInput: photographs have no true shape."""
        raise BadInput("photographs have no true shape: set task=reconstruction, task=multiview or another dataset")

    def identity(self) -> dict[str, Any]:
        """The folder; runs are distinguished by the contents of its files."""
        more = {} if self.images is None else {"images": self.images}
        return {"name": "photos", "path": self.path, "masks": self.masks, "axes": self.axes} | more


def scan_number(name: str) -> int:
    """The number of a scan of DTU at the end of a name, as in `dtu_scan65`.

    Raises:
        BadInput: the name has no number.
    """
    match = re.search(r"(\d+)\D*$", name)
    if match is None:
        raise BadInput(f"'{name}' does not end in the number of a scan of DTU: set dataset.scan=65, or --scan 65")
    return int(match[1])


@dataclass(frozen=True)
class ReadSettings:
    """Settings of reading photographs; see `OwnPhotographs` for `axes` and `images`.

    Args:
        longest: maximum number of pixels of a photograph's longer side; larger photographs are downscaled.
        masks: whether masks are used if there are any.
        held_out: every `held_out`-th photograph, from the first on, is not used to find the sphere; None: all are used.
        unchecked: use photographs that hardly fit, with a note.
    """

    longest: int
    masks: bool = True
    axes: str = "stated"
    held_out: int | None = None
    images: str | None = None
    unchecked: bool = False

    def __post_init__(self) -> None:
        check_at_least("longest", self.longest, 8, "96 shows what there is")
        if self.held_out is not None:
            check_at_least("held_out", self.held_out, 2, "8 holds out an eighth")


def read_capture(folder: Path, settings: ReadSettings) -> Capture:
    """Reads the photographs of a folder, in one of the formats of `formats`.

    Raises:
        BadInput: something is missing, or cameras and masks do not fit.
    """
    layout = find_layout(folder, settings.images, masks=settings.masks)
    if len(layout.frames) < MIN_PHOTOS:
        count = f"{len(layout.frames)} photograph{'s' if len(layout.frames) > 1 else ''} with cameras"
        raise BadInput(f"{folder} has {count}: {MIN_PHOTOS} or more are needed")
    try:
        capture, doubts = _check_fit(_capture(layout, settings), layout, settings)
    except UnfitCameras as error:
        cause = _cause(layout, settings) or layout.doubt
        raise BadInput(f"{folder}: {cause}. As it is, {error}" if cause else f"{error}. {GENERIC_HINT}") from None
    if doubts and not settings.unchecked:
        raise BadInput(f"{folder}: {'; '.join(doubts)}; or set dataset.unchecked=true")
    return replace(capture, notes=(*capture.notes, *doubts))


def _capture(layout: Layout, settings: ReadSettings) -> Capture:
    """The photographs of a layout, with their fit."""
    frames, origin = _centre(layout.frames, AXES[settings.axes])
    shots, depth_notes = read_shots(frames, settings.longest)
    masked = settings.masks and _all_masked(shots)
    shots = shots if masked else [replace(shot, mask=None, covered=None) for shot in shots]
    used = [i for i in range(len(shots)) if settings.held_out is None or i % settings.held_out]
    exif = exif_notes(frames)
    try:
        sphere = _sphere(layout, origin, [shots[i] for i in used], [frames[i].depth_range for i in used])
    except UnfitCameras as error:
        raise UnfitCameras("; ".join([str(error), *exif])) from None
    largest = max(max(shot.camera.height, shot.camera.width) for shot in shots)
    longest = settings.longest
    size_note = (f"the photographs have at most {largest} pixels per side, not {longest}",) if largest < longest else ()
    source = "files" if frames[0].mask is not None else "the alpha channel"
    to_world = np.diag([*[sphere.radius] * 3, 1.0])
    to_world[:3, 3] = sphere.centre
    unit_shots = tuple(in_world(shot, to_world) for shot in shots)
    to_world[:3, 3] += origin
    return Capture(
        layout.format,
        unit_shots,
        source if masked else "",
        sphere.source,
        layout.world @ to_world,
        (*layout.notes, *exif, *depth_notes, *size_note),
        measure_mask_fit(unit_shots) if masked else None,
    )


def _centre(frames: Sequence[Frame], axes: Float[np.ndarray, "4 4"]) -> tuple[list[Frame], Float[np.ndarray, "3"]]:
    """Frames with the origin moved to the mean camera position, and that position; far coordinates would lose digits.

    Raises:
        UnfitCameras: all cameras are at one position.
    """
    poses = [axes @ nearest_rigid_matrix(frame.world_to_camera) for frame in frames]
    positions = -np.stack([np.linalg.solve(pose[:3, :3], pose[:3, 3]) for pose in poses])
    origin = positions.mean(axis=0)
    if np.abs(positions - origin).max() <= SAME_POSITION_TOLERANCE * np.abs(origin).max():
        raise UnfitCameras(
            f"all {len(frames)} cameras, of {frames[0].image.name} to {frames[-1].image.name}, are at one place, "
            f"({', '.join(f'{value:.6g}' for value in origin)}): photographs from several places are needed; check the "
            "translations in the file of cameras, or store the inverse poses"
        )
    shift = rigid_matrix(np.eye(3), origin)
    shifted = [replace(frame, world_to_camera=pose @ shift) for frame, pose in zip(frames, poses, strict=True)]
    return shifted, origin


def _all_masked(shots: Sequence[Shot]) -> bool:
    """Whether photographs have masks; raises BadInput if only some have masks, or a mask is empty."""
    lacking = [shot.name for shot in shots if shot.mask is None]
    if 0 < len(lacking) < len(shots):
        raise BadInput(f"{lacking[0]} has no mask, and others have one: add it, or use no masks")
    if blank := [shot.name for shot in shots if shot.mask is not None and not bool(shot.mask.any())]:
        raise BadInput(f"the mask of {blank[0]} is empty: remove the image, or use no masks")
    if not lacking and all(bool(shot.mask.all()) for shot in shots if shot.mask is not None):
        raise BadInput("the masks are white everywhere, and say nothing of the object: give others, or use no masks")
    return not lacking


def _sphere(
    layout: Layout, origin: Float[np.ndarray, "3"], shots: Sequence[Shot], ranges: Sequence[tuple[float, float] | None]
) -> Sphere:
    """The sphere that the format states, else about the masks' hull, the reconstructed points, or the viewed point."""
    if layout.sphere:
        centre, radius = layout.sphere
        return Sphere(centre - origin, radius, "as the format states")
    if all(shot.mask is not None for shot in shots):
        return hull_sphere(shots, viewed_sphere(shots, ranges))
    if layout.points_sphere:
        centre, radius = layout.points_sphere
        return Sphere(centre - origin, radius, "about most of the reconstructed points")
    return viewed_sphere(shots, ranges)


def _check_fit(capture: Capture, layout: Layout, settings: ReadSettings) -> tuple[Capture, list[str]]:
    """A capture with notes on doubtful fits, and the messages on fits that are refused."""
    fit = capture.fit
    if fit is None:
        has_no_size = None in [frame.size for frame in layout.frames]
        fault = intrinsics_fault(layout.frames[0])
        doubt = fault.text if fault else has_no_size and likely_cause(capture.shots)
        return replace(capture, notes=(*capture.notes, *filter(None, [layout.doubt]))), [doubt] if doubt else []
    overlap, shown = float(np.median(fit.overlaps)), float(np.median(fit.shown))
    text = f"the visual hull of the masks overlaps with them by {overlap:.0%} (median)"
    if overlap < WARN_BELOW and (cause := _cause(layout, settings)):
        return capture, [f"{cause}. As it is, {text}"]
    fractions_by_text = {
        f"{text}: cameras may be those of other images; {PHOTOS_HINT}": overlap,
        f"the photographs show {shown:.0%} of the object (median): cameras may look elsewhere, or the focal length "
        "is another": shown,
    }
    notes = [text for text, fraction in fractions_by_text.items() if REFUSE_BELOW <= fraction < WARN_BELOW]
    refused = [text for text, fraction in fractions_by_text.items() if fraction < REFUSE_BELOW]
    doubts = [layout.doubt if overlap < GOOD_OVERLAP else "", focal_doubt(capture.shots)]
    (refused or notes)[:0] = filter(None, doubts)
    return replace(capture, notes=(*capture.notes, *notes)), refused


def _cause(layout: Layout, settings: ReadSettings) -> str:
    """The likely cause why cameras do not fit, with the remedy; "" if it is unknown."""
    fault = intrinsics_fault(layout.frames[0])
    scale = float(np.linalg.norm(layout.world[:3, 0]))
    resize, to_world = np.diag([scale, scale, scale, 1.0]), np.linalg.inv(layout.world)
    frames = [
        replace(frame, world_to_camera=resize @ AXES[settings.axes] @ frame.world_to_camera @ to_world)
        for frame in layout.frames
    ]
    shots, _ = read_shots(frames, MISTAKE_PIXELS)
    if not settings.masks or any(shot.mask is None or not bool(shot.mask.any()) for shot in shots):
        return fault.text if fault else ""
    cause = "" if fault else likely_cause(shots)
    return cause or likely_mistake(shots, frames, settings.axes) or (fault.text if fault else "")
