"""Camera pose without a renderer: iterative closest points, as Open3D has it, on the same depth image."""

import time
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from bench.poses import JUDGED, PoseStart
from bench.records import RunStatus
from bench.stage import Cell
from datasets.scene import View, see
from datasets.truth import Truth, sample_surface
from renderers.camera import Camera
from renderers.checks import check_at_least, check_choice, check_positive

COSTS = {
    "evaluations.value": "none: no field is asked",
    "evaluations.starts": "starts that were tried; the one with the least distance at its end is kept",
    "seconds.forward": "all registrations",
    "seconds.evaluation": "metrics, off the clock",
    "seconds.total": "the whole run, with shapes made or loaded",
}


@dataclass(frozen=True)
class PoseICP:
    """The camera of a depth image of a known mesh, by Open3D's iterative closest points.

    Args:
        degrees, shift, starts, spread, success_degrees, success_distance: see `bench.poses.PoseStart`. Each start is
            tried to its end.
        method: "point_to_point" (Besl and McKay 1992) or "point_to_plane" (Chen and Medioni 1992).
        points: sampled on the known mesh.
        reach: how far apart corresponding points may be, in scene units, in each of the passes.
        iterations: at most, in each of the passes.
    """

    degrees: float
    shift: float
    starts: int
    spread: float
    success_degrees: float
    success_distance: float
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
        _ = self.start

    @property
    def start(self) -> PoseStart:
        """Where it starts, and what counts as found."""
        return PoseStart(
            self.degrees, self.shift, self.starts, self.spread, self.success_degrees, self.success_distance
        )

    def execute(self, cell: Cell) -> None:
        """Registers the points that the camera saw to the mesh, and judges the camera before and after."""
        stage, record, view = cell.stage, cell.record, cell.stage.scene.view
        record.definitions = JUDGED | COSTS
        cameras = self.start.cameras(view.camera, stage.scene.seed(stage.seed))
        record.metrics_start = self.start.judge(see(Truth(stage.scene.mesh), cameras[0]), view)
        points, normals = sample_surface(stage.scene.mesh, self.points, stage.seed)
        clock = time.perf_counter()
        tried = [self._register(camera, view, points, normals) for camera in cameras]
        found, distance = min(tried, key=lambda result: result[1])
        record.seconds |= {"forward": time.perf_counter() - clock, "backward": 0.0}
        record.evaluations = {"value": 0, "gradient": 0, "starts": len(cameras), "observed": int(view.mask.sum())}
        clock = time.perf_counter()
        record.metrics = self.start.judge(see(Truth(stage.scene.mesh), found), view)
        record.seconds["evaluation"] = time.perf_counter() - clock
        record.status, record.reason = RunStatus.OK, ""
        record.notes = [*record.notes, *self.start.remarks(record.metrics)]
        if not np.isfinite(distance):
            record.status, record.reason = (
                RunStatus.NOT_REACHED,
                "no point that the camera saw came within task.reach of the mesh",
            )

    def _register(
        self, camera: Camera, view: View, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
    ) -> tuple[Camera, float]:
        """The camera from one start, and the mean distance of the points that it saw from the known ones."""
        import open3d

        registration = open3d.pipelines.registration
        estimate = {
            "point_to_point": registration.TransformationEstimationPointToPoint,
            "point_to_plane": registration.TransformationEstimationPointToPlane,
        }[self.method]()
        seen, known = open3d.geometry.PointCloud(), open3d.geometry.PointCloud()
        seen.points = open3d.utility.Vector3dVector(world_points(view, camera).double().numpy())
        known.points = open3d.utility.Vector3dVector(points)
        known.normals = open3d.utility.Vector3dVector(normals)
        motion = np.eye(4)
        criteria = registration.ICPConvergenceCriteria(max_iteration=self.iterations)
        for reach in self.reach:
            result = registration.registration_icp(seen, known, reach, motion, estimate, criteria)
            motion = result.transformation
        seen.transform(motion)
        distance = float(np.mean(seen.compute_point_cloud_distance(known))) if result.fitness > 0 else np.inf
        back = torch.from_numpy(np.linalg.inv(motion).copy()).float()
        moved = Camera(camera.intrinsics, _rigid_part(camera.world_to_camera @ back), camera.height, camera.width)
        return moved, distance


def world_points(view: View, camera: Camera) -> Float[Tensor, "n 3"]:
    """Where the points of a depth image would be if `camera` had taken it."""
    along = camera.depth(torch.ones(view.depth.shape))  # camera z of a point at distance 1
    return camera.rays().at(view.depth / along)[view.mask]


def _rigid_part(motion: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    """The nearest rigid motion: many products in float32 leave a rotation slightly off."""
    exact = motion.clone()
    exact[:3, :3] = torch.from_numpy(Rotation.from_matrix(motion[:3, :3].double().numpy()).as_matrix())
    return exact
