"""The claims of DIST and of DVR, each as a ratio of two errors or costs of measured runs, with a verdict by rule."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd

from bench.report.study import Result, Runs, Selection, compare, format, statistics, table

PLACE = 5
EXPERIMENTS = ("table1_large", "table2", "table3", "fig5", "fig10", "fig12", "dvr_table1", "dvr_table2")
CONDITIONS = tuple(
    f"task.{name}" for name in ("points", "focal", "start_scale", "similarity", "degrees", "shift", "scale")
)
READS = tuple(Selection(name, CONDITIONS, setup=()) for name in EXPERIMENTS)
SHAPE = ["family", "solid"]
PAPERS_FAMILIES = ("sofa", "plane", "table")  # of DIST, Table 2
SAME = 1.25  # a ratio between this and its inverse is called the same
SMALLER, EQUAL, NO_LARGER = "smaller", "equal", "no larger"  # what a claim says of its ratio: than 1, to 1
Settings = Mapping[str, str]  # of a run, as text; a run with others, of an older version too, is not read
CLAMPED = {"renderer.step_clamp": "0.1"}  # as the rows of DIST's Table 1 are now
LONG = {"task.images.views": "72", "task.optimiser.iterations": "180"}  # as the paper's photographs are
FIRST = {**LONG, "task.focal": "1.0", "task.start_scale": "1.0"}
PLACED = {**LONG, "task.degrees": "0.0", "task.shift": "0.0", "task.scale": "1.0"}
UNREAD = "needs runs of this version's settings: the command makes them"


@dataclass(frozen=True)
class Claim:
    """A claim of a paper.

    Args:
        source: the paper, and its table, figure or section.
        text: the claim.
        published: the paper's ratio; None where it gives no number.
        experiment: whose runs measure it; empty where nothing does.
        command: the experiment that makes them, where it has another name.
        top, bottom: presets of the rows whose ratio is taken.
        metric: an error or a cost, of which less is better.
        expected: SMALLER than 1, EQUAL to it, or NO_LARGER.
        of_top, of_bottom: settings of the runs of `top` and, where they differ from these, of `bottom`.
        families: of shapes; empty for all.
        test: of this project's own, which checks it and fails where it does not hold; else empty.
        why: the cause where the claim is not found to hold, or what a measurement needs.
    """

    source: str
    text: str
    published: float | None = None
    experiment: str = ""
    top: str = ""
    bottom: str = ""
    metric: str = "chamfer_l2"
    expected: str = SMALLER
    of_top: Settings = field(default_factory=dict)
    of_bottom: Settings | None = None
    families: tuple[str, ...] = ()
    command: str = ""
    test: str = ""
    why: str = ""


def _dense(top: str, text: str, why: str) -> Claim:
    ratios = [4.12 / 5.37, 2.18 / 3.71, 5.37 / 12.93]
    claim = Claim("DIST, Table 2", text, _mean(ratios), "table2", top, "deepsdf_truncated")
    return replace(claim, of_top={"task.points": "dense"}, families=PAPERS_FAMILIES, why=why)


def _mean(ratios: list[float]) -> float:
    return float(statistics.geometric_mean(np.array(ratios)))


TWENTY = {"of_top": {"task.points": "20"}, "families": PAPERS_FAMILIES}
CARS = ("car",)  # of DVR, Table 1: 0.196 by RGB, 0.179 by depth, 0.181 by 3D supervision
SEEN, COST = "seen_chamfer_l1", "queries"
GPU = "needs a GPU"
CLAIMS = (
    Claim(
        "DIST, Table 1", "aggressive marching saves field evaluations", 1.43 / 1.99, "table1_large", "dist_aggressive",
        "dist_dynamic", COST, of_top=CLAMPED,
    ),
    Claim(
        "DIST, Table 1", "coarse to fine saves further evaluations", 887 / 1430, "table1_large", "dist_coarse_to_fine",
        "dist_aggressive", COST, of_top=CLAMPED,
    ),
    Claim(
        "DIST, Table 1", "100 steps cost as many evaluations as 50", 898 / 887, "table1_large",
        "dist_coarse_to_fine_100", "dist_coarse_to_fine", COST, EQUAL, CLAMPED,
    ),
    Claim("DIST, B.2", "2048 x 2048 pixels fit on one graphics card", why=GPU),
    _dense(
        "dist_mask_paper", "dense depth: DIST, as printed, is better than DeepSDF",
        "of the changes tried, 300 iterations (as DeepSDF's samples have; here 100) and the official code's mask loss "
        "have the lowest ratios: see `as_printed`",
    ),
    _dense(
        "dist_mask_official", "the same, with the official code's mask loss",
        "DIST has 100 iterations, DeepSDF's samples 300: see `as_printed`",
    ),
    Claim(
        "DIST, Table 2", "20 points and mask: DIST, as printed, is better than DeepSDF",
        _mean([4.94 / 7.63, 3.60 / 5.39, 7.62 / 15.77]), "table2", "dist_mask_paper", "deepsdf_truncated", **TWENTY,
    ),
    Claim(
        "DIST, Table 2", "20 points: the mask helps", _mean([4.94 / 6.95, 3.60 / 5.30, 7.62 / 15.83]), "table2",
        "dist_mask_paper", "dist_depth_paper", **TWENTY,
    ),
    Claim(
        "DIST, Table 3", "from random codes, DIST is better than PMO", _mean([0.919 / 1.187, 1.595 / 6.124]),
        "table3", "multiview_paper", "multiview_mesh_long", "chamfer_gt_to_pred", of_top=LONG,
    ),
    Claim(
        "DIST, Fig. 5", "aggressive marching does not impair the result", None, "fig5", "dist_aggressive",
        "dist_dynamic", expected=NO_LARGER,
    ),
    Claim(
        "DIST, Fig. 5", "nor does coarse to fine", None, "fig5", "dist_coarse_to_fine", "dist_aggressive",
        expected=NO_LARGER,
    ),
    Claim(
        "DIST, Fig. 10", "our test of it: half the focal length", None, "fig10", "multiview_paper", "multiview_paper",
        "chamfer_gt_to_pred", NO_LARGER, {**FIRST, "task.focal": "0.5"}, FIRST, command="fig10_focal",
    ),
    Claim(
        "DIST, Fig. 10", "our test of it: twice the noise in the initial code", None, "fig10", "multiview_paper",
        "multiview_paper", "chamfer_gt_to_pred", NO_LARGER, {**FIRST, "task.start_scale": "2.0"}, FIRST,
        command="fig10_start",
    ),
    Claim(
        "DIST, Fig. 12", "a similarity that is 20 degrees off can be optimised with the shape", None, "fig12",
        "multiview_paper", "multiview_paper", "chamfer_gt_to_pred", NO_LARGER, {**PLACED, "task.degrees": "20.0"},
        PLACED,
    ),
    Claim(
        "DIST, Sec. 4.2", "it generalises to other data sets and to real depth",
        why="needs depth images of shapes outside of the prior's family",
    ),
    Claim("DVR, Eqs. 8 and 11", "the gradient of the depth is exact", test="test_the_implicit_gradient_is_exact"),
    Claim("DVR, Sec. 3.3", "memory does not depend on n", test="test_what_a_step_keeps_does_not_grow_with_n"),
    Claim(
        "DVR, Table 1", "cars: RGB does about as well as 3D supervision", 0.196 / 0.181, "dvr_table1",
        "single_view_dvr_rgb", "single_view_occupancy", "chamfer_l1", NO_LARGER, families=CARS,
        why="0.01 % of the paper's rays: it does not beat the mean shape",
    ),
    Claim(
        "DVR, Table 1", "cars: depth does better than RGB", 0.179 / 0.196, "dvr_table1", "single_view_dvr_depth",
        "single_view_dvr_rgb", "chamfer_l1", families=CARS,
    ),
    Claim(
        "DVR, Sec. 4.1.2", "one image of each training shape suffices",
        why="needs a training that beats the mean shape: hundreds of times the rays",
    ),
    Claim("DVR, Fig. 7", "RGB alone passes the visual hull", None, "dvr_table2", "dvr_paper", "hull", SEEN),
    Claim(
        "DVR, Table 2", "RGB is better than stereo with trim 5 (not trim 7)", 0.907 / 1.091, "dvr_table2", "dvr_paper",
        "stereo_5", SEEN,
    ),
    Claim("DVR, Table 2", "depth improves on RGB", 0.782 / 0.907, "dvr_table2", "dvr_paper_depth", "dvr_paper", SEEN),
    Claim(
        "DVR, Table 2", "on DTU's photographs, in mm",
        why="needs DTU's data: `+experiment=photos dataset.truth=DTU`",
    ),
)  # fmt: skip
COLUMNS = (
    *(table.text("source", "Paper"), table.text("claim", "Claim"), table.Column("published", "Published ratio")),
    *(*table.estimate("ratio", "Measured ratio"), table.Column("shapes", "Shapes"), table.text("verdict", "Verdict")),
    *(table.text("why", "Cause, or what it needs"), table.text("command", "Command, or test")),
)
NOTES = (
    "A ratio is a median over shapes, with the interval of the sign test at 95 %; below six shapes there is none. It "
    "is of errors or, in Table 1, of field evaluations, of the two rows that the claim compares. A shape on which both "
    "fail is left out. The published ratio is of the numbers that the paper prints, as a geometric mean over families.",
    "A claim of a smaller error “holds” where the interval lies below 1 and the effect has at least half of the "
    "published size in the logarithm. It is “weaker” where the effect is less. It “does not hold” where the interval "
    "lies above 1.",
    f"A claim of equality “holds” where the interval lies between {1 / SAME:.2f} and {SAME}. One of no larger an error "
    f"“holds” where it lies below {SAME}. Beyond these ends, they do “not hold”. All else is “not decided”. Below six "
    "shapes the direction alone is named.",
    "No correction for the number of claims is made: each is a question of its own.",
)


def make(*read: Runs | None) -> Result:
    """A line per claim."""
    of: dict[str, Runs | None] = dict(zip(EXPERIMENTS, read, strict=True))
    first = next(runs for runs in read if runs is not None)
    lines = [_line(claim, of.get(claim.experiment)) for claim in CLAIMS]
    verdicts = [line["verdict"].split(",")[0] for line in lines]
    counts = {verdict: verdicts.count(verdict) for verdict in dict.fromkeys(verdicts)}
    return Result(
        first,
        "Claims of DIST and DVR.",
        "Ratios of two rows' errors or costs, beside the paper's. Each line has its number of shapes; the sample named "
        "next is that of the first experiment alone.",
        question="Which claims of the two papers hold here?",
        verdict=f"Of {len(lines)} claims: {'; '.join(f'{name} *{count}*' for name, count in counts.items())}.",
        interval=compare.INTERVAL,
        remarks=NOTES,
        columns=COLUMNS,
        lines=lines,
    )


def _line(claim: Claim, runs: Runs | None) -> dict[str, Any]:
    ratio = None if runs is None else ratio_of(claim, runs)
    verdict = verdict_of(claim, ratio) if ratio else "holds, by a test" if claim.test else "not tested"
    explained = verdict.startswith(("holds", "as claimed"))
    return {
        **{"source": claim.source, "claim": claim.text, "published": claim.published, "ratio": ratio},
        **{"shapes": None if ratio is None else len(ratio.points), "verdict": verdict},
        "why": "" if explained else claim.why or (UNREAD if ratio is None else ""),
        "command": f"-m +experiment={claim.command or claim.experiment}" if claim.experiment else claim.test,
    }


def ratio_of(claim: Claim, runs: Runs) -> statistics.Interval | None:
    """The median over shapes of the ratio of a claim's two rows; None without a shape that both have."""
    runs = runs.made
    frame = runs.frame[[*SHAPE, "preset"]].assign(error=runs.error(claim.metric, 1))
    sides = []
    of_bottom = claim.of_top if claim.of_bottom is None else claim.of_bottom
    for preset, settings in ((claim.top, claim.of_top), (claim.bottom, of_bottom)):
        chosen = frame.preset == preset
        for key, value in settings.items():
            chosen &= runs.setting(key) == value
        if claim.families:
            chosen &= frame.family.isin(claim.families)
        errors = frame.loc[chosen].groupby(SHAPE, sort=False).error
        sides.append(errors.agg(lambda of_shape: statistics.geometric_mean(of_shape.to_numpy())))
    both = pd.concat(sides, axis=1, join="inner")
    finite = np.isfinite(both)
    both = both[finite.all(axis=1) if claim.metric == COST else finite.any(axis=1)]  # a failed run has no cost
    if both.empty:
        return None
    above, below = ([np.array([error]) for error in side] for side in both.to_numpy().T)
    return statistics.ratio(above, below)


def verdict_of(claim: Claim, ratio: statistics.Interval) -> str:
    """What a measured ratio says of a claim; the rule is the second of `NOTES`."""
    if not ratio.known:
        least, most = {SMALLER: (0, 1), EQUAL: (1 / SAME, SAME), NO_LARGER: (0, SAME)}[claim.expected]
        close = least <= ratio.value <= most
        return f"{'as claimed' if close else 'against the claim'}, {format.plural(len(ratio.points), 'shape')}"
    if claim.expected != SMALLER:
        least = 1 / SAME if claim.expected == EQUAL else 0
        apart = ratio.low > SAME or ratio.high < least
        inside = least <= ratio.low and ratio.high <= SAME
        return "does not hold" if apart else "holds" if inside else "not decided"
    if ratio.high < 1:
        return "holds" if claim.published is None or ratio.value <= math.sqrt(claim.published) else "weaker"
    return "does not hold" if ratio.low > 1 else "not decided"


PAGES = {"claims": make}
