"""Table 1 and Figs. 4 and 5 of DVR: shape from one image, by the observations that the training uses."""

from typing import Any

from matplotlib.figure import Figure

from bench.report.data.records import SHAPENET, Record, Row, by_shape, error, grouped, median_or_none, row_of, setting
from bench.report.data.statistics import typical
from bench.report.study import Result, Runs, Selection, compare, format, gallery, medians, published, table

PLACE = 41
READS = (Selection("dvr_table1", setup=("machine",), conditions=("task.training.seed",)),)
BASELINES = {"single_view_mean": "Over the mean shape", "single_view_nearest": "Over the nearest image"}  # presets
MEDIANS = ("iou", "chamfer_l1", "normal_consistency", "mask_iou", "psnr")
NOTES = (
    "Each shape is unseen in training, and has one input image. Its other images evaluate the mask and the colours.",
    "Training from images begins with the visual hull of the masks, without a renderer. “Masks, hull” has only that.",
    "“DVR's own”: occupancy, DVR's renderer and losses from the first step. With RGB, the hull gives the depth of Eq. "
    "15. At scale=desk, a step has 4 images of 128 rays, the learning rate is 1e-3, and gradients are clipped to a "
    "norm of 1. A seed is one training run.",
    "Without training: the latent code that DIST fits to the mask, with the known camera; the mean shape; the training "
    "shape with the nearest image; the training shape with the smallest Chamfer-L1, the limit of any retrieval.",
    "“Over the mean shape” and “Over the nearest image”: the median over shapes of the ratio of Chamfer-L1 to that of "
    "this row. A ratio below 1 is better.",
    "“Published” is DVR, Table 1: ShapeNet, in tenths of the largest edge of a shape's bounding box. These numbers "
    "cannot be compared directly with the measured rows.",
)
COLUMNS = (
    *(*table.columns(table.word, family="Family", method="Training"), *table.columns(iou="IoU")),
    *table.columns(table.thousandfold, chamfer_l1="Chamfer-L1"),
    table.shown("95 % interval", lambda line: line["interval"].ends(1000) if "interval" in line else ""),
    *(table.shown(heading, lambda line, name=name: str(line.get(name) or "")) for name, heading in BASELINES.items()),
    *table.columns(normal_consistency="Normals", mask_iou="Mask IoU", psnr="PSNR"),
    *table.columns(format.seconds, training="Training of a family", seconds="Inference, with mesh"),
    *table.columns(table.word, failed="Failed", published="Published"),
)
RUNS = (table.FAMILY, *table.IDENTITY, *table.metrics(*MEDIANS, "chamfer_l2", "mask_iou_least"), *table.LOOP)
LENGTH_ROWS = ("single_view_dvr_rgb", "single_view_occupancy", *BASELINES)  # presets, compared with a longer training
LENGTH = compare.Comparison(
    title="A longer training of DVR's RGB row.",
    question="Does a longer training lower the error of DVR's own RGB training?",
    reference="single_view_dvr_long",
    name="36,000 steps",
    metric="chamfer_l1",
    label="Chamfer-L1 × 1000\n(scene units)",
    hidden=("evaluations",),
    notes=lambda _: (
        "Error: Chamfer-L1 in scene units, times 1000. All rows have the same cars, unseen in training, and one "
        "training run. The other trainings have 4,500 steps. “Occupancy” is 3D supervision.",
        f"{compare.RATIO} {compare.FAILURE}",
    ),
)
IMAGES = {"given": "given", "photograph": "another\nimage"}  # arrays of images.npz
PICTURE_COLUMNS = (table.FAMILY, *table.IDENTITY, *table.metrics("chamfer_l1", "iou"))


def make(runs: Runs) -> Result:
    # Shapes that at least half of the rows of their family have, so that medians compare.
    rows, all_rows = (runs.frame.groupby(keys)["row"].transform("nunique") for keys in (["family", "solid"], "family"))
    runs = runs.where(2 * rows >= all_rows)
    family_lines = {name: _lines_of(runs, name) for name in runs.families()}
    lines = []
    for name, rows in family_lines.items():
        printed = published("dvr_table1").get(name.removeprefix(SHAPENET), {}).items()
        lines += rows
        lines += [{"family": name, "method": f"published: {row}", "published": number} for row, number in printed]
    return Result(
        runs,
        "Shape from one image.",
        "Medians over shapes for each kind of training, of costs over runs that ended ok; Chamfer-L1 in scene units, "
        "times 1000.",
        question="With which observations in training does a network reconstruct a shape best from one image?",
        verdict=" ".join(filter(None, (_verdict(name, rows) for name, rows in family_lines.items()))),
        interval=compare.INTERVAL,
        estimates=[line["interval"] for line in lines if "interval" in line],
        remarks=NOTES,
        columns=COLUMNS,
        lines=lines,
        run_columns=RUNS,
        figure=draw(runs),
    )


def longer(runs: Runs) -> Result:
    """The longer training beside the usual one and the baselines, on the family that has it."""
    families = {*runs.frame.family[runs.frame.preset == LENGTH.reference]}
    is_first = runs.setting("task.training.seed").isin(["", "0"])
    rows = runs.frame.preset.isin([LENGTH.reference, *LENGTH_ROWS])
    return LENGTH(runs.where(rows & runs.frame.family.isin(families) & is_first))


def _lines_of(runs: Runs, family: str) -> list[dict[str, Any]]:
    """A line per row of one family; under each preset of `BASELINES`, the ratio to its row."""
    runs = runs.where(runs.frame.family == family).executed
    errors = {row: medians.errors_of(records, "chamfer_l1") for row, records in runs.rows().items()}
    baselines = {row: values for row, values in errors.items() if row.preset in BASELINES}
    return [
        line
        | {"family": family, "interval": typical(by_shape(errors[row]))}
        | {"training": median_or_none(setting(record, "seconds", "training") for record in records)}
        | {base.preset: medians.paired_ratio(errors[row], values) for base, values in baselines.items() if base != row}
        for line, (row, records) in zip(medians.medians(runs, MEDIANS), runs.rows().items(), strict=True)
    ]


def _verdict(family: str, lines: list[dict]) -> str:
    """The trainings of a family by their Chamfer-L1; only trainings with the most shapes."""
    shapes = {line["method"]: len(line["interval"].points) for line in lines if line["training"] is not None}
    max_shapes = max(shapes.values(), default=0)
    errors = {line["method"]: line["chamfer_l1"] for line in lines if shapes.get(line["method"]) == max_shapes}
    title = f"Median Chamfer-L1 × 1000 of {family}"
    return table.extremes(title, errors, format.plural(max_shapes, "shape"), show=table.thousandfold)


def draw(runs: Runs) -> Figure:
    iou = medians.scored(runs, "iou")
    panels = {f"IoU, {name}": iou.where(runs.frame.family == name) for name in runs.families()}
    figure = medians.draw_runs(runs, panels, log=False)
    for axis in figure.axes:
        axis.set_xlim(-0.02, 1.02)
    return figure


def figures(runs: Runs) -> Result:
    runs = runs.executed
    rows, by_scene = list(runs.rows()), grouped(runs.records, medians.scene_of)
    shown = {scene: end for group in runs.families().values() for scene, end in _ends(group, rows[0]).items()}
    scenes = {name: gallery.Scene(runs, by_scene[name], (*IMAGES, "normals", "hit")) for name in shown}
    lines = {f"{name}, {end}": _line(rows, by_scene[name], scenes[name]) for name, end in shown.items()}
    return Result(
        runs,
        "Shapes from one image in pictures.",
        "For each family, the shapes with the smallest and the largest Chamfer-L1 of the first row: images, and the "
        "normals of each row.",
        remarks=(
            "The encoder sees only the given image. Normals (right, up, towards the camera as red, green, blue) are "
            "seen by the camera of another image, which is no input of any row.",
            *gallery.missing_notes(scenes.values()),
        ),
        run_columns=PICTURE_COLUMNS,
        figure=gallery.draw([gallery.Block("", [*IMAGES.values(), *(row.name for row in rows)], lines)]),
    )


def _line(rows: list[Row], records: list[Record], scene: gallery.Scene) -> list[gallery.Cell]:
    record_by_row = {row_of(record): record for record in reversed(records)}  # the first of several trainings
    images = [scene.full_picture(records, name) for name in IMAGES]
    return [*images, *(scene.cell(record_by_row.get(row), gallery.normals()) for row in rows)]


def _ends(records: list[Record], row: Row) -> dict[str, str]:
    """The scenes of a family's best and worst shape by the error of a row, each with its label."""
    ordered = sorted((r for r in records if row_of(r) == row), key=lambda record: error(record, "chamfer_l1"))
    ends = {0: "best", -1: "worst"} if ordered else {}
    return {medians.scene_of(ordered[index]): end for index, end in ends.items()}


PAGES = {"dvr_table1": make, "dvr_length": longer, "single_view_figures": figures}
