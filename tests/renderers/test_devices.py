"""Each tensor is created on the device of its inputs, whatever the default device is."""

from collections.abc import Iterator

import pytest
import torch

from bench.config import load
from bench.tables import choice, names
from renderers.camera import Camera
from renderers.field import Field, Moved, estimate_lipschitz
from renderers.fields.grid import Grid
from renderers.fields.mlp import Decoder
from renderers.rendering import RayObservation
from renderers.silhouette import DEPTH, CrossEntropy, Hinge, Occupancy, Own

CPU = torch.device("cpu")
NAMES = [name for name in names("renderer") if "defaults" not in choice("renderer", name) and name != "custom"]
NAMES += ["naive_practical", "dist_slope_bound", "dist_dynamic", "dvr_early_stop"]  # presets with separate code
SILHOUETTES = (Own(), Hinge(5e-5, True, "violating"), CrossEntropy(50.0, 100.0), Occupancy(0.02, 3.0, 1.0, DEPTH))


@pytest.fixture
def meta_default_device() -> Iterator[None]:
    """The default device holds no data: a tensor created on it by mistake cannot be combined with the inputs."""
    torch.set_default_device("meta")
    yield
    torch.set_default_device(None)


def camera(size: int) -> Camera:
    """The unit sphere from 2.5 away, on the CPU."""
    intrinsics = torch.tensor([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1]], device=CPU)
    world_to_camera = torch.eye(4, device=CPU)
    world_to_camera[2, 3] = 2.5
    return Camera(intrinsics, world_to_camera, size, size)


def fields() -> dict[str, Field]:
    """One field of each class, on the CPU."""
    axis = torch.linspace(-1.05, 1.05, 9, device=CPU)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
    distances = torch.linalg.vector_norm(points, dim=-1) - 0.5
    with torch.device(CPU):
        decoder = Decoder(layers=2, width=8, code_length=2, skip=0, narrow=False)
    torch.nn.init.constant_(decoder.last.bias, 0.05)
    code = torch.zeros(2, device=CPU, requires_grad=True)
    grid = Grid(distances.requires_grad_(), 1.05)
    return {
        "grid": grid,
        "decoder": decoder.requires_grad_(False).at(code),
        "moved": Moved(grid, torch.zeros(7, device=CPU, requires_grad=True)),
    }


@pytest.mark.parametrize("name", NAMES)
def test_a_renderer_stays_on_the_device_of_its_rays(meta_default_device, name):
    renderer = load("renderer", name)
    size = 4 if name.startswith("naive") else 12  # pixels per side; with a default device all operations are slow
    for field in fields().values():
        rays = camera(size).rays()
        rays.origins.requires_grad_()
        rendering = renderer.render(field, rays)
        depth = torch.where(rendering.hit, rendering.distance.detach(), torch.nan)
        observed = RayObservation(rendering.hit.logical_not(), depth)
        losses = [silhouette(renderer, field, rays, rendering, observed) for silhouette in SILHOUETTES]
        total = torch.stack([rendering.distance.sum(), *losses]).sum()
        assert total.device == CPU
        total.backward()
        assert rays.origins.grad is not None and rays.origins.grad.device == CPU


def test_the_steepest_gradient_is_measured_where_the_field_is(meta_default_device):
    steepest = estimate_lipschitz(fields()["grid"], radius=1.0, samples=64, like=torch.zeros(1, device=CPU))
    assert 0.9 < steepest < 1.5
