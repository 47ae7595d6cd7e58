"""The runs of the tuning: errors of methods' drawn settings on validation and test shapes, and the best of them.

All methods are read on the same draws, shapes and seeds: those of which every method has a run that ended.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bench.records.names import flat
from bench.records.record import NEUTRAL_KEYS, NOT_RUN
from bench.report.data.records import (
    SCALE,
    Record,
    RunKey,
    by_shape,
    error,
    grouped,
    median_of_known,
    run_key,
    value_evaluations,
)
from bench.report.data.runs import Runs, Selection

TUNING = Selection("tuning", ("split",))
ONE_LOSS = replace(TUNING, experiment="tuning_one_loss")  # validation shapes alone
SPACE = "space/"  # before the names of methods whose settings are drawn
VALIDATION, TEST = "validation", "test"
BUDGETS = (1, 2, 4, 8, 16, 32, 64)  # numbers of draws
OTHER = ("label", "draw", "dataset", "index", "seed", "split")  # keys of the configuration that are no drawn settings
UNFINISHED = (NOT_RUN, "killed")  # statuses of runs that say nothing of their draw
Place = tuple[str, int, RunKey]  # split, draw, shape and seed
Table = dict[Place, Record]


@dataclass(frozen=True)
class Tuning:
    """The draws of one method.

    Args:
        method: the method whose settings were drawn.
        label: its name for readers.
        draws: the numbers of the draws.
        settings: the drawn settings of each draw, by dotted key.
        validation, test: the logarithms [draws, runs] of errors. A run that failed has the largest finite error of any
            draw of any method on its shape and seed.
        failures: the number of validation runs of each draw that failed.
        failed, runs: how many runs failed, on both kinds of shapes, of how many.
        test_runs: the shapes and seeds of the columns of `test`.
        evaluations: the median number of field values of a run of each draw; None where none ended ok.
    """

    method: str
    label: str
    draws: list[int]
    settings: list[dict[str, Any]]
    validation: np.ndarray
    test: np.ndarray
    failures: np.ndarray
    failed: int
    runs: int
    test_runs: list[RunKey]
    evaluations: list[float | None]

    @property
    def scores(self) -> np.ndarray:
        """The mean logarithmic error [draws] on the validation shapes."""
        return self.validation.mean(axis=1)

    @property
    def order(self) -> np.ndarray:
        """The draws from the best to the worst: by their failures, then by the mean logarithmic validation error."""
        return np.lexsort((self.scores, self.failures))

    @property
    def best(self) -> int:
        """The place of the best draw."""
        return int(self.order[0])

    @property
    def budgets(self) -> list[int]:
        """The numbers of draws up to all of them."""
        return [k for k in BUDGETS if k <= len(self.draws)]

    def expected(self, k: int) -> list[np.ndarray]:
        """The expected test error if the best of k draws is taken, an array per shape with an entry per seed.

        The expectation is of the logarithm of the error, over all choices of k of the draws, each equally likely (Tang
        et al. 2020, "Showing Your Work Doesn't Always Work", Eq. 3: without replacement).
        """
        n = len(self.draws)
        weights = np.array([math.comb(n - place - 1, k - 1) for place in range(n)]) / math.comb(n, k)
        errors = np.exp(weights @ self.test[self.order])
        return by_shape(dict(zip(self.test_runs, errors.tolist(), strict=True)))


def unfinished(runs: Runs) -> int:
    """The number of runs that were planned and have not ended."""
    return sum(record["status"] in UNFINISHED for record in runs.records)


def tunings(runs: Runs) -> list[Tuning]:
    """The methods of an experiment, on the draws and the shapes that all of them have; empty where there are none.

    Validation shapes are enough: without test shapes `test` has no columns.
    """
    ended = [record for record in runs.records if record["status"] not in UNFINISHED]
    by_method = grouped(ended, lambda record: record["method"])
    tables = [{(_split(r), _draw(r), run_key(r)): r for r in records} for records in by_method.values()]
    common = {*tables[0]}.intersection(*tables[1:]) if tables else set()
    runs = {split: sorted({run for of, _, run in common if of == split}) for split in (VALIDATION, TEST)}
    draws = sorted({draw for _, draw, _ in common})
    draws = [draw for draw in draws if all((s, draw, run) in common for s in runs for run in runs[s])]
    if not draws or not runs[VALIDATION]:
        return []
    worst = {split: _worst(tables, split, draws, runs[split]) for split in runs}
    return [_tuning(method, table, draws, worst) for method, table in zip(by_method, tables, strict=True)]


def pooled(methods: list[Tuning]) -> Tuning:
    """The draws of methods that drew the same settings as those of one, with the runs of all of them.

    Raises:
        ValueError: where methods have drawn settings that the others do not share.
    """
    if any(method.settings != methods[0].settings for method in methods):
        raise ValueError(
            "the methods differ in their drawn settings, and one setting is asked for all of them: sweep over methods "
            "without a search space of their own"
        )
    return replace(
        methods[0],
        method=", ".join(method.method for method in methods),
        label=", ".join(method.label for method in methods),
        validation=np.concatenate([method.validation for method in methods], axis=1),
        test=np.concatenate([method.test for method in methods], axis=1),
        failures=np.sum([method.failures for method in methods], axis=0),
        failed=sum(method.failed for method in methods),
        runs=sum(method.runs for method in methods),
        test_runs=[run for method in methods for run in method.test_runs],
        evaluations=[median_of_known(each) for each in zip(*(method.evaluations for method in methods), strict=True)],
    )


def left_out(runs: Runs, methods: list[Tuning]) -> list[str]:
    """A note of the draws that some runs have, and that no method is read on; none where there are none."""
    used = {draw for method in methods for draw in method.draws}
    draws = sorted({_draw(record) for record in runs.records} - used)
    return [f"Left out, since a method or a shape lacks them: draws {', '.join(map(str, draws))}."] if draws else []


def _tuning(method: str, table: Table, draws: list[int], worst: dict[str, dict[RunKey, float]]) -> Tuning:
    used = {split: [[table[split, draw, run] for run in of] for draw in draws] for split, of in worst.items()}
    logs = {
        split: np.log(
            [[min(_error(r), most) for r, most in zip(line, worst[split].values(), strict=True)] for line in of]
        )
        for split, of in used.items()
    }
    failed = {split: np.array([sum(r["status"] != "ok" for r in line) for line in of]) for split, of in used.items()}
    spent = [used[VALIDATION][i] + used[TEST][i] for i in range(len(draws))]
    first = spent[0][0]["config"]
    return Tuning(
        method=method.removeprefix(SPACE),
        label=str(first.get("label") or method.removeprefix(SPACE)),
        draws=draws,
        settings=_settings([line[0] for line in used[VALIDATION]], [*table.values()]),
        validation=logs[VALIDATION],
        test=logs[TEST],
        failures=failed[VALIDATION],
        failed=int(failed[VALIDATION].sum() + failed[TEST].sum()),
        runs=sum(map(len, spent)),
        test_runs=list(worst[TEST]),
        evaluations=[median_of_known(value_evaluations(r) for r in line if r["status"] == "ok") for line in spent],
    )


def _split(record: Record) -> str:
    return record["config"]["split"]


def _draw(record: Record) -> int:
    return record["config"]["draw"]


def _error(record: Record) -> float:
    return SCALE * error(record, "chamfer_l2")


def _worst(tables: list[Table], split: str, draws: list[int], runs: list[RunKey]) -> dict[RunKey, float]:
    """The largest finite error on each shape and seed; 1 where there is none."""
    found = {run: [_error(table[split, draw, run]) for table in tables for draw in draws] for run in runs}
    return {run: max((value for value in of if math.isfinite(value)), default=1.0) for run, of in found.items()}


def _settings(records: list[Record], among: list[Record]) -> list[dict[str, Any]]:
    """The values of some of a method's draws, by dotted key, in which the configurations of any of its draws differ."""
    every = [flat(record["config"]) for record in among]
    varies = [name for name in every[0] if len({str(each.get(name)) for each in every}) > 1]
    names = [name for name in varies if name.partition(".")[0] not in {*OTHER, *NEUTRAL_KEYS}]
    chosen = [flat(record["config"]) for record in records]
    return [{name: each[name] for name in names} for each in chosen]
