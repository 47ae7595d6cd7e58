"""Photographs as people write them: read with the same cameras, or refused with their cause, in each format."""

import re
import shutil
from collections.abc import Callable
from os import truncate
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from datasets.files.captures.frames import OPENGL
from datasets.files.own_photographs import ReadSettings, read_capture
from renderers.checks import BadInput
from tests.made_photographs import (
    FOCAL,
    MIDDLE,
    PLAIN,
    READ,
    SIZE,
    changed,
    colmap,
    idr,
    llff,
    middlebury,
    moved,
    nerf,
    off,
    renamed,
    repainted,
    rewritten,
)

Spoil = Callable[[Path], object]
IMAGES, MATRICES, LINES = "sparse/0/images.txt", "cameras_sphere.npz", "ball_par.txt"
FIFTH = slice(4, 5)


def removed(name: str) -> Spoil:
    return lambda folder: shutil.rmtree(folder / name) if (folder / name).is_dir() else (folder / name).unlink()


def copied(name: str, other: str) -> Spoil:
    return lambda folder: shutil.copy(folder / name, folder / other)


def written(name: str, data: bytes) -> Spoil:
    return lambda folder: (folder / name).write_bytes(data)


def cameras(change: Callable[[dict], dict]) -> Spoil:
    return lambda folder: rewritten(folder / "cameras_sphere.npz", change)


def stored(change: Callable[[dict], object]) -> Spoil:
    return lambda folder: changed(folder, change)


def frame_3(**values) -> Spoil:
    return stored(lambda data: data["frames"][3].update(values))


def each_frame(**values) -> Spoil:
    return stored(lambda data: [frame.update(values) for frame in data["frames"]])


def poses(change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    return lambda folder: moved(folder, change)


def masks(change: Callable[[np.ndarray], np.ndarray], selected: slice = slice(None)) -> Spoil:
    return lambda folder: repainted(sorted((folder / "mask").iterdir())[selected], change)


def text(name: str, old: str, new: str | Callable[[re.Match], str]) -> Spoil:
    """Replaces the matches of a pattern."""

    def replaced(folder: Path) -> None:
        content, count = re.subn(old, new, (folder / name).read_text())
        assert count
        (folder / name).write_text(content)

    return replaced


def rotated(folder: Path) -> None:
    """Rotates the images and sets their orientation tag."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 8
    for file in (folder / "image").iterdir():
        Image.open(file).transpose(Image.Transpose.ROTATE_90).save(file, exif=exif)


def without_focal_length(**values) -> Spoil:
    return stored(lambda data: data.update(fl_x=None, fl_y=None) or data.update(values))


def own_cameras(folder: Path) -> None:
    """Each frame has the camera, and the head of the file has another one."""
    keys = ("fl_x", "fl_y", "cx", "cy", "w", "h")
    changed(folder, lambda data: [frame.update({key: data[key] for key in keys}) for frame in data["frames"]])
    wrong = {"fl_x": 1.0, "fl_y": 1.0, "camera_angle_x": 1.0, "y_fov": 9.0, "intrinsic_matrix": np.eye(3).tolist()}
    changed(folder, lambda data: data.update(wrong, cx=0.0, cy=0.0))


def flagged(axes: np.ndarray, **flag: bool) -> Spoil:
    """Other axes of the cameras, with the flag that says so."""
    return lambda folder: (moved(folder, lambda matrix: matrix @ axes), changed(folder, lambda data: data.update(flag)))


def other_models(folder: Path) -> None:
    """A model of four images, before the whole one; and an image without a camera."""
    shutil.copytree(folder / "sparse" / "0", folder / "sparse" / "1")
    lines = (folder / IMAGES).read_text().splitlines()
    (folder / IMAGES).write_text("\n".join(lines[:8]) + "\n")
    for name in ("images", "mask"):
        shutil.copy(folder / name / "003.png", folder / name / "100.png")


def files_of_a_mac(folder: Path) -> None:
    for file in [*folder.rglob("*.png")]:
        file.with_name(f"._{file.name}").write_bytes(b"AppleDouble")


def doubled(match: re.Match) -> str:
    """A line with a quaternion of twice the length."""
    return f"{match[1]} {' '.join(str(2 * float(number)) for number in match[2].split())}"


ANGLES = [2 * np.arctan(SIZE[1 - i] / 2 / FOCAL) for i in (0, 1)]  # fields of view, across and down
MATRIX = [[FOCAL, 0, MIDDLE[0], 0], [0, FOCAL, MIDDLE[1], 0], [0, 0, 1, 0], [0, 0, 0, 1]]
MITSUBA = np.diag([-1.0, 1.0, -1.0, 1.0])  # x left, y up, z forward
INTRINSICS = {f"camera_mat_{i}": np.diag([FOCAL, FOCAL, 1.0, 1.0]) for i in range(10)}
UNREAD = "has keys that are not read, {}: if they describe a lens"
LENS_KEYS = ("s1", "ftheta_p0", "equirectangular", "distortion", "K1", "camera_type", "lens", "rolling_shutter")
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n"
FETCH = "is a Git LFS pointer; fetch it with 'git lfs pull'"
TRANSPOSED = [[80.0, 0, 0], [0, 80, 0], [20, 15, 1]]
WIDE, FLAT = np.diag([2.0, 2.0, 1.0, 1.0]), np.diag([1.0, 1.0, 0.7, 1.0])
READ_ALIKE = {  # a change that keeps the cameras, and a part of the note on it
    idr: [
        (files_of_a_mac, ""),
        (cameras(lambda data: {key: data[key] for key in data if key[:5] == "world" or key[-2:] == "_0"}),
         "scale_mat_0 is that of all cameras: 9 have none"),
        (cameras(lambda data: data | {"dist_": [0.1], "world_mat_inv_0": np.eye(4)}), UNREAD.format("dist_")),
        (cameras(lambda data: data | INTRINSICS), ""),
        (lambda f: (cameras(lambda data: data | INTRINSICS)(f), (f / MATRICES).rename(f / "cameras.npz")), ""),
    ],
    nerf: [
        (own_cameras, ""),
        (without_focal_length(camera_angle_x=ANGLES[0], camera_angle_y=ANGLES[1]), ""),
        (without_focal_length(camera_angle_y=ANGLES[1]), ""),
        (without_focal_length(x_fov=np.degrees(ANGLES[0])), ""),
        (without_focal_length(intrinsic_matrix=MATRIX), ""),
        (without_focal_length(fl_x=FOCAL, w=None, h=None), "transforms.json states no w and h"),
        (flagged(OPENGL, from_na=True), ""),
        (flagged(MITSUBA, from_mitsuba=True), ""),
        (poses(lambda matrix: matrix.round(6)), ""),
        *((frame_3(**{key: 0.1, "rotation": 0.01}), UNREAD.format(key)) for key in LENS_KEYS),
    ],
    middlebury: [(text(LINES, r"^10\n", ""), "")],
    colmap: [
        (other_models, "no camera for 1 of the images, such as 100.png"),
        (other_models, "sparse/1 with 10 images is taken, not sparse/0 with 4"),
        (text(IMAGES, r"(?m)^(\d+) (\S+ \S+ \S+ \S+)", doubled), ""),
        (text(IMAGES, "png\n\n", "png\n1.5 2.5 -1 3e1 4.5 -1\n"), ""),
        (text(IMAGES, "\n", "\r\n"), ""),
    ],
}  # fmt: skip


@pytest.mark.parametrize("write, change, note", [(write, *row) for write, rows in READ_ALIKE.items() for row in rows])
def test_cameras_stay_those_that_were_written(tmp_path, write, change, note):
    write(tmp_path)
    change(tmp_path)
    capture = read_capture(tmp_path, READ if note else PLAIN)
    assert off(capture) < 0.01 and len(capture.shots) == 10
    assert any(note in line for line in capture.notes) if note else capture.notes == ()


REFUSED = {
    idr: [
        (removed(MATRICES), r"has no cameras that are known.*transforms\.json.*poses_bounds\.npy"),
        (removed("image"), r"has cameras \(IDR/NeuS\) but none of their images"),
        (copied("image/000004.png", "image/000010.png"), "000010.png has no camera.*10 cameras.* 11 images.*remove"),
        (written("image/000004.png", b"no image"), "000004.png cannot be read as an image.*copy or export it again"),
        (lambda f: truncate(f / "image/000003.png", 100), "000003.png cannot be read as an image"),
        (written("image/000003.png", POINTER), FETCH),
        (written(MATRICES, POINTER), FETCH),
        (removed("image/000004.png"), r"10 cameras, number 0 to 9, and there are 9 images \(000000.png, .*missing"),
        (masks(lambda mask: mask > 0, FIFTH), "mask/004.png has values up to 1, as labels do: write 255"),
        (masks(lambda mask: mask // 2), "mask/000.png has values up to 127, as labels do"),
        (removed("mask/004.png"), r"000004.png has no mask in.*9 masks \(000.png.*add it"),
        (lambda f: Image.new("L", (10, 10)).save(f / "mask/004.png"), "004.png has 10 x 10 pixels, its image 48 x 40"),
        (rotated, r"a mask has the size of its image; the image's tag of orientation \(EXIF\)"),
        (masks(np.zeros_like, FIFTH), "the mask of 000004.png is empty.*use no masks"),
        (masks(lambda mask: 255 - mask, FIFTH), "1 of the masks, such as that of 000004.png.* white along the border"),
        (masks(lambda mask: 255 - mask), "10 of the masks.* are white along the border, as inverted ones"),
        (masks(lambda mask: 0 * mask + 255), "the masks are white everywhere"),
        (cameras(lambda data: dict.fromkeys(data, np.full((4, 4), np.nan))), "world_mat_0 must have finite numbers"),
        (cameras(lambda data: {key: data[key] for key in [*data][1:]}), f"{MATRICES} has no world_mat_0.*export"),
        (cameras(lambda data: data | {"scale_mat_0": FLAT}), "scale_mat_0 must scale all axes alike"),
        (cameras(lambda data: data | {"scale_mat_3": np.eye(4)}), "scale_mat_3 differs from scale_mat_0"),
        (cameras(lambda data: {key: WIDE @ m if key[0] == "w" else m for key, m in data.items()}), "2.1 times"),
    ],
    llff: [(written("poses_bounds.npy", POINTER), FETCH)],
    nerf: [
        (written("transforms.json", POINTER), FETCH),
        (each_frame(mask_path="train/r_0.png"), "train/r_0.png is the mask of several images"),
        (stored(lambda data: data.pop("frames")), "transforms.json has no frames"),
        (stored(lambda data: data["frames"].append(data["frames"][0])), "has ./train/r_0 twice"),
        (stored(lambda data: data["frames"][3].pop("file_path")), "a frame has no file_path"),
        (frame_3(file_path=None), "a frame has no file_path"),
        (frame_3(transform_matrix=None), "r_3 has no transform_matrix"),
        (frame_3(transform_matrix=np.zeros((4, 4)).tolist()), "r_3: transform_matrix must be invertible"),
        (frame_3(transform_matrix=np.diag([-1.0, 1, 1, 1]).tolist()), "r_3.png must have a rotation, but .* mirrors"),
        (frame_3(transform_matrix=np.diag([2.0, 2, 2, 1]).tolist()), "r_3.png must .* its axes have lengths 0.5"),
        (poses(lambda matrix: matrix[:2, :2]), "must be 4 x 4, not 2 x 2"),
        (poses(np.transpose), "r_0: transform_matrix must have 0 0 0 1 as its .*: it may be transposed; export it"),
        (poses(lambda matrix: np.vstack([np.c_[matrix[:3, :3], [2.0] * 3], matrix[3]])),
         r"all 10 cameras, of r_0.png to r_9.png, are at one place, \(2, 2, 2\)"),
        (stored(lambda data: data.update(w=0, h=0)), r"must be of one pixel or more, not \(0, 0\)"),
        (stored(lambda data: data.pop("h")), "r_0 has no h"),
        (stored(lambda data: [data.pop(key) for key in ("fl_x", "fl_y")]), "r_0 has no focal length: give fl_x"),
        (frame_3(fl_x=60.0, camera_angle_x=0.5), r"r_3: focal lengths differ, 60 pixels by fl_x, 93\.9\d* pixels by c"),
        (each_frame(camera_angle_x=39.6), "between 0 and pi, not 39.6: it is in radians"),
        (each_frame(intrinsic_matrix=TRANSPOSED), "transposed"),
        (each_frame(intrinsic_matrix=np.ravel(TRANSPOSED).tolist()), "must be 3 x 3"),
    ],
    middlebury: [
        (lambda folder: renamed(folder / "mask", "mask{}.png".format),
         r"ball0000.png has no mask in .* 10 images \(ball0000.*, ball0004.png, \.\.\.\) and 10 masks \(mask0.png"),
        (text(LINES, r"(?s)(ball0002.*?\n)(.*)", r"\1\2\1"), "ball_par.txt has ball0002.png twice"),
    ],
    colmap: [
        (text(IMAGES, "\n\n", "\n"), "images.txt: after 000.png there must be a line of its points"),
        (text(IMAGES, r"(?m)^4 \S+ \S+ \S+ \S+", "4 0 0 0 0"), "the quaternion of 003.png is 0 0 0 0"),
    ],
}  # fmt: skip


@pytest.mark.parametrize("write, spoil, words", [(write, *row) for write, rows in REFUSED.items() for row in rows])
def test_unusable_photographs_are_refused_in_one_line(tmp_path, write, spoil, words):
    write(tmp_path)
    spoil(tmp_path)
    with pytest.raises(BadInput, match=words) as error:
        read_capture(tmp_path, READ)
    assert len(str(error.value).splitlines()) == 1


def test_without_masks_missing_masks_are_accepted_and_parallel_cameras_refused(tmp_path):
    idr(tmp_path)
    (tmp_path / "mask" / "004.png").unlink()
    assert read_capture(tmp_path, PLAIN).masks == ""
    with pytest.raises(BadInput, match=r"dataset\.images=image is for COLMAP, and .* has IDR/NeuS: leave it out"):
        read_capture(tmp_path, ReadSettings(SIZE[1], masks=False, images="image"))
    (tmp_path / MATRICES).unlink()
    nerf(tmp_path)
    moved(tmp_path, lambda matrix: np.hstack([np.eye(4)[:, :3], matrix[:, 3:]]))
    with pytest.raises(BadInput, match="the cameras look in parallel"):
        read_capture(tmp_path, PLAIN)
