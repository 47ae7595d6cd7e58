"""Surfaces of photographs without a renderer: depths fused by screened Poisson, and colours from photographs."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import map_coordinates

from bench.evaluate.state import DEFAULT_VERTEX_COLOUR, render_vertex_colours
from bench.reconstruct.stereo import Cloud
from bench.reconstruct.subject import Subject, visible, within
from datasets.mesh import Mesh
from datasets.meshes import read_points
from datasets.repair import needed_meshlab
from datasets.scene import Surface, Truth, View, see
from datasets.shot import Shot
from renderers.camera import Camera
from renderers.checks import BadInput

NEIGHBOURS = 16  # points whose plane gives a normal
OUTLYING = 2.0  # standard deviations of the mean distance to neighbours, beyond which a point is left out
IN_FRONT = 0.05  # scene units: how much nearer another point of a pixel is, that hides one
FAR = 1e4  # beyond all cameras that see a point
FACING = 4.0  # power of the cosine between normal and view direction, by which photographs are weighted


def given_clouds(shots: Sequence[Shot]) -> list[Cloud]:
    """The points of all given depths."""
    return [
        Cloud(shot.camera.rays().at(shot.camera.distance(shot.depth))[shot.depth > 0].double().numpy(), shot.camera)
        for shot in shots
        if shot.depth is not None
    ]


def measured_clouds(path: str, subject: Subject) -> list[Cloud]:
    """The points of a file that lie in the unit sphere, each with the nearest given camera that sees it.

    Where photographs have masks, those more than a pixel of this run outside of one are left out (DVR, Sec. 4.2).

    Raises:
        BadInput: where it is no cloud of points, or lies elsewhere.
    """
    points = read_points(path)
    if points is None:
        raise BadInput(f"task.cloud={path} has faces: give a cloud of points, or judge it by python -m bench.judge")
    points = within(points, np.eye(4) if subject.to_world is None else subject.to_world)
    if not len(points):
        raise BadInput(
            f"nothing of task.cloud={path} lies in the unit sphere of the photographs: give it in their cameras' world"
        )
    if all(shot.mask is not None for shot in subject.given):
        where = torch.from_numpy(points).float()
        points = points[torch.stack([shot.allows(where, margin=1.0) for shot in subject.given]).all(0).numpy()]
    cameras = [shot.camera for shot in subject.given]
    seeing = _seeing(torch.from_numpy(points).float(), cameras).numpy()
    return [Cloud(points[seeing == place], camera) for place, camera in enumerate(cameras)]


def _seeing(points: Float[torch.Tensor, "n 3"], cameras: Sequence[Camera]) -> Int[torch.Tensor, " n"]:
    """The nearest camera that sees each point, none of its pixel being in front; the nearest where none does."""
    least, seeing = torch.full((len(points),), torch.inf), torch.zeros(len(points), dtype=torch.long)
    for place, camera in enumerate(cameras):
        pixels, depth = camera.project(points)
        inside = camera.shows(points)
        column, row = torch.where(inside[:, None], pixels, 0.0).long().T
        pixel = row * (camera.width + 1) + column
        front = torch.full(((camera.height + 1) * (camera.width + 1),), torch.inf)
        front.scatter_reduce_(0, pixel, torch.where(inside, depth, torch.inf), "amin")
        hidden = ~inside | (depth > front[pixel] + IN_FRONT)
        distance = torch.linalg.vector_norm(points - camera.center, dim=-1) + torch.where(hidden, FAR, 0.0)
        seeing[distance < least] = place
        least = torch.minimum(least, distance)
    return seeing


def fused(clouds: Sequence[Cloud]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """All points but outliers, and normals of their neighbourhoods that look at their cameras."""
    import open3d

    points = np.concatenate([np.zeros((0, 3)), *(cloud.points for cloud in clouds)])
    centres = [np.broadcast_to(cloud.camera.center.double().numpy(), cloud.points.shape) for cloud in clouds]
    if len(points) < NEIGHBOURS:
        return points, np.zeros_like(points)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    _, kept = cloud.remove_statistical_outlier(NEIGHBOURS, OUTLYING)
    cloud = cloud.select_by_index(kept)
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))
    points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    facing = (normals * (np.concatenate(centres)[kept] - points)).sum(axis=1, keepdims=True)
    return points, np.where(facing < 0, -normals, normals)


def poisson(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], *, depth: int, trim: float
) -> Mesh | None:
    """The surface of points by screened Poisson reconstruction (Kazhdan and Hoppe 2013); None without one.

    Args:
        points: in scene units.
        normals: outward.
        depth: of the octree.
        trim: least depth of the octree's leaf whose points support a vertex; 0 keeps all. DVR's Table 2 has 0, 5 and 7.
    """
    lab = needed_meshlab("screened Poisson reconstruction")
    if len(points) < NEIGHBOURS:
        return None
    meshes = lab.MeshSet()
    meshes.add_mesh(lab.Mesh(vertex_matrix=points, v_normals_matrix=normals))
    meshes.generate_surface_reconstruction_screened_poisson(depth=depth, threads=1)
    made = meshes.current_mesh()
    faces = made.face_matrix()
    if trim and len(faces):
        faces = faces[(made.vertex_scalar_array() >= trim)[faces].all(axis=1)]
    return Mesh(made.vertex_matrix(), faces).compact() if len(faces) else None


def with_colours(mesh: Mesh, shots: Sequence[Shot]) -> Mesh:
    """The mesh with the mean colours of the photographs that see a vertex, those that face it before all others."""
    scene = Truth(mesh, closed=False)
    normals = np.zeros_like(mesh.vertices)
    np.add.at(normals, mesh.faces.ravel(), np.repeat(mesh.crosses, 3, axis=0))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    total, weights = np.zeros_like(mesh.vertices), np.zeros((len(mesh.vertices), 1))
    for shot in shots:
        towards = shot.camera.center.double().numpy() - mesh.vertices
        cosine = (normals * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
        weight = (visible(scene, shot, Surface(mesh.vertices, normals)) * cosine.clip(0) ** FACING)[:, None]
        pixels = shot.camera.project(torch.from_numpy(mesh.vertices).float())[0].double().numpy() - 0.5
        places = np.nan_to_num(pixels).T[::-1]
        image = shot.colours.numpy()
        seen = [map_coordinates(image[..., band], places, order=1, mode="nearest") for band in range(3)]
        total, weights = total + weight * np.stack(seen, axis=1), weights + weight
    return replace(mesh, colours=np.where(weights > 0, total / np.maximum(weights, 1e-12), DEFAULT_VERTEX_COLOUR))


def painter(mesh: Mesh) -> Callable[[Camera], tuple[View, Float[torch.Tensor, "height width 3"]]]:
    """Gives a camera's view of a mesh, and its colours as `bench.evaluate.state.render_vertex_colours` has them."""
    scene = Truth(mesh, closed=False)
    return lambda camera: (see(scene, camera), torch.from_numpy(render_vertex_colours(mesh, scene, camera)).float())
