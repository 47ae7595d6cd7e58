"""Networks of encoded points: features against closed forms, and slopes in float64 against central differences."""

from dataclasses import replace
from math import pi

import pytest
import torch
from torch import Tensor

from bench.evaluate.colours import colours_at
from renderers.field import Meter, autograd_gradients, gradients_at
from renderers.fields.networks.coloured import ColouredEncoded
from renderers.fields.networks.encoded import EncodedNetwork, FourierFeatures, HashGrid

DRAW = torch.Generator().manual_seed(3)


def numbers(*shape: int) -> Tensor:
    return torch.randn(*shape, generator=DRAW, dtype=torch.float64)


POINTS = torch.rand(200, 3, generator=DRAW, dtype=torch.float64) * 2 - 1
ENCODINGS = {
    "fourier": FourierFeatures(numbers(4, 3)),
    "hash": HashGrid(numbers(2, 64, 2), (3, 7), 1.05),  # the first level has an entry for each corner, the second not
}


def test_fourier_features_are_waves_of_their_frequencies():
    features = FourierFeatures(torch.tensor([[1.0, 0.0, 0.5]], dtype=torch.float64))(POINTS)
    angles = 2 * pi * (POINTS[:, 0] + 0.5 * POINTS[:, 2])
    torch.testing.assert_close(features, torch.stack([angles.cos(), angles.sin()], dim=-1))


def test_a_level_without_collisions_interpolates_a_linear_function_exactly_and_is_constant_outside():
    axis = torch.linspace(-1, 1, 4, dtype=torch.float64)
    corners = torch.cartesian_prod(axis, axis, axis)
    slope = torch.tensor([[1.0, 2.0], [-1.0, 0.5], [3.0, 0.0]], dtype=torch.float64)
    grid = HashGrid((corners @ slope)[None], (3,), 1.0)
    torch.testing.assert_close(grid(POINTS), POINTS @ slope)
    torch.testing.assert_close(grid(3 * POINTS), (3 * POINTS).clamp(-1, 1) @ slope)


def test_corners_of_a_level_larger_than_its_table_share_entries():
    shared = HashGrid(torch.arange(16.0)[None, :, None], (8,), 1.0)
    corners = torch.cartesian_prod(*[torch.arange(9)] * 3)
    entries = shared(corners / 4 - 1.0).squeeze(-1)
    assert sorted(entries.unique().tolist()) == list(range(16))
    assert entries[corners.tolist().index([1, 1, 0])] == (1 ^ 2_654_435_761) % 16


@pytest.mark.parametrize("name", ENCODINGS)
def test_slopes_are_those_of_central_differences(name):
    encoding = ENCODINGS[name]
    inputs = 3 + encoding(POINTS).shape[1]
    field = EncodedNetwork(encoding, ((numbers(8, inputs), numbers(8)), (numbers(1, 8), numbers(1))))
    step = 1e-6 * torch.eye(3, dtype=torch.float64)
    numerical = torch.stack([(field(POINTS + h) - field(POINTS - h)) / 2e-6 for h in step], dim=-1)
    off = (autograd_gradients(field, POINTS) - numerical).abs().amax(dim=-1)
    assert (off < 1e-4).double().mean() > 0.98  # except within a step of a cell's side or of a ReLU's bend
    with torch.no_grad():
        torch.testing.assert_close(field(POINTS.view(10, 20, 3)), field(POINTS).view(10, 20))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_hash_grid_is_finite_and_continuous_at_the_ends_of_its_cube_and_outside(dtype):
    grid, end = ENCODINGS["hash"], ENCODINGS["hash"].reach
    axis = torch.tensor([-torch.inf, -9.0, -end - 1e-6, -end, 0.0, end, end + 1e-6, 9.0, torch.inf], dtype=dtype)
    points = torch.cartesian_prod(axis, axis, axis).requires_grad_()
    tables = grid.tables.clone().requires_grad_()
    features = replace(grid, tables=tables)(points)
    torch.testing.assert_close(features, grid((points * (1 - 1e-6)).clamp(-end, end)), rtol=0, atol=1e-3)
    slopes, of_tables = torch.autograd.grad(features.square().sum(), (points, tables))
    assert features.isfinite().all() and slopes.isfinite().all() and of_tables.isfinite().all()
    assert (slopes[(points.abs() > end + 1e-5)] == 0).all() and (of_tables != 0).any()


def test_the_slopes_of_a_width_are_counted_differences_in_losses_and_for_colours():
    model = ColouredEncoded(
        HashGrid(0.1 * torch.randn(2, 64, 2, generator=torch.Generator().manual_seed(0)), (3, 7), 1.05),
        layers=1, width=8, radius=0.5, directional=False, slope_width=0.1,
    )  # fmt: skip
    with torch.no_grad():
        model.distance[0].weight.normal_(generator=torch.Generator().manual_seed(1))
    points, metered = POINTS.float(), Meter(model)
    slopes = gradients_at(metered, points)
    moved = [[model(points + sign * 0.05 * axis) for sign in (1, -1)] for axis in torch.eye(3)]
    expected = torch.stack([(ahead - behind) / 0.1 for ahead, behind in moved], dim=-1)
    torch.testing.assert_close(slopes, expected)
    assert metered.counts.value == 6 * len(points)
    assert (slopes - autograd_gradients(model, points)).abs().max() > 0.01
    seen = model.colours(points, expected, points)
    torch.testing.assert_close(colours_at(model, points, points, torch.device("cpu")), seen.detach())
