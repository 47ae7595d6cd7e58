"""ShapeNetCore as a dataset: the files of a class and of a split, and where their shapes are placed."""

import hashlib
import json
import re
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from datasets.captures.formats import find_layout
from datasets.captures.take import take
from datasets.colours import FileColours
from datasets.local import VERSION, load_repaired, split_files
from datasets.mesh import Mesh, fit_in_sphere
from datasets.meshes import read_mesh
from datasets.repair import WRAPPED
from datasets.scene import Split
from datasets.shot import Shot
from datasets.textures import Texture
from renderers.checks import BadInput, check_choice

SYNSETS = {  # the classes of Choy et al. 2016, of which DeepSDF takes five
    **{"plane": "02691156", "bench": "02828884", "cabinet": "02933112", "car": "02958343", "chair": "03001627"},
    **{"display": "03211117", "lamp": "03636649", "speaker": "03691459", "rifle": "04090263", "sofa": "04256520"},
    **{"table": "04379243", "phone": "04401088", "vessel": "04530566"},
}
NAMES = {number: name for name, number in SYNSETS.items()}
MESHES = ("models/model_normalized.obj", "model.obj")  # of v2 and of v1, in the folder of a shape
WORDS = {Split.TRAIN: "train", Split.VALIDATION: "val", Split.TEST: "test"}  # in the names of lists
BUFFER = 1.03  # of DeepSDF: the unit sphere is so many times as large as the shape
UNKNOWN = "warning: the file does not say what is inside: here it is what the wrap encloses; DeepSDF drops such shapes"


@dataclass(frozen=True)
class ShapeNet:
    """The shapes of a class of ShapeNetCore, each repaired to be a closed solid.

    A split without a list has a fifth of the training list; where there is none, of the shapes that no list names.
    Shapes of training and validation come again where a prior takes more than there are; those of the test do not.

    Args:
        path: the folder that has the synsets' folders, with `ID/models/model_normalized.obj` (v2) or `ID/model.obj`.
        synset: a name of `SYNSETS`, or a number.
        split: a list of ids; see `_lists`. None: all shapes are dealt out.
        normalised: "deepsdf", into the unit sphere, or "onet", into a cube of side 1.
        renders: a folder with `SYNSET/ID` of DVR's data or of NMR's as DVR has it, for `task=single_view`.
    """

    path: str
    synset: str
    split: str | None
    normalised: str
    renders: str | None = None

    def __post_init__(self) -> None:
        check_choice("dataset.normalised", self.normalised, ("deepsdf", "onet"))
        if not self.synset.isdigit():
            check_choice("dataset.synset", self.synset, tuple(SYNSETS))
        _ = self.files  # raises where something is missing
        if self.renders is not None and not (pictured := Path(self.renders) / self.folder.name).is_dir():
            raise ValueError(f"dataset.renders: there is no folder '{pictured}': give the one that has SYNSET/ID")

    @property
    def name(self) -> str:
        """The class, by its name where it has one."""
        return f"shapenet_{NAMES.get(self.synset, self.synset)}"

    @property
    def folder(self) -> Path:
        """That of the class."""
        return Path(self.path) / SYNSETS.get(self.synset, self.synset)

    def mesh(self, split: Split, index: int) -> Mesh:
        """A shape as a closed mesh; its `repairs` say which one it is, what its list lacks, and what was repaired."""
        file = self._file(split, index)
        mesh, told = _load(file, self.normalised), [f"the shape is {_id(file)}"]
        if lost := {*self.lists.get(split, ())}.difference(map(_id, self.files[split])):
            told.append(f"warning: {len(lost)} shapes of the list are not on disk, and left out, such as {min(lost)}")
        return replace(mesh, repairs=(*told, *mesh.repairs))

    def texture(self, split: Split, index: int) -> Texture:
        """The colours of a shape, as its file has them; see `Textured`."""
        file = self._file(split, index)
        return FileColours(file, load_repaired(file), self.mesh(split, index))

    def shots(self, split: Split, index: int, longest: int) -> tuple[Shot, ...] | None:
        """See `Pictured`."""
        if self.renders is None:
            return None
        folder = Path(self.renders) / self.folder.name / _id(self._file(split, index))
        return tuple(take(frame, longest).within(np.eye(4)) for frame in find_layout(folder).frames)

    def _file(self, split: Split, index: int) -> Path:
        files = self.files[split]
        if not files or (index >= len(files) and split is Split.TEST):
            what = f"and none of number {index}: set a smaller index, unpack more shapes, or give another dataset.split"
            if split is not Split.TEST:
                what = "and a prior is trained on some: put their list beside dataset.split, unpack more shapes, "
                what += "or set prior=deepsdf prior.path=FOLDER"
            raise BadInput(f"{self.name} has {len(files)} {split} shapes in '{self.folder}', {what}")
        return files[index % len(files)]

    @cached_property
    def files(self) -> dict[Split, list[Path]]:
        """The files of each split, in the order of its list; those that are not on disk are left out.

        Raises:
            ValueError: where the class or a list has no shapes.
        """
        here = _shapes(self.folder)
        listed = {split: [here[name] for name in names if name in here] for split, names in self.lists.items()}
        if listed and not any(listed.values()):
            names = [name for names in self.lists.values() for name in names]
            raise ValueError(
                f"dataset.split: none of its {len(names)} shapes is in '{self.folder}', such as {names[0]}: unpack "
                "them there, or give the split of the shapes that are"
            )
        rest = {*here.values()}.difference(*listed.values())
        files = split_files(listed.get(Split.TRAIN, sorted(rest))) | listed
        if Split.TRAIN in listed:
            held = {*files[Split.VALIDATION], *files[Split.TEST]}
            files[Split.TRAIN] = [file for file in files[Split.TRAIN] if file not in held]
        return files

    @cached_property
    def lists(self) -> dict[Split, list[str]]:
        """The ids that each list names."""
        files = {} if self.split is None else _lists(Path(self.split))
        return {split: _read_ids(file, self.folder.name) for split, file in files.items()}

    def identity(self) -> dict[str, Any]:
        """Plain data that determines the shapes: which these are, as a release of ShapeNet does not change."""
        names = {split: [str(file.relative_to(self.folder)) for file in files] for split, files in self.files.items()}
        shapes = hashlib.sha256(json.dumps(names).encode()).hexdigest()
        more = {} if self.renders is None else {"renders": self.renders}
        return {"name": self.name, "version": VERSION, "shapes": shapes, "normalised": self.normalised} | more


def _id(file: Path) -> str:
    """The id of a shape, the name of its folder."""
    return file.parts[-3 if file.parent.name == "models" else -2]


def _shapes(folder: Path) -> dict[str, Path]:
    """The file of each shape in a class's folder, by its id."""
    for inner in MESHES:
        if found := sorted(folder.glob(f"*/{inner}")):
            return {_id(file): file for file in found}
    what = f"'{folder}' has no ID/{MESHES[0]} (v2) and no ID/{MESHES[1]} (v1)"
    for place in (folder, folder.parent):
        what = what if place.is_dir() else f"there is no folder '{place}'"
    raise ValueError(f"dataset.path: {what}: give the folder of ShapeNetCore in which that of the synset is unpacked")


def _lists(file: Path) -> dict[Split, Path]:
    """The lists of a split: the file, and those beside it with another of `WORDS` in their names; without one, test."""
    if not file.is_file():
        raise ValueError(f"dataset.split: there is no file '{file}': give a split of DeepSDF (.json) or a list (.lst)")
    found = re.search(rf"(?<![a-z])({'|'.join(WORDS.values())})(?![a-z])", file.name)
    if found is None:
        return {Split.TEST: file}
    others = {split: file.name[: found.start()] + word + file.name[found.end() :] for split, word in WORDS.items()}
    return {split: file.with_name(name) for split, name in others.items() if file.with_name(name).is_file()}


def _read_ids(file: Path, synset: str) -> list[str]:
    """The ids that a list has of a synset: DeepSDF's JSON, or lines with an id, alone or after its synset.

    Raises:
        ValueError: where it cannot be read, or has none.
    """
    ids = dict[str, list[str]]()
    try:
        if file.suffix == ".json":
            for dataset in json.loads(file.read_text()).values():
                ids |= dataset
        else:
            for *of, name in (line.replace("/", " ").split() for line in file.read_text().splitlines() if line.strip()):
                ids.setdefault(of[-1] if of else synset, []).append(name)
    except (ValueError, AttributeError) as error:
        raise ValueError(f"dataset.split: '{file}' cannot be read as a split of DeepSDF or a list: {error}") from None
    if not ids.get(synset):
        has = ", ".join(NAMES.get(number, number) for number in ids) or "nothing"
        raise ValueError(f"dataset.split: '{file}' has nothing of {NAMES.get(synset, synset)}, but {has}: set "
                         "dataset.synset to it, or give another list")  # fmt: skip
    return ids[synset]


@lru_cache(maxsize=64)
def _load(path: Path, normalised: str) -> Mesh:
    """The repaired mesh of a file, placed by the vertices of the file."""
    points = read_mesh(path).used_vertices
    centre, factor = fit_in_sphere(points, 1 / BUFFER)
    if normalised == "onet":
        factor = 1 / float((points.max(axis=0) - points.min(axis=0)).max())
    mesh = load_repaired(path)
    sign = (UNKNOWN,) if any(note.startswith(WRAPPED) for note in mesh.repairs) else ()
    return replace(mesh, vertices=(mesh.vertices - centre) * factor, repairs=(*sign, *mesh.repairs))
