"""Attempts of the suite: one run of a renderer on one problem, with its curve of cost and error.

Attempts are made from runs, and stored as CSV files: a file per renderer, a line per attempt. So results outlive the
run folders, and can be merged from several days and machines.
"""

import csv
import json
import re
from collections.abc import Iterable
from dataclasses import MISSING, asdict, dataclass, field, fields, replace
from functools import cache, lru_cache
from io import StringIO
from itertools import product
from math import inf, isfinite, isnan
from pathlib import Path
from typing import Any

from bench.records.record import (
    RunStatus,
    as_number,
    digest,
    flat,
    from_json_values,
    renderer_name,
    to_json_values,
    write_text,
)
from bench.records.results import curve_lines
from bench.report.data.kept import READ_ERRORS, UNMEASURED
from bench.report.data.records import Record, family, grouped, loop_seconds, setting
from bench.report.data.runs import Selection
from bench.tables import CONF, read_yaml

SUITE_FOLDER = "suite"  # it has a folder per version
EXPERIMENT_PREFIX = "core_"  # before the name of a set
PROBLEM_SETTINGS = {  # per set: the setting in which problems differ, its key under `sizes`, and its text
    "complete": ("task.points", "points", "{} points"),
    "pose": ("task.degrees", "degrees", "{:g} degrees"),
    "reconstruct": ("task.images.texture", "textures", "{}"),
}
BUDGET_KEY = "task.optimiser.budget"
CUSTOM = "custom"  # the preset of renderers that a user names by their class
TUNED_SUFFIX = ", tuned"  # after the name of a row with tuned settings
NOISE_KEY = "task.optimiser.start_noise"
SECOND_START_NOISE = 1e-6  # standard deviation of the noise in the initial parameters of a second start
SECOND_SUFFIX = ", second start"  # after the name of its row
RATE_KEY, ITERATIONS_KEY = "task.optimiser.learning_rate", "task.optimiser.afforded_iterations"  # tuned settings
# A set fixes these for all renderers; tuned settings may only change RATE_KEY and ITERATIONS_KEY.
FIXED_KEYS = ("task", "view", "evaluation", "silhouette", "field", "prior", "split", "seed")


@dataclass(frozen=True)
class Suite:
    """The content of `conf/suite.yaml`, where comments explain it."""

    name: str
    version: int
    sizes: dict[str, str]
    errors: dict[str, str]
    units: dict[str, float]
    candidates: dict[str, tuple[float, int]]
    references: dict[str, dict[str, float]]

    @property
    def id(self) -> str:
        return f"{self.name}-{self.version}"


@cache
def suite() -> Suite:
    return Suite(**read_yaml(CONF / "suite.yaml"))


@cache
def problems_of(size: str) -> set[tuple[Any, ...]]:
    """The set, problem and budget of all cells of a size of the suite."""
    keys: set[tuple[Any, ...]] = set()
    for name in suite().errors:
        sizes = read_yaml(CONF / "experiment" / f"{EXPERIMENT_PREFIX}{name}.yaml")["sizes"]
        axes = {key: str(value).split(",") for key, value in sizes[suite().sizes[size]].items()}
        _, amount_key, form = PROBLEM_SETTINGS.get(name, ("", "", ""))
        degrees = [*map(float, axes.get(amount_key, ()))]  # an axis; other amounts are by the index of the shape
        for family_name, index, budget in product(axes["families"], axes["shapes"], axes["budgets"]):
            amounts = [sizes[amount_key][int(index)]] if amount_key in sizes else degrees
            scene = f"{family_name} test {index}"
            texts = [f"{scene}, {form.format(amount)}" for amount in amounts] or [scene]
            keys |= {(name, text, _units(name, float(budget))) for text in texts}
    return keys


def _units(set_name: str, budget: float) -> float:
    """A budget in field evaluations as a multiple of its set's unit."""
    return float(f"{budget / suite().units[set_name]:.3g}")


def selections() -> tuple[Selection, ...]:
    """The runs of each set, for a study."""
    settings = tuple(key for key, *_ in PROBLEM_SETTINGS.values())
    return tuple(Selection(f"{EXPERIMENT_PREFIX}{name}", settings) for name in suite().errors)


@dataclass(frozen=True)
class Attempt:
    """A run of a renderer on a problem of the suite."""

    set: str
    problem: str  # of the scene, which has one in each set, in `pose` one per initial angle
    scene: str
    budget: float  # the cost that the run could spend, in units of the set
    row: str  # the renderer's name in tables
    preset: str  # it decides the row's look
    status: str
    reason: str
    start: float  # the error before
    final: float  # the error after; infinite if the run did not end ok
    iterations: int
    rays: int  # of an iteration
    cost: float  # of the loop, as `renderers.field.Counts.cost`
    operations: float | None
    seconds: float | None
    waited: float | None  # fraction of its time that the run waited for a processor
    cpu: str
    device: str
    threads: int | None
    kernels: str
    started: str
    commit: str
    code: str  # a hash
    settings: str  # a hash of those that the set fixes
    curve: list[list[float]]  # cost, seconds and error at each checkpoint
    overrides: list[str]  # the command line that repeats the run
    depth_bias: float | None = None  # see `bench.evaluate.evaluate`; None without one

    @property
    def key(self) -> tuple[Any, ...]:
        return self.set, self.problem, self.budget, self.row, self.settings

    @property
    def ok(self) -> bool:
        return self.status == "ok"

    @property
    def second_start(self) -> bool:
        """Whether its initial parameters had noise; it is compared only with the run without."""
        return self.row.endswith(SECOND_SUFFIX)

    @property
    def tuned(self) -> bool:
        """Whether it has the renderer's tuned settings, not those of the set."""
        return self.row.endswith(TUNED_SUFFIX)


def attempts_of(records: Iterable[Record], results_dir: Path, split: str = "test") -> list[Attempt]:
    """The attempts among the records of a results folder; planned runs and those of other splits are none."""
    of_split = (record for record in records if record["config"].get("split") == split)
    return [attempt for record in of_split if (attempt := _attempt(record, results_dir / "runs" / record["folder"]))]


def newest_attempts(attempts: Iterable[Attempt]) -> list[Attempt]:
    ordered = sorted(attempts, key=lambda attempt: (attempt.started, repr(attempt)))
    return [*{attempt.key: attempt for attempt in ordered}.values()]


def _attempt(record: Record, folder: Path) -> Attempt | None:
    config, environment = record["config"], record["environment"]
    set_name = {f"{EXPERIMENT_PREFIX}{name}": name for name in suite().errors}.get(config.get("experiment"))
    if set_name is None or record["status"] in UNMEASURED:
        return None
    if setting(config, "task", "optimiser", "ends") != "budget":  # of an older version of the suite
        return None
    if (noise := setting(config, *NOISE_KEY.split(".")) or 0.0) not in (0.0, SECOND_START_NOISE):
        return None
    error, ok = suite().errors[set_name], record["status"] == "ok"
    scene = f"{family(record)} {config.get('split')} {config.get('index')}"
    amount_key, _, form = PROBLEM_SETTINGS.get(set_name, ("", "", ""))
    amount_texts = [form.format(setting(config, *amount_key.split(".")))] if amount_key else []
    final, start = (_error(record[section].get(error)) for section in ("metrics", "metrics_start"))
    curve, spent = _curve(folder, error, final if ok else None)
    overrides = [text.lstrip("+") for text in record.get("overrides", ()) if not config.get("label")]
    changes = [text.removeprefix("renderer.") for text in overrides if re.match(r"renderer\.[^_]", text)]
    row = ", ".join([renderer_name(config, record["renderer"]), *changes])  # without the loss, which is the set's
    tuned, suffix = row.endswith(TUNED_SUFFIX), SECOND_SUFFIX if noise else ""
    return Attempt(
        set=set_name,
        problem=", ".join([scene, *amount_texts]),
        scene=scene,
        budget=_units(set_name, setting(config, *BUDGET_KEY.split("."))),
        row=row.removesuffix(suffix) + suffix,
        preset=record["renderer"] if tuned else record.get("method") or record["renderer"],
        status=str(record["status"]),
        reason=record["reason"],
        start=start,
        final=final if ok else inf,
        iterations=record["evaluations"].get("iterations", 0),
        rays=record["evaluations"].get("rays_per_iteration", 0),
        cost=spent,
        operations=record["flops"],
        seconds=loop_seconds(record),
        waited=environment.get("waited_share"),
        **{name: environment.get(name, "") for name in ("cpu", "device", "kernels", "commit")},
        threads=environment.get("threads"),
        started=record["started"],
        code=record.get("code", ""),
        settings=settings_hash(config, set_name, tuned),
        curve=curve,
        overrides=portable_overrides(record.get("overrides", ())),
        depth_bias=_bias(record["metrics"].get("depth_bias")) if ok else None,
    )


def _error(value: Any) -> float:
    """The value as an error; infinite if it is missing or not a number."""
    number = as_number(value)
    return inf if number is None or isnan(number) else number


def _bias(value: Any) -> float | None:
    number = as_number(value)
    return None if number is None or not isfinite(number) else _rounded(number)


def portable_overrides(overrides: Iterable[str]) -> list[str]:
    """The overrides that define the run: without folders, options of the command and settings of Hydra."""
    return [text for text in overrides if not text.lstrip("+~").startswith(("results_dir=", "hydra", "-"))]


def settings_hash(config: dict[str, Any], set_name: str, tuned: bool) -> str:
    """A hash of the settings that a set fixes, without those in which problems or tuned settings differ."""
    values = flat({key: config.get(key) for key in FIXED_KEYS})
    amount_key, *_ = PROBLEM_SETTINGS.get(set_name, ("",))
    varying = {amount_key, BUDGET_KEY, NOISE_KEY, *((RATE_KEY, ITERATIONS_KEY) if tuned else ())}
    return digest({key: str(value) for key, value in values.items() if key not in varying})


def _curve(folder: Path, error: str, final: float | None) -> tuple[list[list[float]], float]:
    """The checkpoints and the end of a run, and its cost. A line has the error before its step, and the costs after."""
    checkpoints, costs = list[list[float]](), [0.0, 0.0]
    for line in curve_lines(folder) or []:
        if line.get(error) is not None:
            checkpoints.append([*costs, _error(line[error])])
        costs = [as_number(line.get(name)) or 0.0 for name in ("cost", "seconds")]
    end = [[*costs, final]] if final is not None else []
    return [[_rounded(number) for number in point] for point in checkpoints + end], _rounded(costs[0])


def _rounded(number: float) -> float:
    return float(f"{number:.5g}")


def attempts_folder(results_dir: Path, subfolder: str = "") -> Path:
    return results_dir / SUITE_FOLDER / suite().id / subfolder


def write_attempts(attempts: Iterable[Attempt], results_dir: Path, subfolder: str = "") -> list[Path]:
    """Merges attempts into those of a results folder; returns a file per row. Raises ValueError for a damaged file."""
    folder = attempts_folder(results_dir, subfolder)
    stored, problems = read_attempts(results_dir, subfolder=subfolder)
    if problems:
        raise ValueError(
            f"{folder} has files that cannot be read: {'; '.join(problems)}. Repair them or move them away."
        )
    ordered = sorted(newest_attempts([*stored, *attempts]), key=lambda attempt: attempt.key)
    files = grouped(ordered, lambda attempt: re.sub(r"[^a-z0-9]+", "_", attempt.row.lower()).strip("_") or "row")
    folder.mkdir(parents=True, exist_ok=True)
    return [_write_lines(folder / f"{name}.csv", group) for name, group in sorted(files.items())]


def _write_lines(path: Path, attempts: list[Attempt]) -> Path:
    """Writes a line per attempt: text unchanged, other values as JSON."""
    text = StringIO()
    table = csv.DictWriter(text, [f.name for f in fields(Attempt)], lineterminator="\n")
    table.writeheader()
    for attempt in attempts:
        cells = asdict(attempt).items()
        table.writerow({k: cell if isinstance(cell, str) else json.dumps(to_json_values(cell)) for k, cell in cells})
    write_text(path, text.getvalue())
    return path


@lru_cache(256)
def _read_lines(path: Path, changed: int) -> list[Attempt]:
    """Reads the attempts of a file, once per time of its change; raises one of `READ_ERRORS` if it is damaged."""
    with path.open(encoding="utf-8", newline="") as file:
        table = csv.DictReader(file)
        stored = [f for f in fields(Attempt) if f.default is MISSING or f.name in (table.fieldnames or ())]
        lines = [{f.name: _value(line[f.name], f.type) for f in stored} for line in table]
    return [_checked(Attempt(**line)) for line in lines]


def _value(cell: str, kind: Any) -> Any:
    return cell if kind is str else from_json_values(json.loads(cell))


def read_attempts(*folders: Path, subfolder: str = "") -> tuple[list[Attempt], list[str]]:
    """Reads the attempts of results folders; also returns a message for each file that cannot be read.

    Args:
        subfolder: the folder of attempts that are not on the suite's problems; empty: those that are.
    """
    attempts, problems = list[Attempt](), list[str]()
    for path in (path for folder in folders for path in sorted(attempts_folder(folder, subfolder).glob("[!.]*.csv"))):
        try:
            attempts += _read_lines(path, path.stat().st_mtime_ns)
        except READ_ERRORS as error:
            problems.append(f"{path.name}: {error!r}")
    return attempts, problems


def _checked(attempt: Attempt) -> Attempt:
    """Returns the attempt; raises ValueError or TypeError if its numbers make no sense."""
    numbers = [attempt.start, attempt.final, attempt.cost, *(number for point in attempt.curve for number in point)]
    costs, end = [point[:2] for point in attempt.curve], [[attempt.cost, _rounded(attempt.final)]]
    if any(as_number(number) is None or number < 0 for number in numbers) or any(len(p) != 3 for p in attempt.curve):
        raise ValueError(f"{attempt.problem}: errors and costs must be numbers of 0 or more")
    if costs != sorted(costs) or (attempt.ok and [[point[0], point[2]] for point in attempt.curve[-1:]] != end):
        raise ValueError(f"{attempt.problem}: the curve does not rise in cost to the run's cost and final error")
    if attempt.set not in suite().errors or attempt.status not in [*RunStatus]:
        raise ValueError(f"{attempt.problem}: there is no set {attempt.set!r} or status {attempt.status!r}")
    return attempt


@dataclass(frozen=True)
class Gathered:
    """All attempts in any order, the `local` ones of a results folder, and a message for each unreadable file."""

    everything: list[Attempt]
    local: list[Attempt]
    problems: list[str]
    second_starts: list[Attempt] = field(default_factory=list)  # apart from both, with the names of their rows

    @property
    def size(self) -> str:
        """The size of the suite to compare rows on: smoke if all local rows lack problems of quick."""
        rows = grouped((attempt for attempt in self.local if not attempt.tuned), lambda attempt: attempt.row).values()
        quick = {key[:2] for key in problems_of("quick")}
        return "quick" if not rows or any(quick <= {attempt.key[:2] for attempt in row} for row in rows) else "smoke"


def gather(shipped: Path, results_dir: Path, records: Iterable[Record] = ()) -> Gathered:
    """Collects the shipped attempts and the local ones: stored in a results folder, or among its records."""
    shipped_attempts, problems = read_attempts(shipped)
    local, unread = ([], []) if results_dir.resolve() == shipped.resolve() else read_attempts(results_dir)
    local += attempts_of(records, results_dir)
    names = {attempt.row.removesuffix(SECOND_SUFFIX) for attempt in shipped_attempts}
    local = [_renamed(attempt, names) for attempt in local]
    attempts = [*shipped_attempts, *local]
    second_starts = [
        replace(attempt, row=attempt.row.removesuffix(SECOND_SUFFIX)) for attempt in attempts if attempt.second_start
    ]
    attempts, local = ([run for run in runs if not run.second_start] for runs in (attempts, local))
    return Gathered(attempts, local, [*problems, *unread], second_starts)


def _renamed(attempt: Attempt, shipped: set[str]) -> Attempt:
    """The attempt of a user's class, with another row if its row is shipped."""
    row, suffix = attempt.row.removesuffix(SECOND_SUFFIX), SECOND_SUFFIX * attempt.second_start
    return replace(attempt, row=f"{row}, yours{suffix}") if attempt.preset == CUSTOM and row in shipped else attempt
