"""The child process of a run: executes the job and sends progress and its record to the parent."""

import fcntl
import os
import pkgutil
import signal
import sys
import time
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path

# Slow to import and needed by every run: imported here, so that children inherit them from the fork server.
import open3d  # noqa: F401
import torch._dynamo  # noqa: F401, PyTorch's optimisers import it when they are created

import bench.tasks
import datasets
from bench.config import register
from bench.progress import notices_to
from bench.run.execute import execute
from bench.run.messages import Ended, Job, Notice, Started, Step

for package in (bench.tasks, datasets):
    for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
        import_module(module.name)

INTERVAL = 0.05  # least seconds between two messages on progress


def main(job: Job, channel: Connection, parent: Connection) -> None:
    """Runs a job to its end; its output goes to the job's log.

    Args:
        job: the configuration, the folder and the record.
        channel: where messages are sent to.
        parent: the reading end of a pipe that only the parent holds open, and never writes to.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes of a terminal; the parent passes it on
    signal.signal(signal.SIGTERM, _stop)
    _die_with(parent)
    _print_to(job.folder / "log.txt")
    register()  # the configuration may have to be resolved here
    notices_to(lambda text: channel.send(Notice(text)))
    channel.send(Started())
    try:
        execute(job.config, job.folder, job.record, progress=_Progress(channel), checkpoint=channel.send)
    except KeyboardInterrupt:
        channel.send(job.record)  # what is known; then it ends by SIGTERM, as its exit code should say
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGTERM)
    channel.send(job.record)
    channel.send(Ended())


class _Progress:
    """Sends progress to the parent, at most once per `INTERVAL`."""

    def __init__(self, channel: Connection) -> None:
        self.channel, self.sent = channel, 0.0

    def __call__(self, phase: str, done: int, total: int, loss: float | None = None) -> None:
        now = time.perf_counter()
        if now - self.sent > INTERVAL or done == total:
            self.sent = now
            self.channel.send(Step(phase, done, total, loss))


def _stop(number: int, frame: object) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a second signal must not interrupt the handling of the first
    raise KeyboardInterrupt(f"stopped by {signal.Signals(number).name}")


def _die_with(parent: Connection) -> None:
    """Makes the system end this process when the pipe's other end closes, also during native code."""
    signal.signal(signal.SIGIO, signal.SIG_DFL)
    fcntl.fcntl(parent.fileno(), fcntl.F_SETOWN, os.getpid())
    flags = fcntl.fcntl(parent.fileno(), fcntl.F_GETFL)
    fcntl.fcntl(parent.fileno(), fcntl.F_SETFL, flags | os.O_ASYNC)
    if parent.poll():  # closed before the signal was set up
        os._exit(1)


def _print_to(path: Path) -> None:
    """Appends the output of Python and native code to a file from now on."""
    sys.stdout.flush()
    sys.stderr.flush()
    log = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(log, 1)
    os.dup2(log, 2)
    os.close(log)
