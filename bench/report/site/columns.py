"""The list of all runs as columns, which the page filters, sorts and searches."""

from collections import Counter
from collections.abc import Hashable
from math import isfinite
from typing import Any

from bench.records.format import plural
from bench.records.metrics import MEASUREMENT_METRICS, SORT_METRICS, TABLE_METRICS
from bench.records.names import SharedSettings, make_unique, ordered_settings, settings_of
from bench.records.record import NEUTRAL_KEYS, as_number, digest, row_name, started, to_json_values
from bench.report.data.records import OURS, Record, family, grouped, loop_seconds, run_key, setting, value_evaluations
from bench.report.site.files import Folder

DIGITS = 5  # of numbers in the list; a run's own page has all of them
LONGEST_REASON = 300
GIVEN = ("points", "depths", "mask", "images", "stress", "degrees", "shift", "given", "held_out", "size", "longest")
METRICS = TABLE_METRICS | MEASUREMENT_METRICS
CUSTOM = "custom"  # the choice of renderer that stands for a user's class
MOST_TOLD = 3  # settings in a name
# Parts of a configuration that a list of runs shows in columns of their own, or that follow from others.
IN_COLUMNS = NEUTRAL_KEYS | {
    *("dataset", "stress", "seed", "index", "split", "label", "experiment", "packages", "draw", "scale")
}
# What is named first where several settings tell runs apart.
TOLD_FIRST = ("renderer", "task", "field", "method", "silhouette", "view")


def columns(records: list[Record], folders: list[Folder]) -> dict[str, Any]:
    """The columns, with an entry per record each; texts that repeat are numbers of entries in a list of values."""
    texts = {name: [of(record) for record in records] for name, of in TEXTS.items()}
    texts |= {"name": names(records), "thumb": [one.thumb() for one in folders]}
    return {
        "count": len(records),
        "folder": [folder.name for folder in folders],
        "address": [folder.link("") for folder in folders],
        "key": [folder.key for folder in folders],
        "reason": [_reason(record) for record in records],
        "texts": {name: _coded(values) for name, values in texts.items()},
        "numbers": {name: [rounded(of(record)) for record in records] for name, of in NUMBERS.items()},
        "metrics": _metrics(records),
        "reused": [place for place, record in enumerate(records) if record["reused"]],
        "tasks": _tasks(records),
    }


def names(records: list[Record]) -> list[str]:
    """The name of each run: that of its row, a user's renderer by its class, and the settings that differ.

    What differs is written as for the rows of a sweep, so that a setting reads the same in both; what stands in columns
    of its own, such as shape, seed and scale, is left out. Settings are added as long as one tells apart runs of one
    task, row and scale that those before it do not, so that what follows from another setting is not repeated; at most
    `MOST_TOLD`.
    """
    found = [_base_name(record) for record in records]
    known: dict[Hashable, dict[str, str]] = {}
    settings = [_settings(record["config"], known) for record in records]
    for places in grouped(range(len(records)), lambda place: (records[place]["task"], found[place])).values():
        alike = list(grouped(places, lambda place: (_scale(records[place]), str(settings[place]))).values())
        different = [settings[same[0]] for same in alike]  # most runs of a list have the same
        scales = [_scale(records[same[0]]) for same in alike]
        rows = [found[places[0]]] * len(alike)
        told = make_unique(
            ordered_settings(different, TOLD_FIRST), groups=[*map(scales.index, scales)], names=rows, limit=MOST_TOLD
        )
        for same, name in zip(alike, told, strict=True):
            for place in same:
                found[place] = name
    return found


def _settings(config: dict[str, Any], known: dict[Hashable, dict[str, str]]) -> dict[str, str]:
    """The settings of a run that may be in its name, made once for runs that share all of them; `known` has these."""
    kept = {key: value for key, value in config.items() if key not in IN_COLUMNS}
    parts = tuple((key, value if isinstance(value, SharedSettings) else repr(value)) for key, value in kept.items())
    if parts not in known:
        known[parts] = settings_of(kept, ())
    return known[parts]


def _base_name(record: Record) -> str:
    """The name of a record's row; of a user's renderer without a label, its class."""
    name = row_name(record["config"], record["renderer"])
    target = str(setting(record["config"], "renderer", "_target_") or "")
    if record["renderer"] == CUSTOM and target and not target.startswith(OURS):
        own = target.rpartition(".")[2]
        return name.replace(CUSTOM, own, 1) if name.startswith(CUSTOM) else name
    return name


def _scale(record: Record) -> str:
    return str(setting(record["config"], "scale", "name") or "")


def machine(record: Record) -> str:
    """The machine that the run's times depend on, with its threads; empty where the run ended before it knew."""
    environment = record["environment"]
    parts = [str(environment.get(name) or "") for name in ("cpu", "device")]
    label, threads = " + ".join(part for part in parts if part and part != "cpu"), environment.get("threads")
    return f"{label}, {plural(threads, 'thread')}" if label and threads else ""


NUMBERS = {
    "seed": lambda record: record["seed"],
    "started": lambda record: int(started(record).timestamp()),
    "loop": lambda record: _safely(loop_seconds, record, None),
    "total": lambda record: record["seconds"].get("total"),
    "values": lambda record: _safely(value_evaluations, record, None),
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
    found = {}
    for key, metric in METRICS.items():
        after, before = (
            [rounded(record[part].get(key)) for record in records] for part in ("metrics", "metrics_start")
        )
        if any(value is not None for value in after):
            start = before if any(value is not None for value in before) else None
            found[key] = {"key": key, **metric._asdict(), "after": after, "before": start}
    return found


def _tasks(records: list[Record]) -> list[dict[str, Any]]:
    """The tasks, the one with most runs first: the metrics that their runs have, the one to sort by first."""
    known: dict[str, set[str]] = {}
    for record in records:
        measured = {key for key in METRICS if as_number(record["metrics"].get(key)) is not None}
        known.setdefault(record["task"], set()).update(measured)
    found = []
    for task, count in Counter(record["task"] for record in records).most_common():
        first = SORT_METRICS.get(task)
        keys = sorted((key for key in METRICS if key in known[task]), key=lambda key, first=first: key != first)
        found.append({"task": task, "count": count, "metrics": keys})
    return found


def _cell(record: Record) -> str:
    """What must be alike for two runs to be compared: shape, view, seed, and what the task is given."""
    task = setting(record["config"], "task")
    given = {key: task[key] for key in GIVEN if key in task} if isinstance(task, dict) else {}
    about = [record["task"], record["dataset"], run_key(record), given, setting(record["config"], "view", "resolution")]
    return digest([about, record["config"].get("split")])


def _coded(values: list[str]) -> dict[str, list]:
    """Each value once, the most frequent first, and the number of the value at each place."""
    counts = Counter(values)
    numbers = {value: place for place, (value, _) in enumerate(counts.most_common())}
    return {"values": list(numbers), "codes": [numbers[value] for value in values]}


def _reason(record: Record) -> str:
    reason = " ".join(record["reason"].split())
    if record["status"] == "ok":
        return ""
    return (reason if len(reason) <= LONGEST_REASON else reason[:LONGEST_REASON] + " …") or "no reason recorded"


def rounded(value: Any) -> int | float | str | None:
    """A number with few digits; one that is not finite as a word, as the page's scripts have it."""
    if type(value) is float and isfinite(value):
        return float(f"{value:.{DIGITS}g}")
    known = as_number(value)
    return to_json_values(float(f"{known:.{DIGITS}g}")) if isinstance(known, float) else known


def _safely(of: Any, record: Record, otherwise: Any) -> Any:
    """What a function says of a record; something else where a record from elsewhere holds what it cannot read."""
    try:
        return of(record)
    except (AttributeError, TypeError, ValueError, RecursionError):
        return otherwise
