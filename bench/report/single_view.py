"""What the studies of shape from one image share: a line per row with its interval and its ratios to other rows."""

from collections.abc import Iterable
from typing import Any

from matplotlib.figure import Figure

from bench.report.data.records import (
    Record,
    RunKey,
    by_shape,
    error,
    median_of_known,
    row_of,
    run_key,
    setting,
    shared_settings,
)
from bench.report.data.runs import Runs
from bench.report.data.statistics import Interval, ratio, typical
from bench.report.medians import draw_runs, medians, scored
from bench.report.write.table import FAMILY, IDENTITY, LOOP, Column, metrics, shown, text, thousandfold

NAMES = ("iou", "chamfer_l1", "normal_consistency", "mask_iou", "psnr")
BASELINES = {"single_view_mean": "Over the mean shape", "single_view_nearest": "Over the nearest image"}  # presets
OVER = "“Over ...”: the median over shapes of the ratio of Chamfer-L1 to that row's; below 1 is better."
INTERVALS = "95 % intervals over shapes (of the sign test)"
SETTINGS = {  # of a training, by their names in notes
    "training shapes": ("task", "shapes"),
    "images of each shape": ("task", "views"),
    "steps": ("task", "training", "steps"),
    "shapes per step": ("task", "training", "shapes_per_step"),
    "rays": ("task", "training", "rays"),
    "learning rate": ("task", "training", "learning_rate"),
    "weight of the mask": ("supervision", "losses", "silhouette_weight"),
    "visual hull": ("supervision", "hull"),
}
RUNS = (FAMILY, *IDENTITY, *metrics(*NAMES, "chamfer_l2", "mask_iou_least"), *LOOP)


def over_column(heading: str, preset: str) -> Column:
    """A column with the ratio of each line to the row of a preset."""
    return shown(heading, lambda line: str(line[preset]) if line.get(preset) else "")


def columns(method: str, *ratios: Column) -> tuple[Column, ...]:
    """The first columns of a table, with the ratios to `BASELINES` last."""
    return (
        *(text("family", "Family"), text("method", method), Column("iou", "IoU")),
        Column("chamfer_l1", "Chamfer-L1", show=thousandfold),
        shown("95 % interval", lambda line: line["interval"].ends(1000) if "interval" in line else ""),
        *ratios,
        *(over_column(heading, preset) for preset, heading in BASELINES.items()),
    )


def lines_of(runs: Runs, family: str, presets: Iterable[str]) -> list[dict[str, Any]]:
    """A line per row of one family, with its ratio to the row of each of some presets under that preset."""
    own = runs.where(runs.frame.family == family).made
    errors = {row: errors_of(records) for row, records in own.rows().items()}
    others = {row: values for row, values in errors.items() if row.preset in presets}
    return [
        line
        | {"family": family, "interval": typical(by_shape(errors[row]))}
        | {"training": _of_training(records, "seconds"), "training_values": _of_training(records, "evaluations")}
        | {other.preset: over(errors[row], values) for other, values in others.items() if other != row}
        for line, (row, records) in zip(medians(own, NAMES), own.rows().items(), strict=True)
    ]


def trainings(runs: Runs) -> str:
    """A note on the settings that the trainings share, and on those in which they differ."""
    taught = [record for record in runs.records if row_of(record).preset not in BASELINES]
    return shared_settings(taught, SETTINGS)


def _of_training(records: list[Record], cost: str) -> float | None:
    return median_of_known(setting(record, cost, "training") for record in records)


def errors_of(records: Iterable[Record]) -> dict[RunKey, float]:
    """The Chamfer-L1 of each run; infinite for a failed one."""
    return {run_key(record): error(record, "chamfer_l1") for record in records}


def over(errors: dict[RunKey, float], others: dict[RunKey, float]) -> Interval | None:
    """The ratio of the errors to others over the runs that both have; None without any."""
    both = sorted(set(errors) & set(others), key=str)
    if not both:
        return None
    return ratio(*(by_shape({key: values[key] for key in both}) for values in (errors, others)))


def draw(runs: Runs) -> Figure:
    """A panel per family: the IoU of each shape, a line per row, and the median."""
    iou = scored(runs, "iou")
    figure = draw_runs(
        runs, {f"IoU, {name}": iou.where(runs.frame.family == name) for name in runs.families()}, log=False
    )
    for axis in figure.axes:
        axis.set_xlim(-0.02, 1.02)
    return figure
