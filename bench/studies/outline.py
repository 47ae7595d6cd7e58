"""Shape from the outline in one view: the error of the covered area over the number of rays per pixel."""

from typing import Any

import numpy as np
import pandas as pd

from bench.report.study import Result, Runs, Selection, chart, format, statistics, table

PLACE = 27
RAYS = "view.rays_per_pixel"
READS = (Selection("outline", (RAYS,)),)
SHAPE = ["family", "solid", "seed"]
COLUMNS = (
    *(table.text("name", "Method"), table.Column("rays", "Rays per pixel"), table.Column("shapes", "Shapes")),
    *(table.Column("area", "Area error, pixels"), *table.ends("area", lambda line: line["error"])),
    *(table.Column("ratio", "Ratio to 1 ray"), *table.ends("ratio", lambda line: line["gain"])),
    *(table.Column("chamfer", "Chamfer-L1 × 1000"), table.Column("cost", "Field evaluations")),
)
NOTES = (
    "A prior's code is fitted to the mask of one image of 24 x 24 pixels, without depth. The code is penalised little.",
    "The area error sums the differences between the fractions of pixels that the fitted and the true mesh cover, each "
    "by 8 x 8 rays. At the start, the mean shape has an error of {start} pixels (median).",
    "Rows named `area` compare a pixel's mean opacity with the fraction that the shape covers. The other rows compare "
    "single rays: in a pixel of which a fraction k of n rays is covered, the k rays nearest to the surface should hit.",
    "With 1 ray, it goes through the centre of each pixel. With 4 and 16, each iteration draws a random ray in each of "
    "2 x 2 or 4 x 4 squares of the pixel. A run without a surface counts as infinite.",
    "Values are medians over shapes, with intervals of the sign test. A ratio compares the same shapes.",
)


def make(runs: Runs) -> Result:
    """A line per method and number of rays per pixel, over all shapes."""
    runs = runs.executed
    frame = runs.frame[[*SHAPE, "row", "preset"]].assign(
        rays=runs.number(f"config.{RAYS}"),
        error=runs.number("area_error").fillna(np.inf),  # also of runs that ended without progress
        start=runs.number("start_area_error"),
        chamfer=1e3 * runs.number("chamfer_l1").fillna(np.inf),
        cost=runs.number("evaluations_cost"),
    )
    lines = _lines(frame)
    return Result(
        runs,
        "Outlines by several rays per pixel.",
        "The error of the covered area after a fit to a mask, over rays per pixel.",
        question="Does a silhouette loss fit an outline better with several rays per pixel?",
        verdict=_verdict(lines),
        interval="95 % intervals over shapes (of the sign test)",
        remarks=[note.format(start=f"{frame.start.median():.3g}") for note in NOTES],
        columns=COLUMNS,
        lines=lines,
        figure=chart.draw(_panels(lines), 3.4, legend=2),
    )


def _lines(frame: pd.DataFrame) -> list[dict[str, Any]]:
    lines = []
    for (name, preset), row in frame.groupby(["row", "preset"], sort=False):
        groups = {rays: group.set_index(SHAPE).error for rays, group in row.groupby("rays")}
        for rays, group in row.groupby("rays"):
            error = statistics.typical([np.array([value]) for value in groups[rays]])
            gain = None
            if rays != 1 and 1 in groups and groups[1].index.equals(groups[rays].index):
                gain = statistics.ratio(
                    [np.array([value]) for value in groups[rays]], [np.array([value]) for value in groups[1]]
                )
            ends = {"area": error.value, "error": error, "ratio": gain and gain.value, "gain": gain}
            costs = {"chamfer": float(group.chamfer.median()), "cost": format.number(group.cost.median())}
            lines.append({"name": name, "preset": preset, "rays": int(rays), "shapes": len(group), **ends, **costs})
    return lines


def _verdict(lines: list[dict[str, Any]]) -> str:
    """The rows whose area error 4 rays per pixel change significantly, with the ratio to 1 ray."""
    compared = [line for line in lines if line["rays"] == 4 and line["gain"] is not None]
    verdicts = statistics.ratio_verdicts([line["gain"] for line in compared])
    if not compared:
        return ""
    texts = {
        statistics.Verdict.DIFFERS: "",
        statistics.Verdict.NOT_DECIDABLE: " (undecided)",
    }
    parts = [
        f"{line['name'].partition(',')[0]} *{format.number(line['ratio'])}*{texts.get(verdict, ' (not significant)')}"
        for line, verdict in zip(compared, verdicts, strict=True)
    ]
    return f"Area error with 4 rays per pixel over that with 1: {'; '.join(parts)}."


def _panels(lines: list[dict[str, Any]]) -> list[chart.Panel]:
    panels = []
    for label, key in (("area error (pixels)", "error"), ("Chamfer-L1 × 1000", "chamfer")):
        rows: dict[tuple[str, str], list[dict[str, Any]]] = {}
        for line in lines:
            rows.setdefault((line["name"], line["preset"]), []).append(line)
        curves = [
            chart.curve(*row, [line["rays"] for line in points], [line[key] for line in points])
            for row, points in rows.items()
        ]
        panels.append(chart.panel_data("", "rays per pixel", label, curves))
    return panels


PAGES = {"outline": make}
