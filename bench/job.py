"""What a parent process gives a child to do, and the words that come back."""

from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig

from bench.records import Record


@dataclass(frozen=True)
class Job:
    """What a child is to do: the configuration to run, the folder for its files, and the record that it fills."""

    config: DictConfig
    folder: Path
    record: Record


@dataclass(frozen=True)
class Step:
    """A word on progress; see `bench.progress.Report`."""

    phase: str
    done: int
    total: int
    loss: float | None


@dataclass(frozen=True)
class Said:
    """A line for the user."""

    text: str


@dataclass(frozen=True)
class Started:
    """The child is there: from now on the time counts."""


@dataclass(frozen=True)
class Ended:
    """The record is final: the child has nothing to add."""


Message = Started | Step | Said | Record | Ended
