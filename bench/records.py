"""Run folders: claimed once, with a record that says what became of the run, whatever happens."""

import hashlib
import json
import os
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from enum import StrEnum
from math import isfinite
from pathlib import Path
from typing import Any

from filelock import FileLock

SCHEMA = 1


class RunStatus(StrEnum):
    """What became of a run."""

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


def now() -> str:
    """The time, to the millisecond, in UTC."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


@dataclass
class Record:
    """What `record.json` holds. A new record says killed, which is true until its run ends in another way."""

    id: str
    task: str
    renderer: str
    dataset: str
    seed: int
    config: dict[str, Any]
    scene: str = ""
    started: str = field(default_factory=now)
    status: RunStatus = RunStatus.KILLED
    reason: str = "the run is under way, or was killed before it could say why"
    metrics: dict[str, Any] = field(default_factory=dict)
    metrics_start: dict[str, float] = field(default_factory=dict)
    definitions: dict[str, str] = field(default_factory=dict)
    evaluations: dict[str, float] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    peak_memory_bytes: int | None = None
    flops: int | None = None
    gemm_fraction: float | None = None
    environment: dict[str, Any] = field(default_factory=dict)
    reused: bool = False
    notes: list[str] = field(default_factory=list)
    config_hash: str = ""
    code: str = ""  # hash of the code that ran, and of the files that it read
    asked: str = field(default_factory=now)  # when it was last asked for, which for a reused run is not when it ran
    ended: str = ""  # empty while it is under way, and where it could not say
    log: list[str] = field(default_factory=list)  # the end of log.txt, of a run that failed

    @property
    def name(self) -> str:
        """What tables call it: its label, or else its renderer."""
        return self.config.get("label") or self.renderer

    @classmethod
    def of(cls, data: dict[str, Any]) -> "Record":
        """The record of data that `bench.report.records.read_record` has checked; what it does not know is left out."""
        known = {item.name: data[item.name] for item in fields(cls) if item.name in data}
        return cls(**{**known, "status": RunStatus(data["status"])})

    def write(self, folder: Path) -> None:
        """Writes `record.json` so that a reader, or a crash, never meets half of one."""
        write_text(folder / "record.json", to_json({"schema": SCHEMA, **self.__dict__}))


def alone(folder: Path, name: str) -> FileLock:
    """A lock on a name in a folder: of all processes that take it, one goes on, the others wait."""
    locks = folder / ".locks"
    locks.mkdir(parents=True, exist_ok=True)
    return FileLock(locks / name)


def digest(data: Any) -> str:
    """A hash of plain data, the same whatever the order of its keys."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:12]


def write_text(path: Path, text: str) -> None:
    """Writes a file beside its place, flushes it to the disk and renames it there."""
    scratch = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with scratch.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        scratch.replace(path)
    except BaseException:
        scratch.unlink(missing_ok=True)
        raise


def to_json(data: Any) -> str:
    """JSON in which the floats that it lacks stand as the strings "inf", "-inf" and "nan"."""
    return json.dumps(plain(data), indent=1, allow_nan=False, ensure_ascii=False, default=str) + "\n"


def plain(value: Any) -> Any:
    """The same data with the floats that JSON lacks as the strings "inf", "-inf" and "nan"."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if not isinstance(value, str | int | float | None) and hasattr(value, "item"):
        value = value.item()  # a number of NumPy's or PyTorch's
    if isinstance(value, float) and not isfinite(value):
        return str(value)
    return value
