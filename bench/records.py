"""Run folders: claimed once, with a record that says what became of the run, whatever happens."""

import hashlib
import json
import os
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from math import isfinite
from pathlib import Path
from typing import Any

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
    started: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))
    status: RunStatus = RunStatus.KILLED
    reason: str = "the run is under way, or was killed before it could say why"
    metrics: dict[str, float] = field(default_factory=dict)
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

    @property
    def name(self) -> str:
        """What tables call it: its label, or else its renderer."""
        return self.config.get("label") or self.renderer

    def write(self, folder: Path) -> None:
        """Writes `record.json` so that a reader, or a crash, never meets half of one."""
        write_text(folder / "record.json", to_json({"schema": SCHEMA, **self.__dict__}))


def claim_folder(results_dir: Path, name: str) -> Path:
    """Makes a run folder of this name, with a number behind it where the name is taken.

    Raises:
        OSError: where the results folder cannot be written.
    """
    runs = results_dir / "runs"
    runs.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        folder = runs / (name if number == 1 else f"{name}-{number}")
        try:
            folder.mkdir()
            return folder
        except FileExistsError:
            number += 1


def digest(data: Any) -> str:
    """A hash of plain data, the same whatever the order of its keys."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:12]


def write_text(path: Path, text: str) -> None:
    """Writes a file beside its place, flushes it to the disk and renames it there."""
    scratch = path.with_name(f".{path.name}.{os.getpid()}")
    with scratch.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    scratch.replace(path)


def to_json(data: Any) -> str:
    """JSON in which the floats that it lacks stand as the strings "inf", "-inf" and "nan"."""
    return json.dumps(plain(data), indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def plain(value: Any) -> Any:
    """The same data with the floats that JSON lacks as the strings "inf", "-inf" and "nan"."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not isfinite(value):
        return str(value)
    return value
