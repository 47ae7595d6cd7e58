"""One run: locks its folder, runs in a child process, and always writes its record."""

import shutil
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from bench.config import Isolation, build
from bench.progress import Report, notice, run_progress
from bench.records.folder import Identity, free_reserve, locked_folder, reusable_record
from bench.records.read import Plan
from bench.records.record import Record, RunStatus, now, read_record, write_text
from bench.runner import messages
from bench.runner.messages import Interrupted, RunRequest, reason_of, write_error_message
from bench.runner.plan import planned_cell, refusal_reasons, show_plan
from bench.runner.process import RunLimits, run_isolated, signals_delayed, stopped_by
from bench.runner.summary import print_run_summary, write_log
from bench.trackers import Nothing, Tracker

LOG_TAIL_LINES, LOG_TAIL_BYTES = 80, 16_384  # limits of the log in the record of a failed run


class RunInterrupted(Interrupted):
    """Ctrl-C or SIGTERM ended a run, and its record has been written."""

    def __init__(self, folder: Path, record: Record) -> None:
        super().__init__(f"killed: {record.reason}")
        self.folder, self.record = folder, record


def run_one(identity: Identity) -> str:
    """Makes a single run, prints its summary and returns its status; with plan=true only lists it.

    Raises:
        RunInterrupted: after Ctrl-C or SIGTERM.
        ValueError: if the configuration cannot be run; its folder is removed.
        OSError: if the results folder cannot be written.
    """
    config = identity.config
    if config["plan"] or config["isolation"] == Isolation.process:
        _check(identity)
    if config["plan"]:
        return RunStatus.OK
    try:
        folder, record = run(identity)
    except RunInterrupted as error:
        print_run_summary(error.folder, error.record)
        raise
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), error.filename or config["results_dir"]) from error
    _print_log(record)
    if record.status == RunStatus.REFUSED:
        shutil.rmtree(folder)
        raise ValueError(record.reason)
    print_run_summary(folder, record)
    return record.status


def run_cell(identity: Identity) -> list[str]:
    """Makes the run of a sweep's cell, or reuses it; returns a message if it has no record.

    Raises:
        RunInterrupted: after Ctrl-C or SIGTERM.
    """
    try:
        _print_log(run(identity)[1])
    except OSError as error:
        return [write_error_message(error, identity.config["results_dir"])]
    except ValueError as error:
        return [str(error)]
    return []


def _print_log(record: Record) -> None:
    """Prints the last lines of a failed run's log, with verbose=true."""
    if record.config["verbose"] and record.log:
        print("\n".join(record.log), file=sys.stderr, flush=True)


def _check(identity: Identity) -> None:
    """Checks a run that is not reused, before it has a folder; with plan=true, prints its estimated duration.

    Raises:
        ValueError: if it would be refused.
    """
    config = identity.config
    results_dir = Path(config["results_dir"])
    reused = reusable_record(results_dir / "runs" / identity.name, identity, config["rerun"]) is not None
    if not reused and (reason := refusal_reasons([config])[0]):
        raise ValueError(reason)
    if config["plan"]:
        cell = planned_cell(identity)
        show_plan(Plan("", results_dir, [cell]), {cell.id} if reused else set(), 1)


def run(identity: Identity) -> tuple[Path, Record]:
    """Makes a run in its folder, or reuses the finished run there; returns the folder and the record.

    Raises:
        OSError: if the results folder cannot be written.
        RunInterrupted: after Ctrl-C or SIGTERM, with the record that was written.
    """
    config = identity.config
    with locked_folder(Path(config["results_dir"]), identity, config["rerun"]) as (folder, finished):
        if finished is not None:
            return folder, _reuse(folder, finished)
        hashes = {"config_hash": identity.config_hash, "code": identity.code}
        settings = {"seed": config["seed"], "config": config, "overrides": identity.overrides}
        return folder, _start_run(RunRequest(folder, Record(identity.name, **identity.choices, **settings, **hashes)))


def _reuse(folder: Path, finished: dict[str, Any]) -> Record:
    """The record of a finished run with its original times, marked as reused."""
    record = Record.of(finished)
    record.reused, record.asked = True, now()
    with suppress(OSError):  # a read-only folder is enough
        record.write(folder)
    return record


def _start_run(request: RunRequest) -> Record:
    """Runs a request; the record has the status killed until the end, then the final status."""
    folder, record = request.folder, request.record
    started, stopped, tracker = time.perf_counter(), "", None

    def restart_clock() -> None:
        nonlocal started
        started = time.perf_counter()

    try:
        record.write(folder)  # inside the try, because a signal may follow immediately
        config = record.config
        limits = RunLimits(config["time_limit"], config["memory_limit"])
        tracker = build(config["tracker"], "tracker", config["packages"])
        write_text(folder / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(config)))
        with run_progress(record.name) as progress:
            _execute(request, limits, progress, restart_clock)
    except (KeyboardInterrupt, Exception) as error:  # noqa: BLE001 - of the harness, such as a full disk
        stopped = stopped_by(error)
        record.status, record.reason = RunStatus.CRASHED, reason_of(error, folder)
        if stopped:
            record.status, record.reason = RunStatus.KILLED, f"{stopped}; the same command starts it anew"
    finally:
        with signals_delayed():  # a signal now must not lose the record
            record.seconds["total"] = time.perf_counter() - started
            record.ended = now()
            if record.status not in (RunStatus.OK, RunStatus.UNSUPPORTED):
                record.log = _log_tail(folder / "log.txt")
            free_reserve(folder)
            record.write(folder)
            write_log(folder, record)
    if not isinstance(tracker, Nothing | None) and record.status != RunStatus.REFUSED:
        _export(tracker, folder, record)
    if stopped:
        raise RunInterrupted(folder, record)
    return record


def _execute(request: RunRequest, limits: RunLimits, progress: Report, on_ready: Callable[[], None]) -> None:
    """Runs the request in a child process or, for debugging, in this one, and fills its record.

    Args:
        on_ready: called when the child has imported its modules.
    """
    if request.record.config["isolation"] == Isolation.off:
        from bench.runner.execute import execute  # imports torch, which a launcher's worker does not need

        execute(request, progress=progress, save_record=lambda record: record.write(request.folder))
        return

    def receive(message: messages.Message) -> None:
        if isinstance(message, messages.Started):
            on_ready()
        elif isinstance(message, Record):
            vars(request.record).update(vars(message))
            request.record.write(request.folder)
        elif isinstance(message, messages.Step):
            progress(message.phase, message.finished, message.total, message.loss)
        elif isinstance(message, messages.Notice):
            notice(message.text)

    if (failure := run_isolated(request, limits, receive)) is not None:
        request.record.status, request.record.reason = failure


def _export(tracker: Tracker, folder: Path, record: Record) -> None:
    """Exports a finished run; a failure becomes a note in the record."""
    try:
        tracker.export(folder, read_record(folder))
    except Exception as error:  # noqa: BLE001 - of a server, a database or another library
        record.notes = [*record.notes, f"not exported to the tracker: {' '.join(str(error).split())}"]
        record.write(folder)


def _log_tail(path: Path) -> list[str]:
    try:
        with path.open("rb") as file:
            file.seek(max(path.stat().st_size - LOG_TAIL_BYTES, 0))
            return file.read(LOG_TAIL_BYTES).decode("utf-8", "replace").splitlines()[-LOG_TAIL_LINES:]
    except OSError:
        return []
