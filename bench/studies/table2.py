"""Table 2 of DIST: shape completion over the sparsity of the depth image, measured and published."""

from typing import Any

from bench.report.compare import ERROR, FAILURE, RATIO, Compared, Comparison
from bench.report.data.records import grouped, iterations_of, row_of
from bench.report.data.runs import Runs, Selection
from bench.report.oracle import LABEL, NOTE, oracles
from bench.report.write.result import Result
from bench.report.write.table import COMPLETION, FAMILY, LOOP, Column, configured, to_data, to_table

PLACE = 20
READS = (Selection("table2", ("task.points",)),)
OF = Comparison(reference=lambda _: "dist_mask")
VARIANTS = ("_paper", "_official")  # ends of presets that the figure leaves out, to be read
# DIST (Liu et al. 2020), Table 2: median Chamfer x 1000 over 200 shapes of ShapeNet, in the order of `OF.order`.
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


def make(runs: Runs) -> Result:
    """A line per family and row, with the oracle and published numbers beside each family."""
    found, oracle = Compared(runs, OF), oracles(runs, OF.error)
    lines = [line for name in dict.fromkeys(x["family"] for x in found.lines) for line in _family(found, name, oracle)]
    columns = [
        column for column in found.columns("Ratio to DIST with mask") if column.key not in ("evaluations", "seconds")
    ]
    return found.result(
        "Shape completion from one depth image, over its sparsity.",
        "Which method completes a shape best from sparse depth?",
        plotted="Median error over {shapes and seeds} at each number of given depth points, and the geometric mean.",
        verdict=found.best("error × 1000 over all numbers of points"),
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
        empty | {"row": f"published: {row}"} | dict(zip(OF.order, numbers, strict=True))
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


PAGES = {"table2": make}
