"""A folder of range scans of a sphere in Stanford's layout: poses, points, and the complete surface."""

from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

RADIUS, CENTRE = 0.2, np.array([0.3, -0.1, 0.05])
TURNS = (0.0, 90.0, 200.0)  # degrees of the scanner about y


def scanned_from(turn: float, noise: float) -> tuple[np.ndarray, Rotation, np.ndarray]:
    """Points of the half of the sphere that a scanner sees, in the scanner's axes, and the motion to the world."""
    draw = np.random.default_rng(int(turn))
    points = draw.normal(size=(20000, 3))
    points[:, 2] = np.abs(points[:, 2])
    points *= (RADIUS + noise * draw.normal(size=(len(points), 1))) / np.linalg.norm(points, axis=1, keepdims=True)
    to_world, shift = Rotation.from_euler("y", turn, degrees=True), np.array([0.01, 0.02, turn / 1000])
    return points + to_world.inv().apply(CENTRE - shift), to_world, shift


def write_scans(folder: Path, noise: float = 0.0) -> Path:
    lines = ["camera 0 -0.1 -0.7 0 1 0 0", "mesh whole_cylinder 0 0 0 0 0 0 1", ""]
    for turn in TURNS:
        points, to_world, shift = scanned_from(turn, noise)
        trimesh.PointCloud(points).export(folder / f"scan_{turn:g}.ply")
        numbers = [*shift, *to_world.inv().as_quat()]
        lines.append(f"bmesh scan_{turn:g}.ply {' '.join(map(str, numbers))}")
    (folder / "ball.conf").write_text("\n".join(lines))
    ball = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS).apply_translation(CENTRE)
    ball.export(folder / "ball_whole.ply")
    return folder
