"""Local mesh files: search, reading, refusal and repair."""

import re
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from bench.tasks.reconstruction.surfaces import poisson
from datasets.files.meshes import concatenate_meshes, find_meshes, load_mesh, read_mesh, read_points, repair
from datasets.files.repair import NOT_CHECKED_NOTE
from datasets.mesh import Mesh
from datasets.scene import Truth, sample_surface
from renderers.checks import BadInput
from tests.looped import each
from tests.tiny import mesh_of


def box(centre=(0.0, 0.0, 0.0), size=1.0, inverted=False) -> trimesh.Trimesh:
    solid = trimesh.creation.box((size, size, size))
    solid.apply_translation(centre)
    if inverted:
        solid.invert()
    return solid


def joined(*solids: trimesh.Trimesh) -> Mesh:
    return concatenate_meshes([mesh_of(solid) for solid in solids])


def sheet(height) -> Mesh:
    """A grid of 2 x 12 x 12 triangles over the unit square."""
    x, y = np.meshgrid(np.linspace(0, 1, 13), np.linspace(0, 1, 13), indexing="ij")
    corner = (13 * np.arange(12)[:, None] + np.arange(12)).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 13, corner + 14], 1), np.stack([corner, corner + 14, corner + 1], 1)]
    )
    return Mesh(np.stack([x, y, height(x)], axis=-1).reshape(-1, 3), faces)


def test_a_folder_gives_its_meshes_sorted_and_a_file_itself(tmp_path, monkeypatch):
    for name in ("b.OBJ", "a ü.ply", "notes.txt"):
        (tmp_path / name).write_text("x")
    (tmp_path / "._b.OBJ").write_bytes(b"\x00\x05\x16\x07")
    (tmp_path / "folder.stl").mkdir()
    listed = sorted(tmp_path.iterdir())
    for order in (listed, listed[::-1]):  # of the file system
        monkeypatch.setattr(Path, "iterdir", lambda _, order=order: iter(order))
        assert [path.name for path in find_meshes(tmp_path)] == ["a ü.ply", "b.OBJ"]
    assert find_meshes(str(tmp_path / "b.OBJ")) == [tmp_path / "b.OBJ"]


@each("name, message", [
    ("teapt.obj", r"found nothing at .*teapt.obj'; did you mean '.*teapot\.obj'\?"),
    ("nowhere/zebra.obj", "check the spelling and the current folder"), ("empty", "found none directly in"),
    ("notes.txt", r"must end in one of \.obj .* \.glb, found 'notes\.txt'"),
])  # fmt: skip
def test_paths_that_hold_no_mesh_are_refused_with_a_remedy(tmp_path, name, message):
    for file in ("teapot.obj", "notes.txt"):
        (tmp_path / file).write_text("x")
    (tmp_path / "empty").mkdir(exist_ok=True)
    with pytest.raises(ValueError, match=message):
        find_meshes(tmp_path / name)
    with pytest.raises(ValueError, match="must be one mesh file, found the folder"):
        load_mesh(tmp_path)


@each("name", ["a.obj", "a.ply", "a.stl", "a.off", "a.glb", "with space ü 網.obj"])
def test_a_closed_mesh_keeps_its_surface_in_every_format(name, tmp_path):
    box(centre=(3, 0, 0)).export(tmp_path / name)
    mesh = load_mesh(tmp_path / name)
    assert mesh.watertight and mesh.volume == pytest.approx(1)
    assert (len(mesh.vertices), len(mesh.faces), mesh.repairs) == (8, 12, ())
    assert mesh.vertices.mean(axis=0) == pytest.approx([3, 0, 0])


@each("scale", [1e-6, 1.0, 1e6])
def test_whether_a_mesh_has_an_area_does_not_depend_on_its_scale(tmp_path, scale):
    path = tmp_path / "sliver.obj"
    for width, is_flat in ((1e-11, False), (1e-13, True)):
        path.write_text(f"v 0 0 0\nv {scale} 0 0\nv 0 {width * scale} 0\nf 1 2 3\n")
        with pytest.raises(ValueError, match="must have an area") if is_flat else nullcontext():
            assert len(read_mesh(path).faces) == 1


BALL = trimesh.creation.icosphere(2)  # 162 vertices, 320 faces
COMPLETE = {
    "ply": BALL.export(file_type="ply"),
    "ascii.ply": BALL.export(file_type="ply", encoding="ascii"),
    "stl": BALL.export(file_type="stl"),
    "ascii.stl": BALL.export(file_type="stl_ascii").encode(),
    "off": BALL.export(file_type="off").encode(),
    "glb": BALL.export(file_type="glb"),
}


@each("name", COMPLETE)
def test_a_truncated_file_is_refused(tmp_path, name):
    path, content = tmp_path / f"ball.{name}", COMPLETE[name]
    path.write_bytes(content)
    assert load_mesh(path).repairs == ()
    for length in (*(int(fraction * len(content)) for fraction in (0.02, 0.3, 0.5, 0.8, 0.99)), len(content) - 5):
        path.write_bytes(content[:length])
        with pytest.raises(ValueError, match=r"must be a whole.*; .*copy it again"):
            load_mesh(path)


def with_faces(faces: np.ndarray) -> Mesh:
    """A box with additional faces."""
    return Mesh(box().vertices, np.concatenate([box().faces, faces]))


JUMBLED = np.where(np.arange(12)[:, None] % 3 == 0, box().faces[:, ::-1], box().faces)
DROPPED = "with the same faces as another dropped"
REPAIRED = {  # a mesh, its volume after repair, and the notes without a warning
    "inverted": (joined(box(inverted=True)), 1, ("1 part turned outward",)),
    "jumbled": (Mesh(box().vertices, JUMBLED), 1, ("faces wound consistently", "1 part turned outward")),
    "open": (Mesh(box().vertices, box().faces[2:]), 1, ("1 hole closed",)),
    "doubled": (with_faces(box().faces[:, ::-1]), 1, ("12 doubled faces dropped",)),
    "two faces twice": (with_faces(box().faces[:2]), 1, ("2 doubled faces dropped",)),
    "a part twice": (joined(box(), box(centre=(2, 0, 0)), box()), 2, (f"1 part {DROPPED}",)),
    "three times, and another part": (joined(box(), box(), box(), box(centre=(1, 0, 0))), 2, (f"2 parts {DROPPED}",)),
    "a part twice, and two of its faces three times": (
        with_faces(np.concatenate([box().faces, box().faces[:2]])), 1, (f"1 part {DROPPED}", "2 doubled faces dropped"),
    ),
    "separate": (joined(box(), box(centre=(2, 0, 0))), 2, ()),
    "overlapping": (joined(box(), box(centre=(0.1, 0.1, 0.1))), 2 - 0.9**3, ("2 overlapping parts merged into 1",)),
    "overlapping, and one inside out": (
        joined(box(), box(centre=(0.5, 0.1, 0.2), inverted=True)), 2 - 0.5 * 0.9 * 0.8,
        ("1 part turned outward", "2 overlapping parts merged into 1")),
    "nested": (joined(box(), box(size=0.4)), 1, ("2 overlapping parts merged into 1",)),
    "hollow": (joined(box(), box(size=0.4, inverted=True)), 1 - 0.064, ()),
    "hollow, inside out": (joined(box(inverted=True), box(size=0.4)), 1 - 0.064, ("2 parts turned outward",)),
}  # fmt: skip


@each("scale", [1e-6, 1.0, 1e3])
@each("name", REPAIRED)
def test_a_repair_gives_the_intended_solid_and_a_note_at_each_scale(name, scale):
    mesh, volume, notes = REPAIRED[name]
    repaired = repair(replace(mesh, vertices=scale * mesh.vertices))
    assert repaired.watertight and repaired.volume / scale**3 == pytest.approx(volume) and repaired.repairs == notes


@each("backend", ["pymeshlab", None])
@each("scale", [1e-3, 1e3])
def test_corners_within_a_millionth_of_the_diagonal_are_merged(scale, backend, monkeypatch):
    if backend is None:
        pytest.importorskip("manifold3d")
        monkeypatch.setitem(sys.modules, "pymeshlab", None)
    corners = box().triangles.reshape(-1, 3)  # each face has its own three vertices
    shifts = 2e-7 * np.random.default_rng(0).uniform(-1, 1, corners.shape)
    repaired = repair(Mesh(scale * (corners + shifts), np.arange(36).reshape(-1, 3)))
    assert (len(repaired.vertices), repaired.watertight) == (8, True)
    assert repaired.volume == pytest.approx(scale**3, rel=1e-5)
    assert repaired.repairs == (() if backend else (NOT_CHECKED_NOTE,))


@each("name", REPAIRED)
def test_without_pymeshlab_open3d_and_manifold3d_give_the_same_solids(name, monkeypatch):
    pytest.importorskip("manifold3d")
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    mesh, volume, notes = REPAIRED[name]
    repaired = repair(mesh)
    assert repaired.watertight and repaired.volume == pytest.approx(volume)
    assert {note for note in notes if "outward" not in note} < {
        *repaired.repairs
    }  # Open3D may turn the other side outward
    assert repaired.repairs[-1].startswith("without PyMeshLab, faces ")


def test_functions_that_need_pymeshlab_name_it_if_it_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    points = np.random.default_rng(0).normal(size=(50, 3))
    for call in (lambda: repair(sheet(np.sin)), lambda: poisson(points, points, depth=3, trim=0)):
        with pytest.raises(BadInput, match=r"needs PyMeshLab \(GPL-3\).*: pip install pymeshlab"):
            call()


@pytest.mark.slow
def test_a_sheet_is_wrapped_closely_with_a_note_and_a_warning():
    thin = sheet(lambda x: 0.1 * np.sin(9 * x))
    mesh = repair(replace(thin, vertices=0.01 * thin.vertices))  # tolerances are fractions of the diagonal
    mesh = replace(mesh, vertices=100 * mesh.vertices)
    assert mesh.watertight and 0 < mesh.volume < 0.01
    assert mesh.repairs[-1].startswith("wrapped: ") and "cut away" in mesh.repairs[-1]
    assert mesh.repairs[:-1] == tuple(warnings_of(mesh)) != ()  # the wrap covers both sides, so that the area doubles
    points = sample_surface(thin, 500, seed=0).points
    assert np.abs(Truth(mesh).signed_distance(points)).max() < 0.005


def test_walls_around_a_room_have_a_volume_and_a_torn_sphere_is_not_hollow():
    sides = box().triangles + 0.02 * box().face_normals[:, None]  # the walls do not touch
    ball = trimesh.creation.icosphere(2)
    ball.apply_scale(0.01)
    torn = ball.faces[np.random.default_rng(0).random(len(ball.faces)) < 0.7]
    walls = Mesh(sides.reshape(-1, 3), np.arange(36).reshape(-1, 3))
    for broken, volume in ((walls, 1.04**3), (Mesh(ball.vertices, torn), ball.volume)):
        mesh = repair(broken)
        assert mesh.watertight and mesh.volume == pytest.approx(volume, rel=0.05)
        assert mesh.repairs[-1].startswith("wrapped: ")


def test_a_mesh_without_volume_is_an_error():
    with pytest.raises(ValueError, match=r"must enclose a volume, found a single triangle; .* give the sheet a thick"):
        repair(Mesh(np.eye(3), np.array([[0, 1, 2]])))
    flat = sheet(lambda x: 0 * x)
    twice = Mesh(flat.vertices, np.concatenate([flat.faces, flat.faces[:, ::-1]]))
    with pytest.raises(ValueError, match=r"found 288 faces in flat sheets \(after 288 doubled faces .*; .*export a"):
        repair(twice)


def warnings_of(mesh: Mesh) -> list[str]:
    return [note for note in mesh.repairs if note.startswith("warning: repair changed the ")]


def test_a_large_change_of_area_or_volume_is_in_a_warning():
    ball = trimesh.creation.icosphere(3)
    half = Mesh(ball.vertices, ball.faces[ball.triangles_center[:, 2] > 0])
    (warning,) = warnings_of(repair(half))
    area, volume = (r"from ([\d.]+) to ([\d.]+) \(([+-]\d+)%\)",) * 2
    match = re.fullmatch(
        f"warning: repair changed the area {area} and volume {volume}, in the file's units: .*", warning
    )
    numbers = [float(number) for number in match.groups()]
    assert numbers[0] == pytest.approx(half.area, rel=1e-3)
    assert numbers[1] == pytest.approx(half.area + np.pi, rel=0.02)  # the area of the disc that closes the half sphere
    assert numbers[2] == pytest.approx(100 * (numbers[1] / numbers[0] - 1), abs=1)
    assert numbers[4] == pytest.approx(2 / 3 * np.pi, rel=0.03)


@each("odd", [np.nan, np.inf])
def test_points_that_are_not_finite_are_refused(tmp_path, odd):
    points = np.eye(3)
    trimesh.PointCloud(points).export(tmp_path / "points.ply")
    assert np.array_equal(read_points(tmp_path / "points.ply"), points)
    points[1, 2] = odd
    np.savez(tmp_path / "points.npz", points=points)
    trimesh.PointCloud(points).export(tmp_path / "points.ply")
    for name in ("points.npz", "points.ply"):
        with pytest.raises(BadInput, match="must hold points that are finite, 1 of 3 are not; remove"):
            read_points(tmp_path / name)


def test_point_clouds_of_dvr_are_read_and_its_occupancies_are_refused(tmp_path):
    points = np.arange(12).reshape(4, 3) / 16
    np.savez(tmp_path / "pointcloud.npz", points=points.astype(np.float16), normals=points)
    assert np.array_equal(read_points(tmp_path / "pointcloud.npz"), points)
    np.savez(tmp_path / "points.npz", points=points, occupancies=np.zeros(1, np.uint8))
    (tmp_path / "cut.npz").write_bytes((tmp_path / "points.npz").read_bytes()[:100])
    for name, cause in {"points": "found points, occupancies; take `pointcloud.npz`", "cut": "cannot be read"}.items():
        with pytest.raises(ValueError, match=rf"{name}.npz': must have `points` on the surface, .*{cause}"):
            read_points(tmp_path / f"{name}.npz")
