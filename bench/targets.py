"""Finds the class that a `_target_` names, and checks that it may be used before anything is imported or called.

A class is used where it is defined in `renderers`, `datasets`, `bench` or a package that the command line names, and
where it is what its place in the configuration asks for. A YAML grants no leave: it may be somebody else's.
"""

import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any, Protocol

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Sweep

OURS = ("renderers", "datasets", "bench")
LEAVE = "_package_"  # of the node `renderer`: one more package, that of the class typed for renderer=custom
OWN, NO_CLASS, MISSING = "custom", "none", "???"  # the choice of `renderer` whose class is typed; where it is not
ROLES = {  # what the class of a node of the top level must be
    "task": "bench.tasks.task.Task",
    "renderer": "renderers.rendering.Renderer",
    "dataset": "datasets.dataset.Dataset",
    "silhouette": "renderers.silhouette.SilhouetteLoss",
    "tracker": "bench.trackers.Tracker",
    "supervision": "bench.single_view.training.Supervision",
}


def find_class(path: Any, name: str, packages: Sequence[str], role: type | None) -> type:
    """The class at a dotted path, which is imported only where it can be defined in an allowed package.

    Args:
        path: PACKAGE.MODULE.CLASS.
        name: of the node, for errors.
        packages: that may be imported beside ours.
        role: a Protocol whose methods the class must have, or else a class that it must be or extend; None asks for
            that of the node's name, see `ROLES`.

    Raises:
        ValueError: where it may not be used, or is not there. Nothing of another package was imported or called.
    """
    check_package(path, name, packages)
    cls = _located(path, name)
    if not isinstance(cls, type):
        raise ValueError(f"{name}._target_ names {path!r}, which is no class: name the class of a component")
    if (home := cls.__module__.split(".")[0]) not in (*OURS, *packages):
        raise ValueError(f"{name}._target_ names {path!r}, a class of {home}: {_remedy(home)}")
    wanted = role if role is not None else _role(name)
    if wanted is not None and (lacks := _lacking(cls, wanted)):
        raise ValueError(f"{name}._target_ names {path!r}, which is no {wanted.__name__}: {lacks}")
    return cls


def check_package(path: Any, name: str, packages: Sequence[str]) -> None:
    """Raises ValueError where a path names no class, or a package that is not allowed; imports nothing."""
    parts = str(path).split(".")
    if not isinstance(path, str) or len(parts) < 2 or not all(part.isidentifier() for part in parts):
        raise ValueError(f"{name}._target_ names {path!r}: it must be PACKAGE.CLASS, or PACKAGE.MODULE.CLASS")
    if parts[0] in sys.stdlib_module_names or parts[0] not in (*OURS, *packages):
        raise ValueError(f"{name}._target_ names {path!r}: {_remedy(parts[0])}")


@cache
def parsed(override: str) -> Override:
    """An override of the command line, as Hydra reads it."""
    return OverridesParser.create().parse_override(override)


def check_targets(config: Mapping[str, Any], typed: Sequence[str], renderer: str) -> None:
    """Checks every `_target_` of a configuration by its package, before anything is imported.

    Args:
        config: the resolved configuration, without Hydra's own node.
        typed: the overrides of the command line, by which alone packages are named.
        renderer: the choice of the group `renderer`.

    Raises:
        ValueError: for a package that the command line does not name.
    """
    assert isinstance(config, dict), "nodes of OmegaConf are no dictionaries, and would be passed over"
    told = [override for override in map(parsed, typed) if not override.is_delete()]
    named = {str(package) for package in _flat(_values_of(told, "packages"))}
    for package in map(str, config.get("packages") or []):
        if package not in named:
            raise ValueError(f"a YAML names packages=[{package}]: type it on the command line if you trust {package}")
        if package in sys.stdlib_module_names:
            raise ValueError(f"packages names {package!r}: {_remedy(package)}")
    classes = [str(target) for target in _flat(_values_of(told, "renderer._target_"))] if renderer == OWN else []
    for name, node in _nodes(config):
        target, leave = node.get("_target_"), node.get(LEAVE)
        first = str(target).split(".")[0]
        own = name == "renderer" and target in (*classes, MISSING) and leave in (first, None, NO_CLASS)
        if LEAVE in node and (not own or _values_of(told, f"{name}.{LEAVE}")):
            raise ValueError(f"{name}.{LEAVE} gives no leave: type packages=[{leave}] if you trust {leave}")
        if target not in (None, MISSING):
            check_package(target, name, [*named, *([first] if LEAVE in node else [])])


def has_foreign(config: Mapping[str, Any]) -> bool:
    """Whether a configuration names a class of a package that is not ours."""
    targets = (node.get("_target_") for _, node in _nodes(config))
    return any(target is not None and str(target).split(".")[0] not in OURS for target in targets)


def _values_of(told: list[Override], key: str) -> list[Any]:
    """The values that overrides give a key, those of a sweep one by one."""
    values: list[Any] = []
    for override in told:
        if override.key_or_group == key:
            value = override.value()
            values += value.list if isinstance(value, Sweep) and hasattr(value, "list") else [value]
    return values


def _flat(values: list[Any]) -> Iterator[Any]:
    for value in values:
        yield from value if isinstance(value, list) else [value]


def _nodes(node: Any, name: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Every node below a plain one, with its dotted name."""
    for key, child in node.items() if isinstance(node, Mapping) else enumerate(node) if isinstance(node, list) else ():
        here = f"{name}.{key}" if name else str(key)
        if isinstance(child, dict):
            yield here, child
        yield from _nodes(child, here)


def _remedy(package: str) -> str:
    if package in sys.stdlib_module_names:
        return f"{package} is of Python's standard library, which has no component"
    return f"add its package by packages=[{package}] if you trust it"


def _located(path: str, name: str) -> Any:
    """What is at a dotted path: modules are imported, attributes that are modules of others are not entered."""
    first, *rest = path.split(".")
    try:
        found, place = import_module(first), first
        for part in rest:
            place = f"{place}.{part}"
            if not hasattr(found, part) and isinstance(found, ModuleType) and find_spec(place) is not None:
                found = import_module(place)
                continue
            found = getattr(found, part)
            if isinstance(found, ModuleType) and found.__name__ != place:
                raise ImportError(f"{place} is the module {found.__name__}")
            if not isinstance(found, ModuleType | type):
                break  # a function or an object, whose attributes nobody has to ask for
    except Exception as error:  # of the user's module, whatever it does
        raise ValueError(f"{name}._target_ names {path!r}, which cannot be imported: {error}") from error
    return found


def _role(name: str) -> type | None:
    if name not in ROLES:
        return None
    module, _, cls = ROLES[name].rpartition(".")
    return getattr(import_module(module), cls)


def _lacking(cls: type, role: type) -> str:
    """What a class lacks of a role, in words; empty where it has all of it. Data may be set when it is made."""
    if not getattr(role, "_is_protocol", False):
        return "" if issubclass(cls, role) else f"name a class that extends {role.__module__}.{role.__qualname__}"
    protocols = [base for base in role.__mro__ if getattr(base, "_is_protocol", False) and base is not Protocol]
    methods = [name for base in protocols for name, value in vars(base).items() if callable(value) and _public(name)]
    own = {name for base in cls.__mro__ if base is not object for name, value in vars(base).items() if callable(value)}
    missing = [name for name in dict.fromkeys(methods) if name not in own]
    return f"it lacks {', '.join(missing)}: see {role.__module__}" if missing else ""


def _public(name: str) -> bool:
    return not name.startswith("_") or name == "__call__"
