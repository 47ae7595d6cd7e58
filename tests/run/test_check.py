"""A value that cannot be is refused before anything runs, for the whole sweep, with its cell."""

import subprocess
import sys
from collections import Counter
from copy import deepcopy
from multiprocessing import Pipe
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from bench import config as config_module
from bench.config import Isolation
from bench.records.read import Plan, PlannedCell
from bench.records.record import Record
from bench.run import process
from bench.run.check import check_plan, needed, refusals
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
    return lambda *overrides: OmegaConf.to_container(
        compose_config(*SMALL, *overrides), resolve=True, throw_on_missing=False
    )


def test_a_part_that_cells_share_is_built_once(plain, monkeypatch):
    built: Counter[str] = Counter()
    build = config_module._build

    def counted(node, name, *rest):
        built[name] += 1
        return build(node, name, *rest)

    monkeypatch.setattr(config_module, "_build", counted)
    cells = []
    for renderer in ("dist", "dvr"):
        one = plain(f"renderer={renderer}")
        cells += [deepcopy(one) | {"seed": seed, "index": index} for seed in range(5) for index in range(4)]
    cells.append(plain("renderer=dist", "renderer.steps=0"))
    found = refusals(cells, Isolation.off)
    assert found == [""] * 40 + ["steps must be at least 1, not 0: the paper uses 50 to 100"]
    assert (built["renderer"], built["task"], built["dataset"], built["prior"]) == (3, 1, 1, 1)


def test_a_process_of_its_own_finds_the_same(plain):
    cells = [plain(override) for override in ("seed=1", "renderer.steps=0", "task.points=0", "dataset=mesh", "field=x")]
    found = refusals(cells, Isolation.process)
    assert found == refusals(cells, Isolation.off)
    assert [bool(reason) for reason in found] == [False, True, True, True, True]


@pytest.mark.parametrize("task", ["ablation", "gradients", "pose"])
def test_a_task_on_a_fitted_network_is_refused_without_one(plain, task):
    shape = ("task.shape=prior",) if task == "pose" else ()
    cells = [plain(f"task={task}", *shape), plain("+experiment=fitted", f"task={task}", *shape)]
    assert [reason[-24:] for reason in refusals(cells, Isolation.off)] == ["to: add +experiment=fitted"[-24:], ""]


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


def test_a_single_run_is_checked_before_what_its_run_alone_takes_is_loaded(plain):
    modules = needed(plain("renderer=dvr", "task=pose", "dataset=sphere"))
    assert modules == ["bench", "bench.run.execute", "bench.tasks.pose", "renderers", "datasets.families"]
    assert set(modules) < set(process.preloaded()) | {"renderers"}
    assert needed(plain("renderer=custom", "renderer._target_=mypkg.Mine"))[2:] == [
        "bench.tasks.completion", "datasets.families"
    ]  # fmt: skip
    code = "import sys, bench.__main__, bench.run.run; print(*{'torch', 'pandas', 'matplotlib'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_what_the_server_has_not_loaded_is_loaded_before_the_run_says_that_it_is_ready(tmp_path, monkeypatch):
    done = []
    monkeypatch.setattr(process, "import_module", done.append)
    monkeypatch.setattr("bench.run.execute.main", lambda *_: done.append("main"))
    job = process.Job(OmegaConf.create(), tmp_path, Record("id", "task", "renderer", "dataset", 0, {}))
    process._enter(job, *Pipe())
    assert done == [*process.preloaded(), "main"] and "open3d" in done


@pytest.mark.parametrize(
    ("act", "words"), [("raise RuntimeError", ""), ("os._exit(3)", ""), ("raise ValueError('no')", "no")]
)
def test_a_class_that_fails_otherwise_is_left_to_its_run(plain, tmp_path, monkeypatch, act, words):
    module = f"failing_{tmp_path.name}"
    (tmp_path / f"{module}.py").write_text(CODE.format(name="Mine", act=act))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    own = plain("renderer=custom", f"renderer._target_={module}.Mine")
    isolation = Isolation.process if "_exit" in act else Isolation.off
    assert refusals([own, own], isolation) == [words, words]


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
                       r"; 2 of 3 cells cannot be; nothing was run$"):  # fmt: skip
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


@pytest.mark.parametrize(("arguments", "words"), [
    (("-m", "seed=0,1", "renderer.steps=50,0"), "cell 2 of 4 (seed=0 renderer.steps=0): steps must be at least 1"),
    (("-m", "index=0,-1"), "cell 2 (index=-1"),
    (("index=1000000",), "index must be at most 999999, not 1000000"),
    (("-m", "seed=0,1", "threads=0"), "threads must be at least 1, not 0"),
    (("-m", "seed=0,1", "time_limit=0"), "time_limit must be positive"),
    (("-m", "seed=0,1", "split=holdout"), "split must be one of train, validation, test, not 'holdout'"),
    (("-m", "+experiment=parsimony", "field=box,grid_24", "index=0"), "does not take field=box: leave it out"),
    (("-m", "seed=0,1", "+method=single_view", "task.image_path=none.png"), "task.image_path=none.png is no file"),
    (("-m", "seed=0,1", "dataset=mesh", "dataset.path=none.obj"), "dataset.path must be a mesh file or a folder"),
    (("renderer.alpha=fast",), "renderer.alpha: Value 'fast'"),
    (("task.optimiser.iterations=-3",), "task.optimiser.iterations must be at least 1, not -3"),
    (("memory_limit=-1",), "memory_limit must be positive"),
    (("tracker._target_=bench.trackers.Tracked",), "tracker._target_ names 'bench.trackers.Tracked'"),
])  # fmt: skip
def test_nothing_is_left_of_what_cannot_be(tmp_path, arguments, words):
    off = ("isolation=off",) if "-m" in arguments else ()  # a single run is checked in a process of its own
    done = command(*arguments, "scale=smoke", *off, f"results_dir={tmp_path / 'r'}")
    assert (done.code, done.out) == (2, "")
    assert words in done.err and len(done.err.splitlines()) == 1, done.err
    assert not (tmp_path / "r").exists()
