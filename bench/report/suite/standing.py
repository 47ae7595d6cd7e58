"""The standing of the suite: how far each row gets, what that costs, and which rows differ significantly.

The progress of a run is 1 - log(error / reference) / log(initial error / reference), from 0 to 1; for a failed run 0.
Progress is read at two costs, at the end of the run, and as its mean over the logarithm of the cost. The unit of cost
is DIST's total cost on the same problem. Each set of problems has the same weight.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from math import inf
from typing import Any

import numpy as np
import pandas as pd

from bench.records.record import MAX_WAIT_FRACTION
from bench.report.data import flips, statistics
from bench.report.data.statistics import Interval, shapes_needed
from bench.report.suite.attempts import SETS_WITHOUT_CURVE, Attempt, Gathered, problems_of, suite
from bench.tables import choice

UNIT = "dist"  # costs are relative to those of this preset
AT_1, AT_10, END, AREA = OUTCOMES = ("at_1", "at_10", "end", "area")
AT_SECONDS = "at_seconds"  # progress at the seconds of DIST's run
BUDGETS = {AT_1: 1.0, AT_10: 10.0, END: inf}  # progress is read at these costs
AREA_COSTS = np.geomspace(0.3, 30.0, 49)  # progress is averaged over these, equally spaced in the logarithm
MIN_CHECKPOINTS = 3  # with fewer within a cost, progress there is interpolated rather than measured
MIN_LOG_ERROR = 1e-12  # lower bound before taking the logarithm
KEY = ["set", "problem", "seed"]
ALPHA = 0.02  # total over all tests; as scenes are skewed, it gives 5 % false pairs in simulations of equal rows


class Standing:
    """The attempts of the suite, the compared ones, their progress, and the rankings by it."""

    def __init__(self, gathered: Gathered) -> None:
        self.everything = frame_of(gathered.everything)
        self.compared = compared(self.everything, gathered.size)
        self.reached = with_progress(self.compared)
        self.complete = self.reached[self.reached["complete"]]
        self.rankings = {outcome: ranking(self.complete, outcome) for outcome in OUTCOMES}
        self.rows = [*self.rankings[AT_1].progress]
        self.sets = [name for name in suite().errors if name in {*self.complete["set"]}]
        self.hidden = {budget: rows_with_few_checkpoints(self.complete, budget) for budget in BUDGETS} | {AREA: set()}

    @cached_property
    def costs(self) -> dict[str, float]:
        """The median cost of each row's runs relative to DIST's."""
        return (self.complete["cost"] / self.complete["unit"]).groupby(self.complete["row"]).median().to_dict()

    @cached_property
    def lacking(self) -> dict[str, int]:
        """The rows that are not compared, with the number of problems they lack."""
        rows = self.compared[~self.compared["complete"] & ~self.compared["tuned"]]
        return rows.groupby("row")["missing"].first().to_dict()


def frame_of(attempts: Iterable[Attempt]) -> pd.DataFrame:
    """A line per attempt, the oldest first; a key may have several.

    Its columns: the fields of the attempt, `ok`, `tuned`, `machine`, and `timed` (the machine was not busy). Attempts
    with other settings than most of their set are left out; settings of tuned rows are compared separately.
    """
    lines = [vars(attempt) | {"ok": attempt.ok, "tuned": attempt.tuned} for attempt in attempts]
    columns = [*Attempt.__dataclass_fields__, "ok", "tuned"]
    frame = pd.DataFrame(lines, columns=columns, dtype=object).sort_values(["started", "final"])
    frame = frame.astype(dict.fromkeys(("start", "final", "cost", "waited", "seconds"), float))
    frame = frame.astype({"ok": bool, "tuned": bool}).assign(
        timed=~(frame["waited"] > MAX_WAIT_FRACTION),
        machine=frame["cpu"] + "; " + frame["device"] + "; " + frame["threads"].map(str) + "; " + frame["kernels"],
    )
    counts = frame.drop_duplicates([*KEY, "row", "settings"]).groupby(["set", "tuned", "settings"]).size()
    usual = {key[:2]: key[2] for key in counts.sort_values(kind="stable").index}  # the last is the most frequent
    keys = zip(frame["set"], frame["tuned"], frame["settings"], strict=True)
    return frame.loc[np.array([usual[of_set, tuned] == settings for of_set, tuned, settings in keys], dtype=bool)]


def unit_row(runs: pd.DataFrame) -> str:
    """The row that costs are relative to: DIST at its default settings; empty if there is none."""
    rows = sorted({*runs.loc[(runs["preset"] == UNIT) & ~runs["tuned"], "row"]})
    label = choice("renderer", UNIT).get("_label_")
    return label if label in rows else next(iter(rows), "")


def compared(everything: pd.DataFrame, size: str = "quick") -> pd.DataFrame:
    """The newest attempt of each row on the problems and seeds that all complete rows have.

    A row is complete if it has the problems of that size of the suite, or all of DIST's if these are fewer. Other rows
    stay in the frame, but are not compared.

    Args:
        everything: the result of `frame_of`.

    Returns:
        A line per attempt with further columns: `missing`, the number of problems that its row lacks; `complete`;
        `unit`, the cost of DIST's run, or the median in its set if that run failed; `initial` and `reference`, the
        errors that progress is measured between; and `has_progress`, whether progress is defined.
    """
    runs = everything.drop_duplicates([*KEY, "row"], keep="last")
    keys = pd.Series([*zip(*(runs[name] for name in KEY), strict=True)], runs.index, dtype=object)
    rows = {row: {*group} for row, group in keys.groupby(runs["row"])}
    reachable = rows.get(unit_row(runs), {*keys})
    needed = problems_of(size) if problems_of(size) <= reachable else reachable
    missing = runs["row"].map({row: len(needed - problems) for row, problems in rows.items()})
    runs = runs.assign(missing=missing, complete=(missing == 0) & ~runs["tuned"])
    common = reachable.intersection(*(rows[row] for row in runs.loc[runs["complete"], "row"].unique()))
    return _with_errors(runs[keys.isin(common)].reset_index(drop=True))


def _with_errors(runs: pd.DataFrame) -> pd.DataFrame:
    def at_problem(values: pd.Series) -> pd.Series:
        index = pd.MultiIndex.from_frame(runs[values.index.names])
        return pd.Series(values.reindex(index).to_numpy(dtype=float), runs.index)

    finite = runs[np.isfinite(runs["start"])]
    sound = finite[finite["ok"] | ~finite.groupby(KEY)["ok"].transform("any")]  # those that ended ok, if any
    least = runs[~runs["tuned"]].groupby(["set", "problem"])["final"].min().clip(lower=MIN_LOG_ERROR)
    stated = [_reference(*line) for line in zip(runs["set"], runs["problem"], runs["scene"], strict=True)]
    paid = runs[runs["ok"] & (runs["cost"] > 0)]
    units = paid[paid["row"] == unit_row(runs)].groupby(KEY)["cost"].median()
    usual = units.groupby("set").median().combine_first(paid.groupby("set")["cost"].median())
    runs = runs.assign(
        initial=at_problem(sound.groupby(KEY)["start"].median()),
        reference=pd.Series(stated, runs.index, dtype=float).fillna(at_problem(least)),
        unit=at_problem(units).fillna(runs["set"].map(usual)).fillna(1.0),
    )
    possible = (runs["initial"] > runs["reference"]) & (runs["reference"] > 0)
    return runs.assign(has_progress=possible & ~runs["set"].isin(SETS_WITHOUT_CURVE))


def _reference(of_set: str, problem: str, scene: str) -> float | None:
    """The reference error that the suite states; None if the least final error of all rows is used."""
    errors = suite().references.get(of_set, {})
    return errors.get(problem, errors.get(scene, errors.get("all")))


def progress_curve(run: Any) -> tuple[np.ndarray, np.ndarray]:
    """The costs of a run's checkpoints relative to the unit, and the progress at each."""
    if not run.ok:
        return np.zeros(1), np.zeros(1)
    curve = np.array(run.curve)
    left = np.log(np.maximum(curve[:, 2], MIN_LOG_ERROR) / run.reference) / np.log(run.initial / run.reference)
    return curve[:, 0] / run.unit, 1 - np.clip(left, 0, 1)


def with_progress(runs: pd.DataFrame) -> pd.DataFrame:
    """The attempts with defined progress, and their progress in each outcome.

    Progress is interpolated between checkpoints, and constant after the end of a run.

    Returns:
        A line per attempt with the columns `OUTCOMES`; `BUDGET_checkpoints`, the number of checkpoints within each of
        `BUDGETS`; and `at_1_next`, the larger of `at_1` and the progress at the first checkpoint after it.
    """
    runs, lines = runs[runs["has_progress"]].reset_index(drop=True), []
    for run in runs.itertuples():
        costs, progress = progress_curve(run)
        line = {name: np.interp(min(budget, costs[-1]), costs, progress) for name, budget in BUDGETS.items()}
        line[AREA] = np.interp(AREA_COSTS, costs, progress).mean()
        for name, budget in BUDGETS.items():
            certain = budget == inf or not run.ok  # the end, or the progress of a failed run: 0
            line[f"{name}_checkpoints"] = MIN_CHECKPOINTS if certain else (costs <= budget).sum()
        line[f"{AT_1}_next"] = max(line[AT_1], progress[min((costs <= 1).sum(), len(costs) - 1)])
        lines.append(line)
    columns = [*OUTCOMES, *(f"{name}_checkpoints" for name in BUDGETS), f"{AT_1}_next"]
    return runs.join(pd.DataFrame(lines, runs.index, columns, dtype=float))


def rows_with_few_checkpoints(runs: pd.DataFrame, budget: str) -> set[str]:
    """The rows whose median number of checkpoints within a budget is below `MIN_CHECKPOINTS` in some set."""
    counts = runs.groupby(["row", "set"])[f"{budget}_checkpoints"].median().groupby("row").min()
    return {*counts[counts < MIN_CHECKPOINTS].index}


@dataclass(frozen=True)
class Ranking:
    """The progress of rows in one outcome, and which of them differ significantly.

    Args:
        progress: the mean over sets of the mean over problems, by row, the largest first.
        better: the significant pairs, the row with more progress first.
        pairs: the number of all pairs.
        least_p: the least p value of all pairs; 1 without pairs.
        scenes: the number of scenes, the units of the test.
    """

    progress: dict[str, float]
    better: set[tuple[str, str]]
    pairs: int
    least_p: float
    scenes: int

    @property
    def decidable(self) -> bool:
        """Whether this number of scenes can show any difference."""
        return self.pairs > 0 and self.scenes >= shapes_needed(self.pairs, ALPHA)

    def rank(self, row: str) -> str:
        """The ranks that a row can have, such as 1–4, simultaneous at 95 % (Mogstad et al. 2024)."""
        above, below = (sum(pair[position] == row for pair in self.better) for position in (1, 0))
        return "–".join(dict.fromkeys((str(1 + above), str(len(self.progress) - below))))


def ranking(runs: pd.DataFrame, outcome: str) -> Ranking:
    """Ranks rows that have the same problems by an outcome.

    The signs of scenes' differences are flipped, with Holm's step-down correction over all pairs of rows.
    """
    scores = by_scene(runs, outcome)
    first, second = np.triu_indices(scores.shape[1], 1)
    differences = scores.to_numpy()[:, first] - scores.to_numpy()[:, second]
    pairs, p_values = zip(scores.columns[first], scores.columns[second], strict=True), flips.p_values(differences)
    significant = zip(pairs, differences.sum(axis=0), statistics.holm(p_values, ALPHA), strict=True)
    better = {pair if difference > 0 else pair[::-1] for pair, difference, sure in significant if sure}
    progress = scores.sum().sort_values(ascending=False, kind="stable")
    return Ranking(progress.to_dict(), better, len(first), p_values.min(initial=1.0), len(scores))


def by_scene(runs: pd.DataFrame, outcome: str) -> pd.DataFrame:
    """What each scene [scenes, rows] contributes to a row's mean over sets of the mean over problems."""
    sizes = runs.groupby(["set", "row"]).size().groupby("set").max()
    shares = runs.assign(share=runs[outcome] / runs["set"].map(sizes) / max(len(sizes), 1))
    return shares.pivot_table(index="scene", columns="row", values="share", aggfunc="sum")


def bounds(runs: pd.DataFrame, of_set: str) -> tuple[float, float] | None:
    """The bounds of the mean final errors of all rows relative to DIST's in a set, without rows that mostly failed.

    The means are geometric, over scenes, see `flips.bounds`. None if the set has too few scenes.
    """
    runs = runs[runs["set"] == of_set]
    runs = runs[runs.groupby("row")["ok"].transform("mean") >= 0.5]
    errors = np.log(runs["final"].where(runs["ok"], runs["initial"]).clip(lower=MIN_LOG_ERROR))
    table = errors.groupby([runs["scene"], runs["row"]]).mean().unstack("row")
    ratios = table.drop(columns=unit_row(runs), errors="ignore").sub(table.get(unit_row(runs)), axis=0)
    ends = flips.bounds(ratios.to_numpy(), ALPHA)
    return ends and (float(np.exp(ends[0])), float(np.exp(ends[1])))


def timed(runs: pd.DataFrame, everything: pd.DataFrame) -> pd.DataFrame:
    """The attempts on problems on which all rows were timed on a machine that also timed DIST's run.

    Returns:
        Their lines. `unit` and `unit_seconds` are of DIST's newest run on that machine with the newest kernels.
        `at_seconds` is the progress at DIST's seconds, `at_seconds_checkpoints` is as in `with_progress`.
    """
    units = everything[(everything["row"] == unit_row(runs)) & everything["timed"] & everything["ok"]]
    units = units[units["kernels"].isin(units["kernels"].iloc[-1:])].drop_duplicates([*KEY, "machine"], keep="last")
    units = units[[*KEY, "machine", "cost", "seconds"]].rename(columns={"cost": "unit", "seconds": "unit_seconds"})
    pairs = runs[runs["timed"]].drop(columns="unit").merge(units, on=[*KEY, "machine"])
    rows = pairs.groupby(KEY)["row"].transform("nunique")
    pairs, lines = pairs[rows == runs["row"].nunique()].reset_index(drop=True), []
    for run in pairs.itertuples():
        seconds, progress = np.array(run.curve)[:, 1] if run.ok else np.zeros(1), progress_curve(run)[1]
        count = (seconds <= run.unit_seconds).sum() if run.ok else MIN_CHECKPOINTS
        lines.append((np.interp(run.unit_seconds, seconds, progress), count))
    return pairs.join(pd.DataFrame(lines, pairs.index, [AT_SECONDS, f"{AT_SECONDS}_checkpoints"], dtype=float))


def costs(runs: pd.DataFrame, pairs: pd.DataFrame) -> pd.DataFrame:
    """The total costs of runs that ended ok, relative to DIST's on the same problems.

    Args:
        pairs: the result of `timed`.

    Returns:
        By set and row, the medians over scenes of the ratios of `evaluations` and of `seconds`, and the number of
        `scenes`. They are of the timed pairs; with too few timed scenes, the evaluations are of all runs, without
        seconds.
    """
    scenes, lines = pairs.groupby("set")["scene"].nunique(), []
    enough = scenes.index[scenes >= statistics.MIN_SHAPES]
    chosen = pd.concat([runs[~runs["set"].isin(enough)], pairs[pairs["set"].isin(enough)]])
    for key, group in chosen[chosen["ok"] & (chosen["cost"] > 0) & (chosen["unit"] > 0)].groupby(["set", "row"]):
        seconds = _ratio(group, "seconds", "unit_seconds") if key[0] in enough else None
        lines.append([*key, _ratio(group, "cost", "unit"), seconds, group["scene"].nunique()])
    return pd.DataFrame(lines, columns=["set", "row", "evaluations", "seconds", "scenes"]).set_index(["set", "row"])


def _ratio(runs: pd.DataFrame, *columns: str) -> Interval:
    groups = [group for _, group in runs.groupby("scene")]
    return statistics.ratio(*([group[name].to_numpy(float) for group in groups] for name in columns))


def wrong_pixels(runs: pd.DataFrame) -> pd.Series:
    """The mean fraction of an object's pixels that each row renders wrongly; 1 for a failed run."""
    rendered = runs[runs["set"].isin(SETS_WITHOUT_CURVE) & (runs["initial"] > 0)]
    return (rendered["final"] / rendered["initial"]).clip(upper=1).groupby(rendered["row"]).mean()
