"""Surfaces of photographs without a renderer: they end with colours and metrics, and what they need is told."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from bench.solve.solve import COST_DEFINITIONS
from bench.tasks.reconstruction.baselines import Fusing, Hull, Poisson, Stereo
from bench.tasks.reconstruction.judge import COLOURED_DEFINITIONS, OWN_PREFIX, SEEN_PREFIX
from bench.tasks.reconstruction.stereo import Matching
from bench.tasks.reconstruction.subject import Depths
from bench.tasks.reconstruction.surfaces import fuse_clouds, measured_clouds, with_colours
from datasets.files.captures.hull import hull_mesh
from datasets.scene import Truth, sample_surface
from renderers.checks import BadInput
from tests.datasets.test_photographs import PHOTOGRAPHY
from tests.tasks.test_reconstruction import assert_coloured_mesh, run_in, scene  # noqa: F401, a fixture
from tests.tiny import altered

SHARED = {
    "images": replace(PHOTOGRAPHY, places="sphere", views=9),
    "longest": 24,
    "held_out": 4,
    "masks": True,
    "depths": Depths("none", 0.0),
}
HULL = Hull(**SHARED, samples=32)
POISSON = Poisson(**SHARED | {"depths": Depths("dense", 0.0)}, fusing=Fusing(5, 0.0))
TOLERANCE = replace(PHOTOGRAPHY, views=18, texture_size=0.15)  # on a circle, 20 degrees apart
STEREO = Stereo(
    **SHARED | {"images": TOLERANCE, "longest": 48, "held_out": 9}, matching=Matching(1, 30.0), fusing=Fusing(5, 0.0)
)
TASKS = {"hull": HULL, "poisson": POISSON, "stereo": STEREO}
SEEN_AS = {"colours": (8, 8, 3), "normals": (8, 8, 3), "hit": (8, 8)}  # at the size of pictures
ARRAYS = SEEN_AS | {f"back_{name}": shape for name, shape in SEEN_AS.items()} | {"back_truth": (8, 8, 3)}
WORST = {"hull": (0.055, 0.9, 19), "poisson": (0.035, 0.98, 27), "stereo": (0.06, 0.8, 16)}  # Chamfer-L1, IoU, PSNR
SCORES = {name for name in COLOURED_DEFINITIONS if not name.startswith(OWN_PREFIX)}


@pytest.mark.parametrize("name", TASKS)
def test_a_surface_has_colours_metrics_and_pictures_and_no_evaluations(scene, tmp_path, name):  # noqa: F811
    if name == "stereo":
        pytest.importorskip("cv2", reason="task=stereo needs OpenCV")
    run, task = altered(run_in(tmp_path, scene), {"inputs.evaluation.points": 2000}), TASKS[name]
    task.execute(run)
    record, metrics = run.record, run.record.metrics
    assert (record.status, record.reason) == ("ok", "")
    assert set(metrics) == SCORES and record.definitions == COLOURED_DEFINITIONS | COST_DEFINITIONS
    assert record.evaluations == {"value": 0, "gradient": 0}
    assert record.seconds["forward"] > 0 and record.seconds["backward"] == 0 and record.seconds["evaluation"] > 0
    chamfer, overlap, psnr = WORST[name]
    assert metrics[SEEN_PREFIX + "chamfer_l1"] < chamfer
    assert metrics["mask_iou"] > overlap and metrics["psnr_image"] > psnr
    assert assert_coloured_mesh(tmp_path).std(axis=0).max() > 5
    count, size = task.images.views, task.longest
    summary = (
        f"{count} rendered photographs of {size} x {size} pixels; {-(-count // task.held_out)} of them are held out"
    )
    assert {summary, "no renderer took part"} <= set(record.notes)
    for picture in ("summary.png", "input.png"):
        assert (tmp_path / picture).stat().st_size > 2000
    with np.load(tmp_path / "images.npz") as arrays:
        assert {key: arrays[key].shape for key in arrays} == ARRAYS | {"photograph": (size, size, 3)}
        assert 0.1 < arrays["hit"].mean() < 0.9 and arrays["colours"][arrays["hit"]].std() > 0.02
        assert not arrays["colours"][~arrays["hit"]].any()
    assert not (tmp_path / "curve.jsonl").exists()


def test_held_out_photographs_give_neither_shape_nor_colours(scene, tmp_path, monkeypatch):  # noqa: F811
    used = []

    def noted(function):
        return lambda first, second: (
            used.append(second if function is with_colours else first) or function(first, second)
        )

    for name, function in (("with_colours", with_colours), ("hull_mesh", hull_mesh)):
        monkeypatch.setattr(f"bench.tasks.reconstruction.baselines.{name}", noted(function))
    HULL.execute(altered(run_in(tmp_path, scene), {"inputs.evaluation.picture": None}))
    assert [[shot.name for shot in shots] for shots in used] == [["1", "2", "3", "5", "6", "7"]] * 2


def test_what_a_surface_needs_is_told(scene, tmp_path):  # noqa: F811
    with pytest.raises(BadInput, match="the visual hull needs a mask of each"):
        altered(HULL, {"masks": False}).execute(run_in(tmp_path, scene))
    with pytest.raises(BadInput, match=r"screened Poisson needs depths: set task\.depths\.points=dense"):
        altered(POISSON, {"depths": Depths("none", 0.0)}).execute(run_in(tmp_path, scene))


def test_a_trim_that_leaves_nothing_is_empty(scene, tmp_path):  # noqa: F811
    run = run_in(tmp_path, scene)
    altered(POISSON, {"fusing.trim": 99.0}).execute(run)
    record = run.record
    assert (record.status, record.reason) == ("empty", "no surface was found")
    assert set(record.metrics) == SCORES
    assert record.metrics["seen_chamfer_l1"] == np.inf and record.metrics["mask_iou"] == 0
    assert {path.name for path in tmp_path.iterdir()}.isdisjoint({"mesh.ply", "images.npz", "summary.png"})


def test_points_of_another_program_are_read_in_the_cameras_world(scene, tmp_path):  # noqa: F811
    subject = POISSON.subject(run_in(tmp_path / "run", scene).inputs)
    to_world = np.diag([5.0, 5.0, 5.0, 1.0])
    to_world[:3, 3] = (1.0, -2.0, 30.0)
    points = np.concatenate([sample_surface(subject.truth, 8000, seed=0).points, [[3.0, 0.0, 0.0], [0.0, 0.9, 0.0]]])
    file, lines = tmp_path / "points.ply", 5 * points + to_world[:3, 3]
    header = f"ply\nformat ascii 1.0\nelement vertex {len(lines)}\n" + "".join(f"property float {x}\n" for x in "xyz")
    file.write_text(header + "end_header\n" + "".join(f"{x} {y} {z}\n" for x, y, z in lines))
    task = replace(POISSON, cloud=str(file))
    surface = task.surface(replace(subject, to_world=to_world))
    assert surface is not None and surface.volume == pytest.approx(subject.truth.volume, rel=0.1)  # turned outward
    assert Truth(subject.truth).distance(surface.vertices).mean() < 0.02
    kept = np.concatenate([cloud.points for cloud in measured_clouds(str(file), replace(subject, to_world=to_world))])
    assert 7900 < len(kept) <= 8000 and kept[:, 1].max() < 0.85  # that beside the visual hull is left out
    with pytest.raises(BadInput, match=r"nothing of task\.cloud=.* lies in the unit sphere"):
        task.surface(subject)
    subject.truth.save(tmp_path / "mesh.ply")
    with pytest.raises(BadInput, match="has faces: give a cloud of points"):
        replace(POISSON, cloud=str(tmp_path / "mesh.ply")).surface(subject)


def test_points_are_turned_to_a_camera_that_sees_them_not_to_the_nearest(scene, tmp_path):  # noqa: F811
    """The inner side of a plate far from the middle, which hides it from the camera that is nearest."""
    subject = POISSON.subject(run_in(tmp_path / "run", scene).inputs)
    plate = trimesh.creation.box((0.2, 0.9, 0.9)).apply_translation([0.6, 0.0, 0.0])
    trimesh.PointCloud(trimesh.sample.sample_surface(plate, 6000, seed=0)[0]).export(tmp_path / "plate.ply")
    bare = replace(subject, input_shots=tuple(replace(shot, mask=None) for shot in subject.input_shots))
    points, normals = fuse_clouds(measured_clouds(str(tmp_path / "plate.ply"), bare))
    for inner, side in ((points[:, 0] < 0.52, -1), (points[:, 0] > 0.68, 1)):
        assert (side * normals[inner, 0] > 0).mean() > 0.95
