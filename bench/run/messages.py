"""The job that a parent process gives to a child, and the messages that the child sends back."""

from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig

from bench.records.record import Record


@dataclass(frozen=True)
class Job:
    """A run for a child process: the configuration, the folder for its files, and the record that it fills."""

    config: DictConfig
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
