"""Photographs of a ball, written in each format: the ball is found where it is, and what does not fit is told."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from bench.photos import main
from datasets.captures.capture import Capture, read_capture
from datasets.captures.formats import OPENGL, decomposed, find_layout
from datasets.captures.hull import hull_mesh, hull_views
from datasets.captures.take import take
from datasets.views import look_at
from renderers.camera import Camera
from renderers.fields.analytic import sphere

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


FORMATS = {"IDR/NeuS": idr, "NeRF": nerf, "Middlebury": middlebury, "COLMAP": colmap}


def found(capture: Capture) -> np.ndarray:
    """The hull's vertices in the world of the files, from the ball's centre."""
    hull = hull_mesh(capture.shots, 64)
    assert hull is not None
    return hull.vertices * capture.sphere.radius + capture.sphere.centre - CENTRE


@pytest.mark.parametrize("name", FORMATS)
def test_the_ball_is_where_it_is(tmp_path, name):
    FORMATS[name](tmp_path)
    capture = read_capture(tmp_path, longest=48)
    assert (capture.format, len(capture.shots), capture.notes) == (name, 10, ())
    assert name in capture.summary and "48 x 40 pixels, masks from" in capture.summary
    for shot, camera in zip(capture.shots, cameras(), strict=True):
        torch.testing.assert_close(shot.camera.intrinsics, camera.intrinsics, rtol=0, atol=1e-3)
        moved = shot.within(-capture.sphere.centre / capture.sphere.radius, 1 / capture.sphere.radius)
        stated = capture.format == "IDR/NeuS"  # whose scale_mat is part of its cameras
        if not stated:
            torch.testing.assert_close(moved.camera.world_to_camera, camera.world_to_camera, rtol=0, atol=1e-4)
    if not capture.sphere.found.startswith("as"):
        vertices = found(capture)
        assert np.abs(np.linalg.norm(vertices, axis=1) - RADIUS).max() < 0.06  # a pixel is .025 wide there
        assert np.abs(vertices.mean(axis=0)).max() < 0.02
        assert np.linalg.norm(capture.sphere.centre - CENTRE) + RADIUS < capture.sphere.radius < 1.4 * RADIUS
    covered = [
        float((seen & shot.mask).sum() / shot.mask.sum())
        for shot, seen in zip(capture.shots, hull_views(capture.shots, hull_mesh(capture.shots, 64)), strict=True)
    ]
    assert min(covered) > 0.9


def test_the_unit_sphere_of_idr_is_that_of_its_scale_mat(tmp_path):
    idr(tmp_path)
    hull = hull_mesh(read_capture(tmp_path, longest=48).shots, 64)
    assert hull is not None
    middle = (hull.vertices.min(axis=0) + hull.vertices.max(axis=0)) / 2
    np.testing.assert_allclose(middle, -0.05 / 0.5, atol=0.02)
    np.testing.assert_allclose(np.ptp(hull.vertices, axis=0), 2 * RADIUS / 0.5, atol=0.1)


def test_llff_has_axes_down_right_and_backward_and_a_camera_for_another_size(tmp_path):
    write_images(tmp_path, "images_4")
    rows = []
    for camera in cameras():
        world = camera.camera_to_world.double().numpy()
        right, down, forward, centre = world[:3].T
        pose = np.stack([down, right, -forward, centre, np.array([4.0 * SIZE[0], 4.0 * SIZE[1], 4.0 * FOCAL])], axis=1)
        rows.append([*pose.flatten(), 0.5, 3.0])
    np.save(tmp_path / "poses_bounds.npy", np.array(rows))
    layout = find_layout(tmp_path)
    assert layout.format == "LLFF"
    for frame, camera in zip(layout.frames, cameras(), strict=True):
        np.testing.assert_allclose(frame.world_to_camera, camera.world_to_camera.numpy(), atol=1e-5)
        assert take(frame, 48).camera.intrinsics[0, 0].item() == pytest.approx(FOCAL)
    (tmp_path / "images_4" / "003.png").unlink()
    with pytest.raises(ValueError, match=r"found shape \[10, 17\] and 9 images"):
        find_layout(tmp_path)


def test_a_projection_is_taken_apart_whatever_its_scale_and_sign():
    camera = cameras()[4]
    for factor in (1.0, -2.5):
        intrinsics, motion = decomposed(factor * whole(camera) @ camera.world_to_camera.double().numpy()[:3])
        np.testing.assert_allclose(intrinsics, camera.intrinsics.numpy(), atol=1e-4)
        np.testing.assert_allclose(motion, camera.world_to_camera.numpy(), atol=1e-6)


def test_a_photograph_is_made_smaller_with_its_camera_and_never_larger(tmp_path):
    nerf(tmp_path)
    frame = find_layout(tmp_path).frames[0]
    small, large = take(frame, 24), take(frame, 1000)
    assert (small.camera.height, small.camera.width, small.colours.shape) == (20, 24, (20, 24, 3))
    torch.testing.assert_close(small.camera.intrinsics[:2], large.camera.intrinsics[:2] / 2)
    assert (large.camera.height, large.camera.width) == SIZE
    assert large.colours[0, 0].tolist() == [1.0, 1.0, 1.0]  # transparent is white


def test_distortion_is_taken_out(tmp_path):
    """A straight bar that a lens has bent by half a pixel is straight again."""
    bend, side, fine, focal = 0.15, 60, 8, 50.0
    ends = ((np.arange(side * fine) + 0.5) / fine - side / 2) / focal
    y, x = np.meshgrid(ends, ends, indexing="ij")
    straight_x, straight_y = x, y
    for _ in range(30):  # where a bent pixel comes from
        square = straight_x**2 + straight_y**2
        straight_x, straight_y = x / (1 + bend * square), y / (1 + bend * square)
    bar = (np.abs(straight_x - 0.3) < 0.05).reshape(side, fine, side, fine).mean(axis=(1, 3))

    def spread(picture: np.ndarray) -> float:
        return float(np.ptp(picture[5:55] @ np.arange(side) / picture[5:55].sum(axis=1)))

    Image.fromarray(np.round(255 * np.repeat(bar[..., None], 3, axis=-1)).astype(np.uint8)).save(tmp_path / "0.png")
    stored = {"fl_x": focal, "w": side, "h": side, "k1": bend}
    frame = {"file_path": "0.png", "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({**stored, "frames": [frame]}))
    shot = take(find_layout(tmp_path).frames[0], 60)
    straight = shot.colours[..., 0].numpy()
    assert spread(bar) > 0.4 and spread(straight) < 0.12
    assert straight[30] @ (np.arange(side) + 0.5) / straight[30].sum() == pytest.approx(30 + 0.3 * focal, abs=0.1)


def spoilt(folder: Path, how: str) -> None:
    """Writes the ball in IDR's format, with a mistake."""
    idr(folder)
    if how == "image missing":
        (folder / "image" / "000004.png").unlink()
    elif how == "image without camera":
        shutil.copy(folder / "image" / "000004.png", folder / "image" / "000010.png")
    elif how == "mask missing":
        (folder / "mask" / "004.png").unlink()
    elif how == "mask of another size":
        Image.new("L", (10, 10)).save(folder / "mask" / "004.png")
    elif how == "empty mask":
        Image.new("L", SIZE[::-1]).save(folder / "mask" / "004.png")
    elif how == "broken image":
        (folder / "image" / "000004.png").write_bytes(b"no image")
    elif how == "no numbers":
        np.savez(folder / "cameras_sphere.npz", **{f"world_mat_{i}": np.full((4, 4), np.nan) for i in range(10)})
    elif how == "broken cameras":
        (folder / "cameras_sphere.npz").write_bytes(b"no archive")
    elif how == "gap in the cameras":
        with np.load(folder / "cameras_sphere.npz") as stored:
            known = {name: stored[name] for name in stored if name != "world_mat_0"}
        np.savez(folder / "cameras_sphere.npz", **known)
    elif how == "no images":
        shutil.rmtree(folder / "image")
    elif how == "no cameras":
        (folder / "cameras_sphere.npz").unlink()


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("image without camera", ("000010.png has no camera", "has 10 cameras, and there are 11 images", "remove")),
        ("mask missing", ("000004.png has no mask in", "add it, or remove the folder")),
        ("mask of another size", ("004.png has 10 x 10 pixels, its image 48 x 40",)),
        ("empty mask", ("the mask of 000004.png is empty", "use no masks")),
        ("broken image", ("000004.png cannot be read as an image", "copy or export it again")),
        ("no numbers", ("idr cameras of", "cannot be read", "export them again")),
        ("broken cameras", ("idr cameras of", "cannot be read", "export them again")),
        ("gap in the cameras", ("idr cameras of", "world_mat_0", "export them again")),
        ("no images", ("has cameras (IDR/NeuS) but none of their images",)),
        ("no cameras", ("has no cameras that are known", "transforms.json", "poses_bounds.npy")),
    ],
)
def test_what_cannot_be_used_is_told_in_one_line(tmp_path, capsys, how, words):
    spoilt(tmp_path, how)
    assert main([str(tmp_path), "--into", str(tmp_path / "photos.png")]) == 2
    out, err = capsys.readouterr()
    assert out == "" and len(err.splitlines()) == 1
    assert all(word in err for word in words), err


def test_a_missing_image_leaves_its_camera_out(tmp_path, capsys):
    spoilt(tmp_path, "image missing")
    assert main([str(tmp_path), "--into", str(tmp_path / "photos.png")]) == 0
    out = capsys.readouterr().out
    assert "9 photographs" in out and "note: no image for cameras 4" in out
    assert int(out.split("overlap by ")[1].split("%")[0]) > 90
    assert (tmp_path / "photos.png").stat().st_size > 10_000


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


def test_of_two_formats_the_one_with_images_is_taken_and_the_other_named(tmp_path):
    nerf(tmp_path)
    np.savez(tmp_path / "cameras.npz", world_mat_0=np.eye(4))
    capture = read_capture(tmp_path, longest=48)
    assert capture.format == "NeRF" and capture.notes == ("other cameras in the folder are not used: IDR/NeuS",)


@pytest.mark.parametrize("key", ["camera_angle_x", "transform_matrix"])
def test_broken_transforms_are_told(tmp_path, key):
    nerf(tmp_path)
    stored = json.loads((tmp_path / "transforms.json").read_text())
    if key == "camera_angle_x":
        del stored["fl_x"]
        stored[key] = 39.6
    else:
        stored["frames"][3][key] = [[1.0, 0.0], [0.0, 1.0]]
    (tmp_path / "transforms.json").write_text(json.dumps(stored))
    words = "between 0 and pi, not 39.6: it is in radians" if key == "camera_angle_x" else "cannot be read"
    with pytest.raises(ValueError, match=words):
        read_capture(tmp_path, longest=48)


def test_images_of_16_bits_turned_images_and_masks_of_labels_are_read(tmp_path):
    idr(tmp_path)
    plain = read_capture(tmp_path, longest=48)
    picture = Image.open(tmp_path / "image" / "000002.png")
    Image.fromarray(np.asarray(picture.convert("L")).astype(np.uint16) * 257).save(tmp_path / "image" / "000002.png")
    mask = np.asarray(Image.open(tmp_path / "mask" / "002.png"))
    Image.fromarray((mask > 0).astype(np.uint8)).save(tmp_path / "mask" / "002.png")
    turned = Image.open(tmp_path / "image" / "000005.png").transpose(Image.Transpose.ROTATE_90)
    exif = Image.Exif()
    exif[0x0112] = 6  # "turn it by 90 degrees clockwise"
    turned.save(tmp_path / "image" / "000005.png", exif=exif)
    found = read_capture(tmp_path, longest=48)
    assert torch.equal(found.shots[2].mask, plain.shots[2].mask)
    grey = plain.shots[2].colours @ torch.tensor([0.299, 0.587, 0.114])
    torch.testing.assert_close(found.shots[2].colours[..., 0], grey, rtol=0, atol=0.01)
    assert torch.equal(found.shots[5].colours, plain.shots[5].colours)


def test_an_alpha_channel_that_is_opaque_is_no_mask(tmp_path):
    nerf(tmp_path)
    for file in (tmp_path / "train").iterdir():
        Image.open(file).convert("RGB").convert("RGBA").save(file)
    assert read_capture(tmp_path, longest=48).masks == ""


def test_images_of_two_sizes_each_have_their_camera(tmp_path):
    idr(tmp_path)
    for name in ("image/000003.png", "mask/003.png"):
        Image.open(tmp_path / name).resize((24, 20)).save(tmp_path / name)
    with np.load(tmp_path / "cameras_sphere.npz") as stored:
        known = dict(stored)
    known["world_mat_3"] = np.diag([0.5, 0.5, 1.0, 1.0]) @ known["world_mat_3"]
    np.savez(tmp_path / "cameras_sphere.npz", **known)
    capture = read_capture(tmp_path, longest=48)
    assert "24 x 20 and 48 x 40 pixels" in capture.summary


def test_without_masks_the_sphere_is_about_what_the_cameras_look_at(tmp_path):
    middlebury(tmp_path)
    capture = read_capture(tmp_path, longest=48, masks=False)
    assert all(shot.mask is None for shot in capture.shots) and "no masks" in capture.summary
    np.testing.assert_allclose(capture.sphere.centre, CENTRE, atol=1e-3)
    assert capture.sphere.radius == pytest.approx(1.5 * 20 / FOCAL, rel=1e-3)


def test_a_hull_is_no_smaller_than_the_ball(tmp_path):
    nerf(tmp_path)
    capture = read_capture(tmp_path, longest=48)
    hull = hull_mesh(capture.shots, 64)
    assert hull is not None
    place = torch.from_numpy((CENTRE - capture.sphere.centre) / capture.sphere.radius).float()
    ball = sphere(RADIUS / capture.sphere.radius, tuple(place.tolist()))
    assert hull.watertight and ball(torch.from_numpy(hull.vertices).float()).min() > -0.05


def test_photographs_that_are_smaller_than_was_asked_for_are_told(tmp_path):
    nerf(tmp_path)
    small = read_capture(tmp_path, longest=16)
    assert not any("pixels, not" in note for note in small.notes)
    size = max(small.shots[0].colours.shape)
    assert size == 16
    whole = read_capture(tmp_path, longest=4096)
    largest = max(max(shot.colours.shape) for shot in whole.shots)
    assert whole.notes[-1] == f"the photographs have at most {largest} pixels, not 4096"
