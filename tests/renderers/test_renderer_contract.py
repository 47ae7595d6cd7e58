"""The contract of each renderer in conf/renderer, built as the command line builds it.

A renderer is tested on fields of the kinds that it needs, and for the gradients that its capabilities claim.
A preset of conf/variants.yaml may have fewer hits, for speed or as in its paper. Its hits must be right.
"""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize

from bench.config import build, load
from bench.tables import choice, names
from renderers.boundary import RENDERING_TENSORS
from renderers.camera import Camera, Rays, sphere_span
from renderers.field import Kind
from renderers.fields.analytic import Shape, box, sphere
from renderers.rendering import Blurred, Renderer, Rendering, Status, Unsupported, closest_values
from tests.looped import each
from tests.renderers.analytic_cases import CASES, aimed, box_hits, sphere_hits, vector

# The presets with separate code; the others differ in numbers only.
VARIANTS = [
    "naive_practical",
    "dist_paper",
    "dist_slope_bound",
    "dist_auto_relaxed",
    "dvr_early_stop",
    "volsdf_budget",
    "dist_coarse",
    "idr_coarse",
]


@pytest.fixture(
    scope="module", params=[name for name in names("renderer") if "defaults" not in choice("renderer", name)]
)
def renderer(request, compose_config) -> Renderer:
    if request.param == "custom":
        target = f"renderer._target_={request.config.getoption('--renderer') or 'tests.user_renderer.Mine'}"
        return build(compose_config("renderer=custom", target).renderer, "renderer")
    changed = {"mesh_proxy": {"grid": 48}}  # an eighth of the evaluations; the renderer states its accuracy
    return load("renderer", request.param, **changed.get(request.param, {}))


def tolerance(renderer: Renderer, cosine: float, dtype: torch.dtype = torch.float64) -> float:
    """The accepted error of a hit: a field value of epsilon is epsilon / cosine from the surface.

    The factor 2 allows for bounds, which are lower than the distance (see `stated`). A renderer without an epsilon
    states its blur or its accuracy.
    """
    blur = 2 * renderer.blur if isinstance(renderer, Blurred) else getattr(renderer, "accuracy", 1e-4)
    return 2 * getattr(renderer, "epsilon", blur) / cosine + (2e-6 if dtype is torch.float32 else 1e-9)


def stated(shape: Shape, kind: Kind) -> Shape:
    """A field of the kind with the same surface."""
    if kind is Kind.DISTANCE:
        return shape
    if kind is Kind.BOUND:
        return Shape(lambda p: 0.7 * shape(p), kind, 0.7)
    return Shape(lambda p: (1.5 + torch.sin(3 * p[..., 0])) * shape(p), kind, None)


def assert_same(first: Rendering, second: Rendering, atol: float = 1e-12) -> None:
    for name in RENDERING_TENSORS:
        actual, expected = getattr(first, name), getattr(second, name)
        torch.testing.assert_close(actual.reshape(expected.shape), expected, rtol=0, atol=atol)


def check_rendering(rendering: Rendering, rays: Rays) -> None:
    """Checks shapes, dtypes, finite numbers, and that the tensors agree with one another."""
    for name in RENDERING_TENSORS:
        tensor = getattr(rendering, name)
        assert tensor.shape == ((*rays.shape, 3) if name == "points" else rays.shape), name
        assert tensor.isfinite().all(), name
        assert tensor.dtype == (torch.int8 if name == "status" else rays.origins.dtype), name
    assert set(rendering.status.unique().tolist()) <= set(Status)
    assert torch.equal(rendering.hit, rendering.status == Status.HIT) and not rendering.residual.requires_grad
    torch.testing.assert_close(rendering.points, rays.at(rendering.distance), rtol=0, atol=1e-6)


def mixed(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Rays:
    """Rays that hit or miss a sphere of radius 0.5, miss the unit sphere, or start in or behind one of them."""
    count = torch.Size(shape).numel()
    generator = torch.Generator().manual_seed(seed)
    origins = torch.randn(count, 3, dtype=torch.float64, generator=generator)
    targets = 0.6 * torch.randn(count, 3, dtype=torch.float64, generator=generator)
    directions = normalize(targets - origins, dim=-1)
    return Rays(origins.view(*shape, 3).to(dtype), directions.view(*shape, 3).to(dtype))


def pinhole(height: int, width: int, dtype: torch.dtype = torch.float32) -> Camera:
    """A level camera that sees the whole unit sphere at an oblique angle."""
    size = min(height, width)
    intrinsics = torch.tensor([[1.0 * size, 0, width / 2], [0, 1.0 * size, height / 2], [0, 0, 1]], dtype=dtype)
    world_to_camera = torch.eye(4, dtype=dtype)
    world_to_camera[:3, :3] = torch.tensor([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]], dtype=dtype)
    world_to_camera[2, 3] = 2.5
    return Camera(intrinsics, world_to_camera, height, width)


def test_it_is_a_renderer_with_capabilities(renderer):
    assert isinstance(renderer, Renderer) and renderer.capabilities.needs
    text = type(renderer).__doc__ or ""
    for line in ("Source:", "Differentiable in:", "Needs:", "Deviates from the paper:"):
        assert line in text, f"the docstring of {type(renderer).__name__} lacks the line {line!r}: see renderers/idr.py"


def test_hits_are_those_of_the_closed_forms(renderer):
    for case in CASES:
        for dtype in (torch.float64, torch.float32) if case is CASES[0] else (torch.float64,):
            rays = case.rays(dtype)
            for kind in renderer.capabilities.needs:
                rendering = renderer.render(stated(case.field(), kind), rays)
                check_rendering(rendering, rays)
                assert rendering.status.item() == Status.HIT, case.name
                near = tolerance(renderer, case.cosine, dtype)
                assert rendering.distance.item() == pytest.approx(case.distance, abs=near), case.name
                assert rendering.residual.abs().item() <= getattr(renderer, "epsilon", torch.inf)


def test_a_field_of_a_kind_that_the_renderer_does_not_need_is_refused(renderer):
    """The tasks check the kind for a renderer of the user."""
    for kind in {*Kind} - {*renderer.capabilities.needs}:
        if type(renderer).__module__.startswith("renderers."):
            with pytest.raises(Unsupported, match=f"field, not a {kind.value} field"):
                renderer.render(stated(sphere(0.5), kind), mixed(4))


def test_images_are_those_of_the_closed_forms(renderer):
    """The images are in float32 and have odd sizes."""
    dtype, rays = torch.float32, pinhole(45, 51).rays()
    half = (0.45, 0.5, 0.4)
    for field, (distance, hit) in ((sphere(0.6), sphere_hits(rays, 0.6)), (box(half), box_hits(rays, half))):
        rendering = renderer.render(field, rays)
        check_rendering(rendering, rays)
        # Pixels near an outline are left out: there a renderer that shares steps between neighbours may differ.
        around = max_pool2d(torch.stack([hit, ~hit])[:, None].float(), 9, stride=1, padding=4)[:, 0] > 0
        clear = ~(around[0] & around[1])
        assert (clear & hit).sum() > 5 and (clear & ~hit).sum() > 50
        assert torch.equal(rendering.hit[clear], hit[clear])
        assert (rendering.distance - distance)[clear & hit].abs().max() < tolerance(renderer, 0.5, dtype)


def test_rays_may_have_any_leading_shape(renderer):
    field = sphere(0.5)
    for shape in ((), (0,), (1,), (2, 3, 5), (3, 0, 2)):
        rays = mixed(*shape, dtype=torch.float32 if shape == (2, 3, 5) else torch.float64)
        rendering = renderer.render(field, rays)
        check_rendering(rendering, rays)
        assert_same(rendering, renderer.render(field, rays.flat()))
        if shape == (2, 3, 5):
            assert set(rendering.status.unique().tolist()) >= {Status.HIT, Status.MISS, Status.STARTED_INSIDE}


def test_images_may_have_any_size_and_come_in_batches(renderer, shapes=((1, 1), (5, 7), (2, 4, 6), (0, 4, 4))):
    for shape in shapes:
        single = pinhole(*shape[-2:], dtype=torch.float64).rays()
        rays = Rays(single.origins.expand(*shape, 3), single.directions.expand(*shape, 3), image=True)
        rendering = renderer.render(sphere(0.5), rays)
        check_rendering(rendering, rays)
        expected = renderer.render(sphere(0.5), single)
        for name in RENDERING_TENSORS:
            tensor = getattr(rendering, name)
            torch.testing.assert_close(getattr(expected, name).expand_as(tensor), tensor)


def test_inputs_are_left_as_they_are(renderer):
    rays = mixed(5, 8)
    radius = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    before = rays.origins._version, rays.directions._version, radius._version
    for image in (False, True):
        used_rays = Rays(rays.origins, rays.directions, image)
        rendering = renderer.render(sphere(radius), used_rays)
        renderer.silhouette_loss(sphere(radius), used_rays, rendering, torch.ones(5, 8, dtype=torch.bool))
        assert before == (rays.origins._version, rays.directions._version, radius._version)
        assert not rays.origins.requires_grad and radius.grad is None


def test_the_same_input_gives_the_same_output(renderer):
    for rays in (mixed(50), pinhole(9, 9, torch.float64).rays()):
        assert_same(renderer.render(sphere(0.5), rays), renderer.render(sphere(0.5), rays), atol=0)


def test_rays_without_a_surface_miss(renderer):
    starts = vector((2, 0, -2, 0, 0, 2, 0.8, 0, -2)).view(3, 1, 3)  # aside, behind, through
    for image in (False, True):
        rays = Rays(starts.expand(3, 2, 3), vector((0, 0, 1)).expand(3, 2, 3), image)
        rendering = renderer.render(sphere(0.5), rays)
        check_rendering(rendering, rays)
        assert (rendering.status == Status.MISS).all()
        assert (rendering.closest > 0.1).all()  # outside, by its sign


def test_splitting_the_rays_changes_nothing(renderer):
    rays, field = mixed(15), box((0.4, 0.3, 0.5))
    expected = renderer.render(field, rays)
    for size in (1, 7):
        batches = zip(rays.origins.split(size), rays.directions.split(size), strict=True)
        chunks = [renderer.render(field, Rays(*batch)) for batch in batches]
        assert_same(
            expected, Rendering(*(torch.cat([getattr(chunk, name) for chunk in chunks]) for name in RENDERING_TENSORS))
        )


def leaves() -> tuple[Tensor, Rays, tuple[Tensor, ...]]:
    """A radius and rays with each status, also tangents and a ray through the centre."""
    rays = mixed(30)
    edge = vector((0, 0, -2, 0.5, 0, -2, 1, 0, -2, 0, 0, 0, 0.499999, 0, -2)).view(5, 3)
    origins = torch.cat([rays.origins, edge]).requires_grad_(True)
    directions = torch.cat([rays.directions, vector((0, 0, 1)).expand(5, 3)]).requires_grad_(True)
    radius = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    return radius, Rays(origins, directions), (radius, origins, directions)


def test_gradients_are_finite_on_every_kind_of_ray(renderer):
    radius, rays, wanted = leaves()
    rendering = renderer.render(sphere(radius), rays)
    assert set(rendering.status.unique().tolist()) >= {Status.HIT, Status.MISS, Status.STARTED_INSIDE}
    loss = renderer.silhouette_loss(sphere(radius), rays, rendering, torch.arange(35) % 2 == 0)
    assert loss.shape == () and loss.isfinite() and loss > 0
    for output in (rendering.distance.sum(), rendering.closest.sum(), rendering.points.sum(), loss):
        for gradient in torch.autograd.grad(output, wanted, retain_graph=True, allow_unused=True):
            assert gradient is None or gradient.isfinite().all()


@each("value", [torch.nan, torch.inf, -torch.inf])
def test_a_field_that_is_not_finite_in_half_of_space_has_a_finite_rendering(renderer, value):
    for axis, rays in ((0, mixed(60)), (2, pinhole(16, 16, torch.float64).rays())):
        radius = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
        origins = rays.origins.requires_grad_(True)
        shape = sphere(radius)
        field = Shape(lambda p: torch.where(p[..., axis] > 0.07, value, shape(p)), Kind.DISTANCE, 1.0)  # noqa: B023
        rays = Rays(origins, rays.directions, rays.image)
        rendering = renderer.render(field, rays)
        check_rendering(rendering, rays)
        mask = torch.arange(rays.shape.numel()).view(rays.shape) % 2 == 0
        loss = renderer.silhouette_loss(field, rays, rendering, mask)
        assert loss.isfinite()
        for output in (rendering.distance.sum(), rendering.closest.sum(), loss):
            for gradient in torch.autograd.grad(output, (radius, origins), retain_graph=True, allow_unused=True):
                assert gradient is None or gradient.isfinite().all()


def test_gradients_of_hits_point_the_right_way(renderer):
    for case in CASES:
        parameter = torch.tensor(case.parameter, dtype=torch.float64, requires_grad=True)
        rays = case.rays()
        origins = rays.origins.requires_grad_(True)
        distance = renderer.render(case.shape(parameter), Rays(origins, rays.directions)).distance.sum()
        if renderer.capabilities.field_gradient:
            assert torch.autograd.grad(distance, parameter, retain_graph=True)[0] < -0.2
        if renderer.capabilities.ray_gradient:
            (gradient,) = torch.autograd.grad(distance, origins)
            assert torch.cosine_similarity(gradient[0], case.origin_rate, dim=0) > 0.99


def test_points_move_as_distances_do(renderer):
    radius, rays, wanted = leaves()
    rendering = renderer.render(sphere(radius), rays)
    gradients = torch.autograd.grad(rendering.points.sum(), wanted, retain_graph=True, allow_unused=True)
    expected = torch.autograd.grad(rays.at(rendering.distance).sum(), wanted, allow_unused=True)
    torch.testing.assert_close(gradients, expected)


def test_no_graph_is_built_if_no_input_requires_a_gradient(renderer):
    radius, rays, _ = leaves()
    with torch.no_grad():
        rendering = renderer.render(sphere(radius), rays)
    plain = renderer.render(sphere(0.5), Rays(rays.origins.detach(), rays.directions.detach()))
    for result in (rendering, plain):
        assert not any(getattr(result, name).requires_grad for name in RENDERING_TENSORS)
    assert_same(rendering, plain)


def test_closest_values_follow_the_field_where_a_ray_misses(renderer):
    radius = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    rays = mixed(60)
    rendering = renderer.render(sphere(radius), rays)
    _, _, meets = sphere_span(rays)
    missed = (rendering.status == Status.MISS) & meets
    closest = closest_values(sphere(radius), rays, rendering, missed)
    torch.testing.assert_close(closest.detach(), rendering.closest.detach())
    (gradient,) = torch.autograd.grad(closest[missed].sum(), radius)
    assert missed.sum() > 5
    assert gradient.item() == pytest.approx(-int(missed.sum()), rel=0.01)  # an unrolled sample moves slightly


def test_the_right_mask_costs_less_than_its_opposite(renderer):
    rays = pinhole(16, 16, torch.float64).rays()
    field = sphere(0.5)
    rendering = renderer.render(field, rays)
    _, truth = sphere_hits(rays, 0.5)
    right, wrong = (renderer.silhouette_loss(field, rays, rendering, mask) for mask in (truth, ~truth))
    assert right >= 0 and wrong > max(10 * right, 1e-5)  # the scale of the loss depends on the renderer


@pytest.fixture(scope="module", params=VARIANTS)
def variant(request) -> Renderer:
    return load("renderer", request.param)


def test_a_variant_holds_the_contract_and_its_hits_are_right(variant):
    test_it_is_a_renderer_with_capabilities(variant)
    test_images_may_have_any_size_and_come_in_batches(variant, ((2, 3, 5),))
    test_rays_without_a_surface_miss(variant)
    rays = aimed(0)
    truth, hit = sphere_hits(rays, 0.5)
    rendering = variant.render(sphere(0.5), rays)
    check_rendering(rendering, rays)
    assert_same(rendering, variant.render(sphere(0.5), rays), atol=0)
    assert hit.all() and not (rendering.status == Status.MISS).any()
    wrong = (rendering.distance - truth).abs()[rendering.hit]
    assert wrong.numel() == 0 or wrong.max() < tolerance(variant, 0.9)
    assert (rendering.residual.abs()[rendering.hit] <= getattr(variant, "epsilon", torch.inf)).all()
    test_gradients_are_finite_on_every_kind_of_ray(variant)


def rotation(seed: int) -> Tensor:
    """A random rotation, evenly distributed."""
    q, r = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)))
    q = q * r.diagonal().sign()
    return q * torch.linalg.det(q)


@settings(max_examples=2)
@given(
    seed=st.integers(0, 2**32),
    offset=st.tuples(*[st.floats(-0.15, 0.15)] * 3),
    half=st.tuples(*[st.floats(0.3, 0.4)] * 3),
    factor=st.floats(0.5, 1.1),
)
def test_a_rigid_motion_moves_the_hit_with_the_ray_and_scaling_scales_its_distance(
    renderer, seed, offset, half, factor
):
    rays, turn, offset = aimed(seed), rotation(seed), vector(offset)
    moved = Rays(factor * rays.origins @ turn.T + offset, rays.directions @ turn.T)
    before = renderer.render(box(half), rays)
    after = renderer.render(box(half).scale(factor).rotate(turn).translate(offset), moved)
    assert before.hit.all() and after.hit.all()
    near = 2 * tolerance(renderer, 0.25)
    assert (factor * before.distance - after.distance).abs().max() < near
    torch.testing.assert_close(after.points, factor * before.points @ turn.T + offset, rtol=0, atol=near)


@settings(max_examples=2)
@given(seed=st.integers(0, 2**32))
def test_a_tighter_epsilon_never_raises_the_residual(renderer, seed):
    if not hasattr(renderer, "epsilon"):
        pytest.skip("the renderer has no epsilon")
    rays, loose = aimed(seed), None
    truth, _ = sphere_hits(rays, 0.5)
    for epsilon in (1e-2, 1e-3, 1e-4, 1e-5):
        tight = replace(renderer, epsilon=epsilon)
        rendering = tight.render(sphere(0.5), rays)
        assert rendering.hit.all() and (rendering.residual.abs() < epsilon).all()
        assert ((rendering.distance - truth).abs() < tolerance(tight, 0.9)).all()
        assert loose is None or (rendering.residual.abs() <= loose).all()
        loose = rendering.residual.abs()
