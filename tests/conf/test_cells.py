"""The cells of every experiment: their names and overrides are those of cells.json, and the first and last ones build.

At smoke, two cells of each experiment are compared; at desk, in the slow tests, all cells.
After a change of settings, `python -m tests.conf.test_cells` writes the file again; it takes minutes.
"""

import json
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml
from omegaconf import DictConfig, OmegaConf

from bench.pictures.figure_style import look
from bench.records.record import digest
from bench.records.results import PlannedRun
from bench.tables import choice, names
from tests.composing import cells_of, composed
from tests.conf.test_conf import build_part, builds, paths  # noqa: F401, a fixture
from tests.looped import each

FILE = Path(__file__).with_name("cells.json")
EXPERIMENTS = [name for name in names("experiment") if not name.startswith("_")]
SINGLE_RUN_EXPERIMENTS = {"fitted"}  # without a table or figure
# The experiments that share the table or figure of another name.
JOINED = {"fig10_focal": "fig10", "fig10_start": "fig10", "parsimony_resolutions": "parsimony"}
# An experiment that sweeps over rows that several experiments share.
SHARED_ROWS = {"speed_accuracy": "speed_completion", "core": "core_complete"}
COMPARING = {
    "table1": 25,
    "fig4": 7,
    "fig5": 9,
    "stability": 22,
    "gradients": 17,
    "speed_accuracy": 32,
    "fit_for": 19,
}  # renderers
COMPARING |= {"core": 12}
CELLS = {"smoke": 2, "desk": None}  # at most, of an experiment
EXPECTED = json.loads(FILE.read_text(encoding="utf-8")) if FILE.is_file() else {}


@cache
def cells(experiment: str, scale: str) -> list[PlannedRun]:
    """Cells of an experiment, of which the first one is its first."""
    return cells_of(f"+experiment={experiment}", f"scale={scale}", at_most=CELLS[scale])


def summary(experiment: str, scale: str) -> dict[str, int | str]:
    """The number of compared cells of an experiment, and a digest of their names and overrides."""
    compared = cells(experiment, scale)
    return {"cells": len(compared), "digest": digest([[cell.id, cell.overrides] for cell in compared])}


@pytest.mark.parametrize("scale", ["smoke", pytest.param("desk", marks=pytest.mark.slow)])
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_an_experiment_has_its_written_cells(experiment: str, scale: str):
    assert summary(experiment, scale) == EXPECTED[scale][experiment]


def test_the_cells_of_every_experiment_are_written_and_more_than_one():
    assert {scale: {*EXPECTED[scale]} for scale in CELLS} == {scale: {*EXPERIMENTS} for scale in CELLS}
    single = {scale: {name for name in EXPERIMENTS if EXPECTED[scale][name]["cells"] == 1} for scale in CELLS}
    assert single == {scale: SINGLE_RUN_EXPERIMENTS for scale in CELLS}


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_the_first_cell_of_an_experiment_builds(paths, name):  # noqa: F811
    """At smoke; a renderer or a method brings its own settings."""
    (cell, *_) = cells(name, "smoke")
    config = OmegaConf.create(cell.config)
    if name in paths:
        config.dataset.path = paths[name]
    has_keys(config, cell.overrides, name)
    for key, _, value in (text.removeprefix("+").partition("=") for text in cell.overrides):
        if key in ("renderer", "method"):
            brings_its_own(cell.overrides, config, key, value)


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_the_last_cell_of_an_experiment_builds(paths, name):  # noqa: F811
    """At the papers' scale, of a mesh if it names no dataset."""
    cell = cells(name, "desk")[-1].overrides
    mesh = ["dataset=mesh", f"dataset.path={paths['mesh']}"]
    own_path = [f"dataset.path={paths[name]}"] if name in paths else []
    more = own_path if any(text.startswith("dataset=") for text in cell) else mesh
    has_keys(composed(*(text for text in cell if text != "scale=desk"), "scale=paper", *more), cell, name)


def has_keys(config: DictConfig, cell: list[str], name: str) -> None:
    """Asserts that a configuration builds, and has the keys of a cell of an experiment."""
    builds(config)
    assert config.experiment == (None if name in SINGLE_RUN_EXPERIMENTS else JOINED.get(name, name))
    for key, _, value in (text.removeprefix("+").partition("=") for text in cell):
        if key == "dataset":
            assert config.dataset.name == value
        elif key == "silhouette":
            assert config.task.silhouette == choice("silhouette", value)
        elif key not in ("renderer", "method", "stress", "experiment", "scale"):
            actual, expected = OmegaConf.select(config, key), yaml.safe_load(value.replace(":", ": "))
            if isinstance(expected, dict):  # other settings of a node stay
                assert expected.items() <= dict(actual).items()
            elif isinstance(expected, list):
                assert list(actual) == expected
            else:
                assert actual == (expected if actual is None else type(actual)(value))


def brings_its_own(cell: list[str], config: DictConfig, key: str, value: str) -> None:
    """Asserts that an experiment changes nothing that a renderer or a method sets."""
    default: Any = composed("scale=smoke")
    size = "scale.reconstruction.iterations"  # schedules depend on it
    iterations = OmegaConf.select(config, size)
    overrides = [f"{size}={iterations}"] if iterations != OmegaConf.select(default, size) else []
    if "fit" in config.task:  # a stress
        overrides += [f"task.optimiser.iterations={config.task.fit.iterations}"]
    elif key == "method" and "iterations" not in str(choice("method", value)):  # so the experiment may set them
        overrides += [f"task.optimiser.iterations={iterations}" for iterations in _iterations(config)]
    draw = [text for text in cell if text.startswith("draw=")]
    alone = composed(f"{'+' if key == 'method' else ''}{key}={value}", "scale=smoke", *draw, *overrides)
    assert config.label == alone.label
    assert build_part(config, "renderer") == build_part(alone, "renderer")
    if key == "method":
        assert config.task._target_ == alone.task._target_
        view_settings = choice("method", value).get("view")
        assert view_settings is None or config.view.resolution == alone.view.resolution


def _iterations(config: DictConfig) -> list[int]:
    """The iterations of a task, if it optimises."""
    optimiser = config.task.get("optimiser")
    return [] if optimiser is None else [optimiser.iterations]


@each("name", [*COMPARING])
def test_an_experiment_lists_the_renderers_that_name_it_in_the_order_of_their_ranks(name):
    rows = {renderer: choice("renderer", renderer).get("_rows_", {}) for renderer in names("renderer")}
    named = {renderer: ranks[name] for renderer, ranks in rows.items() if name in ranks}
    experiment = SHARED_ROWS.get(name, name)
    params = composed(f"+experiment={experiment}", "scale=smoke", hydra=True).hydra.sweeper.params
    assert params.renderer.split(",") == sorted(named, key=lambda renderer: named[renderer])
    assert len(named) == COMPARING[name]


@each("name", [name for name in EXPERIMENTS if not name.startswith("speed_")])  # a colour per class
def test_rows_of_an_experiment_have_different_looks(name):
    params = composed(f"+experiment={name}", "scale=smoke", hydra=True).hydra.get("sweeper", {}).get("params") or {}
    rows = str(params.get("+method") or params.get("renderer") or "dist").split(",")
    solid = [row for row in rows if not row.startswith("tuned/")]  # tuned rows are hollow
    assert len({(look(row).colour, look(row).marker) for row in solid}) == len(solid)


def write(scale: str) -> None:
    """Writes the cells of all experiments at a scale."""
    EXPECTED[scale] = {experiment: summary(experiment, scale) for experiment in EXPERIMENTS}
    lines = [f' "{scale}": {{\n  ' + ",\n  ".join(
        f"{json.dumps(name)}: {json.dumps(cells)}" for name, cells in experiments.items()) + "\n }"
        for scale, experiments in EXPECTED.items()]  # fmt: skip
    FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    for scale_name in sys.argv[1:] or CELLS:
        write(scale_name)
