"""Composes the cells of a sweep: all that uses what is internal to Hydra's sweeps stands here and in `Planner`.

Hydra takes a tenth of a second for a cell. It composes one cell of each combination of choices; the others differ from
it in values alone, which are set in its place. Values that refer to others take milliseconds; they are made once for
all cells that differ in the shape or the seed alone.
"""

import re
from copy import deepcopy
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, cast

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from omegaconf import DictConfig, OmegaConf

from bench.records.folder import Identity, identify, resolved
from bench.records.read import Plan, PlannedCell
from bench.records.record import digest

LONE = re.compile(r"(index|seed)=(0|[1-9]\d*)")  # overrides of a single number
ASKING = re.compile(r"\$\{.*(index|seed)", re.DOTALL)  # a value that may refer to one of these


@cache
def parsed(override: str) -> Override:
    """An override of the command line, as Hydra reads it."""
    return OverridesParser.create().parse_override(override)


class ReadOnce(CachingConfigRepository):
    """The files of the configuration, each read once for all cells; Hydra's own repository is copied for each cell."""

    def __deepcopy__(self, memo: dict[int, Any]) -> "ReadOnce":
        return self


@dataclass
class Composed:
    """A cell that Hydra has composed, without Hydra's own node, and the overrides that it has by now."""

    config: DictConfig
    runtime: DictConfig
    overrides: list[str]


class Composer:
    """Gives the configuration of each cell of a sweep, as Hydra would compose it."""

    def __init__(self, config: DictConfig) -> None:
        self.loader: Any = GlobalHydra.instance().config_loader()
        self.loader.repository = ReadOnce(self.loader.repository)
        self.config = config
        self.known: dict[tuple[str, ...], Composed] = {}
        self.resolved: dict[tuple[str, ...], tuple[dict[str, Any], DictConfig]] = {}

    def identity(self, cell: list[str]) -> Identity:
        """The run that a cell is; it shares parts of its configuration with others.

        Raises:
            HydraException, OmegaConfBaseException: where it cannot be composed.
            ValueError: where it is invalid.
        """
        lone = {found[1]: int(found[2]) for text in cell if (found := LONE.fullmatch(text))}
        alike = tuple(_key(text) if LONE.fullmatch(text) else text for text in cell)
        if alike in self.resolved:
            values, runtime = self.resolved[alike]
            return identify(values | lone, runtime, cell)
        composed = self.of(cell)
        values = resolved(composed.config, composed.runtime)
        if not _asks(OmegaConf.to_container(composed.config)):
            self.resolved[alike] = values, composed.runtime
        return identify(values, composed.runtime, cell)

    def of(self, cell: list[str]) -> Composed:
        """The cell with these overrides; it holds until the next one is asked for.

        Raises:
            HydraException, OmegaConfBaseException: where it cannot be composed.
        """
        kind = tuple(_key(text) if self._sets_a_value(text, cell) else text for text in cell)
        if (same := self.known.get(kind)) is not None:
            changed = [parsed(text) for text, before in zip(cell, same.overrides, strict=True) if text != before]
            try:
                ConfigLoaderImpl._apply_overrides_to_config(changed, same.config)
            except Exception:  # noqa: BLE001 - Hydra says it as it says it of a whole cell
                del self.known[kind]
            else:
                same.overrides = cell
                return same
        composed = self.loader.load_sweep_config(self.config, cell)
        runtime = composed.hydra.runtime
        OmegaConf.set_struct(composed, False)
        del composed["hydra"]
        OmegaConf.set_struct(composed, True)
        self.known[kind] = Composed(deepcopy(composed), runtime, cell)  # of its own: what is read once is shared
        return self.known[kind]

    def _sets_a_value(self, text: str, cell: list[str]) -> bool:
        """Whether an override of a cell sets one value, and nothing else in the cell sets a part of it or all of it."""
        override, key = parsed(text), _key(text)
        if override.type != OverrideType.CHANGE or override.package is not None or override.is_hydra_override():
            return False
        if isinstance(override.value(), dict | list) or self.loader.repository.group_exists(key):
            return False
        others = map(_key, cell)
        return not any(other.startswith(f"{key}.") or key.startswith(f"{other}.") for other in others)


def swept_over(config: DictConfig) -> list[list[str]]:
    """The overrides of each cell of the sweep that the command line describes.

    Raises:
        ValueError: where the sweep has no cell.
    """
    params = OmegaConf.select(config, "hydra.sweeper.params") or {}
    typed = cast(list[str], OmegaConf.to_container(config.hydra.overrides.task))  # a cell's ${seed} is that of the cell
    swept = combinations([*(f"{key}={value}" for key, value in params.items()), *typed])
    if not swept:
        raise ValueError(f"the sweep has no cell: {' '.join(typed)}")
    return swept


def make_plan(config: DictConfig, swept: list[list[str]]) -> Plan:
    """All cells of a sweep, from the overrides of each.

    Raises:
        HydraException, OmegaConfBaseException: where a cell cannot be composed.
        ValueError: for an invalid cell.
    """
    composer, common = Composer(config), set.intersection(*map(set, swept))
    cells: list[PlannedCell] = []
    for number, overrides in enumerate(swept, 1):
        try:
            cells.append(planned(composer.identity(overrides)))
        except ValueError as error:
            differing = " ".join(override for override in overrides if override not in common)
            where = f"cell {number} of {len(swept)} ({differing}): " if differing else ""
            raise ValueError(f"{where}{error}; nothing was run") from error
    first = cells[0].config
    name = f"{first['experiment'] or cells[0].task}-{digest([cell.id for cell in cells])}"
    return Plan(name, Path(first["results_dir"]), cells)


def planned(identity: Identity) -> PlannedCell:
    """The cell of a sweep that is a run."""
    config = identity.config
    return PlannedCell(identity.name, identity.overrides, **identity.choices, seed=config["seed"], config=config)


def identity_of(cell: PlannedCell) -> Identity:
    """The identity of a planned cell's run."""
    choices = {name: getattr(cell, name) for name in ("task", "renderer", "dataset", "method")}
    return Identity(choices, cell.config, cell.overrides)


def combinations(texts: list[str]) -> list[list[str]]:
    """The overrides of each cell, from those of a sweep, such as `seed=0,1`, in the order in which Hydra runs them."""
    parser = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader())
    return BasicSweeper.split_arguments(parser.parse_overrides(texts), None)[0]


def _asks(node: Any) -> bool:
    """Whether a value of a configuration may refer to a single number."""
    if isinstance(node, dict | list):
        return any(map(_asks, node.values() if isinstance(node, dict) else node))
    return ASKING.search(str(node)) is not None


def _key(override: str) -> str:
    return override.partition("=")[0].lstrip("+~")
