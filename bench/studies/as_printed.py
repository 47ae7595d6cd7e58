"""The paper's setting of shape completion (DIST), one change at a time."""

from bench.report.study import Result, Runs, Selection, compare

PLACE = 22
READS = (Selection("as_printed", ("task.points",), may_differ=("prior.truncation",)),)
REFERENCE = "as_printed"
NOTES = (
    "“Both”: the truncated prior with clamped steps. All rows of DIST also march aggressively, as the page "
    "`truncation` explains. The clamp and the mean of the squared code are from the official code. The paper does not "
    "give the average of its silhouette loss (Eq. 11); we take the mean over all pixels.",
    "DIST has 100 iterations. DeepSDF's samples have 300, and settings that were chosen on validation shapes.",
    "“Neither”, “clamp alone”, “DIST with mask” and “DeepSDF samples” use the prior that is not truncated.",
    "In DIST, Table 2, dense, the errors are 0.77 (sofas), 0.59 (planes) and 0.42 (tables) times DeepSDF's errors.",
)


def make(runs: Runs) -> Result:
    """A line per family and row, with the ratio to the paper's setting."""
    compared = compare.Compared(runs, lambda _: REFERENCE)
    return compared.result(
        "The paper's setting of DIST on dense depth, one change at a time.",
        "Which part of the paper's setting causes its error?",
        verdict=compared.differing("to the paper's setting"),
        remarks=(compare.ERROR, f"{compare.RATIO} {compare.FAILURE}", *NOTES),
        columns=[column for column in compared.columns("Ratio to the paper's setting") if column.key != "dense"],
    )


PAGES = {"as_printed": make}
