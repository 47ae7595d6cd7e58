"""The standing of the suite: the progress of each row at each budget, and which rows differ significantly.

All rows spend the same cost on each problem: a budget, in units of its set. The progress of a run is
1 - log(final error / reference) / log(initial error / reference), from 0 to 1; for a failed run 0. Each set of problems
has the same weight.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
import pandas as pd

from bench.records.record import MAX_WAIT_FRACTION, TOO_EXPENSIVE
from bench.report.data import flips, statistics
from bench.report.data.statistics import shapes_needed
from bench.report.suite.attempts import Attempt, Gathered, problems_of, suite
from bench.tables import choice

DIST = "dist"  # the preset that decides which problems are compared, and that ratios of errors refer to
MIN_LOG_ERROR = 1e-12  # lower bound before taking the logarithm
KEY = ["set", "problem", "budget"]
MAX_LEVEL = 0.055  # see `Ranking.level`; 5 %, and the uncertainty of its simulation
ALPHA = 0.02  # total over all tests at a budget; as scenes are skewed, simulations of equal rows have 5 % false pairs


class Standing:
    """The attempts of the suite, the compared ones, their progress, and the ranking at each budget."""

    def __init__(self, gathered: Gathered) -> None:
        self.everything, self.other_settings = frame_of(gathered.everything)
        self.compared = compared(self.everything, gathered.size)
        self.reached = with_progress(self.compared)
        self.complete = self.reached[self.reached["complete"]]
        progress = {budget: progress_of(by_scene(runs)) for budget, runs in self.complete.groupby("budget")}
        self.budgets = [*progress]
        ranked_rows = [row for of_rows in progress.values() for row in of_rows]
        self.rows = [*dict.fromkeys([*ranked_rows, *(row for _, row in self.cannot_run)])]
        self.second_starts = second_starts(gathered.second_starts, self.complete)
        self.sets = [name for name in suite().errors if name in {*self.complete["set"]}]

    @cached_property
    def rankings(self) -> "dict[float, Ranking]":
        """The ranking at each budget; it takes seconds."""
        return {budget: verified_ranking(runs) for budget, runs in self.complete.groupby("budget")}

    @cached_property
    def lacking(self) -> dict[tuple[float, str], int]:
        """The rows that are not compared at a budget, with the number of problems they lack there."""
        rows = self.compared[~self.compared["tuned"] & (self.compared["missing"] > 0)]
        return rows.groupby(["budget", "row"])["missing"].first().to_dict()

    @cached_property
    def cannot_run(self) -> dict[tuple[float, str], str]:
        """The rows that are not compared at a budget, since it pays for too few iterations, with the sets."""
        rows = self.compared[self.compared["too_expensive"] != ""]
        return rows.groupby(["budget", "row"])["too_expensive"].first().to_dict()


def frame_of(attempts: Iterable[Attempt]) -> tuple[pd.DataFrame, dict[str, int]]:
    """A line per attempt, the oldest first; a key may have several. Also the number of attempts left out, by row.

    Attempts with other settings than most of their set are left out, apart from tuned ones. `timed`: the machine was
    not busy, and the seconds are stored.
    """
    lines = [vars(attempt) | {"ok": attempt.ok, "tuned": attempt.tuned} for attempt in attempts]
    columns = [*Attempt.__dataclass_fields__, "ok", "tuned"]
    frame = pd.DataFrame(lines, columns=columns, dtype=object).sort_values(["started", "final"])
    frame = frame.astype(dict.fromkeys(("budget", "start", "final", "cost", "waited", "seconds", "depth_bias"), float))
    frame = frame.astype({"ok": bool, "tuned": bool}).assign(
        timed=frame["seconds"].notna() & ~(frame["waited"] > MAX_WAIT_FRACTION),
        machine=frame["cpu"] + "; " + frame["device"] + "; " + frame["threads"].map(str) + "; " + frame["kernels"],
    )
    counts = frame.drop_duplicates([*KEY, "row", "settings"]).groupby(["set", "tuned", "settings"]).size()
    usual = {key[:2]: key[2] for key in counts.sort_values(kind="stable").index}  # the last is the most frequent
    keys = zip(frame["set"], frame["tuned"], frame["settings"], strict=True)
    is_usual = np.array([usual[of_set, tuned] == settings for of_set, tuned, settings in keys], dtype=bool)
    return frame.loc[is_usual], frame.loc[~is_usual, "row"].value_counts().to_dict()


def dist_row(runs: pd.DataFrame) -> str:
    """The row of DIST at its default settings; empty if there is none."""
    rows = sorted({*runs.loc[(runs["preset"] == DIST) & ~runs["tuned"], "row"]})
    label = choice("renderer", DIST).get("_label_")
    return label if label in rows else next(iter(rows), "")


def compared(everything: pd.DataFrame, size: str = "quick") -> pd.DataFrame:
    """The newest attempt of each row on the problems that all complete rows have at the same budget.

    A row is complete at a budget if it has the problems of that size of the suite, at whichever budget the size has
    them. If DIST lacks one of them, it needs all of DIST's. The budget must also pay for enough iterations in at least
    half of the problems of each set. Other rows stay in the frame, but are not compared.

    Further columns: `missing`, the number of problems that its row lacks at the budget; `too_expensive`, the sets in
    which it cannot run; `complete`; and `initial` and `reference`, the errors that progress is measured between.
    """
    newest = everything.drop_duplicates([*KEY, "row"], keep="last")
    parts = [_compared_at_budget(runs, problems_of(size)) for _, runs in newest.groupby("budget")]
    if not parts:
        columns = {"missing": int, "too_expensive": str, "complete": bool, "initial": float, "reference": float}
        return newest.assign(**{name: pd.Series(dtype=kind) for name, kind in columns.items()})
    return pd.concat(parts, ignore_index=True)


def _compared_at_budget(runs: pd.DataFrame, wanted: set[tuple[Any, ...]]) -> pd.DataFrame:
    keys = pd.Series([*zip(*(runs[name] for name in KEY), strict=True)], runs.index, dtype=object)
    rows = {row: {*group} for row, group in keys.groupby(runs["row"])}
    reachable = rows.get(dist_row(runs), {*keys})
    wanted = {(*key[:2], runs["budget"].iloc[0]) for key in wanted}
    needed = wanted if wanted <= reachable else reachable
    missing = runs["row"].map({row: len(needed - problems) for row, problems in rows.items()})
    few = runs["reason"].str.startswith(TOO_EXPENSIVE).groupby([runs["row"], runs["set"]]).mean()
    sets = {row: ", ".join(of_set for _, of_set in group.index) for row, group in few[few > 0.5].groupby("row")}
    expensive = runs["row"].map(lambda row: sets.get(row, ""))
    complete = (missing == 0) & (expensive == "") & ~runs["tuned"]
    runs = runs.assign(missing=missing, too_expensive=expensive, complete=complete)
    common = reachable.intersection(*(rows[row] for row in runs.loc[runs["complete"], "row"].unique()))
    return _with_errors(runs[keys.isin(common)])


def _with_errors(runs: pd.DataFrame) -> pd.DataFrame:
    def at_problem(values: pd.Series) -> pd.Series:
        index = pd.MultiIndex.from_frame(runs[KEY])
        return pd.Series(values.reindex(index).to_numpy(dtype=float), runs.index)

    finite = runs[np.isfinite(runs["start"]) & ~runs["tuned"]]
    sound = finite[finite["ok"] | ~finite.groupby(KEY)["ok"].transform("any")]  # those that ended ok, if any
    least = runs[~runs["tuned"]].groupby(KEY)["final"].min().clip(lower=MIN_LOG_ERROR)
    stated = [_reference(*line) for line in zip(runs["set"], runs["scene"], strict=True)]
    return runs.assign(
        initial=at_problem(sound.groupby(KEY)["start"].median()),
        reference=pd.Series(stated, runs.index, dtype=float).fillna(at_problem(least)),
    )


def _reference(set_name: str, scene: str) -> float | None:
    """The best possible error that the suite states; None for a scene that it does not list."""
    errors = suite().references.get(set_name, {})
    return errors.get(scene, errors.get("all"))


def progress_curve(run: Any) -> tuple[np.ndarray, np.ndarray]:
    """The costs of a run's checkpoints in units of its set, and the progress at each."""
    if not run.ok:
        return np.array([0.0, run.budget]), np.zeros(2)
    curve = np.array(run.curve)
    left = np.log(np.maximum(curve[:, 2], MIN_LOG_ERROR) / run.reference) / np.log(run.initial / run.reference)
    return curve[:, 0] / suite().units[run.set], 1 - np.clip(left, 0, 1)


def with_progress(runs: pd.DataFrame) -> pd.DataFrame:
    """The attempts whose initial error is above the reference, and their final `progress`."""
    runs = runs[(runs["initial"] > runs["reference"]) & (runs["reference"] > 0)].reset_index(drop=True)
    return runs.assign(progress=[float(progress_curve(run)[1][-1]) for run in runs.itertuples()])


def second_starts(attempts: Iterable[Attempt], first: pd.DataFrame) -> pd.DataFrame:
    """The second starts of compared runs with their `progress`, and as `first` that of the run itself."""
    key = [*KEY, "row", "settings"]
    runs = first[[*key, "initial", "reference", "progress"]].rename(columns={"progress": "first"})
    newest = frame_of(attempts)[0].drop_duplicates(key, keep="last")
    return with_progress(newest.merge(runs, on=key))


def units(budget: float) -> str:
    return f"{budget:g} {'unit' if budget == 1 else 'units'}"


@dataclass(frozen=True)
class Ranking:
    """The progress of rows at a budget, and which of them differ significantly."""

    progress: dict[str, float]  # the mean over sets of the mean over problems, the largest first
    better: set[tuple[str, str]]  # the significant pairs, the row with more progress first
    pairs: int  # the number of all pairs
    least_p: float  # of all pairs; 1 without pairs
    scenes: int  # the number of scenes, the units of the test
    level: float = 0.0  # the fraction of simulated draws of equal rows with a significant pair; 0 if not simulated

    @property
    def decidable(self) -> bool:
        """Whether this number of scenes can show any difference, and equal rows rarely have one."""
        return self.pairs > 0 and self.scenes >= shapes_needed(self.pairs, ALPHA) and self.level <= MAX_LEVEL

    @property
    def possible_p(self) -> float:
        return 1 / len(flips.signs(self.scenes))

    def rank(self, row: str) -> str:
        """The ranks that a row can have, such as 1–4, simultaneous at 95 % (Mogstad et al. 2024)."""
        above, below = (sum(pair[position] == row for pair in self.better) for position in (1, 0))
        return "–".join(dict.fromkeys((str(1 + above), str(len(self.progress) - below))))


def ranking(runs: pd.DataFrame, row: str = "") -> Ranking:
    """Ranks rows with the same problems by sign flips of scenes' differences, with Holm's correction over all pairs.

    Args:
        row: the tested pairs are those of this row alone; empty: all pairs.
    """
    scores = by_scene(runs)
    first, second = _pairs([*scores.columns], row)
    differences = scores.to_numpy()[:, first] - scores.to_numpy()[:, second]
    pairs, p_values = zip(scores.columns[first], scores.columns[second], strict=True), flips.p_values(differences)
    significant = zip(pairs, differences.sum(axis=0), statistics.holm(p_values, ALPHA), strict=True)
    better = {pair if difference > 0 else pair[::-1] for pair, difference, sure in significant if sure}
    return Ranking(progress_of(scores), better, len(first), p_values.min(initial=1.0), len(scores))


def progress_of(scores: pd.DataFrame) -> dict[str, float]:
    return scores.sum().sort_values(ascending=False, kind="stable").to_dict()


def _pairs(rows: list[str], row: str) -> tuple[np.ndarray, np.ndarray]:
    """The positions of both rows of each tested pair."""
    first, second = np.triu_indices(len(rows), 1)
    tested = [not row or row in (rows[a], rows[b]) for a, b in zip(first, second, strict=True)]
    return first[tested], second[tested]


def verified_ranking(runs: pd.DataFrame, row: str = "") -> Ranking:
    """The ranking, without significant pairs if too many simulated draws of equal rows have one."""
    ranked = ranking(runs, row)
    if not ranked.better:
        return ranked
    ranked = replace(ranked, level=simulated_level(runs, row=row))
    return ranked if ranked.decidable else replace(ranked, better=set())


def simulated_level(runs: pd.DataFrame, draws: int = 200, row: str = "") -> float:
    """The fraction of draws of scenes with a significant pair, after centring the rows in each set: they are equal."""
    means = runs.groupby(["set", "row"])["progress"].transform("mean")
    scores = by_scene(runs.assign(progress=runs["progress"] - means))
    first, second = _pairs([*scores.columns], row)
    differences = scores.to_numpy()[:, first] - scores.to_numpy()[:, second]
    return _simulated_level(differences.tobytes(), len(scores), draws) if len(first) else 0.0


@cache  # several tables show the same ranking
def _simulated_level(content: bytes, scenes: int, draws: int) -> float:
    differences, rng = np.frombuffer(content).reshape(scenes, -1), np.random.default_rng(1)
    drawn = (differences[rng.integers(scenes, size=scenes)] for _ in range(draws))
    return sum(flips.any_at_most(each, ALPHA / differences.shape[1]) for each in drawn) / draws


def by_scene(runs: pd.DataFrame) -> pd.DataFrame:
    """What each scene [scenes, rows] contributes to a row's mean over sets of the mean over problems."""
    sizes = runs.groupby(["set", "row"]).size().groupby("set").max()
    shares = runs.assign(share=runs["progress"] / runs["set"].map(sizes) / max(len(sizes), 1))
    return shares.pivot_table(index="scene", columns="row", values="share", aggfunc="sum")


def bounds(runs: pd.DataFrame) -> tuple[float, float] | None:
    """The bounds of the mean final errors of all rows relative to DIST's, in runs of one set at one budget.

    Geometric means over scenes, see `flips.bounds`, without rows that mostly failed. None if there are too few scenes.
    """
    runs = runs[runs.groupby("row")["ok"].transform("mean") >= 0.5]
    errors = np.log(runs["final"].where(runs["ok"], runs["initial"]).clip(lower=MIN_LOG_ERROR))
    table = errors.groupby([runs["scene"], runs["row"]]).mean().unstack("row")
    if (reference := dist_row(runs)) not in table:
        return None
    ends = flips.bounds(table.drop(columns=reference).sub(table[reference], axis=0).to_numpy(), ALPHA)
    return ends and (float(np.exp(ends[0])), float(np.exp(ends[1])))


def seconds_per_unit(everything: pd.DataFrame) -> pd.DataFrame:
    """Median `seconds` and number of `timed` runs at 1 unit, by set and row, on the machine with most quiet runs."""
    runs = everything.drop_duplicates([*KEY, "row", "started"])  # a run may be shipped and local
    runs = runs[runs["budget"] == 1]  # at other budgets, iterations may have other numbers of rays
    runs = runs[runs["timed"] & runs["ok"] & (runs["cost"] > 0)]
    runs = runs[runs["machine"].isin(runs["machine"].mode().iloc[:1])]
    runs = runs.assign(seconds=runs["seconds"] / runs["cost"] * runs["set"].map(suite().units))
    return runs.groupby(["set", "row"])["seconds"].agg(seconds="median", timed="size")
