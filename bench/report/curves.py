"""The curves of runs: read from their folders, and the median of several runs of one row."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bench.report.records import decoded

COLUMNS = ("iteration", "seconds", "value_evaluations", "total", "chamfer_l2")


def read(folder: Path) -> tuple[pd.DataFrame, str]:
    """A row for each line of `curve.jsonl`, with `COLUMNS` as floats, nan for missing; and a remark, or ""."""
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
    remark = f"{bad} lines of curve.jsonl cannot be read" if bad else "" if lines else "curve.jsonl is empty"
    return pd.DataFrame(lines, columns=COLUMNS, dtype=float).drop_duplicates("iteration", keep="last"), remark


def median(runs: list[pd.DataFrame], failed: list[bool], quantity: str) -> pd.DataFrame:
    """The median of a quantity over the runs of a row, its least and largest, and the median of the seconds.

    Past the end of a run that failed its value counts as infinite, so that no row gains by losing runs. Iterations at
    which some run that goes on has no value are left out.

    Args:
        runs: curves.
        failed: whether each run did not end ok.
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


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else math.nan
