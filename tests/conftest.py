"""Shared by all tests: types and shapes are checked at every signature of ours, and torch keeps to one thread."""

import bench  # noqa: F401, before all else: it sets the OpenMP variables, which torch reads once

# isort: split
import time
from collections.abc import Callable
from copy import deepcopy

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

# The hook must stand before the first import of what it checks. PEP 484 takes an int where a float is asked for.
CHECKER = "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"
install_import_hook(["renderers", "datasets", "bench"], CHECKER)

settings.register_profile("implicit-bench", deadline=None, derandomize=True)
settings.load_profile("implicit-bench")


def pytest_addoption(parser: pytest.Parser) -> None:
    """The renderer of yours that the contract takes: `-k custom --renderer=mypkg.Mine`."""
    parser.addoption("--renderer", default="tests.user_renderer.Mine", help="class of a renderer, as PACKAGE.CLASS")


SLOWEST = ("run/test_launchers.py", "run/test_resume.py", "conf/", "run/")  # files that take longest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begins with the slowest files, so that no process of pytest-xdist is left alone with one at the end."""

    def place(item: pytest.Item) -> int:
        path = item.path.as_posix()
        return next((n for n, part in enumerate(SLOWEST) if f"/tests/{part}" in path), len(SLOWEST))

    items.sort(key=place)


def pytest_configure(config: pytest.Config) -> None:
    """Lets pass what beartype says of OmegaConf's classes, which build on `typing`; all other warnings are errors."""
    config.option.loadscopereorder = False  # of pytest-xdist, which would begin with the files that have most tests
    config.addinivalue_line("filterwarnings", "ignore::beartype.roar.BeartypeDecorHintPep585DeprecationWarning")


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> None:
    """The tensors of tests are small: a second thread costs more than it brings."""
    import torch

    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def compose_config() -> Callable:
    """Composes a configuration as the command line does, from overrides."""
    from hydra import compose, initialize_config_dir

    from bench.config import CONF, register

    done = {}

    def composed(*overrides: str):
        if overrides not in done:
            register()
            with initialize_config_dir(str(CONF), version_base="1.3"):
                done[overrides] = compose("config", overrides=list(overrides))
        return deepcopy(done[overrides])

    return composed


@pytest.fixture
def isolated(tmp_path) -> Callable:
    """A command line in this process, whose runs have processes of their own: gives its exit status and outputs."""
    from tests.run.driving import command

    def run(*arguments: str):
        given = any(argument.startswith("results_dir=") for argument in arguments)
        return command(*arguments, *([] if given else [f"results_dir={tmp_path / 'r'}"]))

    return run


class Clock:
    """A clock that goes on by what is slept, at once, and by a microsecond each time that it is read."""

    def __init__(self) -> None:
        self.now = 1000.0

    def read(self) -> float:
        self.now += 1e-6
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch) -> Clock:
    """Stands in for the machine's clock, so that a test of times does not depend on how busy the machine is."""
    stand_in = Clock()
    monkeypatch.setattr(time, "perf_counter", stand_in.read)
    monkeypatch.setattr(time, "sleep", stand_in.sleep)
    return stand_in
