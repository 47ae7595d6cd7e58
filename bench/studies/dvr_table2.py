"""Table 2 and Figs. 6 to 8 of DVR: shape and colour from rendered photographs."""

import math
from typing import Any

from bench.records.published import DVR_TABLE2
from bench.records.record import as_number
from bench.report.data.records import CHAMFER_SCALE, Record, Row, grouped, row_of, setting
from bench.report.study import Result, Runs, Selection, format, gallery, medians, table

PLACE = 45
READS = (Selection("dvr_table2", setup=("scenes", "machine")),)
SEEN_ERROR, SEEN_LABEL = "seen_chamfer_l1", "Chamfer-L1, seen × 1000"
NAMES = ("seen_accuracy", "seen_completeness", SEEN_ERROR, "chamfer_l1", "psnr", "ssim", "mask_iou")
NOTES = (
    "“Seen”: the parts of both surfaces that an input photograph shows. No photograph shows the underside. Distances "
    "are in scene units, times 1000. Two samples of 30,000 points of one surface have a Chamfer-L1 of 5.7 to 7.1.",
    "Colours are compared at hits in held-out photographs. For volume renderers and the relaxed boundary, they are "
    "compared at all pixels of the mask, on black.",
    "Volume renderers use the cross entropy between opacity and mask, and a limited number of samples per ray.",
    "“Published” is DVR, Table 2: photographs of three scans of DTU, in mm. These numbers cannot be compared directly "
    "with the measured rows.",
)
NOTED_SETTINGS = {  # names in the note on optimised rows, and configuration keys
    "field": ("field",),
    "learning rate": ("task", "optimiser", "learning_rate"),
    "iterations": ("task", "optimiser", "iterations"),
    "rays": ("task", "rays"),
    "weight of the mask": ("task", "losses", "silhouette_weight"),
    "eikonal weight": ("task", "losses", "eikonal"),
}
COLUMNS = (
    table.text("method", "Method"),
    *table.columns(table.thousandfold, seen_accuracy="Accuracy", seen_completeness="Completeness"),
    *table.columns(table.thousandfold, seen_chamfer_l1="Chamfer-L1, seen", chamfer_l1="all"),
    *table.columns(psnr="PSNR", ssim="SSIM", mask_iou="Mask IoU"),
    *medians.COST,
)
RUNS = (
    table.FAMILY,
    *table.IDENTITY,
    *table.metrics(*NAMES, "seen_fscore", "mask_iou_least", "own_psnr", "own_mask_iou"),
    *table.LOOP,
    *(table.configured(name.replace(" ", "_"), *path) for name, path in NOTED_SETTINGS.items()),
)
PICTURE_COLUMNS = (table.FAMILY, *table.IDENTITY, *table.metrics(SEEN_ERROR, "psnr"))

MAX_SCENES = 2
LOOKALIKES = {  # presets not shown in figures, because they look like another row
    *("rgb_dist", "rgb_idr", "rgb_naive", "rgb_relaxed_boundary", "rgb_volsdf", "rgb_unisurf"),
    *("rgb_newton_auto", "rgbd_dvr", "dvr_paper_depth", "stereo", "poisson_5"),
}
DEPTH_PRESETS = ("rgbd_", "poisson", "dvr_paper_depth")  # prefixes of presets that also use depths
ARRAYS = ("photograph", "colours", "normals", "hit")


def make(runs: Runs) -> Result:
    lines = sorted(medians.medians(runs, NAMES), key=lambda x: math.inf if x[SEEN_ERROR] is None else x[SEEN_ERROR])
    scenes = format.plural(len(grouped(runs.records, medians.scene_of)), "scene")
    published = [
        {"method": f"published: {name}", **dict(zip(NAMES, (value / CHAMFER_SCALE for value in values), strict=False))}
        for name, values in DVR_TABLE2.items()
    ]
    optimised = [record for record in runs.records if setting(record["config"], "task", "optimiser")]
    without_depth = [line for line in lines if not line["preset"].startswith(DEPTH_PRESETS)]
    errors = {f"{SEEN_LABEL} (scene units)": CHAMFER_SCALE * medians.scored(runs, SEEN_ERROR)}
    rows = [Row(line["preset"], line["method"]) for line in lines]
    return Result(
        runs,
        "Shape and colour from photographs.",
        f"Median errors over {scenes} on the surface that the photographs show; the figure has a point per scene and "
        f"the median.{_photograph_settings(runs)}",
        question="Which method best reconstructs shape and colour from photographs?",
        verdict=table.extremes(
            "Median Chamfer-L1 × 1000 of the seen surface, without depth",
            medians.comparable_medians(without_depth, SEEN_ERROR),
            scenes,
            show=table.thousandfold,
        ),
        remarks=(_settings(optimised), _partial_rows(lines), *NOTES),
        columns=COLUMNS,
        lines=[*lines, *published],
        run_columns=RUNS,
        figure=medians.draw_runs(runs, errors | medians.cost(runs), rows),
    )


def _settings(records: list[Record]) -> str:
    """A note on the settings that all records share, and on those in which they differ; empty without settings."""
    values = {
        name: {str(value): value for record in records if (value := setting(record["config"], *path)) is not None}
        for name, path in NOTED_SETTINGS.items()
    }
    shared = [f"{name} {next(iter(each))}" for name, each in values.items() if len(each) == 1]
    differ = []
    for name, each in values.items():
        ordered = sorted(each.values(), key=lambda x: (1, str(x)) if as_number(x) is None else (0, x))
        differ += [f"{name} ({', '.join(map(str, ordered))})"] if len(each) > 1 else []
    parts = [("Rows share: ", shared), ("Rows differ in: ", differ)]
    return " ".join(f"{word}{', '.join(listed)}." for word, listed in parts if listed)


def _partial_rows(lines: list[dict[str, Any]]) -> str:
    count = max((line["runs"] for line in lines), default=0)
    partial = [f"{line['method']} ({line['runs']} of {count})" for line in lines if line["runs"] < count]
    return f"Do not compare the medians of rows without all scenes: {'; '.join(partial)}." if partial else ""


def _photograph_settings(runs: Runs) -> str:
    tasks = [r["config"]["task"] for r in runs.records if setting(r["config"], "task", "optimiser")]
    if not tasks or setting(tasks[0], "images", "views") is None:
        return ""
    iterations = sorted({task["optimiser"]["iterations"] for task in tasks})
    return (
        f" {tasks[0]['images']['views']} photographs, {tasks[0]['longest']} pixels along the longer side, one in "
        f"{tasks[0]['held_out']} held out; {' or '.join(map(str, iterations))} iterations."
    )


def figures(runs: Runs) -> Result:
    distinct = [row for row in runs.rows() if row.preset.removeprefix("tuned/") not in LOOKALIKES]
    rows, by_scene = distinct or list(runs.rows()), grouped(runs.records, medians.scene_of)
    shown = {
        name: {row_of(record): record for record in group if row_of(record) in rows}
        for name, group in list(by_scene.items())[:MAX_SCENES]
    }
    scenes = {name: gallery.Scene(runs, group.values(), ARRAYS) for name, group in shown.items()}
    blocks = [_block(name, rows, shown[name], scene) for name, scene in scenes.items()]
    return Result(
        runs,
        "Shapes from photographs in pictures.",
        f"Colours, and normals (right, up, towards the camera as red, green, blue), of {len(shown)} of "
        f"{format.plural(len(by_scene), 'scene')}, seen by the camera of a held-out photograph.",
        remarks=(
            "Mesh rows have the colours of the photographs that show a vertex. Other rows have the colours of a field.",
            "The figure shows one of several rows with similar results. The run folder of each run has summary.png.",
            *gallery.missing_notes(scenes.values()),
        ),
        run_columns=PICTURE_COLUMNS,
        figure=gallery.draw(blocks),
    )


def _block(name: str, rows: list[Row], record_of: dict[Row, Record], scene: gallery.Scene) -> gallery.Block:
    paints = {"colours": gallery.colours(), "normals": gallery.normals()}
    photograph = scene.shared(record_of.values(), lambda arrays: [arrays["photograph"]])
    first = {"colours": photograph, "normals": gallery.Cell()}
    cells = {
        kind: [first[kind], *(scene.cell(record_of.get(row), paint) for row in rows)] for kind, paint in paints.items()
    }
    return gallery.Block(name, ["held out", *(row.name for row in rows)], cells)


PAGES = {"dvr_table2": make, "dvr_figures": figures}
