"""Captures with a usual mistake are refused with its name; shuffled images and other poses have no name."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from datasets.files.captures.frames import OPENGL, Frame
from datasets.files.captures.mistakes import ROLLED, Views, focal_doubt, hull_fit, likely_mistake
from datasets.files.own_photographs import ReadSettings, read_capture
from datasets.shot import Shot
from renderers.camera import Camera
from renderers.checks import BadInput

SIZE = 48, 64
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
NAMES = [f"{i}.png" for i in range(11)]  # 10 comes before 2 in string order


def seen(seed: int, offset: float = 1.0) -> Views:
    """Cameras around five spheres without symmetry, and their masks; `offset` moves the principal point."""
    random = np.random.default_rng(seed)
    focal = random.uniform(0.8, 1.8) * SIZE[1]
    intrinsics = np.array([[focal, 0, SIZE[1] / 2 + offset], [0, focal, SIZE[0] / 2 - offset], [0, 0, 1]])
    centres, radii = random.uniform(-0.4, 0.4, (5, 3)), random.uniform(0.1, 0.3, 5)
    poses, masks = [], []
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    pixels = np.stack([columns, rows, np.ones(SIZE)], axis=-1) @ np.linalg.inv(intrinsics).T
    for _ in NAMES:
        towards = random.normal(size=3)
        eye = 2 * focal / SIZE[0] * towards / np.linalg.norm(towards)
        forward = 0.05 * random.normal(size=3) - eye
        right = np.cross((0, 0, -1), forward)
        axes = np.stack([right, np.cross(forward, right), forward])
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        rays = pixels @ axes
        along = (rays @ (centres - eye).T) / (rays**2).sum(-1, keepdims=True)
        gaps = np.linalg.norm(eye + along[..., None] * rays[..., None, :] - centres, axis=-1)
        poses.append(np.block([[axes, -axes @ eye[:, None]], [np.eye(4)[3:]]]))
        masks.append((gaps < radii).any(axis=-1))
    world = np.eye(4)
    world[:3, 3] = random.choice((0, 1, 4)) * random.normal(size=3)  # the object is not at the origin
    return Views(np.tile(intrinsics, (len(NAMES), 1, 1)), np.stack(poses) @ world, tuple(masks))


def posed(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Views], Views]:
    return lambda views: replace(views, world_to_camera=change(views.world_to_camera))


def mixed(rotations: np.ndarray, translations: np.ndarray) -> np.ndarray:
    return np.concatenate([rotations[..., :3], translations[..., 3:]], axis=-1)


def opengl(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Views], Views]:
    """A change of camera_to_world in OpenGL's axes, as transforms.json holds it."""
    return posed(lambda poses: OPENGL @ np.linalg.inv(change(np.linalg.inv(poses) @ OPENGL)))


def ordered(order: list[int]) -> Callable[[Views], Views]:
    return lambda views: replace(views, masks=tuple(views.masks[i] for i in order))


def scaled(scale: Callable[[np.ndarray], np.ndarray]) -> Callable[[Views], Views]:
    return lambda views: replace(views, intrinsics=scale(views.intrinsics))


inverse = np.linalg.inv
SHARES = np.array([[1 / SIZE[1]], [1 / SIZE[0]], [1.0]])
BY_STRING = sorted(range(len(NAMES)), key=lambda i: NAMES[i])
MISTAKES = {
    "inverse": ("inverse", posed(inverse)),
    "inverse, OpenGL": ("inverse", opengl(inverse)),
    "world_to_camera of OpenCV in transforms.json": ("inverse", opengl(lambda poses: OPENGL @ inverse(poses))),
    "axes": ("dataset.axes=flipped", posed(lambda poses: OPENGL @ poses)),
    "rolled": ("180 degrees", posed(lambda poses: ROLLED @ poses)),
    "images turned": (
        "180 degrees",
        lambda views: replace(views, masks=tuple(mask[::-1, ::-1] for mask in views.masks)),
    ),
    "rotations of the inverse": ("transposed", posed(lambda poses: mixed(inverse(poses), poses))),
    "rotations of the inverse, OpenGL": ("transposed", opengl(lambda poses: mixed(inverse(poses), poses))),
    "centres as translations": ("camera's position", posed(lambda poses: mixed(poses, inverse(poses)))),
    "translations as centres": ("camera's position", opengl(lambda poses: mixed(poses, inverse(poses)))),
    "left-handed world": ("left-handed", posed(lambda poses: MIRROR @ poses @ MIRROR)),
    "upside down": ("upside down", lambda views: replace(views, masks=tuple(mask[::-1] for mask in views.masks))),
    "string order": ("leading zeros", ordered(BY_STRING)),
    "next image": ("cameras are those of the", ordered(np.roll(range(len(NAMES)), 1).tolist())),
    "millimetres": ("sensor's width", scaled(lambda k: k * [[0.1, 0, 1], [0, 0.1, 1], [0, 0, 1]])),
    "shares": ("shares", scaled(lambda k: k * SHARES)),
    "shares, half a pixel later": ("shares", scaled(lambda k: k * SHARES + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])),
    "none": ("", lambda views: views),
    "shuffled": ("", ordered(np.random.default_rng(3).permutation(len(NAMES)).tolist())),
    "other poses": ("", lambda views: replace(views, world_to_camera=seen(99).world_to_camera)),
}

DRAWS = settings(max_examples=2, suppress_health_check=[HealthCheck.function_scoped_fixture])
READ = ReadSettings(SIZE[1])


def mistake_in(views: Views) -> str:
    """The mistake in photographs whose names are not in the order of their numbers, as `pair_by_order` reads them."""
    frames = [Frame(Path(name), k, np.eye(4), size=SIZE) for name, k in zip(NAMES, views.intrinsics, strict=True)]
    return likely_mistake(shots_of(views), frames, "stated")


def shots_of(views: Views) -> list[Shot]:
    return [
        Shot(name, Camera(*map(torch.from_numpy, (k, motion)), *SIZE), torch.zeros(*SIZE, 3), torch.from_numpy(mask))
        for name, k, motion, mask in zip(
            sorted(NAMES), views.intrinsics, views.world_to_camera, map(np.ascontiguousarray, views.masks), strict=True
        )
    ]


def write_images(folder: Path, views: Views, names: list[str]) -> None:
    for kind in ("image", "mask"):
        (folder / kind).mkdir(exist_ok=True)
        for name, mask in zip(names, views.masks, strict=True):
            Image.fromarray((200 * mask if kind == "image" else 255 * mask).astype(np.uint8)).save(folder / kind / name)


def idr(folder: Path, views: Views) -> None:
    """Projections of the first pixel's centre at 0, and a unit sphere of another centre and size."""
    names = [f"{i:03d}.png" for i in range(len(views.masks))]
    write_images(folder, views, names)
    projections = np.tile(np.eye(4), (len(names), 1, 1))
    half_pixel = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    projections[:, :3] = (views.intrinsics - half_pixel) @ views.world_to_camera[:, :3]
    stored = {f"world_mat_{i}": matrix for i, matrix in enumerate(projections)}
    scale = np.diag([1.2, 1.2, 1.2, 1.0])
    scale[:3, 3] = -views.world_to_camera[:, :3, 3].mean(axis=0) * 0.01
    np.savez(folder / "cameras_sphere.npz", **stored, **{f"scale_mat_{i}": scale for i in range(len(names))})


def nerf(folder: Path, views: Views, **settings: object) -> None:
    """`settings` are lists with a value for each frame."""
    names = [f"{i:03d}.png" for i in range(len(views.masks))]
    write_images(folder, views, names)
    frames = [
        {"file_path": f"image/{name}", "transform_matrix": (np.linalg.inv(motion) @ OPENGL).tolist(),
         "fl_x": k[0, 0], "fl_y": k[1, 1], "cx": k[0, 2], "cy": k[1, 2], "w": SIZE[1], "h": SIZE[0]}
        for name, k, motion in zip(names, views.intrinsics, views.world_to_camera, strict=True)
    ]  # fmt: skip
    for key, values in settings.items():
        for frame, value in zip(frames, values, strict=True):
            frame[key] = value
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))


@pytest.mark.parametrize("mistake", MISTAKES)
@DRAWS
@given(seed=st.integers(0, 10**6))
def test_a_mistake_is_named_and_other_faults_have_no_name(mistake, seed):
    words, change = MISTAKES[mistake]
    views = seen(seed)
    assert hull_fit(views) > 0.9
    text = mistake_in(change(views))
    assert (words in text) if words else (text == "")


@pytest.mark.parametrize("factor, correction", [(0.5, "2.0"), (1.0, None), (2.0, "0.5")])
def test_a_wrong_focal_length_is_a_doubt_that_names_the_correction_and_the_right_one_is_none(factor, correction):
    for seed in range(4):
        doubt = focal_doubt(shots_of(scaled(lambda k: k * [[factor, 1, 1], [1, factor, 1], [1, 1, 1]])(seen(seed))))
        assert f"{correction} times" in doubt if correction else doubt == ""


@DRAWS
@given(seed=st.integers(0, 10**6))
@pytest.mark.parametrize("write", [pytest.param(idr, marks=pytest.mark.slow), nerf])
def test_a_capture_with_a_mistake_is_refused_with_its_name(tmp_path, write, seed):
    views = seen(seed)
    write(tmp_path, views)
    capture = read_capture(tmp_path, READ)
    assert np.median(capture.fit.overlaps) > 0.85 and not any("focal" in note for note in capture.notes)
    for words, change in (MISTAKES["inverse"], MISTAKES["shares"], MISTAKES["millimetres"]):
        if write is idr and "shares" in words:
            words, change = (
                "without intrinsics",
                lambda views: replace(views, intrinsics=np.tile(np.eye(3), (11, 1, 1))),
            )
        write(tmp_path, change(views))
        with pytest.raises(BadInput, match=words):
            read_capture(tmp_path, READ)


def test_times_are_named_if_the_photographs_do_not_fit(tmp_path):
    views, times = seen(1), np.linspace(0, 1, len(NAMES)).tolist()
    nerf(tmp_path, views, time=times)
    assert not any("time" in note for note in read_capture(tmp_path, READ).notes)  # the object did not move
    assert any("time" in note for note in read_capture(tmp_path, replace(READ, masks=False)).notes)
    masks = tuple(np.roll(mask, 12 * (-1) ** i, axis=1) for i, mask in enumerate(views.masks))
    nerf(tmp_path, replace(views, masks=masks), time=times)
    with pytest.raises(BadInput, match="11 values of time"):
        read_capture(tmp_path, READ)


def test_intrinsics_that_are_no_pixels_are_refused_without_masks(tmp_path):
    nerf(tmp_path, MISTAKES["shares"][1](seen(1)))
    with pytest.raises(BadInput, match="shares"):
        read_capture(tmp_path, replace(READ, masks=False))


@pytest.mark.parametrize("words, change", [
    ("cx and cy", lambda k: np.add(k, [[0, 0, -SIZE[1] / 6], [0, 0, SIZE[0] / 6], [0, 0, 0]])),
    ("no shares", lambda k: np.array([[2 / SIZE[0], 0, 0], [0, 2 / SIZE[0], 0], [0, 0, 1]]) * k),  # sides from -1 to 1
])  # fmt: skip
def test_other_intrinsics_are_named_if_the_middle_is_the_principal_point(words, change):
    assert words in mistake_in(scaled(change)(seen(1, offset=0.0)))


def test_turned_images_are_named_wherever_the_principal_point_is():
    for offset in (0.0, 1.0, 4.0):
        for axes in (np.eye(4), OPENGL):
            views = MISTAKES["images turned"][1](seen(2, offset))
            text = mistake_in(replace(views, world_to_camera=axes @ views.world_to_camera))
            assert text.startswith(f"the {'images' if offset else 'cameras'} are turned by 180 degrees")
