"""What a command line does with each composed configuration: runs it, and says what became of it."""

import sys
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from bench.config import register
from bench.records import Record
from bench.report.html import write_index
from bench.runner import Interrupted, run
from bench.summary import line, show

LOST = "lost"  # the status, to the driver, of a run that could leave no record


def run_cell(config: DictConfig) -> str:
    """Runs a configuration and prints what it came to: a table, or in a sweep one line. Gives its status.

    Raises:
        Interrupted: after Ctrl-C or SIGTERM.
    """
    register()  # again, for a worker of a launcher, which has not read the command line
    tell = _line if not OmegaConf.is_missing(HydraConfig.get().job, "num") else _table
    try:
        folder, record = run(config)
        tell(folder, record)
    except Interrupted as error:
        tell(error.folder, error.record)
        raise
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        remedy = "set results_dir to a folder you can write, or free space"
        print(f"error: {error.strerror or error}{where}: {remedy}", file=sys.stderr, flush=True)
        return LOST
    return record.status


def _table(folder: Path, record: Record) -> None:
    show(folder, record, write_index(folder.parent.parent))


def _line(folder: Path, record: Record) -> None:
    print(line(folder, record), flush=True)
