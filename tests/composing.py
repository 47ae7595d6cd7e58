"""Configurations as the command line composes them; what composes is composed once for all tests of a process."""

from functools import cache
from pathlib import Path

from omegaconf import DictConfig

from bench.records.results import PlannedRun
from bench.runner.command import options_of
from bench.runner.compose import Composer, composing, without_hydra


@cache
def composed(*overrides: str, hydra: bool = False) -> DictConfig:
    """The configuration of overrides, read-only; with Hydra's own node if `hydra` is set."""
    with composing():
        composer = Composer(overrides)
        config = composer.shared_config()
        composer.check_keys()
    return config if hydra else without_hydra(config)


def identified(*arguments: str) -> PlannedRun:
    """The run that a command line describes."""
    with composing():
        composer = Composer(options_of([*arguments]).overrides)
        return composer.single_run(composer.shared_config())


def cells_of(*overrides: str, folder: Path | None = None, at_most: int | None = None) -> list[PlannedRun]:
    """The cells of a sweep, with a folder of a user's configurations as after `--config-dir`.

    Composing takes a tenth of a second for each combination of choices; `at_most` leaves cells at even distances.
    """
    with composing(*([folder] if folder else [])):
        composer = Composer(overrides)
        swept = composer.swept(composer.shared_config())
        return composer.cells(swept[:: -(-len(swept) // (at_most or len(swept)))])
