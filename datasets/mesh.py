"""The triangle mesh, and how one is extracted from a field."""

from collections.abc import Callable, Sequence
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

BANDS = ("red", "green", "blue")
LARGEST = 1e12  # so that squares and cubes of coordinates stay finite in float32
STRIDES = (4, 2, 1)  # of the lattices of samples
SLOPE = 3.0  # a field may be so many times as steep as a distance before a part of its surface can be lost
STEEPER = 1.2  # the same, times the largest slope between neighbouring samples, where that is more
KEPT = 0.5  # of the slope times the stride: a sample is asked for finer ones where its value may be less
CHUNK = 65536  # points per evaluation


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh, wound outward.

    Args:
        vertices: in scene units.
        faces: the vertices of each.
        repairs: what was repaired, and warnings, one sentence each.
        colours: of the vertices, RGB from 0 to 1.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    repairs: tuple[str, ...] = ()
    colours: Float[np.ndarray, "v 3"] | None = None

    def __post_init__(self):
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        faces = np.ascontiguousarray(self.faces, dtype=np.int64)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or not (np.abs(vertices) < LARGEST).all():
            raise ValueError(
                f"vertices: must be numbers below {LARGEST:g} of shape [v, 3], found shape {list(vertices.shape)} with "
                f"{np.count_nonzero(~(np.abs(vertices) < LARGEST))} NaN, infinite or too large; export the mesh again"
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
    def crosses(self) -> Float[np.ndarray, "f 3"]:
        """Normals of the faces, as long as twice their areas."""
        corners = self.vertices[self.faces]
        return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

    @property
    def area(self) -> float:
        """Area of the surface."""
        return float(np.linalg.norm(self.crosses, axis=1).sum() / 2)

    @property
    def volume(self) -> float:
        """Volume enclosed, positive where the faces wind outward; without meaning for an open mesh."""
        return float(self.part_volumes.sum())

    @property
    def diagonal(self) -> float:
        """Length of the bounding box's diagonal, over the vertices that faces use."""
        return float(np.linalg.norm(np.ptp(self.used, axis=0)))

    @property
    def used(self) -> Float[np.ndarray, "n 3"]:
        """The vertices that faces use."""
        return self.vertices[np.unique(self.faces)]

    @property
    def open_faces(self) -> Bool[np.ndarray, " f"]:
        """True for faces with an edge that is not used equally often in both directions: a rim, or a wrong winding."""
        steps = self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        keys = steps.min(axis=1) * len(self.vertices) + steps.max(axis=1)
        _, same = np.unique(keys, return_inverse=True)
        balance = np.bincount(same, weights=np.sign(steps[:, 1] - steps[:, 0]))
        return (balance[same] != 0).reshape(-1, 3).any(axis=1)

    @property
    def watertight(self) -> bool:
        """True for a closed surface with one consistent winding."""
        return not self.open_faces.any()

    @cached_property
    def parts(self) -> Int[np.ndarray, " f"]:
        """Number of the connected part that each face belongs to, from 0."""
        first, second = np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]]]).T
        joined = coo_array((np.ones(len(first), dtype=bool), (first, second)), shape=(len(self.vertices),) * 2)
        labels = connected_components(joined, directed=False)[1]
        return np.unique(labels[self.faces[:, 0]], return_inverse=True)[1].reshape(-1)

    @property
    def part_volumes(self) -> Float[np.ndarray, " p"]:
        """Volume that each part encloses, as `volume` does for the whole."""
        heights = self.vertices[self.faces[:, 0]] - self.vertices.mean(axis=0)
        return np.bincount(self.parts, weights=(heights * self.crosses).sum(axis=1) / 6)

    @property
    def holes(self) -> int:
        """Number of loops of edges that have a face on one side only."""
        import trimesh

        steps = np.sort(self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edges, uses = np.unique(steps, axis=0, return_counts=True)
        rim = edges[uses == 1]
        labels = trimesh.graph.connected_component_labels(rim, node_count=len(self.vertices))
        return len(np.unique(labels[rim]))

    def compact(self) -> "Mesh":
        """The mesh without unused vertices."""
        used, faces = np.unique(self.faces, return_inverse=True)
        colours = None if self.colours is None else self.colours[used]
        return replace(self, vertices=self.vertices[used], faces=faces.reshape(-1, 3), colours=colours)

    def moved(self, motion: Float[np.ndarray, "4 4"]) -> "Mesh":
        """The mesh in another world, by an affine map."""
        return replace(self, vertices=self.vertices @ motion[:3, :3].T + motion[:3, 3])

    def cut_off(self) -> "Mesh | None":
        """The part within the unit sphere, as fields are cut off there; None where there is none."""
        faces = self.faces[(np.linalg.norm(self.vertices, axis=1) <= 1)[self.faces].all(axis=1)]
        return replace(self, faces=faces).compact() if len(faces) else None

    def save(self, path: str | Path) -> None:
        """Writes a binary .ply file."""
        path = Path(path)
        if path.suffix.lower() != ".ply":
            raise ValueError(f"path: must end in .ply, found '{path.name}'; name it '{path.stem}.ply'")
        coloured = "" if self.colours is None else "".join(f"property uchar {name}\n" for name in BANDS)
        header = (
            "ply\nformat binary_little_endian 1.0\n"
            f"element vertex {len(self.vertices)}\n"
            "property double x\nproperty double y\nproperty double z\n"
            f"{coloured}element face {len(self.faces)}\n"
            "property list uchar int vertex_indices\nend_header\n"
        )
        rows = np.empty(len(self.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
        rows["count"], rows["corners"] = 3, self.faces
        places = np.empty(len(self.vertices), dtype=[("place", "<f8", 3), ("colour", "u1", 3 if coloured else 0)])
        places["place"] = self.vertices
        if self.colours is not None:
            places["colour"] = (255 * self.colours.clip(0, 1)).round()
        path.write_bytes(header.encode("ascii") + places.tobytes() + rows.tobytes())


def joined(parts: Sequence[Mesh]) -> Mesh:
    """The meshes as one, without colours."""
    firsts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + first for part, first in zip(parts, firsts, strict=False)]
    return Mesh(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))


def normalise(mesh: Mesh, radius: float) -> Mesh:
    """Moves the centre of the bounding box to the origin and scales until the farthest vertex is at `radius`.

    Args:
        mesh: any mesh; unused vertices are moved along but not measured.
        radius: positive, scene units.
    """
    centre, factor = fit_in_sphere(mesh.used, radius)
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
    """The zero set by marching cubes, wound outward; None where the samples have one sign.

    A distance or a bound is evaluated only near its surface, see `_near_values`; a level set everywhere. A sample that
    is NaN is unknown: the surface is left open where it passes there, and a note says how many these are.

    Args:
        grid: samples per axis.
        reach: half the side of the sampled cube about the origin. A surface that leaves it is left open.
        device: where the field's tensors are.
    """

    def evaluate(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        places = torch.from_numpy(points.astype(np.float32)).to(device)
        return torch.cat([field(chunk).float().cpu() for chunk in places.split(CHUNK)]).numpy()

    axis = torch.linspace(-reach, reach, grid).numpy()
    if field.kind is Kind.LEVEL or grid <= 2 * STRIDES[0]:
        values = evaluate(_places(np.arange(grid**3), axis)).reshape(grid, grid, grid)
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
    known = ~maximum_filter(unknown, size=2)  # of the cell before a sample
    try:
        vertices, faces, _, _ = marching_cubes(np.where(unknown, 1, values), 0.0, mask=known, **options)
    except RuntimeError:  # no cell that is known has the surface
        return None
    count = np.count_nonzero(unknown)
    return Mesh(vertices - reach, faces, (f"warning: the field is NaN at {count} samples: a surface is open there",))


class _Samples:
    """Values on the samples of a cube, of those samples whose sign is not known by the values of others.

    A sample is on the same side of the surface as another one whose value is above a bound of the field's slope times
    the distance between the two. Lattices of samples are halved; one is asked where the last leaves the sign open.
    """

    def __init__(self, evaluate: Callable[[np.ndarray], np.ndarray], axis: Float[np.ndarray, " grid"]):
        self.evaluate, self.spacing = evaluate, float(axis[1] - axis[0])
        self.side = -(-(len(axis) - 1) // STRIDES[0]) * STRIDES[0] + 1
        # The last sample is repeated until lattices end on it: so it is nearer than it counts, which is safe.
        self.axis = np.append(axis, np.full(self.side - len(axis), axis[-1], axis.dtype))
        self.values = np.zeros((self.side,) * 3, dtype=np.float32)
        self.known = np.zeros_like(self.values, dtype=bool)

    def refine(self, slope: float) -> None:
        """Asks where signs are open if the field is at most so steep, and gives the others a value of their sign."""
        above, below = (np.full(self.values[_every(STRIDES[0])].shape, -np.inf, dtype=np.float32) for _ in range(2))
        for stride in STRIDES[:-1]:
            fall = slope * self.spacing * stride
            if stride < STRIDES[0]:
                above, below = (_between(bound, fall) for bound in (above, below))
            self._ask(~(above > KEPT * fall) & ~(below > KEPT * fall), stride)
            values = self.values[_every(stride)]
            known = self.known[_every(stride)] & ~np.isnan(values)
            if not known.any():  # NaN everywhere: nothing to search for
                self.values[...] = np.nan
                return
            above, below = np.where(known, values, above), np.where(known, -values, below)
        outside, inside = (_between(bound, slope * self.spacing) > 0 for bound in (above, below))
        self._ask(~outside & ~inside, 1)
        np.copyto(self.values, np.where(inside, np.float32(-1), np.float32(1)), where=~self.known)

    def steepest(self) -> float:
        """The largest slope between samples that are neighbours in one of the lattices."""
        slopes = [0.0]
        for stride in STRIDES:
            values, known = (np.ascontiguousarray(part[_every(stride)]) for part in (self.values, self.known))
            side, index = len(values), np.flatnonzero(known)
            values, known = values.ravel(), known.ravel()
            for step in (1, side, side**2):
                first = index[index // step % side < side - 1]
                first = first[known[first + step]]
                with np.errstate(invalid="ignore"):  # of two that are infinite
                    changes = np.abs(values[first + step] - values[first])
                slopes.append(float(changes[np.isfinite(changes)].max(initial=0.0)) / (stride * self.spacing))
        return max(slopes)

    def follow(self) -> None:
        """Asks what is not known of the corners of all cells that the surface passes, also where that leads away."""
        values, known = self.values.reshape(-1), self.known.reshape(-1)
        inside = values < 0
        while len(places := np.flatnonzero(self._next_to(inside) & self._next_to(~inside) & ~known)):
            self._ask(places, 1)
            turned = places[(values[places] < 0) != inside[places]]
            inside[turned] = ~inside[turned]
            if not len(turned):
                break

    def _ask(self, where: Bool[np.ndarray, "side side side"] | Int[np.ndarray, " n"], stride: int) -> None:
        """Evaluates samples of a lattice that are not known, given by a mask or by their flat indices."""
        values, known = self.values[_every(stride)], self.known[_every(stride)]
        places = np.flatnonzero(where & ~known) if where.dtype == bool else where
        if len(places):
            values.flat[places], known.flat[places] = self.evaluate(_places(places, self.axis[::stride])), True

    def _next_to(self, mask: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """A flat mask with all samples that share a cell with one of its own; at the cube's faces with some more."""
        for step in (1, self.side, self.side**2):
            grown = mask.copy()
            grown[step:] |= mask[:-step]
            grown[:-step] |= mask[step:]
            mask = grown
        return mask


def _near_values(
    evaluate: Callable[[np.ndarray], np.ndarray], axis: Float[np.ndarray, " grid"]
) -> Float[np.ndarray, "grid grid grid"]:
    """Values that are right at the corners of all cells that the surface passes, and have the right sign elsewhere.

    No part of the surface is lost where the field is at most `SLOPE` times as steep as a distance, or `STEEPER` times
    as steep as between any two neighbours among the asked samples. A field that is far steeper is asked everywhere.
    """
    samples, slope, steepest = _Samples(evaluate, axis), 0.0, SLOPE / STEEPER
    while STEEPER * steepest > slope:
        slope = max(SLOPE, STEEPER * steepest)
        samples.refine(slope)
        steepest = samples.steepest()
    samples.follow()
    return samples.values[(slice(len(axis)),) * 3]


def _between(bound: Float[np.ndarray, "n n n"], fall: float) -> Float[np.ndarray, "m m m"]:
    """Lower bounds on a lattice of half the stride, from those on a lattice; they fall by `fall` along its side."""
    finer = np.empty((2 * len(bound) - 1,) * 3, dtype=bound.dtype)
    for odd in product((0, 1), repeat=3):
        around = bound
        for axis in np.flatnonzero(odd).tolist():
            around = np.maximum(*_neighbours(around, axis))
        finer[tuple(slice(start, None, 2) for start in odd)] = around - fall * sqrt(sum(odd))
    return finer


def _neighbours(values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Of each two neighbours along an axis, the first ones and the second ones."""
    before = (slice(None),) * axis
    return values[(*before, slice(None, -1))], values[(*before, slice(1, None))]


def _every(stride: int) -> tuple[slice, slice, slice]:
    return (slice(None, None, stride),) * 3


def _places(flat: Int[np.ndarray, " n"], axis: Float[np.ndarray, " grid"]) -> Float[np.ndarray, "n 3"]:
    """The points of a cube's samples, given by their flat indices."""
    return np.stack([axis[i] for i in np.unravel_index(flat, (len(axis),) * 3)], axis=-1)
