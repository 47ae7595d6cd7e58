"""The pixels of photographs of two sizes: drawn pixels, patches of neighbours, and their observations."""

from dataclasses import replace
from math import isqrt

import pytest
import torch

from bench.tasks.reconstruction.pixels import Stack
from datasets.shot import Shot
from renderers.camera import sphere_span
from renderers.checks import BadInput
from tests.looped import each
from tests.tasks.reconstruction.test_losses import ball, shot_of
from tests.tiny import CPU, camera_of

WIDE, TALL = camera_of(16).resized(12, 20), camera_of(16, angles=(90.0, 10.0)).resized(18, 8)
SIZES = [(12, 20), (18, 8)]


def numbered(camera, photograph: int) -> Shot:
    """A photograph whose colours are its number and the row and the column of each pixel, over 100."""
    rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    colours = torch.stack([torch.full_like(rows, photograph), rows, columns], dim=-1) / 100
    return Shot(str(photograph), camera, colours, (rows + columns) % 3 == 0)


SHOTS = [numbered(WIDE, 0), numbered(TALL, 1)]


def positions(pixels) -> torch.Tensor:
    """Photograph, row and column of pixels, from their colours."""
    return (100 * pixels.colours).round().long()


def test_pixels_are_in_one_row_with_their_rays():
    stack = Stack.build(SHOTS, None, CPU)
    assert len(stack.pixels.colours) == 12 * 20 + 18 * 8
    for shot, (photograph, row, column) in ((SHOTS[0], (0, 3, 7)), (SHOTS[1], (1, 11, 5))):
        index = photograph * 12 * 20 + row * SIZES[photograph][1] + column
        assert positions(stack.pixels)[index].tolist() == [photograph, row, column]
        assert stack.width[index] == SIZES[photograph][1]
        rays = shot.camera.rays()
        assert torch.equal(stack.pixels.rays.directions[index], rays.directions[row, column])
        assert torch.equal(stack.pixels.rays.origins[index], rays.origins[row, column])
        assert stack.pixels.mask is not None and stack.pixels.mask[index] == ((row + column) % 3 == 0)
        forward = shot.camera.world_to_camera[2, :3]
        assert stack.pixels.depth_per_distance[index].item() == pytest.approx(
            (rays.directions[row, column] @ forward).item()
        )


def test_patches_are_neighbours_in_one_photograph():
    drawn = positions(Stack.build(SHOTS, None, CPU).draw(2000, patches=True, seed=0)).view(-1, 4, 3)
    assert len(drawn) == 500 and set(drawn[:, 0, 0].tolist()) == {0, 1}
    offsets = torch.tensor([[0, 0, 0], [0, 0, 1], [0, 1, 0], [0, 1, 1]])
    assert (drawn == drawn[:, :1] + offsets).all()
    for photograph, (height, width) in enumerate(SIZES):
        inside = drawn[drawn[:, 0, 0] == photograph]
        assert (inside[..., 1] < height).all() and (inside[..., 2] < width).all()


@each("count", [4, 16])
def test_several_rays_lie_in_the_cells_of_their_pixel_of_the_right_photograph(count):
    shots, side = [replace(shot, covered=0.5 + 0.5 * shot.mask) for shot in SHOTS], isqrt(count)
    stack = Stack.build(shots, None, CPU)
    drawn = stack.draw(200, patches=False, seed=0)
    pixels = stack.with_rays(drawn, count, torch.Generator().manual_seed(0))
    assert pixels.several and not drawn.several and pixels.rays.shape == (200, count)
    assert torch.equal(pixels.covered, 0.5 + 0.5 * drawn.mask)
    for number, shot in enumerate(shots):
        here = positions(pixels)[:, 0] == number
        points = pixels.rays.at(torch.ones(200, count))[here]
        inside = shot.camera.project(points)[0] - positions(pixels)[here][:, [2, 1]][:, None]
        cells = (side * inside).floor().long()
        expected = torch.cartesian_prod(torch.arange(side), torch.arange(side)).expand_as(cells)
        assert (cells == expected).float().mean() > 0.999 and len(points) > 20
    assert torch.equal(pixels.inside(torch.ones(200, count).bool()), drawn.mask[:, None].expand(-1, count))


def test_only_rays_that_meet_the_unit_sphere_are_drawn_and_all_of_them():
    wide = [numbered(camera_of(16, field_of_view=100.0), 0), numbered(camera_of(9, field_of_view=90.0), 1)]
    stack = Stack.build(wide, None, CPU)
    meets = sphere_span(stack.pixels.rays)[2]
    assert 0.1 < meets.float().mean() < 0.5 and torch.equal(stack.useful, meets.nonzero().squeeze(-1))
    drawn = stack.draw(4000, patches=False, seed=0)
    assert sphere_span(drawn.rays)[2].all() and len(torch.unique(positions(drawn), dim=0)) == int(meets.sum())
    patches = stack.draw(4000, patches=True, seed=0)
    assert sphere_span(patches.rays)[2][::4].all()  # the upper left pixel of each


def test_cameras_that_look_away_are_refused():
    camera = camera_of(8, field_of_view=30.0)
    turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    away = replace(camera, world_to_camera=turn @ camera.world_to_camera)
    with pytest.raises(BadInput, match="no ray meets the unit sphere"):
        Stack.build([numbered(away, 0)], None, CPU)


def test_observed_depths_become_distances_along_rays_or_nan():
    shape, cameras = ball(), (WIDE, TALL)
    shots = [shot_of(shape, camera) for camera in cameras]
    stack = Stack.build(shots, None, CPU)
    true = torch.cat([shape.distance(camera.double().rays()).flatten() for camera in cameras]).float()
    assert stack.pixels.distance is not None and 20 < int(true.isfinite().sum()) < len(true)
    torch.testing.assert_close(stack.pixels.distance, true, rtol=0, atol=1e-5, equal_nan=True)
    assert stack.pixels.normals is not None and stack.pixels.normals.shape == (len(true), 3)
    alone = Stack.build([shots[0], replace(shots[1], depth=None)], None, CPU).pixels.distance
    assert alone is not None and alone[12 * 20 :].isnan().all() and alone[: 12 * 20].isfinite().any()


def test_a_guide_keeps_its_order_and_unknown_observations_are_none():
    guide = [torch.full(size, 1.0 + number) for number, size in enumerate(SIZES)]
    pixels = Stack.build([replace(shot, mask=None) for shot in SHOTS], guide, CPU).pixels
    assert pixels.guide is not None and pixels.guide.tolist() == [1.0] * 240 + [2.0] * 144
    assert (pixels.mask, pixels.distance, pixels.normals) == (None, None, None)
    subset = pixels[torch.tensor([239, 240])]
    assert subset.guide is not None and subset.guide.tolist() == [1.0, 2.0] and subset.mask is None
    assert Stack.build(SHOTS, None, CPU).pixels.guide is None
