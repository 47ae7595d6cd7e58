"""A plan is checked before anything runs; plan=true lists it, and writes nothing."""

import gzip
import signal
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

import pytest
from hydra import compose

from bench.prior import main as prior_main
from bench.records import shipped
from bench.records.folder import code_hash, config_hash, planned_run, resolve_config
from bench.records.record import Record, RunStatus
from bench.records.results import Plan, PlannedRun
from bench.runner import durations as durations_module
from bench.runner import run as run_module
from bench.runner import sweep
from bench.runner.compose import Composer, composing, without_hydra
from bench.runner.durations import duration_group, durations_of_similar_runs
from bench.runner.plan import check_plan, refusal_reason, refusal_reasons
from bench.train import main as train_main
from tests import tiny
from tests.composing import cells_of
from tests.runner.driving import command

SWEEP = ("-m", "scale=smoke", "isolation=off", "threads=1", "renderer=dist,dvr", "seed=0,1")
SMALL = ("scale=smoke", "threads=1")
CODE = """
class Mine:
    def __init__(self, *_, **__):
        {act}
    def render(self, field, rays): ...
    def silhouette_loss(self, field, rays, rendering, mask): ...
"""


@pytest.fixture
def results(tmp_path, monkeypatch) -> Path:
    """A results folder whose runs are written by hand: no cell is checked or run."""
    monkeypatch.setattr(sweep, "check_plan", lambda *_, **__: None)
    monkeypatch.setattr(run_module, "refusal_reasons", lambda configs: [""])
    return tmp_path / "r"


def planned(results: Path, *arguments: str) -> list[PlannedRun]:
    plans = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(durations_module, "show_plan", lambda plan, *_: plans.append(plan))
        assert command(*(arguments or SWEEP), "plan=true", f"results_dir={results}").code == 0
    return plans[0].cells


def write(results: Path, cell: PlannedRun, seconds: float) -> None:
    names = ("id", "task", "renderer", "dataset", "seed", "config")
    record = Record(**{name: value for name, value in asdict(cell).items() if name in names}, status=RunStatus.OK)
    record.ended, record.seconds = record.started, {"total": seconds}
    record.config_hash, record.code = config_hash(cell.config), code_hash(cell.config)
    (results / "runs" / cell.id).mkdir(parents=True)
    record.write(results / "runs" / cell.id)


def test_a_sweep_is_listed_and_nothing_is_written(results):
    result = command(*SWEEP, "plan=true", f"results_dir={results}")
    assert (result.code, result.err) == (0, "")
    *cells, summary = result.out.splitlines()
    assert [line.split("  ")[-1] for line in cells] == ["time unknown"] * 4
    assert "renderer=dvr seed=1  completion, DVR, n = 128, sofa" in cells[3]
    assert summary == "4 planned: 4 to run, 4 of unknown time (no similar run with a runtime is here, or shipped)"
    assert not results.exists()


def test_finished_runs_are_reused_and_give_the_times_of_similar_runs(results):
    cells = planned(results)
    write(results, cells[0], 30.0)
    before = sorted(results.rglob("*"))
    *lines, summary = command(*SWEEP, "plan=true", f"results_dir={results}").out.splitlines()
    times = ["reused", "about 30.0 s (median of 1 finished run)", *["time unknown"] * 2]
    assert [line.split("  ")[-1] for line in lines] == times
    assert summary.startswith("4 planned: 3 to run, 1 reused, 2 of unknown time (")
    assert "; about 30.0 s by mean times, 1 at a time, without the 2 of unknown time; the training of" in summary
    assert sorted(results.rglob("*")) == before
    again = command(*SWEEP, "plan=true", "rerun=all", "hydra/launcher=workers", f"results_dir={results}").out
    assert "; about 30.0 s by mean times, 2 at a time, without" in again.splitlines()[-1]


def test_without_a_finished_run_the_shipped_runs_of_the_experiment_give_the_time(results, monkeypatch, tmp_path):
    lines = ["task,renderer,method,config.scale.name,status,seconds.total", 'ablation,dist,"""""",smoke,ok,70']
    lines += ["ablation,dist,,smoke,ok,50", "ablation,dist,,desk,ok,9", "ablation,dvr,,smoke,crashed,3600"]
    (tmp_path / "paper").mkdir()
    with gzip.open(tmp_path / "paper" / "table1.runs.csv.gz", "wt") as file:
        file.write("\n".join(lines) + "\n")
    monkeypatch.setattr(shipped, "SHIPPED", tmp_path)
    *cells, summary = command(*SWEEP, "+experiment=table1", "plan=true", f"results_dir={results}").out.splitlines()
    times = [*["about 60.0 s (median of 2 shipped runs)"] * 2, *["time unknown"] * 2]
    assert [line.split("  ")[-1] for line in cells] == times and "; about 2.00 min" in summary


def test_a_plan_has_the_number_of_jobs(results):
    pytest.importorskip("submitit")
    cells, jobs = planned(results), ("hydra/launcher=slurm", "plan=true", f"results_dir={results}")
    for cell in cells[:2]:
        write(results, cell, 1000.0)  # others of that renderer take as long, up to the limit
    limits = ("rerun=all", "time_limit=900", "hydra.launcher.minutes_per_job=30", "hydra.launcher.minutes_per_run=20")
    assert command(*SWEEP, *jobs, *limits).out.splitlines()[-1].startswith("4 runs in 2 jobs, by ")
    lines = command(*SWEEP, *jobs, "hydra.launcher.tasks_per_node=4").out.splitlines()
    assert lines[-1] == "2 runs in 1 job, 4 at a time in each, by hydra.launcher.minutes_per_job=60"
    assert lines[-2].startswith("4 planned: 2 to run, 2 reused")


@pytest.mark.parametrize("arguments", [
    ("-m", "scale=smoke", "renderer.alpha=1.5,null", "label=a,'b c','${renderer._label_}'"),
    ("-m", "+method=space/dist_mask,space/idr_mask", "draw=0,3"),
    ("-m", "++task.points=20,30", "evaluation={grid:9}", "evaluation.points=4,5"),
    ("-m", "index=0,3", "label='${index}',b"),
    ("-m", "seed=1,2", "label='${seed}'"),
])  # fmt: skip
def test_a_cell_is_as_hydra_composes_it(arguments):
    with composing():
        composer = Composer(arguments[1:])
        swept = composer.swept(composer.shared_config())
        cells = composer.cells(swept)
        for cell, overrides in zip(cells, swept, strict=True):
            config = compose("config", overrides, return_hydra_config=True)
            choices = dict(config.hydra.runtime.choices)
            assert cell == planned_run(resolve_config(without_hydra(config), choices), choices, overrides)
    assert len({cell.id for cell in cells}) == len(cells)


def test_a_value_goes_to_the_cells_that_have_its_key():
    mine = ("renderer._target_=tests.user_renderer.Mine", "+renderer.size=3", "label=Mine")
    dist, custom = cells_of("renderer=dist,custom", *mine)
    assert dist.overrides == ["renderer=dist"] and custom.overrides == ["renderer=custom", *mine]
    assert (dist.config["label"], custom.config["label"]) == (None, "Mine")
    cells = cells_of("renderer=dist,dvr", "renderer.alpha=1.2,2", "seed=0,1")
    assert [cell.overrides for cell in cells] == [
        *(["renderer=dist", f"renderer.alpha={alpha}", f"seed={seed}"] for alpha in ("1.2", "2") for seed in (0, 1)),
        *(["renderer=dvr", f"seed={seed}"] for seed in (0, 1)),
    ]
    with pytest.raises(ValueError, match=r"unknown key 'renderer\.alpha'"):
        cells_of("renderer=idr,dvr", "renderer.alpha=1.2,2")


def test_a_sweep_says_which_keys_go_to_some_cells(results):
    result = command("-m", "renderer=dist,dvr", "renderer.alpha=2", "plan=true", f"results_dir={results}")
    assert result.err == "sweep: renderer.alpha goes to 1 of 2 runs, which have this key\n"


def test_a_value_that_cannot_be_set_is_an_error_as_for_a_single_run(results):
    for arguments, words in (
        (("seed=0,1,x",), "seed must be a whole number, not 'x'"),
        (("renderer.steps=3", "renderer.stebs=1,2"), "unknown key 'renderer.stebs'"),
    ):
        result = command("-m", *arguments, "plan=true", f"results_dir={results}")
        assert result.code == 2 and words in result.err and len(result.err.splitlines()) == 1


def test_a_sweep_that_is_stopped_during_planning_says_that_nothing_was_run(results, monkeypatch):
    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(sweep, "check_plan", stopped)
    result = command(*SWEEP, f"results_dir={results}")
    assert result.code == 130 and result.err.endswith("error: stopped by Ctrl-C; nothing was run\n")
    assert not results.exists()


@pytest.mark.usefixtures("interruptible")
def test_an_error_that_a_library_makes_of_ctrl_c_has_the_name_of_ctrl_c(results, monkeypatch):
    def stopped(*_, **__):
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        raise ValueError("unknown key 'ranges.seat_height'")

    monkeypatch.setattr(sweep, "check_plan", stopped)
    result = command(*SWEEP, f"results_dir={results}")
    assert result.code == 130 and result.err.endswith("error: stopped by Ctrl-C; nothing was run\n")


def test_a_single_run_is_planned_too(results):
    arguments = ("scale=smoke", "isolation=off", "threads=1", "renderer=dist", "plan=true", f"results_dir={results}")
    result = command(*arguments)
    assert (result.code, result.err) == (0, "")
    assert "completion, DIST, our default, sofa  time unknown" in result.out and not results.exists()
    write(results, planned(results)[0], 30.0)
    assert "reused" in command(*arguments).out


def run(total=10.0, *, status="ok", renderer="dist", task="completion", scale="smoke", **more):
    return {
        "task": task, "renderer": renderer, "method": "", "status": status, "seconds": {"total": total},
        "config": {"scale": {"name": scale}},
    } | more  # fmt: skip


@pytest.fixture
def times_of(tmp_path, monkeypatch):
    """The times of finished runs that are similar to a planned one, and the number of records read for them."""

    def similar_times(runs: list[dict], **like) -> tuple[list[float], int]:
        folders, read = {}, []
        for number, record in enumerate(runs):
            named = [record["task"], record["renderer"], "sofa", record["method"].replace("/", "_")]
            folders["-".join([*filter(None, named), f"{number:012x}"])] = record
        monkeypatch.setattr(durations_module, "run_folders", lambda _: [tmp_path / name for name in folders])
        monkeypatch.setattr(
            durations_module, "read_run", lambda folder, _: (read.append(folder), (folders[folder.name], ""))[1]
        )
        record = run(**like)
        cells = [PlannedRun("c", [], record["task"], record["renderer"], "sofa", 0, record["config"], record["method"])]
        durations = durations_of_similar_runs(Plan("p", tmp_path, cells), set())[duration_group(record)]
        return [duration.scaled(record["config"]) for duration in durations], len(read)

    return similar_times


def test_similar_runs_have_the_same_task_renderer_and_scale_and_ended_by_themselves(times_of):
    other = [run(1.0, task="pose"), run(1.0, renderer="dvr"), run(1.0, renderer="dist_k_3")]
    unlike = [run(1.0, scale="desk"), run(1.0, method="dist_mask")]
    broken = [run(1.0, status=status) for status in ("crashed", "killed", "oom", "refused", "not_run")]
    odd = [run(float("inf")), run(None), run(0.0), run(1.0, config={"scale": 3}), run(1.0, config={"scale": None})]
    assert times_of([*other, *unlike, *broken, *odd]) == ([], len([*unlike, *broken, *odd]))
    assert times_of([*other, run(2.0), run(3.0, status="timeout")]) == ([2.0, 3.0], 2)
    assert times_of([run(2.0), run(3.0, method="dist/mask")], method="dist/mask") == ([3.0], 1)
    longer = {"scale": {"name": "smoke"}, "task": {"optimiser": {"iterations": 4}}}
    phases = {"total": 2.0, "forward": 1.0, "backward": 0.6}  # the loop of four iterations takes 1.6 of 2 seconds
    assert times_of([run(config=longer, seconds=phases)]) == ([pytest.approx(0.8)], 1)


def test_a_plan_names_the_file_of_a_dataset(tmp_path, capsys):
    cell = PlannedRun("c", [], "ablation", "dist", "module", 0, {"dataset": {"path": "mine/net.pth"}})
    durations_module.show_plan(Plan("p", tmp_path, [cell]), {"c"}, 1)
    assert "ablation, dist, module net.pth  reused" in capsys.readouterr().out


def test_only_some_of_many_similar_runs_are_read(times_of):
    many = [run(1.0, scale="desk")] * 50 + [run(2.0)] * 200
    assert times_of(many) == ([2.0] * durations_module.MAX_SIMILAR_RUNS, 50 + durations_module.MAX_SIMILAR_RUNS)
    assert times_of([run(1.0, scale="desk")] * 900) == ([], durations_module.MAX_RECORDS_READ)


def test_a_sweep_of_priors_has_no_plan_and_a_prior_is_of_the_dataset_in_the_command(tmp_path):
    where = f"results_dir={tmp_path / 'r'}"
    for arguments in (["dataset=sofa,plane"], ["dataset=photos", f"dataset.path={tmp_path}", "prior.of=sofa,plane"]):
        result = command("-m", *arguments, where, main=prior_main)
        assert [Path(line).name.split("-")[0] for line in result.out.splitlines()] == ["sofa", "plane"], result.err
    assert not list((tmp_path / "r").rglob("plan.json"))
    assert "set prior.of=sofa" in command("dataset=photos", f"dataset.path={tmp_path}", where, main=prior_main).err


@pytest.mark.parametrize("main", [prior_main, train_main])
def test_a_training_is_not_planned_and_refuses_what_is_invalid(tmp_path, main):
    for wrong, words in (
        (("plan=true",), "plan=true lists runs"),
        (("dataset=mesh", "dataset.path=none.ply"), "none.ply"),
    ):
        result = command("+method=single_view", "scale=smoke", *wrong, f"results_dir={tmp_path / 'r'}", main=main)
        assert (result.code, result.out) == (2, "") and words in result.err and len(result.err.splitlines()) == 1


@pytest.fixture
def plain(compose_config):
    """A configuration as plain data, from overrides."""
    return lambda *overrides: tiny.plain(compose_config(*SMALL, *overrides))


def test_a_task_on_a_fitted_network_is_refused_without_one(plain):
    for task in (("task=gradients",), ("task=pose", "task.shape=prior")):
        cells = [plain(*task), plain("+experiment=fitted", *task), plain("+experiment=fitted", *task, "index=1")]
        refused = ["fitted to: add +experiment=fitted" in reason for reason in map(refusal_reason, cells)]
        assert refused == [True, False, True]


def test_an_experiment_without_m_says_that_it_is_one_run(tmp_path):
    for options, experiment in (([], "fig7"), ([], "[fitted,gradients]"), (["-m"], "fig7")):
        result = command(*options, f"+experiment={experiment}", "plan=true", *SMALL, f"results_dir={tmp_path}")
        assert result.code == 0 and ("this is one run; with -m" in result.err) is (not options)


def test_a_class_that_raises_another_error_is_left_to_its_run_and_prints_nothing(plain, tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(tmp_path)
    lacks = "renderer Mine lacks capabilities: see renderers/rendering.py"
    is_dict = "capabilities of the renderer Mine must be a Capabilities, not a dict"
    acts = {"raise RuntimeError": "", "raise SystemExit(3)": "", "raise ValueError('no')": "no", "print('made')": lacks}
    acts["self.capabilities = {}"] = is_dict
    for number, (act, words) in enumerate(acts.items()):
        module = f"acting_{number}_{tmp_path.name}"
        (tmp_path / f"{module}.py").write_text(CODE.format(act=act))
        assert refusal_reason(plain("renderer=custom", f"renderer._target_={module}.Mine")) == words
    assert capsys.readouterr().out == ""


def test_a_class_that_ends_its_process_is_left_to_its_run(plain, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / f"ends_{tmp_path.name}.py").write_text("import os\n" + CODE.format(act="os._exit(3)"))
    wrong, ends = plain("renderer.steps=0"), plain("renderer=custom", f"renderer._target_=ends_{tmp_path.name}.Mine")
    assert refusal_reasons([wrong]) == [refusal_reason(wrong)] != [""]
    assert refusal_reasons([wrong, ends]) == ["", ""]


def test_a_folder_of_the_users_may_say_that_an_experiment_is_a_sweep(results, tmp_path):
    (tmp_path / "experiment").mkdir()
    text = "# @package _global_\nhydra: {mode: MULTIRUN, sweeper: {params: {seed: '0,1'}}}\n"
    (tmp_path / "experiment" / "mine.yaml").write_text(text)
    result = command("--config-dir", str(tmp_path), "+experiment=mine", "plan=true", *SMALL, f"results_dir={results}")
    assert (result.code, result.out.splitlines()[-1][:9]) == (0, "2 planned"), result.err


@pytest.fixture
def plan_of(plain, tmp_path):
    """A plan of one cell for each list of overrides."""

    def plan(*cells: tuple[str, ...]) -> Plan:
        planned_cells = []
        for number, overrides in enumerate(cells):
            config = plain(*overrides, "isolation=off")
            planned_cells.append(PlannedRun(f"c-{number}", list(overrides), "completion", "dist", "sofa", 0, config))
        return Plan("p", Path(tmp_path), planned_cells)

    return plan


def test_the_message_on_a_sweep_names_the_invalid_cell(plan_of):
    plan = plan_of(("seed=0", "renderer.steps=9"), ("seed=0", "renderer.steps=0"), ("seed=0", "renderer.steps=-1"))
    with pytest.raises(ValueError, match=r"^cell 2 of 3 \(renderer.steps=0\): steps must be at least 1, not 0: .*"
                       r"; 2 of 3 cells are invalid; nothing was run$"):  # fmt: skip
        check_plan(plan, set(), is_local=True)
    check_plan(plan, {"c-1", "c-2"}, is_local=True)  # finished runs are not checked
    with pytest.raises(ValueError, match=r"^steps must be"):  # all cells are invalid, so none is named
        check_plan(plan_of(("renderer.steps=0", "seed=0"), ("renderer.steps=0", "seed=1")), set(), is_local=True)


def test_a_gpu_is_looked_for_on_the_machine_of_the_runs(plan_of, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    plan = plan_of(("device=cuda",))
    with pytest.raises(ValueError, match="PyTorch sees no GPU"):
        check_plan(plan, set(), is_local=True)
    check_plan(plan, set(), is_local=False)
