"""Surfaces without a renderer: depths fused by screened Poisson reconstruction, and colours from photographs."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import map_coordinates

from bench.evaluate.colours import DEFAULT_VERTEX_COLOUR, render_vertex_colours
from bench.tasks.reconstruction.stereo import Cloud, allowed_by_mask
from bench.tasks.reconstruction.subject import Subject, visible
from datasets.files.coincidence import points_in_sphere
from datasets.files.meshes import read_points
from datasets.files.repair import require_meshlab
from datasets.mesh import Mesh
from datasets.scene import Surface, Truth, View, see
from datasets.shot import Shot
from renderers.camera import Camera
from renderers.checks import BadInput

NORMAL_NEIGHBOURS = 16  # a plane through these points gives the normal
OUTLIER_DEVIATIONS = 2.0  # a point is dropped if its mean distance to neighbours exceeds the mean by these deviations
OCCLUSION_GAP = 0.05  # scene units: a point hides others of its pixel that are farther away by more than this
BEYOND_ALL_CAMERAS = 1e4  # scene units: added to the distance of cameras that do not see a point
FACING_EXPONENT = 4.0  # a photograph's weight is this power of the cosine between normal and view direction


def given_clouds(shots: Sequence[Shot]) -> list[Cloud]:
    return [
        Cloud(shot.camera.rays().at(shot.camera.distance(shot.depth))[shot.depth > 0].double().numpy(), shot.camera)
        for shot in shots
        if shot.depth is not None
    ]


def measured_clouds(path: str, subject: Subject) -> list[Cloud]:
    """The points of a file inside the unit sphere, each with the nearest input camera that sees it.

    If all photographs have masks, points more than one pixel of this run outside of a mask are dropped (DVR, Sec. 4.2).

    Raises:
        BadInput: if the file is no point cloud, or no point lies in the unit sphere.
    """
    points = read_points(path)
    if points is None:
        raise BadInput(f"task.cloud={path} has faces: give a cloud of points, or judge it by python -m bench.judge")
    points = points_in_sphere(points, np.eye(4) if subject.to_world is None else subject.to_world)
    if not len(points):
        raise BadInput(
            f"nothing of task.cloud={path} lies in the unit sphere of the photographs: give it in their cameras' world"
        )
    if all(shot.mask is not None for shot in subject.input_shots):
        positions = torch.from_numpy(points).float()
        allowed = [allowed_by_mask(shot, positions, margin=1.0) for shot in subject.input_shots]
        points = points[torch.stack(allowed).all(0).numpy()]
    cameras = [shot.camera for shot in subject.input_shots]
    viewers = _nearest_viewers(torch.from_numpy(points).float(), cameras).numpy()
    return [Cloud(points[viewers == index], camera) for index, camera in enumerate(cameras)]


def _nearest_viewers(points: Float[torch.Tensor, "n 3"], cameras: Sequence[Camera]) -> Int[torch.Tensor, " n"]:
    """The index of the nearest camera that sees each point unoccluded; of the nearest camera if none does."""
    nearest, viewers = torch.full((len(points),), torch.inf), torch.zeros(len(points), dtype=torch.long)
    for index, camera in enumerate(cameras):
        pixels, depth = camera.project(points)
        inside = camera.shows(points)
        column, row = torch.where(inside[:, None], pixels, 0.0).long().T
        pixel = row * (camera.width + 1) + column
        front = torch.full(((camera.height + 1) * (camera.width + 1),), torch.inf)
        front.scatter_reduce_(0, pixel, torch.where(inside, depth, torch.inf), "amin")
        hidden = ~inside | (depth > front[pixel] + OCCLUSION_GAP)
        distance = torch.linalg.vector_norm(points - camera.center, dim=-1) + hidden * BEYOND_ALL_CAMERAS
        viewers[distance < nearest] = index
        nearest = torch.minimum(nearest, distance)
    return viewers


def fuse_clouds(clouds: Sequence[Cloud]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """All points except outliers, and normals estimated from their neighbours, turned towards their cameras."""
    import open3d

    points = np.concatenate([np.zeros((0, 3)), *(cloud.points for cloud in clouds)])
    centres = [np.broadcast_to(cloud.camera.center.double().numpy(), cloud.points.shape) for cloud in clouds]
    if len(points) < NORMAL_NEIGHBOURS:
        return points, np.zeros_like(points)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    _, inliers = cloud.remove_statistical_outlier(NORMAL_NEIGHBOURS, OUTLIER_DEVIATIONS)
    cloud = cloud.select_by_index(inliers)
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(NORMAL_NEIGHBOURS))
    points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    cosines = (normals * (np.concatenate(centres)[inliers] - points)).sum(axis=1, keepdims=True)
    return points, np.where(cosines < 0, -normals, normals)


def poisson(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], *, depth: int, trim: float
) -> Mesh | None:
    """The surface of points by screened Poisson reconstruction (Kazhdan and Hoppe 2013); None without one.

    Args:
        points: in scene units.
        normals: outward.
        depth: of the octree.
        trim: minimum depth of the octree leaf that supports a vertex; 0 keeps all. DVR's Table 2 has 0, 5 and 7.
    """
    lab = require_meshlab("screened Poisson reconstruction")
    if len(points) < NORMAL_NEIGHBOURS:
        return None
    meshes = lab.MeshSet()
    meshes.add_mesh(lab.Mesh(vertex_matrix=points, v_normals_matrix=normals))
    meshes.generate_surface_reconstruction_screened_poisson(depth=depth, threads=1)
    reconstructed = meshes.current_mesh()
    faces = reconstructed.face_matrix()
    if trim and len(faces):
        faces = faces[(reconstructed.vertex_scalar_array() >= trim)[faces].all(axis=1)]
    return Mesh(reconstructed.vertex_matrix(), faces).compact() if len(faces) else None


def with_colours(mesh: Mesh, shots: Sequence[Shot]) -> Mesh:
    """The mesh with the mean colours of the photographs that see a vertex, weighted towards frontal views."""
    scene = Truth(mesh, closed=False)
    normals = np.zeros_like(mesh.vertices)
    np.add.at(normals, mesh.faces.ravel(), np.repeat(mesh.area_normals, 3, axis=0))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    total, weights = np.zeros_like(mesh.vertices), np.zeros((len(mesh.vertices), 1))
    for shot in shots:
        towards = shot.camera.center.double().numpy() - mesh.vertices
        cosine = (normals * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
        weight = (visible(scene, shot, Surface(mesh.vertices, normals)) * cosine.clip(0) ** FACING_EXPONENT)[:, None]
        pixels = shot.camera.project(torch.from_numpy(mesh.vertices).float())[0].double().numpy() - 0.5
        coordinates = np.nan_to_num(pixels).T[::-1]
        image = shot.colours.numpy()
        bands = [map_coordinates(image[..., band], coordinates, order=1, mode="nearest") for band in range(3)]
        total, weights = total + weight * np.stack(bands, axis=1), weights + weight
    return replace(mesh, colours=np.where(weights > 0, total / np.maximum(weights, 1e-12), DEFAULT_VERTEX_COLOUR))


def painter(mesh: Mesh) -> Callable[[Camera], tuple[View, Float[torch.Tensor, "height width 3"]]]:
    """A function that renders a mesh for a camera: the view, and colours by `bench.evaluate.state.painted`."""
    scene = Truth(mesh, closed=False)
    return lambda camera: (see(scene, camera), torch.from_numpy(render_vertex_colours(mesh, scene, camera)).float())
