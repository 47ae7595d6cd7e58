"""Runs one cell: claims its folder, runs it where it can be stopped, and writes its record whatever happens."""

import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from bench.config import Isolation, build
from bench.identity import Identity, identify
from bench.isolation import RunLimits, run_isolated
from bench.job import Job, Message, Said, Step
from bench.progress import Report, notice, run_progress
from bench.records import Record, RunStatus, now, write_text
from bench.report.records import read_record
from bench.run_folder import Claim, claimed, release
from bench.trackers import Tracker

LAST_LINES, LAST_BYTES = 80, 16_384  # of the log, at most, kept in the record of a run that failed


class Interrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM ended a run; its record says so already."""

    def __init__(self, folder: Path, record: Record) -> None:
        super().__init__(f"killed: {record.reason}")
        self.folder, self.record = folder, record


def run(config: DictConfig) -> tuple[Path, Record]:
    """Runs a configuration in the folder that is its own, or reuses what is there; leaves its record.

    Raises:
        OSError: where the results folder cannot be written.
        Interrupted: after Ctrl-C or SIGTERM, with the record that was written.
    """
    identity = identify(config, HydraConfig.get().runtime.choices)
    with claimed(Path(config.results_dir), identity, config.rerun) as claim:
        if claim.finished is not None:
            return claim.folder, _reuse(claim.folder, claim.finished)
        record = _new_record(identity, claim)
        return claim.folder, _run_anew(config, claim.folder, record)


def _reuse(folder: Path, finished: dict[str, Any]) -> Record:
    """The record of a finished run, with its times, marked as reused."""
    record = Record.of(finished)
    record.reused, record.asked = True, now()
    with suppress(OSError):  # it can be read, which is enough
        record.write(folder)
    return record


def _run_anew(config: DictConfig, folder: Path, record: Record) -> Record:
    """Runs a configuration, whose record says under way until it says how the run ended."""
    record.write(folder)
    started, interrupted, tracker = time.perf_counter(), False, None
    try:
        limits = RunLimits(config.time_limit, config.memory_limit)
        tracker = build(config.tracker, "tracker", list(config.packages))
        write_text(folder / "config.yaml", OmegaConf.to_yaml(config, resolve=True))
        with run_progress(record.name) as progress:
            _carry_out(Job(config, folder, record), limits, progress)
    except KeyboardInterrupt as error:
        who = str(error) or "stopped by Ctrl-C"
        record.status, record.reason = RunStatus.KILLED, f"{who}; the same command starts it anew"
        interrupted = True
    except Exception as error:  # noqa: BLE001 - of the harness: a full disk, a limit that cannot be
        record.status, record.reason = RunStatus.CRASHED, " ".join(str(error).split()) or type(error).__name__
    finally:
        record.seconds["total"] = time.perf_counter() - started
        record.ended = now()
        if record.status not in (RunStatus.OK, RunStatus.UNSUPPORTED):
            record.log = _last_lines(folder / "log.txt")
        release(folder)
        record.write(folder)
    if tracker is not None:
        _export(tracker, folder, record)
    if interrupted:
        raise Interrupted(folder, record)
    return record


def _carry_out(job: Job, limits: RunLimits, progress: Report) -> None:
    """Does the job, in a child process or, for debugging, in this one; its record is filled as far as it came."""
    if job.config.isolation == Isolation.off:
        from bench.execute import execute  # it imports torch, which else only the child does

        execute(job.config, job.folder, job.record, progress=progress, checkpoint=lambda r: r.write(job.folder))
        return

    def receive(message: Message) -> None:
        if isinstance(message, Record):
            vars(job.record).update(vars(message))
            job.record.write(job.folder)
        elif isinstance(message, Step):
            progress(message.phase, message.done, message.total, message.loss)
        elif isinstance(message, Said):
            notice(message.text)

    ending = run_isolated(job, limits, receive)
    if ending is not None:
        job.record.status, job.record.reason = ending.status, ending.reason


def _export(tracker: Tracker, folder: Path, record: Record) -> None:
    """Exports a finished run; that it fails is noted in the record, and costs nothing else."""
    try:
        tracker.export(folder, read_record(folder))
    except Exception as error:  # noqa: BLE001 - of a server, a database, a library that is not ours
        record.notes = [*record.notes, f"not exported to the tracker: {' '.join(str(error).split())}"]
        record.write(folder)


def _new_record(identity: Identity, claim: Claim) -> Record:
    return Record(
        claim.folder.name,
        **identity.choices,
        seed=identity.config["seed"],
        config=identity.config,
        config_hash=identity.config_hash,
        code=identity.code,
    )


def _last_lines(path: Path) -> list[str]:
    try:
        with path.open("rb") as file:
            file.seek(max(path.stat().st_size - LAST_BYTES, 0))
            return file.read(LAST_BYTES).decode("utf-8", "replace").splitlines()[-LAST_LINES:]
    except OSError:
        return []
