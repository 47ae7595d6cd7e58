"""Exports finished runs to where others keep theirs; never during a run, and nothing here can lose one."""

from pathlib import Path
from typing import Any, Protocol, runtime_checkable


@runtime_checkable
class Tracker(Protocol):
    """Takes a finished run."""

    def export(self, folder: Path, record: dict[str, Any]) -> None:
        """Exports a run.

        Args:
            folder: of the run, with its curve and pictures.
            record: as `bench.report.records.read_record` gives it.
        """
        ...


class Nothing:
    """Exports nothing."""

    def export(self, folder: Path, record: dict[str, Any]) -> None:
        """Does nothing."""
