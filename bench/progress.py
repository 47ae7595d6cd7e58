"""Shows progress on a terminal: a line for the run and one for the sweep.

Without a terminal, it prints a line of a long phase at intervals.
"""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import parent_process
from typing import Protocol, runtime_checkable

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

PRINT_INTERVAL_SECONDS = 15.0
MIN_BAR_COLUMNS = 80  # a narrower terminal has no room for a bar
SPEED_WINDOW_SECONDS = 3600.0  # long, because a sweep's cells may take minutes each


@runtime_checkable
class Report(Protocol):
    """Reports that `finished` of `total` steps of a phase are finished, with the loss if there is one.

    A phase is an activity, such as "training the prior"; the message of a reached limit names it.
    """

    def __call__(self, phase: str, finished: int, total: int, loss: float | None = None) -> None: ...


def _print(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


_receive: Callable[[str], None] = _print


def notice(text: str) -> None:
    """Prints a message for the user, also without a terminal."""
    _receive(text)


def notices_to(receive: Callable[[str], None]) -> None:
    """Sends notices to `receive` from now on, for example to a parent process."""
    global _receive
    _receive = receive


def columns(width: int) -> list[ProgressColumn]:
    """The columns of a line of progress; on a narrow terminal name, number of finished steps, and time left."""
    name, count, left = TextColumn("{task.description}", markup=False), MofNCompleteColumn(), TimeRemainingColumn()
    if width < MIN_BAR_COLUMNS:
        return [name, count, left]
    name, status = TextColumn("{task.description:<28}", markup=False), TextColumn("{task.fields[status]}", markup=False)
    return [name, BarColumn(), count, status, TimeElapsedColumn(), TextColumn("left"), left]


_active_display: Progress | None = None  # shared by the lines of a sweep and of its run


@contextmanager
def display() -> Iterator[Progress]:
    """The live display of this process, on standard error."""
    global _active_display
    if _active_display is not None:
        yield _active_display
        return
    console = Console(stderr=True)
    with Progress(
        *columns(console.width),
        console=console,
        disable=not console.is_terminal or parent_process() is not None,  # a worker's lines would mix with others
        refresh_per_second=5,
        speed_estimate_period=SPEED_WINDOW_SECONDS,
        transient=True,
    ) as _active_display:
        try:
            yield _active_display
        finally:
            _active_display = None


@contextmanager
def run_progress(name: str) -> Iterator[Report]:
    """Shows one line for a run: its phase, its progress, and its loss."""
    with display() as live:
        line = live.add_task(name, total=None, status="")
        current_phase, start, last_print, first = "", 0.0, 0.0, 0

        def report(phase: str, finished: int, total: int, loss: float | None = None) -> None:
            nonlocal current_phase, start, last_print, first
            status = "" if loss is None else f"loss {loss:.4g}"
            now = time.monotonic()
            if phase != current_phase:  # another phase has another speed
                current_phase, start, last_print, first = phase, now, now, finished  # a resumed phase begins late
                live.reset(line, total=total, description=f"{name}: {phase}", status=status)
            live.update(line, completed=finished, status=status)
            if live.disable and now - last_print >= PRINT_INTERVAL_SECONDS and first < finished < total:
                last_print = now
                left = (now - start) * (total - finished) / (finished - first)
                _print(f"{name}: {phase}, {finished / total:.0%}, about {left:.0f} s left")

        try:
            yield report
        finally:
            live.remove_task(line)
