"""The runs of the tuning: errors of methods' drawn settings on validation and test shapes, and the best of them."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import SCALE, Record, RunKey, by_shape, error, run_key

TUNING = Selection("tuning", ("completion",), ("dataset", "task", "split", "draw"), splits=True)
SPACE = "space/"  # the folder of conf/method with the search spaces
VALIDATION, TEST = "validation", "test"
BUDGETS = (1, 2, 4, 8, 16, 32, 64)  # numbers of draws
UNTUNED = ("label", "draw")  # keys that differ between draws and are no settings
Errors = dict[int, dict[RunKey, float]]  # by draw, then by shape and seed


@dataclass(frozen=True)
class Tuned:
    """The draws of one method, in their order.

    Args:
        method: the file of conf/method whose settings were drawn.
        label: its name for readers.
        draws: the numbers of the draws.
        settings: the drawn settings of each draw, by dotted key.
        validation, test: the logarithms [draws, shapes and seeds] of errors. A failure has the largest finite error of
            any draw of any method on its shape.
        runs: the shapes and seeds of the columns of `test`.
        failures: of each draw, on both kinds of shapes.
    """

    method: str
    label: str
    draws: list[int]
    settings: list[dict[str, Any]]
    validation: np.ndarray
    test: np.ndarray
    runs: list[RunKey]
    failures: list[int]

    @property
    def scores(self) -> np.ndarray:
        """The mean logarithmic error [draws] on the validation shapes, by which draws are chosen."""
        return self.validation.mean(axis=1)

    @property
    def best(self) -> int:
        """The draw with the smallest geometric mean of errors on the validation shapes; of equal ones the first."""
        return int(np.argmin(self.scores))

    @property
    def budgets(self) -> list[int]:
        """The numbers of draws up to all of them."""
        return [k for k in BUDGETS if k <= len(self.settings)]

    def expected(self, k: int) -> list[np.ndarray]:
        """The expected test error if the best of k draws is taken, an array per shape with an entry per seed.

        The expectation is over all choices of k of the draws, each equally likely (Dodge et al. 2019, "Show Your Work",
        without replacement), and of the logarithm of the error.
        """
        n = len(self.settings)
        weights = np.array([math.comb(n - place - 1, k - 1) for place in range(n)]) / math.comb(n, k)
        errors = np.exp(weights @ self.test[np.argsort(self.scores, kind="stable")])
        return by_shape(dict(zip(self.runs, errors.tolist(), strict=True)))

    def effects(self) -> list[dict[str, Any]]:
        """A line per setting: its range, its chosen value, and its rank correlation with the validation error."""
        lines = []
        for name in self.settings[0]:
            values = [settings[name] for settings in self.settings]
            rho = stats.spearmanr(values, self.scores).statistic if len({*values}) > 1 and len(values) > 2 else math.nan
            ends = {"least": min(values), "most": max(values), "chosen": values[self.best]}
            lines.append({"setting": name, **ends, "rho": None if math.isnan(rho) else float(rho), "n": len(values)})
        return lines


def tuned(experiment: Experiment) -> list[Tuned]:
    """The methods of an experiment, with those draws that have every shape of both splits."""
    errors: dict[str, dict[str, Errors]] = {}
    records: dict[str, dict[int, Record]] = {}
    failures: dict[tuple[str, int], int] = {}
    for record in experiment.records:
        method, draw, split = record["method"], record["config"]["draw"], record["config"]["split"]
        found = errors.setdefault(method, {}).setdefault(split, {}).setdefault(draw, {})
        found[run_key(record)] = SCALE * error(record, "chamfer_l2")
        records.setdefault(method, {})[draw] = record
        failures[method, draw] = failures.get((method, draw), 0) + (record["status"] != "ok")
    worst = {split: _worst([of[split] for of in errors.values() if split in of]) for split in (VALIDATION, TEST)}
    methods = []
    for method, by_split in errors.items():
        runs = {split: list(worst[split]) for split in worst}
        draws = [draw for draw in sorted(records[method]) if all(_complete(by_split, s, draw, runs[s]) for s in runs)]
        if draws:
            logs = {split: _logs(by_split[split], draws, worst[split]) for split in worst}
            label = str(records[method][draws[0]]["config"].get("label") or method).rpartition(", draw")[0] or method
            settings = _settings([records[method][draw] for draw in draws])
            failed = [failures[method, draw] for draw in draws]
            name = method.removeprefix(SPACE)
            methods.append(Tuned(name, label, draws, settings, logs[VALIDATION], logs[TEST], runs[TEST], failed))
    return methods


def _complete(by_split: dict[str, Errors], split: str, draw: int, runs: list[RunKey]) -> bool:
    return bool(runs) and {*runs} <= {*by_split.get(split, {}).get(draw, {})}


def _worst(tables: list[Errors]) -> dict[RunKey, float]:
    """The largest finite error on each shape and seed; 1 where there is none."""
    found: dict[RunKey, list[float]] = {}
    for run, value in ((run, e) for table in tables for errors in table.values() for run, e in errors.items()):
        found.setdefault(run, []).append(value)
    return {run: max((value for value in values if math.isfinite(value)), default=1.0) for run, values in found.items()}


def _logs(errors: Errors, draws: list[int], worst: dict[RunKey, float]) -> np.ndarray:
    return np.log([[min(errors[draw][run], largest) for run, largest in worst.items()] for draw in draws])


def _settings(records: list[Record]) -> list[dict[str, Any]]:
    """The numbers in which the configurations of a method's draws differ, by dotted key."""
    flat = [dict(_flat(record["config"])) for record in records]
    same = {"index", "seed", "split", *UNTUNED}
    names = [name for name in flat[0] if len({str(each.get(name)) for each in flat}) > 1 and name not in same]
    kept = [name for name in names if name.partition(".")[0] in ("task", "renderer")]
    return [{name: each[name] for name in kept} for each in flat]


def _flat(node: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    items = []
    for key, value in node.items():
        items += _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else [(f"{prefix}{key}", value)]
    return items
