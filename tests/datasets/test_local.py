"""Local mesh files as a dataset."""

import shutil

import numpy as np
import pytest
import trimesh

from datasets.files import local as module
from datasets.files.local import LocalMeshes
from datasets.files.meshes import load_mesh
from datasets.scene import Split
from tests.looped import each

ODD_NAME = "two words ünïcode 50% #1?"


def write_box(path, sides=(1.0, 0.6, 0.4)):
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box(sides).export(path)
    return path


def local(path, *, strength=1.0) -> LocalMeshes:
    return LocalMeshes(str(path), radius=0.97, strength=strength)


def proportions(mesh) -> tuple[float, ...]:
    """Area and volume in scene units, which differ between these shapes."""
    return round(mesh.area, 6), round(mesh.volume, 6)


@pytest.fixture
def folder(tmp_path):
    for index in range(6):
        write_box(
            tmp_path / ODD_NAME / f"Möbel {index}.{'OBJ' if index == 0 else 'ply'}", (1.0, 0.3 + 0.1 * index, 0.4)
        )
    (tmp_path / ODD_NAME / "notes.txt").write_text("not a mesh")
    return tmp_path / ODD_NAME


def test_all_other_shapes_of_one_file_differ_and_stay_closed_in_the_sphere(tmp_path):
    dataset = local(write_box(tmp_path / "box.ply"))
    shapes = [dataset.mesh(split, index) for split in Split for index in range(4)]
    assert len({proportions(mesh) for mesh in shapes}) == 12
    for mesh in shapes:
        assert mesh.watertight and mesh.volume > 0
        assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(0.97, abs=1e-9)


def test_each_file_of_a_folder_is_in_one_split(folder):
    dataset = local(folder)
    splits = {split: dataset.files(split) for split in Split}
    dealt = [file for files in splits.values() for file in files]
    assert sorted(dealt) == sorted(file for file in folder.iterdir() if file.suffix != ".txt")
    assert len(dealt) == len(set(dealt)) == 6 and min(len(files) for files in splits.values()) >= 1
    assert len(splits[Split.TRAIN]) == 4 and splits == {split: local(folder).files(split) for split in Split}


def test_a_folder_gives_unchanged_meshes_first_and_deformed_meshes_after_them(folder):
    dataset = local(folder)
    plain = {proportions(local(file).mesh(Split.TRAIN, 0)) for file in folder.iterdir() if file.suffix != ".txt"}
    unchanged = [dataset.mesh(split, index) for split in Split for index in range(len(dataset.files(split)))]
    assert {proportions(mesh) for mesh in unchanged} == plain
    beyond = [proportions(dataset.mesh(split, len(dataset.files(split)))) for split in Split]
    assert not plain & set(beyond)


@each("count", [1, 2, 3])
def test_one_file_is_enough(tmp_path, count):
    for index in range(count):
        write_box(tmp_path / f"{index}.ply", (1.0, 0.3 + 0.2 * index, 0.4))
    dataset = local(tmp_path)
    test, train = dataset.mesh(Split.TEST, 0), dataset.mesh(Split.TRAIN, 0)
    assert proportions(test) != proportions(train)
    if count > 1:
        assert not set(dataset.files(Split.TEST)) & set(dataset.files(Split.TRAIN))


def test_contents_decide_identity_and_shapes_and_not_the_path(tmp_path, folder):
    path = write_box(tmp_path / "box.ply")
    moved = local(shutil.copy(path, tmp_path / ODD_NAME.replace("?", ".ply")))
    assert local(path).identity() == moved.identity() and moved.name == ODD_NAME.replace("?", "")
    for split, index in ((Split.TRAIN, 0), (Split.TRAIN, 3), (Split.TEST, 0)):
        assert np.array_equal(local(path).mesh(split, index).vertices, moved.mesh(split, index).vertices)
    other = local(write_box(tmp_path / "other" / "box.ply", (1.0, 0.6, 0.5)))
    smaller = LocalMeshes(str(path), radius=0.9, strength=1.0)
    identities = [
        str(dataset.identity()) for dataset in (local(path), other, local(path, strength=0.5), smaller, local(folder))
    ]
    write_box(folder / "one more.stl", (1.0, 0.65, 0.4))
    assert len({*identities, str(local(folder).identity())}) == 6


def test_no_strength_leaves_the_mesh_as_it_is(tmp_path):
    dataset = local(write_box(tmp_path / "box.ply"), strength=0.0)
    shapes = [dataset.mesh(split, index) for split in Split for index in (0, 1)]
    assert len({proportions(mesh) for mesh in shapes}) == 1


def test_invalid_settings_are_errors_at_once(tmp_path):
    path = write_box(tmp_path / "box.ply")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"found nothing at .*boks.ply'; did you mean .*box.ply"):
        local(tmp_path / "boks.ply")
    with pytest.raises(ValueError, match="a folder must hold mesh files"):
        local(tmp_path / "empty")
    with pytest.raises(ValueError, match=r"dataset.strength must be at least 0, not -1"):
        local(path, strength=-1.0)
    with pytest.raises(ValueError, match=r"dataset.radius must be above 0 and at most 1, not 0"):
        LocalMeshes(str(path), radius=0.0, strength=1.0)


def test_a_slow_repair_is_cached_until_the_file_changes(tmp_path, monkeypatch):
    loaded = []
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(module, "load_mesh", lambda path: loaded.append(path) or load_mesh(path))
    path = write_box(tmp_path / "box.ply")
    module.load_repaired(path)
    assert not (tmp_path / "cache").exists()  # since the repair was fast
    monkeypatch.setattr(module, "MIN_CACHED_SECONDS", -1.0)
    half = trimesh.creation.box((1.0, 0.6, 0.4))
    half.update_faces(range(10))
    half.export(path)
    first, again = module.load_repaired(path), module.load_repaired(path)
    assert np.array_equal(first.vertices, again.vertices) and np.array_equal(first.faces, again.faces)
    assert first.repairs == again.repairs != () and len(loaded) == 2
    (cached,) = (tmp_path / "cache").rglob("*.npz")
    cached.write_bytes(cached.read_bytes()[:200])
    assert np.array_equal(module.load_repaired(path).faces, first.faces) and len(loaded) == 3
    write_box(path)
    assert module.load_repaired(path).repairs == () and len(loaded) == 4
