"""Depth images of a sofa: the scene of the observed points, refused input, and completion with a prior."""

import os

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from bench.config import load
from datasets.files.depth_image import OBJECT_RADIUS, _crop_and_subsample
from datasets.files.meshes import read_mesh
from datasets.scene import Split, Truth, see
from datasets.views import look_at
from renderers.camera import Camera
from renderers.checks import BadInput
from tests.looped import each
from tests.runner.driving import command, record_of
from tests.tiny import icosphere

STEP = 0.002  # world units per stored step
CAMERA = [150.0, 140.0, 70.3, 52.8]


@pytest.fixture(scope="module")
def sofa_files(tmp_path_factory):
    """A rotated, scaled and shifted sofa, its depth image and its mask: the folder and the camera."""
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


def depth_image(sofa_files, **changed):
    folder, camera = sofa_files
    keys = {"path": str(folder / "depth.png"), "intrinsics": CAMERA, "scale": STEP}
    return load("dataset", "depth_image", **keys | {"camera_to_world": camera.camera_to_world.tolist()} | changed)


@pytest.mark.parametrize(
    "suffix, pixels, unknown",
    [(".png", 40, False), (".npy", 40, False), (".npz", 40, False), (".exr", 40, False), (".png", 200, False),
     (".png", 40, True)],
)  # fmt: skip
def test_observed_points_lie_on_the_object_and_in_the_unit_sphere(sofa_files, suffix, pixels, unknown):
    folder, camera = sofa_files
    if suffix == ".exr":
        os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")
        cv2 = pytest.importorskip("cv2", reason="OpenCV is an extra: pip install -e '.[stereo]'")
        cv2.imwrite(str(folder / "depth.exr"), np.array(Image.open(folder / "depth.png"), np.float32))
    changed = {"camera_to_world": None} if unknown else {"mask_path": str(folder / "mask.png")}
    scene = depth_image(sofa_files, path=str(folder / f"depth{suffix}"), **changed).placed(pixels)
    view, observed = scene.observed_view()
    points = view.camera.rays().at(view.camera.distance(view.depth))[observed].double().numpy()
    assert OBJECT_RADIUS < np.linalg.norm(points, axis=1).max() < 1 and observed.sum() > pixels
    assert scene.is_partial and max(observed.shape) <= pixels and torch.equal(observed, view.mask)
    world = points @ scene.to_world[:3, :3].T + scene.to_world[:3, 3]
    if unknown:
        motion = camera.camera_to_world.double().numpy()
        world = world @ motion[:3, :3].T + motion[:3, 3]
    assert Truth(read_mesh(folder / "sofa.ply")).distance(world).max() < 2 * STEP
    facing = (scene.view.normals * view.camera.rays().directions).sum(-1)[scene.view.mask]
    assert (facing <= 0).all()


@each("most", [32, 5])
def test_the_square_crop_of_an_object_keeps_the_ray_of_each_pixel(most):
    """All depths differ, so that the test can identify a pixel of the crop in the image."""
    depth = np.zeros((20, 30))
    depth[5:12, 8:12] = 2 + 0.01 * np.arange(28).reshape(7, 4)
    pinhole = np.array([[40.0, 0, 14.3], [0, 35.0, 10.6], [0, 0, 1]])
    crop, mask, moved = _crop_and_subsample(depth, depth > 0, pinhole, most)
    assert crop.shape == mask.shape and len(set(crop.shape)) == 1 and max(crop.shape) <= most
    assert np.array_equal(mask, crop > 0) and mask.sum() >= 4
    for row, column in np.argwhere(mask):
        ((y, x),) = np.argwhere(depth == crop[row, column])
        before, after = (pinhole @ (a, b, 1) for pinhole, a, b in (
            (np.linalg.inv(pinhole), x + 0.5, y + 0.5), (np.linalg.inv(moved), column + 0.5, row + 0.5)
        ))  # fmt: skip
        assert after == pytest.approx(before)


@each("key, value, message", [
    ("path", "nothing.png", "dataset.path=nothing.png is no file"), ("scale", 0.0, "dataset.scale must be positive"),
    ("intrinsics", [150.0, 140.0, 70.3], r"intrinsics must have shape \[3, 3\].*write \[fx,fy,cx,cy\]"),
    ("camera_to_world", (2 * np.eye(4)).tolist(), "must hold a rotation.*for a rigid motion"),
])  # fmt: skip
def test_invalid_cameras_and_files_are_refused(sofa_files, key, value, message):
    with pytest.raises(ValueError, match=message):
        depth_image(sofa_files, **{key: value})


@each("intrinsics, noted", [
    ([300, 280, 140.6, 105.6], True), ([150, 140, 0, 0], True), ([60, 60, 24, 24], True), ([150, 140, 20, 60], True),
    ([150, 140, 75, 100], True), ([150, 140, 75, 47], False), ([150, 140, 58, 60], False), ([150, 140, 92, 60], False),
])  # fmt: skip
def test_a_principal_point_far_from_the_middle_of_its_axis_is_noted(sofa_files, intrinsics, noted):
    """The image has 150 x 120 pixels. The points without a note are at most 0.23 of half of it from its middle."""
    _, *notes = depth_image(sofa_files, intrinsics=intrinsics).placed(40).mesh.repairs
    words = f"({intrinsics[2]}, {intrinsics[3]}) is far from the middle of the 150 x 120 pixels"
    assert [words in note for note in notes] == [True] * noted


def test_a_camera_of_unknown_pose_looks_down_by_25_degrees(sofa_files):
    forward = depth_image(sofa_files, camera_to_world=None).placed(40).view.camera.camera_to_world[:3, 2]
    assert forward.tolist() == pytest.approx([0.0, -np.sin(np.radians(25)), -np.cos(np.radians(25))], abs=1e-6)


def test_the_object_is_shown_with_a_tenth_of_its_extent_around_it(sofa_files):
    mask = depth_image(sofa_files).placed(200).view.mask.numpy()  # each pixel of the file
    rows, columns = np.nonzero(mask)
    extent = max(np.ptp(rows), np.ptp(columns)) + 1
    for side, indices in zip(mask.shape, (rows, columns), strict=True):
        assert side == pytest.approx(1.2 * extent, abs=1)
        assert indices.min() == pytest.approx(side - 1 - indices.max(), abs=1)  # in the middle
    assert min(rows.min(), columns.min()) == pytest.approx(0.1 * extent, abs=1)


def test_depths_outside_the_mask_are_not_observed(sofa_files, tmp_path):
    stored = np.array(Image.open(sofa_files[0] / "mask.png"))
    stored[:, ::3] = 0
    Image.fromarray(stored).save(tmp_path / "stripes.png")
    scene = depth_image(sofa_files, mask_path=str(tmp_path / "stripes.png")).placed(200)
    assert torch.equal(scene.measured > 0, scene.view.mask) and scene.view.mask.sum() == (stored > 0).sum()


@each("odd", [-3.0, np.inf, np.nan])
def test_an_invalid_depth_on_the_object_is_not_observed(sofa_files, tmp_path, odd):
    folder, _ = sofa_files
    depths, mask = np.load(folder / "depth.npy"), np.array(Image.open(folder / "mask.png")) > 0
    depths[::2] = odd
    np.save(tmp_path / "odd.npy", depths)
    scene = depth_image(sofa_files, path=str(tmp_path / "odd.npy"), mask_path=str(folder / "mask.png")).placed(200)
    assert (scene.measured >= 0).all() and scene.observed_view()[1].sum() == mask[1::2].sum()


def test_a_far_pixel_at_the_outline_does_not_shrink_the_object(sofa_files, tmp_path):
    depths = np.load(sofa_files[0] / "depth.npy")
    depths[tuple(np.argwhere(depths > 0)[0])] *= 3
    np.save(tmp_path / "flies.npy", depths)
    sizes = [
        np.linalg.norm(depth_image(sofa_files, path=str(path)).placed(200).to_world[:3, 0])
        for path in (sofa_files[0] / "depth.npy", tmp_path / "flies.npy")
    ]
    assert sizes[1] == pytest.approx(sizes[0], rel=0.02)


def test_too_few_depths_are_refused(sofa_files):
    with pytest.raises(BadInput, match=r"has \d+ depths on the object at view.resolution=4, and 20 are the fewest"):
        depth_image(sofa_files).placed(4)


def test_a_ground_truth_far_from_most_observed_points_is_refused(sofa_files, tmp_path):
    scene = depth_image(sofa_files).placed(40)
    icosphere(0.1, scene.mesh.vertices[0]).moved(scene.to_world).save(tmp_path / "speck.ply")
    with pytest.raises(BadInput, match=r"times the radius of .*: give both in one world, .* dataset.unchecked=true"):
        depth_image(sofa_files, truth=str(tmp_path / "speck.ply")).placed(40)
    mesh = depth_image(sofa_files, truth=str(tmp_path / "speck.ply"), unchecked=True).placed(40).mesh
    assert any("times the radius of what" in note for note in mesh.repairs)


def test_files_without_depths_are_refused(sofa_files, tmp_path):
    stored, mask = (
        {"a": np.zeros((4, 4, 3)), "b": np.zeros((9, 9)), "c": np.ones((9, 9))},
        str(sofa_files[0] / "mask.png"),
    )
    for (name, numbers), message in zip(stored.items(), ("one number", "no object", "120 and 9 x 9"), strict=True):
        np.save(tmp_path / f"{name}.npy", numbers)
        with pytest.raises(ValueError, match=message):
            depth_image(sofa_files, path=str(tmp_path / f"{name}.npy"), mask_path=mask if name == "c" else None).placed(
                32
            )


@pytest.mark.slow
def test_a_prior_completes_an_object_at_any_pose(sofa_files, tmp_path):
    folder, camera = sofa_files
    rows = str(camera.camera_to_world.tolist()).replace(" ", "")
    image = ("dataset=depth_image", f"dataset.path={folder}/depth.png", "dataset.intrinsics=[150,140,70.3,52.8]")
    world = (f"dataset.scale={STEP}", f"dataset.camera_to_world={rows}", f"dataset.truth={folder}/sofa.ply")
    small = ("scale=smoke", "view.resolution=24", "evaluation.grid=32", "evaluation.every=null", "threads=1")
    for wrong, message in (
        (("task=pose",), "set task=completion"),
        ((), "set prior.of=sofa"),
        (("index=1",), "index=0"),
    ):
        assert message in command(*image, *small, *wrong, f"results_dir={tmp_path}").err
    fewer = ("task.rotations=6", "task.optimiser.iterations=80", "evaluation.picture=null", "isolation=off")
    output = command(*image, *world, *small, *fewer, "prior.of=sofa", f"results_dir={tmp_path}").out
    record = record_of(output)
    assert record["metrics"]["chamfer_l1"] < 0.25 * record["metrics_start"]["chamfer_l1"]
    vertices = read_mesh(f"{output.splitlines()[-1]}/mesh_world.ply").vertices
    assert np.median(Truth(read_mesh(folder / "sofa.ply")).distance(vertices)) < 0.4  # the sofa is 14 wide
