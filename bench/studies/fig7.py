"""Fig. 7 of DIST: missed and spurious pixels by the convergence threshold epsilon."""

import math
from dataclasses import replace
from typing import Any

from bench.report.study import Result, Runs, Selection, gallery, records, table

PLACE = 230
READS = (Selection("fig7", alike=("dataset", "view", "prior", "task")),)
NOTES = (
    "Missed and spurious pixels are the paper's erosion and dilation, as percentages of the hits of the reference.",
    "The depth error is over the pixels that are hits in both images. Epsilon is in scene units.",
)
MAX_COLUMNS = 7
COUNTED = ("size", "hits", "lost", "false")  # from the record, or if missing from its picture


def make(runs: Runs) -> Result:
    chosen = runs.of_newest_scene()
    chosen = replace(chosen, records=sorted(chosen.records, key=lambda record: -(_epsilon(record) or -math.inf)))
    comparison = gallery.compare_with_reference(chosen, MAX_COLUMNS)
    lines = [(record, _counts(record, shown)) for record, shown in zip(chosen.records, comparison.counts, strict=True)]
    sound = [counts | {"epsilon": _epsilon(record)} for record, counts in lines if record["status"] == "ok"]
    return Result(
        chosen,
        "Missed and spurious pixels by the convergence threshold.",
        "Pictures from the largest to the smallest epsilon: normals (right, up, towards the camera as red, green, "
        "blue), and below their angle to the normals of the reference.",
        question="Which convergence threshold gives the fewest wrong pixels?",
        verdict=_verdict(sound),
        remarks=(*comparison.missing, *NOTES),
        columns=COLUMNS,
        lines=lines,
        figure=gallery.draw(comparison.blocks, largest=comparison.largest),
    )


def _verdict(counts: list[dict[str, Any]]) -> str:
    """The smallest fraction of wrong pixels, and the thresholds within one standard deviation of its count."""
    measured = [line for line in counts if "lost_share" in line and line["epsilon"] is not None]
    if not measured:
        return ""
    wrong = {line["epsilon"]: line["lost"] + line["false"] for line in measured}
    least, (worst, most) = min(wrong.values()), max(wrong.items(), key=lambda item: item[1])
    similar = [f"{epsilon:g}" for epsilon, pixels in wrong.items() if pixels - least <= math.sqrt(least)]
    share, largest = (table.small_percent(pixels / measured[0]["hits"]) for pixels in (least, most))
    return (
        f"Missed and spurious pixels are fewest at epsilon = {' or '.join(similar)} scene units: *{share}* of the "
        f"hits. At epsilon = {worst:g} they are {largest}; n = one shape."
    )


def _counts(record: records.Record, picture_counts: dict[str, Any]) -> dict[str, Any]:
    """The counts of a record, or if missing of its picture, and their fractions of the reference's hits."""
    counts = picture_counts | {name: x for name in COUNTED if (x := records.measured(record, name)) is not None}
    hits = counts.get("hits")
    return counts | {f"{name}_share": counts[name] / hits for name in ("lost", "false") if hits and name in counts}


def _epsilon(record: records.Record) -> float | None:
    value = records.setting(record["config"], "renderer", "epsilon")
    return value if isinstance(value, int | float) and value > 0 else None


COLUMNS = (  # a line is a record and its counts
    table.shown("Renderer", lambda line: line[0]["renderer"]),
    *table.through(lambda line: line[0], *table.IDENTITY, table.Column("epsilon", "Epsilon", _epsilon)),
    *table.through(lambda line: line[1], *map(table.Column, gallery.COUNT_KEYS)),
    *table.through(
        lambda line: line[1],
        table.Column("lost_share", "Missed", show=table.small_percent),
        table.Column("false_share", "Spurious", show=table.small_percent),
    ),
    *table.through(lambda line: line[0], table.metric("depth_error_median", "Median depth error")),
)

PAGES = {"fig7": make}
