"""Runs the cells of a sweep by `hydra/launcher`, by default in this process; `clusters` has other launchers."""

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from importlib import import_module
from itertools import chain
from typing import Any, ClassVar

from omegaconf import DictConfig, OmegaConf

from bench.config import find_class
from bench.progress import notice
from bench.records.results import Plan, PlannedRun
from bench.runner.process import raise_if_stopped
from bench.tables import names
from datasets.extras import install_command

Make = Callable[[PlannedRun], list[str]]  # runs a cell; returns messages if it leaves no record
Jobs = Sequence[Sequence[PlannedRun]]  # the cells, in groups that one job of a cluster runs one after another
Messages = Generator[list[str], None, None]  # of each cell or task that has ended


@dataclass(frozen=True)
class Launcher(ABC):
    """The choice of `hydra/launcher`, which runs the cells of a sweep.

    Args:
        name: the name of the choice.
        settings: `hydra.launcher`; its `executor` is the dotted name of the class, and none of them is `InTurn`.
        variables: environment variables for runs.
    """

    name: str
    settings: dict[str, Any]
    variables: dict[str, str]

    extra: ClassVar[str] = ""  # that it needs, which has the name of its package
    is_local: ClassVar[bool] = True  # whether all runs are on this machine
    runs_per_job: ClassVar[int] = 1  # at a time

    @property
    def concurrency(self) -> int:
        """The number of cells at a time, if its settings have it, else 1; all processors for n_jobs=-1."""
        for key in ("n_jobs", "array_parallelism"):
            if (count := self.settings.get(key)) is not None:
                return max(int(count), 1) if count > 0 else os.cpu_count() or 1
        return 1

    @property
    def rate(self) -> str:
        """The number of cells at a time, in words."""
        return f"{self.concurrency} at a time"

    def check(self, cells: Sequence[PlannedRun]) -> None:  # noqa: B027 - without settings there is nothing to check
        """Raises ValueError if a setting does not fit the cells to run."""

    def jobs(self, plan: Plan, reused: set[str]) -> list[list[PlannedRun]]:
        """The cells of each job, without reused cells."""
        return [[cell] for cell in plan.cells if cell.id not in reused]

    def describe(self, jobs: Jobs) -> str:
        """The number of runs and jobs, as text; empty if each run is its own job."""
        return ""

    @abstractmethod
    def run(self, make: Make, jobs: Jobs) -> Messages:
        """Runs all cells; yields the messages of each cell or job when it ends.

        Raises:
            Exception: if a cluster is missing, or a process is lost.
        """


def launcher_of(config: DictConfig) -> Launcher:
    """The launcher of a composed configuration.

    Raises:
        ValueError: if its executor is no launcher, or needs a package that is not installed.
    """
    settings: Any = OmegaConf.to_container(config.hydra.launcher, resolve=True)
    cls: type[Launcher] = InTurn
    if (executor := settings.get("executor")) is not None:  # Hydra's own launcher, `basic`, has no such key
        try:
            cls = find_class(executor, "hydra.launcher", config.packages, Launcher)
        except ValueError as error:
            choices = ", ".join(["basic", *names("hydra/launcher")])
            text = f"hydra.launcher.executor={executor}: choose hydra/launcher={choices}, or a class: {error}"
            raise ValueError(text) from error
    if cls.extra:
        try:
            import_module(cls.extra)
        except ImportError as error:
            raise ValueError(f"this launcher needs a package: {install_command(cls.extra)}") from error
    variables = {str(key): str(value) for key, value in config.hydra.job.env_set.items()}
    return cls(str(config.hydra.runtime.choices["hydra/launcher"]), settings, variables)


def execute(make: Make, jobs: Jobs, launcher: Launcher) -> bool:
    """Runs all cells; returns whether each left a record. Errors are printed as they occur.

    Raises:
        KeyboardInterrupt: after Ctrl-C or SIGTERM.
        Exception: if a cluster is missing, or a process is lost.
    """
    if not jobs:
        return True
    with closing(launcher.run(make, jobs)) as results:
        return print_errors(results)


def print_errors(results: Iterable[list[str]]) -> bool:
    """Prints the error messages of cells as they end; returns whether there are none."""
    succeeded = True
    for text in chain.from_iterable(results):
        notice(f"error: {text}")
        succeeded = False
    return succeeded


def run_in_turn(make: Make, cells: Iterable[PlannedRun]) -> Messages:
    """Runs cells in this process."""
    for cell in cells:
        yield make(cell)
        raise_if_stopped()  # a library may have swallowed the exception


class InTurn(Launcher):
    """Runs cells in this process, one after another; also those that are reused, in their order."""

    def jobs(self, plan: Plan, reused: set[str]) -> list[list[PlannedRun]]:
        return [[cell] for cell in plan.cells]

    def run(self, make: Make, jobs: Jobs) -> Messages:
        return run_in_turn(make, chain.from_iterable(jobs))
