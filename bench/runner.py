"""Runs one cell of a plan and writes its record, whatever happens."""

import logging
import time
import traceback
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from bench import environment
from bench.config import build, check_top_level
from bench.progress import Report, live_progress
from bench.records import Record, RunStatus, claim_folder, digest, write_text
from bench.stage import Cell, set_up
from bench.tasks.problem import Task, Unsupported

NEUTRAL = ("results_dir", "priors_dir", "verbose")  # keys that change no result, left out of a configuration's hash


def run(config: DictConfig) -> tuple[Path, Record]:
    """Makes a run folder, runs the configuration in it, and leaves its record there.

    Raises:
        OSError: where the results folder cannot be written.
    """
    choices = _choices()
    # As far as it can be resolved: a value that is missing is an error of the run, not of its record.
    values: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=False)
    identity = {key: value for key, value in values.items() if key not in NEUTRAL}
    folder = claim_folder(Path(config.results_dir), "-".join([*choices.values(), digest(identity)[:8]]))
    record = Record(folder.name, **choices, seed=config.seed, config=values)
    record.write(folder)
    log = _open_log(folder)
    started = time.perf_counter()
    try:
        write_text(folder / "config.yaml", OmegaConf.to_yaml(config, resolve=True))
        with live_progress() as progress:
            _execute(config, folder, record, progress)
    except KeyboardInterrupt as error:
        who = str(error) or "stopped by Ctrl-C"
        record.status, record.reason = RunStatus.KILLED, f"{who}; the same command starts it anew"
    except Unsupported as error:
        record.status, record.reason = RunStatus.UNSUPPORTED, _one_line(error)
    except (MemoryError, torch.OutOfMemoryError) as error:
        record.status, record.reason = RunStatus.OOM, _one_line(error)
    except Exception as error:  # noqa: BLE001 - whatever a run does, its record says so
        out_of_memory = "DefaultCPUAllocator: can't allocate" in str(error)
        record.status, record.reason = RunStatus.OOM if out_of_memory else RunStatus.CRASHED, _one_line(error)
        log.error(traceback.format_exc())
        if config.verbose:
            traceback.print_exc()
    finally:
        record.seconds["total"] = time.perf_counter() - started
        log.info("%s %s", record.status, record.reason)
        _close_log(log)
        record.write(folder)
    return folder, record


def _execute(config: DictConfig, folder: Path, record: Record, progress: Report) -> None:
    check_top_level(config)
    task = build(config.task, "task", list(config.packages))
    if not isinstance(task, Task):
        raise ValueError(f"task {type(task).__name__} lacks execute: see bench/tasks/problem.py")
    stage = set_up(config, progress)
    record.scene, record.notes = stage.scene.name, list(stage.scene.mesh.repairs)
    record.environment = environment.describe(stage.device)
    task.execute(Cell(stage, folder, record, progress))


def _choices() -> dict[str, str]:
    """What was chosen for task, renderer and dataset, by the name of the chosen YAML."""
    chosen = HydraConfig.get().runtime.choices
    return {name: str(chosen[name]) for name in ("task", "renderer", "dataset")}


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
