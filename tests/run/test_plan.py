"""plan=true lists what would run, with the time that like runs took, and leaves nothing behind."""

import json
from dataclasses import asdict
from pathlib import Path

import pytest

from bench.machine.processor import cpu_name
from bench.records.record import Record, RunStatus
from bench.run import run as run_module
from bench.run import sweep
from bench.run.plan import told
from tests.records.test_expected import expected
from tests.run.driving import command

SWEEP = ("-m", "scale=smoke", "isolation=off", "threads=1", "renderer=dist,dvr", "seed=0,1")


@pytest.fixture
def results(tmp_path, monkeypatch) -> Path:
    """A results folder whose runs are written by hand: no cell is checked or run."""
    monkeypatch.setattr(sweep, "check_plan", lambda *_: None)
    monkeypatch.setattr(run_module, "refusals", lambda configs, isolation: [""])
    return tmp_path / "r"


def planned(results: Path) -> list[sweep.PlannedCell]:
    plans = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep, "show_plan", lambda plan, *_: plans.append(plan))
        assert command(*SWEEP, "plan=true", f"results_dir={results}").code == 0
    return plans[0].cells


def write(results: Path, cell: sweep.PlannedCell, seconds: float, waited: float = 0.0) -> None:
    names = ("id", "task", "renderer", "dataset", "seed", "config")
    record = Record(**{name: value for name, value in asdict(cell).items() if name in names}, status=RunStatus.OK)
    record.ended, record.seconds = record.started, {"total": seconds}
    record.environment = {"cpu": cpu_name(), "waited_share": waited}
    identity = sweep.identity_of(cell)
    record.config_hash, record.code = identity.config_hash, identity.code
    (results / "runs" / cell.id).mkdir(parents=True)
    record.write(results / "runs" / cell.id)


def test_a_sweep_is_listed_and_nothing_is_left(results):
    done = command(*SWEEP, "plan=true", f"results_dir={results}")
    assert (done.code, done.err) == (0, "")
    *cells, whole = done.out.splitlines()
    assert [line.split("  ")[-1] for line in cells] == ["no like run"] * 4
    assert "renderer=dvr seed=1  completion, DVR, n = 128, sofa" in cells[3]
    assert whole == "4 planned: 4 to run, 4 without a like run"
    assert not results.exists()


def test_what_is_there_is_reused_and_tells_of_the_others(results):
    cells = planned(results)
    write(results, cells[0], 30.0)
    before = sorted(results.rglob("*"))
    *lines, whole = command(*SWEEP, "plan=true", f"results_dir={results}").out.splitlines()
    assert [line.split("  ")[-1] for line in lines] == [
        "reused", "about 30.0 s (1 like run)", *["about 30.0 s (1 run of other renderers)"] * 2
    ]  # fmt: skip
    assert whole == "4 planned: 3 to run, 1 reused; about 90.0 s (n = 1 each), 1 at a time"
    assert sorted(results.rglob("*")) == before
    again = command(*SWEEP, "plan=true", "rerun=all", "hydra/launcher=workers", f"results_dir={results}").out
    assert again.splitlines()[-1] == "4 planned: 4 to run; about 60.0 s (n = 1 each), 2 at a time"


def test_only_several_like_runs_give_a_range(results):
    for cell, seconds in zip(planned(results)[:2], (20.0, 40.0), strict=True):
        write(results, cell, seconds)
    *_, whole = command(*SWEEP, "plan=true", f"results_dir={results}").out.splitlines()
    assert whole == "4 planned: 2 to run, 2 reused; about 60.0 s (40.0 s to 80.0 s), 1 at a time"


def test_files_that_are_read_once_give_the_same_cells(results, monkeypatch):
    once = planned(results)
    monkeypatch.setattr(sweep, "ReadOnce", lambda repository: repository)
    assert planned(results) == once
    assert len({cell.id for cell in once}) == 4


@pytest.mark.parametrize("silent", [0.0, 100.0])
def test_a_sweep_that_is_planned_for_long_says_so(results, monkeypatch, silent):
    monkeypatch.setattr(sweep, "SILENT", silent)
    done = command(*SWEEP, "plan=true", f"results_dir={results}")
    assert done.err.splitlines() == (["planning 4 cells, about 400 ms"] if silent == 0 else [])


def test_a_sweep_that_is_stopped_while_it_is_planned_says_that_nothing_was_run(results, monkeypatch):
    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(sweep, "check_plan", stopped)
    done = command(*SWEEP, f"results_dir={results}")
    assert (done.code, done.err) == (130, "error: stopped by Ctrl-C; nothing was run\n")
    assert not results.exists()


def test_a_single_run_is_planned_too(results):
    one = ("scale=smoke", "isolation=off", "threads=1", "renderer=dist", "plan=true", f"results_dir={results}")
    done = command(*one)
    assert (done.code, done.err) == (0, "")
    assert "completion, DIST, our default, sofa  no like run" in done.out
    assert not results.exists()
    write(results, planned(results)[0], 30.0)
    assert "reused" in command(*one).out


def test_that_it_was_planned_does_not_change_a_run(results):
    cells = planned(results)
    assert cells[0].config["plan"] is True
    write(results, cells[0], 30.0)
    path = results / "runs" / cells[0].id / "record.json"
    record = json.loads(path.read_text())
    del record["config"]["plan"]  # of a run before there was a plan
    path.write_text(json.dumps(record | {"status": "diverged"}))
    assert "reused" in command(*SWEEP, "plan=true", f"results_dir={results}").out


def test_an_estimate_says_how_sure_it_is():
    assert told(None) == "no like run"
    assert told(next(iter(expected(10.0).values()))) == "about 10.0 s (1 like run), +1.00 kB"


def test_an_estimate_from_a_loaded_machine_says_so(results):
    write(results, planned(results)[0], 30.0, waited=0.6)
    *_, whole, note = command(*SWEEP, "plan=true", f"results_dir={results}").out.splitlines()
    assert "about 90.0 s" in whole
    assert note == "note: like runs waited 60% of their time for a processor; alone on it, it is about 36.0 s"
