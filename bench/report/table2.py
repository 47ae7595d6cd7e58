"""Table 2 of DIST: shape completion over sparsity, with the published numbers beside ours."""

from collections import Counter
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bench.report import format, style
from bench.report.caption import joined, omitted, setup
from bench.report.experiments import Experiment, error, family, identity, measured, row_name, setting
from bench.report.planned import NOT_RUN
from bench.report.statistics import bootstrap, compare, holm, interquartile_mean, median, paired_bootstrap, rank, wilson
from bench.report.tables import Result

POINTS = ("dense", "50%", "10%", "100", "50", "20")
# DIST (Liu et al. 2020), Table 2: median Chamfer x 1000 over 200 shapes of ShapeNet, in the order of POINTS.
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
Cell = tuple[str, str, str]  # family, row, points
Run = tuple[Any, Any]  # shape, seed
REFERENCE = "DIST with mask"  # what the other rows are compared with
ORACLE = "oracle: the prior at its best"
SCALE = 1000.0
SEED = 0  # of the bootstrap
TITLE = "Shape completion from one depth image, over its sparsity."
ERROR = (
    "Chamfer distance (chamfer_l2: the sum of the two mean squared distances, squared scene units) times 1000. A run "
    "that did not end ok, or was planned and not run, counts as infinite. "
)
CAPTION = (
    "Medians over shapes. Dense depth implies the mask. “Paper's” is the setting of DIST, B.4; the other rows are as "
    "README, “Paper-literal”, says. The oracle is a code fitted to the distances of the true mesh "
    "(+experiment=priors). “Published” is DIST, Table 2: 200 shapes of ShapeNet, another prior and camera, not to be "
    "ranked with ours."
)


class Runs:
    """The errors of an experiment's runs, by family, row and points, then by shape and seed."""

    def __init__(self, experiment: Experiment):
        self.errors: dict[Cell, dict[Run, float]] = {}
        self.statuses: dict[Cell, Counter[str]] = {}
        for record in experiment.records:
            cell = (family(record), row_name(record), str(setting(record["config"], "task", "points")))
            run = (record["config"].get("index"), record["seed"])
            self.errors.setdefault(cell, {})[run] = SCALE * error(record, "chamfer_l2")
            self.statuses.setdefault(cell, Counter())[record["status"]] += 1
        self.families = list(dict.fromkeys(name for name, _, _ in self.errors))
        self.rows = list(dict.fromkeys(row for _, row, _ in self.errors))
        found = {points for _, _, points in self.errors}
        self.points = [p for p in POINTS if p in found] + sorted(found - {*POINTS})

    def rows_of(self, name: str) -> list[str]:
        """The rows that a family has."""
        return [row for row in self.rows if any((name, row, points) in self.errors for points in self.points)]

    def median(self, *cell: str) -> float | None:
        """Over shapes and seeds; None where nothing was planned."""
        return float(median(list(self.errors[cell].values()))) if cell in self.errors else None

    def pair(self, name: str, row: str, other: str) -> list[list[np.ndarray]]:
        """The errors of two rows in a family at all points together: groups of the same runs, one a shape."""
        mine, others = (
            {(*run, p): e for p in self.points for run, e in self.errors.get((name, one, p), {}).items()}
            for one in (row, other)
        )
        common = [key for key in mine if key in others]
        return [_by_shape({key: errors[key] for key in common}) for errors in (mine, others)]

    def failures(self, name: str, row: str) -> tuple[int, int]:
        """How many of a row's runs in a family did not end ok, and how many there are."""
        together = sum((self.statuses.get((name, row, points), Counter()) for points in self.points), Counter())
        return together.total() - together["ok"], together.total()


def _by_shape(errors: dict[Any, float]) -> list[np.ndarray]:
    """The errors of runs, whose keys begin with the shape, as a group a shape."""
    shapes: dict[Any, list[float]] = {}
    for key, value in errors.items():
        shapes.setdefault(key[0], []).append(value)
    return [np.array(values) for values in shapes.values()]


def make(experiment: Experiment) -> Result:
    """A row a family and method: the median at each number of points."""
    runs = Runs(experiment)
    oracle = oracles(experiment)
    rows = []
    for name in runs.families:
        if name in oracle:
            rows.append([name, ORACLE, *[format.number(oracle[name])] * len(runs.points), ""])
        for row in runs.rows_of(name):
            failed, total = runs.failures(name, row)
            medians = [runs.median(name, row, points) for points in runs.points]
            rows.append([name, row, *map(format.number, medians), f"{failed} of {total}"])
        for row, numbers in PUBLISHED.get(name, {}).items():
            known = dict(zip(POINTS, numbers, strict=True))
            rows.append([name, f"published: {row}", *[format.number(known.get(p)) for p in runs.points], ""])
    return Result(
        name="table2",
        title=TITLE,
        caption=joined(setup(experiment), ERROR, CAPTION, _numbers(runs), _outcome(experiment), omitted(experiment)),
        data=pd.DataFrame([_raw(record) for record in experiment.records], dtype=object),
        table=pd.DataFrame(rows, columns=["Family", "Method", *map(_heading, runs.points), "Failed"]),
        figure=draw(runs, oracle),
    )


def intervals(experiment: Experiment) -> Result:
    """The same with interquartile means, their intervals, ratios to the reference row, and failure rates."""
    runs = Runs(experiment)
    cells = {cell: _statistics(runs, *cell) for cell in runs.errors}
    rows = []
    for name in runs.families:
        ranks = _ranks(runs, name)
        for row in runs.rows_of(name):
            found = [cells.get((name, row, points)) for points in runs.points]
            shown = [format.MISSING if one is None else _told(one) for one in found]
            share = wilson(*runs.failures(name, row))
            failed = f"{100 * share.value:.0f} % [{100 * share.low:.0f}, {100 * share.high:.0f}]"
            rows.append([name, row, *shown, failed, _ratio(runs, name, row), format.number(ranks[row])])
    columns = ["Family", "Method", *map(_heading, runs.points), "Failed", "Ratio to the reference", "Mean rank"]
    notes = [f"{row} against {REFERENCE}: p = {p:.2g}" for row, p in _p_values(runs).items()]
    return Result(
        name="table2_intervals",
        title="The same, with intervals.",
        caption=joined(
            setup(experiment),
            ERROR,
            "Interquartile means with 95 % bootstrap intervals over shapes and seeds (expanded percentiles, 2,000 "
            "draws); failure rates with Wilson's intervals. The ratio is that of the row's interquartile mean over all "
            f"points to that of “{REFERENCE}”, paired by shape, over shapes that both have. The rank is the mean over "
            "shapes and points; a run that failed, or that a row lacks, ranks last. Below, Wilcoxon's signed-rank test "
            "over the shapes of all families, on medians over points, adjusted for their number (Holm).",
            _numbers(runs),
            omitted(experiment),
        ),
        data=pd.DataFrame(cells.values(), dtype=object),
        table=pd.DataFrame(rows, columns=columns),
        notes=notes,
    )


def oracles(experiment: Experiment) -> dict[str, float]:
    """Median Chamfer x 1000 of the prior's best fit to each family's shapes, where these were run."""
    fits = experiment.beside("priors")
    shapes = {(family(record), record["config"].get("index")) for record in experiment.records}
    found: dict[str, list[float]] = {}
    for record in fits.records if fits else []:
        if (family(record), record["config"].get("index")) in shapes:
            found.setdefault(family(record), []).append(SCALE * error(record, "chamfer_l2"))
    return {name: float(median(values)) for name, values in found.items()}


@style.styled
def draw(runs: Runs, oracle: dict[str, float]) -> Figure:
    """A panel a family: medians over points, and the prior at its best."""
    columns = min(len(runs.families), 4)
    lines = -(-len(runs.families) // columns)
    figure = Figure(figsize=(style.WIDTH, 2.4 * lines + 0.7), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False, sharey=True)
    everything = []
    for axis, name in zip(axes.flat, runs.families, strict=False):
        for row in runs.rows_of(name):
            medians = [runs.median(name, row, points) for points in runs.points]
            everything += medians
            look = style.look(row)
            axis.plot(style.finite(medians), linestyle=look.line, color=look.colour, marker=look.marker, label=row)
        if name in oracle:
            axis.axhline(oracle[name], color="#777777", lw=0.9, label=ORACLE)
            axis.axhline(1.5 * oracle[name], color="#777777", lw=0.9, ls=":", label="1.5 times that")
        axis.set(title=name, xlabel="depth points", xticks=range(len(runs.points)))
        axis.set_xticklabels(runs.points, rotation=45)
    for axis in axes.flat[len(runs.families) :]:
        axis.axis("off")
    for axis in axes[:, 0]:
        axis.set_ylabel("Chamfer × 1000 (scene units²)")
    style.log_axis(axes[0, 0], "y", everything)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


def _statistics(runs: Runs, *cell: str) -> dict[str, Any]:
    """Everything about a cell."""
    errors, statuses = runs.errors[cell], runs.statuses[cell]
    groups = _by_shape(errors)
    mean = bootstrap(groups, interquartile_mean, seed=SEED)
    failed = statuses.total() - statuses["ok"]
    share = wilson(failed, statuses.total())
    return {
        **dict(zip(("family", "row", "points"), cell, strict=True)),
        **{
            "shapes": len(groups),
            "runs": len(errors),
            "median": runs.median(*cell),
            "mean": np.mean([*errors.values()]),
        },
        **{"mean": float(np.mean([*errors.values()])), "iqm": mean.value, "iqm_low": mean.low, "iqm_high": mean.high},
        **{"failed": failed, "failed_low": share.low, "failed_high": share.high, "not_run": statuses[NOT_RUN]},
    }


def _told(found: dict[str, Any]) -> str:
    return f"{format.number(found['iqm'])} {format.interval(found['iqm_low'], found['iqm_high'])}".strip()


def _ratio(runs: Runs, name: str, row: str) -> str:
    first, second = runs.pair(name, row, REFERENCE)
    if row == REFERENCE or not first:
        return ""
    ratio = paired_bootstrap(first, second, interquartile_mean, seed=SEED)
    return f"{format.number(ratio.value)} {format.interval(ratio.low, ratio.high)}".strip()


def _ranks(runs: Runs, name: str) -> dict[str, float]:
    """Each row's mean rank over shapes and points; what a row lacks counts as a failure, lest dropping one pays."""
    return rank(
        {
            row: {(p, run): e for p in runs.points for run, e in runs.errors.get((name, row, p), {}).items()}
            for row in runs.rows_of(name)
        }
    )


def _p_values(runs: Runs) -> dict[str, float]:
    """Holm's p-value of each row against the reference, over the shapes of all families."""
    raw = {}
    for row in runs.rows:
        pairs = [runs.pair(name, row, REFERENCE) for name in runs.families]
        first, second = ([group for pair in pairs for group in pair[side]] for side in (0, 1))
        if row != REFERENCE and first:
            raw[row] = compare(first, second)
    return dict(zip(raw, holm(list(raw.values())).tolist(), strict=True)) if raw else {}


def _numbers(runs: Runs) -> str:
    counts = {len(_by_shape(errors)) for errors in runs.errors.values()}
    least = min(counts)
    told = f"{least}" if len(counts) == 1 else f"{least} to {max(counts)}"
    few = " Of fewer than 6 shapes an interval covers less than it says: 88 % of four." if least < 6 else ""
    return f"Shapes a cell: {told}.{few}"


def _outcome(experiment: Experiment) -> str:
    """How many runs did not end ok, by status."""
    failed = [record for record in experiment.records if record["status"] != "ok"]
    total = len(experiment.records)
    if not failed:
        return f"All {total} runs ended ok."
    statuses = ", ".join(f"{count} {status}" for status, count in Counter(r["status"] for r in failed).most_common())
    return f"{len(failed)} of {total} runs did not end ok ({statuses}); the CSV says why."


def _heading(points: str) -> str:
    return f"{points} pts" if points.isdigit() else points


def _raw(record: dict[str, Any]) -> dict[str, Any]:
    seconds = [record["seconds"].get(name) for name in ("forward", "backward")]
    return {
        "family": family(record),
        "points": setting(record["config"], "task", "points"),
        **identity(record),
        **{name: measured(record, name) for name in ("chamfer_l2", "chamfer_l1", "normal_consistency", "mask_iou")},
        "chamfer_l2_start": record["metrics_start"].get("chamfer_l2"),
        "loop_seconds": None if None in seconds else sum(seconds),
        "value_evaluations": record["evaluations"].get("value"),
    }
