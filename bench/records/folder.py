"""The folder of a run: named by hashes of what runs, locked by one process at a time, and never overwritten."""

import hashlib
import importlib.util
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from bench.config import OURS, Rerun, check, check_draw
from bench.records.record import NEUTRAL_KEYS, RunStatus, digest, file_lock, leads_out, link_out, read_record, to_json
from bench.tables import own_row
from datasets.extras import referenced_files, version

ROOT = Path(__file__).resolve().parents[2]
PASSIVE = (
    *("bench/report", "bench/studies"),
    *(f"bench/{name}.py" for name in ("judge", "merge", "photos", "prior", "progress", "suite", "trackers", "train")),
    *(f"bench/{name}.py" for name in ("tune", "turntable", "verify")),
    *(f"bench/run/{name}.py" for name in ("compose", "executors", "jobs", "library", "plan", "summary", "sweep")),
    *(f"bench/records/{name}.py" for name in ("format", "metrics", "names", "read")),
    *("bench/pictures/style.py", "bench/pictures/size_chart.py"),
)
NO_STRESS = "none"
FILE_KEYS = ("path", "image_path", "mask_path", "truth", "codes", "cloud")  # of files that a run reads
IN_FOLDERS = ("*", "ModelParameters/*", "LatentCodes/*")  # and of a folder those of DeepSDF
ARCHIVES = (".zip", ".tar", ".gz")  # which are left out of it: gigabytes that no run reads
FIELD = "field.safetensors"  # of a run's folder, which alone is read of it; see `datasets.field_files`
LIBRARIES = ("torch", "numpy", "scipy", "open3d", "pymeshlab", "trimesh", "scikit-image")
RESERVE = 64 * 1024  # bytes kept free, so that the record can still be written when the disk has become full
RESERVED = ".reserve"
DECIDING = NEUTRAL_KEYS - {"results_dir", "verbose", "rerun", "plan"}  # whether a run that failed would fail again


@dataclass(frozen=True)
class Identity:
    """The run that a configuration describes.

    Args:
        choices: names of the chosen YAMLs of task, renderer, dataset and method; a stress takes the dataset's place,
            and the method is empty where none is chosen.
        config: the resolved configuration, as plain data.
        overrides: of the command line.
    """

    choices: dict[str, str]
    config: dict[str, Any]
    overrides: list[str] = field(default_factory=list)

    @cached_property
    def config_hash(self) -> str:
        """Hash of the configuration without the keys that change no result; the order of keys does not matter.

        Packages change no result of a run that uses no class of the user's.
        """
        hashed = {key: value for key, value in self.config.items() if key not in NEUTRAL_KEYS}
        return digest(hashed if self._users else {**hashed, "packages": []})

    @property
    def name(self) -> str:
        """Name of the run's folder."""
        named = [choice.replace("/", "_") for choice in self.choices.values() if choice]  # of files in a nested folder
        return "-".join([*named, self.config_hash])

    @cached_property
    def _users(self) -> set[str]:
        """The user's packages of which the run uses a class."""
        return {target.split(".")[0] for target in _values(self.config, "_target_")} - {*OURS}

    @cached_property
    def code(self) -> str:
        """Hash of our code and the user's, of the versions of libraries, and of the files that `FILE_KEYS` name."""
        named = [str(package) for package in self.config.get("packages") or []] if self._users else []
        users = sorted({*named, *self._users} - {*OURS})  # a class of one may import another that is named
        dataset = self.config.get("dataset") or {}
        read = [path for key in FILE_KEYS for path in _values(self.config, key)]
        for split in map(Path, _values(dataset, "split")):  # a list of shapes, beside which are others
            read += sorted(map(str, split.parent.glob(f"*{split.suffix or split.name}")))
        files = [_content(Path(path)) for path in read]
        files += [_classes(str(dataset["path"]))] if "synset" in dataset else []
        return digest([_our_code(), *(_package(name) for name in users), *files])


def resolved(config: DictConfig, choices: Mapping[str, Any]) -> dict[str, Any]:
    """A composed configuration as plain data; missing values are kept, as an error of the run that its record reports.

    Args:
        config: without Hydra's own node.
        choices: the names of the chosen files and rows, by group.

    Raises:
        ValueError: where the command line removes a part that every run has, or sets a draw that nothing asks for.
    """
    check_draw(config)
    for part in ("task", "renderer", "dataset"):
        if part not in choices:
            raise ValueError(f"every run needs one {part}: remove ~{part} or a list; several are -m {part}=A,B")
    values: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=False)
    if isinstance(values.get("renderer"), dict):
        values["renderer"] = own_row(values["renderer"], str(choices["renderer"]))
    return values


def identify(values: dict[str, Any], choices: Mapping[str, Any], overrides: Sequence[str]) -> Identity:
    """The run that a configuration describes, as `resolved` gives it, after all checks of it that need no torch.

    Raises:
        ValueError: for an invalid value.
    """
    seen = choices["dataset"] if choices.get("stress", NO_STRESS) == NO_STRESS else choices["stress"]
    named = {"task": choices["task"], "renderer": choices["renderer"], "dataset": seen}
    named["method"] = choices.get("method") or ""
    check(values, overrides)
    return Identity({name: str(choice) for name, choice in named.items()}, values, list(overrides))


@contextmanager
def claimed(results_dir: Path, identity: Identity, rerun: Rerun) -> Iterator[tuple[Path, dict[str, Any] | None]]:
    """Locks the folder of a run, after waiting for any other process that holds it; gives it and the record to reuse.

    A finished run of the same code is kept, to be reused; any other run is moved to `results_dir/earlier`.

    Raises:
        OSError: where the results folder cannot be written.
        ValueError: where a link in it leads to another folder.
    """
    folder = results_dir / "runs" / identity.name
    for path in (folder, results_dir / "earlier", results_dir / ".locks" / identity.name):
        if leads_out(path, results_dir):
            raise ValueError(f"{path} is a link out of the results folder: remove it, or set results_dir to another")
    if link := link_out(folder, results_dir):
        raise ValueError(f"{folder / link} is a link out of the results folder: remove that folder")
    with file_lock(results_dir, identity.name):
        record = reusable(folder, identity, rerun)
        if record is None:
            set_aside(folder, results_dir / "earlier")
            folder.mkdir(parents=True)
            _reserve(folder)
        try:
            yield folder, record
        finally:
            release(folder)


def reusable(folder: Path, identity: Identity, rerun: Rerun) -> dict[str, Any] | None:
    """The record of a finished run of the same configuration and code, unless it is to be run again."""
    if rerun == Rerun.all:
        return None
    try:
        record = read_record(folder)
        status = RunStatus(record["status"])
    except (OSError, ValueError, RecursionError):
        return None
    same = (record.get("config_hash"), record.get("code")) == (identity.config_hash, identity.code)
    if not same or not record.get("ended") or status == RunStatus.KILLED:
        return None
    if status != RunStatus.OK:
        # Settings that change no result, such as a limit, can still decide whether a run fails.
        limits = [{key: config.get(key) for key in DECIDING} for config in (record["config"], identity.config)]
        return record if rerun == Rerun.none and limits[0] == limits[1] else None
    return record


def set_aside(folder: Path, earlier: Path) -> None:
    """Moves a folder, if it exists, to `earlier`, where a hash of its content is added to its name."""
    if folder.exists():
        place = earlier / f"{folder.name}-{content_of(folder)}"
        earlier.mkdir(exist_ok=True)
        if place.exists():  # the same run was set aside before
            shutil.rmtree(folder)
        else:
            folder.rename(place)


def put_into(place: Path, folder: Path) -> None:
    """Copies a folder to a place atomically; does nothing where the place exists already."""
    if place.exists():
        return
    place.parent.mkdir(parents=True, exist_ok=True)
    scratch = place.with_name(f".{place.name}.{os.getpid()}")
    shutil.copytree(folder, scratch)
    scratch.rename(place)


def content_of(folder: Path) -> str:
    """A hash of a run folder's files, without the fields `asked` and `reused` of its record."""
    whole = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        content = path.read_bytes()
        if path.name == "record.json":
            content = _without_requests(content)
        whole.update(path.relative_to(folder).as_posix().encode() + b"\0" + hashlib.sha256(content).digest())
    return whole.hexdigest()[:12]


def _without_requests(content: bytes) -> bytes:
    """A record without the fields that a later request of the same run changes."""
    try:
        record = json.loads(content)
        return to_json({key: value for key, value in record.items() if key not in ("asked", "reused")}).encode()
    except (ValueError, AttributeError, RecursionError):  # a damaged record is hashed unchanged
        return content


def release(folder: Path) -> None:
    """Frees the reserved bytes, before the last write."""
    (folder / RESERVED).unlink(missing_ok=True)


def _reserve(folder: Path) -> None:
    with suppress(OSError), (folder / RESERVED).open("wb") as file:  # on a full disk, writing the record will fail
        file.write(os.urandom(RESERVE))
        os.fsync(file.fileno())


@lru_cache(maxsize=1)
def _our_code() -> str:
    files = [path for package in OURS for path in sorted((ROOT / package).rglob("*.py"))]
    acting = [path for path in files if not path.relative_to(ROOT).as_posix().startswith(PASSIVE)]
    shipped = sorted((ROOT / "datasets" / "priors").glob("*.safetensors"))
    return digest([*map(_content, [*acting, *shipped]), *(version(library) for library in LIBRARIES)])


@lru_cache
def _package(name: str) -> str:
    """Hash of a user's package or module; empty where there is none, which the run reports as an error."""
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return ""
    if spec is None:
        return ""
    if spec.submodule_search_locations is not None:
        files = [path for folder in spec.submodule_search_locations for path in sorted(Path(folder).rglob("*.py"))]
    else:  # a module, with those in the same folder, which it may import
        files = sorted(Path(spec.origin or "").parent.glob("*.py"))
    return digest([_content(path) for path in files])


def _content(path: Path) -> str:
    """Hash of a file's name, bytes and the files it names, of a run's field, or a folder; empty where there is none."""
    try:
        if (path / FIELD).is_file():
            return _content(path / FIELD)
        if path.is_dir():
            found = [child for part in IN_FOLDERS for child in sorted(path.glob(part)) if child.is_file()]
            return digest([_content(child) for child in found if child.suffix not in ARCHIVES])
        own = [path.name, hashlib.sha256(path.read_bytes()).hexdigest()]
        return digest([*own, *map(_content, referenced_files(path))])
    except OSError:
        return ""


@lru_cache
def _classes(path: str) -> str:
    """Hash of how many shapes each class of a folder has: whether more of ShapeNet was unpacked."""
    return digest([f"{folder.name} {len([*folder.iterdir()])}" for folder in sorted(Path(path).glob("*/"))])


def _values(node: Any, name: str) -> list[str]:
    if not isinstance(node, dict):
        return []
    found = [node[name]] if isinstance(node.get(name), str) else []
    return found + [value for child in node.values() for value in _values(child, name)]
