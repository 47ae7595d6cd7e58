"""What a renderer costs on one view: counts, clock, limits and errors, on networks of a few neurons."""

import json
import weakref
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.image import imread

from bench.config import load
from bench.evaluate.reference import Reference
from bench.machine.limits import Limits
from bench.records.record import RunStatus, to_json
from bench.setup.inputs import RunContext
from bench.tasks import ablation
from bench.tasks.ablation import BASE, DEFINITIONS, SHRINK_FACTOR, WARM_UP_PIXELS, Ablation, Timings
from renderers.camera import Camera, Rays
from renderers.field import Counts, Field, Kind, Meter
from renderers.rendering import Capabilities, Renderer, Rendering, Status
from renderers.tracing import waits
from tests.looped import each
from tests.tiny import PEAK, ball_prior, camera_of, run_of

SETTINGS = Ablation(repeats=2, limits=Limits(values=1e6, memory=8), smallest=2, wrong=0.02)
PRIOR = ball_prior()
SIZE = 16


def view(size: int) -> Camera:
    """From a side and from above, so that the axes of world, camera and picture differ."""
    return camera_of(size, angles=(70.0, 20.0))


def measured(folder: Any, renderer: Any, settings: Ablation = SETTINGS, size: int = SIZE) -> RunContext:
    """A run in which the task was executed."""
    run = run_of(folder, renderer, PRIOR, view(size))
    settings.execute(run)
    return run


@pytest.fixture(scope="module")
def dist(tmp_path_factory) -> RunContext:
    return measured(tmp_path_factory.mktemp("run"), load("renderer", "dist"), replace(SETTINGS, gradient=True))


def test_it_ends_well_with_all_its_files(dist):
    assert (dist.record.status, dist.record.reason) == (RunStatus.OK, "")
    assert {path.name for path in dist.folder.iterdir()} == {"cache", "images.npz", "summary.png"}
    assert imread(dist.folder / "summary.png")[..., :3].std() > 0.02
    json.loads(to_json(dist.record.metrics), parse_constant=pytest.fail)


def defined(name: str, definition: str) -> bool:
    """Whether a definition is of a number: it may be of several, or of all that begin alike."""
    return any(name == prefix or name.startswith(f"{prefix}_") for prefix in definition.split(", "))


def test_every_number_has_a_definition_and_every_definition_a_number(dist):
    record = dist.record
    numbers = {*record.metrics, *(f"evaluations.{name}" for name in record.evaluations), "seconds.total"}
    assert record.definitions == DEFINITIONS
    assert [name for name in numbers if sum(defined(name, key) for key in DEFINITIONS) != 1] == []
    numbers.add("peak_memory_bytes")  # of a GPU alone
    assert [name for key in DEFINITIONS for name in key.split(", ") if not any(defined(n, name) for n in numbers)] == []
    assert all(len(text) > 15 for text in DEFINITIONS.values())


@cache
def sampled_hit() -> torch.Tensor:
    """By dense sampling: whether a ray meets a value below zero."""
    rays, t = view(SIZE).double().rays(), torch.linspace(1.4, 3.6, 4000, dtype=torch.float64)
    points = rays.origins[..., None, :] + t[:, None] * rays.directions[..., None, :]
    with torch.no_grad():
        values = deepcopy(PRIOR.decoder).double().at(PRIOR.codes[0].double())(points)
    return ((values <= 0) & (points.norm(dim=-1) < 1)).any(-1)


CAN = Capabilities((Kind.DISTANCE,), field_gradient=True, ray_gradient=False)


def by_hand(renderer: Renderer, *, gradient: bool) -> Meter:
    """A Meter that has seen one rendering, or one step, at the first code."""
    code = PRIOR.codes[0].clone().requires_grad_(gradient)
    meter, rays = Meter(PRIOR.decoder.at(code)), view(SIZE).rays()
    with torch.set_grad_enabled(gradient):
        rendering = renderer.render(meter, rays)
        if gradient:
            loss = renderer.silhouette_loss(meter, rays, rendering, sampled_hit())
            (rendering.distance[rendering.hit].sum() + loss).backward()
    return meter


def test_counts_are_those_of_a_meter(dist):
    renderer, record = load("renderer", "dist"), dist.record  # counts are of one of its two repeats
    forward, step = by_hand(renderer, gradient=False), by_hand(renderer, gradient=True)
    assert record.metrics["queries"] == forward.counts.value > 0
    assert record.metrics["step_queries"] == record.evaluations["value"] == step.counts.value > 0
    assert record.metrics["step_gradients"] == record.evaluations["gradient"] == step.counts.gradient > 0
    assert record.evaluations["per_ray"] == forward.counts.value / SIZE**2
    least = 2 * (record.metrics["hits"] - record.metrics["lost"] + record.metrics["false"])
    work = record.metrics["step_queries"] + record.metrics["step_gradients"]
    assert record.evaluations["work_over_bound"] == pytest.approx(work / least, rel=1e-12)


def test_the_gradient_by_weights_is_right_at_exact_hits_and_wrong_signs_of_pixels_do_not_cancel(tmp_path):
    settings = replace(SETTINGS, gradient=True)
    exact = measured(tmp_path / "a", load("renderer", "newton"), settings).record.metrics
    assert exact["gradient_error"] < 1e-3 and exact["out_of_steps"] == 0
    opposite = measured(tmp_path / "b", Changed(load("renderer", "newton"), (-1, -1)), settings).record.metrics
    assert opposite["gradient_error"] == pytest.approx(2, abs=1e-3)
    half = measured(tmp_path / "c", Changed(load("renderer", "newton"), (-1, 3)), settings).record.metrics
    assert half["gradient_error"] > 1.5
    assert measured(tmp_path / "d", load("renderer", "dist", steps=3)).record.metrics["out_of_steps"] > 0


def test_times_and_rates_agree_with_each_other(dist):
    metrics = dist.record.metrics
    assert metrics["repeats"] == 2
    for name in ("forward", "backward", "step"):
        low, middle, high = (metrics[f"{name}_seconds{end}"] for end in ("_low", "", "_high"))
        assert 0 < low <= middle <= high
    assert metrics["backward_seconds"] < metrics["step_seconds"]
    assert dist.record.seconds["forward"] == metrics["forward_seconds"]
    weights = 3 * 128 + 128  # the code is folded into the biases
    peak = dist.record.environment["gemm_peak_flops"]
    step = 2 * weights * (metrics["step_queries"] + metrics["step_gradients"])
    forward = 2 * weights * metrics["queries"]
    assert metrics["forward_gemm"] == pytest.approx(forward / metrics["forward_seconds"] / peak)
    assert metrics["step_gemm"] == pytest.approx(step / metrics["step_seconds"] / peak)
    assert dist.record.peak_memory_bytes == metrics.get("peak_memory_bytes")


@each("after, best", [(0.5 * PEAK, PEAK), (2 * PEAK, 2 * PEAK)])
def test_rates_are_compared_with_the_best_that_the_machine_did_before_and_after(tmp_path, monkeypatch, after, best):
    monkeypatch.setattr(ablation, "gemm_peak", lambda device: after)
    assert measured(tmp_path, Fake(), size=4).record.environment["gemm_peak_flops"] == best


def test_costs_are_medians_with_least_and_largest():
    clocked = Timings([3.0, 1.0, 8.0], [0.5, 0.25, 0.75], [0.0], Counts(10, 4, coarse=7), 77, 600, 80)
    forward = Timings([2.0], [0.0], [0.0], Counts(5, 0), None, None)
    assert ablation.costs(forward, clocked, {"gemm_peak_flops": 100.0, "bfloat16_peak_flops": 400.0}) == {
        "queries": 5, "coarse_queries": 0, "step_queries": 10, "step_coarse_queries": 7, "step_gradients": 4,
        "repeats": 3, "peak_memory_bytes": 77,
        "forward_seconds": 2.0, "forward_seconds_low": 2.0, "forward_seconds_high": 2.0,
        "step_seconds": 3.0, "step_seconds_low": 1.0, "step_seconds_high": 8.0,
        "step_gemm": (600 / 100.0 + 80 / 400.0) / 3.0,
        "backward_seconds": 0.5, "backward_seconds_low": 0.25, "backward_seconds_high": 0.75,
    }  # fmt: skip


def test_the_renderer_is_near_the_reference(dist):
    metrics = dist.record.metrics
    assert metrics["size"] == SIZE and metrics["rays"] == SIZE**2
    assert metrics["hits"] == int(sampled_hit().sum()) > 20 and metrics["lost"] + metrics["false"] <= 4
    assert metrics["wrong"] == 0
    assert 0 < metrics["depth_error_median"] <= metrics["depth_error_p99"] <= metrics["depth_error_max"] < 1e-3


def test_the_images_are_those_of_the_renderer_and_of_the_reference(dist):
    images = np.load(dist.folder / "images.npz")
    hit, true, metrics = images["hit"], images["reference_hit"], dist.record.metrics
    assert true.sum() == metrics["hits"] and (true & ~hit).sum() == metrics["lost"]
    right, up, towards = images["reference_normals"].astype(float)[true].T
    rows, columns = np.nonzero(true)
    assert (towards > 0).all() and np.corrcoef(right, columns)[0, 1] > 0.9
    assert np.corrcoef(up, rows)[0, 1] < -0.9
    differ = np.abs(images["normals"] - images["reference_normals"])[hit & true].max(axis=-1)
    assert (differ < 0.01).mean() > 0.9  # others lie beside an edge of the polyhedron


def test_longer_steps_ask_more_behind_the_surface(tmp_path, monkeypatch):
    def behind(name: str) -> float:
        return measured(tmp_path / name, load("renderer", name)).record.metrics["behind"]

    regular, longer = behind("dist_dynamic"), behind("dist_aggressive")
    assert 0 <= regular < 0.02 and 0.05 < longer < 0.5  # DIST, Fig. 14
    # Finished rays are evaluated with the others, as on a GPU.
    monkeypatch.setitem(waits.COMPACTION_INTERVALS, "cpu", waits.DEFAULT_COMPACTION_INTERVAL)
    assert behind("dist_aggressive") == pytest.approx(longer)


@dataclass
class Fake:
    """Hits where it is told, at known distances, with a gradient of one value of the field a ray."""

    hit: torch.Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.bool))
    distance: torch.Tensor = field(default_factory=lambda: torch.zeros(0))
    capabilities: Capabilities = CAN

    def render(self, field: Field, rays: Rays) -> Rendering:
        values = field(rays.at(torch.full(rays.shape, 2.5)))
        measured = rays.shape == self.hit.shape  # all renderings except the warm-up
        hit = self.hit if measured else torch.ones(rays.shape, dtype=torch.bool)
        distance = self.distance if measured else torch.ones(rays.shape)
        status = torch.where(hit, Status.HIT, Status.MISS).to(torch.int8)
        return Rendering(
            distance + values - values.detach(), status, rays.at(distance), torch.zeros(rays.shape), values
        )

    def silhouette_loss(self, field: Field, rays: Rays, rendering: Rendering, mask: torch.Tensor) -> torch.Tensor:
        return rendering.closest.sum() * 0


def test_lost_false_and_wrong_are_counted_against_the_reference(tmp_path, monkeypatch):
    cosine = camera_of(4).double().depth(torch.ones(4, 4).double())
    true, rendered, error = torch.zeros(4, 4).bool(), torch.zeros(4, 4).bool(), torch.zeros(4, 4).double()
    true[0], rendered[1] = True, True  # 4 lost, 4 false
    true[2:], rendered[2:] = True, True
    error[2], error[3, 0], error[3, 1] = 0.01, 0.019, 0.021
    error[3, 2:] = torch.tensor([-0.5, 0.0])
    reference = Reference(2.0 * true / cosine, torch.zeros(4, 4, 3).double(), true)
    monkeypatch.setattr(ablation, "reference_for", lambda *_: reference)
    metrics = measured(tmp_path, Fake(rendered, ((2.0 + error) / cosine).float()), size=4).record.metrics
    assert {name: metrics[name] for name in ("rays", "hits", "lost", "false", "wrong")} == {
        "rays": 16, "hits": 12, "lost": 4, "false": 4, "wrong": 2,
    }  # fmt: skip
    assert metrics["depth_error_median"] == pytest.approx(0.01, abs=1e-6)  # of depths, not of distances
    assert metrics["depth_error_max"] == pytest.approx(0.5, abs=1e-6)


@dataclass
class Changed:
    """A renderer whose hits are right and whose gradients are multiplied by two factors, pixel by pixel in turn."""

    inner: Renderer
    factors: tuple[float, float]

    @property
    def capabilities(self) -> Capabilities:
        return self.inner.capabilities

    def render(self, field: Field, rays: Rays) -> Rendering:
        rendering = self.inner.render(field, rays)
        flat = rendering.distance.flatten()
        factors = torch.tensor(self.factors).repeat(len(flat) // 2 + 1)[: len(flat)]
        changed = flat.detach() + factors * (flat - flat.detach())
        return replace(rendering, distance=changed.reshape(rendering.distance.shape))

    def silhouette_loss(self, *arguments: Any) -> torch.Tensor:
        return self.inner.silhouette_loss(*arguments)


@dataclass
class Costly(Fake):
    """Evaluates more values in each rendering with more rays than some."""

    above: int = 0
    values: int = 0
    rendered: list[int] = field(default_factory=list)
    held: list[Any] = field(default_factory=list)  # weak references to what each rendering made

    def render(self, field: Field, rays: Rays) -> Rendering:
        made = torch.ones(1000)
        assert all(reference() is None for reference in self.held)
        self.held.append(weakref.ref(made))
        self.rendered.append(rays.shape.numel())
        if rays.shape.numel() > self.above:
            field(torch.zeros(self.values, 3))
        return super().render(field, rays)


def test_where_the_work_is_done_a_smaller_image_is_measured(tmp_path):
    costly = Costly(above=16 * 16 - 1, values=10_000)
    run = measured(tmp_path, costly, replace(SETTINGS, limits=Limits(9000, 8)))
    side = SIZE // SHRINK_FACTOR
    assert run.record.status is RunStatus.TIMEOUT
    assert run.record.reason == f"more than 9,000 field values in a step at 16 x 16; it finishes at {side} x {side}"
    assert run.record.metrics["size"] == side and run.record.metrics["rays"] == side**2
    assert np.load(run.folder / "images.npz")["hit"].shape == (side, side)
    # Each size begins with a warm-up. What is too much once is not tried again.
    assert costly.rendered[:4] == [WARM_UP_PIXELS**2, SIZE**2, WARM_UP_PIXELS**2, side**2]


@each("smallest", [SIZE // SHRINK_FACTOR + 1, 1])
def test_where_no_size_finishes_there_are_no_numbers(tmp_path, smallest):
    costly = Costly(above=0, values=1000)
    record = measured(tmp_path, costly, replace(SETTINGS, limits=Limits(900, 8), smallest=smallest)).record
    assert record.reason == "more than 900 field values in a step at 16 x 16; it finishes at no smaller size"
    assert (record.status, record.metrics) == (RunStatus.TIMEOUT, {})


@each("values, times", [(0, 5), (1000, 1)])
def test_repeats_are_fewer_where_they_come_to_a_quarter_of_the_limit(tmp_path, values, times):
    costly = Costly(above=WARM_UP_PIXELS**2, values=values)
    run = measured(tmp_path, costly, replace(SETTINGS, repeats=5, limits=Limits(5000 if values else 20_000, 8)))
    assert run.record.status is RunStatus.OK and run.record.metrics["repeats"] == times
    assert costly.rendered == [WARM_UP_PIXELS**2] + [SIZE**2] * (2 * times + 1)  # the last one counts signs


TURNS = replace(SETTINGS, repeats=1, beside=["newton", "dvr"], rounds=2, size=16, threads=1)


def test_ratios_are_of_the_same_round():
    mine, base = (
        Timings([2.0, 9.0, 2.0], cpu_seconds=[4.0, 4.0, 4.0]),
        Timings([1.0, 3.0, 1.0], cpu_seconds=[8.0, 2.0, 8.0]),
    )
    assert ablation.ratios(mine, base, "step") == {
        "step_cpu": 4.0, "step_ratio": 2.0, "step_ratio_low": 2.0, "step_ratio_high": 3.0,
        "step_cpu_ratio": 0.5, "step_cpu_ratio_low": 0.5, "step_cpu_ratio_high": 2.0,
    }  # fmt: skip


def test_every_renderer_in_turn_has_its_numbers_and_a_limit_names_the_one_that_reached_it(tmp_path):
    metrics = measured(tmp_path, load("renderer", "dist"), TURNS, 32).record.metrics
    assert {key.split(".")[0] for key in metrics} == {"size", "rounds", BASE, "newton", "dvr"}
    assert metrics["rounds"] == metrics["dvr.repeats"] == 2 and metrics["size"] == 16
    assert metrics["dvr.queries"] > 5 * metrics["newton.queries"]
    assert metrics[f"{BASE}.forward_ratio"] == metrics[f"{BASE}.step_cpu_ratio_high"] == 1
    run = measured(tmp_path, load("renderer", "dist"), replace(TURNS, limits=Limits(values=8000, memory=8)), 32)
    assert run.record.status is RunStatus.TIMEOUT
    assert run.record.reason.startswith("more than 8,000 field values in a rendering of dvr at 16 x 16; ")


def test_threads_follow_the_setting_and_are_restored(tmp_path, monkeypatch):
    threads, before = [], torch.get_num_threads()
    clock = ablation.Workbench._clock
    monkeypatch.setattr(
        ablation.Workbench, "_clock", lambda *arguments: threads.append(torch.get_num_threads()) or clock(*arguments)
    )
    measured(tmp_path, load("renderer", "dist"), replace(SETTINGS, threads=2))
    assert set(threads) == {2} and torch.get_num_threads() == before
