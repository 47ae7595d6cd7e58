"""Sweeps are planned before they start, have a row for every cell under every launcher, and go on where they were."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

from bench.report.records import read_records
from tests.test_isolation import CASES, FAILING, ROOT

UNHEARD = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
SHORT = ("raise", "not_a_number", "leave", "kill", "segfault")  # those that need no limit to end
LAUNCHERS = {
    "basic": ("", ()),
    "joblib": ("hydra_plugins.hydra_joblib_launcher", ("hydra.launcher.n_jobs=2",)),
    "workers": ("hydra_plugins.hydra_joblib_launcher", ()),
    "submitit_local": ("hydra_plugins.hydra_submitit_launcher", ("hydra.launcher.timeout_min=5",)),
    "ray_cluster": ("hydra_plugins.hydra_ray_launcher", ()),
}


def available(launcher: str) -> bool:
    package = LAUNCHERS[launcher][0]
    return not package or (find_spec("hydra_plugins") is not None and find_spec(package) is not None)


def sweep(results: Path, *arguments: str, **options) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "bench", "-m", *FAILING, *arguments, f"results_dir={results}"],
        cwd=ROOT, capture_output=True, text=True, timeout=240, check=False, **options,
    )  # fmt: skip


def plan_of(results: Path) -> dict:
    (path,) = results.glob("sweeps/*/plan.json")
    return json.loads(path.read_text())


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_every_planned_cell_is_a_row_whatever_becomes_of_it(tmp_path, launcher):
    if not available(launcher):
        pytest.skip(f"the plugin of {launcher} is not installed: pip install -e '.[joblib,submitit,ray]'")
    hows = ("not", *SHORT)
    done = sweep(
        tmp_path,
        f"hydra/launcher={launcher}",
        *LAUNCHERS[launcher][1],
        f"+renderer.how={','.join(hows)}",
        "threads=null",
    )
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    planned = [cell["id"] for cell in plan_of(tmp_path)["cells"]]
    records, problems = read_records(tmp_path)
    assert problems == []
    assert sorted(record["id"] for record in records) == sorted(planned)
    found = {record["config"]["renderer"]["how"]: record["status"] for record in records}
    assert found == {"not": found["not"], **{how: CASES[how][1] for how in SHORT}}
    assert found["not"] in ("ok", "not_reached")
    lines = done.stdout.splitlines()
    assert Path(lines[-1]) == next(tmp_path.glob("sweeps/*/plan.json")).parent
    assert sum(str(tmp_path / "runs") in line for line in lines) == len(hows)  # a line each
    page = (tmp_path / "index.html").read_text()
    assert all(name in page for name in planned)
    threads = {record["environment"]["threads"] for record in records}
    if launcher in ("workers", "ray_cluster"):  # our presets pin them
        assert threads == {1}


def test_limits_hold_in_a_sweep(tmp_path):
    done = sweep(tmp_path, "+renderer.how=loop,native_loop,not", "time_limit=1.5")
    statuses = {r["config"]["renderer"]["how"]: r["status"] for r in read_records(tmp_path)[0]}
    assert statuses["loop"] == statuses["native_loop"] == "timeout"
    assert statuses["not"] != "timeout"
    assert done.returncode == 1


def test_the_plan_stands_before_the_first_cell_and_shows_what_was_not_run(tmp_path):
    command = [sys.executable, "-m", "bench", "-m", *FAILING, "+renderer.how=not", "+renderer.pause=5", "seed=0,1,2"]
    driver = subprocess.Popen([*command, f"results_dir={tmp_path}"], cwd=ROOT, **UNHEARD)
    latest = time.perf_counter() + 60
    while not list(tmp_path.glob("runs/*/record.json")) and time.perf_counter() < latest:
        time.sleep(0.02)
    driver.kill()
    driver.wait()
    cells = plan_of(tmp_path)["cells"]
    assert [cell["seed"] for cell in cells] == [0, 1, 2]
    records, problems = read_records(tmp_path)
    assert problems == []
    assert {record["id"] for record in records} == {cell["id"] for cell in cells}
    assert sorted(record["status"] for record in records) == ["killed", "not_run", "not_run"]
    assert "the same command runs it" in next(r for r in records if r["status"] == "not_run")["reason"]
    subprocess.run([sys.executable, "-m", "bench.report", f"results_dir={tmp_path}"], cwd=ROOT, check=True, **UNHEARD)
    assert (tmp_path / "index.html").read_text().count("not_run") >= 2


def test_a_cell_that_cannot_be_composed_stops_the_sweep_before_it_starts(tmp_path):
    done = sweep(tmp_path, "scale=smoke,smok")
    assert done.returncode == 2
    assert done.stderr.strip() == "error: unknown scale 'smok': did you mean smoke or desk?"
    assert not (tmp_path / "runs").exists()


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
    killed_and_resumed(tmp_path, cells=6, kills=3, seed=0)


@pytest.mark.slow
def test_a_sweep_of_30_killed_at_20_moments_ends_as_one_that_was_not(tmp_path):
    killed_and_resumed(tmp_path, cells=30, kills=20, seed=1)


def test_what_is_finished_is_reused_and_failures_are_tried_again_on_request(tmp_path):
    arguments = ("+renderer.how=not,raise",)
    times = []
    for more in ((), (), ("rerun=failed",), ("rerun=all",)):
        sweep(tmp_path, *arguments, *more)
        records = {r["config"]["renderer"]["how"]: r for r in read_records(tmp_path)[0]}
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
    assert len(list((tmp_path / "earlier").iterdir())) == 3  # what was run again is kept


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
