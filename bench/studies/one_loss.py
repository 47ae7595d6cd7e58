"""Every renderer under one loss of the mask and at one tuned setting: errors, ratios to DIST, error over cost."""

from bench.report.study import Result, Runs, Selection, compare, records

PLACE = 21
READS = (Selection("one_loss", ("task.points",)),)
NOTES = (
    compare.ERROR,
    f"{compare.RATIO} {compare.FAILURE}",
    "On a front no other row has less error for less cost; a bound of range analysis counts as three field values.",
    "Under this loss a renderer is its hits, their distances and the least value along each ray: the relaxed boundary "
    "is IDR with more steps, and what these two differ by is close to the noise of the fits.",
    "Rates and weights are the best draw over some of the methods on validation shapes (`python -m bench.tune`).",
)
SETTINGS = {
    "learning rate": ("task", "optimiser", "learning_rate"),
    "iterations": ("task", "optimiser", "iterations"),
    "depth weight": ("task", "depth_weight"),
    "mask weight": ("task", "silhouette_weight"),
    "code weight": ("task", "code", "weight"),
}


def make(runs: Runs) -> Result:
    """A line per family and row, all families first."""
    return compare.Compared(runs, lambda _: "dist_mask").result(
        "Every renderer under one loss, at one tuned setting.",
        "How do all renderers compare under one loss and one setting?",
        ratio="Ratio to DIST",
        remarks=(*NOTES, records.shared_settings(runs.records, SETTINGS)),
    )


PAGES = {"one_loss": make}
