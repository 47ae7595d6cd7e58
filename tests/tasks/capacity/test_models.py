"""Candidate fields: formulas, held-out errors, the choice by these errors, and growth."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from bench.config import load
from bench.records.record import RunStatus
from bench.solve.observed_view import ObservedView
from bench.tasks.capacity.candidates import REACH, by_size, candidate
from bench.tasks.capacity.field import rendered_curve
from bench.tasks.capacity.fit import SCREENING, FitProblem, Fitter, scatter_points
from bench.tasks.capacity.growth import _is_better, cost, grow
from bench.tasks.capacity.held_out import MISSED_FOOTPRINTS, HeldOutError
from bench.tasks.capacity.model import Evidence, Model, Size, StartInputs
from bench.tasks.capacity.observations import FREE_POINTS_PER_RAY, Views, concatenate_views, hold_out
from bench.tasks.capacity.settings import FitSettings, GrowthSettings, ModelSettings, ViewSettings, rays_share
from bench.tasks.capacity.study import choose, fit_all, refit
from datasets.mesh import extract
from datasets.scene import Truth, see
from datasets.views import ViewSampler
from renderers import Capabilities, Kind
from renderers.fields.analytic import Shape, box, capsule, sphere
from renderers.fields.parts import FORMULAS, superquadric
from renderers.silhouette import Own
from tests.looped import each
from tests.tiny import CPU

DIST = load("renderer", "dist", n_gradient_samples=1)
FIT = FitSettings(iterations=30, fewest_rays=1.0, warm_iterations=60, warm_points=128, eikonal_weight=1.0)
SAMPLER = ViewSampler(2.5, 50.0, (0.0, 360.0), (15.0, 35.0), 24)
WEIGHTS = SimpleNamespace(depth_loss="depth", depth_weight=10.0, silhouette=Own(), silhouette_weight=10.0)
VIEWS = ViewSettings(fitted=6, held_out=4, share=0.1, elevation=60.0, rays=256)
SIZES = {
    "sphere": 4,
    "ellipsoid": 9,
    "box": 9,
    "rounded_box": 10,
    "superquadric": 11,
    "union_3": 30,
    "network_1x16": 81,
    "fourier_1x8": 8 * 11 + 8 + 9,
    "hash_2x6": 2 * 64 * 2 + 32 * 7 + 32 + 33,
}
GROWTH = GrowthSettings(trial=0.2, patience=5, budget=2.0)


@cache
def shape_of(name: str) -> Truth:
    shapes = {
        "ball": sphere(0.6, (0.1, 0.0, -0.1)),
        "box": box((0.5, 0.3, 0.4)),
        "capsule": capsule((0.0, -0.4, 0.0), (0.0, 0.4, 0.0), 0.3),
    }
    mesh = extract(shapes[name], grid=64, reach=1.0)
    assert mesh is not None
    return Truth(mesh)


def views_of(name: str, renderer=DIST) -> Views:
    return Views(shape_of(name), SAMPLER, VIEWS, WEIGHTS, renderer, CPU, held_out_rays=576)


def fitter_of(name: str, renderer=DIST, seed: int = 0, **changed) -> Fitter:
    observations = views_of(name, renderer).observations(seed)
    return Fitter(observations, replace(FIT, **changed), seed, CPU, lambda name, line: None)


def points(count: int = 4000) -> torch.Tensor:
    return 2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 1


def an_error(mean: float, spread: float = 0.0) -> HeldOutError:
    """A held-out error of four groups of ten hits, spread evenly about the mean."""
    means = mean + spread * np.array([-1.5, -0.5, 0.5, 1.5])
    return HeldOutError(np.stack([10 * means, [10.0] * 4, [0.0] * 4, [10.0] * 4], axis=1), 0.1)


def evidence_of(name: str, size: int | Size, error: HeldOutError | None) -> Evidence:
    status = RunStatus.OK if error else RunStatus.DIVERGED
    size = size if isinstance(size, Size) else Size(size, size)
    return Evidence(name, size, 10, error, status, "" if error else "it rose")


@each("name", SIZES)
def test_a_candidate_has_the_number_of_parameters_of_its_name(name):
    ball = Model("sphere", [torch.zeros(1, requires_grad=True)], lambda free: sphere(0.5), 0.1, metric=True)
    inputs = StartInputs(points(500).float(), ball, 0, CPU)
    for model in candidate(name).starts(inputs):
        stored = SIZES[name] + (12 if name == "fourier_1x8" else 0)  # its frequencies are not fitted
        assert model.size == Size(SIZES[name], stored) and model.size.bytes == 4 * stored
        assert candidate(name).stored == stored and model.field().flops.value == candidate(name).flops
        values = model.field()(points(50).float())
        values.sum().backward()
        assert all(bool(parameter.grad.isfinite().all()) for parameter in model.parameters)


@each("changed, message", [
    ({"candidates": ("unoin_3",)}, "did you mean union_3"), ({"candidates": ("union_1",)}, "union_2 is the smallest"),
    ({"candidates": ("grid_4",)}, "between 8 and 256"),
    ({"candidates": ("sphere", "box", "sphere")}, "name each candidate once"),
    ({"size": "parameters"}, r"models\.size must be one of stored, free, bytes, not 'parameters'"),
])  # fmt: skip
def test_invalid_settings_are_refused(changed, message):
    settings = {"candidates": ("sphere",), "size": "stored", "fit": FIT, "growth": GROWTH, "views": VIEWS}
    with pytest.raises(ValueError, match=message):
        ModelSettings(**settings | changed)


def test_a_rounded_box_can_be_a_box_and_a_capsule():
    logs = [*np.log([0.2, 0.5, 0.2]), 40.0]
    numbers = torch.tensor([0.0] * 6 + logs, dtype=torch.float64)
    as_capsule = capsule((0.0, -0.3, 0.0), (0.0, 0.3, 0.0), 0.2)
    rounded = FORMULAS["rounded_box"]
    assert torch.allclose(rounded(numbers)(points()), as_capsule(points()), atol=1e-9)
    numbers[9] = -40.0
    assert torch.allclose(rounded(numbers)(points()), box((0.2, 0.5, 0.2))(points()), atol=1e-9)


def test_the_boxes_of_a_union_are_rotated_and_translated():
    first = torch.tensor([0.3, 0.1, -0.2, 0.0, 0.0, torch.pi / 2, *np.log([0.1, 0.4, 0.2]), -40.0], dtype=torch.float64)
    second = torch.tensor([-0.4, 0.0, 0.0, 0.0, 0.0, 0.0, *np.log([0.2, 0.2, 0.2]), 40.0], dtype=torch.float64)
    turned = box((0.4, 0.1, 0.2)).translate((0.3, 0.1, -0.2))  # rotated by a right angle about z
    union = turned | sphere(0.2, (-0.4, 0.0, 0.0))
    assert torch.allclose(FORMULAS["union"](torch.stack([first, second]))(points()), union(points()), atol=1e-6)
    assert torch.allclose(FORMULAS["box"](first[:9])(points()), turned(points()), atol=1e-6)


@each("powers", [(1.0, 1.0), (1.0, 4.0), (2.0, 2.0), (20.0, 20.0)])
def test_a_superquadric_is_a_bound(powers):
    shape = superquadric((0.6, 0.3, 0.4), powers)
    locations = points()[:1000].requires_grad_()
    (slopes,) = torch.autograd.grad(shape(locations).sum(), locations)
    assert torch.linalg.vector_norm(slopes, dim=-1).max() <= 1 + 1e-6
    close = shape(locations.detach() + 1e-9)
    assert bool(close.isfinite().all())


def test_free_samples_of_a_grid_lie_near_the_surface_and_the_others_are_fixed():
    ball = Model("sphere", [torch.zeros(1)], lambda free: sphere(0.5), 0.1, metric=True)
    (model,) = candidate("grid_24").starts(StartInputs(torch.tensor([[0.9, 0.9, 0.9]]), ball, 0, CPU))
    cell = 2 * REACH / 23
    shell = 4 * np.pi * 0.5**2 * 4 * cell / cell**3  # two cells on both sides
    assert model.size.free == pytest.approx(shell + 4**3, rel=0.15)
    assert model.size.stored == candidate("grid_24").stored == 24**3 and model.size.bytes == 4 * 24**3
    assert model.size.sparse_bytes == 4 * model.size.free + 24**3 / 8 + 4  # the previous field has one number
    locations = 0.5 * points(200).float()
    assert (model.field()(locations) - sphere(0.5)(locations)).abs().max() < 0.5 * cell
    model.parameters[0].data.fill_(1.0)
    assert model.frozen()(torch.zeros(1, 3)).item() == pytest.approx(-0.5, abs=cell)
    assert model.frozen()(torch.tensor([[0.9, 0.9, 0.9]])).item() == 1.0


def test_a_union_keeps_the_boxes_of_a_smaller_union():
    old = torch.tensor([[0.0] * 6 + [-1.0] * 3 + [0.0], [0.5] + [0.0] * 5 + [-2.0] * 3 + [0.0]], requires_grad=True)
    smaller = Model("union_2", [old], lambda free: FORMULAS["union"](free[0]), 0.1, metric=True)
    *_, kept = candidate("union_3").starts(StartInputs(points(400).float(), smaller, 0, CPU))
    assert torch.equal(kept.parameters[0][:2], old)
    starts = candidate("union_3").starts(StartInputs(points(400).float(), None, 0, CPU))
    assert len(starts) == candidate("union_3").tries - 1


def test_the_error_is_the_surface_offset_along_its_normal():
    observations = views_of("ball").observations(0)
    footprint = observations.footprint
    error = observations.error(sphere(0.6 + 0.3 * footprint, (0.1, 0.0, -0.1)))
    off, hits, alone, either = error.sums.sum(0)
    assert off / hits == pytest.approx(0.3 * footprint, rel=0.1)
    radius = 0.6 / (2 * footprint) * 1.5 / 2.5  # of the outline in pixels: it moves by about 0.15 pixels
    assert alone / either == pytest.approx(2 * 0.15 / radius, rel=0.5)
    smaller = observations.error(sphere(0.6 - 0.3 * footprint, (0.1, 0.0, -0.1))).sums.sum(0)
    assert smaller[2] / smaller[3] == pytest.approx(alone / either, rel=0.5)
    nothing = observations.error(sphere(0.01, (0.0, 0.0, 0.9)))
    assert nothing.mean == pytest.approx(MISSED_FOOTPRINTS * footprint, rel=1e-3)


def test_groups_give_the_standard_error_of_a_mean():
    error = an_error(0.01, 0.002)
    assert error.mean == pytest.approx(0.01)
    assert error.standard_error == pytest.approx(np.std([-0.003, -0.001, 0.001, 0.003], ddof=1) / 2)
    shifted = HeldOutError(error.sums + np.array([0.05, 0, 0, 0]), 0.1)
    assert shifted.mean == pytest.approx(0.015)
    assert shifted.noise_of_difference(error) == pytest.approx(0, abs=1e-12)
    lost = HeldOutError(np.array([[0.0, 0, 5, 10], [0.05, 5, 5, 10]]), 0.1)
    assert lost.mean == pytest.approx(0.5 * 0.01 + 0.5 * 0.1)
    assert lost.select(np.array([1])).mean == pytest.approx(0.5 * 0.01 + 0.5 * 0.1)


def test_held_out_rays_are_not_fitted():
    views = [see(shape_of("box"), SAMPLER.camera(angle, 20.0)) for angle in (0.0, 90.0, 180.0)]
    views_of_rays = [ObservedView.of(v, WEIGHTS, DIST, observed=v.mask, mask=v.mask, device=CPU) for v in views]
    group = torch.arange(3).repeat_interleave(24 * 24)
    split = hold_out(concatenate_views(views_of_rays), group, share=0.25, entire=(2,), footprint=0.02, seed=0)
    pixels = 24 * 24
    assert len(split.held_out.distance) == pytest.approx(pixels + 0.25 * 2 * pixels, abs=2)
    everything = torch.cat([split.fitted.rays.directions, split.held_out.rays.directions])
    assert len(everything) == 3 * pixels == len(everything.unique(dim=0))
    assert split.held_out.group.bincount().tolist()[2] == pixels
    observed = torch.cat([v.mask.flatten() for v in views[:2]])
    assert split.fitted.observed.sum() == pytest.approx(0.75 * observed.sum(), abs=1)
    assert box((0.5, 0.3, 0.4))(split.points).abs().max() < 0.01
    assert (box((0.5, 0.3, 0.4))(split.free) > -0.01).all()
    # Background rays have free points too.
    assert len(split.free) > 1.5 * FREE_POINTS_PER_RAY * split.fitted.observed.sum()
    first, again, other = (split.terms(sphere(0.4), iteration, 1.0) for iteration in (0, 0, 1))
    assert first == again != other


CASES = {
    "the smallest within one standard error": ([(4, 0.030), (9, 0.0105), (10, 0.010)], 0.001, 9, True, False),
    "not one that is just above": ([(4, 0.030), (9, 0.0125), (10, 0.010)], 0.001, 10, True, False),
    "or under the footprint": ([(4, 0.019), (9, 0.0125), (10, 0.010)], 0.02, 4, False, True),
    "whatever the order": ([(50, 0.010), (4, 0.0101)], 0.001, 4, True, False),
}


@each("case", CASES)
def test_the_choice_is(case):
    candidates, footprint, chosen, within, enough = CASES[case]
    ladder = [evidence_of(str(size), size, an_error(mean, 0.0015)) for size, mean in candidates]  # s.e. about 0.00097
    choice = choose([evidence_of("failed", 1, None), *ladder], footprint, "stored")
    assert (choice.chosen.size.stored, choice.within, choice.enough) == (chosen, within, enough)
    assert choice.best.mean == pytest.approx(min(mean for _, mean in candidates)) and choice.confirmed


@each("enough, within, chosen, confirmed", [
    ((0.9, 1.0), (0.0, 0.0), 4, True), ((0.7, 1.0), (0.0, 0.0), 10, True),
    ((0.7, 0.0), (0.9, 0.9), 10, True), ((0.7, 0.0), (0.9, 0.7), 10, False),
])  # fmt: skip
def test_a_choice_must_hold_on_further_views(enough, within, chosen, confirmed):
    small, large = (evidence_of(str(size), size, an_error(mean, 0.0015)) for size, mean in ((4, 0.019), (10, 0.010)))
    for fit, *held in zip((small, large), enough, within, strict=True):
        fit.held_enough, fit.held_within = held
    choice = choose([small, large], 0.02, "stored")
    assert (choice.chosen.size.stored, choice.confirmed) == (chosen, confirmed)


def test_an_error_has_as_many_random_rays_of_each_view():
    held = views_of("ball").further(3, 0)
    few = held.thinned(50, 1)
    assert (held.group.bincount().tolist(), few.group.bincount().tolist()) == ([576] * 3, [50] * 3)
    assert len(few.rays.directions.unique(dim=0)) == 150
    assert float(few.observed.double().mean()) == pytest.approx(float(held.observed.double().mean()), abs=0.15)


def test_a_warm_start_alone_finds_a_sphere_and_a_box():
    ball = fitter_of("ball").begin(candidate("sphere"), None)
    assert ball.model.parameters[0].tolist() == pytest.approx([0.1, 0.0, -0.1, np.log(0.6)], abs=0.02)
    assert ball.evidence.evaluations == 2 * 60 * 128
    crate = fitter_of("box").begin(candidate("box"), None)
    assert crate.evidence.mean < views_of("box").footprint
    assert crate.evidence.iterations == 0 < crate.evidence.seconds


def test_a_fit_continues_from_a_warm_start_and_is_counted():
    fitter = fitter_of("box", warm_iterations=5)
    fitted = fitter.begin(candidate("rounded_box"), None)
    before = fitted.evidence.mean, fitted.evidence.evaluations
    fitter.fit(fitted, 30, checkpoints=True)
    assert fitted.evidence.mean < before[0] and fitted.evidence.iterations == 30
    assert fitted.evidence.evaluations > before[1] + 30 * 256
    assert fitted.evidence.flops > 55 * fitted.evidence.evaluations
    spent = [checkpoint["evaluations"] for checkpoint in fitted.evidence.checkpoints]
    assert spent == sorted(spent) and len(set(spent)) == 4  # after the warm start, 4, 16 and 30 iterations


def test_a_network_imitates_the_previous_field():
    fitter = fitter_of("ball", warm_iterations=120, warm_points=256)
    ball = fitter.begin(candidate("sphere"), None)
    network = fitter.begin(candidate("network_2x32"), ball.model)
    assert network.evidence.mean < 3 * views_of("ball").footprint
    alone = fitter.begin(candidate("network_2x32"), None)
    assert alone.evidence.evaluations > network.evidence.evaluations  # this network fits a sphere first


@pytest.mark.slow
def test_growth_ends_on_a_sufficient_candidate():
    candidates = [candidate(name) for name in ("sphere", "box", "rounded_box", "network_1x16")]
    growth = grow(fitter_of("ball"), candidates, GROWTH)
    assert list(growth.fields) == ["sphere"] and len(growth.tried) == 1
    assert growth.overhead == 1
    boxed = grow(fitter_of("box"), candidates, GROWTH)
    assert list(boxed.fields) == ["sphere", "box"] and boxed.fitted.evidence.mean < views_of("box").footprint
    assert boxed.total("evaluations") > boxed.fitted.evidence.evaluations
    assert boxed.summary("auto")[0].startswith("field=auto: sphere -> box, 9 numbers, held-out error 0.0")


def test_growth_ends_with_its_budget():
    fitter = fitter_of("capsule", warm_iterations=20, iterations=10, warm_points=64)
    candidates = [candidate(name) for name in ("sphere", "box", "box", "box", "rounded_box")]
    two_more = 2.5 * cost(candidate("box"), 3, fitter) / cost(candidate("box"), 10, fitter)
    tight = grow(fitter, candidates, replace(GROWTH, patience=9, budget=1 + two_more))
    assert [evidence.candidate for evidence in tight.tried] == ["sphere", "box", "box"]
    small, large = candidates[0], candidate("network_8x256")
    assert cost(large, 3, fitter) > cost(small, 10, fitter) and cost(small, 3, fitter) < 0.5 * cost(large, 10, fitter)
    growth = grow(fitter, [small, large], replace(GROWTH, budget=1.5))
    assert [evidence.candidate for evidence in growth.tried] == ["sphere"]
    assert "larger ones would exceed models.growth.budget" in growth.summary("auto")[0]


def test_the_eikonal_term_is_the_squared_difference_of_slopes_from_one():
    observations, ball = views_of("ball").observations(0), sphere(0.5)
    for factor, expected in ((1, 0), (3, 4)):
        model = Model("network", [], lambda free, k=factor: Shape(lambda p: k * ball(p)), 0.1, metric=False)
        terms = FitProblem(model, observations, FIT, 0).loss(0)
        assert terms["eikonal"].item() == pytest.approx(expected, abs=1e-6)


def test_each_of_several_starts_is_tried_before_the_best_one_goes_on(monkeypatch):
    spent = []
    monkeypatch.setattr(Fitter, "_warm_start", lambda self, fitted, start, iterations: spent.append(iterations))
    fitter_of("box", warm_iterations=80).begin(candidate("union_3"), None, evaluate=False)
    assert len(spent) > 3 and spent == [80 // SCREENING] * (len(spent) - 1) + [80]


@each("spread, better", [(0.002, True), (-0.002, False)])
def test_a_candidate_is_better_beyond_the_noise_of_the_difference(spread, better):
    """The difference is the same in both cases: all groups agree on it, or they contradict each other."""
    old, new = (evidence_of("box", 9, error) for error in (an_error(0.01, 0.002), an_error(0.0095, spread)))
    assert _is_better(new, old) is better


def test_a_candidate_that_the_renderer_does_not_support_has_no_error():
    strict = SimpleNamespace(
        capabilities=Capabilities((Kind.DISTANCE,), field_gradient=True, ray_gradient=True),
        render=DIST.render,
        silhouette_loss=DIST.silhouette_loss,
    )
    fitter = fitter_of("ball", strict, warm_iterations=5)
    fitted = fitter.begin(candidate("superquadric"), None)
    fitter.fit(fitted, 5, checkpoints=False)
    assert (fitted.evidence.status, fitted.evidence.error, fitted.evidence.iterations) == ("unsupported", None, 0)
    assert "needs a distance field" in fitted.evidence.reason
    assert fitter.begin(candidate("sphere"), None).evidence.error is not None


def test_the_fraction_of_rays_follows_the_remaining_error():
    assert rays_share(0.1, 0.01, 0.02) == pytest.approx(0.25) and rays_share(0.1, 0.01, 0.5) == 0.1
    assert rays_share(0.1, 0.01, 0.001) == 1.0 and rays_share(0.1, 0.01, float("nan")) == 1.0
    coarse, full = fitter_of("capsule", warm_iterations=1, fewest_rays=0.1), fitter_of("capsule", warm_iterations=1)
    spent = []
    for fitter in (coarse, full):
        fitted = fitter.begin(candidate("sphere"), None)
        fitter.fit(fitted, 10, checkpoints=False)
        spent.append(fitted.evidence.evaluations)
    assert spent[0] < 0.6 * spent[1]


@each("name", ["dist", "dvr"])
def test_the_remaining_error_depends_on_the_depth_and_not_on_the_silhouette(name):
    """A cross entropy is no length. A correct shape needs all rays, and a missed shape needs the fewest."""
    observations = views_of("box", load("renderer", name)).observations(0)
    right, small = (
        observations.depth_error(observations.terms(shape, 0, 1.0)) for shape in (box((0.5, 0.3, 0.4)), sphere(0.2))
    )
    assert right < observations.footprint < small
    nothing = Shape(lambda p: 1 + 0 * p[..., 0], Kind.DISTANCE)
    assert observations.depth_error(observations.terms(nothing, 0, 1.0)) == np.inf


def test_a_renderers_random_draws_are_the_same_for_every_fit():
    dvr = load("renderer", "dvr", n_ray_samples=16, doublings=[])
    fitter, means = fitter_of("ball", dvr, warm_iterations=10), []
    for _ in range(2):
        fitted = fitter.begin(candidate("sphere"), None)
        fitter.fit(fitted, 4, checkpoints=False)
        means.append(fitted.model.parameters[0].tolist())
        torch.rand(3)
    assert means[0] == means[1]


def test_too_few_depths_to_hold_some_out_are_an_error():
    view = see(shape_of("box"), SAMPLER.camera(0.0, 20.0))
    few = view.mask & (view.mask.flatten().cumsum(0).view_as(view.mask) <= 2)
    view_with_few = ObservedView.of(view, WEIGHTS, DIST, observed=few, mask=None, device=CPU)
    with pytest.raises(ValueError, match="2 depths are too few to hold some out: give more"):
        hold_out(
            concatenate_views([view_with_few]),
            torch.arange(24 * 24) // 96,
            share=0.2,
            entire=(),
            footprint=0.02,
            seed=0,
        )


def test_half_of_the_points_of_a_warm_start_lie_near_the_surface():
    far = torch.tensor([[0.0, 0.0, 9.0]])  # outside the sphere of the other points
    scattered = scatter_points(far, 100, torch.Generator().manual_seed(0))
    assert int(((scattered - far).norm(dim=1) < 0.5).sum()) == 50
    assert int((scattered.norm(dim=1) <= 1.1).sum()) == 50


def test_a_warm_start_counts_evaluations_of_the_previous_field():
    fitter = fitter_of("ball", warm_iterations=10)
    ball = fitter.begin(candidate("sphere"), None)
    grid = fitter.begin(candidate("grid_16"), ball.model)
    # Those of the sphere are of each iteration, the warm-up, the final loss, and the grid.
    assert grid.evidence.evaluations == 10 * 128 + 12 * 128 + 16**3
    network = fitter.begin(candidate("network_1x16"), ball.model)
    assert network.evidence.evaluations == 10 * 128 + 12 * 128
    assert network.evidence.flops > 10 * 128 * (10 + candidate("network_1x16").flops)


def test_a_union_has_a_box_at_each_cluster_also_if_it_is_small():
    two = torch.cat([torch.randn(30, 3) * 0.02 + 0.6, torch.tensor([[-0.7] * 3, [-0.72] * 3])])
    for start in candidate("union_2").starts(StartInputs(two, None, 0, CPU)):
        middles = start.parameters[0][:, :3].mean(1).sort().values
        assert middles.tolist() == pytest.approx([-0.71, 0.6], abs=0.05)


# On fandisk, both are under half a pixel: the grid has fewer free numbers, the network fewer stored ones.
GRID, NETWORK = Size(free=4_427, stored=32_768, sparse_bytes=40_000), Size(free=12_801, stored=12_801)


@each("measure, chosen", [("free", "grid_32"), ("stored", "network_4x64"), ("bytes", "network_4x64")])
def test_free_and_stored_numbers_disagree_and_the_measure_decides(measure, chosen):
    assert str(GRID) == "32,768 numbers, 4,427 of them free" and str(NETWORK) == "12,801 numbers"
    fits = [evidence_of("grid_32", GRID, an_error(0.008)), evidence_of("network_4x64", NETWORK, an_error(0.009))]
    choice = choose(fits, 0.01, measure)
    assert (choice.chosen.candidate, choice.measure, choice.best.candidate) == (chosen, measure, "grid_32")


def test_candidates_are_tried_in_the_order_of_the_measure():
    names = ("sphere", "ellipsoid", "box", "network_2x64", "grid_32", "network_4x64", "network_4x128")
    by_stored = (*names[:4], "network_4x64", "grid_32", "network_4x128")
    assert [tried.name for tried in by_size(names, "free")] == list(names)
    for measure in ("stored", "bytes"):
        assert [tried.name for tried in by_size(names, measure)] == list(by_stored)


@pytest.mark.slow
def test_a_candidate_begins_from_the_best_and_an_unchanged_refit_equals_the_fit():
    fitter = fitter_of("box", iterations=6, warm_iterations=60)
    fits = list(fit_all(fitter, [candidate(name) for name in ("box", "sphere", "grid_8")]))
    assert fits[0].evidence.mean < fits[1].evidence.mean
    assert [fitted.previous for fitted in fits] == [None, fits[0].model, fits[0].model]
    first, second = fits[2].evidence, refit(fits[2], fitter, DIST, fewest_rays=1.0)
    assert (second.mean, second.evaluations, second.flops) == (first.mean, first.evaluations, first.flops)


@pytest.mark.slow
@each("shape, name, rounds, falling", [("ball", "sphere", 6, False), ("capsule", "network_2x32", 2, True)])
def test_a_fit_continues_while_its_error_falls_and_states_if_it_was_stopped(shape, name, rounds, falling):
    torch.manual_seed(0)
    fitter = fitter_of(shape, iterations=8, warm_iterations=20)
    fitted = fitter.begin(candidate(name), None)
    fitter.finish(fitted, rounds)
    assert fitted.evidence.falling is falling is (fitted.evidence.iterations == 8 * 2 ** (rounds - 1))
    left = fitter.observations.error(fitted.model.frozen())
    assert left.mean == pytest.approx(fitted.evidence.mean)


def test_a_first_round_is_kept_although_the_warm_start_imitates_a_better_field():
    fitter = fitter_of("ball", iterations=8, warm_iterations=200)
    fitted = fitter.begin(candidate("network_2x32"), fitter.begin(candidate("sphere"), None).model)
    imitation = fitted.evidence.mean
    fitter.finish(fitted, 1)
    assert fitted.evidence.mean > imitation and fitted.evidence.iterations == 8


def test_the_seconds_of_a_fit_continue_those_of_its_trial():
    """In the second part the seconds begin at 0 again."""
    rows = [("box", "warm", 9.0), ("box", "fit", 1.0), ("box", "fit", 2.5), ("sphere", "fit", 7.0), ("box", "fit", 0.5)]
    lines = [{"candidate": name, "phase": phase, "part": "growth", "seconds": n, "total": n} for name, phase, n in rows]
    curve = rendered_curve(lines, "box")
    assert [(point["iteration"], point["seconds"], point["total"]) for point in curve] == [
        (0, 1.0, 1.0), (1, 2.5, 2.5), (2, 3.0, 0.5),
    ]  # fmt: skip
