"""The cells of every experiment have the names and overrides of cells.json, whatever changes in the driver.

At smoke, two cells of each experiment are compared; at desk, in the slow tests, all cells.
After a change of settings, `python -m tests.conf.test_cells` writes the file again; it takes minutes.
"""

import json
import sys
from pathlib import Path

import pytest

from bench.records.record import digest
from bench.tables import names
from tests.composing import cells_of

FILE = Path(__file__).with_name("cells.json")
EXPERIMENTS = [name for name in names("experiment") if not name.startswith("_")]
CELLS = {"smoke": 2, "desk": None}  # at most, of an experiment
EXPECTED = json.loads(FILE.read_text(encoding="utf-8")) if FILE.is_file() else {}


def summary(experiment: str, scale: str) -> dict[str, int | str]:
    """The number of compared cells of an experiment, and a digest of their names and overrides."""
    cells = cells_of(f"+experiment={experiment}", f"scale={scale}", at_most=CELLS[scale])
    return {"cells": len(cells), "digest": digest([[cell.id, cell.overrides] for cell in cells])}


@pytest.mark.parametrize("scale", ["smoke", pytest.param("desk", marks=pytest.mark.slow)])
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_an_experiment_has_its_written_cells(experiment: str, scale: str):
    assert summary(experiment, scale) == EXPECTED[scale][experiment]


def test_the_cells_of_every_experiment_are_written():
    assert {scale: {*EXPECTED[scale]} for scale in CELLS} == {scale: {*EXPERIMENTS} for scale in CELLS}


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
