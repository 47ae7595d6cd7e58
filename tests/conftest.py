"""Shared by all tests. CHECK_TYPES=1 checks the types and shapes of every call of this project, in twice the time."""

import bench  # noqa: F401, before all else: it sets the OpenMP variables, which torch reads once

# isort: split
import gc
import os
import pickle
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from beartype import BeartypeConf, beartype
from beartype.roar import BeartypeDecorHintPep585DeprecationWarning
from hypothesis import settings
from jaxtyping import install_import_hook

CHECKED = beartype(conf=BeartypeConf(is_pep484_tower=True))  # PEP 484 takes an int where a float is asked for


def checked(function: Callable) -> Callable:
    """Checks the types of a call, each once.

    jaxtyping calls one function before a call, with its arguments, and a second one after it, with its result too.
    The second function has the names of the shapes from the first, so this function checks only its result.
    """
    result = function.__annotations__.get("return", Any)  # the first function gives Any
    if result is not Any:
        function.__annotations__ = {"return": result}
    return CHECKED(function)


if os.environ.get("CHECK_TYPES"):  # set by `make test-types`; the hook must stand before the imports that it checks
    warnings.simplefilter("ignore", BeartypeDecorHintPep585DeprecationWarning)  # of OmegaConf's, in other conftests
    install_import_hook(["renderers", "datasets", "bench"], "tests.conftest.checked")

settings.register_profile("implicit-bench", deadline=None, derandomize=True)
settings.load_profile("implicit-bench")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Adds the renderer that the contract tests: `-k custom --renderer=mypkg.Mine`."""
    parser.addoption("--renderer", help="class of a renderer, as PACKAGE.CLASS")


SLOWEST = ("runner/test_launchers.py", "runner/test_resume.py", "conf/", "runner/")  # files that take longest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begins with the slowest files, so that no process of pytest-xdist runs one of them alone at the end."""

    def rank(item: pytest.Item) -> int:
        path = item.path.as_posix()
        return next((n for n, prefix in enumerate(SLOWEST) if f"/tests/{prefix}" in path), len(SLOWEST))

    items.sort(key=rank)


def pytest_configure(config: pytest.Config) -> None:
    """Ignores beartype's warning about OmegaConf's classes, which build on `typing`; other warnings are errors."""
    if config.getoption("keyword") == "custom" and config.getoption("--renderer") is None:
        raise pytest.UsageError("-k custom tests a renderer of yours: add --renderer=PACKAGE.CLASS")
    config.option.loadscopereorder = False  # of pytest-xdist, which would begin with the files that have most tests
    config.addinivalue_line("filterwarnings", "ignore::beartype.roar.BeartypeDecorHintPep585DeprecationWarning")


def pytest_collection_finish() -> None:
    """Freezes the objects that imports created, so that the garbage collector skips them."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> None:
    """Uses one thread: the tensors of tests are small, and a second thread costs more than it saves."""
    import torch

    torch.set_num_threads(1)


@contextmanager
def forgetting_modules(folder: Path) -> Iterator[None]:
    """After the block, the modules that it imported from a folder are no longer imported."""
    before = {*sys.modules}
    yield
    for name in sys.modules.keys() - before:
        if Path(getattr(sys.modules[name], "__file__", None) or "").is_relative_to(folder):
            del sys.modules[name]


@pytest.fixture(autouse=True)
def forgotten_modules(tmp_path_factory) -> Iterator[None]:
    """Forgets a user's module that a test wrote: the next test may write another module of that name.

    Modules elsewhere stay, since parts of PyTorch cannot be imported twice.
    """
    with forgetting_modules(tmp_path_factory.getbasetemp().resolve()):
        yield


@pytest.fixture(scope="session", autouse=True)
def cached_probes() -> Iterator[None]:
    """Caches git's output and the machine's matrix product rate for all runs in this process.

    `tests.runner.spared` does so for runs in other processes.
    """
    import torch

    from bench.machine import environment
    from bench.runner import process

    measure = environment.gemm_peak
    rate = cache(lambda *arguments: measure(*arguments[:-1]))  # for each number of threads
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(environment, "_git", cache(environment._git))
        patch.setattr(environment, "gemm_peak", lambda *on: rate(*on, torch.get_num_threads()))
        # One server of processes serves all tests. It loads all that runs import, and pytest, which is their program.
        loaded = [*process.preloaded_modules(), "pytest", "tests.runner.spared"]
        patch.setattr(process, "preloaded_modules", lambda: loaded)
        yield


@pytest.fixture(scope="session", autouse=True)
def cached_compositions() -> Iterator[None]:
    """Composes each combination of choices of conf once for all tests of this process; each command gets a copy."""
    from bench.runner import compose
    from bench.tables import folders

    do = compose.compose_choices
    once = cache(lambda choices: pickle.dumps(do(choices)))

    def copied(choices: Sequence[str]) -> Any:
        return do(choices) if folders() else pickle.loads(once(tuple(choices)))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compose, "compose_choices", copied)
        yield


@pytest.fixture(scope="session", autouse=True)
def quick_pages() -> Iterator[None]:
    """Draws figures and pictures of few pixels; their PDF files subset no font."""
    from bench.pictures import distances, figure_style

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(distances, "PIXELS", 140)  # per side of a view, as many as the figure then shows
        patch.setitem(figure_style.RC, "savefig.dpi", 60)
        patch.setitem(figure_style.RC, "pdf.fonttype", 3)
        yield


@pytest.fixture(scope="session", autouse=True)
def without_shipped(tmp_path_factory) -> Iterator[None]:
    """A report shows the user's own tables alone; reading those that a checkout ships takes half a second."""
    from bench.report.write import paper

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper, "SHIPPED", tmp_path_factory.getbasetemp() / "none")
        yield


@pytest.fixture(scope="module")
def few_samples() -> Iterator[None]:
    """Compares the frames of two surfaces by fewer points."""
    from datasets.files import coincidence

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(coincidence, "SAMPLES", (4000, 200))
        patch.setattr(coincidence, "FAST_SAMPLES", (1500, 80))
        yield


@pytest.fixture(scope="session")
def compose_config() -> Callable:
    """Composes a configuration as the command line does, from overrides."""
    from tests.composing import composed

    return lambda *overrides: deepcopy(composed(*overrides))


@pytest.fixture
def isolated(tmp_path) -> Callable:
    """Runs a command line in this process, and its runs in other processes; gives its exit status and outputs."""
    from tests.runner.driving import command

    def run(*arguments: str):
        has_results_dir = any(argument.startswith("results_dir=") for argument in arguments)
        return command(*arguments, *([] if has_results_dir else [f"results_dir={tmp_path / 'r'}"]))

    return run


@pytest.fixture
def undrawn(monkeypatch) -> None:
    """Leaves empty files in place of the figures of a report, which take longer to draw than all else together."""
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda self, path, **_: Path(path).touch())


class Clock:
    """A clock that advances by each sleep, without waiting, and by a microsecond each time that it is read."""

    def __init__(self) -> None:
        self.now = 1000.0

    def read(self) -> float:
        self.now += 1e-6
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch) -> Clock:
    """Replaces the machine's clock, so that a test of times does not depend on how busy the machine is."""
    stand_in = Clock()
    monkeypatch.setattr(time, "perf_counter", stand_in.read)
    monkeypatch.setattr(time, "sleep", stand_in.sleep)
    return stand_in
