"""Real runs: what a run folder holds, that its numbers agree with each other, and what becomes of a run that fails."""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
import trimesh
from hydra.core.global_hydra import GlobalHydra
from matplotlib.image import imread
from omegaconf import OmegaConf

from bench.__main__ import main
from bench.config import EvaluationSettings
from bench.evaluate.evaluate import Evaluation
from bench.records.read import read_records
from bench.records.record import Record, RunStatus
from bench.report.write.html import write_index
from bench.run import cell as cell_module
from bench.run import execute
from bench.setup.inputs import RunContext, RunInputs
from bench.solve import solve
from bench.solve.optimise import History
from bench.solve.problem import OptimiserSettings, Unsupported
from datasets.scene import Scene
from tests.report.page_data import Page
from tests.run.driving import PATIENCE, ROOT, Outcome, command
from tests.solve.test_optimise import POINTS, Toy
from tests.tiny import ball_prior, cell_from, silent

TINY = (
    "scale=smoke", "task.optimiser.iterations=6", "view.resolution=16", "task.points=20",
    "evaluation.grid=32", "evaluation.points=500", "evaluation.picture=24",
)  # fmt: skip
COMMANDS = {
    "dist": ("task=completion", "renderer=dist", "scale=smoke"),
    "naive": ("task=completion", "renderer=naive", *TINY, "task.optimiser.iterations=12"),
}
SURFACE = {"chamfer_l2", "chamfer_l1", "chamfer_gt_to_pred", "accuracy", "completeness", "fscore", "normal_consistency"}
IMAGE = {"depth_mae", "depth_error_capped", "mask_iou"}
METRICS = SURFACE | IMAGE | {f"own_{name}" for name in IMAGE}
PICTURES = {"summary", "input", "depth", "normals", "silhouette", "curve"}
SETTINGS = {"dist": (20, 32), "naive": (12, 16)}  # iterations, image width in pixels


@dataclass(frozen=True)
class Finished:
    """A run that has ended: its command's renderer and outputs, its folder and what the folder says."""

    renderer: str
    stdout: str
    stderr: str
    code: int
    results: Path
    folder: Path
    record: dict
    curve: list[dict]


@pytest.fixture(scope="module", params=COMMANDS)
def finished(request, tmp_path_factory) -> Finished:
    """One run of each command, with results where spaces, brackets and other letters are; DIST's is a program."""
    results = tmp_path_factory.mktemp("results") / "of [today] ü"
    arguments = (*COMMANDS[request.param], f'results_dir="{results}"')
    if request.param == "dist":
        program, columns = [sys.executable, "-m", "bench", *arguments], {**os.environ, "COLUMNS": "80"}
        options = {"capture_output": True, "text": True, "cwd": ROOT, "timeout": 4 * PATIENCE, "env": columns}
        done = subprocess.run(program, check=False, **options)
        outcome = Outcome(done.returncode, done.stdout, done.stderr)
    else:
        outcome = command(*arguments)
    assert outcome.out, outcome.err
    folder = Path(outcome.out.splitlines()[-1])
    record = json.loads((folder / "record.json").read_text(encoding="utf-8"))
    lines = (folder / "curve.jsonl").read_text(encoding="utf-8").splitlines()
    return Finished(
        renderer=request.param,
        stdout=outcome.out,
        stderr=outcome.err,
        code=outcome.code,
        results=results,
        folder=folder,
        record=record,
        curve=[json.loads(line) for line in lines],
    )


def test_it_ends_well_and_its_last_line_is_its_folder(finished):
    assert finished.code == 0
    assert finished.record["status"] == "ok"
    assert finished.record["reason"] == ""
    assert finished.folder.parent == finished.results / "runs"
    assert finished.record["id"] == finished.folder.name
    assert "Traceback" not in finished.stdout + finished.stderr
    assert finished.stderr == ""
    assert not [note for note in finished.record["notes"] if not note.startswith("loaded machine")]


def test_its_summary_has_its_metrics_and_the_command_for_the_page_which_it_leaves_alone(finished):
    assert f"page and tables: python -m bench.report results_dir='{finished.results}'" in finished.stdout.splitlines()
    assert not (finished.results / "index.html").exists()
    assert "Chamfer" in finished.stdout


def test_the_folder_holds_what_others_script_against(finished):
    names = {path.name for path in finished.folder.iterdir()}
    assert {"record.json", "curve.jsonl", "config.yaml", "log.txt", "mesh.ply"} <= names
    assert names >= {f"{name}.png" for name in PICTURES}
    assert not [name for name in names if name.startswith(".")]
    assert "ok" in (finished.folder / "log.txt").read_text()


def test_the_pictures_show_something(finished):
    for path in finished.folder.glob("*.png"):
        image = imread(path)
        assert min(image.shape[:2]) > 100
        assert image[..., :3].std() > 0.02, path.name


def test_the_mesh_is_one_that_others_read(finished):
    mesh = trimesh.load_mesh(finished.folder / "mesh.ply")
    assert mesh.is_watertight
    assert mesh.volume > 0.02
    assert np.linalg.norm(mesh.vertices, axis=1).max() < 1.01


def test_the_configuration_is_whole_and_that_of_the_record(finished):
    config = OmegaConf.load(finished.folder / "config.yaml")
    written = OmegaConf.to_container(config)
    written["renderer"].pop("_rows_", None)  # in which tables it has a row is not of the run
    assert written == finished.record["config"]
    assert config.results_dir == str(finished.results)
    assert config.renderer._target_ == {"dist": "renderers.DIST", "naive": "renderers.Naive"}[finished.renderer]
    assert config.task.optimiser.iterations == SETTINGS[finished.renderer][0]


def test_the_record_says_what_was_run_on_what(finished):
    record = finished.record
    assert record["schema"] == 1
    assert (record["task"], record["renderer"], record["dataset"]) == ("completion", finished.renderer, "sofa")
    assert (record["seed"], record["scene"], record["reused"]) == (0, "sofa test 0", False)
    environment = record["environment"]
    assert environment["torch"] == torch.__version__
    assert environment["threads"] >= 1
    assert environment["gemm_peak_flops"] > 1e8
    assert {"commit", "dirty", "cpu", "cores", "device", "platform"} <= set(environment)


def test_every_metric_is_there_before_and_after_with_its_definition(finished):
    record = finished.record
    assert set(record["metrics"]) == set(record["metrics_start"]) == METRICS
    assert set(record["definitions"]) >= METRICS
    costs = {f"evaluations.{name}" for name in ("value", "gradient", "per_ray", "work_over_bound")}
    costs |= {f"seconds.{name}" for name in record["seconds"]}
    assert set(record["definitions"]) >= costs
    assert all(len(text) > 20 for text in record["definitions"].values())
    assert all(isinstance(value, float) and np.isfinite(value) for value in record["metrics"].values())


def test_the_shape_is_nearer_to_the_truth_than_the_mean_shape(finished):
    before, after = finished.record["metrics_start"], finished.record["metrics"]
    assert after["chamfer_l2"] < before["chamfer_l2"]
    assert after["mask_iou"] > before["mask_iou"]
    if finished.renderer == "dist":
        assert after["chamfer_l2"] < 0.5 * before["chamfer_l2"]
        assert after["depth_mae"] < 0.5 * before["depth_mae"]


def test_metrics_agree_with_each_other(finished):
    for metrics in (finished.record["metrics"], finished.record["metrics_start"]):
        assert metrics["chamfer_l1"] == pytest.approx((metrics["accuracy"] + metrics["completeness"]) / 2)
        assert metrics["chamfer_gt_to_pred"] < metrics["chamfer_l2"]
        assert metrics["accuracy"] ** 2 + metrics["completeness"] ** 2 <= metrics["chamfer_l2"]  # Jensen
        assert all(0 <= metrics[name] <= 1 for name in ("fscore", "normal_consistency", "mask_iou"))


def test_the_curve_has_a_line_an_iteration_and_falls(finished):
    iterations, _ = SETTINGS[finished.renderer]
    assert [line["iteration"] for line in finished.curve] == list(range(iterations))
    for line in finished.curve:
        assert line["total"] == pytest.approx(line["depth"] + line["silhouette"] + line["code"], rel=1e-4)
    assert finished.curve[-1]["total"] < finished.curve[0]["total"]
    assert finished.curve[0]["code"] == 0.0


def test_evaluations_add_up(finished):
    iterations, pixels = SETTINGS[finished.renderer]
    evaluations, last = finished.record["evaluations"], finished.curve[-1]
    assert evaluations["rays_per_iteration"] == pixels**2
    assert evaluations["iterations"] == iterations
    assert evaluations["value"] == last["value_evaluations"] > 0
    assert evaluations["gradient"] == last["gradient_evaluations"] > 0
    assert evaluations["per_ray"] == pytest.approx(evaluations["value"] / pixels**2 / iterations)
    rays = evaluations["rays_per_iteration"] * iterations
    hits = (evaluations["value"] + evaluations["gradient"]) / 2 / evaluations["work_over_bound"]
    assert hits == pytest.approx(round(hits))  # a value and a gradient of the network take as many operations
    assert 0 < hits < rays
    width, inputs = 128, 67  # the shipped network: 4 layers with a skip; the code is folded into the biases
    weights = 3 * width + width * width + (width + 3) * width + width * width + width
    assert inputs == 64 + 3
    assert finished.record["flops"] == 2 * weights * (evaluations["value"] + evaluations["gradient"])


def test_naive_asks_every_ray_that_meets_the_sphere_at_every_step(finished):
    evaluations = finished.record["evaluations"]
    if finished.renderer == "naive":
        assert evaluations["value"] % (50 * evaluations["iterations"]) == 0
        assert evaluations["per_ray"] > 20
    else:
        assert evaluations["per_ray"] < 10
    # Steps after a ray has ended, and rays whose loss is 0, carry no gradient.
    assert evaluations["iterations"] <= evaluations["gradient"] < evaluations["value"]


def test_seconds_add_up(finished):
    seconds, last = finished.record["seconds"], finished.curve[-1]
    assert set(seconds) == {"warmup", "forward", "backward", "evaluation", "total"}
    assert all(value > 0 for value in seconds.values())
    assert sum(seconds.values()) - seconds["total"] <= seconds["total"]
    loop = seconds["forward"] + seconds["backward"]
    assert last["seconds"] == pytest.approx(loop)
    peak = finished.record["environment"]["gemm_peak_flops"]
    assert finished.record["gemm_fraction"] == pytest.approx(finished.record["flops"] / loop / peak)


def test_the_record_has_what_the_command_line_set(finished):
    assert finished.record["overrides"] == [*COMMANDS[finished.renderer], f'results_dir="{finished.results}"']


def test_the_report_has_the_run(finished):
    write_index(finished.results)
    page = Page(finished.results)
    assert page.folders == [finished.folder.name] and page.text("thumb") == ["summary.png"]
    assert page.run(finished.folder.name)["files"]["mesh.ply"] == f"runs/{finished.folder.name}/mesh.ply"
    assert page.read("mesh", page.runs["key"][0])["shown"][0] > 0
    (record,), problems = read_records(finished.results)
    assert problems == []
    assert record["metrics"] == finished.record["metrics"]


@pytest.fixture
def bench(monkeypatch, capsys, tmp_path):
    """A command line in this process: its exit status, its outputs, and its run folder."""
    threads = torch.get_num_threads()
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")  # so that it is put back

    def run(*arguments):
        GlobalHydra.instance().clear()
        monkeypatch.setattr(sys, "argv", ["bench", *arguments, "isolation=off", f"results_dir={tmp_path / 'results'}"])
        code = main()
        out, err = capsys.readouterr()
        return code, out, err, Path(out.splitlines()[-1] if out else tmp_path)

    yield run
    torch.set_num_threads(threads)


def test_the_same_command_run_again_gives_the_same_numbers_and_sets_the_first_aside(bench, tmp_path):
    command = ("renderer=dist", *TINY, "evaluation.picture=null", "threads=1", "dataset=table", "rerun=all")
    folders = [bench(*command)[3] for _ in range(2)]
    assert folders[0] == folders[1]
    folders[0] = next((tmp_path / "results" / "earlier").iterdir())
    first, second = (json.loads((folder / "record.json").read_text()) for folder in folders)
    assert first["scene"] == "table test 0"
    assert first["environment"]["threads"] == 1
    for part in ("metrics", "metrics_start", "evaluations", "flops", "config", "status"):
        assert first[part] == second[part], part
    lines = [(folder / "curve.jsonl").read_text().splitlines() for folder in folders]
    curves = [[json.loads(line)["total"] for line in curve] for curve in lines]
    assert curves[0] == curves[1]


@pytest.mark.parametrize(
    ("error", "status", "code"),
    [
        (RuntimeError("a bug\nover two lines"), "crashed", 1),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried"), "oom", 1),
        (MemoryError(), "oom", 1),
        (Unsupported("Fake has no gradient"), "unsupported", 1),
        (KeyboardInterrupt(), "killed", 130),
    ],
)
def test_whatever_ends_a_run_stands_in_its_record(bench, monkeypatch, tmp_path, error, status, code):
    meanwhile = []

    def fail(config):
        meanwhile.extend(json.loads(path.read_text()) for path in (tmp_path / "results").glob("runs/*/record.json"))
        raise error

    monkeypatch.setattr(execute, "cell_of", fail)
    found, out, err, folder = bench()
    record = json.loads((folder / "record.json").read_text())
    assert found == code
    assert [before["status"] for before in meanwhile] == ["killed"]
    assert record["status"] == status
    assert record["reason"]
    assert "\n" not in record["reason"]
    assert record["seconds"]["total"] > 0
    assert "Traceback" not in out + err
    assert len(err.strip().splitlines()) == 1
    assert record["reason"] in err
    assert status in (folder / "log.txt").read_text()
    assert ("Traceback" in (folder / "log.txt").read_text()) is isinstance(error, RuntimeError)


def blank_record() -> Record:
    record = Record("id", "task", "renderer", "dataset", 0, {})
    record.environment = {"gemm_peak_flops": 1e10}
    return record


@pytest.fixture
def curve_after(tmp_path, monkeypatch):
    """What curve.jsonl holds after each of some totals, with the loop left out."""

    def write(*totals):
        seen = []

        def optimise(problem, settings, device, *, history, on_step):
            for iteration, total in enumerate(totals):
                on_step({"iteration": iteration, "total": total})
                history.seconds |= {"forward": 1.0, "backward": 1.0}
                seen.append((tmp_path / "curve.jsonl").read_text())

        monkeypatch.setattr(solve, "optimise", optimise)
        stage = Mock(spec=RunInputs, device=None, evaluation=EvaluationSettings(every=None))
        cell = RunContext(stage, tmp_path, blank_record(), lambda *_: None)
        solve.descend(Toy(), OptimiserSettings(len(totals), 0.1, "constant"), cell, lambda _: {})
        return seen

    return write


def test_each_line_of_the_curve_is_on_the_disk_as_it_comes(curve_after):
    assert [text.count("\n") for text in curve_after(3.0, 2.0, 1.0)] == [1, 2, 3]


def test_the_curve_is_json_whatever_the_loss(curve_after):
    text = curve_after(1.0, float("inf"), float("nan"))[-1]
    for line in text.splitlines():
        json.loads(line, parse_constant=pytest.fail)


@pytest.mark.parametrize(
    ("every", "iterations", "looks"),
    [
        (None, 5, []),
        (1, 3, [0, 1, 2]),
        (3, 6, [0, 3, 5]),
        (3, 7, [0, 3, 6]),
        (9, 4, [0, 3]),
        ("doubling", 6, [0, 1, 2, 4, 5]),
        ("doubling", 9, [0, 1, 2, 4, 8]),
        ("doubling", 1, [0]),
    ],
)
def test_the_chamfer_distance_is_looked_at_every_so_often_and_off_the_clock(clock, tmp_path, every, iterations, looks):
    class Slow(Toy):
        def loss(self, iteration):
            clock.sleep(1.0)
            return super().loss(iteration)

    toy = Slow()
    radii = []

    def see(iteration):
        clock.sleep(100.0)
        radii.append(toy.radius.item())
        return {"chamfer_l2": radii[-1]}

    stage = Mock(spec=RunInputs, device=torch.device("cpu"), evaluation=EvaluationSettings(every=every))
    record = blank_record()
    record.seconds["evaluation"] = 1.0
    settings = OptimiserSettings(iterations, 0.05, "constant")
    history = solve.descend(toy, settings, RunContext(stage, tmp_path, record, lambda *_: None), see)
    curve = [json.loads(line) for line in (tmp_path / "curve.jsonl").read_text().splitlines()]
    assert [line["iteration"] for line in curve] == list(range(iterations))
    assert [line["iteration"] for line in curve if "chamfer_l2" in line] == looks
    if every is not None:  # of the parameters that the line's loss is of
        assert [line["chamfer_l2"] for line in curve if "chamfer_l2" in line] == radii
        assert [(3 - r) ** 2 for r in radii] == pytest.approx([curve[i]["total"] for i in looks])
    assert sorted(radii) == radii
    assert history.curve == curve
    assert curve[-1]["seconds"] == history.seconds["forward"] + history.seconds["backward"]
    assert history.seconds == pytest.approx({"warmup": 1.0, "forward": iterations, "backward": 0.0}, abs=0.01)
    assert record.seconds["evaluation"] - 1.0 == pytest.approx(100.0 * len(looks), abs=0.01)
    assert curve[-1]["value_evaluations"] == iterations * POINTS


def test_a_run_that_looks_on_the_way_ends_as_one_that_does_not(bench):
    folders = [
        bench("renderer=dist", *TINY, "evaluation.picture=null", f"evaluation.every={every}")[3]
        for every in ("null", 4)
    ]
    plain, looked = (json.loads((folder / "record.json").read_text()) for folder in folders)
    curve = [json.loads(line) for line in (folders[1] / "curve.jsonl").read_text().splitlines()]
    assert [line["iteration"] for line in curve if "chamfer_l2" in line] == [0, 4, 5]
    assert curve[0]["chamfer_l2"] == looked["metrics_start"]["chamfer_l2"]
    assert looked["metrics"]["chamfer_l2"] == plain["metrics"]["chamfer_l2"]
    assert looked["evaluations"] == plain["evaluations"]


def test_what_is_drawn_in_a_run_does_not_depend_on_whether_its_prior_was_there(compose_config, monkeypatch):
    """DVR draws points: a prior that is trained first uses up random numbers of its own."""
    prior, drawn = ball_prior(), []
    monkeypatch.setattr(cell_module, "make_scene", lambda *_, **__: Mock(spec=Scene))
    for used in (0, 1000):
        monkeypatch.setattr(cell_module, "prior_for", lambda *_, used=used: (torch.rand(used), prior)[1])
        stage = cell_from(compose_config("threads=1", "seed=3")).start(silent)
        assert stage.prior is stage.prior is prior  # made once
        drawn.append(torch.rand(4).tolist())
    assert drawn[0] == drawn[1]
    cell_from(compose_config("threads=1", "seed=4")).start(silent)
    assert torch.rand(4).tolist() != drawn[0]


def test_a_task_that_is_none_is_told(bench, monkeypatch):
    build = cell_module.build
    none = Mock(spec=["problem"])
    monkeypatch.setattr(
        cell_module, "build", lambda node, name, *more: none if name == "task" else build(node, name, *more)
    )
    code, out, err, _ = bench()
    assert (code, out) == (2, "")
    assert "lacks execute: see bench/tasks/task.py" in err


@pytest.mark.parametrize(
    ("history", "mesh", "status"),
    [
        (History(curve=[{"total": 2.0}, {"total": 1.0}]), True, RunStatus.OK),
        (History(curve=[{"total": 2.0}]), True, RunStatus.OK),
        (History(curve=[{"total": 1.0}, {"total": 2.0}]), True, RunStatus.NOT_REACHED),
        (History(curve=[{"total": 2.0}, {"total": 1.0}]), False, RunStatus.EMPTY),
        (History(RunStatus.NAN, "why", curve=[{"total": 2.0}, {"total": float("nan")}]), False, RunStatus.NAN),
        (History(RunStatus.DIVERGED, "why", curve=[{"total": 1.0}, {"total": 200.0}]), True, RunStatus.DIVERGED),
    ],
)
def test_a_run_is_judged_by_its_own_loss_and_surface(history, mesh, status):
    after = Evaluation({}, failure=None if mesh else (RunStatus.EMPTY, "nothing is there"))
    found, reason = solve.failure_of(history, after) or (RunStatus.OK, "")
    assert found is status
    assert bool(reason) is (status is not RunStatus.OK)
