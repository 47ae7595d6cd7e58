"""Sweeps are planned before they start, and have a row for every cell under every launcher."""

import json
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


@pytest.mark.parametrize("launcher", [name for name in LAUNCHERS if name != "joblib"])  # it is in `workers`
def test_every_planned_cell_is_a_row_whatever_becomes_of_it(tmp_path, launcher):
    if not available(launcher):
        pytest.skip(f"the plugin of {launcher} is not installed: pip install -e '.[joblib,submitit,ray]'")
    hows = ("not", *(SHORT if launcher == "basic" else SHORT[:1] + SHORT[3:4]))
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
    assert found == {"not": found["not"], **{how: CASES[how][1] for how in hows[1:]}}
    assert found["not"] in ("ok", "not_reached")
    lines = done.stdout.splitlines()
    assert Path(lines[-1]) == next(tmp_path.glob("sweeps/*/plan.json")).parent
    assert sum(str(tmp_path / "runs") in line for line in lines) == len(hows)  # a line each
    page = (tmp_path / "index.html").read_text()
    assert all(name in page for name in planned)
    threads = {record["environment"]["threads"] for record in records}
    if launcher in ("workers", "ray_cluster"):  # our presets pin them
        assert threads == {1}


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_every_way_to_fail_is_a_row_under_every_launcher(tmp_path, launcher):
    if not available(launcher):
        pytest.skip(f"the plugin of {launcher} is not installed: pip install -e '.[joblib,submitit,ray]'")
    limits = ("time_limit=10", "memory_limit=1.5")
    sweep(tmp_path, f"hydra/launcher={launcher}", f"+renderer.how={','.join(CASES)}", *limits)
    records, problems = read_records(tmp_path)
    assert problems == []
    found = {record["config"]["renderer"]["how"]: record["status"] for record in records}
    assert found == {how: status for how, (_, status, _) in CASES.items()}
    assert len(plan_of(tmp_path)["cells"]) == len(records) == len(CASES)


@pytest.mark.parametrize("launcher", ["basic", "workers", "submitit_local"])
def test_where_no_run_folder_can_be_made_every_planned_cell_is_still_a_row(tmp_path, launcher):
    if not available(launcher):
        pytest.skip(f"the plugin of {launcher} is not installed: pip install -e '.[joblib,submitit,ray]'")
    (tmp_path / "runs").touch()  # where a folder should be
    done = sweep(tmp_path, f"hydra/launcher={launcher}", "+renderer.how=not,raise")
    assert done.returncode == 1
    assert "Traceback" not in done.stdout + done.stderr
    assert "2 planned: 2 not_run" in done.stdout
    if launcher != "submitit_local":  # whose jobs have a log of their own
        assert done.stderr.count("set results_dir to a folder you can write") == 2
    records, _ = read_records(tmp_path)
    assert [record["status"] for record in records] == ["not_run"] * 2


def test_limits_hold_in_a_sweep(tmp_path):
    done = sweep(tmp_path, "+renderer.how=loop,native_loop,not", "time_limit=1.5", "evaluation.picture=null")
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


def test_a_sweep_that_is_stopped_says_what_it_came_to(tmp_path):
    command = [sys.executable, "-m", "bench", "-m", *FAILING, "+renderer.how=not", "+renderer.pause=1", "seed=0,1,2"]
    driver = subprocess.Popen([*command, f"results_dir={tmp_path}"], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    latest = time.perf_counter() + 60
    while not list(tmp_path.glob("runs/*/record.json")) and time.perf_counter() < latest:
        time.sleep(0.02)
    driver.send_signal(signal.SIGINT)
    out, _ = driver.communicate(timeout=30)
    assert driver.returncode == 130
    assert "3 planned: 2 not_run, 1 killed" in out
    assert Path(out.splitlines()[-1]) == next(tmp_path.glob("sweeps/*/plan.json")).parent
    assert (tmp_path / "index.html").is_file()


def test_a_sweep_of_nothing_is_told(tmp_path):
    done = sweep(tmp_path, "seed=range(0,0)")
    assert done.returncode == 2
    assert "error: the sweep has no cell" in done.stderr
    assert len(done.stderr.splitlines()) == 1
