"""The data of the page on each renderer of the suite: progress per problem, failures, settings and source."""

import inspect
import re
import shlex
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd

from bench.records.record import flat
from bench.report.data.records import OURS, Record
from bench.report.suite.attempts import TUNED_PREFIX, Attempt, attempts_of, gather, suite
from bench.report.suite.standing import KEY, Standing
from bench.report.write import paper
from bench.tables import METHOD, choice, names

SET_BY_SUITE = ("index=", "dataset=", "seed=", "task.", "sizes.", "experiment=")  # overrides that define the problem


def renderers(records: list[Record], results_dir: Path) -> dict[str, Any]:
    """The problems of the suite, and the progress of each row on each problem; shipped rows and the user's.

    Without rows if a record is odd or foreign: then the suite has no page either, and the report says why.
    """
    try:
        return _progress_of_rows(records, results_dir)
    except paper.RECORD_ERRORS:
        return {"problems": [], "rows": []}


def _progress_of_rows(records: list[Record], results_dir: Path) -> dict[str, Any]:
    folders = {
        (*attempt.key, attempt.started): record["folder"]
        for record in records
        for attempt in attempts_of([record], results_dir)
    }
    gathered = gather(paper.SHIPPED, results_dir, records)
    standing = Standing(gathered)
    attempts = {(*attempt.key, attempt.started): attempt for attempt in gathered.everything}
    order = [*suite().errors]
    keys = {tuple(key) for key in standing.reached[KEY].itertuples(index=False)}
    problems = sorted(keys, key=lambda key: (order.index(key[0]), *key[1:]))
    ranks = {row: rank for rank, row in enumerate(standing.rows)}
    rows = sorted(standing.reached.groupby("row"), key=lambda pair: ranks.get(pair[0], len(ranks)))
    return {
        "problems": problems,
        "rows": [_row(row, runs, problems, attempts, folders) for row, runs in rows],
    }


def _row(
    row: str, runs: pd.DataFrame, problems: list[Any], attempts: dict[Any, Attempt], folders: dict[Any, str]
) -> dict[str, Any]:
    """A row's final progress on each problem (None without an attempt), its failures, settings and source."""
    by_problem = {(run.set, run.problem, run.seed): run for run in runs.itertuples()}
    solved = [by_problem.get(problem) for problem in problems]
    keys = [run and (run.set, run.problem, run.seed, run.row, run.settings, run.started) for run in solved]
    first = next(attempts[key] for key in keys if key)
    settings = _preset_settings(first.preset) | _overridden_settings(first)
    settings |= _tuned_settings(attempts[key] for key in keys if key)
    file, source = _source(str(settings.get("_target_", "")))
    return {
        "row": row,
        "progress": [run and round(run.end, 4) for run in solved],
        "failed": [[index, run.status, run.reason] for index, run in enumerate(solved) if run and not run.ok],
        "runs": [folders.get(key) for key in keys],
        "settings": [
            [key, str(value)]
            for key, value in settings.items()
            if not key.startswith("_") and key.partition(":")[0] not in ("defaults", "label")
        ],
        "file": file,
        "source": source,
        "command": shlex.join(["python", "-m", "bench.suite", *_overrides_of_row(first)]),
    }


def _overrides_of_row(attempt: Attempt) -> list[str]:
    if attempt.tuned:
        return ["setting=tuned", f"renderer={attempt.preset}"]
    return [text for text in attempt.overrides if not text.lstrip("+").startswith(SET_BY_SUITE)]


def _overridden_settings(attempt: Attempt) -> dict[str, Any]:
    pairs = [text.lstrip("+").partition("=") for text in _overrides_of_row(attempt)]
    return {key.removeprefix("renderer."): value for key, _, value in pairs if key.startswith("renderer.")}


def _tuned_settings(attempts: Iterable[Attempt]) -> dict[str, Any]:
    """The tuned settings of the attempts; each key names its method, one per set."""
    overrides = {text.lstrip("+") for attempt in attempts if attempt.tuned for text in attempt.overrides}
    tuned_names = {text.removeprefix(f"method={TUNED_PREFIX}") for text in overrides} & {*names(f"{METHOD}/tuned")}
    settings_by_name = {name: choice(METHOD, f"{TUNED_PREFIX}{name}") for name in sorted(tuned_names)}
    pairs = [(name, pair) for name, settings in settings_by_name.items() for pair in flat(settings).items()]
    return {f"{key}: {TUNED_PREFIX}{name}": value for name, (key, value) in pairs}


def _preset_settings(preset: str) -> dict[str, Any]:
    """The settings of a preset, including those of its bases; empty for an unknown preset."""
    try:
        settings = choice("renderer", preset)
    except KeyError:
        return {}
    bases = [base for base in settings.get("defaults", ()) if isinstance(base, str) and base != "_self_"]
    return {key: value for base in bases for key, value in _preset_settings(base).items()} | settings


@cache
def _source(target: str) -> tuple[str, str]:
    """The file and the docstring of a class of this project; for another class, its name."""
    name = target.rpartition(".")[2]
    for path in sorted((paper.ROOT / OURS.rstrip(".")).rglob("*.py")) if target.startswith(OURS) else ():
        if docstring := re.search(
            rf'^class {name}\b[^\n]*:\n    """(.*?)"""', path.read_text("utf-8"), re.DOTALL | re.MULTILINE
        ):
            return path.relative_to(paper.ROOT).as_posix(), inspect.cleandoc(docstring[1]).partition("\n\nArgs:")[0]
    return target, ""
