"""Composes the runs of a command line by Hydra's `compose`: once for each combination of choices.

A composition takes a tenth of a second. The values of a cell are set on a copy of it. Values that refer to others take
milliseconds; they are resolved once for all cells that differ in the shape or the seed alone.
"""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from hydra.core.plugins import Plugins
from hydra.errors import HydraException, MissingConfigException
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from bench.config import CLASS_PACKAGE_KEY, Config, type_of, wrong_type_message
from bench.records.folder import Identity, identify, resolve_config
from bench.tables import CONF, folders, listed, nearest, register_resolvers, register_rows

NOT_BY_DEFAULT = ("method", "experiment")  # groups that take a plus in front
LONE = re.compile(r"(index|seed)=(0|[1-9]\d*)")  # overrides of a single number
ASKING = re.compile(r"\$\{.*(index|seed)", re.DOTALL)  # a value that may refer to one of these


class Listed(ConfigSource):
    """What `bench.tables` lists, for Hydra: files and rows, each parsed once."""

    @staticmethod
    def scheme() -> str:
        """The beginning of its address on Hydra's search path."""
        return "listed"

    def available(self) -> bool:
        """It is always there."""
        return True

    def is_group(self, config_path: str) -> bool:
        """Whether a path is a group with choices."""
        return bool(listed(config_path.strip("/")))

    def is_config(self, config_path: str) -> bool:
        """Whether a path is a choice of a group."""
        group, _, name = config_path.rpartition("/")
        return name.removesuffix(".yaml") in listed(group)

    def load_config(self, config_path: str) -> ConfigResult:
        """The content of a choice, and the package of its keys."""
        group, _, name = config_path.rpartition("/")
        node, package = listed(group)[name.removesuffix(".yaml")].load()
        return ConfigResult(self.provider, self.full_path(), node, {"package": package})

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        """The choices of a group."""
        return [] if results_filter == ObjectType.GROUP else sorted(listed(config_path.strip("/")))


class SearchPath(SearchPathPlugin):
    """Has Hydra search `Listed` before all else, and the user's folders after it, for groups of the user's own."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Adds these to Hydra's search path."""
        search_path.prepend("implicit-bench", "listed://")
        for folder in folders():
            search_path.append("command-line", f"file://{folder.absolute()}")


def register(*config_dirs: Path) -> None:
    """Makes known to Hydra the schema of conf/config.yaml, the choices of all groups, and what values may ask for.

    Args:
        config_dirs: folders of the user's, whose files and tables have more choices.

    Raises:
        ValueError: for a folder that is not there, and a table that cannot be read.
    """
    for folder in config_dirs:
        if not folder.is_dir():
            raise ValueError(f"--config-dir {folder}: there is no such folder")
    ConfigStore.instance().store(name="schema", node=Config)
    Plugins.instance().register(Listed)
    Plugins.instance().register(SearchPath)
    register_rows(config_dirs)
    register_resolvers()


@contextmanager
def composing(*config_dirs: Path) -> Iterator[None]:
    """Within it, `Composer` composes what conf and the user's folders hold.

    Raises:
        ValueError: for a folder that is not there, and a table that cannot be read.
    """
    register(*config_dirs)
    with initialize_config_dir(str(CONF), version_base="1.3"):
        yield


@cache
def parsed(text: str) -> Override:
    """An override of the command line, as Hydra reads it.

    Raises:
        OverrideParseException: where it is none.
    """
    return OverridesParser.create().parse_overrides([text])[0]


def combinations(texts: Sequence[str]) -> list[list[str]]:
    """The overrides of each cell, from those of a sweep, such as `seed=0,1`; of two with one key the later counts.

    Raises:
        ValueError: for an interval, which has no values to list.
    """
    parser = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader())  # it lists what a glob means
    cells: dict[str, list[str]] = {}
    for override in parser.parse_overrides([*texts]):
        key = override.get_key_element()
        if not override.is_sweep_override():
            cells[key] = [f"{key}={override.get_value_element_as_str()}"]
        elif override.is_discrete_sweep():
            cells[key] = [f"{key}={value}" for value in override.sweep_string_iterator()]
        else:
            raise ValueError(f"{override.input_line!r} is no list of values: write {key}=A,B or {key}=range(0,3)")
    return [list(cell) for cell in product(*cells.values())]


def sets_value(override: Override) -> bool:
    """Whether an override sets a key that is there; others choose, add or remove, which Hydra does."""
    key = override.key_or_group
    chooses = override.package is not None or "/" in key or (listed(key) and not isinstance(override.value(), dict))
    return override.type == OverrideType.CHANGE and not chooses and key != "hydra.searchpath"


def set_value(override: Override, config: DictConfig) -> bool:
    """Sets the value of a key; gives whether the configuration has the key.

    Raises:
        ValueError: for a value of the wrong type, and an unknown key within a value.
    """
    key, value = override.key_or_group, override.value()
    try:
        OmegaConf.update(config, key, value, merge=True)
    except (ConfigAttributeError, ConfigKeyError) as error:
        if isinstance(value, dict) and OmegaConf.select(config, key) is not None:
            raise unknown_key(str(error.full_key), config) from error
        return False
    except OmegaConfBaseException as error:
        raise ValueError(wrong_type_message(key, str(override.input_line).partition("=")[2], type_of(key))) from error
    return True


def composed(overrides: Sequence[str]) -> DictConfig:
    """What Hydra composes of the overrides that set no value, with Hydra's own node.

    Raises:
        ValueError: for an unknown choice, and where choices do not fit together.
    """
    try:
        return compose("config", [*overrides], return_hydra_config=True)
    except MissingConfigException as error:
        nested = str(error.missing_cfg_file).rpartition("/")[0]
        group = nested if nested.startswith("hydra/") else nested.partition("/")[0]
        path = str(error.missing_cfg_file).removeprefix(f"{group}/")
        raise unknown_choice(group, path, [*(error.options or listed(nested))]) from error
    except (HydraException, OmegaConfBaseException) as error:
        for override in map(parsed, overrides):
            if (group := override.key_or_group) in NOT_BY_DEFAULT and not override.is_add():
                raise ValueError(f"{group} is not chosen by default: write +{group}=NAME, with a plus") from error
        for cause in (error, error.__cause__, error.__context__):
            if isinstance(cause, ConfigKeyError | ConfigAttributeError) and cause.full_key:
                raise unknown_key(str(cause.full_key), composed([])) from error
        raise ValueError(" ".join(f"{error} {error.__cause__ or ''}".split())) from error


def unknown_choice(group: str, name: str, options: Sequence[str]) -> ValueError:
    """The error of a choice that there is not, with the nearest ones."""
    what = f"unknown {group} {name!r}" if group else f"unknown configuration {name!r}"
    mesh = f"; a mesh of your own is dataset=mesh dataset.path={name}" if group == "dataset" else ""
    hint = nearest(name, [option for option in options if not option.startswith("_")])  # others build on these
    return ValueError(what + hint + (mesh if "/" in name or "." in name else ""))


def unknown_key(key: str, config: DictConfig) -> ValueError:
    """The error of a key that a configuration lacks, with the nearest ones."""
    if key.startswith("renderer.") and CLASS_PACKAGE_KEY in (config.get("renderer") or ()):
        return ValueError(f"unknown key {key!r}: an argument of your class is set by +{key}=VALUE, with a plus")
    names = dotted(config.hydra, "hydra.") if key.startswith("hydra.") else dotted(config)
    return ValueError(f"unknown key {key!r}{nearest(key, names)}")


def dotted(node: Any, prefix: str = "") -> list[str]:
    """Every dotted key of a configuration, without Hydra's."""
    if OmegaConf.is_config(node):
        node = OmegaConf.to_container(node)
    keys = {f"{prefix}{key}": child for key, child in node.items() if key != "hydra"}
    within = (name for key, child in keys.items() if isinstance(child, dict) for name in dotted(child, f"{key}."))
    return [*keys, *within]


@dataclass(frozen=True)
class Tree:
    """What a combination of choices composes to, without Hydra's node, and the names of all choices by group."""

    config: DictConfig
    choices: dict[str, Any]


@dataclass(frozen=True)
class Resolved:
    """The plain configuration of cells that differ in the shape or the seed alone, and overrides that go to others."""

    values: dict[str, Any]
    choices: dict[str, Any]
    left_out: set[str]


class Composer:
    """Gives the configurations of a command line's cells, within `composing`."""

    def __init__(self, texts: Sequence[str]) -> None:
        overrides = [*map(parsed, texts)]
        hydra = [override for override in overrides if override.is_hydra_override()]
        self.task = [str(override.input_line) for override in overrides if not override.is_hydra_override()]
        self.always = [str(override.input_line) for override in hydra if not sets_value(override)]
        self.settings = [override for override in hydra if sets_value(override)]
        for override in hydra:
            if override.is_sweep_override():
                raise ValueError(
                    f"{override.key_or_group} has several values, but a sweep has one launcher: choose one"
                )
        self.trees: dict[tuple[str, ...], Tree] = {}
        self.shared: dict[tuple[str, ...], Resolved] = {}
        self.used: set[str] = set()  # keys that a cell has
        self.lacking: dict[str, DictConfig] = {}  # a configuration that lacks a key, by the key
        self.to_custom: set[str] = set()  # groups of which a choice waits for its class, beside choices with one

    def whole(self) -> DictConfig:
        """The configuration without what is swept over, with Hydra's node; keys that it lacks are in `lacking`.

        Raises:
            ValueError: for an unknown choice, an unknown key of Hydra's, and a value of the wrong type.
        """
        fixed = [override for override in map(parsed, self.task) if not override.is_sweep_override()]
        config = composed([*self.always, *(str(o.input_line) for o in fixed if not sets_value(o))])
        for override in self.settings:
            if not set_value(override, config):
                raise unknown_key(override.key_or_group, config)
        for override in filter(sets_value, fixed):
            if not set_value(override, config):
                self.lacking.setdefault(override.key_or_group, config)
        return config

    def single(self, config: DictConfig) -> Identity:
        """The run that `whole` describes.

        Raises:
            ValueError: for an unknown key, a key of several values and an invalid value.
        """
        for override in map(parsed, self.task):
            if override.is_sweep_override():
                raise _several(override)
        self.check_keys()
        tree = _tree(config)
        return identify(resolve_config(tree.config, tree.choices), tree.choices, self.task)

    def swept(self, config: DictConfig) -> list[list[str]]:
        """The overrides of each cell of the sweep that `whole` describes.

        Raises:
            ValueError: where the sweep has no cell.
        """
        self.lacking.clear()  # cells may have what the whole lacks
        params, choices = OmegaConf.select(config, "hydra.sweeper.params") or {}, config.hydra.runtime.choices
        methods = "renderer" if choices.get("method") else ""  # a method brings its renderer
        pairs = [f"{key}={value}" for key, value in params.items() if key != methods or value != choices.renderer]
        swept = combinations([*pairs, *self.task])
        if not swept:
            raise ValueError(f"the sweep has no cell: {' '.join(self.task)}")
        self.to_custom = _waiting(swept)
        return swept

    def cells(self, swept: Sequence[list[str]]) -> list[Identity]:
        """The runs of a sweep. A value goes to the cells that have its key; cells that are then equal are one.

        Raises:
            ValueError: for an invalid cell, and a key that no cell has.
        """
        common = set.intersection(*map(set, swept))
        cells: dict[tuple[str, ...], Identity] = {}
        for number, overrides in enumerate(swept, 1):
            try:
                identity = self.identity(overrides)
            except ValueError as error:
                differing = " ".join(override for override in overrides if override not in common)
                where = f"cell {number} of {len(swept)} ({differing}): " if differing else ""
                raise ValueError(f"{where}{error}; nothing was run") from error
            cells.setdefault(tuple(identity.overrides), identity)
        self.check_keys()
        return [*cells.values()]

    def check_keys(self) -> None:
        """Raises ValueError for a key of the command line that no cell has."""
        for key, config in self.lacking.items():
            if key not in self.used:
                raise unknown_key(key, config)

    def identity(self, cell: list[str]) -> Identity:
        """The run that a cell is; it shares parts of its configuration with others.

        Raises:
            ValueError: where it cannot be composed, or is invalid.
        """
        lone = {match[1]: int(match[2]) for text in cell if (match := LONE.fullmatch(text))}
        alike = tuple(text.partition("=")[0] if LONE.fullmatch(text) else text for text in cell)
        if (common := self.shared.get(alike)) is None:
            config, common = self._resolved(cell)
            if not _asks(OmegaConf.to_container(config)):
                self.shared[alike] = common
        overrides = [text for text in cell if parsed(text).get_key_element() not in common.left_out]
        return identify(common.values | lone, common.choices, overrides)

    def _resolved(self, cell: list[str]) -> tuple[DictConfig, Resolved]:
        """A cell's configuration, and the same with all values resolved."""
        overrides = [*map(parsed, cell)]
        left_out = _of_custom(overrides, self.to_custom)
        overrides = [override for override in overrides if override.get_key_element() not in left_out]
        others = tuple(str(override.input_line) for override in overrides if not sets_value(override))
        if others not in self.trees:
            self.trees[others] = _tree(composed([*self.always, *others]))
        tree = self.trees[others]
        config = deepcopy(tree.config)
        for override in filter(sets_value, overrides):
            key = override.key_or_group
            if set_value(override, config):
                self.used.add(key)
            else:
                left_out.add(key)
                self.lacking.setdefault(key, config)
        return config, Resolved(resolve_config(config, tree.choices), tree.choices, left_out)


def without_hydra(config: DictConfig) -> DictConfig:
    """The same configuration, which loses Hydra's node."""
    OmegaConf.set_struct(config, False)
    del config["hydra"]
    OmegaConf.set_struct(config, True)
    return config


def _tree(config: DictConfig) -> Tree:
    choices: Any = OmegaConf.to_container(config.hydra.runtime.choices)
    return Tree(without_hydra(config), choices)


def _several(override: Override) -> ValueError:
    """The error of a key with several values in a command that makes one run."""
    key, values = override.key_or_group, str(override.input_line).partition("=")[2]
    text = f"{key} has several values: add -m for a run of each"
    quoted = f", write {key}=[{values}] for a list, or quote it where it is one value: '{key}=\"{values}\"'"
    return ValueError(text + quoted if sets_value(override) else text)


def _waits(group: str, name: Any) -> bool:
    """Whether a choice waits for its class, as `renderer=custom` does."""
    choice = listed(group).get(str(name))
    return choice is not None and choice.content.get("_target_") == MISSING


def _waiting(swept: Sequence[list[str]]) -> set[str]:
    """The groups of which a sweep has a choice that waits for its class, and choices that have one."""
    pairs = {text.partition("=")[::2] for cell in swept for text in cell}
    waiting = {group for group, name in pairs if _waits(group, name)}
    return {group for group, name in pairs if group in waiting and not _waits(group, name)}


def _of_custom(overrides: Sequence[Override], groups: set[str]) -> set[str]:
    """The overrides that go to `renderer=custom` alone, where a cell has another: its class, arguments and label."""
    keys = {override.get_key_element(): override.value() for override in overrides}
    others = [group for group in groups if f"{group}._target_" in keys and not _waits(group, keys.get(group))]
    left_out = {key for key in keys for group in others if key.startswith((f"{group}._target_", f"+{group}."))}
    return left_out | ({"label"} if others else set())


def _asks(node: Any) -> bool:
    """Whether a value of a configuration may refer to a single number."""
    if isinstance(node, dict | list):
        return any(map(_asks, node.values() if isinstance(node, dict) else node))
    return ASKING.search(str(node)) is not None
