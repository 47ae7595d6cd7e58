"""Polygons in space as files have them, concave ones too, and their triangles."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

FLAT = 1e-12  # of a polygon's area: a triangle with less is flat, and a point by so much outside is on the edge


@dataclass(frozen=True)
class Polygons:
    """Vertices and the polygons between them.

    Args:
        vertices: in the file's units.
        counts: number of corners of each polygon.
        corners: the vertices of all polygons, one polygon after the other.
        vertex_colours: RGB from 0 to 1.
        face_colours: RGB from 0 to 1.

    Raises:
        ValueError: where a corner is no vertex.
    """

    vertices: Float[np.ndarray, "v 3"]
    counts: Int[np.ndarray, " p"]
    corners: Int[np.ndarray, " c"]
    vertex_colours: Float[np.ndarray, "v 3"] | None = None
    face_colours: Float[np.ndarray, "p 3"] | None = None

    def __post_init__(self) -> None:
        wrong = self.corners[(self.corners < 0) | (self.corners >= len(self.vertices))]
        if len(wrong):
            raise ValueError(
                f"a face must use the file's {len(self.vertices)} vertices, but one uses number {wrong[0]} "
                f"counted from 0, {wrong[0] + 1} from 1; export or copy it again"
            )

    def triangles(self) -> tuple[Int[np.ndarray, "t 3"], Int[np.ndarray, " t"]]:
        """Triangles that fill the polygons, in their order, and the polygon of each.

        A polygon that is a fan about its first corner becomes that fan, others are cut at ears. Corners on a straight
        edge are kept, since a neighbour may use them. What has fewer than three corners is left out.
        """
        starts = np.cumsum(self.counts) - self.counts
        triangles, owners = [np.empty((0, 3), np.int64)], [np.empty(0, np.int64)]
        for count in np.unique(self.counts[self.counts >= 3]).tolist():
            alike = np.flatnonzero(self.counts == count)
            loops = self.corners[starts[alike, None] + np.arange(count)]
            cut = loops[:, fan(count)]
            if count > 3:
                places = self.vertices[loops]
                for i in np.flatnonzero(~_is_fan(places)):
                    cut[i] = loops[i][ears(_in_plane(places[i]))]
            triangles.append(cut.reshape(-1, 3))
            owners.append(np.repeat(alike, count - 2))
        owner = np.concatenate(owners)
        order = np.argsort(owner, kind="stable")
        return np.concatenate(triangles)[order], owner[order]


def shades(colours: Float[np.ndarray, "n 3"], full: float | None = None) -> Float[np.ndarray, "n 3"]:
    """Colours from 0 to 1. Where the brightest, `full`, is not known, it is 255 if a number is above 1, and else 1."""
    return colours / (full or (255 if (colours > 1).any() else 1))


def fan(count: int) -> Int[np.ndarray, "t 3"]:
    """The triangles about the first corner of a polygon."""
    return np.array([(0, 1, 2), *((i - 1, i, 0) for i in range(3, count))])


def _crosses(places: Float[np.ndarray, "*p c 3"]) -> Float[np.ndarray, "*p t 3"]:
    """Normals of the triangles about the first corner, as long as twice their areas."""
    spokes = places[..., 1:, :] - places[..., :1, :]
    return np.cross(spokes[..., :-1, :], spokes[..., 1:, :])


def _is_fan(places: Float[np.ndarray, "p c 3"]) -> np.ndarray:
    """True for polygons whose triangles about the first corner all face the polygon's way."""
    crosses = _crosses(places)
    normals = crosses.sum(axis=1, keepdims=True)
    return ((crosses * normals).sum(axis=-1) > FLAT * (normals**2).sum(axis=-1)).all(axis=1)


def _in_plane(places: Float[np.ndarray, "c 3"]) -> Float[np.ndarray, "c 2"]:
    """A polygon seen along its normal (Newell's), from where it winds anticlockwise."""
    normal = _crosses(places).sum(axis=0)
    right = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    axes = np.stack([right, np.cross(normal, right)])
    lengths = np.linalg.norm(axes, axis=1, keepdims=True)
    return (places - places[0]) @ np.divide(axes, lengths, out=np.zeros_like(axes), where=lengths > 0).T


def ears(points: Float[np.ndarray, "c 2"]) -> Int[np.ndarray, "t 3"]:
    """The triangles of a simple polygon that winds anticlockwise: corners of which nothing is behind are cut off.

    None is flat, also beside corners on a straight edge. mapbox_earcut leaves flat ones there.
    """
    left, found = list(range(len(points))), []
    while len(left) > 3:
        place = _ear(points[left])
        found.append((left[place - 1], left[place], left[(place + 1) % len(left)]))
        del left[place]
    return np.array([*found, left])


def _ear(points: Float[np.ndarray, "c 2"]) -> int:
    """The corner with the shortest cut behind which no other corner lies; the widest of a polygon that has none."""
    before, after = np.roll(points, 1, axis=0), np.roll(points, -1, axis=0)
    turns = _turn(before, points, after)
    least = FLAT * np.ptp(points, axis=0).max() ** 2
    for i in np.argsort(((after - before) ** 2).sum(axis=1)):
        if turns[i] <= least:
            continue
        corners = np.stack([before[i], points[i], after[i]])
        inside = np.all([_turn(corners[j - 1], corners[j], points) >= -least for j in range(3)], axis=0)
        if not (inside & (points[:, None] != corners).any(axis=2).all(axis=1)).any():
            return int(i)
    return int(np.argmax(turns))


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Twice the areas of triangles in the plane, positive where they wind anticlockwise."""
    ab, ac = b - a, c - a
    return ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0]
