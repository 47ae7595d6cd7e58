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
    "which the row is better. An interval that contains 1 does not show that errors are equal.",
    "`effort=needed` holds out a tenth of the pixels. Each iteration compares a random pixel of blocks of 4 x 4 "
    "pixels, then of 2 x 2, then all others: the next when the loss of the held-out pixels stops falling. The last ten "
    "iterations compare all pixels. The true shape is not used. DIST and IDR have an epsilon of half a pixel, "
    "Newton has none.",
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
            both = shown[[preset, full]].dropna() if full in shown and preset in shown else shown[:0]
            ratio = (
                statistics.ratio(*(statistics.by_shape(both[name]) for name in (preset, full))) if len(both) else None
            )
            cost = shown[preset].median() if preset in shown else None
            line = everywhere[preset]
            name = NAMES.get(preset, line["row"])
            lines.append(line | {"row": name, "ratio": gap, "cost": cost, "cost_ratio": ratio})
    return lines


def _verdict(lines: list[Line]) -> str:
    """The ratios of costs and errors for the rows of `HEADLINE`, and which errors differ significantly."""
    pooled = {line["preset"]: line for line in lines if line["family"] == lines[0]["family"]}
    tested = [line for line in pooled.values() if line["ratio"] and line["cost_ratio"]]
    ratios = [line["ratio"].ratio for line in tested]
    verdicts = zip(tested, statistics.ratio_verdicts(ratios), strict=True)
    differ = [line["row"] for line, verdict in verdicts if verdict is statistics.Verdict.DIFFERS]
    parts = [
        f"{line['row']}: cost *{format.number(line['cost_ratio'].value)}×*, error {line['ratio'].ratio}"
        for line in tested
        if line["preset"] in HEADLINE
    ]
    few = f"{len(differ)} of {len(tested)} errors differ significantly: {', '.join(differ)}"
    test = few if differ else f"None of {len(tested)} errors differs significantly"
    return f"Relative to full effort: {'; '.join(parts)}. {test} (n = {len(ratios[0].points)} shapes)." if parts else ""


def _panel(lines: list[Line]) -> chart.Panel:
    """Error ratio over cost ratio: a point per row, and the renderers at full effort at 1 and 1."""
    drawn = [line for line in lines if line["ratio"] and line["cost_ratio"]]
    points = [
        chart.series(each["row"], each["preset"], [each["cost_ratio"].value], [each["ratio"].ratio]) for each in drawn
    ]
    full = chart.series("full effort", "", [1.0], [1.0], symbol="o") | {"colour": chart.REFERENCE_COLOUR}
    equal = chart.level("equal error", [0, 1], 1.0, quiet=True)
    cost, error = (f"{name}, relative to the same renderer at full effort" for name in ("field evaluations", "error"))
    return chart.panel_data("", cost, error, [equal, full, *points])


COLUMNS = (
    *table.columns(table.word, family="Family", row="Method"),
    *table.estimate("error", "Chamfer × 1000"),
    table.text("ratio", "Error ratio", lambda line: "" if line["ratio"] is None else str(line["ratio"])),
    *table.ends("ratio", lambda line: compare.ratio_of(line["ratio"])),
    table.text("cost_ratio", "Cost ratio", lambda line: "" if line["cost_ratio"] is None else str(line["cost_ratio"])),
    *table.columns(format.count, cost="Field evaluations"),
    *table.columns(table.word, failed="Failed", preset=""),
)
PAGES = {"effort": make}
