"""`python -m bench task=completion renderer=dist`: one run, or with -m a sweep."""

from __future__ import annotations  # of a run's process, which imports this module again, nothing else is loaded

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bench.records.folder import Identity


def main() -> int:
    """Runs the command line; 0 if every run ended ok."""
    from bench.run.command import FAILED, command_line
    from bench.run.sweep import Sweep

    statuses: list[str] = []

    def one(run: Identity) -> None:  # in a sweep with a launcher this runs in other processes, on a copy
        from bench.run.run import run_cell

        statuses.append(run_cell(run))

    code = command_line(one)
    if (plan := Sweep.plan) is not None:  # also after Ctrl-C: what was run stands there
        Sweep.end()
        from bench.report.sweeps import write_sweep
        from bench.report.write.html import write_index
        from bench.run.summary import show_sweep

        table = write_sweep(plan)
        statuses = show_sweep(plan, write_index(plan.results_dir), table)
    return code or (FAILED if any(status != "ok" for status in statuses) else 0)


if __name__ == "__main__":
    try:
        from bench.run.process import start_early

        start_early(sys.argv[1:])
        sys.exit(main())
    except KeyboardInterrupt:  # before the command line was read
        sys.exit("error: stopped by Ctrl-C; nothing was run")
