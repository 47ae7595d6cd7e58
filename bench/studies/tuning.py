"""What tuning is worth: the expected test error of the best of some drawn settings."""

from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report.compare import CHAMFER
from bench.report.data import statistics
from bench.report.data.runs import Runs
from bench.report.tuning import TUNING, Tuning, left_out, tunings, unfinished
from bench.report.write import chart
from bench.report.write.result import Result
from bench.report.write.table import (
    FAMILY,
    IDENTITY,
    LOOP,
    Column,
    configured,
    metrics,
    text,
    to_data,
    to_table,
)

PLACE = 36
READS = (TUNING,)
NOTES = (
    "Every method has the same number of Sobol draws from its own search space (`space` of its row in "
    "conf/methods.yaml), even in the logarithm of each setting, and is judged on the same shapes.",
    "The draw with the smallest geometric mean of errors on the validation shapes is taken; the expectation is over "
    "all choices of so many of the draws.",
    f"{CHAMFER} A run that did not end ok has the largest finite error of any draw of any method on its shape; of two "
    "draws that with fewer failures is better. Validation runs: {validation} per draw; test runs: {test} per draw.",
    "The interval is over test shapes, for these draws and this choice: other draws and shapes would add to it.",
)
RUNS = (
    *(FAMILY, configured("split", "split"), configured("draw", "draw"), *IDENTITY),
    *metrics("chamfer_l2", "chamfer_l1", "mask_iou"),
    *LOOP,
)
Curve = dict[int, statistics.Interval]  # by the number of draws


def make(runs: Runs) -> Result:
    """A line per method: the expected test error at each number of draws."""
    methods = [method for method in tunings(runs) if method.test_runs]
    curves = {method.label: {k: statistics.geometric(method.expected(k)) for k in method.budgets} for method in methods}
    budgets = sorted({k for curve in curves.values() for k in curve})
    columns = [
        text("method", "Method"),
        *(
            Column(str(k), f"Best of {k}", words=lambda line, k=k: str(line["curve"].get(k, format.MISSING)))
            for k in budgets
        ),
        *(text("worth", "Best over one draw"), Column("evaluations", "Evaluations of the best", show=format.count)),
        text("failed", "Failed"),
    ]
    worth = {method.label: _worth(method) for method in methods}
    lines = [
        {"method": method.label, "curve": curves[method.label], "failed": f"{method.failed} of {method.runs}"}
        | {"evaluations": method.evaluations[method.best], "worth": worth[method.label]}
        for method in methods
    ]
    return Result(
        runs,
        "What tuning is worth.",
        "Geometric mean of the test errors, if the best of so many drawn settings on the validation shapes is taken.",
        question="What is tuning worth?",
        verdict=_verdict(methods, worth),
        interval="95 % intervals over test shapes (Student's, of logarithms)",
        estimates=[found for curve in curves.values() for found in curve.values()],
        remarks=_notes(runs, methods),
        data=to_data(RUNS, runs.records),
        table=to_table(columns, lines),
        figure=draw(methods, curves),
    )


def _worth(method: Tuning) -> statistics.Interval | str:
    """The error of the best of all draws over that of one draw; empty for one draw."""
    most = max(method.budgets)
    return statistics.geometric_ratio(method.expected(most), method.expected(1)) if most > 1 else ""


def _notes(runs: Runs, methods: list[Tuning]) -> list[str]:
    if not methods:
        return ["No draw has a run that ended on every shape, of every method."]
    waiting = unfinished(runs)
    told = f"{waiting} planned runs have not ended: draws and shapes that some method lacks are left out."
    sizes = {"validation": methods[0].validation.shape[1], "test": len(methods[0].test_runs)}
    return [*(note.format(**sizes) for note in NOTES), *([told] if waiting else []), *left_out(runs, methods)]


def _verdict(methods: list[Tuning], worth: dict[str, statistics.Interval | str]) -> str:
    """What the best draw is worth, of the method that gains the most and of the one that gains the least."""
    known = [(found.value, label) for label, found in worth.items() if isinstance(found, statistics.Interval)]
    if not known:
        return ""
    ends = [f"*{format.number(value)}* ({label})" for value, label in (min(known), max(known))]
    draws, n = len(methods[0].draws), len({run[0] for run in methods[0].test_runs})
    return f"The best of {draws} draws has {' to '.join(ends)} times the error of one draw; n = {n} test shapes."


@style.styled
def draw(methods: list[Tuning], curves: dict[str, Curve]) -> Figure:
    """Draws a line per method, the expected test error over the number of draws, and its interval at the last one."""
    figure, axes = chart.sheet(3.2, width=4.6)
    axis = axes[0, 0]
    for method in methods:
        curve = curves[method.label]
        chart.line(axis, method.method, list(curve), [one.value for one in curve.values()], label=method.label)
        chart.estimates(axis, method.method, [max(curve)], [curve[max(curve)]], bars=True, label=None)
    axis.set(xlabel="number of drawn settings, the best of which is taken", ylabel="Chamfer × 1000 (scene units²)")
    found = [one for curve in curves.values() for one in curve.values()]
    style.log_axis(axis, "y", [end for one in found for end in (one.low, one.value, one.high, *one.points)])
    ticks = sorted({k for curve in curves.values() for k in curve})
    axis.set_xscale("log", base=2)
    axis.set_xticks(ticks, [str(k) for k in ticks])
    style.legend_below(figure, axis, columns=2)
    return figure


PAGES = {"tuning": make}
