"""Each method at its defaults, tuned, and at its paper's setting, side by side."""

from bench.report.study import Result, Runs, Selection, compare, table
from bench.report.tuning import TUNED

PLACE = 38
READS = (Selection("tuned", ("task.points",)),)
PAPERS = ("_paper", "_official")  # ends of the names of presets with a paper's setting
NOTES = (
    compare.ERROR,
    f"{compare.RATIO} {compare.FAILURE}",
    "Tuned rows were chosen on validation shapes by `python -m bench.tune`, at desk on sofas and planes from 20 "
    "points: other families and numbers of points are not what they were tuned for.",
    "In the figure filled points are tuned.",
)
RUNS = (table.FAMILY, table.configured("points", "task", "points"), *table.COMPLETION, *table.LOOP)


def default_of(preset: str) -> str:
    """The preset of which another is the tuned or the paper's setting."""
    name = preset.removeprefix(TUNED)
    return next((name.removesuffix(end) for end in PAPERS if name.endswith(end)), name)


def make(runs: Runs) -> Result:
    """A line per family and row: medians, and the ratio to the method's defaults."""
    found = compare.Compared(runs, default_of)
    lines = [line for line in found.lines if line["family"] in found.families]
    tuned = [line for line in lines if line["preset"].startswith(TUNED)]
    ratios = [(f"{line['row']} on {line['family']}", compare.ratio_of(line["ratio"])) for line in tuned]
    return found.result(
        "Methods at their defaults, tuned, and at their papers' settings.",
        "Are our defaults as good as tuned settings?",
        ratio="Ratio to the default",
        verdict=compare.differing(ratios, "of tuned settings to the defaults"),
        remarks=NOTES,
        lines=lines,
        run_columns=RUNS,
        filled=lambda preset: preset.startswith(TUNED),
    )


PAGES = {"tuned": make}
