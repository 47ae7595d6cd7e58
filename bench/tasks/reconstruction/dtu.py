"""DTU's protocol in surface mode (Jensen et al. 2014; Aanaes et al. 2016): a mesh against a scan's points, in mm.

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

from bench.evaluate.distances import Distances
from bench.records.published import DVR_SCANS, DVR_TABLE2
from bench.tasks.reconstruction.stereo import allowed_by_mask
from datasets.files.meshes import read_points
from datasets.mesh import Mesh
from datasets.shot import Shot
from renderers.checks import BadInput

SPACING_MM = 0.2  # the mesh is sampled with a point in each square of this side, then thinned to this distance
MAX_DISTANCE_MM = 20.0  # larger distances do not count
LAST_COLOUR_MM = 5.0
VOLUME_MARGIN_MM = 60.0  # points of the mesh count within this margin of the observed volume, twice at its far corner
MASK_DILATION_FRACTION = 1 / 32  # before culling, as NeuS: 50 pixels for the longer side of DTU's images, 1600
MAX_MESH_SAMPLES = 300_000_000  # before thinning
SAMPLES_PER_BATCH = 2_000_000
INITIAL_BATCH = 4096
ARCHIVE_FOLDERS = ("", "MVS Data", "SampleSet/MVS Data", "SampleSet/MVS_Data")  # with Points and ObsMask
METRIC_NAMES = ("dtu_accuracy", "dtu_completeness", "dtu_overall")
_DISTANCES = f"distances of {MAX_DISTANCE_MM:g} mm and more left out, in mm"
DEFINITIONS = {
    "dtu_accuracy": f"Mean distance from points of the mesh, {SPACING_MM} mm apart, within the scan's observed volume "
    f"(ObsMask) to the nearest point of the scan, {_DISTANCES}.",
    "dtu_completeness": "Mean distance from the scan's points above its plane to the nearest point of the mesh, "
    f"{_DISTANCES}.",
    "dtu_overall": "Mean of dtu_accuracy and dtu_completeness, the Chamfer distance of tables on DTU, in mm.",
}
WORST = dict.fromkeys(METRIC_NAMES, inf)
PROTOCOL = (
    f"points of the mesh, {SPACING_MM} mm apart, in ObsMask, and the scan's points above its plane; means of distances "
    f"(not squared) to the nearest point; {MAX_DISTANCE_MM:g} mm and more are left out"
)


@dataclass(frozen=True)
class DtuScan:
    """The ground truth of a scan, in the world of DTU's cameras, in mm.

    Args:
        points: of the structured light scanner.
        plane: a, b, c, d of the table; points above it have a x + b y + c z + d > 0.
        observed: mask of a grid's cells that the scanner observed.
        corners: the first and the last cell of the grid.
        spacing: of the grid.
    """

    points: Float[np.ndarray, "n 3"]
    plane: Float[np.ndarray, "4"]
    observed: Bool[np.ndarray, "x y z"]
    corners: Float[np.ndarray, "2 3"]
    spacing: float

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(self.points)

    @property
    def box(self) -> Float[np.ndarray, "2 3"]:
        """The corners of the box in which points of a mesh count."""
        return self.corners + np.array([[-VOLUME_MARGIN_MM], [2 * VOLUME_MARGIN_MM]])

    def points_above_plane(self) -> Float[np.ndarray, "m 3"]:
        return self.points[self.points @ self.plane[:3] + self.plane[3] > 0]

    def in_observed_cell(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Which points lie in an observed cell."""
        cells = np.around((points - self.corners[0]) / self.spacing).astype(np.int64)
        within = ((cells >= 0) & (cells < self.observed.shape)).all(axis=1)
        within[within] = self.observed[tuple(cells[within].T)]
        return within


def read_scan(folder: Path, number: int) -> DtuScan:
    """Reads a scan of DTU's folders `Points/stl` and `ObsMask`, of the archives Points and SampleSet.

    Raises:
        BadInput: if a file is missing or does not have DTU's format; the message names it.
    """
    cloud = _file(folder, f"Points/stl/stl{number:03d}_total.ply", "Points.zip")
    volume = _file(folder, f"ObsMask/ObsMask{number}_10.mat", "SampleSet.zip")
    plane = _file(folder, f"ObsMask/Plane{number}.mat", "SampleSet.zip")
    points = read_points(cloud)
    if points is None:
        raise BadInput(f"{cloud} must be the points of a scan, found a mesh: copy it again from Points.zip")
    observed, box, spacing = _matrices(volume, "ObsMask", "BB", "Res")
    (plane_coefficients,) = _matrices(plane, "P")
    if observed.ndim != 3 or box.shape != (2, 3) or spacing.size != 1 or plane_coefficients.size != 4:
        shapes = ", ".join(str(list(array.shape)) for array in (observed, box, spacing, plane_coefficients))
        raise BadInput(
            f"{volume} and {plane.name} must have ObsMask [x, y, z], BB [2, 3], a number Res and P [4], "
            f"found {shapes}: copy them again"
        )
    corners = box.astype(np.float32).astype(np.float64)
    return DtuScan(points, plane_coefficients.ravel().astype(float), observed > 0, corners, float(spacing.ravel()[0]))


def published_results(number: int) -> list[str]:
    """A text with the results of DVR's Table 2, if it has the scan."""
    rows = "; ".join(f"{name}: {values[-1]:.3f}" for name, values in DVR_TABLE2.items())
    scans = ", ".join(map(str, DVR_SCANS))
    message = f"published, DVR, Table 2, dtu_overall in mm, mean of scans {scans}: {rows}"
    return [message] if number in DVR_SCANS else []


def dtu_metrics(mesh: Mesh | None, scan: DtuScan, *, seed: int) -> dict[str, float]:
    """The metrics of `DEFINITIONS`.

    Args:
        mesh: in the scan's world, in mm. All vertices count, also those without a face. Distances are infinite for None
            and for a mesh without a point in the scan's box.
        seed: of the order of thinning, which changes the means by about 0.01 %.

    Raises:
        BadInput: if the mesh is too large, within the scan's box, to be sampled.
    """
    return dict(WORST) if mesh is None else metrics_of(dtu_distances(mesh, scan, seed=seed))


def dtu_distances(mesh: Mesh, scan: DtuScan, *, seed: int) -> Distances:
    """The distances of `dtu_metrics`; those of `MAX_DISTANCE_MM` and more are infinite."""
    points = np.concatenate([*sample_mesh(mesh, scan.box, SPACING_MM)])
    np.random.default_rng(seed).shuffle(points, axis=0)
    points = thinned(points, SPACING_MM)
    points = points[((points >= scan.box[0]) & (points < scan.box[1])).all(axis=1)]
    observed, above = points[scan.in_observed_cell(points)], scan.points_above_plane()
    clouds = (observed, _nearest(observed, scan.tree), above, _nearest(above, cKDTree(points)))
    return Distances(*clouds, "mm", None, scan.plane[:3], LAST_COLOUR_MM)


def metrics_of(distances: Distances) -> dict[str, float]:
    """The metrics of `DEFINITIONS`: means of the distances that are finite, infinite without any."""
    counted = (array[np.isfinite(array)] for array in (distances.mesh_to_truth, distances.truth_to_mesh))
    accuracy, completeness = (float(array.mean()) if len(array) else inf for array in counted)
    return dict(zip(METRIC_NAMES, (accuracy, completeness, (accuracy + completeness) / 2), strict=True))


def culled(mesh: Mesh, shots: Sequence[Shot]) -> Mesh | None:
    """The faces without a corner that a photograph shows outside its mask; None if no face remains.

    NeuS and others cull their results without masks in this way. Corners outside a photograph's frame are kept.

    Args:
        mesh: in the world of the photographs.
        shots: with masks, which are dilated by `MASK_DILATION_FRACTION` of the longer side.
    """
    points, kept = torch.from_numpy(mesh.vertices), np.ones(len(mesh.vertices), dtype=bool)
    for shot in shots:
        if shot.mask is None:
            raise BadInput(f"culling needs a mask of each photograph, and {shot.name} has none")
        kept &= allowed_by_mask(shot, points, MASK_DILATION_FRACTION * max(shot.mask.shape)).numpy()
    faces = mesh.faces[kept[mesh.faces].all(axis=1)]
    return replace(mesh, faces=faces).compact() if len(faces) else None


def thinned(points: Float[np.ndarray, "n 3"], radius: float) -> Float[np.ndarray, "m 3"]:
    """The points, in their order, that lie farther than `radius` from all kept points before them."""
    kept, start, size = points[:0], 0, INITIAL_BATCH
    while start < len(points):  # batches double: each is compared with the kept points, then within itself
        batch = points[start : start + size]
        if len(kept):
            batch = batch[cKDTree(kept).query(batch, distance_upper_bound=2 * radius)[0] > radius]
        kept = np.concatenate([kept, batch[_greedy_mask(batch, radius)]])
        start, size = start + size, start + size
    return kept


def _greedy_mask(points: Float[np.ndarray, "n 3"], radius: float) -> Bool[np.ndarray, " n"]:
    """A mask of the kept points of one batch. Each round keeps the points without an earlier undecided neighbour."""
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


def sample_mesh(mesh: Mesh, box: Float[np.ndarray, "2 3"], spacing: float) -> Iterator[Float[np.ndarray, "_ 3"]]:
    """Yields the vertices, then points in each face: centres of cells with an area of about `spacing` squared.

    Points outside the box are left out; faces outside it are not sampled.
    """
    low, high = box[0] - spacing, box[1] + spacing

    def in_box(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
        return points[((points >= low) & (points <= high)).all(axis=1)]

    yield in_box(mesh.vertices)
    corners = mesh.vertices[mesh.faces]
    corners = corners[((corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)).all(axis=1)]
    start, sides = corners[:, 0], corners[:, 1:] - corners[:, :1]
    lengths, areas = np.linalg.norm(sides, axis=2), np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    start, sides, lengths, areas = (array[areas > 0] for array in (start, sides, lengths, areas))
    counts = np.floor(lengths / (spacing * np.sqrt(lengths.prod(axis=1) / areas))[:, None])
    cell_counts = counts.prod(axis=1)
    if cell_counts.sum() > MAX_MESH_SAMPLES:
        raise BadInput(
            f"the mesh has an area of {areas.sum() / 2:.3g} near the scan, too much for points {spacing:g} apart: is "
            "it in the scan's units? Cut off what is no part of the object, or cull it by masks"
        )
    batch_ends = np.flatnonzero(np.diff(np.cumsum(cell_counts) // SAMPLES_PER_BATCH)) + 1
    for batch in np.split(np.arange(len(cell_counts)), batch_ends):
        size = cell_counts[batch].astype(np.int64)
        face = np.repeat(batch, size)
        cell = np.arange(size.sum()) - np.repeat(np.cumsum(size) - size, size)
        along = (np.stack(np.divmod(cell, counts[face, 1]), axis=1) + 0.5) / counts[face]
        inside = along.sum(axis=1) < 1
        face, along = face[inside], along[inside]
        yield in_box(sides[face, 0] * along[:, :1] + sides[face, 1] * along[:, 1:] + start[face])


def _nearest(points: Float[np.ndarray, "n 3"], tree: cKDTree) -> Float[np.ndarray, " n"]:
    """The distance of each point to the nearest of a tree, infinite from `MAX_DISTANCE_MM` on."""
    if not len(points) or not tree.n:
        return np.full(len(points), inf)
    distances = tree.query(points, distance_upper_bound=MAX_DISTANCE_MM)[0]
    return np.where(distances < MAX_DISTANCE_MM, distances, inf)


def _file(folder: Path, name: str, archive: str) -> Path:
    """The path of a file of DTU, in a folder or in the archives' folders within it."""
    for parent in ARCHIVE_FOLDERS:
        if (folder / parent / name).is_file():
            return folder / parent / name
    raise BadInput(f"{folder} has no {name}: give the folder that has DTU's Points and ObsMask ({archive} has it)")


def _matrices(file: Path, *names: str) -> list[Any]:
    try:
        matrices = loadmat(file)
    except (MatReadError, zlib.error, OSError, ValueError, NotImplementedError, TypeError, LookupError) as error:
        raise BadInput(f"{file} cannot be read as a .mat file ({error}): copy it again") from None
    if missing := [name for name in names if name not in matrices]:
        raise BadInput(f"{file} has no {missing[0]}, found {', '.join(matrices) or 'nothing'}: copy it again")
    return [matrices[name] for name in names]
