"""`python -m bench task=completion renderer=dist`: one run, or with -m a sweep."""

import sys

from omegaconf import DictConfig

from bench.command import FAILED, command_line


def main() -> int:
    """Runs the command line; 0 if every run ended ok."""
    statuses: list[str] = []

    def one(config: DictConfig) -> None:
        from bench.report.html import write_index  # torch and the rest wait until the command line is known to be sound
        from bench.runner import run
        from bench.summary import show

        folder, record = run(config)
        show(folder, record, write_index(folder.parent.parent))
        statuses.append(record.status)
        if record.status == "killed":
            raise KeyboardInterrupt(f"killed: {record.reason}")  # a sweep stops with its run

    code = command_line(one)
    return code or (FAILED if any(status != "ok" for status in statuses) else 0)


if __name__ == "__main__":
    sys.exit(main())
