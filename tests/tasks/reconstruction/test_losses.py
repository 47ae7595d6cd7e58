"""The losses of a reconstruction on a sphere in closed form: their values, and their gradients in float64."""

from dataclasses import dataclass, field, replace
from typing import Any

import pytest
import torch
from torch import Tensor

from bench.config import load
from bench.solve import pixel_area
from bench.solve.latent_code import Terms
from bench.tasks.reconstruction.background import OneColour
from bench.tasks.reconstruction.losses import CUBE_POINTS, NEIGHBOUR_CUBE_SIDE, Losses
from bench.tasks.reconstruction.pixels import FILLED, Pixels
from datasets.shot import Shot
from renderers.camera import Camera, Rays
from renderers.checks import BadInput
from renderers.field import Coloured, Kind, Meter
from renderers.silhouette import Area, Own
from tests.looped import each
from tests.renderers.analytic_cases import vector
from tests.tiny import camera_of

RENDERERS = {
    "idr": load("renderer", "idr", epsilon=1e-12, steps=300),
    "newton": load("renderer", "newton", steps=300, march_epsilon=1e-9, warm=False),
    "dvr": load("renderer", "dvr", doublings=[], refinement_steps=60),
}
OFF = {"colour": 0.0, "colour_gradient": 0.0, "depth": 0.0, "smoothness": 0.0, "normals": 0.0, "eikonal": 0.0}
BACKGROUND = 0.5
PAINT = torch.linspace(-0.9, 0.8, 30).sin().view(3, 10)


@dataclass(frozen=True)
class Ball:
    """A sphere whose colours are sigmoids of a linear map of the point, the field's gradient and the direction.

    Args:
        paint: the map; its last column is added.
        slope: by which the distance is multiplied.
    """

    radius: Tensor
    centre: Tensor
    paint: Tensor
    slope: float = 1.0
    kind: Kind = Kind.DISTANCE
    lipschitz: float | None = None
    flops: None = None

    def __call__(self, points: Tensor) -> Tensor:
        return self.slope * (torch.linalg.vector_norm(points - self.centre, dim=-1) - self.radius)

    def colours(self, points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
        inputs = torch.cat([points, normals, directions, torch.ones_like(points[..., :1])], dim=-1)
        return torch.sigmoid(inputs @ self.paint.T)

    def distance(self, rays: Rays) -> Tensor:
        """The distance along each ray to the surface; NaN for a miss."""
        towards = self.centre - rays.origins
        along = (towards * rays.directions).sum(-1)
        return along - (self.radius**2 - towards.square().sum(-1) + along**2).sqrt()

    def normals(self, points: Tensor) -> Tensor:
        """Unit normals of the surface at its points."""
        return (points - self.centre) / self.radius


def ball(
    radius: float = 0.6, centre: tuple[float, ...] = (0.1, -0.05, 0.15), paint: Tensor | None = None, **more: Any
) -> Ball:
    return Ball(torch.tensor(radius).double(), vector(centre), (PAINT if paint is None else paint).double(), **more)


def cast(shape: Ball, dtype: torch.dtype) -> Ball:
    return replace(shape, radius=shape.radius.to(dtype), centre=shape.centre.to(dtype), paint=shape.paint.to(dtype))


def shot_of(shape: Ball, camera: Camera, name: str = "0") -> Shot:
    """The exact photograph of a sphere on grey, with mask, depths and normals."""
    shape, rays = cast(shape, torch.float64), camera.double().rays()
    distance = shape.distance(rays)
    mask, points = distance.isfinite(), rays.at(distance)
    normals = shape.normals(points)
    colours = torch.where(mask[..., None], shape.colours(points, normals, rays.directions), BACKGROUND)
    depth = torch.where(mask, camera.double().depth(distance), 0.0)
    return Shot(name, camera, colours.float(), mask, depth.float(), torch.where(mask[..., None], normals, 0.0).float())


def pixels_of(camera: Camera, **observed: Tensor) -> Pixels:
    """All pixels of a camera in float64, by rows, with colours that rise from the first to the last."""
    camera, count = camera.double(), camera.height * camera.width
    at_one = camera.depth(torch.ones(camera.height, camera.width, dtype=torch.float64)).flatten()
    colours = torch.linspace(0, 1, 3 * count, dtype=torch.float64).view(count, 3)
    observed = {"colours": colours, "mask": None, "distance": None, "guide": None, "normals": None} | observed
    return Pixels(rays=camera.rays().flat(), depth_per_distance=at_one, **observed)


def losses(**weights: Any) -> Losses:
    return Losses(**({"depth_loss": "depth", "silhouette": Own(), "silhouette_weight": 0.0} | OFF | weights))


def terms_of(settings: Losses, shape: Coloured, pixels: Pixels, renderer: str = "idr") -> Terms:
    return settings(RENDERERS[renderer], shape, Meter(shape), pixels)


CAMERA = camera_of(8, field_of_view=32.0)
LEFT_HALF = (torch.arange(64) % 8 < 4).bool()  # a mask of the left half of the image
BALL = ball()
PIXELS = pixels_of(CAMERA)
DISTANCE = BALL.distance(PIXELS.rays)  # NaN on some pixels
POINTS = PIXELS.rays.at(DISTANCE)


@each("mask", [None, LEFT_HALF])
def test_the_colour_term_is_the_sum_over_hits_on_the_foreground_over_all_rays(mask):
    expected = 0.0
    for pixel in range(64):
        if DISTANCE[pixel].isfinite() and (mask is None or mask[pixel]):
            normal = BALL.normals(POINTS[pixel])
            inputs = torch.cat([POINTS[pixel], normal, PIXELS.rays.directions[pixel], vector((1,))])
            expected += float((1 / (1 + (-BALL.paint @ inputs).exp()) - PIXELS.colours[pixel]).abs().sum())
    terms = terms_of(losses(colour=3.0), BALL, replace(PIXELS, mask=mask))
    assert set(terms) == {"total", "colour"}
    assert terms["colour"].item() == pytest.approx(3.0 * expected / 64, rel=1e-9)
    assert torch.equal(terms["total"], terms["colour"])


def several(count: int, **observed: Tensor) -> Pixels:
    """All pixels of a camera with several rays, and the exact fractions of them that the ball covers."""
    camera = CAMERA.double()
    covered = BALL.distance(pixel_area.random_rays(camera, 256, 0, 0)).isfinite().double().mean(-1).flatten()
    rays = pixel_area.random_rays(camera, count, 0, 0)
    flat = Rays(rays.origins.flatten(0, 1), rays.directions.flatten(0, 1))
    return replace(PIXELS, rays=flat, covered=covered, mask=covered > 0.5, **observed)


@each("name", ["idr", "neus"])
def test_the_colour_of_a_filled_pixel_is_the_mean_over_its_rays(name):
    renderer, pixels = RENDERERS.get(name) or load("renderer", name), several(4)
    distance = BALL.distance(pixels.rays)
    points = pixels.rays.at(distance)
    filled = pixels.covered > FILLED
    mean = BALL.colours(points, BALL.normals(points), pixels.rays.directions).mean(1)
    expected = (mean - pixels.colours)[filled].abs().sum() / 64
    terms = losses(colour=1.0)(renderer, BALL, Meter(BALL), pixels)
    tolerance = 1e-6 if name == "idr" else 0.05  # a volume blends colours along the ray
    assert 10 < int(filled.sum()) < int(pixels.mask.sum())
    assert terms["colour"].item() == pytest.approx(expected.item(), rel=tolerance)


def test_fractions_of_pixels_are_compared_by_the_area_loss_and_by_losses_of_masks():
    for silhouette, name in ((Area(1.0), "relaxed_boundary"), (Own(), "neus"), (Own(), "idr")):
        settings, renderer = losses(silhouette=silhouette, silhouette_weight=1.0), load("renderer", name)
        errors = [
            settings(renderer, shape, Meter(shape), several(16))["silhouette"].item()
            for shape in (ball(0.4), BALL, ball(0.8))
        ]
        assert errors[1] < 0.2 * min(errors[0], errors[2]), name


def test_observations_of_single_rays_are_refused_with_several():
    losses(colour=1.0).check_rays_per_pixel(depths=False)
    with pytest.raises(BadInput, match=r"set task\.depths\.points=none task\.losses\.normals=0$"):
        losses(colour=1.0, normals=1.0).check_rays_per_pixel(depths=True)
    with pytest.raises(BadInput, match=r"remove view\.rays_per_pixel, or set task\.losses\.colour_of=blended"):
        losses(colour=1.0, colour_of="samples").check_rays_per_pixel(depths=False)


def test_a_volume_of_which_some_rays_miss_has_the_mean_colour_of_all_rays_of_a_filled_pixel():
    small, pixels, renderer = ball(0.5), several(4), load("renderer", "neus")
    terms = losses(colour=1.0)(renderer, small, Meter(small), pixels)
    volume = renderer.render(small, pixels.rays).volume
    flat = pixels.rays.flat()[volume.ray]
    points = flat.at(volume.distance)
    seen = volume.weighted_sum(small.colours(points, small.normals(points), flat.directions), 256).view(64, 4, 3)
    opacity = volume.weighted_sum(torch.ones_like(volume.weight), 256).view(64, 4)
    filled = pixels.covered > FILLED
    assert int((opacity[filled] < 0.5).sum()) > 3
    expected = (seen.mean(1) - pixels.colours)[filled].abs().sum() / 64
    assert terms["colour"].item() == pytest.approx(expected.item(), rel=0.02)


@each("name", ["idr", "neus"])
def test_behind_the_shape_all_rays_of_a_pixel_see_the_background(name):
    away, pixels = ball(0.2, (0.0, 0.0, 0.0)), replace(several(4), mask=None, colours=torch.zeros(64, 3).double())
    renderer = RENDERERS.get(name) or load("renderer", name)
    terms = losses(colour=1.0)(renderer, away, Meter(away), pixels, OneColour(1.0))
    rendering = renderer.render(away, pixels.rays)
    colours = away.colours(rendering.points, away.normals(rendering.points), pixels.rays.directions)
    share = rendering.opacity[..., None]
    expected = (share * colours + 1 - share).mean(1).abs().sum() / 64
    assert terms["colour"].item() == pytest.approx(expected.item(), rel=1e-6 if name == "idr" else 0.02)


@each("target", [0.0, 1.0, None])
@each("name", ["neus", "opaque"])
def test_the_samples_of_a_volume_have_a_larger_error_than_their_blended_colour(name, target):
    """Equal if all colours lie on one side of the target: then the error is linear in the colour."""
    renderer = load("renderer", name).with_blur(0.1)
    colours = PIXELS.colours if target is None else torch.full_like(PIXELS.colours, target)
    pixels = replace(PIXELS, mask=LEFT_HALF, colours=colours)
    blended, samples = (
        losses(colour=2.0, colour_of=kind)(renderer, BALL, Meter(BALL), pixels)["colour"].item()
        for kind in ("blended", "samples")
    )
    if target is None:
        assert samples > 1.01 * blended > 0
    else:
        assert samples == pytest.approx(blended, rel=1e-9) and blended > 0


def test_the_error_of_samples_is_that_of_each_sample_by_its_weight():
    renderer = load("renderer", "neus").with_blur(0.05)
    pixels = replace(PIXELS, mask=LEFT_HALF)
    terms = losses(colour=2.0, colour_of="samples")(renderer, BALL, Meter(BALL), pixels)
    assert set(terms) == {"total", "colour"}
    volume = renderer.render(BALL, pixels.rays).volume
    expected, passing = 0.0, torch.ones(64, dtype=torch.float64)
    for ray, distance, weight in zip(volume.ray, volume.distance, volume.weight, strict=True):
        direction = pixels.rays.directions[ray]
        point = pixels.rays.origins[ray] + distance * direction
        inputs = torch.cat([point, torch.nn.functional.normalize(point - BALL.centre, dim=0), direction, vector((1,))])
        error = (torch.sigmoid(BALL.paint @ inputs) - pixels.colours[ray]).abs().sum()
        passing[ray] -= weight
        expected += float(weight * error) * bool(LEFT_HALF[ray])
    expected += float((passing * pixels.colours.sum(-1))[LEFT_HALF].sum())
    assert terms["colour"].item() == pytest.approx(2.0 * expected / 64, rel=1e-9)


def test_colours_of_samples_need_a_volume_with_masks_and_no_differences():
    settings = losses(colour=1.0, colour_of="samples")
    with pytest.raises(BadInput, match=r"IDR has no samples: take task\.losses\.colour_of=blended"):
        terms_of(settings, BALL, replace(PIXELS, mask=LEFT_HALF))
    with pytest.raises(BadInput, match="NeuS needs masks"):
        settings(load("renderer", "neus"), BALL, Meter(BALL), PIXELS)
    with pytest.raises(ValueError, match=r"task\.losses\.colour_gradient compares blended colours"):
        losses(colour=1.0, colour_gradient=1.0, colour_of="samples")
    with pytest.raises(ValueError, match=r"task\.losses\.colour_of must be one of blended, samples"):
        losses(colour=1.0, colour_of="mean")


@each("weight", [0.0, 2.0])
def test_the_colour_gradient_term_compares_neighbours_of_complete_patches(weight):
    camera = camera_of(12, field_of_view=32.0)
    corners = torch.tensor([12 * row + column for row in range(0, 12, 2) for column in range(0, 12, 2)])
    pixels = pixels_of(camera)[(corners[:, None] + torch.tensor([0, 1, 12, 13])).flatten()]
    pixels = replace(pixels, colours=pixels.colours.flip(0).square())
    distance = BALL.distance(pixels.rays)
    points = pixels.rays.at(distance)
    off = BALL.colours(points, BALL.normals(points), pixels.rays.directions) - pixels.colours
    expected, complete = 0.0, 0
    for patch in off.split(4):
        if bool(patch.isfinite().all()):
            across, down = patch[1] - patch[0], patch[2] - patch[0]
            expected += float((across.square() + down.square()).sqrt().sum())
            complete += 1
    partly = sum(bool(patch.isfinite().any()) for patch in off.split(4)) - complete
    assert complete > 3 and partly > 3
    terms = terms_of(losses(colour=weight, colour_gradient=1.5), BALL, pixels)
    assert terms["colour_gradient"].item() == pytest.approx(1.5 * expected / 144, rel=1e-9)
    assert ("colour" in terms) == (weight > 0)


@each("kind", ["depth", "points"])
def test_the_depth_term_is_the_error_of_hits_with_a_depth_over_all_rays(kind):
    observed = torch.where(LEFT_HALF, DISTANCE + torch.linspace(-0.2, 0.3, 64, dtype=torch.float64), torch.nan)
    counted = observed.isfinite()  # depths of rays that miss the sphere do not count
    observed = torch.where(DISTANCE.isnan() & LEFT_HALF, 2.0, observed)
    error = (DISTANCE - observed).abs() * (PIXELS.depth_per_distance if kind == "depth" else 1.0)
    pixels = replace(PIXELS, distance=observed, mask=~LEFT_HALF)  # the mask has no effect on depths
    terms = terms_of(losses(depth=2.0, depth_loss=kind), BALL, pixels)
    assert set(terms) == {"total", "depth"} and 10 < int(counted.sum()) < 50
    assert terms["depth"].item() == pytest.approx(2.0 * error[counted].sum().item() / 64, rel=1e-9)


@dataclass
class Noting:
    """A silhouette loss that records its arguments."""

    calls: list = field(default_factory=list)

    def __call__(self, renderer, field, rays, rendering, observed):
        self.calls.append((renderer, field, rays, rendering, observed))
        return 0.7 + 0 * rendering.closest.sum()


def test_the_silhouette_term_is_the_weighted_loss_of_the_mask_and_the_guide():
    noting, guide = Noting(), torch.where(LEFT_HALF, DISTANCE, torch.nan)
    terms = terms_of(
        losses(silhouette=noting, silhouette_weight=4.0), BALL, replace(PIXELS, mask=LEFT_HALF, guide=guide)
    )
    assert terms["silhouette"].item() == pytest.approx(2.8)
    ((renderer, evaluated, rays, rendering, observed),) = noting.calls
    assert renderer is RENDERERS["idr"] and isinstance(evaluated, Meter) and rays is PIXELS.rays
    assert torch.equal(rendering.hit, DISTANCE.isfinite())
    assert observed.mask is LEFT_HALF and observed.distance is guide


def test_the_smoothness_term_compares_normals_with_those_of_neighbours():
    torch.manual_seed(3)
    terms = terms_of(losses(smoothness=5.0), BALL, PIXELS)
    torch.manual_seed(3)
    points = POINTS[DISTANCE.isfinite()]
    neighbours = points + NEIGHBOUR_CUBE_SIDE * (torch.rand(len(points), 3, dtype=torch.float64) - 0.5)
    away = neighbours - BALL.centre
    off = (BALL.normals(points) - away / away.norm(dim=-1, keepdim=True)).norm(dim=-1)
    assert 0 < off.max() < NEIGHBOUR_CUBE_SIDE / 0.6
    assert terms["smoothness"].item() == pytest.approx(5.0 * off.sum().item() / 64, rel=1e-6)


def test_the_normals_term_depends_on_the_cosine_with_observed_normals():
    true = BALL.normals(POINTS)
    turn = torch.linalg.matrix_exp(torch.tensor([[0, -0.4, 0.2], [0.4, 0, 0.3], [-0.2, -0.3, 0]]).double())
    observed = torch.where((LEFT_HALF & DISTANCE.isfinite())[:, None], true @ turn, 0.0)
    expected = 1 - (true * observed).sum(-1)[LEFT_HALF & DISTANCE.isfinite()]
    terms = terms_of(losses(normals=2.0), BALL, replace(PIXELS, normals=observed))
    assert terms["normals"].item() == pytest.approx(2.0 * expected.mean().item(), rel=1e-7)
    steep = terms_of(losses(normals=2.0), replace(BALL, slope=1.5), replace(PIXELS, normals=observed))
    assert steep["normals"].item() == pytest.approx(terms["normals"].item(), rel=1e-6)
    exact = terms_of(losses(normals=2.0), BALL, replace(PIXELS, normals=true.nan_to_num(0.0)))
    assert exact["normals"].item() == pytest.approx(0.0, abs=1e-9)


@each("slope", [1.0, 0.7, 1.3])
def test_the_eikonal_term_is_of_the_slope_at_hits_and_anywhere(slope):
    shape = ball(slope=slope)
    meter = Meter(shape)
    terms = losses(eikonal=0.5)(RENDERERS["dvr"], shape, meter, PIXELS)
    expected = 0.5 * 2 * (slope - 1) ** 2
    assert terms["eikonal"].item() == pytest.approx(expected, abs=1e-7)  # random points are in float32
    assert meter.counts.value > CUBE_POINTS


@each("slope", [1.0, 0.6])
@each("rate", [2.0, 8.0])
def test_the_heat_term_is_the_integral_over_the_cube(slope, rate, monkeypatch):
    """Against a grid of the cube. Of a distance of slope 1, the integrand is exp(-2 rate |u|)."""
    monkeypatch.setattr("bench.tasks.reconstruction.losses.CUBE_POINTS", 200_000)
    torch.manual_seed(0)
    shape = ball(slope=slope)
    terms = losses(heat=3.0, heat_rate=rate)(RENDERERS["idr"], shape, Meter(shape), PIXELS)
    axis = (torch.arange(80, dtype=torch.float64) + 0.5) / 40 - 1
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
    expected = 3.0 * (-2 * rate * shape(grid).abs()).exp().mean().item() * (slope**2 + 1) / 2
    assert set(terms) == {"total", "heat"} and terms["heat"].item() == pytest.approx(expected, rel=0.02)


def test_the_heat_term_costs_a_value_and_a_gradient_per_point_and_a_level_set_has_none():
    off, on = Meter(BALL), Meter(BALL)
    losses(colour=1.0)(RENDERERS["idr"], BALL, off, PIXELS)
    losses(colour=1.0, heat=1.0)(RENDERERS["idr"], BALL, on, PIXELS)
    assert on.counts.value - off.counts.value == 2 * CUBE_POINTS
    level = replace(BALL, kind=Kind.LEVEL)
    terms = losses(colour=1.0, heat=1.0)(RENDERERS["dvr"], level, Meter(level), PIXELS)
    assert set(terms) == {"total", "colour"}
    with pytest.raises(ValueError, match=r"task\.losses\.heat_rate must be positive"):
        losses(heat=1.0, heat_rate=0.0)


def test_the_heat_term_is_least_for_a_distance_among_slopes():
    """HotSpot: a field that is too flat keeps heat far from the surface; too steep a one has large gradients."""
    torch.manual_seed(0)
    values = []
    for slope in (0.5, 1.0, 2.5):
        shape = ball(slope=slope)
        torch.manual_seed(0)
        values.append(losses(heat=1.0)(RENDERERS["idr"], shape, Meter(shape), PIXELS)["heat"].item())
    assert min(values) == values[1]


def test_unknown_observations_have_no_term_and_the_total_is_the_sum():
    settings = losses(colour=1.0, depth=1.0, normals=1.0, smoothness=1.0, eikonal=1.0, silhouette_weight=1.0)
    assert set(terms_of(settings, BALL, PIXELS)) == {"total", "colour", "smoothness", "eikonal"}
    observed = replace(PIXELS, mask=LEFT_HALF, distance=DISTANCE + 0.1, normals=BALL.normals(POINTS).nan_to_num(0.0))
    terms = terms_of(settings, ball(radius=0.5), observed)
    assert set(terms) == {"total", "colour", "depth", "silhouette", "normals", "smoothness", "eikonal"}
    total = terms.pop("total").item()
    assert total == pytest.approx(sum(term.item() for term in terms.values()))


def test_a_surface_that_no_ray_meets_has_finite_terms():
    settings = losses(colour=1.0, depth=1.0, normals=1.0, smoothness=1.0, eikonal=1.0, silhouette_weight=1.0)
    observed = replace(PIXELS, mask=LEFT_HALF, distance=DISTANCE, normals=BALL.normals(POINTS).nan_to_num(0.0))
    radius = torch.tensor(-0.5, dtype=torch.float64, requires_grad=True)
    terms = terms_of(settings, replace(BALL, radius=radius), observed)
    assert [terms[name].item() for name in ("colour", "depth", "normals", "smoothness")] == [0.0] * 4
    (gradient,) = torch.autograd.grad(terms["total"], radius)
    assert gradient.isfinite() and gradient < 0  # the silhouette loss makes the sphere larger


INNER = pixels_of(camera_of(6, field_of_view=18.0))  # all rays hit, away from the outline, also after a step
TARGETS = torch.rand(36, 3, generator=torch.Generator().manual_seed(0)).round().double()  # no difference changes sign


@each("renderer", RENDERERS)
@each("weights", [{"colour": 1.0}, {"depth": 1.0}, {"normals": 1.0}, {"colour_gradient": 1.0}, {"smoothness": 1e3}])
def test_the_gradient_towards_shape_and_colours_is_that_of_differences(renderer, weights):
    """DVR, Eqs. 3 to 8: the gradient depends on the colours at the hit and on the position of the hit."""
    settings, first = losses(**weights), ball(slope=0.8)
    normals = first.normals(INNER.rays.at(first.distance(INNER.rays))).roll(1, 0)
    pixels = replace(INNER, colours=TARGETS, distance=first.distance(INNER.rays) - 0.2, normals=normals)

    def loss(radius: Tensor, centre: Tensor, paint: Tensor) -> Tensor:
        torch.manual_seed(0)  # the neighbours of the smoothness term are random
        shape = replace(first, radius=radius, centre=centre, paint=paint)
        return terms_of(settings, shape, pixels, renderer)["total"]

    leaves = [tensor.clone().requires_grad_() for tensor in (first.radius, first.centre, first.paint)]
    gradients = torch.autograd.grad(loss(*leaves), leaves, materialize_grads=True, allow_unused=True)
    draw = torch.Generator().manual_seed(1)
    step, precision = 1e-5, 1e-4 if renderer == "newton" else 1e-6  # the last step of Newton may be long
    for moved in ([0, 1], [2]):  # the shape, then its colours
        ways = [torch.zeros_like(leaf) for leaf in leaves]
        for index in moved:
            ways[index] = torch.randn(leaves[index].shape, generator=draw, dtype=torch.float64)
        ends = [
            loss(*(leaf.detach() + sign * step * way for leaf, way in zip(leaves, ways, strict=True)))
            for sign in (1, -1)
        ]
        expected = (ends[0] - ends[1]).item() / (2 * step)
        along = sum((gradient * way).sum() for gradient, way in zip(gradients, ways, strict=True)).item()
        assert along == pytest.approx(expected, rel=precision, abs=1e-9)
        assert (expected != 0) == (moved == [0, 1] or "colour" in str(weights))
