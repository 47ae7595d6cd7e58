"""Shape from many views: the median error over each condition, with the other conditions neutral; and its figure."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from bench.records.format import plural
from bench.report.data import records
from bench.report.data.records import ONE_WAY, Record, by_shape, error, family, grouped, row_of, run_key, setting, solid
from bench.report.data.statistics import Interval, bootstrap, median
from bench.report.write.table import FAMILY, IDENTITY, Column, configured, estimate, metrics, text

ERROR_TEXT = "median Chamfer distance from truth to prediction (squared scene units, times 1000)"
LABEL = "Chamfer × 1000, truth to\nprediction (scene units²)"
INTERVALS = "95 % bootstrap intervals over {shapes and seeds}"
MEDIAN_COLUMNS = estimate("error", "Median")
NAME_COLUMNS = (text("family", "Family"), text("method", "Method"), text("condition", "Condition"))


@dataclass(frozen=True)
class Condition:
    """A setting of the task that varies."""

    key: str
    label: str  # on axes, with the unit
    neutral: float  # in runs that vary another condition

    def value_of(self, record: Record) -> float:
        return float(setting(record["config"], "task", self.key))


def run_columns(conditions: Sequence[Condition], *other_keys: str) -> tuple[Column, ...]:
    keys = (*(configured(condition.key, "task", condition.key) for condition in conditions), *IDENTITY)
    return (FAMILY, *keys, *(configured(key, "task", key) for key in other_keys), *metrics(ONE_WAY, "chamfer_l2"))


def shapes_text(runs: Sequence[Record]) -> str:
    """The number of shapes, and how many each family has, such as 4 shapes, 2 per family."""
    counts = [len(shapes) for shapes in grouped({solid(run) for run in runs}, lambda shape: shape[0]).values()]
    per_family = f", {' or '.join(map(str, sorted({*counts})))} per family" if len(counts) > 1 else ""
    return plural(sum(counts), "shape") + per_family


def median_error(runs: Sequence[Record]) -> Interval:
    """The median error x 1000 over shapes and seeds; the error of a failed run is infinite."""
    return bootstrap(by_shape({run_key(run): records.CHAMFER_SCALE * error(run, ONE_WAY) for run in runs}), median)


def lines_of(runs: Sequence[Record], conditions: Sequence[Condition]) -> list[dict[str, Any]]:
    """A line per family, row, condition and value, from the runs whose other conditions are neutral."""
    lines = []
    for condition in conditions:
        others = [other for other in conditions if other != condition]
        shown = [run for run in runs if all(other.value_of(run) == other.neutral for other in others)]
        groups = grouped(shown, lambda record, get=condition.value_of: (family(record), row_of(record), get(record)))
        for (family_name, row, value), group in groups.items():
            line = {"family": family_name, "method": row.name, "preset": row.preset}
            line |= {"condition": f"{condition.label}: {value:g}", "runs": group, "error": median_error(group)}
            lines.append(line | {"key": condition.key, "value": value})
    return sorted(lines, key=lambda line: (line["family"], line["method"], line["key"], line["value"]))
