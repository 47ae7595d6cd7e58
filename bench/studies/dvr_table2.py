"""Table 2 and Figs. 6 to 8 of DVR: shape and colour from rendered photographs."""

import numpy as np
import pandas as pd

from bench.records.metrics import DVR_TABLE2
from bench.records.read import curve_lines
from bench.report.data.kept import KEPT
from bench.report.data.records import SCALE, Record, Row, grouped, row_of, setting
from bench.report.study import Result, Runs, Selection, chart, curves, format, gallery, medians, style, table
from bench.report.tuning import TUNED

PLACE = 45
READS = (Selection("dvr_table2", setup=("scenes", "machine")),)
SEEN = "seen_chamfer_l1"
NAMES = ("seen_accuracy", "seen_completeness", SEEN, "chamfer_l1", "psnr", "ssim", "mask_iou")
NOTES = (
    "“Seen” is what a given photograph sees of either surface, as none sees the underside; distances are in scene "
    "units, times 1000, and two samplings of one surface by 30,000 points have a Chamfer-L1 of 5.7 to 7.1.",
    "Colours are compared at hits on held-out photographs; with volumes and the relaxed boundary on all rays of the "
    "foreground, in front of black.",
    "All rows but DVR's own share one field, rate and iterations; volumes have the cross entropy of their opacity for "
    "the masks and a budget of samples a ray.",
    "DVR's own rows have their paper's rate and no more iterations than others, but the one that has ten times both.",
    "“Published” is DVR, Table 2: photographs of three scans of DTU, in mm, which cannot be compared directly with the "
    "measured rows.",
)
COLUMNS = (
    table.text("method", "Method"),
    table.Column("seen_accuracy", "Accuracy", show=table.thousandfold),
    table.Column("seen_completeness", "Completeness", show=table.thousandfold),
    table.Column(SEEN, "Chamfer-L1, seen", show=table.thousandfold),
    table.Column("chamfer_l1", "all", show=table.thousandfold),
    *(table.Column("psnr", "PSNR"), table.Column("ssim", "SSIM"), table.Column("mask_iou", "Mask IoU")),
    *medians.COST,
)
RUNS = (
    table.FAMILY,
    *table.IDENTITY,
    *table.metrics(*NAMES, "seen_fscore", "mask_iou_least", "own_psnr", "own_mask_iou"),
    *table.LOOP,
)
PICTURED = (table.FAMILY, *table.IDENTITY, *table.metrics(SEEN, "psnr"))

RISING = 0.5  # dB
SCENES = 2  # of `figures`
ALIKE = {  # rows that are not shown there, since they look as another does
    *("rgb_dist", "rgb_idr", "rgb_naive", "rgb_relaxed_boundary", "rgb_volsdf", "rgb_unisurf"),
    *("rgb_newton_auto", "rgbd_dvr", "dvr_paper_depth", "stereo", "poisson_5"),
}
ARRAYS = ("photograph", "colours", "normals", "hit")


def make(runs: Runs) -> Result:
    """A line per row, and the published ones."""
    lines, scenes = medians.medians(runs, NAMES), _scenes(runs)
    published = [
        {"method": f"published: {name}", **dict(zip(NAMES, (value / SCALE for value in values), strict=False))}
        for name, values in DVR_TABLE2.items()
    ]
    panels = {
        "Chamfer-L1, seen × 1000 (scene units)": SCALE * medians.scored(runs, SEEN),
        **medians.cost(runs),
    }
    return Result(
        runs,
        "Shape and colour from photographs.",
        f"Medians over {scenes} of errors on what the photographs see; in the figure a point per scene, and the "
        f"median.{_conditions(runs)}",
        question="Which method finds shape and colour from photographs?",
        verdict=format.ends(
            "Median Chamfer-L1 × 1000 of what the photographs see",
            medians.whole(lines, SEEN),
            scenes,
            show=table.thousandfold,
        ),
        remarks=[*NOTES, _rising(runs)],
        columns=COLUMNS,
        lines=[*lines, *published],
        run_columns=RUNS,
        figure=medians.draw_runs(runs, panels),
    )


def _rising(runs: Runs) -> str:
    """Which rows are not at their end; of runs without a folder it is not known."""
    gains = dict[str, list[float]]()
    for record in runs.records:
        lines = (curve_lines(runs.folder(record)) if KEPT not in record else None) or []
        points = [line for line in lines if line.get("psnr") is not None]
        late = [line["psnr"] for line in points if 2 * line["iteration"] >= points[-1]["iteration"]]
        if late:
            gains.setdefault(row_of(record).name, []).append(late[-1] - late[0])
    rising = [name for name, found in gains.items() if float(np.median(found)) > RISING]
    told = f"Not at their end, as the PSNR rose by over {RISING} dB in the second half of the iterations"
    return f"{told}: {', '.join(rising)}." if rising else ""


def _unlike(runs: Runs) -> dict[Row, list[Record]]:
    """One row of those that look alike, or all where no other is there."""
    unlike = {row: of for row, of in runs.rows().items() if row.preset.removeprefix(TUNED) not in ALIKE}
    return unlike or runs.rows()


def _scenes(runs: Runs) -> str:
    return format.plural(len(grouped(runs.records, medians.scene_of)), "scene")


def _conditions(runs: Runs) -> str:
    """What photographs there were, and how long was optimised."""
    task = next((r["config"]["task"] for r in runs.records if setting(r["config"], "task", "optimiser")), {})
    if setting(task, "images", "views") is None:
        return ""
    return (
        f" {task['images']['views']} photographs, {task['longest']} pixels along the longer side, one in "
        f"{task['held_out']} held out; {task['optimiser']['iterations']} iterations."
    )


def convergence(runs: Runs) -> Result:
    """The error on what is seen over the iterations, as the median of a row's scenes; a level without iterations."""
    runs = runs.made
    lines = []
    for row, records in _unlike(runs).items():
        own = [curves.read(runs.folder(record), ("iteration", "seconds", SEEN))[0] for record in records]
        course = curves.median(own, [record["status"] != "ok" for record in records], SEEN)
        mine = (runs.frame.row == row.name) & (runs.frame.preset == row.preset)
        end = medians.scored(runs, SEEN)[mine].median()
        last = max((int(curve["iteration"].max()) + 1 for curve in own if len(course)), default=0)
        found = [*zip(course["iteration"], course["median"], strict=True), (last, end)]
        lines += [{"row": row.name, "preset": row.preset, "iteration": at, SEEN: error} for at, error in found]
    data = pd.DataFrame(lines)
    ends, drawn = data["iteration"].max(), []
    for (name, preset), line in data.groupby(["row", "preset"], sort=False):
        x, y = line["iteration"].tolist(), style.finite(SCALE * line[SEEN])
        drawn.append(chart.curve(name, preset, *((x, y) if x != [0] else ([1, ends], 2 * y))))
    return Result(
        runs,
        "Error over the iterations on photographs.",
        f"Median over {_scenes(runs)} of the Chamfer-L1 of what the photographs see.",
        question="Which rows are at their end?",
        verdict=_rising(runs),
        remarks=("Of rows that look alike one is shown. A row without iterations is a level.",),
        data=data,
        figure=chart.draw([chart.panel_data("", "iteration", "Chamfer-L1, seen × 1000 (scene units)", drawn)], 3.4),
    )


def figures(runs: Runs) -> Result:
    """The first scenes in pictures, one row of those that look alike."""
    rows, every = list(_unlike(runs)), grouped(runs.records, medians.scene_of)
    shown = {name: [record for record in of if row_of(record) in rows] for name, of in list(every.items())[:SCENES]}
    scenes = {name: gallery.Scene(runs, of, ARRAYS) for name, of in shown.items()}
    photograph = ("held out", "colours", lambda found: [found["photograph"]])
    blocks = [gallery.colours_above_normals(scenes[name], name, rows, of, photograph) for name, of in shown.items()]
    return Result(
        runs,
        "Shapes from photographs in pictures.",
        f"Colours, and normals (right, up, towards the camera as red, green, blue), of {len(shown)} of "
        f"{format.plural(len(every), 'scene')}, seen by the camera of a held-out photograph.",
        remarks=(
            "A mesh row has the colours of the photographs that see a vertex, another row those of its field.",
            "Of rows that look alike one is shown; summary.png in a run's folder is its own picture.",
            *gallery.missing(scenes.values()),
        ),
        run_columns=PICTURED,
        figure=gallery.draw(blocks),
    )


PAGES = {"dvr_table2": make, "dvr_curves": convergence, "dvr_figures": figures}
