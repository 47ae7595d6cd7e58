"""Lists of shapes in the forms that are published: no shape is lost, and none is in two splits."""

import json
import shutil
from collections.abc import Callable
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from datasets.files.duplicates import SAME_SHAPE_TOLERANCE, same_shape, shape_numbers
from datasets.files.local import LocalMeshes
from datasets.files.meshes import read_mesh
from datasets.files.shape_lists import read_lists
from datasets.files.shapenet import ShapeNet
from datasets.mesh import Mesh
from datasets.scene import Split
from tests.datasets.test_shapenet import write_shape

CAR, CHAIR = "02958343", "03001627"
IDS = [f"{i:x}a{i}b9" for i in range(8)]
SPLITS = {"train": IDS[:5], "val": IDS[5:6], "test": IDS[6:]}
OTHERS = {"train": ["cha1"], "val": ["cha2"], "test": ["cha3"]}  # of another class
DRAWS = settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
Write = Callable[[dict[str, dict[str, list[str]]]], str]  # the text of ids by class and split


def by_split(leaf: Callable[[str, list[str]], object]) -> Write:
    return lambda classes: json.dumps(
        {split: {synset: leaf(synset, splits[split]) for synset, splits in classes.items()} for split in SPLITS}
    )


def taxonomy(classes: dict[str, dict[str, list[str]]]) -> str:
    """A list of classes, as PCN and GRNet write it; the class `train` has the name of a split."""
    return json.dumps(
        [{"taxonomy_id": synset, "taxonomy_name": "train", **splits} for synset, splits in classes.items()]
    )


def rows(classes: dict[str, dict[str, list[str]]]) -> list[tuple[str, str, str]]:
    return [(synset, name, split) for synset, splits in classes.items() for split in splits for name in splits[split]]


def table(headings: str, row: str, separator: str) -> Write:
    """Columns with a heading; {n} is a number."""

    def text(classes: dict[str, dict[str, list[str]]]) -> str:
        lines = [headings, *(row.format(n=n, s=s, i=i, split=split) for n, (s, i, split) in enumerate(rows(classes)))]
        return "\n".join(line.replace(",", separator) for line in lines if line) + "\n"

    return text


FORMS: dict[str, Write] = {
    "R2N2.json": by_split(lambda synset, names: {name: [0, 1, 2] for name in names}),
    "lists.json": by_split(lambda synset, names: names),
    "paths.json": by_split(lambda synset, names: [f"shape_data/{synset}/{name}" for name in names]),
    "PCN.json": taxonomy,
    "class_first.json": lambda classes: json.dumps({synset: {**splits} for synset, splits in classes.items()}),
    "records.json": lambda classes: json.dumps(
        [{"synset": synset, "model_id": name, "split": split} for synset, name, split in rows(classes)]
    ),
    "of_id.json": lambda classes: json.dumps({f"{synset}/{name}": [split] for synset, name, split in rows(classes)}),
    "all.csv": table("id,synsetId,subSynsetId,modelId,split", "{n:06d},{s},{s},{i},{split}", ","),
    "quoted.csv": table('"split","synsetId","modelId"', '"{split}","{s}","{i}"', ","),
    "names.csv": table("modelId,set,category,synsetId", "{i},{split},train,{s}", ","),
    "with_paths.csv": table("model_id,path,split", "{i},{s}/{i}/models/model_normalized.obj,{split}", ","),
    "with_names.csv": table("split,modelId,name,synsetId", '{split},{i},"a blue, office #{n} chair",{s}', ","),
    "unquoted_names.csv": table("modelId;synset;name;set", "{i};{s};police car;{split}", ";"),
    "empty_cells.csv": table("synsetId,modelId,subSynsetId,tags,split", "{s},{i},,,{split}", ","),
    "empty_cells.tsv": table("synsetId,modelId,subSynsetId,split", "{s},{i},,{split}", "\t"),
    "spaces.txt": table("synsetId modelId split", "{s}  {i} {split}", ","),
    "tabs.txt": table("", "{s},{i},{split}", "\t"),
    "semicolons.txt": table("", "{split},{s},{i}", "; "),
    "files.lst": table("", "{split}/{s}/{i}/models/model_normalized.obj", ","),
    "windows.lst": table("", "{split}\\{s}\\{i}.obj", ","),
}
FORMS["sections.txt"] = lambda classes: "".join(
    f"{split}:\n" + "".join(f"- {s}/{name}\n" for s, splits in classes.items() for name in splits[split])
    for split in SPLITS
)
ENCODINGS = ("utf-8", "utf-8-sig", "utf-16")


def shapenet(folder: Path, split: Path | None) -> ShapeNet:
    return ShapeNet(str(folder), "car", split and str(split), "deepsdf")


def names_of(dataset: ShapeNet) -> dict[str, list[str]]:
    return {key: [file.relative_to(dataset.folder).parts[0] for file in dataset.files[split]]
            for key, split in zip(SPLITS, Split, strict=True)}  # fmt: skip


@DRAWS
@given(
    st.sampled_from([*FORMS]), st.sampled_from(ENCODINGS), st.sampled_from(["\n", "\r\n"]), st.booleans(), st.booleans()
)
@example(form="with_paths.csv", encoding="utf-8", line_end="\n", no_zero=False, on_disk=False)
@example(form="with_names.csv", encoding="utf-8", line_end="\n", no_zero=False, on_disk=False)
@example(form="unquoted_names.csv", encoding="utf-8", line_end="\n", no_zero=False, on_disk=False)
@example(form="empty_cells.csv", encoding="utf-8", line_end="\n", no_zero=False, on_disk=False)
def test_each_form_gives_all_shapes_of_each_split(tmp_path, form, encoding, line_end, no_zero, on_disk):
    number = CAR.lstrip("0") if no_zero else CAR  # as a spreadsheet stores it
    text = FORMS[form]({CHAIR: OTHERS, number: SPLITS})
    file = tmp_path / form
    file.write_bytes(text.replace("\n", line_end).encode(encoding))
    lists = read_lists(file, CAR, {*IDS} if on_disk else ())
    assert {split: [*names] for split, names in zip(Split, SPLITS.values(), strict=True)} == lists


@DRAWS
@given(st.sampled_from(ENCODINGS), st.sampled_from(["{i}", "{s} {i}", "{s}/{i}", "{s}\t{i}", "{i},{s}"]))
def test_a_list_of_one_split_is_that_of_its_name(tmp_path, encoding, line):
    lines = [line.format(s=CAR, i=name) for name in IDS[:3]]
    (tmp_path / "cars_val.lst").write_bytes("\r\n".join(lines).encode(encoding))
    assert read_lists(tmp_path / "cars_val.lst", CAR, IDS) == {Split.VALIDATION: IDS[:3]}


@pytest.mark.parametrize("text", ["3", '"car"', '{"train": {"02958343": 3.5}, "test": [4]}', "[null]"])
def test_other_json_is_refused(tmp_path, text):
    (tmp_path / "split.json").write_text(text)
    with pytest.raises(ValueError, match=r"dataset\.split: '.*split.json'"):
        read_lists(tmp_path / "split.json", CAR, IDS)


def test_a_column_of_splits_with_numbers_is_refused(tmp_path):
    (tmp_path / "all.csv").write_text("modelId,split\n" + "".join(f"{name},{i % 2}\n" for i, name in enumerate(IDS)))
    with pytest.raises(ValueError, match="has '0': write train, val or test"):
        read_lists(tmp_path / "all.csv", CAR, IDS)


@pytest.mark.parametrize("line", ['a1,"office,train', "a1,office", "a1,office,", "a1,train,office"])
def test_a_row_without_a_split_in_its_column_is_refused(tmp_path, line):
    (tmp_path / "all.csv").write_text(f"modelId,name,split\n{line}\na2,chair,test\n")
    with pytest.raises(ValueError, match=r"all.csv' cannot be read as a split .*: (its column|unexp)"):
        read_lists(tmp_path / "all.csv", CAR, IDS)


def test_no_shape_is_lost_or_in_two_splits_and_the_counts_are_noted(tmp_path):
    write_shape(tmp_path, CAR, IDS[0])
    notes = shapenet(tmp_path, None).mesh(Split.TEST, 0).repairs
    assert "1 shape on disk, 1 used: 0 train, 0 validation, 1 test" in notes
    write_shape(tmp_path, CAR, IDS[6], version=1)
    notes = shapenet(tmp_path, None).mesh(Split.TEST, 0).repairs
    assert "1 shape is of ShapeNetCore v2, and 1 of v1" in notes
    for i, name in enumerate(IDS):
        if i not in (0, 6):
            write_shape(tmp_path, CAR, name, version=1 + (i < 6))
    dataset = shapenet(tmp_path, None)
    assert sorted(chain(*names_of(dataset).values())) == IDS
    notes = " ".join(dataset.mesh(Split.TEST, 0).repairs)
    assert "8 shapes on disk, 8 used" in notes and "6 shapes are of ShapeNetCore v2, and 2 of v1" in notes
    (tmp_path / "splits.json").write_text(
        by_split(lambda _, names: names)({CAR: SPLITS | {"train": IDS[:3] + IDS[6:7]}})
    )
    dataset = shapenet(tmp_path, tmp_path / "splits.json")
    assert names_of(dataset) == {"train": IDS[:3], "val": IDS[5:6], "test": IDS[6:]}
    notes = " ".join(dataset.mesh(Split.TEST, 0).repairs)
    assert "8 shapes on disk, 6 used: 3 train, 1 validation, 2 test" in notes and "1 shape is in several" in notes


def test_files_with_the_same_shape_are_one_shape(tmp_path):
    random = np.random.default_rng(0)
    boxes = [trimesh.creation.box(sides) for sides in random.uniform(0.3, 1, (6, 3))]
    for i, box in enumerate(boxes):
        box.export(tmp_path / f"{i}.obj")
    plain = LocalMeshes(str(tmp_path), 0.97, 1.0)
    assert plain.mesh(Split.TEST, 0).repairs == ()
    for i, (box, suffix) in enumerate(zip(boxes, ["stl", "ply", "off", "obj", "stl"], strict=False)):
        copy = box.subdivide() if i == 1 else box.copy()  # the same surface, cut into other faces
        copy.apply_scale(random.uniform(0.1, 100)).apply_translation(random.uniform(-50, 50, 3))
        copy.export(tmp_path / f"{i} (1).{suffix}")
    dataset = LocalMeshes(str(tmp_path), 0.97, 1.0)
    assert {split: plain.files(split) for split in Split} == {split: dataset.files(split) for split in Split}
    assert dataset.identity() == plain.identity()
    assert "5 of 11 files hold the shape of another file" in dataset.mesh(Split.TEST, 0).repairs[0]
    (tmp_path / "9.obj").write_text("no mesh")  # it is an error only where it is used
    boxes[0].apply_transform(np.diag([1, 1, 1.01, 1])).export(tmp_path / "8.obj")
    assert len(LocalMeshes(str(tmp_path), 0.97, 1.0)._meshes) == 8


def test_other_shapes_with_the_same_moments_are_kept(tmp_path):
    bar, ball, stud = trimesh.creation.box((0.3, 0.3, 1)), trimesh.creation.icosphere(3), trimesh.creation.icosphere(1)
    for _ in range(3):
        bar = bar.subdivide()
    for name, turn in (("left", -1.0), ("right", 1.0)):
        twisted, angles = bar.copy(), turn * bar.vertices[:, 2]
        x, y, z = bar.vertices.T
        twisted.vertices = np.stack(
            [x * np.cos(angles) - y * np.sin(angles), x * np.sin(angles) + y * np.cos(angles), z], axis=1
        )
        twisted.export(tmp_path / f"{name}.ply")
    ball.export(tmp_path / "ball.stl")
    (ball + stud.apply_scale(0.02).apply_translation((0.7, 0.7, 0.7))).export(tmp_path / "stud.obj")
    for first, second in (("left.ply", "right.ply"), ("ball.stl", "stud.obj")):
        numbers = [shape_numbers(read_mesh(tmp_path / name)) for name in (first, second)]
        assert np.abs(numbers[0] - numbers[1]).max() < SAME_SHAPE_TOLERANCE
    dataset = LocalMeshes(str(tmp_path), 0.97, 1.0)
    assert len(dataset._meshes) == 4 == len(LocalMeshes(str(tmp_path), 0.97, 1.0)._meshes)  # then from the cache
    shutil.copy(tmp_path / "left.ply", tmp_path / "left (1).ply")
    (ball + stud).apply_scale(9).export(tmp_path / "stud (1).ply")
    assert len(LocalMeshes(str(tmp_path), 0.97, 1.0)._meshes) == 4


def test_the_same_surface_in_other_colours_is_another_shape():
    box = trimesh.creation.box()
    red, blue, dark_red, plain = (
        Mesh(
            box.vertices * size, box.faces, colours=None if colour is None else np.tile(np.array(colour, float), (8, 1))
        )
        for size, colour in ((1, (1, 0, 0)), (2, (0, 0, 1)), (3, (0.99, 0, 0)), (4, None))
    )
    assert [same_shape(red, other) for other in (blue, dark_red, plain)] == [False, True, True]
