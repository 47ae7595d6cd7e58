"""What tuning is worth: the expected test error of the best of some drawn settings."""

from typing import Any

from matplotlib.figure import Figure

from bench.report.study import Result, Runs, chart, compare, format, statistics, table
from bench.report.tuning import TUNING, Tuning, left_out, tunings, unfinished

PLACE = 36
READS = (TUNING,)
NOTES = (
    "Every method has the same number of Sobol draws from its own search space (`space` of its row in "
    "conf/methods.yaml), even in the logarithm of each setting, and is judged on the same shapes.",
    "The draw with the smallest geometric mean of errors on the validation shapes is taken; the expectation is over "
    "all choices of so many of the draws.",
    f"{compare.CHAMFER} A run that did not end ok has the largest finite error of any draw of any method on its shape; "
    "of two draws that with fewer failures is better. Validation runs: {validation} per draw; test runs: {test} per "
    "draw.",
    "The interval is over test shapes, for these draws and this choice: other draws and shapes would add to it.",
)
RUNS = (
    *(table.FAMILY, table.configured("split", "split"), table.configured("draw", "draw"), *table.IDENTITY),
    *(*table.metrics("chamfer_l2", "chamfer_l1", "mask_iou"), *table.LOOP),
)
Line = dict[str, Any]  # of a method, with the expected error by the number of draws as `curve`


def make(runs: Runs) -> Result:
    """A line per method: the expected test error at each number of draws."""
    methods = [method for method in tunings(runs) if method.test_runs]
    lines = [_line(method) for method in methods]
    budgets = sorted({k for line in lines for k in line["curve"]})
    return Result(
        runs,
        "What tuning is worth.",
        "Median of the test errors, if the best of so many drawn settings on the validation shapes is taken; "
        "evaluations are medians of runs that ended ok.",
        question="What is tuning worth?",
        verdict=format.ends(
            f"Error of the best of {max(budgets, default=0)} draws over that of one draw",
            {line["method"]: line["worth"] and line["worth"].value for line in lines},
            f"{len({run[0] for method in methods for run in method.test_runs})} test shapes",
        ),
        interval="95 % intervals over test shapes (of the sign test)",
        estimates=[found for line in lines for found in line["curve"].values()],
        remarks=_notes(runs, methods),
        columns=[
            table.text("method", "Method"),
            *(table.text("", f"Best of {k}", lambda line, k=k: line["curve"].get(k)) for k in budgets),
            table.text("worth", "Best over one draw"),
            table.Column("evaluations", "Evaluations of the best", show=format.count),
            table.text("failed", "Failed"),
        ],
        lines=lines,
        run_columns=RUNS,
        figure=draw(lines),
    )


def _line(method: Tuning) -> Line:
    """Its curve, and the error of the best of all draws over that of one draw as `worth`; None for one draw."""
    most = max(method.budgets)
    worth = statistics.ratio(method.expected(most), method.expected(1)) if most > 1 else None
    return {
        **{"method": method.label, "preset": method.method, "failed": f"{method.failed} of {method.runs}"},
        **{"evaluations": method.evaluations[method.best], "worth": worth},
        "curve": {k: statistics.typical(method.expected(k)) for k in method.budgets},
    }


def _notes(runs: Runs, methods: list[Tuning]) -> list[str]:
    if not methods:
        return ["No draw has a run that ended on every shape, of every method."]
    waiting = unfinished(runs)
    told = f"{waiting} planned runs have not ended: draws and shapes that some method lacks are left out."
    sizes = {"validation": methods[0].validation.shape[1], "test": len(methods[0].test_runs)}
    return [*(note.format(**sizes) for note in NOTES), *([told] if waiting else []), *left_out(runs, methods)]


def draw(lines: list[Line]) -> Figure:
    """Draws a line per method: the expected test error over the number of draws, with its interval."""
    drawn = [chart.curve(line["method"], line["preset"], line["curve"], line["curve"].values()) for line in lines]
    label = "number of drawn settings, the best of which is taken"
    panel = chart.panel_data("", label, compare.LABEL, drawn)
    return chart.draw([panel], 3.2, legend=2, width=4.6)


PAGES = {"tuning": make}
