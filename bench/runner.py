"""Runs one cell of a plan and writes its record, whatever happens."""

import json
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
from bench.gallery import draw_run
from bench.judge import Judgement, judge
from bench.metrics import DEFINITIONS
from bench.optimise import Course, optimise
from bench.progress import Report, live_progress
from bench.records import Record, RunStatus, claim_folder, digest, plain, write_text
from bench.stage import Stage, set_up
from bench.tasks.problem import Problem, Unsupported

NEUTRAL = ("results_dir", "priors_dir", "verbose")  # keys that change no result, left out of a configuration's hash
COST_DEFINITIONS = {
    "evaluations.value": "points whose field value was computed in the optimisation loop, counted at the field",
    "evaluations.gradient": "points whose field value was back-propagated through in the optimisation loop",
    "evaluations.per_ray": "value evaluations divided by rays times iterations",
    "seconds.warmup": "one step's forward and backward pass before the clock, whose work is not counted",
    "seconds.forward": "rendering and loss, over all iterations; the device is synchronised at both ends",
    "seconds.backward": "back-propagation and the optimiser's step, over all iterations",
    "seconds.evaluation": "meshes, metrics and pictures, off the loop's clock",
    "seconds.total": "the whole run, with shapes and prior made or loaded",
    "peak_memory_bytes": "highest rise, during the loop, of the process's resident memory (CPU) or PyTorch's (GPU)",
    "flops": "value evaluations times the field's operations a value, gradients at twice that",
    "gemm_fraction": "flops over the loop's seconds, divided by the machine's best float32 matrix product rate",
}


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
    stage = set_up(config, progress)
    record.scene, record.notes = stage.scene.name, list(stage.scene.mesh.repairs)
    record.environment = environment.describe(stage.device)
    record.definitions = DEFINITIONS | COST_DEFINITIONS
    problem = stage.problem()
    clock = time.perf_counter()
    first = problem.field()
    before = judge(first, stage)
    record.metrics_start, record.seconds["evaluation"] = before.metrics, time.perf_counter() - clock
    course = Course()
    try:
        _optimise(stage, problem, folder, course, progress)
    finally:
        _note_costs(record, problem, course)
    clock = time.perf_counter()
    after = judge(problem.field(), stage)
    record.metrics = after.metrics
    record.status, record.reason = _verdict(course, after)
    if after.mesh is not None:
        after.mesh.save(folder / "mesh.ply")
    draw_run(folder, stage, (first, problem.field()), problem.observed.cpu().numpy(), course.curve, _title(record))
    record.seconds["evaluation"] += time.perf_counter() - clock


def _optimise(stage: Stage, problem: Problem, folder: Path, course: Course, progress: Report) -> None:
    """The loop, with each line of its curve written as it comes."""
    with (folder / "curve.jsonl").open("w", buffering=1, encoding="utf-8") as curve:

        def on_step(line: dict[str, Any]) -> None:
            curve.write(json.dumps(plain(line), allow_nan=False) + "\n")
            progress("optimising", line["iteration"] + 1, stage.task.optimiser.iterations, line["total"])

        optimise(problem, stage.task.optimiser, stage.device, course=course, on_step=on_step)


def _note_costs(record: Record, problem: Problem, course: Course) -> None:
    """Also for a loop that was cut short, as far as it came."""
    iterations = max(len(course.curve), 1)
    record.seconds |= course.seconds
    record.evaluations = {
        "value": course.counts.value,
        "gradient": course.counts.gradient,
        "per_ray": course.counts.value / problem.rays_per_iteration / iterations,
        "rays_per_iteration": problem.rays_per_iteration,
        "iterations": len(course.curve),
    }
    record.peak_memory_bytes = course.peak_memory_bytes
    record.flops = course.counts.flops(problem.field())
    seconds = course.seconds["forward"] + course.seconds["backward"]
    if record.flops is not None and seconds > 0:
        record.gemm_fraction = record.flops / seconds / record.environment["gemm_peak_flops"]


def _verdict(course: Course, after: Judgement) -> tuple[RunStatus, str]:
    """The truth picks nothing here: a run fails by its own loss and its own surface."""
    if course.status is not RunStatus.OK:
        return course.status, course.reason
    if after.mesh is None:
        return RunStatus.EMPTY, "the field has no surface in the unit sphere"
    first, last = course.curve[0]["total"], course.curve[-1]["total"]
    if last >= first and len(course.curve) > 1:
        return RunStatus.NOT_REACHED, f"the loss did not fall: {first:.4g} at the start, {last:.4g} at the end"
    return RunStatus.OK, ""


def _choices() -> dict[str, str]:
    """What was chosen for task, renderer and dataset, by the name of the chosen YAML."""
    chosen = HydraConfig.get().runtime.choices
    return {name: str(chosen[name]) for name in ("task", "renderer", "dataset")}


def _title(record: Record) -> str:
    return f"{record.task}, {record.renderer}, {record.scene}: {record.status}"


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
