"""Shared by all tests: types and shapes are checked at every signature of ours, and torch keeps to one thread."""

import bench  # noqa: F401, before all else: it sets the OpenMP variables, which torch reads once

# isort: split
import sys
from collections.abc import Callable

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


def pytest_configure(config: pytest.Config) -> None:
    """Lets pass what beartype says of OmegaConf's classes, which build on `typing`; all other warnings are errors."""
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

    def composed(*overrides: str):
        register()
        with initialize_config_dir(str(CONF), version_base="1.3"):
            return compose("config", overrides=list(overrides))

    return composed


@pytest.fixture
def isolated(monkeypatch, capsys, tmp_path) -> Callable:
    """A command line in this process, whose runs have processes of their own: gives its exit status and outputs."""
    from hydra.core.global_hydra import GlobalHydra

    from bench.__main__ import main

    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")  # so that it is put back

    def run(*arguments: str):
        GlobalHydra.instance().clear()
        monkeypatch.setattr(sys, "argv", ["bench", *arguments, f"results_dir={tmp_path / 'r'}"])
        code = main()
        return code, *capsys.readouterr()

    return run
