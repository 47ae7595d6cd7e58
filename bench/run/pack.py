"""`hydra/launcher=slurm`: jobs of many runs each, by the seconds that the runs are expected to take.

Submitit submits the jobs and waits for them, with `hydra.launcher.cluster=local` on this machine.
"""

import os
import signal
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, make_dataclass, replace
from math import ceil, inf
from pathlib import Path
from shutil import which
from statistics import median
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.plugins.launcher import Launcher
from omegaconf import MISSING, OmegaConf

from bench.progress import notice
from bench.records.format import plural
from bench.records.read import Plan, PlannedCell
from bench.records.record import BESIDE, RunStatus
from bench.run.compose import identity_of
from bench.run.job import unwritten
from bench.run.plan import kind, times
from bench.run.process import catch_signals, stopped_by

# Keys of `hydra.launcher` that are ours; see conf/hydra/launcher/slurm.yaml.
KEYS = {"cluster": str, "minutes_per_job": float, "minutes_per_run": float, "array_size": int}
CLUSTERS = ("slurm", "local")
PLUGIN = (
    "hydra_plugins.implicit_bench"  # the name of this module for Hydra, which takes launchers of `hydra_plugins` alone
)


def register_slurm() -> None:
    """Makes the launcher and its keys known to Hydra, where submitit's plugin is installed."""
    try:
        from hydra_plugins.hydra_submitit_launcher.config import SlurmQueueConf
    except ImportError:
        return
    ours = [("_target_", str, f"{PLUGIN}.Packed"), *((key, of, MISSING) for key, of in KEYS.items())]
    node = make_dataclass("Packed", ours, bases=(SlurmQueueConf,))
    ConfigStore.instance().store(group="hydra/launcher", name="submitit_packed", node=node)
    sys.modules[PLUGIN] = sys.modules[__name__]
    Plugins.instance().register(Packed)


def packs(launcher: Mapping[str, Any]) -> bool:
    """Whether a launcher, by its settings, makes jobs of several runs."""
    return "minutes_per_job" in launcher


def check_jobs(cells: Sequence[PlannedCell], launcher: Mapping[str, Any]) -> None:
    """Checks what a launcher of jobs is told about the cells that are to run.

    Raises:
        ValueError: for a value out of range, and where a job may end before a run reaches its limit.
    """
    timeout = launcher.get("timeout_min", inf)
    limit = max((cell.config["time_limit"] or 0 for cell in cells), default=0)
    if limit > 60 * timeout:
        raise ValueError(
            f"hydra.launcher.timeout_min={timeout} ends a job before time_limit={limit:g} seconds end its run: set "
            f"hydra.launcher.timeout_min={ceil(limit / 60)} or more, or time_limit={60 * timeout} or less"
        )
    if not packs(launcher):
        return
    for key in ("minutes_per_job", "minutes_per_run", "array_size", "tasks_per_node"):
        if not launcher[key] > 0:
            raise ValueError(f"hydra.launcher.{key} must be positive, not {launcher[key]}: leave it out")
    if launcher["minutes_per_job"] > timeout:
        raise ValueError(
            f"hydra.launcher.minutes_per_job={launcher['minutes_per_job']:g} is more than hydra.launcher.timeout_min="
            f"{timeout}, which ends a job: set hydra.launcher.minutes_per_job={timeout / 4:g}, since some take longer"
        )
    if launcher["cluster"] not in CLUSTERS:
        raise ValueError(f"hydra.launcher.cluster must be {' or '.join(CLUSTERS)}, not {launcher['cluster']!r}")


def packed(plan: Plan, launcher: Mapping[str, Any], reused: set[str]) -> list[Plan]:
    """The part of a plan that each job does, without the cells that are reused."""
    known, unknown = times(plan, reused), [60 * launcher["minutes_per_run"]]
    cells = [cell for cell in plan.cells if cell.id not in reused]
    expected = [min(median(known[kind(vars(one))] or unknown), one.config["time_limit"] or inf) for one in cells]
    jobs = grouped(expected, 60 * launcher["minutes_per_job"] * launcher["tasks_per_node"])
    return [replace(plan, cells=[cells[place] for place in places]) for places in jobs]


def grouped(seconds: Sequence[float], most: float) -> list[list[int]]:
    """The places of runs in each job: in their order, as many as `most` seconds hold, and one at least."""
    jobs, left = list[list[int]](), 0.0
    for place, each in enumerate(seconds):
        if not jobs or each > left:
            jobs.append([])
            left = most
        jobs[-1].append(place)
        left -= each
    return jobs


def in_words(jobs: Sequence[Plan], launcher: Mapping[str, Any]) -> str:
    """How many jobs there are, and how long they take."""
    text = f"{plural(sum(len(job.cells) for job in jobs), 'run')} in {plural(len(jobs), 'job')}"
    beside = f", {launcher['tasks_per_node']} at a time in each" if launcher["tasks_per_node"] > 1 else ""
    return f"{text}{beside}, by hydra.launcher.minutes_per_job={launcher['minutes_per_job']:g}"


@dataclass(frozen=True)
class Pack:
    """What a job does: the runs of its cells, one after another; the tasks of a job share them.

    Args:
        plan: of the sweep, with the cells of this job alone.
        folder: in which the command was typed: relative paths of configurations lead from there.
        variables: of the environment, that the launcher sets for runs.
    """

    plan: Plan
    folder: str
    variables: dict[str, str]

    def __call__(self) -> list[str]:
        """Makes the runs that are not there yet, until a signal ends the job; gives what there is to say."""
        from submitit import JobEnvironment

        job, said = JobEnvironment(), list[str]()
        os.chdir(self.folder)
        os.environ |= self.variables | {BESIDE: str(job.num_tasks)}
        catch_signals()
        for number in (signal.SIGUSR1, signal.SIGUSR2):  # of a scheduler, before it ends a job
            signal.signal(number, signal.getsignal(signal.SIGTERM))
        try:
            for cell in self.plan.cells[job.global_rank :: job.num_tasks]:
                record = self.plan.record(cell)  # of this job, before it was requeued
                if record is None or record["status"] == RunStatus.KILLED:
                    said += made(cell)
        except KeyboardInterrupt as error:
            why = stopped_by(error).removeprefix("killed: ").partition(";")[0]
            said.append(f"job {job.job_id}: {why}; the same command goes on")
        return said


def made(cell: PlannedCell) -> list[str]:
    """Makes the run of a cell, or reuses it; says why it has no record, where that is so."""
    from bench.run.run import run  # of the command line, which imports this module

    try:
        run(identity_of(cell))
    except OSError as error:
        return [unwritten(error, cell.config["results_dir"])]
    except ValueError as error:
        return [str(error)]
    return []


class Packed(Launcher):
    """Hydra's launcher of packed jobs; where the cells of a sweep are no runs, each has a job."""

    __module__ = PLUGIN

    def __init__(self, **settings: Any) -> None:
        self.settings = {
            key: OmegaConf.to_object(of) if OmegaConf.is_config(of) else of for key, of in settings.items()
        }
        self.passed_on = {key: of for key, of in self.settings.items() if key not in KEYS}

    def setup(self, **context: Any) -> None:
        """Keeps what Hydra launches jobs with."""
        self.context = context

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[Any]:
        """Runs the cells of a sweep, an array of jobs after another, and waits for them."""
        from hydra_plugins.hydra_submitit_launcher.submitit_launcher import SlurmLauncher

        from bench.run.sweep import Sweep  # it imports this module

        if Sweep.plan is None:
            stock = SlurmLauncher(**self.passed_on)
            stock.setup(**self.context)
            return stock.launch(job_overrides, initial_job_idx)
        cells = Sweep.plan.cells[initial_job_idx : initial_job_idx + len(job_overrides)]
        for cell in (cell for cell in cells if cell.id in Sweep.reused):
            _say(made(cell))  # its record tells that it was asked for
        variables = {key: str(of) for key, of in self.context["config"].hydra.job.env_set.items()}
        parts = packed(replace(Sweep.plan, cells=cells), self.settings, Sweep.reused)
        jobs = [Pack(part, str(Path.cwd()), variables) for part in parts]
        if not jobs:
            return []
        notice(in_words(parts, self.settings))
        executor, size = self._executor(), self.settings["array_size"]
        for start in range(0, len(jobs), size):
            for job in executor.submit_array(jobs[start : start + size]):
                for task in range(job.num_tasks):
                    _say(_told(job.task(task)))
        return []

    def _executor(self) -> Any:
        """Submitit's, with the settings of this launcher, as submitit's plugin makes it."""
        from hydra_plugins.hydra_submitit_launcher.config import BaseQueueConf
        from submitit import AutoExecutor

        if self.settings["cluster"] == "slurm" and which("srun") is None:
            raise ValueError("no Slurm is here: type this on a machine of the cluster, or hydra.launcher.cluster=local")
        rest, shared = dict(self.passed_on), BaseQueueConf.__dataclass_fields__
        folder, retries = rest.pop("submitit_folder"), rest.pop("max_num_timeout")
        executor = AutoExecutor(folder, self.settings["cluster"], slurm_max_num_timeout=retries)
        executor.update_parameters(**{key if key in shared else f"slurm_{key}": of for key, of in rest.items()})
        return executor


def _told(task: Any) -> list[str]:
    """What a task of a job has to say when it has ended, also where it was lost."""
    from submitit.core.utils import UncompletedJobError

    try:
        return task.result()
    except UncompletedJobError:
        return [f"job {task.job_id} was lost; {task.paths.stderr} may say why; the same command goes on"]


def _say(lines: list[str]) -> None:
    for text in lines:
        notice(f"error: {text}")
