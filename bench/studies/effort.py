"""`effort=needed`: no more rays, iterations and precision than a scene needs, against a fixed effort."""

from dataclasses import replace

from bench.records.format import number
from bench.report.study import Result, Runs, Selection, compare, statistics

PLACE = 23
READS = (Selection("effort"),)
NOTES = (
    compare.ERROR,
    f"{compare.RATIO} {compare.FAILURE}",
    "`effort=needed` holds out a tenth of the pixels. Each iteration compares a random pixel of blocks of 4 x 4 "
    "pixels, then of 2 x 2, then all: the next, and then the end, when the loss of the held-out pixels stops falling. "
    "The true shape is not used. A renderer with an epsilon has half a pixel (`renderer.epsilon=auto`).",
    "`ends=held_out` and `epsilon=auto` are the two parts of it. The other rows have all pixels in each of 100 "
    "iterations, or of 60.",
    "Field evaluations are of points whose value was computed, also of the held-out pixels. In the verdict, a gradient "
    "counts as two.",
)


PAIRS = {"dist_needed": "dist_all_pixels", "newton_needed": "newton_mask", "idr_needed": "idr_mask"}  # with less effort


def make(runs: Runs) -> Result:
    """Errors and costs of completions with and without `effort=needed`, relative to DIST with a fixed effort."""
    page = compare.Comparison(
        title="Depth completion with no more effort than a scene needs.",
        question="Does a completion need all pixels, 100 iterations and the default precision?",
        reference="dist_all_pixels",
        name="DIST",
        notes=lambda _: NOTES,
    )
    return replace(page(runs), verdict=_verdict(compare.Compared(runs, page.reference)))


def _verdict(compared: compare.Compared) -> str:
    """The ratios of errors and of field evaluations that `effort=needed` has for each renderer."""
    rows = {row.preset: row for row in compared.rows}
    present = [pair for pair in PAIRS.items() if rows.keys() >= {*pair}]
    gaps = [compared.gap(compare.ALL_FAMILIES, rows[less], rows[more]) for less, more in present]
    ratios = [gap.ratio for gap in gaps if gap is not None]
    words = {statistics.Verdict.DIFFERS: ", a significant difference", statistics.Verdict.NOT_DECIDABLE: ", undecided"}
    parts = []
    for pair, ratio, verdict in zip(present, ratios, statistics.ratio_verdicts(ratios), strict=True):
        costs = [compared.runs.number("evaluations_cost")[compared.runs.frame.preset == preset] for preset in pair]
        cost = number(costs[0].median() / costs[1].median())
        name = rows[pair[1]].name.removesuffix(" with mask")
        parts.append(f"{name} needs *{cost} times* the field evaluations, error {ratio} times{words.get(verdict, '')}")
    shapes = f"; n = {len(ratios[0].points)} shapes. An error ratio above 1 is worse." if ratios else ""
    return f"With `effort=needed`, {'; '.join(parts)}{shapes}" if parts else ""


PAGES = {"effort": make}
