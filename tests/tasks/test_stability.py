"""Breakdowns known in closed form are found, planted faults move them, and a user's renderer is in the atlas."""

from base64 import b64decode
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgba
from PIL import Image

from bench.config import load
from bench.machine.limits import Limits
from bench.pictures.style import PAPER
from bench.records.format import number
from bench.records.record import Record, RunStatus
from bench.tasks.stability import picture
from bench.tasks.stability.search import SearchSettings
from bench.tasks.stability.task import Stability
from renderers import IDR
from renderers.tracing.march import Stepping
from tests.tasks.stability.test_stress import CRITERIA, FIT, stress_named
from tests.tiny import ball_prior, camera_of, curve_of, run_of

SEARCH = SearchSettings(levels=17, repeats=3)
SHORT = replace(FIT, resolution=12, iterations=5)
AGGRESSIVE = {"coarse_to_fine": False, "careful_split": False, "extra_step_cap": None}


def run(folder: Path, stress: str, renderer, *, resolution: int = 24) -> dict:
    """The metrics of a search."""
    return record_of(folder, stress, renderer, resolution).metrics


def record_of(folder: Path, stress: str, renderer, resolution: int = 24) -> Record:
    folder.mkdir(exist_ok=True)
    run = run_of(folder, renderer, ball_prior(), camera_of(8))
    small = SearchSettings(levels=5, repeats=2)
    Stability(stress_named(stress), SEARCH, small, CRITERIA, SHORT, resolution, Limits(1e8, 8)).execute(run)
    assert run.record.status is RunStatus.OK
    return run.record


def within(stress: str, metrics: dict, severity: float) -> bool:
    """Whether a severity lies in the interval of a breakdown; without one, within half a step between levels."""
    sweep = stress_named(stress).sweep
    level = np.log(severity / sweep.mild) / np.log(sweep.severe / sweep.mild)
    if metrics["level_low"] is None:
        return abs(level - metrics["level"]) <= 0.5 / (SEARCH.levels - 1)
    return metrics["level_low"] <= level <= metrics["level_high"]


CAPPED = load("renderer", "dist", **AGGRESSIVE | {"extra_step_cap": 0.01})
PLAIN = load("renderer", "dist", **AGGRESSIVE, alpha=1.0)
CLAMPED = load("renderer", "dist", **AGGRESSIVE, step_clamp=0.1)
CLOSED_FORM = {  # axis and reason: renderer, and where it must break
    ("thin_plate", "a capped step overshoots by its cap"): (CAPPED, 0.01),
    ("thin_plate", "a clamped step by alpha - 1 times the clamp"): (CLAMPED, 0.05),
    ("thin_plate", "samples are 2 / (n - 1) apart"): (load("renderer", "dvr", n_ray_samples=64, doublings=[]), 2 / 63),
    ("grazing_gradient", "DIST's scale is alpha sin(theta)"): (PLAIN, np.degrees(np.arcsin(0.9))),
    ("empty_scene", "what is nearer than epsilon is hit"): (load("renderer", "idr"), 5e-5),
    ("camera_inside", "what is nearer than epsilon is hit"): (load("renderer", "idr", epsilon=1e-3), 1e-3),
}


@pytest.mark.parametrize("case", CLOSED_FORM, ids=lambda case: f"{case[0]}: {case[1]}")
def test_the_breakdown_is_that_of_the_closed_form(tmp_path, case):
    renderer, severity = CLOSED_FORM[case]
    metrics = run(tmp_path, case[0], renderer)
    assert within(case[0], metrics, severity) and metrics["trials"] <= metrics["grid_trials"] / 2
    once = stress_named(case[0]).repeats == 1  # trial per level, which gives no interval
    assert (metrics["level_low"] is None) == (metrics["grid_trials"] == SEARCH.levels) == once


def test_an_exception_of_a_trial_is_a_failure_and_the_search_continues(tmp_path):
    class Fragile(IDR):
        def render(self, field, rays):
            if float(rays.origins.norm(dim=-1).max()) > 50:
                raise RuntimeError("too far")
            return super().render(field, rays)

    metrics = run(tmp_path, "far_camera", Fragile(**vars(load("renderer", "idr"))))
    assert within("far_camera", metrics, 50.0) and metrics["failed_crashed"] >= 3
    lines = curve_of(tmp_path)
    assert {line["message"] for line in lines if not line["success"]} == {"RuntimeError: too far"}


def test_a_renderer_that_always_raises_has_crashed(tmp_path):
    class Broken(IDR):
        def render(self, field, rays):
            raise RuntimeError("no more")

    run = run_of(tmp_path, Broken(**vars(load("renderer", "idr"))), ball_prior(), camera_of(8))
    Stability(stress_named("gap"), SEARCH, SEARCH, CRITERIA, SHORT, 16, Limits(1e8, 8)).execute(run)
    assert run.record.status is RunStatus.CRASHED
    assert run.record.reason == "every trial raised an error: RuntimeError: no more"
    assert "trials raised an error, the last: RuntimeError: no more" in run.record.notes[0]


def test_a_doubled_step_breaks_a_plate_that_sphere_tracing_never_misses(tmp_path, monkeypatch):
    assert run(tmp_path / "right", "thin_plate", load("renderer", "idr"))["level"] > 1
    monkeypatch.setattr(Stepping, "length", lambda self, value: 2 * value)
    after = run(tmp_path / "wrong", "thin_plate", load("renderer", "idr"))
    assert after["level"] < 0 and after["failed_lost"] == after["trials"]


@pytest.mark.parametrize(
    ("guard", "stress"), [({"step_back": True}, "thin_plate"), ({"least_step": 1e-3}, "grazing_plane")], ids=str
)
def test_a_guard_moves_its_breakdown(tmp_path, guard, stress):
    bare = run(tmp_path / "bare", stress, load("renderer", "dist", **AGGRESSIVE))
    guarded = run(tmp_path / "guarded", stress, load("renderer", "dist", **AGGRESSIVE | guard))
    assert guarded["level"] > bare["level"] + 0.03


def test_success_that_rises_with_severity_is_noted(tmp_path):
    stress = stress_named("gap")
    turned = replace(stress, sweep=replace(stress.sweep, mild=stress.sweep.severe, severe=stress.sweep.mild))
    few = SearchSettings(levels=5, repeats=2)
    for used_stress, doubted in ((stress, False), (turned, True)):
        run = run_of(tmp_path, load("renderer", "idr"), ball_prior(), camera_of(8))
        Stability(used_stress, few, few, CRITERIA, SHORT, 32, Limits(1e8, 8)).execute(run)
        assert any(note.startswith("success does not fall with severity") for note in run.record.notes) is doubted


def test_a_run_shows_both_sides_of_its_breakdown(tmp_path):
    record = record_of(tmp_path, "thin_plate", CAPPED)
    lines, level = curve_of(tmp_path), record.metrics["level"]
    assert len(lines) == record.metrics["trials"]
    works = [line["severity"] for line in lines if line["success"] and line["level"] <= level]
    breaks = [line["severity"] for line in lines if not line["success"] and line["level"] >= level]
    with np.load(tmp_path / "images.npz") as images:  # a thinner plate is severer
        assert images["works_severity"] == pytest.approx(min(works))
        assert images["breaks_severity"] == pytest.approx(max(breaks))
        missed = {name: (images[f"{name}_kinds"] == 2).sum() for name in ("works", "breaks")}
        assert images["breaks_true_distance"].shape == (24, 24)
    assert missed["breaks"] > missed["works"]
    assert (tmp_path / "failure.png").stat().st_size > 5000
    assert "(missed)" in record.pictures["breaks_text"]
    small = Image.open(BytesIO(b64decode(record.pictures["breaks"].removeprefix("data:image/png;base64,"))))
    assert (np.asarray(small) == 2).sum() == missed["breaks"]


@pytest.mark.parametrize(("renderer", "breaks"), [(CAPPED, True), (load("renderer", "idr"), False)])
def test_the_figure_states_the_breakdown_the_criterion_and_the_failed_trials(tmp_path, monkeypatch, renderer, breaks):
    figures = []
    monkeypatch.setattr(picture, "save", lambda figure, path: figures.append(figure))
    record = record_of(tmp_path, "thin_plate", renderer)
    lines, sweep = curve_of(tmp_path), stress_named("thin_plate").sweep
    failed = [line for line in lines if not line["success"]]
    title, panels = figures[0].get_suptitle(), figures[0].subfigs
    severity = record.metrics["breakdown"] if breaks else sweep.severe
    assert f"{number(severity)} {sweep.unit}" in title and f"{len(failed)} of {len(lines)} trials failed" in title
    assert f"{CRITERIA.hits:g} of the true hits" in title and len(panels) == 1 + breaks
    if breaks:
        at_level = [line for line in lines if line["severity"] == max(line["severity"] for line in failed)]
        lost = next(line["lost"] for line in at_level if not line["success"])
        text = panels[-1].get_suptitle()
        assert f"{sum(not line['success'] for line in at_level)} of {len(at_level)} trial" in text
        assert f" {lost:.0f} missed" in text
        legend = panels[-1].axes[0].get_legend()  # of the rendered distances, in which missed pixels are white
        assert legend is not None and legend.get_patches()[0].get_facecolor() == to_rgba(PAPER)


def test_the_levels_of_the_pictures_are_those_that_bench_ray_draws(tmp_path):
    """It draws the first trial of a level."""
    record = record_of(tmp_path, "thin_plate", CAPPED)
    firsts = {line["level"]: line["success"] for line in reversed(curve_of(tmp_path))}
    levels = {name: record.pictures.get(f"{name}_level") for name in ("works", "breaks")}
    assert any(levels.values())
    assert all(firsts[float(text)] is (name == "works") for name, text in levels.items() if text)


def test_a_small_picture_keeps_single_wrong_pixels():
    kinds = np.ones((130, 129), np.uint8)
    kinds[7, 128] = 4
    uri = picture._thumbnail(kinds)
    small = np.asarray(Image.open(BytesIO(b64decode(uri.partition(",")[2]))))
    assert small.shape == (44, 43) and small[2, 42] == 4 and (small == 4).sum() == 1


def test_a_task_without_a_stress_names_the_remedy():
    with pytest.raises(ValueError, match="set stress=thin_plate"):
        Stability(None, SEARCH, SEARCH, CRITERIA, FIT, 24, Limits(1e8, 8))


def test_a_fit_is_searched_with_its_own_settings(tmp_path):
    metrics = run(tmp_path, "missing_depth", load("renderer", "dist"))
    assert metrics["grid_trials"] == 10 and metrics["trials"] <= 5
