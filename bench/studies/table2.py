"""Table 2 and Figs. 20 to 22 of DIST: shape completion over the sparsity of the depth image."""

from typing import Any

from bench.report import gallery
from bench.report.compare import ERROR, FAILURE, METRIC, ORDER, RATIO, Compared, heading
from bench.report.data.records import Record, grouped, iterations_of, row_of, setting
from bench.report.data.runs import Runs, Selection
from bench.report.gallery import BEHIND, FOUND, FRONT, TRUE, Block, Scene
from bench.report.oracle import LABEL, NOTE, oracles
from bench.report.write.result import Result
from bench.report.write.table import COMPLETION, FAMILY, LOOP, Column, configured, to_data, to_table

PLACE = 20
READS = (Selection("table2", ("task.points",)),)
REFERENCE = "dist_mask"
VARIANTS = ("_paper", "_official")  # ends of presets that the figure leaves out, to be read
# DIST (Liu et al. 2020), Table 2: median Chamfer x 1000 over 200 shapes of ShapeNet, in the order of `ORDER`.
PUBLISHED = {
    "sofa": {
        "DeepSDF": (5.37, 5.56, 5.50, 5.93, 6.03, 7.63),
        "DIST": (4.12, 5.75, 5.49, 5.72, 5.57, 6.95),
        "DIST with mask": (4.12, 3.98, 4.31, 3.98, 4.30, 4.94),
    },
    "plane": {
        "DeepSDF": (3.71, 3.73, 4.29, 4.44, 4.40, 5.39),
        "DIST": (2.18, 4.08, 4.81, 4.44, 4.51, 5.30),
        "DIST with mask": (2.18, 2.08, 2.62, 2.26, 2.55, 3.60),
    },
    "table": {
        "DeepSDF": (12.93, 12.78, 11.67, 12.87, 13.76, 15.77),
        "DIST": (5.37, 12.05, 11.42, 11.70, 13.76, 15.83),
        "DIST with mask": (5.37, 5.15, 5.16, 5.26, 6.33, 7.62),
    },
}
NOTES = (
    f"{RATIO} {FAILURE}",
    "Dense depth implies the mask; “paper's as printed” is the setting of DIST, B.4, with the mean of the squared code "
    "of the official code. The figure leaves out rows with the settings of papers.",
    f"{NOTE} “Published” is DIST, Table 2: 200 shapes of ShapeNet with another prior and camera, and another number of "
    "points per share, so these numbers do not compare with the measured ones.",
)
RUNS = (
    FAMILY,
    configured("points", "task", "points"),
    *COMPLETION,
    Column("chamfer_l2_start", value=lambda record: record["metrics_start"].get("chamfer_l2")),
    *LOOP,
)
PICTURED = ("deepsdf", "dist_depth", "dist_mask")  # presets of the rows in pictures, where they were run
ARRAYS = ("given", *(kind + part for kind in (FOUND, TRUE) for part in ("normals", "hit")))
BOTH = (FRONT, BEHIND)


def make(runs: Runs) -> Result:
    """A line per family and row, with the oracle and published numbers beside each family."""
    found, oracle = Compared(runs, lambda _: REFERENCE), oracles(runs, METRIC)
    lines = [line for name in dict.fromkeys(x["family"] for x in found.lines) for line in _family(found, name, oracle)]
    columns = [
        column for column in found.columns("Ratio to DIST with mask") if column.key not in ("evaluations", "seconds")
    ]
    return found.result(
        "Shape completion from one depth image, over its sparsity.",
        "Which method completes a shape best from sparse depth?",
        plotted="Median error over {shapes and seeds} at each number of given depth points, and the geometric mean.",
        verdict=found.best("errors × 1000 over all numbers of points"),
        remarks=(ERROR, " ".join((found.shapes(), _given(runs), _iterations(runs))), *NOTES),
        data=to_data(RUNS, runs.records),
        table=to_table(columns, lines),
        figure=found.draw_conditions([r for r in found.rows if not r[0].endswith(VARIANTS)], oracle, LABEL),
    )


def _family(found: Compared, name: str, oracle: dict[str, float]) -> list[dict[str, Any]]:
    """The lines of a family, or of all: the oracle, the rows, and the published ones."""
    empty = {"family": name, "error": "", "ratio": None, "failed": ""}
    best = [empty | {"row": LABEL} | dict.fromkeys(found.conditions, oracle[name])] if name in oracle else []
    published = [
        empty | {"row": f"published: {row}"} | dict(zip(ORDER, numbers, strict=True))
        for row, numbers in PUBLISHED.get(name, {}).items()
    ]
    return best + [line for line in found.lines if line["family"] == name] + published


def _given(runs: Runs) -> str:
    """The median numbers of points that shares of the depth image are, of each family."""
    given = runs.frame.assign(given=runs.number("evaluations_observed"), at=runs.setting("task.points"))
    shares = (
        given[~given["at"].str.isdigit() & given.given.notna()].groupby(["family", "at"], sort=False).given.median()
    )
    of_family = {name: own.droplevel(0) for name, own in shares.groupby("family", sort=False)}
    told = [f"{name} " + ", ".join(f"{at} {n:.0f}" for at, n in own.items()) for name, own in of_family.items()]
    return f"Points given, medians: {'; '.join(told)}." if told else ""


def _iterations(runs: Runs) -> str:
    """The rows' iterations: the most frequent number, then the rows with another one."""
    known = {count: records for count, records in grouped(runs.records, iterations_of).items() if count is not None}
    names = {count: list(dict.fromkeys(row_of(record).name for record in records)) for count, records in known.items()}
    most = max(names, key=lambda count: len(names[count]), default=None)
    others = [f"{', '.join(rows)} {count}" for count, rows in names.items() if count != most]
    return f"Iterations: {'; '.join([str(most), *others])}." if names else ""


def pictures(runs: Runs) -> Result:
    """A block per family: the given depths over their number, and each row's shape below them."""
    shown = gallery.first_shapes(runs, 1, PICTURED)
    scenes = {name: Scene(shown, records, ARRAYS) for name, records in shown.families().items()}
    return Result(
        shown,
        "Completed shapes in pictures.",
        "The shape with the least number of each family at each number of given depth points, from the given camera "
        "and from behind.",
        remarks=(
            "Normals are red, green and blue (right, up, towards the camera) of the mesh that is judged; given depths "
            "are yellow where they are near.",
            "Dense depth implies the mask, “DIST with mask” sees it at all numbers of points, and DeepSDF is given the "
            "true normals.",
            "DIST, Figs. 20 to 22, shows shapes of ShapeNet; these are of other families and another prior.",
            *gallery.missing(scenes.values()),
        ),
        data=to_data((*RUNS[:2], *COMPLETION), shown.records),
        figure=gallery.draw([_block(name, of, scenes[name]) for name, of in shown.families().items()], across=2),
    )


def _block(name: str, records: list[Record], scene: Scene) -> Block:
    """The rows of a family over the number of points, behind them the truth."""
    found = grouped(records, _points)
    points = [p for p in ORDER if p in found] + sorted(found.keys() - {*ORDER})
    given = [scene.shared(found[p][:1], gallery.depth) for p in points]
    rows = {"given depths": [*given, scene.shared(records, gallery.normals(TRUE), BOTH)]}
    for row, own in grouped(records, row_of).items():
        at = {_points(record): record for record in own}
        rows[row.name] = [scene.cell(at.get(p), gallery.normals(FOUND), BOTH) for p in points]
    return Block(name, [*map(heading, points), "truth"], rows)


def _points(record: Record) -> str:
    return str(setting(record["config"], "task", "points"))


PAGES = {"table2": make, "completion_gallery": pictures}
