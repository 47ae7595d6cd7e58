"""DIST's own setting of shape completion, one change at a time, over DeepSDF's samples on the same prior."""

from bench.report.study import Result, Runs, Selection, compare

PLACE = 22
READS = (Selection("as_printed", ("task.points",)),)
REFERENCE = {False: "deepsdf", True: "deepsdf_truncated"}  # by whether a row has the truncated prior
PLAIN = ("as_printed_neither", "as_printed_clamp", "dist_mask")  # rows on the prior of distances
NOTES = (
    "“As printed” has, beside the text, the official code's clamp and its mean over the squared code. DIST has 100 "
    "iterations; DeepSDF's samples have 300, with numbers that were chosen on validation shapes.",
    "A ratio is over DeepSDF's samples on the same prior: the truncated one, or that of distances for “neither”, "
    "“clamp alone” and “DIST with mask”.",
    "DIST, Table 2, dense, has the ratios 0.77 (sofas), 0.59 (planes) and 0.42 (tables), with DeepSDF's own prior.",
)


def make(runs: Runs) -> Result:
    """A line per family and row, with the ratio to DeepSDF's samples on the same prior."""
    found = compare.Compared(runs, lambda preset: REFERENCE[preset not in (*PLAIN, "deepsdf")])
    return found.result(
        "DIST's own setting on dense depth, one change at a time.",
        "To what is the error of DIST's own setting due?",
        verdict=found.best("errors × 1000"),
        remarks=(
            found.differing("to DeepSDF's samples"),
            compare.ERROR,
            f"{compare.RATIO} {compare.FAILURE}",
            *NOTES,
        ),
        columns=[column for column in found.columns("Ratio to DeepSDF's samples") if column.key != "dense"],
    )


PAGES = {"as_printed": make}
