"""Executes one run, in its own process or in that of the command; every failure is recorded with its reason."""

import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

import torch

from bench.machine import environment
from bench.progress import notices_to
from bench.records.record import Record, RunStatus, append_to_log, now
from bench.runner.messages import Message, Notice, Started, Step, exit_with_parent, reason_of
from bench.setup.inputs import RunContext, prepare_run
from renderers.checks import BadInput
from renderers.rendering import Unsupported

PROGRESS_INTERVAL_SECONDS = 0.05


def main(record: Record, channel: Connection) -> None:
    """Makes the run of a record in the process of that run; its output goes to `log.txt`."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes of a terminal; the parent passes it on
    exit_with_parent()
    _redirect_output(record.folder / "log.txt")
    notices_to(lambda text: channel.send(Notice(text)))
    channel.send(Started())
    try:
        signal.signal(signal.SIGTERM, _stop)  # before this, SIGTERM ends the process at once
        execute(record, channel.send)
    except KeyboardInterrupt:
        record.status = RunStatus.KILLED
        channel.send(record)  # as far as it is filled; then ends by SIGTERM, so that the exit code is right
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGTERM)
    channel.send(record)


@environment.flushing_denormals()
def execute(record: Record, send: Callable[[Message], None]) -> None:
    """Makes the run of a record, which gets a status, and a reason if that is not ok.

    Args:
        send: receives the progress, and the record as soon as the machine is known.

    Raises:
        KeyboardInterrupt: if the run was stopped; the record is filled as far as possible.
    """
    folder, progress = record.folder, _Progress(send)
    schedule_before = environment.scheduled()
    try:
        try:
            task, inputs = prepare_run(record.config, progress=progress)
        except (ValueError, OSError) as error:  # the configuration is invalid
            raise BadInput(reason_of(error)) from error
        inputs.configure_process()
        record.scene, record.notes = inputs.scene_name, [*record.notes, *inputs.notes]
        record.environment |= environment.describe(inputs.device)
        send(record)
        try:
            task.execute(RunContext(inputs, folder, record, progress))
        finally:
            record.notes = [*record.notes, *inputs.last_notes]
    except BadInput as error:
        record.status, record.reason = RunStatus.REFUSED, reason_of(error)
        append_to_log(folder, f"{now()} {traceback.format_exc()}")
    except Unsupported as error:
        record.status, record.reason = RunStatus.UNSUPPORTED, reason_of(error)
    except (MemoryError, torch.OutOfMemoryError) as error:
        record.status, record.reason = RunStatus.OOM, reason_of(error)
    except Exception as error:  # noqa: BLE001 - every failure of a run is recorded
        out_of_memory = "DefaultCPUAllocator: can't allocate" in str(error)
        record.status = RunStatus.OOM if out_of_memory else RunStatus.CRASHED
        record.reason = reason_of(error, folder)
        append_to_log(folder, f"{now()} {traceback.format_exc()}")
    finally:
        record.environment["waited_share"] = environment.waited_share(schedule_before)
        record.notes += environment.doubts(record)


class _Progress:
    """Sends progress when a phase begins or ends, and between at intervals."""

    def __init__(self, send: Callable[[Message], None]) -> None:
        self.send, self.sent, self.phase = send, 0.0, ""

    def __call__(self, phase: str, finished: int, total: int, loss: float | None = None) -> None:
        moment = time.perf_counter()
        if moment - self.sent > PROGRESS_INTERVAL_SECONDS or finished == total or phase != self.phase:
            self.sent, self.phase = moment, phase
            self.send(Step(phase, finished, total, loss))


def _stop(number: int, frame: object) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a second signal must not interrupt the handling of the first
    raise KeyboardInterrupt(f"stopped by {signal.Signals(number).name}")


def _redirect_output(path: Path) -> None:
    """Appends the output of Python and native code to a file from now on."""
    sys.stdout.flush()
    sys.stderr.flush()
    log = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(log, 1)
    os.dup2(log, 2)
    os.close(log)
