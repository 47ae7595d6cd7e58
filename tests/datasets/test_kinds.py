"""Photographs of the kinds that people have: each is read as it was taken, or refused with the true cause."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import ExifTags, Image

from datasets import own_photographs
from datasets.captures.frames import OPENGL
from datasets.captures.hull import fit_of
from datasets.captures.take import read_image
from datasets.own_photographs import Capture, Reading, read_capture
from renderers.checks import BadInput
from tests.datasets.test_captures import (
    CENTRE,
    FOCAL,
    MIDDLE,
    RADIUS,
    SIZE,
    cameras,
    idr,
    image,
    llff,
    nerf,
)
from tests.looped import each

READ, PLAIN = Reading(48), Reading(48, masks=False)
POINTS = CENTRE + 0.5 * RADIUS * (np.random.default_rng(0).random((50, 3)) - 0.5)
FEW = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=5, deadline=None)


def off(capture: Capture, middle: tuple[float, float] = MIDDLE, away: float = 0.0) -> float:
    """Most pixels by which points of the world are seen elsewhere than by the cameras that took the photographs."""
    back = np.linalg.inv(capture.to_world)
    unit = torch.from_numpy((POINTS + away) @ back[:3, :3].T + back[:3, 3]).float()
    errors = []
    for shot in capture.shots:
        camera = cameras()[int(re.findall(r"\d+", shot.name)[-1])]
        seen = torch.from_numpy(POINTS).double() @ camera.world_to_camera[:3, :3].T.double()
        seen = (seen + camera.world_to_camera[:3, 3]).numpy()
        expected = FOCAL * seen[:, :2] / seen[:, 2:] + middle
        errors.append(np.abs(shot.camera.project(unit)[0].numpy() - expected).max())
    return float(max(errors))


def changed(folder: Path, change) -> None:
    """Rewrites transforms.json."""
    stored = json.loads((folder / "transforms.json").read_text())
    change(stored)
    (folder / "transforms.json").write_text(json.dumps(stored))


def renamed(folder: Path, name) -> None:
    """Gives the files of a folder other names, by their number."""
    files = sorted(folder.iterdir())
    for i, file in enumerate(files):
        file.rename(folder / f"new_{i}")
    for i in range(len(files)):
        (folder / f"new_{i}").rename(folder / name(i))


# Pairs


@each("format, folder", [(idr, "image"), (llff, "images_4")])
def test_names_without_zeros_are_paired_in_string_order(tmp_path, format, folder):
    tmp_path = tmp_path / folder
    tmp_path.mkdir()
    format(tmp_path)
    for place in (folder, "mask"):
        order = sorted(f"{i}.png" for i in range(8, 18))
        renamed(tmp_path / place, lambda i, order=order: order[i])
    capture = read_capture(tmp_path, READ)
    assert [shot.name for shot in capture.shots] == order
    assert capture.notes[
        0
    ] == "10 images, paired with cameras by name order: 17.png before 8.png; if cameras follow " + (
        "the numbers, give these leading zeros"
    )
    (tmp_path / folder / "12.png").unlink()
    assert [shot.name for shot in read_capture(tmp_path, READ).shots] == [name for name in order if name != "12.png"]


@each("lost", [0, 9])
def test_where_names_do_not_tell_what_is_missing_masks_do(tmp_path, monkeypatch, lost):
    """Of 000 to 009, or of 001 to 010, 001 to 009 are left, and a small ball is not where the cameras look."""
    tmp_path = tmp_path / str(lost)
    tmp_path.mkdir()
    idr(tmp_path)
    rng = np.random.default_rng(0)
    points = CENTRE + [0.15, 0.1, 0.2] + 0.12 * rng.normal(size=(4000, 3)).clip(-1, 1)
    for i, camera in enumerate(cameras()):
        columns, rows = camera.project(torch.from_numpy(points).float())[0].long().T
        mask = np.zeros(SIZE, np.uint8)
        mask[rows, columns] = 255
        Image.fromarray(mask).save(tmp_path / "mask" / f"{i:03d}.png")
    for place in ("image", "mask"):
        renamed(tmp_path / place, lambda i: f"{i + (lost > 0):03d}.png")
        (tmp_path / place / f"{lost + (lost > 0):03d}.png").unlink()
    capture = read_capture(tmp_path, READ)
    assert "which images are missing was found by the masks" in capture.notes[-1]
    for shot, camera in zip(capture.shots, (cameras()[1:] if lost == 0 else cameras()[:9]), strict=True):
        np.testing.assert_allclose(shot.camera.world_to_camera[:3, :3], camera.world_to_camera[:3, :3], atol=1e-4)
    with pytest.raises(BadInput, match="do not tell which, nor do masks"):
        read_capture(tmp_path, PLAIN)
    with monkeypatch.context() as patch:
        patch.setattr(own_photographs, "fit_of", lambda *given: replace(fit_of(*given), shown=(0.4,)))
        with pytest.raises(BadInput, match=r"the photographs show 40% of the object"):
            read_capture(tmp_path, READ)


def test_without_masks_nothing_is_said_of_them(tmp_path):
    idr(tmp_path)
    (tmp_path / "mask" / "004.png").rename(tmp_path / "mask" / "other.png")
    with pytest.raises(BadInput, match="has no mask"):
        read_capture(tmp_path, READ)
    assert read_capture(tmp_path, PLAIN).masks == ""
    shutil.rmtree(tmp_path / "mask")
    with pytest.raises(BadInput, match=r"dataset\.images=image is for COLMAP, and .* has IDR/NeuS: leave it out"):
        read_capture(tmp_path, Reading(48, images="image"))


def test_masks_that_transforms_json_does_not_name_are_used(tmp_path):
    nerf(tmp_path)
    white = np.full(SIZE, 255, np.uint8)
    white[:, :2] = 0
    (tmp_path / "masks").mkdir()
    for file in sorted(tmp_path.glob("train/*.png")):
        Image.fromarray(white).save(tmp_path / "masks" / file.name)
    own = read_capture(tmp_path, READ)
    assert any("does not name it" in note for note in own.notes)
    assert all(shot.mask.float().mean() > 0.9 for shot in own.shots)
    changed(tmp_path, lambda stored: [one.update(mask_path="masks/r_0.png") for one in stored["frames"]])
    with pytest.raises(BadInput, match=r"masks/r_0\.png is the mask of several images"):
        read_capture(tmp_path, READ)


def test_files_of_a_mac_are_no_images(tmp_path):
    idr(tmp_path)
    for file in [*tmp_path.rglob("*.png")]:
        file.with_name(f"._{file.name}").write_bytes(b"AppleDouble")
    assert off(read_capture(tmp_path, PLAIN)) < 0.01


# NeRF's files


def test_fields_of_view_and_matrices_give_focal_lengths(tmp_path):
    nerf(tmp_path)
    angles = [2 * np.arctan(SIZE[1 - i] / 2 / FOCAL) for i in (0, 1)]
    matrix = [[FOCAL, 0, MIDDLE[0], 0], [0, FOCAL, MIDDLE[1], 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    ways = (
        {"camera_angle_x": angles[0], "camera_angle_y": angles[1]},
        {"camera_angle_y": angles[1]},
        {"x_fov": np.degrees(angles[0])},
        {"intrinsic_matrix": matrix},
    )
    for way in ways:
        changed(
            tmp_path, lambda stored, way=way: ([stored.pop(key, 0) for key in ("fl_x", "fl_y")], stored.update(way))
        )
        assert off(read_capture(tmp_path, PLAIN)) < 0.01
        changed(tmp_path, lambda stored, way=way: [stored.pop(key) for key in way])
    changed(tmp_path, lambda stored: (stored.update(fl_x=FOCAL, fl_y=None), [stored.pop(key) for key in "wh"]))
    guessed = read_capture(tmp_path, PLAIN)
    assert off(guessed) < 0.01 and "transforms.json states no w and h" in guessed.notes[0]
    changed(tmp_path, lambda stored: stored.pop("fl_x"))
    with pytest.raises(BadInput, match="r_0 has no focal length: give fl_x"):
        read_capture(tmp_path, PLAIN)


def test_each_frame_has_its_own_camera(tmp_path):
    nerf(tmp_path)
    own = ("fl_x", "fl_y", "cx", "cy", "w", "h")
    changed(tmp_path, lambda stored: [frame.update({key: stored[key] for key in own}) for frame in stored["frames"]])
    top = {"fl_x": 1.0, "fl_y": 1.0, "camera_angle_x": 1.0, "y_fov": 9.0, "intrinsic_matrix": np.eye(3).tolist()}
    changed(tmp_path, lambda stored: stored.update(top, cx=0.0, cy=0.0))
    assert off(read_capture(tmp_path, PLAIN)) < 0.01
    changed(tmp_path, lambda stored: stored["frames"][2].update(camera_angle_x=0.5))
    with pytest.raises(
        BadInput, match=r"r_2: focal lengths differ, 60 pixels by fl_x, 93\.9\d* pixels by camera_angle_x"
    ):
        read_capture(tmp_path, PLAIN)


MITSUBA = np.diag([-1.0, 1.0, -1.0, 1.0])  # x left, y up, z forward


@each("axes, flag", [(np.eye(4), {}), (OPENGL, {"from_na": True}), (MITSUBA, {"from_mitsuba": True})])
def test_flags_tell_of_other_axes(tmp_path, axes, flag):
    nerf(tmp_path)

    def change(stored) -> None:
        stored.update(flag)
        for frame in stored["frames"]:
            frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ axes).tolist()

    changed(tmp_path, change)
    assert off(read_capture(tmp_path, PLAIN)) < 0.01


@FEW
@given(st.integers(3, 6))
def test_few_digits_are_the_nearest_rotation(tmp_path, digits):
    nerf(tmp_path)

    def change(stored) -> None:
        for frame in stored["frames"]:
            frame["transform_matrix"] = np.round(frame["transform_matrix"], digits).tolist()

    changed(tmp_path, change)
    assert off(read_capture(tmp_path, PLAIN)) < 0.1


BROKEN = {
    "frames": (lambda stored: stored.pop("frames"), "transforms.json has no frames"),
    "matrix": (lambda stored: stored["frames"][3].pop("transform_matrix"), "r_3 has no transform_matrix"),
    "path": (lambda stored: stored["frames"][3].pop("file_path"), "a frame has no file_path"),
    "zeros": (
        lambda stored: stored["frames"][3].update(transform_matrix=np.zeros((4, 4)).tolist()),
        "r_3: transform_matrix must be invertible",
    ),
    "turned": (
        lambda stored: [
            one.update(transform_matrix=np.transpose(one["transform_matrix"]).tolist()) for one in stored["frames"]
        ],
        "r_0: transform_matrix must have 0 0 0 1 as its fourth row, not .*: it may be transposed; export it again",
    ),
    "one place": (
        lambda stored: [row.__setitem__(3, 2.0) for one in stored["frames"] for row in one["transform_matrix"][:3]],
        r"all 10 cameras, of r_0.png to r_9.png, are at one place, \(2, 2, 2\)",
    ),
    "null": (lambda stored: stored["frames"][3].update(file_path=None), "a frame has no file_path"),
    "no size": (lambda stored: stored.update(w=0, h=0), r"r_0\.png must be of one pixel or more, not \(0, 0\)"),
    "width": (lambda stored: stored.pop("h"), "r_0 has no h"),
    "twice": (lambda stored: stored["frames"].append(stored["frames"][0]), "has ./train/r_0 twice"),
    "mirror": (
        lambda stored: stored["frames"][3].update(transform_matrix=np.diag([-1.0, 1, 1, 1]).tolist()),
        "r_3.png must have a rotation, but .* mirrors",
    ),
    "scaled": (
        lambda stored: stored["frames"][3].update(transform_matrix=np.diag([2.0, 2, 2, 1]).tolist()),
        "r_3.png must have a rotation, but its axes have lengths 0.5",
    ),
}


@each("broken", [*BROKEN])
def test_what_is_missing_or_broken_is_named(tmp_path, broken):
    change, words = BROKEN[broken]
    nerf(tmp_path)
    changed(tmp_path, change)
    with pytest.raises(BadInput, match=words):
        read_capture(tmp_path, PLAIN)


# Orientation


def tagged(folder: Path, tag: int, turn: Image.Transpose | None = None) -> None:
    """Turns the images of a folder, and gives them a tag: 6 says "turn it by 90 degrees clockwise"."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = tag
    for file in folder.iterdir():
        picture = Image.open(file)
        (picture if turn is None else picture.transpose(turn)).save(file, exif=exif)


@FEW
@given(st.integers(2, 8))
def test_pixels_are_used_as_stored(tmp_path, tag):
    nerf(tmp_path)
    plain = read_capture(tmp_path, PLAIN)
    tagged(tmp_path / "train", tag)
    found = read_capture(tmp_path, PLAIN)
    assert all(torch.equal(one.colours, other.colours) for one, other in zip(found.shots, plain.shots, strict=True))
    assert found.notes == ("10 photographs have a tag of orientation (EXIF), and are used as stored, as cameras are",)


def test_a_picture_is_turned_where_its_camera_has_that_size(tmp_path):
    nerf(tmp_path)
    plain = read_capture(tmp_path, PLAIN)
    tagged(tmp_path / "train", 6, Image.Transpose.ROTATE_90)
    found = read_capture(tmp_path, PLAIN)
    assert torch.equal(found.shots[3].colours, plain.shots[3].colours)
    assert found.notes == ("10 photographs are turned by their tag (EXIF), since their cameras have that size",)


def test_a_turned_picture_of_unturned_cameras_is_refused(tmp_path):
    idr(tmp_path)
    tagged(tmp_path / "image", 8, Image.Transpose.ROTATE_90)
    with pytest.raises(BadInput, match=r"a mask has the size of its image; the image's tag of orientation \(EXIF\)"):
        read_capture(tmp_path, READ)


# Masks


COLOUR = st.tuples(*[st.sampled_from([0, 90, 180, 255])] * 3)


@FEW
@given(st.lists(COLOUR.filter(any), min_size=2, max_size=2), st.booleans())
def test_a_mask_is_all_that_is_not_background(tmp_path, colours, alpha):
    mask = image(cameras()[0])[1]
    inside, left = np.asarray(mask) > 0, np.arange(SIZE[1])[None] < SIZE[1] / 2
    painted = np.where(left[..., None], colours[0], colours[1]) * inside[..., None]
    painted = np.dstack([painted, np.full(SIZE, 255)]) if alpha else painted
    Image.fromarray(painted.astype(np.uint8)).save(tmp_path / "mask.png")
    image(cameras()[0])[0].save(tmp_path / "image.png")
    found = read_image(tmp_path / "image.png", tmp_path / "mask.png", 48)[1]
    assert found is not None and ((found[..., 0] > 0.5) == inside).all()


def test_inverted_masks_and_broken_files_are_told(tmp_path):
    idr(tmp_path)
    files = sorted((tmp_path / "mask").iterdir())
    for some, told in (
        (files[4:5], "1 of the masks, such as that of 000004.png"),
        (files[:4] + files[5:], "10 of the masks"),
    ):
        for file in some:
            Image.fromarray(255 - np.asarray(Image.open(file))).save(file)
        with pytest.raises(BadInput, match=f"{told}.* are white along the border, as inverted ones"):
            read_capture(tmp_path, READ)
    for file in files:
        Image.fromarray(np.full(SIZE, 255, np.uint8)).save(file)
    with pytest.raises(BadInput, match="the masks are white everywhere"):
        read_capture(tmp_path, READ)
    file = tmp_path / "image" / "000003.png"
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(BadInput, match=r"000003.png cannot be read as an image"):
        read_capture(tmp_path, READ)


# Worlds


@FEW
@given(st.floats(-7e6, 7e6))
def test_a_far_world_is_read_as_exactly_and_led_back_to(tmp_path, away):
    nerf(tmp_path)

    def change(stored) -> None:
        for frame in stored["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[3] += away

    changed(tmp_path, change)
    capture = read_capture(tmp_path, READ if abs(away) > 1e6 else PLAIN)
    assert off(capture, away=away) < 0.01
    assert np.abs(capture.to_world[:3, 3] - away - CENTRE).max() < 0.1
    assert ", ".join(str(float(value)) for value in capture.sphere.centre) in capture.summary


def test_parallel_cameras_without_masks_need_depths(tmp_path):
    llff(tmp_path)
    rows = np.load(tmp_path / "poses_bounds.npy")
    for i, row in enumerate(rows):
        pose = row[:15].reshape(3, 5)
        pose[:, :3] = np.stack([[0, -1, 0], [1, 0, 0], [0, 0, 1]], axis=1)  # along -z
        pose[:, 3] = [0.1 * (i % 4), 0.1 * (i // 4), 7.0]
    rows[:, 15:] = 3.5, 4.5
    np.save(tmp_path / "poses_bounds.npy", rows)
    capture = read_capture(tmp_path, Reading(48, masks=False))
    assert abs(capture.sphere.centre[2] - 3.0) < 1e-6 and 0.5 <= capture.sphere.radius < 2
    assert "the depths that the format states" in capture.summary
    frames = [{"file_path": f"images_4/{i:03d}.png", "transform_matrix": np.eye(4).tolist()} for i in range(10)]
    for i, frame in enumerate(frames):
        frame["transform_matrix"][0][3] = 0.1 * i
    (tmp_path / "poses_bounds.npy").unlink()
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 60.0, "frames": frames}))
    with pytest.raises(BadInput, match="the cameras look in parallel"):
        read_capture(tmp_path, Reading(48, masks=False))


# IDR's matrices


def matrices(folder: Path, change) -> None:
    with np.load(folder / "cameras_sphere.npz") as stored:
        known = dict(stored)
    np.savez(folder / "cameras_sphere.npz", **change(known))


def test_one_scale_is_that_of_all_and_must_be_a_similarity(tmp_path):
    idr(tmp_path)
    matrices(tmp_path, lambda known: {key: one for key, one in known.items() if key[:5] == "world" or key[-2:] == "_0"})
    capture = read_capture(tmp_path, READ)
    assert off(capture) < 0.01 and "scale_mat_0 is that of all cameras: 9 have none" in capture.notes[0]
    matrices(tmp_path, lambda known: known | {"scale_mat_0": np.diag([1.0, 1.0, 0.7, 1.0])})
    with pytest.raises(BadInput, match="scale_mat_0 must scale all axes alike"):
        read_capture(tmp_path, READ)
    matrices(tmp_path, lambda known: known | {"scale_mat_0": np.eye(4), "scale_mat_3": np.diag([2.0, 2.0, 2.0, 1.0])})
    with pytest.raises(BadInput, match="scale_mat_3 differs from scale_mat_0"):
        read_capture(tmp_path, READ)


def test_cameras_of_larger_images_and_of_other_ones_are_refused(tmp_path):
    idr(tmp_path)
    matrices(
        tmp_path,
        lambda known: {key: np.diag([2.0, 2, 1, 1]) @ one if key[:5] == "world" else one for key, one in known.items()},
    )
    with pytest.raises(BadInput, match=r"in images about 2\.1 times as wide and high"):
        read_capture(tmp_path, READ)
    idr(tmp_path)
    for i, file in enumerate(sorted((tmp_path / "mask").iterdir())):
        Image.fromarray(np.roll(np.asarray(Image.open(file)), 11 * (-1) ** i, axis=1)).save(file)
    with pytest.raises(BadInput, match=r"the visual hull of the masks overlaps .* or set dataset.unchecked=true"):
        read_capture(tmp_path, READ)
    capture = read_capture(tmp_path, Reading(48, unchecked=True))
    assert "cameras may be those of other images" in capture.notes[-1]
