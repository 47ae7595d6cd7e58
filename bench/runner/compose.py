"""Composes the configurations of a command line by Hydra's `compose`, once for each combination of choices.

A composition takes a tenth of a second. The values of a cell are set on a copy of it. Resolving references between
values takes milliseconds; it is done once for all cells that differ only in `index` or `seed`.
"""

import pickle
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
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

from bench.config import CLASS_PACKAGE_KEY, Config, custom_renderer_hint, type_of, wrong_type_message
from bench.records.folder import planned_run, resolve_config
from bench.records.results import PlannedRun
from bench.runner.messages import OPTIONAL_GROUPS
from bench.tables import CONF, folders, group_choices, nearest, register_resolvers, register_rows

NUMBER_OVERRIDE = re.compile(r"(index|seed)=(0|[1-9]\d*)")
SETTING_TYPES = (OverrideType.CHANGE, OverrideType.FORCE_ADD)
# Arguments with a default that no YAML has: there, they would change the hashes of all runs.
OPTIONAL_KEYS = ("view.rays_per_pixel", "task.pixel_block", "task.optimiser.ends", "task.optimiser.start_noise")
INDEX_OR_SEED_REFERENCE = re.compile(r"\$\{[^}]*(index|seed)")


class ChoiceSource(ConfigSource):
    """Hydra's access to the files and rows that `bench.tables` lists, each parsed once."""

    @staticmethod
    def scheme() -> str:
        """The scheme of the source's address on Hydra's search path."""
        return "listed"

    def available(self) -> bool:
        """Always true."""
        return True

    def is_group(self, config_path: str) -> bool:
        """Whether a path is a group with choices."""
        return bool(group_choices(config_path.strip("/")))

    def is_config(self, config_path: str) -> bool:
        """Whether a path is a choice of a group."""
        group, _, name = config_path.rpartition("/")
        return name.removesuffix(".yaml") in group_choices(group)

    def load_config(self, config_path: str) -> ConfigResult:
        """The content of a choice, and the package of its keys."""
        group, _, name = config_path.rpartition("/")
        node, package = group_choices(group)[name.removesuffix(".yaml")].load()
        return ConfigResult(self.provider, self.full_path(), node, {"package": package})

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        """The choices of a group."""
        return [] if results_filter == ObjectType.GROUP else sorted(group_choices(config_path.strip("/")))


class SearchPath(SearchPathPlugin):
    """Makes Hydra search `ChoiceSource` first, and the user's folders last, for groups that the user adds."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Adds both to Hydra's search path."""
        search_path.prepend("implicit-bench", "listed://")
        for folder in folders():
            search_path.append("command-line", f"file://{folder.absolute()}")


@contextmanager
def composing(*config_dirs: Path) -> Iterator[None]:
    """The context in which a `Composer` can use conf and the user's folders.

    Raises:
        ValueError: if a folder does not exist, or a table cannot be read.
    """
    for folder in config_dirs:
        if not folder.is_dir():
            raise ValueError(f"--config-dir {folder}: there is no such folder")
    ConfigStore.instance().store(name="schema", node=Config)
    Plugins.instance().register(ChoiceSource)
    Plugins.instance().register(SearchPath)
    register_rows(config_dirs)
    register_resolvers()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        yield


@cache
def parse_override(text: str) -> Override:
    """An override of the command line, as Hydra reads it.

    Raises:
        OverrideParseException: if it is not an override.
    """
    return OverridesParser.create().parse_overrides([text])[0]


def combinations(texts: Sequence[str]) -> list[list[str]]:
    """The overrides of each cell of a sweep, from overrides such as `seed=0,1`; for equal keys the last one counts.

    Raises:
        ValueError: if an override is an interval, which has no list of values.
    """
    parser = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader())  # for globs
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
    """Whether an override sets a key, with `++` also a new one. Hydra applies those that choose, add or remove."""
    key = override.key_or_group
    is_group = group_choices(key) and not isinstance(override.value(), dict)
    chooses = override.package is not None or "/" in key or is_group
    if is_group and isinstance(override.value(), list) and not all(isinstance(name, str) for name in override.value()):
        raise ValueError(f"{override.input_line}: {key} is chosen by a name: write {key}=NAME")
    return override.type in SETTING_TYPES and not chooses and key != "hydra.searchpath"


def set_value(override: Override, config: DictConfig) -> bool:
    """Sets the value of a key; returns whether the configuration has the key.

    Raises:
        ValueError: if the value has the wrong type, or an unknown key in it.
    """
    key, value = override.key_or_group, override.value()
    try:
        OmegaConf.update(config, key, value, merge=True, force_add=override.type == OverrideType.FORCE_ADD)
    except (ConfigAttributeError, ConfigKeyError) as error:
        if isinstance(value, dict) and OmegaConf.select(config, key) is not None:
            raise unknown_key(str(error.full_key), config) from error
        return False
    except OmegaConfBaseException as error:
        raise ValueError(wrong_type_message(key, str(override.input_line).partition("=")[2], type_of(key))) from error
    return True


def compose_choices(overrides: Sequence[str]) -> DictConfig:
    """Hydra's composition of the overrides that set no value, with Hydra's node.

    Raises:
        ValueError: if a choice is unknown, or choices do not fit together.
    """
    try:
        return compose("config", [*overrides], return_hydra_config=True)
    except MissingConfigException as error:
        nested = str(error.missing_cfg_file).rpartition("/")[0]
        group = nested if nested.startswith("hydra/") else nested.partition("/")[0]
        path = str(error.missing_cfg_file).removeprefix(f"{group}/")
        raise unknown_choice(group, path, [*(error.options or group_choices(nested))]) from error
    except (HydraException, OmegaConfBaseException) as error:
        for override in map(parse_override, overrides):
            group, has_plus = override.key_or_group, str(override.input_line).startswith("+")
            if group in OPTIONAL_GROUPS and not has_plus:
                raise ValueError(f"{group} is not chosen by default: write +{group}=NAME, with a plus") from error
            if has_plus and group in compose_choices([]).hydra.runtime.choices and group not in OPTIONAL_GROUPS:
                raise ValueError(f"{group} is chosen by default: write {group}=NAME, without a plus") from error
        for cause in (error, error.__cause__, error.__context__):
            if isinstance(cause, ConfigKeyError | ConfigAttributeError) and cause.full_key:
                raise unknown_key(str(cause.full_key), compose_choices([])) from error
        raise ValueError(" ".join(f"{error} {error.__cause__ or ''}".split())) from error


def unknown_choice(group: str, name: str, options: Sequence[str]) -> ValueError:
    """The error for an unknown choice, with similar choices."""
    text = f"unknown {group} {name!r}" if group else f"unknown configuration {name!r}"
    remedies = {"renderer": custom_renderer_hint("mypkg.Mine"), "stress": "conf/README.md has the meaning of each"}
    remedies["experiment"] = "a file of your own needs --config-dir FOLDER"
    if "/" in name or "." in name:
        remedies = {"dataset": f"a mesh of your own is dataset=mesh dataset.path={name}"}
    hint = nearest(name, [option for option in options if not option.startswith("_")])  # choices with _ are only bases
    return ValueError(f"{text}{hint}{f'; {remedies[group]}' if group in remedies else ''}")


def unknown_key(key: str, config: DictConfig) -> ValueError:
    """The error for a key that a configuration lacks, with similar keys."""
    if key in OPTIONAL_KEYS or (key.startswith("renderer.") and CLASS_PACKAGE_KEY in (config.get("renderer") or ())):
        return ValueError(f"the YAML does not have the key {key!r}: it is set by +{key}=VALUE, with a plus")
    if key.startswith("hydra.launcher.") and "executor" not in config.hydra.launcher:  # Hydra's own launcher
        launchers = " or ".join(f"hydra/launcher={name}" for name in group_choices("hydra/launcher"))
        return ValueError(f"unknown key {key!r}: keys of a launcher need {launchers}")
    names = dotted_keys(config.hydra, "hydra.") if key.startswith("hydra.") else dotted_keys(config)
    return ValueError(f"unknown key {key!r}{nearest(key, names)}")


def dotted_keys(node: Any, prefix: str = "") -> list[str]:
    """All dotted keys of a configuration, without Hydra's node."""
    if OmegaConf.is_config(node):
        node = OmegaConf.to_container(node)
    keys = {f"{prefix}{key}": child for key, child in node.items() if key != "hydra"}
    inner = (name for key, child in keys.items() if isinstance(child, dict) for name in dotted_keys(child, f"{key}."))
    return [*keys, *inner]


@dataclass(frozen=True)
class ResolvedCells:
    """The resolved configuration of cells that differ only in `index` or `seed`, and the keys left out."""

    values: dict[str, Any]
    choices: dict[str, Any]
    left_out: set[str]


class Composer:
    """Composes the configurations of a command line's cells; to be used within `composing`."""

    def __init__(self, texts: Sequence[str]) -> None:
        self.overrides = [*map(parse_override, texts)]
        hydra = [override for override in self.overrides if override.is_hydra_override()]
        self.hydra_choices = [str(override.input_line) for override in hydra if not sets_value(override)]
        self.run_overrides = [str(override.input_line) for override in self.overrides if override not in hydra]
        if swept := [override.key_or_group for override in hydra if override.is_sweep_override()]:
            raise ValueError(f"{swept[0]} has several values, but a sweep has one launcher: choose one")
        self.composed: dict[tuple[str, ...], tuple[bytes, dict[str, Any]]] = {}  # pickled, to be copied fast
        self.resolved_cells: dict[tuple[str, ...], ResolvedCells] = {}
        self.used_keys: set[str] = set()  # keys that at least one cell has
        self.lacking_keys: dict[str, DictConfig] = {}  # by key: a configuration without it
        self.mixed_groups: set[str] = set()  # groups swept over custom and other choices

    def shared_config(self) -> DictConfig:
        """The configuration without swept values, with Hydra's node; `lacking_keys` gets the keys that it lacks.

        Raises:
            ValueError: if a choice or a key of Hydra is unknown, or a value has the wrong type.
        """
        fixed = [override for override in self.overrides if not override.is_sweep_override()]
        config = compose_choices([str(override.input_line) for override in fixed if not sets_value(override)])
        for override in filter(sets_value, fixed):
            if not set_value(override, config):
                if override.is_hydra_override():
                    raise unknown_key(override.key_or_group, config)
                self.lacking_keys.setdefault(override.key_or_group, config)
        return config

    def single_run(self, config: DictConfig) -> PlannedRun:
        """The run of the configuration `shared_config`.

        Raises:
            ValueError: if a key is unknown or has several values, or a value is invalid.
        """
        for override in self.overrides:
            if override.is_sweep_override():
                key, values = override.key_or_group, str(override.input_line).partition("=")[2]
                quoted = f", write {key}=[{values}] for a list, or quote it where it is one value: '{key}=\"{values}\"'"
                hint = quoted if sets_value(override) else ""
                raise ValueError(f"{key} has several values: add -m for a run of each{hint}")
        self.check_keys()
        config, choices = _split_off_choices(config)
        return planned_run(resolve_config(config, choices), choices, self.run_overrides)

    def swept(self, config: DictConfig) -> list[list[str]]:
        """The overrides of each cell of the sweep with the configuration `shared_config`.

        Raises:
            ValueError: if the sweep has no cell.
        """
        self.lacking_keys.clear()  # cells may have keys that the shared configuration lacks
        params, choices = OmegaConf.select(config, "hydra.sweeper.params") or {}, config.hydra.runtime.choices
        method_key = "renderer" if choices.get("method") else ""  # a method sets its renderer
        pairs = [f"{key}={value}" for key, value in params.items() if key != method_key or value != choices.renderer]
        swept = combinations([*pairs, *self.run_overrides])
        if not swept:
            raise ValueError(f"the sweep has no cell: {' '.join(self.run_overrides)}")
        self.mixed_groups = _groups_with_custom(swept)
        return swept

    def cells(self, swept: Sequence[list[str]]) -> list[PlannedRun]:
        """The runs of a sweep. A value goes to the cells that have its key; equal cells are merged.

        Raises:
            ValueError: if a cell is invalid, or no cell has a key.
        """
        common = set.intersection(*map(set, swept))
        cells: dict[tuple[str, ...], PlannedRun] = {}
        for number, overrides in enumerate(swept, 1):
            try:
                cell = self.planned_cell(overrides)
            except ValueError as error:
                differing = " ".join(override for override in overrides if override not in common)
                where = f"cell {number} of {len(swept)} ({differing}): " if differing else ""
                raise ValueError(f"{where}{error}; nothing was run") from error
            cells.setdefault(tuple(cell.overrides), cell)
        self.check_keys()
        return [*cells.values()]

    def check_keys(self) -> None:
        """Raises ValueError if no cell has a key of the command line."""
        for key, config in self.lacking_keys.items():
            if key not in self.used_keys:
                raise unknown_key(key, config)

    def planned_cell(self, cell: list[str]) -> PlannedRun:
        """The run of a cell; it shares nodes of its configuration with other cells.

        Raises:
            ValueError: if it cannot be composed, or is invalid.
        """
        numbers = {match[1]: int(match[2]) for text in cell if (match := NUMBER_OVERRIDE.fullmatch(text))}
        cache_key = tuple(text.partition("=")[0] if NUMBER_OVERRIDE.fullmatch(text) else text for text in cell)
        if (resolved := self.resolved_cells.get(cache_key)) is None:
            config, resolved = self._resolve(cell)
            if INDEX_OR_SEED_REFERENCE.search(str(OmegaConf.to_container(config))) is None:
                self.resolved_cells[cache_key] = resolved
        overrides = [text for text in cell if parse_override(text).get_key_element() not in resolved.left_out]
        return planned_run(resolved.values | numbers, resolved.choices, overrides)

    def _resolve(self, cell: list[str]) -> tuple[DictConfig, ResolvedCells]:
        """A cell's configuration, unresolved and resolved."""
        overrides = [*map(parse_override, cell)]
        left_out = _keys_for_custom(overrides, self.mixed_groups)
        overrides = [override for override in overrides if override.get_key_element() not in left_out]
        choices = tuple(str(override.input_line) for override in overrides if not sets_value(override))
        if choices not in self.composed:
            shared_config, names = _split_off_choices(compose_choices([*self.hydra_choices, *choices]))
            self.composed[choices] = pickle.dumps(shared_config), names
        content, names = self.composed[choices]
        config = pickle.loads(content)
        for override in filter(sets_value, overrides):
            key = override.key_or_group
            if set_value(override, config):
                self.used_keys.add(key)
            else:
                left_out.add(key)
                self.lacking_keys.setdefault(key, config)
        return config, ResolvedCells(resolve_config(config, names), names, left_out)


def without_hydra(config: DictConfig) -> DictConfig:
    """Removes Hydra's node from the configuration and returns it."""
    OmegaConf.set_struct(config, False)
    del config["hydra"]
    OmegaConf.set_struct(config, True)
    return config


def _split_off_choices(config: DictConfig) -> tuple[DictConfig, dict[str, Any]]:
    """The configuration without Hydra's node, and the names of all choices by group."""
    choices: Any = OmegaConf.to_container(config.hydra.runtime.choices)
    return without_hydra(config), choices


def _needs_class(group: str, name: Any) -> bool:
    """Whether a choice needs a class on the command line, as `renderer=custom` does."""
    choice = group_choices(group).get(str(name))
    return choice is not None and choice.content.get("_target_") == MISSING


def _groups_with_custom(swept: Sequence[list[str]]) -> set[str]:
    """The groups of which a sweep has both a choice that needs a class and a choice that has one."""
    pairs = {text.partition("=")[::2] for cell in swept for text in cell}
    custom_groups = {group for group, name in pairs if _needs_class(group, name)}
    return {group for group, name in pairs if group in custom_groups and not _needs_class(group, name)}


def _keys_for_custom(overrides: Sequence[Override], groups: set[str]) -> set[str]:
    """The keys that go only to `renderer=custom`, if a cell has another renderer: class, arguments and label."""
    keys = {override.get_key_element(): override.value() for override in overrides}
    others = [group for group in groups if f"{group}._target_" in keys and not _needs_class(group, keys.get(group))]
    left_out = {key for key in keys for group in others if key.startswith((f"{group}._target_", f"+{group}."))}
    return left_out | ({"label"} if others else set())
