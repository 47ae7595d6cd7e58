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
    "pixels, then of 2 x 2, then all others: the next when the loss of the held-out pixels stops falling. The last ten "
    "iterations compare all pixels. The true shape is not used. A renderer with an epsilon has half a pixel.",
    "Two rows have its two parts: `epsilon=auto`, and `effort=needed` with the default epsilon. The other rows compare "
    "all pixels in each of 100 iterations, or of 60.",
    "Field evaluations are of points whose value was computed, also of the held-out pixels. In the verdict, a gradient "
    "counts as two.",
)


PAIRS = {
    "dist_needed": "dist_all_pixels",
    "newton_needed": "newton_mask",
    "idr_needed": "idr_mask",
}  # rows with effort=needed, and with effort=full


def make(runs: Runs) -> Result:
    """Errors and costs of completions with and without `effort=needed`, relative to DIST with a fixed effort."""
    page = compare.Comparison(
        title="Depth completion with no more effort than a scene needs.",
        question="Does a completion need all pixels, 100 iterations and the default precision?",
        reference="dist_all_pixels",
        name="DIST, effort=full",
        notes=lambda _: NOTES,
    )
    return replace(page(runs), verdict=_verdict(compare.Compared(runs, page.reference)))


def _verdict(compared: compare.Compared) -> str:
    """The ratios of errors and of field evaluations that `effort=needed` has for each renderer."""
    rows, parts = {row.preset: row for row in compared.rows}, []
    gaps = {
        less: compared.gap(compare.ALL_FAMILIES, rows[less], rows[more])
        for less, more in PAIRS.items()
        if rows.keys() >= {less, more}
    }
    ratios = {less: gap.ratio for less, gap in gaps.items() if gap is not None}
    words = {statistics.Verdict.DIFFERS: ", a significant difference", statistics.Verdict.NOT_DECIDABLE: ", undecided"}
    costs = compared.runs.frame.assign(cost=compared.runs.number("evaluations_cost"))
    costs = costs[costs.status == "ok"].pivot_table(index=["family", "solid", "seed"], columns="preset", values="cost")
    for (less, ratio), verdict in zip(ratios.items(), statistics.ratio_verdicts([*ratios.values()]), strict=True):
        cost, shapes = number((costs[less] / costs[PAIRS[less]]).median()), len(ratio.points)
        name = rows[PAIRS[less]].name.removesuffix(" with mask").removesuffix(", effort=full")
        text = f"{name} needs *{cost} times* the field evaluations, error {ratio} times (n = {shapes} shapes)"
        parts.append(f"{text}{words.get(verdict, '')}")
    return f"With effort=needed, {'; '.join(parts)}. An error ratio above 1 is worse." if parts else ""


PAGES = {"effort": make}
