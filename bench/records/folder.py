"""The folder of a run: named after its configuration, locked by one process at a time, and never overwritten."""

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
from bench.records.files import file_lock, to_json
from bench.records.identity import Identity
from bench.records.record import NEUTRAL_KEYS, RunStatus, read_record

RESERVE = 64 * 1024  # bytes kept free, so that the record can still be written when the disk has become full
RESERVED = ".reserve"
DECIDING = NEUTRAL_KEYS - {"results_dir", "verbose", "rerun"}  # whether a run that failed would fail again


@dataclass(frozen=True)
class Claim:
    """A run's folder, locked by this process; `finished` is the record in it where that run is to be reused."""

    folder: Path
    finished: dict[str, Any] | None


@contextmanager
def claimed(results_dir: Path, identity: Identity, rerun: Rerun) -> Iterator[Claim]:
    """Locks the folder of a run, after waiting for any other process that holds it.

    A finished run of the same code is kept, to be reused; any other run is moved to `results_dir/earlier`.

    Raises:
        OSError: where the results folder cannot be written.
    """
    folder = results_dir / "runs" / identity.name
    with file_lock(results_dir, identity.name):
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
        # Settings that change no result, such as a limit, can still decide whether a run fails.
        limits = [{key: config.get(key) for key in DECIDING} for config in (record["config"], identity.config)]
        return record if rerun == Rerun.none and limits[0] == limits[1] else None
    return record


def set_aside(folder: Path, earlier: Path) -> None:
    """Moves a folder, if it exists, to `earlier`, where a hash of its content is added to its name."""
    if folder.exists():
        place = earlier / f"{folder.name}-{content_of(folder)}"
        earlier.mkdir(exist_ok=True)
        if place.exists():  # the same run was set aside before
            shutil.rmtree(folder)
        else:
            folder.rename(place)


def put_into(place: Path, folder: Path) -> None:
    """Copies a folder to a place atomically; does nothing where the place exists already."""
    if place.exists():
        return
    place.parent.mkdir(parents=True, exist_ok=True)
    scratch = place.with_name(f".{place.name}.{os.getpid()}")
    shutil.copytree(folder, scratch)
    scratch.rename(place)


def content_of(folder: Path) -> str:
    """A hash of a run folder's files, without the fields `asked` and `reused` of its record."""
    whole = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        content = path.read_bytes()
        if path.name == "record.json":
            content = _without_requests(content)
        whole.update(path.relative_to(folder).as_posix().encode() + b"\0" + hashlib.sha256(content).digest())
    return whole.hexdigest()[:12]


def _without_requests(content: bytes) -> bytes:
    """A record without the fields that a later request of the same run changes."""
    try:
        record = json.loads(content)
        return to_json({key: value for key, value in record.items() if key not in ("asked", "reused")}).encode()
    except (ValueError, AttributeError, RecursionError):  # a damaged record is hashed unchanged
        return content


def release(folder: Path) -> None:
    """Frees the reserved bytes, before the last write."""
    (folder / RESERVED).unlink(missing_ok=True)


def _reserve(folder: Path) -> None:
    with suppress(OSError), (folder / RESERVED).open("wb") as file:  # on a full disk, writing the record will fail
        file.write(os.urandom(RESERVE))
        os.fsync(file.fileno())
