"""Experiment trackers export finished runs, never during a run; a failed export loses no run."""

from pathlib import Path
from typing import Any, Protocol, runtime_checkable


@runtime_checkable
class Tracker(Protocol):
    """Exports finished runs to an experiment tracker."""

    def export(self, folder: Path, record: dict[str, Any]) -> None:
        """Exports the run of a folder, with its record as `bench.records.record.read_record` gives it."""
        ...


class Nothing:
    """The tracker that exports nothing."""

    def export(self, folder: Path, record: dict[str, Any]) -> None: ...
