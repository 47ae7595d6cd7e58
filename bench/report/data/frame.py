"""All runs of a results folder as one table with typed columns, for pandas."""

import os
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pandas as pd

from bench.records.read import read_plans, read_records
from bench.records.record import flat, row_name, started
from bench.records.results import RESULTS
from bench.report.data.records import index, setting

TEXT, CATEGORY, INTEGER, NUMBER, BOOLEAN, TIME = (
    *("string", "category", "Int64", "Float64", "boolean"),
    "datetime64[ms, UTC]",
)
FIXED_COLUMNS = {  # every table has them
    **{name: TEXT for name in ("folder", "name")},
    **{name: CATEGORY for name in ("task", "renderer", "method", "dataset", "scene", "experiment", "sweep", "scale")},
    **{name: INTEGER for name in ("index", "seed")},
    "status": CATEGORY,
    "reason": TEXT,
    "started": TIME,
    "reused": BOOLEAN,
    **{name: NUMBER for name in ("peak_memory_bytes", "flops", "gemm_fraction")},
    **{name: CATEGORY for name in ("cpu", "device")},
    "threads": INTEGER,
    "commit": CATEGORY,
    "dirty": BOOLEAN,
}
ENVIRONMENT_COLUMNS = ("cpu", "device", "threads", "commit", "dirty")
PREFIXES = {"metrics": "", "metrics_start": "start_", "metrics_best": "best_"}
PREFIXES |= {"seconds": "seconds_", "evaluations": "evaluations_"}
CONFIG = "config."


def load(results_dir: str | os.PathLike[str] = RESULTS, *, config: bool = False) -> pd.DataFrame:
    """Reads all runs of a results folder into a table, newest first, with a row per run, also failed or planned.

    >>> runs = load("results/local")
    >>> runs[["name", "status", "seed"]]
         name status  seed
    0  Newton     ok     0
    >>> bool((runs.chamfer_l2 < runs.start_chamfer_l2).all())
    True

    Args:
        results_dir: the results folder of the runs.
        config: whether to add all settings as columns `config.KEY`, some hundred.

    Returns:
        The columns of `FIXED_COLUMNS`, then metrics by their names, `start_NAME` for metrics before the optimisation,
        `best_NAME` for the best possible ones, `seconds_NAME` and `evaluations_NAME`. `sweep` is the folder in
        `RESULTS_DIR/sweeps` of the newest sweep with this run. Missing values are `pandas.NA`. The files of a
        run are in `RESULTS_DIR/runs/FOLDER`.

    Raises:
        ValueError: the folder does not exist.
    """
    records, problems = read_records(Path(results_dir))
    if problems:
        warnings.warn(f"{len(problems)} not read: {'; '.join(problems)}", stacklevel=2)
    plans = sorted(read_plans(Path(results_dir))[0], key=lambda plan: plan.asked)
    sweeps = {cell.id: plan.name for plan in plans for cell in plan.cells}
    table = to_frame(records)
    table["sweep"] = _series([sweeps.get(folder) for folder in table["folder"]], CATEGORY)
    return table if config else table.loc[:, ~table.columns.str.startswith(CONFIG)]


def to_frame(records: Iterable[dict[str, Any]]) -> pd.DataFrame:
    """A row per run, with the columns that `load` states and all settings; without sweeps."""
    rows = [_row(record) for record in records]
    names = sorted({name for row in rows for name in row}, key=_sort_key)
    columns = {name: [row.get(name) for row in rows] for name in dict.fromkeys((*FIXED_COLUMNS, *names))}
    return pd.DataFrame({name: _series(values, _type(name, values)) for name, values in columns.items()})


def _row(record: dict[str, Any]) -> dict[str, Any]:
    """The values of a run by column; a metric named like a fixed column gets the prefix `metric_`."""
    row = {name: record.get(name) for name in FIXED_COLUMNS}
    row |= {name: None if (value := record["environment"].get(name)) == "" else value for name in ENVIRONMENT_COLUMNS}
    row |= {"name": row_name(record["config"], record["renderer"]), "index": index(record)}
    config = record["config"]
    row |= {"experiment": config.get("experiment") or None, "scale": setting(config, "scale", "name")}
    row |= {"started": started(record), "method": record.get("method") or None, "scene": record.get("scene") or None}
    for section, prefix in PREFIXES.items():
        named = {f"{prefix}{name}": value for name, value in record.get(section, {}).items()}
        row |= {f"metric_{name}" if name in FIXED_COLUMNS else name: _cell(value) for name, value in named.items()}
    return row | {name: _cell(value) for name, value in flat(record["config"], CONFIG).items()}


def _series(values: list[Any], kind: str) -> pd.Series:
    """A column of that type; text if a foreign record has values of another type. Categories are text."""
    if kind != CATEGORY:
        try:
            return pd.Series(values, dtype=kind)
        except (TypeError, ValueError, OverflowError):
            return pd.Series([None if value is None else str(value) for value in values], dtype=TEXT)
    texts = [None if value is None else str(value) for value in values]
    categories = pd.Index(sorted({text for text in texts if text is not None}), dtype="str")
    return pd.Series(pd.Categorical(texts, categories=categories))


def _cell(value: Any) -> Any:
    return value if isinstance(value, str | int | float | None) else str(value)


def _sort_key(name: str) -> tuple[int, str]:
    """Sorts metrics first, then initial metrics, seconds, evaluations and settings; each group by name."""
    prefixes = [*list(PREFIXES.values())[1:], CONFIG]
    return next((rank for rank, prefix in enumerate(prefixes, 1) if name.startswith(prefix)), 0), name


def _type(name: str, values: list[Any]) -> str:
    """The type of a column: a setting's follows from its values, a measured column is a number unless it has text."""
    if name in FIXED_COLUMNS:
        return FIXED_COLUMNS[name]
    kinds = {type(value) for value in values if value is not None}
    if kinds == {bool}:
        return BOOLEAN
    if kinds == {int} and name.startswith(CONFIG):
        return INTEGER
    return NUMBER if kinds <= {int, float} and (kinds or not name.startswith(CONFIG)) else TEXT
