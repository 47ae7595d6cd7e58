"""Photographs of a sphere from given cameras, written in each format, and functions that change these files."""

import json
import os
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from datasets.files.captures.frames import OPENGL
from datasets.files.own_photographs import Capture, ReadSettings
from datasets.views import look_at
from renderers.camera import Camera

CENTRE, RADIUS = np.array([0.4, -1.1, 2.0]), 0.35  # world frame of the files
NUMBERED = "{:03d}.png"
SIZE = 40, 48  # height and width
FOCAL, MIDDLE = 60.0, (25.0, 19.0)  # pixels; the principal point is not in the middle
HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # a first pixel's centre is at 0 or at 0.5
READ, PLAIN = ReadSettings(48), ReadSettings(48, masks=False)
POINTS = CENTRE + 0.5 * RADIUS * (np.random.default_rng(0).random((50, 3)) - 0.5)


def cameras(count: int = 10) -> list[Camera]:
    """Cameras all around the sphere, two thirds of them from above."""
    intrinsics = torch.tensor([[FOCAL, 0, MIDDLE[0]], [0, FOCAL, MIDDLE[1]], [0, 0, 1]])
    centre, result = torch.from_numpy(CENTRE).float(), []
    for i in range(count):
        across, up = 2.4 * i, (0.7, -0.5, 0.1)[i % 3]
        toward = [np.cos(up) * np.sin(across), np.sin(up), np.cos(up) * np.cos(across)]
        eye = centre + 1.5 * torch.tensor(toward, dtype=torch.float32)
        result.append(Camera(intrinsics, look_at(eye, centre), *SIZE))
    return result


def matrices() -> list[tuple[np.ndarray, np.ndarray]]:
    """The intrinsics and world_to_camera of each camera."""
    return [(camera.intrinsics.double().numpy(), camera.world_to_camera.double().numpy()) for camera in cameras()]


def image(camera: Camera, *, alpha: bool = False) -> tuple[Image.Image, Image.Image]:
    """The image of the sphere before grey, and its mask."""
    rays = camera.rays().flat()
    towards = torch.from_numpy(CENTRE).float() - rays.origins
    closest = (towards * rays.directions).sum(-1)
    hit = (rays.at(closest) - torch.from_numpy(CENTRE).float()).norm(dim=-1) < RADIUS
    colours = torch.where(hit[:, None], torch.tensor([200.0, 80.0, 40.0]), 128.0).view(*SIZE, 3)
    mask = (255 * hit.view(*SIZE)).to(torch.uint8).numpy()
    pixels = colours.to(torch.uint8).numpy()
    picture = Image.fromarray(np.dstack([pixels, mask]) if alpha else pixels)
    return picture, Image.fromarray(mask)


def write_images(folder: Path, images: str, *, masks: str = NUMBERED, alpha: bool = False, names: str = NUMBERED):
    """Writes the images, and the masks, if these have names, into separate folders."""
    (folder / images).mkdir(parents=True, exist_ok=True)
    for i, camera in enumerate(cameras()):
        picture, mask = image(camera, alpha=alpha)
        picture.save(folder / images / names.format(i))
        if masks:
            (folder / "mask").mkdir(exist_ok=True)
            mask.save(folder / "mask" / masks.format(i))


def idr(folder: Path) -> None:
    write_images(folder, "image", names="{:06d}.png")
    scale, stored = np.diag([0.5, 0.5, 0.5, 1.0]), {}
    scale[:3, 3] = CENTRE + 0.05
    for i, (intrinsics, motion) in enumerate(matrices()):
        projection = np.vstack([-3.0 * (intrinsics - HALF_PIXEL) @ motion[:3], np.eye(4)[3]])  # of any scale and sign
        stored |= {f"world_mat_{i}": projection, f"scale_mat_{i}": scale}
    np.savez(folder / "cameras_sphere.npz", **stored)


def dvr(folder: Path) -> None:
    """Writes intrinsics onto an image from -1 to 1, and depths of 1.25 as OpenEXR files; OpenCV is an extra."""
    os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")
    cv2 = pytest.importorskip("cv2", reason="OpenCV is an extra: pip install -e '.[stereo]'")
    write_images(folder, "image")
    (folder / "depth").mkdir()
    scale, stored = np.diag([0.9, 0.9, 0.9, 1.0]), {}
    scale[:3, 3] = CENTRE
    half = (np.array(SIZE[::-1]) - 1) / 2
    for i, (_, motion) in enumerate(matrices()):
        scaled = np.diag([FOCAL / half[0], FOCAL / half[1], 1.0, 1.0])
        scaled[:2, 2] = (np.array(MIDDLE) - 0.5) / half - 1
        stored |= {f"camera_mat_{i}": scaled, f"scale_mat_{i}": scale, f"world_mat_{i}": motion}
        cv2.imwrite(str(folder / "depth" / f"{i:03d}.exr"), np.full(SIZE, 1.25, np.float32))
    np.savez(folder / "cameras.npz", **stored)


def nerf(folder: Path) -> None:
    write_images(folder, "train", masks="", alpha=True, names="r_{}.png")
    poses = [(np.linalg.inv(motion) @ OPENGL).tolist() for _, motion in matrices()]
    frames = [{"file_path": f"./train/r_{i}", "transform_matrix": pose} for i, pose in enumerate(poses)]
    stored = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": MIDDLE[0], "cy": MIDDLE[1], "w": SIZE[1], "h": SIZE[0]}
    (folder / "transforms.json").write_text(json.dumps({**stored, "frames": frames}))


def middlebury(folder: Path) -> None:
    write_images(folder, ".", names="ball{:04d}.png", masks="ball{:04d}.png")
    lines = ["10"]
    for i, (intrinsics, motion) in enumerate(matrices()):
        numbers = [*(intrinsics - HALF_PIXEL).flatten(), *motion[:3, :3].flatten(), *motion[:3, 3]]
        lines.append(f"ball{i:04d}.png " + " ".join(map(str, numbers)))
    (folder / "ball_par.txt").write_text("\n".join(lines) + "\n")


def blended_mvs(folder: Path) -> None:
    """Writes BlendedMVS's files, and one masked image that is no view."""
    write_images(folder, "blended_images", names="{:08d}.jpg")
    image(cameras()[0])[0].save(folder / "blended_images" / "00000000_masked.jpg")
    (folder / "cams").mkdir()
    for i, (intrinsics, motion) in enumerate(matrices()):
        first, second = (" ".join(map(str, matrix.ravel())) for matrix in (motion, intrinsics))
        text = f"extrinsic\n{first}\n\nintrinsic\n{second}\n\n1.0 0.01 128 2.0\n"
        (folder / "cams" / f"{i:08d}_cam.txt").write_text(text)


def colmap(folder: Path) -> None:
    """Writes COLMAP's text files; pycolmap is an extra."""
    pytest.importorskip("pycolmap", reason="pycolmap is an extra: pip install -e '.[colmap]'")
    write_images(folder, "images")
    (folder / "sparse" / "0").mkdir(parents=True)
    camera_line = f"1 PINHOLE {SIZE[1]} {SIZE[0]} {FOCAL} {FOCAL} {MIDDLE[0]} {MIDDLE[1]}\n"
    lines = []
    for i, (_, motion) in enumerate(matrices()):
        x, y, z, w = Rotation.from_matrix(motion[:3, :3]).as_quat()
        lines += [f"{i + 1} {w} {x} {y} {z} {' '.join(map(str, motion[:3, 3]))} 1 {i:03d}.png", ""]
    for name, text in (("cameras", camera_line), ("images", "\n".join(lines) + "\n"), ("points3D", "")):
        (folder / "sparse" / "0" / f"{name}.txt").write_text(text)


def llff(folder: Path) -> None:
    """Writes cameras of images four times as large, whose principal point is in the middle."""
    write_images(folder, "images_4")
    rows = []
    for _, motion in matrices():
        right, down, forward, centre = np.linalg.inv(motion)[:3].T
        pose = np.stack([down, right, -forward, centre, 4 * np.array([*SIZE, FOCAL])], axis=1)
        rows.append([*pose.flatten(), 0.5, 3.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))


FORMATS = {
    **{"IDR/NeuS": idr, "DVR": dvr, "NeRF": nerf, "Middlebury": middlebury},
    **{"BlendedMVS": blended_mvs, "COLMAP": colmap, "LLFF": llff},
}


def off(capture: Capture, middle: tuple[float, float] = MIDDLE, away: float = 0.0) -> float:
    """The largest error in pixels between the cameras of a capture and those that took the photographs."""
    back = np.linalg.inv(capture.to_world)
    unit = torch.from_numpy((POINTS + away) @ back[:3, :3].T + back[:3, 3]).float()
    errors = []
    for shot in capture.shots:
        _, motion = matrices()[int(re.findall(r"\d+", shot.name)[-1])]
        in_camera = POINTS @ motion[:3, :3].T + motion[:3, 3]
        expected = FOCAL * in_camera[:, :2] / in_camera[:, 2:] + middle
        errors.append(np.abs(shot.camera.project(unit)[0].numpy() - expected).max())
    return float(max(errors))


def changed(folder: Path, change: Callable) -> None:
    """Rewrites transforms.json."""
    stored = json.loads((folder / "transforms.json").read_text())
    change(stored)
    (folder / "transforms.json").write_text(json.dumps(stored))


def moved(folder: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Rewrites each matrix of transforms.json."""

    def move_all(stored) -> None:
        for frame in stored["frames"]:
            frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()

    changed(folder, move_all)


def rewritten(file: Path, change: Callable[[dict], dict]) -> None:
    """Rewrites a .npz file."""
    with np.load(file) as stored:
        arrays = dict(stored)
    np.savez(file, **change(arrays))


def repainted(files: list[Path], change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Rewrites the pixels of images."""
    for file in files:
        Image.fromarray(change(np.asarray(Image.open(file))).astype(np.uint8)).save(file)


def renamed(folder: Path, name: Callable[[int], str]) -> None:
    """Gives the files of a folder other names, by their number."""
    files = sorted(folder.iterdir())
    for i, file in enumerate(files):
        file.rename(folder / f"new_{i}")
    for i in range(len(files)):
        (folder / f"new_{i}").rename(folder / name(i))
