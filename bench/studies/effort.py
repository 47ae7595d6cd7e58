"""`effort=needed`: no more rays, iterations and precision than a scene needs, against a fixed effort."""

from bench.report.study import Result, Runs, Selection, compare

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
    "Field evaluations are of points whose value was computed, also of the held-out pixels.",
)


def make(runs: Runs) -> Result:
    """Errors and costs of completions with and without `effort=needed`, relative to DIST with a fixed effort."""
    page = compare.Comparison(
        title="Depth completion with no more effort than a scene needs.",
        question="Does a completion need all pixels, 100 iterations and the default precision?",
        reference="dist_all_pixels",
        name="DIST",
        notes=lambda _: NOTES,
    )
    return page(runs)


PAGES = {"effort": make}
