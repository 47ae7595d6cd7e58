"""`python -m bench task=completion renderer=dist`: one run, or with -m a sweep."""

import sys

from omegaconf import DictConfig

from bench.command import FAILED, command_line
from bench.plan import Sweep


def main() -> int:
    """Runs the command line; 0 if every run ended ok."""
    statuses: list[str] = []

    def one(config: DictConfig) -> None:  # in a sweep with a launcher this runs in other processes, on a copy
        from bench.cell import run_cell  # what it needs waits until the command line is known to be sound

        statuses.append(run_cell(config))

    code = command_line(one)
    plan = Sweep.end()
    if plan is not None:  # also after Ctrl-C: what was run stands there
        from bench.summary import show_sweep

        statuses = show_sweep(plan)
    return code or (FAILED if any(status != "ok" for status in statuses) else 0)


if __name__ == "__main__":
    sys.exit(main())
