"""ShapeNetCore as a dataset: the files of a class and of a split, and the placement of their shapes."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from datasets.files.captures.layouts import find_layout
from datasets.files.captures.sphere import in_world
from datasets.files.captures.take import read_shot
from datasets.files.colours import FileColours
from datasets.files.local import VERSION, load_repaired, split_files
from datasets.files.meshes import read_mesh
from datasets.files.repair import WRAPPED
from datasets.files.shape_lists import NAMES, SYNSETS, read_lists
from datasets.mesh import Mesh, fit_in_sphere
from datasets.scene import Split
from datasets.shot import Shot
from datasets.textures import Texture
from renderers.checks import BadInput, check_choice

MESH_PATHS = ("models/model_normalized.obj", "model.obj")  # ShapeNetCore v2 and v1
DEEPSDF_BUFFER = 1.03  # radius of the unit sphere divided by the shape's radius
UNKNOWN_INSIDE_WARNING = (
    "warning: the file does not say what is inside: here it is what the wrap encloses; DeepSDF drops such shapes"
)


@dataclass(frozen=True)
class ShapeNet:
    """The shapes of a class of ShapeNetCore, each repaired to be a closed solid.

    A split without a list has a fifth of the training list; without that list, of the shapes that no list names.
    Training and validation repeat shapes if a prior takes more than exist. The test split does not.

    Args:
        path: the folder with the synsets' folders, with `ID/models/model_normalized.obj` (v2) or `ID/model.obj`.
        synset: a name of `SYNSETS`, or a number.
        split: a list of ids; see `read_lists`. None: all shapes are divided among the splits.
        normalised: "deepsdf", into the unit sphere, or "onet", into a cube of side 1.
        renders: a folder with `SYNSET/ID`, of DVR's data or of NMR's in DVR's form, for `task=single_view`.
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
        _ = self.files  # raises if something is missing
        if self.renders is not None and not (class_folder := Path(self.renders) / self.folder.name).is_dir():
            raise ValueError(f"dataset.renders: there is no folder '{class_folder}': give the one that has SYNSET/ID")

    @property
    def name(self) -> str:
        """The class, by its name if `SYNSETS` has one."""
        return f"shapenet_{NAMES.get(self.folder.name, self.folder.name)}"

    @property
    def folder(self) -> Path:
        return Path(self.path) / SYNSETS.get(self.synset, self.synset.zfill(8))

    def mesh(self, split: Split, index: int) -> Mesh:
        """A shape as a closed mesh; its `repairs` state its id, shapes that are missing on disk, and its repairs."""
        file = self._file(split, index)
        mesh, notes = _load(file, self.normalised), [f"the shape is {_id(file)}"]
        if missing := {*self.lists.get(split, ())}.difference(map(_id, self.files[split])):
            count = _counted(len(missing), "shape of the list is", "shapes of the list are")
            notes.append(f"warning: {count} not on disk, and left out, such as {min(missing)}")
        return replace(mesh, repairs=(*notes, *self._counts, *mesh.repairs))

    @property
    def _counts(self) -> Iterator[str]:
        """Notes on the numbers of shapes: on disk, in each split, in several lists, and of each release."""
        on_disk, counts = [*_shapes(self.folder).values()], {split: len({*self.files[split]}) for split in Split}
        listed = ", ".join(f"{count} {split}" for split, count in counts.items())
        used = len({*chain(*self.files.values())})
        yield f"{_counted(len(on_disk), 'shape', 'shapes')} on disk, {used} used: {listed}"
        if repeated := sum(map(len, self.lists.values())) - len({*chain(*self.lists.values())}):
            count = _counted(repeated, "shape is", "shapes are")
            yield f"warning: {count} in several lists, and only used in the last: train, validation, test"
        if 0 < (first := sum(file.parent.name != "models" for file in on_disk)) < len(on_disk):
            yield f"{_counted(len(on_disk) - first, 'shape is', 'shapes are')} of ShapeNetCore v2, and {first} of v1"

    def texture(self, split: Split, index: int) -> Texture:
        file = self._file(split, index)
        return FileColours(file, load_repaired(file), self.mesh(split, index))

    def shots(self, split: Split, index: int, longest: int) -> tuple[Shot, ...] | None:
        """A shape's images with cameras in its mesh's world, `longest` pixels per side at most; None without any."""
        if self.renders is None:
            return None
        folder = Path(self.renders) / self.folder.name / _id(self._file(split, index))
        return tuple(in_world(read_shot(frame, longest), np.eye(4)) for frame in find_layout(folder).frames)

    def _file(self, split: Split, index: int) -> Path:
        files = self.files[split]
        if not files or (index >= len(files) and split is Split.TEST):
            what = f"and none of number {index}: set a smaller index, unpack more shapes, or give another dataset.split"
            if split is not Split.TEST:
                what = "and a prior is trained on some: put their list beside dataset.split, unpack more shapes, "
                what += "or set prior=deepsdf prior.path=FOLDER"
            count = _counted(len(files), f"{split} shape", f"{split} shapes")
            raise BadInput(f"{self.name} has {count} in '{self.folder}', {what}")
        return files[index % len(files)]

    @cached_property
    def files(self) -> dict[Split, list[Path]]:
        """The files of each split that are on disk, in the order of its list.

        Raises:
            ValueError: the class or a list has no shapes.
        """
        by_id = _shapes(self.folder)
        listed = {split: [by_id[name] for name in names if name in by_id] for split, names in self.lists.items()}
        if listed and not any(listed.values()):
            names = [name for names in self.lists.values() for name in names]
            raise ValueError(
                f"dataset.split: none of its {len(names)} shapes is in '{self.folder}', such as {names[0]}: unpack "
                "them there, or give the split of the shapes that are"
            )
        rest = {*by_id.values()}.difference(*listed.values())
        files = split_files(listed.get(Split.TRAIN, sorted(rest))) | listed
        held_out = set[Path]()
        for split in (Split.TEST, Split.VALIDATION, Split.TRAIN):  # a shape of several lists is only in the first
            if {split, Split.TRAIN} & {*listed}:
                files[split] = [file for file in files[split] if file not in held_out]
            held_out |= {*files[split]}
        return files

    @cached_property
    def lists(self) -> dict[Split, list[str]]:
        return {} if self.split is None else read_lists(Path(self.split), self.folder.name, _shapes(self.folder))

    def identity(self) -> dict[str, Any]:
        """Plain data that determines the shapes: their paths, since the files of a ShapeNet release do not change."""
        names = {split: [str(file.relative_to(self.folder)) for file in files] for split, files in self.files.items()}
        shapes = hashlib.sha256(json.dumps(names).encode()).hexdigest()
        renders = {} if self.renders is None else {"renders": self.renders}
        return {"name": self.name, "version": VERSION, "shapes": shapes, "normalised": self.normalised} | renders


def _counted(count: int, singular: str, plural: str) -> str:
    return f"{count} {singular if count == 1 else plural}"


def _id(file: Path) -> str:
    return file.parts[-3 if file.parent.name == "models" else -2]


def _shapes(folder: Path) -> dict[str, Path]:
    """The file of each shape in a class's folder, by its id."""
    if files := [file for inner in MESH_PATHS for file in sorted(folder.glob(f"*/{inner}"))]:
        return {_id(file): file for file in reversed(files)}  # of two releases, the later one
    what = f"'{folder}' has no ID/{MESH_PATHS[0]} (v2) and no ID/{MESH_PATHS[1]} (v1)"
    for parent in (folder, folder.parent):
        what = what if parent.is_dir() else f"there is no folder '{parent}'"
    raise ValueError(f"dataset.path: {what}: give the folder of ShapeNetCore in which that of the synset is unpacked")


@lru_cache(maxsize=64)
def _load(path: Path, normalised: str) -> Mesh:
    """The repaired mesh of a file, normalised by the vertices of the unrepaired mesh."""
    points = read_mesh(path).used_vertices
    centre, factor = fit_in_sphere(points, 1 / DEEPSDF_BUFFER)
    if normalised == "onet":
        factor = 1 / float((points.max(axis=0) - points.min(axis=0)).max())
    mesh = load_repaired(path)
    sign = (UNKNOWN_INSIDE_WARNING,) if any(note.startswith(WRAPPED) for note in mesh.repairs) else ()
    return replace(mesh, vertices=(mesh.vertices - centre) * factor, repairs=(*sign, *mesh.repairs))
