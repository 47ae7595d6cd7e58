"""What the page shows of each renderer of the suite: its progress at each problem, failures, settings and source."""

import inspect
import re
import shlex
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd

from bench.records.names import flat
from bench.report.data.records import OURS, Record
from bench.report.suite.attempts import TUNED, Attempt, attempts_of, gather, suite
from bench.report.suite.standing import KEY, Standing
from bench.report.write import paper
from bench.tables import METHOD, choice, names

SET_BY_SUITE = ("index=", "dataset=", "seed=", "task.", "sizes.", "experiment=")  # overrides that say which problem


def renderers(records: list[Record], results_dir: Path) -> dict[str, Any]:
    """The problems of the suite, and for each of its rows the progress at each, shipped rows beside one's own.

    Without rows where a record is odd or foreign: then the suite has no page either, and the report says why.
    """
    try:
        return _found(records, results_dir)
    except paper.BROKEN:
        return {"problems": [], "rows": []}


def _found(records: list[Record], results_dir: Path) -> dict[str, Any]:
    folders = {
        (*attempt.key, attempt.started): record["folder"]
        for record in records
        for attempt in attempts_of([record], results_dir)
    }
    gathered = gather(paper.SHIPPED, results_dir, records)
    made = Standing(gathered)
    attempts = {(*attempt.key, attempt.started): attempt for attempt in gathered.everything}
    order = [*suite().errors]
    keys = {tuple(key) for key in made.reached[KEY].itertuples(index=False)}
    problems = sorted(keys, key=lambda key: (order.index(key[0]), *key[1:]))
    ranks = {row: rank for rank, row in enumerate(made.rows)}
    rows = sorted(made.reached.groupby("row"), key=lambda pair: ranks.get(pair[0], len(ranks)))
    return {
        "problems": problems,
        "rows": [_row(row, runs, problems, attempts, folders) for row, runs in rows],
    }


def _row(
    row: str, runs: pd.DataFrame, problems: list[Any], attempts: dict[Any, Attempt], folders: dict[Any, str]
) -> dict[str, Any]:
    """A row: its progress at the end of each problem, None where it has no attempt; its failures, and the rest."""
    by_problem = {(run.set, run.problem, run.seed): run for run in runs.itertuples()}
    solved = [by_problem.get(problem) for problem in problems]
    keys = [run and (run.set, run.problem, run.seed, run.row, run.settings, run.started) for run in solved]
    first = next(attempts[key] for key in keys if key)
    settings = _node(first.preset) | _asked(first) | _tuned(attempts[key] for key in keys if key)
    file, source = _source(str(settings.get("_target_", "")))
    return {
        "row": row,
        "progress": [run and round(run.end, 4) for run in solved],
        "failed": [[place, run.status, run.reason] for place, run in enumerate(solved) if run and not run.ok],
        "runs": [folders.get(key) for key in keys],
        "settings": [
            [key, str(value)]
            for key, value in settings.items()
            if not key.startswith("_") and key.partition(":")[0] not in ("defaults", "label")
        ],
        "file": file,
        "source": source,
        "command": shlex.join(["python", "-m", "bench.suite", *_own(first)]),
    }


def _own(attempt: Attempt) -> list[str]:
    """The overrides that say which renderer it is."""
    if attempt.tuned:
        return ["setting=tuned", f"renderer={attempt.preset}"]
    return [text for text in attempt.overrides if not text.lstrip("+").startswith(SET_BY_SUITE)]


def _asked(attempt: Attempt) -> dict[str, Any]:
    """The settings of the renderer that the command line gave."""
    pairs = [text.lstrip("+").partition("=") for text in _own(attempt)]
    return {key.removeprefix("renderer."): value for key, _, value in pairs if key.startswith("renderer.")}


def _tuned(attempts: Iterable[Attempt]) -> dict[str, Any]:
    """The keys of tuned settings that attempts are at, each with its method, one a set."""
    overrides = {text.lstrip("+") for one in attempts if one.tuned for text in one.overrides}
    ours = {text.removeprefix(f"method={TUNED}") for text in overrides} & {*names(f"{METHOD}/tuned")}
    known = {name: choice(METHOD, f"{TUNED}{name}") for name in sorted(ours)}
    return {f"{key}: {TUNED}{name}": value for name, node in known.items() for key, value in flat(node).items()}


def _node(preset: str) -> dict[str, Any]:
    """What the file or the row of a renderer holds, over what it builds on; nothing for another preset."""
    try:
        own = choice("renderer", preset)
    except KeyError:
        return {}
    bases = [base for base in own.get("defaults", ()) if isinstance(base, str) and base != "_self_"]
    return {key: value for base in bases for key, value in _node(base).items()} | own


@cache
def _source(target: str) -> tuple[str, str]:
    """The file of a class of ours, with what its docstring says; of another class its name."""
    name = target.rpartition(".")[2]
    for path in sorted((paper.ROOT / OURS.rstrip(".")).rglob("*.py")) if target.startswith(OURS) else ():
        if said := re.search(
            rf'^class {name}\b[^\n]*:\n    """(.*?)"""', path.read_text("utf-8"), re.DOTALL | re.MULTILINE
        ):
            return path.relative_to(paper.ROOT).as_posix(), inspect.cleandoc(said[1]).partition("\n\nArgs:")[0]
    return target, ""
