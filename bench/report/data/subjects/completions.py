"""Runs that complete shapes: their errors by family, row and number of points, and pairs of rows."""

import math
from collections import Counter

import numpy as np

from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import SCALE, Row, RunKey, by_shape, error, family, row_of, run_key, setting
from bench.report.data.statistics import geometric_mean, median

TABLE2 = Selection("table2", ("completion", "deepsdf"), ("dataset", "task"), ("points",))
POINTS = ("dense", "50%", "10%", "100", "50", "20")
EVERY = "all families"
FAILURE = (
    "In geometric means a run that did not end ok has the largest finite error of any row on the same shape, seed and "
    "number of points; a shape on which every row failed is left out."
)
Cell = tuple[str, Row, str]  # family, row, points
CHAMFER = (
    "Error: Chamfer distance (chamfer_l2: the sum of the two mean squared distances, squared scene units) times 1000."
)
ERROR = f"{CHAMFER} A run that did not end ok, or was planned and not run, counts as infinite."


class Completions:
    """The errors of an experiment's runs, by family, row and points, then by shape and seed."""

    def __init__(self, experiment: Experiment):
        self.errors: dict[Cell, dict[RunKey, float]] = {}
        self.statuses: dict[Cell, Counter[str]] = {}
        self.observed: dict[tuple[str, str], list[float]] = {}
        for record in experiment.records:
            cell = (family(record), row_of(record), str(setting(record["config"], "task", "points")))
            self.errors.setdefault(cell, {})[run_key(record)] = SCALE * error(record, "chamfer_l2")
            self.statuses.setdefault(cell, Counter())[record["status"]] += 1
            if (count := record["evaluations"].get("observed")) is not None:
                self.observed.setdefault((cell[0], cell[2]), []).append(count)
        self.families = list(dict.fromkeys(name for name, _, _ in self.errors))
        self.rows = list(dict.fromkeys(row for _, row, _ in self.errors))
        found = {points for _, _, points in self.errors}
        self.points = [p for p in POINTS if p in found] + sorted(found - {*POINTS})

    def rows_of(self, name: str) -> list[Row]:
        """The rows of a family."""
        return [row for row in self.rows if any((name, row, points) in self.errors for points in self.points)]

    def median(self, *cell: str | Row) -> float | None:
        """The median over shapes and seeds of a family, row and points; None where nothing was planned."""
        return float(median(list(self.errors[cell].values()))) if cell in self.errors else None

    def over_points(self, name: str, row: Row, *, finite: bool = False) -> dict[RunKey, float]:
        """The geometric mean over all numbers of points for each shape and seed of a row; infinite where one failed.

        Of one family, or of `EVERY`. With `finite` a failure counts as the largest finite error of any row on the same
        shape, seed and number of points, so that geometric means over shapes can be compared; where every row failed it
        is left out. So is a shape and seed that was not planned for every number of points of its family.
        """
        if name == EVERY:
            parts = [self.over_points(each, row, finite=finite) for each in self.families]
            return {run: value for part in parts for run, value in part.items()}
        wanted = [p for p in self.points if any((name, other, p) in self.errors for other in self.rows)]
        cells = [self.errors.get((name, row, p), {}) for p in wanted]
        if finite:
            cells = [self._scored(name, points, cell) for points, cell in zip(wanted, cells, strict=True)]
        runs = [run for run in cells[0] if all(run in cell for cell in cells)] if cells else []
        means = {run: float(geometric_mean([cell[run] for cell in cells])) for run in runs}
        return {run: mean for run, mean in means.items() if not finite or math.isfinite(mean)}

    def _scored(self, name: str, points: str, cell: dict[RunKey, float]) -> dict[RunKey, float]:
        """The errors of a cell, in which a failure has the largest finite error of any row; infinite where all fail."""
        alike = [self.errors.get((name, row, points), {}) for row in self.rows]
        worst = {run: [e for errors in alike if math.isfinite(e := errors.get(run, math.inf))] for run in cell}
        return {run: e if math.isfinite(e) else max(worst[run], default=e) for run, e in cell.items()}

    def pair(self, name: str, row: Row, other: Row, *, finite: bool = False) -> list[list[np.ndarray]]:
        """The values of `over_points` for two rows, for the runs that both have, as an array per shape."""
        mine, others = (self.over_points(name, each, finite=finite) for each in (row, other))
        common = [run for run in mine if run in others]
        return [by_shape({run: errors[run] for run in common}) for errors in (mine, others)]

    def all_errors(self, name: str, row: Row) -> dict[RunKey, float]:
        """The errors of a row by shape, view, seed, family and points; of one family, or of `EVERY`."""
        found = {(*cell, run): error for cell, errors in self.errors.items() for run, error in errors.items()}
        mine = {key: error for key, error in found.items() if key[1] == row and name in (EVERY, key[0])}
        return {(*run, of, points): error for (of, _, points, run), error in mine.items()}

    def failures(self, name: str, row: Row) -> tuple[int, int]:
        """The number of a row's runs in a family that did not end ok, and the number of all."""
        total = sum((self.statuses.get((name, row, points), Counter()) for points in self.points), Counter())
        return total.total() - total["ok"], total.total()

    def failed_shapes(self, name: str, row: Row) -> tuple[int, int]:
        """The number of a row's shapes in a family with a run that did not end ok, and the number of all."""
        cells = [self.errors.get((name, row, points), {}) for points in self.points]
        worst: dict[object, float] = {}
        for run, error_of_run in [item for cell in cells for item in cell.items()]:
            worst[run[0]] = max(worst.get(run[0], 0.0), error_of_run)
        return sum(map(math.isinf, worst.values())), len(worst)

    def given(self, name: str, points: str) -> float | None:
        """The median number of observed points in a family's depth images."""
        found = self.observed.get((name, points))
        return float(np.median(found)) if found else None


def shapes_per_cell(runs: Completions) -> str:
    """The number of shapes per cell, as a note."""
    counts = {len(by_shape(errors)) for errors in runs.errors.values()}
    return f"Shapes per cell: {min(counts)}{f' to {max(counts)}' if len(counts) > 1 else ''}."


def heading(points: str) -> str:
    """The heading of a column of the tables."""
    return f"{points} pts" if points.isdigit() else points
