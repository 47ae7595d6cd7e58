"""One run: locks its folder, runs in a child process, and always writes its record."""

import shutil
import sys
import time
from contextlib import suppress
from pathlib import Path

from omegaconf import OmegaConf

from bench.config import Isolation, build
from bench.progress import run_progress
from bench.records.folder import code_hash, config_hash, free_reserve, locked_folder
from bench.records.record import Record, RunStatus, append_to_log, now, read_record, write_text
from bench.records.results import Plan, PlannedRun, ended_record, write_error_message
from bench.runner.messages import Interrupted, reason_of
from bench.runner.plan import refusal_reasons, reused_ids
from bench.runner.process import RunInProgress, run_isolated, signals_delayed, stopped_by
from bench.runner.summary import log_lines, print_run_summary
from bench.tables import extension
from bench.trackers import Nothing, Tracker

LOG_TAIL_LINES, LOG_TAIL_BYTES = 80, 16_384  # limits of the log in the record of a failed run


class RunInterrupted(Interrupted):
    """Ctrl-C or SIGTERM ended a run, and its record has been written."""

    def __init__(self, record: Record) -> None:
        super().__init__(f"killed: {record.reason}")
        self.record = record


def run_one(run: PlannedRun) -> str:
    """Makes a single run, prints its summary and returns its status; with plan=true only lists it.

    Raises:
        RunInterrupted: after Ctrl-C or SIGTERM.
        ValueError: if the configuration cannot be run; its folder is removed.
        OSError: if the results folder cannot be written.
    """
    config = run.config
    if config["plan"] or config["isolation"] == Isolation.process:  # else the run itself is the check
        reused = reused_ids([run])
        if not reused and (reason := refusal_reasons([config])[0]):
            raise ValueError(reason)
    if config["plan"]:
        extension("show_plan")(Plan("", Path(config["results_dir"]), [run]), reused, 1)
        return RunStatus.OK
    try:
        record = make_or_reuse(run)
    except RunInterrupted as error:
        print_run_summary(run.folder, error.record)
        raise
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), error.filename or config["results_dir"]) from error
    _print_log(record)
    if record.status == RunStatus.REFUSED:
        shutil.rmtree(run.folder)
        raise ValueError(record.reason)
    print_run_summary(run.folder, record)
    return record.status


def run_cell(cell: PlannedRun, planned_at: str) -> list[str]:
    """Makes the run of a sweep's cell, or reuses it; returns a message if it has no record.

    Nothing is done if the cell has ended since its sweep was planned, so that a requeued job continues.

    Raises:
        RunInterrupted: after Ctrl-C or SIGTERM.
    """
    record = ended_record(cell.folder, planned_at)
    if record is not None and record["status"] != RunStatus.KILLED:
        return []
    try:
        _print_log(make_or_reuse(cell, planned_at))
    except OSError as error:
        return [write_error_message(error, cell.config["results_dir"])]
    except ValueError as error:
        return [str(error)]
    return []


def _print_log(record: Record) -> None:
    """Prints the last lines of a failed run's log, with verbose=true."""
    if record.config["verbose"] and record.log:
        print("\n".join(record.log), file=sys.stderr, flush=True)


def make_or_reuse(run: PlannedRun, planned_at: str = "") -> Record:
    """Makes a run in its folder, or reuses the finished run there; returns the record.

    Args:
        planned_at: when the sweep was planned. The clock of this machine may be behind that of the planning machine,
            but the time of the request is never before the plan.

    Raises:
        OSError: if the results folder cannot be written.
        RunInterrupted: after Ctrl-C or SIGTERM, with the record that was written.
    """
    request_time = max(now(), planned_at)
    with locked_folder(run) as finished:
        if finished is None:
            hashes = {"config_hash": config_hash(run.config), "code": code_hash(run.config)}
            return _make(Record(**vars(run), **hashes, asked=request_time))
        record = Record.of(finished)
        record.reused, record.asked = True, request_time
        with suppress(OSError):  # a read-only folder is enough
            record.write(run.folder)
        return record


def _make(record: Record) -> Record:
    """Makes the run of a record. Its status is killed during the run, and final at the end."""
    folder, stopped, tracker, run = record.folder, "", None, RunInProgress(record)
    try:
        record.write(folder)  # inside the try, because a signal may follow immediately
        tracker = build(record.config["tracker"], "tracker", record.config["packages"])
        write_text(folder / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(record.config)))
        with run_progress(record.name) as run.report:
            _execute(run)
    except (KeyboardInterrupt, Exception) as error:  # noqa: BLE001 - of the harness, such as a full disk
        stopped = stopped_by(error)
        record.status, record.reason = RunStatus.CRASHED, reason_of(error, folder)
        if stopped:
            record.status, record.reason = RunStatus.KILLED, f"{stopped}; the same command starts it anew"
    finally:
        with signals_delayed():  # a signal now must not lose the record
            record.seconds["total"] = time.perf_counter() - run.started
            record.ended = now()
            if record.status not in (RunStatus.OK, RunStatus.UNSUPPORTED):
                record.log = _log_tail(folder / "log.txt")
            free_reserve(folder)
            record.write(folder)
            append_to_log(folder, "\n".join(log_lines(record)))
    if not isinstance(tracker, Nothing | None) and record.status != RunStatus.REFUSED:
        _export(tracker, folder, record)
    if stopped:
        raise RunInterrupted(record)
    return record


def _execute(run: RunInProgress) -> None:
    """Makes the run in a child process or, for debugging, in this one, and fills its record."""
    if run.record.config["isolation"] == Isolation.off:
        from bench.runner.execute import execute  # imports torch, which a launcher's worker does not need

        execute(run.record, run.receive)
    elif (failure := run_isolated(run)) is not None:
        run.record.status, run.record.reason = failure


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
