"""What runs will take, by finished ones: `plan=true` lists runs and starts none; the time left of a sweep."""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from statistics import median
from typing import Any

from bench.records.format import plural, seconds
from bench.records.read import Plan, PlannedCell, read_records
from bench.records.record import row_name

# Statuses of runs that did not take their whole time.
UNMEASURED = ("killed", "crashed", "refused", "oom", "unsupported", "not_run")


class Shown(BaseException):
    """A plan was shown in place of a sweep. Not an Exception, which Hydra would turn into a warning."""


class Estimates:
    """The seconds of finished runs, by task, renderer, method and scale."""

    def __init__(self, records: Iterable[dict[str, Any]] = ()) -> None:
        self.known: dict[Any, list[float]] = defaultdict(list)
        for record in records:
            self.add(record)

    def add(self, record: dict[str, Any]) -> None:
        """Learns from a run that took its whole time."""
        total = record["seconds"].get("total")
        if record["status"] not in UNMEASURED and isinstance(total, int | float) and 0 < total < float("inf"):
            self.known[_kind(record)].append(total)

    def of(self, planned: dict[str, Any]) -> list[float]:
        """The seconds of the finished runs with the same task, renderer, method and scale."""
        return self.known.get(_kind(planned), [])


def _kind(record: dict[str, Any]) -> Any:
    scale = record["config"].get("scale")
    name = str(scale.get("name")) if isinstance(scale, dict) else None
    return record["task"], record["renderer"], record.get("method", ""), name


@dataclass
class Remaining:
    """What is left of a sweep.

    Args:
        cells: those that are not reused, by their ids.
        estimates: of the results folder; they learn from each cell that ends.
        workers: how many cells run at a time.
        latest: when a cell ended last, in seconds since the sweep began.
    """

    cells: dict[str, dict[str, Any]]
    estimates: Estimates = field(default_factory=Estimates)
    workers: int = 1
    latest: float = 0.0

    def ended(self, cell: str, record: dict[str, Any], elapsed: float) -> None:
        """Notes that a cell has ended."""
        if self.cells.pop(cell, None) is not None:
            self.latest = elapsed
            if not record.get("reused"):  # another command ran it meanwhile
                self.estimates.add(record)

    def left(self, elapsed: float) -> float | None:
        """Seconds left, `elapsed` seconds after the sweep began; None where no finished run is like one of them."""
        known = [median(like) for cell in self.cells.values() if (like := self.estimates.of(cell))]
        if not known and self.cells:
            return None
        whole = sum(known) / max(len(known), 1) * len(self.cells) / self.workers  # the others take what these take
        return max(whole - (elapsed - self.latest), 0.0)


def remaining(plan: Plan, reused: set[str], workers: int) -> Remaining:
    """What a sweep has to do, as it is before its first cell."""
    records = read_records(plan.results_dir)[0] if plan.results_dir.is_dir() else []
    cells = {cell.id: asdict(cell) for cell in plan.cells if cell.id not in reused}
    return Remaining(cells, Estimates(records), max(1, min(workers, len(cells))))


def show_plan(plan: Plan, reused: set[str], workers: int) -> None:
    """Prints a line for each cell, and one for the whole plan."""
    left = remaining(plan, reused, workers)
    taken = {name: left.estimates.of(cell) for name, cell in left.cells.items()}
    for number, cell in enumerate(plan.cells, 1):
        about = "reused" if cell.id in reused else about_as_long(taken[cell.id])
        print("  ".join(part for part in (f"{number:>4}", " ".join(plan.differing(cell)), named(cell), about) if part))
    parts = [f"{len(plan.cells)} planned: {len(taken)} to run"]
    if reused:
        parts.append(f"{len(reused)} reused")
    if unknown := sum(not like for like in taken.values()):
        parts.append(f"{unknown} of unknown time")
    text = ", ".join(parts) + ("" if taken else "; nothing is left to do")
    if known := [median(like) for like in taken.values() if like]:
        text += f"; about {seconds(sum(known) / left.workers)}, {left.workers} at a time"
        text += f", without the {unknown} of unknown time" if unknown else ""
        text += "; the training of a missing prior is not counted"
    print(text)


def named(cell: PlannedCell) -> str:
    """The task, the row and the dataset of a cell."""
    return ", ".join((cell.task, row_name(cell.config, cell.renderer), cell.dataset))


def about_as_long(like: list[float]) -> str:
    """What a run will take, in words, by what runs like it took."""
    if not like:
        return "time unknown"
    return f"about {seconds(median(like))} (median of {plural(len(like), 'finished run')})"
