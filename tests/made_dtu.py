"""A scan in DTU's folders: points of a sphere of 20 mm, the mask of observed cells, and the plane of a table."""

from pathlib import Path

import numpy as np
import trimesh
from scipy.io import savemat

from datasets.mesh import Mesh
from tests.tiny import icosphere

CENTRE, RADIUS, NUMBER = np.array([3.0, -7.0, 600.0]), 20.0, 65


def ball(radius: float = RADIUS, centre=CENTRE, subdivisions: int = 4) -> Mesh:
    return icosphere(radius, centre, subdivisions)


def solid() -> Mesh:
    """An ellipsoid with a knob, without any symmetry."""
    ellipsoid, knob = ball(1.0, (0, 0, 0)), ball(0.25, (0.6, 0.35, 0.2))
    vertices = np.concatenate([ellipsoid.vertices * (1.0, 0.6, 0.35), knob.vertices])
    return Mesh(vertices, np.concatenate([ellipsoid.faces, knob.faces + len(ellipsoid.vertices)]))


def write_dtu(folder: Path, points: np.ndarray, *, reach: float = 25.0, plane=(0, 0, 1, -590), centre=CENTRE):
    """Writes a scan whose observed cells of 2 mm are those within `reach` of the centre."""
    for name in ("Points/stl", "ObsMask"):
        (folder / name).mkdir(parents=True)
    trimesh.PointCloud(points).export(folder / f"Points/stl/stl{NUMBER:03d}_total.ply")
    axes = [middle + np.arange(-30, 31, 2.0) for middle in centre]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    observed = (np.linalg.norm(cells - centre, axis=-1) <= reach).astype(np.uint8)
    grid = {"ObsMask": observed, "BB": np.stack([centre - 30, centre + 30]), "Res": np.array([[2.0]])}
    savemat(folder / f"ObsMask/ObsMask{NUMBER}_10.mat", grid)
    savemat(folder / f"ObsMask/Plane{NUMBER}.mat", {"P": np.array(plane, dtype=float)[:, None]})


def on_ball(count: int, radius: float = RADIUS) -> np.ndarray:
    points = np.random.default_rng(0).standard_normal((count, 3))
    return CENTRE + radius * points / np.linalg.norm(points, axis=1, keepdims=True)
