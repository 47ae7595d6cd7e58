"""Configurations as the command line composes them; each file of conf is read once for all tests of a process."""

from copy import deepcopy
from dataclasses import replace
from functools import cache

from hydra import compose, initialize_config_dir
from hydra._internal.config_repository import CachingConfigRepository
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from bench.config import register
from bench.records.folder import Identity, identify, resolved
from bench.records.read import PlannedCell
from bench.run.command import options_first
from bench.run.compose import make_plan, swept_over
from bench.tables import CONF

_KEPT: dict[str, CachingConfigRepository] = {}


class ReadOnce(CachingConfigRepository):
    """The files of the configuration, each read once; a composition may change its copy."""

    def load_config(self, config_path: str):
        """What Hydra makes of a file or a row; None where there is none."""
        found = super().load_config(config_path)
        return found and replace(found, config=deepcopy(found.config))


@cache
def composed(*overrides: str, hydra: bool = False) -> DictConfig:
    """The configuration of some overrides, with Hydra's own node where it is asked for: only to be read."""
    register()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        loader: ConfigLoader = GlobalHydra.instance().config_loader()
        loader.repository = _KEPT.setdefault("all", ReadOnce(loader.repository))
        return compose("config", overrides=list(overrides), return_hydra_config=hydra)


def identified(*arguments: str) -> Identity:
    """The run that a command line describes."""
    overrides = options_first([*arguments])
    GlobalHydra.instance().clear()
    config = deepcopy(composed(*overrides, hydra=True))
    runtime = config.hydra.runtime
    OmegaConf.set_struct(config, False)
    del config["hydra"]
    return identify(resolved(config, runtime), runtime, overrides)


def cells_of(*overrides: str) -> list[PlannedCell]:
    """The cells of a sweep, as its plan lists them."""
    register()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = GlobalHydra.instance().config_loader().load_configuration("config", [*overrides], RunMode.MULTIRUN)
        return make_plan(config, swept_over(config)).cells
