"""Photographs in each format, with what people write otherwise: read as taken, or refused with the true cause."""

import re
import shutil

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from datasets.captures.frames import OPENGL
from datasets.captures.rows import _from_angles
from datasets.captures.take import _alike, read_image
from datasets.own_photographs import Reading, read_capture
from renderers.checks import BadInput
from tests.datasets.test_captures import (
    CENTRE,
    FOCAL,
    MIDDLE,
    SIZE,
    cameras,
    colmap,
    idr,
    llff,
    middlebury,
    nerf,
)
from tests.datasets.test_captures import write_images as write
from tests.datasets.test_kinds import FEW, PLAIN, READ, changed, off
from tests.looped import each

# DVR, BlendedMVS, Choy


def test_broken_cameras_beside_others_do_not_matter(tmp_path):
    nerf(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", np.zeros((3, 17)))
    capture = read_capture(tmp_path, READ)
    assert capture.format == "NeRF" and "other cameras in the folder are not used: poses_bounds.npy" in capture.notes


def test_an_image_of_floats_is_from_black_to_white(tmp_path):
    Image.fromarray(np.full(SIZE, 0.5, np.float32)).save(tmp_path / "a.tiff")
    assert np.abs(read_image(tmp_path / "a.tiff", None, 48)[0] - 0.5).max() < 0.01


@each(
    "size, same",
    [((400, 300), True), ((401, 300), True), ((133, 100), True), ((400, 297), False), ((4000, 2975), False)],
)
def test_a_cropped_image_is_no_smaller_one(size, same):
    assert _alike(size, (3000, 4000)) == same


def test_intrinsics_beside_whole_cameras_are_neus_own(tmp_path):
    idr(tmp_path)
    (file,) = tmp_path.glob("*.npz")
    stored = dict(np.load(file))
    stored |= {f"camera_mat_{i}": np.diag([FOCAL, FOCAL, 1.0, 1.0]) for i in range(10)}
    for name in ("cameras_sphere.npz", "cameras.npz"):
        file.unlink()
        np.savez(file := tmp_path / name, **stored)
        assert read_capture(tmp_path, READ).format == "IDR/NeuS" and off(read_capture(tmp_path, READ)) < 0.01


@each("matrix", [[[80.0, 0, 0], [0, 80, 0], [20, 15, 1]], [80.0, 0, 20, 0, 80, 15, 0, 0, 1]])
def test_other_matrices_are_no_intrinsics(tmp_path, matrix):
    nerf(tmp_path)
    changed(tmp_path, lambda stored: [frame.update(intrinsic_matrix=matrix) for frame in stored["frames"]])
    with pytest.raises(BadInput, match=r"transposed|must be 3 x 3"):
        read_capture(tmp_path, READ)


def test_dvrs_cameras_and_depths_are_read(tmp_path, monkeypatch):
    monkeypatch.setenv("OPENCV_IO_ENABLE_OPENEXR", "1")
    cv2 = pytest.importorskip("cv2", reason="OpenCV is an extra: pip install -e '.[stereo]'")
    write(tmp_path, "image")
    (tmp_path / "depth").mkdir()
    scale, stored = np.diag([0.9, 0.9, 0.9, 1.0]), {}
    scale[:3, 3] = CENTRE
    half = (np.array(SIZE[::-1]) - 1) / 2
    for i, camera in enumerate(cameras()):
        scaled = np.diag([FOCAL / half[0], FOCAL / half[1], 1.0, 1.0])
        scaled[:2, 2] = (np.array(MIDDLE) - 0.5) / half - 1
        stored |= {f"camera_mat_{i}": scaled, f"scale_mat_{i}": scale}
        stored |= {f"world_mat_{i}": camera.world_to_camera.double().numpy()}
        cv2.imwrite(str(tmp_path / "depth" / f"{i:03d}.exr"), np.full(SIZE, 1.25, np.float32))
    np.savez(tmp_path / "cameras.npz", **stored)
    capture = read_capture(tmp_path, READ)
    assert capture.format == "DVR" and off(capture) < 0.01
    assert capture.sphere.radius == pytest.approx(0.9 * 0.75**0.5)
    assert capture.shots[2].depth is not None
    torch.testing.assert_close(capture.shots[2].depth, torch.full(SIZE, 1.25 / capture.sphere.radius))


def test_blended_mvs_is_read(tmp_path):
    write(tmp_path, "blended_images", names="{:08d}.jpg")
    shutil.copy(tmp_path / "blended_images" / "00000000.jpg", tmp_path / "blended_images" / "00000000_masked.jpg")
    (tmp_path / "cams").mkdir()
    for i, camera in enumerate(cameras()):
        numbers = [one.double().numpy() for one in (camera.world_to_camera, camera.intrinsics)]
        text = "\n\n".join(" ".join(map(str, one.ravel())) for one in numbers)
        first, second = text.split("\n\n")
        (tmp_path / "cams" / f"{i:08d}_cam.txt").write_text(
            f"extrinsic\n{first}\n\nintrinsic\n{second}\n\n1.0 0.01 128 2.0\n"
        )
    capture = read_capture(tmp_path, READ)
    assert capture.format == "BlendedMVS" and off(capture) < 0.01


@FEW
@given(st.floats(0, 360), st.floats(-80, 80), st.floats(0.5, 2))
def test_choys_cameras_are_those_of_his_renderer(azimuth, elevation, distance):
    """Against the steps of the code that came with the renderings."""
    across, up = np.radians([-azimuth, -elevation])
    sa, ca, se, ce = np.sin(across), np.cos(across), np.sin(up), np.cos(up)
    world_to_object = np.array([[ca * ce, -sa, ca * se], [sa * ce, ca, sa * se], [-se, 0, ce]]).T
    object_to_camera = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]]).T
    expected = np.eye(4)
    expected[:3, :3] = object_to_camera @ world_to_object
    expected[:3, 3] = -object_to_camera @ [distance, 0, 0]
    np.testing.assert_allclose(_from_angles(azimuth, elevation, distance), OPENGL @ expected, atol=1e-12)


# COLMAP


def test_the_largest_model_is_taken_and_images_without_a_camera_are_named(tmp_path):
    colmap(tmp_path)
    shutil.copytree(tmp_path / "sparse" / "0", tmp_path / "sparse" / "1")
    lines = (tmp_path / "sparse" / "0" / "images.txt").read_text().splitlines()
    (tmp_path / "sparse" / "0" / "images.txt").write_text("\n".join(lines[:8]) + "\n")
    shutil.copy(tmp_path / "images" / "003.png", tmp_path / "images" / "100.png")
    (tmp_path / "mask" / "100.png").write_bytes((tmp_path / "mask" / "003.png").read_bytes())
    capture = read_capture(tmp_path, READ)
    assert off(capture) < 0.01 and len(capture.shots) == 10
    assert capture.notes == (
        "sparse/1 with 10 images is taken, not sparse/0 with 4",
        "no camera for 1 of the images, such as 100.png",
    )


@each("named", ["a b (1)/{0}", "C:\\me\\images\\{0}", "/home/me/images/{0}", "left/{0}"])
def test_names_with_folders_blanks_and_paths_of_elsewhere(tmp_path, named):
    tmp_path = tmp_path / str(abs(hash(named)))
    tmp_path.mkdir()
    colmap(tmp_path)
    inner = named.format("") if named[0] not in "C/" else ""
    if inner:
        for place in ("images", "mask"):
            (tmp_path / place).rename(tmp_path / "moved")
            (tmp_path / place).mkdir()
            (tmp_path / "moved").rename(tmp_path / place / inner.strip("/"))
    file = tmp_path / "sparse" / "0" / "images.txt"
    file.write_text(re.sub(r"(\d{3}\.png)", lambda name: named.format(name[0]), file.read_text()))
    assert off(read_capture(tmp_path, PLAIN)) < 0.01
    (tmp_path / "images").rename(tmp_path / "elsewhere")
    with pytest.raises(BadInput, match=r"none of their images, such as .*000.png; its files end with .png, .txt"):
        read_capture(tmp_path, READ)
    assert off(read_capture(tmp_path, Reading(48, masks=False, images="elsewhere"))) < 0.01


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n"


@each(
    "format, name",
    [
        (idr, "image/000003.png"),
        (idr, "cameras_sphere.npz"),
        (llff, "poses_bounds.npy"),
        (nerf, "transforms_train.json"),
    ],
)
def test_a_pointer_of_git_lfs_is_told_as_such(tmp_path, format, name):
    folder = tmp_path / name.replace("/", "_")
    folder.mkdir()
    format(folder)
    (file,) = [folder / name] if (folder / name).exists() else folder.glob("*.json")
    file.write_bytes(POINTER)
    with pytest.raises(BadInput, match=r"is a Git LFS pointer; fetch it with 'git lfs pull'"):
        read_capture(folder, READ)


def test_lines_without_points_and_quaternions_of_any_length(tmp_path):
    colmap(tmp_path)
    file = tmp_path / "sparse" / "0" / "images.txt"
    text = file.read_text()
    longer = re.sub(
        r"(?m)^(\d+) (\S+ \S+ \S+ \S+)", lambda m: f"{m[1]} {' '.join(str(2 * float(v)) for v in m[2].split())}", text
    )
    for good in (longer, text.replace("png\n\n", "png\n1.5 2.5 -1 3e1 4.5 -1\n"), text.replace("\n", "\r\n")):
        file.write_text(good)
        assert off(read_capture(tmp_path, PLAIN)) < 0.01
    for bad, words in (
        (text.replace("\n\n", "\n"), r"images.txt: after 000.png there must be a line of its points"),
        (re.sub(r"(?m)^4 \S+ \S+ \S+ \S+", "4 0 0 0 0", text), "the quaternion of 003.png is 0 0 0 0"),
    ):
        file.write_text(bad)
        with pytest.raises(BadInput, match=words):
            read_capture(tmp_path, PLAIN)


def test_middlebury_needs_no_count_and_has_each_name_once(tmp_path):
    middlebury(tmp_path)
    file = tmp_path / "ball_par.txt"
    lines = file.read_text().splitlines()
    file.write_text("\n".join(lines[1:]))
    assert off(read_capture(tmp_path, PLAIN)) < 0.01
    file.write_text("\n".join([*lines, lines[3]]))
    with pytest.raises(BadInput, match=r"ball_par.txt has ball0002.png twice"):
        read_capture(tmp_path, PLAIN)
