"""Tables: a `Column` defines a value, its name in the CSV, and its heading and text in the readable table."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import pandas as pd

from bench.records import format
from bench.records.metrics import LOWER
from bench.report.data import records
from bench.report.data.records import CHAMFER_SCALE, measured, row_of, setting
from bench.report.data.statistics import Interval

thousandfold = partial(format.number, scale=CHAMFER_SCALE)
ENDS = ("low", "high")


def integer(value: float | None) -> str:
    """A count as text, without decimals."""
    return format.number(value) if value is None else f"{value:.0f}"


def word(value: Any) -> str:
    """A name or a number as text, unchanged."""
    return format.MISSING if value is None else str(value)


def queries(values: int | float | None, coarse: int | float | None) -> str:
    """Counts of field evaluations and coarse evaluations, such as 39.9k + 123k coarse."""
    return f"{format.count(values)} + {format.count(coarse)} coarse" if coarse else format.count(values)


def size(n: int | float | None) -> str:
    """A number of bytes with its unit, in powers of 1000, such as 512 B or 1.43 GB."""
    if n is None or not math.isfinite(n):
        return format.number(n)
    text = format.count(n)
    return f"{text} B" if text[-1].isdigit() else f"{text[:-1]} {text[-1]}B"


def percent(share: float | None) -> str:
    """A fraction in whole per cent."""
    return format.number(share) if share is None else f"{100 * share:.0f} %"


def small_percent(share: float | None) -> str:
    """A fraction in per cent, with enough digits for small ones."""
    return format.number(share) if share is None else f"{format.number(share, 100)} %"


def count_with_interval(number: float, total: int, rate: Interval) -> str:
    """A count with the interval of its fraction in per cent, or with the number of shapes, such as 3 of 4 (n = 2)."""
    return f"{number:g} of {total} {rate.ends(100)}{' %' if rate.has_ends else ''}"


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    key: str  # in the CSV; empty for a column of the readable table only
    heading: str = ""  # in the readable table; empty for a column of the CSV only
    value: Callable[[Any], Any] | None = None  # of a line; None: `line.get(key)`
    show: Callable[[Any], str] = format.number
    words: Callable[[Any], str] | None = None  # the text of a line, if it depends on more than the value
    better: str = ""  # "lower" or "higher" if the best values are bold
    is_metric: bool = False  # some run must have it if the column has a heading

    def of(self, line: Any) -> Any:
        return line.get(self.key) if self.value is None else self.value(line)

    def text(self, line: Any) -> str:
        """The text of a line for readers; nan counts as missing."""
        if self.words is not None:
            return self.words(line)
        value = self.of(line)
        return self.show(None if isinstance(value, float) and math.isnan(value) else value)


def to_data(columns: Sequence[Column], lines: Iterable[Any]) -> pd.DataFrame:
    """The raw values of all lines, for the CSV."""
    in_csv = [column for column in columns if column.key]
    return pd.DataFrame([[c.of(line) for c in in_csv] for line in lines], columns=[c.key for c in in_csv], dtype=object)


def to_table(columns: Sequence[Column], lines: Iterable[Any]) -> pd.DataFrame:
    """The values of all lines as text, for readers."""
    shown = [column for column in columns if column.heading]
    return pd.DataFrame([[c.text(line) for c in shown] for line in lines], columns=[c.heading for c in shown])


def best(columns: Sequence[Column], lines: Sequence[Any]) -> list[list[int]]:
    """The row and the column, in the readable table, of the best values of each column with different values."""
    cells = []
    for index, column in enumerate([column for column in columns if column.heading]):
        values = [column.of(line) for line in lines] if column.better else []
        finite = [value for value in values if value is not None and math.isfinite(value)]
        if len({*values}) > 1 and finite:
            top = min(finite) if column.better == LOWER else max(finite)
            cells += [[line, index] for line, value in enumerate(values) if value == top]
    return cells


def columns(show: Callable[[Any], str] = format.number, /, **headings: str) -> tuple[Column, ...]:
    """Columns by their keys, with their headings and how all of them show values."""
    return tuple(Column(key, heading, show=show) for key, heading in headings.items())


def raw(*keys: str) -> tuple[Column, ...]:
    """Of the CSV only."""
    return tuple(map(Column, keys))


def text(key: str, heading: str = "", value: Callable[[Any], Any] | None = None) -> Column:
    return Column(key, heading, value, show=word)


def estimate(key: str, heading: str) -> tuple[Column, ...]:
    """The column of an estimate, which a line may lack, and CSV columns of its ends."""

    def words(line: Any) -> str:
        return format.MISSING if line[key] is None else str(line[key])

    value = Column(key, heading, lambda line: line[key] and line[key].value, words=words)
    low, high = (Column(end, value=lambda line, end=end: getattr(line[key], end, None)) for end in ENDS)
    return value, low, high


def ends(key: str, get: Callable[[Any], Interval | None]) -> tuple[Column, ...]:
    """CSV columns of the ends of an interval, which a line may lack."""
    return tuple(Column(f"{key}_{end}", value=lambda line, end=end: getattr(get(line), end, None)) for end in ENDS)


def shown(heading: str, words: Callable[[Any], str]) -> Column:
    """A column of the readable table, not of the CSV."""
    return Column("", heading, words=words)


def joined(heading: str, get: Callable[[Any, str], Any], show: Callable[[Any], str], *keys: str) -> Column:
    """A column of the readable table with several values of a line, which `get` reads by their keys."""

    def words(line: Any) -> str:
        texts = [show(get(line, key)) for key in keys]
        return format.MISSING if set(texts) == {format.MISSING} else " / ".join(texts)

    return shown(heading, words)


def metric(name: str, heading: str = "", show: Callable[[Any], str] = format.number) -> Column:
    return Column(name, heading, lambda record: measured(record, name), show, is_metric=True)


def metrics(*names: str) -> tuple[Column, ...]:
    return tuple(metric(name) for name in names)


def configured(key: str, *path: str, heading: str = "") -> Column:
    return Column(key, heading, lambda record: setting(record["config"], *path), word)


def through(select: Callable[[Any], Any], *columns: Column) -> tuple[Column, ...]:
    """The columns applied to a part of each line, such as its record."""
    return tuple(replace(c, value=lambda line, c=c: c.of(select(line))) for c in columns)


def extremes(
    what: str,
    values: Mapping[str, float | None],
    n: str,
    *,
    show: Callable[[float], str] = format.number,
    largest_first: bool = False,
) -> str:
    """A sentence with the best and the worst value and their rows, of a sample `n`; empty if no value is finite."""
    numbers = {row: value for row, value in values.items() if value is not None and not math.isnan(value)}
    ordered = sorted(numbers, key=lambda row: -numbers[row] if largest_first else numbers[row])
    if not ordered or math.isinf(numbers[ordered[0]]):
        return ""
    best, worst = (f"{show(numbers[row])}" for row in (ordered[0], ordered[-1]))
    rest = f" to {worst} ({ordered[-1]})" if len(ordered) > 1 else ""
    return f"{what}: *{best}* ({ordered[0]}){rest}; n = {n}."


# Identity and outcome of a run, for every table of runs.
IDENTITY = (
    text("row", value=lambda record: row_of(record).name),
    *(text(key) for key in ("renderer", "seed")),
    text("index", value=records.index),
    *(text(key) for key in ("status", "reason", "folder")),
)
COMPLETION = (*IDENTITY, *metrics("chamfer_l2", "chamfer_l1", "normal_consistency", "mask_iou"))
PRESET = text("preset")  # CSV only; it decides the colour of a row in charts
FAMILY = text("family", value=records.family)
LOOP = (
    Column("loop_seconds", value=records.loop_seconds),
    Column("value_evaluations", value=records.value_evaluations),
)
