"""Does the work of one run in this process; whatever happens, the record says so."""

import logging
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import torch
from omegaconf import DictConfig

from bench import environment
from bench.config import build, check_top_level
from bench.contention import Contention
from bench.ladder.settings import PRIOR
from bench.progress import Report
from bench.records import Record, RunStatus
from bench.stage import Cell, set_up
from bench.tasks.problem import TakesField, Task, Unsupported


def execute(
    config: DictConfig, folder: Path, record: Record, *, progress: Report, checkpoint: Callable[[Record], None]
) -> None:
    """Runs a configuration, and fills its record with what came of it.

    Args:
        config: of the run.
        folder: where its files go.
        record: is given a status, and a reason where that is not ok.
        progress: is told how far it is.
        checkpoint: is given the record as soon as it says on what machine it runs.

    Raises:
        KeyboardInterrupt: where it was stopped; the record has what it came to.
    """
    log = _open_log(folder)
    contention = Contention()
    try:
        check_top_level(config)
        task = build(config.task, "task", list(config.packages))
        if not isinstance(task, Task):
            raise ValueError(f"task {type(task).__name__} lacks execute: see bench/tasks/problem.py")
        stage = set_up(config, progress)
        if stage.field != PRIOR and not isinstance(task, TakesField):
            raise ValueError(f"task={record.task} takes no field but its own: leave field={stage.field} out")
        record.scene, record.notes = stage.scene_name, [*record.notes, *stage.notes]
        record.environment |= environment.describe(stage.device)
        checkpoint(record)
        try:
            task.execute(Cell(stage, folder, record, progress))
        finally:
            record.notes = [*record.notes, *stage.last_notes]
    except Unsupported as error:
        record.status, record.reason = RunStatus.UNSUPPORTED, _one_line(error)
    except (MemoryError, torch.OutOfMemoryError) as error:
        record.status, record.reason = RunStatus.OOM, _one_line(error)
    except Exception as error:  # noqa: BLE001 - whatever a run does, its record says so
        out_of_memory = "DefaultCPUAllocator: can't allocate" in str(error)
        record.status, record.reason = RunStatus.OOM if out_of_memory else RunStatus.CRASHED, _one_line(error)
        log.error(traceback.format_exc())
    finally:
        record.environment |= contention.measured()
        record.notes += contention.warnings(record)
        log.info("%s %s", record.status, record.reason)
        _close_log(log)


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


class _LogFile(logging.FileHandler):
    """A log file that a full disk silences, but does not make a nuisance of."""

    def handleError(self, record: logging.LogRecord) -> None:
        """The record of the run says what went wrong."""


def _open_log(folder: Path) -> logging.Logger:
    log = logging.Logger(folder.name, logging.INFO)  # not registered: Hydra disables registered ones between jobs
    handler = _LogFile(folder / "log.txt", encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    log.addHandler(handler)
    return log


def _close_log(log: logging.Logger) -> None:
    for handler in log.handlers:
        with suppress(OSError):
            handler.close()
