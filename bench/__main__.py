"""`python -m bench task=completion renderer=dist`: one run, or with -m a sweep."""

from __future__ import annotations  # a run's process imports this module again and must not load more

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bench.records.results import Plan


def main() -> int:
    """Runs the command line; returns 0 if every run ended ok."""
    from bench.runner.command import command_line
    from bench.runner.run import run_one
    from bench.runner.sweep import run_sweep

    return command_line(run_one, lambda composer, config: run_sweep(composer, config, _summarise))


def _summarise(plan: Plan) -> list[str]:
    """Writes and prints the summary of a sweep; returns the status of each of its cells."""
    from bench.records.read import read_records
    from bench.report.sweeps import summary_lines, write_sweep
    from bench.report.write.html import MAX_MESHES, page_lock, write_page
    from bench.runner.summary import print_sweep_summary

    problems: list[str] = []
    with page_lock(plan.results_dir):
        records, unread = read_records(plan.results_dir)
        lines = summary_lines(write_sweep(plan, records, problems))
        index = write_page(records, unread, plan.results_dir, MAX_MESHES)
    return print_sweep_summary(plan, index, [*lines, *problems])


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:  # before the command line was read
        print("error: stopped by Ctrl-C; nothing was run", file=sys.stderr)
        sys.exit(130)  # as after the command line was read
