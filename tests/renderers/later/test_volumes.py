"""Volume and band renderers: the claims of their papers, in numbers, and reported faults."""

from dataclasses import replace
from math import pi

import pytest
import torch
from torch import Tensor
from torch.nn.functional import l1_loss

from bench.config import load
from renderers.camera import Rays, sphere_span
from renderers.field import Meter
from renderers.fields.analytic import Shape, box, plane, sphere
from renderers.later.relaxed_boundary import _parabola_vertex
from renderers.later.volsdf import OpacityErrorBound, _clearance, _log_transmittance
from renderers.later.volumes import Samples, resample, weights
from renderers.rendering import Blurred, Status, Volume, at_iteration
from renderers.tracing.bracket import equally_spaced
from tests.renderers.analytic_cases import CASES, Case, sheet, vector

NEUS, VOLSDF, UNISURF, OPAQUE = (load("renderer", name) for name in ("neus", "volsdf", "unisurf", "opaque"))
BAND = load("renderer", "relaxed_boundary")
VOLUMES = pytest.mark.parametrize(
    "renderer", [NEUS, VOLSDF, UNISURF, OPAQUE], ids=lambda renderer: type(renderer).__name__
)
BLURRED = pytest.mark.parametrize(
    "renderer", [NEUS, VOLSDF, UNISURF, OPAQUE, BAND], ids=lambda renderer: type(renderer).__name__
)
PLANES = [case for case in CASES if case.name.startswith("plane")]


def parallel(side: int, half: float = 0.8) -> Rays:
    """A square grid of rays along z, in float64."""
    centres = half * ((torch.arange(side, dtype=torch.float64) + 0.5) / side * 2 - 1)
    return replace(sheet(centres, centres), image=False)


def meeting(side: int) -> tuple[Rays, Tensor, Tensor]:
    """The parallel rays that meet the unit sphere, and where they enter and leave it."""
    rays = parallel(side).flat()
    entry, leave, meets = sphere_span(rays)
    return rays[meets], entry[meets], leave[meets]


def error(renderer: Blurred, case: Case, blur: float) -> float:
    """The distance of a hit behind the surface, in units of the blur."""
    rendering = renderer.with_blur(blur).render(case.field(), case.rays())
    assert rendering.status.item() == Status.HIT
    return (rendering.distance.item() - case.distance) / blur


@pytest.mark.parametrize("case", PLANES, ids=lambda case: case.name)
def test_neus_is_unbiased_and_volsdf_is_not(case):
    """NeuS, Sec. 3.1: the weight of a plane is greatest at the surface; here also its mean lies there."""
    fine = replace(NEUS, samples=4000, rounds=0)  # equally spaced, so that weights are densities
    assert abs(error(fine, case, 0.01)) < 5e-4
    weight = fine.with_blur(0.01).render(case.field(), case.rays()).volume
    assert weight.distance[weight.weight.argmax()].item() == pytest.approx(case.distance, abs=2.5e-4)
    off = error(replace(VOLSDF, fine_samples=512), case, 0.01)  # positive behind the surface; in front of it at a slant
    assert off == pytest.approx({1.0: 0.36, 0.8: 0.06, 0.28: -4.06}[case.cosine], abs=0.02)


@pytest.mark.parametrize("anisotropy", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("case", PLANES, ids=lambda case: case.name)
def test_delta_normals_of_an_opaque_solid_are_unbiased_and_uniform_ones_are_not(case, anisotropy):
    """Between both, the mean of a plane's weights lies behind a frontal plane and in front of an oblique one."""
    renderer = replace(OPAQUE, anisotropy=anisotropy)
    off = {0.0: (0.70, 0.57, -1.71), 0.5: (0.27, 0.24, -1.02), 1.0: (0.0, 0.0, 0.0)}[anisotropy]
    expected = dict(zip((1.0, 0.8, 0.28), off, strict=True))[case.cosine]
    assert error(replace(renderer, samples=4000, rounds=0), case, 0.01) == pytest.approx(expected, abs=0.01)
    assert error(renderer, case, 0.01) == pytest.approx(expected, abs=0.02)  # its 128 samples are enough


@pytest.mark.parametrize("anisotropy", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("slope", [-0.9, -0.2, 0.0, 0.4], ids=str)
def test_the_attenuation_of_an_interval_is_its_integral(anisotropy, slope):
    """Of values that are linear along the ray, against 20,001 samples of the attenuation, from 9 to -5 deviations."""
    renderer = replace(OPAQUE, anisotropy=anisotropy, sharpness=50.0)
    start = torch.linspace(0.18, -0.1, 9, dtype=torch.float64)
    ends = torch.stack([start, start + 0.03 * slope], dim=1)
    fraction = torch.linspace(0, 1, 20_001, dtype=torch.float64)
    values = 50 * (ends[:, :1] + fraction * (ends[:, 1:] - ends[:, :1]))
    normal = torch.distributions.Normal(vector(0), vector(1))
    rate = 50 * normal.log_prob(values).exp() / normal.cdf(values)
    truth = -(anisotropy * abs(slope) + (1 - anisotropy) / 2) * torch.trapezoid(rate, 0.03 * fraction, dim=1)
    actual = renderer._log_transmittance(ends, vector((0.0, 0.03)).expand(9, 2))
    torch.testing.assert_close(actual.squeeze(1), truth, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_opaque_solid_has_finite_weights_and_gradients_at_every_value(dtype):
    values = torch.tensor([[1.0, 0.5, 0.5, 1e-9, 0.0, -1e-9, -0.4, -0.4, -1.0, 1.0]], dtype=dtype, requires_grad=True)
    distances = torch.linspace(0, 2, 10, dtype=dtype)[None]
    passing = replace(OPAQUE, sharpness=1e4)._log_transmittance(values, distances)
    assert passing.isfinite().all() and (passing <= 0).all()
    (gradient,) = torch.autograd.grad(weights(passing).square().sum() + passing[:, :5].sum(), values)
    assert gradient.isfinite().all() and gradient.any()


@pytest.mark.parametrize(
    ("width", "error_bound"), [(0.05, 0.01), (0.01, 0.1), pytest.param(0.002, 0.01, marks=pytest.mark.slow)]
)
def test_volsdf_bounds_the_error_of_the_opacity(width, error_bound):
    """VolSDF, Theorem 1 and Algorithm 1, against 20,000 samples of the opacity along each ray."""
    renderer = replace(VOLSDF, error=error_bound, rounds=8).with_blur(width)
    rays, entry, leave = meeting(8)
    for field in (sphere(0.5), box((0.3, 0.5, 0.02))):
        sharp, indices = 0, []
        for index, samples, reached in renderer.bounded_samples(field, rays, entry, leave):
            dense = Samples.of(field, rays[index], equally_spaced(entry[index], leave[index], 20_000))
            truth, opacity = (
                1 - _log_transmittance(s.value, s.distance, reached)[:, :-1].cumsum(dim=1).exp()
                for s in (dense, samples)
            )
            rank = torch.searchsorted(dense.distance, samples.distance[:, 1:].contiguous()).clamp_max(19_999) - 1
            off = (opacity - truth.gather(1, rank.clamp_min(0))).abs()
            assert off.numel() == 0 or off.max() <= error_bound
            sharp += int((reached == width).sum())
            indices += index.tolist()
        assert sorted(indices) == list(range(len(entry)))
        assert sharp / len(entry) > (0.9 if error_bound == 0.1 else 0.5)  # the other rays have a greater width


def test_the_width_at_which_volsdf_begins_bounds_the_error_of_any_field():
    """Lemma 2 holds for few samples and any values; this field leaves no space for a large step."""
    renderer = replace(VOLSDF, samples=3, rounds=0, error=0.1)
    field = Shape(lambda p: torch.where((20 * p[..., 2]).round() % 2 == 0, 0.7, -0.001), sphere(0.5).kind)
    for _, samples, width in renderer.bounded_samples(field, *meeting(6)):
        assert (OpacityErrorBound.of(samples).max_error(width) <= renderer.error).all()


def test_the_clearance_of_volsdf_is_that_of_the_empty_spheres_about_both_ends():
    """VolSDF, Eq. 12, against a dense search on the outline of two circles for the point closest to the segment."""
    for side, first, second in ((1.0, 0.9, 0.6), (0.3, 0.7, 0.5), (0.5, 0.8, 0.35), (1.0, 0.4, 0.5)):
        for radii in ((first, second), (second, first)):
            samples = Samples(vector((0.0, side))[None], vector(radii)[None])
            angle = torch.linspace(0, pi, 200_001, dtype=torch.float64)
            ends = zip((0.0, side), radii, strict=True)
            circles = [torch.stack([end + radius * angle.cos(), radius * angle.sin()]) for end, radius in ends]
            across, up = torch.cat(circles, dim=1)
            outside = (across.hypot(up) >= radii[0] - 1e-9) & ((across - side).hypot(up) >= radii[1] - 1e-9)
            truth = (across - across.clamp(0, side)).hypot(up)[outside].min().item()
            assert _clearance(samples).item() == pytest.approx(truth, abs=1e-5), (side, radii)


@pytest.mark.slow
def test_a_grazing_ray_of_volsdf_has_at_most_five_rounds_of_samples():
    """The official code has 128 samples in each of five rounds, 64 and 32 for the integral, and the two ends."""
    meter = Meter(sphere(0.5))
    VOLSDF.render(meter, Rays(torch.tensor([[0.4995, 0.0, -2.0]]), torch.tensor([[0.0, 0.0, 1.0]])))
    assert 5 * 128 + 64 + 32 <= meter.counts.value <= 5 * 128 + 64 + 32 + 2


@pytest.mark.parametrize(("renderer", "least"), [(VOLSDF, 1.0), (load("renderer", "volsdf_budget"), 0.6)])
def test_the_presets_of_volsdf_bound_the_error_on_a_fraction_of_the_rays(renderer, least):
    for field in (sphere(0.5), box((0.3, 0.5, 0.02))):
        batches = renderer.bounded_samples(field, *meeting(12))
        reached = torch.cat([(width == renderer.width).flatten() for _, _, width in batches])
        assert len(reached) == len(meeting(12)[1]) and reached.double().mean() >= least


def area_rates(renderer, radius: float, side: int) -> tuple[float, float, float]:
    """The visible area of a sphere, its derivative with respect to the radius, and the noise per ray."""
    leaf = torch.tensor(radius, dtype=torch.float64, requires_grad=True)
    rays = parallel(side)
    opacity = renderer.render(sphere(leaf), rays).opacity.flatten()
    weights = torch.ones_like(opacity).requires_grad_(True)
    (rate,) = torch.autograd.grad(opacity, leaf, weights, create_graph=True)
    (ray_rates,) = torch.autograd.grad(rate, weights)
    cell = (1.6 / side) ** 2
    return cell * opacity.sum().item(), cell * rate.item(), ray_rates.std().item()


@pytest.mark.parametrize(("blur", "side"), [(0.1, 200), pytest.param(0.01, 400, marks=pytest.mark.slow)])
def test_the_band_carries_the_gradient_of_the_silhouette_with_the_bias_of_its_width(blur, side):
    """The area of a circle grows by its circumference, at a radius half a band larger (Wang et al. 2024, Sec. 4).

    The noise grows as the band gets thinner.
    """
    area, rate, noise = area_rates(BAND.with_blur(blur), 0.5, side)
    assert area == pytest.approx(pi * 0.25, rel=0.01)
    assert rate == pytest.approx(2 * pi * (0.5 + blur / 2), rel=0.01)
    assert noise > area_rates(BAND.with_blur(2 * blur), 0.5, side)[2]


@pytest.mark.slow
@pytest.mark.parametrize(("renderer", "ratio", "margin"), [
    (NEUS, 1.0, 0.01), (VOLSDF, 1.05, 2.9), (UNISURF, 1.08, 2.97), (OPAQUE, 1.03, 1.39),
    (replace(OPAQUE, anisotropy=0.0), 1.04, 1.70), (replace(OPAQUE, anisotropy=1.0), 1.03, 0.56),
], ids=lambda renderer: type(renderer).__name__)  # fmt: skip
def test_opacity_carries_the_gradient_of_a_silhouette_that_density_outside_makes_larger(renderer, ratio, margin):
    """The margin is in units of the blur: except for NeuS, density outside absorbs light along a close ray."""
    area, rate, _ = area_rates(renderer.with_blur(0.01), 0.5, side=120)
    assert rate / (2 * pi * 0.5) == pytest.approx(ratio, abs=0.01)
    assert (area - pi * 0.25) / (pi * 0.01) == pytest.approx(margin, abs=0.02)


def test_the_weight_of_a_surface_that_enters_the_view_replaces_that_of_the_wall():
    """A ray passes close to a sphere in front of a wall: the weight of the sphere grows as that of the wall falls."""
    leaf = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    field = Shape(lambda p: torch.minimum(sphere(leaf)(p), plane((0.0, 0.0, -1.0), -0.6)(p)), sphere(0.3).kind, 1.0)
    ray = Rays(vector((0.304, 0, -2))[None], vector((0, 0, 1))[None])
    rendering = BAND.render(field, ray)
    assert rendering.hit.item() and rendering.distance.item() == pytest.approx(2.6, abs=1e-3)
    assert rendering.volume is not None
    for weight, rate in zip(rendering.volume.weight, (1, -1), strict=True):
        (gradient,) = torch.autograd.grad(weight, leaf, retain_graph=True)
        assert gradient.item() == pytest.approx(rate / BAND.band, rel=1e-6)
    (opacity,) = torch.autograd.grad(rendering.opacity.sum(), leaf)
    assert opacity.item() == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("iteration", [0, None])
@pytest.mark.parametrize("renderer", [NEUS, VOLSDF, OPAQUE], ids=lambda renderer: type(renderer).__name__)
def test_distances_have_the_gradient_of_the_surface_at_every_sharpness(renderer, iteration):
    """Away from the outline the distance to a sphere falls by 1 / cosine as its radius grows."""
    now = renderer if iteration is None else at_iteration(renderer, iteration)
    leaf = torch.tensor(0.6, dtype=torch.float64, requires_grad=True)
    rays = parallel(14, half=0.5).flat()
    rendering = now.render(sphere(leaf), rays)
    cosine = (0.36 - rays.origins[:, :2].square().sum(-1)).clamp_min(0).sqrt() / 0.6
    clear = rendering.hit & (cosine > 0.5)
    assert clear.sum() > 100
    (rate,) = torch.autograd.grad(rendering.distance[clear].sum(), leaf)
    assert rate.item() == pytest.approx(-(1 / cosine[clear]).sum().item(), rel=0.12)


def test_a_surface_near_the_unit_sphere_has_a_gradient_in_unisurf():
    leaf = torch.tensor(0.95, dtype=torch.float64, requires_grad=True)
    ray = Rays(vector((0, 0, -2))[None], vector((0, 0, 1))[None])
    rendering = at_iteration(UNISURF, 0).render(sphere(leaf), ray)
    assert rendering.hit.item() and rendering.distance.item() > 1.01  # not where the ray enters
    assert torch.autograd.grad(rendering.distance.sum(), leaf)[0].item() < -0.2


@VOLUMES
def test_hits_lie_on_a_surface_also_at_an_outline_before_a_wall(renderer):
    """At the outline the weights are a mixture of sphere and wall, but a hit lies on one of them."""
    both = Shape(lambda p: torch.minimum(sphere(0.3)(p), plane((0.0, 0.0, -1.0), -0.6)(p)), sphere(0.3).kind, 1.0)
    across = torch.linspace(0.29, 0.31, 41).double()
    origins = torch.stack([across, torch.zeros_like(across), torch.full_like(across, -2.0)], -1)
    rays = Rays(origins, vector((0, 0, 1)).expand_as(origins))
    rendering = renderer.render(both, rays)
    assert rendering.hit.all() and (both(rendering.points).abs() < 0.03).all()
    mixed = (rendering.opacity > 0.99) & (rendering.volume.weighted_sum(rendering.volume.distance, 41) < 2.5)
    assert (mixed & (rendering.volume.weighted_sum(rendering.volume.distance, 41) > 2.1)).any()


@VOLUMES
def test_the_distance_in_one_solid_is_the_weighted_mean_also_behind_a_ridge(renderer):
    """Between two overlapping spheres the values rise and fall again below 0, without a second surface."""
    rays = Rays(vector((0.01, 0.02, -2))[None], vector((0, 0, 1))[None])
    pair = replace(sphere(0.3, (0.0, 0.0, -0.2)) | sphere(0.3, (0.0, 0.0, 0.2)), kind=sphere(0.3).kind)
    rendering = renderer.with_blur(0.3).render(pair, rays)
    volume = rendering.volume
    assert rendering.hit.item()
    assert rendering.distance.item() == pytest.approx(
        ((volume.weight * volume.distance).sum() / volume.weight.sum()).item(), abs=1e-4
    )


@BLURRED
def test_a_narrower_blur_brings_the_image_closer_to_the_hits(renderer):
    rays, errors = parallel(20), []
    truth = load("renderer", "idr").render(sphere(0.5), rays)
    for blur in (0.1, 0.02, 0.004):
        rendering = renderer.with_blur(blur).render(sphere(0.5), rays)
        assert rendering.opacity.shape == rays.shape
        assert ((rendering.opacity >= 0) & (rendering.opacity <= 1 + 1e-9)).all()
        errors.append(l1_loss(rendering.opacity, truth.hit.double()).item())
    assert errors[-1] < 0.02 and errors == sorted(errors, reverse=True)


@VOLUMES
def test_a_sharpening_ends_at_the_setting(renderer):
    blurs = [at_iteration(renderer, iteration).blur for iteration in (0, 20, 100, 1000)]
    assert blurs == sorted(blurs, reverse=True) and blurs[0] > 10 * blurs[-1]
    assert blurs[-1] == blurs[-2] == renderer.blur and renderer.with_blur(0.02).blur == pytest.approx(0.02)
    assert at_iteration(renderer.with_blur(0.02), 0).blur == pytest.approx(0.02)


@VOLUMES
def test_the_residual_is_the_field_where_the_ray_ends(renderer):
    """The field of a plane is linear along the ray, like the interpolation between two samples."""
    case = PLANES[1]  # at a slant
    rendering = renderer.render(case.field(), case.rays())
    assert rendering.residual.item() == pytest.approx(case.field()(rendering.points).item(), abs=1e-12)


def test_weights_importance_and_sums_worked_out_by_hand():
    passing = vector((0.5, 1.0, 0.25)).log()[None]
    torch.testing.assert_close(weights(passing), vector((0.5, 0.0, 0.375))[None])
    drawn = resample(vector((0, 1, 2, 4))[None], torch.stack([vector((0, 1, 0))]), 4)
    torch.testing.assert_close(drawn, vector((1.125, 1.375, 1.625, 1.875))[None], rtol=0, atol=1e-4)
    even = resample(vector((0, 1, 2, 4))[None], torch.zeros(1, 3).double(), 4)
    torch.testing.assert_close(even, vector((0.5, 1.5, 2.5, 3.5))[None])
    volume = Volume(torch.tensor([2, 0, 2]), vector((1, 2, 3)), vector((0.5, 1, 0.25)))
    channels: Tensor = vector((1, 0, 0, 1, 1, 1)).view(3, 2)
    torch.testing.assert_close(volume.weighted_sum(channels, 3), vector((0, 1, 0, 0, 0.75, 0.25)).view(3, 2))


def test_the_band_samples_the_vertex_of_the_parabola_through_three_samples():
    distances = vector((0.0, 0.3, 0.9, 0.1, 0.3, 0.35)).view(2, 3).T
    lowest = vector((0.37, 0.28))
    torch.testing.assert_close(_parabola_vertex(distances, 3 * (distances - lowest) ** 2 + 0.1), lowest)
