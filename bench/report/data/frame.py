"""Writes all runs as one table, with a row per run, for pandas or a spreadsheet."""

from pathlib import Path
from typing import Any

import pandas as pd

from bench.report.data.records import flattened

PLAIN = ("folder", "task", "renderer", "dataset", "scene", "seed", "status", "reason", "started")
NUMBERS = ("peak_memory_bytes", "flops", "gemm_fraction")
NESTED = ("metrics", "metrics_start", "evaluations", "seconds")
MACHINE = ("cpu", "device", "threads", "commit", "dirty")


def to_frame(records: list[dict[str, Any]]) -> pd.DataFrame:
    """A row per run, including failed ones; nested values are columns such as `metrics.chamfer_l2`, `config.seed`."""
    rows = []
    for record in records:
        row = {name: record.get(name) for name in (*PLAIN, *NUMBERS)}
        for part in NESTED:
            row |= {f"{part}.{name}": value for name, value in record[part].items()}
        row |= {f"environment.{name}": record["environment"].get(name) for name in MACHINE}
        row |= flattened(record["config"], "config")
        rows.append(row)
    return pd.DataFrame(rows)


def write_frame(records: list[dict[str, Any]], results_dir: Path) -> Path:
    """Writes `results_dir/runs.csv` and gives its path."""
    path = results_dir / "runs.csv"
    to_frame(records).to_csv(path, index=False)
    return path
