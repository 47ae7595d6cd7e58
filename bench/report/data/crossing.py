"""The runs of the crossing: errors of every renderer under every loss of the mask, by family and number of points."""

import math
from itertools import product
from typing import Any

import numpy as np

from bench.report.data.completions import POINTS
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import (
    SCALE,
    Record,
    RunKey,
    by_shape,
    error,
    family,
    median_of_known,
    run_key,
    setting,
    value_evaluations,
)
from bench.report.data.statistics import Groups, flat, median

CROSSING = Selection("crossing", ("completion",), ("dataset", "task", "silhouette"), ("points",))
OWN = {  # the loss of each renderer's paper; the naive one has that of DIST
    **{"renderers.DIST": "Hinge", "renderers.Naive": "Hinge"},
    **{"renderers.IDR": "CrossEntropy", "renderers.DVR": "Occupancy"},
}
Cell = tuple[str, str, str, str]  # family, points, renderer, loss


class Crossed:
    """The errors of an experiment's runs, by family, number of points, renderer and loss, then by shape and seed.

    Renderers are named by their presets, losses by their classes; `labels` has the names of both for readers.
    """

    def __init__(self, experiment: Experiment):
        self.errors: dict[Cell, dict[RunKey, float]] = {}
        self.failed: dict[Cell, int] = {}
        self.planned: dict[Cell, int] = {}
        self.labels: dict[str, str] = {}
        self.own: dict[str, str] = {}
        self._costs: dict[tuple[str, str], list[float | None]] = {}
        for record in experiment.records:
            cell = self._named(record)
            self.errors.setdefault(cell, {})[run_key(record)] = SCALE * error(record, "chamfer_l2")
            self.planned[cell] = self.planned.get(cell, 0) + 1
            self.failed[cell] = self.failed.get(cell, 0) + (record["status"] != "ok")
            self._costs.setdefault(cell[2:], []).append(value_evaluations(record))
        self.families, points, self.renderers, self.losses = (
            list(dict.fromkeys(cell[i] for cell in self.errors)) for i in range(4)
        )
        self.points = [p for p in POINTS if p in points] + sorted({*points} - {*POINTS})

    def _named(self, record: Record) -> Cell:
        renderer = record["renderer"]
        loss = str(setting(record["config"], "silhouette", "_target_") or "").rpartition(".")[2]
        self.labels[renderer] = str(setting(record["config"], "renderer", "_label_") or renderer)
        self.labels[loss] = str(setting(record["config"], "silhouette", "_label_") or loss)
        if own := OWN.get(str(setting(record["config"], "renderer", "_target_"))):
            self.own[renderer] = own
        return family(record), str(setting(record["config"], "task", "points")), renderer, loss

    def cell(self, *cell: str) -> dict[RunKey, float]:
        """The errors of a family, number of points, renderer and loss; empty where none was planned."""
        return self.errors.get(cell, {})

    def median(self, *cell: str) -> float | None:
        """The median error of a cell; None where nothing was planned."""
        return float(median([*self.cell(*cell).values()])) if self.cell(*cell) else None

    def cost(self, renderer: str, loss: str) -> float | None:
        """The median number of field values of a run."""
        return median_of_known(self._costs.get((renderer, loss), []))

    def over_points(self, renderer: str, loss: str, family: str | None = None) -> dict[RunKey, float]:
        """The geometric mean over all numbers of points for each shape and seed; infinite where one failed.

        A shape and seed without a run at one of the numbers of points is left out.
        """
        means: dict[RunKey, float] = {}
        for name in self.families if family is None else [family]:
            cells = [self.cell(name, points, renderer, loss) for points in self.points]
            common = [run for run in cells[0] if all(run in cell for cell in cells)]
            means |= {run: float(np.exp(np.mean(np.log([cell[run] for cell in cells])))) for run in common}
        return means

    def pair(
        self, first: tuple[str, str], second: tuple[str, str], family: str | None = None
    ) -> list[list[np.ndarray]]:
        """The values of `over_points` for two settings on the shapes and seeds of both, as an array per shape."""
        mine, other = self.over_points(*first, family), self.over_points(*second, family)
        common = [run for run in mine if run in other]
        return [by_shape({run: errors[run] for run in common}) for errors in (mine, other)]

    def shares(self) -> tuple[dict[str, float], int]:
        """What explains the variance between the settings' mean logarithmic errors, in shares of 1; and the runs.

        A two-way analysis of variance without replication over the means: renderer, loss, and what only both together
        explain. A shape and seed at which a setting failed or is missing is left out.
        """
        tables = {key: self.over_points(*key) for key in product(self.renderers, self.losses)}
        first = next(iter(tables.values()))
        common = [run for run in first if all(math.isfinite(table.get(run, math.inf)) for table in tables.values())]
        if not common or min(len(self.renderers), len(self.losses)) < 2:
            return {}, len(common)
        means = np.array(
            [
                [np.mean(np.log([tables[r, loss][run] for run in common])) for loss in self.losses]
                for r in self.renderers
            ]
        )
        means -= means.mean()
        renderer, loss = means.mean(axis=1, keepdims=True), means.mean(axis=0, keepdims=True)
        parts = {"renderer": renderer + 0 * means, "loss": loss + 0 * means, "both": means - renderer - loss}
        total = float((means**2).sum())
        return ({name: float((part**2).sum()) / total for name, part in parts.items()} if total else {}), len(common)


def shape_medians(groups: Groups) -> list[float]:
    """The median of each shape's errors."""
    return [float(median(flat([group]))) for group in groups]


def geometric_mean(values: np.ndarray) -> Any:
    """The geometric mean [...] of values [..., n]; infinite where one of them is."""
    return np.exp(np.mean(np.log(values), axis=-1))
