"""One's own photographs as a dataset: one object, moved into the unit sphere, whose true shape is not known."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from datasets.captures.formats import OPENGL, find_layout
from datasets.captures.hull import Sphere, sphere_of
from datasets.captures.take import take
from datasets.mesh import Mesh
from datasets.scene import Split
from datasets.shot import Shot
from renderers.checks import BadInput, check_at_least, check_choice

AXES = {"stated": np.eye(4), "flipped": OPENGL}
FEWEST = 3  # photographs


@dataclass(frozen=True)
class Capture:
    """Photographs of one object, which lies in the unit sphere.

    Args:
        format: of the folder.
        shots: the photographs, by name.
        masks: where the masks come from, in words; empty without masks.
        sphere: which part of the file's world became the unit sphere.
        notes: what was left out or changed.
    """

    format: str
    shots: tuple[Shot, ...]
    masks: str
    sphere: Sphere
    notes: tuple[str, ...]

    @property
    def summary(self) -> str:
        """What was found, in one sentence."""
        sizes = sorted({(shot.camera.width, shot.camera.height) for shot in self.shots})
        pixels = " and ".join(f"{width} x {height}" for width, height in sizes)
        masks = f"masks from {self.masks}" if self.masks else "no masks"
        place = ", ".join(f"{value:.3g}" for value in self.sphere.centre)
        return (
            f"{self.format}: {len(self.shots)} photographs of {pixels} pixels, {masks}; the unit sphere has its centre "
            f"at ({place}) and radius {self.sphere.radius:.3g}, {self.sphere.found}"
        )


@runtime_checkable
class Photographed(Protocol):
    """A dataset of one object that is known from photographs alone."""

    def capture(self, longest: int, held_out: int) -> Capture:
        """The photographs, with at most `longest` pixels along their longer sides.

        Of so many as `held_out`, one has no part in finding the unit sphere.
        """
        ...


@dataclass(frozen=True)
class OwnPhotographs:
    """Photographs of one object with their cameras, in a folder; see `datasets/README.md` for the formats.

    Args:
        path: the folder.
        masks: False reads none, as if there were none.
        axes: "stated", as the format has them, or "flipped": y and z of each camera point the other way.
    """

    path: str
    masks: bool
    axes: str

    def __post_init__(self) -> None:
        check_choice("dataset.axes", self.axes, tuple(AXES))
        if not Path(self.path).is_dir():
            raise ValueError(f"dataset.path={self.path} is no folder: give the folder that has the photographs")

    @property
    def name(self) -> str:
        """The folder's name."""
        return Path(self.path).resolve().name

    def capture(self, longest: int, held_out: int) -> Capture:
        """See `Photographed`."""
        return read_capture(Path(self.path), longest=longest, masks=self.masks, axes=self.axes, held_out=held_out)

    def mesh(self, split: Split, index: int) -> Mesh:
        """Raises BadInput: photographs have no true shape."""
        raise BadInput("photographs have no true shape: set task=reconstruction, or another dataset")

    def identity(self) -> dict[str, Any]:
        """The folder; runs are told apart by the contents of its files."""
        return {"name": "photos", "path": self.path, "masks": self.masks, "axes": self.axes}


def read_capture(
    folder: Path, *, longest: int, masks: bool = True, axes: str = "stated", held_out: int | None = None
) -> Capture:
    """Reads the photographs of a folder.

    Args:
        folder: in one of the formats of `formats`.
        longest: most pixels of a photograph's longer side; larger ones are made smaller.
        masks: whether masks are used where there are any.
        axes: "stated", as the format has them, or "flipped": y and z of each camera point the other way.
        held_out: of so many photographs one, from the first on, has no part in finding the sphere; None: all have.

    Raises:
        BadInput: where something is missing, or cameras and masks do not fit.
    """
    check_at_least("longest", longest, 8, "128 shows what there is")
    check_choice("axes", axes, tuple(AXES))
    layout = find_layout(folder)
    if len(layout.frames) < FEWEST:
        raise BadInput(f"{folder} has {len(layout.frames)} photographs with cameras: {FEWEST} or more are needed")
    frames = [replace(frame, world_to_camera=AXES[axes] @ frame.world_to_camera) for frame in layout.frames]
    middle = -np.mean([frame.world_to_camera[:3, :3].T @ frame.world_to_camera[:3, 3] for frame in frames], axis=0)
    moved = np.eye(4)
    moved[:3, 3] = middle  # the origin among the cameras: single precision would round a far world
    frames = [replace(frame, world_to_camera=frame.world_to_camera @ moved) for frame in frames]
    shots = [take(frame, longest) for frame in frames]
    lacking = [shot.name for shot in shots if shot.mask is None]
    if masks and 0 < len(lacking) < len(shots):
        raise BadInput(f"{lacking[0]} has no mask, and others have one: add it, or use no masks")
    masked = masks and not lacking
    shots = shots if masked else [replace(shot, mask=None) for shot in shots]
    if blank := [shot.name for shot in shots if shot.mask is not None and not bool(shot.mask.any())]:
        raise BadInput(f"the mask of {blank[0]} is empty: remove the image, or use no masks")
    given = [shot for place, shot in enumerate(shots) if held_out is None or place % held_out]
    if layout.sphere:
        sphere = Sphere(*layout.sphere, "as the format states")
    else:
        found = sphere_of(given)
        sphere = replace(found, centre=found.centre + middle)
    largest = max(max(shot.camera.height, shot.camera.width) for shot in shots)
    whole = (f"the photographs have at most {largest} pixels, not {longest}",) if largest < longest else ()
    source = "files" if frames[0].mask is not None else "the alpha channel"
    return Capture(
        layout.format,
        tuple(shot.within(sphere.centre - middle, sphere.radius) for shot in shots),
        source if masked else "",
        sphere,
        (*layout.notes, *whole),
    )
