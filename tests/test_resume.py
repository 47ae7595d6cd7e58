"""A sweep that is cut short goes on where it was; what is finished is reused, and nothing is lost or run twice."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bench.identity import _package
from bench.report.records import read_records
from tests.test_isolation import FAILING, ROOT
from tests.test_launchers import UNHEARD, sweep


def results_of(results: Path) -> dict[str, dict]:
    """All that a sweep came to, but for times and machines, by cell."""
    records, problems = read_records(results)
    assert problems == []
    timeless = ("id", "task", "renderer", "dataset", "seed", "status", "reason", "config_hash", "code")
    timeless += ("metrics", "metrics_start", "evaluations", "flops", "definitions", "scene")
    return {record["id"]: {name: record[name] for name in timeless} for record in records}


def killed_and_resumed(tmp_path: Path, cells: int, kills: int, seed: int) -> None:
    arguments = ("+renderer.how=not,raise", f"seed={','.join(map(str, range(cells // 2)))}")
    whole = tmp_path / "whole"
    begun = time.perf_counter()
    sweep(whole, *arguments)
    takes = time.perf_counter() - begun
    draw, broken = random.Random(seed), tmp_path / "broken"
    command = [sys.executable, "-m", "bench", "-m", *FAILING, *arguments, f"results_dir={broken}"]
    for _ in range(kills):
        driver = subprocess.Popen(command, cwd=ROOT, **UNHEARD)
        try:
            driver.wait(timeout=draw.uniform(0.2, max(2.5 * takes / kills, 4.0)))
        except subprocess.TimeoutExpired:
            driver.send_signal(draw.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGINT]))
            driver.wait()
    done = sweep(broken, *arguments)
    assert f"{cells} planned" in done.stdout
    assert len(results_of(whole)) == cells
    assert results_of(broken) == results_of(whole)


def test_a_sweep_whose_driver_is_killed_goes_on_where_it_was(tmp_path):
    killed_and_resumed(tmp_path, cells=4, kills=2, seed=0)


@pytest.mark.slow
def test_a_sweep_of_30_killed_at_20_moments_ends_as_one_that_was_not(tmp_path):
    killed_and_resumed(tmp_path, cells=30, kills=20, seed=1)


def test_what_is_finished_is_reused_and_failures_are_tried_again_on_request(isolated, tmp_path):
    times = []
    for more in ((), (), ("rerun=failed",), ("rerun=all",)):
        isolated("-m", *FAILING, "+renderer.how=not,raise", *more)
        records = {r["config"]["renderer"]["how"]: r for r in read_records(tmp_path / "r")[0]}
        times.append(
            {how: (record["ended"], record["seconds"]["total"], record["reused"]) for how, record in records.items()}
        )
    first, again, failed, everything = times
    assert [first["not"][2], first["raise"][2]] == [False, False]
    assert {how: value[:2] for how, value in again.items()} == {how: value[:2] for how, value in first.items()}
    assert [again["not"][2], again["raise"][2]] == [True, True]
    assert failed["not"][:2] == first["not"][:2]
    assert failed["raise"][1] != first["raise"][1]
    assert everything["not"][1] != first["not"][1]
    assert len(list((tmp_path / "r" / "earlier").iterdir())) == 3  # what was run again is kept


def test_other_code_is_no_reason_to_reuse(tmp_path):
    package = tmp_path / "theirs"
    package.mkdir()
    shutil.copy(ROOT / "tests" / "failing.py", package / "mypkg.py")
    arguments = ["renderer._target_=mypkg.Failing", "+renderer.how=not"]
    environment = {**os.environ, "PYTHONPATH": str(package)}
    command = [sys.executable, "-m", "bench", *FAILING, *arguments, f"results_dir={tmp_path / 'r'}"]
    options = {"cwd": ROOT, "env": environment, "capture_output": True, "text": True, "check": False}
    outputs = []
    for change in ("", "", "\n# another line\n"):
        with (package / "mypkg.py").open("a") as file:
            file.write(change)
        outputs.append(subprocess.run(command, **options).stdout)
    assert ["reused: the run of" in output for output in outputs] == [False, True, False]
    assert len({output.splitlines()[-1] for output in outputs}) == 1


def test_two_launches_at_once_run_a_cell_once(tmp_path):
    command = [sys.executable, "-m", "bench", *FAILING, "+renderer.how=not", f"results_dir={tmp_path}"]
    both = [subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    outputs = [process.communicate(timeout=120)[0] for process in both]
    assert len({output.splitlines()[-1] for output in outputs}) == 1
    assert sorted("reused: the run of" in output for output in outputs) == [False, True]
    assert len(read_records(tmp_path)[0]) == 1


def test_what_had_not_quite_ended_is_not_reused(isolated, tmp_path):
    """The driver may be killed after a run's last word, and before it wrote what that came to."""
    isolated(*FAILING, "+renderer.how=not")
    (path,) = (tmp_path / "r").glob("runs/*/record.json")
    record = json.loads(path.read_text())
    path.write_text(json.dumps(record | {"ended": ""}))
    _, out, _ = isolated(*FAILING, "+renderer.how=not")
    assert "reused" not in out
    assert json.loads(path.read_text())["ended"]


@pytest.mark.parametrize("damage", ["", "{", '{"schema": 99}', '{"schema": 1, "asked": null}', "[" * 100_000])
def test_a_damaged_record_is_set_aside_and_the_cell_run(isolated, tmp_path, damage):
    isolated(*FAILING, "split=tst")  # fails at once
    (path,) = (tmp_path / "r").glob("runs/*/record.json")
    path.write_text(damage)
    code, out, err = isolated(*FAILING, "split=tst")
    assert code == 1
    assert "Traceback" not in out + err
    assert json.loads(path.read_text())["status"] == "crashed"
    (aside,) = (tmp_path / "r" / "earlier").iterdir()
    assert (aside / "record.json").read_text() == damage


def test_a_run_that_failed_by_a_limit_is_run_again_under_another(isolated, tmp_path):
    statuses = []
    for limit in (0.2, 0.2, 60):
        _, out, _ = isolated(*FAILING, "+renderer.how=not", "+renderer.pause=0.1", f"time_limit={limit}")
        record = json.loads((Path(out.splitlines()[-1]) / "record.json").read_text())
        statuses.append((record["status"] == "timeout", record["reused"]))
    assert statuses == [(True, False), (True, True), (False, False)]


def test_code_that_a_package_without_an_init_holds_is_seen(tmp_path, monkeypatch):
    (tmp_path / "space" / "inner").mkdir(parents=True)
    module = tmp_path / "space" / "inner" / "mine.py"
    monkeypatch.syspath_prepend(str(tmp_path))
    found = set()
    for text in ("a = 1", "a = 2"):
        module.write_text(text)
        _package.cache_clear()
        found.add(_package("space"))
    assert len(found - {""}) == 2
