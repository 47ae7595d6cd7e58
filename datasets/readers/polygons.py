"""Polygons in space as files have them, concave ones too, their triangles, and their materials."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

FLAT = 1e-12  # of a polygon's area: a triangle with less is flat, and a point by so much outside is on the edge
WHITE = (1.0, 1.0, 1.0)  # beside an image, which has the colour


@dataclass(frozen=True)
class Material:
    """What a file says of the colour of some polygons.

    Args:
        name: in the .mtl files that an .obj names; "" where the file itself has the material.
        colour: RGB from 0 to 1, in place of the vertices' colours; None without one.
        image: the content of an image file, or where that file is; the image multiplies the colour.
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
        corners: the vertices of all polygons, one polygon after the other.
        vertex_colours: RGB from 0 to 1.
        face_colours: RGB from 0 to 1.
        coordinates: of each corner in the image of its material, u to the right and v upward; NaN without any.
        materials: of the file.
        material: the number of each polygon's material; -1 without one.

    Raises:
        ValueError: where a corner is no vertex.
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
        """Triangles that fill the polygons, in their order, by places in `corners`, and the polygon of each.

        A polygon that is a fan about its first corner becomes that fan, others are cut at ears. Corners on a straight
        edge are kept, since a neighbour may use them. What has fewer than three corners is left out.
        """
        starts = np.cumsum(self.counts) - self.counts
        triangles, owners = [np.empty((0, 3), np.int64)], [np.empty(0, np.int64)]
        for count in np.unique(self.counts[self.counts >= 3]).tolist():
            alike = np.flatnonzero(self.counts == count)
            loops = starts[alike, None] + np.arange(count)
            cut = loops[:, fan(count)]
            if count > 3:
                places = self.vertices[self.corners[loops]]
                others = np.flatnonzero(~_is_fan(places))
                cut[others] = loops[others[:, None, None], ears(_in_plane(places[others]))]
            triangles.append(cut.reshape(-1, 3))
            owners.append(np.repeat(alike, count - 2))
        owner = np.concatenate(owners)
        order = np.argsort(owner, kind="stable")
        return np.concatenate(triangles)[order], owner[order]

    @property
    def shaded(self) -> Float[np.ndarray, "v 3"] | None:
        """RGB of each vertex, if it or its faces have some: then the mean of its triangles'."""
        if self.vertex_colours is not None or self.face_colours is None:
            return self.vertex_colours
        triangles, owner = self.triangles, self.cuts[1]
        counts = np.bincount(triangles.ravel(), minlength=len(self.vertices)).clip(1)
        bands = np.repeat(self.face_colours[owner], 3, axis=0).T
        sums = [np.bincount(triangles.ravel(), weights=band, minlength=len(self.vertices)) for band in bands]
        return np.stack(sums, axis=1) / counts[:, None]


def shades(colours: Float[np.ndarray, "n 3"], full: float | None = None) -> Float[np.ndarray, "n 3"]:
    """Colours from 0 to 1. Where the brightest, `full`, is not known, it is 255 if a number is above 1, and else 1."""
    return (colours / (full or (255 if (colours > 1).any() else 1))).clip(0, 1)


def fan(count: int) -> Int[np.ndarray, "t 3"]:
    """The triangles about the first corner of a polygon."""
    return np.array([(0, 1, 2), *((i - 1, i, 0) for i in range(3, count))])


def cut_strips(corners: Int[np.ndarray, " m"], counts: Int[np.ndarray, " n"]) -> Int[np.ndarray, "t 3"]:
    """The triangles of strips with so many corners each, every second one turned; -1 begins a strip anew."""
    numbers = np.insert(corners, np.cumsum(counts), -1)
    place = np.arange(len(numbers))
    begin = np.maximum.accumulate(np.where(numbers < 0, place + 1, 0))
    three = np.stack([numbers, np.roll(numbers, -1), np.roll(numbers, -2)], axis=1)  # the last is -1
    turned = (place - begin)[:, None] % 2 == 1
    triangles = np.where(turned, three[:, [1, 0, 2]], three)
    distinct = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    return triangles[(three >= 0).all(axis=1) & distinct]


def _crosses(places: Float[np.ndarray, "*p c 3"]) -> Float[np.ndarray, "*p t 3"]:
    """Normals of the triangles about the first corner, as long as twice their areas."""
    spokes = places[..., 1:, :] - places[..., :1, :]
    return np.cross(spokes[..., :-1, :], spokes[..., 1:, :])


def _is_fan(places: Float[np.ndarray, "p c 3"]) -> np.ndarray:
    """True for polygons whose triangles about the first corner all face the polygon's way."""
    crosses = _crosses(places)
    normals = crosses.sum(axis=1, keepdims=True)
    return ((crosses * normals).sum(axis=-1) > FLAT * (normals**2).sum(axis=-1)).all(axis=1)


def _in_plane(places: Float[np.ndarray, "p c 3"]) -> Float[np.ndarray, "p c 2"]:
    """Polygons seen along their normals (Newell's), from where they wind anticlockwise."""
    normals = _crosses(places).sum(axis=1)
    right = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
    axes = np.stack([right, np.cross(normals, right)], axis=2)
    lengths = np.linalg.norm(axes, axis=1, keepdims=True)
    return (places - places[:, :1]) @ np.divide(axes, lengths, out=np.zeros_like(axes), where=lengths > 0)


def ears(points: Float[np.ndarray, "p c 2"]) -> Int[np.ndarray, "p t 3"]:
    """The triangles of simple polygons that wind anticlockwise: corners of which nothing is behind are cut off.

    None is flat, also beside corners on a straight edge. mapbox_earcut leaves flat ones there.
    """
    left, found = np.tile(np.arange(points.shape[1]), (len(points), 1)), []
    while (count := left.shape[1]) > 3:
        ear = _ears(np.take_along_axis(points, left[..., None], axis=1))[:, None]
        found.append(np.take_along_axis(left, (ear + np.arange(-1, 2)) % count, axis=1))
        left = left[np.arange(count) != ear].reshape(-1, count - 1)
    return np.stack([*found, left], axis=1)


def _ears(points: Float[np.ndarray, "p c 2"]) -> Int[np.ndarray, " p"]:
    """The corner with the shortest cut behind which no other corner lies; the widest of a polygon that has none."""
    before, after = np.roll(points, 1, axis=1), np.roll(points, -1, axis=1)
    corners = np.stack([before, points, after], axis=2)
    turns = _turn(before, points, after)
    least = FLAT * np.ptp(points, axis=1).max(axis=1, keepdims=True) ** 2
    found, open_ = turns.argmax(axis=1), np.arange(len(points))
    cuts = np.where(turns > least, ((after - before) ** 2).sum(axis=2), np.inf)
    for ear in cuts.argsort(axis=1, kind="stable").T:
        open_ = open_[np.isfinite(cuts[open_, ear[open_]])]
        if not len(open_):
            break
        ear, others = ear[open_], points[open_]
        three = corners[open_, ear][:, :, None]
        inside = np.all([_turn(three[:, j - 1], three[:, j], others) >= -least[open_] for j in range(3)], axis=0)
        free = ~(inside & (others[:, None] != three).any(axis=3).all(axis=1)).any(axis=1)
        found[open_[free]] = ear[free]
        open_ = open_[~free]
    return found


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Twice the areas of triangles in the plane, positive where they wind anticlockwise."""
    ab, ac = b - a, c - a
    return ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0]
