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
from bench.report.data.lines import UNREADABLE, read_lines, write_lines
from bench.report.data.records import Record, family, grouped, loop_seconds, setting
from bench.tables import CONF, read_yaml

FOLDER = "suite"  # of a results folder, with a folder a version in it
EXPERIMENT = "core_"  # in front of the name of a set
GIVEN = {  # the setting in which the problems of a scene differ, and its name
    **{"complete": ("task.points", "{} points"), "pose": ("task.degrees", "{:g} degrees")},
    **{"reconstruct": ("task.images.texture", "{}"), "render": ("task.size", "{} pixels")},
}
APART = ("render",)  # sets without a course of error over cost
TUNED = "tuned/"  # in front of the name of a method with its tuned setting
BY_ITSELF = ", tuned"  # behind the name of the row of a renderer at its own setting
FREE = r"silhouette|task\.(losses|code|\w+_weight|optimiser\.learning_rate)\b"  # what such a setting may set
STATED = ("task", "view", "evaluation", "silhouette", "field", "prior", "split")  # by a set, for all renderers


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
    found: set[tuple[Any, ...]] = set()
    for name in suite().errors:
        node = read_yaml(CONF / "experiment" / f"{EXPERIMENT}{name}.yaml")
        chosen = {key: str(value).split(",") for key, value in node["sizes"][suite().sizes[size]].items()}
        parts = [chosen.pop(key) for key in ("families", "shapes", "seeds")]
        text = GIVEN.get(name, ("", ""))[1]
        for name_of, index, seed, *given in product(*parts, *chosen.values()):
            named = [text.format(float(one) if one.isdecimal() and ":g" in text else one) for one in given]
            problem = ", ".join([f"{name_of} {node.get('split', 'test')} {index}", *named])
            found.add((name, problem, int(seed)))
    return found


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
        return self.row.endswith(BY_ITSELF)


def attempts_of(records: Iterable[Record], results_dir: Path) -> list[Attempt]:
    """The attempts among the records of a results folder; a run that was planned and not made is none."""
    return [one for record in records if (one := _attempt(record, results_dir / "runs" / record["folder"]))]


def joined(attempts: Iterable[Attempt]) -> list[Attempt]:
    """One attempt of each key: of several the newest, in whatever order they come."""
    return [*{one.key: one for one in sorted(attempts, key=lambda one: (one.started, repr(one)))}.values()]


def _attempt(record: Record, folder: Path) -> Attempt | None:
    config, said = record["config"], record["environment"]
    of_set = {f"{EXPERIMENT}{name}": name for name in suite().errors}.get(config.get("experiment"))
    if of_set is None or record["status"] in NO_ATTEMPTS:
        return None
    error, ok = suite().errors[of_set], record["status"] == "ok"
    scene = f"{family(record)} {config.get('split')} {config.get('index')}"
    given, text = GIVEN.get(of_set, ("", ""))
    named = [text.format(setting(config, *given.split(".")))] if given else []
    final, start = (_finite(record[part].get(error)) for part in ("metrics", "metrics_start"))
    curve = _curve(record, folder, final if ok else None)
    tuned = str(record.get("method") or "").startswith(TUNED)
    asked = [text.lstrip("+") for text in record.get("overrides", ()) if not config.get("label")]
    changed = [text.removeprefix("renderer.") for text in asked if re.match(r"renderer\.[^_]", text)]
    row = ", ".join([renderer_name(config, record["renderer"]), *changed])  # without the loss, which is the set's
    return Attempt(
        **{"set": of_set, "problem": ", ".join([scene, *named]), "scene": scene, "seed": record["seed"]},
        row=row.removesuffix(BY_ITSELF) + BY_ITSELF if tuned else row,
        preset=record["renderer"] if tuned else record.get("method") or record["renderer"],
        status=str(record["status"]),
        reason=record["reason"],
        start=start,
        final=final if ok else inf,
        cost=curve[-1][0] if curve else 0.0,
        operations=record["flops"],
        seconds=loop_seconds(record),
        waited=said.get("waited_share"),
        **{name: said.get(name, "") for name in ("cpu", "device", "kernels", "commit")},
        threads=said.get("threads"),
        **{"started": record["started"], "code": record.get("code", "")},
        settings=settings_of(config, of_set, tuned),
        curve=curve,
        overrides=portable(record.get("overrides", ())),
    )


def _finite(value: Any) -> float:
    """A number; infinite where it is none."""
    number = as_number(value)
    return inf if number is None or isnan(number) else number


def portable(overrides: Iterable[str]) -> list[str]:
    """Those of a run that say what it is, not where: no option of the command, no setting of Hydra's."""
    return [text for text in overrides if not text.lstrip("+~").startswith(("results_dir=", "hydra", "-"))]


def settings_of(config: dict[str, Any], of_set: str, tuned: bool) -> str:
    """A hash of what a set states for all renderers, without what its problems, or tuned settings, differ in."""
    known, (given, _) = flat({part: config.get(part) for part in STATED}), GIVEN.get(of_set, ("", ""))
    left = [key for key in known if key == given or (tuned and re.match(FREE, key))]
    return digest({key: str(value) for key, value in known.items() if key not in left})


def _curve(record: Record, folder: Path, final: float | None) -> list[list[float]]:
    """The checkpoints, and the end; a line has the error before its step, and the costs after it."""
    error = suite().errors[record["config"]["experiment"].removeprefix(EXPERIMENT)]
    lines = curve_lines(folder) or []
    of_rendering = record["metrics"].get("cost"), record["seconds"].get("forward")  # of a run without a loop
    found, spent = list[list[float]](), [0.0 if lines else as_number(number) or 0.0 for number in of_rendering]
    for line in lines:
        if line.get(error) is not None:
            found.append([*spent, _finite(line[error])])
        spent = [as_number(line.get(name)) or 0.0 for name in ("cost", "seconds")]
    end = [[*spent, final]] if final is not None else []
    return [[float(f"{number:.5g}") for number in point] for point in found + end]


def place(results_dir: Path) -> Path:
    """The folder of the attempts at this version of the suite."""
    return results_dir / FOLDER / suite().id


def write_attempts(attempts: Iterable[Attempt], results_dir: Path) -> list[Path]:
    """Joins attempts to those of a results folder; gives the files, one a row.

    Raises:
        ValueError: where a file of the folder cannot be read, whose content would be lost.
    """
    folder, (kept, problems) = place(results_dir), read_attempts(results_dir)
    if problems:
        raise ValueError(f"{folder} keeps what cannot be read; mend it or move it away: {'; '.join(problems)}")
    ordered = sorted(joined([*kept, *attempts]), key=lambda attempt: attempt.key)
    files = grouped(ordered, lambda attempt: re.sub(r"[^a-z0-9]+", "_", attempt.row.lower()).strip("_") or "row")
    folder.mkdir(parents=True, exist_ok=True)
    return [write_lines(folder / f"{name}.csv", Attempt, group) for name, group in sorted(files.items())]


def read_attempts(*folders: Path) -> tuple[list[Attempt], list[str]]:
    """The attempts that results folders keep, and a message for each file that cannot be read."""
    attempts, problems = list[Attempt](), list[str]()
    for path in (path for folder in folders for path in sorted(place(folder).glob("[!.]*.csv"))):
        try:
            attempts += [*map(_checked, read_lines(path, Attempt))]
        except UNREADABLE as error:
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
        whole = all(problems_of("quick") <= {attempt.key[:3] for attempt in row} for row in rows)
        return "quick" if whole else "smoke"


def gather(shipped: Path, results_dir: Path, records: Iterable[Record] = ()) -> Gathered:
    """The attempts that are shipped; and local ones, which a results folder keeps or which are among its records."""
    kept, problems = read_attempts(shipped)
    local, unread = ([], []) if results_dir.resolve() == shipped.resolve() else read_attempts(results_dir)
    local += attempts_of(records, results_dir)
    return Gathered([*kept, *local], local, [*problems, *unread])
