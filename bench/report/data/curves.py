"""Reads the curves of runs from their folders, and computes the median curve of a row."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from bench.records.record import as_number
from bench.records.results import curve_lines
from bench.report.data.records import CHAMFER_SCALE, Record, measured
from bench.report.data.runs import Runs
from bench.report.data.statistics import rank_correlation

HISTORY = ("iteration", "seconds", "value_evaluations", "error", "loss")
COLUMNS = ("iteration", "seconds", "value_evaluations", "total", "chamfer_l2")
HIGH_RHO = 0.7  # a larger rank correlation of loss and error is called high


def read(folder: Path, columns: Sequence[str] = COLUMNS) -> tuple[pd.DataFrame, str]:
    """Reads `curve.jsonl`: a row per line with these columns as floats (nan if missing), and a warning or ""."""
    parsed = curve_lines(folder)
    numbered = [line for line in parsed or [] if as_number(line.get("iteration")) is not None]
    rows = [[as_number(line.get(name)) for name in columns] for line in numbered]
    if parsed is None:
        warning = "no curve.jsonl"
    elif len(rows) < len(parsed):
        warning = f"{len(parsed) - len(rows)} lines of curve.jsonl cannot be read"
    else:
        warning = "" if parsed else "curve.jsonl is empty"
    return pd.DataFrame(rows, columns=list(columns), dtype=float).drop_duplicates("iteration", keep="last"), warning


def median(runs: list[pd.DataFrame], failed: list[bool], quantity: str) -> pd.DataFrame:
    """Columns iteration, seconds, median, low, high: of a quantity over the runs of a row, and the median seconds.

    After its end, a failed run counts as infinite, so that failures do not improve a row. Iterations at which another
    run has no value are left out.
    """
    numbered = [run.set_index("iteration") for run in runs]
    values = pd.concat([run[quantity] for run in numbered], axis=1, keys=range(len(runs))).sort_index()
    times = pd.concat([run["seconds"] for run in numbered], axis=1, keys=range(len(runs))).reindex(values.index)
    for column, (run, has_failed) in enumerate(zip(numbered, failed, strict=True)):
        end = run.index.max() if len(run) else -math.inf
        if has_failed:
            values.loc[values.index > end, column] = math.inf
    values = values.dropna(how="any")
    values = values[np.isfinite(values).any(axis=1)]
    parts = {"seconds": times.loc[values.index].median(axis=1)}
    parts |= {"median": values.median(axis=1), "low": values.min(axis=1), "high": values.max(axis=1)}
    return pd.DataFrame(parts).rename_axis("iteration").reset_index()


def history_of(runs: Runs, record: Record) -> pd.DataFrame:
    """A run's error over seconds and evaluations, at its checkpoints and at its end.

    A line of a curve has the error before its step, but the costs after it. So a checkpoint gets the costs of the
    previous line.
    """
    curve = read(runs.folder(record))[0].sort_values("iteration")
    costs = curve[["seconds", "value_evaluations"]].shift(1, fill_value=0.0)
    history = costs.assign(iteration=curve["iteration"], error=CHAMFER_SCALE * curve["chamfer_l2"], loss=curve["total"])
    history = history.dropna(subset=["error"])
    if record["status"] == "ok" and len(curve) and (error := measured(record, "chamfer_l2")) is not None:
        last = curve.iloc[-1]
        end = {"seconds": last["seconds"], "value_evaluations": last["value_evaluations"]}
        end |= {"iteration": last["iteration"] + 1, "error": CHAMFER_SCALE * error, "loss": math.nan}
        history = pd.concat([history, pd.DataFrame([end])], ignore_index=True)
    return history[[*HISTORY]]


def spearman(points: pd.DataFrame, first: str = "loss", second: str = "error") -> float | None:
    """The rank correlation of two columns; None for fewer than three points, or if a column is constant."""
    varied = len(points) > 2 and all(points[column].nunique() > 1 for column in (first, second))
    return rank_correlation(points[first], points[second])[0] if varied else None
