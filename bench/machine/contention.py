"""Checks of a run's times: how long its threads waited for a processor, and whether the clock missed work."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

from bench.records.record import Record

WAITED = 0.05  # share of its threads' ready time that they waited: above it, the machine was loaded
IMPOSSIBLE = 1.2  # times the machine's matrix product rate: above it, the clock did not wait for the device


class Contention:
    """Measures, from its creation on, how long this process's threads ran, and how long they were ready but waited.

    Linux counts both for each thread; elsewhere the load average is used instead.
    """

    def __init__(self) -> None:
        self.before = _scheduled()

    def measured(self) -> dict[str, Any]:
        """`waited_share`: time spent waiting for a processor over time spent running or waiting; None if unknown."""
        now = _scheduled()
        if self.before is None or now is None:
            return {"waited_share": None}
        ran, waited = now[0] - self.before[0], now[1] - self.before[1]
        if ran <= 0 or waited < 0:  # threads have ended meanwhile, and their counts with them
            return {"waited_share": None}
        return {"waited_share": waited / (ran + waited)}

    @staticmethod
    def warnings(record: Record) -> list[str]:
        """Reasons not to trust the record's times, one line each."""
        lines = []
        share, load = record.environment.get("waited_share"), record.environment.get("load_at_start")
        if share is not None and share > WAITED:
            lines.append(
                f"loaded machine: threads waited {share:.0%} of their time for a processor; times are too long"
            )
        elif share is None and load is not None and load > (os.cpu_count() or 1):
            lines.append(f"loaded machine: load {load:.1f} at the start; times may be too long")
        if record.gemm_fraction is not None and record.gemm_fraction > IMPOSSIBLE:
            lines.append(
                f"missing synchronisation: {record.gemm_fraction:.1f} times the machine's matrix product rate is more "
                f"than it can do; the clock did not wait for the device"
            )
        return lines


def _scheduled() -> tuple[int, int] | None:
    """Nanoseconds that this process's living threads ran, and that they waited."""
    ran = waited = 0
    try:
        for task in Path("/proc/self/task").iterdir():
            with suppress(FileNotFoundError, ProcessLookupError):  # a thread that has just ended
                numbers = (task / "schedstat").read_text().split()
                ran, waited = ran + int(numbers[0]), waited + int(numbers[1])
    except (OSError, ValueError, IndexError):
        return None
    return ran, waited
