"""Depth images of a sphere and of a sofa: where the scene puts what they show, what is refused, what a prior makes."""

import os

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from bench.config import load
from datasets.depth_image import OBJECT_RADIUS, _crop_and_subsample
from datasets.meshes import read_mesh
from datasets.scene import Split, Truth, see
from datasets.views import look_at
from renderers.camera import Camera
from renderers.checks import BadInput
from tests.looped import each
from tests.runner.driving import command, record_of
from tests.tiny import icosphere

STEP = 0.002  # units of the world for a step of the stored numbers
CAMERA = [150.0, 140.0, 70.3, 52.8]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A sofa that was turned, enlarged and shifted, its depth image and its mask; the folder and the camera."""
    folder, motion = tmp_path_factory.mktemp("depths"), np.diag([7.0, 7.0, 7.0, 1.0])
    motion[:3] = Rotation.from_euler("y", 75, degrees=True).as_matrix() @ motion[:3]
    motion[:3, 3] = 20.0, -5.0, 3.0
    mesh = load("dataset", "sofa").mesh(Split.VALIDATION, 0).moved(motion)
    mesh.save(folder / "sofa.ply")
    target = torch.tensor([20.0, -5.0, 4.0])
    pinhole = torch.tensor([[150.0, 0, 70.3], [0, 140.0, 52.8], [0, 0, 1]])
    view = see(Truth(mesh), Camera(pinhole, look_at(target + torch.tensor([12.0, 9.0, 14.0]), target), 120, 150))
    stored = (view.depth.numpy() / STEP).round().astype(np.uint16)
    Image.fromarray(stored).save(folder / "depth.png")
    np.save(folder / "depth.npy", np.where(stored, stored.astype(float), np.nan))
    np.savez(folder / "depth.npz", rgb=np.zeros((2, 2, 3)), depth=stored[..., None])
    Image.fromarray(np.uint8(255 * view.mask.numpy())).save(folder / "mask.png")
    return folder, view.camera


def depth_image(made, **changed):
    folder, camera = made
    keys = {"path": str(folder / "depth.png"), "intrinsics": CAMERA, "scale": STEP}
    return load("dataset", "depth_image", **keys | {"camera_to_world": camera.camera_to_world.tolist()} | changed)


@pytest.mark.parametrize(
    "suffix, pixels, unknown",
    [(".png", 40, False), (".npy", 40, False), (".npz", 40, False), (".exr", 40, False), (".png", 200, False),
     (".png", 40, True)],
)  # fmt: skip
def test_what_is_seen_lies_on_the_object_and_in_the_unit_sphere(made, suffix, pixels, unknown):
    folder, camera = made
    if suffix == ".exr":
        os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")
        cv2 = pytest.importorskip("cv2", reason="OpenCV is an extra: pip install -e '.[stereo]'")
        cv2.imwrite(str(folder / "depth.exr"), np.array(Image.open(folder / "depth.png"), np.float32))
    changed = {"camera_to_world": None} if unknown else {"mask_path": str(folder / "mask.png")}
    scene = depth_image(made, path=str(folder / f"depth{suffix}"), **changed).placed(pixels)
    view, known = scene.observed_view()
    points = view.camera.rays().at(view.camera.distance(view.depth))[known].double().numpy()
    assert OBJECT_RADIUS < np.linalg.norm(points, axis=1).max() < 1 and known.sum() > pixels
    assert scene.is_partial and max(known.shape) <= pixels and torch.equal(known, view.mask)
    world = points @ scene.to_world[:3, :3].T + scene.to_world[:3, 3]
    if unknown:
        motion = camera.camera_to_world.double().numpy()
        world = world @ motion[:3, :3].T + motion[:3, 3]
    assert Truth(read_mesh(folder / "sofa.ply")).distance(world).max() < 2 * STEP
    facing = (scene.view.normals * view.camera.rays().directions).sum(-1)[scene.view.mask]
    assert (facing <= 0).all()


@each("most", [32, 5])
def test_an_object_of_an_odd_extent_is_cut_out_as_a_square_whose_pixels_see_the_same_points(most):
    """Each depth is another one, so that a pixel of the cut-out is found in the image."""
    depth = np.zeros((20, 30))
    depth[5:12, 8:12] = 2 + 0.01 * np.arange(28).reshape(7, 4)
    pinhole = np.array([[40.0, 0, 14.3], [0, 35.0, 10.6], [0, 0, 1]])
    cut, mask, moved = _crop_and_subsample(depth, depth > 0, pinhole, most)
    assert cut.shape == mask.shape and len(set(cut.shape)) == 1 and max(cut.shape) <= most
    assert np.array_equal(mask, cut > 0) and mask.sum() >= 4
    for row, column in np.argwhere(mask):
        ((y, x),) = np.argwhere(depth == cut[row, column])
        before, after = (pinhole @ (a, b, 1) for pinhole, a, b in (
            (np.linalg.inv(pinhole), x + 0.5, y + 0.5), (np.linalg.inv(moved), column + 0.5, row + 0.5)
        ))  # fmt: skip
        assert after == pytest.approx(before)


@each(
    "key, value, says",
    [
        ("path", "nothing.png", "dataset.path=nothing.png is no file"),
        ("scale", 0.0, "dataset.scale must be positive"),
        ("intrinsics", [150.0, 140.0, 70.3], r"intrinsics must have shape \[3, 3\].*write \[fx,fy,cx,cy\]"),
        ("camera_to_world", (2 * np.eye(4)).tolist(), "must hold a rotation.*for a rigid motion"),
    ],
)
def test_what_is_no_camera_or_file_is_refused(made, key, value, says):
    with pytest.raises(ValueError, match=says):
        depth_image(made, **{key: value})


def test_a_principal_point_far_from_the_middle_is_noted(made):
    assert len(depth_image(made).placed(40).mesh.repairs) == 1
    both = [((300, 280), [140.6, 105.6]), ((150, 140), [0, 0]), ((60, 60), [24, 24])]
    for focal, at in [*both, ((150, 140), [20, 60]), ((150, 140), [75, 100])]:
        _, note = depth_image(made, intrinsics=[*focal, *at]).placed(40).mesh.repairs
        assert f"({at[0]}, {at[1]}) is far from the middle of the 150 x 120 pixels" in note


def test_a_principal_point_is_compared_with_the_middle_of_its_own_axis(made):
    for at in ([75.0, 47.0], [58.0, 60.0], [92.0, 60.0]):  # at most .23 of half the image from its middle
        assert len(depth_image(made, intrinsics=[150, 140, *at]).placed(40).mesh.repairs) == 1


def test_a_camera_of_unknown_place_looks_down_by_25_degrees(made):
    forward = depth_image(made, camera_to_world=None).placed(40).view.camera.camera_to_world[:3, 2]
    assert forward.tolist() == pytest.approx([0.0, -np.sin(np.radians(25)), -np.cos(np.radians(25))], abs=1e-6)


def test_the_object_is_shown_with_a_tenth_of_its_extent_around_it(made):
    mask = depth_image(made).placed(200).view.mask.numpy()  # each pixel of the file
    rows, columns = np.nonzero(mask)
    extent = max(np.ptp(rows), np.ptp(columns)) + 1
    for side, places in zip(mask.shape, (rows, columns), strict=True):
        assert side == pytest.approx(1.2 * extent, abs=1)
        assert places.min() == pytest.approx(side - 1 - places.max(), abs=1)  # in the middle
    assert min(rows.min(), columns.min()) == pytest.approx(0.1 * extent, abs=1)


def test_depths_outside_of_the_mask_are_not_given(made, tmp_path):
    stored = np.array(Image.open(made[0] / "mask.png"))
    stored[:, ::3] = 0
    Image.fromarray(stored).save(tmp_path / "stripes.png")
    scene = depth_image(made, mask_path=str(tmp_path / "stripes.png")).placed(200)
    assert torch.equal(scene.measured > 0, scene.view.mask) and scene.view.mask.sum() == (stored > 0).sum()


@each("odd", [-3.0, np.inf, np.nan])
def test_a_number_that_is_no_depth_is_none_also_on_the_object(made, tmp_path, odd):
    folder, _ = made
    depths, mask = np.load(folder / "depth.npy"), np.array(Image.open(folder / "mask.png")) > 0
    depths[::2] = odd
    np.save(tmp_path / "odd.npy", depths)
    scene = depth_image(made, path=str(tmp_path / "odd.npy"), mask_path=str(folder / "mask.png")).placed(200)
    assert (scene.measured >= 0).all() and scene.observed_view()[1].sum() == mask[1::2].sum()


def test_a_pixel_that_flies_behind_the_outline_does_not_shrink_the_object(made, tmp_path):
    depths = np.load(made[0] / "depth.npy")
    depths[tuple(np.argwhere(depths > 0)[0])] *= 3
    np.save(tmp_path / "flies.npy", depths)
    sizes = [
        np.linalg.norm(depth_image(made, path=str(path)).placed(200).to_world[:3, 0])
        for path in (made[0] / "depth.npy", tmp_path / "flies.npy")
    ]
    assert sizes[1] == pytest.approx(sizes[0], rel=0.02)


def test_too_few_depths_are_refused(made):
    with pytest.raises(BadInput, match=r"has \d+ depths on the object at view.resolution=4, and 20 are the fewest"):
        depth_image(made).placed(4)


def test_a_truth_that_only_touches_what_is_seen_is_refused(made, tmp_path):
    seen = depth_image(made).placed(40)
    icosphere(0.1, seen.mesh.vertices[0]).moved(seen.to_world).save(tmp_path / "speck.ply")
    with pytest.raises(BadInput, match=r"of its radius from dataset.truth \(median\): give both in one world"):
        depth_image(made, truth=str(tmp_path / "speck.ply")).placed(40)


def test_files_without_depths_are_refused(made, tmp_path):
    stored, mask = {"a": np.zeros((4, 4, 3)), "b": np.zeros((9, 9)), "c": np.ones((9, 9))}, str(made[0] / "mask.png")
    for (name, numbers), says in zip(stored.items(), ("one number", "no object", "120 and 9 x 9"), strict=True):
        np.save(tmp_path / f"{name}.npy", numbers)
        with pytest.raises(ValueError, match=says):
            depth_image(made, path=str(tmp_path / f"{name}.npy"), mask_path=mask if name == "c" else None).placed(32)


def test_a_prior_completes_what_is_seen_wherever_it_is(made, tmp_path):
    folder, camera = made
    rows = str(camera.camera_to_world.tolist()).replace(" ", "")
    given = ("dataset=depth_image", f"dataset.path={folder}/depth.png", "dataset.intrinsics=[150,140,70.3,52.8]")
    known = (f"dataset.scale={STEP}", f"dataset.camera_to_world={rows}", f"dataset.truth={folder}/sofa.ply")
    small = ("scale=smoke", "view.resolution=24", "evaluation.grid=32", "evaluation.every=null", "threads=1")
    for wrong, says in ((("task=pose",), "set task=completion"), ((), "set prior.of=sofa"), (("index=1",), "index=0")):
        assert says in command(*given, *small, *wrong, f"results_dir={tmp_path}").err
    fewer = ("task.rotations=6", "task.optimiser.iterations=80", "evaluation.picture=null", "isolation=off")
    done = command(*given, *known, *small, *fewer, "prior.of=sofa", f"results_dir={tmp_path}")
    record = record_of(done.out)
    assert record["metrics"]["chamfer_l1"] < 0.25 * record["metrics_start"]["chamfer_l1"]
    found = read_mesh(f"{done.out.splitlines()[-1]}/mesh_world.ply").vertices
    assert np.median(Truth(read_mesh(folder / "sofa.ply")).distance(found)) < 0.4  # of 14 across
