"""Shows progress on a terminal: a line for the run and one for the sweep.

Where there is no terminal, a line is printed of a phase that takes long, again and again.
"""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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

PLAIN = 15.0  # seconds between two printed lines of a phase, where there is no terminal
NARROW = 80  # columns of a terminal, below which a line of progress has no room for a bar
HOUR = 3600.0  # seconds over which the speed is estimated; a sweep's cells may take minutes each


@runtime_checkable
class Report(Protocol):
    """Reports that `done` of `total` steps of a phase are done, with the loss if there is one.

    A phase says what is being done, such as "training the prior"; the message of a limit that is reached names it.
    """

    def __call__(self, phase: str, done: int, total: int, loss: float | None = None) -> None: ...


def _print(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


_receive: Callable[[str], None] = _print


def notice(text: str) -> None:
    """Prints a message for the user, also where there is no terminal."""
    _receive(text)


def notices_to(receive: Callable[[str], None]) -> None:
    """Sends notices to `receive` from now on, for example to a parent process."""
    global _receive
    _receive = receive


def columns(width: int) -> list[ProgressColumn]:
    """What a line of progress shows; on a narrow terminal its name, how many are done, and the time left."""
    name, count, left = TextColumn("{task.description}", markup=False), MofNCompleteColumn(), TimeRemainingColumn()
    if width < NARROW:
        return [name, count, left]
    padded, said = TextColumn("{task.description:<28}", markup=False), TextColumn("{task.fields[said]}", markup=False)
    return [padded, BarColumn(), count, said, TimeElapsedColumn(), TextColumn("left"), left]


_shown: Progress | None = None  # the display of this process, shared by the lines of a sweep and of its run


@contextmanager
def display() -> Iterator[Progress]:
    """The live display of this process, on standard error."""
    global _shown
    if _shown is not None:
        yield _shown
        return
    console = Console(stderr=True)
    with Progress(
        *columns(console.width),
        console=console,
        disable=not console.is_terminal,
        refresh_per_second=5,
        speed_estimate_period=HOUR,
        transient=True,
    ) as _shown:
        try:
            yield _shown
        finally:
            _shown = None


@contextmanager
def run_progress(name: str) -> Iterator[Report]:
    """Shows one line for a run: its phase, its progress, and its loss."""
    with display() as shown:
        line = shown.add_task(name, total=None, said="")
        current, begun, printed = "", 0.0, 0.0

        def report(phase: str, done: int, total: int, loss: float | None = None) -> None:
            nonlocal current, begun, printed
            said = "" if loss is None else f"loss {loss:.4g}"
            now = time.monotonic()
            if phase != current:  # another phase has another speed
                current, begun, printed = phase, now, now
                shown.reset(line, total=total, description=f"{name}: {phase}", said=said)
            shown.update(line, completed=done, said=said)
            if shown.disable and now - printed >= PLAIN and 0 < done < total:
                printed = now
                _print(f"{name}: {phase}, {done / total:.0%}, about {(now - begun) * (total / done - 1):.0f} s left")

        try:
            yield report
        finally:
            shown.remove_task(line)
