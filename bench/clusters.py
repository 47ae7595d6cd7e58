"""Runs the cells of a sweep in worker processes, in Slurm jobs of several runs each, or by Ray.

conf/hydra/launcher has their settings.
"""

import os
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from math import ceil, inf
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from shutil import which
from statistics import median
from typing import Any, ClassVar

from bench.records.format import plural
from bench.records.record import CONCURRENT_RUNS_VARIABLE
from bench.records.results import Plan, PlannedRun
from bench.runner.durations import duration_group, durations_of_similar_runs
from bench.runner.executors import Jobs, Launcher, Make, Messages
from bench.runner.messages import exit_with_parent
from bench.runner.process import WORKER, catch_signals, signals_delayed, stop_signal, warm_up

CLUSTERS = ("slurm", "local")
POSITIVE_KEYS = ("minutes_per_job", "minutes_per_run", "array_size", "tasks_per_node", "timeout_min")
# Keys of conf/hydra/launcher/slurm.yaml: those that submitit does not know, and those that all its clusters share.
OUR_SETTINGS = (
    *("executor", "cluster", "minutes_per_job", "minutes_per_run", "array_size", "submitit_folder", "max_num_timeout"),
)
COMMON_SETTINGS = (
    *("timeout_min", "cpus_per_task", "gpus_per_node", "tasks_per_node", "mem_gb", "nodes", "name", "stderr_to_stdout"),
)


class Workers(Launcher):
    """Runs cells in processes of this machine, each one cell at a time."""

    def run(self, make: Make, jobs: Jobs) -> Messages:
        cells = [*chain.from_iterable(jobs)]
        remaining = iter(cells)
        workers = dict(_start_worker(make) for _ in range(min(self.concurrency, len(cells))))
        try:
            for channel in workers:
                channel.send(next(remaining))
            while workers:
                for channel in wait([*workers]):
                    assert isinstance(channel, Connection)
                    try:
                        yield channel.recv()
                        channel.send(next(remaining, None))
                    except (EOFError, ConnectionError):  # the worker has received None, or is lost
                        process = workers.pop(channel)
                        process.join()
                        if process.exitcode:
                            raise RuntimeError(f"a worker ended with exit status {process.exitcode}") from None
        finally:
            for process in workers.values():
                process.terminate()
            for process in workers.values():
                process.join()


def _start_worker(make: Make) -> tuple[Connection, BaseProcess]:
    """Starts a worker from the server of processes; returns the connection to it, and its process."""
    context = warm_up()
    parent_end, child_end = context.Pipe()
    process = context.Process(target=_worker_main, args=(make, child_end), name=WORKER)
    with signals_delayed():
        process.start()
        child_end.close()
    return parent_end, process


def _worker_main(make: Make, channel: Connection) -> None:
    """Runs the cells that the channel sends, until it sends None or a signal comes."""
    catch_signals()
    exit_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to all processes; the parent passes it on
    try:
        while (cell := channel.recv()) is not None:
            channel.send(make(cell))
    except (KeyboardInterrupt, EOFError):
        return


class Slurm(Launcher):
    """Runs cells in one array of Slurm jobs after another, several cells per job, by submitit."""

    extra: ClassVar[str] = "submitit"
    is_local: ClassVar[bool] = False

    @property
    def runs_per_job(self) -> int:
        return self.settings["tasks_per_node"]

    @property
    def rate(self) -> str:
        return "many to a job"

    def check(self, cells: Sequence[PlannedRun]) -> None:
        """Checks the settings for the cells to run.

        Raises:
            ValueError: if a value is out of range, or a job may end before a run reaches its time limit.
        """
        settings = self.settings
        for key in POSITIVE_KEYS:
            if not (isinstance(settings[key], int | float) and settings[key] > 0):
                raise ValueError(f"hydra.launcher.{key} must be positive, not {settings[key]}: leave it out")
        timeout, minutes = settings["timeout_min"], settings["minutes_per_job"]
        limit = max((cell.config["time_limit"] or 0 for cell in cells), default=0)
        if limit > 60 * timeout:
            raise ValueError(
                f"hydra.launcher.timeout_min={timeout} ends a job before time_limit={limit:g} seconds end its run: set "
                f"hydra.launcher.timeout_min={ceil(limit / 60)} or more, or time_limit={60 * timeout} or less"
            )
        if minutes > timeout:
            raise ValueError(
                f"hydra.launcher.minutes_per_job={minutes:g} is more than hydra.launcher.timeout_min={timeout}, which "
                f"ends a job: set hydra.launcher.minutes_per_job={timeout / 4:g}, since some take longer"
            )
        if settings["cluster"] not in CLUSTERS:
            raise ValueError(f"hydra.launcher.cluster must be {' or '.join(CLUSTERS)}, not {settings['cluster']!r}")

    def jobs(self, plan: Plan, reused: set[str]) -> list[list[PlannedRun]]:
        """The cells of each job, as many as are expected to fit into `minutes_per_job`; without reused cells."""
        settings = self.settings
        measured, default = durations_of_similar_runs(plan, reused), 60 * settings["minutes_per_run"]
        cells = [cell for cell in plan.cells if cell.id not in reused]
        expected = []
        for cell in cells:
            times = [run.scaled(cell.config) for run in measured[duration_group(vars(cell))]]
            duration = median(times) if times else default
            expected.append(min(duration, cell.config["time_limit"] or inf))
        groups = group_by_duration(expected, 60 * settings["minutes_per_job"] * settings["tasks_per_node"])
        return [[cells[index] for index in group] for group in groups]

    def describe(self, jobs: Jobs) -> str:
        """The number of runs and jobs, as text."""
        settings = self.settings
        text = f"{plural(sum(map(len, jobs)), 'run')} in {plural(len(jobs), 'job')}"
        at_once = f", {settings['tasks_per_node']} at a time in each" if settings["tasks_per_node"] > 1 else ""
        return f"{text}{at_once}, by hydra.launcher.minutes_per_job={settings['minutes_per_job']:g}"

    def run(self, make: Make, jobs: Jobs) -> Messages:
        """Runs the cells in one array of jobs after another."""
        executor, size = _submitit_executor(self.settings), self.settings["array_size"]
        packed_jobs = [PackedJob(make, job, str(Path.cwd()), self.variables) for job in jobs]
        for start in range(0, len(packed_jobs), size):
            for job in executor.submit_array(packed_jobs[start : start + size]):
                yield from (_task_messages(job.task(task)) for task in range(job.num_tasks))


def group_by_duration(seconds: Sequence[float], max_seconds: float) -> list[list[int]]:
    """The indices of the runs of each job, in order: as many as fit into `max_seconds`, but at least one."""
    jobs, remaining = list[list[int]](), 0.0
    for index, duration in enumerate(seconds):
        if not jobs or duration > remaining:
            jobs.append([])
            remaining = max_seconds
        jobs[-1].append(index)
        remaining -= duration
    return jobs


@dataclass(frozen=True)
class PackedJob:
    """A job of submitit, whose tasks share its cells and run them one after another.

    Args:
        folder: the folder of the command, to which paths in configurations are relative.
        variables: environment variables for runs.
    """

    make: Make
    cells: Sequence[PlannedRun]
    folder: str
    variables: dict[str, str]

    def __call__(self) -> list[str]:
        """Runs the cells of this task until a signal ends the job; returns error messages."""
        from submitit import JobEnvironment

        job, messages = JobEnvironment(), list[str]()
        os.chdir(self.folder)
        os.environ |= self.variables | {CONCURRENT_RUNS_VARIABLE: str(job.num_tasks)}
        catch_signals()
        for number in (signal.SIGUSR1, signal.SIGUSR2):  # a scheduler sends them before it ends a job
            signal.signal(number, signal.getsignal(signal.SIGTERM))
        try:
            for cell in self.cells[job.global_rank :: job.num_tasks]:
                messages += self.make(cell)
        except KeyboardInterrupt:
            messages.append(f"job {job.job_id}: {stop_signal()}; the same command goes on")
        return messages


def _submitit_executor(settings: dict[str, Any]) -> Any:
    """The executor of submitit with the settings of the launcher."""
    from submitit import AutoExecutor

    if settings["cluster"] == "slurm" and which("srun") is None:
        raise ValueError("no Slurm is here: type this on a machine of the cluster, or hydra.launcher.cluster=local")
    retries = settings["max_num_timeout"]
    executor = AutoExecutor(settings["submitit_folder"], settings["cluster"], slurm_max_num_timeout=retries)
    names = {key: key if key in COMMON_SETTINGS else f"slurm_{key}" for key in settings if key not in OUR_SETTINGS}
    executor.update_parameters(**{name: settings[key] for key, name in names.items()})
    return executor


def _task_messages(task: Any) -> list[str]:
    """Waits for a task of a job; returns its error messages, also if it was lost."""
    from submitit.core.utils import UncompletedJobError

    try:
        return task.result()
    except UncompletedJobError:
        return [f"job {task.job_id} was lost; {task.paths.stderr} may say why; the same command goes on"]


class Ray(Launcher):
    """Runs each cell in a Ray task."""

    extra: ClassVar[str] = "ray"
    is_local: ClassVar[bool] = False

    def run(self, make: Make, jobs: Jobs) -> Messages:
        """Runs each cell in a Ray task."""
        import ray

        settings = self.settings["ray"]
        if not ray.is_initialized():
            ray.init(**settings["init"])
        remote, folder = ray.remote(**settings["remote"])(_make_in_folder), str(Path.cwd())
        pending = [remote.remote(make, cell, folder, self.variables) for cell in chain.from_iterable(jobs)]
        while pending:
            ended, pending = ray.wait(pending)
            yield from map(ray.get, ended)


def _make_in_folder(make: Make, cell: PlannedRun, folder: str, variables: dict[str, str]) -> list[str]:
    """Runs a cell in the folder of the command."""
    os.chdir(folder)
    os.environ |= variables
    return make(cell)
