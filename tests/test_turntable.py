"""The command bench.turntable: its frames, colours, files and errors."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from matplotlib import colormaps
from PIL import Image

from bench.records.record import Record
from bench.turntable import UPRIGHT, main, make_upright, turntable
from datasets.files.meshes import read_mesh
from datasets.mesh import Mesh
from tests.tiny import icosphere

SIZE = 32
RED, BLUE = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])


def ball(radius: float = 0.8, centre: tuple[float, float, float] = (0, 0, 0), split: int = 0) -> Mesh:
    """A sphere, red on the negative side of the axis `split` and blue on the other."""
    sphere = icosphere(radius, centre)
    return replace(sphere, colours=np.where(sphere.vertices[:, [split]] < centre[split], RED, BLUE))


def frames_of(path: Path) -> list[np.ndarray]:
    with Image.open(path) as moving:
        frames = []
        for index in range(getattr(moving, "n_frames", 1)):
            moving.seek(index)
            frames.append(np.asarray(moving.convert("RGB"), dtype=float) / 255)
        return frames


def small_turntable(capsys: pytest.CaptureFixture, *arguments: object) -> Path:
    """Runs the command with small frames; gives the file that its last line names."""
    assert main([*map(str, arguments), "--frames", "4", "--size", str(SIZE)]) == 0
    return Path(capsys.readouterr().out.splitlines()[-1])


def drawn(mesh: Mesh, column: int, frames: int = 4) -> list[np.ndarray]:
    """The frames of a column before they are written: 0 for colours, 1 for normals and 2 for depth."""
    return [frame[:, column * SIZE : (column + 1) * SIZE] / 255 for frame in turntable(mesh, frames, SIZE)]


def red(image: np.ndarray) -> np.ndarray:
    return (image[..., 0] > 0.6) & (image[..., 2] < 0.4)


@pytest.mark.parametrize("suffix", ["webp", "gif"])
def test_the_red_half_is_on_the_left_and_half_a_turn_later_on_the_right(tmp_path, capsys, suffix):
    ball().save(tmp_path / "ball.ply")
    path = small_turntable(capsys, tmp_path / "ball.ply", "--into", tmp_path / "new" / f"a.{suffix}")
    assert path == tmp_path / "new" / f"a.{suffix}"
    first, quarter, half, _ = (frame[:, :SIZE] for frame in frames_of(path))
    middle = SIZE // 2
    assert red(first[:, :middle]).sum() > 150 and not red(first[:, middle + 2 :]).any()
    assert red(half[:, middle:]).sum() > 150 and not red(half[:, : middle - 2]).any()
    assert not red(quarter).any()  # the camera went to the right, where the sphere is blue
    with Image.open(path) as moving:
        assert (moving.info["loop"], moving.size, moving.n_frames) == (0, (3 * SIZE, SIZE), 4)


def test_colours_are_interpolated_over_a_triangle():
    corners = np.array([[-0.9, -0.9, 0.0], [0.9, -0.9, 0.0], [0.0, 0.9, 0.0]])
    (frame, *_) = drawn(Mesh(0.9 * corners, np.array([[0, 1, 2]]), colours=np.eye(3)), 0, frames=2)
    inside = np.ptp(frame, axis=-1) > 0.02
    rows, columns = (np.nonzero(inside.any(axis=axis))[0] for axis in (1, 0))
    assert frame[rows[-2], columns[1]].argmax() == 0  # the lower left corner is red
    assert frame[rows[-2], columns[-2]].argmax() == 1 and frame[rows[1], SIZE // 2].argmax() == 2
    centre = frame[round(rows[0] + 2 / 3 * (rows[-1] - rows[0])), SIZE // 2]
    assert centre == pytest.approx([1 / 3] * 3, abs=0.06)


def test_depth_has_one_scale_over_all_frames():
    frames = drawn(ball(0.2, (0, 0, 0.7)), 2)
    viridis = colormaps["viridis_r"](np.arange(256))[:, :3]

    def colour_indices(frame: np.ndarray) -> np.ndarray:
        shown = frame[frame.min(axis=-1) < 0.5]
        return np.abs(shown[:, None] - viridis).sum(-1).argmin(-1)

    near, side, far, _ = map(colour_indices, frames)
    assert near.max() < 50 and far.min() > 190 and side.min() > 80 and side.max() < 175


def test_a_mesh_without_colours_is_shaded_and_its_normals_face_the_camera():
    mesh = ball()
    outward, inward = Mesh(mesh.vertices, mesh.faces), Mesh(mesh.vertices, mesh.faces[:, ::-1])
    shaded = drawn(outward, 0)[0]
    assert np.ptp(shaded, axis=-1).max() == 0
    assert shaded[10, 12, 0] > shaded[21, 20, 0] + 0.2  # light from the upper left
    for column in (0, 1):
        assert drawn(inward, column)[0] == pytest.approx(drawn(outward, column)[0], abs=0.01)
    normals = drawn(outward, 1)[1]
    assert (normals[0] == 1).all() and normals[SIZE // 2, SIZE // 2, 2] > 0.9  # white around; it faces the camera


def test_a_run_folder_gets_its_turntable_and_a_mesh_file_one_in_the_current_folder(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    ball().save(tmp_path / "run" / "mesh.ply")
    assert small_turntable(capsys, tmp_path / "run") == tmp_path / "run" / "turntable.webp"
    mesh = ball(50.0, (300, 0, 0))
    Mesh(mesh.vertices, mesh.faces[::2]).save("half.ply")  # open
    assert small_turntable(capsys, "half.ply") == Path("turntable.webp")
    shown = frames_of(tmp_path / "turntable.webp")[0].min(axis=-1) < 0.9
    assert shown[:, :SIZE].any(axis=1).sum() > 0.8 * SIZE  # scaled until it fills the picture


def test_a_mesh_in_the_unit_sphere_stays_and_another_is_moved_into_it():
    inside, outside = ball(0.3, (0.5, 0, 0)), ball(0.3, (0.8, 0, 0))
    assert np.array_equal(make_upright(inside, "y").vertices, inside.vertices)
    moved = make_upright(outside, "y").vertices
    assert np.linalg.norm(moved, axis=1).max() == pytest.approx(1)
    assert moved.mean(axis=0) == pytest.approx(np.zeros(3), abs=1e-6)


def test_up_turns_an_axis_upwards():
    for up in UPRIGHT:
        axis = (-1 if up[0] == "-" else 1) * np.eye(3)["xyz".index(up[-1])]
        turned = make_upright(ball(0.2, tuple(0.5 * axis)), up)
        assert turned.vertices.mean(axis=0) == pytest.approx([0, 0.5, 0], abs=1e-6), up
        assert turned.volume > 0  # not mirrored


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb", "stl"])
def test_every_kind_of_file_is_read_with_its_colours(tmp_path, suffix):
    mesh = ball()
    rgba = (255 * np.hstack([mesh.colours, np.ones((len(mesh.vertices), 1))])).astype(np.uint8)
    path = tmp_path / f"ball.{suffix}"
    trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=rgba, process=False).export(path)
    read = read_mesh(path)
    assert read.repairs == () and len(read.faces) == len(mesh.faces)
    if suffix == "stl":  # STL has no colours
        assert read.colours is None
    else:
        assert read.colours == pytest.approx(np.where(read.vertices[:, [0]] < 0, RED, BLUE))


def test_colours_of_vertices_are_read_if_there_is_also_a_texture(tmp_path):
    corners = "v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 0 0 1\n"
    (tmp_path / "a.obj").write_text(f"{corners}vt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n")
    assert read_mesh(tmp_path / "a.obj").colours == pytest.approx(np.stack([RED, RED, BLUE]))


def test_parts_of_a_scene_are_joined_and_those_without_colours_are_grey(tmp_path):
    mesh, plain = ball(), ball(0.1)
    painted = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=[255, 0, 0, 255], process=False)
    bare = trimesh.Trimesh(plain.vertices, plain.faces, process=False)
    trimesh.Scene({"a": painted, "b": bare}).export(tmp_path / "two.glb")
    read = read_mesh(tmp_path / "two.glb")
    assert len(read.faces) == 2 * len(mesh.faces)
    outer = np.linalg.norm(read.vertices, axis=1) > 0.5
    assert read.colours is not None and outer.sum() == len(mesh.vertices)
    assert (read.colours[outer] == RED).all() and not (read.colours[~outer] == RED).all(axis=1).any()


ERRORS = (
    (["bare"], "bare has no mesh.ply: name a run folder that has one, or a mesh file"),
    (["killed"], "killed has no mesh.ply: the run has no mesh (killed: out of time); name another run"),
    (["nothing.ply"], "error: a mesh file or a folder of them is asked for, found nothing at 'nothing.ply'"),
    (["broken.ply"], "broken.ply': must be a whole .ply file, but it does not begin with a line 'ply'"),
    (["line.ply"], "line.ply': must have an area, found 0 in a box"),
    (["dust.ply"], "must be large enough to be seen, found 3.46e-06 across; scale it to 1"),
    (["ball.ply", "--into", "new/a.mp4"], "must end in .webp or .gif, found 'new/a.mp4'; type --into new/a.webp"),
    (["ball.ply", "--frames", "1"], "--frames must be 2 to 720, found 1; 36 is a good number"),
    (["ball.ply", "--size", "8"], "--size must be 16 to 1024 pixels, found 8"),
)


def test_errors_are_one_line_and_nothing_is_written(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ball().save("ball.ply")
    ball(1e-6).save("dust.ply")
    Mesh(np.outer([0, 0.1, 0.2], [1, 1, 1]), np.array([[0, 1, 2]])).save("line.ply")
    Path("broken.ply").write_text("no mesh")
    Path("bare").mkdir()
    Path("killed").mkdir()
    Record(id="a", task="t", renderer="r", dataset="d", seed=0, config={}, reason="out\nof time").write(Path("killed"))
    before = sorted(tmp_path.rglob("*"))
    for arguments, message in ERRORS:
        assert main([*arguments, "--frames", "2"] if "--frames" not in arguments else arguments) == 2, message
        out, err = capsys.readouterr()
        assert out == "" and message in err
        assert err.startswith("error: ") and err.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before
