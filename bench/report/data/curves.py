"""Reads the curves of runs from their folders, and gives the median of several runs of one row."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bench.records.files import decoded
from bench.report.data.experiments import Experiment
from bench.report.data.records import SCALE, Record, measured

COLUMNS = ("iteration", "seconds", "value_evaluations", "total", "chamfer_l2")


def read(folder: Path) -> tuple[pd.DataFrame, str]:
    """A row for each line of `curve.jsonl`, with `COLUMNS` as floats, nan for missing; and a warning, or ""."""
    try:
        text = (folder / "curve.jsonl").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return pd.DataFrame(columns=COLUMNS, dtype=float), "no curve.jsonl"
    lines, bad = [], 0
    for line in text.splitlines():
        try:
            found = decoded(json.loads(line))
        except (ValueError, RecursionError):
            found = None
        if isinstance(found, dict) and isinstance(found.get("iteration"), int | float):
            lines.append([_number(found.get(name)) for name in COLUMNS])
        else:
            bad += 1
    warning = f"{bad} lines of curve.jsonl cannot be read" if bad else "" if lines else "curve.jsonl is empty"
    return pd.DataFrame(lines, columns=COLUMNS, dtype=float).drop_duplicates("iteration", keep="last"), warning


def median(runs: list[pd.DataFrame], failed: list[bool], quantity: str) -> pd.DataFrame:
    """The median, minimum and maximum of a quantity over the runs of a row, and the median of the seconds.

    After the end of a failed run its value counts as infinite, so that no row improves by failed runs. Iterations at
    which another run has no value are left out.

    Args:
        runs: the curves.
        failed: for each run, whether it did not end ok.
        quantity: a column of the curves.

    Returns:
        Columns iteration, seconds, median, low, high.
    """
    numbered = [run.set_index("iteration") for run in runs]
    values = pd.concat([run[quantity] for run in numbered], axis=1, keys=range(len(runs))).sort_index()
    times = pd.concat([run["seconds"] for run in numbered], axis=1, keys=range(len(runs))).reindex(values.index)
    for place, (run, over) in enumerate(zip(numbered, failed, strict=True)):
        end = run.index.max() if len(run) else -math.inf
        if over:
            values.loc[values.index > end, place] = math.inf
    values = values.dropna(how="any")
    values = values[np.isfinite(values).any(axis=1)]
    parts = {"seconds": times.loc[values.index].median(axis=1)}
    parts |= {"median": values.median(axis=1), "low": values.min(axis=1), "high": values.max(axis=1)}
    return pd.DataFrame(parts).rename_axis("iteration").reset_index()


def history_of(experiment: Experiment, record: Record) -> pd.DataFrame:
    """A run's error over seconds and evaluations: at its checkpoints, and at its end.

    A line of a curve has the error before its step, but the costs after it, so a checkpoint gets the costs of the line
    before it.
    """
    lines = read(experiment.folder(record))[0].sort_values("iteration")
    costs = lines[["seconds", "value_evaluations"]].shift(1, fill_value=0.0)
    history = costs.assign(iteration=lines["iteration"], error=SCALE * lines["chamfer_l2"], loss=lines["total"])
    history = history.dropna(subset=["error"])
    if record["status"] == "ok" and len(lines) and (error := measured(record, "chamfer_l2")) is not None:
        last = lines.iloc[-1]
        end = {"seconds": last["seconds"], "value_evaluations": last["value_evaluations"]}
        end |= {"iteration": last["iteration"] + 1, "error": SCALE * error, "loss": math.nan}
        history = pd.concat([history, pd.DataFrame([end])], ignore_index=True)
    return history[["iteration", "seconds", "value_evaluations", "error", "loss"]]


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else math.nan
