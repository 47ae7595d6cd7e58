"""The rows of the suite: an attempt of a renderer at a problem, with its curve of cost and error.

Attempts are made of runs, and kept as CSV files, a file a renderer and a line an attempt, so that results outlive the
run folders and are joined over days and machines.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from itertools import product
from math import inf, isnan
from pathlib import Path
from typing import Any

from bench.records.names import flat
from bench.records.read import curve_lines
from bench.records.record import RunStatus, as_number, digest, renderer_name
from bench.report.data.kept import NO_ATTEMPTS
from bench.report.data.lines import READ_ERRORS, read_lines, write_lines
from bench.report.data.records import Record, family, grouped, loop_seconds, setting
from bench.tables import CONF, read_yaml

SUITE_FOLDER = "suite"  # of a results folder, with a folder a version in it
EXPERIMENT_PREFIX = "core_"  # in front of the name of a set
PROBLEM_SETTINGS = {  # the setting in which the problems of a scene differ, and its name
    **{"complete": ("task.points", "{} points"), "pose": ("task.degrees", "{:g} degrees")},
    **{"reconstruct": ("task.images.texture", "{}"), "render": ("task.size", "{} pixels")},
}
SETS_WITHOUT_CURVE = ("render",)  # sets without a course of error over cost
TUNED_PREFIX = "tuned/"  # in front of the name of a method with its tuned setting
TUNED_SUFFIX = ", tuned"  # behind the name of the row of a renderer at its own setting
TUNABLE_KEYS = r"silhouette|task\.(losses|code|\w+_weight|optimiser\.learning_rate)\b"  # what such a setting may set
FIXED_KEYS = ("task", "view", "evaluation", "silhouette", "field", "prior", "split")  # by a set, for all renderers


@dataclass(frozen=True)
class Suite:
    """The content of `conf/suite.yaml`; its comments say what it means."""

    name: str
    version: int
    sizes: dict[str, str]
    errors: dict[str, str]
    references: dict[str, dict[str, float]]

    @property
    def id(self) -> str:
        """The name with the version."""
        return f"{self.name}-{self.version}"


@cache
def suite() -> Suite:
    """The suite of this version."""
    return Suite(**read_yaml(CONF / "suite.yaml"))


@cache
def problems_of(size: str) -> set[tuple[Any, ...]]:
    """The set, problem and seed of all cells of a size of the suite: a row that has them is compared."""
    keys: set[tuple[Any, ...]] = set()
    for name in suite().errors:
        experiment = read_yaml(CONF / "experiment" / f"{EXPERIMENT_PREFIX}{name}.yaml")
        sizes = {key: str(value).split(",") for key, value in experiment["sizes"][suite().sizes[size]].items()}
        axes = [sizes.pop(key) for key in ("families", "shapes", "seeds")]
        form = PROBLEM_SETTINGS.get(name, ("", ""))[1]
        for family_name, index, seed, *amounts in product(*axes, *sizes.values()):
            values = [float(text) if text.isdecimal() and ":g" in form else text for text in amounts]
            problem = ", ".join([f"{family_name} {experiment.get('split', 'test')} {index}", *map(form.format, values)])
            keys.add((name, problem, int(seed)))
    return keys


@dataclass(frozen=True)
class Attempt:
    """A run of a renderer at a problem of the suite.

    Args:
        set, problem, scene, seed: what was to be solved; a scene has a problem for each amount of what is given.
        row, preset: the renderer's name in tables, and what decides its look.
        start, final: the errors before and after; `final` is infinite where the run did not end ok.
        cost, operations, seconds: of the loop, or of one rendering; `cost` as `renderers.field.Counts.cost`.
        waited: share of its time that the run waited for a processor.
        settings, code: hashes of what the set states for all renderers, and of the code.
        curve: at each checkpoint the cost, the seconds and the error.
        overrides: the command line that makes it again.
    """

    set: str
    problem: str
    scene: str
    seed: int
    row: str
    preset: str
    status: str
    reason: str
    start: float
    final: float
    cost: float
    operations: float | None
    seconds: float | None
    waited: float | None
    cpu: str
    device: str
    threads: int | None
    kernels: str
    started: str
    commit: str
    code: str
    settings: str
    curve: list[list[float]]
    overrides: list[str]

    @property
    def key(self) -> tuple[Any, ...]:
        """What there is one attempt of: its set, problem, seed, row and settings."""
        return self.set, self.problem, self.seed, self.row, self.settings

    @property
    def ok(self) -> bool:
        """Whether its errors count; those of a run that ended otherwise do not."""
        return self.status == "ok"

    @property
    def tuned(self) -> bool:
        """Whether it is at the renderer's own setting, not at the one of the set."""
        return self.row.endswith(TUNED_SUFFIX)


def attempts_of(records: Iterable[Record], results_dir: Path) -> list[Attempt]:
    """The attempts among the records of a results folder; a run that was planned and not made is none."""
    return [attempt for record in records if (attempt := _attempt(record, results_dir / "runs" / record["folder"]))]


def newest_attempts(attempts: Iterable[Attempt]) -> list[Attempt]:
    """One attempt of each key: of several the newest, in whatever order they come."""
    ordered = sorted(attempts, key=lambda attempt: (attempt.started, repr(attempt)))
    return [*{attempt.key: attempt for attempt in ordered}.values()]


def _attempt(record: Record, folder: Path) -> Attempt | None:
    config, environment = record["config"], record["environment"]
    set_name = {f"{EXPERIMENT_PREFIX}{name}": name for name in suite().errors}.get(config.get("experiment"))
    if set_name is None or record["status"] in NO_ATTEMPTS:
        return None
    error, ok = suite().errors[set_name], record["status"] == "ok"
    scene = f"{family(record)} {config.get('split')} {config.get('index')}"
    amount_key, form = PROBLEM_SETTINGS.get(set_name, ("", ""))
    amount_texts = [form.format(setting(config, *amount_key.split(".")))] if amount_key else []
    final, start = (_finite(record[section].get(error)) for section in ("metrics", "metrics_start"))
    curve = _curve(record, folder, final if ok else None)
    tuned = str(record.get("method") or "").startswith(TUNED_PREFIX)
    overrides = [text.lstrip("+") for text in record.get("overrides", ()) if not config.get("label")]
    changes = [text.removeprefix("renderer.") for text in overrides if re.match(r"renderer\.[^_]", text)]
    row = ", ".join([renderer_name(config, record["renderer"]), *changes])  # without the loss, which is the set's
    return Attempt(
        **{"set": set_name, "problem": ", ".join([scene, *amount_texts]), "scene": scene, "seed": record["seed"]},
        row=row.removesuffix(TUNED_SUFFIX) + TUNED_SUFFIX if tuned else row,
        preset=record["renderer"] if tuned else record.get("method") or record["renderer"],
        status=str(record["status"]),
        reason=record["reason"],
        start=start,
        final=final if ok else inf,
        cost=curve[-1][0] if curve else 0.0,
        operations=record["flops"],
        seconds=loop_seconds(record),
        waited=environment.get("waited_share"),
        **{name: environment.get(name, "") for name in ("cpu", "device", "kernels", "commit")},
        threads=environment.get("threads"),
        **{"started": record["started"], "code": record.get("code", "")},
        settings=settings_hash(config, set_name, tuned),
        curve=curve,
        overrides=portable_overrides(record.get("overrides", ())),
    )


def _finite(value: Any) -> float:
    """A number; infinite where it is none."""
    number = as_number(value)
    return inf if number is None or isnan(number) else number


def portable_overrides(overrides: Iterable[str]) -> list[str]:
    """Those of a run that say what it is, not where: no option of the command, no setting of Hydra's."""
    return [text for text in overrides if not text.lstrip("+~").startswith(("results_dir=", "hydra", "-"))]


def settings_hash(config: dict[str, Any], set_name: str, tuned: bool) -> str:
    """A hash of what a set states for all renderers, without what its problems, or tuned settings, differ in."""
    values, (amount_key, _) = (
        flat({part: config.get(part) for part in FIXED_KEYS}),
        PROBLEM_SETTINGS.get(set_name, ("", "")),
    )
    varying = [key for key in values if key == amount_key or (tuned and re.match(TUNABLE_KEYS, key))]
    return digest({key: str(value) for key, value in values.items() if key not in varying})


def _curve(record: Record, folder: Path, final: float | None) -> list[list[float]]:
    """The checkpoints, and the end; a line has the error before its step, and the costs after it."""
    error = suite().errors[record["config"]["experiment"].removeprefix(EXPERIMENT_PREFIX)]
    lines = curve_lines(folder) or []
    rendering_costs = record["metrics"].get("cost"), record["seconds"].get("forward")  # of a run without a loop
    checkpoints, costs = list[list[float]](), [0.0 if lines else as_number(number) or 0.0 for number in rendering_costs]
    for line in lines:
        if line.get(error) is not None:
            checkpoints.append([*costs, _finite(line[error])])
        costs = [as_number(line.get(name)) or 0.0 for name in ("cost", "seconds")]
    end = [[*costs, final]] if final is not None else []
    return [[float(f"{number:.5g}") for number in point] for point in checkpoints + end]


def attempts_folder(results_dir: Path) -> Path:
    """The folder of the attempts at this version of the suite."""
    return results_dir / SUITE_FOLDER / suite().id


def write_attempts(attempts: Iterable[Attempt], results_dir: Path) -> list[Path]:
    """Joins attempts to those of a results folder; gives the files, one a row.

    Raises:
        ValueError: where a file of the folder cannot be read, whose content would be lost.
    """
    folder, (stored, problems) = attempts_folder(results_dir), read_attempts(results_dir)
    if problems:
        raise ValueError(f"{folder} keeps what cannot be read; mend it or move it away: {'; '.join(problems)}")
    ordered = sorted(newest_attempts([*stored, *attempts]), key=lambda attempt: attempt.key)
    files = grouped(ordered, lambda attempt: re.sub(r"[^a-z0-9]+", "_", attempt.row.lower()).strip("_") or "row")
    folder.mkdir(parents=True, exist_ok=True)
    return [write_lines(folder / f"{name}.csv", Attempt, group) for name, group in sorted(files.items())]


def read_attempts(*folders: Path) -> tuple[list[Attempt], list[str]]:
    """The attempts that results folders keep, and a message for each file that cannot be read."""
    attempts, problems = list[Attempt](), list[str]()
    for path in (path for folder in folders for path in sorted(attempts_folder(folder).glob("[!.]*.csv"))):
        try:
            attempts += [*map(_checked, read_lines(path, Attempt))]
        except READ_ERRORS as error:
            problems.append(f"{path.name}: {error!r}")
    return attempts, problems


def _checked(attempt: Attempt) -> Attempt:
    """The attempt, if its numbers make sense.

    Raises:
        ValueError, TypeError: where they do not.
    """
    numbers = [attempt.start, attempt.final, attempt.cost, *(number for point in attempt.curve for number in point)]
    costs, end = [point[:2] for point in attempt.curve], [[attempt.cost, float(f"{attempt.final:.5g}")]]
    if any(as_number(number) is None or number < 0 for number in numbers) or any(len(p) != 3 for p in attempt.curve):
        raise ValueError(f"{attempt.problem}: errors and costs must be numbers of 0 or more")
    if costs != sorted(costs) or (attempt.ok and [[point[0], point[2]] for point in attempt.curve[-1:]] != end):
        raise ValueError(f"{attempt.problem}: the curve does not rise in cost to the run's cost and final error")
    if attempt.set not in suite().errors or attempt.status not in [*RunStatus]:
        raise ValueError(f"{attempt.problem}: there is no set {attempt.set!r} or status {attempt.status!r}")
    return attempt


@dataclass(frozen=True)
class Gathered:
    """All attempts in any order, the `local` ones of a results folder, and a message for each file that is unread."""

    everything: list[Attempt]
    local: list[Attempt]
    problems: list[str]

    @property
    def size(self) -> str:
        """The size of the suite at which rows are compared: the least one if a local row lacks problems of quick."""
        rows = grouped((attempt for attempt in self.local if not attempt.tuned), lambda attempt: attempt.row).values()
        is_complete = all(problems_of("quick") <= {attempt.key[:3] for attempt in row} for row in rows)
        return "quick" if is_complete else "smoke"


def gather(shipped: Path, results_dir: Path, records: Iterable[Record] = ()) -> Gathered:
    """The attempts that are shipped; and local ones, which a results folder keeps or which are among its records."""
    shipped_attempts, problems = read_attempts(shipped)
    local, unread = ([], []) if results_dir.resolve() == shipped.resolve() else read_attempts(results_dir)
    local += attempts_of(records, results_dir)
    return Gathered([*shipped_attempts, *local], local, [*problems, *unread])
