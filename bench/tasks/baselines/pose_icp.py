"""Camera pose without a renderer: Open3D's iterative closest points on the same depth image."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from bench.records.record import RunStatus
from bench.setup.inputs import RunContext
from bench.solve.solve import note_result
from bench.tasks.pose import MESH_VIEW_DEFINITIONS, PoseTask
from datasets.scene import Surface, View, sample_surface
from renderers.camera import Camera
from renderers.checks import check_at_least, check_choice, check_positive

COSTS = {
    "evaluations.value": "0: no field is evaluated",
    "evaluations.starts": "starts that were tried; the one with the least final distance is kept",
    "seconds.forward": "all registrations",
    "seconds.evaluation": "metrics, not part of the loop",
    "seconds.total": "the whole run, with making or loading shapes",
}


@dataclass(frozen=True)
class PoseICP(PoseTask):
    """Finds the camera of a depth image of a known mesh by Open3D's iterative closest points.

    Args:
        degrees, shift, starts, spread, success_degrees, success_distance: see `bench.tasks.pose.PoseTask`. Every start
            runs to its end.
        method: "point_to_point" (Besl and McKay 1992) or "point_to_plane" (Chen and Medioni 1992).
        points: number of points sampled on the known mesh.
        reach: largest distance of corresponding points in each pass, in scene units.
        iterations: maximum iterations in each pass.
    """

    method: str
    points: int
    reach: tuple[float, ...]
    iterations: int

    def __post_init__(self) -> None:
        check_choice("task.method", self.method, ("point_to_point", "point_to_plane"))
        check_at_least("task.points", self.points, 10, "30000 works")
        check_at_least("task.iterations", self.iterations, 1, "100 works")
        if not self.reach:
            raise ValueError("task.reach must have one pass or more: [0.5, 0.2, 0.05] works")
        for reach in self.reach:
            check_positive("task.reach", reach, "[0.5, 0.1] works")
        super().__post_init__()

    def execute(self, run: RunContext) -> None:
        """Registers the points of the depth image to the mesh, and evaluates the camera before and after."""
        inputs, record, view = run.inputs, run.record, run.inputs.scene.view
        record.definitions = MESH_VIEW_DEFINITIONS | COSTS
        cameras = self.cameras(view.camera, inputs.scene.seed(inputs.seed))
        record.metrics_start = self.evaluate(cameras[0], inputs.scene).metrics
        sampled = sample_surface(inputs.scene.mesh, self.points, inputs.seed)
        registered = []
        with run.on_clock():
            for camera in cameras:
                run.progress("registering points", len(registered), len(cameras))
                registered.append(self._register(camera, view, sampled))
        run.progress("registering points", len(registered), len(cameras))
        best, distance = min(registered, key=lambda result: result[1])
        record.evaluations = {"value": 0, "gradient": 0, "starts": len(cameras), "observed": int(view.mask.sum())}
        with run.off_clock():
            after = self.evaluate(best, inputs.scene)
        failure = (RunStatus.NOT_REACHED, "no point of the depth image came within task.reach of the mesh")
        note_result(run, replace(after, failure=None if np.isfinite(distance) else failure))

    def _register(self, camera: Camera, view: View, sampled: Surface) -> tuple[Camera, float]:
        """The registered camera of one start, and the mean distance of its points from the mesh's points."""
        import open3d

        registration = open3d.pipelines.registration
        estimate = {
            "point_to_point": registration.TransformationEstimationPointToPoint,
            "point_to_plane": registration.TransformationEstimationPointToPlane,
        }[self.method]()
        depth_cloud, mesh_cloud = open3d.geometry.PointCloud(), open3d.geometry.PointCloud()
        depth_cloud.points = open3d.utility.Vector3dVector(world_points(view, camera).double().numpy())
        mesh_cloud.points = open3d.utility.Vector3dVector(sampled.points)
        mesh_cloud.normals = open3d.utility.Vector3dVector(sampled.normals)
        motion = np.eye(4)
        criteria = registration.ICPConvergenceCriteria(max_iteration=self.iterations)
        for reach in self.reach:
            result = registration.registration_icp(depth_cloud, mesh_cloud, reach, motion, estimate, criteria)
            motion = result.transformation
        depth_cloud.transform(motion)
        distances = depth_cloud.compute_point_cloud_distance(mesh_cloud) if result.fitness > 0 else [np.inf]
        moved = camera.world_to_camera @ torch.from_numpy(np.linalg.inv(motion).copy()).float()
        rotation = Rotation.from_matrix(moved[:3, :3].double().numpy())  # exact: float32 makes it slightly inexact
        moved[:3, :3] = torch.from_numpy(rotation.as_matrix())
        return Camera(camera.intrinsics, moved, camera.height, camera.width), float(np.mean(distances))


def world_points(view: View, camera: Camera) -> Float[Tensor, "n 3"]:
    """The points of a depth image in world axes, if `camera` had taken it."""
    depth_per_distance = camera.depth(torch.ones(view.depth.shape))
    return camera.rays().at(view.depth / depth_per_distance)[view.mask]
