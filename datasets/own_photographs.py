"""A folder of one's own photographs as a dataset: one object, whose true shape is not known."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from datasets.captures.capture import AXES, Capture, read_capture
from datasets.mesh import Mesh
from datasets.scene import Split
from renderers.checks import BadInput, check_choice


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
