"""The claims of DIST and of DVR, each as a ratio of two errors or costs of measured runs, with a verdict by rule."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd

from bench.report.study import Result, Runs, Selection, compare, format, statistics, table

PLACE = 5
EXPERIMENTS = ("table1", "table2", "table3", "fig5", "fig10", "fig12", "dvr_table1", "dvr_table2")
CONDITIONS = (
    "task.points",
    "task.focal",
    "task.start_scale",
    "task.similarity",
    "task.degrees",
    "task.shift",
    "task.scale",
)
READS = tuple(Selection(name, CONDITIONS, setup=()) for name in EXPERIMENTS)
SHAPE = ["family", "solid"]
PAPERS_FAMILIES = ("sofa", "plane", "table")  # of DIST, Table 2
SAME = 1.25  # a ratio between this and its inverse is called the same
SMALLER, EQUAL, NO_LARGER = "smaller", "equal", "no larger"  # what a claim says of its ratio: than 1, to 1
PLAIN = {"task.similarity": ("", "False"), "task.degrees": "0.0", "task.shift": "0.0", "task.scale": "1.0"}

Settings = Mapping[str, str | tuple[str, ...]]  # of a run, as text, or several texts that will do


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
        at, over: settings of the runs of `top` and, where they differ from these, of `bottom`.
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
    at: Settings = field(default_factory=dict)
    over: Settings | None = None
    families: tuple[str, ...] = ()
    command: str = ""
    test: str = ""
    why: str = ""


def _dense(top: str, text: str, why: str) -> Claim:
    ratios = [4.12 / 5.37, 2.18 / 3.71, 5.37 / 12.93]
    known = Claim("DIST, Table 2", text, _mean(ratios), "table2", top, "deepsdf_truncated")
    return replace(known, at={"task.points": "dense"}, families=PAPERS_FAMILIES, why=why)


def _mean(ratios: list[float]) -> float:
    return float(statistics.geometric_mean(np.array(ratios)))


TWENTY = {"at": {"task.points": "20"}, "families": PAPERS_FAMILIES}
SEEN = "seen_chamfer_l1"
GPU = "needs a GPU"
CLAIMS = (
    Claim(
        "DIST, Table 1", "aggressive marching saves field evaluations", 1.43 / 1.99, "table1", "dist_aggressive",
        "dist_dynamic", "queries",
    ),
    Claim(
        "DIST, Table 1", "coarse to fine saves further evaluations", 887 / 1430, "table1", "dist_coarse_to_fine",
        "dist_aggressive", "queries",
    ),
    Claim(
        "DIST, Table 1", "100 steps cost as many evaluations as 50", 898 / 887, "table1", "dist_coarse_to_fine_100",
        "dist_coarse_to_fine", "queries", EQUAL,
    ),
    Claim("DIST, B.2", "2048 x 2048 pixels fit on one graphics card", why=GPU),
    _dense(
        "dist_mask_paper", "dense depth: DIST, as printed, is better than DeepSDF",
        "of the changes tried, more iterations and the official mask loss help most: see “one change at a time”",
    ),
    _dense("dist_mask_official", "the same, by the official code's setting", "see “one change at a time”"),
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
        "table3", "multiview_paper", "multiview_mesh", "chamfer_gt_to_pred",
        why="the mesh row moves the same prior's code, as PMO does not",
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
        "DIST, Fig. 10", "half the focal length does as well", None, "fig10", "multiview_paper", "multiview_paper",
        "chamfer_gt_to_pred", NO_LARGER, {"task.focal": "0.5"}, {"task.focal": "1.0", "task.start_scale": "1.0"},
        command="fig10_focal",
    ),
    Claim(
        "DIST, Fig. 10", "twice the noise in the initial code does as well", None, "fig10", "multiview_paper",
        "multiview_paper", "chamfer_gt_to_pred", NO_LARGER, {"task.start_scale": "2.0"},
        {"task.focal": "1.0", "task.start_scale": "1.0"},
        command="fig10_start",
    ),
    Claim(
        "DIST, Fig. 12", "a similarity can be optimised with the shape", None, "fig12", "multiview_paper",
        "multiview_paper", expected=NO_LARGER, at={"task.similarity": "True"}, over=PLAIN,
        why="pixels of the object that the shape leaves free cost nothing in Eq. 6",
    ),
    Claim(
        "DIST, Sec. 4.2", "it generalises to other data sets and to real depth",
        why="needs depth images of shapes outside of the prior's family",
    ),
    Claim("DVR, Eqs. 8 and 11", "the gradient of the depth is exact", test="test_the_implicit_gradient_is_exact"),
    Claim("DVR, Sec. 3.3", "memory does not depend on n", test="test_what_a_step_keeps_does_not_grow_with_n"),
    Claim(
        "DVR, Table 1", "RGB does about as well as 3D supervision", 1.08, "dvr_table1", "single_view_dvr_rgb",
        "single_view_occupancy", "chamfer_l1", NO_LARGER,
        why="0.01 % of the paper's rays: it does not beat the mean shape",
    ),
    Claim(
        "DVR, Table 1", "depth does better than RGB", 0.99 / 1.08, "dvr_table1", "single_view_dvr_depth",
        "single_view_dvr_rgb", "chamfer_l1",
    ),
    Claim(
        "DVR, Sec. 4.1.2", "one image of each training shape suffices",
        why="needs a training that beats the mean shape: hundreds of times the rays",
    ),
    Claim("DVR, Fig. 7", "RGB alone passes the visual hull", None, "dvr_table2", "dvr_paper", "hull", SEEN),
    Claim(
        "DVR, Table 2", "RGB is better than trimmed stereo", 0.907 / 1.091, "dvr_table2", "dvr_paper", "stereo_5",
        SEEN,
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
    "is of errors or, in Table 1, of field evaluations, of the two rows that the claim compares.",
    "A claim of a smaller error: “holds” where the interval lies below 1 and the effect has at least half of the "
    "published size in the logarithm, “weaker” where it has less, “does not hold” where the interval lies above 1.",
    f"A claim of equality, or of no larger an error: “holds” where the interval lies between {1 / SAME:.2f}, or 0, and "
    f"{SAME}, “does not hold” where it lies beyond. Else “not decided”; below six shapes the direction alone is named.",
    "No correction for the number of claims is made: each is a question of its own.",
)


def make(*read: Runs | None) -> Result:
    """A line per claim."""
    of: dict[str, Runs | None] = dict(zip(EXPERIMENTS, read, strict=True))
    known = next(runs for runs in read if runs is not None)
    lines = [_line(claim, of.get(claim.experiment)) for claim in CLAIMS]
    verdicts = [line["verdict"].split(",")[0].split(" (")[0] for line in lines]
    counts = {verdict: verdicts.count(verdict) for verdict in dict.fromkeys(verdicts)}
    return Result(
        known,
        "Claims of DIST and DVR.",
        "Ratios of two rows' errors or costs, beside the paper's.",
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
    return {
        **{"source": claim.source, "claim": claim.text, "published": claim.published, "ratio": ratio},
        **{"shapes": None if ratio is None else len(ratio.points), "verdict": verdict},
        "why": "" if verdict == "holds" else claim.why,
        "command": f"-m +experiment={claim.command or claim.experiment}" if claim.experiment else claim.test,
    }


def ratio_of(claim: Claim, runs: Runs) -> statistics.Interval | None:
    """The median over shapes of the ratio of a claim's two rows; None without a shape that both have."""
    runs = runs.made
    frame = runs.frame[[*SHAPE, "preset"]].assign(error=runs.error(claim.metric, 1))
    sides = []
    for preset, settings in ((claim.top, claim.at), (claim.bottom, claim.at if claim.over is None else claim.over)):
        chosen = frame.preset == preset
        for key, value in settings.items():
            chosen &= runs.setting(key).isin([value] if isinstance(value, str) else value)
        if claim.families:
            chosen &= frame.family.isin(claim.families)
        sides.append(
            frame.loc[chosen].groupby(SHAPE, sort=False).error.agg(lambda errors: statistics.geometric_mean(errors))
        )
    both = pd.concat(sides, axis=1, join="inner")
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
