"""All that a file of `bench/studies` is written with: its runs, its result, and the modules for what is between.

`records` reads values of a run, `statistics` and `compare` make numbers of many, `table` has the columns, `chart` and
`gallery` draw, `style` has the looks of rows and `format` the texts of numbers.
"""

# ruff: noqa: F401 - what is imported here is passed on
from bench.pictures import style
from bench.records import format
from bench.report import compare, conditions, gallery, medians
from bench.report.data import curves, records, statistics
from bench.report.data.runs import Runs, Selection, merge_runs
from bench.report.write import chart, table
from bench.report.write.result import Result
