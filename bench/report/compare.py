"""Compares rows on the same shapes: medians per condition, mean errors, ratios, costs, Pareto fronts, a figure."""

import math
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import pandas as pd
import yaml
from matplotlib.figure import Figure

from bench.records import format
from bench.records.read import read_plans
from bench.report.data import statistics
from bench.report.data.records import CHAMFER_SCALE, SHAPENET, Row, RunKey, by_shape, error, row_of, setting, shape
from bench.report.data.runs import Runs, Selection
from bench.report.data.statistics import Interval, Verdict, geometric_mean
from bench.report.write import chart
from bench.report.write.result import Result
from bench.report.write.table import Column, columns, ends, estimate, text, word
from bench.tables import CONF

ALL_FAMILIES = "all families"
COSTS = {"evaluations": "field evaluations\nof a run", "seconds": "runtime (seconds)"}  # with their axis labels
FAILURE = (
    "In the mean of a shape, a failed run has the largest finite error of all rows on the same shape, seed and "
    "condition. A shape on which every row failed is left out."
)
ERROR = (
    "Error: chamfer_l2, the sum of the two mean squared distances in squared scene units, times 1000. A failed "
    "run, or a planned run that was not made, counts as infinite."
)
INTERVAL = "95 % intervals over shapes (of the sign test)"
RATIO = (
    "A ratio is the median over shapes of the ratio of the two rows' geometric mean errors. After it stands the number "
    "of shapes on which the row is better; a tie counts as half."
)
HOLM = "the sign test over shapes with Holm's correction"
METRIC, LABEL = "chamfer_l2", "Chamfer × 1000\n(scene units²)"
CONDITION_KEY = "task.points"  # tables have a column for each of its values
CONDITION_ORDER = ("dense", "50%", "10%", "100", "50", "20")
PRIORS = Selection("priors")
ORACLE = "oracle: the prior's fit to the truth"
FITTED = "The oracle is a latent code fitted to the distances of the true mesh (`+experiment=priors`), for all shapes."
PLOTTED = (
    "Median error under each condition; median over shapes of a shape's geometric mean error, with its ratio; median "
    "cost of runs that ended ok."
)
Line = dict[str, Any]
Above = dict[str, dict[str, Any]]  # medians of further lines, by name and family


@cache
def published(name: str) -> dict[str, Any]:
    """A table of `conf/published.yaml`: numbers of a paper as text, as printed."""
    return yaml.load((CONF / "published.yaml").read_text(encoding="utf-8"), yaml.BaseLoader)[name]


@dataclass(frozen=True)
class Gap:
    """The ratio of two rows' errors, and on how many of their common shapes the first is better (a tie counts half)."""

    ratio: Interval
    better: float
    shapes: int

    def __str__(self) -> str:
        return f"{self.ratio}; {self.better:g} of {self.shapes}"


def ratio_of(gap: Gap | None) -> Interval | None:
    return None if gap is None else gap.ratio


def pooled(lines: Sequence[Line]) -> list[Line]:
    return [line for line in lines if line["family"] == lines[0]["family"]]


def ratio_columns(heading: str) -> list[Column]:
    """The columns of a `Gap`, empty for the reference row, and of the ends of its interval."""
    return [
        text("ratio", heading, lambda line: "" if line["ratio"] is None else str(line["ratio"])),
        *ends("ratio", lambda line: ratio_of(line["ratio"])),
    ]


@dataclass(frozen=True)
class Compared:
    """The runs of a comparison, at least one."""

    runs: Runs
    reference: str  # the preset of the reference row; of several rows with it, the first that the sweep planned
    metric: str = METRIC  # the error
    label: str = LABEL  # of the error on axes

    @cached_property
    def cells(self) -> pd.DataFrame:
        """A line per run: family, row, preset, solid, view, seed, condition, ok, costs, error and score.

        The score is the error if it is finite, else the largest finite error on the same shape, view, seed and
        condition; infinite if every row failed.
        """
        frame = self.runs.frame
        cells = frame[["family", "row", "preset", "solid", "view", "seed"]].assign(
            condition=self.runs.setting(CONDITION_KEY),
            ok=(frame.status == "ok").to_numpy(bool),
            error=self.runs.error(self.metric),
            evaluations=frame["values"],
            seconds=frame.loop,
        )
        keys = [cells[name] for name in ("family", "solid", "view", "seed", "condition")]
        worst = cells.error.where(np.isfinite(cells.error)).groupby(keys).transform("max")
        return cells.assign(score=cells.error.where(np.isfinite(cells.error), worst).fillna(math.inf))

    @cached_property
    def families(self) -> list[str]:
        return list(self.runs.families())

    @cached_property
    def rows(self) -> list[Row]:
        return list(self.runs.rows())

    @cached_property
    def planned(self) -> list[Row]:
        """The rows in the order of the sweep that planned most runs, then the others. It reads all plans."""
        row_by_id = {record["folder"]: row_of(record) for record in self.runs.records}
        plans, _ = read_plans(self.runs.results_dir)
        planned_rows = [[row_by_id[cell.id] for cell in plan.cells if cell.id in row_by_id] for plan in plans]
        ordered = [row for rows in sorted(planned_rows, key=len, reverse=True) for row in rows]
        return list(dict.fromkeys([*ordered, *self.rows]))

    @cached_property
    def reference_row(self) -> Row | None:
        candidates = [row for row in self.rows if row.preset == self.reference]
        return min(candidates, key=self.planned.index) if len(candidates) > 1 else next(iter(candidates), None)

    @cached_property
    def conditions(self) -> list[str]:
        return ordered({str(value) for value in self.cells["condition"]})

    def cells_of(self, family: str, row: Row, condition: str | None = None) -> pd.DataFrame:
        """The cells of a row in a family, or in `ALL_FAMILIES`; at one condition, or at all."""
        lines = self.cells[(self.cells.preset == row.preset) & (self.cells.row == row.name)]
        lines = lines if family == ALL_FAMILIES else lines[lines.family == family]
        return lines if condition is None else lines[lines["condition"] == condition]

    def median(self, family: str, row: Row, condition: str) -> float | None:
        errors = self.cells_of(family, row, condition).error
        return float(statistics.median(errors.to_numpy())) if len(errors) else None

    def means(self, family: str, row: Row) -> dict[RunKey, float]:
        """The geometric mean of the scores over all conditions, by shape, view and seed.

        Left out are those that lack a run at a condition of their family, and those on which every row failed.
        """
        return {run: mean for run, mean in self._means[row].items() if family in (ALL_FAMILIES, run[0][0])}

    @cached_property
    def _means(self) -> dict[Row, dict[RunKey, float]]:
        condition_counts = self.cells.groupby("family", sort=False)["condition"].nunique()
        means: dict[Row, dict[RunKey, float]] = {row: {} for row in self.rows}
        columns = ["preset", "row", "family", "solid", "view", "seed"]
        for (preset, row, family, solid, view, seed), group in self.cells.groupby(columns, sort=False, dropna=False):
            mean = float(geometric_mean(group.score.to_numpy()))
            if len(group) == condition_counts[family] and math.isfinite(mean):
                means[Row(preset, row)][(family, solid), view, seed] = mean
        return means

    def lacking(self, family: str, row: Row) -> int:
        """The number of shapes, views and seeds that another row has at all conditions and this one does not."""
        return len({run for other in self.rows for run in self.means(family, other)} - {*self.means(family, row)})

    def error(self, family: str, row: Row) -> Interval:
        """The median over shapes of a row's mean error over conditions and seeds; nan without a shape."""
        groups = by_shape(self.means(family, row))
        return statistics.typical(groups) if groups else Interval(math.nan, math.nan, math.nan)

    def gap(self, family: str, first: Row, second: Row) -> Gap | None:
        """The gap between two rows; None if they have no common shape."""
        means = [self.means(family, row) for row in (first, second)]
        common = [run for run in means[0] if run in means[1]]
        ours, theirs = (by_shape({run: each[run] for run in common}) for each in means)
        return Gap(statistics.ratio(ours, theirs), statistics.shapes_won(ours, theirs), len(ours)) if ours else None

    @cached_property
    def lines(self) -> list[Line]:
        """A line per family and row; with several families, lines over all families come first.

        `ratio` is a `Gap`, or None for the reference; `lacking` is the number of missing shapes and seeds. A row that
        lacks some is in no verdict.
        """
        names = [ALL_FAMILIES, *self.families] if len(self.families) > 1 else self.families
        return [self._line(name, row) for name in names for row in self.rows]

    def _line(self, family: str, row: Row) -> Line:
        lines, reference, lacking = self.cells_of(family, row), self.reference_row, self.lacking(family, row)
        costs = {cost: lines[cost][lines.ok].dropna().median() for cost in COSTS}
        return {
            **{"family": family, "row": row.name, "preset": row.preset},
            **{condition: self.median(family, row, condition) for condition in self.conditions},
            "error": self.error(family, row),
            "ratio": None if reference in (row, None) else self.gap(family, row, reference),
            **{cost: None if math.isnan(value) else float(value) for cost, value in costs.items()},
            "lacking": lacking,
            "failed": f"{(~lines.ok).sum()} of {len(lines)}" + (f", {lacking} missing" if lacking else ""),
        }

    @property
    def pooled(self) -> list[Line]:
        return pooled(self.lines)

    @cached_property
    def oracles(self) -> dict[str, float]:
        """The median Chamfer x 1000 of the prior's fits, evaluated like the runs; of families with all shapes."""
        runs, fits = self.runs, self.runs.other(PRIORS)
        if fits is None or _evaluation_settings(fits.requested()) != _evaluation_settings(runs.requested()):
            return {}
        errors = {shape(record): CHAMFER_SCALE * error(record, self.metric) for record in fits.records}
        shapes_by_family = {name: {shape(record) for record in records} for name, records in runs.families().items()}
        fitted = {name: shapes for name, shapes in shapes_by_family.items() if shapes <= set(errors)}
        return {name: float(statistics.median([errors[key] for key in shapes])) for name, shapes in fitted.items()}

    def extended_lines(self, above: Above, published: dict[str, dict[str, Any]]) -> list[Line]:
        """The lines of each family, with medians of further lines above, and published numbers below."""
        lines = []
        for family in dict.fromkeys(line["family"] for line in self.lines):
            empty = {"family": family, "error": "", "ratio": None, "failed": ""}
            lines += [
                empty | {"row": row} | dict.fromkeys(self.conditions, median_by_family[family])
                for row, median_by_family in above.items()
                if family in median_by_family
            ]
            lines += [line for line in self.lines if line["family"] == family]
            lines += [
                empty | {"row": f"published: {row}"} | (numbers if isinstance(numbers, dict) else {"": numbers})
                for row, numbers in published.get(family.removeprefix(SHAPENET), {}).items()
            ]
        return lines

    def columns(self, ratio: str) -> list[Column]:
        return [
            *columns(word, family="Family", row="Method"),
            *columns(**{condition: heading(condition) for condition in self.conditions}),
            *estimate("error", "Median over shapes"),
            *ratio_columns(ratio),
            *columns(format.count, evaluations="Field evaluations"),
            *columns(format.seconds, seconds="Runtime"),
            *columns(word, failed="Failed", preset=""),
        ]

    @property
    def comparable(self) -> list[Line]:
        """The pooled lines of rows that lack no shape and have the settings, of `Runs.mixed`, of most runs."""
        is_usual = np.ones(len(self.runs.records), dtype=bool)
        for key in self.runs.mixed():
            values = self.runs.setting(key)
            is_usual &= (values == values.mode()[0]).to_numpy()
        usual_rows = self.runs.where(pd.Series(is_usual)).rows()
        return [line for line in self.pooled if not line["lacking"] and Row(line["preset"], line["row"]) in usual_rows]

    def differing(self, versus: str) -> str:
        """The verdict on the error ratios of all rows to their references, see `differing`."""
        return differing([(line["row"], ratio_of(line["ratio"])) for line in self.comparable], versus)

    def best(self, least_of: str) -> str:
        """The verdict on the row with the least error and, if runs are timed, the fastest row; empty without rows."""
        lines = self.comparable
        complete = [line for line in lines if math.isfinite(line["error"].value) and line["seconds"] is not None]
        if not complete:
            return ""
        n = len(complete[0]["error"].points)
        among = "The" if len(lines) == len(self.pooled) else "Among the rows with equal settings, the"
        best, quickest = (min(complete, key=key) for key in (lambda x: x["error"].value, lambda x: x["seconds"]))
        best_text, quickest_text = (
            f"{format.number(line['error'].value)}{mark} ({line['row']}"
            + (f", {format.seconds(line['seconds'])})" if self.runs.timed else ")")
            for line, mark in ((best, "*"), (quickest, ""))
        )
        text = f"{among} smallest median of {least_of} is *{best_text}; n = {format.plural(n, 'shape')}."
        if not self.runs.timed:
            return text
        return f"{text} {'It is also the fastest.' if best is quickest else f'The fastest row has {quickest_text}.'}"

    def panels(self, ratio: str) -> list[chart.Panel]:
        """Panels of errors, of ratios (labelled `ratio`) and of costs: a line per row, the least error first."""
        lines = sorted(self.pooled, key=lambda line: (math.isnan(line["error"].value), line["error"].value))
        costs = {label: cost for cost, label in COSTS.items() if cost != "seconds" or self.runs.timed}
        costs = {label: cost for label, cost in costs.items() if any(line[cost] for line in lines)}
        measures = {
            self.label: [line["error"] for line in lines],
            ratio: [ratio_of(line["ratio"]) for line in lines],
            **{label: [line[cost] for line in lines] for label, cost in costs.items()},
        }
        panels = []
        for label, values in measures.items():
            points = [
                chart.series(line["row"], line["preset"], [value], [position])
                for position, (line, value) in enumerate(zip(lines, values, strict=True))
                if value is not None
            ]
            panels.append(chart.panel_data("", label, "", points, rows=[line["row"] for line in lines]))
        panels[1]["series"].insert(0, chart.level("equal", [1, 1], 0) | {"y": [-0.6, len(lines) - 0.4], "quiet": True})
        panels[1]["x"]["log"] = True
        return panels


@dataclass(frozen=True)
class Comparison:
    """A page with a line per family and row, the ratio to a reference row, and a figure; see `Result`, `Compared`."""

    title: str
    question: str
    reference: str
    name: str  # of the reference, in headings and verdicts
    notes: Callable[[Compared], Iterable[str]]
    plotted: str = PLOTTED
    least_of: str = ""  # errors whose smallest is the verdict; empty: the verdict is on the ratios
    metric: str = METRIC
    label: str = LABEL
    above: Callable[[Compared], Above] = lambda _: {}  # further lines, as in `Compared.extended_lines`
    published: str = ""  # a table of `conf/published.yaml`
    hidden: Collection[str] = ()  # keys of columns that are left out
    run_columns: Sequence[Column] = ()
    figure: Callable[[Compared], Figure] | None = None  # None: `Compared.panels`

    def __call__(self, runs: Runs) -> Result:
        compared, ratio = Compared(runs, self.reference, self.metric, self.label), f"Ratio to {self.name}"
        panels = compared.panels(ratio)
        height = 0.19 * len(compared.rows) + 1.1
        return Result(
            runs,
            self.title,
            self.plotted,
            question=self.question,
            verdict=compared.best(self.least_of) if self.least_of else compared.differing(f"to {self.name}"),
            interval=INTERVAL,
            estimates=[line["error"] for line in compared.lines],
            remarks=self.notes(compared),
            columns=[column for column in compared.columns(ratio) if column.key not in self.hidden],
            lines=compared.extended_lines(self.above(compared), published(self.published) if self.published else {}),
            run_columns=self.run_columns,
            figure=self.figure(compared) if self.figure else chart.draw(panels, height, legend=0, sharey=True),
            chart={"panels": panels},
        )


def differing(ratios: Sequence[tuple[str, Interval | None]], versus: str) -> str:
    """The verdict on named ratios of errors, see `statistics.ratio_verdicts`; empty if none has an interval.

    Args:
        versus: completes "error ratios", such as "to DIST"; may be empty.
    """
    tested = [(name, ratio) for name, ratio in ratios if ratio is not None and ratio.has_ends]
    what = f"error ratios {versus}".strip()
    if not tested:
        return ""
    verdicts = statistics.ratio_verdicts([ratio for _, ratio in tested])
    undecided = verdicts.count(Verdict.NOT_DECIDABLE)
    sizes = sorted({len(ratio.points) for _, ratio in tested})
    if undecided == len(tested):
        few = f"cannot be decided with {' or '.join(map(str, sizes))} shapes"
        needed = f"{format.plural(undecided, 'ratio')} need {statistics.shapes_needed(undecided)} shapes or more"
        return f"Whether {what} differ from 1 *{few}*: by the sign test with Holm's correction {needed}."
    unequal = [
        f"{name} {ratio}" for (name, ratio), verdict in zip(tested, verdicts, strict=True) if verdict is Verdict.DIFFERS
    ]
    needed = f"{statistics.shapes_agreeing(sizes[-1], len(tested))} of {sizes[-1]} shapes on one side of 1"
    if not unequal and len(tested) == 1:
        name, ratio = tested[0]
        answer = f"{name}: the {what.replace('ratios', 'ratio', 1)} is *{ratio}*, not significantly different from 1."
        return f"{answer} The sign test needs {needed}."
    differ = f"*{len(unequal)} of {len(tested)}* {what} differ significantly from 1 by {HOLM}"
    differ += f"{': ' if unequal else ''}{'; '.join(unequal)}."
    few = f" {undecided} cannot be decided with {sizes[0]} shapes." if undecided else ""
    return f"{differ}{few}{'' if unequal else f' The test needs {needed}.'}"


def ordered(conditions: Collection[str]) -> list[str]:
    """The values of the condition, from many points to few; unknown words come last."""
    numbers = sorted((value for value in conditions if value.isdigit()), key=int, reverse=True)
    words = sorted({*conditions} - {*numbers})
    return [*(w for w in CONDITION_ORDER if w in words), *numbers, *(w for w in words if w not in CONDITION_ORDER)]


def heading(condition: str) -> str:
    return f"{condition} pts" if condition.isdigit() else condition or "Median"


def _evaluation_settings(config: dict[str, Any]) -> list[Any]:
    paths = (("split",), ("prior",), ("evaluation", "grid"), ("evaluation", "points"))
    return [setting(config, *path) for path in paths]
