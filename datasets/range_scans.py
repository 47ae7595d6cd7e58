"""Range scans of one object as a dataset: depths that a scanner measured, beside the surface made from all of them."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from datasets.dataset import Split
from datasets.mesh import Mesh, fit_in_sphere, normalise
from datasets.meshes import load_mesh
from renderers.camera import Camera
from renderers.checks import BadInput, check_share

NEAR = 0.25  # pixels, along rows and columns: a point farther from a pixel's centre does not measure its depth
HIDDEN = 0.05  # scene units behind the nearest point of a pixel: a point farther behind belongs to a hidden surface
SCANNER = np.array([0.0, 0.0, 1.0])  # from the object to the scanner, in a scan's own axes (Stanford's repository)
LINE = "bmesh FILE tx ty tz qx qy qz qw"


@runtime_checkable
class Scanned(Protocol):
    """A dataset of one object whose depths were measured from several sides."""

    def towards_scanner(self, index: int) -> Float[Tensor, "3"]:
        """The direction from the object to the scanner of scan number `index`."""
        ...

    def depths(self, index: int, camera: Camera) -> Float[Tensor, "height width"]:
        """The depths of scan number `index` in a camera's image, 0 where there is none."""
        ...


@dataclass(frozen=True)
class Scan:
    """A scan's points and its motion, x_world = R^T x + t with R of a quaternion (x, y, z, w)."""

    file: Path
    translation: Float[np.ndarray, "3"]
    quaternion: Float[np.ndarray, "4"]

    @property
    def rotation(self) -> Rotation:
        """From the scan's axes to the world's."""
        return Rotation.from_quat(self.quaternion).inv()

    def points(self) -> Float[np.ndarray, "n 3"]:
        """Its points in world coordinates.

        Raises:
            BadInput: where the file has none.
        """
        import open3d

        points = np.asarray(open3d.io.read_point_cloud(str(self.file)).points)
        if not len(points) or not np.isfinite(points).all():
            raise BadInput(f"scan '{self.file}' has no points, or some that are not finite: copy the file again")
        return self.rotation.apply(points) + self.translation


@dataclass(frozen=True)
class RangeScans:
    """Range scans with their poses in a `.conf` file, and the mesh that was made from them, as Stanford keeps them.

    Every index is the same object, seen from the scanner of that scan.

    Args:
        path: the folder: one `.conf` file whose lines `bmesh FILE tx ty tz qx qy qz qw` name the scans, these, and the
            mesh, which is the largest other `.ply` file.
        radius: of the sphere about the origin that holds the mesh.
    """

    path: str
    radius: float

    def __post_init__(self) -> None:
        check_share("dataset.radius", self.radius, "rays start on the unit sphere; 0.97 leaves a margin")
        if not Path(self.path).is_dir():
            raise ValueError(f"dataset.path={self.path} is no folder: give the folder that has the .conf file")
        _ = self.scans, self.reference

    @property
    def name(self) -> str:
        """The folder's name."""
        return Path(self.path).resolve().name

    @cached_property
    def scans(self) -> list[Scan]:
        """The scans that the `.conf` file names, in its order."""
        found = sorted(Path(self.path).glob("*.conf"))
        if len(found) != 1:
            raise ValueError(f"dataset.path={self.path} must have one .conf file, the poses of scans, not {len(found)}")
        lines = [(number, line.split()) for number, line in enumerate(found[0].read_text().splitlines(), 1)]
        scans = [_scan(found[0], number, words) for number, words in lines if words and words[0] == "bmesh"]
        if not scans:
            raise ValueError(f"'{found[0]}' names no scan: it needs lines '{LINE}'")
        return scans

    @cached_property
    def reference(self) -> Path:
        """The file of the mesh that stands for the true shape."""
        scans = {scan.file.name for scan in self.scans}
        others = [file for file in Path(self.path).glob("*.ply") if file.name not in scans]
        if not others:
            raise ValueError(f"dataset.path={self.path} has no mesh beside its scans: add theirs, as .ply")
        return max(others, key=lambda file: file.stat().st_size)

    @cached_property
    def _read(self) -> Mesh:
        return load_mesh(self.reference)

    def mesh(self, split: Split, index: int) -> Mesh:
        """The object, whatever the index; its `repairs` say what was repaired in the file.

        Raises:
            BadInput: where there is no scan of that number, or a prior should be trained.
        """
        if split is Split.TRAIN:
            raise BadInput("scans show one object, of which no prior can be trained: set field=auto split=test")
        self._scan(index)
        return normalise(self._read, self.radius)

    def towards_scanner(self, index: int) -> Float[Tensor, "3"]:
        """See `Scanned`."""
        return torch.from_numpy(self._scan(index).rotation.apply(SCANNER)).float()

    def depths(self, index: int, camera: Camera) -> Float[Tensor, "height width"]:
        """See `Scanned`; a pixel has the depth of the point next to its centre."""
        centre, factor = fit_in_sphere(self._read, self.radius)
        points = torch.from_numpy((self._scan(index).points() - centre) * factor).float()
        return nearest_to_pixels(points, camera)

    def identity(self) -> dict[str, Any]:
        """The folder; runs are told apart by the contents of its files."""
        return {"name": "scans", "path": self.path, "radius": self.radius}

    def _scan(self, index: int) -> Scan:
        if index >= len(self.scans):
            raise BadInput(f"index must be at most {len(self.scans) - 1}, the last scan of {self.name}, not {index}")
        return self.scans[index]


def _scan(conf: Path, number: int, words: list[str]) -> Scan:
    """The scan of a line's words.

    Raises:
        ValueError: where they are no scan, or its file is not there.
    """
    try:
        name, numbers = words[1], np.array(words[2:], dtype=np.float64)
    except (ValueError, IndexError):
        name, numbers = "", np.empty(0)
    if len(numbers) != 7 or not np.isfinite(numbers).all() or not numbers[3:].any():
        raise ValueError(f"'{conf}', line {number}, must be '{LINE}', not '{' '.join(words)}'")
    file = conf.parent / name
    if not file.is_file():
        raise ValueError(f"'{conf}' names '{name}', which is not beside it: copy it there, or take line {number} out")
    return Scan(file, numbers[:3], numbers[3:])


def nearest_to_pixels(points: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "height width"]:
    """The camera's depth of the point next to each pixel's centre, 0 where none is within `NEAR`.

    Points farther behind the nearest one of their pixel than `HIDDEN` are left out.
    """
    pixels, depths = (found.numpy() for found in camera.project(points[camera.shows(points)]))
    column, row = np.minimum(pixels.T.astype(int), [[camera.width - 1], [camera.height - 1]])
    place = row * camera.width + column
    front = np.full(camera.height * camera.width, np.inf, dtype=np.float32)
    np.minimum.at(front, place, depths)
    offset = np.abs(pixels % 1 - 0.5).max(axis=1)
    (kept,) = np.nonzero((depths <= front[place] + HIDDEN) & (offset <= NEAR))
    kept = kept[np.lexsort((offset[kept], place[kept]))]
    seen, first = np.unique(place[kept], return_index=True)
    image = np.zeros(camera.height * camera.width, dtype=np.float32)
    image[seen] = depths[kept[first]]
    return torch.from_numpy(image).view(camera.height, camera.width)
