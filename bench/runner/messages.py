"""The messages between the process of a run and its parent, its end with the parent, and the texts of errors."""

import errno
import fcntl
import os
import re
import signal
from dataclasses import dataclass
from multiprocessing import parent_process
from multiprocessing.connection import wait
from pathlib import Path

from bench.records.record import Record

OPTIONAL_GROUPS = ("method", "experiment")  # they take a plus: +method=NAME


@dataclass(frozen=True)
class Step:
    """Progress within a phase; see `bench.progress.Report`."""

    phase: str
    finished: int
    total: int
    loss: float | None

    @property
    def phase_text(self) -> str:
        """The phase and step, for the reason of a failure: `while optimising (3 of 20)`."""
        return f"{'while' if self.finished < self.total else 'after'} {self.phase} ({self.finished} of {self.total})"


@dataclass(frozen=True)
class Notice:
    """A message for the user."""

    text: str


@dataclass(frozen=True)
class Started:
    """The child is ready: the time limit counts from now on."""


Message = Started | Step | Notice | Record  # the status of a record is killed until the run ends


class Interrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM ended a command after runs had started; their records and the plan are written."""


def reason_of(error: BaseException, folder: Path | None = None) -> str:
    """An error as the reason of a failure, in one line, with the remedy if the disk of the run's folder is full."""
    text = " ".join(str(error).split()) or type(error).__name__
    is_disk_full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
    suffix = f" ({folder})" if folder else ""
    return f"{text}{suffix}: free space, or set results_dir to a folder on another disk" if is_disk_full else text


def quoted(text: str) -> str:
    """A text in quotes as Hydra reads it."""
    escaped = re.sub(r"(\\*)('|$)", lambda match: 2 * match[1] + match[2].replace("'", "\\'"), text)
    return f"'{escaped}'"


def exit_with_parent() -> None:
    """Makes the system end this process when its parent ends, also during native code."""
    parent = parent_process()
    assert parent is not None
    end = parent.sentinel  # the reading end of a pipe that only the parent holds open
    signal.signal(signal.SIGIO, signal.SIG_DFL)
    fcntl.fcntl(end, fcntl.F_SETOWN, os.getpid())
    flags = fcntl.fcntl(end, fcntl.F_GETFL)
    fcntl.fcntl(end, fcntl.F_SETFL, flags | os.O_ASYNC)
    if wait([end], 0):  # ended before the signal was set up
        os._exit(1)
