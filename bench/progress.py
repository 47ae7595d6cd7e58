"""Live progress on a terminal: one bar with loss and time left; silent where there is no terminal."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol, runtime_checkable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn


@runtime_checkable
class Report(Protocol):
    """Says that `done` of `total` steps of a phase are done, with the loss if there is one."""

    def __call__(self, phase: str, done: int, total: int, loss: float | None = None) -> None: ...


@contextmanager
def live_progress() -> Iterator[Report]:
    """A bar on standard error, replaced when the phase changes."""
    columns = (
        TextColumn("{task.description:<22}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[loss]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal, refresh_per_second=5) as bars:
        tasks: dict[str, int] = {}

        def report(phase: str, done: int, total: int, loss: float | None = None) -> None:
            shown = "" if loss is None else f"loss {loss:.4g}"
            if phase not in tasks:
                tasks[phase] = bars.add_task(phase, total=total, loss=shown)
            bars.update(tasks[phase], completed=done, loss=shown)

        yield report
