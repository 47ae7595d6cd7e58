"""What makes the cells of a sweep, by `hydra/launcher`: this process, some processes here, Slurm jobs or Ray."""

import os
import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from shutil import which
from typing import Any

from omegaconf import DictConfig, OmegaConf

from bench.progress import notice
from bench.records.folder import Identity
from bench.records.record import BESIDE
from bench.run.process import catch_signals, raise_if_stopped, signals_delayed, stopped_by
from datasets.extras import install_command

Make = Callable[[Identity], list[str]]  # does what a cell describes; gives a message where that leaves no record
EXTRAS = {"slurm": "submitit", "ray": "ray"}  # packages that executors need, each the name of its extra
# Keys of `hydra.launcher` in conf/hydra/launcher/slurm.yaml that are not submitit's, and those that every cluster has.
OURS = ("executor", "cluster", "minutes_per_job", "minutes_per_run", "array_size", "submitit_folder", "max_num_timeout")
SHARED = (
    "timeout_min",
    "cpus_per_task",
    "gpus_per_node",
    "tasks_per_node",
    "mem_gb",
    "nodes",
    "name",
    "stderr_to_stdout",
)


@dataclass(frozen=True)
class Launcher:
    """The choice of `hydra/launcher`.

    Args:
        name: of the choice.
        settings: `hydra.launcher`.
        variables: of the environment, for runs.
    """

    name: str
    settings: dict[str, Any]
    variables: dict[str, str]

    @classmethod
    def of(cls, config: DictConfig) -> "Launcher":
        """That of a composed configuration.

        Raises:
            ValueError: where it needs a package that is not installed, or is none of ours.
        """
        settings: Any = OmegaConf.to_container(config.hydra.launcher, resolve=True)
        variables = {str(key): str(value) for key, value in config.hydra.job.env_set.items()}
        launcher = cls(str(config.hydra.runtime.choices["hydra/launcher"]), settings, variables)
        if launcher.executor not in EXECUTORS:
            raise ValueError(
                f"hydra.launcher.executor must be one of {', '.join(EXECUTORS)}, not {launcher.executor!r}"
            )
        if (extra := EXTRAS.get(launcher.executor)) is not None:
            try:
                import_module(extra)
            except ImportError as error:
                raise ValueError(f"this launcher needs a package: {install_command(extra)}") from error
        return launcher

    @property
    def executor(self) -> str:
        """The key of `EXECUTORS`; without one, this process makes a cell after another."""
        return str(self.settings.get("executor", "basic"))

    @property
    def packs(self) -> bool:
        """Whether it makes jobs of several runs."""
        return "minutes_per_job" in self.settings

    @property
    def at_once(self) -> int:
        """How many cells it makes at a time, as far as its settings say so; all processors for n_jobs=-1."""
        for key in ("n_jobs", "array_parallelism"):
            if (count := self.settings.get(key)) is not None:
                return max(int(count), 1) if count > 0 else os.cpu_count() or 1
        return 1


def execute(make: Make, jobs: Sequence[Sequence[Identity]], launcher: Launcher) -> bool:
    """Makes all cells; gives whether each has what it describes. What is missing is printed as it ends.

    Args:
        jobs: the cells, in groups that a job of a cluster makes one after another.

    Raises:
        KeyboardInterrupt: after Ctrl-C or SIGTERM.
        Exception: of a cluster that is not there, or a process that is lost.
    """
    if not jobs:
        return True
    os.environ |= launcher.variables
    return EXECUTORS[launcher.executor](make, jobs, launcher)


def _say(messages: Sequence[str]) -> bool:
    """Prints messages on cells; gives whether there is none."""
    for text in messages:
        notice(f"error: {text}")
    return not messages


def _in_turn(make: Make, jobs: Sequence[Sequence[Identity]], launcher: Launcher) -> bool:
    done = []
    for identity in (identity for job in jobs for identity in job):
        done.append(_say(make(identity)))
        raise_if_stopped()  # also where a library swallowed it
    return all(done)


def _by_workers(make: Make, jobs: Sequence[Sequence[Identity]], launcher: Launcher) -> bool:
    """Some processes on this machine, each with a cell at a time."""
    cells = [identity for job in jobs for identity in job]
    left, done = iter(cells), []
    workers = dict(_started(make) for _ in range(min(launcher.at_once, len(cells))))
    try:
        for channel in workers:
            channel.send(next(left))
        while workers:
            for channel in wait([*workers]):
                assert isinstance(channel, Connection)
                try:
                    done.append(_say(channel.recv()))
                    channel.send(next(left, None))
                except (EOFError, ConnectionError):  # it has got None, or is lost
                    process = workers.pop(channel)
                    process.join()
                    if process.exitcode:
                        raise RuntimeError(f"a worker ended with exit status {process.exitcode}") from None
    finally:
        for process in workers.values():
            process.terminate()
        for process in workers.values():
            process.join()
    return all(done)


def _started(make: Make) -> tuple[Connection, BaseProcess]:
    """A worker, and the connection to it."""
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(make, theirs))
    with signals_delayed():
        process.start()
        theirs.close()
    return ours, process


def _work(make: Make, channel: Connection) -> None:
    """Makes the cells that come, until None does, or a signal."""
    catch_signals()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of a terminal, which sends it to all; the driver passes it on
    try:
        while (identity := channel.recv()) is not None:
            channel.send(make(identity))
    except (KeyboardInterrupt, EOFError):
        return


@dataclass(frozen=True)
class Pack:
    """A job of submitit's: makes some cells, one after another; the tasks of a job share them.

    Args:
        folder: in which the command was typed: relative paths of configurations lead from there.
        variables: of the environment, for runs.
    """

    make: Make
    cells: Sequence[Identity]
    folder: str
    variables: dict[str, str]

    def __call__(self) -> list[str]:
        """Makes the cells of this task, until a signal ends the job; gives what there is to say."""
        from submitit import JobEnvironment

        job, messages = JobEnvironment(), list[str]()
        os.chdir(self.folder)
        os.environ |= self.variables | {BESIDE: str(job.num_tasks)}
        catch_signals()
        for number in (signal.SIGUSR1, signal.SIGUSR2):  # of a scheduler, before it ends a job
            signal.signal(number, signal.getsignal(signal.SIGTERM))
        try:
            for identity in self.cells[job.global_rank :: job.num_tasks]:
                messages += self.make(identity)
        except KeyboardInterrupt as error:
            why = stopped_by(error).removeprefix("killed: ").partition(";")[0]
            messages.append(f"job {job.job_id}: {why}; the same command goes on")
        return messages


def _by_slurm(make: Make, jobs: Sequence[Sequence[Identity]], launcher: Launcher) -> bool:
    """An array of jobs after another."""
    executor, size, done = _submitit(launcher.settings), launcher.settings["array_size"], []
    packs = [Pack(make, job, str(Path.cwd()), launcher.variables) for job in jobs]
    for start in range(0, len(packs), size):
        for job in executor.submit_array(packs[start : start + size]):
            done += [_say(_messages(job.task(task))) for task in range(job.num_tasks)]
    return all(done)


def _submitit(settings: dict[str, Any]) -> Any:
    """Submitit's executor with the settings of the launcher."""
    from submitit import AutoExecutor

    if settings["cluster"] == "slurm" and which("srun") is None:
        raise ValueError("no Slurm is here: type this on a machine of the cluster, or hydra.launcher.cluster=local")
    retries = settings["max_num_timeout"]
    executor = AutoExecutor(settings["submitit_folder"], settings["cluster"], slurm_max_num_timeout=retries)
    theirs = {key: value for key, value in settings.items() if key not in OURS}
    executor.update_parameters(**{key if key in SHARED else f"slurm_{key}": value for key, value in theirs.items()})
    return executor


def _messages(task: Any) -> list[str]:
    """What a task of a job has to say when it has ended, also where it was lost."""
    from submitit.core.utils import UncompletedJobError

    try:
        return task.result()
    except UncompletedJobError:
        return [f"job {task.job_id} was lost; {task.paths.stderr} may say why; the same command goes on"]


def _by_ray(make: Make, jobs: Sequence[Sequence[Identity]], launcher: Launcher) -> bool:
    """A Ray task for each cell."""
    import ray

    settings, done = launcher.settings["ray"], []
    if not ray.is_initialized():
        ray.init(**settings["init"])
    remote, folder = ray.remote(**settings["remote"])(_in_folder), str(Path.cwd())
    left = [remote.remote(make, identity, folder, launcher.variables) for job in jobs for identity in job]
    while left:
        ended, left = ray.wait(left)
        done += [_say(ray.get(task)) for task in ended]
    return all(done)


def _in_folder(make: Make, identity: Identity, folder: str, variables: dict[str, str]) -> list[str]:
    """Makes a cell from the folder in which the command was typed."""
    os.chdir(folder)
    os.environ |= variables
    return make(identity)


EXECUTORS = {"basic": _in_turn, "workers": _by_workers, "slurm": _by_slurm, "ray": _by_ray}
