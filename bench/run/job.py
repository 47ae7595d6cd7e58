"""What the process of a run and its parent say to each other, and errors in words."""

import errno
from dataclasses import dataclass
from pathlib import Path

from bench.records.record import Record


@dataclass(frozen=True)
class Job:
    """A run for a child process: the folder for its files, and the record that it fills, with its configuration."""

    folder: Path
    record: Record


@dataclass(frozen=True)
class Step:
    """Progress within a phase; see `bench.progress.Report`."""

    phase: str
    done: int
    total: int
    loss: float | None

    @property
    def when(self) -> str:
        """The phase and the step for the reason of a failure: `while optimising (3 of 20)`."""
        return f"{'while' if self.done < self.total else 'after'} {self.phase} ({self.done} of {self.total})"


@dataclass(frozen=True)
class Notice:
    """A message for the user."""

    text: str


@dataclass(frozen=True)
class Started:
    """The child is ready: the time limit counts from now on."""


@dataclass(frozen=True)
class Ended:
    """The child has sent its final record."""


Message = Started | Step | Notice | Record | Ended


class Interrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM ended a command whose runs had begun; their records and the plan are written."""


def reason_of(error: BaseException, folder: Path | None = None) -> str:
    """An error as the reason of a failure: in one line, with the remedy where the disk of the run's folder is full."""
    text = " ".join(str(error).split()) or type(error).__name__
    full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
    where = f" ({folder})" if folder else ""
    return f"{text}{where}: free space, or set results_dir to a folder on another disk" if full else text


def unwritten(error: OSError, results_dir: str | None = None) -> str:
    """One line on what could not be written, and what to do; `results_dir` is named where the error names no file."""
    path = Path(named) if (named := error.filename or results_dir) else None
    file = next((above for above in path.parents if above.is_file()), path) if path else None
    where = f" ({file})" if file else ""
    return f"{error.strerror or error}{where}: set results_dir to a folder you can write, or free space"
