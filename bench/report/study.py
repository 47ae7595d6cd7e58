"""Everything that a file of `bench/studies` imports: runs, results, and the modules between them.

`records` reads values of one run, `statistics` and `compare` summarise many runs, `table` has the columns, `chart` and
`gallery` draw, `figure_style` and `style` have the looks of figures, and `format` writes numbers. `breakdowns` reads
stress tests.
"""

# ruff: noqa: F401 - these imports are re-exported
from bench.pictures import figure_style, style
from bench.records import format
from bench.report import breakdowns, compare, condition_curves, conditions, gallery, medians
from bench.report.compare import published
from bench.report.data import curves, records, statistics
from bench.report.data.runs import NoFolder, Runs, Selection, merge_runs
from bench.report.write import chart, table
from bench.report.write.result import Result
