"""The claims of DIST and of DVR, each as a ratio of two errors or costs of measured runs, with a verdict by rule."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
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
DIST_TABLE2_FAMILIES = ("sofa", "plane", "table")
MAX_SAME_RATIO = 1.25  # a ratio between this and its inverse is called the same; the paper has no such margin
SMALLER, NO_LARGER = (0.0, 1.0), (0.0, MAX_SAME_RATIO)  # the ratios that a claim allows
RunSettings = Mapping[str, float | str | bool]  # only runs with these settings are read
CLAMPED = {"renderer.step_clamp": 0.1}  # both rows, as in the official code
PAPER_VIEWS = {"task.images.views": 72, "task.optimiser.iterations": 180}  # as many photographs as in the paper
FIG10 = {**PAPER_VIEWS, "task.focal": 1.0, "task.start_scale": 1.0}
FIG12 = {**PAPER_VIEWS, "task.similarity": True, "task.degrees": 0.0, "task.shift": 0.0, "task.scale": 1.0}
NO_RUNS = "needs runs with the settings of this version: use the command"


@dataclass(frozen=True)
class Claim:
    """A claim of a paper.

    Args:
        source: the paper, and its table, figure or section.
        text: the claim.
        published: the paper's ratio; None where it gives no number.
        experiment: name of the experiment whose runs measure it; empty if it is not measured.
        command: name of the experiment that makes the runs, if it is another one.
        top, bottom: presets of the rows whose ratio is computed.
        metric: an error or a cost; less is better.
        expected: the least and the largest ratio that the claim allows.
        top_settings, bottom_settings: settings of the runs of `top` and of `bottom`; None: the same.
        families: families of shapes; empty for all.
        test: name of a test of this project that fails if the claim does not hold; else empty.
        why: the cause if the claim does not hold here, or what a measurement needs.
    """

    source: str
    text: str
    published: float | None = None
    experiment: str = ""
    top: str = ""
    bottom: str = ""
    metric: str = "chamfer_l2"
    expected: tuple[float, float] = SMALLER
    top_settings: RunSettings = field(default_factory=dict)
    bottom_settings: RunSettings | None = None
    families: tuple[str, ...] = ()
    command: str = ""
    test: str = ""
    why: str = ""


def _table2(points: str, ratios: list[float], top: str, bottom: str, text: str, why: str) -> Claim:
    settings = {"top_settings": {"task.points": points}, "families": DIST_TABLE2_FAMILIES, "why": why}
    return Claim("DIST, Table 2", text, _mean(ratios), "table2", top, bottom, **settings)


def _mean(ratios: list[float]) -> float:
    return float(statistics.geometric_mean(np.array(ratios)))


DENSE = [4.12 / 5.37, 2.18 / 3.71, 5.37 / 12.93]  # DIST with mask over DeepSDF
TWENTY = [4.94 / 7.63, 3.60 / 5.39, 7.62 / 15.77]
TWENTY_MASK = [4.94 / 6.95, 3.60 / 5.30, 7.62 / 15.83]  # over DIST without the mask
AVERAGE = "the paper does not give the average of its silhouette loss; we take the mean over all pixels (`as_printed`)"
ITERATIONS = "DIST has 100 iterations here, DeepSDF 300 (`as_printed`)"
CARS = ("car",)  # DVR, Table 1: 0.196 with RGB, 0.179 with depth, 0.181 with 3D supervision
SEEN_ERROR, COST = "seen_chamfer_l1", "queries"
CLAIMS = (
    Claim(
        "DIST, Table 1", "aggressive marching saves field evaluations (both rows clamped)", 1.43 / 1.99, "table1_large",
        "dist_aggressive", "dist_dynamic", COST, top_settings=CLAMPED,
    ),
    Claim(
        "DIST, Table 1", "coarse-to-fine marching saves more field evaluations", 887 / 1430, "table1_large",
        "dist_coarse_to_fine", "dist_aggressive", COST, top_settings=CLAMPED,
    ),
    Claim(
        "DIST, Table 1", "100 steps take about as many field evaluations as 50", 898 / 887, "table1_large",
        "dist_coarse_to_fine_100", "dist_coarse_to_fine", COST, NO_LARGER, CLAMPED,
    ),
    Claim("DIST, B.2", "an image of 2048 x 2048 pixels fits on one GPU", why="needs a GPU"),
    _table2(
        "dense", DENSE, "dist_mask_paper", "deepsdf_truncated",
        "dense depth: DIST is better than DeepSDF (paper's setting)", AVERAGE,
    ),
    _table2(
        "dense", DENSE, "dist_mask_official", "deepsdf_truncated",
        "dense depth: DIST is better than DeepSDF (official code's mask loss)", ITERATIONS,
    ),
    _table2(
        "20", TWENTY, "dist_mask_paper", "deepsdf_truncated",
        "20 points and mask: DIST is better than DeepSDF (paper's setting)", AVERAGE,
    ),
    _table2(
        "20", TWENTY, "dist_mask_official", "deepsdf_truncated",
        "20 points and mask: DIST is better than DeepSDF (official code's mask loss)", ITERATIONS,
    ),
    _table2(
        "20", TWENTY_MASK, "dist_mask_paper", "dist_depth_paper", "20 points: the mask helps (paper's setting)", AVERAGE
    ),
    _table2(
        "20", TWENTY_MASK, "dist_mask_official", "dist_depth_paper",
        "20 points: the mask helps (official code's mask loss)", "",
    ),
    Claim(
        "DIST, Table 3", "from random codes, DIST is better than PMO", _mean([0.919 / 1.187, 1.595 / 6.124]),
        "table3", "multiview_paper", "multiview_mesh_long", "chamfer_gt_to_pred", top_settings=PAPER_VIEWS,
        why="needs runs of the method `multiview_mesh_long` with 72 views and 180 iterations",
    ),
    Claim(
        "DIST, Fig. 5", "aggressive marching does not impair the result", None, "fig5", "dist_aggressive",
        "dist_dynamic", expected=NO_LARGER,
    ),
    Claim(
        "DIST, Fig. 5", "coarse to fine does not impair the result", None, "fig5", "dist_coarse_to_fine",
        "dist_aggressive", expected=NO_LARGER,
    ),
    Claim(
        "DIST, Fig. 10", "robust to the focal length (our test: half of it)", None, "fig10", "multiview_paper",
        "multiview_paper", "chamfer_gt_to_pred", NO_LARGER, {**FIG10, "task.focal": 0.5}, FIG10, command="fig10_focal",
    ),
    Claim(
        "DIST, Fig. 10", "robust to noise in the initial code (our test: twice the noise)", None, "fig10",
        "multiview_paper", "multiview_paper", "chamfer_gt_to_pred", NO_LARGER,
        {**FIG10, "task.start_scale": 2.0}, FIG10, command="fig10_start",
    ),
    Claim(
        "DIST, Fig. 12", "a wrong initial rotation is corrected (our test: 20 degrees)", None, "fig12",
        "multiview_paper", "multiview_paper", "chamfer_gt_to_pred", NO_LARGER,
        {**FIG12, "task.similarity": False, "task.degrees": 20.0}, FIG12,  # a misplaced run always optimises it
    ),
    Claim(
        "DIST, Sec. 4.2", "DIST generalises to another data set and to real photographs",
        why="needs photographs with cameras of a class that has a prior",
    ),
    Claim("DVR, Eqs. 8 and 11", "the gradient of the depth is exact", test="test_the_implicit_gradient_is_exact"),
    Claim(
        "DVR, Sec. 1", "memory of the backward pass does not depend on n (samples per ray)",
        test="test_dvr_memory_does_not_grow_with_samples",
    ),
    Claim(
        "DVR, Table 1", "cars: RGB supervision is about as good as ONet's 3D supervision", 0.196 / 0.181, "dvr_table1",
        "single_view_dvr_rgb", "single_view_occupancy", "chamfer_l1", NO_LARGER, families=CARS,
        why="our training is much shorter; its error cannot be distinguished from the error of the mean shape",
    ),
    Claim(
        "DVR, Table 1", "cars: depth is a better supervision than RGB", 0.179 / 0.196, "dvr_table1",
        "single_view_dvr_depth", "single_view_dvr_rgb", "chamfer_l1", families=CARS,
    ),
    Claim(
        "DVR, Sec. 4.1.2", "one image of each training shape suffices",
        why="needs a training run with one depth image per shape",
    ),
    Claim(
        "DVR, Fig. 7", "RGB alone has a smaller error than the visual hull", None, "dvr_table2", "dvr_paper", "hull",
        SEEN_ERROR,
    ),
    Claim(
        "DVR, Table 2", "RGB is better than stereo with trim 5 (not trim 7)", 0.907 / 1.091, "dvr_table2", "dvr_paper",
        "stereo_5", SEEN_ERROR,
    ),
    Claim(
        "DVR, Table 2", "depth improves on RGB", 0.782 / 0.907, "dvr_table2", "dvr_paper_depth", "dvr_paper", SEEN_ERROR
    ),
    Claim(
        "DVR, Table 2", "errors in mm on DTU's photographs",
        why="needs DTU's data: `+experiment=photos dataset.truth=DTU`",
    ),
)  # fmt: skip
COLUMNS = (
    *(table.text("source", "Paper"), table.text("claim", "Claim"), table.Column("published", "Published ratio")),
    *(*table.estimate("ratio", "Measured ratio"), table.Column("shapes", "Shapes"), table.text("families", "Families")),
    table.text("verdict", "Verdict"),
    *(table.text("why", "Possible cause, or what is missing"), table.text("command", "Command, or test")),
)
NOTES = (
    "A ratio compares the errors of two rows, or in DIST, Table 1, their field evaluations. It is a median over shapes "
    "without those where both rows failed. The 95 % interval of the sign test needs six shapes. The published ratio is "
    "of the paper's numbers, as a geometric mean over families.",
    "A claim of a smaller error “holds” if the interval is below 1, and “does not hold” if it is above 1. If the "
    "interval shows less than half of the published effect, on a log scale, the verdict is “weaker” if it is below 1, "
    "and “less than half the effect” if it contains 1.",
    f"A claim of no larger error allows ratios up to {MAX_SAME_RATIO}. This margin is ours. The claim “holds” if the "
    "interval is below it. “Larger (size not decided)”: the interval is above 1 and contains the margin.",
    "With fewer than six shapes, the verdict only states whether the median is as claimed. The algorithm nearly "
    "determines the counts of DIST, Table 1: one shape shows their size. All other cases are “not decided”.",
    "Each claim is a separate question, so there is no correction for the number of claims.",
)
CHECKED, UNTESTED = "checked by a test", "not tested"


def make(*sources: Runs | None) -> Result:
    """A line per claim."""
    experiments: dict[str, Runs | None] = dict(zip(EXPERIMENTS, sources, strict=True))
    first = next(runs for runs in sources if runs is not None)
    lines = [_line(claim, experiments.get(claim.experiment)) for claim in CLAIMS]
    return Result(
        first,
        "Claims of DIST and DVR.",
        "Measured and published ratios of the errors or costs of two rows. A failed run has an infinite error.",
        question="Which claims of the DIST and DVR papers hold in our measurements?",
        verdict=_verdict([line["verdict"] for line in lines]),
        n=f"{sum(line['shapes'] is not None for line in lines)} measured claims; the table has the shapes of each",
        interval=compare.INTERVAL,
        remarks=NOTES,
        columns=COLUMNS,
        lines=lines,
    )


def _verdict(verdicts: list[str]) -> str:
    kinds = [verdict.split(",")[0] for verdict in verdicts]
    tested = {kind: kinds.count(kind) for kind in dict.fromkeys(kinds) if kind not in (CHECKED, UNTESTED)}
    counts = "; ".join(f"{kind} *{count}*" for kind, count in tested.items())
    rest = f"Tests of this project check {kinds.count(CHECKED)} claims, and {kinds.count(UNTESTED)} are not tested."
    return f"{sum(tested.values())} of {len(kinds)} claims are measured: {counts}. {rest}"


def _line(claim: Claim, runs: Runs | None) -> dict[str, Any]:
    ratio = None if runs is None else ratio_of(claim, runs)
    verdict = verdict_of(claim, ratio) if ratio else CHECKED if claim.test else UNTESTED
    explained = verdict.startswith(("holds", "as claimed", CHECKED))
    return {
        **{"source": claim.source, "claim": claim.text, "published": claim.published, "ratio": ratio},
        **{"shapes": None if ratio is None else len(ratio.points), "verdict": verdict},
        "families": "" if ratio is None or runs is None else ", ".join(claim.families or runs.families()),
        "why": "" if explained else claim.why or (NO_RUNS if ratio is None else ""),
        "command": f"-m +experiment={claim.command or claim.experiment}" if claim.experiment else claim.test,
    }


def ratio_of(claim: Claim, runs: Runs) -> statistics.Interval | None:
    """The median over shapes of the ratio of a claim's two rows; None without a common shape."""
    runs = runs.executed
    frame = runs.frame[[*SHAPE, "preset"]].assign(error=runs.error(claim.metric, 1))
    sides = []
    bottom_settings = claim.top_settings if claim.bottom_settings is None else claim.bottom_settings
    for preset, settings in ((claim.top, claim.top_settings), (claim.bottom, bottom_settings)):
        chosen = frame.preset == preset
        for key, value in settings.items():
            chosen &= runs.setting(key).map(_as_number) == _as_number(str(value))
        if claim.families:
            chosen &= frame.family.isin(claim.families)
        errors = frame.loc[chosen].groupby(SHAPE, sort=False).error
        sides.append(errors.agg(lambda shape: statistics.geometric_mean(shape.to_numpy())))
    pairs = pd.concat(sides, axis=1, join="inner")
    finite = np.isfinite(pairs)
    pairs = pairs[finite.all(axis=1) if claim.metric == COST else finite.any(axis=1)]  # a failed run has no cost
    if pairs.empty:
        return None
    above, below = ([np.array([error]) for error in side] for side in pairs.to_numpy().T)
    return statistics.ratio(above, below)


def _as_number(text: str) -> float | str:
    """A setting as a number, so that 20 and 20.0 are equal; unchanged if it is no number."""
    try:
        return float(text)
    except ValueError:
        return text


def verdict_of(claim: Claim, ratio: statistics.Interval) -> str:
    """The verdict of a measured ratio on a claim, by the rules in `NOTES`."""
    least, most = claim.expected
    if not ratio.has_ends:
        as_claimed = least <= ratio.value <= most
        return f"{'as claimed' if as_claimed else 'against the claim'}, {format.plural(len(ratio.points), 'shape')}"
    if ratio.low > most:
        return "does not hold"
    if claim.expected != SMALLER:
        return "holds" if ratio.high <= most else "larger (size not decided)" if ratio.low > 1 else "not decided"
    if claim.published is not None and ratio.low > math.sqrt(claim.published):
        return "weaker" if ratio.high < most else "less than half the effect"
    return "holds" if ratio.high < most else "not decided"


PAGES = {"claims": make}
