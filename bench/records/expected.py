"""What runs will take, by the records of like runs: seconds, memory, how sure that is, and a sweep's time left.

Like runs have the same task, scale, renderer, dataset, sizes, processor and threads. Where there are none, one demand
after another is dropped, as `LADDER` says, and the estimate says which. Runs of another task or scale are never like.
"""

import statistics
from collections import defaultdict
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

Ladder = tuple[tuple[tuple[str, ...], str], ...]
Record = dict[str, Any]  # as `read_record` gives it; a planned cell has the same fields, but no environment
FEWEST = 4  # like runs from which on the spread is that of quartiles; below, the least and the largest
ALWAYS = ("task", "scale")  # demands that are never dropped
# What is dropped, in this order, and what an estimate then says of the runs that it is from.
LADDER: Ladder = (
    ((), "like runs"),
    (("dataset",), "runs on other shapes"),
    (("dataset", "machine"), "runs on other machines or threads"),
    (("dataset", "machine", "renderer"), "runs of other renderers"),
    (("dataset", "machine", "renderer", "sizes"), "runs of other sizes"),
)
SIZES = ("resolution", "iterations", "steps", "views", "repeats")  # numbers of a task that decide its time
# Statuses of runs that did not take their whole time.
UNMEASURED = ("killed", "crashed", "refused", "oom", "unsupported", "not_run")


@dataclass(frozen=True)
class Expected:
    """What a run will take.

    Args:
        seconds: the median of like runs.
        low, high: their quartiles; of fewer than `FEWEST` runs the least and the largest.
        memory: most bytes that one of them took beyond those of its start; None where none says.
        n: the number of like runs.
        like: what they have in common with it, in words.
        waited: share of their time for which the threads of like runs waited for a processor, the median.
    """

    seconds: float
    low: float
    high: float
    memory: float | None
    n: int
    like: str
    waited: float


class Model:
    """Expects of a run what like runs took."""

    def __init__(
        self, records: Iterable[Record], cpu: str, *, ladder: Ladder = LADDER, sizes: Sequence[str] = SIZES
    ) -> None:
        """Learns from records.

        Args:
            records: those of a results folder.
            cpu: the name of this machine's processor.
            ladder: what is dropped where there are no like runs, and what an estimate then says.
            sizes: keys of the task whose values decide its time.
        """
        self.cpu, self.ladder, self.sizes = cpu, ladder, sizes
        self.known: list[dict[Hashable, list[Record]]] = [defaultdict(list) for _ in ladder]
        for record in records:
            if not _measured(record):
                continue
            parts = _parts(record, record["environment"].get("cpu", ""), sizes)
            for (dropped, _), known in zip(ladder, self.known, strict=True):
                known[_key(parts, dropped)].append(record)

    def of(self, planned: Record) -> Expected | None:
        """What a planned run will take on this machine; None where there is no like run."""
        parts = _parts(planned, self.cpu, self.sizes)
        for (dropped, words), known in zip(self.ladder, self.known, strict=True):
            if like := known.get(_key(parts, dropped)):
                return _expected(like, words)
        return None


@dataclass
class Remaining:
    """The time left of a sweep: what its cells are expected to take, corrected by what its ended cells took.

    The correction is the median, over the ended cells, of the time that a cell took over the time that it was expected
    to take: this machine, with its load of today. The expectation itself counts as one more, so that the first cells
    alone do not decide.

    Args:
        cells: what each cell is expected to take, by its id, in the order in which they run; None where there is no
            like run. Those that are reused are not among them.
        workers: how many cells run at a time.
    """

    cells: dict[str, Expected | None]
    workers: int
    done: dict[str, float | None] = field(default_factory=dict)  # what each ended cell took; None: not its whole time
    latest: float = 0.0  # when the last of them ended, in seconds since the sweep began

    def ended(self, cell: str, record: Record, elapsed: float) -> None:
        """Notes the record of a cell that has ended by now; one that was reused takes no time."""
        if cell in self.cells and cell not in self.done:
            whole = _measured(record) and not record.get("reused")  # a reused one: another command ran it meanwhile
            self.done[cell] = float(record["seconds"]["total"]) if whole else None
            self.latest = elapsed

    def left(self, elapsed: float) -> float | None:
        """Seconds left, `elapsed` seconds after the sweep began; None where nothing is known yet."""
        known = [expected.seconds for expected in self.cells.values() if expected is not None]
        took = {cell: seconds for cell, seconds in self.done.items() if seconds is not None}
        if not known and not took:
            return None
        usual = statistics.mean(known) if known else statistics.median(took.values())  # of cells without a like run
        weights = {cell: usual if expected is None else expected.seconds for cell, expected in self.cells.items()}
        slower = statistics.median([1.0, *(seconds / weights[cell] for cell, seconds in took.items())])
        pending = [slower * weight + self._between(took) for cell, weight in weights.items() if cell not in self.done]
        whole, others = sum(pending) / self.workers, sum(pending[self.workers :]) / self.workers
        return max(whole - (elapsed - self.latest), others)  # of those that are under way, some is done

    def _between(self, took: dict[str, float]) -> float:
        """Seconds from the end of a cell to the start of the next one; of several at a time that is not known."""
        if self.workers > 1 or not took or len(took) < len(self.done):
            return 0.0
        return max(self.latest - sum(took.values()), 0.0) / len(took)


def _measured(record: Record) -> bool:
    total = record["seconds"].get("total")
    return record["status"] not in UNMEASURED and isinstance(total, int | float) and 0 < total < float("inf")


def _expected(like: list[Record], words: str) -> Expected:
    seconds = sorted(float(record["seconds"]["total"]) for record in like)
    memory = [r["peak_memory_bytes"] for r in like if isinstance(r.get("peak_memory_bytes"), int | float)]
    low, high = seconds[0], seconds[-1]
    if len(seconds) >= FEWEST:
        low, _, high = statistics.quantiles(seconds, n=4, method="inclusive")
    shares = [record["environment"].get("waited_share") for record in like]
    waited = statistics.median([share for share in shares if isinstance(share, float)] or [0.0])
    return Expected(statistics.median(seconds), low, high, max(memory, default=None), len(seconds), words, waited)


def _parts(record: Record, cpu: str, wanted: Sequence[str]) -> dict[str, Any]:
    """What decides how long a run takes, each part by the name that `LADDER` has for it."""
    config = record["config"]
    scale, view = config.get("scale"), config.get("view")
    sizes = [("view", str(view.get("resolution")))] if isinstance(view, dict) else []
    return {
        "task": record["task"],
        "scale": str(scale.get("name")) if isinstance(scale, dict) else None,
        "renderer": (record["renderer"], record.get("method", "")),
        "dataset": record["dataset"],
        "sizes": (*sizes, *_numbers(config.get("task"), "", wanted)),
        "machine": (str(cpu), str(config.get("device")), str(config.get("threads"))),
    }


def _numbers(node: Any, name: str, wanted: Sequence[str]) -> list[tuple[str, Any]]:
    """The values of the wanted keys below a node, with their dotted names."""
    if not isinstance(node, dict):
        return []
    found: list[tuple[str, Any]] = []
    for key, value in sorted(node.items(), key=lambda item: str(item[0])):
        if isinstance(value, dict):
            found += _numbers(value, f"{name}{key}.", wanted)
        elif key in wanted and isinstance(value, int | float | str):
            found.append((f"{name}{key}", value))
    return found


def _key(parts: dict[str, Any], dropped: tuple[str, ...]) -> Hashable:
    return tuple((name, value) for name, value in parts.items() if name in ALWAYS or name not in dropped)
