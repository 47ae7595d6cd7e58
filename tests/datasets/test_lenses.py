"""Lens models distort rays as in OpenCV and COLMAP, or are refused by name."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.files.captures.lenses import FISHEYE_MODELS, PERSPECTIVE_MODELS, colmap_lens, nerf_lens
from renderers.checks import BadInput
from tests.looped import each

POINTS = np.stack(np.meshgrid(np.linspace(-0.7, 0.7, 9), np.linspace(-0.6, 0.6, 7)), axis=-1).reshape(-1, 2)
RAYS = np.concatenate([POINTS, np.ones_like(POINTS[:, :1])], axis=1)
SMALL = st.floats(-0.05, 0.05, allow_subnormal=False)
OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
FEW = settings(max_examples=20)


def distorted(lens) -> np.ndarray:
    return np.stack(lens.distort(*POINTS.T), axis=-1)


@FEW
@given(st.lists(SMALL, min_size=8, max_size=8), st.sampled_from([4, 5, 8]))
def test_distortion_keys_give_the_distortion_of_opencv(numbers, count):
    cv2 = pytest.importorskip("cv2", reason="OpenCV is an extra: pip install -e '.[stereo]'")
    keys = dict(zip(OPENCV_ORDER[:count], numbers[:count], strict=True))
    expected = cv2.projectPoints(RAYS, np.zeros(3), np.zeros(3), np.eye(3), np.array(numbers[:count]))[0][:, 0]
    np.testing.assert_allclose(distorted(nerf_lens(keys, "file")), expected, atol=1e-9)


@FEW
@given(
    st.lists(SMALL, min_size=4, max_size=4), st.sampled_from([{"is_fisheye": True}, {"camera_model": "OPENCV_FISHEYE"}])
)
def test_a_fisheye_gives_the_distortion_of_opencv(numbers, flag):
    cv2 = pytest.importorskip("cv2", reason="OpenCV is an extra: pip install -e '.[stereo]'")
    keys = dict(zip(("k1", "k2", "k3", "k4"), numbers, strict=True)) | flag
    expected = cv2.fisheye.projectPoints(RAYS[:, None], np.zeros(3), np.zeros(3), np.eye(3), np.array(numbers))[0][:, 0]
    np.testing.assert_allclose(distorted(nerf_lens(keys, "file")), expected, atol=1e-9)


@FEW
@given(st.data())
def test_each_model_of_colmap_gives_its_distortion_or_is_refused(data):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is an extra: pip install -e '.[colmap]'")
    name = data.draw(st.sampled_from([model for model in pycolmap.CameraModelId.__members__ if model != "INVALID"]))
    camera = pycolmap.Camera.create_from_model_id(1, getattr(pycolmap.CameraModelId, name), 50.0, 40, 30)
    if name not in PERSPECTIVE_MODELS | FISHEYE_MODELS:
        with pytest.raises(BadInput, match=f"of the model {name}, which is not understood"):
            colmap_lens(name, list(camera.params), "sparse/0")
        return
    extra = len((PERSPECTIVE_MODELS | FISHEYE_MODELS)[name])
    plain = list(camera.params[: len(camera.params) - extra])
    camera.params = plain + data.draw(st.lists(SMALL, min_size=extra, max_size=extra))
    focal, middle = camera.calibration_matrix()[[0, 1], [0, 1]], camera.calibration_matrix()[:2, 2]
    expected = (camera.img_from_cam(RAYS) - middle) / focal
    np.testing.assert_allclose(distorted(colmap_lens(name, list(camera.params), "sparse/0")), expected, atol=1e-9)


@each("keys, words", [
    ({"camera_model": "EQUIRECTANGULAR"}, "camera_model EQUIRECTANGULAR is not understood"),
    ({"camera_model": "OPENCV", "is_fisheye": True}, "is_fisheye does not fit"),
    ({"k1": 0.1, "k4": 0.01}, "k4 means one thing in a fisheye"),
    ({"is_fisheye": True, "k1": 0.1, "p1": 0.01}, "a fisheye has k1 to k4"),
    ({"distortion_params": [0.1, 0, 0, 0, 0, 0], "k1": 0.2}, "distortion_params and the numbers by name differ"),
    ({"camera_model": "PERSPECTIVE", "is_fisheye": True}, "is_fisheye does not fit"),
])  # fmt: skip
def test_other_lenses_are_refused_by_name(keys, words):
    with pytest.raises(BadInput, match=words):
        nerf_lens(keys, "transforms.json")


def test_a_list_of_numbers_is_in_the_order_of_nerfstudio():
    assert nerf_lens({"distortion_params": [1, 2, 3, 0, 5, 6]}, "file") == nerf_lens(
        {"k1": 1, "k2": 2, "k3": 3, "p1": 5, "p2": 6}, "file"
    )


@each("keys", [{"distortion_params": [0.1, 0, 0, 0, 0.01]}, {"distortion_params": [0.1, 0, 0, 0]}])
def test_a_list_of_another_length_is_refused(keys):
    with pytest.raises(BadInput, match=r"distortion_params must be .* not \d numbers: give them by name"):
        nerf_lens(keys, "file")
    assert nerf_lens({"distortion_params": [0.1, 0, 0, 0], "is_fisheye": True}, "file").fisheye


@each("keys", [
    {"camera_model": "OPENCV", "k1": 0, "k4": 0.0, "s1": 0.0, "is_fisheye": False},
    {"distortion": [0, 0], "distortion_params": [0] * 6, "K1": None, "camera_type": "perspective", "lens": {}},
    {"rolling_shutter": [0.0] * 4, "equirectangular": False, "projection": "Pinhole", "camera": {"name": "mine"}},
    {"applied_scale": 2.0, "aabb_scale": 16, "offset": [0.5] * 3, "sharpness": 30.1, "k": 5, "camera_angle_x": 0.7},
])  # fmt: skip
def test_keys_without_a_lens_give_no_distortion(keys):
    assert not nerf_lens(keys, "file").has_distortion
