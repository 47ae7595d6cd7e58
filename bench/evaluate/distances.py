"""The distances between the points of a mesh and those of its truth."""

from dataclasses import dataclass
from math import inf

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from bench.evaluate.evaluate import surface_metrics
from datasets.mesh import Mesh
from datasets.scene import Surface, sample_surface

SURFACE_UP = np.array([0.0, 1.0, 0.0])
COLOUR_END = 3.0  # distance of the last colour of pictures, as a multiple of the threshold


@dataclass(frozen=True)
class Distances:
    """The points at which a mesh and its truth are compared, with their distances to the other surface.

    Args:
        mesh: points of the mesh that count.
        mesh_to_truth: distance of each; infinite where a protocol leaves it out.
        truth: points of the truth that count.
        truth_to_mesh: distance of each.
        unit: of all lengths, such as mm.
        threshold: of precision, recall and F-score; None without one.
        up: upright axis of pictures, of any length.
        colour_end: distance of the last colour.
    """

    mesh: Float[np.ndarray, "m 3"]
    mesh_to_truth: Float[np.ndarray, " m"]
    truth: Float[np.ndarray, "n 3"]
    truth_to_mesh: Float[np.ndarray, " n"]
    unit: str
    threshold: float | None
    up: Float[np.ndarray, "3"]
    colour_end: float

    @property
    def extent(self) -> float:
        return float(np.linalg.norm(np.ptp(self.truth, axis=0)))

    def shares(self, limits: Float[np.ndarray, " k"]) -> tuple[Float[np.ndarray, " k"], ...]:
        """Precision and recall, the shares of points closer than each limit, and the F-score, from 0 to 1."""
        precision, recall = (
            np.searchsorted(np.sort(values), limits) / max(len(values), 1)
            for values in (self.mesh_to_truth, self.truth_to_mesh)
        )
        both = precision + recall
        return precision, recall, 2 * precision * recall / np.where(both > 0, both, 1)


def cloud_metrics(predicted: Surface | None, points: Float[np.ndarray, "n 3"], *, threshold: float) -> dict[str, float]:
    """The metrics of `surface_metrics` that need no normals, for a truth that is a point cloud."""
    metrics = surface_metrics(predicted, Surface(points, np.zeros_like(points)), threshold=threshold)
    del metrics["normal_consistency"]
    return metrics


def subsample(points: Float[np.ndarray, "n 3"], count: int, seed: int) -> Float[np.ndarray, "m 3"]:
    """At most `count` random points of a cloud."""
    return points if len(points) <= count else np.random.default_rng(seed).choice(points, count, replace=False)


def surface_protocol(points: int, threshold: str, *, has_faces: bool) -> list[str]:
    """How the metrics against a true surface, or a cloud of its points, are computed, in words.

    Args:
        points: sampled on each surface.
        threshold: of the F-score, in words.
        has_faces: whether the truth is a surface.
    """
    sampling = (
        "random points on each surface, uniform by area; distances to the nearest point of the other surface"
        if has_faces
        else "random points of the mesh, uniform by area, and at most as many of the truth's points; distances to the "
        "nearest point of the other; no normals, since the truth has no faces"
    )
    return [
        f"{points} {sampling}",
        "accuracy, completeness: mean distance from mesh to truth, from truth to mesh; chamfer_l1: their mean; "
        "chamfer_l2: sum of the two means of squared distances; chamfer_gt_to_pred: the mean from truth to mesh alone",
        f"fscore: harmonic mean of the shares of points, per surface, whose distance is below {threshold}",
    ]


def measure_distances(
    mesh: Mesh,
    truth: Mesh | Float[np.ndarray, "k 3"],
    *,
    count: int,
    seed: int,
    threshold: float,
    unit: str,
    limit: float = inf,
) -> Distances:
    """The distances between random points of a mesh and those of a true mesh, or of a cloud of true points.

    Args:
        limit: larger distances are taken as this one, which is faster: far surfaces have many points as near as each
            other.
    """
    predicted = sample_surface(mesh, count, seed + 1).points
    true = sample_surface(truth, count, seed).points if isinstance(truth, Mesh) else subsample(truth, count, seed)
    to_truth, to_mesh = (
        np.minimum(cKDTree(points).query(queries, distance_upper_bound=limit)[0], limit)
        for points, queries in ((true, predicted), (predicted, true))
    )
    return Distances(predicted, to_truth, true, to_mesh, unit, threshold, SURFACE_UP, COLOUR_END * threshold)
