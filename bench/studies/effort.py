"""`effort=needed`: no more rays, iterations and precision than a scene needs, against a fixed effort."""

from typing import Any

from bench.records import format
from bench.report.study import Result, Runs, Selection, chart, compare, statistics, table

PLACE = 23
READS = (Selection("effort"),)
FULL = {  # each row, and the row of the same renderer with full effort
    "dist_needed": "dist_all_pixels",
    "newton_needed": "newton_mask",
    "idr_needed": "idr_mask",
    "dist_epsilon_auto": "dist_all_pixels",
    "dist_held_out": "dist_all_pixels",
    "dist_60": "dist_all_pixels",
}
NAMES = {"newton_mask": "Newton, effort=full", "idr_mask": "IDR, effort=full"}
HEADLINE = ("dist_needed", "newton_needed", "idr_needed", "dist_60")  # rows of the verdict
NOTES = (
    compare.ERROR,
    "Ratios compare each row with the same renderer at full effort: all pixels in each of 100 iterations, and the "
    "default epsilon. They are medians over shapes; a failed run has the largest error of all rows on its shape.",
    "A row at full effort has no ratios. An error ratio below 1 is better; after it stands the number of shapes on "
    "which the row is better.",
    "`effort=needed` holds out a tenth of the pixels. Each iteration compares a random pixel of blocks of 4 x 4 "
    "pixels, then of 2 x 2, then all others: the next when the loss of the held-out pixels stops falling. The last ten "
    "iterations compare all pixels. The true shape is not used. Epsilon, where a renderer has it, is half a pixel.",
    "Two rows test each part alone: `epsilon=auto`, and `effort=needed` with the default epsilon.",
    "Field evaluations: a gradient counts as two. Those of the held-out pixels are included.",
)
Line = dict[str, Any]


def make(runs: Runs) -> Result:
    """Errors and costs of completions relative to those of the same renderer at full effort."""
    compared = compare.Compared(runs, FULL["dist_needed"])
    frame = runs.frame.assign(cost=runs.number("evaluations_cost"))
    lines = _lines(compared, frame[frame.status == "ok"].pivot_table("cost", ["family", "solid", "seed"], "preset"))
    panel = _panel([line for line in lines if line["family"] == lines[0]["family"]])
    return Result(
        runs,
        "Depth completion with no more effort than a scene needs.",
        "Error and field evaluations relative to the same renderer at full effort.",
        question="Does a completion need all pixels, 100 iterations and the default precision?",
        verdict=_verdict(lines),
        interval=compare.INTERVAL,
        estimates=[line["error"] for line in lines],
        remarks=NOTES,
        columns=COLUMNS,
        lines=lines,
        figure=chart.draw([panel], 3.4, legend=3),
        chart={"panels": [panel]},
    )


def _lines(compared: compare.Compared, costs: Any) -> list[Line]:
    """A line per family and row, those over all families first; `costs` has a line per run and a column per preset."""
    rows, lines = {row.preset: row for row in compared.rows}, []
    presets = [each for each in (*dict.fromkeys(FULL.values()), *FULL) if each in rows]
    for family in dict.fromkeys(line["family"] for line in compared.lines):
        everywhere = {line["preset"]: line for line in compared.lines if line["family"] == family}
        shown = costs if family == compare.ALL_FAMILIES else costs[costs.index.get_level_values("family") == family]
        for preset in presets:
            full = FULL.get(preset)
            gap = compared.gap(family, rows[preset], rows[full]) if full in rows else None
            ratio = (shown[preset] / shown[full]).median() if full in shown and preset in shown else None
            cost = shown[preset].median() if preset in shown else None
            line = everywhere[preset]
            name = NAMES.get(preset, line["row"])
            lines.append(line | {"row": name, "ratio": gap, "cost": cost, "cost_ratio": ratio})
    return lines


def _verdict(lines: list[Line]) -> str:
    """The ratios of costs and errors for the rows of `HEADLINE`, and which errors differ significantly."""
    pooled = {line["preset"]: line for line in lines if line["family"] == lines[0]["family"]}
    shown = [pooled[preset] for preset in HEADLINE if preset in pooled and pooled[preset]["ratio"]]
    ratios = [line["ratio"].ratio for line in shown]
    differ = [
        line["row"]
        for line, verdict in zip(shown, statistics.ratio_verdicts(ratios), strict=True)
        if verdict is statistics.Verdict.DIFFERS
    ]
    parts = [f"{line['row']} *{format.number(line['cost_ratio'])}* and {line['ratio'].ratio}" for line in shown]
    test = f"{', '.join(differ)} differ significantly in error" if differ else "No error differs significantly"
    sample = f"n = {len(ratios[0].points)} shapes" if ratios else ""
    return f"Cost and error relative to full effort: {'; '.join(parts)}. {test} ({sample})." if shown else ""


def _panel(lines: list[Line]) -> chart.Panel:
    """Error ratio over cost ratio: a point per row, and the renderers at full effort at 1 and 1."""
    drawn = [line for line in lines if line["ratio"] and line["cost_ratio"]]
    points = [chart.series(each["row"], each["preset"], [each["cost_ratio"]], [each["ratio"].ratio]) for each in drawn]
    level = chart.level("full effort", [0, 1], 1.0)
    return chart.panel_data("", "cost relative to full effort", "error relative to full effort", [level, *points])


COLUMNS = (
    *table.columns(table.word, family="Family", row="Method"),
    *table.estimate("error", "Chamfer × 1000"),
    table.text("ratio", "Error ratio", lambda line: "" if line["ratio"] is None else str(line["ratio"])),
    *table.ends("ratio", lambda line: compare.ratio_of(line["ratio"])),
    *table.columns(lambda value: "" if value is None else format.number(value), cost_ratio="Cost ratio"),
    *table.columns(format.count, cost="Field evaluations"),
    *table.columns(table.word, failed="Failed", preset=""),
)
PAGES = {"effort": make}
