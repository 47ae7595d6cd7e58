"""The record of a run: the schema of `record.json`, and how it is written and read."""

import json
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from enum import StrEnum
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

from bench.records.files import decoded, to_json, write_text

SCHEMA = 1
# Keys of a configuration that change no result, and are left out of its hash.
NEUTRAL_KEYS = frozenset(
    (
        *("results_dir", "priors_dir", "sizes", "verbose", "isolation", "time_limit", "memory_limit", "rerun"),
        *("tracker", "plan"),
    )
)
NUMERIC = ("metrics", "metrics_start", "evaluations", "seconds", "peak_memory_bytes", "flops", "gemm_fraction")
# Fields that old records may lack.
LATER = ("method", "scene", "config_hash", "code", "ended", "log", "notes", "asked", "overrides")


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
PICTURES = ("summary.png", "strip.png", "failure.png")  # of a run: the first that it has is looked at first
NOT_RUN = "not_run"  # the status of a planned cell without a run, which has no record.json


def now() -> str:
    """The current time in UTC, to the millisecond."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


@dataclass(repr=False)
class Record:
    """The content of `record.json`. A new record has the status killed, which holds until its run ends."""

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
    definitions: dict[str, Any] = field(default_factory=dict)
    evaluations: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, Any] = field(default_factory=dict)
    peak_memory_bytes: int | float | None = None
    flops: int | float | None = None
    gemm_fraction: float | int | None = None
    environment: dict[str, Any] = field(default_factory=dict)
    reused: bool = False
    notes: list[str] = field(default_factory=list)
    config_hash: str = ""
    code: str = ""  # hash of the code that ran, and of the files that it read
    asked: str = field(default_factory=now)  # when it was last requested; a reused run ran earlier
    ended: str = ""  # empty while it is under way, and where it was killed before it could write this
    log: list[str] = field(default_factory=list)  # the last lines of log.txt, where the run failed
    overrides: list[str] = field(default_factory=list)  # what the command line set, as KEY=VALUE

    def __repr__(self) -> str:
        """What was run, how it ended, and where it is."""
        return f"<run {self.outcome}{f' ({self.reason})' if self.reason else ''}; {self.id}>"

    @property
    def name(self) -> str:
        """Its name in tables: its label, or else that of its renderer, or else the renderer's name."""
        return row_name(self.config, self.renderer)

    @property
    def title(self) -> str:
        """What was run, on what: for pictures and tables."""
        return f"{self.task}, {self.name}, {self.scene or self.dataset}"

    @property
    def outcome(self) -> str:
        """The title with the status."""
        return f"{self.title}: {self.status}"

    @property
    def folder(self) -> Path:
        """Its folder, by the results folder of its configuration."""
        return Path(self.config["results_dir"]) / "runs" / self.id

    @classmethod
    def of(cls, data: dict[str, Any]) -> "Record":
        """The record of data that `read_record` has checked; unknown fields are ignored."""
        known = {item.name: data[item.name] for item in fields(cls) if item.name in data}
        return cls(**{**known, "status": RunStatus(data["status"])})

    def write(self, folder: Path) -> None:
        """Writes `record.json` atomically."""
        write_text(folder / "record.json", to_json({"schema": SCHEMA, **self.__dict__}))


def row_name(config: dict[str, Any], renderer: str) -> str:
    """The name of a run's row: that of `renderer_name`, with a silhouette loss that is not the renderer's own.

    Where a task was told to leave the masks out, no loss of them took part.
    """
    name, loss = renderer_name(config, renderer), _labelled(config.get("silhouette"))
    if (config.get("task") or {}).get("masks") is False:
        loss = "without masks"
    return f"{name}, {loss}" if loss else name


def renderer_name(config: dict[str, Any], renderer: str) -> str:
    """The label of a run's configuration, or of its renderer's node, or the name of the renderer's file."""
    return str(config.get("label") or _labelled(config.get("renderer")) or renderer)


def _labelled(node: Any) -> str:
    return str(node.get("_label_") or "") if isinstance(node, dict) else ""


def read_record(folder: Path) -> dict[str, Any]:
    """The record of one run folder, with non-finite numbers as floats and the folder's name under `folder`.

    Raises:
        OSError, ValueError, RecursionError: where it cannot be read; the message gives the reason.
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
    record |= {name: decoded(record[name]) for name in NUMERIC if name in record}
    _check(record)
    started(record), requested(record)  # a time that cannot be read is an error here, not later in a sort
    return record | {"folder": folder.name}


def requested(record: dict[str, Any]) -> datetime:
    """When the run was last requested; a reused one ran earlier."""
    return _time(record["asked"])


def started(record: dict[str, Any]) -> datetime:
    """When the run started; a time without an offset is UTC."""
    return _time(record["started"])


def _check(record: dict[str, Any]) -> None:
    """Raises ValueError where a field of `Record` has another type, or is missing and not in `LATER`, or no status."""
    for name, classes in _fields().items():
        if name not in record:
            if name in LATER:
                continue
            raise ValueError(f"record.json must have the field {name!r}, found none")
        if not isinstance(record[name], classes):
            raise ValueError(f"{name} in record.json has the wrong type, found {type(record[name]).__name__}")
    if record["status"] not in _STATUSES:
        raise ValueError(f"status in record.json must be one of {', '.join(RunStatus)}, found {record['status']!r}")


@cache
def _fields() -> dict[str, tuple[type, ...]]:
    hints = get_type_hints(Record)
    return {item.name: _classes(hints[item.name]) for item in fields(Record)}


def _classes(hint: Any) -> tuple[type, ...]:
    if isinstance(hint, UnionType):
        return tuple(cls for part in get_args(hint) for cls in _classes(part))
    return (get_origin(hint) or hint,)


def _time(text: str) -> datetime:
    time = datetime.fromisoformat(text)
    return time if time.tzinfo else time.replace(tzinfo=UTC)
