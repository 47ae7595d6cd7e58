"""The folder of a run: named by hashes, locked by one process at a time, and never overwritten."""

import hashlib
import importlib.util
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from bench.config import AUTO, OUR_PACKAGES, PRIOR_FIELD, Rerun, check, check_references
from bench.records.imports import ROOT, imported_files
from bench.records.record import NEUTRAL_KEYS, RunStatus, bad_link, digest, file_lock, is_outside, read_record, to_json
from bench.records.results import PlannedRun
from bench.tables import CONF, extensions, without_row_keys
from datasets.extras import referenced_files, version

NO_STRESS = "none"
# Keys whose values are files or folders.
INPUT_FILE_KEYS = ("path", "image_path", "mask_path", "images", "truth", "codes", "cloud")
# A run with such a key loads a choice by its name: the module and the files in conf of all such choices are hashed too.
LOADED_BY_NAME = {
    ("task", "beside"): ("renderers", ("renderer/*.yaml", "variants.yaml")),
    ("prior", "of"): ("datasets.families", ("dataset/*.yaml", "shapes.yaml")),
}
ARCHIVE_SUFFIXES = (".zip", ".tar", ".gz")  # not hashed: gigabytes that no run reads
FIELD_FILE = "field.safetensors"  # the only file of a run folder that another run reads
HASHED_LIBRARIES = ("torch", "numpy", "scipy", "open3d", "pymeshlab", "trimesh", "scikit-image")
RESERVED_BYTES = 64 * 1024  # occupied until the last write, so that a disk that fills up has room for the record
RESERVE_FILE = ".reserve"
# Keys that do not change a result, such as a limit. They can decide whether a failed run fails again.
LIMIT_KEYS = NEUTRAL_KEYS - {"results_dir", "verbose", "rerun", "plan", "tracker"}


def config_hash(config: Mapping[str, Any]) -> str:
    """Hash of a resolved configuration without the keys that change no result; the order of keys does not matter.

    `packages` is left out if the run uses no class of the user.
    """
    hashed = {key: value for key, value in config.items() if key not in NEUTRAL_KEYS}
    return digest(hashed if _user_packages(config) else {**hashed, "packages": []})


def code_hash(config: Mapping[str, Any]) -> str:
    """Hash of the modules that the run imports, the user's packages, libraries, shipped priors and input files."""
    used_packages = _user_packages(config)
    listed = [str(package) for package in config.get("packages") or []] if used_packages else []
    packages = sorted({*listed, *used_packages} - {*OUR_PACKAGES})  # a class may import a listed package
    dataset = config.get("dataset") or {}
    shapenet = dataset["path"] if "synset" in dataset else None  # thousands of folders: only counted
    inputs = [
        (path, key in ("path", "images") and path != shapenet)
        for key in INPUT_FILE_KEYS
        for path in _values_of_key(config, key)
    ]
    for split in map(Path, _values_of_key(dataset, "split")):  # a list of shapes, with others in the same folder
        inputs += [(str(path), False) for path in sorted(split.parent.glob(f"*{split.suffix or split.name}"))]
    files = [_file_hash(Path(path), deep=is_deep) for path, is_deep in inputs]
    files += [_class_counts_hash(str(dataset.get(key))) for key in ("path", "renders") if "synset" in dataset]
    hashed = {key: value for key, value in config.items() if key not in NEUTRAL_KEYS}
    targets = {*_values_of_key(hashed, "_target_")}
    by_name = [entry for (group, key), entry in LOADED_BY_NAME.items() if (hashed.get(group) or {}).get(key)]
    targets |= {module for module, _ in by_name}
    files += [_file_hash(path) for _, patterns in by_name for each in patterns for path in sorted(CONF.glob(each))]
    targets |= {extensions()[purpose] for purpose in _used_extensions(hashed)}
    code = _our_code_hash(frozenset(targets), bool(packages))
    return digest([code, *(_package_hash(name) for name in packages), *files])


def _used_extensions(config: Mapping[str, Any]) -> Iterator[str]:
    """The purposes of the classes and functions of conf/extensions.yaml that a run uses."""
    yield "pictures"
    if AUTO in (config.get("renderer") or {}).values():
        yield "auto"
    if (config.get("prior") or {}).get("colour"):
        yield from ("colour_codes", "evaluate_colours")
    if (config.get("task") or {}).get("colour_weight"):
        yield "colours"
    if config.get("field", PRIOR_FIELD) != PRIOR_FIELD:
        yield "fit"


def _user_packages(config: Mapping[str, Any]) -> set[str]:
    """The packages of the user whose classes a run uses."""
    return {target.split(".")[0] for target in _values_of_key(config, "_target_")} - {*OUR_PACKAGES}


def resolve_config(config: DictConfig, choices: Mapping[str, Any]) -> dict[str, Any]:
    """A composed configuration as plain data. Missing values are kept; the check of its objects reports them.

    Args:
        config: a configuration without Hydra's node.
        choices: the names of the chosen files and rows, by group.

    Raises:
        ValueError: if the command line removes a group that every run needs; see also `check_references`.
    """
    check_references(config)
    for group in ("task", "renderer", "dataset"):
        if group not in choices:
            raise ValueError(f"every run needs one {group}: remove ~{group} or a list; several are -m {group}=A,B")
    values: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=False)
    if isinstance(values.get("renderer"), dict):
        values["renderer"] = without_row_keys(values["renderer"], str(choices["renderer"]))
    return values


def planned_run(values: dict[str, Any], choices: Mapping[str, Any], overrides: Sequence[str]) -> PlannedRun:
    """The run of a resolved configuration, after all checks that need no torch.

    Its id has the names of its choices, the number of the shape, a seed other than 0, and `task.points`. With a stress,
    it has the stress's name instead of the dataset's.

    Raises:
        ValueError: if a value is invalid.
    """
    check(values, overrides)
    scene_group = "dataset" if choices.get("stress", NO_STRESS) == NO_STRESS else "stress"
    names = {"task": choices["task"], "renderer": choices["renderer"], "dataset": choices[scene_group]}
    names = {key: str(name) for key, name in (names | {"method": choices.get("method") or ""}).items()}
    parts = [name.replace("/", "_") for name in names.values() if name]  # some are NAME/NAME
    points = (values["task"] or {}).get("points")
    numbers = {"": values.get("index"), "seed": values["seed"] or None, "points": points}
    details = [f"{word}{number}" for word, number in numbers.items() if isinstance(number, int | str)]
    folder = "-".join([*parts, *details, config_hash(values)])
    return PlannedRun(folder, [*overrides], seed=values["seed"], config=values, **names)


@contextmanager
def locked_folder(run: PlannedRun) -> Iterator[dict[str, Any] | None]:
    """Waits for the lock of a run's folder; yields the record to reuse, or None and makes an empty folder.

    A finished run of the same code is kept to be reused. Any other run is moved to `results_dir/earlier`.

    Raises:
        OSError: if the results folder cannot be written.
        ValueError: if a link in it leads out of it.
    """
    folder, results_dir = run.folder, Path(run.config["results_dir"])
    for path in (folder, results_dir / "earlier", results_dir / ".locks" / run.id):
        if is_outside(path, results_dir):
            raise ValueError(f"{path} is a link out of the results folder: remove it, or set results_dir to another")
    if link := bad_link(folder, results_dir):
        raise ValueError(f"{folder / link} is a link out of the results folder: remove that folder")
    with file_lock(results_dir, run.id):
        record = reusable_record(run)
        if record is None:
            archive_run(folder, results_dir / "earlier")
            folder.mkdir(parents=True)
            _reserve_bytes(folder)
        try:
            yield record
        finally:
            free_reserve(folder)


def reusable_record(run: PlannedRun) -> dict[str, Any] | None:
    """The record of a finished run of the same configuration and code; None if it must be run."""
    rerun = run.config["rerun"]
    if rerun == Rerun.all:
        return None
    try:
        record = read_record(run.folder)
    except (OSError, ValueError, RecursionError):
        return None
    if not record.get("ended") or record["status"] == RunStatus.KILLED:
        return None
    if (record.get("config_hash"), record.get("code")) != (config_hash(run.config), code_hash(run.config)):
        return None
    if record["status"] != RunStatus.OK:
        limits = [{key: config.get(key) for key in LIMIT_KEYS} for config in (record["config"], run.config)]
        return record if rerun == Rerun.none and limits[0] == limits[1] else None
    return record


def archive_run(folder: Path, earlier: Path) -> None:
    """Moves a folder, if it exists, to `earlier`, and adds a hash of its content to its name."""
    if folder.exists():
        target = earlier / f"{folder.name}-{content_hash(folder)}"
        earlier.mkdir(exist_ok=True)
        if target.exists():  # the same run was archived before
            shutil.rmtree(folder)
        else:
            folder.rename(target)


def content_hash(folder: Path) -> str:
    """Hash of a run folder's files, without the fields `asked` and `reused` of its record."""
    total_hash = hashlib.sha256()
    for path in sorted(file for file in folder.rglob("*") if file.is_file() and file.name != RESERVE_FILE):
        content = path.read_bytes()
        if path.name == "record.json":
            content = _without_requests(content)
        total_hash.update(path.relative_to(folder).as_posix().encode() + b"\0" + hashlib.sha256(content).digest())
    return total_hash.hexdigest()[:12]


def _without_requests(content: bytes) -> bytes:
    """The JSON of a record without the fields that a later request of the same run changes."""
    try:
        record = json.loads(content)
        return to_json({key: value for key, value in record.items() if key not in ("asked", "reused")}).encode()
    except (ValueError, AttributeError, RecursionError):  # a damaged record is hashed unchanged
        return content


def free_reserve(folder: Path) -> None:
    (folder / RESERVE_FILE).unlink(missing_ok=True)


def _reserve_bytes(folder: Path) -> None:
    with suppress(OSError), (folder / RESERVE_FILE).open("wb") as file:  # on a full disk, writing the record will fail
        file.write(os.urandom(RESERVED_BYTES))
        os.fsync(file.fileno())


@lru_cache
def _our_code_hash(targets: frozenset[str], has_user_code: bool) -> str:
    """Hash of the code that a run imports, of shipped priors and library versions; user code may import any of ours."""
    every_file = sorted(
        path for package in OUR_PACKAGES for path in (ROOT / package).rglob("*") if path.suffix in (".py", ".cpp")
    )
    files = every_file if has_user_code else imported_files(targets)
    shipped = sorted((ROOT / "datasets" / "priors").glob("*.safetensors"))
    return digest([*map(_file_hash, [*files, *shipped]), *(version(library) for library in HASHED_LIBRARIES)])


@lru_cache
def _package_hash(name: str) -> str:
    """Hash of a user's package or module; empty if it does not exist, which the run reports as an error."""
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return ""
    if spec is None:
        return ""
    if spec.submodule_search_locations is not None:
        files = [path for folder in spec.submodule_search_locations for path in sorted(Path(folder).rglob("*.py"))]
    else:  # a module, with the modules of its folder, which it may import
        files = sorted(Path(spec.origin or "").parent.glob("*.py"))
    return digest([_file_hash(path) for path in files])


def _file_hash(path: Path, *, deep: bool = False) -> str:
    """Hash of a file with the files that it names, of a run's field, or of a folder; empty if it does not exist.

    Args:
        deep: whether the hash of a folder is of all files below it, not only of the files directly in it.
    """
    try:
        if (path / FIELD_FILE).is_file():
            return _file_hash(path / FIELD_FILE)
        if path.is_dir():
            children = sorted(path.rglob("*") if deep else path.glob("*"))
            files = [child for child in children if child.is_file() and child.suffix not in ARCHIVE_SUFFIXES]
            return digest([[child.relative_to(path).as_posix(), _file_hash(child)] for child in files])
        status = path.stat()
        bytes_hash = _bytes_hash(path, status.st_size, status.st_mtime_ns)
        return digest([path.name, bytes_hash, *map(_file_hash, referenced_files(path))])
    except OSError:
        return ""


@cache
def _bytes_hash(path: Path, size: int, changed: int) -> str:
    """Hash of a file's content. The runs of a sweep share files, which are read once, unless they change."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


@lru_cache
def _class_counts_hash(path: str) -> str:
    """Hash of the number of shapes per class in a ShapeNet folder, which changes when more is unpacked."""
    return digest([f"{folder.name} {len([*folder.iterdir()])}" for folder in sorted(Path(path).glob("*/"))])


def _values_of_key(node: Any, name: str) -> list[str]:
    if not isinstance(node, dict):
        return []
    values = [node[name]] if isinstance(node.get(name), str) else []
    return values + [value for child in node.values() for value in _values_of_key(child, name)]
