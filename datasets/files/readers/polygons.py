"""Polygons of mesh files, convex or concave, with their triangles and materials."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

MIN_AREA_FRACTION = 1e-12  # a triangle with less of a polygon's area is flat, and its third corner lies on the edge
WHITE = (1.0, 1.0, 1.0)  # for a material whose image has the colour


@dataclass(frozen=True)
class Material:
    """The colour of some polygons of a file.

    Args:
        name: in the .mtl files that an .obj names; "" if the mesh file itself has the material.
        colour: RGB from 0 to 1, replaces the vertices' colours; None without one.
        image: the content of an image file, or its path; the image multiplies the colour.
    """

    name: str = ""
    colour: tuple[float, float, float] | None = None
    image: bytes | Path | None = None


@dataclass(frozen=True)
class Polygons:
    """Vertices and the polygons between them.

    Args:
        vertices: in the file's units.
        counts: number of corners of each polygon.
        corners: vertex indices of all polygons, one polygon after the other.
        vertex_colours: RGB from 0 to 1.
        face_colours: RGB from 0 to 1.
        coordinates: of each corner in the image of its material, u to the right and v upward; NaN without any.
        materials: of the file.
        material: the index of each polygon's material; -1 without one.

    Raises:
        ValueError: a corner is no vertex.
    """

    vertices: Float[np.ndarray, "v 3"]
    counts: Int[np.ndarray, " p"]
    corners: Int[np.ndarray, " c"]
    vertex_colours: Float[np.ndarray, "v 3"] | None = None
    face_colours: Float[np.ndarray, "p 3"] | None = None
    coordinates: Float[np.ndarray, "c 2"] | None = None
    materials: tuple[Material, ...] = ()
    material: Int[np.ndarray, " p"] | None = None

    def __post_init__(self) -> None:
        wrong = self.corners[(self.corners < 0) | (self.corners >= len(self.vertices))]
        if len(wrong):
            raise ValueError(
                f"a face must use the file's {len(self.vertices)} vertices, but one uses number {wrong[0]} "
                f"counted from 0, {wrong[0] + 1} from 1; export or copy it again"
            )

    @property
    def triangles(self) -> Int[np.ndarray, "t 3"]:
        """The vertices of the triangles that fill the polygons."""
        return self.corners[self.cuts[0]]

    @cached_property
    def cuts(self) -> tuple[Int[np.ndarray, "t 3"], Int[np.ndarray, " t"]]:
        """Triangles that fill the polygons, in the polygons' order, as indices into `corners`; the polygon of each.

        A polygon that is a fan about its first corner becomes that fan, others are cut at ears. Corners on a straight
        edge are kept, since a neighbour may use them. Polygons with fewer than three corners are left out.
        """
        starts = np.cumsum(self.counts) - self.counts
        triangles, owners = [np.empty((0, 3), np.int64)], [np.empty(0, np.int64)]
        for count in np.unique(self.counts[self.counts >= 3]).tolist():
            same_count = np.flatnonzero(self.counts == count)
            loops = starts[same_count, None] + np.arange(count)
            cut = loops[:, fan(count)]
            if count > 3:
                positions = self.vertices[self.corners[loops]]
                concave = np.flatnonzero(~_is_fan(positions))
                cut[concave] = loops[concave[:, None, None], ears(_in_plane(positions[concave]))]
            triangles.append(cut.reshape(-1, 3))
            owners.append(np.repeat(same_count, count - 2))
        owner = np.concatenate(owners)
        order = np.argsort(owner, kind="stable")
        return np.concatenate(triangles)[order], owner[order]

    @property
    def shaded(self) -> Float[np.ndarray, "v 3"] | None:
        """RGB of each vertex: its own colour, or the mean colour of its triangles; None without colours."""
        if self.vertex_colours is not None or self.face_colours is None:
            return self.vertex_colours
        triangles, owner = self.triangles, self.cuts[1]
        counts = np.bincount(triangles.ravel(), minlength=len(self.vertices)).clip(1)
        bands = np.repeat(self.face_colours[owner], 3, axis=0).T
        sums = [np.bincount(triangles.ravel(), weights=band, minlength=len(self.vertices)) for band in bands]
        return np.stack(sums, axis=1) / counts[:, None]


def scale_colours(colours: Float[np.ndarray, "n 3"], brightest: float | None = None) -> Float[np.ndarray, "n 3"]:
    """Scales colours to 0 to 1. Without `brightest`, the brightest number is 255 if any number exceeds 1, else 1."""
    return (colours / (brightest or (255 if (colours > 1).any() else 1))).clip(0, 1)


def fan(count: int) -> Int[np.ndarray, "t 3"]:
    """The triangles of a polygon with `count` corners, all about its first corner."""
    return np.array([(0, 1, 2), *((i - 1, i, 0) for i in range(3, count))])


def cut_strips(corners: Int[np.ndarray, " m"], counts: Int[np.ndarray, " n"]) -> Int[np.ndarray, "t 3"]:
    """The triangles of strips with `counts` corners each, every second one reversed; a corner -1 restarts a strip."""
    sequence = np.insert(corners, np.cumsum(counts), -1)
    position = np.arange(len(sequence))
    strip_start = np.maximum.accumulate(np.where(sequence < 0, position + 1, 0))
    triples = np.stack([sequence, np.roll(sequence, -1), np.roll(sequence, -2)], axis=1)  # the last is -1
    turned = (position - strip_start)[:, None] % 2 == 1
    triangles = np.where(turned, triples[:, [1, 0, 2]], triples)
    distinct = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    return triangles[(triples >= 0).all(axis=1) & distinct]


def _fan_normals(positions: Float[np.ndarray, "*p c 3"]) -> Float[np.ndarray, "*p t 3"]:
    """Normals of the triangles about the first corner; the lengths are twice the triangles' areas."""
    spokes = positions[..., 1:, :] - positions[..., :1, :]
    return np.cross(spokes[..., :-1, :], spokes[..., 1:, :])


def _is_fan(positions: Float[np.ndarray, "p c 3"]) -> np.ndarray:
    """True for polygons whose triangles about the first corner all have the polygon's orientation."""
    normals = _fan_normals(positions)
    total = normals.sum(axis=1, keepdims=True)
    return ((normals * total).sum(axis=-1) > MIN_AREA_FRACTION * (total**2).sum(axis=-1)).all(axis=1)


def _in_plane(positions: Float[np.ndarray, "p c 3"]) -> Float[np.ndarray, "p c 2"]:
    """Polygons projected along their normals (Newell's method), so that they wind anticlockwise."""
    normals = _fan_normals(positions).sum(axis=1)
    right = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
    axes = np.stack([right, np.cross(normals, right)], axis=2)
    lengths = np.linalg.norm(axes, axis=1, keepdims=True)
    return (positions - positions[:, :1]) @ np.divide(axes, lengths, out=np.zeros_like(axes), where=lengths > 0)


def ears(points: Float[np.ndarray, "p c 2"]) -> Int[np.ndarray, "p t 3"]:
    """Cuts simple anticlockwise polygons at ears into triangles that are not flat, unlike those of mapbox_earcut."""
    remaining, cut_ears = np.tile(np.arange(points.shape[1]), (len(points), 1)), []
    while (count := remaining.shape[1]) > 3:
        ear = _choose_ears(np.take_along_axis(points, remaining[..., None], axis=1))[:, None]
        cut_ears.append(np.take_along_axis(remaining, (ear + np.arange(-1, 2)) % count, axis=1))
        remaining = remaining[np.arange(count) != ear].reshape(-1, count - 1)
    return np.stack([*cut_ears, remaining], axis=1)


def _choose_ears(points: Float[np.ndarray, "p c 2"]) -> Int[np.ndarray, " p"]:
    """The corner with the shortest cut whose triangle contains no other corner; without one, the largest triangle's."""
    before, after = np.roll(points, 1, axis=1), np.roll(points, -1, axis=1)
    corners = np.stack([before, points, after], axis=2)
    turns = _signed_areas(before, points, after)
    tolerance = MIN_AREA_FRACTION * np.ptp(points, axis=1).max(axis=1, keepdims=True) ** 2
    best, pending = turns.argmax(axis=1), np.arange(len(points))
    cuts = np.where(turns > tolerance, ((after - before) ** 2).sum(axis=2), np.inf)
    for ear in cuts.argsort(axis=1, kind="stable").T:
        pending = pending[np.isfinite(cuts[pending, ear[pending]])]
        if not len(pending):
            break
        ear, polygon = ear[pending], points[pending]
        triangle = corners[pending, ear][:, :, None]
        areas = np.array([_signed_areas(triangle[:, j - 1], triangle[:, j], polygon) for j in range(3)])
        inside = (areas >= -tolerance[pending]).all(axis=0)
        free = ~(inside & (polygon[:, None] != triangle).any(axis=3).all(axis=1)).any(axis=1)
        best[pending[free]] = ear[free]
        pending = pending[~free]
    return best


def _signed_areas(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Twice the areas of triangles in the plane, positive if they wind anticlockwise."""
    ab, ac = b - a, c - a
    return ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0]
