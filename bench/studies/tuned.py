"""Each method at its defaults, tuned, and at its paper's setting, side by side."""

from bench.report.compare import ERROR, FAILURE, RATIO, Compared, excluding_one
from bench.report.data.runs import Runs, Selection
from bench.report.write.result import Result
from bench.report.write.table import COMPLETION, FAMILY, LOOP, configured, to_data, to_table

PLACE = 38
READS = (Selection("tuned", ("task.points",)),)
FOLDER = "tuned/"  # of the presets that `python -m bench.tune` writes
PAPERS = ("_paper", "_official")  # ends of the names of presets with a paper's setting
NOTES = (
    f"{RATIO} {FAILURE}",
    "Tuned rows were chosen on validation shapes by `python -m bench.tune`, at desk on sofas and planes from 20 "
    "points: other families and numbers of points are not what they were tuned for.",
    "In the figure filled points are tuned.",
)
RUNS = (FAMILY, configured("points", "task", "points"), *COMPLETION, *LOOP)


def default_of(preset: str) -> str:
    """The preset of which another is the tuned or the paper's setting."""
    name = preset.removeprefix(FOLDER)
    return next((name.removesuffix(end) for end in PAPERS if name.endswith(end)), name)


def make(runs: Runs) -> Result:
    """A line per family and row: medians, and the ratio to the method's defaults."""
    found = Compared(runs, default_of)
    lines = [line for line in found.lines if line["family"] in found.families]
    tuned = [
        (f"{line['row']} on {line['family']}", line["ratio"]) for line in lines if line["preset"].startswith(FOLDER)
    ]
    return found.result(
        "Methods at their defaults, tuned, and at their papers' settings.",
        "Are our defaults as good as tuned settings?",
        verdict=excluding_one(tuned, "of tuned settings to the defaults"),
        remarks=(ERROR, *NOTES),
        data=to_data(RUNS, runs.records),
        figure=found.draw_front(filled=lambda preset: preset.startswith(FOLDER)),
        table=to_table(found.columns("Ratio to the default"), lines),
    )


PAGES = {"tuned": make}
