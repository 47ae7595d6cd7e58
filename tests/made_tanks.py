"""A scene in the files of Tanks and Temples: a bumpy sphere, its crop volume, and a mesh of it with faults."""

import json
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from datasets.mesh import Mesh
from tests.tiny import icosphere

NAME, THRESHOLD, RADIUS = "Barn", 0.01, 0.25
POLYGON = ((-0.4, -0.4), (0.4, -0.4), (0.4, 0.05), (0.1, 0.1), (0.1, 0.4), (-0.4, 0.4))  # x and z, not convex
HEIGHTS = (-0.2, 0.5)  # y: the lowest part of the sphere is outside
CAMERAS = 24
HOLE = np.array([-0.15, 0.2, 0.0])  # in the mesh, where the crop volume is


def bumpy(points: np.ndarray) -> np.ndarray:
    """Points of a sphere, moved along its radius."""
    x, y, z = (points / np.linalg.norm(points, axis=1, keepdims=True)).T
    bumps = 0.12 * np.sin(5 * x + 1) + 0.1 * np.cos(6 * y * z) + 0.05 * z
    return points * (1 + bumps)[:, None]


def motion(degrees: float, shift: tuple[float, float, float], scale: float) -> np.ndarray:
    """A similarity."""
    matrix = np.eye(4)
    matrix[:3, :3] = scale * Rotation.from_rotvec(np.radians(degrees) * np.array([0.36, 0.48, 0.8])).as_matrix()
    matrix[:3, 3] = shift
    return matrix


def moved(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


MESH_TO_SCAN = motion(70, (3, -2, 5), 4.0)  # exact; trajectories have it with errors
CAMERAS_TO_SCAN = motion(-130, (-1, 4, 2), 0.3)


def write_scene(folder: Path) -> Path:
    """Writes the scan, its crop volume, the scene's cameras and their matrix to the scan into the folder `Barn`."""
    folder = folder / NAME
    folder.mkdir(parents=True)
    random = np.random.default_rng(0)
    directions = random.standard_normal((60_000, 3))
    scan = bumpy(RADIUS * directions / np.linalg.norm(directions, axis=1, keepdims=True))
    clutter = random.uniform(-0.6, 0.6, (3000, 3)) + np.array([0, 1.3, 0])
    trimesh.PointCloud(np.concatenate([scan, clutter])).export(folder / f"{NAME}.ply")
    polygon = [[x, 0.0, z] for x, z in POLYGON]
    volume = {"class_name": "SelectionPolygonVolume", "orthogonal_axis": "Y", "bounding_polygon": polygon}
    volume |= {"axis_min": HEIGHTS[0], "axis_max": HEIGHTS[1], "version_major": 1, "version_minor": 0}
    (folder / f"{NAME}.json").write_text(json.dumps(volume))
    write_log(folder / f"{NAME}_COLMAP_SfM.log", moved(centres(), np.linalg.inv(CAMERAS_TO_SCAN)))
    np.savetxt(folder / f"{NAME}_trans.txt", CAMERAS_TO_SCAN)
    return folder


def centres() -> np.ndarray:
    """The centres of cameras in the scan's world, on a spiral."""
    turns = np.linspace(0, 4 * np.pi, CAMERAS)
    return np.stack([2 * np.cos(turns), 0.2 * turns, 2 * np.sin(turns)], axis=1)


def write_log(path: Path, positions: np.ndarray) -> None:
    """Writes a trajectory whose cameras are not turned."""
    lines = []
    for index, position in enumerate(positions):
        pose = np.eye(4)
        pose[:3, 3] = position
        lines += [f"{index} {index} 0", *(" ".join(f"{x:.12f}" for x in row) for row in pose)]
    path.write_text("\n".join(lines) + "\n")


def estimated_centres() -> np.ndarray:
    """The cameras in the mesh's world, with errors of 1 cm in the scan's, and three that have no pose."""
    errors = np.random.default_rng(1).normal(0, 0.01, (CAMERAS, 3))
    positions = moved(centres() + errors, np.linalg.inv(MESH_TO_SCAN))
    positions[[3, 11, 17]] = 0
    return positions


def faulty(subdivisions: int = 6) -> Mesh:
    """The sphere with noise, a hole, and a part outside of the crop volume, in the scan's world, not aligned."""
    sphere = icosphere(RADIUS, np.zeros(3), subdivisions)
    surface = bumpy(sphere.vertices)
    noise = np.random.default_rng(2).normal(0, 0.006, surface.shape)
    hole = np.linalg.norm(surface[sphere.faces].mean(axis=1) - HOLE, axis=1) < 0.12
    stray = icosphere(0.1, np.array([1.0, 0.0, 0.0]), 3)
    faces = np.concatenate([sphere.faces[~hole], stray.faces + len(surface)])
    return (
        Mesh(np.concatenate([surface + noise, stray.vertices]), faces)
        .compact()
        .moved(motion(2, (0.01, -0.01, 0), 1.01))
    )
