"""`plan=true`: lists what would run, with the time and the memory that like runs took; runs nothing, writes nothing."""

from dataclasses import asdict, dataclass
from pathlib import Path

from bench.machine.processor import cpu_name
from bench.records.expected import Expected, Model, Remaining
from bench.records.format import seconds, size
from bench.records.read import Plan, PlannedCell, read_records
from bench.records.record import row_name

BUSY = 0.05  # share of the time that like runs waited, above which it is told


@dataclass(frozen=True)
class Words:
    """What a plan says of what it lists: what would be done, that it was done before, what no estimate is from."""

    noun: str
    verb: str
    done: str
    like: str


RUNS = Words("run", "run", "reused", "like run")


class Shown(BaseException):
    """A plan was shown in place of a sweep. Not an Exception, which Hydra would turn into a warning."""


def model_of(results_dir: Path) -> Model:
    """The model of a results folder's records; it knows nothing where there is no such folder."""
    records = read_records(results_dir)[0] if results_dir.is_dir() else []
    return Model(records, cpu_name())


def remaining(plan: Plan, reused: set[str], workers: int) -> Remaining:
    """The time left of a sweep, as it is before its first cell."""
    model = model_of(plan.results_dir)
    cells = {c.id: model.of(asdict(c)) for c in plan.cells if c.id not in reused}
    return Remaining(cells, max(1, min(workers, len(cells))))


def show_plan(plan: Plan, reused: set[str], workers: int) -> None:
    """Prints a line for each cell, and one for the whole plan."""
    left = remaining(plan, reused, workers)
    for number, cell in enumerate(plan.cells, 1):
        about = "reused" if cell.id in reused else told(left.cells[cell.id])
        print("  ".join(part for part in (f"{number:>4}", " ".join(plan.differing(cell)), named(cell), about) if part))
    print(total(len(plan.cells), left))
    known = [expected for expected in left.cells.values() if expected is not None]
    if (whole := sum(e.seconds for e in known)) and (waited := sum(e.waited * e.seconds for e in known) / whole) > BUSY:
        free = seconds(whole * (1 - waited) / left.workers)
        print(f"note: like runs waited {waited:.0%} of their time for a processor; alone on it, it is about {free}")


def named(cell: PlannedCell) -> str:
    """The task, the row and the dataset of a cell."""
    return ", ".join((cell.task, row_name(cell.config, cell.renderer), cell.dataset))


def told(expected: Expected | None, words: Words = RUNS) -> str:
    """What a run will take, in words."""
    if expected is None:
        return f"no {words.like}"
    spread = "" if expected.n == 1 else f", {seconds(expected.low)} to {seconds(expected.high)}"
    memory = "" if expected.memory is None else f", +{size(expected.memory)}"
    runs = expected.like.replace(f"{words.noun}s", words.noun) if expected.n == 1 else expected.like
    return f"about {seconds(expected.seconds)} ({expected.n} {runs}{spread}){memory}"


def total(planned: int, left: Remaining, words: Words = RUNS) -> str:
    """The sum over all that is planned, in a line."""
    known = [expected for expected in left.cells.values() if expected is not None]
    parts = [f"{planned} planned: {len(left.cells)} to {words.verb}"]
    if done := planned - len(left.cells):
        parts.append(f"{done} {words.done}")
    if unknown := len(left.cells) - len(known):
        parts.append(f"{unknown} without a {words.like}")
    text = ", ".join(parts)
    if not known:
        return text + ("" if left.cells else "; nothing is left to do")
    low, high = (sum(getattr(e, end) for e in known) / left.workers for end in ("low", "high"))
    whole = sum(expected.seconds for expected in known) / left.workers
    spread = f" ({seconds(low)} to {seconds(high)})" if any(e.n > 1 for e in known) else " (n = 1 each)"
    text += f"; about {seconds(whole)}{spread}, {left.workers} at a time"
    if unknown:
        text += f", and what the {unknown} take"
    memory = [expected.memory for expected in known if expected.memory is not None]
    return text + (f"; the largest took +{size(max(memory))} of memory" if memory else "")
