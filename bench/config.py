"""The typed top level of a run's configuration, the one place where a YAML node becomes an object, and hints on names.

A file of the group `renderer` may have two keys that are no arguments: `_rows_` maps an experiment to the place of the
renderer's row in its table, and `_label_` names the row. A file without `_rows_` has a row in every such experiment,
after the others. An experiment sweeps over `renderer: ${rows:EXPERIMENT}`. The files are those of conf/renderer and of
the user's `--config-dir`.

A file of `conf/method/space` declares what may be tuned of a method: `${drawn:DIMENSION,LEAST,MOST}` is the value, in
that dimension, of the Sobol point whose number is `draw`.
"""

import dataclasses
import importlib.util
import re
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, make_dataclass
from difflib import get_close_matches
from enum import StrEnum
from functools import cache
from math import inf
from pathlib import Path
from typing import Any, cast, get_args, get_origin, get_type_hints

import numpy as np
from hydra.core.config_store import ConfigStore
from hydra.utils import get_class
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from datasets.dataset import Split

CONF = Path(__file__).resolve().parent.parent / "conf"
LEAST = {
    "seed": 0,
    "index": 0,
    "draw": 0,
    "threads": 1,
    "evaluation.grid": 8,
    "evaluation.points": 1,
    "evaluation.picture": 4,
    "evaluation.every": 1,
}
DOUBLING = "doubling"
SELF = "_self_"  # of a list of defaults: the file itself
LABEL, ROWS = "_label_", "_rows_"  # of a renderer: its name in tables; the place of its row by experiment
RESERVED = ("_target_", "_package_", LABEL, ROWS)  # of a node; its other keys are arguments
OURS = ("renderers", "datasets", "bench")
DRAWS, DIMENSIONS = 64, 8  # of the Sobol points that search spaces are drawn from; more than spaces need
MANY = 20  # names, beyond which a message leaves variants out
KEY = re.compile(r"\w+(\.\w+)+")  # a dotted key and nothing else
STRATEGIES = {  # of the group `strategy`, whose files are files of `renderer` now
    "aggressive": "dist_aggressive",
    "capped": "dist_capped",
    "coarse_to_fine": "dist_coarse_to_fine",
    "coarse_to_fine_100": "dist_coarse_to_fine_100",
    "dist": "dist",
    "dvr": "dvr_64",
    "dvr_128": "dvr",
    "dvr_official_slope": "dvr_official_slope",
    "dynamic": "dist_dynamic",
    "idr": "idr",
    "naive": "naive_serial",
    "official_clamp": "dist_official_clamp",
    "parallel": "naive_practical_parallel",
    "practical_gradient": "naive_practical",
    "slope_bound": "dist_slope_bound",
    "step_back": "dist_step_back",
    "step_floor": "dist_step_floor",
    "unrolled_parallel": "naive_parallel",
}
SETTINGS = (  # of the group `setting`, likewise; these keep their names
    *("dist", "dist_alpha_1", "dist_alpha_1_2", "dist_alpha_2", "dist_epsilon_5e3", "dist_epsilon_5e4", "dist_k_3"),
    *("dist_one_level", "dist_steps_10", "dist_steps_20", "idr", "idr_epsilon_5e3", "idr_steps_20", "naive"),
    "naive_steps_20",
)
K_OR_N = "renderer.n_gradient_samples (K, of dist and naive) or renderer.n_ray_samples (n, of dvr)"
SIZES = "sizes.smoke, sizes.desk or sizes.paper, which +experiment=NAME has"
RENAMED = {  # what users typed before, a choice as GROUP/NAME or a key, and what to type now
    **{f"strategy/{name}": f"renderer={renderer}" for name, renderer in STRATEGIES.items()},
    "strategy": "renderer=NAME",
    **{f"setting/{name}": f"renderer={name}" for name in SETTINGS},
    "setting/dvr": "renderer=dvr_early_stop",
    **{f"setting/dvr_{n}": f"renderer=dvr_fixed_{n}" for n in (16, 32, 64, 128)},
    "setting/dist_half": "+method=dist_half",
    "setting": "renderer=NAME",
    "trial/completion": "+experiment=speed_completion",
    "trial/rendering": "+experiment=speed_rendering",
    "trial": "+experiment=speed_completion or +experiment=speed_rendering",
    **{f"condition/focal_{name}": f"task.focal={int(name) / 100:g}" for name in ("050", "075", "105")},
    **{f"condition/start_{name}": f"task.start_scale={int(name) / 100:g}" for name in ("000", "050", "200")},
    "condition": "task.focal=1 task.start_scale=1",
    "common": "+experiment=fitted",
    "experiment/speed_accuracy": "+experiment=speed_completion or +experiment=speed_rendering",
    "experiment/fig10": "+experiment=fig10_focal or +experiment=fig10_start",
    "renderer.samples": K_OR_N,
    "task.samples": "renderer.n_gradient_samples",
    **{f"task.{name}": f"task.optimiser.{name}" for name in ("iterations", "learning_rate", "schedule")},
    **{f"task.code_{name}": f"task.code.{name}" for name in ("weight", "average")},
    "ladder.rungs": "models.candidates",
    "ladder": "models",
    **{f"ladder.{name}": f"models.{name}" for name in ("fit", "growth", "views")},
    "task.stress.among": "task.stress.setting alone",
    **{f"scale.{name}": SIZES for name in ("table2", "table3", "fig6", "fig10", "speed_accuracy")},
    **{f"scale.{name}": SIZES for name in ("stability.stresses", "capacity.resolution", "capacity.scenes")},
}


class Device(StrEnum):
    """Where tensors live; auto takes a GPU if there is one."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


class Isolation(StrEnum):
    """Where a run takes place: in a process of its own, or for debugging in that of the command, without limits."""

    process = "process"
    off = "off"


class Rerun(StrEnum):
    """Which finished runs are run again; one that was killed always is."""

    none = "none"
    failed = "failed"
    all = "all"


@dataclass
class EvaluationSettings:
    """How a result is judged; see conf/config.yaml."""

    grid: int = MISSING
    points: int = MISSING
    fscore_threshold: float = MISSING
    picture: int | None = MISSING
    every: int | str | None = MISSING
    film: str | None = MISSING

    def checkpoints(self, iterations: int) -> set[int]:
        """The iterations, counted from 0, before which the current state is evaluated: with the first also the last."""
        if self.every is None:
            return set()
        last = iterations - 1
        if self.every == DOUBLING:
            return {0, last} | {2**power for power in range(last.bit_length()) if 2**power < last}
        return {*range(0, last, int(self.every)), last}


@dataclass
class Config:
    """The top level of conf/config.yaml. Nodes of type Any are built by `build` from their `_target_`."""

    task: Any = MISSING
    renderer: Any = MISSING
    dataset: Any = MISSING
    stress: Any = MISSING
    silhouette: Any = MISSING
    prior: Any = MISSING
    scale: Any = MISSING
    tracker: Any = MISSING
    view: Any = MISSING
    auto: Any = MISSING
    models: Any = MISSING
    field: str = MISSING
    evaluation: EvaluationSettings = dataclasses.field(default_factory=EvaluationSettings)
    split: str = MISSING
    index: int = MISSING
    seed: int = MISSING
    label: str | None = MISSING
    experiment: str | None = MISSING
    draw: int | None = MISSING
    sizes: Any = MISSING
    device: Device = MISSING
    threads: int | None = MISSING
    results_dir: str = MISSING
    priors_dir: str = MISSING
    packages: list[str] = MISSING
    isolation: Isolation = MISSING
    time_limit: float | None = MISSING
    memory_limit: float | None = MISSING
    rerun: Rerun = MISSING
    verbose: bool = MISSING


def register() -> None:
    """Makes the schema known to Hydra, under the name that conf/config.yaml uses, and what its values may ask for."""
    ConfigStore.instance().store(name="schema", node=Config)
    OmegaConf.register_new_resolver("rows", _rows, replace=True)
    OmegaConf.register_new_resolver("drawn", _drawn, replace=True)
    OmegaConf.register_new_resolver("package_of", lambda path: path.split(".")[0], replace=True)
    OmegaConf.register_new_resolver("class_of", lambda path: path.split(".")[-1], replace=True)


def check_names(config: DictConfig) -> None:
    """Raises ValueError for a key of the top level that there is not, and for a choice that nothing reads."""
    names = [item.name for item in fields(Config)]
    for key in map(str, config):
        if key not in names:
            what = f"{key}/{config[key]}" if isinstance(config[key], str) else key
            raise ValueError(f"unknown key {key!r}{renamed(what) or nearest(key, names)}")
    loss, task = config.get("silhouette") or {}, config.get("task") or {}
    if not str(loss.get("_target_", ".Own")).endswith(".Own") and "silhouette" not in {*task, *task.get("fit", {})}:
        raise ValueError("silhouette is read by task=completion, pose, capacity and stability alone: leave it out")


def check_top_level(config: DictConfig) -> None:
    """Raises ValueError for a value of the top level that no part checks by itself."""
    if config.split not in list(Split):
        raise ValueError(f"split must be one of {', '.join(Split)}, not {config.split!r}")
    if not config.evaluation.fscore_threshold > 0:
        raise ValueError(f"evaluation.fscore_threshold must be positive, not {config.evaluation.fscore_threshold}")
    if isinstance(config.evaluation.every, str) and config.evaluation.every != DOUBLING:
        raise ValueError(f"evaluation.every must be {DOUBLING}, a number or null, not {config.evaluation.every!r}")
    if config.evaluation.film not in (None, "gif", "webp"):
        raise ValueError(f"evaluation.film must be gif, webp or null, not {config.evaluation.film!r}")
    if config.stress is not None and "stress" not in config.task:
        raise ValueError("stress is read by task=stability alone: leave it out, or set task=stability")
    if config.evaluation.film is not None and config.evaluation.picture is None:
        raise ValueError("evaluation.film needs pictures: set evaluation.picture=256")
    for name, least in LEAST.items():
        value = OmegaConf.select(config, name)
        if isinstance(value, int) and value < least:
            raise ValueError(f"{name} must be at least {least}, not {value}: set {name}={least} or more")


def build(node: DictConfig, name: str, packages: tuple[str, ...] | list[str] = (), target: str = "") -> Any:
    """The object that a YAML node describes: its `_target_`, or `target`, with its other keys as arguments.

    Args:
        node: the node. Its key `_package_` names one more package that its `_target_` may name.
        name: what it is called in the configuration, for errors.
        packages: packages of the user's that a `_target_` may name, beside ours.
        target: the class of a node that has no `_target_`.

    Raises:
        ValueError: for an unknown package, class, key or a value of the wrong type.
    """
    if OmegaConf.is_missing(node, "_target_"):
        raise ValueError(f"{name}._target_ must be given: set {name}._target_=PACKAGE.CLASS")
    path = node.get("_target_", target)
    if path.split(".")[0] not in (*OURS, *packages, node.get("_package_")):
        raise ValueError(f"{name}._target_ names {path!r}: add its package by packages=[{path.split('.')[0]}]")
    try:
        cls = get_class(path)
    except Exception as error:
        raise ValueError(f"{name}._target_ names {path!r}, which cannot be imported: {error}") from error
    for key in node:
        if OmegaConf.is_missing(node, key):
            raise ValueError(f"{name}.{key} must be given: set {name}.{key}=...")
    arguments = {str(key): node[key] for key in node if key not in RESERVED}
    if not is_dataclass(cls):
        return cls(**arguments)
    names = [f.name for f in fields(cls)]
    for key in arguments:
        if key not in names:
            new = renamed(f"{name}.{key}", [f"{name}.{known}" for known in names])
            raise ValueError(f"{name} has no key {key!r}{new or nearest(str(key), names)}")
    return _typed(cls, arguments, name, packages)


def load(group: str, name: str, **arguments: Any) -> Any:
    """The object of conf/GROUP/NAME.yaml, for use as a library: `load("renderer", "dist", steps=100)`.

    Raises:
        ValueError: for an unknown group or name, an unknown key or a value of the wrong type.
    """
    path = CONF / group / f"{name}.yaml"
    if not path.is_file():
        known = [file.stem for file in (CONF / group).glob("*.yaml")]
        raise ValueError(f"unknown {group} {name!r}{nearest(name, known)}")
    package = {"_package_": arguments.get("_target_", "").split(".")[0]}  # who names a class in Python trusts it
    return build(OmegaConf.merge(_with_defaults(path), arguments, package), group)  # type: ignore[arg-type]


def own_row(renderer: dict[str, Any], choice: str, runtime: DictConfig) -> dict[str, Any]:
    """A resolved `renderer` node without `_rows_`, and without a `_label_` inherited from a file that it builds on.

    Args:
        renderer: the node.
        choice: the name of its file.
        runtime: `hydra.runtime`, which has the folders of configurations.
    """
    path = _renderers(runtime).get(choice)
    file = OmegaConf.create() if path is None else _loaded(path)
    inherits = "defaults" in file and LABEL not in file
    dropped = {ROWS, LABEL} if inherits else {ROWS}
    return {key: value for key, value in renderer.items() if key not in dropped}


def renderers_of(experiment: str, runtime: DictConfig) -> list[str]:
    """The renderers that have a row in an experiment, in the order of their places, then by name."""
    places = {}
    for name, path in _renderers(runtime).items():
        file = _loaded(path)
        place = file.get(ROWS, {experiment: inf}).get(experiment)
        if place is not None and not OmegaConf.is_missing(file, "_target_"):  # custom: its class is on the command line
            places[name] = place
    return sorted(places, key=lambda name: (places[name], name))


def _with_defaults(path: Path) -> DictConfig:
    """What a YAML holds, over the files of its own group that its `defaults` name, in their order, as Hydra has it."""
    node = cast(DictConfig, OmegaConf.load(path))
    bases = [str(base) for base in node.pop("defaults", [])]
    order = bases if SELF in bases else [SELF, *bases]
    parts = [node if base == SELF else _with_defaults(path.with_name(f"{base}.yaml")) for base in order]
    return cast(DictConfig, OmegaConf.merge(*parts))


def _typed(cls: type, arguments: dict, name: str, packages: tuple[str, ...] | list[str]) -> Any:
    """An instance whose arguments were converted to the field types, or a ValueError that names the field."""
    types = get_type_hints(cls)
    protocols = [key for key in arguments if getattr(types[key], "_is_protocol", False)]
    for key in protocols:
        if not OmegaConf.is_dict(arguments[key]):
            raise ValueError(
                f"{name}.{key} must have a _target_, not be {arguments[key]!r}: write {key}=NAME, without {name}"
            )
    nested = {key: _node_class(types[key]) for key, value in arguments.items() if OmegaConf.is_dict(value)}
    nested = {key: found for key, found in nested.items() if found or key in protocols}
    given = {key: value for key, value in arguments.items() if key not in nested}
    schema = OmegaConf.structured(make_dataclass(cls.__name__, [(key, types[key]) for key in given]))
    try:
        flat = OmegaConf.merge(schema, given)
    except OmegaConfBaseException as error:
        wanted = _type_name(types.get(str(error.full_key).split(".")[0], ""))
        raise ValueError(f"{name}.{error.full_key}: {str(error).splitlines()[0]} (expected {wanted})") from None
    values: Any = OmegaConf.to_container(flat)
    values |= {key: tuple(value) for key, value in values.items() if get_origin(types[key]) is tuple}
    values |= {
        key: build(arguments[key], f"{name}.{key}", packages, target=_path(found) if found else "")
        for key, found in nested.items()
    }
    for item in fields(cls):
        if (
            item.name not in values
            and item.default is dataclasses.MISSING
            and item.default_factory is dataclasses.MISSING
        ):
            raise ValueError(f"{name}.{item.name} must be given: set {name}.{item.name}=...")
    try:
        return cls(**values)
    except ValueError as error:  # a class within another does not know where it stands
        raise error if "." not in name or name in str(error) else ValueError(f"{name}: {error}") from error


def _node_class(wanted: Any) -> type | None:
    """The dataclass that a field's type asks for, alone or beside None; None where it asks for no dataclass."""
    return next((cls for cls in (wanted, *get_args(wanted)) if isinstance(cls, type) and is_dataclass(cls)), None)


def _path(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"


def _type_name(wanted: Any) -> str:
    return getattr(wanted, "__name__", None) if isinstance(wanted, type) else str(wanted).replace("typing.", "")


def _rows(experiment: str, *, _root_: DictConfig) -> str:
    runtime = _root_.hydra.runtime
    if runtime.choices.get("method") is not None:  # a method sets its renderer
        return runtime.choices["renderer"]
    return ",".join(renderers_of(experiment, runtime))


def _drawn(dimension: int, least: float, most: float, *, _root_: DictConfig) -> float | int:
    """The value of draw `_root_.draw` in a range, even in its logarithm; a whole number for whole ends, else 3 digits.

    Raises:
        ValueError: without a draw, beyond the last one, or for a range or dimension that there is not.
    """
    draw = _root_.draw
    if draw is None or not 0 <= draw < DRAWS:
        raise ValueError(f"a method of method/space needs draw=0 to draw={DRAWS - 1}, found {draw}")
    if not (0 < least < most and 0 <= dimension < DIMENSIONS):
        raise ValueError(
            f"${{drawn:{dimension},{least},{most}}} must have a dimension from 0 to {DIMENSIONS - 1} and ends above 0"
        )
    value = least * (most / least) ** float(sobol_points()[draw, dimension])
    return round(value) if isinstance(least, int) and isinstance(most, int) else float(f"{value:.3g}")


@cache
def sobol_points() -> np.ndarray:
    """The points [DRAWS, DIMENSIONS] of a scrambled Sobol sequence in the unit cube, the same for every method."""
    from scipy.stats import qmc  # only here: it takes a second

    return qmc.Sobol(DIMENSIONS, scramble=True, rng=0).random(DRAWS)


def _renderers(runtime: DictConfig) -> dict[str, Path]:
    """The files of the group `renderer` by name; of two with the same name, the one that Hydra takes."""
    paths: dict[str, Path] = {}
    for folder in _folders(runtime):
        for path in sorted((folder / "renderer").glob("*.yaml")):
            paths.setdefault(path.stem, path)
    return paths


def _loaded(path: Path) -> DictConfig:
    """The content of a file, without the files that it builds on."""
    node = OmegaConf.load(path)
    if not isinstance(node, DictConfig):
        raise ValueError(f"{path} must hold keys and values: see conf/renderer/dist.yaml")
    return node


def _folders(runtime: DictConfig) -> Iterator[Path]:
    """The folders of configurations, in the order in which Hydra searches them."""
    for source in runtime.config_sources:
        if source.schema == "file":
            yield Path(source.path)
        elif source.schema == "pkg" and (found := importlib.util.find_spec(source.path.replace("/", "."))):
            yield from map(Path, found.submodule_search_locations or [])


def renamed(name: str, known: list[str] | None = None) -> str:
    """A hint at the end of an error message: the new name of a choice GROUP/NAME or of a key; empty for others.

    With the dotted keys that are `known`, also empty where the new key, or the one that holds it, is not among them.
    """
    outer = [name, name.split("/")[0], *(name.rsplit(".", count)[0] for count in range(1, name.count(".") + 1))]
    new = next((RENAMED[known] for known in outer if known in RENAMED), None)
    holders = [key for key in known or [] if "." in key]
    if new and known and KEY.fullmatch(new) and not any(f"{new}.".startswith(f"{key}.") for key in holders):
        return ""
    return f": it was renamed, write {new}" if new else ""


def nearest(word: str, known: list[str]) -> str:
    """A hint at the end of an error message: the nearest known names, or all of them."""
    last = [name for name in known if "." not in word and name.rsplit(".", 1)[-1] == word]
    close = last or [name for name in get_close_matches(word, known, n=3, cutoff=0.5) if name != word]
    if close:
        return f": did you mean {' or '.join(close)}?"
    roots = [name for name in known if not any(name.startswith(f"{other}_") for other in known)]
    shown = roots if len(known) > MANY else known
    return f": it has {', '.join(sorted(shown))}" + (", and variants of these" if len(shown) < len(known) else "")
