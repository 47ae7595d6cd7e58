"""Settings computed from the camera: each follows its equation and is in the record."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from bench.config import load
from bench.setup.auto import AutoSettings, epsilon, footprint, steps
from datasets.families import BUILDERS, CUBE_HALF_SIDE, Family
from datasets.mesh import extract, fit_in_sphere
from datasets.scene import Split
from datasets.views import ViewSampler
from renderers import Meter
from renderers.field import Field, Kind
from renderers.fields.analytic import Shape, box, sphere
from tests.looped import each
from tests.tiny import inputs_from

VIEW = ViewSampler(2.5, 50.0, (0.0, 360.0), (15.0, 35.0), 128)
TEN = AutoSettings(10.0, spurious=0.01, area_over_perimeter=0.07)
BOX = box((0.4, 0.3, 0.5))
FAMILIES = ("sofa", "plane", "table", "car")


def formula(family: Family) -> Shape:
    """The formula of the first validation shape, normalised like its mesh, and divided by its slope to be a bound."""
    raw = BUILDERS[family.name](SimpleNamespace(**family.draw(Split.VALIDATION, 0)))
    steepest = max(raw.lipschitz, 1.0)
    centre, factor = fit_in_sphere(
        extract(raw, grid=family.resolution, reach=CUBE_HALF_SIDE).used_vertices, family.radius
    )
    return Shape(lambda p: raw(p) / steepest, Kind.BOUND).translate(tuple(-centre)).scale(factor)


def test_epsilon_agrees_with_the_example_of_the_paper():
    # DIST, A.2: f = 60 mm, S = 32 mm, d = 100 mm, R = 512: about 0.05 mm. In scene units, with d = 1 from 2 away:
    field_of_view = 2 * torch.rad2deg(torch.atan(torch.tensor(16 / 60))).item()
    view = ViewSampler(2.0, field_of_view, (0.0, 0.0), (0.0, 0.0), 512)
    assert epsilon(view, {}, TEN) * 100 == pytest.approx(0.0521, rel=1e-3)


def test_steps_agree_with_the_example_of_the_paper():
    # DIST, A.1: 52 steps at alpha 1 and 33 at 1.5, at 10 degrees and epsilon 5e-5.
    assert steps(VIEW, {"epsilon": 5e-5, "alpha": 1.0}, TEN) == 52
    assert steps(VIEW, {"epsilon": 5e-5, "alpha": 1.5}, TEN) == 33


@each(
    "alpha, grazing, expected",
    [(1.5, 30.0, 15), (1.5, 41.81, 15), (1.0, 90.0, 1), (1.0, 30.0, 15), (0.5, 90.0, 15), (1.0, 89.9, 1)],
)
def test_steps_reach_each_surface_at_the_grazing_angle_or_above(alpha, grazing, expected):
    node = {"epsilon": 5e-5, "alpha": alpha}
    assert steps(VIEW, node, replace(TEN, grazing=grazing)) == expected


def test_steps_that_cannot_be_computed_are_errors():
    with pytest.raises(ValueError, match=r"alpha must lie between 0 and 2, not 2"):
        steps(VIEW, {"epsilon": 5e-5, "alpha": 2.0}, TEN)
    with pytest.raises(ValueError, match=r"which this renderer does not have: give a number"):
        steps(VIEW, {"steps": "auto"}, TEN)


def test_epsilon_and_steps_are_resolved_in_order_with_notes():
    node, notes = TEN.resolve({"epsilon": "auto", "steps": "auto", "alpha": 1.5}, VIEW)
    assert node["epsilon"] == pytest.approx(7e-4) and node["steps"] == steps(VIEW, node, TEN) < 33
    views = "for 128 pixels from 2.5 away (view)"
    numbers = {"epsilon": f"{node['epsilon']:.4g}", "steps": str(node["steps"])}
    angle = {
        "epsilon": ", with at most 1% spurious hits around outlines (auto.spurious) of true distances whose area over "
        "perimeter is 0.07 or more (auto.area_over_perimeter)",
        "steps": ", for surfaces met at 10 degrees or more (auto.grazing)",
    }
    assert notes == [f"renderer.{name}=auto is {number}, {views}{angle[name]}" for name, number in numbers.items()]


def test_auto_without_an_equation_is_an_error():
    with pytest.raises(ValueError, match=r"renderer\.alpha=auto has no equation: only epsilon, steps have one"):
        TEN.resolve({"alpha": "auto"}, VIEW)
    with pytest.raises(ValueError, match=r"view\.distance - 1 must be positive.*outside of the unit sphere"):
        epsilon(ViewSampler(0.9, 50.0, (0.0, 0.0), (0.0, 0.0), 64), {}, TEN)
    with pytest.raises(ValueError, match=r"auto\.grazing must be positive"):
        replace(TEN, grazing=0.0)


def test_a_run_has_the_resolved_number_and_a_note(compose_config):
    config = compose_config("renderer.epsilon=auto", "renderer.steps=auto", "view.resolution=128", "dataset=sphere")
    inputs = inputs_from(config)
    assert inputs.renderer.epsilon == pytest.approx(7e-4)
    assert inputs.notes[0].startswith("renderer.epsilon=auto is 0.0007, for 128 pixels")


def hits(name: str, shape: Field, resolution: int, **settings: float) -> tuple[Tensor, int]:
    """The pixels that a renderer hits, and its field evaluations."""
    meter = Meter(shape)
    rays = replace(VIEW, resolution=resolution).camera(30.0, 25.0).rays()
    return load("renderer", name, **settings).render(meter, rays).hit, meter.counts.value


@each("name, shape, resolution", [
    ("dist", sphere(0.6), 128), ("dist", BOX, 48), ("idr", BOX, 48), ("naive", sphere(0.6), 48),
])  # fmt: skip
def test_epsilon_auto_loses_no_hit_adds_at_most_one_percent_and_saves_a_tenth(name, shape, resolution):
    fine, values = hits(name, shape, resolution)
    auto = epsilon(replace(VIEW, resolution=resolution), {}, TEN)
    coarse, fewer = hits(name, shape, resolution, epsilon=auto)
    exact, _ = hits("idr", shape, resolution, steps=300)
    assert int((fine & ~coarse).sum()) == 0 and int((coarse & ~exact).sum()) <= 0.01 * int(exact.sum())
    if name != "naive":  # naive evaluates each ray at each step
        assert fewer <= 0.9 * values


@pytest.mark.slow
@each("family", FAMILIES)
def test_epsilon_auto_holds_on_the_families(family):
    shape = formula(load("dataset", family))
    exact, _ = hits("idr", shape, 64, steps=300)
    coarse, _ = hits("dist", shape, 64, epsilon=epsilon(replace(VIEW, resolution=64), {}, TEN))
    fine, _ = hits("dist", shape, 64)
    assert int((fine & ~coarse).sum()) == 0 and int((coarse & ~exact).sum()) <= 0.01 * int(exact.sum())
    width = footprint(replace(VIEW, resolution=64).focal_length, VIEW.distance)
    half_a_pixel, _ = hits("dist", shape, 64, epsilon=width)
    assert int((half_a_pixel & ~exact).sum()) > 0.01 * int(exact.sum())  # half a pixel would be too much


def test_no_more_precision_than_a_pixel():
    far = replace(VIEW, resolution=4096)
    assert epsilon(far, {}, TEN) == footprint(far.focal_length, far.distance) < 7e-4
