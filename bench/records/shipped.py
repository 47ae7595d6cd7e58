"""The folder of shipped results, in a checkout or as setup.py copies it into a wheel; its rows of an experiment."""

import csv
import gzip
import json
from functools import lru_cache
from pathlib import Path
from typing import Any

from bench.records.record import flat

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = ROOT / "results" if (ROOT / "results" / "suite").is_dir() else ROOT / "bench" / "shipped_results"
SUFFIX = ".runs.csv.gz"
CONFIG = "config."  # before the dotted key of a setting, in the name of a column
FITS = "priors"  # the experiment that fits the default priors to the true distances of test shapes
# What an error of such a fit depends on; not the view, since these errors are of the whole surface.
FIT_KEYS = ("dataset", "index", "split", "stress", "field", "prior", "evaluation.points", "evaluation.fscore_threshold")
SURFACE_METRICS = ("chamfer_l2", "chamfer_l1", "accuracy", "completeness", "fscore", "normal_consistency")


def shipped_rows(experiment: str) -> list[dict[str, str]]:
    """The shipped rows of an experiment, each as cells by column; `cell_value` reads a cell. Empty without a file."""
    if not (path := SHIPPED / "paper" / f"{experiment}{SUFFIX}").is_file():
        return []
    with gzip.open(path, "rt", encoding="utf-8", newline="") as file:
        return [*csv.DictReader(file)]


def cell_value(cell: str) -> Any:
    """The value of a cell: JSON, or text without quotes."""
    value = _parsed(cell)
    return json.loads(cell) if isinstance(value, dict | list) else value  # each cell has its own


@lru_cache(2**18)
def _parsed(cell: str) -> Any:
    try:
        return json.loads(cell)
    except ValueError:
        return cell


def best_possible(config: dict[str, Any]) -> dict[str, float]:
    """The errors of the prior's fit to the true distances of a run's shape, by metric; empty if none is shipped."""
    keys = tuple(f"{CONFIG}{key}." for key in FIT_KEYS)
    settings = {name: value for name, value in flat(config, CONFIG).items() if f"{name}.".startswith(keys)}
    for row in shipped_rows(FITS):
        fitted = {name: cell_value(cell) for name, cell in row.items() if cell and f"{name}.".startswith(keys)}
        if all(fitted.get(name) == settings.get(name) for name in {*fitted, *settings}):  # null is as a missing key
            return {name: cell_value(row[f"metrics.{name}"]) for name in SURFACE_METRICS}
    return {}
