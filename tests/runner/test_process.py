"""A run that ends badly leaves a record that says how; it is stopped at its limit, and costs no other run."""

import os
import signal
import subprocess
import sys
import time
from multiprocessing import Pipe
from types import SimpleNamespace

import psutil
import pytest

from bench.records.record import Record
from bench.runner import process
from bench.runner.process import Job, Step
from tests.runner.driving import FAILING, at_work, driver, lines_of_curves, record_of, wait_for

LIMIT = 600  # seconds
# How it fails, with which limits; the status that must come of it, and words of the reason.
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
    """The clock of limits goes on by an hour when the run is at work: what never ends is at its limit, however slow."""

    def read() -> float:
        return time.perf_counter() + (3600.0 if lines_of_curves(tmp_path / "r") else 0.0)

    monkeypatch.setattr(process, "time", SimpleNamespace(perf_counter=read))


@pytest.mark.parametrize("how", CASES)
def test_a_run_that_ends_badly_says_how(request, isolated, tmp_path, how):
    more, status, words = CASES[how]
    if status == "timeout":
        request.getfixturevalue("hour_later")
    code, out, err = isolated(*FAILING, f"+renderer.how={how}", *more)
    record = record_of(out)
    assert code == 1
    assert (record["status"], words in record["reason"]) == (status, True), record["reason"]
    assert record["ended"]
    assert record["scene"] == "sofa test 0"  # what was known before it failed is kept
    assert record["environment"]["threads"] == 1
    assert record["metrics_start"] == {} or "chamfer_l2" in record["metrics_start"]
    assert "Traceback" not in err
    assert record["reason"] in " ".join(err.split())
    assert at_work(tmp_path) == []  # its process is gone, whatever it was busy with
    assert how != "raise" or "RuntimeError: it failed on request" in "\n".join(record["log"])


def test_a_step_says_in_which_phase_a_limit_was_reached():
    assert Step("training the prior", 100, 6500, None).phase_text == "while training the prior (100 of 6500)"
    assert Step("optimising", 20, 20, None).phase_text == "after optimising (20 of 20)"


@pytest.mark.parametrize(("how", "words"), [
    ("raise", "it failed on request"),
    ("short", "Failing.render: distance must have the shape [12, 12], not [11, 12]"),
    ("detached_loss", "Failing.capabilities.field_gradient is True, but its silhouette loss carries no gradient"),
])  # fmt: skip
def test_without_isolation_it_fails_in_this_process_and_says_how(isolated, how, words):
    code, out, _ = isolated(*FAILING, f"+renderer.how={how}", "isolation=off")
    record = record_of(out)
    assert code == 1
    assert (record["status"], words in record["reason"]) == ("crashed", True), record["reason"]
    assert record["metrics_start"]["chamfer_l2"] > 0  # what was known before is kept


def test_the_run_dies_with_its_driver_even_in_native_code(tmp_path):
    arguments = (*FAILING, "+renderer.how=native_loop", f"results_dir={tmp_path / 'r'}")
    with driver(tmp_path / "output", *arguments) as forked:
        wait_for(lambda: lines_of_curves(tmp_path / "r"), forked)
        assert at_work(tmp_path)
        assert forked.send(signal.SIGKILL).code == -signal.SIGKILL
    wait_for(lambda: not at_work(tmp_path))


def test_what_the_server_has_not_loaded_is_loaded_before_the_run_says_that_it_is_ready(tmp_path, monkeypatch):
    done = []
    monkeypatch.setattr(process, "import_module", done.append)
    monkeypatch.setattr("bench.runner.execute.main", lambda *_: done.append("main"))
    job = Job(tmp_path, Record("id", "task", "renderer", "dataset", 0, {}))
    process._run_job(job, *Pipe())
    assert done == [*process.preloaded_modules(), "main"] and "open3d" in done


def test_the_server_has_what_runs_need_and_no_more():
    found = process.run_in_child(eval, "{name.partition('.')[0] for name in __import__('sys').modules}")
    assert found >= {"torch", "open3d", "matplotlib"} and not found & {"hydra", "pandas"}


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_while_the_server_loads_what_runs_need_is_told_in_one_line(tmp_path):
    command = [sys.executable, "-m", "bench", f"results_dir={tmp_path}", "scale=smoke"]
    with subprocess.Popen(command, start_new_session=True, stderr=subprocess.PIPE, text=True) as running:
        parent = psutil.Process(running.pid)
        wait_for(lambda: any("forkserver" in " ".join(child.cmdline()) for child in parent.children()))
        os.killpg(running.pid, signal.SIGINT)  # as a terminal does: all of its processes get it
        assert running.communicate()[1].splitlines() == ["error: stopped by Ctrl-C; nothing was run"]
