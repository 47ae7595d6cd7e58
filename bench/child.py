"""The child process of a run: does the work, and tells its parent how it goes."""

import fcntl
import os
import signal
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path

# Slow to import and needed by every run: here, so that the server which children are forked from has them.
import open3d  # noqa: F401
import torch._dynamo  # noqa: F401, PyTorch's optimisers import it when they are made

import bench.tasks.ablation
import bench.tasks.completion
import bench.tasks.deepsdf
import bench.tasks.gradients
import bench.tasks.multiview
import bench.tasks.pose
import bench.tasks.pose_icp
import bench.tasks.prior_fit  # noqa: F401
import datasets.families
import datasets.local  # noqa: F401
from bench.config import register
from bench.execute import execute
from bench.job import Ended, Job, Said, Started, Step
from bench.progress import notices_to

OFTEN = 0.05  # seconds, at least, between two words on progress


def main(job: Job, channel: Connection, parent: Connection) -> None:
    """Runs a job to its end; what it prints goes to the job's log.

    Args:
        job: the work.
        channel: where messages are sent to.
        parent: the reading end of a pipe that the parent alone holds open, and never writes to.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to a terminal's whole group; the parent passes it on
    signal.signal(signal.SIGTERM, _stop)
    _die_with(parent)
    _print_to(job.folder / "log.txt")
    register()  # the configuration may have to be resolved here
    notices_to(lambda text: channel.send(Said(text)))
    channel.send(Started())
    try:
        execute(job.config, job.folder, job.record, progress=_Telling(channel), checkpoint=channel.send)
    except KeyboardInterrupt:
        channel.send(job.record)  # what there is; then it ends as one that was told to, whoever told it
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGTERM)
    channel.send(job.record)
    channel.send(Ended())


class _Telling:
    """Progress that is sent, but not more often than a person can read."""

    def __init__(self, channel: Connection) -> None:
        self.channel, self.said = channel, 0.0

    def __call__(self, phase: str, done: int, total: int, loss: float | None = None) -> None:
        now = time.perf_counter()
        if now - self.said > OFTEN or done == total:
            self.said = now
            self.channel.send(Step(phase, done, total, loss))


def _stop(number: int, frame: object) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # once is enough
    raise KeyboardInterrupt(f"stopped by {signal.Signals(number).name}")


def _die_with(parent: Connection) -> None:
    """Lets the system end this process when the pipe's other end closes, whatever this process is busy with."""
    signal.signal(signal.SIGIO, signal.SIG_DFL)
    fcntl.fcntl(parent.fileno(), fcntl.F_SETOWN, os.getpid())
    flags = fcntl.fcntl(parent.fileno(), fcntl.F_GETFL)
    fcntl.fcntl(parent.fileno(), fcntl.F_SETFL, flags | os.O_ASYNC)
    if parent.poll():  # closed before the system was asked to watch
        os._exit(1)


def _print_to(path: Path) -> None:
    """What Python and native code print from now on goes to the end of a file."""
    sys.stdout.flush()
    sys.stderr.flush()
    log = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(log, 1)
    os.dup2(log, 2)
    os.close(log)
