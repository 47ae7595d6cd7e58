"""The runs of Table 2: their errors by family, row and number of points, and how they pair."""

import math
from collections import Counter
from typing import Any

import numpy as np

from bench.report.experiments import Experiment, error, family, row_name, setting
from bench.report.statistics import median

POINTS = ("dense", "50%", "10%", "100", "50", "20")
SCALE = 1000.0
Cell = tuple[str, str, str]  # family, row, points
Run = tuple[Any, Any]  # shape, seed
ERROR = (
    "Chamfer distance (chamfer_l2: the sum of the two mean squared distances, squared scene units) times 1000. A run "
    "that did not end ok, or was planned and not run, counts as infinite. "
)


class Runs:
    """The errors of an experiment's runs, by family, row and points, then by shape and seed."""

    def __init__(self, experiment: Experiment):
        self.errors: dict[Cell, dict[Run, float]] = {}
        self.statuses: dict[Cell, Counter[str]] = {}
        self.observed: dict[tuple[str, str], list[float]] = {}
        for record in experiment.records:
            cell = (family(record), row_name(record), str(setting(record["config"], "task", "points")))
            run = (record["config"].get("index"), record["seed"])
            self.errors.setdefault(cell, {})[run] = SCALE * error(record, "chamfer_l2")
            self.statuses.setdefault(cell, Counter())[record["status"]] += 1
            if (count := record["evaluations"].get("observed")) is not None:
                self.observed.setdefault((cell[0], cell[2]), []).append(count)
        self.families = list(dict.fromkeys(name for name, _, _ in self.errors))
        self.rows = list(dict.fromkeys(row for _, row, _ in self.errors))
        found = {points for _, _, points in self.errors}
        self.points = [p for p in POINTS if p in found] + sorted(found - {*POINTS})

    def rows_of(self, name: str) -> list[str]:
        """The rows that a family has."""
        return [row for row in self.rows if any((name, row, points) in self.errors for points in self.points)]

    def median(self, *cell: str) -> float | None:
        """Over shapes and seeds; None where nothing was planned."""
        return float(median(list(self.errors[cell].values()))) if cell in self.errors else None

    def over_points(self, name: str, row: str) -> dict[Run, float]:
        """The geometric mean of each run of a row over all points of the family; infinite where one failed.

        Runs that were not planned at all these points are left out.
        """
        wanted = [p for p in self.points if any((name, other, p) in self.errors for other in self.rows)]
        cells = [self.errors.get((name, row, p), {}) for p in wanted]
        runs = [run for run in cells[0] if all(run in cell for cell in cells)] if cells else []
        return {run: float(np.exp(np.mean(np.log([cell[run] for cell in cells])))) for run in runs}

    def pair(self, name: str, row: str, other: str) -> list[list[np.ndarray]]:
        """What `over_points` has of two rows in a family: groups of the same runs, one a shape."""
        mine, others = self.over_points(name, row), self.over_points(name, other)
        common = [run for run in mine if run in others]
        return [by_shape({run: errors[run] for run in common}) for errors in (mine, others)]

    def failures(self, name: str, row: str) -> tuple[int, int]:
        """How many of a row's runs in a family did not end ok, and how many there are."""
        together = sum((self.statuses.get((name, row, points), Counter()) for points in self.points), Counter())
        return together.total() - together["ok"], together.total()

    def failed_shapes(self, name: str, row: str) -> tuple[int, int]:
        """How many of a row's shapes in a family have a run that did not end ok, and how many there are."""
        cells = [self.errors.get((name, row, points), {}) for points in self.points]
        worst: dict[Any, float] = {}
        for (shape, _), error_of_run in [item for cell in cells for item in cell.items()]:
            worst[shape] = max(worst.get(shape, 0.0), error_of_run)
        return sum(map(math.isinf, worst.values())), len(worst)

    def given(self, name: str, points: str) -> float | None:
        """Median number of points that a family's depth images gave."""
        found = self.observed.get((name, points))
        return float(np.median(found)) if found else None


def by_shape(errors: dict[Any, float]) -> list[np.ndarray]:
    """The errors of runs, whose keys begin with the shape, as a group a shape."""
    shapes: dict[Any, list[float]] = {}
    for key, value in errors.items():
        shapes.setdefault(key[0], []).append(value)
    return [np.array(values) for values in shapes.values()]


def shapes_told(runs: Runs) -> str:
    """How many shapes a cell has, and how far an interval of so many can be believed."""
    counts = {len(by_shape(errors)) for errors in runs.errors.values()}
    least = min(counts)
    told = f"{least}" if len(counts) == 1 else f"{least} to {max(counts)}"
    bound = 100 * (1 - 2.0 ** (1 - least))
    few = f" An interval of {least} covers {bound:.0f} % at most." if 1 < least < 6 else ""
    return f"Shapes a cell: {told}.{few}"


def heading(points: str) -> str:
    return f"{points} pts" if points.isdigit() else points
