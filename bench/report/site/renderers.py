"""The data of the page on each renderer of the suite: progress on each problem, failures and command."""

import shlex
from pathlib import Path
from typing import Any

import pandas as pd

from bench.report.data.records import Record
from bench.report.suite.attempts import Attempt, attempts_of, gather, suite
from bench.report.suite.standing import KEY, Standing
from bench.report.write import paper

SET_BY_SUITE = ("index=", "dataset=", "seed=", "task.", "sizes.", "experiment=")  # overrides that define the problem


def renderers(records: list[Record], results_dir: Path) -> dict[str, Any]:
    """The problems of the suite, and the progress of each row on each; without rows if a record is odd or foreign."""
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
    """A row's final progress on each problem (None without an attempt), its failures and the command."""
    by_problem = {(run.set, run.problem, run.budget): run for run in runs.itertuples()}
    solved = [by_problem.get(problem) for problem in problems]
    keys = [run and (run.set, run.problem, run.budget, run.row, run.settings, run.started) for run in solved]
    first = next(attempts[key] for key in keys if key)
    overrides = [text for text in first.overrides if not text.lstrip("+").startswith(SET_BY_SUITE)]
    overrides = ["setting=tuned", f"renderer={first.preset}"] if first.tuned else overrides
    return {
        "row": row,
        "progress": [run and round(run.progress, 4) for run in solved],
        "failed": [[index, run.status, run.reason] for index, run in enumerate(solved) if run and not run.ok],
        "runs": [folders.get(key) for key in keys],
        "command": shlex.join(["python", "-m", "bench.suite", *overrides]),
    }
