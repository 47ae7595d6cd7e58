"""Executes one run in this process; every failure is recorded with its reason."""

import logging
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import torch
from omegaconf import DictConfig

from bench.config import build, check_top_level
from bench.machine import environment
from bench.machine.contention import Contention
from bench.models.field import FieldChoice
from bench.progress import Report
from bench.records.record import Record, RunStatus
from bench.setup.inputs import RunContext, RunInputs, set_up
from bench.solve.problem import Unsupported
from bench.tasks.task import TakesField, Task


def execute(
    config: DictConfig, folder: Path, record: Record, *, progress: Report, checkpoint: Callable[[Record], None]
) -> None:
    """Runs a configuration and fills its record.

    Args:
        config: configuration of the run.
        folder: for the run's files.
        record: gets a status, and a reason where that is not ok.
        progress: receives the progress.
        checkpoint: receives the record as soon as the machine is known.

    Raises:
        KeyboardInterrupt: where the run was stopped; the record has what is known.
    """
    log = _open_log(folder)
    contention = Contention()
    try:
        check_top_level(config)
        task = build(config.task, "task", list(config.packages))
        if not isinstance(task, Task):
            raise ValueError(f"task {type(task).__name__} lacks execute: see bench/tasks/task.py")
        inputs = _with_field(set_up(config, progress), config)
        if not inputs.field.of_prior and not isinstance(task, TakesField):
            raise ValueError(f"task={record.task} does not take field={config.field}: leave it out")
        record.scene, record.notes = inputs.scene_name, [*record.notes, *inputs.notes]
        record.environment |= environment.describe(inputs.device)
        checkpoint(record)
        try:
            task.execute(RunContext(inputs, folder, record, progress))
        finally:
            record.notes = [*record.notes, *inputs.last_notes]
    except Unsupported as error:
        record.status, record.reason = RunStatus.UNSUPPORTED, _one_line(error)
    except (MemoryError, torch.OutOfMemoryError) as error:
        record.status, record.reason = RunStatus.OOM, _one_line(error)
    except Exception as error:  # noqa: BLE001 - every failure of a run is recorded
        out_of_memory = "DefaultCPUAllocator: can't allocate" in str(error)
        record.status, record.reason = RunStatus.OOM if out_of_memory else RunStatus.CRASHED, _one_line(error)
        log.error(traceback.format_exc())
    finally:
        record.environment |= contention.measured()
        record.notes += contention.warnings(record)
        log.info("%s %s", record.status, record.reason)
        _close_log(log)


def _with_field(inputs: RunInputs, config: DictConfig) -> RunInputs:
    """The inputs with the kind of field for an unknown shape, and the candidates for it."""
    models = build(config.models, "models", target="bench.models.candidates.ModelSettings")
    return replace(inputs, field=FieldChoice(config.field, models))


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


class _LogFile(logging.FileHandler):
    """A log file whose write errors, such as a full disk, are ignored."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Does nothing: the run's record has the reason of a failure."""


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
