"""Aggressive marching on distances and on truncated distances: wrong pixels and field evaluations."""

from typing import Any

import numpy as np
import pandas as pd

from bench.report.study import Result, Runs, Selection, chart, compare, statistics, table

PLACE = 24
KEYS = ("renderer.alpha", "renderer.step_clamp", "prior.truncation")
READS = (Selection("truncation", KEYS, setup=Selection.WITHOUT_MACHINE),)
SERIES = {  # (truncated prior, clamped steps): name, and the preset that gives the line style
    (True, True): ("truncated field, clamped steps: DIST's own", "dist_aggressive"),
    (True, False): ("truncated field", "dist_step_floor"),
    (False, True): ("distances, clamped steps", "dist_dynamic"),
    (False, False): ("distances", "dist_capped"),
}
DISTANCES = (False, False)
SHAPE = ["family", "solid"]
WRONG, COST = "wrong pixels (fraction of hits)", "field evaluations\n(relative to distances, alpha = 1)"
COLUMNS = (
    *(table.text("field", "Field and steps"), table.Column("alpha", "Alpha"), table.Column("shapes", "Shapes")),
    *(
        table.Column("wrong", "Wrong pixels", show=table.small_percent),
        *table.ends("wrong", lambda line: line["share"]),
    ),
    *(table.Column("cost", "Field evaluations, ratio"), *table.ends("cost", lambda line: line["ratio"])),
)
NOTES = (
    "Wrong pixels are missed, spurious, or more than 0.02 scene units off in depth, relative to the hits of a float64 "
    "reference. The ratio of evaluations is relative to plain sphere tracing of distances: alpha = 1, no clamp.",
    "A truncated field is a prior trained on distances clamped at 0.1 scene units, like DeepSDF's networks. Farther "
    "from the surface, its values are not constrained. Clamped steps clamp field values at 0.1 before alpha, like "
    "DIST's official code.",
)
Kind = tuple[bool, bool]  # whether the prior is truncated, and whether steps are clamped
Line = dict[str, Any]


def make(runs: Runs) -> Result:
    runs = runs.executed
    frame = runs.frame[SHAPE].assign(
        alpha=runs.number("config.renderer.alpha"),
        truncated=runs.number("config.prior.truncation").notna(),
        clamped=runs.number("config.renderer.step_clamp").notna(),
        wrong=sum(runs.number(name) for name in ("lost", "false", "wrong")) / runs.number("hits"),
        queries=runs.number("queries"),
    )
    plain = _of_kind(frame, DISTANCES)
    plain_queries = plain[plain.alpha == 1].groupby(SHAPE).queries.mean()
    lines = [line for kind in SERIES for line in _lines(_of_kind(frame, kind), kind, plain_queries)]
    return Result(
        runs,
        "Aggressive marching on distances and on truncated distances.",
        "Wrong pixels and field evaluations of a rendering over alpha, as medians over shapes.",
        question="Does aggressive marching need a truncated field, or clamped steps?",
        verdict=_verdict({(line["kind"], line["alpha"]): line for line in lines}),
        interval=compare.INTERVAL,
        remarks=NOTES,
        columns=COLUMNS,
        lines=lines,
        figure=chart.draw(_panels(lines), 3.1, legend=2),
    )


def _of_kind(frame: pd.DataFrame, kind: Kind) -> pd.DataFrame:
    return frame.loc[(frame.truncated == kind[0]) & (frame.clamped == kind[1])]


def _lines(frame: pd.DataFrame, kind: Kind, plain_queries: pd.Series) -> list[Line]:
    lines = []
    for alpha, group in frame.groupby("alpha"):
        shapes = group.groupby(SHAPE)[["wrong", "queries"]].mean()
        shapes = shapes.assign(ratio=shapes.queries / plain_queries).dropna()
        share, ratio = (statistics.typical([np.array([x]) for x in values]) for values in (shapes.wrong, shapes.ratio))
        identity = {"field": SERIES[kind][0], "kind": kind, "alpha": alpha, "shapes": len(shapes)}
        lines.append({**identity, "wrong": share.value, "share": share, "cost": ratio.value, "ratio": ratio})
    return lines


def _verdict(lines: dict[tuple[Kind, float], Line]) -> str:
    kinds = {"plain": DISTANCES, "clamped": (False, True), "both": (True, True)}
    if not all((kind, alpha) in lines for kind in kinds.values() for alpha in (1.0, 1.5)):
        return ""
    wrong = {name: table.small_percent(lines[kind, 1.5]["wrong"]) for name, kind in kinds.items()}
    plain, clamped, both = (lines[kind, 1.5] for kind in kinds.values())
    return (
        f"Wrong pixels at alpha = 1.5, relative to the hits: *{wrong['plain']}* on distances, {wrong['clamped']} with "
        f"clamped steps, {wrong['both']} on a truncated field with clamped steps; n = {plain['shapes']} shapes. Field "
        f"evaluations of these three, relative to alpha = 1 on distances: {plain['cost']:.2f}, {clamped['cost']:.2f} "
        f"and {both['cost']:.2f}."
    )


def _panels(lines: list[Line]) -> list[chart.Panel]:
    panels = []
    for label, key in ((WRONG, "share"), (COST, "ratio")):
        curves = [
            chart.curve(name, preset, [line["alpha"] for line in kind_lines], [line[key] for line in kind_lines])
            for kind, (name, preset) in SERIES.items()
            if (kind_lines := [line for line in lines if line["kind"] == kind])
        ]
        panels.append(chart.panel_data("", "alpha", label, curves))
    return panels


PAGES = {"truncation": make}
