"""What a command line does with each composed configuration: runs it, and says what became of it."""

import sys
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from bench.command import unwritten
from bench.config import register
from bench.report.html import write_index
from bench.runner import Interrupted, run
from bench.summary import show

LOST = "lost"  # the status, to the driver, of a run that could leave no record


def run_cell(config: DictConfig) -> str:
    """Runs a configuration and gives its status; prints what it came to, but for a sweep's, whose driver does that.

    Raises:
        Interrupted: after Ctrl-C or SIGTERM.
    """
    register()  # again, for a worker of a launcher, which has not read the command line
    _stay_in_place(config)
    alone = OmegaConf.is_missing(HydraConfig.get().job, "num")
    try:
        folder, record = run(config)
    except Interrupted as error:
        if alone:
            show(error.folder, error.record, write_index(error.folder.parent.parent))
        raise
    except OSError as error:
        print(f"error: {unwritten(error)}", file=sys.stderr, flush=True)
        return LOST
    if config.verbose:
        print("\n".join(record.log), file=sys.stderr, flush=True)
    if alone:
        show(folder, record, write_index(folder.parent.parent))
    return record.status


def _stay_in_place(config: DictConfig) -> None:
    """A worker that was started elsewhere has another working directory: results go where the driver's are."""
    driver = Path(HydraConfig.get().runtime.cwd)
    if driver != Path.cwd():
        config.results_dir = str(driver / config.results_dir)
