"""The fields that are sufficient for a scene, by error, stored numbers and FLOPs."""

from collections.abc import Iterable
from itertools import groupby
from pathlib import PurePosixPath
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from bench.pictures.size_chart import AXES, CONFIRMED_FROM, FLOPS, KINDS, CandidateResult, Candidates, marker_points
from bench.report.study import Result, Runs, Selection, chart, figure_style, format, medians, records, table

PLACE = 160
READS = (
    Selection(
        "parsimony",
        conditions=("view.resolution", "task.rounds", "task.held_out_rays"),
        setup=("scenes", "pixels", "machine"),
    ),
)
COSTS = ("seconds", "flops", "evaluations")
CHOICES = {  # the metric that a choice minimises, whether half a pixel suffices, heading, marker and size of its ring
    "by_numbers": ("stored", True, "fewest numbers under half a pixel", "o", 10),
    "by_flops": (FLOPS, True, "fewest FLOPs under half a pixel", "s", 10),
    "by_best": ("stored", False, "fewest numbers as good as the best", "D", 10),
}
RING_COLOUR, PIXEL_COLOUR = "#111111", "#47684f"
MAX_PANELS_IN_TWO_COLUMNS = 8
LEGEND_LABELS = {label for label, *_ in KINDS.values()} | {heading for _, _, heading, *_ in CHOICES.values()}
CROWDED = {"FLOPs": 12, "error": 5}  # ratios within which names of two candidates would overlap
MARKER_EXAMPLES = (10, 10_000, 1_000_000)  # stored numbers
NOTES = (
    "All candidates are fitted to depth and silhouettes of the same views with the same rays, in rounds until a round "
    "no longer reduces the held-out error by more than its noise. The error is the mean distance along the normal over "
    "held-out rays, most of them of other views.",
    "A field under half a pixel at the nearest distance suffices for these pixels. A field within one standard error "
    "of the least error is as good as the best: it suffices for the scene, as far as these candidates show.",
    "A field that was checked on further views is chosen only if it suffices on {held:.0f} % or more of random draws "
    "of these. Unchecked: the run has no such draws of this field.",
    "Numbers are those that a field stores. Of a grid, only those near the surface are trained: `free` in the CSV.",
    "Scenes may differ in their candidates, whose number is in the last column, and in the length of rounds.",
    "The field with the fewest numbers under half a pixel, confirmed or not, is fitted again at pixel precision: with "
    "renderer.epsilon=auto, renderer.steps=auto and rays that follow the loss. The table has the evaluations relative "
    "to its first fit, and the error. An exclamation mark: above half a pixel.",
)
POINT = (
    "The larger a marker, the more numbers its field stores. Hollow markers: the last round still reduced the error. "
    "Rings mark the choices of the table."
)
Line = dict[str, Any]  # a run
Labels = dict[tuple[float, float], str]  # the name of a candidate by its position


def make(runs: Runs) -> Result:
    """A line per scene and resolution: the sufficient candidates, each the smallest by another quantity.

    Of runs of a scene with other rounds or held-out rays, the newest is shown.
    """
    runs = runs.only(list({_cell(record): record for record in runs.records}.values()))
    lines = scenes(runs)
    drawn = [_panel(list(group)) for _, group in groupby(lines, key=lambda line: line["scene"])]
    panels, labels = [panel for panel, _ in drawn], [names for _, names in drawn]
    return Result(
        runs,
        "The sufficient fields for each scene, by error, numbers and FLOPs.",
        "Held-out error of each candidate over its FLOPs per evaluation; the larger the marker, the more numbers.",
        question="How small can the model of a shape be?",
        verdict=_verdict([line for line in lines if line["ok"]]),
        interval="± and bars are one standard error, by the jackknife over views",
        remarks=[*(note.format(held=100 * CONFIRMED_FROM) for note in NOTES), _falling(lines)],
        data=table.to_data(CANDIDATES, [line | candidate for line in lines for candidate in _candidates(line)]),
        columns=COLUMNS,
        lines=lines,
        figure=draw(panels, labels),
        chart={"panels": panels, "note": POINT},
    )


def _cell(record: records.Record) -> tuple[Any, ...]:
    return medians.scene_of(record), records.setting(record["config"], "view", "resolution"), record["seed"]


def scenes(runs: Runs) -> list[Line]:
    """A line per run: the scenes by their smallest sufficient field, each by resolution, failed runs last."""
    lines = [_scene(record, medians.scene_of(record)) for record in runs.records]
    fewest: dict[str, float] = {}
    for line in lines:
        stored = line["recommended_stored"] if line["ok"] else float("inf")
        fewest[line["scene"]] = min(stored, fewest.get(line["scene"], stored))
    return sorted(lines, key=lambda line: (fewest[line["scene"]], line["scene"], line["pixels"] or 0))


def _scene(record: records.Record, name: str) -> Line:
    """The run's identity, metrics and choices; `problem` says why these are missing."""
    metrics = record["metrics"] if record["status"] == "ok" else {}
    candidates = Candidates.of(metrics)
    path = PurePosixPath(name)
    line = {"scene": path.stem if path.suffix else name, "candidates": candidates}
    line |= {"pixels": records.setting(record["config"], "view", "resolution")}
    line |= {column.key: column.of(record) for column in table.IDENTITY}
    if candidates.chosen is None or candidates.best is None:
        status = record["status"].replace("_", " ") if record["status"] != "ok" else "no field recommended"
        return line | {"ok": False, "problem": status, "lost": format.MISSING, "stopped": format.MISSING}
    for choice, (cost, by_pixel, *_) in CHOICES.items():
        line[choice] = candidates.smallest(cost, by_pixel=by_pixel)
    frugal, plain = metrics.get("frugal.evaluations"), candidates.chosen.numbers.get("evaluations")
    fitted = metrics.get("frugal.error") is not None and frugal is not None and plain
    count = len(candidates.results)
    line |= {"frugal_evaluations": frugal / plain if fitted else None}
    line |= {"lost": f"{sum(candidate.error is None for candidate in candidates.results)} of {count}"}
    line |= {"stopped": f"{sum(candidate.is_falling for candidate in candidates.results)} of {count}"}
    return line | metrics | {"ok": True, "problem": ""}


def _candidates(line: Line) -> list[Line]:
    """The candidates of a run with their kind and numbers; one empty line for a failed run."""
    candidates = line["candidates"]
    return [
        {**candidate.numbers, "rung": candidate.name, "kind": KINDS[candidate.kind][0]}
        | {"recommended": candidate is candidates.chosen, "best": candidate is candidates.best}
        | {choice: candidate is line[choice] for choice in CHOICES}
        for candidate in (candidates.results if line["ok"] else ())
    ] or [{}]


def _falling(lines: list[Line]) -> str:
    labels = [candidate.label for line in lines for candidate in line["candidates"].results if candidate.is_falling]
    counts = ", ".join(f"{label} in {labels.count(label)}" for label in dict.fromkeys(labels))
    return f"Not converged (the last round still reduced the error), in runs: {counts}." if labels else ""


def _verdict(lines: list[Line]) -> str:
    """The sizes that suffice, and the kinds of the best fields by each quantity; empty without runs that ended ok."""
    if not lines:
        return ""
    fewest, quickest = ([line[choice] for line in lines] for choice in ("by_numbers", "by_flops"))
    best = [line["candidates"].best for line in lines]
    same = sum(a is not None and a is b is c for a, b, c in zip(fewest, quickest, best, strict=True))
    are_scenes = len({line["scene"] for line in lines}) == len(lines)
    sample = format.plural(len(lines), "scene") if are_scenes else f"{len(lines)} scenes and resolutions"
    sizes = sorted(result.numbers["stored"] for result in fewest if result is not None)
    sample = f"{len(sizes)} of {sample}" if 0 < len(sizes) < len(lines) else sample
    enough = f"*{' to '.join(f'{size:,}' for size in dict.fromkeys((*sizes[:1], *sizes[-1:])))}* numbers suffice"
    unchecked = sum(result is not None and result.held(by_pixel=True) is None for result in quickest)
    limit = f" (not checked on further views: {unchecked})" if unchecked else ""
    return (
        f"{f'{enough} for an error under half a pixel in' if sizes else 'No field suffices at half a pixel in'} "
        f"{sample}. Fewest numbers: {_kinds(fewest)}. Fewest FLOPs: {_kinds(quickest)}{limit}. Least error: "
        f"{_kinds(best)}. One field is best by all three in *{same}*."
    )


def _kinds(results: Iterable[CandidateResult | None]) -> str:
    """How often each kind occurs, the most frequent first, such as networks in 3, unions of boxes in 1."""
    names = ["no confirmed field" if result is None else KINDS[result.kind][0] for result in results]
    counts = sorted({name: names.count(name) for name in names}.items(), key=lambda pair: -pair[1])
    return ", ".join(f"{name} in {count}" for name, count in counts)


def _panel(lines: list[Line]) -> tuple[chart.Panel, Labels]:
    """The candidates of a scene at its finest resolution, the front of each resolution, and the choices.

    Also returns the names of the chosen candidates by their positions.
    """
    lines = [line for line in lines if line["ok"]] or lines
    *coarser, line = lines
    drawn, labels = list[chart.Series](), Labels()
    for dash, each in zip(("-", "--", "-."), (line, *coarser), strict=False):
        drawn += _front(each, dash, is_coarser=each is not line)
    drawn += [_point(line, candidate) for candidate in line["candidates"].results]
    for choice, (*_, heading, marker, size) in CHOICES.items():
        if candidate := line.get(choice):
            ring = {"colour": RING_COLOUR, "symbol": marker, "hollow": True, "size": 2 * size}
            drawn.append(chart.series(heading, "", *_position(candidate), text=[[candidate.label]]) | ring)
            labels[candidate.numbers[FLOPS], 1000 * candidate.numbers["error"]] = candidate.label
    title = f"{line['scene']} ({line['problem']})" if line["problem"] else line["scene"]
    title += f", {line['pixels']} pixels" if coarser else ""
    return chart.panel_data(title, AXES[FLOPS], "held-out error × 1000", drawn), labels


def _position(candidate: CandidateResult) -> tuple[list[float], list[float]]:
    error = float("inf") if candidate.error is None else 1000 * candidate.error
    return [candidate.numbers[FLOPS]], [error]


def _front(line: Line, dash: str, *, is_coarser: bool) -> list[chart.Series]:
    """The front of error over FLOPs, with the resolution in its name if that is not the finest, and half a pixel."""
    points = [_position(candidate) for candidate in line["candidates"].results]
    if not points:
        return []
    x, y = ([value for (value,) in values] for values in zip(*points, strict=True))
    suffix = f" at {line['pixels']} pixels" if is_coarser else ""
    front = chart.front(x, y) | {"name": f"front of error and FLOPs{suffix}", "dash": dash, "quiet": False}
    level = chart.level("half a pixel", x, 1000 * line["footprint"], colour=PIXEL_COLOUR, dash=":")
    return [front, level]


def _point(line: Line, candidate: CandidateResult) -> chart.Series:
    """A candidate: its marker grows with its numbers, and is hollow if its error still fell."""
    label, colour, marker = KINDS[candidate.kind]
    x, y = _position(candidate)
    text = [candidate.label, f"{candidate.numbers['stored']:,} numbers, error × 1000 {format.number(y[0])}"]
    look = {"colour": colour, "symbol": marker, "size": 2 * marker_points(candidate.numbers["stored"])}
    if candidate.error is not None:
        spread = 1000 * candidate.numbers["standard_error"]
        look |= {"low": [y[0] - spread], "high": [y[0] + spread]}
    hollow = {"hollow": True} if candidate.is_falling else {}
    return chart.series(label, "", x, y, text=[text], **hollow) | look


@figure_style.styled
def draw(panels: list[chart.Panel], labels: list[Labels]) -> Figure:
    rows = -(-len(panels) // (2 if len(panels) <= MAX_PANELS_IN_TWO_COLUMNS else 3))
    figure = chart.draw(panels, 2.0 * rows + 1.1, rows, legend=0, sharey=True, sharex=True)
    for axis, names in zip(figure.axes, labels, strict=False):
        for (x, y), label in names.items():
            lower = [a for a, b in names if max(x / a, a / x) < CROWDED["FLOPs"] and 1 < y / b < CROWDED["error"]]
            sideways: tuple[tuple[int, int], str] = ((9, -2), "left") if lower and x > lower[0] else ((-9, -2), "right")
            offset, align = sideways if lower else ((0, -14), "center")
            axis.annotate(label, (x, y), offset, textcoords="offset points", ha=align, fontsize=6.5)
        axis.margins(y=0.16)
        axis.tick_params(labelbottom=True)
    axis = figure.axes[0]
    axis.set_ylim(bottom=axis.get_ylim()[0] / 2)  # all axes share it; names of candidates are below markers
    axis.plot([], [], KINDS["network"][2], mfc="none", color=KINDS["network"][1], label="hollow: error still fell")
    for stored in MARKER_EXAMPLES:
        axis.plot([], [], "o", ms=marker_points(stored), color="#bbbbbb", label=f"{stored:,} numbers")
    figure_style.legend_below(figure, *figure.axes, columns=4)
    for handle in figure.legends[0].legend_handles:
        if isinstance(handle, Line2D) and handle.get_label() in LEGEND_LABELS:
            is_ring = handle.get_color() == RING_COLOUR
            handle.set(markersize=7 if is_ring else 5, markerfacecolor="none" if is_ring else handle.get_color())
    return figure


def _chosen(line: Line, choice: str) -> str:
    cost, by_pixel, *_ = CHOICES[choice]
    candidate = line.get(choice)
    if candidate is None:
        return "none passes further views" if line["ok"] else format.MISSING
    unit = "FLOPs" if cost == FLOPS else "numbers"
    unchecked = ", unchecked" if candidate.held(by_pixel=by_pixel) is None else ""
    return f"{candidate.label}{unchecked}: {candidate.numbers[cost]:,} {unit}, {table.thousandfold(candidate.error)}"


def _best(line: Line) -> str:
    if not line["ok"]:
        return line["problem"]
    best = line["candidates"].best
    error, spread = (table.thousandfold(best.numbers[name]) for name in ("error", "standard_error"))
    return f"{best.label}: {best.numbers['stored']:,} numbers, {error} ± {spread}"


def _at_pixel_precision(line: Line) -> str:
    """The field, the evaluations of its second fit relative to the first, and its error, such as grid 32: 0.4×, 5."""
    if (ratio := line.get("frugal_evaluations")) is None:
        return format.MISSING
    name, error, footprint = line["candidates"].chosen.label, line["frugal.error"], line["footprint"]
    mark = "!" if error > footprint else ""
    return f"{name}: {format.number(ratio)}×, {table.thousandfold(error)}{mark}"


SIZES = ("stored", "free", "bytes")
SCENE = (table.text("scene", "Scene"), *(table.text(column.key) for column in table.IDENTITY))
PIXELS = table.Column("pixels", "Pixels", show=table.integer)
CANDIDATES = (  # a line is a run and a candidate
    *SCENE,
    table.Column("pixels"),
    *table.raw("auto.overhead", "frugal_evaluations", "frugal.error"),
    *table.raw("footprint", "chamfer_l2", "recommended_within", "recommended_enough", "held_out_seeds"),
    *table.raw("rung", "kind", "recommended", "best", *CHOICES),
    *table.raw(*SIZES, "sparse_bytes", FLOPS, "error", "standard_error", *COSTS, "iterations", "falling", "failed"),
    *table.raw("held_enough", "held_within", *(f"{cost}_at_auto" for cost in COSTS)),
)
COLUMNS = (  # a line is a run
    SCENE[0],
    PIXELS,
    table.Column("footprint", "Half a pixel (scene units × 1000)", show=table.thousandfold),
    *(
        table.shown(f"F{heading[1:]}, error × 1000", lambda line, choice=choice: _chosen(line, choice))
        for choice, (_, _, heading, *_) in CHOICES.items()
    ),
    table.shown("Least error × 1000", _best),
    table.text("stopped", "Error still fell"),
    table.shown("At pixel precision: evaluations, error × 1000", _at_pixel_precision),
    table.text("lost", "Failed candidates"),
)
PAGES = {"parsimony": make}
