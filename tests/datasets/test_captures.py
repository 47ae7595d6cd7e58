"""Photographs of a ball, written in each format: the ball is found where it is, and what does not fit is told."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from bench.photos import main
from datasets.captures.formats import find_layout
from datasets.captures.frames import OPENGL
from datasets.captures.hull import carve, hull_mesh, hull_views
from datasets.captures.take import take
from datasets.own_photographs import Reading, read_capture
from datasets.shot import Shot
from datasets.views import look_at
from renderers.camera import Camera
from tests.looped import each
from tests.tiny import camera_of

CENTRE, RADIUS = np.array([0.4, -1.1, 2.0]), 0.35  # of the ball, in the world of the files
SIZE = 40, 48  # height and width
FOCAL, MIDDLE = 60.0, (25.0, 19.0)  # pixels; the principal point is not in the middle


def cameras(count: int = 10) -> list[Camera]:
    """Cameras all around the ball, two thirds of them from above."""
    intrinsics = torch.tensor([[FOCAL, 0, MIDDLE[0]], [0, FOCAL, MIDDLE[1]], [0, 0, 1]])
    centre, found = torch.from_numpy(CENTRE).float(), []
    for i in range(count):
        across, up = 2.4 * i, (0.7, -0.5, 0.1)[i % 3]
        toward = [np.cos(up) * np.sin(across), np.sin(up), np.cos(up) * np.cos(across)]
        eye = centre + 1.5 * torch.tensor(toward, dtype=torch.float32)
        found.append(Camera(intrinsics, look_at(eye, centre), *SIZE))
    return found


def image(camera: Camera, *, alpha: bool = False) -> tuple[Image.Image, Image.Image]:
    """The ball in a colour for each side, before grey; and its mask."""
    rays = camera.rays().flat()
    towards = torch.from_numpy(CENTRE).float() - rays.origins
    closest = (towards * rays.directions).sum(-1)
    hit = (rays.at(closest) - torch.from_numpy(CENTRE).float()).norm(dim=-1) < RADIUS
    colours = torch.where(hit[:, None], torch.tensor([200.0, 80.0, 40.0]), 128.0).view(*SIZE, 3)
    mask = (255 * hit.view(*SIZE)).to(torch.uint8).numpy()
    pixels = colours.to(torch.uint8).numpy()
    picture = Image.fromarray(np.dstack([pixels, mask]) if alpha else pixels)
    return picture, Image.fromarray(mask)


def whole(camera: Camera) -> np.ndarray:
    """Intrinsics with the first pixel's centre at (0, 0)."""
    matrix = camera.intrinsics.double().numpy().copy()
    matrix[:2, 2] -= 0.5
    return matrix


def write_images(folder: Path, images: str, *, masks: bool = True, alpha: bool = False, names: str = "{:03d}.png"):
    """Writes the images, and the masks into a folder of their own."""
    (folder / images).mkdir(parents=True, exist_ok=True)
    for i, camera in enumerate(cameras()):
        picture, mask = image(camera, alpha=alpha)
        picture.save(folder / images / names.format(i))
        if masks:
            (folder / "mask").mkdir(exist_ok=True)
            mask.save(folder / "mask" / f"{i:03d}.png")


def idr(folder: Path) -> None:
    write_images(folder, "image", names="{:06d}.png")
    scale = np.diag([0.5, 0.5, 0.5, 1.0])
    scale[:3, 3] = CENTRE + 0.05
    stored = {}
    for i, camera in enumerate(cameras()):
        projection = np.eye(4)
        projection[:3] = -3.0 * whole(camera) @ camera.world_to_camera.double().numpy()[:3]  # of any scale and sign
        stored |= {f"world_mat_{i}": projection, f"scale_mat_{i}": scale}
    np.savez(folder / "cameras_sphere.npz", **stored)


def nerf(folder: Path) -> None:
    write_images(folder, "train", masks=False, alpha=True, names="r_{}.png")
    frames = [
        {
            "file_path": f"./train/r_{i}",
            "transform_matrix": (camera.camera_to_world.double().numpy() @ OPENGL).tolist(),
        }
        for i, camera in enumerate(cameras())
    ]
    stored = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": MIDDLE[0], "cy": MIDDLE[1], "w": SIZE[1], "h": SIZE[0]}
    (folder / "transforms.json").write_text(json.dumps({**stored, "frames": frames}))


def middlebury(folder: Path) -> None:
    write_images(folder, ".", names="ball{:04d}.png")
    lines = ["10"]
    for i, camera in enumerate(cameras()):
        motion = camera.world_to_camera.double().numpy()
        numbers = [*whole(camera).flatten(), *motion[:3, :3].flatten(), *motion[:3, 3]]
        lines.append(f"ball{i:04d}.png " + " ".join(map(str, numbers)))
    (folder / "ball_par.txt").write_text("\n".join(lines) + "\n")


def colmap(folder: Path) -> None:
    """COLMAP's text files; pycolmap is an extra."""
    pytest.importorskip("pycolmap", reason="pycolmap is an extra: pip install -e '.[colmap]'")
    from scipy.spatial.transform import Rotation

    write_images(folder, "images")
    (folder / "sparse" / "0").mkdir(parents=True)
    camera_line = f"1 PINHOLE {SIZE[1]} {SIZE[0]} {FOCAL} {FOCAL} {MIDDLE[0]} {MIDDLE[1]}\n"
    lines = []
    for i, camera in enumerate(cameras()):
        motion = camera.world_to_camera.double().numpy()
        x, y, z, w = Rotation.from_matrix(motion[:3, :3]).as_quat()
        lines += [f"{i + 1} {w} {x} {y} {z} {' '.join(map(str, motion[:3, 3]))} 1 {i:03d}.png", ""]
    for name, text in (("cameras", camera_line), ("images", "\n".join(lines) + "\n"), ("points3D", "")):
        (folder / "sparse" / "0" / f"{name}.txt").write_text(text)


def llff(folder: Path) -> None:
    """Cameras of images four times as large, whose principal point is in the middle."""
    write_images(folder, "images_4")
    rows = []
    for camera in cameras():
        right, down, forward, centre = camera.camera_to_world.double().numpy()[:3].T
        pose = np.stack([down, right, -forward, centre, 4 * np.array([*SIZE, FOCAL])], axis=1)
        rows.append([*pose.flatten(), 0.5, 3.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))


FORMATS = {"IDR/NeuS": idr, "NeRF": nerf, "Middlebury": middlebury, "COLMAP": colmap, "LLFF": llff}


@pytest.mark.parametrize("name", FORMATS)
def test_cameras_are_those_that_were_written(tmp_path, name):
    FORMATS[name](tmp_path)
    capture = read_capture(tmp_path, Reading(48))
    assert (capture.format, len(capture.shots)) == (name, 10)
    assert capture.notes == (("10 images; 10 masks by a common prefix or suffix",) if name == "Middlebury" else ())
    assert name in capture.summary and "48 x 40 pixels, masks from" in capture.summary
    for shot, camera in zip(capture.shots, cameras(), strict=True):
        intrinsics = camera.intrinsics.clone()
        if name == "LLFF":
            intrinsics[:2, 2] = torch.tensor([SIZE[1] / 2, SIZE[0] / 2])
        torch.testing.assert_close(shot.camera.intrinsics, intrinsics, rtol=0, atol=1e-3)
        if name != "IDR/NeuS":  # whose scale_mat is part of its cameras
            moved = shot.within(-capture.sphere.centre / capture.sphere.radius, 1 / capture.sphere.radius)
            torch.testing.assert_close(moved.camera.world_to_camera, camera.world_to_camera, rtol=0, atol=1e-4)


def test_the_ball_is_where_it_is_and_its_hull_no_smaller(tmp_path):
    nerf(tmp_path)
    capture = read_capture(tmp_path, Reading(48))
    hull = hull_mesh(capture.shots, 64)
    assert hull is not None and hull.watertight
    vertices = hull.vertices * capture.sphere.radius + capture.sphere.centre - CENTRE
    distances = np.linalg.norm(vertices, axis=1)
    assert np.abs(distances - RADIUS).max() < 0.06  # a pixel is .025 wide there
    assert distances.min() > RADIUS - 0.02 and np.abs(vertices.mean(axis=0)).max() < 0.02
    assert np.linalg.norm(capture.sphere.centre - CENTRE) + RADIUS < capture.sphere.radius < 1.4 * RADIUS
    for shot, seen in zip(capture.shots, hull_views(capture.shots, hull), strict=True):
        assert (seen & shot.mask).sum() > 0.9 * shot.mask.sum()


def test_the_unit_sphere_of_idr_is_that_of_its_scale_mat(tmp_path):
    idr(tmp_path)
    hull = hull_mesh(read_capture(tmp_path, Reading(48)).shots, 64)
    assert hull is not None
    middle = (hull.vertices.min(axis=0) + hull.vertices.max(axis=0)) / 2
    np.testing.assert_allclose(middle, -0.05 / 0.5, atol=0.02)
    np.testing.assert_allclose(np.ptp(hull.vertices, axis=0), 2 * RADIUS / 0.5, atol=0.1)


def test_a_photograph_is_made_smaller_with_its_camera_and_never_larger(tmp_path):
    nerf(tmp_path)
    small, large = (read_capture(tmp_path, Reading(longest)) for longest in (24, 4096))
    assert large.notes == ("the photographs have at most 48 pixels, not 4096",) and small.notes == ()
    assert small.shots[0].colours.shape == (20, 24, 3) and large.shots[0].colours.shape == (*SIZE, 3)
    torch.testing.assert_close(small.shots[0].camera.intrinsics[:2], large.shots[0].camera.intrinsics[:2] / 2)
    assert large.shots[0].colours[0, 0].tolist() == [1.0, 1.0, 1.0]  # transparent is white


BENT = (
    {"k1": 0.15, "k2": -0.08, "p1": 0.03, "p2": -0.05},
    {"k1": 0.1, "k2": 0.05, "k3": -0.1, "k4": 0.2, "k5": 0.05, "k6": 0.01, "camera_model": "FULL_OPENCV"},
    {"k1": 0.05, "k2": -0.01, "k3": 0.02, "k4": 0.01, "is_fisheye": True},
)


@each("bent", BENT)
def test_distortion_is_taken_out(tmp_path, bent):
    """Each pixel of a ramp says where it was taken from; test_lenses.py has the places against OpenCV."""
    side = 60
    rows, columns = np.mgrid[:side, :side] + 0.5
    ramp = np.dstack([4 * columns, 4 * rows, 0 * rows]).astype(np.uint8)
    Image.fromarray(ramp).save(tmp_path / "0.png")
    stored = {"fl_x": 50.0, "fl_y": 48.0, "cx": 31.0, "cy": 28.0, "w": side, "h": side, **bent}
    frame = {"file_path": "0.png", "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({**stored, "frames": [frame]}))
    read = find_layout(tmp_path).frames[0]
    found = take(read, side).colours.numpy()[..., :2] * 255 / 4
    places = np.dstack(read.lens.bend((columns - 31) / 50, (rows - 28) / 48)) * [50, 48] + [31, 28]
    inside = ((places > 1) & (places < side - 1)).all(axis=-1)
    assert inside.mean() > 0.7 and np.abs(places - np.dstack([columns, rows]))[inside].max() > 1
    np.testing.assert_allclose(found[inside], places[inside], atol=0.01)


def without_first_camera(folder: Path) -> None:
    with np.load(folder / "cameras_sphere.npz") as stored:
        known = {name: stored[name] for name in stored if name != "world_mat_0"}
    np.savez(folder / "cameras_sphere.npz", **known)


def no_numbers(folder: Path) -> None:
    np.savez(folder / "cameras_sphere.npz", **{f"world_mat_{i}": np.full((4, 4), np.nan) for i in range(10)})


MISTAKES = {  # in the ball in IDR's format, and what is said of them
    "image without camera": (
        lambda f: shutil.copy(f / "image" / "000004.png", f / "image" / "000010.png"),
        ("000010.png has no camera", "has 10 cameras, and there are 11 images", "remove"),
    ),
    "mask missing": (
        lambda f: (f / "mask" / "004.png").unlink(),
        ("000004.png has no mask in", "9 masks (000.png", "add it"),
    ),
    "mask of another size": (
        lambda f: Image.new("L", (10, 10)).save(f / "mask" / "004.png"),
        ("004.png has 10 x 10 pixels, its image 48 x 40",),
    ),
    "empty mask": (
        lambda f: Image.new("L", SIZE[::-1]).save(f / "mask" / "004.png"),
        ("the mask of 000004.png is empty", "use no masks"),
    ),
    "broken image": (
        lambda f: (f / "image" / "000004.png").write_bytes(b"no image"),
        ("000004.png cannot be read as an image", "copy or export it again"),
    ),
    "no numbers": (no_numbers, ("world_mat_0", "finite numbers", "export it again")),
    "gap in the cameras": (without_first_camera, ("cameras_sphere.npz has no world_mat_0", "export it again")),
    "no images": (lambda f: shutil.rmtree(f / "image"), ("has cameras (IDR/NeuS) but none of their images",)),
    "no cameras": (
        lambda f: (f / "cameras_sphere.npz").unlink(),
        ("has no cameras that are known", "transforms.json", "poses_bounds.npy"),
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_what_cannot_be_used_is_told_in_one_line(tmp_path, capsys, mistake):
    spoil, words = MISTAKES[mistake]
    idr(tmp_path)
    spoil(tmp_path)
    assert main([str(tmp_path), "--into", str(tmp_path / "photos.png")]) == 2
    out, err = capsys.readouterr()
    assert out == "" and len(err.splitlines()) == 1
    assert all(word in err for word in words), err


def test_a_missing_image_leaves_its_camera_out(tmp_path, capsys):
    idr(tmp_path)
    (tmp_path / "image" / "000004.png").unlink()
    assert main([str(tmp_path), "--into", str(tmp_path / "photos.png")]) == 0
    out = capsys.readouterr().out
    assert "9 photographs" in out and "note: no image for 1 of the cameras, such as camera 4" in out
    assert int(out.split("overlap by ")[1].split("%")[0]) > 90
    assert (tmp_path / "photos.png").stat().st_size > 10_000


def test_a_folder_of_another_format_too_and_broken_ones_are_told(tmp_path):
    nerf(tmp_path)
    np.savez(tmp_path / "cameras.npz", world_mat_0=np.eye(4))
    assert find_layout(tmp_path).notes == ("other cameras in the folder are not used: cameras.npz",)
    stored = json.loads((tmp_path / "transforms.json").read_text())
    angle = {name: value for name, value in stored.items() if name != "fl_x"} | {"camera_angle_x": 39.6}
    flat = stored | {"frames": [frame | {"transform_matrix": [[1.0, 0.0], [0.0, 1.0]]} for frame in stored["frames"]]}
    for broken, words in ((angle, "between 0 and pi, not 39.6: it is in radians"), (flat, "must be 4 x 4, not 2 x 2")):
        (tmp_path / "transforms.json").write_text(json.dumps(broken))
        with pytest.raises(ValueError, match=words):
            find_layout(tmp_path)


def test_flipped_axes_are_told_and_can_be_turned(tmp_path, capsys):
    nerf(tmp_path)
    stored = json.loads((tmp_path / "transforms.json").read_text())
    for frame in stored["frames"]:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ OPENGL).tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(stored))
    picture = ("--into", str(tmp_path / "photos.png"))
    assert main([str(tmp_path), *picture]) == 2
    assert "the visual hull of the masks is empty" in (err := capsys.readouterr().err) and "flipped axes" in err
    assert main([str(tmp_path), "--axes", "flipped", *picture]) == 0


def test_the_photographs_that_fit_worst_are_named(tmp_path, capsys):
    idr(tmp_path)
    mask = np.asarray(Image.open(tmp_path / "mask" / "007.png"))
    Image.fromarray(np.roll(mask, 6, axis=1)).save(tmp_path / "mask" / "007.png")
    assert main([str(tmp_path), "--into", str(tmp_path / "a" / "b")]) == 0
    out = capsys.readouterr().out
    assert "note: least in 000007.png" in out and out.splitlines()[-1] == str(tmp_path / "a" / "b.png")
    assert (tmp_path / "a" / "b.png").is_file()


def test_images_of_16_bits_and_masks_of_labels_are_read(tmp_path):
    idr(tmp_path)
    plain = read_capture(tmp_path, Reading(48))
    picture = Image.open(tmp_path / "image" / "000002.png")
    Image.fromarray(np.asarray(picture.convert("L")).astype(np.uint16) * 257).save(tmp_path / "image" / "000002.png")
    mask = np.asarray(Image.open(tmp_path / "mask" / "002.png"))
    Image.fromarray((mask > 0).astype(np.uint8)).save(tmp_path / "mask" / "002.png")
    found = read_capture(tmp_path, Reading(48))
    assert torch.equal(found.shots[2].mask, plain.shots[2].mask)
    grey = plain.shots[2].colours @ torch.tensor([0.299, 0.587, 0.114])
    torch.testing.assert_close(found.shots[2].colours[..., 0], grey, rtol=0, atol=0.01)


def test_an_alpha_channel_that_is_opaque_is_no_mask(tmp_path):
    nerf(tmp_path)
    for file in (tmp_path / "train").iterdir():
        Image.open(file).convert("RGB").convert("RGBA").save(file)
    assert read_capture(tmp_path, Reading(48)).masks == ""


def test_images_of_two_sizes_each_have_their_camera(tmp_path):
    idr(tmp_path)
    for name in ("image/000003.png", "mask/003.png"):
        Image.open(tmp_path / name).resize((24, 20)).save(tmp_path / name)
    with np.load(tmp_path / "cameras_sphere.npz") as stored:
        known = dict(stored)
    known["world_mat_3"] = np.diag([0.5, 0.5, 1.0, 1.0]) @ known["world_mat_3"]
    np.savez(tmp_path / "cameras_sphere.npz", **known)
    capture = read_capture(tmp_path, Reading(48))
    assert "24 x 20 and 48 x 40 pixels" in capture.summary


@each("share", [0.005, 0.3, 0.7])
def test_the_hull_is_half_less_the_least_mask_between_pixels(share):
    """Four photographs from one place show one half; a point lies between the last column of it and the next."""
    camera = camera_of(16)
    mask = torch.arange(16).expand(16, 16) < 8
    shots = [Shot(str(place), camera, torch.zeros(16, 16, 3), mask) for place in range(4)]
    focal, middle = camera.intrinsics[0, 0], camera.intrinsics[0, 2]
    across = (8.5 - share - middle) / focal  # of a point at depth 1
    seen = torch.tensor([across, 0.0, 1.0])
    point = camera.camera_to_world[:3, :3] @ seen + camera.camera_to_world[:3, 3]
    assert carve(shots, point[None]).item() == pytest.approx(0.5 - share, abs=1e-5)


def test_without_masks_the_sphere_is_about_what_the_cameras_look_at(tmp_path):
    middlebury(tmp_path)
    capture = read_capture(tmp_path, Reading(48, masks=False))
    assert all(shot.mask is None for shot in capture.shots) and "no masks" in capture.summary
    np.testing.assert_allclose(capture.sphere.centre, CENTRE, atol=1e-3)
    assert capture.sphere.radius == pytest.approx(1.5 * 20 / FOCAL, rel=1e-3)
