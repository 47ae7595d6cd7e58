"""The judge of gradients against closed forms: planes, whose derivatives are known, and an edge that moves."""

from math import sqrt

import pytest
import torch

from bench.tasks.gradients.finite_differences import _clear, differences, image_differences, outline_steps, subrays
from renderers.camera import Camera, Rays
from renderers.fields.analytic import Shape
from renderers.fields.mlp import Decoder
from renderers.fields.networks.network import Coded, Published
from renderers.fields.networks.published import Layered
from renderers.tracing.reference import trace
from tests.looped import each
from tests.tiny import camera_of, plane_decoder

CODE_WEIGHTS = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
CODE = torch.tensor([0.1, 0.2, -0.1], dtype=torch.float64)
OFFSET = -0.06  # so that the plane goes through the origin
NORMALS = {"frontal": (0.0, 0.0, 1.0), "oblique": (0.6, 0.0, 0.8), "grazing": (sqrt(1 - 0.1**2), 0.0, 0.1)}


def camera() -> Camera:
    return camera_of(6, field_of_view=2.0).double()


def plane(normal: tuple[float, float, float], scale: float = 1.0) -> Decoder:
    """scale * (normal . x + CODE_WEIGHTS . code - OFFSET)."""
    return plane_decoder([scale * x for x in normal], scale * CODE_WEIGHTS, scale * OFFSET)


@each("scale", [1.0, 0.4, 3.0])
@each("angle", NORMALS)
def test_differences_are_the_derivatives_of_a_plane(angle, scale):
    normal, pixels = torch.tensor(NORMALS[angle], dtype=torch.float64), torch.tensor([0, 7, 20, 35])
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    rays = camera().moved(twist).rays().flat()[pixels]
    distance = (OFFSET - CODE_WEIGHTS @ CODE - rays.origins @ normal) / (rays.directions @ normal)
    by_camera = torch.stack([torch.autograd.grad(hit, twist, retain_graph=True)[0] for hit in distance])
    slope = camera().rays().flat()[pixels].directions @ normal
    directions = torch.linalg.qr(torch.randn(3, 2, generator=torch.Generator().manual_seed(0)).double()).Q

    layer = torch.cat([CODE_WEIGHTS, normal])[None], torch.tensor([-OFFSET], dtype=torch.float64)
    published = Coded(Layered([layer], activation="relu"), code_length=3, width=1).double()  # takes one code at a time
    for network in (plane(NORMALS[angle], scale), Published(published, 0)):
        result = differences(network, CODE, directions, camera=camera(), pixels=pixels, distance=distance.detach())
        assert result.valid.all()
        assert torch.allclose(result.code[:, 0], -(CODE_WEIGHTS @ directions) / slope[:, None], rtol=1e-7, atol=1e-8)
        assert torch.allclose(result.camera[:, 0], by_camera, rtol=1e-7, atol=1e-7)


def union_decoder(first: tuple[torch.Tensor, float], second: tuple[torch.Tensor, float]) -> Decoder:
    """The lesser of two planes' fields, normal . x - offset, with a code of one number added to the first."""
    (a, a_offset), (b, b_offset) = first, second
    towards_code = torch.tensor([1.0], dtype=torch.float64)
    rows = [torch.cat([towards_code, a]), -torch.cat([towards_code, a]), torch.cat([towards_code, a - b])]
    decoder = Decoder(layers=1, width=3, code_length=1, skip=0, narrow=False).double().requires_grad_(False)
    decoder.hidden[0].weight.copy_(torch.stack(rows))
    decoder.hidden[0].bias.copy_(torch.tensor([-a_offset, a_offset, b_offset - a_offset], dtype=torch.float64))
    decoder.last.weight.copy_(torch.tensor([[1.0, -1.0, -1.0]]))
    decoder.last.bias.zero_()
    return decoder


@each("height, valid", [(3e-6, False), (1e-4, True)])
def test_a_ray_along_a_plane_that_steps_may_lift_into_its_way_is_left_out(height, valid):
    pixels = torch.tensor([15])
    origin, along = (
        part[0] for part in (camera().rays().flat()[pixels].origins, camera().rays().flat()[pixels].directions)
    )
    across = torch.nn.functional.normalize(torch.linalg.cross(along, torch.tensor([1.0, 0, 0]).double()), dim=0)
    front = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    decoder = union_decoder((across, (across @ origin).item() - height), (front, 0.0))
    decoder.hidden[0].weight[2, 0] = 0.0  # the code moves both planes, by 1e-6 in a step
    code, directions = torch.zeros(1).double(), torch.tensor([[1.0, 0.0]]).double()  # the second moves nothing
    distance = (-origin[2] / along[2])[None]
    result = differences(decoder, code, directions, camera=camera(), pixels=pixels, distance=distance)
    assert result.code[0, 0, 0].item() == pytest.approx(-1 / along[2].item(), rel=1e-6)
    assert result.valid.tolist() == [valid]


def passing_decoder(position: float, height: float) -> Decoder:
    """The lesser of 20 z and 0.1 |z - at| + height, in float64: a wall at 0, and something beside the way to it."""
    decoder = Decoder(layers=2, width=4, code_length=0, skip=0, narrow=False).double().requires_grad_(False)
    decoder.hidden[0].weight.copy_(torch.tensor([0.1, -0.1, 20, -20])[:, None] * torch.tensor([0.0, 0, 1]))
    decoder.hidden[0].bias.copy_(torch.tensor([-0.1 * position, 0.1 * position, 0.0, 0.0]))
    decoder.hidden[1].weight.copy_(torch.tensor([[-1.0, -1, 1, -1], [0, 0, 1, -1], [0, 0, -1, 1], [0, 0, 0, 0]]))
    decoder.hidden[1].bias.copy_(torch.tensor([-height, 0.0, 0.0, 0.0]))
    decoder.last.weight.copy_(torch.tensor([[-1.0, 1.0, -1.0, 0.0]]))
    decoder.last.bias.zero_()
    return decoder


@each("position, height, clear", [(0.5, 0.004, False), (0.5, 0.02, True), (0.9, 0.004, False), (-0.5, 0.004, True)])
def test_a_ray_that_passes_close_by_something_before_its_hit_is_not_clear(position, height, clear):
    field = passing_decoder(position, height).at(torch.zeros(0).double())
    z = torch.linspace(-0.9, 0.9, 19, dtype=torch.float64)
    points = torch.stack([torch.zeros(19), torch.zeros(19), z], dim=1)
    assert torch.allclose(field(points), torch.minimum(20 * z, 0.1 * (z - position).abs() + height), atol=1e-12)
    rays = Rays(torch.tensor([[0.0, 0, 2.5]]).double(), torch.tensor([[0.0, 0, -1]]).double())
    result = _clear(field, rays, torch.tensor([2.5]).double(), margin=torch.tensor(0.01).double())
    assert result.tolist() == [clear]


def edge(position: torch.Tensor | float) -> Shape:
    """A wall z <= 0 that ends at x = `at`; its end recedes from there, so that a camera in front sees none of it."""
    return Shape(lambda points: torch.maximum(points[..., 2], points[..., 0] - 0.2 * points[..., 2] - position))


def test_the_differences_of_an_image_see_what_comes_into_view():
    """An edge moves by so many columns of rays: each swaps the background's distance for that of the wall."""
    view, count = camera_of(8, field_of_view=2.0).double(), 6
    directions, pixels = torch.eye(2).double(), torch.tensor([8 * 3 + 3, 8 * 3 + 4, 8 * 3 + 6])
    column = 2.5 / view.intrinsics[0, 0].item() / count  # width of a column of rays, where the wall is
    middle = 2 * column  # between the second and the third column of the pixel beside the axis
    result = image_differences(
        lambda shift: edge(middle + shift[0]), directions,
        camera=view, pixels=pixels, steps=torch.full((2,), 2 * column).double(), supersampling=count, lipschitz=1.1,
    )  # fmt: skip
    columns = subrays(view, pixels[1:2], count).directions[0].view(count, count, 3)
    swapped = columns[:, :4]  # the edge moves over them, from two before the middle to two behind it
    wall = -2.5 / swapped[..., 2]
    sine = (1 - swapped[..., 2].square()).sqrt()
    background = 2.5 * -swapped[..., 2] + (1 - (2.5 * sine).square()).sqrt()
    rate = (wall - background).sum() / count**2 / (4 * column)
    assert result[1, 0].item() == pytest.approx(rate.item(), rel=1e-6)
    assert result[1, 0] < -1 / (8 * column)  # more than one unit of distance, times its share of the pixel
    assert torch.equal(result[:, 1], torch.zeros(3).double())  # the other direction moves nothing
    assert result[[0, 2], 0].abs().max() < 1e-9


def test_the_differences_of_an_image_are_those_of_the_surface_where_no_edge_moves():
    view, pixels = camera(), torch.tensor([0, 14])
    result = image_differences(
        lambda shift: plane((0, 0, 1)).at(CODE + shift), torch.eye(3).double(),
        camera=view, pixels=pixels, steps=torch.full((3,), 1e-3).double(), supersampling=3, lipschitz=1.2,
    )  # fmt: skip
    slope = subrays(view, pixels, 3).directions[..., 2]
    assert torch.allclose(result, -CODE_WEIGHTS * (1 / slope).mean(dim=1, keepdim=True), rtol=1e-6)


def test_the_steps_at_an_outline_move_the_surface_by_parts_of_a_pixel():
    """A plane across the view moves by as much as the code's direction says; a steeper field by less."""
    view, pixels = camera(), torch.tensor([0, 5, 14])
    result = outline_steps(
        lambda shift: plane((0, 0, 1)).at(CODE + shift), torch.eye(3).double(),
        camera=view, pixels=pixels, shift=0.1, lipschitz=1.2,
    )  # fmt: skip
    rays = view.rays().flat()[pixels]
    distance = trace(plane((0, 0, 1)).at(CODE), rays, lipschitz=1.2, least_step=1e-3, radius=1.0).distance
    footprint = (view.intrinsics[0, 0] / distance).quantile(0.9)
    expected = 0.1 / (CODE_WEIGHTS.abs() * footprint)
    torch.testing.assert_close(result, expected.squeeze(), rtol=1e-4, atol=0)
