"""Settings that follow from the camera: each is its equation, and stands in the record."""

import pytest
import torch
from omegaconf import OmegaConf

from bench.config import load
from bench.setup.auto import AutoSettings, epsilon, resolved, steps
from bench.setup.inputs import set_up
from datasets.views import ViewSampler
from renderers import Meter
from renderers.fields.analytic import box, sphere
from tests.tiny import silent

VIEW = ViewSampler(2.5, 50.0, (0.0, 360.0), (15.0, 35.0), 128)
TEN = AutoSettings(10.0)


def test_epsilon_is_that_of_the_papers_example():
    # DIST, A.2: f = 60 mm, S = 32 mm, d = 100 mm, R = 512: about 0.05 mm. In scene units, with d = 1 from 2 away:
    field_of_view = 2 * torch.rad2deg(torch.atan(torch.tensor(16 / 60))).item()
    view = ViewSampler(2.0, field_of_view, (0.0, 0.0), (0.0, 0.0), 512)
    assert epsilon(view, OmegaConf.create({}), TEN) * 100 == pytest.approx(0.0521, rel=1e-3)


def test_steps_are_those_of_the_papers_example():
    # DIST, A.1: 52 steps at alpha 1 and 33 at 1.5, at 10 degrees and epsilon 5e-5.
    assert steps(VIEW, OmegaConf.create({"epsilon": 5e-5, "alpha": 1.0}), TEN) == 52
    assert steps(VIEW, OmegaConf.create({"epsilon": 5e-5, "alpha": 1.5}), TEN) == 33


@pytest.mark.parametrize(
    ("alpha", "grazing", "expected"),
    [(1.5, 30.0, 15), (1.5, 41.81, 15), (1.0, 90.0, 1), (1.0, 30.0, 15), (0.5, 90.0, 15), (1.0, 89.9, 1)],
)
def test_steps_reach_every_surface_that_is_met_at_the_angle_or_above(alpha, grazing, expected):
    node = OmegaConf.create({"epsilon": 5e-5, "alpha": alpha})
    assert steps(VIEW, node, AutoSettings(grazing)) == expected


def test_steps_that_cannot_be_computed_are_errors():
    with pytest.raises(ValueError, match=r"alpha must lie between 0 and 2, not 2"):
        steps(VIEW, OmegaConf.create({"epsilon": 5e-5, "alpha": 2.0}), TEN)
    with pytest.raises(ValueError, match=r"which this renderer does not have: give a number"):
        steps(VIEW, OmegaConf.create({"steps": "auto"}), TEN)


def test_epsilon_and_steps_are_resolved_in_order_with_notes():
    node, notes = resolved(OmegaConf.create({"epsilon": "auto", "steps": "auto", "alpha": 1.5}), VIEW, TEN)
    assert node.epsilon == pytest.approx(1.5 / (2 * 137.25), rel=1e-3)
    assert node.steps == steps(VIEW, node, TEN) < 33
    seen = "for 128 pixels from 2.5 away (view)"
    numbers = {"epsilon": f"{node.epsilon:.4g}", "steps": str(node.steps)}
    angle = {"epsilon": "", "steps": ", for surfaces met at 10 degrees or more (auto.grazing)"}
    assert notes == [f"renderer.{name}=auto is {number}, {seen}{angle[name]}" for name, number in numbers.items()]


def test_auto_without_an_equation_is_an_error():
    with pytest.raises(ValueError, match=r"renderer\.alpha=auto has no equation: only epsilon, steps, n_ray_samples"):
        resolved(OmegaConf.create({"alpha": "auto"}), VIEW, TEN)
    with pytest.raises(ValueError, match=r"view\.distance - 1 must be positive.*outside of the unit sphere"):
        epsilon(ViewSampler(0.9, 50.0, (0.0, 0.0), (0.0, 0.0), 64), OmegaConf.create({}), TEN)
    with pytest.raises(ValueError, match=r"auto\.grazing must be positive"):
        AutoSettings(0.0)


def test_a_run_has_the_resolved_number_and_a_note(compose_config):
    config = compose_config("renderer.epsilon=auto", "renderer.steps=auto", "view.resolution=128", "dataset=sphere")
    inputs = set_up(config, silent)
    assert inputs.renderer.epsilon == pytest.approx(0.005465, rel=1e-3)
    assert inputs.notes[0].startswith("renderer.epsilon=auto is 0.005465, for 128 pixels")


@pytest.mark.parametrize("name", ["dist", "idr", "naive"])
@pytest.mark.parametrize("shape", [sphere(0.6), box((0.4, 0.3, 0.5))], ids=["sphere", "box"])
def test_no_more_precision_than_a_pixel_loses_no_pixel_and_saves_a_fifth(name, shape):
    rays = VIEW.camera(30.0, 25.0).rays()
    fine, auto = Meter(shape), Meter(shape)
    kept = load("renderer", name).render(fine, rays).hit
    found = load("renderer", name, epsilon=epsilon(VIEW, OmegaConf.create({}), TEN)).render(auto, rays).hit
    assert int((kept & ~found).sum()) == 0
    if name != "naive":  # which asks every ray at every step
        assert auto.counts.value <= 0.8 * fine.counts.value
