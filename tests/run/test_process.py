"""A run that ends badly leaves a record that says how; it is stopped at its limit, and costs no other run."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from bench.run import process
from bench.run.messages import Started, Step
from bench.run.process import RunLimits, _watch
from tests.run.driving import FAILING, ROOT, at_work, driver, lines_of_curves, record_of, wait_for

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


@pytest.mark.parametrize(("steps", "when"), [
    ([], "while setting up"),
    ([("training the prior", 50, 6500), ("training the prior", 100, 6500)], "while training the prior (100 of 6500)"),
    ([("training the prior", 6500, 6500), ("optimising", 3, 20)], "while optimising (3 of 20)"),
    ([("optimising", 20, 20)], "after optimising (20 of 20)"),
])  # fmt: skip
@pytest.mark.parametrize(("limits", "what"), [
    (RunLimits(seconds=0.01, memory=None), "more than time_limit=0.01 s, "),
    (RunLimits(seconds=None, memory=1e-6), "more than 1e-06 GiB of memory (memory_limit), "),
])  # fmt: skip
def test_a_limit_says_in_which_phase_it_was_reached(limits, what, steps, when):
    ours, childs = multiprocessing.Pipe()
    child = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(600,))
    child.start()
    try:
        for message in (Started(), *(Step(*step, loss=None) for step in steps)):
            childs.send(message)
        ending = _watch(child, ours, limits, lambda message: None)
    finally:
        child.kill()
        child.join()
    assert ending is not None and ending.reason == what + when


def test_a_crash_leaves_the_end_of_its_log_in_the_record(isolated):
    _, out, _ = isolated(*FAILING, "+renderer.how=raise")
    log = "\n".join(record_of(out)["log"])
    assert "Traceback" in log
    assert "RuntimeError: it failed on request" in log


def test_without_isolation_it_runs_in_this_process(isolated):
    code, out, _ = isolated(*FAILING, "+renderer.how=raise", "isolation=off")
    assert code == 1
    assert record_of(out)["reason"] == "it failed on request"


@pytest.mark.parametrize(("how", "words"), [
    ("nothing", "Failing.render must return a Rendering, not None"),
    ("short", "Failing.render: distance must have the shape [12, 12], not [11, 12]"),
    ("double", "Failing.render: distance must be float32, as the rays are, not float64"),
    ("detached", "Failing.capabilities.field_gradient is True, but the distances of its hits carry no gradient"),
    ("no_loss", "Failing.silhouette_loss must return a tensor with one number, not None"),
    ("loss_per_ray", "Failing.silhouette_loss must return one floating-point number of shape [], not float32 of shape"),
    ("detached_loss", "Failing.capabilities.field_gradient is True, but its silhouette loss carries no gradient"),
])  # fmt: skip
def test_a_renderer_that_breaks_its_contract_ends_the_run_with_what_it_broke(isolated, how, words):
    code, out, _ = isolated(*FAILING, f"+renderer.how={how}", "isolation=off", "evaluation.picture=null")
    record = record_of(out)
    assert code == 1
    assert (record["status"], words in record["reason"]) == ("crashed", True), record["reason"]
    assert record["metrics_start"]["chamfer_l2"] > 0  # what was known before is kept


@pytest.mark.parametrize(("argument", "words"), [
    ("time_limit=0", "time_limit must be positive"),
    ("memory_limit=-1", "memory_limit must be positive"),
    ("isolation=maybe", "isolation"),
    ("rerun=sometimes", "rerun"),
])  # fmt: skip
def test_a_limit_that_cannot_be_is_told(isolated, argument, words):
    code, _, err = isolated(*FAILING, argument)
    assert code != 0
    assert words in err
    assert len(err.strip().splitlines()) == 1


@pytest.mark.parametrize("own", [True, False], ids=["with its server", "its server lives on"])
def test_the_run_dies_with_its_driver_even_in_native_code(tmp_path, own):
    """A run is forked from a server of processes, which dies with its driver unless others use it."""
    arguments = (*FAILING, "+renderer.how=native_loop", f"results_dir={tmp_path / 'r'}")
    if own:
        command = [sys.executable, "-m", "bench", *arguments]
        running = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            wait_for(lambda: lines_of_curves(tmp_path / "r") or running.poll() is not None)
            assert at_work(tmp_path)
        finally:
            running.kill()
            running.wait()
    else:
        with driver(tmp_path / "output", *arguments) as forked:
            wait_for(lambda: lines_of_curves(tmp_path / "r"), forked)
            assert at_work(tmp_path)
            assert forked.send(signal.SIGKILL).code == -signal.SIGKILL
    wait_for(lambda: not at_work(tmp_path))


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 160 KiB, which the pictures of a run fill."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=160k", "tmpfs", str(place)], capture_output=True)
    if mounted.returncode:
        pytest.skip("a small disk cannot be mounted here; it takes a right that this user lacks")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def test_a_disk_that_fills_up_leaves_a_record_that_says_so(isolated, small_disk):
    code, _, err = isolated(*FAILING, "+renderer.how=not", "evaluation.picture=24", f"results_dir={small_disk}")
    assert code == 1
    assert "Traceback" not in err
    (path,) = small_disk.glob("runs/*/record.json")
    record = json.loads(path.read_text())
    assert record["status"] == "crashed"
    assert "No space left on device" in record["reason"]
    assert record["metrics"]["chamfer_l2"] > 0  # what was measured before is kept


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written_is_told(isolated, tmp_path):
    (tmp_path / "r" / "runs").mkdir(parents=True)
    (tmp_path / "r" / "runs").chmod(0o500)
    code, _, err = isolated(*FAILING, "+renderer.how=not")
    assert code == 1
    assert "set results_dir to a folder you can write" in err
