"""The check of hits: hits of shipped renderers pass, and wrong distances are reported for each kind of field."""

from dataclasses import replace

import pytest
import torch

from bench.config import load
from bench.tables import names
from renderers.boundary import render_checked
from renderers.checks import BrokenContract
from renderers.field import Counts, Field, Kind, Meter
from renderers.fields.analytic import Shape, box, sphere
from renderers.hits import MAX_CHECKED_HITS, Hits, collect_hits, missing_distance_message
from renderers.rendering import Renderer, Rendering, at_iteration
from tests.looped import each
from tests.renderers.test_renderer_contract import stated
from tests.tiny import ball_prior, camera_of
from tests.wrong_hits import ENDLESS_HITS, WRONG, WrongHits

RAYS = camera_of(20, angles=(30.0, 20.0)).rays()
PLATE = box((0.45, 0.5, 0.1))  # thin, with edges
NETWORK = ball_prior().decoder.at(torch.zeros(4))


class Changed(WrongHits):
    """A shipped renderer with a function applied to its renderings."""

    def __init__(self, name: str, change) -> None:
        super().__init__(name=name)
        self.change = change

    def render(self, field: Field, rays) -> Rendering:
        return self.change(field, rays, self.inner.render(field, rays))


def hits_of(renderer: Renderer, field: Field, rays=RAYS) -> Hits:
    with collect_hits() as collected, torch.no_grad():
        render_checked(renderer, field, rays)
    (hits,) = collected
    return hits


@pytest.mark.parametrize("name", [name for name in names("renderer") if name != "custom"])
def test_the_hits_of_no_shipped_renderer_are_flagged(name):
    """Volumes are checked at their greatest blur, in the first iteration, and at their least."""
    renderer = load("renderer", name)
    rays = camera_of(4, angles=(30.0, 20.0)).rays() if getattr(renderer, "serial", False) else RAYS
    fields = [stated(shape, kind) for kind in renderer.capabilities.needs for shape in (PLATE, sphere(0.5))]
    first = at_iteration(renderer, 0)
    for variant in [renderer] if first == renderer else [first, renderer]:
        for field in [*fields, *([NETWORK] if NETWORK.kind in renderer.capabilities.needs else [])]:
            hits = hits_of(variant, field, rays)
            hits.check()
            assert bool(hits.hit.any()) and hits.off_surface() == ""


def test_hits_within_the_largest_shipped_epsilon_are_not_flagged():
    """The epsilon of Figure 7: the residual accounts for the distance of such a hit from the surface."""
    hits = hits_of(replace(load("renderer", "dist"), epsilon=0.05), PLATE)
    assert float(PLATE(RAYS.at(hits.distance)[hits.hit]).max()) > 0.02 and hits.off_surface() == ""


@each(
    "name",
    ["dist", "dvr", "newton", "mesh_proxy", "relaxed_boundary", "edge_sampling", "neus", "opaque", "unisurf", "volsdf"],
)
def test_distances_that_are_5_percent_short_are_noted_in_each_kind_of_field(name):
    for kind in load("renderer", name).capabilities.needs:
        note = hits_of(WrongHits("short", name), stated(PLATE, kind)).off_surface()
        assert note.startswith("WrongHits.render: ") and "hits are not on the surface" in note, kind
        assert "Return the distance along the unit direction, in scene units" in note


@each("factor", [0.01, 100.0])
def test_how_far_off_hits_are_does_not_depend_on_the_fields_scale(factor):
    field = Shape(lambda p: factor * PLATE(p), Kind.LEVEL)
    right, short = hits_of(load("renderer", "dvr"), field), hits_of(WrongHits("short", "dvr"), field)
    assert right.off_surface() == ""
    assert short.off_surface() == hits_of(WrongHits("short", "dvr"), PLATE).off_surface() != ""


def test_a_note_has_the_number_of_wrong_hits_and_their_median_distance():
    facing, ball = camera_of(20).rays(), sphere(0.5)
    hits = hits_of(WrongHits("short"), ball, facing)
    off, count = float(ball(facing.at(hits.distance))[hits.hit].median()), int(hits.hit.sum())
    note = hits.off_surface()
    assert off == pytest.approx(0.08, abs=0.02)
    assert note.startswith(f"WrongHits.render: {count} of {count} hits are not on the surface ")
    assert f"median distance from it is {off:.2g} scene units, and 0.02 beyond the residual is allowed. Return" in note


@each("kind", [Kind.DISTANCE, Kind.BOUND])
def test_a_large_residual_does_not_excuse_a_surface_renderer(kind):
    """A residual equal to the value at the hit is an excuse only for a volume, which is blurred."""

    def admits(field, rays, rendering):
        short = 0.92 * rendering.distance
        return replace(rendering, distance=short, residual=field(rays.at(short)))

    assert "hits are not on the surface" in hits_of(Changed("idr", admits), stated(PLATE, kind)).off_surface()
    assert hits_of(Changed("neus", admits), stated(PLATE, kind)).off_surface() == ""


@each("missed, noted", [(0.05, False), (0.3, True)])
def test_a_few_hits_may_be_off_the_surface(missed, noted):
    def change(field, rays, rendering):
        wrong = torch.arange(rendering.distance.numel()).view_as(rendering.distance) % 100 < 100 * missed
        return replace(rendering, distance=torch.where(wrong, 0.9 * rendering.distance, rendering.distance))

    rays = camera_of(60).rays()
    assert bool(hits_of(Changed("idr", change), sphere(0.5), rays).off_surface()) is noted


def test_a_negative_distance_breaks_the_contract():
    hits = hits_of(WrongHits("behind"), PLATE)
    count, least = int(hits.hit.sum()), float(hits.distance[hits.hit].min())
    message = f"WrongHits.render: {count} of {count} hits have a negative distance, down to {least:.3g},.* return the"
    with pytest.raises(BrokenContract, match=message):
        hits.check()


@each("value", [torch.nan, torch.inf])
def test_a_hit_without_a_finite_distance_breaks_the_contract(value):
    def change(field, rays, rendering):
        return replace(rendering, distance=WRONG["endless"](rendering).nan_to_num(value))

    cause = rf"{ENDLESS_HITS} of 400 rays have a hit without a finite distance \(the field is finite on them, so the "
    with pytest.raises(BrokenContract, match=rf"Changed\.render: {cause}renderer is at fault\): return a finite"):
        hits_of(Changed("dist", change), PLATE).check()


def test_a_field_without_finite_values_is_named():
    broken = Shape(lambda p: torch.where(p[..., 0] > 0, torch.nan, PLATE(p)))
    hits = replace(hits_of(WrongHits("endless"), PLATE), field=broken)
    message = missing_distance_message([hits])
    assert "the field has values that are not finite on" in message and "the renderer is at fault" not in message
    assert missing_distance_message([hits_of(load("renderer", "dist"), PLATE)]) == missing_distance_message([]) == ""


def test_a_miss_may_have_any_distance():
    def change(field, rays, rendering):
        return replace(rendering, distance=rendering.distance.where(rendering.hit, -torch.inf))

    hits = hits_of(Changed("idr", change), PLATE)
    hits.check()
    assert hits.off_surface() == ""
    nothing = hits_of(load("renderer", "idr"), sphere(0.5).translate((5.0, 0.0, 0.0)))
    nothing.check()
    assert not nothing.hit.any() and nothing.off_surface() == ""


def test_a_check_evaluates_the_field_once_and_is_not_counted():
    evaluated = []
    field = Shape(lambda p: (evaluated.append(p.numel() // 3), PLATE(p))[1])
    counts = Counts()
    hits = hits_of(load("renderer", "idr"), Meter(field, counts), camera_of(200, angles=(30.0, 20.0)).rays())
    before = counts.value
    evaluated.clear()
    hits.check()
    assert hits.off_surface() == ""
    assert len(evaluated) == 1 and MAX_CHECKED_HITS / 2 < evaluated[0] <= MAX_CHECKED_HITS < hits.hit.sum()
    assert counts.value == before


def test_hits_are_kept_within_the_innermost_block_alone():
    renderer = load("renderer", "idr")
    with collect_hits() as outer:
        with collect_hits() as inner:
            render_checked(renderer, PLATE, RAYS)
        render_checked(renderer, PLATE, RAYS)
        render_checked(renderer, PLATE, RAYS)
    render_checked(renderer, PLATE, RAYS)
    assert (len(outer), len(inner)) == (2, 1)
    assert not any(tensor.requires_grad for tensor in (inner[0].distance, inner[0].residual))
