"""ShapeNetCore in its published layout, with the lists of DeepSDF, Choy and PMO."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from bench.records.folder import _class_counts_hash, code_hash
from bench.report.data.records import family
from bench.tasks.single_view.images import Imaging
from datasets.files import repair
from datasets.files.shapenet import ShapeNet
from datasets.scene import Split, Truth, see
from datasets.views import ViewSampler
from renderers.checks import BadInput
from tests.datasets.test_photographs import PHOTOGRAPHY
from tests.runner.driving import SMALLEST, command, record_of

SOFA, TABLE = "04256520", "04379243"
IDS = [f"{number:02x}a9" for number in (11, 3, 7, 12, 5, 10)]  # unsorted
TINY = (*SMALLEST, "field=box", "view.resolution=12", "task.points=20", "task.optimiser.iterations=2")


def write_shape(folder: Path, synset: str, name: str, version: int = 2, shape: trimesh.Trimesh | None = None) -> None:
    """Writes a shape in the layout of ShapeNetCore v1 or v2: a box whose second side grows with its id."""
    models = folder / synset / name / ("models" if version == 2 else "")
    models.mkdir(parents=True)
    box = trimesh.creation.box((1.0, 0.3 + int(name[:2], 16) / 40, 0.4)).apply_translation((0.2, 0.1, -0.3))
    (box if shape is None else shape).export(models / ("model_normalized.obj" if version == 2 else "model.obj"))


def write_shapenet(folder: Path, version: int = 2) -> Path:
    for name in IDS:
        write_shape(folder, SOFA, name, version)
    write_shape(folder, TABLE, "01ff", version)
    (folder / "taxonomy.json").write_text("[]")
    return folder


def write_split(file: Path, names: list[str], synset: str = SOFA) -> Path:
    file.write_text(json.dumps({"ShapeNetV2": {synset: names}}))
    return file


def write_renders(folder: Path, dataset: ShapeNet, sampler: ViewSampler, views: int = 3) -> Path:
    """Writes the renderings of NMR and DVR for each shape: images, masks, and cameras onto an image from -1 to 1."""
    half = (sampler.resolution - 1) / 2
    for split, index in [(s, index) for s in Split for index in range(len(dataset.files[s]))]:
        truth, target, stored = Truth(dataset.mesh(split, index)), folder / SOFA / ids(dataset, split)[index], {}
        for view in range(views):
            camera = sampler.draw(view)
            intrinsics = np.eye(4)
            intrinsics[[0, 1], [0, 1]] = camera.intrinsics.numpy()[[0, 1], [0, 1]] / half
            motion = camera.world_to_camera.double().numpy()
            stored |= {f"camera_mat_{view}": intrinsics, f"world_mat_{view}": motion}
            stored |= {f"world_mat_inv_{view}": np.linalg.inv(motion)}
            for name, value in {"mask": 255, "image": 80 + 40 * view}.items():
                (target / name).mkdir(parents=True, exist_ok=True)
                pixels = (see(truth, camera).mask.numpy() * value).astype(np.uint8)
                Image.fromarray(pixels).save(target / name / f"{view:04d}.png")
        np.savez(target / "cameras.npz", **stored)
    return folder


def shapenet(folder: Path, split: Path | None = None, **changes: str) -> ShapeNet:
    settings = {"path": str(folder), "synset": "sofa", "split": split and str(split), "normalised": "deepsdf"}
    return ShapeNet(**settings | changes)


def ids(dataset: ShapeNet, split: Split) -> list[str]:
    return [file.relative_to(dataset.folder).parts[0] for file in dataset.files[split]]


@pytest.fixture(scope="module")
def v2(tmp_path_factory) -> Path:
    return write_shapenet(tmp_path_factory.mktemp("ShapeNetCore.v2"))


@pytest.mark.parametrize("version", [1, 2])
def test_both_releases_are_read_and_each_shape_is_in_a_split(tmp_path, version):
    dataset = shapenet(write_shapenet(tmp_path, version))
    dealt = {split: ids(dataset, split) for split in Split}
    assert sorted(name for names in dealt.values() for name in names) == sorted(IDS) and all(dealt.values())
    assert dataset.name == shapenet(tmp_path, synset=SOFA).name == "shapenet_sofa"
    mesh = dataset.mesh(Split.TEST, 0)
    assert mesh.watertight and mesh.repairs[0] == f"the shape is {dealt[Split.TEST][0]}"


def test_shapes_are_placed_as_by_deepsdf_or_onet(v2, tmp_path):
    split = write_split(tmp_path / "split.json", IDS[:1])
    ball = shapenet(v2, split).mesh(Split.TEST, 0)
    assert np.linalg.norm(ball.vertices, axis=1).max() == pytest.approx(1 / 1.03, abs=1e-6)
    cube = shapenet(v2, split, normalised="onet").mesh(Split.TEST, 0)
    for mesh in (ball, cube):
        assert mesh.vertices.min(axis=0) == pytest.approx(-mesh.vertices.max(axis=0), abs=1e-6)
        assert np.ptp(mesh.vertices, axis=0)[[1, 2]] / np.ptp(mesh.vertices[:, 0]) == pytest.approx([0.575, 0.4])
    assert np.ptp(cube.vertices, axis=0).max() == pytest.approx(1)


def test_a_shape_without_an_inside_has_a_warning_and_is_normalised_by_the_file(tmp_path, monkeypatch):
    monkeypatch.setattr(repair, "WRAP_ALPHAS", (8.0,))
    walls = trimesh.creation.box((1.0, 1.0, 1.0))
    walls.update_faces([0, 1, 2, 3, 6, 7, 9])  # these faces do not close
    write_shape(tmp_path, SOFA, "01aa", shape=walls)
    write_shape(tmp_path, SOFA, "02aa")
    dataset = shapenet(tmp_path, write_split(tmp_path / "split.json", ["01aa", "02aa"]))
    wrapped, box = (dataset.mesh(Split.TEST, index) for index in (0, 1))
    warned = ["warning: the file does not say what is inside" in " ".join(mesh.repairs) for mesh in (wrapped, box)]
    assert warned == [True, False]
    assert 1 / 1.03 + 1e-3 < np.linalg.norm(wrapped.vertices, axis=1).max() < 1 / 1.03 + 1e-2  # the wrap lies outside


def test_the_split_of_deepsdf_gives_the_order_and_its_training_list_the_others(v2, tmp_path):
    test = write_split(tmp_path / "sv2_sofas_test.json", [IDS[2], IDS[0]])
    alone = shapenet(v2, test)
    assert ids(alone, Split.TEST) == [IDS[2], IDS[0]]
    others = [*ids(alone, Split.TRAIN), *ids(alone, Split.VALIDATION)]
    assert len({*others} - {IDS[2], IDS[0]}) == len(others) == 3
    train = write_split(tmp_path / "sv2_sofas_train.json", IDS[3:])
    for file in (test, train):
        both = shapenet(v2, file)
        assert ids(both, Split.TEST) == [IDS[2], IDS[0]]
        assert sorted([*ids(both, Split.TRAIN), *ids(both, Split.VALIDATION)]) == sorted(IDS[3:])
    assert both.identity() != alone.identity()
    write_split(train, ["0dead"])  # no shape of the list is on disk
    assert ids(shapenet(v2, test), Split.TEST) == [IDS[2], IDS[0]]
    with pytest.raises(BadInput, match=r"shapenet_sofa has 0 train .* put their list beside dataset\.split, .* prior="):
        shapenet(v2, test).mesh(Split.TRAIN, 0)


def test_a_prior_may_take_a_shape_twice_and_a_test_may_not(v2):
    dataset = shapenet(v2)
    first, again = (dataset.mesh(Split.TRAIN, index) for index in (0, len(dataset.files[Split.TRAIN])))
    assert first.repairs == again.repairs
    with pytest.raises(ValueError, match=r"shapenet_sofa has 1 test shape in .*, and none of number 1: set a smaller"):
        dataset.mesh(Split.TEST, 1)
    with pytest.raises(ValueError, match="shapenet_table has 0 train shapes"):
        shapenet(v2, synset="table").mesh(Split.TRAIN, 0)


@pytest.mark.parametrize("line", ["{id}", "04256520 {id}", "04256520/{id}"], ids=["choy", "pmo", "path"])
def test_lists_have_a_line_for_each_id(v2, tmp_path, line):
    other = [] if line == "{id}" else [line.format(id="01ff").replace(SOFA, TABLE)]
    (tmp_path / "test.lst").write_text("\n".join([*other, *(line.format(id=name) for name in IDS[:3])]) + "\n")
    assert ids(shapenet(v2, tmp_path / "test.lst"), Split.TEST) == IDS[:3]


def test_shapes_that_are_not_on_disk_are_counted_and_left_out(v2, tmp_path):
    split = write_split(tmp_path / "split.json", ["0dead", IDS[1], "0bad", IDS[4]])
    dataset = shapenet(v2, split)
    assert ids(dataset, Split.TEST) == [IDS[1], IDS[4]]
    assert "2 shapes of the list are not on disk, and left out, such as 0bad" in dataset.mesh(Split.TEST, 1).repairs[1]
    assert not any("left out" in note for note in dataset.mesh(Split.TRAIN, 0).repairs)
    write_split(split, ["0dead", IDS[1]])
    assert "1 shape of the list is not on disk" in shapenet(v2, split).mesh(Split.TEST, 0).repairs[1]


@pytest.mark.parametrize(("settings", "message"), [
    ({"synset": "sofas"}, "dataset.synset must be one of plane, .* sofa"),
    ({"synset": "car"}, "there is no folder .*02958343': give the folder of ShapeNetCore"),
    ({"synset": "lamp"}, "03636649' has no ID/models/model_normalized.obj .*: give the folder of ShapeNetCore"),
    ({"path": "nowhere"}, "there is no folder 'nowhere': give"),
    ({"renders": "nowhere"}, "dataset.renders: there is no folder 'nowhere/04256520'"),
    ({"normalised": "atlasnet"}, "dataset.normalised must be one of deepsdf, onet"),
    ({"split": "nowhere.lst"}, "there is no file 'nowhere.lst': give a split of DeepSDF"),
    ({"split": "tables.json"}, "has nothing of sofa, but table: set dataset.synset to it"),
    ({"split": "broken.json"}, "broken.json' cannot be read as a split of DeepSDF or a list"),
    ({"split": "other.lst"}, "none of its 2 shapes is in .*04256520', such as 0bad: unpack them there"),
    ({"split": "empty.lst"}, "has nothing of sofa, but nothing"),
], ids=lambda value: " ".join(value.values()) if isinstance(value, dict) else "")  # fmt: skip
def test_what_is_missing_is_named_with_a_remedy(v2, tmp_path, monkeypatch, settings, message):
    monkeypatch.chdir(tmp_path)
    (v2 / "03636649").mkdir(exist_ok=True)
    write_split(tmp_path / "tables.json", ["01ff"], TABLE)
    for name, text in {"broken.json": '{"ShapeNetV2": {', "other.lst": "0bad\n0dead\n", "empty.lst": "\n"}.items():
        (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=message):
        shapenet(v2, **settings)


def test_a_run_completes_a_shape_and_says_which(v2, tmp_path):
    write_split(tmp_path / "sofas_test.json", IDS[:2])
    named = (f"dataset.path={v2}", f"dataset.split={tmp_path}/${{dataset.synset}}s_test.json", "index=1")
    record = record_of(command("dataset=shapenet", *named, f"results_dir={tmp_path / 'r'}", *TINY).out)
    assert record["status"] == "ok" and record["scene"] == "shapenet_sofa test 1"
    assert family(record) == "shapenet_sofa" and f"the shape is {IDS[1]}" in record["notes"]


def test_another_list_or_other_shapes_on_disk_are_another_run(tmp_path):
    folder = write_shapenet(tmp_path / "ShapeNetCore.v2")
    split = write_split(tmp_path / "test.json", IDS[:2])

    def code() -> str:
        _class_counts_hash.cache_clear()  # the cache holds for one command
        dataset = {"path": str(folder), "synset": "sofa", "split": str(split)}
        return code_hash({"dataset": dataset})

    first = code()
    (folder / "02958343.zip").write_bytes(b"packed")
    assert code() == first  # archives are not part of the identity
    write_shape(folder, SOFA, "14a9")
    second = code()
    write_split(split, IDS[1:3])
    assert len({first, second, code()}) == 3


SAMPLER = ViewSampler(distance=2.5, field_of_view=50.0, azimuth=(0.0, 360.0), elevation=(10.0, 40.0), resolution=24)
IMAGING = Imaging(replace(PHOTOGRAPHY, views=3), SAMPLER)


@pytest.fixture(scope="module")
def renders(v2, tmp_path_factory) -> Path:
    return write_renders(tmp_path_factory.mktemp("NMR"), shapenet(v2, normalised="onet"), SAMPLER)


def test_published_images_replace_rendered_ones(v2, renders, tmp_path):
    dataset = shapenet(v2, normalised="onet", renders=str(renders))
    assert dataset.identity() != shapenet(v2, normalised="onet").identity()
    (first, *_) = IMAGING.images(dataset, Split.TRAIN, 2, tmp_path, lambda *_: None)
    truth = Truth(dataset.mesh(Split.TRAIN, 0))
    for view, camera in enumerate(first.cameras):
        torch.testing.assert_close(camera.world_to_camera, SAMPLER.draw(view).world_to_camera)
        torch.testing.assert_close(camera.intrinsics, SAMPLER.draw(view).intrinsics)
        assert torch.equal(first.masks[view], see(truth, SAMPLER.draw(view)).mask)
        torch.testing.assert_close(first.depths[view], see(truth, camera).depth)
        assert (first.colours[view][first.masks[view]] == 80 + 40 * view).all()


@pytest.mark.parametrize(("changes", "imaging", "message"), [
    ({"normalised": "deepsdf"}, IMAGING, "do not show its mesh: masks overlap by .*dataset.normalised=onet"),
    ({}, replace(IMAGING, photography=replace(PHOTOGRAPHY, views=4)), "has 3 images, .* not 4 of 24 x 24 with masks"),
    ({}, replace(IMAGING, sampler=replace(SAMPLER, resolution=32)), "24 x 24 pixels, not 3 of 32 x 32 with masks: set"),
], ids=["another place", "few", "small"])  # fmt: skip
def test_images_that_do_not_fit_are_refused(v2, renders, changes, imaging, message):
    dataset = shapenet(v2, **{"normalised": "onet", "renders": str(renders)} | changes)
    with pytest.raises(BadInput, match=message):
        imaging.shape_images(dataset, Split.TRAIN, 0)
