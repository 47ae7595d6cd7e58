"""DTU's protocol in surface mode (Jensen et al. 2014; Aanaes et al. 2016): a mesh against the points of a scan, in mm.

Constants are those of its MATLAB code, which the Python version in use today (DTUeval-python) shares.
"""

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.io import loadmat
from scipy.io.matlab import MatReadError
from scipy.spatial import cKDTree

from bench.records.metrics import DVR_SCANS, DVR_TABLE2
from datasets.mesh import Mesh
from datasets.meshes import read_points
from datasets.shot import Shot
from renderers.checks import BadInput

DENSITY = 0.2  # mm: the mesh is sampled with a point in each square of this side, then thinned to this distance
CUT = 20.0  # mm: distances of this size and more do not count
MARGIN = 60.0  # mm about the observed volume in which points of the mesh count; twice as much at its far corner
DILATION = 1 / 32  # of an image's longer side, 50 pixels of DTU's 1600: masks are dilated by it before culling (NeuS)
MOST = 300_000_000  # samples of a mesh, before it is thinned
CHUNK = 2_000_000  # samples at a time
FIRST = 4096  # points that are thinned at first
PARENTS = ("", "MVS Data", "SampleSet/MVS Data", "SampleSet/MVS_Data")  # where DTU's archives have their folders
NAMES = ("dtu_accuracy", "dtu_completeness", "dtu_overall")
_DISTANCES = f"distances of {CUT:g} mm and more left out, in mm"
DEFINITIONS = {
    "dtu_accuracy": f"Mean distance from points of the mesh, {DENSITY} mm apart, within the scan's observed volume "
    f"(ObsMask) to the nearest point of the scan, {_DISTANCES}.",
    "dtu_completeness": "Mean distance from the scan's points above its plane to the nearest point of the mesh, "
    f"{_DISTANCES}.",
    "dtu_overall": "Mean of dtu_accuracy and dtu_completeness, the Chamfer distance of tables on DTU, in mm.",
}
WORST = dict.fromkeys(NAMES, inf)


@dataclass(frozen=True)
class DtuScan:
    """What a mesh of a scan is judged by, in the world of DTU's cameras, in mm.

    Args:
        points: of the structured light scanner.
        plane: a, b, c, d of the table; points above it have a x + b y + c z + d > 0.
        observed: cells of a grid that the scanner saw.
        corners: the grid's first cell, and its last.
        spacing: of the grid.
    """

    points: Float[np.ndarray, "n 3"]
    plane: Float[np.ndarray, "4"]
    observed: Bool[np.ndarray, "x y z"]
    corners: Float[np.ndarray, "2 3"]
    spacing: float

    @cached_property
    def tree(self) -> cKDTree:
        """The points, ready to be asked for the nearest ones."""
        return cKDTree(self.points)

    @property
    def box(self) -> Float[np.ndarray, "2 3"]:
        """Corners of the box in which points of a mesh count."""
        return self.corners + np.array([[-MARGIN], [2 * MARGIN]])

    def above(self) -> Float[np.ndarray, "m 3"]:
        """The points above the plane."""
        return self.points[self.points @ self.plane[:3] + self.plane[3] > 0]

    def sees(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Which points lie in an observed cell."""
        cells = np.around((points - self.corners[0]) / self.spacing).astype(np.int64)
        within = ((cells >= 0) & (cells < self.observed.shape)).all(axis=1)
        within[within] = self.observed[tuple(cells[within].T)]
        return within


def read_scan(folder: Path, number: int) -> DtuScan:
    """Reads a scan of DTU's folders `Points/stl` and `ObsMask`, of the archives Points and SampleSet.

    Raises:
        BadInput: where a file is missing, or is not as DTU has it; the message names it.
    """
    cloud = _file(folder, f"Points/stl/stl{number:03d}_total.ply", "Points.zip")
    volume = _file(folder, f"ObsMask/ObsMask{number}_10.mat", "SampleSet.zip")
    plane = _file(folder, f"ObsMask/Plane{number}.mat", "SampleSet.zip")
    points = read_points(cloud)
    if points is None:
        raise BadInput(f"{cloud} must be the points of a scan, found a mesh: copy it again from Points.zip")
    observed, box, spacing = _matrices(volume, "ObsMask", "BB", "Res")
    (level,) = _matrices(plane, "P")
    if observed.ndim != 3 or box.shape != (2, 3) or spacing.size != 1 or level.size != 4:
        shapes = ", ".join(str(list(one.shape)) for one in (observed, box, spacing, level))
        raise BadInput(
            f"{volume} and {plane.name} must have ObsMask [x, y, z], BB [2, 3], a number Res and P [4], "
            f"found {shapes}: copy them again"
        )
    corners = box.astype(np.float32).astype(np.float64)
    return DtuScan(points, level.ravel().astype(float), observed > 0, corners, float(spacing.ravel()[0]))


def published(number: int) -> list[str]:
    """What DVR's Table 2 has, in words, where it has the scan."""
    rows = "; ".join(f"{name}: {values[-1]:.3f}" for name, values in DVR_TABLE2.items())
    scans = ", ".join(map(str, DVR_SCANS))
    told = f"published, DVR, Table 2, dtu_overall in mm, mean of scans {scans}: {rows}"
    return [told] if number in DVR_SCANS else []


def dtu_metrics(mesh: Mesh | None, scan: DtuScan, *, seed: int) -> dict[str, float]:
    """The metrics of `DEFINITIONS`.

    Args:
        mesh: in the scan's world, in mm. All of its vertices count, those without a face too. None scores infinity, as
            does a mesh that has no point where points count.
        seed: of the order in which its samples are thinned, on which means depend by about 0.01 %.

    Raises:
        BadInput: where the mesh is so large, within the scan's box, that it cannot be sampled.
    """
    if mesh is None:
        return dict(WORST)
    points = np.concatenate([*_sampled(mesh, scan.box)])
    np.random.default_rng(seed).shuffle(points, axis=0)
    points = thinned(points, DENSITY)
    points = points[((points >= scan.box[0]) & (points < scan.box[1])).all(axis=1)]
    accuracy = _mean_distance(points[scan.sees(points)], scan.tree)
    completeness = _mean_distance(scan.above(), cKDTree(points)) if len(points) else inf
    return dict(zip(NAMES, (accuracy, completeness, (accuracy + completeness) / 2), strict=True))


def culled(mesh: Mesh, shots: Sequence[Shot]) -> Mesh | None:
    """The faces of which no photograph shows a corner outside of its mask; None where there are none.

    NeuS and others cull so what they find without masks. A corner that a photograph does not show is kept by it.

    Args:
        mesh: in the world of the photographs.
        shots: with masks, which are dilated by `DILATION`.
    """
    points, kept = torch.from_numpy(mesh.vertices), np.ones(len(mesh.vertices), dtype=bool)
    for shot in shots:
        if shot.mask is None:
            raise BadInput(f"culling needs a mask of each photograph, and {shot.name} has none")
        kept &= shot.allowed_by_mask(points, DILATION * max(shot.mask.shape)).numpy()
    faces = mesh.faces[kept[mesh.faces].all(axis=1)]
    return replace(mesh, faces=faces).compact() if len(faces) else None


def thinned(points: Float[np.ndarray, "n 3"], radius: float) -> Float[np.ndarray, "m 3"]:
    """The points, in their order, that lie farther than a radius from all kept ones before them."""
    kept, start, size = points[:0], 0, FIRST
    while start < len(points):  # chunks double: each is compared with those kept before it, then within itself
        some = points[start : start + size]
        if len(kept):
            some = some[cKDTree(kept).query(some, distance_upper_bound=2 * radius)[0] > radius]
        kept = np.concatenate([kept, some[_first_come(some, radius)]])
        start, size = start + size, start + size
    return kept


def _first_come(points: Float[np.ndarray, "n 3"], radius: float) -> Bool[np.ndarray, " n"]:
    """The same within one chunk: in rounds, each of those that no earlier point still undecided is near to."""
    undecided, kept = np.ones(len(points), dtype=bool), np.zeros(len(points), dtype=bool)
    pairs = cKDTree(points).query_pairs(radius, output_type="ndarray")  # the earlier point first
    while len(pairs):
        chosen = undecided.copy()
        chosen[pairs[:, 1]] = False
        kept |= chosen
        undecided &= ~chosen
        undecided[pairs[chosen[pairs[:, 0]], 1]] = False
        pairs = pairs[undecided[pairs].all(axis=1)]
    return kept | undecided


def _sampled(mesh: Mesh, box: Float[np.ndarray, "2 3"]) -> Iterator[Float[np.ndarray, "_ 3"]]:
    """The vertices, then centres of as many cells in each face as fit with an area of `DENSITY` squared each.

    Points far outside of the box are left out, before they are made where a face is.
    """
    low, high = box[0] - DENSITY, box[1] + DENSITY

    def near(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
        return points[((points >= low) & (points <= high)).all(axis=1)]

    yield near(mesh.vertices)
    corners = mesh.vertices[mesh.faces]
    corners = corners[((corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)).all(axis=1)]
    start, sides = corners[:, 0], corners[:, 1:] - corners[:, :1]
    lengths, areas = np.linalg.norm(sides, axis=2), np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    start, sides, lengths, areas = (part[areas > 0] for part in (start, sides, lengths, areas))
    counts = np.floor(lengths / (DENSITY * np.sqrt(lengths.prod(axis=1) / areas))[:, None])
    cells = counts.prod(axis=1)
    if cells.sum() > MOST:
        raise BadInput(
            f"the mesh has an area of {areas.sum() / 2e6:.3g} square metres near the scan, too much for points "
            f"{DENSITY} mm apart: is it in mm? Cut off what is no part of the object, or cull it by masks"
        )
    for some in np.split(np.arange(len(cells)), np.flatnonzero(np.diff(np.cumsum(cells) // CHUNK)) + 1):
        size = cells[some].astype(np.int64)
        face = np.repeat(some, size)
        place = np.arange(size.sum()) - np.repeat(np.cumsum(size) - size, size)
        along = (np.stack(np.divmod(place, counts[face, 1]), axis=1) + 0.5) / counts[face]
        inside = along.sum(axis=1) < 1
        face, along = face[inside], along[inside]
        yield near(sides[face, 0] * along[:, :1] + sides[face, 1] * along[:, 1:] + start[face])


def _mean_distance(points: Float[np.ndarray, "n 3"], tree: cKDTree) -> float:
    """The mean distance to the nearest point, of those below `CUT`; infinite where there is none."""
    distances = tree.query(points, distance_upper_bound=CUT)[0] if len(points) else np.empty(0)
    distances = distances[distances < CUT]
    return float(distances.mean()) if len(distances) else inf


def _file(folder: Path, name: str, archive: str) -> Path:
    """A file of DTU's in a folder, or where its archives have it."""
    for parent in PARENTS:
        if (folder / parent / name).is_file():
            return folder / parent / name
    raise BadInput(f"{folder} has no {name}: give the folder that has DTU's Points and ObsMask ({archive} has it)")


def _matrices(file: Path, *names: str) -> list[Any]:
    """Matrices of a .mat file by their names."""
    try:
        known = loadmat(file)
    except (MatReadError, zlib.error, OSError, ValueError, NotImplementedError, TypeError, LookupError) as error:
        raise BadInput(f"{file} cannot be read as a .mat file ({error}): copy it again") from None
    if missing := [name for name in names if name not in known]:
        raise BadInput(f"{file} has no {missing[0]}, found {', '.join(known) or 'nothing'}: copy it again")
    return [known[name] for name in names]
