"""A mesh in place of the field: the errors of its hits and gradients, and what it loses."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from torch.nn.functional import normalize

from bench.config import load
from renderers.camera import Rays, sphere_span
from renderers.field import Counts, Kind, Meter
from renderers.fields.analytic import Shape, box, sphere
from renderers.rendering import Status
from tests.looped import each
from tests.renderers.analytic_cases import aimed, vector
from tests.runner.driving import by_program

RENDERER = load("renderer", "mesh_proxy", grid=48)
FIRST_USE = """
import sys, renderers
assert "open3d" not in sys.modules, "import renderers imports open3d"
assert renderers.MeshProxy.__module__ == "renderers.later.mesh_proxy" and not hasattr(renderers, "Mesh")
"""
SPACING = 2 * RENDERER.sphere_radius / (RENDERER.grid - 1)


def test_gradients_are_those_of_the_field_up_to_the_grid(steep=5.0):
    """The field is a level set: the gradient of a vertex must be divided by the slope of the field."""
    radius, rays = torch.tensor(0.5, dtype=torch.float64, requires_grad=True), aimed(1, 60, spread=0.3)
    origins = rays.origins.requires_grad_(True)
    field = Shape(lambda p: steep * sphere(radius)(p), Kind.LEVEL, None)
    rendering, exact = (
        renderer.render(field, Rays(origins, rays.directions))
        for renderer in (RENDERER, load("renderer", "dvr", n_ray_samples=400, doublings=[]))
    )
    assert rendering.hit.all() and (rendering.distance - exact.distance).abs().max() < 0.2 * SPACING
    for leaf in (radius, origins):
        gradient, truth = (
            torch.autograd.grad(r.distance.sum(), leaf, retain_graph=True)[0].flatten() for r in (rendering, exact)
        )
        assert torch.cosine_similarity(gradient, truth, dim=0) > 0.999
        assert float(gradient.norm() / truth.norm()) == pytest.approx(1, abs=0.01)


def test_a_finer_grid_is_closer():
    rays, errors = aimed(1, 100, spread=0.3), []
    truth = load("renderer", "idr").render(sphere(0.5), rays).distance
    for grid in (12, 24, 48):
        errors.append((replace(RENDERER, grid=grid).render(sphere(0.5), rays).distance - truth).abs().max().item())
    for coarse, fine in pairwise(errors):
        assert fine < 0.4 * coarse  # the error of a chord falls with the square of its length


def test_what_is_thinner_than_the_grid_is_lost():
    ray = Rays(vector((0.01, 0.02, -2))[None], normalize(vector((0.02, 0.03, 1))[None], dim=-1))
    thin = box((0.5, 0.5, 0.02))  # cells of 0.02 resolve the box, and cells of 0.09 do not
    assert replace(RENDERER, grid=101).render(thin, ray).hit.item()
    assert not replace(RENDERER, grid=22).render(thin, ray).hit.item()


def test_a_grazing_hit_stays_where_it_is(slope=5e-4):
    """Only the derivative of a grazing hit is limited."""
    ray = Rays(vector((-1.5, 0, 0.5 * slope + 1e-9))[None], normalize(vector((1, 0, -slope))[None], dim=-1))
    rendering = RENDERER.render(Shape(lambda p: p[..., 2], Kind.DISTANCE, 1.0), ray)
    assert rendering.hit.item() and rendering.points[0, 0].item() == pytest.approx(-1.0, abs=0.05)


def test_closest_values_of_misses_are_right_and_a_shape_behind_the_camera_is_missed():
    shape, generator = sphere(0.2, (0.5, -0.1, 0.3)), torch.Generator().manual_seed(0)
    origins = 2 * normalize(torch.randn(200, 3, dtype=torch.float64, generator=generator), dim=-1)
    targets = 0.7 * normalize(torch.randn(200, 3, dtype=torch.float64, generator=generator), dim=-1)
    rays = Rays(origins, normalize(targets - origins, dim=-1))
    rendering = RENDERER.render(shape, rays)
    entry, leave, _ = sphere_span(rays)
    least = shape(rays.at_each(entry[:, None] + torch.linspace(0, 1, 2000) * (leave - entry)[:, None])).amin(dim=1)
    passes = ~rendering.hit & (least > 0.01)
    assert passes.sum() > 100 and (rendering.closest - least)[passes].min() >= -1e-4
    assert (rendering.closest - least)[passes].max() < 2 / RENDERER.ray_samples
    beyond = RENDERER.render(sphere(0.1, (0.8, 0.8, 0.0)), Rays(origins, normalize(vector((0.8, 0.8, 0)) - origins)))
    assert not beyond.hit.any()


def test_the_cost_is_that_of_the_grid_for_any_number_of_rays():
    for count in (1, 100):
        counts = Counts()
        RENDERER.render(Meter(sphere(0.5), counts), aimed(1, count, spread=0.3))
        assert 48**3 < counts.value < 48**3 + 1000


@each("value", [1.0, -1.0, float("nan")])
def test_a_field_without_a_surface_has_no_mesh(value):
    field = Shape(lambda p: value + 0 * p[..., 0], Kind.LEVEL, None)
    rendering = RENDERER.render(field, aimed(1, 5, spread=0.3))
    assert (rendering.status == (Status.STARTED_INSIDE if value < 0 else Status.MISS)).all()
    assert rendering.distance.isfinite().all()


@pytest.mark.slow
def test_libraries_of_meshes_are_imported_at_the_first_use_only():
    result = by_program("-c", FIRST_USE)
    assert result.code == 0, result.err
