"""Which renderer and which settings suit a field: wrong pixels, depth errors and costs from several cameras."""

from typing import Any

from bench.report.study import Result, Runs, Selection, chart, format, gallery, records, table

PLACE = 25
READS = (Selection("fit_for", ("view.azimuth",), alike=("dataset", "index", "prior", "task")),)
MAX_WRONG_FRACTION_OF_HITS = 0.01
MAX_COLUMNS = 6
Y_TITLE = "wrong pixels (% of the hits)"
SUMMED = ("hits", "lost", "false", "wrong", "pixel_errors", "out_of_steps")
MEDIANS = ("cost", "forward_seconds", "step_seconds", "depth_error_median", "error_p95", "gradient_error")
NOTES = (
    "Missed: only the float64 reference hits. Spurious: only the renderer hits. Wrong depth: both hit, at depths that "
    "differ by more than task.wrong, half a pixel at the 64 pixels of this experiment. Pixels are summed over cameras, "
    "other numbers are medians over cameras.",
    "Out of steps: rays that used all steps, also those that miss the shape. More steps can mend them: see DIST, 200 "
    "steps.",
    "A step of an optimisation is a rendering with gradients, the loss and the backward pass. The fewest evaluations "
    "are not always the shortest time.",
    "Depths are in scene units. A 95 % depth error is infinite if more than 5 % of the hits are missed or spurious.",
    "The axis of the chart is logarithmic, so 0 wrong pixels are drawn as half a pixel.",
    "Gradient error: the relative error of the gradient by the network's weights, over pixels that both hit. It does "
    "not see the outline.",
)
PICTURE_NOTE = "The pictures are of the first camera. A wrong depth has no colour of its own."
RAY_NOTE = "python -m bench.ray RUN_FOLDER shows what a renderer did on the ray of its most wrong pixel."
Line = dict[str, Any]


def make(runs: Runs) -> Result:
    rows = runs.executed.rows()
    lines = [_line(row.name, row.preset, of_row) for row, of_row in rows.items()]
    return Result(
        runs,
        "Renderers on one field.",
        "Pixels that differ from the float64 reference, over the field evaluations of one rendering.",
        n=f"{len(lines)} renderers × {max(line['cameras'] for line in lines)} cameras, one shape",
        question="Which renderer suits this field?",
        verdict=_verdict(rows, lines),
        remarks=NOTES,
        columns=COLUMNS,
        lines=lines,
        folders={row.name: [record["folder"] for record in of_row] for row, of_row in rows.items()},
        figure=chart.draw(panels := _panels(lines, timed=runs.timed), 3.6, legend=4, sharey=True),
        chart={"panels": panels, "note": "Click on a point for the runs of its renderer."},
    )


def make_pictures(runs: Runs) -> Result:
    first = min(map(_azimuth, runs.records))
    chosen = runs.only([record for record in runs.records if _azimuth(record) == first])
    comparison = gallery.compare_with_reference(chosen, MAX_COLUMNS)
    return Result(
        chosen,
        "Wrong pixels of each renderer.",
        "Normals (right, up, towards the camera as red, green, blue), and below their angle to those of the reference.",
        remarks=(*comparison.missing, PICTURE_NOTE, RAY_NOTE),
        figure=gallery.draw(comparison.blocks, largest=comparison.largest),
    )


def _line(name: str, preset: str, of_row: list[records.Record]) -> Line:
    ok = [record for record in of_row if record["status"] == "ok"]  # others may have a smaller image
    sums = {key: [records.measured(record, key) for record in ok] or [None] for key in SUMMED}
    failed = [record for record in of_row if record["status"] != "ok"]
    line = {"renderer": name, "preset": preset, "cameras": len(of_row), "failed": len(failed)}
    line |= {key: None if None in values else sum(values) for key, values in sums.items()}
    line |= {key: records.median_or_none(records.measured(record, key) for record in ok) for key in MEDIANS}
    has_fraction = line["hits"] and line["pixel_errors"] is not None
    line["fraction"] = line["pixel_errors"] / line["hits"] if has_fraction else None
    return line | {"reason": failed[0]["reason"] if failed else ""}


def _verdict(rows: dict[records.Row, list[records.Record]], lines: list[Line]) -> str:
    """The cheapest renderer with few wrong pixels, chosen without the last camera, whose pixels are then stated."""
    cameras, limit = max(line["cameras"] for line in lines), table.percent(MAX_WRONG_FRACTION_OF_HITS)
    all_ok = {line["renderer"] for line in lines if line["cameras"] == cameras and not line["failed"]}
    complete = {row.name: sorted(of_row, key=_azimuth) for row, of_row in rows.items() if row.name in all_ok}
    kept = {name: _line(name, "", of_row[: max(cameras - 1, 1)]) for name, of_row in complete.items()}
    cost = {line["renderer"]: line["cost"] for line in lines}
    fractions = {name: line["fraction"] for name, line in kept.items() if line["fraction"] is not None}
    good = [name for name, fraction in fractions.items() if fraction <= MAX_WRONG_FRACTION_OF_HITS]
    good.sort(key=lambda name: cost[name])
    if not good:
        fractions = {line["renderer"]: line["fraction"] for line in lines}
        return table.extremes("Wrong pixels, of all hits", fractions, f"{cameras} cameras", show=table.small_percent)
    best, line = good[0], kept[good[0]]
    text = f"With at most {limit} wrong pixels, a rendering by *{best}* needs the fewest field evaluations, "
    text += f"{format.count(cost[best])}: {line['pixel_errors']} of {line['hits']} hit pixels are wrong."
    if cameras > 1:
        last = _line(best, "", complete[best][-1:])
        text += f" From a camera whose pixels had no part in the choice: {last['pixel_errors']} of "
        text += f"{last['hits']}."
    cheaper = [line for line in lines if line["renderer"] in complete and line["fraction"] is not None]
    cheaper = [line for line in cheaper if line["cost"] < cost[best]]
    others = [f"{line['renderer']} ({table.small_percent(line['fraction'])})" for line in cheaper]
    return text + (f" Cheaper, but with more wrong pixels: {', '.join(others)}." if others else "")


def _azimuth(record: records.Record) -> float:
    return records.setting(record["config"], "view", "azimuth")[0]


def _panels(lines: list[Line], *, timed: bool) -> list[chart.Panel]:
    axes = {"cost": "field evaluations of a rendering"} | ({"forward_seconds": "runtime (seconds)"} if timed else {})
    panels = []
    for key, title in axes.items():
        drawn = []
        for line in lines:
            if line["fraction"] is not None and line[key] is not None:
                percent = 100 * max(line["fraction"], 0.5 / line["hits"])  # the axis is logarithmic
                name, share = line["renderer"], table.small_percent(line["fraction"])
                look = {"text": [[name, share]], "link": [chart.link_to_runs(name)]}
                drawn.append(chart.series(name, line["preset"], [line[key]], [percent], **look))
        panels.append(chart.panel_data("", title, Y_TITLE, drawn, height=440))
    return panels


COLUMNS = (
    *table.columns(table.word, renderer="Renderer"),
    table.Column("fraction", "Wrong pixels", show=table.small_percent, better="lower"),
    table.joined("Missed / spurious / wrong depth", dict.get, table.integer, "lost", "false", "wrong"),
    *table.raw(*SUMMED[:-1]),
    table.Column("out_of_steps", "Out of steps", show=table.integer),
    table.Column("depth_error_median", "Median depth error"),
    table.Column("error_p95", "95 % depth error"),
    table.Column("cost", "Field evaluations", show=format.count),
    *table.columns(format.seconds, forward_seconds="Rendering", step_seconds="Step"),
    table.Column("gradient_error", "Gradient error", show=table.small_percent),
    *table.raw("cameras", "failed"),
    table.Column("reason", "Not measured", show=table.word),
)

PAGES = {"fit_for": make, "fit_for_pixels": make_pictures}
