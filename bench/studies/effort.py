"""`effort=needed`: no more rays, iterations and precision than a scene needs, against a fixed effort."""

import math
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
HEADLINES = {  # the beginning of a sentence of the verdict, and its rows
    "Relative to full effort, with effort=needed": ("dist_needed", "newton_needed", "idr_needed"),
    "With 60 iterations": ("dist_60",),
}
NOTES = (
    compare.ERROR,
    "Ratios compare each row with the same renderer at full effort: all pixels in each of 100 iterations, and the "
    "default epsilon. They are medians over shapes; a failed run has the largest error of all rows on its shape.",
    "A row at full effort has no ratios. An error ratio below 1 is better; after it stands the number of shapes on "
    "which the row is better. An interval that contains 1 does not show that errors are equal.",
    "`effort=needed` holds out a tenth of the pixels. An iteration compares a random pixel of each block: of 4 x 4 "
    "pixels at first, then of 2 x 2, then every pixel. Blocks become smaller when the loss of the held-out pixels "
    "stops falling. The last ten iterations compare all pixels, held-out ones included. The true shape is not used. "
    "DIST and IDR have an epsilon of half a pixel, Newton has none.",
    "Two rows of DIST test one part alone: `epsilon=auto`, and `effort=needed` with the default epsilon.",
    "Field evaluations: a gradient counts as two. Those of the held-out pixels are included. Runs that did not end ok "
    "have no cost.",
)
Line = dict[str, Any]


def make(runs: Runs) -> Result:
    compared = compare.Compared(runs, FULL["dist_needed"])
    frame = runs.frame.assign(cost=runs.number("evaluations_cost"))
    lines = _lines(compared, frame[frame.status == "ok"].pivot_table("cost", ["family", "solid", "seed"], "row"))
    pooled = compare.pooled(lines)
    panel = _panel(pooled)
    return Result(
        runs,
        "Depth completion with no more effort than a scene needs.",
        "Error and field evaluations relative to the same renderer at full effort.",
        question="Does a completion need all pixels, 100 iterations and the default precision?",
        verdict=_verdict(pooled),
        interval=compare.INTERVAL,
        estimates=[line["error"] for line in lines],
        remarks=NOTES,
        columns=COLUMNS,
        lines=lines,
        figure=chart.draw([panel], 3.4, legend=3),
        chart={"panels": [panel]},
    )


def _lines(compared: compare.Compared, costs: Any) -> list[Line]:
    """A line per family and row, those over all families first.

    Args:
        costs: a data frame with a line per run and a column per row.
    """
    order = [*dict.fromkeys(FULL.values()), *FULL]
    rows = sorted(compared.rows, key=lambda row: order.index(row.preset) if row.preset in order else len(order))
    of_preset, lines = {row.preset: row for row in rows}, []
    line_of = {(line["family"], line["preset"], line["row"]): line for line in compared.lines}
    for family in dict.fromkeys(line["family"] for line in compared.lines):
        shown = costs if family == compare.ALL_FAMILIES else costs[costs.index.get_level_values("family") == family]
        for row in rows:
            full = of_preset.get(FULL.get(row.preset, ""))
            cost = shown[row.name].median() if row.name in shown else math.nan
            is_shown = full is not None and {row.name, full.name} <= {*shown}
            costs_of_both = [shown[each.name].dropna() for each in (row, full)] if is_shown else []
            lines.append(
                line_of[family, row.preset, row.name]
                | {"row": NAMES.get(row.preset, row.name), "cost": None if math.isnan(cost) else cost}
                | {"ratio": compared.gap(family, row, full) if full else None}
                | {"cost_ratio": statistics.common_ratio(*costs_of_both) if costs_of_both else None}
            )
    return lines


def _verdict(pooled: list[Line]) -> str:
    sentences = []
    for beginning, presets in HEADLINES.items():
        parts = [_costs(line) for line in pooled if line["preset"] in presets and line["ratio"]]
        sentences += [f"{beginning}: {', '.join(parts)}."] if parts else []
    ratios = [(line["row"], compare.ratio_of(line["ratio"])) for line in pooled]
    return " ".join(filter(None, [*sentences, compare.differing(ratios, "")]))


def _costs(line: Line) -> str:
    """A renderer with its ratios, such as DIST (cost 0.4×, error 1.01×)."""
    cost = "no cost" if line["cost_ratio"] is None else f"{format.number(line['cost_ratio'].value)}×"
    return f"{line['row'].partition(',')[0]} (cost *{cost}*, error {format.number(line['ratio'].ratio.value)}×)"


def _panel(pooled: list[Line]) -> chart.Panel:
    points = [
        chart.series(line["row"], line["preset"], [line["cost_ratio"].value], [line["ratio"].ratio])
        for line in pooled
        if line["ratio"] and line["cost_ratio"]
    ]
    full = chart.series("full effort", "", [1.0], [1.0], symbol="o") | {"colour": chart.REFERENCE_COLOUR}
    equal = chart.level("equal error", [0, 1], 1.0, quiet=True)
    cost = "field evaluations, relative to the same renderer at full effort"
    return chart.panel_data("", cost, "error, relative to full effort", [equal, full, *points])


COLUMNS = (
    *table.columns(table.word, family="Family", row="Method"),
    *table.estimate("error", "Chamfer × 1000"),
    *compare.ratio_columns("Error ratio"),
    table.text("cost_ratio", "Cost ratio", lambda line: "" if line["cost_ratio"] is None else str(line["cost_ratio"])),
    *table.columns(format.count, cost="Field evaluations"),
    *table.columns(table.word, failed="Failed", preset=""),
)
PAGES = {"effort": make}
