"""How much a network of one image needs: the error over its training shapes, and over the images of each."""

from typing import Any

from bench.report.study import Result, Runs, Selection, compare, conditions, records, single_view, statistics, table

PLACE = 43
READS = (Selection("single_view_budget", ("task.shapes", "task.views"), setup=("machine",)),)
LABELS = {"shapes": "training shapes", "views": "images of each shape"}
NOTES = (
    "One of the two numbers varies, the other is the largest. Each point is a training of its own; all are "
    "judged by the same shapes, and a failed run counts as infinite.",
    "“Over the largest”: the median over shapes of the ratio of Chamfer-L1 to that of the largest training; "
    "above 1 is worse.",
)
COLUMNS = (
    *(*conditions.NAMED, *conditions.MEDIAN),
    table.text("ratio", "Over the largest", lambda line: str(line["ratio"] or "")),
    table.text("failed", "Failed"),
)
RUNS = (
    *(table.FAMILY, *(table.configured(key, "task", key) for key in LABELS), *table.IDENTITY),
    *table.metrics("chamfer_l1", "iou", "normal_consistency", "mask_iou"),
)


def make(runs: Runs) -> Result:
    """A line per family, row and budget."""
    largest = {key: max(map(int, runs.setting(f"task.{key}"))) for key in LABELS}
    budgets = [conditions.Condition(key, label, largest[key]) for key, label in LABELS.items()]
    lines = conditions.lines_of(runs.made.records, budgets, "chamfer_l1")
    whole = {(line["family"], line["method"]): line["runs"] for line in lines if line["at"] == largest[line["key"]]}
    lines = [line | _judged(line, largest, whole.get((line["family"], line["method"]))) for line in lines]
    return Result(
        runs,
        "Shape from one image, by the size of the training.",
        "Chamfer-L1 in scene units, times 1000, medians over shapes.",
        question="How many shapes, and images of each, does a training need?",
        verdict=_verdict(lines, largest),
        interval=single_view.INTERVALS,
        estimates=[line["error"] for line in lines],
        remarks=(single_view.trainings(runs), *NOTES),
        columns=COLUMNS,
        lines=lines,
        run_columns=RUNS,
        figure=conditions.draw(lines, budgets, label="Chamfer-L1 × 1000 (scene units)"),
    )


def _judged(line: dict[str, Any], largest: dict[str, int], whole: list[records.Record] | None) -> dict[str, Any]:
    """What failed at a budget, its median error, and its ratio to the runs of the largest one; None for that itself."""
    own, errors = line["runs"], single_view.errors_of
    same = whole is None or line["at"] == largest[line["key"]]
    return {
        "failed": f"{sum(record['status'] != 'ok' for record in own)} of {len(own)}",
        "error": statistics.typical(records.by_shape(errors(own))).times(records.SCALE),
        "ratio": None if same else single_view.over(errors(own), errors(whole)),
    }


def _verdict(lines: list[dict[str, Any]], largest: dict[str, int]) -> str:
    """Which errors differ from those of the largest training of a family."""
    ratios = [(f"{line['family']}, {line['condition']}", line["ratio"]) for line in lines]
    size = f"to the training on {largest['shapes']} shapes with {largest['views']} images each"
    said = compare.differing(ratios, size)
    return said and f"{said} One training each, so that the test is of shapes and not of trainings."


PAGES = {"single_view_budget": make}
