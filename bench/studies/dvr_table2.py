"""Table 2 and Figs. 6 to 8 of DVR: shape and colour from rendered photographs."""

import math
from typing import Any

import pandas as pd

from bench.records.metrics import DVR_TABLE2
from bench.report.data.records import SCALE, Record, Row, grouped, row_of, setting, shared_settings
from bench.report.study import Result, Runs, Selection, chart, curves, format, gallery, medians, style, table
from bench.report.tuning import TUNED

PLACE = 45
READS = (Selection("dvr_table2", setup=("scenes", "machine")),)
SEEN, SEEN_LABEL = "seen_chamfer_l1", "Chamfer-L1, seen × 1000"
NAMES = ("seen_accuracy", "seen_completeness", SEEN, "chamfer_l1", "psnr", "ssim", "mask_iou")
NOTES = (
    "“Seen” is what a given photograph sees of either surface, as none sees the underside; distances are in scene "
    "units, times 1000, and two samplings of one surface by 30,000 points have a Chamfer-L1 of 5.7 to 7.1.",
    "Colours are compared at hits on held-out photographs; with volumes and the relaxed boundary on all rays of the "
    "foreground, in front of black.",
    "Volumes have the cross entropy of their opacity for the masks and a budget of samples a ray.",
    "“Error over the iterations on photographs” shows whether a row is at its end.",
    "A row without field evaluations has no point where the figure shows them.",
    "“Published” is DVR, Table 2: photographs of three scans of DTU, in mm, which cannot be compared directly with the "
    "measured rows.",
)
SETTINGS = {  # of rows that are optimised, by their names in the note
    "field": ("field",),
    "learning rate": ("task", "optimiser", "learning_rate"),
    "iterations": ("task", "optimiser", "iterations"),
    "rays": ("task", "rays"),
    "weight of the mask": ("task", "losses", "silhouette_weight"),
    "eikonal weight": ("task", "losses", "eikonal"),
}
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
    *(table.configured(name.replace(" ", "_"), *path) for name, path in SETTINGS.items()),
)
PICTURED = (table.FAMILY, *table.IDENTITY, *table.metrics(SEEN, "psnr"))

COURSE = (
    table.text("method", "Method"),
    table.Column("iterations", "Iterations", show=table.whole),
    table.Column("at", "Nearest to half", show=table.whole),
    table.Column("half", "Error there", show=table.thousandfold),
    table.Column("end", "At the end", show=table.thousandfold),
    table.Column("fell", "Fell by", show=table.percent),
)
SCENES = 2  # of `figures`
ALIKE = {  # rows that are not shown there, since they look as another does
    *("rgb_dist", "rgb_idr", "rgb_naive", "rgb_relaxed_boundary", "rgb_volsdf", "rgb_unisurf"),
    *("rgb_newton_auto", "rgbd_dvr", "dvr_paper_depth", "stereo", "poisson_5"),
}
GIVEN_DEPTHS = ("rgbd_", "poisson", "dvr_paper_depth")  # beginnings of presets of rows that see depths as well
ARRAYS = ("photograph", "colours", "normals", "hit")


def make(runs: Runs) -> Result:
    """A line per row, and the published ones."""
    lines, scenes = sorted(medians.medians(runs, NAMES), key=_error), _scenes(runs)
    published = [
        {"method": f"published: {name}", **dict(zip(NAMES, (value / SCALE for value in values), strict=False))}
        for name, values in DVR_TABLE2.items()
    ]
    optimised = [record for record in runs.records if setting(record["config"], "task", "optimiser")]
    panels = {
        f"{SEEN_LABEL} (scene units)": SCALE * medians.scored(runs, SEEN),
        **medians.cost(runs),
    }
    return Result(
        runs,
        "Shape and colour from photographs.",
        f"Medians over {scenes} of errors on what the photographs see; in the figure a point per scene, and the "
        f"median.{_conditions(runs)}",
        question="Which method finds shape and colour from photographs?",
        verdict=format.ends(
            "From photographs alone, the median Chamfer-L1 × 1000 of what they see",
            medians.whole([line for line in lines if not line["preset"].startswith(GIVEN_DEPTHS)], SEEN),
            scenes,
            show=table.thousandfold,
        ),
        remarks=(shared_settings(optimised, SETTINGS), *NOTES),
        columns=COLUMNS,
        lines=[*lines, *published],
        run_columns=RUNS,
        figure=medians.draw_runs(runs, panels, [Row(line["preset"], line["method"]) for line in lines]),
    )


def _error(line: dict[str, Any]) -> float:
    """The median error on what is seen, by which lines are in order; infinite where a run has none."""
    return math.inf if line[SEEN] is None else line[SEEN]


def _unlike(runs: Runs) -> dict[Row, list[Record]]:
    """One row of those that look alike, or all where no other is there."""
    unlike = {row: of for row, of in runs.rows().items() if row.preset.removeprefix(TUNED) not in ALIKE}
    return unlike or runs.rows()


def _scenes(runs: Runs) -> str:
    return format.plural(len(grouped(runs.records, medians.scene_of)), "scene")


def _conditions(runs: Runs) -> str:
    """What photographs there were, and how long was optimised."""
    tasks = [r["config"]["task"] for r in runs.records if setting(r["config"], "task", "optimiser")]
    if not tasks or setting(tasks[0], "images", "views") is None:
        return ""
    iterations = sorted({task["optimiser"]["iterations"] for task in tasks})
    return (
        f" {tasks[0]['images']['views']} photographs, {tasks[0]['longest']} pixels along the longer side, one in "
        f"{tasks[0]['held_out']} held out; {' or '.join(map(str, iterations))} iterations."
    )


def convergence(runs: Runs) -> Result:
    """The error on what is seen over the iterations, as the median of a row's scenes; a level without iterations."""
    runs = runs.made
    ends = {Row(line["preset"], line["method"]): line[SEEN] for line in medians.medians(runs, (SEEN,))}
    courses = {row: _course(runs, records, ends[row]) for row, records in runs.rows().items()}
    longest = max(course.index[-1] for course in courses.values())
    levels = {row: pd.Series([course[0]] * 2, [1, longest]) for row, course in courses.items() if 0 in course}
    shown = courses | levels
    drawn = [
        chart.curve(row.name, row.preset, shown[row].index, style.finite(SCALE * shown[row])) for row in _unlike(runs)
    ]
    lines = [_fall(row, course) for row, course in courses.items() if row not in levels]
    return Result(
        runs,
        "Error over the iterations on photographs.",
        f"Median over {_scenes(runs)} of the Chamfer-L1 of what the photographs see, at the checkpoint nearest to half "
        "of the iterations and at the end; in the figure, at all checkpoints.",
        question="Would more iterations help on photographs?",
        verdict=format.ends(
            "Fall of the error from the checkpoint nearest to half of the iterations to the end",
            {line["method"]: line["fell"] for line in lines},
            _scenes(runs),
            show=table.percent,
        ),
        remarks=(
            "The error of a low rate falls slowly, far from its end too.",
            "In the figure, of rows that look alike one is shown, and a row without iterations is a level.",
        ),
        data=pd.concat(
            course.rename(SEEN).rename_axis("iteration").reset_index().assign(row=row.name)
            for row, course in courses.items()
        ),
        columns=COURSE,
        lines=lines,
        figure=chart.draw([chart.panel_data("", "iteration", f"{SEEN_LABEL} (scene units)", drawn)], 3.6),
    )


def _course(runs: Runs, records: list[Record], end: float | None) -> pd.Series:
    """The error of a row by the iteration, from the first one to its end; that at 0 alone without any."""
    own = [curves.read(runs.folder(record), ("iteration", "seconds", SEEN))[0] for record in records]
    course = curves.median(own, [record["status"] != "ok" for record in records], SEEN)
    course = course.set_index("iteration")["median"]
    last = max(int(curve["iteration"].max()) + 1 for curve in own if len(curve)) if len(course) else 0
    return pd.concat([course[course.index > 0], pd.Series({last: end}, dtype=float)])


def _fall(row: Row, course: pd.Series) -> dict[str, Any]:
    """A row's line: by how much its error fell at last; nan where that is infinite or not measured."""
    *before, last = course.index
    at = min(before, key=lambda at: abs(at - last / 2), default=0)
    known = 4 * abs(at - last / 2) <= last
    half, end = course[at] if known else math.nan, course[last]
    return {
        "method": row.name,
        "preset": row.preset,
        "iterations": last,
        **({"at": at, "half": half} if known else {}),
        "end": end,
        "fell": 1 - end / half if 0 < half < math.inf and end < math.inf else math.nan,
    }


def figures(runs: Runs) -> Result:
    """The first scenes in pictures, one row of those that look alike."""
    rows, every = list(_unlike(runs)), grouped(runs.records, medians.scene_of)
    shown = {name: [record for record in of if row_of(record) in rows] for name, of in list(every.items())[:SCENES]}
    scenes = {name: gallery.Scene(runs, of, ARRAYS) for name, of in shown.items()}
    photograph = ("held out", lambda found: [found["photograph"]])
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
