"""A page of claims of papers, each as a ratio of two errors or costs of measured runs, with a verdict by rule."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from bench.records import format
from bench.report import compare
from bench.report.data import curves, statistics
from bench.report.data.runs import NoFolder, Runs, merge_runs
from bench.report.write import table
from bench.report.write.result import Result

SHAPE = ["family", "solid"]
MAX_SAME_RATIO = 1.25  # a ratio between this and its inverse is called the same; papers have no such margin
SMALLER, NO_LARGER = (0.0, 1.0), (0.0, MAX_SAME_RATIO)  # the ratios that a claim allows
RunSettings = Mapping[str, float | str | bool]  # only runs with these settings are read
NO_RUNS = "needs runs with the settings of this version: use the command"
SEEN_ERROR, COST, DISORDER = "seen_chamfer_l1", "queries", "1 - ρ"
COLUMNS = (
    *(*table.columns(table.word, source="Paper", claim="Claim"), table.Column("published", "Published ratio")),
    *(*table.estimate("ratio", "Measured ratio"), table.Column("shapes", "Shapes")),
    *table.columns(table.word, families="Families", verdict="Verdict", why="Possible cause, or what is missing"),
    table.text("command", "Command, or test"),
)
RULES = (
    "A ratio compares the errors of two rows, or their field evaluations. It is a median over shapes without those "
    "where both rows failed. The 95 % interval of the sign test needs six shapes. The published ratio is the ratio of "
    "the paper's numbers, as a geometric mean over families.",
    "A claim of a smaller error “holds” if the interval is below 1, and “does not hold” if it is above 1. An interval "
    "may show less than half of the published effect on a log scale. Then the verdict is “weaker” if the interval is "
    "below 1, and “less than half the effect” if it contains 1.",
    f"A claim of no larger error allows ratios up to {MAX_SAME_RATIO}. This margin is ours. The claim “holds” if the "
    "interval is below it. “Larger (size not decided)”: the interval is above 1 and contains the margin.",
    "With fewer than six shapes, the verdict only states whether the median is as claimed. All other cases are “not "
    "decided”.",
    "Each claim is a separate question, so there is no correction for the number of claims.",
)
CHECKED, UNTESTED, AS_CLAIMED = "checked by a test", "not tested", "as claimed"


@dataclass(frozen=True)
class Claim:
    """A claim of a paper."""

    source: str  # the paper, and its table, figure or section
    text: str
    published: Callable[[], float] | None = None  # the paper's ratio; None if it gives no number
    experiment: str = ""  # whose runs measure it; empty if it is not measured
    top: str = ""  # the preset of the upper row
    bottom: str = ""  # the preset of the lower row; empty: the metric of `top` itself
    metric: str = "chamfer_l2"  # an error, a cost or `DISORDER`; less is better
    expected: tuple[float, float] = SMALLER  # the least and the largest ratio that the claim allows
    top_settings: RunSettings = field(default_factory=dict)  # of the runs of `top`
    bottom_settings: RunSettings | None = None  # of the runs of `bottom`; None: the same
    families: tuple[str, ...] = ()  # of shapes; empty for all
    command: str = ""  # the experiment that makes the runs, if it is another one
    test: str = ""  # a test of this project that fails if the claim does not hold
    why: str = ""  # the cause if the claim does not hold here, or what a measurement needs


def page(
    claims: Sequence[Claim], runs: Mapping[str, Runs | None], title: str, question: str, notes: Sequence[str]
) -> Result:
    lines = [_line(claim, runs.get(claim.experiment)) for claim in claims]
    return Result(
        merge_runs(*runs.values()),
        title,
        "Measured and published ratios of the errors or costs of two rows. A failed run has an infinite error.",
        question=question,
        verdict=_verdict([line["verdict"] for line in lines]),
        n=f"{sum(line['shapes'] is not None for line in lines)} measured claims; the table has the shapes of each",
        interval=compare.INTERVAL,
        remarks=notes,
        columns=[column for column in COLUMNS if column.key != "published" or any(line["published"] for line in lines)],
        lines=lines,
    )


def _verdict(verdicts: list[str]) -> str:
    kinds = [verdict.split(",")[0] for verdict in verdicts]
    tested = {kind: kinds.count(kind) for kind in dict.fromkeys(kinds) if kind not in (CHECKED, UNTESTED)}
    holds, few = tested.pop("holds", 0), tested.pop(AS_CLAIMED, 0)
    on_few = f"; {few} are as claimed on few shapes, without a test" if few else ""
    verb = "holds" if holds == 1 else "hold"
    measured = f"*{holds}* of {holds + few + sum(tested.values())} measured comparisons {verb}{on_few}."
    others = f"Verdicts of the others: {', '.join(f'“{kind}” {count}' for kind, count in tested.items())}."
    others = others if tested else ""
    checked = format.plural(kinds.count(CHECKED), "claim")
    untested = kinds.count(UNTESTED)
    rest = f"Tests of this project check {checked}, and {untested} {'is' if untested == 1 else 'are'} not tested."
    return " ".join(filter(None, [measured, others, rest]))


def _line(claim: Claim, runs: Runs | None) -> dict[str, Any]:
    pairs = None if runs is None else pairs_of(claim, runs)
    above_and_below = [] if pairs is None else [[np.array([x]) for x in side] for side in pairs.to_numpy().T]
    ratio = statistics.ratio(*above_and_below) if above_and_below else None
    verdict = verdict_of(claim, ratio) if ratio else CHECKED if claim.test else UNTESTED
    needs = claim.why.startswith("needs")
    explained = verdict.startswith(("holds", AS_CLAIMED, CHECKED)) or (ratio is not None and needs)
    return {
        **{"source": claim.source, "claim": claim.text, "published": claim.published and claim.published()},
        **{"ratio": ratio, "shapes": None if pairs is None else len(pairs), "verdict": verdict},
        "families": "" if pairs is None else ", ".join(pairs.index.unique("family")),
        "why": "" if explained else claim.why if ratio is not None or needs else NO_RUNS,
        "command": f"-m +experiment={claim.command or claim.experiment}" if claim.experiment else claim.test,
    }


def pairs_of(claim: Claim, runs: Runs) -> pd.DataFrame | None:
    """The errors of a claim's two rows on each common shape; None without a common shape."""
    runs = runs.executed
    try:
        if claim.metric == DISORDER:  # of a run; nan if it has too few iterations
            folders = [runs.folder(record) for record in runs.records]
            histories = [curves.read(folder)[0].dropna(subset=["total", "chamfer_l2"]) for folder in folders]
            rhos = [curves.spearman(history, "total", "chamfer_l2") for history in histories]
            error = 1 - pd.Series(rhos, runs.frame.index, dtype=float)
        else:
            error = runs.error(claim.metric, 1)
    except NoFolder:
        return None
    frame = runs.frame[[*SHAPE, "preset"]].assign(error=error)
    sides = []
    bottom_settings = claim.top_settings if claim.bottom_settings is None else claim.bottom_settings
    for preset, settings in ((claim.top, claim.top_settings), (claim.bottom or claim.top, bottom_settings)):
        chosen = (frame.preset == preset) & frame.error.notna()
        for key, value in settings.items():
            chosen &= runs.setting(key).map(_as_number) == _as_number(str(value))
        if claim.families:
            chosen &= frame.family.isin(claim.families)
        errors = frame.loc[chosen].groupby(SHAPE, sort=False).error
        sides.append(errors.agg(lambda shape: statistics.geometric_mean(shape.to_numpy())))
    pairs = pd.concat(sides if claim.bottom else [sides[0], 0 * sides[0] + 1], axis=1, join="inner")
    finite = np.isfinite(pairs)
    pairs = pairs[finite.all(axis=1) if claim.metric == COST else finite.any(axis=1)]  # a failed run has no cost
    return None if pairs.empty else pairs


def _as_number(text: str) -> float | str:
    """A setting as a number, so that 20 and 20.0 are equal; unchanged if it is no number."""
    try:
        return float(text)
    except ValueError:
        return text


def verdict_of(claim: Claim, ratio: statistics.Interval) -> str:
    least, most = claim.expected
    if not ratio.has_ends:
        as_claimed = least <= ratio.value <= most
        return f"{AS_CLAIMED if as_claimed else 'against the claim'}, {format.plural(len(ratio.points), 'shape')}"
    if ratio.low > most:
        return "does not hold"
    if claim.expected != SMALLER:
        return "holds" if ratio.high <= most else "larger (size not decided)" if ratio.low > 1 else "not decided"
    if claim.published is not None and ratio.low > math.sqrt(claim.published()):
        return "weaker" if ratio.high < most else "less than half the effect"
    return "holds" if ratio.high < most else "not decided"
