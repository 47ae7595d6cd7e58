"""The tuning: errors of the drawn settings of each method on validation shapes, and the best draw.

All methods are compared on the same draws, shapes and seeds: those for which every method has a finished run.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from bench.records.record import NEUTRAL_KEYS, flat
from bench.report.data.kept import UNFINISHED
from bench.report.data.records import CHAMFER_SCALE, Record, RunKey, error, grouped, run_key
from bench.report.data.runs import Runs, Selection

TUNING = Selection("tuning", ("split",))
PHOTOGRAPHS = replace(TUNING, experiment="tuning_photographs")  # it has validation shapes only
CHAMFER = "chamfer_l2"
SELECTION_METRICS = {PHOTOGRAPHS.experiment: "seen_chamfer_l1"}  # other experiments choose draws by CHAMFER
SPACE_PREFIX, TUNED_PREFIX = "space/", "tuned/"  # methods whose settings are drawn; methods with tuned settings
VALIDATION = "validation"
NOT_DRAWN = ("label", "draw", "dataset", "index", "seed", "split")  # keys of the configuration that are not drawn


@dataclass(frozen=True)
class Tuning:
    """The draws of one method.

    Args:
        method: the method whose settings were drawn.
        label: its name for readers.
        draws: the numbers of the draws.
        settings: the drawn settings of each draw, by dotted key.
        validation: the logarithms [draws, runs] of errors. A failed run has the largest finite error of any draw of any
            method on its shape and seed.
        failures: the number of validation runs of each draw that failed.
    """

    method: str
    label: str
    draws: list[int]
    settings: list[dict[str, Any]]
    validation: np.ndarray
    failures: np.ndarray

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
        return int(self.order[0])


def unfinished(runs: Runs) -> int:
    return sum(record["status"] in UNFINISHED for record in runs.records)


def metric_of(runs: Runs) -> str:
    """The error that the draws of an experiment are chosen by."""
    return SELECTION_METRICS.get(runs.selection.experiment, CHAMFER)


def tunings(runs: Runs) -> list[Tuning]:
    """The methods of an experiment, on the draws and shapes that all of them have; empty without validation runs.

    Test shapes are optional; if there are some, each draw must have all of them.
    """
    ended = [record for record in runs.records if record["status"] not in UNFINISHED]
    by_method = grouped(ended, lambda record: record["method"])
    keys = sorted({run_key(record) for record in ended})
    cells = pd.DataFrame([_cell(record, keys, metric_of(runs)) for record in ended])
    if cells.empty:
        return []
    cells = cells[cells.groupby(["split", "draw", "run"]).method.transform("nunique") == len(by_method)]
    places = cells.groupby(["split", "run"]).ngroups  # needed per draw and method
    cells = cells[cells.groupby("draw").draw.transform("size") == places * len(by_method)]
    if VALIDATION not in {*cells.split}:
        return []
    worst = cells.error.where(np.isfinite(cells.error)).groupby([cells.split, cells.run]).transform("max").fillna(1.0)
    cells = cells.assign(error=np.log(np.minimum(cells.error, worst)))
    return [_tuning(cells[cells.method == method], records) for method, records in by_method.items()]


def left_out(runs: Runs, methods: list[Tuning]) -> list[str]:
    """A note on draws that are left out because not all methods have them; empty if there are none."""
    used = {draw for method in methods for draw in method.draws}
    draws = sorted({record["config"]["draw"] for record in runs.records} - used)
    return [f"Left out, since a method or a shape lacks them: draws {', '.join(map(str, draws))}."] if draws else []


def _cell(record: Record, keys: list[RunKey], metric: str) -> dict[str, Any]:
    """A line of the table of runs; `run` is the number of its shape and seed."""
    config, ok = record["config"], record["status"] == "ok"
    return {
        **{"method": record["method"], "split": config["split"], "draw": config["draw"]},
        **{"run": keys.index(run_key(record)), "failed": not ok, "record": record},
        "error": CHAMFER_SCALE * error(record, metric),
    }


def _tuning(runs: pd.DataFrame, records: list[Record]) -> Tuning:
    runs = runs[runs.split == VALIDATION]
    first = runs.groupby("draw").record.first()
    method, config = runs.method.iloc[0].removeprefix(SPACE_PREFIX), first.iloc[0]["config"]
    return Tuning(
        method=method,
        label=str(config.get("label") or method),
        draws=first.index.tolist(),
        settings=_settings(first.tolist(), records),
        validation=runs.pivot(index="draw", columns="run", values="error").to_numpy(),
        failures=runs.groupby("draw").failed.sum().to_numpy(),
    )


def _settings(records: list[Record], among: list[Record]) -> list[dict[str, Any]]:
    """The settings in which the draws `among` differ, by dotted key, for each of `records`."""
    configs = [flat(record["config"]) for record in among]
    varies = [name for name in configs[0] if len({str(config.get(name)) for config in configs}) > 1]
    names = [name for name in varies if name.partition(".")[0] not in {*NOT_DRAWN, *NEUTRAL_KEYS}]
    return [{name: config[name] for name in names} for config in (flat(record["config"]) for record in records)]
