"""An invalid value is refused before anything runs, for the whole sweep, with its cell."""

from multiprocessing import Pipe
from pathlib import Path

import pytest

from bench.records.read import Plan, PlannedCell
from bench.records.record import Record
from bench.run import process
from bench.run.plan import check_plan, refusal
from bench.run.process import Job
from tests import tiny
from tests.run.driving import command

SMALL = ("scale=smoke", "threads=1")
CODE = """
class Mine:
    def __init__(self, *_, **__):
        {act}
    def render(self, field, rays): ...
    def silhouette_loss(self, field, rays, rendering, mask): ...
"""


@pytest.fixture
def plain(compose_config):
    """A configuration as plain data, from overrides."""
    return lambda *overrides: tiny.plain(compose_config(*SMALL, *overrides))


def test_a_task_on_a_fitted_network_is_refused_without_one(plain):
    for task in (("task=gradients",), ("task=pose", "task.shape=prior")):
        cells = [plain(*task), plain("+experiment=fitted", *task), plain("+experiment=fitted", *task, "index=1")]
        refused = [reason.endswith("fitted to: add +experiment=fitted") for reason in map(refusal, cells)]
        assert refused == [True, False, True]


def test_an_experiment_without_m_says_that_it_is_one_run(tmp_path):
    for options, experiment in (([], "fig10_start"), ([], "[fitted,gradients]"), (["-m"], "fig10_start")):
        done = command(*options, f"+experiment={experiment}", "plan=true", *SMALL, f"results_dir={tmp_path}")
        assert done.code == 0 and ("this is one run; with -m" in done.err) is (not options)


def test_what_the_server_has_not_loaded_is_loaded_before_the_run_says_that_it_is_ready(tmp_path, monkeypatch):
    done = []
    monkeypatch.setattr(process, "import_module", done.append)
    monkeypatch.setattr("bench.run.execute.main", lambda *_: done.append("main"))
    job = Job(tmp_path, Record("id", "task", "renderer", "dataset", 0, {}))
    process._enter(job, *Pipe())
    assert done == [*process.preloaded(), "main"] and "open3d" in done


@pytest.fixture
def own(tmp_path, monkeypatch):
    """Overrides that choose a renderer whose constructor does what is asked for."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)

    def write(act: str) -> tuple[str, str]:
        module = f"acting_{abs(hash(act))}_{tmp_path.name}"
        (tmp_path / f"{module}.py").write_text(CODE.format(act=act))
        return "renderer=custom", f"renderer._target_={module}.Mine"

    return write


def test_a_class_that_fails_otherwise_is_left_to_its_run_and_prints_nothing(plain, own, capsys):
    lacks = "renderer Mine lacks capabilities, render or silhouette_loss: see renderers/rendering.py"
    for act, words in (
        *(("raise RuntimeError", ""), ("raise SystemExit(3)", ""), ("raise ValueError('no')", "no")),
        ("print('made')", lacks),
    ):
        assert refusal(plain(*own(act))) == words
    assert capsys.readouterr().out == ""


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
