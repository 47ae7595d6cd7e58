"""The folder of a run: named by what it runs, held by one process at a time, and never overwritten."""

import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.config import Rerun
from bench.identity import Identity
from bench.records import RunStatus, alone, to_json
from bench.report.records import NEUTRAL_KEYS, read_record

RESERVE = 64 * 1024  # bytes that are kept, so that a record can be written to a disk that has become full
RESERVED = ".reserve"
DECIDING = NEUTRAL_KEYS - {"results_dir", "verbose", "rerun"}  # whether a run that failed would fail again


@dataclass(frozen=True)
class Claim:
    """A run's folder, held by this process, with the record of the finished run in it if that is to be reused."""

    folder: Path
    finished: dict[str, Any] | None


@contextmanager
def claimed(results_dir: Path, identity: Identity, rerun: Rerun) -> Iterator[Claim]:
    """Holds the folder of a run, after waiting for any other process that holds it.

    A finished run of the same code stays, to be reused; any other is set aside, whole, into `results_dir/earlier`.

    Raises:
        OSError: where the results folder cannot be written.
    """
    folder = results_dir / "runs" / identity.name
    with alone(results_dir, identity.name):
        record = reusable(folder, identity, rerun)
        if record is None:
            set_aside(folder, results_dir / "earlier")
            folder.mkdir(parents=True)
            _reserve(folder)
        try:
            yield Claim(folder, record)
        finally:
            release(folder)


def reusable(folder: Path, identity: Identity, rerun: Rerun) -> dict[str, Any] | None:
    """The record of a finished run of the same configuration and code, unless it is to be run again."""
    if rerun == Rerun.all:
        return None
    try:
        record = read_record(folder)
        status = RunStatus(record["status"])
    except (OSError, ValueError, RecursionError):
        return None
    same = (record.get("config_hash"), record.get("code")) == (identity.config_hash, identity.code)
    if not same or not record.get("ended") or status == RunStatus.KILLED:
        return None
    if status != RunStatus.OK:
        # What changes no result may well decide a failure, such as a limit.
        limits = [{key: config.get(key) for key in DECIDING} for config in (record["config"], identity.config)]
        return record if rerun == Rerun.none and limits[0] == limits[1] else None
    return record


def set_aside(folder: Path, earlier: Path) -> None:
    """Moves a folder, if it is there, under its name and a hash of its content."""
    if folder.exists():
        place = earlier / f"{folder.name}-{content_of(folder)}"
        earlier.mkdir(exist_ok=True)
        if place.exists():  # the same was set aside before
            shutil.rmtree(folder)
        else:
            folder.rename(place)


def put_into(place: Path, folder: Path) -> None:
    """Copies a folder to a place that is empty, whole or not at all."""
    if place.exists():
        return
    place.parent.mkdir(parents=True, exist_ok=True)
    scratch = place.with_name(f".{place.name}.{os.getpid()}")
    shutil.copytree(folder, scratch)
    scratch.rename(place)


def content_of(folder: Path) -> str:
    """A hash of a run folder's files, but for what its record says of when it was asked for again."""
    whole = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        content = path.read_bytes()
        if path.name == "record.json":
            content = _without_asking(content)
        whole.update(path.relative_to(folder).as_posix().encode() + b"\0" + hashlib.sha256(content).digest())
    return whole.hexdigest()[:12]


def _without_asking(content: bytes) -> bytes:
    try:
        record = json.loads(content)
        return to_json({key: value for key, value in record.items() if key not in ("asked", "reused")}).encode()
    except (ValueError, AttributeError, RecursionError):  # damaged: as it is
        return content


def release(folder: Path) -> None:
    """Gives back what was reserved, before the last write."""
    (folder / RESERVED).unlink(missing_ok=True)


def _reserve(folder: Path) -> None:
    with suppress(OSError), (folder / RESERVED).open("wb") as file:  # a disk that is full by now says so at the record
        file.write(os.urandom(RESERVE))
        os.fsync(file.fileno())
