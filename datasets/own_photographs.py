"""One's own photographs as a dataset: one object, moved into the unit sphere, whose true shape is not known."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from datasets.captures.formats import find_layout
from datasets.captures.frames import OPENGL, Frame, Layout, motion, nearest_motion
from datasets.captures.hull import Fit, fit_of
from datasets.captures.sphere import Sphere, doubt_of, hull_sphere, looked_at
from datasets.captures.take import take, turning_notes
from datasets.mesh import Mesh
from datasets.scene import Split
from datasets.shot import Shot
from renderers.checks import BadInput, check_at_least, check_choice

AXES = {"stated": np.eye(4), "flipped": OPENGL}
FEWEST = 3  # photographs
GOOD, DOUBTFUL, WRONG = 0.9, 0.8, 0.5  # overlap of hull and masks: cameras are right; hardly; photographs are refused
LOOK = "python -m bench.photos shows it"
ONE_PLACE = 1e-9  # most by which places of cameras may differ to be one, as a share of their coordinates


@dataclass(frozen=True)
class Capture:
    """Photographs of one object, which lies in the unit sphere.

    Args:
        format: of the folder.
        shots: the photographs, by name.
        masks: where the masks come from, in words; empty without masks.
        found: how the unit sphere was found, in words.
        to_world: the similarity from the world of the unit sphere into that of the file.
        notes: how files were paired, where that is not plain; what was left out, changed, or is doubtful.
        fit: of cameras and masks; None without masks.
    """

    format: str
    shots: tuple[Shot, ...]
    masks: str
    found: str
    to_world: Float[np.ndarray, "4 4"]
    notes: tuple[str, ...]
    fit: Fit | None

    @property
    def sphere(self) -> Sphere:
        """The unit sphere in the file's world."""
        return Sphere(self.to_world[:3, 3], float(np.linalg.norm(self.to_world[:3, 0])), self.found)

    @property
    def summary(self) -> str:
        """What was found, in one sentence."""
        sizes = sorted({(shot.camera.width, shot.camera.height) for shot in self.shots})
        pixels = " and ".join(f"{width} x {height}" for width, height in sizes)
        masks = f"masks from {self.masks}" if self.masks else "no masks"
        place = ", ".join(str(float(value)) for value in self.sphere.centre)  # all digits: a world may be far away
        return (
            f"{self.format}: {len(self.shots)} photographs of {pixels} pixels, {masks}; the unit sphere has its centre "
            f"at ({place}) and radius {self.sphere.radius}, {self.found}"
        )


@runtime_checkable
class Photographed(Protocol):
    """A dataset of one object that is known from photographs, and perhaps from a file of its surface.

    Args:
        truth: see `OwnPhotographs`, as `dtu_scan`.
    """

    truth: str | None

    @property
    def dtu_scan(self) -> int | None:
        """The number of DTU's scan."""
        ...

    def capture(self, longest: int, held_out: int) -> Capture:
        """The photographs, with at most `longest` pixels along their longer sides.

        Of so many as `held_out`, one has no part in finding the unit sphere.
        """
        ...


@dataclass(frozen=True)
class OwnPhotographs:
    """Photographs of one object with their cameras, in a folder; see `datasets/README.md` for the formats.

    Args:
        path: the folder that has the photographs and their cameras.
        masks: False reads none, as if there were none.
        axes: "stated", as the format has them, or "flipped": y and z of each camera point the other way.
        images: the folder of COLMAP's images; None for the usual ones in `path`.
        unchecked: whether photographs are used although cameras hardly fit masks or sizes.
        truth: a mesh or a cloud of points in the cameras' world, or DTU's folder; None where nothing is known.
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
        """The number of the scan of DTU whose folder is the truth; None where the truth is none of DTU's.

        Raises:
            BadInput: where neither `scan` nor the folder's name says it.
        """
        if self.truth is None or not Path(self.truth, "Points").is_dir():
            return None
        return scan_number(self.name) if self.scan is None else self.scan

    @property
    def name(self) -> str:
        """The folder's name."""
        return Path(self.path).resolve().name

    def capture(self, longest: int, held_out: int) -> Capture:
        """See `Photographed`."""
        reading = Reading(longest, self.masks, self.axes, held_out, self.images, self.unchecked)
        return read_capture(Path(self.path), reading)

    def mesh(self, split: Split, index: int) -> Mesh:
        """Raises BadInput: photographs have no true shape."""
        raise BadInput("photographs have no true shape: set task=reconstruction, task=multiview or another dataset")

    def identity(self) -> dict[str, Any]:
        """The folder; runs are told apart by the contents of its files."""
        more = {} if self.images is None else {"images": self.images}
        return {"name": "photos", "path": self.path, "masks": self.masks, "axes": self.axes} | more


def scan_number(name: str) -> int:
    """The number of a scan of DTU that ends a name, as in `dtu_scan65`.

    Raises:
        BadInput: where there is none.
    """
    found = re.search(r"(\d+)\D*$", name)
    if found is None:
        raise BadInput(f"'{name}' does not end in the number of a scan of DTU: set dataset.scan=65, or --scan 65")
    return int(found[1])


@dataclass(frozen=True)
class Reading:
    """How photographs are read.

    Args:
        longest: most pixels of a photograph's longer side; larger ones are made smaller.
        masks: whether masks are used where there are any.
        axes: "stated", as the format has them, or "flipped": y and z of each camera point the other way.
        held_out: of so many photographs one, from the first on, has no part in finding the sphere; None: all have.
        images: the folder of COLMAP's images; None for the usual ones.
        unchecked: whether what hardly fits is used, with a note.
    """

    longest: int
    masks: bool = True
    axes: str = "stated"
    held_out: int | None = None
    images: str | None = None
    unchecked: bool = False

    def __post_init__(self) -> None:
        check_at_least("longest", self.longest, 8, "128 shows what there is")


def read_capture(folder: Path, reading: Reading) -> Capture:
    """Reads the photographs of a folder, in one of the formats of `formats`.

    Raises:
        BadInput: where something is missing, or cameras and masks do not fit.
    """
    layout = find_layout(folder, reading.images, masks=reading.masks)
    if len(layout.frames) < FEWEST:
        raise BadInput(f"{folder} has {len(layout.frames)} photographs with cameras: {FEWEST} or more are needed")
    capture, doubts = _checked(_capture(layout, reading), layout.frames)
    if doubts and not reading.unchecked:
        raise BadInput(f"{folder}: {'; '.join(doubts)}; or set dataset.unchecked=true")
    return replace(capture, notes=(*capture.notes, *doubts))


def _capture(layout: Layout, reading: Reading) -> Capture:
    """The photographs of a layout, with their fit."""
    frames, middle = _centred(layout.frames, AXES[reading.axes])
    shots = [take(frame, reading.longest) for frame in frames]
    masked = reading.masks and _all_masked(shots)
    shots = shots if masked else [replace(shot, mask=None) for shot in shots]
    every = reading.held_out
    given = [place for place in range(len(shots)) if every is None or place % every]
    turns = turning_notes(frames)
    try:
        sphere = _sphere(layout, middle, [shots[place] for place in given], [frames[place].span for place in given])
    except BadInput as error:
        raise BadInput("; ".join([str(error), *turns])) from None
    largest = max(max(shot.camera.height, shot.camera.width) for shot in shots)
    longest = reading.longest
    whole = (f"the photographs have at most {largest} pixels, not {longest}",) if largest < longest else ()
    source = "files" if frames[0].mask is not None else "the alpha channel"
    to_world = np.diag([*[sphere.radius] * 3, 1.0])
    to_world[:3, 3] = sphere.centre
    within = tuple(shot.within(to_world) for shot in shots)
    to_world[:3, 3] += middle
    return Capture(
        layout.format,
        within,
        source if masked else "",
        sphere.found,
        layout.world @ to_world,
        (*layout.notes, *turns, *whole),
        fit_of(within) if masked else None,
    )


def _centred(frames: Sequence[Frame], axes: Float[np.ndarray, "4 4"]) -> tuple[list[Frame], Float[np.ndarray, "3"]]:
    """Frames with the origin among the cameras, since digits would be lost in a far world; and where that was.

    Raises:
        BadInput: where all cameras are at one place.
    """
    motions = [axes @ nearest_motion(frame.world_to_camera) for frame in frames]
    places = -np.stack([np.linalg.solve(one[:3, :3], one[:3, 3]) for one in motions])
    middle = places.mean(axis=0)
    if np.abs(places - middle).max() <= ONE_PLACE * np.abs(middle).max():
        raise BadInput(
            f"all {len(frames)} cameras, of {frames[0].image.name} to {frames[-1].image.name}, are at one place, "
            f"({', '.join(f'{value:.6g}' for value in middle)}): photographs from several places are needed; check the "
            "translations in the file of cameras"
        )
    shift = motion(np.eye(3), middle)
    moved = [replace(frame, world_to_camera=one @ shift) for frame, one in zip(frames, motions, strict=True)]
    return moved, middle


def _all_masked(shots: Sequence[Shot]) -> bool:
    """Whether photographs have masks; raises BadInput where only some have, or one is empty."""
    lacking = [shot.name for shot in shots if shot.mask is None]
    if 0 < len(lacking) < len(shots):
        raise BadInput(f"{lacking[0]} has no mask, and others have one: add it, or use no masks")
    if blank := [shot.name for shot in shots if shot.mask is not None and not bool(shot.mask.any())]:
        raise BadInput(f"the mask of {blank[0]} is empty: remove the image, or use no masks")
    if not lacking and all(bool(shot.mask.all()) for shot in shots if shot.mask is not None):
        raise BadInput("the masks are white everywhere, and say nothing of the object: give others, or use no masks")
    return not lacking


def _sphere(
    layout: Layout, middle: Float[np.ndarray, "3"], shots: Sequence[Shot], spans: Sequence[tuple[float, float] | None]
) -> Sphere:
    """The sphere that the format states; else about the masks' hull, the reconstructed points, or what is looked at."""
    if layout.sphere:
        centre, radius = layout.sphere
        return Sphere(centre - middle, radius, "as the format states")
    if all(shot.mask is not None for shot in shots):
        return hull_sphere(shots, looked_at(shots, spans))
    if layout.points:
        centre, radius = layout.points
        return Sphere(centre - middle, radius, "about most of the reconstructed points")
    return looked_at(shots, spans)


def _checked(capture: Capture, frames: Sequence[Frame]) -> tuple[Capture, list[str]]:
    """A capture with notes on what is doubtful, and what is so doubtful that it is refused."""
    fit = capture.fit
    overlap, shown = (float(np.median(one)) for one in ((fit.overlaps, fit.shown) if fit else ([1.0], [1.0])))
    open_to_doubt = overlap < DOUBTFUL if fit else None in [frame.size for frame in frames]
    if open_to_doubt and (doubt := doubt_of(capture.shots)):
        return capture, [doubt]
    told = {
        f"the visual hull of the masks overlaps with them by {overlap:.0%} (median): cameras may be those of other "
        f"images; {LOOK}": overlap,
        f"the photographs show {shown:.0%} of the object (median): cameras may look elsewhere, or the focal length "
        "is another": shown,
    }
    notes = [text for text, share in told.items() if WRONG <= share < DOUBTFUL]
    return replace(capture, notes=(*capture.notes, *notes)), [text for text, share in told.items() if share < WRONG]
