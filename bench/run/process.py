"""The process of a run, seen from its parent: its limits, how it ends, and signals."""

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext
from multiprocessing.process import BaseProcess
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

import psutil

import bench.tasks
import datasets
from bench.records.record import RunStatus
from bench.run.job import Ended, Job, Message, Started, Step

INTERVAL = 0.05  # seconds between two checks of clock and memory
GRACE = 0.5  # seconds that a child has to send its record after SIGTERM
BOOT = 120.0  # seconds in which a child must be ready; a cold disk is slow
GIB = 2**30
# Signals that come from outside: from a user, a batch system, or the operating system where memory runs out.
EXTERNAL = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)
# Signals are noted as well as raised: an interrupted library may swallow or replace the exception.
_stopped = ""  # by which signal, in words
_delayed = False  # within `signals_delayed`
_early = False  # whether this command has started the server before it knew that it would need it


@dataclass(frozen=True)
class RunLimits:
    """Limits on a run's time and memory.

    Args:
        seconds: wall-clock time from when the child process is ready; None for no limit.
        memory: resident memory of the process in GiB; None for nine tenths of the machine's.
    """

    seconds: float | None
    memory: float | None

    @property
    def bytes(self) -> float:
        return 0.9 * machine_memory() if self.memory is None else self.memory * GIB


@dataclass(frozen=True)
class Ending:
    """How a child ended that did not report it itself."""

    status: RunStatus
    reason: str


def run_isolated(job: Job, limits: RunLimits, receive: Callable[[Message], None]) -> Ending | None:
    """Runs a job in a child process, and passes every message of the child to `receive` as it arrives.

    Returns:
        None where the child finished and sent its final record; else how it ended.
    """
    context = warm_up()
    channel, childs = context.Pipe()
    alive, ours = context.Pipe(duplex=False)  # closes when this process ends in any way, which the child notices
    process = context.Process(target=_enter, args=(job, childs, alive))
    with channel, ours:
        try:
            with signals_delayed():  # a request that breaks off would end the fork server
                process.start()
                childs.close()
                alive.close()
            ending = _watch(process, channel, limits, receive)
            process.join(GRACE if ending is None else 0.0)
            return ending
        finally:
            if process.pid is not None:
                _end(process, channel, receive)


def preloaded() -> list[str]:
    """Modules that runs import and that are slow to import; bench first, as it sets what torch reads at its import."""
    packages = bench.tasks, datasets
    named = [module.name for one in packages for module in iter_modules(one.__path__, f"{one.__name__}.")]
    return ["bench", "open3d", "bench.run.execute", *named]


def fork_server() -> ForkServerContext:
    """The context of processes that branch off from a server, which has imported what is slow, once for all of them."""
    if multiprocessing.get_start_method(allow_none=True) not in (None, *multiprocessing.get_all_start_methods()):
        multiprocessing.set_start_method("forkserver", force=True)  # joblib's workers set one that children lack
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(preloaded())
    return context


def warm_up() -> ForkServerContext:
    """Starts the server of processes, which loads what is slow while this process does something else.

    The server and its children never get Ctrl-C: their parent does, and ends them.
    """
    context = fork_server()
    resource_tracker.ensure_running()  # the server would start it, and it unblocks the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])  # which a new process inherits
    try:
        with signals_delayed():  # a request that breaks off would end the server
            forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return context


def start_early(arguments: Sequence[str]) -> None:
    """Starts the server before the command line is read, where it seems to ask for runs in processes of their own.

    Where it sets anything of Hydra's, which may set variables of the environment, the server starts after these.
    """
    global _early
    plain = all(argument in ("-m", "--multirun") or argument[:1] != "-" for argument in arguments)
    other = {"help", "list", "isolation=off"} & {*arguments}
    if plain and not other and not any("hydra" in argument for argument in arguments):
        _early = True
        warm_up()


def leave_server() -> None:
    """Ends the server of a command that is refused, if it was started early: it would go on to load what is slow."""
    number = getattr(forkserver._forkserver, "_forkserver_pid", None)
    if _early and number is not None:
        with suppress(ProcessLookupError):
            os.kill(number, signal.SIGKILL)


def in_child(work: Callable[[Any], Any], argument: Any) -> Any:
    """What `work` gives for an argument, in a process that branches off from the server; None where that one dies."""
    context = warm_up()
    answers, answer = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(work, argument, answer))
    with answers:
        try:
            with signals_delayed():
                process.start()
                answer.close()
            return answers.recv()
        except (EOFError, ConnectionError):
            return None
        finally:
            if process.pid is not None:
                process.kill()
                process.join()


def _work(work: Callable[[Any], Any], argument: Any, answer: Connection) -> None:
    answer.send(work(argument))


def _enter(job: Job, channel: Connection, parent: Connection) -> None:
    for module in preloaded():  # what the server has left out, before `Started`: off the run's clocks
        with suppress(ImportError):
            import_module(module)
    from bench.run.execute import main

    main(job, channel, parent)


def _watch(
    process: BaseProcess, channel: Connection, limits: RunLimits, receive: Callable[[Message], None]
) -> Ending | None:
    begun, ready, most = time.perf_counter(), False, limits.bytes
    when = "while setting up"  # until the first step is reported
    with suppress(psutil.NoSuchProcess):
        memory = psutil.Process(process.pid)
    while True:
        raise_if_stopped()
        wait([channel, process.sentinel], timeout=INTERVAL)
        alive = process.is_alive()  # before the messages are read, so that none can arrive after the last read
        while channel.poll():
            try:
                with signals_delayed():  # what is left of a message would be taken for the next one
                    message = channel.recv()
            except (EOFError, OSError):
                return _died(process)
            if isinstance(message, Ended):
                return None
            if isinstance(message, Started):
                begun, ready = time.perf_counter(), True
            elif isinstance(message, Step):
                when = message.when
            receive(message)
        if not alive:
            return _died(process)
        spent = time.perf_counter() - begun
        if ready and limits.seconds is not None and spent > limits.seconds:
            return Ending(RunStatus.TIMEOUT, f"more than time_limit={limits.seconds:g} s, {when}")
        if not ready and spent > BOOT:
            return Ending(RunStatus.CRASHED, f"its process was not ready within {BOOT:g} s")
        with suppress(psutil.NoSuchProcess):
            if memory.memory_info().rss > most:
                process.kill()  # at once, before the machine runs out of memory
                return Ending(RunStatus.OOM, f"more than {most / GIB:.3g} GiB of memory (memory_limit), {when}")


def _end(process: BaseProcess, channel: Connection, receive: Callable[[Message], None]) -> None:
    """Sends the child SIGTERM, receives its last messages, and ends it."""
    if process.is_alive():
        process.terminate()
    latest = time.perf_counter() + GRACE
    with suppress(EOFError, OSError):
        while (left := latest - time.perf_counter()) > 0 and channel.poll(left):
            receive(channel.recv())
    process.join(max(latest - time.perf_counter(), 0.0))
    if process.is_alive():
        process.kill()
    process.join()
    process.close()


def _died(process: BaseProcess) -> Ending:
    process.join()
    code = process.exitcode or 0
    if code >= 0:
        return Ending(RunStatus.CRASHED, f"its process ended by itself, with exit status {code}")
    name = signal.Signals(-code).name
    if -code in EXTERNAL:
        hint = "; the operating system does that where memory runs out" if -code == signal.SIGKILL else ""
        return Ending(RunStatus.KILLED, f"its process was ended by {name}{hint}")
    return Ending(RunStatus.CRASHED, f"its process died of {name} in native code")


def machine_memory() -> int:
    """Bytes of memory that all processes may use together: the machine's, or a lower limit of its container."""
    total = psutil.virtual_memory().total
    for path in (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes")):
        with suppress(OSError, ValueError):
            total = min(total, int(path.read_text()))
    return total


def catch_signals() -> None:
    """From now on Ctrl-C and SIGTERM raise KeyboardInterrupt, which says which of them it was."""
    signal.signal(signal.SIGTERM, _stop)
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # a shell's background jobs ignore it
        signal.signal(signal.SIGINT, _stop)


def _stop(number: int, frame: object) -> None:
    global _stopped
    _stopped = "stopped by Ctrl-C" if number == signal.SIGINT else f"stopped by {signal.Signals(number).name}"
    if not _delayed:
        raise KeyboardInterrupt(_stopped)


def stopped_by(error: BaseException) -> str:
    """The signal, in words, of which an error is the outcome; empty where it has another cause."""
    if isinstance(error, KeyboardInterrupt):
        return str(error) or "stopped by Ctrl-C"
    return _stopped


@contextmanager
def signals_delayed() -> Iterator[None]:
    """The first signal that arrives in the block raises KeyboardInterrupt at its end."""
    global _delayed
    before, _delayed = _stopped, True
    try:
        yield
    finally:
        _delayed = False
    if not before:
        raise_if_stopped()


def forget_signals() -> None:
    """Forgets the signals of a command that has ended, for the next one in this process."""
    global _stopped
    _stopped = ""


def raise_if_stopped() -> None:
    """Raises KeyboardInterrupt after a signal, also where nothing came of the first one."""
    if _stopped:
        raise KeyboardInterrupt(_stopped)
