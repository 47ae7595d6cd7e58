"""The typed top level of a run's configuration, and the one place where a YAML node becomes an object."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, make_dataclass
from enum import StrEnum
from inspect import Parameter, signature
from pathlib import Path
from typing import Any, cast, get_args, get_origin, get_type_hints

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from bench.hints import nearest
from bench.rows import LABEL, ROWS, register_resolvers
from bench.tables import CONF as CONF
from bench.tables import LOOK, choice, names, register_rows
from bench.targets import LEAVE, find_class
from datasets.dataset import SPLIT_STRIDE, Split

LEAST = {
    "seed": 0,
    "index": 0,
    "draw": 0,
    "threads": 1,
    "evaluation.grid": 8,
    "evaluation.points": 1,
    "evaluation.picture": 4,
    "evaluation.gallery": 4,
    "evaluation.every": 1,
}
DOUBLING = "doubling"
SELF = "_self_"  # of a list of defaults: the file itself
RESERVED = ("_target_", LEAVE, "_prior_", "_field_", LABEL, ROWS, LOOK)  # of a node; its other keys are arguments


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
    gallery: int | None = MISSING
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
    supervision: Any = MISSING
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
    plan: bool = MISSING
    verbose: bool = MISSING


def register(*folders: Path) -> None:
    """Makes known to Hydra the schema that conf/config.yaml uses, the rows of tables, and what values may ask for.

    Args:
        folders: of the user's, whose tables have more rows.

    Raises:
        ValueError: for a table that cannot be read.
    """
    ConfigStore.instance().store(name="schema", node=Config)
    register_rows(folders)
    register_resolvers()


def check_label(config: Mapping[str, Any], overrides: Sequence[str]) -> None:
    """Raises ValueError where a renderer takes the place of a method's, whose label the run would keep."""
    given = dict(text.lstrip("+").partition("=")[::2] for text in overrides)
    if config.get("label") and {"renderer", "method"} <= given.keys() and "label" not in given:
        raise ValueError(
            f"renderer={given['renderer']} beside +method={given['method']} would run under the name "
            f"{config['label']!r}: add label=NAME, in a sweep 'label=\\${{renderer._label_}}'"
        )


def check_draw(config: DictConfig) -> None:
    """Raises ValueError where a draw is set that no value asks for; the configuration is not resolved yet."""
    if config.get("draw") is not None and "${drawn:" not in str(OmegaConf.to_container(config, resolve=False)):
        raise ValueError("draw is read by a method of method/space alone: add +method=space/NAME, or leave draw out")


def check_names(config: Mapping[str, Any]) -> None:
    """Raises ValueError for a key of the top level that there is not, and for a choice that nothing reads."""
    names = [item.name for item in fields(Config)]
    for key in map(str, config):
        if key not in names:
            raise ValueError(f"unknown key {key!r}{nearest(key, names)}")
    loss, task = config.get("silhouette") or {}, config.get("task") or {}
    if not str(loss.get("_target_", ".Own")).endswith(".Own") and "silhouette" not in {
        *task,
        *task.get("fit", {}),
        *task.get("losses", {}),
        *(task.get("supervision") or {}).get("losses", {}),
    }:
        raise ValueError(
            "silhouette is read by task=completion, pose, capacity, stability, reconstruction and single_view alone: "
            "leave it out"
        )


def check_top_level(config: Mapping[str, Any]) -> None:
    """Raises ValueError for a value of the top level that no part checks by itself."""
    evaluation = config["evaluation"]
    if config["split"] not in list(Split):
        raise ValueError(f"split must be one of {', '.join(Split)}, not {config['split']!r}")
    if not evaluation["fscore_threshold"] > 0:
        raise ValueError(f"evaluation.fscore_threshold must be positive, not {evaluation['fscore_threshold']}")
    if isinstance(evaluation["every"], str) and evaluation["every"] != DOUBLING:
        raise ValueError(f"evaluation.every must be {DOUBLING}, a number or null, not {evaluation['every']!r}")
    if evaluation["film"] not in (None, "gif", "webp"):
        raise ValueError(f"evaluation.film must be gif, webp or null, not {evaluation['film']!r}")
    if not config["results_dir"].strip():
        raise ValueError(
            "results_dir must name a folder, and is empty: type results_dir=results/local, or leave it out"
        )
    if config["stress"] is not None and "stress" not in config["task"]:
        raise ValueError("stress is read by task=stability alone: leave it out, or set task=stability")
    if evaluation["film"] is not None and evaluation["picture"] is None:
        raise ValueError("evaluation.film needs pictures: set evaluation.picture=256")
    if config["index"] >= SPLIT_STRIDE:
        raise ValueError(f"index must be at most {SPLIT_STRIDE - 1}, not {config['index']}: a split has no more shapes")
    for name, least in LEAST.items():
        value = (evaluation if "." in name else config)[name.rpartition(".")[2]]
        if isinstance(value, int) and value < least:
            raise ValueError(f"{name} must be at least {least}, not {value}: set {name}={least} or more")


def build(
    node: Mapping[Any, Any],
    name: str,
    packages: Sequence[str] = (),
    target: str = "",
    *,
    role: type | None = None,
) -> Any:
    """The object that a YAML node describes: its `_target_`, or `target`, with its other keys as arguments.

    Args:
        node: the node. Of the renderer, its key `_package_` names one more package that its `_target_` may name.
        name: what it is called in the configuration, for errors, and for what its class must be; see `bench.targets`.
        packages: packages of the user's that a `_target_` may name, beside ours.
        target: the class of a node that has no `_target_`; that of one that has must be this class or extend it.
        role: what the class must be, where the name does not say it.

    Raises:
        ValueError: for an unknown package, a class that may not be used, an unknown key or a value of the wrong type.
    """
    if isinstance(node, DictConfig):
        node = cast(dict[Any, Any], OmegaConf.to_container(node, resolve=True, throw_on_missing=False))
    if role is None and target:
        role = find_class(target, name, packages, object)
    for key in ("_target_", *node):
        if node.get(key) == MISSING:
            raise ValueError(
                f"{name}.{key} must be given: set {name}.{key}={'PACKAGE.CLASS' if key[0] == '_' else '...'}"
            )
    leave = [str(node[LEAVE])] if name == "renderer" and LEAVE in node else []
    cls = find_class(node.get("_target_", target), name, [*packages, *leave], role)
    arguments = {str(key): value for key, value in node.items() if key not in RESERVED}
    names = _argument_names(cls)
    for key in arguments:
        if names is not None and key not in names:
            raise ValueError(f"{name} has no key {key!r}{nearest(str(key), names)}")
    return _typed(cls, arguments, name, packages) if is_dataclass(cls) else cls(**arguments)


def _argument_names(cls: type) -> list[str] | None:
    """The arguments of a class, which may be the user's; None where it takes any, or does not say."""
    if is_dataclass(cls):
        return [f.name for f in fields(cls)]
    try:
        parameters = signature(cls).parameters.values()
    except (TypeError, ValueError):
        return None
    if any(p.kind is Parameter.VAR_KEYWORD for p in parameters):
        return None
    return [p.name for p in parameters if p.kind in (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY)]


def load(group: str, name: str, **arguments: Any) -> Any:
    """The object of a file or row of conf, for use as a library: `load("renderer", "dist", steps=100)`.

    Raises:
        ValueError: for an unknown group or name, an unknown key or a value of the wrong type.
    """
    if name not in names(group):
        raise ValueError(f"unknown {group} {name!r}{nearest(name, names(group))}")
    node = cast(DictConfig, OmegaConf.merge(_with_defaults(group, name), arguments))
    for key in RESERVED[1:]:
        node.pop(key, None)
    return build(node, group, [arguments.get("_target_", "").split(".")[0]])  # who names a class in Python trusts it


def _with_defaults(group: str, name: str) -> DictConfig:
    """What a choice holds, over those of its own group that its `defaults` name, in their order, as Hydra has it."""
    node = OmegaConf.create(choice(group, name))
    bases = [str(base) for base in node.pop("defaults", [SELF])]
    return cast(DictConfig, OmegaConf.merge(*(node if base == SELF else _with_defaults(group, base) for base in bases)))


def _typed(cls: type, arguments: dict[str, Any], name: str, packages: Sequence[str]) -> Any:
    """An instance whose arguments were converted to the field types, or a ValueError that names the field."""
    types = get_type_hints(cls)
    protocols = [key for key in arguments if getattr(types[key], "_is_protocol", False)]
    for key in protocols:
        if not isinstance(arguments[key], dict):
            raise ValueError(
                f"{name}.{key} must have a _target_, not be {arguments[key]!r}: write {key}=NAME, without {name}"
            )
    nested = {key: _node_class(types[key]) for key, value in arguments.items() if isinstance(value, dict)}
    nested = {key: found for key, found in nested.items() if found or key in protocols}
    given = {key: value for key, value in arguments.items() if key not in nested}
    schema = OmegaConf.structured(make_dataclass(cls.__name__, [(key, types[key]) for key in given]))
    try:
        flat = OmegaConf.merge(schema, given)
    except OmegaConfBaseException as error:
        key = str(error.full_key).split(".")[0]
        wanted = types.get(key, "")
        if get_args(wanted)[1:] == (...,) and isinstance(arguments[key], str | int | float):
            raise ValueError(f"{name}.{key} must be a list: write {name}.{key}=[{arguments[key]}]") from None
        text = str(error).splitlines()[0]
        raise ValueError(f"{name}.{error.full_key}: {text} (expected {_type_name(wanted)})") from None
    values: Any = OmegaConf.to_container(flat)
    values |= {key: tuple(value) for key, value in values.items() if get_origin(types[key]) is tuple}
    values |= {
        key: build(arguments[key], f"{name}.{key}", packages, _path(found) if found else "", role=found or types[key])
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
