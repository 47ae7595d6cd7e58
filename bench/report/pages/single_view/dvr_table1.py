"""Table 1 of DVR: shape from one image, by what the training may know, measured and published."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import Record, RunKey, by_shape, error, measured, median_of_known, run_key, setting
from bench.report.data.statistics import Interval, bootstrap, geometric_ratio, median
from bench.report.write import chart
from bench.report.write.answer import Answer, ranked
from bench.report.write.result import Result
from bench.report.write.shapes import lines_of
from bench.report.write.table import (
    FAMILY,
    IDENTITY,
    LOOP,
    Column,
    metrics,
    shown,
    text,
    thousandfold,
    to_data,
    to_table,
)

PLACE = 41
TRAINED = ("RGB", "Depth", "RGB and depth", "Masks, hull", "Occupancy")  # rows of a network, by what taught it
READS = (
    Selection("dvr_table1", ("single_view",), ("dataset", "task", "supervision", "silhouette"), setup=("machine",)),
)
NAMES = ("iou", "chamfer_l1", "normal_consistency", "mask_iou", "psnr")
COMPARED = {"single_view_mean": "Over the mean shape", "single_view_nearest": "Over the nearest image"}  # rows
# DVR (Niemeyer et al. 2020), Table 1: Chamfer-L1, in tenths of the largest edge of a shape's bounding box.
PUBLISHED = {
    "car": {"DVR, RGB": 0.196, "DVR, depth": 0.179, "ONet (3D)": 0.181},
    "sofa": {"DVR, RGB": 0.224, "DVR, depth": 0.221, "ONet (3D)": 0.217},
    "table": {"DVR, RGB": 0.280, "DVR, depth": 0.180, "ONet (3D)": 0.185},
    "plane": {"DVR, RGB": 0.190, "DVR, depth": 0.143, "ONet (3D)": 0.151},
}
NOTES = (
    "Shapes that no training has seen, each from one image; its other images judge the mask and the colours. "
    "Chamfer-L1 in scene units, times 1000.",
    "Trainings from images spend their first steps on the visual hull of the masks, without a renderer; “Masks, hull” "
    "does nothing else, so that the other rows differ from it by what the renderer teaches.",
    "Rows without a training: the code of the family's prior that DIST finds by the mask of the image, which knows the "
    "camera, and whose prior was trained on true distances; the zero set of the training shapes' mean distance; the "
    "training shape with the nearest image; the one with the least Chamfer-L1, which no retrieval can beat in that.",
    "“Trained in”: once for the family, beside another training. “Inference”: the network with its mesh, the search of "
    "the code without, or the search among training shapes.",
    "“Over ...”: the ratio of geometric means of Chamfer-L1 to that row over the same shapes; below 1 is better.",
    "“Published” is DVR, Table 1: ShapeNet, Chamfer-L1 in tenths of the largest edge of a shape's bounding box, which "
    "cannot be compared directly with the measured rows.",
)
INTERVAL = shown("95 % interval", lambda line: line["interval"].ends(1000) if "interval" in line else "")
RATIOS = tuple(
    shown(heading, lambda line, key=key: str(line[key]) if line.get(key) else "") for key, heading in COMPARED.items()
)
COLUMNS = (
    *(text("family", "Family"), text("method", "Training"), Column("iou", "IoU")),
    Column("chamfer_l1", "Chamfer-L1", show=thousandfold),
    INTERVAL,
    *RATIOS,
    *(Column("normal_consistency", "Normals"), Column("mask_iou", "Mask IoU"), Column("psnr", "PSNR")),
    *(Column("training", "Trained in", show=format.seconds), Column("seconds", "Inference", show=format.seconds)),
    *(text("failed", "Failed"), text("published", "Published")),
)
RUNS = (FAMILY, *IDENTITY, *metrics(*NAMES, "chamfer_l2", "mask_iou_least"), *LOOP)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per family and row."""
    lines: list[dict[str, Any]] = []
    for name, records in experiment.families().items():
        lines += compared_lines(name, replace(experiment, records=records), COMPARED)
        published = PUBLISHED.get(name.partition("/")[0], {})
        lines += [
            {"family": name, "method": f"published: {who}", "published": f"{x:.3f}"} for who, x in published.items()
        ]
    return Result(
        experiment,
        "Shape from one image.",
        "Medians over shapes, by what the training of the network may know.",
        interval="95 % bootstrap intervals over shapes",
        estimates=[line["interval"] for line in lines if "interval" in line],
        remarks=NOTES,
        data=to_data(RUNS, experiment.records),
        table=to_table(COLUMNS, lines),
        figure=draw(experiment),
    )


def compared_lines(family: str, experiment: Experiment, presets: Iterable[str]) -> list[dict[str, Any]]:
    """A line per row of one family, with its ratios to other rows, which are named by their presets."""
    errors = {row: errors_of(found) for row, found in experiment.rows().items()}
    lines = []
    for line, (row, values) in zip(lines_of(experiment, NAMES), errors.items(), strict=True):
        records, others = (
            experiment.rows()[row],
            [other for other in errors if other.preset in presets and other != row],
        )
        line |= {"interval": bootstrap(by_shape(values), median, seed=0)}
        line |= {"training": _of_training(records, "seconds"), "training_values": _of_training(records, "evaluations")}
        lines.append({"family": family, **line, **{one.preset: over(values, errors[one]) for one in others}})
    return lines


def _of_training(records: list[Record], cost: str) -> float | None:
    return median_of_known(setting(record, cost, "training") for record in records)


def errors_of(records: list[Record]) -> dict[RunKey, float]:
    """The Chamfer-L1 of each run; infinite for a failed one."""
    return {run_key(record): error(record, "chamfer_l1") for record in records}


def over(errors: dict[RunKey, float], others: dict[RunKey, float]) -> Interval | None:
    """The ratio of the errors to others over the runs that both have; None without any."""
    both = sorted(set(errors) & set(others), key=str)
    if not both:
        return None
    return geometric_ratio(*(by_shape({key: values[key] for key in both}) for values in (errors, others)))


@style.styled
def draw(experiment: Experiment) -> Figure:
    """A panel per family: the IoU of each shape, a column per row, the median as a line."""
    families = experiment.families()
    figure, axes = chart.sheet(2.8, 1, len(families), sharey="row")
    for axis, (name, records) in zip(axes[0], families.items(), strict=True):
        rows = replace(experiment, records=records).rows()
        for place, (row, found) in enumerate(rows.items()):
            known = [measured(r, "iou") if r["status"] == "ok" else 0.0 for r in found]  # a failed run is the worst
            known = [value for value in known if value is not None]
            if known:
                chart.points(axis, row.preset, [place] * len(known), known, ms=3, alpha=0.6)
                axis.plot([place - 0.3, place + 0.3], [median(known)] * 2, color="#222222", lw=1.2)
        axis.set_xticks(range(len(rows)), [row.name for row in rows], rotation=35, ha="right", fontsize=6)
        axis.set(title=name, ylim=(0, 1))
    axes[0, 0].set_ylabel("IoU of each shape, and the median")
    return figure


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The best training by the Chamfer-L1, in each family."""
    said = []
    for family, found in data.groupby("family", sort=False):
        rows = [(name, value) for name, value in ranked(found, "chamfer_l1").rows if name in TRAINED]
        if rows:
            said.append(
                f"{family}: {rows[0][0]} *{thousandfold(rows[0][1])}*, RGB alone {thousandfold(dict(rows).get('RGB'))}"
            )
    return Answer(
        "How much must a training know, so that one image gives a shape?",
        f"Least median Chamfer-L1 × 1000 of the trainings: {'; '.join(said)}." if said else "",
    )
