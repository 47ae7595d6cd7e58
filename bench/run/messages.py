"""What a run's process gets from its parent, and what it sends back."""

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


def reason_of(error: BaseException, folder: Path | None = None) -> str:
    """An error as the reason of a failure: in one line, with the remedy where the disk of the run's folder is full."""
    text = " ".join(str(error).split()) or type(error).__name__
    full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
    where = f" ({folder})" if folder else ""
    return f"{text}{where}: free space, or set results_dir to a folder on another disk" if full else text
