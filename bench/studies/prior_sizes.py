"""How large a prior a completion needs: the error over the cost, for several networks and lengths of codes."""

from itertools import cycle
from typing import Any

from bench.records import format
from bench.report.study import Result, Runs, Selection, chart, compare, records, statistics, table

PLACE = 24
SIZES = tuple(f"prior.network.{key}" for key in ("layers", "width", "code_length", "skip"))
READS = (Selection("prior_sizes", SIZES, setup=("scenes", "pixels", "machine")),)
COLOURS = ("#f2a65a", "#2a6f97", "#7b2d26", "#5c8001", "#845ec2")  # of lines, the narrowest network first
NOTES = (
    "Error: chamfer_l2, the sum of the two mean squared distances in squared scene units, times 1000.",
    "Each row has a prior of its size, trained on the same shapes with the same number of steps. Ratios compare it "
    "with the largest prior of the same renderer, and are medians over shapes.",
    "A failed run, or a planned run that was not made, counts as infinite in medians of errors. In ratios it has the "
    "largest error of all rows on its shape. A row without a run that ended ok has no ratio.",
    "After a ratio stands the number of shapes on which the row is better. An interval that contains 1 does not show "
    "that errors are equal.",
    "FLOPs are those of all field evaluations of a run. All shapes share the weights of the network, and each shape "
    "has a code.",
)
Line = dict[str, Any]


def make(runs: Runs) -> Result:
    lines = _lines(runs, compare.Compared(runs, ""))
    pooled = compare.pooled(lines)
    panels = _panels(pooled)
    return Result(
        runs,
        "Completion with priors of several sizes.",
        "Error of a completion, and the FLOPs of its field evaluations, over the length of the code.",
        question="How large a prior does a completion need?",
        verdict=" ".join(_verdict([line for line in pooled if line["preset"] == name]) for name in _presets(pooled)),
        interval=compare.INTERVAL,
        estimates=[line["error"] for line in lines],
        remarks=NOTES,
        columns=COLUMNS,
        lines=lines,
        figure=chart.draw(panels, 3.4, legend=2),
        chart={"panels": panels},
    )


def _lines(runs: Runs, compared: compare.Compared) -> list[Line]:
    sizes = {row: _size(of_row[0]["config"]["prior"]["network"]) for row, of_row in runs.rows().items()}
    by_size = sorted(sizes, key=lambda row: (sizes[row]["weights"], sizes[row]["code"]))
    largest = {row.preset: row for row in by_size}
    all_flops, lines = runs.number("flops"), []
    for line in compared.lines:
        row = records.Row(line["preset"], line["row"])
        cells, reference = compared.cells_of(line["family"], row), largest[row.preset]
        flops = all_flops[cells.index[cells.ok]]
        ratio = None if row == reference or flops.empty else compared.gap(line["family"], row, reference)
        lines.append(line | sizes[row] | {"ratio": ratio, "flops": None if flops.empty else float(flops.median())})
    families = list(dict.fromkeys(line["family"] for line in lines))
    return sorted(lines, key=lambda line: (families.index(line["family"]), line["preset"], line["weights"]))


def _presets(lines: list[Line]) -> list[str]:
    return list(dict.fromkeys(line["preset"] for line in lines))


def _size(network: dict[str, Any]) -> Line:
    layers, width, code = (network[key] for key in ("layers", "width", "code_length"))
    return {"network": f"{layers} × {width}", "code": code, "weights": weights(**network)}


def weights(layers: int, width: int, code_length: int, skip: int, *, narrow: bool) -> int:
    """The number of weights and biases of a `renderers.fields.mlp.Decoder`."""
    inputs, sizes = [code_length + 3] + [width] * (layers - 1), [width] * layers
    if skip and narrow:
        sizes[skip - 1] -= code_length + 3
    elif skip:
        inputs[skip] += code_length + 3
    return sum((i + 1) * o for i, o in zip([*inputs, width], [*sizes, 1], strict=True))


def _verdict(lines: list[Line]) -> str:
    """A renderer's number of priors with a significantly larger error, and its smallest other prior."""
    largest = lines[-1]
    ratios = [(line["row"], compare.ratio_of(line["ratio"])) for line in lines]
    tested = [(line, ratio) for line, (_, ratio) in zip(lines, ratios, strict=True) if ratio and ratio.has_ends]
    verdicts = statistics.ratio_verdicts([ratio for _, ratio in tested])
    is_larger = [
        ratio.value > 1 and verdict is statistics.Verdict.DIFFERS
        for (_, ratio), verdict in zip(tested, verdicts, strict=True)
    ]
    similar = [line for (line, _), larger in zip(tested, is_larger, strict=True) if not larger]
    candidates = [line for line in (*similar, largest) if line["flops"]]  # with a run that ended ok
    if not tested or statistics.Verdict.NOT_DECIDABLE in verdicts or largest not in candidates:
        return compare.differing(ratios, f"to {largest['row']}")
    text = f"By {compare.HOLM}, *{sum(is_larger)} of {len(tested)}* smaller priors have a larger error."
    smallest = min(candidates, key=lambda line: line["weights"])
    if smallest is largest:
        return f"No smaller prior is as good as *{largest['row']}* (layers × width). {text}"
    limit = f"whose error is not significantly larger than that of {largest['row']}"
    return f"*{smallest['row']}* (layers × width) is the smallest prior {limit}. {text}"


def _panels(pooled: list[Line]) -> list[chart.Panel]:
    several, codes = len(_presets(pooled)) > 1, sorted({line["code"] for line in pooled})
    panels = []
    for key, title in (("error", compare.LABEL), ("flops", "FLOPs of a run")):
        curves = []
        groups = dict.fromkeys((line["network"], line["preset"]) for line in pooled)
        for colour, (network, preset) in zip(cycle(COLOURS), groups, strict=False):
            lines = [line for line in pooled if (line["network"], line["preset"]) == (network, preset)]
            lines = [line for line in lines if line["flops"]]
            x, y = [codes.index(line["code"]) for line in lines], [line[key] for line in lines]
            texts = [f"{line['weights']:,} weights" for line in lines]
            name = f"network {network}{f', {preset}' if several else ''}"
            curves.append(chart.curve(name, "", x, y, text=texts) | {"colour": colour, "symbol": "o"})
        panels.append(chart.panel_data("", "length of the code (numbers)", title, curves, ticks=[*map(str, codes)]))
    return panels


COLUMNS = (
    *table.columns(table.word, family="Family", row="Prior"),
    *table.columns(table.integer, weights="Weights"),
    *table.estimate("error", "Chamfer × 1000"),
    *compare.ratio_columns("Ratio to the largest"),
    *table.columns(format.count, evaluations="Field evaluations", flops="FLOPs"),
    *table.columns(table.word, failed="Failed", preset=""),
)
PAGES = {"prior_sizes": make}
