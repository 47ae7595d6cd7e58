"""The claims of DIST and of DVR, each as a ratio of two errors or costs of measured runs, with a verdict by rule."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial, reduce
from operator import getitem
from typing import Any

import numpy as np
import pandas as pd

from bench.records.published import DVR_TABLE2
from bench.report.data.runs import NoFolder
from bench.report.study import (
    Result,
    Runs,
    Selection,
    compare,
    curves,
    format,
    merge_runs,
    published,
    statistics,
    table,
)

PLACE = 5
EXPERIMENTS = ("table1_large", "table2_claims", "table3", "fig5", "fig10", "fig12", "dvr_table1", "dvr_table2")
CONDITIONS = (
    *(f"task.{name}" for name in ("points", "focal", "start_scale", "similarity", "degrees", "shift", "scale")),
    "task.training.seed",
)
OF_ROWS = ("prior.truncation", "view.resolution", "field")  # a claim names rows that compare
READS = tuple(Selection(name, CONDITIONS, setup=(), may_differ=OF_ROWS) for name in EXPERIMENTS)
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
POWERS = {ord("K"): "e3", ord("M"): "e6"}


@dataclass(frozen=True)
class Claim:
    """A claim of a paper.

    Args:
        source: the paper, and its table, figure or section.
        text: the claim.
        published: returns the paper's ratio; None where it gives no number.
        experiment: name of the experiment whose runs measure it; empty if it is not measured.
        command: name of the experiment that makes the runs, if it is another one.
        top, bottom: presets of the rows whose ratio is computed; without `bottom`, the metric of `top` itself.
        metric: an error, a cost or `DISORDER`; less is better.
        expected: the least and the largest ratio that the claim allows.
        top_settings, bottom_settings: settings of the runs of `top` and of `bottom`; None: the same.
        families: families of shapes; empty for all.
        test: name of a test of this project that fails if the claim does not hold; else empty.
        why: the cause if the claim does not hold here, or what a measurement needs.
    """

    source: str
    text: str
    published: Callable[[], float] | None = None
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


def _ratio(name: str, top: Sequence[str], bottom: Sequence[str], families: Sequence[str] = ("",)) -> float:
    """The ratio of two published numbers of a table by their keys, as a geometric mean over families."""
    paths = [[[family, *keys] if family else keys for keys in (top, bottom)] for family in families]
    numbers = [[float(reduce(getitem, keys, published(name)).translate(POWERS)) for keys in path] for path in paths]
    return float(statistics.geometric_mean(np.array([above / below for above, below in numbers])))


def _table1(text: str, top: str, bottom: str, expected: tuple[float, float] = SMALLER) -> Claim:
    ratio = partial(_ratio, "dist_table1", (top, "queries"), (bottom, "queries"))
    return Claim("DIST, Table 1", text, ratio, "table1_large", top, bottom, COST, expected, CLAMPED)


def _table2(points: str, top: str, bottom: str, text: str, why: str) -> Claim:
    keys = [(PUBLISHED_ROWS.get(row, "DIST with mask"), points) for row in (top, bottom)]
    ratio = partial(_ratio, "dist_table2", *keys, DIST_TABLE2_FAMILIES)
    settings = {"top_settings": {"task.points": points}, "families": DIST_TABLE2_FAMILIES, "why": why}
    return Claim("DIST, Table 2", text, ratio, "table2_claims", top, bottom, **settings)


# Rows of other presets are "DIST with mask".
PUBLISHED_ROWS = {"deepsdf_official": "DeepSDF", "dist_depth_paper": "DIST"}
MASK_LOSS = (
    "likely the mask loss: with the official one, average and sign together, the error is smaller; the effect of the "
    "average alone is not decided (page as_printed)"
)
ITERATIONS = "perhaps the number of iterations: with 300, the error is smaller (page as_printed)"
CARS = ("car",)
SEEN_ERROR, COST, DISORDER = "seen_chamfer_l1", "queries", "1 - ρ"
CLAIMS = (
    _table1("aggressive marching saves field evaluations (both rows clamped)", "dist_aggressive", "dist_dynamic"),
    _table1("coarse-to-fine marching saves more field evaluations", "dist_coarse_to_fine", "dist_aggressive"),
    _table1(
        "100 steps take about as many field evaluations as 50", "dist_coarse_to_fine_100", "dist_coarse_to_fine",
        NO_LARGER,
    ),
    Claim("DIST, B.2", "an image of 2048 x 2048 pixels fits on one GPU", why="needs a GPU"),
    _table2(
        "dense", "dist_mask_paper", "deepsdf_official",
        "dense depth: DIST is better than DeepSDF (paper's setting)", MASK_LOSS,
    ),
    _table2(
        "dense", "dist_mask_official", "deepsdf_official",
        "dense depth: DIST is better than DeepSDF (official code's mask loss)", ITERATIONS,
    ),
    _table2(
        "dense", "dist_mask", "deepsdf_official",
        "dense depth: DIST is better than DeepSDF (our setting, not the paper's)", "not known",
    ),
    _table2(
        "20", "dist_mask_paper", "deepsdf_official",
        "20 points and mask: DIST is better than DeepSDF (paper's setting)", MASK_LOSS,
    ),
    _table2(
        "20", "dist_mask_official", "deepsdf_official",
        "20 points and mask: DIST is better than DeepSDF (official code's mask loss)", "not known",
    ),
    _table2(
        "20", "dist_mask", "deepsdf_official",
        "20 points and mask: DIST is better than DeepSDF (our setting, not the paper's)", "not known",
    ),
    _table2(
        "20", "dist_mask_paper", "dist_depth_paper", "20 points: the mask helps (paper's setting)", MASK_LOSS
    ),
    _table2(
        "20", "dist_mask_official", "dist_depth_paper",
        "20 points: the mask helps (official code's mask loss)", "",
    ),
    *(
        Claim(
            "DIST, Table 3", f"from random codes, DIST is better than PMO ({what})",
            partial(_ratio, "dist_table3", ["DIST, random start"], ["PMO, random start"], ("car", "plane")),
            "table3", "multiview_paper", row, "chamfer_gt_to_pred", top_settings=PAPER_VIEWS, bottom_settings={},
        )
        for row, what in (
            ("multiview_mesh_long", "here a mesh, also with 72 views and 180 iterations, which raise its error"),
            ("multiview_mesh", "here a mesh with the 24 views and 60 iterations that suit it better"),
        )
    ),
    Claim(
        "DIST, Fig. 5", f"loss and error are tightly correlated (our test: 1 - ρ is at most {1 - curves.HIGH_RHO:.1f})",
        None, "fig5", "dist_coarse_to_fine", metric=DISORDER, expected=(0.0, 1 - curves.HIGH_RHO),
        why="needs the run folders, because rows do not have the curves",
    ),
    Claim(
        "DIST, Fig. 5", "aggressive marching does not impair the result", None, "fig5", "dist_aggressive",
        "dist_dynamic", expected=NO_LARGER,
    ),
    Claim(
        "DIST, Fig. 5", "coarse to fine does not impair the result", None, "fig5", "dist_coarse_to_fine",
        "dist_aggressive", expected=NO_LARGER, why="not known",
    ),
    Claim(
        "DIST, Fig. 10", "robust to the focal length (our test: half of it)", None, "fig10", "multiview_paper",
        "multiview_paper", "chamfer_gt_to_pred", NO_LARGER, {**FIG10, "task.focal": 0.5}, FIG10,
        command="fig10_focal",
        why="at half the focal length, the object has a quarter of the pixels; pixels alone were not varied",
    ),
    Claim(
        "DIST, Fig. 10", "robust to noise in the initial code (our test: twice the noise)", None, "fig10",
        "multiview_paper", "multiview_paper", "chamfer_gt_to_pred", NO_LARGER,
        {**FIG10, "task.start_scale": 2.0}, FIG10, command="fig10_start",
    ),
    Claim(
        "DIST, Fig. 12", "position, rotation and size can be optimised too (our test: 20 degrees off, over 0 degrees)",
        None, "fig12",        "multiview_paper", "multiview_paper", "chamfer_gt_to_pred", NO_LARGER,
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
        "DVR, Table 1", "cars: RGB supervision is about as good as ONet's 3D supervision",
        partial(_ratio, "dvr_table1", ["DVR, RGB"], ["ONet (3D)"], CARS), "dvr_table1",
        "single_view_dvr_long", "single_view_occupancy", "chamfer_l1", NO_LARGER, families=CARS,
        why="the length of the training: an eighth of the steps has a larger error (page dvr_length)",
    ),
    Claim(
        "DVR, Table 1", "cars: depth is a better supervision than RGB",
        partial(_ratio, "dvr_table1", ["DVR, depth"], ["DVR, RGB"], CARS), "dvr_table1",
        "single_view_dvr_depth", "single_view_dvr_rgb", "chamfer_l1", families=CARS,
    ),
    Claim(
        "DVR, Sec. 4.1.2", "one RGB-D image of each training shape suffices", lambda: 0.410 / 0.383, "dvr_table1",
        "single_view_dvr_one", "single_view_dvr_depth", "chamfer_l1", NO_LARGER,
    ),
    Claim(
        "DVR, Fig. 7", "RGB alone has a smaller error than the visual hull", None, "dvr_table2", "dvr_paper", "hull",
        SEEN_ERROR,
    ),
    Claim(
        "DVR, Table 2", "RGB is better than stereo with trim 5 (not trim 7)",
        lambda: DVR_TABLE2["DVR (RGB)"][-1] / DVR_TABLE2["Colmap + sPSR, trim 5"][-1], "dvr_table2", "dvr_paper",
        "stereo_5", SEEN_ERROR,
    ),
    Claim(
        "DVR, Table 2", "depth improves on RGB",
        lambda: DVR_TABLE2["DVR (RGB and depth)"][-1] / DVR_TABLE2["DVR (RGB)"][-1],
        "dvr_table2", "dvr_paper_depth", "dvr_paper", SEEN_ERROR,
    ),
    Claim(
        "DVR, Table 2", "errors in mm on DTU's photographs",
        why="needs DTU's data: `+experiment=photos dataset.truth=DTU`",
    ),
)  # fmt: skip
COLUMNS = (
    *(*table.columns(table.word, source="Paper", claim="Claim"), table.Column("published", "Published ratio")),
    *(*table.estimate("ratio", "Measured ratio"), table.Column("shapes", "Shapes")),
    *table.columns(table.word, families="Families", verdict="Verdict", why="Possible cause, or what is missing"),
    table.text("command", "Command, or test"),
)
RULES = (
    "A ratio compares the errors of two rows, or their field evaluations. It is a median over shapes without those "
    "where both rows failed. The 95 % interval of the sign test needs six shapes. The published ratio is of the "
    "paper's numbers, as a geometric mean over families.",
    "A claim of a smaller error “holds” if the interval is below 1, and “does not hold” if it is above 1. If the "
    "interval shows less than half of the published effect, on a log scale, the verdict is “weaker” if it is below 1, "
    "and “less than half the effect” if it contains 1.",
    f"A claim of no larger error allows ratios up to {MAX_SAME_RATIO}. This margin is ours. The claim “holds” if the "
    "interval is below it. “Larger (size not decided)”: the interval is above 1 and contains the margin.",
    "Each claim is a separate question, so there is no correction for the number of claims.",
)
NOTES = (
    *RULES,
    "ρ is Spearman's rank correlation of loss and Chamfer distance over the iterations of a run. Its limit of "
    f"{curves.HIGH_RHO} is ours.",
    "With fewer than six shapes, the verdict only states whether the median is as claimed. The algorithm nearly "
    "determines the counts of DIST, Table 1: one shape shows their size. All other cases are “not decided”.",
    "In DIST, Table 2, all rows of DIST have the paper's 100 iterations and weights. DeepSDF's row has 800 iterations, "
    "the rate and the weight of its official code, true normals, and samples 0.02 scene units from the surface.",
)
CHECKED, UNTESTED, AS_CLAIMED = "checked by a test", "not tested", "as claimed"


def make(*sources: Runs | None) -> Result:
    """A line for each claim of DIST and DVR."""
    question = "Which claims of the DIST and DVR papers hold in our measurements?"
    return page(CLAIMS, dict(zip(EXPERIMENTS, sources, strict=True)), "Claims of DIST and DVR.", question, NOTES)


def page(
    claims: Sequence[Claim], runs: Mapping[str, Runs | None], title: str, question: str, notes: Sequence[str]
) -> Result:
    """A page with a line for each claim, from the runs of each experiment."""
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
        columns=COLUMNS,
        lines=lines,
    )


def _verdict(verdicts: list[str]) -> str:
    kinds = [verdict.split(",")[0] for verdict in verdicts]
    tested = {kind: kinds.count(kind) for kind in dict.fromkeys(kinds) if kind not in (CHECKED, UNTESTED)}
    holds, few = tested.pop("holds", 0), tested.pop(AS_CLAIMED, 0)
    measured = (
        f"*{holds}* of {holds + few + sum(tested.values())} measured comparisons hold; {few} are as claimed on few "
        "shapes, without a test."
    )
    others = f"Others: {'; '.join(f'{kind} {count}' for kind, count in tested.items()) or 'none'}."
    rest = f"Tests of this project check {kinds.count(CHECKED)} claims, and {kinds.count(UNTESTED)} are not tested."
    return f"{measured} {others} {rest}"


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
        error = _disorder(runs) if claim.metric == DISORDER else runs.error(claim.metric, 1)
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


def _disorder(runs: Runs) -> pd.Series:
    """1 - ρ of loss and error over the iterations of each run; nan if a run has too few."""
    histories = [curves.read(runs.folder(record))[0].dropna(subset=["total", "chamfer_l2"]) for record in runs.records]
    rhos = [curves.spearman(history, "total", "chamfer_l2") for history in histories]
    return 1 - pd.Series(rhos, runs.frame.index, dtype=float)


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
        return f"{AS_CLAIMED if as_claimed else 'against the claim'}, {format.plural(len(ratio.points), 'shape')}"
    if ratio.low > most:
        return "does not hold"
    if claim.expected != SMALLER:
        return "holds" if ratio.high <= most else "larger (size not decided)" if ratio.low > 1 else "not decided"
    if claim.published is not None and ratio.low > math.sqrt(claim.published()):
        return "weaker" if ratio.high < most else "less than half the effect"
    return "holds" if ratio.high < most else "not decided"


PAGES = {"claims": make}
