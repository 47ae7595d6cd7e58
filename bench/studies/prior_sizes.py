"""How large a prior a completion needs: the error over the cost, for several networks and lengths of codes."""

from typing import Any

from bench.records import format
from bench.report.study import Result, Runs, Selection, chart, compare, records, statistics, table

PLACE = 24
READS = (Selection("prior_sizes", tuple(f"prior.network.{key}" for key in ("layers", "width", "code_length", "skip"))),)
COLOURS = ("#f2a65a", "#2a6f97", "#7b2d26")  # of networks, the narrowest first
NOTES = (
    compare.ERROR,
    "Each row has a prior of its size, trained on the same shapes with the same number of steps. Ratios compare it "
    "with the largest prior of the table, and are medians over shapes. A failed run has the largest error of all rows "
    "on its shape.",
    "After a ratio stands the number of shapes on which the row is better. An interval that contains 1 does not show "
    "that errors are equal.",
    "Numbers: the weights of the network; each shape has a code besides. FLOPs: those of all field evaluations of a "
    "run.",
)
Line = dict[str, Any]


def make(runs: Runs) -> Result:
    """A line per family and prior, those over all families first."""
    lines = _lines(runs, compare.Compared(runs, ""))
    pooled = [line for line in lines if line["family"] == lines[0]["family"]]
    panels = _panels(pooled)
    return Result(
        runs,
        "Completion with priors of several sizes.",
        "Error of a completion, and the FLOPs of its field evaluations, over the length of the code.",
        question="How large a prior does a completion need?",
        verdict=_verdict(pooled),
        interval=compare.INTERVAL,
        estimates=[line["error"] for line in lines],
        remarks=NOTES,
        columns=COLUMNS,
        lines=lines,
        figure=chart.draw(panels, 3.4, legend=2),
        chart={"panels": panels},
    )


def _lines(runs: Runs, compared: compare.Compared) -> list[Line]:
    """The lines of the comparison with the sizes of priors, the smallest first, and ratios to the largest prior."""
    sizes = {row: _size(of_row[0]["config"]["prior"]["network"]) for row, of_row in runs.rows().items()}
    largest = max(sizes, key=lambda row: (sizes[row]["numbers"], sizes[row]["code"]))
    frame = runs.frame.assign(flops=runs.number("flops"))
    lines = []
    for line in compared.lines:
        row = records.Row(line["preset"], line["row"])
        of_row = frame[(frame.status == "ok") & (frame.row == row.name)]
        if line["family"] != compare.ALL_FAMILIES:
            of_row = of_row[of_row.family == line["family"]]
        ratio = None if row == largest else compared.gap(line["family"], row, largest)
        flops = None if of_row.empty else float(of_row.flops.median())
        lines.append(line | sizes[row] | {"ratio": ratio, "flops": flops})
    families = list(dict.fromkeys(line["family"] for line in lines))
    return sorted(lines, key=lambda line: (families.index(line["family"]), line["numbers"]))


def _size(network: dict[str, Any]) -> Line:
    """The network in words, the length of its code, and the number of its weights."""
    layers, width, code = (network[key] for key in ("layers", "width", "code_length"))
    return {"network": f"{layers} × {width}", "code": code, "numbers": weights(**network)}


def weights(layers: int, width: int, code_length: int, skip: int, *, narrow: bool) -> int:
    """The number of weights and biases of a `renderers.fields.mlp.Decoder`."""
    inputs, sizes = [code_length + 3] + [width] * (layers - 1), [width] * layers
    if skip and narrow:
        sizes[skip - 1] -= code_length + 3
    elif skip:
        inputs[skip] += code_length + 3
    return sum((i + 1) * o for i, o in zip([*inputs, width], [*sizes, 1], strict=True))


def _verdict(pooled: list[Line]) -> str:
    """The ratios of errors that differ significantly, and the cost of the cheapest prior whose ratio does not."""
    named = [(line["row"], compare.ratio_of(line["ratio"])) for line in pooled]
    tested = [(line, ratio) for line, (_, ratio) in zip(pooled, named, strict=True) if ratio and ratio.has_ends]
    text = compare.differing(named, f"of errors, to {pooled[-1]['row']},")
    if not tested:
        return text
    verdicts = statistics.ratio_verdicts([ratio for _, ratio in tested])
    similar = [
        line
        for (line, _), verdict in zip(tested, verdicts, strict=True)
        if verdict is statistics.Verdict.NOT_DISTINGUISHED and line["flops"]
    ]
    if not similar or not pooled[-1]["flops"]:
        return text
    cheapest = min(similar, key=lambda line: line["flops"])
    share = table.percent(cheapest["flops"] / pooled[-1]["flops"])
    ratio = format.number(cheapest["ratio"].ratio.value)
    return f"{text} Of these, {cheapest['row']} needs the fewest FLOPs: {share}, with {ratio} times the error."


def _panels(pooled: list[Line]) -> list[chart.Panel]:
    """Error and FLOPs over the length of the code: a line per network."""
    panels = []
    for key, title in (("error", compare.LABEL), ("flops", "FLOPs of a run")):
        curves = []
        for colour, network in zip(COLOURS, dict.fromkeys(line["network"] for line in pooled), strict=False):
            lines = [line for line in pooled if line["network"] == network and line["flops"]]
            x, y = ([line[name] for line in lines] for name in ("code", key))
            texts = [f"{line['numbers']:,} weights" for line in lines]
            curve = chart.curve(f"network {network}", "", x, y, text=texts)
            curves.append(curve | {"colour": colour, "symbol": "o"})
        panels.append(chart.panel_data("", "numbers of the code", title, curves))
    return panels


COLUMNS = (
    *table.columns(table.word, family="Family", row="Prior"),
    *table.columns(table.integer, numbers="Numbers"),
    *table.estimate("error", "Chamfer × 1000"),
    table.text("ratio", "Ratio to the largest", lambda line: "" if line["ratio"] is None else str(line["ratio"])),
    *table.ends("ratio", lambda line: compare.ratio_of(line["ratio"])),
    *table.columns(format.count, evaluations="Field evaluations", flops="FLOPs"),
    *table.columns(table.word, failed="Failed", preset=""),
)
PAGES = {"prior_sizes": make}
