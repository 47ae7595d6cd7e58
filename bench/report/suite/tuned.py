"""Each renderer's own setting in a set of the suite: of a few candidates, the best one on validation shapes.

`conf/suite.yaml` lists the candidates, which are the same for all renderers. They change the learning rate, or the
number of rays per iteration. `python -m bench.suite setting=candidates` runs them on validation shapes.
"""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bench.report.suite.attempts import (
    CUSTOM,
    EXPERIMENT_PREFIX,
    ITERATIONS_KEY,
    RATE_KEY,
    Attempt,
    read_attempts,
    suite,
)
from bench.tables import CONF, read_yaml

CANDIDATES = "candidates"  # the folder of their attempts, next to the files of rows
STATED = "stated"  # the candidate with the set's setting
KEY = ["budget", "set", "renderer"]
Chosen = dict[tuple[float, str, str], str]  # the candidate by `KEY`


@cache
def stated_rate(set_name: str) -> float:
    """The learning rate of a set: of its experiment, else of its task."""
    experiment = read_yaml(CONF / "experiment" / f"{EXPERIMENT_PREFIX}{set_name}.yaml")
    choices = [base for base in experiment["defaults"] if isinstance(base, dict)]
    task = next(base["override /task"] for base in choices if "override /task" in base)
    optimisers = (experiment["task"]["optimiser"], read_yaml(CONF / "task" / f"{task}.yaml")["optimiser"])
    return next(optimiser["learning_rate"] for optimiser in optimisers if "learning_rate" in optimiser)


def setting_overrides(set_name: str, candidate: str) -> list[str]:
    """The overrides of a candidate in a set; none for the set's setting."""
    settings, stated = suite().candidates[candidate], suite().candidates[STATED]
    texts = [f"{RATE_KEY}={settings[0] * stated_rate(set_name):.3g}", f"+{ITERATIONS_KEY}={settings[1]}"]
    return [text for text, value, usual in zip(texts, settings, stated, strict=True) if value != usual]


def candidate_of(attempt: Attempt) -> str:
    """The candidate whose overrides an attempt has; empty if there is none."""
    keys = (RATE_KEY, f"+{ITERATIONS_KEY}")
    changes = [text for text in attempt.overrides if text.partition("=")[0] in keys]
    names = (name for name in suite().candidates if {*setting_overrides(attempt.set, name)} == {*changes})
    return next(names, "")


def renderer_of(attempt: Attempt) -> str:
    """The name by which a renderer is chosen: its preset, or the label of a user's class."""
    return attempt.row if attempt.preset == CUSTOM else attempt.preset


def chosen_settings(*folders: Path) -> tuple[Chosen, dict[str, int]]:
    """The best candidate by budget, set and renderer, of the attempts in results folders; later folders count more.

    It has the smallest geometric mean of final errors on validation shapes. A failed run counts with its initial error.
    Problems that lack a candidate are left out. Also returns the smallest number of problems of a renderer, by set.
    Raises ValueError for a damaged file.
    """
    attempts, problems = read_attempts(*folders, subfolder=CANDIDATES)
    if problems:
        raise ValueError(f"runs of candidates cannot be read: {'; '.join(problems)}")
    lines = [
        {
            **{"budget": attempt.budget, "set": attempt.set, "renderer": renderer_of(attempt)},
            **{"problem": attempt.problem, "candidate": candidate_of(attempt)},
            "error": np.log(attempt.final if attempt.ok else attempt.start),
        }
        for attempt in attempts
    ]
    frame = pd.DataFrame(lines, columns=[*KEY, "problem", "candidate", "error"])
    table = frame.pivot_table(index=[*KEY, "problem"], columns="candidate", values="error", aggfunc="last")
    table = table.reindex(columns=[*suite().candidates]).dropna()
    best: dict[Any, Any] = table.groupby(KEY).mean().idxmin(axis=1).to_dict() if len(table) else {}
    return best, table.groupby(KEY).size().groupby("set").min().to_dict()
