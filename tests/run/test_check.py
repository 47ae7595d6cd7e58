"""A value that cannot be is refused before anything runs, for the whole sweep, with its cell."""

import subprocess
import sys
from multiprocessing import Pipe
from pathlib import Path

import pytest

from bench.records.read import Plan, PlannedCell, read_records
from bench.records.record import Record
from bench.run import process
from bench.run.check import check_plan, refusal, refusals
from bench.run.messages import Job
from tests import tiny
from tests.run.driving import ROOT, command

SMALL = ("scale=smoke", "threads=1")
CODE = """
import os
class {name}:
    def __init__(self, *_, **__):
        {act}
    def render(self, field, rays): ...
    def silhouette_loss(self, field, rays, rendering, mask): ...
"""


@pytest.fixture
def plain(compose_config):
    """A configuration as plain data, from overrides."""
    return lambda *overrides: tiny.plain(compose_config(*SMALL, *overrides))


@pytest.mark.parametrize("task", ["ablation", "gradients", "pose"])
def test_a_task_on_a_fitted_network_is_refused_without_one(plain, task):
    shape = ("task.shape=prior",) if task == "pose" else ()
    cells = [plain(f"task={task}", *shape), plain("+experiment=fitted", f"task={task}", *shape)]
    assert [reason[-24:] for reason in map(refusal, cells)] == ["to: add +experiment=fitted"[-24:], ""]


def test_an_experiment_without_m_says_that_it_is_one_run(tmp_path):
    shown = command("+experiment=fig10_start", "plan=true", *SMALL, f"results_dir={tmp_path}")
    assert "this is one run; with -m" in shown.err
    two = command("+experiment=[fitted,gradients]", "plan=true", *SMALL, f"results_dir={tmp_path}")
    assert two.code == 0 and "this is one run; with -m" in two.err
    whole = [
        command(*args, "plan=true", *SMALL, f"results_dir={tmp_path}")
        for args in (["-m", "+experiment=fig10_start"], [])
    ]
    assert [done.code for done in whole] == [0, 0] and not any("one run" in done.err for done in whole)


def test_the_command_line_loads_nothing_slow():
    code = "import sys, bench.__main__, bench.run.run; print(*{'torch', 'pandas', 'matplotlib'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_what_the_server_has_not_loaded_is_loaded_before_the_run_says_that_it_is_ready(tmp_path, monkeypatch):
    done = []
    monkeypatch.setattr(process, "import_module", done.append)
    monkeypatch.setattr("bench.run.execute.main", lambda *_: done.append("main"))
    job = Job(tmp_path, Record("id", "task", "renderer", "dataset", 0, {}))
    process._enter(job, *Pipe())
    assert done == [*process.preloaded(), "main"] and "open3d" in done


@pytest.mark.parametrize(
    ("act", "words"),
    [
        ("raise RuntimeError", ""),
        ("raise ValueError('no')", "no"),
        ("print('made')", "renderer Mine lacks capabilities, render or silhouette_loss: see renderers/rendering.py"),
    ],
)
def test_a_class_that_fails_otherwise_is_left_to_its_run_and_prints_nothing(
    plain, tmp_path, monkeypatch, capsys, act, words
):
    module = f"failing_{tmp_path.name}"
    (tmp_path / f"{module}.py").write_text(CODE.format(name="Mine", act=act))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    assert refusal(plain("renderer=custom", f"renderer._target_={module}.Mine")) == words
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("end", ["os._exit(3)", "raise SystemExit"])
def test_a_class_that_ends_its_process_ends_its_run_alone(plain, tmp_path, monkeypatch, end):
    module = f"ending_{tmp_path.name}"
    (tmp_path / f"{module}.py").write_text(CODE.format(name="Mine", act=end))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    own = plain("renderer=custom", f"renderer._target_={module}.Mine")
    assert refusals([own, own]) == ["", ""]
    few = ("renderer=custom", f"renderer._target_={module}.Mine", "seed=0,1", f"results_dir={tmp_path / 'r'}")
    assert command("-m", *few, *SMALL).code == 1
    assert [record["status"] for record in read_records(tmp_path / "r")[0]] == ["crashed"] * 2


@pytest.fixture
def planned(plain, tmp_path):
    """A plan of one cell for each list of overrides."""

    def plan(*cells: tuple[str, ...]) -> Plan:
        made = []
        for number, overrides in enumerate(cells):
            config = plain(*overrides, "isolation=off")
            made.append(PlannedCell(f"c-{number}", list(overrides), "completion", "dist", "sofa", 0, config))
        return Plan("p", Path(tmp_path), made)

    return plan


def test_a_sweep_is_told_which_cell_cannot_be(planned):
    plan = planned(("seed=0", "renderer.steps=9"), ("seed=0", "renderer.steps=0"), ("seed=0", "renderer.steps=-1"))
    with pytest.raises(ValueError, match=r"^cell 2 of 3 \(renderer.steps=0\): steps must be at least 1, not 0: .*"
                       r"; 2 of 3 cells are invalid; nothing was run$"):  # fmt: skip
        check_plan(plan, "basic", set())
    check_plan(plan, "basic", {"c-1", "c-2"})  # what is there already is not checked
    with pytest.raises(ValueError, match=r"^steps must be"):  # all of them: no cell is worth naming
        check_plan(planned(("renderer.steps=0", "seed=0"), ("renderer.steps=0", "seed=1")), "basic", set())


def test_a_gpu_is_looked_for_where_the_runs_are(planned, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    plan = planned(("device=cuda",))
    with pytest.raises(ValueError, match="PyTorch sees no GPU"):
        check_plan(plan, "joblib", set())
    check_plan(plan, "slurm", set())


@pytest.mark.parametrize(("overrides", "words"), [
    (("index=1000000",), "index must be at most 999999, not 1000000"),
    (("threads=0",), "threads must be at least 1, not 0"),
    (("split=holdout",), "split must be one of train, validation, test, not 'holdout'"),
    (("+experiment=parsimony", "field=box", "index=0"), "does not take field=box: leave it out"),
    (("+method=single_view", "task.image_path=none.png"), "task.image_path=none.png is no file"),
    (("dataset=mesh", "dataset.path=none.obj"), "dataset.path must be a mesh file or a folder"),
    (("renderer.alpha=fast",), "renderer.alpha: Value 'fast'"),
    (("task.optimiser.iterations=-3",), "task.optimiser.iterations must be at least 1, not -3"),
])  # fmt: skip
def test_what_cannot_be_says_its_key(plain, overrides, words):
    assert words in refusal(plain(*overrides))


@pytest.mark.parametrize(("arguments", "words"), [
    (("-m", "seed=0,1", "renderer.steps=50,0"), "cell 2 of 4 (seed=0 renderer.steps=0): steps must be at least 1"),
    (("-m", "index=0,-1"), "cell 2 of 2 (index=-1): index must be at least 0"),
    (("-m", "seed=0,1", "time_limit=0"), "time_limit must be positive"),
    (("renderer.steps=0",), "steps must be at least 1"),
    (("memory_limit=-1",), "memory_limit must be positive"),
    (("tracker._target_=bench.trackers.Tracked",), "tracker._target_ names 'bench.trackers.Tracked'"),
])  # fmt: skip
def test_nothing_is_left_of_what_cannot_be(tmp_path, arguments, words):
    done = command(*arguments, "scale=smoke", f"results_dir={tmp_path / 'r'}")
    assert (done.code, done.out) == (2, "")
    assert words in done.err and len(done.err.splitlines()) == 1, done.err
    assert not (tmp_path / "r").exists()
