"""Command lines in this process and in other processes, and the small runs that tests start."""

import contextlib
import io
import json
import multiprocessing.forkserver
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import torch

from bench.__main__ import main
from bench.machine.environment import using_threads
from bench.records.record import Record, RunStatus
from bench.records.results import PlannedRun
from bench.runner import process

ROOT = Path(__file__).parents[2]
FAILING = (
    "renderer=custom", "renderer._target_=tests.failing.Failing", "scale=smoke", "task.optimiser.iterations=4",
    "view.resolution=12", "task.points=20", "evaluation.grid=16", "evaluation.points=100", "evaluation.picture=null",
    "evaluation.every=null", "threads=1",
)  # fmt: skip
SMALLEST = (
    "scale=smoke", "isolation=off", "threads=1", "evaluation.grid=16", "evaluation.points=100", "evaluation.every=null",
    "evaluation.picture=null",
)  # fmt: skip
PATIENCE = 120.0  # seconds until a test that hangs is ended


class CommandResult(NamedTuple):
    """The exit status, standard output and standard error of a command."""

    code: int
    out: str
    err: str


def errors(err: str) -> list[str]:
    """The lines of standard error, without the first line of a sweep."""
    return [line for line in err.splitlines() if not line.startswith("sweep: ")]


def record_of(out: str) -> dict:
    """The record of the run folder that the last line of an output names."""
    return json.loads((Path(out.splitlines()[-1]) / "record.json").read_text())


def stored(results: Path, name: str, status: str = "ok", **changed: Any) -> Path:
    """Writes a run folder that holds only the record of a completion; gives the folder."""
    folder = results / "runs" / name
    folder.mkdir(parents=True)
    Record(name, "completion", "dist", "sofa", 0, {"seed": 0}, status=RunStatus(status), **changed).write(folder)
    return folder


def planned(*names: str) -> list[PlannedRun]:
    """The cells of a plan with these names."""
    return [PlannedRun(name, [], "completion", "dist", "sofa", 0, {"seed": 0}) for name in names]


def by_program(*arguments: str, cwd: Path = ROOT, **environment: str) -> CommandResult:
    """Runs Python with these arguments in a separate program, and with these environment variables."""
    program, variables = [sys.executable, *arguments], os.environ | environment
    completed = subprocess.run(
        program, cwd=cwd, env=variables, capture_output=True, text=True, timeout=20 * PATIENCE, check=False
    )
    return CommandResult(completed.returncode, completed.stdout, completed.stderr)


def command(*arguments: str, main: Callable[[], int] = main) -> CommandResult:
    """Runs a command line in this process, and its runs in other processes, unless it has isolation=off."""
    out, err = io.StringIO(), io.StringIO()
    with (
        using_threads(torch.get_num_threads()),
        mock.patch.dict(os.environ),  # restores what the command sets
        mock.patch.object(sys, "argv", ["bench", *arguments]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        code = main()
    return CommandResult(code, out.getvalue(), err.getvalue())


class Driver:
    """A command line in a process forked from the server of processes, which has loaded torch already."""

    def __init__(self, output: Path, arguments: tuple[str, ...]) -> None:
        output.mkdir(parents=True)
        context = process.fork_server()
        self.output, self.process = output, context.Process(target=_drive, args=(output, arguments))
        self.process.start()

    def send(self, number: signal.Signals) -> CommandResult:
        """Sends a signal, unless the process has ended, and waits for the end."""
        assert self.process.pid is not None
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.process.pid, number)
        return self.ended()

    def ended(self) -> CommandResult:
        """Waits for the end; the exit status is negative if a signal ended the process."""
        self.process.join(PATIENCE)
        assert self.process.exitcode is not None, "the driver does not end"
        return CommandResult(self.process.exitcode, *((self.output / name).read_text() for name in ("out", "err")))


def _drive(output: Path, arguments: tuple[str, ...]) -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    for number, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(output / name, os.O_WRONLY | os.O_CREAT | os.O_APPEND), number)
    server = multiprocessing.forkserver._forkserver
    # Its runs come from the same server; Python would start another one.
    multiprocessing.forkserver.ensure_running = server.ensure_running = lambda: None
    process.TERMINATION_GRACE_SECONDS = PATIENCE / 4  # a busy machine needs longer
    sys.argv = ["bench", *arguments]
    sys.exit(main())


@contextlib.contextmanager
def driver(output: Path, *arguments: str) -> Iterator[Driver]:
    """A driver, which is killed if it still runs at the end.

    Args:
        output: the new folder for its standard output and standard error.
        arguments: its command line.
    """
    started = Driver(output, arguments)
    try:
        yield started
    finally:
        started.process.kill()
        started.process.join()


def wait_for(ready: Callable[[], object], running: Driver | None = None) -> None:
    """Waits until `ready` gives a true value; fails if the driver ends before."""
    latest = time.monotonic() + PATIENCE
    while not ready():
        if running is not None and not running.process.is_alive():
            assert ready(), (running.output / "err").read_text()
            return
        assert time.monotonic() < latest, "waited too long"
        time.sleep(0.1)


def lines_of_curves(results: Path) -> int:
    """How many iterations the runs of a results folder have finished, also runs under way."""
    return sum(path.read_bytes().count(b"\n") for path in results.glob("runs/*/curve.jsonl"))


def at_work(results: Path) -> list[int]:
    """The processes that hold a log of a run open."""
    processes = []
    for process_folder in Path("/proc").glob("[0-9]*"):
        try:
            links = [str(link.readlink()) for link in (process_folder / "fd").iterdir()]
        except OSError:
            continue
        if any(link.startswith(str(results)) and link.endswith("log.txt") for link in links):
            processes.append(int(process_folder.name))
    return processes
