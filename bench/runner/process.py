"""The process of a run, on the side of its parent: limits, exit and signals."""

import multiprocessing
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib import import_module
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkContext, ForkServerContext
from multiprocessing.process import BaseProcess
from pathlib import Path
from pkgutil import walk_packages
from typing import Any

import psutil

import bench.tasks
import datasets
from bench.progress import Report, notice
from bench.records.record import Record, RunStatus
from bench.runner.messages import Message, Started, Step

POLL_INTERVAL_SECONDS = 0.05
TERMINATION_GRACE_SECONDS = 0.5  # for a child to send its record after SIGTERM
STARTUP_TIMEOUT_SECONDS = 120.0  # long, because a cold disk is slow
GIB = 2**30
WORKER = "worker"  # the name of a launcher's processes, which the server has forked, and which fork their runs
Failure = tuple[RunStatus, str]  # the status and reason of a child that ended without a final record
# Signals from outside: from a user, a batch system, or the operating system when memory runs out.
EXTERNAL_SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)
# A signal is also stored, because an interrupted library may swallow or replace the exception.
_stopped = ""  # the signal that stopped this command, in words
_delayed = False  # within `signals_delayed`


@dataclass
class RunInProgress:
    """What the parent process knows of a run in progress.

    Args:
        record: the run's record, which the messages of the child fill.
        report: receives the progress.
        started: when the clock of the run started: when its child had imported its modules.
        is_ready: whether the child has imported its modules.
        phase: for the reason of a failure.
    """

    record: Record
    report: Report = lambda *_: None
    started: float = field(default_factory=time.perf_counter)
    is_ready: bool = False
    phase: str = "while setting up"

    def receive(self, message: Message) -> None:
        """Handles a message of the child."""
        if isinstance(message, Started):
            self.started, self.is_ready = time.perf_counter(), True
        elif isinstance(message, Step):
            self.phase = message.phase_text
            self.report(message.phase, message.finished, message.total, message.loss)
        elif isinstance(message, Record):
            vars(self.record).update(vars(message))
            self.record.write(self.record.folder)
        else:
            notice(message.text)


def run_isolated(run: RunInProgress) -> Failure | None:
    """Makes a run in a child process, within its limits; returns how it ended if it sent no final record, else None."""
    context = warm_up()
    channel, child_channel = context.Pipe()
    process = context.Process(target=_run, args=(run.record, child_channel))
    with channel:
        try:
            with signals_delayed():  # an interrupted start would end the fork server
                process.start()
                child_channel.close()
            failure = _watch(process, channel, run)
            process.join(TERMINATION_GRACE_SECONDS if failure is None else 0.0)
            return failure
        finally:
            if process.pid is not None:
                _terminate(process, channel, run)


def preloaded_modules() -> list[str]:
    """Slow modules that runs import; bench first, because it sets variables that torch reads at its import."""
    packages = bench.tasks, datasets
    names = [module.name for package in packages for module in walk_packages(package.__path__, f"{package.__name__}.")]
    return ["bench", "open3d", "bench.runner.execute", *names]


def fork_server() -> ForkServerContext:
    """The context of processes that are forked from a server, which has imported the slow modules once for all."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(preloaded_modules())
    return context


def warm_up() -> ForkServerContext | ForkContext:
    """Starts the fork server, which imports the slow modules while this process does something else.

    The server and its children never receive Ctrl-C: their parent does, and ends them.
    """
    if multiprocessing.current_process().name == WORKER:
        return multiprocessing.get_context("fork")
    context = fork_server()
    resource_tracker.ensure_running()  # here, because it unblocks the signal that is blocked below
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])  # a new process inherits the mask
    try:
        with signals_delayed():  # an interrupted start would end the server
            forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return context


def run_in_child(work: Callable[[Any], Any], argument: Any) -> Any:
    """Returns `work(argument)`, computed in a child process forked from the server; None if the child dies."""
    context = warm_up()
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send_result, args=(work, argument, sender))
    with receiver:
        try:
            with signals_delayed():
                process.start()
                sender.close()
            return receiver.recv()
        except (EOFError, ConnectionError):
            return None
        finally:
            if process.pid is not None:
                process.kill()
                process.join()


def _send_result(work: Callable[[Any], Any], argument: Any, sender: Connection) -> None:
    sender.send(work(argument))


def _run(record: Record, channel: Connection) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # else it keeps the handler of its parent worker
    for module in preloaded_modules():  # before `Started`, so that the run's time excludes it
        with suppress(ImportError):
            import_module(module)
    from bench.runner.execute import main

    main(record, channel)


def _watch(process: BaseProcess, channel: Connection, run: RunInProgress) -> Failure | None:
    """Receives messages until the final record, or until a limit is reached; returns the failure if there is one."""
    time_limit, memory_limit = run.record.config["time_limit"], run.record.config["memory_limit"]
    max_bytes = 0.9 * machine_memory() if memory_limit is None else memory_limit * GIB
    while True:
        raise_if_stopped()
        wait([channel, process.sentinel], timeout=POLL_INTERVAL_SECONDS)
        is_alive = process.is_alive()  # before the messages are read, so that none arrives after the last read
        while channel.poll():
            try:
                with signals_delayed():  # the rest of an interrupted message would be read as the next one
                    message = channel.recv()
            except (EOFError, OSError):
                return _exit_reason(process)
            run.receive(message)
            if isinstance(message, Record) and message.status != RunStatus.KILLED:
                return None
        if not is_alive:
            return _exit_reason(process)
        spent = time.perf_counter() - run.started
        if run.is_ready and time_limit is not None and spent > time_limit:
            return RunStatus.TIMEOUT, f"more than time_limit={time_limit:g} s, {run.phase}"
        if not run.is_ready and spent > STARTUP_TIMEOUT_SECONDS:
            return RunStatus.CRASHED, f"its process was not ready within {STARTUP_TIMEOUT_SECONDS:g} s"
        with suppress(psutil.NoSuchProcess):
            if psutil.Process(process.pid).memory_info().rss > max_bytes:
                process.kill()  # at once, before the machine runs out of memory
                return RunStatus.OOM, f"more than {max_bytes / GIB:.3g} GiB of memory (memory_limit), {run.phase}"


def _terminate(process: BaseProcess, channel: Connection, run: RunInProgress) -> None:
    """Sends the child SIGTERM, receives its last messages, and ends it."""
    if process.is_alive():
        process.terminate()
    deadline = time.perf_counter() + TERMINATION_GRACE_SECONDS
    with suppress(EOFError, OSError):
        while (left := deadline - time.perf_counter()) > 0 and channel.poll(left):
            run.receive(channel.recv())
    process.join(max(deadline - time.perf_counter(), 0.0))
    if process.is_alive():
        process.kill()
    process.join()
    process.close()


def _exit_reason(process: BaseProcess) -> Failure:
    process.join()
    code = process.exitcode or 0
    if code >= 0:
        return RunStatus.CRASHED, f"its process ended by itself, with exit status {code}"
    name = signal.Signals(-code).name
    if -code in EXTERNAL_SIGNALS:
        hint = "; the operating system does that where memory runs out" if -code == signal.SIGKILL else ""
        return RunStatus.KILLED, f"its process was ended by {name}{hint}"
    return RunStatus.CRASHED, f"its process died of {name} in native code"


def machine_memory() -> int:
    """Bytes of memory that all processes may use together: that of the machine, or a lower limit of its container."""
    total = psutil.virtual_memory().total
    for path in (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes")):
        with suppress(OSError, ValueError):
            total = min(total, int(path.read_text()))
    return total


def catch_signals() -> None:
    """From now on, Ctrl-C and SIGTERM raise KeyboardInterrupt with the name of the signal."""
    signal.signal(signal.SIGTERM, _stop)
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # a shell's background jobs ignore it
        signal.signal(signal.SIGINT, _stop)


def _stop(number: int, frame: object) -> None:
    global _stopped
    _stopped = "stopped by Ctrl-C" if number == signal.SIGINT else f"stopped by {signal.Signals(number).name}"
    if not _delayed:
        raise KeyboardInterrupt(_stopped)


def stop_signal() -> str:
    """The signal that stopped this command, in words; empty if there was none."""
    return _stopped


def stopped_by(error: BaseException) -> str:
    """The signal, in words, that caused an error; empty if it has another cause."""
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
    """Raises KeyboardInterrupt after a signal, also if the first exception was lost."""
    if _stopped:
        raise KeyboardInterrupt(_stopped)
