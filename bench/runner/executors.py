"""Runs the cells of a sweep by `hydra/launcher`: in this process, in local workers, in Slurm jobs or by Ray."""

import os
import signal
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from importlib import import_module
from itertools import chain
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from shutil import which
from typing import Any

from omegaconf import DictConfig, OmegaConf

from bench.progress import notice
from bench.records.record import CONCURRENT_RUNS_VARIABLE
from bench.records.results import PlannedRun
from bench.runner.process import catch_signals, raise_if_stopped, signals_delayed, stop_signal
from datasets.extras import install_command

Make = Callable[[PlannedRun], list[str]]  # runs a cell; returns messages if it leaves no record
Jobs = Sequence[Sequence[PlannedRun]]  # the cells, in groups that one job of a cluster runs one after another
Messages = Generator[list[str], None, None]  # of each cell or task that has ended
EXTRA_BY_EXECUTOR = {"slurm": "submitit", "ray": "ray"}  # each extra has the name of its package
# Keys of conf/hydra/launcher/slurm.yaml: those that submitit does not know, and those that all its clusters share.
OUR_SETTINGS = (
    *("executor", "cluster", "minutes_per_job", "minutes_per_run", "array_size", "submitit_folder", "max_num_timeout"),
)
COMMON_SETTINGS = (
    *("timeout_min", "cpus_per_task", "gpus_per_node", "tasks_per_node", "mem_gb", "nodes", "name", "stderr_to_stdout"),
)


@dataclass(frozen=True)
class Launcher:
    """The choice of `hydra/launcher`.

    Args:
        name: the name of the choice.
        settings: `hydra.launcher`.
        variables: environment variables for runs.
    """

    name: str
    settings: dict[str, Any]
    variables: dict[str, str]

    @classmethod
    def of(cls, config: DictConfig) -> "Launcher":
        """The launcher of a composed configuration.

        Raises:
            ValueError: if its executor is unknown, or needs a package that is not installed.
        """
        settings: Any = OmegaConf.to_container(config.hydra.launcher, resolve=True)
        variables = {str(key): str(value) for key, value in config.hydra.job.env_set.items()}
        launcher = cls(str(config.hydra.runtime.choices["hydra/launcher"]), settings, variables)
        if launcher.executor not in EXECUTORS:
            options = ", ".join(EXECUTORS)
            raise ValueError(f"hydra.launcher.executor must be one of {options}, not {launcher.executor!r}")
        if (extra := EXTRA_BY_EXECUTOR.get(launcher.executor)) is not None:
            try:
                import_module(extra)
            except ImportError as error:
                raise ValueError(f"this launcher needs a package: {install_command(extra)}") from error
        return launcher

    @property
    def executor(self) -> str:
        """The key of `EXECUTORS`; by default, this process runs one cell after another."""
        return str(self.settings.get("executor", "basic"))

    @property
    def packs_runs(self) -> bool:
        """Whether a job has several runs."""
        return "minutes_per_job" in self.settings

    @property
    def concurrency(self) -> int:
        """The number of cells at a time, if its settings have it, else 1; all processors for n_jobs=-1."""
        for key in ("n_jobs", "array_parallelism"):
            if (count := self.settings.get(key)) is not None:
                return max(int(count), 1) if count > 0 else os.cpu_count() or 1
        return 1


def execute(make: Make, jobs: Jobs, launcher: Launcher) -> bool:
    """Runs all cells; returns whether each left a record. Errors are printed as they occur.

    Raises:
        KeyboardInterrupt: after Ctrl-C or SIGTERM.
        Exception: if a cluster is missing, or a process is lost.
    """
    if not jobs:
        return True
    os.environ |= launcher.variables
    with closing(EXECUTORS[launcher.executor](make, jobs, launcher)) as results:
        return print_errors(results)


def print_errors(results: Iterable[list[str]]) -> bool:
    """Prints the error messages of cells as they end; returns whether there are none."""
    succeeded = True
    for text in chain.from_iterable(results):
        notice(f"error: {text}")
        succeeded = False
    return succeeded


def run_in_turn(make: Make, cells: Iterable[PlannedRun]) -> Messages:
    """Runs cells in this process."""
    for cell in cells:
        yield make(cell)
        raise_if_stopped()  # a library may have swallowed the exception


def _run_by_workers(make: Make, jobs: Jobs, launcher: Launcher) -> Messages:
    """Runs cells in processes of this machine, each one cell at a time."""
    cells = [*chain.from_iterable(jobs)]
    remaining = iter(cells)
    workers = dict(_start_worker(make) for _ in range(min(launcher.concurrency, len(cells))))
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
    """Starts a worker; returns the connection to it, and its process."""
    context = get_context("spawn")
    parent_end, child_end = context.Pipe()
    process = context.Process(target=_worker_main, args=(make, child_end))
    with signals_delayed():
        process.start()
        child_end.close()
    return parent_end, process


def _worker_main(make: Make, channel: Connection) -> None:
    """Runs the cells that the channel sends, until it sends None or a signal comes."""
    catch_signals()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to all processes; the parent passes it on
    try:
        while (cell := channel.recv()) is not None:
            channel.send(make(cell))
    except (KeyboardInterrupt, EOFError):
        return


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


def _run_by_slurm(make: Make, jobs: Jobs, launcher: Launcher) -> Messages:
    """Runs the cells in one array of jobs after another."""
    executor, size = _submitit_executor(launcher.settings), launcher.settings["array_size"]
    packed_jobs = [PackedJob(make, job, str(Path.cwd()), launcher.variables) for job in jobs]
    for start in range(0, len(packed_jobs), size):
        for job in executor.submit_array(packed_jobs[start : start + size]):
            yield from (_task_messages(job.task(task)) for task in range(job.num_tasks))


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


def _run_by_ray(make: Make, jobs: Jobs, launcher: Launcher) -> Messages:
    """Runs each cell in a Ray task."""
    import ray

    settings = launcher.settings["ray"]
    if not ray.is_initialized():
        ray.init(**settings["init"])
    remote, folder = ray.remote(**settings["remote"])(_make_in_folder), str(Path.cwd())
    pending = [remote.remote(make, cell, folder, launcher.variables) for cell in chain.from_iterable(jobs)]
    while pending:
        ended, pending = ray.wait(pending)
        yield from map(ray.get, ended)


def _make_in_folder(make: Make, cell: PlannedRun, folder: str, variables: dict[str, str]) -> list[str]:
    """Runs a cell in the folder of the command."""
    os.chdir(folder)
    os.environ |= variables
    return make(cell)


EXECUTORS: dict[str, Callable[[Make, Jobs, Launcher], Messages]] = {
    "basic": lambda make, jobs, launcher: run_in_turn(make, chain.from_iterable(jobs)),
    "workers": _run_by_workers,
    "slurm": _run_by_slurm,
    "ray": _run_by_ray,
}
