"""Depth files of any kind: they give the depths of a sphere, or a message with the remedy, never other numbers."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation

from bench.config import load
from datasets.files.captures.depth import NO_DEPTH_VALUES, read_depths
from datasets.files.captures.frames import OPENGL
from datasets.files.own_photographs import read_capture
from datasets.views import look_at
from renderers.checks import BadInput
from tests.looped import each
from tests.made_depths import CENTRE, HEIGHT, INTRINSICS, RADIUS, WIDTH, sphere_depths, write_exr
from tests.made_photographs import READ, SIZE, dvr

SEVERAL = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=10, deadline=None)
DEPTHS = sphere_depths()
ON_SPHERE = DEPTHS > 0
NO_DEPTH = st.sampled_from(
    [np.nan, np.inf, -np.inf, 65535.0, 65504.0, 1e10, -1e10, float(np.finfo(np.float32).max), 4294967295.0, -1.0]
)
NAMES = st.text("abcdefgkuvwxz_", min_size=1, max_size=8)


def scene_of(path: Path, **changed):
    return load("dataset", "depth_image", **{"path": str(path), "intrinsics": INTRINSICS} | changed).placed(64)


def radii(scene, motion=None) -> np.ndarray:
    """Distances of the observed points from the sphere's centre, in the file's world."""
    view, observed = scene.observed_view()
    points = view.camera.rays().at(view.camera.distance(view.depth))[observed].double().numpy()
    points = points @ scene.to_world[:3, :3].T + scene.to_world[:3, 3]
    centre = np.array([*CENTRE, 1.0]) if motion is None else motion @ (*CENTRE, 1.0)
    return np.linalg.norm(points - centre[:3], axis=1)


def assert_is_sphere(scene, *, pixels: int = int(ON_SPHERE.sum())) -> None:
    distances = radii(scene)
    assert len(distances) == pixels and np.abs(distances - RADIUS).max() < 2e-3


def saved(folder: Path, name: str, numbers: np.ndarray) -> Path:
    """The numbers in a new file, by the suffix of its name."""
    path = folder / name
    if path.suffix == ".npy":
        np.save(path, numbers)
    elif path.suffix == ".exr":
        pytest.importorskip("cv2", reason="OpenCV is an extra: pip install -e '.[stereo]'")
        write_exr(path, {"Y": numbers})
    else:
        Image.fromarray(numbers).save(path)
    return path


@SEVERAL
@given(NO_DEPTH, st.booleans(), st.sampled_from([".npy", ".exr"]))
def test_numbers_that_stand_for_no_depth_are_missing_and_noted(tmp_path, number, beside, suffix):
    """Such numbers are around the object, or at some of its pixels."""
    depths, hole = DEPTHS.astype(np.float32), ~ON_SPHERE if beside else np.roll(np.eye(HEIGHT, WIDTH) > 0, 4, axis=1)
    depths[hole] = number
    scene = scene_of(saved(tmp_path, f"depth{suffix}", depths))
    assert_is_sphere(scene, pixels=int((ON_SPHERE & ~hole).sum()))
    (note,) = [note for note in scene.mesh.repairs if "stand for no depth" in note]
    assert f"{np.float32(number):.6g} ({hole.sum()})" in note


@SEVERAL
@given(st.sampled_from([np.uint16, np.int16, np.int32, np.uint32, np.int64]), st.booleans())
def test_the_largest_integer_is_no_depth(tmp_path, dtype, masked):
    stored = np.full(DEPTHS.shape, np.iinfo(dtype).max, dtype)
    stored[ON_SPHERE] = (DEPTHS[ON_SPHERE] * 1000).round()
    mask = {"mask_path": str(saved(tmp_path, "mask.png", np.uint8(255 * ON_SPHERE)))} if masked else {}
    assert_is_sphere(scene_of(saved(tmp_path, "depth.npy", stored), scale=0.001, **mask))


@SEVERAL
@given(st.floats(60, 9e6).filter(lambda far: far not in NO_DEPTH_VALUES), st.floats(0.02, 0.9))
def test_a_depth_far_beyond_the_others_is_refused(tmp_path, far, fraction):
    """Of a far plane or of stray pixels; the fraction is that of the image's rows."""
    depths = DEPTHS.copy()
    depths[: int(fraction * HEIGHT) + 1][~ON_SPHERE[: int(fraction * HEIGHT) + 1]] = far
    with pytest.raises(BadInput, match=r"write 0 at pixels without depth, or give a mask"):
        scene_of(saved(tmp_path, "depth.npy", depths))


@SEVERAL
@given(st.floats(10, 100), st.integers(0, 3))
def test_a_far_plane_is_refused_but_not_behind_a_mask(tmp_path, far, turns):
    path = saved(tmp_path, "depth.npy", np.where(ON_SPHERE, DEPTHS, far))
    with pytest.raises(BadInput, match=r"write 0"):
        scene_of(path)
    assert_is_sphere(scene_of(path, mask_path=str(saved(tmp_path, "mask.png", np.uint8(255 * ON_SPHERE)))))


@SEVERAL
@given(st.floats(0.1, 1.5), st.floats(4.5, 1000.0))
def test_a_depth_buffer_is_refused(tmp_path, near, far):
    buffer = np.where(ON_SPHERE, far * (1 - near / np.where(ON_SPHERE, DEPTHS, 1)) / (far - near), 1.0)
    with pytest.raises(BadInput, match=r"OpenGL's depth buffer"):
        scene_of(saved(tmp_path, "depth.npy", buffer))


@SEVERAL
@given(st.sampled_from([0.0, -np.inf, -1e10, np.nan, 65504.0]), st.floats(0.01, 1000))
def test_depths_of_opengl_are_refused(tmp_path, background, unit):
    with pytest.raises(BadInput, match=r"negative depths.*save minus these numbers"):
        scene_of(saved(tmp_path, "depth.npy", np.where(ON_SPHERE, -unit * DEPTHS, background)))


@SEVERAL
@given(
    st.sampled_from(["L", "P", "RGB", "RGBA", "LA", "1"]), st.sampled_from([".png", ".jpg", ".bmp", ".gif", ".webp"])
)
def test_pictures_of_depth_are_refused(tmp_path, mode, suffix):
    picture = Image.fromarray(np.uint8(DEPTHS / DEPTHS.max() * 255)).convert(mode)
    path = tmp_path / f"depth{suffix}"
    try:
        picture.save(path)
    except OSError:  # the format has no such mode
        picture.convert("RGB").save(path)
    with pytest.raises(BadInput, match=r"is a picture.*save camera z as an .npy"):
        scene_of(path)


@SEVERAL
@given(st.sampled_from([np.uint8, np.int8, np.bool_]), st.sampled_from(["depth.npy", "depth.npz"]))
def test_arrays_of_8_bits_are_refused(tmp_path, dtype, name):
    (np.save if name.endswith("y") else np.savez)(tmp_path / name, (DEPTHS / DEPTHS.max() * 120).astype(dtype))
    with pytest.raises(BadInput, match=r"as a picture or a mask, not depths: save camera z"):
        scene_of(tmp_path / name)


@each("factor", [256, 257])
def test_numbers_of_8_bits_stretched_to_16_are_refused(tmp_path, factor):
    stretched = (DEPTHS / DEPTHS.max() * 250).astype(np.uint16) * np.uint16(factor)
    with pytest.raises(BadInput, match=r"8 bits, stretched to 16.*save camera z"):
        scene_of(saved(tmp_path, "depth.png", stretched))


@SEVERAL
@given(
    st.dictionaries(NAMES, st.sampled_from(["same size", "matrix"]), max_size=4), st.sampled_from(["depth", "DEPTH"])
)
def test_an_npz_has_one_array_or_one_called_depth(tmp_path, others, name):
    others = {key: np.ones(DEPTHS.shape if size == "same size" else (3, 3)) for key, size in others.items()}
    path = tmp_path / "depth.npz"
    np.savez_compressed(path, **others, **{name: DEPTHS})
    assert_is_sphere(scene_of(path))
    np.savez(path, **others, alone=DEPTHS)
    if others:
        with pytest.raises(BadInput, match=r"and has .*save the depths as 'depth'") as refused:
            scene_of(path)
        assert all(key in str(refused.value) for key in (*others, "alone"))
    else:
        assert_is_sphere(scene_of(path))


@SEVERAL
@given(st.sampled_from("VZYRGBD"), st.booleans(), st.booleans())
def test_an_exr_with_one_channel_is_read_whatever_its_name(tmp_path, name, with_alpha, is_half):
    pytest.importorskip("cv2", reason="OpenCV is an extra: pip install -e '.[stereo]'")
    channels = {name: np.where(ON_SPHERE, DEPTHS, 65504.0 if is_half else 1e10)}
    write_exr(tmp_path / "depth.exr", channels | ({"A": ON_SPHERE} if with_alpha else {}))
    assert_is_sphere(scene_of(tmp_path / "depth.exr"))


@SEVERAL
@given(st.sets(st.sampled_from(["R", "G", "B", "Z", "V", "Depth.V", "View.Depth.Z", "X"]), min_size=2), st.booleans())
def test_an_exr_with_several_channels_is_read_if_its_colours_are_equal(tmp_path, names, equal):
    pytest.importorskip("cv2", reason="OpenCV is an extra: pip install -e '.[stereo]'")
    names = sorted(names) if not equal else ["B", "G", "R"]
    write_exr(tmp_path / "depth.exr", {name: DEPTHS * (1 if equal else 1 + i) for i, name in enumerate(names)})
    if equal:
        assert_is_sphere(scene_of(tmp_path / "depth.exr"))
        return
    with pytest.raises(BadInput, match=r"save the depths alone") as refused:
        scene_of(tmp_path / "depth.exr")
    assert all(name in str(refused.value) for name in names)


def test_the_name_of_a_layer_is_named(tmp_path):
    pytest.importorskip("cv2", reason="OpenCV is an extra: pip install -e '.[stereo]'")
    write_exr(tmp_path / "depth.exr", {"View Layer.Depth.Z": DEPTHS})
    with pytest.raises(BadInput, match=r"channels View Layer.Depth.Z;.*save the depths alone"):
        scene_of(tmp_path / "depth.exr")


@each("name, content", [
    ("depth.bin", b"48&40&1&" + bytes(4 * 48 * 40)), ("depth.exr", b"\x76\x2f\x31\x01 cut"), ("depth.npz", b"PK cut"),
    ("depth.npy", b""), ("depth.tif", b"II*\0 cut"),
])  # fmt: skip
def test_files_of_other_formats_are_refused_with_the_formats_that_are_read(tmp_path, name, content):
    pytest.importorskip("cv2", reason="OpenCV is an extra: pip install -e '.[stereo]'")
    (tmp_path / name).write_bytes(content)
    with pytest.raises(BadInput, match=r"save camera z as an .npy, an .npz"):
        read_depths(tmp_path / name)


def test_distances_along_rays_are_converted(tmp_path):
    path = saved(tmp_path, "depth.npy", sphere_depths(along_ray=True))
    assert_is_sphere(scene_of(path, depth="ray"))
    assert np.abs(radii(scene_of(path)) - RADIUS).max() > 0.02
    with pytest.raises(ValueError, match=r"dataset.depth must be one of z, ray"):
        scene_of(path, depth="disparity")


@SEVERAL
@given(st.floats(0.2, 3.0), st.floats(0.2, 0.8), st.floats(0.2, 0.8), st.booleans())
def test_intrinsics_as_shares_of_the_image_are_refused(tmp_path, focal, across, down, as_matrix):
    shares = [[focal, 0, across], [0, focal, down], [0, 0, 1]] if as_matrix else [focal, focal, across, down]
    with pytest.raises(BadInput, match=f"dataset.intrinsics must be pixels.*multiply shares of the image by {WIDTH}"):
        scene_of(saved(tmp_path, "depth.npy", DEPTHS), intrinsics=shares)


@SEVERAL
@given(st.floats(0.5, 7.9), st.booleans())
def test_a_focal_length_in_another_unit_is_refused(tmp_path, focal, in_pixels):
    intrinsics = [focal, focal, WIDTH / 2, HEIGHT / 2] if in_pixels else [focal, focal, 0, 0]
    with pytest.raises(BadInput, match=r"dataset.intrinsics must be pixels.*millimetres"):
        scene_of(saved(tmp_path, "depth.npy", DEPTHS), intrinsics=intrinsics)


@each("key, value", [
    ("intrinsics", [[FOCAL := 45.0, 0, 0], [0, FOCAL, 0], [24, 20, 1]]),
    ("camera_to_world", look_at(torch.tensor([1.0, 2.0, 3.0]), torch.zeros(3)).inverse().T.tolist()),
])  # fmt: skip
def test_transposed_matrices_are_refused(tmp_path, key, value):
    with pytest.raises(ValueError, match=f"dataset.{key}.*transposed"):
        scene_of(saved(tmp_path, "depth.npy", DEPTHS), **{key: value})


@st.composite
def poses(draw) -> np.ndarray:
    """camera_to_world of a camera that looks up or down by at most 70 degrees, and is nearly level; y is up."""
    angles = [draw(st.floats(*span)) for span in ((-180, 180), (-70, 70), (-20, 20))]
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("YXZ", angles, degrees=True).as_matrix() @ OPENGL[:3, :3]
    motion[:3, 3] = [draw(st.floats(-5, 5)) for _ in range(3)]
    return motion


@SEVERAL
@given(poses())
def test_the_axes_of_opengl_are_read_as_such_and_refused_as_others(tmp_path, motion):
    path, flipped = saved(tmp_path, "depth.npy", DEPTHS), (motion @ OPENGL).tolist()
    for scene in (
        scene_of(path, camera_to_world=motion.tolist()), scene_of(path, camera_to_world=flipped, axes="flipped")
    ):  # fmt: skip
        assert np.abs(radii(scene, motion) - RADIUS).max() < 2e-3
    with pytest.raises(ValueError, match=r"camera_to_world.*dataset.axes=flipped"):
        scene_of(path, camera_to_world=flipped)
    with pytest.raises(ValueError, match=r"camera_to_world.*dataset.axes=stated"):
        scene_of(path, camera_to_world=motion.tolist(), axes="flipped")


def test_without_a_pose_the_world_has_the_axes_of_the_camera(tmp_path):
    path = saved(tmp_path, "depth.npy", DEPTHS)
    stated, flipped = scene_of(path), scene_of(path, axes="flipped")
    assert np.allclose(OPENGL @ stated.to_world, flipped.to_world)
    assert torch.allclose(stated.measured, flipped.measured)
    assert np.abs(radii(flipped, OPENGL) - RADIUS).max() < 2e-3


@SEVERAL
@given(st.floats(10, 80), st.floats(-60, 60), st.booleans())
def test_a_world_whose_z_is_up_is_refused_with_the_matrix_that_turns_it(tmp_path, azimuth, pitch, is_opengl):
    upright = Rotation.from_euler("YX", [azimuth, pitch], degrees=True).as_matrix() @ OPENGL[:3, :3]
    motion = np.eye(4)
    motion[:3, :3] = (
        np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) @ upright @ (OPENGL[:3, :3] if is_opengl else np.eye(3))
    )
    with pytest.raises(ValueError, match=r"z points up: give the product \[\[1,0,0,0\]") as refused:
        scene_of(saved(tmp_path, "depth.npy", DEPTHS), camera_to_world=motion.tolist())
    assert ("dataset.axes=flipped" in str(refused.value)) == is_opengl


@SEVERAL
@given(st.integers(0, 8), st.booleans())
def test_an_inverted_mask_is_refused(tmp_path, shift, has_wall):
    depths = np.where(ON_SPHERE, DEPTHS, 4.0 if has_wall else 0)
    mask = np.roll(~ON_SPHERE, shift, axis=1)
    with pytest.raises(BadInput, match=r"dataset.mask_path=.*inverted mask: make the object white"):
        scene_of(saved(tmp_path, "depth.npy", depths), mask_path=str(saved(tmp_path, "mask.png", np.uint8(255 * mask))))


@each("number, missing", [(65504.0, True), (1e10, True), (-1.0, True), (0.0, False)])
def test_depths_of_photographs_are_read_in_the_same_way(tmp_path_factory, number, missing):
    folder, depths = tmp_path_factory.mktemp("dvr"), np.full(SIZE, 1.25)
    dvr(folder)
    depths[::2] = number
    write_exr(folder / "depth" / "002.exr", {"V": depths})
    capture = read_capture(folder, READ)
    stored = capture.shots[2].depth
    assert (stored[::2] == 0).all() and stored[1::2].unique().tolist() == pytest.approx([1.25 / capture.sphere.radius])
    assert any(f"{number:.6g} ({SIZE[0] // 2 * SIZE[1]})" in note for note in capture.notes) is missing


@each("channels, message", [
    ({"Y": -np.full(SIZE, 1.25)}, "negative depths"), ({"R": np.ones(SIZE), "Z": np.ones(SIZE)}, "channels R, Z"),
    ({"Y": np.geomspace(1, 1e6, SIZE[0] * SIZE[1]).reshape(SIZE)}, "002.exr has depths up to .*write 0"),
])  # fmt: skip
def test_depths_of_photographs_are_refused_in_the_same_way(tmp_path_factory, channels, message):
    folder = tmp_path_factory.mktemp("dvr")
    dvr(folder)
    write_exr(folder / "depth" / "002.exr", channels)
    with pytest.raises(BadInput, match=message):
        read_capture(folder, READ)
