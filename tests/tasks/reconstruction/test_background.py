"""Backgrounds: their colours, and the colours of a volume in front of them."""

import pytest
import torch

from bench.config import load
from bench.tasks.reconstruction.background import CHOICES, OutsideSphere, make
from bench.tasks.reconstruction.losses import Losses
from bench.tasks.reconstruction.pixels import Pixels
from renderers.camera import Rays
from renderers.checks import BadInput
from renderers.field import Counts, Meter
from renderers.fields.networks.coloured import ColouredGrid
from renderers.silhouette import Own
from tests.looped import each
from tests.tiny import camera_of

LOSSES = Losses(
    colour=1.0, colour_gradient=0.0, depth=0.0, depth_loss="depth", silhouette=Own(), silhouette_weight=0.0,
    smoothness=0.0, normals=0.0, eikonal=0.0,
)  # fmt: skip
RAYS = camera_of(16, field_of_view=70.0).rays().flat()  # many miss the unit sphere


@each("name", [name for name in CHOICES if name != "none"])
def test_a_background_has_finite_colours_on_all_rays(name):
    torch.manual_seed(0)
    background = make(name)
    radial = Rays(2 * RAYS.directions, RAYS.directions)  # also rays from outside through the origin's side
    for rays in (radial, RAYS):
        colours = background(rays)
        assert colours.shape == (256, 3) and bool(colours.isfinite().all())
        assert float(colours.detach().min()) >= 0 and float(colours.detach().max()) <= 1
    if name == "sphere":
        colours.sum().backward()
        assert all(bool(p.grad.isfinite().all()) and bool((p.grad != 0).any()) for p in background.parameters())


@pytest.mark.slow
def test_a_learnt_background_fits_a_distant_texture():
    torch.manual_seed(0)
    background, wanted = OutsideSphere(), (RAYS.directions + 1) / 2
    optimiser = torch.optim.Adam(background.parameters(), lr=0.001)
    for _ in range(150):
        optimiser.zero_grad()
        (background(RAYS) - wanted).abs().mean().backward()
        optimiser.step()
    assert (background(RAYS) - wanted).abs().mean().item() < 0.02


@each("name", ["neus_budget", "newton"])
def test_with_its_true_background_a_shape_of_true_colours_has_no_loss_without_masks(name):
    torch.manual_seed(0)
    shape = ColouredGrid(samples=24, radius=0.5, reach=1.05).field
    renderer, background = load("renderer", name), make("grey")
    rendering = renderer.render(shape, RAYS)
    colours = torch.full((256, 3), 0.5)  # also the initial colours of a grid
    pixels = Pixels(RAYS, colours, torch.ones(256), None, None, None, None)
    meter = Meter(shape, Counts())
    loss = LOSSES(renderer, shape, meter, pixels, background)["colour"]
    assert loss.item() == pytest.approx(0, abs=1e-5)
    darker = LOSSES(renderer, shape, meter, pixels, make("black"))["colour"]
    missing = ((1 - rendering.opacity).sum() if name == "neus_budget" else (~rendering.hit).sum()).item() / 256
    assert darker.item() == pytest.approx(1.5 * missing, rel=1e-3)


def test_a_volume_without_masks_names_the_background():
    shape = ColouredGrid(samples=12, radius=0.5, reach=1.05).field
    pixels = Pixels(RAYS, torch.zeros(256, 3), torch.ones(256), None, None, None, None)
    with pytest.raises(BadInput, match="background=sphere"):
        LOSSES(load("renderer", "neus_budget"), shape, Meter(shape, Counts()), pixels)
