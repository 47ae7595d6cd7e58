"""The triangle mesh, and how one is extracted from a field."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from skimage.measure import block_reduce, marching_cubes

from renderers.field import Field, Kind

BANDS = ("red", "green", "blue")
LARGEST = 1e12  # so that squares and cubes of coordinates stay finite in float32
BLOCKS = (4, 2)  # sides of the blocks, in samples, that are not divided further where the surface is far
MARGIN = 2.0  # a field may exceed the distance by this factor before a part of its surface can be skipped
STEEPER = 1.2  # the same, times its steepest slope between the middles of blocks, where that is more
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
        return float(np.linalg.norm(np.ptp(self.vertices[np.unique(self.faces)], axis=0)))

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


def normalise(mesh: Mesh, radius: float) -> Mesh:
    """Moves the centre of the bounding box to the origin and scales until the farthest vertex is at `radius`.

    Args:
        mesh: any mesh; unused vertices are moved along but not measured.
        radius: positive, scene units.
    """
    centre, factor = fit_in_sphere(mesh, radius)
    return replace(mesh, vertices=(mesh.vertices - centre) * factor)


def fit_in_sphere(mesh: Mesh, radius: float) -> tuple[Float[np.ndarray, "3"], float]:
    """The point that `normalise` moves to the origin, and the factor by which it then scales."""
    if not (np.isfinite(radius) and radius > 0):
        raise ValueError(f"radius: must be positive, found {radius}; the scenes use a little less than 1")
    used = mesh.vertices[np.unique(mesh.faces)]
    centre = (used.min(axis=0) + used.max(axis=0)) / 2
    farthest = np.linalg.norm(used - centre, axis=1).max()
    if farthest == 0:
        raise ValueError("mesh: must have an extent, found all vertices at one place; export the mesh again")
    return centre, radius / farthest


@torch.no_grad()
def extract(field: Field, *, grid: int, reach: float, device: torch.device | str = "cpu") -> Mesh | None:
    """The zero set by marching cubes, wound outward; None where the samples have one sign.

    A distance or a bound is evaluated only near its surface, see `_near_values`; a level set everywhere.

    Args:
        grid: samples per axis.
        reach: half the side of the sampled cube about the origin. A surface that leaves it is left open.
        device: where the field's tensors are.
    """

    def evaluate(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        places = torch.from_numpy(points.astype(np.float32)).to(device)
        return torch.cat([field(chunk).float().cpu() for chunk in places.split(CHUNK)]).numpy()

    axis = torch.linspace(-reach, reach, grid).numpy()
    if field.kind is Kind.LEVEL or grid < 2 * BLOCKS[0]:
        values = evaluate(_places(np.arange(grid**3), axis)).reshape(grid, grid, grid)
    else:
        values = _near_values(evaluate, axis)
    if not (values.min() < 0 < values.max()):
        return None
    spacing = 2 * reach / (grid - 1)
    vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=(spacing,) * 3, gradient_direction="descent")
    return Mesh(vertices - reach, faces)


def _near_values(
    evaluate: Callable[[np.ndarray], np.ndarray], axis: Float[np.ndarray, " grid"]
) -> Float[np.ndarray, "grid grid grid"]:
    """Values that are right near the surface and have the right sign elsewhere.

    A block is not divided if its middle is farther from the surface than its corners are from its middle; it takes the
    value of its middle. Where signs then differ across the side of a block, that block is sampled as well.
    """
    spacing, parent, margin = axis[1] - axis[0], len(axis), MARGIN
    values, near = np.zeros((1, 1, 1), dtype=np.float32), np.ones((1, 1, 1), dtype=bool)
    for side in (*BLOCKS, 1):
        middles = np.array([axis[start : start + side].mean() for start in range(0, len(axis), side)], dtype=axis.dtype)
        parent_of = np.ix_(*(np.arange(len(middles)) * side // parent,) * 3)
        values, known = values[parent_of], near
        values[near[parent_of]] = evaluate(_places(np.flatnonzero(near[parent_of]), middles))
        if side == BLOCKS[0]:
            steps = [np.nan_to_num(np.abs(np.diff(values, axis=i)), posinf=0.0).max() for i in range(3)]
            steepest = max(steps) / (side * spacing)
            margin = max(MARGIN, STEEPER * steepest)
        far = np.abs(values) > margin * np.sqrt(3) * (side + 1) / 2 * spacing  # NaN is not
        near, parent = near[parent_of] & ~far, side
    while (found := block_reduce(_beside_another_sign(values), BLOCKS[-1], np.any) & ~known).any():
        wanted = found[parent_of]
        values[wanted] = evaluate(_places(np.flatnonzero(wanted), axis))
        known |= found
    return values


def _beside_another_sign(values: Float[np.ndarray, "grid grid grid"]) -> Bool[np.ndarray, "grid grid grid"]:
    """The samples that have a neighbour along an axis on the other side of the surface."""
    inside = values < 0
    return binary_dilation(inside) & binary_dilation(~inside)


def _places(flat: Int[np.ndarray, " n"], axis: Float[np.ndarray, " grid"]) -> Float[np.ndarray, "n 3"]:
    """The points of a cube's samples, given by their flat indices."""
    return np.stack([axis[i] for i in np.unravel_index(flat, (len(axis),) * 3)], axis=-1)
