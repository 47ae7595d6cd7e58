"""How much model a shape needs, end to end; and tasks that take any field in the place of a prior's."""

import re
from dataclasses import replace

import numpy as np
import pytest

from bench.evaluate.evaluate import Evaluation
from bench.records.record import Record, RunStatus
from bench.runner.execute import execute
from bench.runner.summary import print_run_summary
from bench.tasks.capacity.candidates import candidate
from bench.tasks.capacity.field import failure_of
from bench.tasks.capacity.growth import grow
from bench.tasks.capacity.held_out import HeldOutError
from bench.tasks.capacity.model import Evidence, Size
from bench.tasks.capacity.study import CheckSettings, shares
from bench.tasks.capacity.task import Capacity, savings
from renderers.silhouette import Own
from tests.tasks.capacity.test_models import GROWTH, fitter_of
from tests.tiny import curve_of, plain

TINY = (
    "scale=smoke", "view.resolution=16", "evaluation.picture=null", "evaluation.grid=24", "device=cpu",
    "models.fit.iterations=8", "models.fit.warm_iterations=40", "models.fit.warm_points=128", "models.views.fitted=4",
    "models.views.held_out=3", "models.views.rays=64", "prior.shapes=1",
)  # fmt: skip

PAPERS = candidate("network_8x512")
BETTER = ("task.optimiser.iterations=20", "models.candidates=[sphere,box,union_2]", "models.fit.warm_iterations=120")


def run(folder, compose_config, *overrides: str) -> Record:
    """The record of a run in this process, with its files in its folder."""
    config = compose_config(*TINY, *overrides, f"results_dir={folder}")
    record = Record("id", "task", "dist", config.dataset.name, 0, plain(config))
    record.folder.mkdir(parents=True)
    execute(record, lambda message: None)
    return record


def test_steps_that_cannot_reach_pixel_precision_are_told_before_any_fit(compose_config, tmp_path):
    record = run(tmp_path, compose_config, "task=capacity", "dataset=capsule", "renderer=dist", "renderer.alpha=2.5")
    assert record.status != "ok" and "renderer.alpha must lie between 0 and 2" in record.reason
    assert (record.folder / "curve.jsonl").read_text() == ""


@pytest.mark.slow
def test_a_capsule_needs_a_rounded_box(compose_config, tmp_path, capsys):
    ladder = "models.candidates=[sphere,rounded_box]"
    better = ("models.fit.iterations=16", "models.fit.warm_iterations=120")
    small = ("task.checks.views=4", "task.checks.drawn=3", "task.checks.seeds=5", "evaluation.picture=24")
    record = run(tmp_path, compose_config, "task=capacity", "dataset=capsule", ladder, *small, *better)
    assert (record.status, record.reason) == ("ok", "")
    metrics = record.metrics
    assert metrics["recommended_field"] == "rounded_box" and metrics["recommended_by"] == "stored"
    for size, number in (("free", 10), ("stored", 10), ("bytes", 40)):
        assert metrics[f"recommended_{size}"] == number == metrics[f"rounded_box.{size}"]
    assert metrics["recommended_error"] == metrics["rounded_box.error"] < metrics["footprint"]
    assert metrics["saved_stored"] == metrics["saved_free"] == metrics["saved_bytes"] == PAPERS.stored / 10
    assert "saved_seconds" not in metrics  # the network was not fitted
    assert metrics["sphere.error"] > metrics["footprint"]
    assert metrics["sphere.seconds"] > 0 < metrics["sphere.evaluations"]
    assert metrics["auto.field"] == "rounded_box" and metrics["auto.overhead"] > 1
    assert metrics["auto.evaluations"] > metrics["rounded_box.evaluations"]
    assert metrics["frugal.evaluations"] < metrics["rounded_box.evaluations"]
    assert (
        metrics["rounded_box.held_within"]
        == metrics["rounded_box.held_enough"]
        == 1
        == metrics["recommended_confirmed"]
    )
    assert metrics["sphere.held_within"] == metrics["sphere.held_enough"] == 0
    assert metrics["chamfer_l2"] < 0.01
    assert any(
        "needs rounded_box, 10 numbers, the smallest by stored numbers: held-out" in note for note in record.notes
    )
    *settings, saved = (note for note in record.notes if note.startswith("pixel precision: "))
    assert [note.split()[2] for note in settings] == ["renderer.epsilon=auto", "renderer.steps=auto"]
    values = 100 * metrics["frugal.evaluations"] / metrics["rounded_box.evaluations"]
    assert saved.endswith(f", {values:.0f} % of the field values")
    assert record.evaluations["value"] > record.evaluations["gradient"] > 0
    lines = curve_of(record.folder)
    assert {line["candidate"] for line in lines} == {"sphere", "rounded_box"}
    shares = {key: {line["rays_share"] for line in lines if line["part"] == key and line["phase"] == "fit"}
              for key in ("fit_all", "frugal")}  # fmt: skip
    assert shares["fit_all"] == {1.0} and 0 < min(shares["frugal"]) < 1
    assert {path.name for path in record.folder.iterdir()} >= {"mesh.ply", "ladder.png", "strip.png"}
    record.seconds["total"] = 1.0
    print_run_summary(record.folder, record)
    assert re.search(r"recommended_field +rounded_box\b", capsys.readouterr().out)


def test_a_fit_as_good_as_its_start_is_ok_and_a_worse_one_is_not_reached():
    growth = grow(fitter_of("box", iterations=10, seed=1), [candidate("sphere")], GROWTH)
    assert growth.fitted.evidence.mean > growth.footprint  # a ball is no box
    assert failure_of(growth, Evaluation({})) is None
    assert failure_of(growth, Evaluation({}, failure=(RunStatus.EMPTY, "nothing")))[0] == RunStatus.EMPTY
    better = replace(growth.initial_error, sums=growth.initial_error.sums * [0.5, 1, 0.5, 1])
    status, reason = failure_of(replace(growth, initial_error=better), Evaluation({}))
    assert status == RunStatus.NOT_REACHED
    assert reason.startswith("the held-out error rose by more than its noise: 0.0")


def test_a_users_renderer_without_epsilon_works(compose_config, tmp_path):
    user_renderer = ("renderer=custom", "renderer._target_=tests.user_renderer.Mine", "+renderer.steps=40")
    record = run(
        tmp_path, compose_config, "task=capacity", "dataset=sphere", "models.candidates=[sphere]", *user_renderer
    )
    assert (record.status, record.metrics["recommended_field"]) == ("ok", "sphere")
    assert not [note for note in record.notes if note.startswith("pixel precision: renderer.")]


def test_saved_time_is_given_only_where_the_network_was_fitted():
    error = HeldOutError(np.array([[0.1, 10, 0, 10]] * 3), 0.1)
    chosen = Evidence("sphere", Size(4, 4), 10, error, seconds=2.0)
    network = Evidence(PAPERS.name, Size(PAPERS.stored, PAPERS.stored), PAPERS.flops, error, seconds=300.0)
    failed = replace(network, error=None, status=RunStatus.DIVERGED)
    assert savings(chosen, [chosen, network])["saved_seconds"] == 150
    assert "saved_seconds" not in savings(chosen, [chosen, failed])
    assert savings(chosen, [chosen])["saved_flops_per_query"] == PAPERS.flops / 10


def test_a_choice_is_checked_by_the_best_candidate_of_each_draw():
    """Two candidates change places from view to view: the choice is within one standard error on some draws only."""
    off = {"chosen": [0.01, 0.03, 0.03, 0.03], "other": [0.03, 0.01, 0.01, 0.01]}
    chosen, other = (HeldOutError(np.array([[10 * mean, 10, 0, 10] for mean in means]), 0.1) for means in off.values())
    settings = CheckSettings(views=4, seeds=40, drawn=2)
    within, enough = shares(chosen, [chosen, other], settings, footprint=0.001, seed=0)
    assert 0.2 < within < 0.8 and enough == 0  # of six pairs of views, three are those with the first one
    assert shares(chosen, [chosen, other], settings, footprint=0.04, seed=0) == (within, 1.0)


def test_hits_off_the_surface_are_noted_once_of_all_candidates(compose_config, tmp_path):
    short = ("renderer=custom", "renderer._target_=tests.wrong_hits.WrongHits", "task.optimiser.iterations=4")
    overrides_of_task = ("task=completion", "dataset=sphere", "field=sphere", "task.points=50")
    record = run(tmp_path, compose_config, *overrides_of_task, *BETTER, *short)
    (note,) = [note for note in record.notes if "hits are not on the surface" in note]
    assert note.startswith("at the first iteration, WrongHits.render: ")


@pytest.mark.parametrize(("overrides", "ends"), [
    (("task=completion", "dataset=box", "task.points=dense"), "box"),
    (("task=completion", "dataset=sphere", "field=sphere", "task.points=50", "task.mask=false"), "sphere"),
], ids=["auto", "one candidate, without a mask"])  # fmt: skip
def test_completion_takes_any_field(compose_config, tmp_path, overrides, ends):
    default_field = () if any(override.startswith("field=") for override in overrides) else ("field=auto",)
    record = run(tmp_path, compose_config, *overrides, *default_field, *BETTER)
    assert record.status == "ok", record.reason
    assert record.metrics["field"] == ends
    assert record.metrics["field_free"] == record.metrics["field_stored"] == {"box": 9, "sphere": 4}[ends]
    assert record.metrics["field_bytes"] == 4 * record.metrics["field_stored"]
    assert record.metrics["field_error"] < 3 * record.metrics["field_footprint"]
    assert record.evaluations["iterations"] >= 20 and record.evaluations["observed"] >= 50
    assert record.evaluations["value"] > record.evaluations["gradient"] > 0
    assert record.seconds["forward"] > 0 < record.seconds["backward"] and (record.folder / "mesh.ply").is_file()


def test_invalid_settings_are_told_with_their_reason(compose_config, tmp_path):
    record = run(tmp_path, compose_config, "task=gradients", "+experiment=fitted", "field=auto")
    assert record.status == "refused" and "does not take field=auto: remove it" in record.reason
    with pytest.raises(ValueError, match="frugal_rays must be above 0"):
        Capacity("depth", 10.0, Own(), 10.0, 1, 100, 0.0, CheckSettings(4, 2, 2))
