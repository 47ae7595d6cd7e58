"""Real runs: the files of a run folder, the consistency of its numbers, and the end of a failed run."""

import json
import shlex
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
import trimesh
from matplotlib.image import imread
from omegaconf import OmegaConf

from bench.config import EvaluationSettings
from bench.evaluate.evaluate import Evaluation
from bench.records.format import number, seconds
from bench.records.record import Record, RunStatus, curve_file
from bench.report.write.html import write_index
from bench.runner import execute
from bench.setup import inputs as inputs_module
from bench.setup import priors as priors_module
from bench.setup.inputs import RunContext, RunInputs
from bench.solve import solve
from bench.solve.optimise import History, OptimiserSettings
from datasets.scene import Scene
from renderers.fields.analytic import sphere
from renderers.rendering import Unsupported
from tests.looped import each
from tests.report.page_data import Page
from tests.runner.driving import CommandResult, by_program
from tests.solve.test_optimise import POINTS, Toy
from tests.tiny import ball_prior, curve_of, inputs_from

TINY = (
    "scale=smoke", "task.optimiser.iterations=6", "view.resolution=16", "task.points=20",
    "evaluation.grid=32", "evaluation.points=500", "evaluation.picture=24",
)  # fmt: skip
COMMAND = ("task=completion", "renderer=dist", "scale=smoke")
ITERATIONS, PIXELS = 20, 32
SURFACE = {"chamfer_l2", "chamfer_l1", "chamfer_gt_to_pred", "accuracy", "completeness", "fscore", "normal_consistency"}
IMAGE = {"depth_mae", "depth_bias", "mask_iou"}
METRICS = SURFACE | IMAGE | {f"own_{name}" for name in IMAGE}
PICTURES = {"summary", "curve"}


@dataclass(frozen=True)
class Finished:
    """A run that has ended: its command's outputs, its folder, record and curve."""

    outcome: CommandResult
    results: Path
    folder: Path
    record: dict
    curve: list[dict]


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Finished:
    """A run by a separate program, in a folder whose name has spaces, brackets and other letters."""
    results = tmp_path_factory.mktemp("results") / "of [today] ü"
    outcome = by_program("-m", "bench", *COMMAND, f'results_dir="{results}"', COLUMNS="80")
    assert outcome.out, outcome.err
    folder = Path(outcome.out.splitlines()[-1])
    record = json.loads((folder / "record.json").read_text(encoding="utf-8"))
    return Finished(outcome, results, folder, record, curve_of(folder))


def test_it_ends_well_and_its_last_line_is_its_folder(finished):
    record, out = finished.record, finished.outcome.out
    assert (finished.outcome.code, finished.outcome.err) == (0, "")
    assert (record["status"], record["reason"], record["id"]) == ("ok", "", finished.folder.name)
    assert finished.folder.parent == finished.results / "runs"
    assert not [note for note in record["notes"] if not note.startswith("loaded machine")]
    assert f"page and tables: python -m bench.report results_dir='{finished.results}'" in out.splitlines()
    assert "Chamfer" in out and record["overrides"] == [*COMMAND, f'results_dir="{finished.results}"']
    write_index(finished.results)
    page = Page(finished.results)
    assert page.folders == [finished.folder.name] and page.text("thumb") == ["summary.png"]
    assert page.run(finished.folder.name)["files"]["mesh.ply"] == f"runs/{finished.folder.name}/mesh.ply"
    assert page.read("mesh", page.runs["key"][0])["shown"][0] > 0


def test_its_log_has_the_command_the_machine_and_the_outcome(finished):
    record, log = finished.record, (finished.folder / "log.txt").read_text(encoding="utf-8")
    command, *lines = log[log.index("command: ") :].splitlines()
    assert shlex.split(command)[1:] == ["python", "-m", "bench", *record["overrides"]]
    assert lines[0].startswith(f"machine: {record['environment']['cpu']}; device {record['environment']['device']}; ")
    before, after = (number(record[name]["chamfer_l2"], 1000) for name in ("metrics_start", "metrics"))
    assert f"Chamfer (x1000): {before} before, {after} after" in lines
    assert f"ended {record['ended']}, {seconds(record['seconds']['total'])} in all" in log and "in the loop" in log
    assert [line for line in lines if line.startswith("note: ")] == [f"note: {note}" for note in record["notes"]]
    assert lines[-1] == "status: ok"


def test_the_folder_has_the_files_that_scripts_rely_on(finished):
    names = {path.name for path in finished.folder.iterdir()}
    assert {"record.json", "curve.jsonl", "config.yaml", "log.txt", "mesh.ply"} <= names
    assert names >= {f"{name}.png" for name in PICTURES}
    assert not [name for name in names if name.startswith(".")]
    for path in finished.folder.glob("*.png"):
        image = imread(path)
        assert min(image.shape[:2]) > 100 and image[..., :3].std() > 0.02, path.name
    mesh = trimesh.load_mesh(finished.folder / "mesh.ply")
    assert mesh.is_watertight and mesh.volume > 0.02
    assert np.linalg.norm(mesh.vertices, axis=1).max() < 1.01


def test_the_record_has_the_settings_and_the_machine(finished):
    record = finished.record
    written = OmegaConf.to_container(OmegaConf.load(finished.folder / "config.yaml"))
    assert written == record["config"] and written["results_dir"] == str(finished.results)
    assert written["task"]["optimiser"]["iterations"] == ITERATIONS and record["schema"] == 1
    assert (record["task"], record["renderer"], record["dataset"]) == ("completion", "dist", "sofa")
    assert (record["seed"], record["scene"], record["reused"]) == (0, "sofa test 0", False)
    environment = record["environment"]
    assert environment["torch"] == torch.__version__
    assert environment["threads"] >= 1 and environment["gemm_peak_flops"] > 1e8
    assert {"commit", "dirty", "cpu", "cores", "device", "platform"} <= set(environment)


def test_every_metric_has_an_initial_value_a_final_value_and_a_definition(finished):
    record = finished.record
    assert set(record["metrics"]) == set(record["metrics_start"]) == METRICS
    costs = {f"evaluations.{name}" for name in ("value", "gradient", "cost", "per_ray", "work_over_bound")}
    assert set(record["definitions"]) >= METRICS | costs | {f"seconds.{name}" for name in record["seconds"]}
    assert all(len(text) > 20 for text in record["definitions"].values())
    assert all(isinstance(value, float) and np.isfinite(value) for value in record["metrics"].values())


def test_metrics_agree_with_each_other_and_are_better_than_at_the_start(finished):
    before, after = finished.record["metrics_start"], finished.record["metrics"]
    assert all(after[name] < 0.5 * before[name] for name in ("chamfer_l2", "depth_mae"))
    assert after["mask_iou"] > before["mask_iou"]
    for metrics in (before, after):
        assert metrics["chamfer_l1"] == pytest.approx((metrics["accuracy"] + metrics["completeness"]) / 2)
        assert metrics["chamfer_gt_to_pred"] < metrics["chamfer_l2"]
        assert metrics["accuracy"] ** 2 + metrics["completeness"] ** 2 <= metrics["chamfer_l2"]  # Jensen
        assert all(0 <= metrics[name] <= 1 for name in ("fscore", "normal_consistency", "mask_iou"))


def test_the_curve_has_a_line_an_iteration_and_falls(finished):
    assert [line["iteration"] for line in finished.curve] == list(range(ITERATIONS))
    for line in finished.curve:
        assert line["total"] == pytest.approx(line["depth"] + line["silhouette"] + line["code"], rel=1e-4)
    assert finished.curve[-1]["total"] < finished.curve[0]["total"] and finished.curve[0]["code"] == 0.0


def test_evaluations_add_up(finished):
    evaluations, last = finished.record["evaluations"], finished.curve[-1]
    assert (evaluations["rays_per_iteration"], evaluations["iterations"]) == (PIXELS**2, ITERATIONS)
    assert evaluations["value"] == last["value_evaluations"] > 0
    assert evaluations["gradient"] == last["gradient_evaluations"] > 0
    assert evaluations["per_ray"] == pytest.approx(evaluations["value"] / PIXELS**2 / ITERATIONS)
    assert evaluations["per_ray"] < 10
    assert evaluations["cost"] == evaluations["value"] + 2 * evaluations["gradient"] == last["cost"]
    hits = (evaluations["value"] + evaluations["gradient"]) / 2 / evaluations["work_over_bound"]
    assert hits == pytest.approx(round(hits))  # a value and a gradient of the network take equally many operations
    assert 0 < hits < evaluations["rays_per_iteration"] * ITERATIONS
    width = 128  # the shipped network: 4 layers with a skip; the code is folded into the biases
    weights = 3 * width + width * width + (width + 3) * width + width * width + width
    assert finished.record["flops"] == 2 * weights * (evaluations["value"] + evaluations["gradient"])


def test_seconds_add_up(finished):
    seconds, last = finished.record["seconds"], finished.curve[-1]
    assert set(seconds) == {"warmup", "forward", "backward", "evaluation", "total"}
    assert all(value > 0 for value in seconds.values())
    assert sum(seconds.values()) - seconds["total"] <= seconds["total"]
    loop = seconds["forward"] + seconds["backward"]
    assert last["seconds"] == pytest.approx(loop)
    peak = finished.record["environment"]["gemm_peak_flops"]
    assert finished.record["gemm_fraction"] == pytest.approx(finished.record["flops"] / loop / peak)


@pytest.fixture
def bench(isolated):
    """Runs a command line and its runs in this process; gives its exit status, outputs and run folder."""

    def run(*arguments):
        code, out, err = isolated(*arguments, "isolation=off")
        return code, out, err, Path(out.splitlines()[-1])

    return run


@pytest.mark.parametrize(("error", "status", "code"), [
    (RuntimeError("a bug\nover two lines"), "crashed", 1), (MemoryError(), "oom", 1),
    (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried"), "oom", 1),
    (Unsupported("Fake has no gradient"), "unsupported", 1), (KeyboardInterrupt(), "killed", 130),
])  # fmt: skip
def test_the_error_that_ends_a_run_is_in_its_record(bench, monkeypatch, tmp_path, error, status, code):
    meanwhile = []

    def fail(config, progress):
        meanwhile.extend(json.loads(path.read_text()) for path in (tmp_path / "r").glob("runs/*/record.json"))
        raise error

    monkeypatch.setattr(execute, "prepare_run", fail)
    exit_code, out, err, folder = bench()
    record = json.loads((folder / "record.json").read_text())
    assert (exit_code, record["status"]) == (code, status) and record["seconds"]["total"] > 0
    assert [before["status"] for before in meanwhile] == ["killed"]
    assert record["reason"] and "\n" not in record["reason"] and record["reason"] in err
    assert "Traceback" not in out + err and len(err.strip().splitlines()) == 1
    log = (folder / "log.txt").read_text()
    assert status in log and ("Traceback" in log) is isinstance(error, RuntimeError)


def test_each_line_of_the_curve_is_json_and_written_at_once(tmp_path):
    with curve_file(tmp_path) as write:
        for number, total in enumerate((1.0, float("inf"), float("nan")), 1):
            write({"total": total})
            lines = (tmp_path / "curve.jsonl").read_text().splitlines()
            assert len(lines) == number
    for line in lines:
        json.loads(line, parse_constant=pytest.fail)


@pytest.mark.parametrize(
    ("interval", "iterations", "checkpoints"),
    [(None, 5, []), (3, 7, [0, 3, 6]), ("doubling", 9, [0, 1, 2, 4, 8]), ("doubling", 1, [0])],
)
def test_checkpoints_have_the_chamfer_distance_and_cost_no_runtime(clock, tmp_path, interval, iterations, checkpoints):
    class Slow(Toy):
        observed = torch.ones(1, 1, dtype=torch.bool)

        def loss(self, iteration):
            clock.sleep(1.0)
            return super().loss(iteration)

        def field(self):
            return sphere(self.radius.detach())

        def objective(self):
            return None

    toy = Slow()
    radii = []

    def see(iteration):
        clock.sleep(100.0)
        radii.append(toy.radius.item())
        return {"chamfer_l2": radii[-1]}

    stage = Mock(spec=RunInputs, device=torch.device("cpu"), evaluation=EvaluationSettings(every=interval))
    record = Record("id", "task", "renderer", "dataset", 0, {}, seconds={"evaluation": 1.0})
    record.environment = {"gemm_peak_flops": 1e10}
    settings = OptimiserSettings(iterations, 0.05, "constant")
    history = solve.run_optimisation(toy, settings, RunContext(stage, tmp_path, record, lambda *_: None), see)
    curve = curve_of(tmp_path)
    assert [line["iteration"] for line in curve] == list(range(iterations))
    assert [line["iteration"] for line in curve if "chamfer_l2" in line] == checkpoints
    if interval is not None:  # for the same parameters as the loss of the line
        assert [line["chamfer_l2"] for line in curve if "chamfer_l2" in line] == radii
        assert [(3 - r) ** 2 for r in radii] == pytest.approx([curve[i]["total"] for i in checkpoints])
    assert sorted(radii) == radii and history.curve == curve
    assert curve[-1]["seconds"] == history.seconds["forward"] + history.seconds["backward"]
    assert history.seconds == pytest.approx({"warmup": 1.0, "forward": iterations, "backward": 0.0}, abs=0.01)
    assert record.seconds["evaluation"] - 1.0 == pytest.approx(100.0 * len(checkpoints), abs=0.01)
    assert curve[-1]["value_evaluations"] == iterations * POINTS


def test_a_run_with_checkpoints_ends_as_one_without(bench):
    folders = [
        bench("renderer=dist", *TINY, "evaluation.picture=null", f"evaluation.every={interval}")[3]
        for interval in ("null", 4)
    ]
    plain, checked = (json.loads((folder / "record.json").read_text()) for folder in folders)
    curve = curve_of(folders[1])
    assert [line["iteration"] for line in curve if "chamfer_l2" in line] == [0, 4, 5]
    assert curve[0]["chamfer_l2"] == checked["metrics_start"]["chamfer_l2"]
    assert checked["metrics"]["chamfer_l2"] == plain["metrics"]["chamfer_l2"]
    assert checked["evaluations"] == plain["evaluations"]


def test_random_numbers_of_a_run_do_not_depend_on_whether_its_prior_was_cached(compose_config, monkeypatch):
    """DVR draws points, and the training of a prior also draws random numbers."""
    prior, drawn = ball_prior(), []
    monkeypatch.setattr(inputs_module, "make_scene", lambda *_, **__: Mock(spec=Scene))
    for used in (0, 1000):
        monkeypatch.setattr(priors_module, "prior_for", lambda *_, used=used: (torch.rand(used), prior)[1])
        stage = inputs_from(compose_config("threads=1", "seed=3"))
        stage.configure_process()
        assert stage.prior is stage.prior is prior  # made once
        drawn.append(torch.rand(4).tolist())
    assert drawn[0] == drawn[1]
    inputs_from(compose_config("threads=1", "seed=4")).configure_process()
    assert torch.rand(4).tolist() != drawn[0]


@each("ended, losses, mesh, status", [
    ((), [2.0, 1.0], True, RunStatus.OK), ((), [2.0], True, RunStatus.OK),
    ((), [1.0, 2.0], True, RunStatus.NOT_REACHED), ((), [2.0, 1.0], False, RunStatus.EMPTY),
    ((RunStatus.NAN, "why"), [2.0, float("nan")], False, RunStatus.NAN),
    ((RunStatus.DIVERGED, "why"), [1.0, 200.0], True, RunStatus.DIVERGED),
])  # fmt: skip
def test_a_run_is_judged_by_its_loss_and_surface(ended, losses, mesh, status):
    history = History(*ended, curve=[{"total": loss} for loss in losses], first_loss=losses[0])
    after = Evaluation({}, failure=None if mesh else (RunStatus.EMPTY, "nothing is there"))
    result, reason = solve.failure_of(history, after) or (RunStatus.OK, "")
    assert result is status and bool(reason) is (status is not RunStatus.OK)


def test_a_run_whose_last_objective_is_not_a_number_is_not_ok():
    history = History(curve=[{"total": 2.0}, {"total": 1.0}], first_loss=2.0, objectives=[1.0, float("nan")])
    assert solve.failure_of(history, Evaluation({})) == (RunStatus.NAN, "the objective is not a number at the end")
