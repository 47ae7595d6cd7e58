"""Photographs of a sphere, written in each format and in the variants that people write."""

import json
import shutil
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import ExifTags, Image

from bench.photos import main
from datasets.files import own_photographs
from datasets.files.captures.formats.choy import _from_angles
from datasets.files.captures.frames import OPENGL
from datasets.files.captures.hull import carve, hull_mesh, measure_mask_fit
from datasets.files.captures.layouts import find_layout
from datasets.files.captures.take import _same_aspect, read_image, read_shot
from datasets.files.own_photographs import OwnPhotographs, ReadSettings, read_capture
from datasets.shot import Shot
from renderers.checks import BadInput
from tests.composing import composed
from tests.looped import each
from tests.made_photographs import (
    CENTRE,
    FOCAL,
    FORMATS,
    MIDDLE,
    PLAIN,
    RADIUS,
    READ,
    SIZE,
    cameras,
    idr,
    image,
    llff,
    middlebury,
    moved,
    nerf,
    off,
    repainted,
    rewritten,
)
from tests.tiny import camera_of

FEW = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=5, deadline=None)
SCALE_MAT_SPHERES = {"IDR/NeuS": (CENTRE + 0.05, 0.5), "DVR": (CENTRE, 0.9 * 0.75**0.5)}


@pytest.mark.parametrize("name", FORMATS)
def test_cameras_are_those_that_were_written(tmp_path, name):
    FORMATS[name](tmp_path)
    capture = read_capture(tmp_path, READ)
    middle = (SIZE[1] / 2, SIZE[0] / 2) if name == "LLFF" else MIDDLE
    assert (capture.format, len(capture.shots)) == (name, 10) and off(capture, middle) < 0.01
    assert capture.notes == () and name in capture.summary and "48 x 40 pixels, masks from" in capture.summary
    expected = torch.tensor([[FOCAL, 0, middle[0]], [0, FOCAL, middle[1]], [0, 0, 1]])
    for shot in capture.shots:
        torch.testing.assert_close(shot.camera.intrinsics, expected, rtol=0, atol=1e-3)
    if name in SCALE_MAT_SPHERES:
        centre, radius = SCALE_MAT_SPHERES[name]
        assert [*capture.sphere.centre, capture.sphere.radius] == pytest.approx([*centre, radius])
    if name == "DVR":
        assert capture.shots[2].depth.unique().tolist() == pytest.approx([1.25 / capture.sphere.radius])


def test_the_hull_contains_the_sphere_closely(tmp_path):
    nerf(tmp_path)
    capture = read_capture(tmp_path, READ)
    hull = hull_mesh(capture.shots, 64)
    assert hull is not None and hull.watertight
    vertices = hull.vertices * capture.sphere.radius + capture.sphere.centre - CENTRE
    distances = np.linalg.norm(vertices, axis=1)
    assert np.abs(distances - RADIUS).max() < 0.06  # a pixel is 0.025 wide there
    assert distances.min() > RADIUS - 0.02 and np.abs(vertices.mean(axis=0)).max() < 0.02
    assert np.linalg.norm(capture.sphere.centre - CENTRE) + RADIUS < capture.sphere.radius < 1.4 * RADIUS
    for shot, silhouette in zip(capture.shots, capture.fit.silhouettes, strict=True):
        assert (torch.from_numpy(silhouette) & shot.mask).sum() > 0.9 * shot.mask.sum()


@each("offset", [0.005, 0.3, 0.7])
def test_the_hull_interpolates_masks_between_pixels(offset):
    """Four equal masks show the left half. The point lies between the last column of the mask and the next column."""
    camera = camera_of(16)
    mask = torch.arange(16).expand(16, 16) < 8
    shots = [Shot(str(number), camera, torch.zeros(16, 16, 3), mask) for number in range(4)]
    focal, middle = camera.intrinsics[0, 0], camera.intrinsics[0, 2]
    across = (8.5 - offset - middle) / focal  # at depth 1
    in_camera = torch.tensor([across, 0.0, 1.0])
    point = camera.camera_to_world[:3, :3] @ in_camera + camera.camera_to_world[:3, 3]
    assert carve(shots, point[None]).item() == pytest.approx(0.5 - offset, abs=1e-5)


def test_without_masks_the_sphere_is_around_the_common_target_of_the_cameras(tmp_path):
    middlebury(tmp_path)
    capture = read_capture(tmp_path, PLAIN)
    assert all(shot.mask is None for shot in capture.shots) and capture.masks == "" and "no masks" in capture.summary
    np.testing.assert_allclose(capture.sphere.centre, CENTRE, atol=1e-3)
    assert capture.sphere.radius == pytest.approx(1.5 * 20 / FOCAL, rel=1e-3)


def test_parallel_cameras_have_their_sphere_in_the_range_of_depths(tmp_path):
    llff(tmp_path)
    rows = np.load(tmp_path / "poses_bounds.npy")
    for i, row in enumerate(rows):
        pose = row[:15].reshape(3, 5)
        pose[:, :3] = np.stack([[0, -1, 0], [1, 0, 0], [0, 0, 1]], axis=1)  # along -z
        pose[:, 3] = [0.1 * (i % 4), 0.1 * (i // 4), 7.0]
    rows[:, 15:] = 3.5, 4.5
    np.save(tmp_path / "poses_bounds.npy", rows)
    capture = read_capture(tmp_path, PLAIN)
    assert abs(capture.sphere.centre[2] - 3.0) < 1e-6 and 0.5 <= capture.sphere.radius < 2
    assert "the depths that the format states" in capture.summary


@FEW
@given(st.floats(-7e6, 7e6))
def test_a_world_far_from_the_origin_is_read_exactly(tmp_path, away):
    nerf(tmp_path)
    moved(tmp_path, lambda matrix: matrix + away * np.outer((1, 1, 1, 0), (0, 0, 0, 1)))
    capture = read_capture(tmp_path, READ if abs(away) > 1e6 else PLAIN)
    assert off(capture, away=away) < 0.01 and np.abs(capture.to_world[:3, 3] - away - CENTRE).max() < 0.1
    assert ", ".join(str(float(value)) for value in capture.sphere.centre) in capture.summary


# Pictures


def test_photographs_are_reduced_with_their_cameras_and_never_enlarged(tmp_path):
    nerf(tmp_path)
    small, large = (read_capture(tmp_path, ReadSettings(longest)) for longest in (24, 4096))
    assert large.notes == ("the photographs have at most 48 pixels per side, not 4096",) and small.notes == ()
    assert small.shots[0].colours.shape == (20, 24, 3) and large.shots[0].colours.shape == (*SIZE, 3)
    torch.testing.assert_close(small.shots[0].camera.intrinsics[:2], large.shots[0].camera.intrinsics[:2] / 2)
    assert large.shots[0].colours[0, 0].tolist() == [1.0, 1.0, 1.0]  # transparent is white


DISTORTIONS = (
    {"k1": 0.15, "k2": -0.08, "p1": 0.03, "p2": -0.05},
    {"k1": 0.1, "k2": 0.05, "k3": -0.1, "k4": 0.2, "k5": 0.05, "k6": 0.01, "camera_model": "FULL_OPENCV"},
    {"k1": 0.05, "k2": -0.01, "k3": 0.02, "k4": 0.01, "is_fisheye": True},
)


@each("distortion", DISTORTIONS)
def test_distortion_is_removed(tmp_path, distortion):
    """The colours of a ramp encode their positions; test_lenses.py compares the distortion with OpenCV."""
    side = 60
    rows, columns = np.mgrid[:side, :side] + 0.5
    ramp = np.dstack([4 * columns, 4 * rows, 0 * rows]).astype(np.uint8)
    Image.fromarray(ramp).save(tmp_path / "0.png")
    stored = {"fl_x": 50.0, "fl_y": 48.0, "cx": 31.0, "cy": 28.0, "w": side, "h": side, **distortion}
    frame = {"file_path": "0.png", "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({**stored, "frames": [frame]}))
    read = find_layout(tmp_path).frames[0]
    sampled = read_shot(read, side).colours.numpy()[..., :2] * 255 / 4
    distorted = np.dstack(read.lens.distort((columns - 31) / 50, (rows - 28) / 48)) * [50, 48] + [31, 28]
    inside = ((distorted > 1) & (distorted < side - 1)).all(axis=-1)
    assert inside.mean() > 0.7 and np.abs(distorted - np.dstack([columns, rows]))[inside].max() > 1
    np.testing.assert_allclose(sampled[inside], distorted[inside], atol=0.01)


def test_images_of_16_bits_and_of_floats_are_read(tmp_path):
    idr(tmp_path)
    plain = read_capture(tmp_path, READ)
    picture = Image.open(tmp_path / "image" / "000002.png")
    Image.fromarray(np.asarray(picture.convert("L")).astype(np.uint16) * 257).save(tmp_path / "image" / "000002.png")
    capture = read_capture(tmp_path, READ)
    grey = plain.shots[2].colours @ torch.tensor([0.299, 0.587, 0.114])
    torch.testing.assert_close(capture.shots[2].colours[..., 0], grey, rtol=0, atol=0.01)
    Image.fromarray(np.full(SIZE, 0.5, np.float32)).save(tmp_path / "a.tiff")
    assert np.abs(read_image(tmp_path / "a.tiff", None, 48)[0] - 0.5).max() < 0.01


@each("bits", [10, 12, 14, 16])
def test_images_of_10_to_16_bits_are_as_bright_as_those_of_8(tmp_path, bits):
    idr(tmp_path)
    for file in (tmp_path / "image").iterdir():
        grey = np.asarray(Image.open(file).convert("L")) * ((2**bits - 1) / 255)
        Image.fromarray(grey.astype(np.uint16)).save(file)
    capture = read_capture(tmp_path, READ)
    assert float(capture.shots[0].colours.max()) == pytest.approx(128 / 255, abs=0.01)
    assert any(f"read as of {bits} bits" in note for note in capture.notes) is (bits < 16)


@each("factor, noted", [(1, False), (1 / 16, True)])
def test_dark_photographs_have_a_note(tmp_path, factor, noted):
    idr(tmp_path)
    repainted([*(tmp_path / "image").iterdir()], lambda pixels: pixels * factor)
    assert any("12 bits to 16" in note for note in read_capture(tmp_path, READ).notes) is noted


def test_an_opaque_alpha_channel_is_no_mask(tmp_path):
    nerf(tmp_path)
    repainted([*(tmp_path / "train").iterdir()], lambda pixels: np.dstack([pixels[..., :3], np.full(SIZE, 255)]))
    assert read_capture(tmp_path, READ).masks == ""


COLOUR = st.just((255, 255, 255)) | st.tuples(*[st.sampled_from([0, 90, 180, 255])] * 3).filter(np.ptp)


@FEW
@given(st.lists(COLOUR, min_size=2, max_size=2), st.booleans())
def test_a_mask_is_each_colour_except_the_background(tmp_path, colours, alpha):
    mask = image(cameras()[0])[1]
    inside, left = np.asarray(mask) > 0, np.arange(SIZE[1])[None] < SIZE[1] / 2
    painted = np.where(left[..., None], colours[0], colours[1]) * inside[..., None]
    painted = np.dstack([painted, np.full(SIZE, 255)]) if alpha else painted
    Image.fromarray(painted.astype(np.uint8)).save(tmp_path / "mask.png")
    image(cameras()[0])[0].save(tmp_path / "image.png")
    mask_read = read_image(tmp_path / "image.png", tmp_path / "mask.png", 48)[1]
    assert mask_read is not None and ((mask_read[..., 0] > 0.5) == inside).all()


def test_images_of_two_sizes_each_have_their_camera(tmp_path):
    idr(tmp_path)
    for name in ("image/000003.png", "mask/003.png"):
        Image.open(tmp_path / name).resize((24, 20)).save(tmp_path / name)
    half = np.diag([0.5, 0.5, 1.0, 1.0])
    rewritten(tmp_path / "cameras_sphere.npz", lambda arrays: arrays | {"world_mat_3": half @ arrays["world_mat_3"]})
    assert "24 x 20 and 48 x 40 pixels" in read_capture(tmp_path, READ).summary


@each("size, same", [
    ((400, 300), True), ((401, 300), True), ((133, 100), True), ((400, 297), False), ((4000, 2975), False),
])  # fmt: skip
def test_a_cropped_image_has_another_aspect(size, same):
    assert _same_aspect(size, (3000, 4000)) == same


@each("tag, turn", [*((tag, None) for tag in range(2, 9)), (6, Image.Transpose.ROTATE_90)])
def test_pixels_are_used_as_stored_or_rotated_if_cameras_have_that_size(tmp_path, tag, turn):
    """A tag of 6 means "rotate by 90 degrees clockwise"."""
    nerf(tmp_path)
    plain, exif = read_capture(tmp_path, PLAIN), Image.Exif()
    exif[ExifTags.Base.Orientation] = tag
    for file in (tmp_path / "train").iterdir():
        picture = Image.open(file)
        (picture if turn is None else picture.transpose(turn)).save(file, exif=exif)
    capture = read_capture(tmp_path, PLAIN)
    assert all(
        torch.equal(actual.colours, expected.colours)
        for actual, expected in zip(capture.shots, plain.shots, strict=True)
    )
    stored = "have a tag of orientation (EXIF), and are used as stored, as cameras are"
    action = "are turned by their tag (EXIF), since their cameras have that size" if turn is not None else stored
    assert capture.notes == (f"10 photographs {action}",)


# Names and pairs


def test_a_missing_image_leaves_its_camera_out(tmp_path, capsys):
    nerf(tmp_path)
    (tmp_path / "train" / "r_4.png").unlink()
    assert main([str(tmp_path), "--into", str(tmp_path / "photos.abc")]) == 2
    assert "--into must end in .png" in capsys.readouterr().err
    assert main([str(tmp_path), "--into", str(tmp_path / "photos.png")]) == 0
    out = capsys.readouterr().out
    assert "9 photographs" in out and "note: no image for 1 of the cameras, such as ./train/r_4" in out
    assert int(out.split("overlap by ")[1].split("%")[0]) > 90
    assert (tmp_path / "photos.png").stat().st_size > 10_000


def test_the_sphere_is_that_of_a_run_and_a_doubtful_focal_length_is_noted(tmp_path, capsys, monkeypatch):
    nerf(tmp_path)
    monkeypatch.setattr(own_photographs, "focal_doubt", lambda shots: "it is doubtful")
    assert main([str(tmp_path), "--into", str(tmp_path / "photos.png")]) == 0
    out, task = capsys.readouterr().out, composed("task=reconstruction").task
    photographs = OwnPhotographs(str(tmp_path), masks=True, axes="stated", images=None, unchecked=False)
    assert photographs.capture(task.longest, task.held_out).summary in out and "note: it is doubtful" in out
    assert read_capture(tmp_path, ReadSettings(task.longest)).summary not in out


def test_the_photographs_that_fit_worst_are_named(tmp_path, capsys):
    idr(tmp_path)
    repainted([tmp_path / "mask" / "007.png"], lambda mask: np.roll(mask, 6, axis=1))
    assert main([str(tmp_path), "--into", str(tmp_path / "a" / "b")]) == 0
    out = capsys.readouterr().out
    assert "note: least in 000007.png" in out and out.splitlines()[-1] == str(tmp_path / "a" / "b.png")
    assert (tmp_path / "a" / "b.png").is_file()


def test_cameras_of_other_images_are_refused_except_with_unchecked(tmp_path):
    idr(tmp_path)
    for i, file in enumerate(sorted((tmp_path / "mask").iterdir())):
        repainted([file], lambda mask, i=i: np.roll(mask, 11 * (-1) ** i, axis=1))
    with pytest.raises(BadInput, match=r"the visual hull of the masks overlaps .* or set dataset.unchecked=true"):
        read_capture(tmp_path, READ)
    capture = read_capture(tmp_path, ReadSettings(48, unchecked=True))
    assert "cameras may be those of other images" in capture.notes[-1]


@each("shown, note", [(0.7, "show 70% of the object (median): cameras"), (0.4, None)])
def test_photographs_that_show_a_part_of_the_hull_have_a_note_and_a_small_part_is_refused(tmp_path, shown, note):
    nerf(tmp_path)

    def fit(*arguments):
        return replace(measure_mask_fit(*arguments), shown=(shown,))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(own_photographs, "measure_mask_fit", fit)
        with nullcontext() if note else pytest.raises(BadInput, match="the photographs show 40% of the object"):
            assert note in read_capture(tmp_path, READ).notes[-1]


def test_other_cameras_in_the_folder_are_named_in_a_note(tmp_path):
    nerf(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", np.zeros((3, 17)))  # broken cameras
    np.savez(tmp_path / "cameras.npz", world_mat_0=np.eye(4))  # cameras without images
    layout = find_layout(tmp_path)
    note = "other cameras in the folder are not used: cameras.npz, poses_bounds.npy"
    assert layout.format == "NeRF" and layout.notes == (note,)


def test_masks_that_transforms_json_does_not_name_are_used(tmp_path):
    nerf(tmp_path)
    white = np.full(SIZE, 255, np.uint8)
    white[:, :2] = 0
    shutil.copytree(tmp_path / "train", tmp_path / "masks")
    repainted([*(tmp_path / "masks").iterdir()], lambda _: white)
    capture = read_capture(tmp_path, READ)
    assert any("does not name it" in note for note in capture.notes)
    assert all(shot.mask.float().mean() > 0.9 for shot in capture.shots)


def test_flipped_axes_are_reported_and_can_be_set(tmp_path, capsys):
    nerf(tmp_path)
    moved(tmp_path, lambda matrix: matrix @ OPENGL)
    picture = ("--into", str(tmp_path / "photos.png"))
    assert main([str(tmp_path), *picture]) == 2
    out, err = capsys.readouterr()
    assert out == "" and len(err.splitlines()) == 1
    assert "the visual hull of the masks is empty" in err and "dataset.axes=flipped" in err
    assert main([str(tmp_path), "--axes", "flipped", *picture]) == 0


@FEW
@given(st.integers(3, 6))
def test_rounded_matrices_become_the_nearest_rotation(tmp_path, digits):
    nerf(tmp_path)
    moved(tmp_path, lambda matrix: matrix.round(digits))
    assert off(read_capture(tmp_path, PLAIN)) < 0.1


@FEW
@given(st.floats(0, 360), st.floats(-80, 80), st.floats(0.5, 2))
def test_cameras_of_choy_follow_from_angles(azimuth, elevation, distance):
    """The reference repeats the steps of the code published with the renderings."""
    across, up = np.radians([-azimuth, -elevation])
    sa, ca, se, ce = np.sin(across), np.cos(across), np.sin(up), np.cos(up)
    world_to_object = np.array([[ca * ce, -sa, ca * se], [sa * ce, ca, sa * se], [-se, 0, ce]]).T
    object_to_camera = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]]).T
    expected = np.eye(4)
    expected[:3, :3] = object_to_camera @ world_to_object
    expected[:3, 3] = -object_to_camera @ [distance, 0, 0]
    np.testing.assert_allclose(_from_angles(azimuth, elevation, distance), OPENGL @ expected, atol=1e-12)
