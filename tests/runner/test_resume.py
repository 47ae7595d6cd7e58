"""An interrupted sweep resumes: finished runs are reused, and no run is lost or run twice."""

import json
import random
import shutil
import signal
import time
from pathlib import Path

import pytest

from bench.records.folder import _package_hash
from bench.records.read import read_records
from bench.records.results import ended_record
from bench.runner.run import run_cell
from tests.composing import cells_of
from tests.runner.driving import FAILING, ROOT, command, driver, record_of, wait_for


def results_of(results: Path) -> dict[str, dict]:
    """The results of a sweep by cell, without times and machines."""
    records, problems = read_records(results)
    assert problems == []
    timeless = ("id", "task", "renderer", "dataset", "seed", "status", "reason", "config_hash", "code")
    timeless += ("metrics", "metrics_start", "evaluations", "flops", "definitions", "scene")
    return {record["id"]: {name: record[name] for name in timeless} for record in records}


def ended(results: Path) -> int:
    """How many cells of a sweep have ended."""
    return sum(bool(record.get("ended")) for record in read_records(results)[0]) if under_way(results) else 0


def killed_and_resumed(tmp_path: Path, cells: int, kills: int, seed: int) -> None:
    """Kills a sweep several times, each time when one more cell has ended or is under way, and resumes it."""
    uninterrupted, broken, draw = tmp_path / "uninterrupted", tmp_path / "broken", random.Random(seed)
    arguments = ("-m", *FAILING, "+renderer.how=not,raise", f"seed={','.join(map(str, range(cells // 2)))}")
    command(*arguments, "isolation=off", f"results_dir={uninterrupted}")  # faster, and changes no result
    for number in range(kills):
        already_ended = ended(broken)
        with driver(tmp_path / f"driver {number}", *arguments, f"results_dir={broken}") as running:
            moment, most = draw.choice([ended, under_way]), already_ended + cells // (kills + 1)
            wait_for(lambda moment=moment, most=most: moment(broken) > min(most, cells - 1), running)
            time.sleep(draw.uniform(0.0, 0.3))  # anywhere within a cell
            running.send(draw.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGINT]))
    resumed = command(*arguments, f"results_dir={broken}")
    assert f"{cells} planned" in resumed.out and len(results_of(uninterrupted)) == cells
    assert results_of(broken) == results_of(uninterrupted)


def under_way(results: Path) -> int:
    """How many cells of a sweep have begun."""
    return len(list(results.glob("runs/*/record.json")))


def test_a_sweep_whose_driver_is_killed_resumes(tmp_path):
    killed_and_resumed(tmp_path, cells=4, kills=1, seed=0)


@pytest.mark.slow
def test_a_sweep_of_30_killed_at_20_moments_ends_as_one_that_was_not(tmp_path):
    killed_and_resumed(tmp_path, cells=30, kills=20, seed=1)


def test_finished_runs_are_reused_and_failed_ones_are_run_again_on_request(isolated, tmp_path):
    times, reused = [], []
    for more in ((), (), ("rerun=failed",), ("rerun=all",)):
        isolated("-m", *FAILING, "+renderer.how=not,raise", "isolation=off", *more)
        records = {r["config"]["renderer"]["how"]: r for r in read_records(tmp_path / "r")[0]}
        times.append({how: (record["ended"], record["seconds"]["total"]) for how, record in records.items()})
        reused.append((records["not"]["reused"], records["raise"]["reused"]))
    first, again, failed, everything = times
    assert reused[:2] == [(False, False), (True, True)] and again == first
    assert failed["not"] == first["not"] and failed["raise"][1] != first["raise"][1]
    assert everything["not"][1] != first["not"][1]
    assert len(list((tmp_path / "r" / "earlier").iterdir())) == 3  # runs before they were run again


def test_a_run_of_other_code_is_not_reused(isolated, tmp_path, monkeypatch):
    package = tmp_path / "theirs"
    package.mkdir()
    shutil.copy(ROOT / "tests" / "failing.py", package / "mypkg.py")
    monkeypatch.syspath_prepend(str(package))
    outputs = []
    for change in ("", "", "\n# another line\n"):
        with (package / "mypkg.py").open("a") as file:
            file.write(change)
        _package_hash.cache_clear()  # a command reads the code once
        outputs.append(isolated(*FAILING, "renderer._target_=mypkg.Failing", "isolation=off").out)
    assert ["reused: the run of" in output for output in outputs] == [False, True, False]
    assert len({output.splitlines()[-1] for output in outputs}) == 1


def test_two_launches_at_once_run_a_cell_once(tmp_path):
    arguments = (*FAILING, "+renderer.how=not", f"results_dir={tmp_path / 'r'}")
    with driver(tmp_path / "a", *arguments) as first, driver(tmp_path / "b", *arguments) as second:
        outputs = [first.ended().out, second.ended().out]
    assert len({output.splitlines()[-1] for output in outputs}) == 1
    assert sorted("reused: the run of" in output for output in outputs) == [False, True]
    assert len(read_records(tmp_path / "r")[0]) == 1


def test_a_run_without_its_end_time_is_not_reused(isolated, tmp_path):
    """The driver may be killed after a run's last output, before it writes the end of the run."""
    isolated(*FAILING, "isolation=off")
    (path,) = (tmp_path / "r").glob("runs/*/record.json")
    record = json.loads(path.read_text())
    path.write_text(json.dumps(record | {"ended": ""}))
    _, out, _ = isolated(*FAILING, "isolation=off")
    assert "reused" not in out and json.loads(path.read_text())["ended"]


def test_a_damaged_record_is_set_aside_and_the_cell_run(isolated, tmp_path):
    failing = (*FAILING, "+renderer.how=raise", "isolation=off")
    isolated(*failing)
    (path,) = (tmp_path / "r").glob("runs/*/record.json")
    for number, damage in enumerate(('{"schema": 99}', "[" * 100_000), 1):
        path.write_text(damage)
        code, out, err = isolated(*failing)
        assert code == 1 and "Traceback" not in out + err
        assert json.loads(path.read_text())["status"] == "crashed"
        aside = [folder / "record.json" for folder in (tmp_path / "r" / "earlier").iterdir()]
        assert len(aside) == number and damage in [file.read_text() for file in aside]


def test_a_run_that_failed_by_a_limit_is_run_again_under_another(isolated):
    outcomes = []
    for limit in (0.2, 0.2, 0.3):
        record = record_of(isolated(*FAILING, "+renderer.how=loop", f"time_limit={limit}").out)
        assert f"more than time_limit={limit} s" in record["reason"]
        outcomes.append((record["status"], record["reused"]))
    assert outcomes == [("timeout", False), ("timeout", True), ("timeout", False)]


def test_the_code_of_a_package_without_an_init_file_is_read(tmp_path, monkeypatch):
    (tmp_path / "space" / "inner").mkdir(parents=True)
    module = tmp_path / "space" / "inner" / "mine.py"
    monkeypatch.syspath_prepend(str(tmp_path))
    hashes = set()
    for text in ("a = 1", "a = 2"):
        module.write_text(text)
        _package_hash.cache_clear()
        hashes.add(_package_hash("space"))
    assert len(hashes - {""}) == 2


def test_a_run_on_a_machine_whose_clock_is_behind_counts_for_its_sweep(tmp_path):
    (cell,) = cells_of(*FAILING, "+renderer.how=raise", "isolation=off", f"results_dir={tmp_path}")
    for planned_at, reused in (("2999-01-01T00:00:00.000+00:00", False), ("2999-01-02T00:00:00.000+00:00", True)):
        assert run_cell(cell, planned_at) == []
        record = ended_record(cell.folder, planned_at)
        assert record is not None and record["reused"] is reused
