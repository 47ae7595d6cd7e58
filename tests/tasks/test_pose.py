"""Camera poses of known shapes: how far off a start is, and that the way back is found."""

from dataclasses import replace
from math import radians

import numpy as np
import pytest
import torch
import trimesh

from bench.config import load
from bench.records.record import RunStatus
from bench.solve.optimise import History, OptimiserSettings, optimise
from bench.tasks.baselines.pose_icp import PoseICP, world_points
from bench.tasks.pose import Pose, PoseProblem, build_shape_field, pose_error
from datasets.scene import Scene
from renderers.fields.analytic import box
from renderers.silhouette import Own
from tests.looped import each
from tests.tiny import CPU, ball_prior, camera_of, curve_of, mesh_of, run_of, scene_of

SIZES = (0.5, 0.35, 0.2)
CAMERA = camera_of(24, angles=(30.0, 20.0))
SETTINGS = Pose(
    degrees=12.0, shift=0.05, starts=1, spread=90.0, success_degrees=5.0, success_distance=0.05, trial=5,
    shape="grid", grid=32, depth_loss="depth", depth_weight=10.0, silhouette=Own(), silhouette_weight=10.0,
    normal_weight=0.0,
    optimiser=OptimiserSettings(60, 0.02, "cosine"),
)  # fmt: skip
START = replace(SETTINGS, degrees=20.0, shift=0.1, starts=3, spread=40.0)
ICP = PoseICP(
    degrees=12.0, shift=0.05, starts=1, spread=90.0, success_degrees=5.0, success_distance=0.05,
    method="point_to_plane", points=4000, reach=(0.3, 0.05), iterations=50,
)  # fmt: skip
DIST = load("renderer", "dist")


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A box with three unlike sides."""
    return scene_of(mesh_of(trimesh.creation.box(2 * np.array(SIZES))), CAMERA)


@pytest.fixture
def run(tmp_path, scene):
    return run_of(tmp_path, DIST, ball_prior(), CAMERA, make_scene=lambda: scene)


def problem_of(scene, renderer=DIST, **changed) -> PoseProblem:
    settings = replace(SETTINGS, **changed)
    return PoseProblem(settings, renderer, box(SIZES), scene.view, settings.cameras(CAMERA, 0), CPU)


@each("angle", [0.0, 1e-3, 17.0, 90.0, 179.0])
def test_the_error_of_a_turn_is_its_angle_and_that_of_a_shift_its_length(angle):
    axis = torch.tensor([0.6, 0.0, 0.8])
    turned = CAMERA.with_object_moved(torch.cat([torch.zeros(3), radians(angle) * axis]))
    rotation, translation = pose_error(turned, CAMERA)
    assert rotation == pytest.approx(angle, abs=1e-3)
    assert translation == pytest.approx(0.0, abs=1e-6)  # about the object's origin
    moved = CAMERA.with_object_moved(torch.tensor([0.0, 0.3, 0.4, 0, 0, 0]))
    assert pose_error(moved, CAMERA) == pytest.approx((0.0, 0.5), abs=1e-3)


def test_the_first_start_is_off_by_what_is_asked_and_others_are_turned_from_it():
    first, *others = START.cameras(CAMERA, seed=4)
    rotation, _ = pose_error(first, CAMERA)
    assert rotation == pytest.approx(20.0, abs=1e-2)
    steep, shift = pose_error(replace(START, degrees=170.0).cameras(CAMERA, seed=4)[0], CAMERA)
    assert (steep, shift) == pytest.approx((170.0, 0.1), abs=1e-2) and len(others) == 2
    for other in others:
        rotation, translation = pose_error(other, first)
        assert 0 < rotation <= 40.0 and translation == pytest.approx(0.0, abs=1e-5)
    again = START.cameras(CAMERA, seed=4)
    assert torch.equal(again[2].world_to_camera, others[1].world_to_camera)
    alone = replace(START, starts=1).cameras(CAMERA, seed=4)
    assert torch.equal(alone[0].world_to_camera, first.world_to_camera)  # more starts change nothing of the first


def test_success_needs_both_errors_to_be_small():
    near = CAMERA.with_object_moved(torch.tensor([0.03, 0, 0, 0, 0, radians(4.0)]))
    turned = CAMERA.with_object_moved(torch.tensor([0.03, 0, 0, 0, 0, radians(6.0)]))
    far = CAMERA.with_object_moved(torch.tensor([0.06, 0, 0, 0, 0, radians(4.0)]))
    assert [START.metrics(camera, CAMERA)["success"] for camera in (near, turned, far)] == [1.0, 0.0, 0.0]


def test_the_true_pose_costs_nearly_nothing(scene):
    terms = problem_of(scene, degrees=0.0, shift=0.0, normal_weight=1.0).loss(0)
    off = problem_of(scene, normal_weight=1.0).loss(0)
    assert terms["depth"] < 0.1 * off["depth"] and terms["normals"] < 0.1 * off["normals"]
    assert terms["total"] < 0.3 * off["total"]  # a pixel at an edge is off by a part of it


@each("name", ["dist", "dvr", "idr"])
def test_gradients_of_the_loss_point_back(scene, name):
    """Towards the truth the loss falls: along the twist that the start was moved by, against it."""
    problem = problem_of(scene, load("renderer", name), starts=1)
    problem.loss(0)["total"].backward()
    gradient = problem.parameters[0].grad
    assert gradient.isfinite().all()
    back = torch.linalg.inv(problem.cameras[0].world_to_camera) @ CAMERA.world_to_camera
    turn = torch.tensor([back[2, 1] - back[1, 2], back[0, 2] - back[2, 0], back[1, 0] - back[0, 1]]) / 2
    assert torch.cat([back[:3, 3], turn]) @ gradient < 0


def test_it_finds_the_pose_and_leaves_a_record(run):
    replace(SETTINGS, grid=64, optimiser=OptimiserSettings(40, 0.06, "cosine")).execute(run)
    record = run.record
    assert record.status is RunStatus.OK, record.reason
    assert record.metrics_start["rotation_error_deg"] == pytest.approx(12.0, abs=0.01)
    assert record.metrics["rotation_error_deg"] < 3.0 and record.metrics["success"] == 1.0
    assert record.metrics["mask_iou"] > 0.93 and set(record.metrics) <= set(record.definitions)
    assert record.evaluations["value"] > 0 and record.evaluations["gradient"] > 0
    lines = curve_of(run.folder)
    assert len(lines) == 40 and {"depth", "silhouette", "total"} <= set(lines[0])
    assert (run.folder / "strip.png").stat().st_size > 1000


def test_a_pixel_of_each_block_is_compared(scene):
    problem, sampled = problem_of(scene), problem_of(scene, pixel_block=2)
    assert 4 * sampled.rays_per_iteration == problem.rays_per_iteration
    losses = [sampled.loss(step)["depth"].item() for step in (*range(60), 3)]
    assert losses[3] == losses[-1] and len({*losses}) > 50
    assert sum(losses) / len(losses) == pytest.approx(problem.loss(0)["depth"].item(), rel=0.1)
    counts = replace(sampled.counts)
    for each_problem in (problem, sampled):
        each_problem.parameters[0].data += 0.01
    with torch.no_grad():
        assert sampled.objective() == problem.loss(0)["total"].item()
    assert sampled.counts == counts and problem.objective() is None


def final_loss(scene, seed: int, *, iterations: int = 60, **changed) -> float:
    optimiser = OptimiserSettings(iterations, 0.1, "cosine")
    settings = replace(SETTINGS, degrees=90.0, optimiser=optimiser, **changed)
    problem = PoseProblem(settings, DIST, box(SIZES), scene.view, settings.cameras(CAMERA, seed), CPU)
    history = History()
    optimise(problem, settings.optimiser, CPU, history=history, on_step=lambda line: None)
    return history.curve[-1]["total"]


@pytest.mark.slow
def test_restarts_find_what_one_start_misses(scene):
    """Judged by the loss: a box looks the same from four sides."""
    assert final_loss(scene, 2, starts=8, trial=4, iterations=90) < 0.1 < final_loss(scene, 2, iterations=40)


def test_a_known_shape_is_the_scenes(run):
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * 1.6 - 0.8
    grid, network = (
        build_shape_field(replace(SETTINGS, shape=shape, grid=48), run.inputs)(points) for shape in ("grid", "prior")
    )
    assert (grid - box(SIZES)(points)).abs().max() < 0.02
    prior = run.inputs.prior
    assert torch.equal(network, prior.decoder.at(prior.codes[0])(points))


def test_the_grid_of_a_shape_is_computed_once_for_each_shape_and_size(run, monkeypatch):
    settings = replace(SETTINGS, shape="grid", grid=10)
    first = build_shape_field(settings, run.inputs)
    monkeypatch.setattr("datasets.scene.Truth.distance_grid", lambda *_: pytest.fail("it is stored"))
    assert torch.equal(build_shape_field(settings, run.inputs).values, first.values)
    with pytest.raises(pytest.fail.Exception, match="it is stored"):
        build_shape_field(replace(settings, grid=11), run.inputs)
    moved = run.inputs.scene.mesh.moved(np.diag([0.9, 1.0, 1.0, 1.0]))
    with pytest.raises(pytest.fail.Exception, match="it is stored"):
        build_shape_field(settings, replace(run.inputs, make_scene=lambda: replace(run.inputs.scene, mesh=moved)))


@pytest.mark.parametrize("method", ["point_to_point", "point_to_plane"])
def test_closest_points_find_a_near_pose(run, method):
    replace(ICP, method=method).execute(run)
    assert run.record.status is RunStatus.OK
    assert run.record.metrics_start["rotation_error_deg"] == pytest.approx(12.0, abs=0.01)
    assert run.record.metrics["rotation_error_deg"] < 4.0 and run.record.evaluations["value"] == 0
    assert run.record.seconds["forward"] > 0


def test_the_points_of_the_true_camera_lie_on_the_surface(scene):
    points = world_points(scene.view, CAMERA)
    assert len(points) == int(scene.view.mask.sum()) and box(SIZES)(points).abs().max() < 1e-4


def test_points_that_never_come_near_are_told(run):
    replace(ICP, shift=3.0, reach=(1e-3,)).execute(run)
    assert run.record.status is RunStatus.NOT_REACHED and run.record.metrics["success"] == 0.0


@each("settings, changed, message", [
    (SETTINGS, {"degrees": 200.0}, r"task\.degrees must lie between 0 and 180"),
    (SETTINGS, {"starts": 12}, r"task\.optimiser\.iterations must be more than"),
    (ICP, {"reach": ()}, r"task\.reach must have one pass or more"),
])  # fmt: skip
def test_what_cannot_be_is_told(settings, changed, message):
    with pytest.raises(ValueError, match=message):
        replace(settings, **changed)
