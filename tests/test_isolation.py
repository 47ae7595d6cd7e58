"""A run that ends badly in any way leaves a record that says how; it is stopped on time, and costs no other run."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FAILING = (
    "renderer=custom", "renderer._target_=tests.failing.Failing", "scale=smoke", "task.iterations=4",
    "view.resolution=12", "task.points=20", "evaluation.grid=16", "evaluation.points=100", "evaluation.picture=8",
    "threads=1",
)  # fmt: skip
LIMIT = 1.5  # seconds
# How it fails, with which limits; the status that must come of it, and words of the reason.
CASES = {
    "raise": ((), "crashed", "it failed on request"),
    "not_a_number": ((), "nan", "not a number"),
    "loop": ((f"time_limit={LIMIT}",), "timeout", f"more than time_limit={LIMIT:g} s"),
    "native_loop": ((f"time_limit={LIMIT}",), "timeout", f"more than time_limit={LIMIT:g} s"),
    "leave": ((), "crashed", "ended by itself, with exit status 0"),
    "kill": ((), "killed", "ended by SIGKILL"),
    "terminate": ((), "killed", "ended by SIGTERM"),
    "segfault": ((), "crashed", "died of SIGSEGV in native code"),
    "hog": (("memory_limit=1.5",), "oom", "more than 1.5 GiB"),
}


def record_of(out: str) -> dict:
    return json.loads((Path(out.splitlines()[-1]) / "record.json").read_text())


@pytest.mark.parametrize("how", CASES)
def test_a_run_that_ends_badly_says_how(isolated, how):
    more, status, words = CASES[how]
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


@pytest.mark.parametrize("how", ["loop", "native_loop"])
def test_a_run_is_stopped_within_a_second_of_its_limit(isolated, how):
    isolated(*FAILING, f"+renderer.how={how}", "time_limit=0.3")  # so that the server of processes is there
    started = time.perf_counter()
    _, out, _ = isolated(*FAILING, f"+renderer.how={how}", f"time_limit={LIMIT}", "rerun=all")
    assert time.perf_counter() - started < LIMIT + 2.0  # with composing, claiming, and the page
    record = record_of(out)
    assert LIMIT < record["seconds"]["total"] < LIMIT + 1.0


def test_a_crash_leaves_the_end_of_its_log_in_the_record(isolated):
    _, out, _ = isolated(*FAILING, "+renderer.how=raise")
    log = "\n".join(record_of(out)["log"])
    assert "Traceback" in log
    assert "RuntimeError: it failed on request" in log


def test_without_isolation_it_runs_in_this_process(isolated):
    code, out, _ = isolated(*FAILING, "+renderer.how=raise", "isolation=off")
    assert code == 1
    assert record_of(out)["reason"] == "it failed on request"


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


def test_the_run_dies_with_its_driver_even_in_native_code(tmp_path):
    command = [sys.executable, "-m", "bench", *FAILING, "+renderer.how=native_loop", f"results_dir={tmp_path}"]
    driver = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    latest = time.perf_counter() + 60
    while not (busy := _children_at_work(tmp_path)) and time.perf_counter() < latest:
        time.sleep(0.1)
    assert busy
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    latest = time.perf_counter() + 5
    while any(_alive(pid) for pid in busy) and time.perf_counter() < latest:
        time.sleep(0.05)
    assert not any(_alive(pid) for pid in busy)


def _children_at_work(results: Path) -> list[int]:
    """Processes that hold a log of a run open, once it has begun its optimisation."""
    if not list(results.glob("runs/*/curve.jsonl")):
        return []
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            links = [str(link.readlink()) for link in (process / "fd").iterdir()]
        except OSError:
            continue
        if any(link.startswith(str(results)) and link.endswith("log.txt") for link in links):
            found.append(int(process.name))
    return found


def _alive(pid: int) -> bool:
    try:
        state = (Path("/proc") / str(pid) / "stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


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


def test_a_disk_that_fills_up_leaves_a_record_that_says_so(small_disk):
    arguments = (*FAILING, "+renderer.how=not", "evaluation.picture=256", f"results_dir={small_disk}")
    done = subprocess.run([sys.executable, "-m", "bench", *arguments], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
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
