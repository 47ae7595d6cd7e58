"""The data of a run's page: request, status, metrics, costs, settings, curve and pictures."""

from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from bench.records.names import SharedSettings
from bench.records.record import as_number, flat
from bench.records.results import NOT_LOSS_TERMS, curve_lines
from bench.report.data.records import Record, definition
from bench.report.site.columns import rounded
from bench.report.site.files import PICTURE_TEXTS, Folder
from bench.report.site.rays import rays
from bench.report.site.words import STATUSES, command, request_sentence

MAX_CURVE_POINTS = 240  # longer curves are thinned, but keep their ends and checkpoints
PHASES = {
    "warmup": "warm-up, off the clock",
    "forward": "optimisation: forward",
    "backward": "optimisation: backward",
    "evaluation": "evaluation and pictures",
}
MAX_LOSS_TERMS = 8
LEADING_KEYS = ("label", "field", "split", "index", "seed", "device", "threads", "experiment", "draw")


def detail(record: Record, folder: Folder, results_dir: Path) -> dict[str, Any]:
    """The data of a run's page, except name, scene and status, which are in the list of runs."""
    return {
        "asked": request_sentence(record),
        "reason": record["reason"],
        "said": STATUSES[record["status"]]._asdict(),
        "notes": [text(note) for note in record["notes"]],
        "log": [text(line) for line in record.get("log") or []],
        "metrics": _metrics(record),
        "costs": _costs(record),
        "environment": [(text(key), text(value)) for key, value in record["environment"].items()],
        "settings": settings(record),
        "files": folder.links(),
        "pictures": [[name, folder.link(name), PICTURE_TEXTS.get(name, "")] for name in folder.pictures()],
        "curve": curve(folder),
        "rays": rays(record, folder),
        "command": command(record, results_dir),
    }


def settings(record: Record) -> list[tuple[str, str]]:
    """All settings of the run by dotted key, the most important first."""
    rows: list[tuple[str, str]] = []
    for key, value in sorted(record["config"].items(), key=lambda item: _sort_key(item[0])):
        if key != "results_dir":
            rows += _shared_rows(key, value) if isinstance(value, SharedSettings) else _rows(key, value)
    return rows


def _rows(key: str, value: Any) -> list[tuple[str, str]]:
    value_by_key = flat({key: value}) if isinstance(value, dict) else {key: value}
    return [(key, text(value_by_key[key])) for key in sorted(value_by_key)]


_shared_rows = lru_cache(maxsize=10_000)(_rows)


@cache
def _sort_key(key: str) -> tuple[int, str]:
    leading = ("task", "renderer", "dataset", *LEADING_KEYS)
    return leading.index(key) if key in leading else len(leading), f"{key}."  # as the first of its settings


def text(value: Any) -> str:
    try:
        return "null" if value is None else str(value)
    except (RecursionError, ValueError):  # nested too deeply, or an integer with too many digits
        return "…"


def curve(folder: Folder) -> dict[str, Any] | None:
    """The lines of `curve.jsonl` as thinned columns; None without a curve."""
    lines = curve_lines(folder.path) if folder.has("curve.jsonl") else None
    numbered = [line for line in lines or [] if as_number(line.get("iteration")) is not None]
    if not numbered:
        return None
    keys = dict.fromkeys(key for line in numbered for key in line)
    terms = [key for key in keys if key not in NOT_LOSS_TERMS]
    terms = [key for key in terms if any(as_number(line.get(key)) is not None for line in numbered)][:MAX_LOSS_TERMS]
    thinned = [numbered[index] for index in _kept_indices(numbered)]
    names = [*NOT_LOSS_TERMS, *terms]
    return {"terms": terms, **{name: [rounded(line.get(name)) for line in thinned] for name in names}}


def _kept_indices(lines: list[dict[str, Any]]) -> list[int]:
    step = max(1, -(-len(lines) // MAX_CURVE_POINTS))
    regular = {0, len(lines) - 1, *range(0, len(lines), step)}
    checkpoints = [index for index, line in enumerate(lines) if as_number(line.get("chamfer_l2")) is not None]
    thinned = checkpoints[:: max(1, -(-len(checkpoints) // MAX_CURVE_POINTS))]
    return sorted(regular | set(thinned) | set(checkpoints[-1:]))


def _metrics(record: Record) -> list[list[Any]]:
    names = tuple(dict.fromkeys([*record["metrics"], *record["metrics_start"]]))
    definitions = _definitions(tuple((key, text(words)) for key, words in record["definitions"].items()), names)
    before, after, best = record["metrics_start"], record["metrics"], record.get("metrics_best", {})
    return [
        [name, _value(before.get(name)), _value(after.get(name)), definitions[name], _value(best.get(name))]
        for name in names
    ]


@lru_cache(maxsize=1000)  # most runs of a task share their definitions
def _definitions(pairs: tuple[tuple[str, str], ...], names: tuple[str, ...]) -> dict[str, str]:
    return {name: definition(dict(pairs), name) for name in names}


def _value(value: Any) -> int | float | str | None:
    number = as_number(value)
    return number if number is not None or value is None else text(value)


def _costs(record: Record) -> dict[str, Any]:
    seconds, evaluations = record["seconds"], record["evaluations"]
    total = as_number(seconds.get("total"))
    phases = [[label, as_number(seconds.get(key)), key in ("forward", "backward")] for key, label in PHASES.items()]
    timed_phases = [phase for phase in phases if phase[1] is not None]
    rest = None if total is None else total - sum(phase[1] for phase in timed_phases)
    if rest is not None and timed_phases and rest > 0:
        timed_phases.append(["start, set-up and the rest", rest, False])
    return {
        "phases": timed_phases,
        "total": total,
        "evaluations": [[name, as_number(evaluations.get(name))] for name in evaluations],
        "flops": as_number(record["flops"]),
        "gemm_fraction": as_number(record["gemm_fraction"]),
        "peak_memory_bytes": as_number(record["peak_memory_bytes"]),
    }
