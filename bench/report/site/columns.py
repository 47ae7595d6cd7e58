"""The list of all runs as columns, which the page filters, sorts and searches."""

from collections import Counter
from collections.abc import Hashable
from math import isfinite
from typing import Any

from bench.records.format import plural
from bench.records.metrics import TABLE_METRICS
from bench.records.names import SharedSettings, make_unique, ordered_settings, settings_of
from bench.records.record import NEUTRAL_KEYS, as_number, digest, row_name, started, to_json_values
from bench.report.data.records import (
    OURS,
    Record,
    cost,
    family,
    grouped,
    loop_seconds,
    run_key,
    setting,
    value_evaluations,
)
from bench.report.data.runs import MEASUREMENT_METRICS
from bench.report.site.files import Folder
from bench.report.suite.attempts import CUSTOM

SIGNIFICANT_DIGITS = 5  # a run's own page has all digits
MAX_REASON_LETTERS = 300
OBSERVATION_KEYS = (
    *("points", "depths", "mask", "images", "stress", "degrees", "shift", "given", "held_out", "size", "longest"),
)
METRICS = TABLE_METRICS | MEASUREMENT_METRICS
# The metric by which the runs of a task are sorted. For other tasks it is the first table metric that the runs have.
SORT_METRICS = {
    "pose": "rotation_error_deg",
    "pose_icp": "rotation_error_deg",
    "reconstruction": "seen_chamfer_l1",
    "single_view": "iou",
    "ablation": "step_seconds",
}
MAX_NAMED_SETTINGS = 3
# Keys of the configuration that have columns of their own, or follow from other keys.
IN_COLUMNS = NEUTRAL_KEYS | {
    *("dataset", "stress", "seed", "index", "split", "label", "experiment", "packages", "draw", "scale")
}
NAMED_FIRST = ("renderer", "task", "field", "method", "silhouette", "view")


def columns(records: list[Record], folders: list[Folder]) -> dict[str, Any]:
    """The columns, with one entry per record. Texts that repeat are stored once and referred to by number."""
    texts = {name: [get(record) for record in records] for name, get in TEXTS.items()}
    texts |= {"name": names(records), "thumb": [folder.thumb() for folder in folders]}
    return {
        "count": len(records),
        "folder": [folder.name for folder in folders],
        "address": [folder.link("") for folder in folders],
        "key": [folder.key for folder in folders],
        "reason": [_reason(record) for record in records],
        "texts": {name: _coded(values) for name, values in texts.items()},
        "numbers": {name: [rounded(get(record)) for record in records] for name, get in NUMBERS.items()},
        "metrics": _metrics(records),
        "reused": [index for index, record in enumerate(records) if record["reused"]],
        "tasks": _tasks(records),
    }


def names(records: list[Record]) -> list[str]:
    """The name of each run: of its row or class, and at most `MAX_NAMED_SETTINGS` settings in which runs differ.

    Settings with a column of their own are left out. A setting is added only if it distinguishes runs of one task, row
    and scale that the settings before it do not.
    """
    run_names = [_base_name(record) for record in records]
    cache: dict[Hashable, dict[str, str]] = {}
    settings = [_settings(record["config"], cache) for record in records]
    for indices in grouped(range(len(records)), lambda index: (records[index]["task"], run_names[index])).values():
        groups = list(grouped(indices, lambda index: (_scale(records[index]), str(settings[index]))).values())
        group_settings = [settings[group[0]] for group in groups]  # usually one group
        scales = [_scale(records[group[0]]) for group in groups]
        rows = [run_names[indices[0]]] * len(groups)
        ordered, numbers = ordered_settings(group_settings, NAMED_FIRST), [*map(scales.index, scales)]
        group_names = make_unique(ordered, groups=numbers, names=rows, limit=MAX_NAMED_SETTINGS)
        for group, name in zip(groups, group_names, strict=True):
            for index in group:
                run_names[index] = name
    return run_names


def _settings(config: dict[str, Any], cache: dict[Hashable, dict[str, str]]) -> dict[str, str]:
    """The settings of a run that its name may show; `cache` keeps the result for runs with equal settings."""
    kept = {key: value for key, value in config.items() if key not in IN_COLUMNS}
    parts = tuple((key, value if isinstance(value, SharedSettings) else repr(value)) for key, value in kept.items())
    if parts not in cache:
        cache[parts] = settings_of(kept, ())
    return cache[parts]


def _base_name(record: Record) -> str:
    """The name of a record's row; for a user's renderer without a label, its class."""
    name = row_name(record["config"], record["renderer"])
    target = str(setting(record["config"], "renderer", "_target_") or "")
    if record["renderer"] == CUSTOM and target and not target.startswith(OURS):
        class_name = target.rpartition(".")[2]
        return name.replace(CUSTOM, class_name, 1) if name.startswith(CUSTOM) else name
    return name


def _scale(record: Record) -> str:
    return str(setting(record["config"], "scale", "name") or "")


def machine(record: Record) -> str:
    """The machine and the threads that the run's times depend on; empty if the run ended too early to record them."""
    environment = record["environment"]
    names = [str(environment.get(key) or "") for key in ("cpu", "device")]
    label, threads = " + ".join(name for name in names if name and name != "cpu"), environment.get("threads")
    return f"{label}, {plural(threads, 'thread')}" if label and threads else ""


NUMBERS = {
    "seed": lambda record: record["seed"],
    "started": lambda record: int(started(record).timestamp()),
    "loop": lambda record: _safely(loop_seconds, record, None),
    "total": lambda record: record["seconds"].get("total"),
    "cost": lambda record: cost(record) or _safely(value_evaluations, record, None),  # old records lack the first
    "gradients": lambda record: record["evaluations"].get("gradient"),
}


TEXTS = {
    "task": lambda record: record["task"],
    "family": lambda record: _safely(family, record, record["dataset"]),
    "scene": lambda record: record.get("scene") or record["dataset"],
    "renderer": lambda record: record["renderer"],
    "scale": _scale,
    "status": lambda record: record["status"],
    "machine": machine,
    "experiment": lambda record: str(record["config"].get("experiment") or ""),
    "cell": lambda record: _safely(_cell, record, record["folder"]),
}


def _metrics(records: list[Record]) -> dict[str, Any]:
    columns = {}
    for key, metric in METRICS.items():
        sections = ("metrics", "metrics_start")
        final, initial = ([rounded(record[section].get(key)) for record in records] for section in sections)
        if any(value is not None for value in final):
            shown_initial = initial if any(value is not None for value in initial) else None
            columns[key] = {"key": key, **metric._asdict(), "after": final, "before": shown_initial}
    return columns


def _tasks(records: list[Record]) -> list[dict[str, Any]]:
    """The tasks, the most frequent first, with the metrics of their runs; the metric to sort by is first."""
    metrics_of: dict[str, set[str]] = {}
    for record in records:
        measured = {key for key in METRICS if as_number(record["metrics"].get(key)) is not None}
        metrics_of.setdefault(record["task"], set()).update(measured)
    tasks = []
    for task, count in Counter(record["task"] for record in records).most_common():
        first = SORT_METRICS.get(task)
        keys = sorted((key for key in METRICS if key in metrics_of[task]), key=lambda key, first=first: key != first)
        tasks.append({"task": task, "count": count, "metrics": keys})
    return tasks


def _cell(record: Record) -> str:
    """A hash of what runs must share to be compared: shape, view, seed and the observations."""
    task = setting(record["config"], "task")
    observed = {key: task[key] for key in OBSERVATION_KEYS if key in task} if isinstance(task, dict) else {}
    resolution = setting(record["config"], "view", "resolution")
    identity = [record["task"], record["dataset"], run_key(record), observed, resolution]
    return digest([identity, record["config"].get("split")])


def _coded(values: list[str]) -> dict[str, list]:
    """The distinct values, the most frequent first, and for each entry the number of its value."""
    counts = Counter(values)
    codes = {value: code for code, (value, _) in enumerate(counts.most_common())}
    return {"values": list(codes), "codes": [codes[value] for value in values]}


def _reason(record: Record) -> str:
    reason = " ".join(record["reason"].split())
    if record["status"] == "ok":
        return ""
    return (reason if len(reason) <= MAX_REASON_LETTERS else reason[:MAX_REASON_LETTERS] + " …") or "no reason recorded"


def rounded(value: Any) -> int | float | str | None:
    """A number with few digits; an infinite number or nan as a word, which the page's scripts decode."""
    if type(value) is float and isfinite(value):
        return float(f"{value:.{SIGNIFICANT_DIGITS}g}")
    number = as_number(value)
    return to_json_values(float(f"{number:.{SIGNIFICANT_DIGITS}g}")) if isinstance(number, float) else number


def _safely(get: Any, record: Record, default: Any) -> Any:
    """Returns `get(record)`, or `default` if a foreign record has values that `get` cannot read."""
    try:
        return get(record)
    except (AttributeError, TypeError, ValueError, RecursionError):
        return default
