"""Range scans of one object as a dataset: depths that a scanner measured, and the surface made from all of them."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Real
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation
from torch import Tensor

from datasets.files.captures.depth import missing_numbers
from datasets.files.coincidence import DISTANCE, IDENTITY, compare_surfaces, settled
from datasets.files.meshes import load_mesh
from datasets.files.readers.ply import read_ply
from datasets.files.readers.text import wrong_kind_message
from datasets.files.repair import MAX_OUTSIDE_FRACTION, OUTSIDE_DISTANCE, apply, current, mesh_set, meshlab, with_note
from datasets.mesh import Mesh, fit_in_sphere, normalise
from datasets.scene import Split, Truth, sample_surface
from renderers.checks import BadInput, check_fraction

MAX_EDGE_RATIO = 4.0  # to the median edge; a longer edge crosses a gap or an outline
SCANNER_DIRECTION = np.array([0.0, 0.0, 1.0])  # from the object, in the scan's axes (Stanford's repository)
CONF_LINE = "bmesh FILE tx ty tz qx qy qz qw"
POISSON_DEPTH = 9  # octree cells are 1/512 of its box


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

    @cached_property
    def points(self) -> tuple[Float[np.ndarray, "n 3"], int]:
        """The measured points in the scan's axes, and the number of others, such as (0, 0, 0) and not finite ones.

        Raises:
            BadInput: the file is truncated, or has no points.
        """
        try:
            if wrong_kind := wrong_kind_message(self.file):
                raise ValueError(wrong_kind)
            points = read_ply(self.file.read_bytes()).vertices
        except ValueError as error:
            raise BadInput(f"scan '{self.file}' {error}") from None
        missing = missing_numbers(points)
        measured = ~missing.all(axis=1) & (~missing | (points == 0)).all(axis=1)
        if measured.sum() < 3:
            raise BadInput(f"scan '{self.file}' has no points: none of {len(points)} is finite; copy the file again")
        return points[measured], int((~measured).sum())

    @property
    def other_rotations(self) -> dict[str, Rotation]:
        """Rotations that files of another convention may mean, and how the file must then be changed."""
        scalar_last = Rotation.from_quat(np.roll(self.quaternion, -1))
        return {
            "its quaternion is that of the inverse rotation: negate qx, qy and qz": self.rotation.inv(),
            "its quaternion begins with qw: write qx qy qz qw": scalar_last.inv(),
            "its quaternion begins with qw and is that of the inverse rotation": scalar_last,
        }

    def in_world(self, rotation: Rotation) -> Float[np.ndarray, "n 3"]:
        """The measured points in world coordinates, by a rotation in place of the stated one."""
        return rotation.apply(self.points[0]) + self.translation

    def surface(self) -> Mesh:
        """The scan as an open surface in world coordinates; neighbours in the scanner's view are joined.

        Raises: as `points`.
        """
        points, _ = self.points
        return replace(join_neighbours(points[:, :2], points), vertices=self.in_world(self.rotation))


@dataclass(frozen=True)
class RangeScans:
    """Range scans with poses in a `.conf` file, and the mesh that was made from them, as in Stanford's repository.

    Every index is the same object, seen from the scanner of the scan with this index.

    Args:
        path: a folder with the scans, the mesh, and one `.conf` file with lines `bmesh FILE tx ty tz qx qy qz qw`.
        truth: the mesh's file in the folder; None takes the largest `.ply` file that is no scan.
        radius: of the sphere about the origin that contains the mesh.
        unchecked: use scans that do not lie on the mesh, with a note.
    """

    path: str
    truth: str | None
    radius: float
    unchecked: bool = False

    def __post_init__(self) -> None:
        check_fraction("dataset.radius", self.radius, "rays start on the unit sphere; 0.97 leaves a margin")
        if not self.path or not Path(self.path).is_dir():
            raise ValueError(f"dataset.path={self.path} is no folder: give the folder that has the .conf file")
        _ = self.scans, self.reference

    @property
    def name(self) -> str:
        """The folder's name."""
        return Path(self.path).resolve().name

    @cached_property
    def scans(self) -> list[Scan]:
        """The scans that the `.conf` file names, in its order."""
        confs = sorted(Path(self.path).glob("*.conf"))
        if len(confs) != 1:
            raise ValueError(f"dataset.path={self.path} must have one .conf file, the poses of scans, not {len(confs)}")
        text = confs[0].read_text(encoding="utf-8-sig", errors="replace")
        lines = [(number, line.split()) for number, line in enumerate(text.splitlines(), 1)]
        scans = [_scan(confs[0], number, words) for number, words in lines if words and words[0] == "bmesh"]
        if not scans:
            raise ValueError(f"'{confs[0]}' names no scan: it needs lines '{CONF_LINE}'")
        return scans

    @cached_property
    def reference(self) -> Path:
        """The file of the mesh that is the ground truth."""
        if self.truth is not None:
            file = Path(self.path) / self.truth
            if not file.is_file():
                raise ValueError(f"dataset.truth={self.truth} is not in {self.path}: name the mesh's file")
            return file
        scans = {scan.file.name for scan in self.scans}
        others = [file for file in Path(self.path).glob("*.ply") if file.name not in scans]
        if not others:
            raise ValueError(f"dataset.path={self.path} has no mesh beside its scans: add theirs, as .ply")
        return max(others, key=lambda file: file.stat().st_size)

    @cached_property
    def _read(self) -> Mesh:
        mesh = load_mesh(self.reference, close=smooth)
        return replace(mesh, repairs=(f"the true shape is '{self.reference.name}'", *mesh.repairs))

    def mesh(self, split: Split, index: int) -> Mesh:
        """The object, the same for each index; its `repairs` state what was repaired in the file.

        Raises:
            BadInput: no scan has this index, it does not lie on the mesh, or `split` is the training split.
        """
        if split is Split.TRAIN:
            raise BadInput(
                "scans show one object, of which there is no prior: take task=completion field=auto split=test"
            )
        scan, mesh = self._scan(index), normalise(self._read, self.radius)
        _, missing = scan.points
        notes = [f"{missing} points of '{scan.file.name}' are no measurements, and are left out"] if missing else []
        return replace(mesh, repairs=(*mesh.repairs, *notes, *self._pose_notes(scan)))

    def _pose_notes(self, scan: Scan) -> tuple[str, ...]:
        """A note on a scan that does not lie on the mesh; raises BadInput without `unchecked`."""
        thing, reference = f"'{self.reference.name}'", f"scan '{scan.file.name}'"
        comparison = compare_surfaces(self._read, scan.in_world(scan.rotation), is_partial=True)
        doubt = comparison.text(thing, reference)
        if not comparison.coincides:
            for remedy, rotation in scan.other_rotations.items():
                other = compare_surfaces(self._read, scan.in_world(rotation), is_partial=True)
                if other.misfit < min(comparison.changed_misfit, DISTANCE.good):
                    doubt = f"{replace(comparison, change=IDENTITY).text(thing, reference)}, and fits if {remedy}"
        doubt += ": give scans and mesh in one unit, and poses x_world = R^T x + t in the .conf file"
        return settled(comparison, doubt, unchecked=self.unchecked, override="+dataset.unchecked=true")

    def towards_scanner(self, index: int) -> Float[Tensor, "3"]:
        """See `Scanned`."""
        return torch.from_numpy(self._scan(index).rotation.apply(SCANNER_DIRECTION)).float()

    def seen(self, index: int) -> Mesh:
        """See `Scanned`."""
        centre, factor = fit_in_sphere(self._read.used_vertices, self.radius)
        surface = self._scan(index).surface()
        return replace(surface, vertices=(surface.vertices - centre) * factor)

    def identity(self) -> dict[str, Any]:
        """The folder; runs are distinguished by the contents of its files."""
        return {"name": "scans", "path": self.path, "truth": self.truth, "radius": self.radius}

    def _scan(self, index: int) -> Scan:
        if index >= len(self.scans):
            raise BadInput(f"index must be at most {len(self.scans) - 1}, the last scan of {self.name}, not {index}")
        return self.scans[index]


def join_neighbours(image_positions: Real[np.ndarray, "n 2"], points: Float[np.ndarray, "n 3"]) -> Mesh:
    """The open surface that joins points which are neighbours in the image, except over long distances."""
    faces = Delaunay(image_positions).simplices
    corners = points[faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    return Mesh(points, faces[edges.max(axis=1) <= MAX_EDGE_RATIO * np.median(edges)])


def _scan(conf: Path, number: int, words: list[str]) -> Scan:
    """The scan of a line of the `.conf` file.

    Raises:
        ValueError: the line does not describe a scan, or its file is missing.
    """
    try:
        name, numbers = words[1], np.array(words[2:], dtype=np.float64)
    except (ValueError, IndexError):
        name, numbers = "", np.empty(0)
    if len(numbers) != 7 or not np.isfinite(numbers).all() or not numbers[3:].any():
        raise ValueError(f"'{conf}', line {number}, must be '{CONF_LINE}', not '{' '.join(words)}'")
    file = conf.parent / name
    if not file.is_file():
        raise ValueError(f"'{conf}' names '{name}', which is not beside it: copy it there, or take line {number} out")
    return Scan(file, numbers[:3], numbers[3:])


def smooth(mesh: Mesh) -> Mesh | None:
    """The screened Poisson reconstruction of a mesh (Kazhdan and Hoppe 2013), for scans with holes and tangled faces.

    None without PyMeshLab, or if more than `MAX_OUTSIDE_FRACTION` of one surface is farther than
    `OUTSIDE_DISTANCE` from the other. This happens if faces are oriented inconsistently or a hole is wide.
    """
    if meshlab() is None:
        return None
    oriented = apply(mesh, ("meshing_re_orient_faces_coherently", {}))
    meshes = mesh_set(oriented if oriented.volume > 0 else replace(oriented, faces=oriented.faces[:, ::-1]))
    meshes.generate_surface_reconstruction_screened_poisson(depth=POISSON_DEPTH, preclean=True, threads=1)
    smooth_mesh = current(meshes, mesh)
    if not (smooth_mesh.watertight and smooth_mesh.volume > 0):
        return None
    for near, far in ((mesh, smooth_mesh), (smooth_mesh, mesh)):
        points = sample_surface(near, 5000, seed=0).points
        if (Truth(far, closed=False).distance(points) > OUTSIDE_DISTANCE * mesh.diagonal).mean() > MAX_OUTSIDE_FRACTION:
            return None
    return with_note(smooth_mesh, "replaced by its Poisson reconstruction, since its parts do not close into a solid")
