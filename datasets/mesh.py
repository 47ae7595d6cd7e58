"""The triangle mesh, and its extraction from a field."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import sqrt
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import maximum_filter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from renderers.field import Field, Kind

COLOUR_CHANNELS = ("red", "green", "blue")
MAX_COORDINATE = 1e12  # keeps squares and cubes of coordinates finite in float32
STRIDES = (4, 2, 1)  # samples between neighbours, from the coarsest lattice to the finest
# The assumed slope bound: the larger of the first, and the second times the largest slope between neighbours.
MAX_FIELD_SLOPE, SLOPE_SAFETY_FACTOR = 3.0, 1.2
REFINE_FRACTION = 0.5  # finer samples are evaluated if the field may be below this fraction of slope x stride
POINTS_PER_BATCH = 65536


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh, wound outward.

    Args:
        vertices: in scene units.
        faces: vertex indices.
        repairs: notes on repairs, and warnings, one sentence each.
        colours: of the vertices, RGB from 0 to 1.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    repairs: tuple[str, ...] = ()
    colours: Float[np.ndarray, "v 3"] | None = None

    def __post_init__(self):
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        faces = np.ascontiguousarray(self.faces, dtype=np.int64)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or not (np.abs(vertices) < MAX_COORDINATE).all():
            count = np.count_nonzero(~(np.abs(vertices) < MAX_COORDINATE))
            raise ValueError(
                f"vertices: must be numbers below {MAX_COORDINATE:g} of shape [v, 3], found shape "
                f"{list(vertices.shape)} with {count} NaN, infinite or too large; export the mesh again"
            )
        if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
            raise ValueError(
                f"faces: must be one or more triangles of shape [f, 3], found shape {list(faces.shape)}; "
                "export the mesh with its faces, as triangles"
            )
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise ValueError(
                f"faces: must index the {len(vertices)} vertices from 0, found {faces.min()} to {faces.max()}; "
                "export the mesh again"
            )
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)

    @property
    def area_normals(self) -> Float[np.ndarray, "f 3"]:
        """Normals of the faces, with twice the face area as length."""
        corners = self.vertices[self.faces]
        return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

    @property
    def area(self) -> float:
        return float(np.linalg.norm(self.area_normals, axis=1).sum() / 2)

    @property
    def volume(self) -> float:
        """Volume enclosed, positive if the faces wind outward; without meaning for an open mesh."""
        return float(self.part_volumes.sum())

    @property
    def diagonal(self) -> float:
        """Length of the bounding box's diagonal, over the vertices that faces use."""
        return float(np.linalg.norm(np.ptp(self.used_vertices, axis=0)))

    @property
    def used_vertices(self) -> Float[np.ndarray, "n 3"]:
        """The vertices that faces use."""
        return self.vertices[np.unique(self.faces)]

    @property
    def open_faces(self) -> Bool[np.ndarray, " f"]:
        """True for faces with an edge not used equally often in both directions: a rim, or a wrong winding."""
        steps = self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        keys = steps.min(axis=1) * len(self.vertices) + steps.max(axis=1)
        _, edge = np.unique(keys, return_inverse=True)
        balance = np.bincount(edge, weights=np.sign(steps[:, 1] - steps[:, 0]))
        return (balance[edge] != 0).reshape(-1, 3).any(axis=1)

    @property
    def watertight(self) -> bool:
        """True for a closed surface with one consistent winding."""
        return not self.open_faces.any()

    @cached_property
    def parts(self) -> Int[np.ndarray, " f"]:
        """Index of the connected part of each face, from 0."""
        first, second = np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]]]).T
        edges = coo_array((np.ones(len(first), dtype=bool), (first, second)), shape=(len(self.vertices),) * 2)
        labels = connected_components(edges, directed=False)[1]
        return np.unique(labels[self.faces[:, 0]], return_inverse=True)[1].reshape(-1)

    @property
    def part_volumes(self) -> Float[np.ndarray, " p"]:
        """Volume enclosed by each part, with the sign of `volume`."""
        heights = self.vertices[self.faces[:, 0]] - self.vertices.mean(axis=0)
        return np.bincount(self.parts, weights=(heights * self.area_normals).sum(axis=1) / 6)

    def compact(self) -> "Mesh":
        used, faces = np.unique(self.faces, return_inverse=True)
        colours = None if self.colours is None else self.colours[used]
        return replace(self, vertices=self.vertices[used], faces=faces.reshape(-1, 3), colours=colours)

    def moved(self, motion: Float[np.ndarray, "4 4"]) -> "Mesh":
        """The mesh transformed by an affine map."""
        return replace(self, vertices=self.vertices @ motion[:3, :3].T + motion[:3, 3])

    def cut_off(self) -> "Mesh | None":
        """The faces with all corners in the unit sphere, as fields are cut off there; None without any."""
        faces = self.faces[(np.linalg.norm(self.vertices, axis=1) <= 1)[self.faces].all(axis=1)]
        return replace(self, faces=faces).compact() if len(faces) else None

    @staticmethod
    def load(path: Path) -> "Mesh":
        """The mesh of a file that `save` wrote; `datasets.files.meshes` reads other files."""
        import trimesh

        loaded = trimesh.load_mesh(path, process=False)
        colours = loaded.visual.vertex_colors[:, :3] / 255 if loaded.visual.kind == "vertex" else None
        return Mesh(np.array(loaded.vertices), np.array(loaded.faces), colours=colours)

    def save(self, path: str | Path) -> None:
        path = Path(path)
        if path.suffix.lower() != ".ply":
            raise ValueError(f"path: must end in .ply, found '{path.name}'; name it '{path.stem}.ply'")
        coloured = "" if self.colours is None else "".join(f"property uchar {name}\n" for name in COLOUR_CHANNELS)
        header = (
            "ply\nformat binary_little_endian 1.0\n"
            f"element vertex {len(self.vertices)}\n"
            "property double x\nproperty double y\nproperty double z\n"
            f"{coloured}element face {len(self.faces)}\n"
            "property list uchar int vertex_indices\nend_header\n"
        )
        faces = np.empty(len(self.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
        faces["count"], faces["corners"] = 3, self.faces
        vertices = np.empty(len(self.vertices), dtype=[("position", "<f8", 3), ("colour", "u1", 3 if coloured else 0)])
        vertices["position"] = self.vertices
        if self.colours is not None:
            vertices["colour"] = (255 * self.colours.clip(0, 1)).round()
        path.write_bytes(header.encode("ascii") + vertices.tobytes() + faces.tobytes())


def normalise(mesh: Mesh, radius: float) -> Mesh:
    """Moves the centre of the bounding box to the origin and scales until the farthest vertex is at `radius`.

    Args:
        mesh: any mesh; unused vertices are moved too, but do not count for centre and scale.
        radius: positive, scene units.
    """
    centre, factor = fit_in_sphere(mesh.used_vertices, radius)
    return replace(mesh, vertices=(mesh.vertices - centre) * factor)


def fit_in_sphere(points: Float[np.ndarray, "n 3"], radius: float) -> tuple[Float[np.ndarray, "3"], float]:
    """The point that `normalise` moves to the origin, and the factor by which it then scales."""
    if not (np.isfinite(radius) and radius > 0):
        raise ValueError(f"radius: must be positive, found {radius}; the scenes use a little less than 1")
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    farthest = np.linalg.norm(points - centre, axis=1).max()
    if farthest == 0:
        raise ValueError("mesh: must have an extent, found all vertices at one place; export the mesh again")
    return centre, radius / farthest


@torch.no_grad()
def extract(field: Field, *, grid: int, reach: float, device: torch.device | str = "cpu") -> Mesh | None:
    """The zero set by marching cubes, wound outward; None if all samples have the same sign.

    A distance or a bound is evaluated only near its surface, see `_near_values`; a level set everywhere. The surface
    is left open at samples that are NaN, and a note gives their number.

    Args:
        grid: samples per axis.
        reach: half the side of the sampled cube about the origin. A surface that leaves it is left open.
        device: of the field's tensors.
    """

    def evaluate(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        positions = torch.from_numpy(points.astype(np.float32)).to(device)
        return torch.cat([field(batch).float().cpu() for batch in positions.split(POINTS_PER_BATCH)]).numpy()

    axis = torch.linspace(-reach, reach, grid).numpy()
    if field.kind is Kind.LEVEL or grid <= 2 * STRIDES[0]:
        values = evaluate(_sample_points(np.arange(grid**3), axis)).reshape(grid, grid, grid)
    else:
        values = _near_values(evaluate, axis)
    unknown = np.isnan(values)
    if not (np.fmin.reduce(values, axis=None) < 0 < np.fmax.reduce(values, axis=None)):
        return None
    spacing = 2 * reach / (grid - 1)
    options = {"spacing": (spacing,) * 3, "gradient_direction": "descent"}
    if not unknown.any():
        vertices, faces, _, _ = marching_cubes(values, 0.0, **options)
        return Mesh(vertices - reach, faces)
    complete_cells = ~maximum_filter(unknown, size=2)  # indexed by the last sample of each cell
    try:
        vertices, faces, _, _ = marching_cubes(np.where(unknown, 1, values), 0.0, mask=complete_cells, **options)
    except RuntimeError:  # the surface is in no complete cell
        return None
    count = np.count_nonzero(unknown)
    return Mesh(vertices - reach, faces, (f"warning: the field is NaN at {count} samples: a surface is open there",))


class _Samples:
    """Evaluates the samples of a cube whose sign does not follow from the values of other samples.

    A sample has the sign of another one if the other's magnitude exceeds the slope bound times their distance. Lattices
    become finer by halves; a finer lattice is evaluated where the coarser one leaves the sign open.
    """

    def __init__(self, evaluate: Callable[[np.ndarray], np.ndarray], axis: Float[np.ndarray, " grid"]):
        self.evaluate, self.spacing = evaluate, float(axis[1] - axis[0])
        self.side = -(-(len(axis) - 1) // STRIDES[0]) * STRIDES[0] + 1
        # The last sample is repeated until all lattices end on it. Its assumed distance is too large, which is safe.
        self.axis = np.append(axis, np.full(self.side - len(axis), axis[-1], axis.dtype))
        self.values = np.zeros((self.side,) * 3, dtype=np.float32)
        self.evaluated = np.zeros_like(self.values, dtype=bool)

    def refine(self, slope: float) -> None:
        """Evaluates samples whose sign is open for a slope bound; sets the others to 1 or -1, their sign."""
        above, below = (np.full(self.values[_lattice(STRIDES[0])].shape, -np.inf, dtype=np.float32) for _ in range(2))
        for stride in STRIDES[:-1]:
            fall = slope * self.spacing * stride
            if stride < STRIDES[0]:
                above, below = (_between(bound, fall) for bound in (above, below))
            self._evaluate_at(~(above > REFINE_FRACTION * fall) & ~(below > REFINE_FRACTION * fall), stride)
            values = self.values[_lattice(stride)]
            numeric = self.evaluated[_lattice(stride)] & ~np.isnan(values)
            if not numeric.any():  # NaN everywhere: nothing to search for
                self.values[...] = np.nan
                return
            above, below = np.where(numeric, values, above), np.where(numeric, -values, below)
        outside, inside = (_between(bound, slope * self.spacing) > 0 for bound in (above, below))
        self._evaluate_at(~outside & ~inside, 1)
        np.copyto(self.values, np.where(inside, np.float32(-1), np.float32(1)), where=~self.evaluated)

    def largest_slope(self) -> float:
        """The largest slope between evaluated samples that are neighbours in a lattice."""
        slopes = [0.0]
        for stride in STRIDES:
            values, evaluated = (np.ascontiguousarray(a[_lattice(stride)]) for a in (self.values, self.evaluated))
            side, index = len(values), np.flatnonzero(evaluated)
            values, evaluated = values.ravel(), evaluated.ravel()
            for step in (1, side, side**2):
                first = index[index // step % side < side - 1]
                first = first[evaluated[first + step]]
                with np.errstate(invalid="ignore"):  # both may be infinite
                    changes = np.abs(values[first + step] - values[first])
                slopes.append(float(changes[np.isfinite(changes)].max(initial=0.0)) / (stride * self.spacing))
        return max(slopes)

    def follow(self) -> None:
        """Evaluates all corners of cells on the surface, and follows the surface into further cells."""
        values, evaluated = self.values.reshape(-1), self.evaluated.reshape(-1)
        inside = values < 0
        while len(indices := np.flatnonzero(self._next_to(inside) & self._next_to(~inside) & ~evaluated)):
            self._evaluate_at(indices, 1)
            flipped = indices[(values[indices] < 0) != inside[indices]]
            inside[flipped] = ~inside[flipped]
            if not len(flipped):
                break

    def _evaluate_at(self, selection: Bool[np.ndarray, "side side side"] | Int[np.ndarray, " n"], stride: int) -> None:
        """Evaluates samples of a lattice not evaluated yet, selected by a mask or by flat indices."""
        values, evaluated = self.values[_lattice(stride)], self.evaluated[_lattice(stride)]
        indices = np.flatnonzero(selection & ~evaluated) if selection.dtype == bool else selection
        if len(indices):
            values.flat[indices] = self.evaluate(_sample_points(indices, self.axis[::stride]))
            evaluated.flat[indices] = True

    def _next_to(self, mask: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Grows a flat mask by all samples that share a cell with a sample in it; by a few more at the cube's faces."""
        for step in (1, self.side, self.side**2):
            grown = mask.copy()
            grown[step:] |= mask[:-step]
            grown[:-step] |= mask[step:]
            mask = grown
        return mask


def _near_values(
    evaluate: Callable[[np.ndarray], np.ndarray], axis: Float[np.ndarray, " grid"]
) -> Float[np.ndarray, "grid grid grid"]:
    """Samples with exact values at the corners of all cells on the surface, and the right sign elsewhere.

    No part of the surface is lost if the field's slope is at most `MAX_FIELD_SLOPE`, or at most `SLOPE_SAFETY_FACTOR`
    times the largest slope between evaluated neighbours. A far steeper field is evaluated everywhere.
    """
    samples, slope, largest_slope = _Samples(evaluate, axis), 0.0, MAX_FIELD_SLOPE / SLOPE_SAFETY_FACTOR
    while SLOPE_SAFETY_FACTOR * largest_slope > slope:
        slope = max(MAX_FIELD_SLOPE, SLOPE_SAFETY_FACTOR * largest_slope)
        samples.refine(slope)
        largest_slope = samples.largest_slope()
    samples.follow()
    return samples.values[(slice(len(axis)),) * 3]


def _between(bound: Float[np.ndarray, "n n n"], fall: float) -> Float[np.ndarray, "m m m"]:
    """Lower bounds on a lattice of half the stride; a bound falls by `fall` per side of the finer lattice."""
    finer = np.empty((2 * len(bound) - 1,) * 3, dtype=bound.dtype)
    for odd in product((0, 1), repeat=3):
        bounds = bound
        for axis in np.flatnonzero(odd).tolist():
            before = (slice(None),) * axis  # the larger one of each pair of neighbours
            bounds = np.maximum(bounds[(*before, slice(None, -1))], bounds[(*before, slice(1, None))])
        finer[tuple(slice(start, None, 2) for start in odd)] = bounds - fall * sqrt(sum(odd))
    return finer


def _lattice(stride: int) -> tuple[slice, slice, slice]:
    return (slice(None, None, stride),) * 3


def _sample_points(flat: Int[np.ndarray, " n"], axis: Float[np.ndarray, " grid"]) -> Float[np.ndarray, "n 3"]:
    """The points of a cube's samples with these flat indices."""
    return np.stack([axis[i] for i in np.unravel_index(flat, (len(axis),) * 3)], axis=-1)
