"""The typed top level of a run's configuration, and the one place where a YAML node becomes an object."""

import dataclasses
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, make_dataclass
from enum import StrEnum
from importlib import import_module
from inspect import Parameter, getdoc, signature
from types import UnionType
from typing import Any, Protocol, Union, cast, get_args, get_origin, get_type_hints

from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from bench.tables import LABEL, LOOK, ROWS, choice, names, nearest, register_resolvers

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
POSITIVE = {  # where they are not null: with what to type
    "time_limit": "600 is ten minutes, null no limit",
    "memory_limit": "8 is 8 GiB, null all but a tenth",
}
DOUBLING = "doubling"
SELF, HERE = "_self_", "@_here_"  # of a list of defaults: the file itself; where one of another group goes
OURS = ("renderers", "datasets", "bench")  # packages that a `_target_` may always name
PACKAGE = "_package_"  # of the node `renderer`: one more, that of the class typed for renderer=custom
OF = "of"  # of a prior: a dataset whose prior it is
# Keys of a dataset or a task that other keys follow.
DEFAULTS = ("_prior_", "_field_", "_similarity_", "_iterations_", "_silhouette_weight_")
RESERVED = ("_target_", PACKAGE, *DEFAULTS, OF, LABEL, ROWS, LOOK)  # of a node; its other keys are arguments
ROLES = {  # what the class of a node of the top level must be
    "task": "bench.setup.inputs.Task",
    "renderer": "renderers.rendering.Renderer",
    "dataset": "datasets.scene.Dataset",
    "silhouette": "renderers.silhouette.SilhouetteLoss",
    "tracker": "bench.trackers.Tracker",
    "prior": "datasets.network_files.HasNetwork",
    "supervision": "bench.single_view.training.Supervision",
}
TARGETS = {  # classes of nodes without a _target_
    "view": "datasets.views.ViewSampler",
    "auto": "bench.setup.auto.AutoSettings",
    "prior": "bench.shape_prior.PriorSettings",
    "models": "bench.setup.fields.ModelSettings",
    "evaluation": "bench.config.EvaluationSettings",
}
WORDS = {int: "a whole number", float: "a number", bool: "true or false", str: "a word", type(None): "null"}


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


def check(config: Mapping[str, Any], overrides: Sequence[str]) -> None:
    """Raises ValueError for what is invalid in a resolved configuration and needs no torch to be found."""
    check_names(config)
    check_label(config, overrides)
    check_top_level(config)
    build(config["tracker"], "tracker", config["packages"])


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
        raise ValueError("only a method of method/space reads draw: add +method=space/NAME, or remove draw")


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
            "only task=completion, pose, capacity, stability, reconstruction and single_view read silhouette: remove it"
        )


def check_top_level(config: Mapping[str, Any]) -> None:
    """Raises ValueError for a value of the top level that no part checks by itself."""
    evaluation = config["evaluation"]
    if not evaluation["fscore_threshold"] > 0:
        raise ValueError(f"evaluation.fscore_threshold must be positive, not {evaluation['fscore_threshold']}")
    if isinstance(evaluation["every"], str) and evaluation["every"] != DOUBLING:
        raise ValueError(f"evaluation.every must be {DOUBLING}, a number or null, not {evaluation['every']!r}")
    if evaluation["film"] not in (None, "gif", "webp"):
        raise ValueError(f"evaluation.film must be gif, webp or null, not {evaluation['film']!r}")
    if not config["results_dir"].strip():
        raise ValueError("results_dir must name a folder, and is empty: type results_dir=results/local, or remove it")
    if config["stress"] is not None and "stress" not in config["task"]:
        raise ValueError("only task=stability reads stress: remove it, or set task=stability")
    if evaluation["film"] is not None and evaluation["picture"] is None:
        raise ValueError("evaluation.film needs pictures: set evaluation.picture=256")
    for name, least in LEAST.items():
        value = (evaluation if "." in name else config)[name.rpartition(".")[2]]
        if isinstance(value, int) and value < least:
            raise ValueError(f"{name} must be at least {least}, not {value}: set {name}={least} or more")
    for name, remedy in POSITIVE.items():
        if config[name] is not None and not config[name] > 0:
            raise ValueError(f"{name} must be positive, not {config[name]}: {remedy}")


def build(
    node: Mapping[Any, Any], name: str, packages: Sequence[str] = (), target: str = "", *, role: type | None = None
) -> Any:
    """The object that a YAML node describes: its `_target_`, or `target`, with its other keys as arguments.

    Args:
        node: the node. Of the renderer, its key `_package_` names one more package that its `_target_` may name.
        name: what it is called in the configuration, for errors, and for what its class must be; see `ROLES`.
        packages: packages of the user's that a `_target_` may name, besides ours.
        target: the class of a node that has no `_target_`; that of one that has must be this class or extend it, or
            be what `ROLES` has for the name.
        role: what the class must be, where the name does not say it.

    Raises:
        ValueError: for an unknown package, a class of another kind, an unknown key or a value of the wrong type.
    """
    if isinstance(node, DictConfig):
        node = cast(dict[Any, Any], OmegaConf.to_container(node, resolve=True, throw_on_missing=False))
    if role is None and target and not ("_target_" in node and name in ROLES):
        role = find_class(target, name, packages, object)
    if node.get("_target_") == MISSING:
        raise ValueError(f"{name}._target_ must be given: set {name}._target_=PACKAGE.CLASS")
    own = [str(node[PACKAGE])] if name == "renderer" and PACKAGE in node else []
    cls = find_class(node.get("_target_", target), name, [*packages, *own], role)
    arguments = {str(key): value for key, value in node.items() if key not in RESERVED}
    names = _argument_names(cls)
    for key in (key for key, value in node.items() if value == MISSING):
        raise ValueError(_missing(cls, name, str(key)))
    for key in arguments:
        if names is not None and key not in names:
            raise ValueError(f"{name} has no key {key!r}{nearest(str(key), names)}")
    return _typed(cls, arguments, name, packages) if is_dataclass(cls) else cls(**arguments)


def find_class(path: Any, name: str, packages: Sequence[str], role: type | None) -> type:
    """The class at a dotted path; nothing is imported of a package that is not ours and not named by the user.

    Args:
        path: PACKAGE.CLASS, or PACKAGE.MODULE.CLASS.
        name: of the node, for errors.
        packages: that may be imported besides ours.
        role: a Protocol whose methods the class must have, or a class that it must be or extend; None asks for that of
            the node's name, see `ROLES`.

    Raises:
        ValueError: where the package is not allowed, or no such class is there.
    """
    module, _, last = str(path).rpartition(".")
    if (package := module.partition(".")[0]) not in (*OURS, *packages):
        remedy = f"type packages=[{package}] if you trust it" if package else "it must be PACKAGE.CLASS"
        raise ValueError(f"{name}._target_ names {path!r}: {remedy}")
    try:
        cls = getattr(import_module(module), last)
    except Exception as error:  # of the user's module, whatever it does
        raise ValueError(f"{name}._target_ names {path!r}, which cannot be imported: {error}") from error
    if not isinstance(cls, type):
        raise ValueError(f"{name}._target_ names {path!r}, which is no class: name the class of a component")
    if role is None and name in ROLES:
        role = find_class(ROLES[name], name, (), object)
    if role is not None and (lacks := _lacking(cls, role)):
        raise ValueError(f"{name}._target_ names {path!r}, which is no {role.__name__}: {lacks}")
    return cls


def _lacking(cls: type, role: type) -> str:
    """What a class lacks of a role, in words; empty where it has all of it. Data may be set when it is made."""
    if not getattr(role, "_is_protocol", False):
        return "" if issubclass(cls, role) else f"name a class that extends {_path(role)}"
    protocols = [base for base in role.__mro__ if getattr(base, "_is_protocol", False) and base is not Protocol]
    methods = {name for base in protocols for name, value in vars(base).items() if callable(value)}
    public = sorted(name for name in methods if not name.startswith("_") or name == "__call__")
    own = {name for base in cls.__mro__ if base is not object for name, value in vars(base).items() if callable(value)}
    missing = [name for name in public if name not in own]
    return f"it lacks {', '.join(missing)}: see {role.__module__}" if missing else ""


def build_once(nodes: Mapping[str, Any], packages: Sequence[str], built: dict[str, Any]) -> list[Any]:
    """The objects of nodes by name, as `build` makes them; equal nodes are built once.

    Args:
        packages: that a `_target_` may name, besides ours.
        built: objects and errors by the text of their nodes, which is extended.
    """
    texts = {name: json.dumps([name, packages, node], sort_keys=True, default=str) for name, node in nodes.items()}
    for name, text in texts.items():
        if text not in built:
            try:
                built[text] = build(nodes[name], name, packages, TARGETS.get(name, ""))
            except ValueError as error:
                built[text] = error
        if isinstance(built[text], ValueError):
            raise built[text]
    return [built[text] for text in texts.values()]


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
    register_resolvers()  # a program that uses the library has read no command line
    node = cast(DictConfig, OmegaConf.merge(_with_defaults(group, name), arguments))
    for key in RESERVED[1:]:
        node.pop(key, None)
    return build(node, group, [arguments.get("_target_", "").split(".")[0]])  # who names a class in Python trusts it


def _with_defaults(group: str, name: str) -> DictConfig:
    """What a choice holds, over those that its `defaults` name, in their order, as Hydra has it."""
    node = OmegaConf.create(choice(group, name))
    bases = [base for base in node.pop("defaults", [SELF]) if isinstance(base, str)]  # not what it sets of others
    places = [
        base.removeprefix("/").removesuffix(HERE).split("/") if base[0] == "/" else [group, base] for base in bases
    ]
    return cast(DictConfig, OmegaConf.merge(*(node if at[1] == SELF else _with_defaults(*at) for at in places)))


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
        key = re.split(r"[.\[]", str(error.full_key))[0]
        raise ValueError(wrong_type(f"{name}.{error.full_key}", arguments[key], types[key])) from None
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
            raise ValueError(_missing(cls, name, item.name))
    try:
        return cls(**values)
    except ValueError as error:  # a class within another does not know where it stands
        raise error if "." not in name or name in str(error) else ValueError(f"{name}: {error}") from error


def _missing(cls: type, name: str, key: str) -> str:
    """What is said of a key without a value, with what the docstring of its class says of it."""
    meaning = re.search(rf"^( *){re.escape(key)}: (.+?)(?=^\1\S|^$|\Z)", getdoc(cls) or "", re.MULTILINE | re.DOTALL)
    said = f", {' '.join(meaning[2].split()).rstrip('.')}" if meaning else ""
    return f"{name}.{key} must be given: set {name}.{key}=...{said}"


def _node_class(wanted: Any) -> type | None:
    """The dataclass that a field's type asks for, alone or beside None; None where it asks for no dataclass."""
    return next((cls for cls in (wanted, *get_args(wanted)) if isinstance(cls, type) and is_dataclass(cls)), None)


def _path(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"


def wrong_type(key: str, value: Any, wanted: Any) -> str:
    """One line on a value of the wrong type: the key, what it must be, the value found, and how a list is written."""
    parts = get_args(wanted)
    listed = get_origin(wanted) is list or parts[1:] == (...,)
    remedy = f": write {key}=[{value}]" if listed and isinstance(value, str | int | float) else ""
    return f"{key} must be {_in_words(wanted)}, not {value!r}{remedy}"


def _in_words(wanted: Any) -> str:
    """What a type hint asks for."""
    parts, of = get_args(wanted), get_origin(wanted)
    if isinstance(wanted, type) and issubclass(wanted, StrEnum):
        return f"one of {', '.join(wanted)}"
    if of in (list, tuple):
        return f"a list of {len(parts)}" if len(parts) > 1 and parts[-1] is not ... else "a list"
    if of is UnionType or of is Union:
        return " or ".join(map(_in_words, parts))
    return WORDS.get(wanted, "keys and values")


def type_of(key: str) -> Any:
    """The type that the top level asks for at a dotted key; None where a part says it by itself."""
    outer, _, inner = key.partition(".")
    return get_type_hints(EvaluationSettings if outer == "evaluation" else Config).get(inner or outer)
