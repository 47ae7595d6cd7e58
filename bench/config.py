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

from bench.tables import LABEL_KEY, LOOK_KEY, ROWS_KEY, choice, extensions, names, nearest, register_resolvers
from bench.tables import extension as extension

MIN_VALUES = {
    **{"seed": 0, "index": 0, "draw": 0, "threads": 1, "evaluation.grid": 8, "evaluation.points": 1},
    **{"evaluation.picture": 4, "evaluation.gallery": 4, "evaluation.every": 1},
}
REMEDY_IF_NOT_POSITIVE = {
    "time_limit": "600 is ten minutes, null no limit",
    "memory_limit": "8 is 8 GiB, null all but a tenth",
}
DOUBLING = "doubling"
SILHOUETTE_REFERENCE = "${silhouette}"
SELF_ENTRY = "_self_"  # the file itself, in a list of defaults
GROUP_MARK = "@_here_"  # follows a choice of another group, in a list of defaults
OUR_PACKAGES = ("renderers", "datasets", "bench")  # a `_target_` may always name them
CLASS_PACKAGE_KEY = "_package_"  # key of the node `renderer`: the package of the class typed for renderer=custom
PRIOR_DATASET_KEY = "of"  # key of the node `prior`: the dataset that it was trained on
# Keys of a dataset or a task that other nodes refer to.
FOLLOWED_KEYS = ("_prior_", "_field_", "_multiview_", "_similarity_", "_iterations_", "_silhouette_weight_")
EPSILON_KEY = "_epsilon_"  # key of the node `task`, which renderers refer to; set by effort=needed
# Keys of nodes that are not arguments of their class, as `_target_` is not.
MARKS = (CLASS_PACKAGE_KEY, *FOLLOWED_KEYS, EPSILON_KEY, PRIOR_DATASET_KEY, LABEL_KEY, ROWS_KEY, LOOK_KEY)
ROLE_OF_NODE = {  # the protocol or base class that the class of a node must have
    "task": "bench.setup.inputs.Task",
    "renderer": "renderers.rendering.Renderer",
    "dataset": "datasets.scene.Dataset",
    "silhouette": "renderers.silhouette.SilhouetteLoss",
    "tracker": "bench.trackers.Tracker",
    "prior": "datasets.scene.HasNetwork",
    "supervision": "bench.tasks.single_view.training.Supervision",
}
CLASS_OF_NODE = {  # for nodes without a _target_; see also conf/extensions.yaml
    "view": "datasets.views.ViewSampler",
    "prior": "bench.shape_prior.PriorSettings",
    "evaluation": "bench.config.EvaluationSettings",
}
PRIOR_FIELD = "prior"  # value of `field`: a latent code of the prior
AUTO = "auto"  # value of `field`, and of settings of a renderer that the node `auto` computes
TYPE_LABELS = {int: "a whole number", float: "a number", bool: "true or false", str: "a word", type(None): "null"}


class Device(StrEnum):
    """Where tensors live; auto takes a GPU if there is one."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


class Isolation(StrEnum):
    """The process of a run: a new one, or for debugging that of the command, without limits on time and memory."""

    process = "process"
    off = "off"


class Rerun(StrEnum):
    """Which finished runs are run again; a killed run always is."""

    none = "none"
    failed = "failed"
    all = "all"


@dataclass
class EvaluationSettings:
    """Settings of the evaluation of a result; see conf/config.yaml."""

    grid: int = MISSING
    points: int = MISSING
    fscore_threshold: float = MISSING
    picture: int | None = MISSING
    gallery: int | None = MISSING
    every: int | str | None = MISSING
    film: str | None = MISSING


@dataclass
class Config:
    """The top level of conf/config.yaml. `build` makes the objects of nodes, by `_target_` or `CLASS_OF_NODE`."""

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
    """Raises ValueError if a resolved configuration is invalid, as far as this can be checked without torch."""
    check_names(config)
    check_label(config, overrides)
    check_top_level(config)
    build(config["tracker"], "tracker", config["packages"])


def check_label(config: Mapping[str, Any], overrides: Sequence[str]) -> None:
    """Raises ValueError if a renderer replaces that of a method, because the run would keep the method's label."""
    typed = dict(text.lstrip("+").partition("=")[::2] for text in overrides)
    if config.get("label") and {"renderer", "method"} <= typed.keys() and "label" not in typed:
        raise ValueError(
            f"renderer={typed['renderer']} beside +method={typed['method']} would run under the name "
            f"{config['label']!r}: add label=NAME, in a sweep 'label=\\${{renderer._label_}}'"
        )


def check_references(config: DictConfig) -> None:
    """Raises ValueError if a draw or a silhouette loss is set, and no value of the unresolved configuration uses it."""
    is_own_loss = str((config.get("silhouette") or {}).get("_target_", ".Own")).endswith(".Own")
    if config.get("draw") is None and is_own_loss:
        return
    text = str(OmegaConf.to_container(config, resolve=False))
    if config.get("draw") is not None and "${drawn:" not in text:
        raise ValueError("only a method of method/space reads draw: add +method=space/NAME, or remove draw")
    if not is_own_loss and SILHOUETTE_REFERENCE not in text:
        merged = {name: str(OmegaConf.to_container(_with_defaults("task", name))) for name in names("task")}
        tasks = [name for name, content in merged.items() if SILHOUETTE_REFERENCE in content]
        raise ValueError(f"silhouette is read only by task={', '.join(tasks)}: remove it, or set one of these tasks")


def check_names(config: Mapping[str, Any]) -> None:
    """Raises ValueError for an unknown key of the top level."""
    keys = [item.name for item in fields(Config)]
    for key in map(str, config):
        if key not in keys:
            raise ValueError(f"unknown key {key!r}{nearest(key, keys)}")


def check_top_level(config: Mapping[str, Any]) -> None:
    """Raises ValueError for an invalid value of the top level that no component checks."""
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
    for name, minimum in MIN_VALUES.items():
        value = (evaluation if "." in name else config)[name.rpartition(".")[2]]
        if isinstance(value, int) and value < minimum:
            raise ValueError(f"{name} must be at least {minimum}, not {value}: set {name}={minimum} or more")
    for name, remedy in REMEDY_IF_NOT_POSITIVE.items():
        if config[name] is not None and not config[name] > 0:
            raise ValueError(f"{name} must be positive, not {config[name]}: {remedy}")


def build(
    node: Mapping[Any, Any], name: str, packages: Sequence[str] = (), target: str = "", *, role: type | None = None
) -> Any:
    """The object that a YAML node describes: its `_target_`, or `target`, with its other keys as arguments.

    Args:
        node: the node. In the node `renderer`, the key `_package_` names one more allowed package.
        name: the node's key in the configuration, for error messages and for `ROLE_OF_NODE`.
        packages: packages of the user that a `_target_` may name, in addition to ours.
        target: the class of a node without `_target_`. A `_target_` must be this class or extend it, unless
            `ROLE_OF_NODE` has the name.
        role: the required protocol or base class, if the name does not determine it.

    Raises:
        ValueError: for an unknown package, a class of another kind, an unknown key or a value of the wrong type.
    """
    if isinstance(node, DictConfig):
        node = cast(dict[Any, Any], OmegaConf.to_container(node, resolve=True, throw_on_missing=False))
    if role is None and target and not ("_target_" in node and name in ROLE_OF_NODE):
        role = find_class(target, name, packages, object)
    if node.get("_target_") == MISSING:
        raise ValueError(f"{name}._target_ must be given: set {name}._target_=PACKAGE.CLASS")
    is_custom = name == "renderer" and CLASS_PACKAGE_KEY in node
    class_package = [str(node[CLASS_PACKAGE_KEY])] if is_custom else []
    cls = find_class(node.get("_target_", target), name, [*packages, *class_package], role)
    arguments = {str(key): value for key, value in node.items() if key not in ("_target_", *MARKS)}
    argument_names = _argument_names(cls)
    if missing := [str(key) for key, value in node.items() if value == MISSING]:
        raise ValueError(_missing_values_message(cls, name, missing))
    for key in arguments:
        if argument_names is not None and key not in argument_names:
            needs_custom = name == "renderer" and not is_custom and _is_of_user(cls)
            hint = f"; {custom_renderer_hint(_class_path(cls))}" if needs_custom else ""
            raise ValueError(f"{name} has no key {key!r}{nearest(key, argument_names)}{hint}")
    return _build_dataclass(cls, arguments, name, packages) if is_dataclass(cls) else cls(**arguments)


def find_class(path: Any, name: str, packages: Sequence[str], role: type | None) -> type:
    """The class at a dotted path. Only our packages and those that the user names are imported.

    Args:
        path: PACKAGE.CLASS, or PACKAGE.MODULE.CLASS.
        name: the name of the node, for error messages.
        packages: packages that may be imported in addition to ours.
        role: a Protocol whose methods the class must have, or a class that it must be or extend; None takes that of
            `ROLE_OF_NODE`.

    Raises:
        ValueError: if the package is not allowed, the class does not exist, or it lacks the role.
    """
    module, _, class_name = str(path).rpartition(".")
    if (package := module.partition(".")[0]) not in (*OUR_PACKAGES, *packages):
        remedy = f"type packages=[{package}] if you trust it" if package else "it must be PACKAGE.CLASS"
        if package and name == "renderer":
            remedy += f"; {custom_renderer_hint(path)}"
        raise ValueError(f"{name}._target_ names {path!r}: {remedy}")
    try:
        cls = getattr(import_module(module), class_name)
    except Exception as error:  # a module of the user may raise any error
        is_absent = isinstance(error, ModuleNotFoundError) and error.name == package
        remedy = "; add its folder to PYTHONPATH, or start there" if is_absent else ""
        raise ValueError(f"{name}._target_ names {path!r}, which cannot be imported: {error}{remedy}") from error
    if not isinstance(cls, type):
        raise ValueError(f"{name}._target_ names {path!r}, which is no class: name the class of a component")
    if role is None and name in ROLE_OF_NODE:
        role = find_class(ROLE_OF_NODE[name], name, (), object)
    if role is not None and (fault := _role_fault(cls, role)):
        raise ValueError(f"{name}._target_ names {path!r}, which is no {role.__name__}: {fault}")
    return cls


def custom_renderer_hint(path: str) -> str:
    """How to run a renderer's class of the user."""
    return f"a class of your own is renderer=custom renderer._target_={path}"


def _role_fault(cls: type, role: type) -> str:
    """Why a class does not fill a role; empty if it does. Data attributes are not checked: __init__ may set them."""
    if abstract := sorted(getattr(cls, "__abstractmethods__", ())):
        return f"it does not define {', '.join(abstract)}: see {role.__module__}"
    if not getattr(role, "_is_protocol", False):
        return "" if issubclass(cls, role) else f"name a class that extends {_class_path(role)}"
    protocols = [base for base in role.__mro__ if getattr(base, "_is_protocol", False) and base is not Protocol]
    methods = {name for base in protocols for name, value in vars(base).items() if callable(value)}
    public = sorted(name for name in methods if not name.startswith("_") or name == "__call__")
    bases = [base for base in cls.__mro__ if base is not object]
    missing = [name for name in public if not any(callable(vars(base).get(name)) for base in bases)]
    return f"it lacks {', '.join(missing)}: see {role.__module__}" if missing else ""


def class_of_node(name: str) -> str:
    """The class of a node without a `_target_`; empty if it needs one."""
    return CLASS_OF_NODE.get(name) or extensions().get(name, "")


def build_once(nodes: Mapping[str, Any], packages: Sequence[str], built: dict[str, Any]) -> list[Any]:
    """The objects of nodes by name, as `build` makes them; equal nodes are built once.

    Args:
        packages: packages that a `_target_` may name, in addition to ours.
        built: cache of objects and errors by the text of their nodes; it is extended.
    """
    texts = {name: json.dumps([name, packages, node], sort_keys=True, default=str) for name, node in nodes.items()}
    for name, text in texts.items():
        if text not in built:
            try:
                built[text] = build(nodes[name], name, packages, class_of_node(name))
            except ValueError as error:
                built[text] = error
        if isinstance(built[text], ValueError):
            raise built[text]
    return [built[text] for text in texts.values()]


def _argument_names(cls: type) -> list[str] | None:
    """The names of a class's arguments; None if it takes any argument, or has no signature."""
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
    register_resolvers()  # otherwise only the command line registers them
    node = cast(DictConfig, OmegaConf.merge(_with_defaults(group, name), arguments))
    for key in MARKS:
        node.pop(key, None)
    return build(node, group, [arguments.get("_target_", "").split(".")[0]])  # a class named in Python is trusted


def _with_defaults(group: str, name: str) -> DictConfig:
    """The content of a choice, merged with the choices of its `defaults` in Hydra's order."""
    node = OmegaConf.create(choice(group, name))
    nodes = []
    for base in node.pop("defaults", [SELF_ENTRY]):
        if base == SELF_ENTRY:
            nodes.append(node)
        elif isinstance(base, str):  # a dict chooses in another group
            path = base[1:].removesuffix(GROUP_MARK).split("/") if base[0] == "/" else [group, base]
            nodes.append(_with_defaults(*path))
    return cast(DictConfig, OmegaConf.merge(*nodes))


def _build_dataclass(cls: type, arguments: dict[str, Any], name: str, packages: Sequence[str]) -> Any:
    """An instance of a dataclass, with arguments converted to the field types; a ValueError names the wrong field."""
    types = get_type_hints(cls)
    protocols = [key for key, value in arguments.items() if value is not None and _protocol(types[key])]
    for key in protocols:
        if not isinstance(arguments[key], dict):
            raise ValueError(
                f"{name}.{key} must have a _target_, not be {arguments[key]!r}: write {key}=NAME, without {name}"
            )
    nested = {key: _node_class(types[key]) for key, value in arguments.items() if isinstance(value, dict)}
    nested = {key: child for key, child in nested.items() if child or key in protocols}
    plain_arguments = {key: value for key, value in arguments.items() if key not in nested}
    schema = OmegaConf.structured(make_dataclass(cls.__name__, [(key, types[key]) for key in plain_arguments]))
    try:
        converted = OmegaConf.merge(schema, plain_arguments)
    except OmegaConfBaseException as error:
        key = re.split(r"[.\[]", str(error.full_key))[0]
        raise ValueError(wrong_type_message(f"{name}.{error.full_key}", arguments[key], types[key])) from None
    values: Any = OmegaConf.to_container(converted)
    values |= {key: tuple(value) for key, value in values.items() if get_origin(types[key]) is tuple}
    for key, child in nested.items():
        target = _class_path(child) if child else ""
        values[key] = build(arguments[key], f"{name}.{key}", packages, target, role=child or _protocol(types[key]))
    no_default = dataclasses.MISSING
    required = [item.name for item in fields(cls) if item.default is item.default_factory is no_default]
    if missing := [key for key in required if key not in values]:
        plus = "+" if name == "renderer" and _is_of_user(cls) else ""
        raise ValueError(_missing_values_message(cls, name, missing, plus=plus))
    try:
        return cls(**values)
    except ValueError as error:  # the class of a nested node does not know its key
        raise error if "." not in name or name in str(error) else ValueError(f"{name}: {error}") from error


def _missing_values_message(cls: type, name: str, keys: Sequence[str], plus: str = "") -> str:
    """The error message for keys without a value, with the description of the first one from the class's docstring.

    Args:
        plus: of an override of a key that no YAML has.
    """
    key = keys[0]
    match = re.search(rf"^( *){re.escape(key)}: (.+?)(?=^\1\S|^$|\Z)", getdoc(cls) or "", re.MULTILINE | re.DOTALL)
    explanation = f", {' '.join(match[2].split()).rstrip('.')}" if match else ""
    settings = " ".join(f"{plus}{name}.{each}=..." for each in keys)
    default = "; or give it a default in the class" if plus else ""
    return f"{' and '.join(f'{name}.{each}' for each in keys)} must be given: set {settings}{explanation}{default}"


def _node_class(wanted: Any) -> type | None:
    """The dataclass in a field's type, such as `X` or `X | None`; None if there is no dataclass."""
    return next((cls for cls in (wanted, *get_args(wanted)) if isinstance(cls, type) and is_dataclass(cls)), None)


def _protocol(wanted: Any) -> type | None:
    """The protocol in a field's type, such as `X` or `X | None`; None if there is no protocol."""
    return next((cls for cls in (wanted, *get_args(wanted)) if getattr(cls, "_is_protocol", False)), None)


def _is_of_user(cls: type) -> bool:
    return cls.__module__.partition(".")[0] not in OUR_PACKAGES


def _class_path(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"


def wrong_type_message(key: str, value: Any, wanted: Any) -> str:
    """The error message for a value of the wrong type: the key, the right type, the value, and how to write a list."""
    members = get_args(wanted)
    is_list = get_origin(wanted) is list or members[1:] == (...,)
    remedy = f": write {key}=[{value}]" if is_list and isinstance(value, str | int | float) else ""
    if match := re.fullmatch(r"(\d+)-(\d+)", str(value)):
        remedy = f": several are -m {key}='range({match[1]},{int(match[2]) + 1})'"
    return f"{key} must be {_type_label(wanted)}, not {value!r}{remedy}"


def _type_label(wanted: Any) -> str:
    """A type hint in words."""
    members, origin = get_args(wanted), get_origin(wanted)
    if isinstance(wanted, type) and issubclass(wanted, StrEnum):
        return f"one of {', '.join(wanted)}"
    if origin in (list, tuple):
        return f"a list of {len(members)}" if len(members) > 1 and members[-1] is not ... else "a list"
    if origin is UnionType or origin is Union:
        return " or ".join(map(_type_label, members))
    return TYPE_LABELS.get(wanted, "keys and values")


def type_of(key: str) -> Any:
    """The type of a dotted key of the top level; None for keys of other nodes, whose classes define them."""
    outer, _, inner = key.partition(".")
    return get_type_hints(EvaluationSettings).get(inner) if outer == "evaluation" else get_type_hints(Config).get(key)
