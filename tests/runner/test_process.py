"""A failed run has a record with its reason, is stopped at its limit, and costs no other run."""

import os
import signal
import subprocess
import sys
import time
from multiprocessing import Pipe
from types import SimpleNamespace
from unittest.mock import Mock

import psutil
import pytest

from bench.records.record import Record
from bench.runner import process
from tests.runner.driving import FAILING, PATIENCE, at_work, driver, lines_of_curves, record_of, wait_for

LIMIT = 600  # seconds
# The way to fail: limits, the expected status, words of the reason.
CASES = {
    "raise": ((), "crashed", "it failed on request"),
    "not_a_number": ((), "nan", "not a number"),
    "loop": ((f"time_limit={LIMIT}",), "timeout", f"more than time_limit={LIMIT} s"),
    "native_loop": ((f"time_limit={LIMIT}",), "timeout", f"more than time_limit={LIMIT} s"),
    "leave": ((), "crashed", "ended by itself, with exit status 0"),
    "kill": ((), "killed", "ended by SIGKILL"),
    "terminate": ((), "killed", "ended by SIGTERM"),
    "segfault": ((), "crashed", "died of SIGSEGV in native code"),
    "hog": (("memory_limit=1.5",), "oom", "more than 1.5 GiB of memory (memory_limit), while optimising (1 of 4)"),
}


@pytest.fixture
def hour_later(monkeypatch, tmp_path):
    """Moves the clock of limits by an hour when the run iterates: a run that never ends reaches its limit at once."""

    def read() -> float:
        return time.perf_counter() + (3600.0 if lines_of_curves(tmp_path / "r") else 0.0)

    monkeypatch.setattr(process, "time", SimpleNamespace(perf_counter=read))


@pytest.mark.parametrize("how", CASES)
def test_a_failed_run_has_its_reason(request, isolated, tmp_path, how):
    more, status, words = CASES[how]
    if status == "timeout":
        request.getfixturevalue("hour_later")
    code, out, err = isolated(*FAILING, f"+renderer.how={how}", *more)
    record = record_of(out)
    assert code == 1 and record["ended"]
    assert record["status"] == status and words in record["reason"], record["reason"]
    assert (record["scene"], record["environment"]["threads"]) == ("sofa test 0", 1)  # the failure keeps these
    assert record["metrics_start"] == {} or "chamfer_l2" in record["metrics_start"]
    assert "Traceback" not in err and record["reason"] in " ".join(err.split())
    assert at_work(tmp_path) == []  # its process has ended
    assert how != "raise" or "RuntimeError: it failed on request" in "\n".join(record["log"])


@pytest.mark.parametrize(("how", "words"), [
    ("short", "Failing.render: distance must have the shape [12, 12], not [11, 12]"),
    ("detached_loss", "Failing.capabilities.field_gradient is True, but its silhouette loss carries no gradient"),
])  # fmt: skip
def test_without_isolation_a_run_fails_in_this_process_with_its_reason(isolated, how, words):
    code, out, _ = isolated(*FAILING, f"+renderer.how={how}", "isolation=off")
    record = record_of(out)
    assert code == 1 and record["status"] == "crashed" and words in record["reason"], record["reason"]
    assert record["metrics_start"]["chamfer_l2"] > 0  # the failure keeps it


def test_the_run_dies_with_its_driver_even_in_native_code(tmp_path):
    arguments = (*FAILING, "+renderer.how=native_loop", f"results_dir={tmp_path / 'r'}")
    with driver(tmp_path / "output", *arguments) as forked:
        wait_for(lambda: lines_of_curves(tmp_path / "r"), forked)
        assert at_work(tmp_path) and forked.send(signal.SIGKILL).code == -signal.SIGKILL
    wait_for(lambda: not at_work(tmp_path))


def test_a_process_that_is_lost_before_the_first_measurement_of_its_memory_is_reported():
    alive = iter((True, False))
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    record = Record("id", "task", "renderer", "dataset", 0, {"time_limit": None, "memory_limit": None})
    pipes = [Pipe(), Pipe()]
    lost = Mock(pid=ended.pid, sentinel=pipes[0][0], exitcode=-signal.SIGKILL, is_alive=lambda: next(alive))
    failure = process._watch(lost, pipes[1][0], process.RunInProgress(record))
    assert failure is not None and "ended by SIGKILL" in failure[1]


def test_modules_that_the_server_lacks_are_loaded_before_the_run_begins(monkeypatch):
    calls = []
    monkeypatch.setattr(process, "import_module", calls.append)
    monkeypatch.setattr("bench.runner.execute.main", lambda *_: calls.append("main"))
    process._run(Record("id", "task", "renderer", "dataset", 0, {}), Pipe()[0])
    assert calls == [*process.preloaded_modules(), "main"] and "open3d" in calls


def test_the_server_has_what_runs_need_and_no_more():
    loaded = process.run_in_child(eval, "{name.partition('.')[0] for name in __import__('sys').modules}")
    assert loaded >= {"torch", "open3d", "matplotlib"} and not loaded & {"hydra", "pandas"}


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_while_the_server_loads_modules_is_reported_in_one_line(tmp_path):
    command = [sys.executable, "-m", "bench", f"results_dir={tmp_path}", "scale=smoke"]
    with subprocess.Popen(command, start_new_session=True, stderr=subprocess.PIPE, text=True) as running:
        parent = psutil.Process(running.pid)
        wait_for(lambda: any("forkserver" in " ".join(child.cmdline()) for child in parent.children()))
        os.killpg(running.pid, signal.SIGINT)  # to all processes, as a terminal does
        running.wait(PATIENCE)
        os.killpg(running.pid, signal.SIGKILL)  # else the server ends after it has loaded all modules
        assert running.communicate()[1].splitlines() == ["error: stopped by Ctrl-C; nothing was run"]
