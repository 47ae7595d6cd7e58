"""Runs under conditions of which one varies at a time, each with a neutral value: medians by row and value."""

from dataclasses import dataclass

from bench.report.data.experiments import Experiment
from bench.report.data.records import (
    ONE_WAY,
    SCALE,
    Record,
    Row,
    by_shape,
    error,
    family,
    grouped,
    row_of,
    run_key,
    setting,
)
from bench.report.data.statistics import Interval, bootstrap, median


@dataclass(frozen=True)
class Condition:
    """A setting of the task that varies.

    Args:
        key: its name in the task.
        label: with its unit.
        neutral: its value where another varies.
    """

    key: str
    label: str
    neutral: float

    def of(self, record: Record) -> float:
        """Its value in a run."""
        return float(setting(record["config"], "task", self.key))


Conditions = tuple[Condition, ...]
Cell = tuple[str, Row, Condition, float]  # family, row, condition, its value


def cells(experiment: Experiment, conditions: Conditions) -> dict[Cell, list[Record]]:
    """The runs of each family, row and value of a condition, with all other conditions at their neutral values."""
    found: dict[Cell, list[Record]] = {}
    for one in conditions:
        others = [other for other in conditions if other != one]
        alone = [record for record in experiment.records if all(other.of(record) == other.neutral for other in others)]
        found |= grouped(alone, lambda record, one=one: (family(record), row_of(record), one, one.of(record)))
    return dict(sorted(found.items(), key=lambda item: (item[0][0], item[0][1].name, item[0][2].key, item[0][3])))


def middle(records: list[Record]) -> Interval:
    """The median error from truth to prediction x 1000, over shapes and seeds; a run that failed is infinite."""
    return bootstrap(by_shape({run_key(run): SCALE * error(run, ONE_WAY) for run in records}), median, seed=0)
