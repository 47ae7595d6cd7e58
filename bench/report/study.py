"""Everything that a file of `bench/studies` imports: runs, results, and the modules between them.

`records` reads values of one run, `statistics` and `compare` summarise many runs, `table` has the columns, `chart` and
`gallery` draw, `style` has the looks of rows, and `format` writes numbers.
"""

# ruff: noqa: F401 - these imports are re-exported
from functools import cache
from typing import Any

import yaml

from bench.pictures import style
from bench.records import format
from bench.report import compare, conditions, gallery, medians
from bench.report.data import curves, records, statistics
from bench.report.data.runs import Runs, Selection, merge_runs
from bench.report.write import chart, table
from bench.report.write.result import Result
from bench.tables import CONF


@cache
def published(name: str) -> dict[str, Any]:
    """A table of `conf/published.yaml`: numbers of a paper as text, as printed."""
    return yaml.load((CONF / "published.yaml").read_text(encoding="utf-8"), yaml.BaseLoader)[name]
