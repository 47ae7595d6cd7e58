"""Scenes of the stress atlas: closed-form ground truth, success criteria, distortions, and disturbed fits."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from safetensors.torch import load_file

from bench.config import build, load
from bench.machine.limits import LimitReached, Limits
from bench.records.record import RunStatus
from bench.shape_prior import SHIPPED, Prior
from bench.solve.optimise import History
from bench.tables import choice, names
from bench.tasks.stability import fit
from bench.tasks.stability.axes import Stress, Sweep
from bench.tasks.stability.fit import OCCLUDER_RADIUS, Occluder, _failure, judge_fit
from bench.tasks.stability.judge import judge_gradient, judge_rendering, truth
from bench.tasks.stability.scenes import CAMERA_DISTANCE, SCENES
from bench.tasks.stability.search import Bisection, Search, SearchSettings
from bench.tasks.stability.solids import box, half_space, rod, sphere_solid
from bench.tasks.stability.trial import Conditions, Criteria, Failure, FitSettings
from renderers.camera import Rays
from renderers.fields.analytic import plane
from renderers.fields.mlp import Decoder
from renderers.rendering import Status, Unsupported
from renderers.silhouette import Own
from renderers.tracing import reference
from tests.looped import each
from tests.tiny import CPU, Blind, ball_prior, camera_of

CRITERIA = Criteria(hits=0.99, false_hits=0.01, cosine=0.99, scale=0.1, surface_error=0.02)
LIMITS = Limits(1e8, 8)
FIT = FitSettings(12, 30, 0.02, "depth", 10.0, Own(), 10.0, 1.0)
BALL = ball_prior()
NAMES = [name for name in names("stress") if name != "none"]


def stress_named(name: str) -> Stress:
    return build(OmegaConf.create(choice("stress", name)), "task.stress", target="bench.tasks.stability.axes.Stress")


def conditions(resolution: int = 32) -> Conditions:
    return Conditions(resolution, FIT, CRITERIA, LIMITS, CPU, BALL)


def sofa_prior() -> Prior:
    """The shipped prior of sofas."""
    tensors = load_file(SHIPPED / "sofa-9f2350f923ef.safetensors")
    codes = tensors.pop("codes")
    decoder = Decoder(layers=4, width=128, code_length=64, skip=2, narrow=False)
    decoder.load_state_dict(tensors)
    return Prior(decoder.requires_grad_(False), codes)


def drawn(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def random_rays(n: int, seed: int) -> Rays:
    draw = torch.Generator().manual_seed(seed)
    origins = 1.5 * torch.nn.functional.normalize(torch.randn(n, 3, generator=draw, dtype=torch.float64), dim=-1)
    targets = 0.6 * torch.rand(n, 3, generator=draw, dtype=torch.float64) - 0.3
    return Rays(origins, torch.nn.functional.normalize(targets - origins, dim=-1))


SOLIDS = {
    "ball": sphere_solid(0.4),
    "box": box((0.3, 0.2, 0.4)),
    "half space": half_space((0.0, 2.0, 0.0), 0.1),
    "rod": rod(0.2, 0.5),
    "union": sphere_solid(0.3).moved((0.2, 0.0, 0.0)) | box((0.2,) * 3),
    "difference": box((0.4,) * 3) - sphere_solid(0.5),
    "shell without a corner": (sphere_solid(0.5) - sphere_solid(0.4)) - box((0.5,) * 3).moved((0.5, 0.5, 0.5)),
    "turned": (rod(0.1, 0.4) | rod(0.1, 0.4).moved((0.3, 0, 0))).turned(
        torch.linalg.matrix_exp(torch.tensor([[0, 0.3, 0.1], [-0.3, 0, 0.5], [-0.1, -0.5, 0]], dtype=torch.float64))
    ),
}


@each("name", SOLIDS)
def test_the_closed_form_agrees_with_the_reference_tracer(name):
    solid, rays = SOLIDS[name], random_rays(2000, 0)
    first = solid.trace(rays)
    judged = reference.trace(solid.field, rays, lipschitz=1.0, least_step=2e-4, radius=1.0)
    assert (first.hit != judged.hit).sum() <= 2  # rays that touch an edge
    both = first.hit & judged.hit
    assert both.sum() > 100 and (first.distance - judged.distance)[both].abs().max() < 1e-5
    assert torch.equal(first.inside, judged.status == Status.STARTED_INSIDE)


@each("name", [name for name in NAMES if stress_named(name).measure != "fit"])
def test_a_careful_renderer_succeeds_at_the_mild_end_of_each_stress(name):
    stress = stress_named(name)
    dist = stress.setting == "alpha" or stress.group == "network"  # IDR has too few steps for outlines
    renderer = load("renderer", "dist" if dist else "idr")
    if stress.setting == "n_ray_samples":
        renderer = load("renderer", "dvr")
    assert any(stress.trial(renderer, 0.0, repeat, conditions(48)).success for repeat in range(3))


@each("name", [name for name in NAMES if stress_named(name).measure != "fit"])
def test_every_stress_has_the_same_trial_for_every_renderer(name):
    stress = stress_named(name)
    severity = stress.sweep.severity(0.3)
    first_exam, second_exam = (stress.exam_generator(conditions())(severity, drawn(0), 24) for _ in range(2))
    assert torch.equal(first_exam.camera.world_to_camera, second_exam.camera.world_to_camera)
    first, again = truth(first_exam)[0], truth(second_exam)[0]
    assert torch.equal(first.hit, again.hit)


def test_a_truncated_network_stops_a_march_before_its_surface():
    scene = stress_named("truncated_network")
    for severity, succeeds in ((scene.sweep.mild, True), (scene.sweep.severe, False)):
        exam = scene.exam_generator(conditions(64))(severity, drawn(), 64)
        assert judge_rendering(exam, load("renderer", "dist"), conditions()).success == succeeds


def test_a_floater_is_hit_by_samples_and_missed_by_a_march():
    """A sphere of radius 0.9 x 0.03 in front of a cube covers 0.09 of the image."""
    exam = SCENES["floaters"](0.03, drawn(), 48)
    exact = truth(exam)[0]
    in_front = exact.distance < CAMERA_DISTANCE - 0.81 + 0.03
    assert in_front.double().mean() == pytest.approx(np.pi / 4 / 9, rel=0.3)
    rays = exam.camera.rays().flat()
    share = {}
    for name in ("dist", "newton", "dvr"):
        rendering = load("renderer", name).render(exam.field, rays)
        near = (rendering.distance - exact.distance).abs() < 0.01
        share[name] = float((rendering.hit & near)[in_front].double().mean())
    assert share["dist"] < 0.1 and share["newton"] < 0.1 and share["dvr"] > 0.9


def test_errors_of_a_mask_are_of_both_kinds():
    mask = torch.zeros(40, 40, dtype=torch.bool)
    mask[:, :20] = True
    observation = fit.Observation(camera_of(40), torch.ones(40, 40), mask, mask)
    wrong = fit.mask_errors(observation, 0.3, drawn()).mask ^ mask
    assert wrong[:, :20].double().mean() == pytest.approx(0.3, abs=0.08)
    assert wrong[:, 20:].double().mean() == pytest.approx(0.3, abs=0.08)


def outcome_of(stress: Stress, level: float, repeat: int) -> dict[str, float]:
    """The numbers that decide the success of a trial."""
    renderer = load("renderer", "dvr" if stress.setting == "n_ray_samples" else "dist")
    resolution = 128 if stress.group == "network" else 32  # networks are rendered at a quarter of it
    tiny = replace(conditions(resolution), fit=replace(FIT, resolution=8, iterations=1))
    numbers = stress.trial(renderer, level, repeat, tiny).numbers
    if stress.measure == "fit":
        return numbers
    return {name: n for name, n in numbers.items() if name not in ("evaluations_per_ray", "hits")}


@pytest.mark.slow
@each("name", NAMES)
def test_repeats_of_a_trial_have_other_outcomes_or_there_is_one_trial(name):
    stress = stress_named(name)
    levels = np.linspace(1, 0, 6 if stress.repeats is None else 3)
    differ = any(outcome_of(stress, level, 0) != outcome_of(stress, level, 1) for level in levels)
    assert differ == (stress.repeats is None)


MOVED = {
    "perturbed": 0.1,
    "quantised": 0.1,
    "coarse_floats": 3,
    "noisy_weights": 0.3,
    "coarse_weights": 3,
    "far_code": 3,
}


@pytest.mark.parametrize("names", [["perturbed", "far_code"], pytest.param([*MOVED], marks=pytest.mark.slow)])
def test_the_ground_truth_of_a_moved_surface_is_the_zero_of_the_disturbed_field(names):
    for name in names:
        check_moved(name, MOVED[name])


def check_moved(name: str, severity: float) -> None:
    before = {key: tensor.clone() for key, tensor in BALL.decoder.state_dict().items()}
    exam = stress_named(name).exam_generator(conditions())(severity, drawn(), 20)
    assert all(torch.equal(tensor, before[key]) for key, tensor in BALL.decoder.state_dict().items())
    assert judge_rendering(exam, load("renderer", "dvr", n_ray_samples=512), conditions()).success
    first, rays = truth(exam)[0], exam.camera.double().rays().flat()
    steps = torch.linspace(1.6, 3.2, 1601, dtype=torch.float64)  # 0.001 apart
    field = exam.field if name in SCENES else exam.truth.field  # a network takes float32
    inside = torch.stack([field(rays.at(step.expand(len(first.hit)))) <= 0 for step in steps], dim=1)
    hit, distance = inside.any(dim=1), steps[inside.to(torch.uint8).argmax(dim=1)]
    outside = ~first.inside
    assert (hit != first.hit)[outside].sum() <= 3  # thinner than the samples
    behind = (distance - first.distance)[outside & hit & first.hit]
    assert behind.quantile(0.95) <= 0.00101 and behind.quantile(0.05) >= -1e-6


def test_pixels_are_counted_by_kind_of_error():
    exam = SCENES["cube"](1.0, drawn(), 32)
    good = judge_rendering(exam, load("renderer", "idr"), conditions())
    assert good.success and good.numbers["hits"] > 200
    short = judge_rendering(exam, load("renderer", "idr", steps=3), conditions())
    assert short.failure is Failure.LOST and short.numbers["lost"] == (short.images["kinds"] == 2).sum() > 200
    wide = judge_rendering(exam, load("renderer", "idr", epsilon=0.05), conditions())
    assert wide.failure is Failure.FALSE and wide.numbers["false"] == (wide.images["kinds"] == 3).sum() > 20


def test_spurious_hits_are_judged_by_their_share_of_the_hits():
    exam, renderer = SCENES["wires"](0.05, drawn(), 32), load("renderer", "idr", epsilon=0.005)
    numbers = judge_rendering(exam, renderer, conditions()).numbers
    of_hits, of_rays = numbers["false"] / numbers["hits"], numbers["false"] / 32**2
    assert 0 < of_rays < of_hits
    for allowed, failure in (((of_rays + of_hits) / 2, Failure.FALSE), (1.01 * of_hits, Failure.NONE)):
        judged = replace(conditions(), criteria=replace(CRITERIA, false_hits=allowed))
        assert judge_rendering(exam, renderer, judged).failure is failure


def test_gradients_are_those_of_the_closed_form():
    exam = SCENES["grazing_plane"](30.0, drawn(), 24)
    exact = judge_gradient(exam, load("renderer", "dvr"), conditions())
    assert exact.success and exact.numbers["gradient_cosine"] == pytest.approx(1, abs=1e-6)
    biased = judge_gradient(exam, load("renderer", "dist"), conditions())
    assert biased.failure is Failure.SCALE
    assert biased.numbers["gradient_scale"] == pytest.approx(1.5 * np.sin(np.radians(30)), rel=0.05)  # alpha K cos


@each("name", ["grazing_gradient", "depth_noise"])
def test_a_renderer_without_a_gradient_is_unsupported(name):
    with pytest.raises(Unsupported, match="Blind has no gradient towards the field"):
        stress_named(name).trial(Blind(), 0.0, 0, conditions())


def test_a_severity_may_be_a_setting_of_the_renderer():
    epsilon = stress_named("epsilon")
    assert epsilon.stressed(load("renderer", "idr"), 0.01).epsilon == 0.01
    assert stress_named("few_steps").stressed(load("renderer", "idr"), 12.4).steps == 12
    assert stress_named("few_steps").stressed(load("renderer", "idr"), 0.3).steps == 1  # 0 is invalid
    with pytest.raises(Unsupported, match="DVR has no epsilon, or it is null: choose another"):
        epsilon.stressed(load("renderer", "dvr"), 0.01)
    with pytest.raises(Unsupported, match="Naive has no n_gradient_samples, or it is null"):  # it is unrolled
        stress_named("gradient_samples").stressed(load("renderer", "naive"), 3.0)
    practical = load("renderer", "naive", gradient="practical", n_gradient_samples=1)
    assert stress_named("gradient_samples").stressed(practical, 2.6).n_gradient_samples == 3


@pytest.mark.slow
@each("scene", ["depth_noise", "wrong_pose"])
def test_a_disturbed_fit_ends_further_off(scene):
    renderer, few = load("renderer", "dist"), replace(conditions(), fit=replace(FIT, resolution=12, iterations=30))
    mild, severe = (
        judge_fit(scene, severity, drawn(), renderer=renderer, conditions=few)
        for severity in (1e-6, 0.5 if scene != "wrong_pose" else 60.0)
    )
    assert mild.success and severe.numbers["surface_error"] > mild.numbers["surface_error"]


@pytest.mark.slow
@each(
    "name, repeat",
    [("growing_slope", 0), ("new_hole", 0), ("outside_family", 0), ("thin_parts", 0), ("one_sided_views", 0),
     ("occlusion", 2)],
)  # fmt: skip
def test_a_fit_of_a_code_succeeds_at_the_mild_end_and_fails_at_the_severe_one(name, repeat):
    stress = stress_named(name)
    held = replace(
        conditions(), prior=sofa_prior(), fit=replace(FIT, resolution=20, silhouette=load("silhouette", "hinge"))
    )
    mild, severe = (stress.trial(load("renderer", "dist"), level, repeat, held) for level in (0.0, 1.0))
    assert mild.success and severe.numbers["surface_error"] > 2 * mild.numbers["surface_error"]
    assert not severe.success


def test_an_occluder_is_a_ball_at_first_and_at_last_its_front_does_not_change_when_it_moves():
    axes, middle, far = torch.eye(3), torch.tensor([0.1, 0.2, 0.3]), plane(offset=-9.0)
    points = torch.rand(50, 3) - 0.5
    moved = torch.tensor([0.05, -0.02])
    ball = Occluder(middle, axes, OCCLUDER_RADIUS).applied(far, moved)
    center = middle + torch.tensor([0.05, 0.0, -0.02])
    torch.testing.assert_close(ball(points), torch.linalg.vector_norm(points - center, dim=-1) - OCCLUDER_RADIUS)
    front = middle + torch.tensor([0.0, OCCLUDER_RADIUS, 0.0])
    for rounding, slope in ((0.02 * OCCLUDER_RADIUS, 0.0), (OCCLUDER_RADIUS, 1e-2)):
        position = moved.clone().requires_grad_()
        Occluder(middle, axes, rounding).applied(far, position)(front).backward()
        assert (position.grad.norm() > slope) == (slope > 0)


def test_evaluations_of_a_trial_are_limited_over_all_iterations_of_a_fit():
    held = replace(conditions(), limits=Limits(1, 8))
    assert stress_named("thin_plate").trial(load("renderer", "idr"), 0.0, 0, held).failure is Failure.TIMEOUT
    fit = replace(FIT, resolution=12, iterations=10)

    def spent(limits: Limits) -> float:
        held = replace(conditions(), limits=limits, fit=fit)
        fitted = judge_fit("a_code", 0.0, drawn(), renderer=load("renderer", "dist"), conditions=held)
        return fitted.numbers["evaluations_per_ray"] * fit.resolution**2

    one_in_five = Limits(int(spent(LIMITS) * fit.iterations / 5), 8)
    with pytest.raises(LimitReached, match="field values"):
        spent(one_in_five)


def test_a_fit_fails_where_its_error_is_above_the_largest():
    assert _failure(History(), 0.05, 0.05) is Failure.NONE
    assert _failure(History(), 0.051, 0.05) is Failure.NOT_REACHED
    assert _failure(History(), float("nan"), 0.05) is Failure.NAN
    assert _failure(History(status=RunStatus.DIVERGED), 0.01, 0.05) is Failure.DIVERGED


def test_sweeps_and_stresses_are_checked():
    assert Sweep(0.1, 0.001, log=True, unit="m").severity(0.5) == pytest.approx(0.01)
    assert Sweep(2.0, 4.0, log=False, unit="m").severity(0.25) == 2.5
    with pytest.raises(ValueError, match=r"log needs positive ends: set log=false"):
        Sweep(0.0, 1.0, log=True, unit="m")
    with pytest.raises(ValueError, match="must have two finite ends that differ"):
        Sweep(1.0, 1.0, log=False, unit="m")
    with pytest.raises(ValueError, match=r"task\.stress\.scene must be one of"):
        Stress("nowhere", "rendering", "viewing", Sweep(1.0, 2.0, log=False, unit="m"))
    with pytest.raises(ValueError, match=r"task\.stress\.repeats must be 1 or null, not 3"):
        Stress("wires", "rendering", "viewing", Sweep(1.0, 2.0, log=False, unit="m"), repeats=3)


DESK = SearchSettings(levels=33, repeats=5)


def searched(settings: SearchSettings, succeeds) -> Search:
    search = Search(settings)
    while (level := search.next()) is not None:
        search.note(level, bool(succeeds(float(search.levels[level]))))
    return search


@each("middle", [0.05, 0.31, 0.5, 0.77, 0.95])
def test_a_sharp_breakdown_lies_in_a_short_interval(middle):
    search = searched(DESK, lambda level: level < middle)
    result = search.result()
    assert result.low <= middle <= result.high and result.low <= result.level <= result.high
    assert result.high - result.low < 0.08 and len(search.trials) < 25


@each("width, least", [(0.02, 0.9), (0.08, 0.8)])
def test_the_interval_of_a_noisy_breakdown_holds(width, least):
    generator = np.random.default_rng(1)
    holds = 0
    for _ in range(20):
        middle = generator.uniform(0.1, 0.9)
        search = searched(
            DESK, lambda level, m=middle: generator.random() < 1 / (1 + np.exp(np.clip((level - m) / width, -50, 50)))
        )
        result = search.result()
        holds += result.low <= middle <= result.high
        assert len(search.trials) <= search.max_trials
    assert holds / 20 >= least


def bisected(succeeds, levels: int = 33) -> Bisection:
    search = Bisection(SearchSettings(levels, 5))
    while (level := search.next()) is not None:
        assert level not in search.outcomes  # a level is tried once
        search.note(level, bool(succeeds(float(search.levels[level]))))
    return search


@each("levels", [3, 9, 17, 33])
@each("middle", [0.01, 0.31, 0.5, 0.77, 0.999])
def test_without_repeats_the_breakdown_lies_between_neighbours_and_has_no_interval(middle, levels):
    search = bisected(lambda level: level < middle, levels)
    result = search.result()
    assert abs(result.level - middle) <= 0.5 / (levels - 1) + 1e-12
    assert (result.low, result.high, result.width) == (None, None, None)
    assert len(search.outcomes) <= search.max_trials < levels + 1 == search.grid_trials + 1


def test_without_repeats_an_end_is_tried_once():
    for succeeds, level in ((True, 1 + 0.5 / 32), (False, -0.5 / 32)):
        search = bisected(lambda level_tried, succeeds=succeeds: succeeds)
        assert search.result().level == pytest.approx(level)
        assert search.outcomes == {0: succeeds, 32: succeeds}
    assert bisected(lambda level: level > 0.5).result().level < 0  # a failure at the mild end decides
