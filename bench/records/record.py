"""The record of a run, `record.json`: its schema, and functions that write, lock and read it and other data."""

import hashlib
import json
import math
import os
from base64 import b64encode
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from enum import StrEnum
from functools import cache
from html import escape
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

from filelock import FileLock

from bench.records.format import breakdown, number
from bench.records.metrics import TABLE_METRICS, metric_fault

SCHEMA = 1
# Keys of a configuration that change no result. Its hash leaves them out.
NEUTRAL_KEYS = {
    *("results_dir", "priors_dir", "sizes", "verbose", "isolation", "time_limit", "memory_limit", "rerun"),
    *("tracker", "plan"),
}
CONCURRENT_RUNS_VARIABLE = "IMPLICIT_BENCH_BESIDE"  # environment variable: number of runs at a time in a cluster job
MAX_SETTINGS_DEPTH = 20
MIN_BUDGET_ITERATIONS = 10  # with fewer, a run that its budget ends has no result
TOO_EXPENSIVE = "the budget paid for"  # begins the reason of such a run
MAX_WAIT_FRACTION = 0.05  # if threads waited for a larger fraction of their ready time, the machine was loaded
NUMERIC_FIELDS = ("metrics", "metrics_start", "metrics_best", "evaluations", "seconds")
NUMERIC_FIELDS += ("peak_memory_bytes", "flops", "gemm_fraction")
# Fields that old records may lack.
OPTIONAL_FIELDS = ("method", "scene", "config_hash", "code", "ended", "log", "notes", "pictures", "asked", "overrides")
OPTIONAL_FIELDS += ("metrics_best",)
# JSON has no such numbers: these strings stand for them.
_NON_FINITE = {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}


class RunStatus(StrEnum):
    """How a run ended."""

    OK = "ok"
    DIVERGED = "diverged"
    NAN = "nan"
    EMPTY = "empty"
    NOT_REACHED = "not_reached"
    TIMEOUT = "timeout"
    OOM = "oom"
    CRASHED = "crashed"
    KILLED = "killed"
    UNSUPPORTED = "unsupported"
    REFUSED = "refused"


_STATUSES = frozenset(RunStatus)
PICTURE_FILES = ("summary.png", "strip.png", "failure.png")  # the first that a run has is its main picture
NOT_RUN = "not_run"  # the status of a planned cell without a run, which has no record.json


def now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


@dataclass(repr=False)
class Record:
    """The content of `record.json`. A new record has the status `killed`, which it keeps until its run ends."""

    id: str
    task: str
    renderer: str
    dataset: str
    seed: int | None
    config: dict[str, Any]
    method: str = ""  # the chosen method; empty where none was chosen
    scene: str = ""
    started: str = field(default_factory=now)
    status: RunStatus | str = RunStatus.KILLED
    reason: str = "the run is under way, or was killed before it could say why"
    metrics: dict[str, Any] = field(default_factory=dict)
    metrics_start: dict[str, Any] = field(default_factory=dict)
    metrics_best: dict[str, Any] = field(default_factory=dict)  # best possible ones, see `shipped.best_possible`
    definitions: dict[str, Any] = field(default_factory=dict)
    evaluations: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, Any] = field(default_factory=dict)
    peak_memory_bytes: int | float | None = None
    flops: int | float | None = None
    gemm_fraction: float | int | None = None
    environment: dict[str, Any] = field(default_factory=dict)
    reused: bool = False
    notes: list[str] = field(default_factory=list)
    pictures: dict[str, str] = field(default_factory=dict)  # small ones as data URIs, and their texts
    config_hash: str = ""
    code: str = ""  # hash of the code that ran, and of the files that it read
    asked: str = field(default_factory=now)  # time of the last request; a reused run ran earlier
    ended: str = ""  # empty while the run goes on, and if it was killed before it could write this
    log: list[str] = field(default_factory=list)  # the last lines of log.txt, if the run failed
    overrides: list[str] = field(default_factory=list)  # what the command line set, as KEY=VALUE

    def __repr__(self) -> str:
        """The title, the status, its reason and the run's folder name."""
        return f"<run {self.outcome}{f' ({self.reason})' if self.reason else ''}; {self.id}>"

    def _repr_html_(self) -> str:
        """The text of `__repr__` and the run's picture, for notebooks."""
        picture = self.folder / "summary.png"
        data = b64encode(picture.read_bytes()).decode() if picture.is_file() else ""
        image = f'<img src="data:image/png;base64,{data}" width="800">' if data else ""
        return f"<p>{escape(repr(self))}</p>{image}"

    @property
    def name(self) -> str:
        return row_name(self.config, self.renderer)

    @property
    def title(self) -> str:
        """Task, name and scene, for pictures and tables."""
        return f"{self.task}, {self.name}, {self.scene or self.dataset}"

    @property
    def outcome(self) -> str:
        return f"{self.title}: {self.status}"

    @property
    def verdict(self) -> str:
        """A sentence on the severity at which the renderer breaks; empty unless it is a finished stress test."""
        if self.status != RunStatus.OK or "severe_trials" not in self.metrics:
            return ""
        return f"{self.scene}: {self.name} {breakdown(self.metrics, self.config['task']['stress']['sweep'])}."

    def compared(self) -> list[tuple[str, dict[str, str], str]]:
        """The metrics of an optimisation: heading, values by their moment, and which direction is better."""
        moments = {"before": self.metrics_start, "after": self.metrics}
        moments |= {"best possible": self.metrics_best} if self.metrics_best else {}
        measured = {*self.metrics_start, *self.metrics} if self.metrics_start else set[str]()
        return [
            (metric.label, {key: number(each.get(name), metric.factor) for key, each in moments.items()}, metric.better)
            for name, metric in TABLE_METRICS.items()
            if name in measured
        ]

    @property
    def folder(self) -> Path:
        return Path(self.config["results_dir"]) / "runs" / self.id

    @classmethod
    def of(cls, data: dict[str, Any]) -> "Record":
        """The record of data that `read_record` has checked; unknown fields are ignored."""
        values = {item.name: data[item.name] for item in fields(cls) if item.name in data}
        return cls(**{**values, "status": RunStatus(data["status"])})

    def write(self, folder: Path) -> None:
        write_text(folder / "record.json", to_json({"schema": SCHEMA, **self.__dict__}))


def row_name(config: dict[str, Any], renderer: str) -> str:
    """The name of a run's row: `renderer_name`, and the silhouette loss unless it is the default of the renderer.

    If task.masks is false, the run used no silhouette loss, and the name has "without masks" unless it has "no masks".
    """
    name, loss = renderer_name(config, renderer), _label_of(config.get("silhouette"))
    if (config.get("task") or {}).get("masks") is False:
        loss = "" if name.endswith("no masks") else "without masks"
    return f"{name}, {loss}" if loss else name


def renderer_name(config: dict[str, Any], renderer: str) -> str:
    """The label of a run's configuration, else that of its renderer's node, else the name of the renderer's file."""
    return str(config.get("label") or _label_of(config.get("renderer")) or renderer)


def _label_of(node: Any) -> str:
    return str(node.get("_label_") or "") if isinstance(node, dict) else ""


def read_record(folder: Path) -> dict[str, Any]:
    """The record of one run folder, with non-finite numbers as floats and the folder's name under `folder`.

    Raises:
        OSError, ValueError, RecursionError: if it cannot be read; the message has the reason.
    """
    try:
        record = json.loads((folder / "record.json").read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"record.json is not JSON in UTF-8 ({error})") from error
    if not isinstance(record, dict):
        raise ValueError(f"record.json must hold an object, found {type(record).__name__}")
    if record.get("schema") != SCHEMA:
        raise ValueError(f"record.json must have schema {SCHEMA}, found {record.get('schema')!r}")
    record.setdefault("notes", [])
    record.setdefault("asked", record.get("started"))
    record |= {name: from_json_values(record[name]) for name in NUMERIC_FIELDS if name in record}
    _check_fields(record)
    started(record), requested(record)  # an invalid time is an error here, not later in a sort
    return record | {"folder": folder.name}


def requested(record: dict[str, Any]) -> datetime:
    """The time of the last request of the run; a reused run ran earlier."""
    return _parse_time(record["asked"])


def started(record: dict[str, Any]) -> datetime:
    """The start time of the run; a time without an offset is UTC."""
    return _parse_time(record["started"])


def _check_fields(record: dict[str, Any]) -> None:
    """Raises ValueError if a field has a wrong type or value, or is missing and not in `OPTIONAL_FIELDS`."""
    for name, types in _field_types().items():
        if name not in record:
            if name in OPTIONAL_FIELDS:
                continue
            raise ValueError(f"record.json must have the field {name!r}, found none")
        if not isinstance(record[name], types):
            raise ValueError(f"{name} in record.json has the wrong type, found {type(record[name]).__name__}")
    for name in ("metrics", "metrics_start", "metrics_best"):
        if fault := metric_fault(record.get(name, {})):
            raise ValueError(f"{name} in record.json: {fault}")
    if record["status"] not in _STATUSES:
        raise ValueError(f"status in record.json must be one of {', '.join(RunStatus)}, found {record['status']!r}")


@cache
def _field_types() -> dict[str, tuple[type, ...]]:
    hints = get_type_hints(Record)
    return {item.name: _runtime_types(hints[item.name]) for item in fields(Record)}


def _runtime_types(hint: Any) -> tuple[type, ...]:
    if isinstance(hint, UnionType):
        return tuple(runtime_type for member in get_args(hint) for runtime_type in _runtime_types(member))
    return (get_origin(hint) or hint,)


def _parse_time(text: str) -> datetime:
    time = datetime.fromisoformat(text)
    return time if time.tzinfo else time.replace(tzinfo=UTC)


def file_lock(folder: Path, name: str) -> FileLock:
    """A lock between processes for a name in a folder: one process holds it, the others wait."""
    locks = folder / ".locks"
    locks.mkdir(parents=True, exist_ok=True)
    return FileLock(locks / name)


def is_outside(path: Path, root: Path) -> bool:
    """Whether a path lies outside a folder after links are followed; a results folder may come from somebody else."""
    return not path.resolve().is_relative_to(root.resolve())


def bad_link(folder: Path, root: Path) -> str:
    """The path of the first link that leads out of `root`: the folder or a link in it at any depth; else empty."""
    if folder.is_symlink() and is_outside(folder, root):
        return folder.name
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                if entry.is_symlink():
                    if is_outside(Path(entry), root):
                        return entry.name
                elif entry.is_dir(follow_symlinks=False) and (inner_link := bad_link(Path(entry), root)):
                    return f"{entry.name}/{inner_link}"
    except OSError:  # the reader of the folder will report the error
        return ""
    return ""


def digest(data: Any) -> str:
    """A hash of JSON data, independent of the order of keys."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:12]


def write_text(path: Path, text: str) -> None:
    """Writes a file atomically, flushed to the disk."""
    write_bytes(path, text.encode("utf-8"), flushed=True)


def write_bytes(path: Path, content: bytes, *, flushed: bool = False) -> None:
    """Writes a file atomically: under a temporary name in the same folder, then renamed; a link is replaced."""
    scratch = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with scratch.open("wb") as file:
            file.write(content)
            if flushed:
                file.flush()
                os.fsync(file.fileno())
        scratch.replace(path)
    except BaseException:
        scratch.unlink(missing_ok=True)
        raise


@contextmanager
def curve_file(folder: Path) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Opens `folder/curve.jsonl` and yields a function that writes a line, which is in the file at once."""
    with (folder / "curve.jsonl").open("w", buffering=1, encoding="utf-8") as curve:
        yield lambda line: curve.write(json.dumps(to_json_values(line), allow_nan=False) + "\n")


def append_to_log(folder: Path, text: str) -> None:
    """Adds a text to a run's `log.txt`; on a full disk it is lost, but the record has the reason of a failure."""
    with suppress(OSError), (folder / "log.txt").open("a", encoding="utf-8", errors="backslashreplace") as log:
        log.write(f"{text}\n")


def to_json(data: Any) -> str:
    """The data as JSON text, with non-finite floats as the strings "inf", "-inf" and "nan"."""
    return json.dumps(to_json_values(data), indent=1, allow_nan=False, ensure_ascii=False, default=str) + "\n"


def to_json_values(value: Any) -> Any:
    """The same data with non-finite floats, which JSON lacks, as the strings "inf", "-inf" and "nan"."""
    if isinstance(value, dict):
        return {str(key): to_json_values(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json_values(item) for item in value]
    if not isinstance(value, str | int | float | None) and hasattr(value, "item"):
        value = value.item()  # a NumPy or PyTorch scalar
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def as_number(value: Any) -> int | float | None:
    """The value if it is a number that fits into a float, else None."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        float(value)
    except OverflowError:
        return None
    return value


def from_json_values(value: Any) -> Any:
    """The same data with the strings "inf", "-inf" and "nan" as floats: the inverse of `to_json_values`."""
    if isinstance(value, dict):
        return {key: from_json_values(item) for key, item in value.items()}
    if isinstance(value, list):
        return [from_json_values(item) for item in value]
    return _NON_FINITE.get(value, value) if isinstance(value, str) else value


def flat(node: dict[str, Any], prefix: str = "", depth: int = MAX_SETTINGS_DEPTH) -> dict[str, Any]:
    """The values of nested settings by dotted keys; nodes deeper than `depth` levels are replaced by "…"."""
    values: dict[str, Any] = {}
    for key, value in node.items():
        if isinstance(value, dict) and depth:
            values |= flat(value, f"{prefix}{key}.", depth - 1)
        else:
            values[f"{prefix}{key}"] = "…" if isinstance(value, dict) else value
    return values
