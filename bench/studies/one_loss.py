"""Every renderer under one loss of the mask and at one tuned setting: errors, ratios to DIST, error over cost."""

from bench.report.compare import ERROR, FAILURE, RATIO, Compared, Comparison, excluding_one
from bench.report.data.runs import Runs, Selection
from bench.report.write.result import Result
from bench.report.write.table import to_data, to_table

PLACE = 21
READS = (Selection("one_loss", ("task.points",)),)
OF = Comparison(reference=lambda _: "dist_mask")
NOTES = (
    f"{RATIO} {FAILURE}",
    "On a front, filled in the figure, no other row has less error for less cost; a bound of range analysis counts as "
    "three field values.",
    "Under this loss a renderer is its hits, their distances and the least value along each ray: the relaxed boundary "
    "is IDR with more steps, and what these two differ by is close to the noise of the fits.",
    "Rates and weights, one setting for all rows, are the best draw over some of the methods on validation shapes "
    "(`python -m bench.tune`).",
)


def make(runs: Runs) -> Result:
    """A line per family and row, all families first."""
    found = Compared(runs, OF)
    sure = excluding_one([(line["row"], line["ratio"]) for line in found.pooled], "to DIST")
    columns = found.columns("Ratio to DIST")
    return Result(
        runs,
        "Every renderer under one loss, at one tuned setting.",
        "Median error at each number of given depth points, the geometric mean of all errors, and the median cost.",
        question="How do all renderers compare under one loss and one setting?",
        verdict=f"{found.best('error × 1000')} {sure}".strip(),
        interval="95 % intervals over shapes (Student's, of logarithms)",
        estimates=[line["error"] for line in found.lines],
        remarks=(ERROR, *NOTES),
        data=to_data(columns, found.lines),
        table=to_table(columns, found.lines),
        figure=found.draw_front(),
        chart=found.chart(),
    )


PAGES = {"one_loss": make}
