"""Reference gradients against closed forms: planes with known derivatives, and a moving edge."""

from math import sqrt

import pytest
import torch

from bench.evaluate.finite_differences import _clear, differences, image_differences, outline_steps, subrays
from renderers.camera import Camera, Rays
from renderers.fields.analytic import Shape
from renderers.fields.mlp import Decoder
from renderers.fields.network import Coded, Published
from renderers.fields.published import Layered
from renderers.reference import trace
from tests.looped import each
from tests.tiny import camera_of, plane_decoder

CODE_WEIGHTS = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
CODE = torch.tensor([0.1, 0.2, -0.1], dtype=torch.float64)
OFFSET = -0.06  # the plane goes through the origin
NORMALS = {"frontal": (0.0, 0.0, 1.0), "oblique": (0.6, 0.0, 0.8), "grazing": (sqrt(1 - 0.1**2), 0.0, 0.1)}


def camera() -> Camera:
    return camera_of(6, field_of_view=2.0).double()


def plane(normal: tuple[float, float, float], scale: float = 1.0) -> Decoder:
    """scale * (normal . x + CODE_WEIGHTS . code - OFFSET)."""
    return plane_decoder([scale * x for x in normal], scale * CODE_WEIGHTS, scale * OFFSET)


def published_plane(normal: torch.Tensor) -> Coded:
    """The plane as a network that takes one code at a time."""
    layer = torch.cat([CODE_WEIGHTS, normal])[None], torch.tensor([-OFFSET], dtype=torch.float64)
    return Coded(Layered([layer], activation="relu"), code_length=3, width=1).double()


def distance_to_plane(normal: torch.Tensor, rays: Rays, code: torch.Tensor) -> torch.Tensor:
    level = OFFSET - CODE_WEIGHTS @ code
    return (level - rays.origins @ normal) / (rays.directions @ normal)


@each("scale", [1.0, 0.4, 3.0])
@each("angle", NORMALS)
def test_differences_are_the_derivatives_of_a_plane(angle, scale):
    normal, pixels = torch.tensor(NORMALS[angle], dtype=torch.float64), torch.tensor([0, 7, 20, 35])
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    distance = distance_to_plane(normal, camera().moved(twist).rays().flat()[pixels], CODE)
    by_camera = torch.stack([torch.autograd.grad(d, twist, retain_graph=True)[0] for d in distance])
    slope = camera().rays().flat()[pixels].directions @ normal
    directions = torch.linalg.qr(torch.randn(3, 2, generator=torch.Generator().manual_seed(0)).double()).Q

    for network in (plane(NORMALS[angle], scale), Published(published_plane(normal), 0)):
        result = differences(network, CODE, directions, camera=camera(), pixels=pixels, distance=distance.detach())
        assert result.valid.all()
        assert torch.allclose(result.code[:, 0], -(CODE_WEIGHTS @ directions) / slope[:, None], rtol=1e-7, atol=1e-8)
        assert torch.allclose(result.camera[:, 0], by_camera, rtol=1e-7, atol=1e-7)


def union_decoder(first: tuple[torch.Tensor, float], second: tuple[torch.Tensor, float]) -> Decoder:
    """The minimum of the fields of two planes, normal . x - offset. A code of one number is added to the first."""
    (a, a_offset), (b, b_offset) = first, second
    towards_code = torch.tensor([1.0], dtype=torch.float64)
    rows = [torch.cat([towards_code, a]), -torch.cat([towards_code, a]), torch.cat([towards_code, a - b])]
    decoder = Decoder(layers=1, width=3, code_length=1, skip=0, narrow=False).double().requires_grad_(False)
    decoder.hidden[0].weight.copy_(torch.stack(rows))
    decoder.hidden[0].bias.copy_(torch.tensor([-a_offset, a_offset, b_offset - a_offset], dtype=torch.float64))
    decoder.last.weight.copy_(torch.tensor([[1.0, -1.0, -1.0]]))
    decoder.last.bias.zero_()
    return decoder


def test_a_grazing_pixel_does_not_spoil_other_pixels():
    """Its distance moves 20,000 times as far as the field, but the distances of other pixels do not."""
    pixels, slope = torch.tensor([15, 17]), 5e-5
    rays = camera().rays().flat()[pixels]
    other, flat = rays.directions
    aside = torch.nn.functional.normalize(other - (other @ flat) * flat, dim=0)
    grazed = aside - slope * flat  # it rises along the first ray and falls slowly along the second
    point = rays.origins[1] + 2.0 * flat
    front = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    decoder = union_decoder((front, 0.0), (grazed, (grazed @ point).item()))
    decoder.hidden[0].weight[2, 0] = 0.0  # the code moves both planes
    distance = torch.stack([-rays.origins[0, 2] / other[2], torch.tensor(2.0, dtype=torch.float64)])
    code, directions = torch.zeros(1).double(), torch.ones(1, 1).double()
    assert torch.allclose(decoder.at(code)(rays.at(distance)), torch.zeros(2).double(), atol=1e-12)
    result = differences(decoder, code, directions, camera=camera(), pixels=pixels, distance=distance)
    assert result.code[1, 0, 0].item() == pytest.approx(1 / slope, rel=0.01)
    assert result.code[0, 0, 0].item() == pytest.approx(-1 / other[2].item(), rel=1e-7) and result.valid[0]


@each("height, valid", [(3e-6, False), (1e-4, True)])
def test_a_ray_along_a_plane_that_a_step_may_move_into_the_ray_is_invalid(height, valid):
    pixels = torch.tensor([15])
    origin, along = (
        tensor[0] for tensor in (camera().rays().flat()[pixels].origins, camera().rays().flat()[pixels].directions)
    )
    normal = torch.nn.functional.normalize(torch.linalg.cross(along, torch.tensor([1.0, 0, 0]).double()), dim=0)
    front = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    decoder = union_decoder((normal, (normal @ origin).item() - height), (front, 0.0))
    decoder.hidden[0].weight[2, 0] = 0.0  # the code moves both planes, by 1e-6 in a step
    code, directions = torch.zeros(1).double(), torch.tensor([[1.0, 0.0]]).double()  # the second moves nothing
    distance = (-origin[2] / along[2])[None]
    result = differences(decoder, code, directions, camera=camera(), pixels=pixels, distance=distance)
    assert result.code[0, 0, 0].item() == pytest.approx(-1 / along[2].item(), rel=1e-6)
    assert result.valid.tolist() == [valid]


def passing_decoder(position: float, height: float) -> Decoder:
    """The minimum of 20 z and 0.1 |z - position| + height: a wall at 0, and a surface near the way to it."""
    decoder = Decoder(layers=2, width=4, code_length=0, skip=0, narrow=False).double().requires_grad_(False)
    decoder.hidden[0].weight.copy_(torch.tensor([0.1, -0.1, 20, -20])[:, None] * torch.tensor([0.0, 0, 1]))
    decoder.hidden[0].bias.copy_(torch.tensor([-0.1 * position, 0.1 * position, 0.0, 0.0]))
    decoder.hidden[1].weight.copy_(torch.tensor([[-1.0, -1, 1, -1], [0, 0, 1, -1], [0, 0, -1, 1], [0, 0, 0, 0]]))
    decoder.hidden[1].bias.copy_(torch.tensor([-height, 0.0, 0.0, 0.0]))
    decoder.last.weight.copy_(torch.tensor([[-1.0, 1.0, -1.0, 0.0]]))
    decoder.last.bias.zero_()
    return decoder


@each("position, height, clear", [(0.5, 0.004, False), (0.5, 0.02, True), (0.9, 0.004, False), (-0.5, 0.004, True)])
def test_a_ray_that_passes_close_to_a_surface_before_its_hit_is_not_clear(position, height, clear):
    field = passing_decoder(position, height).at(torch.zeros(0).double())
    z = torch.linspace(-0.9, 0.9, 19, dtype=torch.float64)
    points = torch.stack([torch.zeros(19), torch.zeros(19), z], dim=1)
    assert torch.allclose(field(points), torch.minimum(20 * z, 0.1 * (z - position).abs() + height), atol=1e-12)
    rays = Rays(torch.tensor([[0.0, 0, 2.5]]).double(), torch.tensor([[0.0, 0, -1]]).double())
    is_clear = _clear(field, rays, torch.tensor([2.5]).double(), margin=torch.tensor(0.01).double())
    assert is_clear.tolist() == [clear]


def edge(position: torch.Tensor | float) -> Shape:
    """A wall z <= 0 that ends at x = `position`. A camera in front of it does not see the side of its end."""
    return Shape(lambda points: torch.maximum(points[..., 2], points[..., 0] - 0.2 * points[..., 2] - position))


def test_image_differences_include_the_visibility_gradient():
    """An edge moves by columns of rays: the distance of each changes from the background to the wall."""
    view, count = camera_of(8, field_of_view=2.0).double(), 6
    directions, pixels = torch.eye(2).double(), torch.tensor([8 * 3 + 3, 8 * 3 + 4, 8 * 3 + 6])
    column = 2.5 / view.intrinsics[0, 0].item() / count  # width of a column of rays, where the wall is
    middle = 2 * column  # between the second and the third column of the pixel beside the axis
    rates = image_differences(
        lambda shift: edge(middle + shift[0]), directions,
        camera=view, pixels=pixels, steps=torch.full((2,), 2 * column).double(), supersampling=count, lipschitz=1.1,
    )  # fmt: skip
    columns = subrays(view, pixels[1:2], count).directions[0].view(count, count, 3)
    swapped = columns[:, :4]  # the edge moves from two columns before the middle to two behind it
    wall = -2.5 / swapped[..., 2]
    sine = (1 - swapped[..., 2].square()).sqrt()
    background = 2.5 * -swapped[..., 2] + (1 - (2.5 * sine).square()).sqrt()
    rate = (wall - background).sum() / count**2 / (4 * column)
    assert rates[1, 0].item() == pytest.approx(rate.item(), rel=1e-6)
    assert rates[1, 0] < -1 / (8 * column)  # more than one scene unit, times the fraction of the pixel
    assert torch.equal(rates[:, 1], torch.zeros(3).double())  # the other direction moves nothing
    assert rates[[0, 2], 0].abs().max() < 1e-9


def test_image_differences_without_an_edge_are_those_of_the_surface():
    view, pixels = camera(), torch.tensor([0, 14])
    rates = image_differences(
        lambda shift: plane((0, 0, 1)).at(CODE + shift), torch.eye(3).double(),
        camera=view, pixels=pixels, steps=torch.full((3,), 1e-3).double(), supersampling=3, lipschitz=1.2,
    )  # fmt: skip
    slope = subrays(view, pixels, 3).directions[..., 2]
    assert torch.allclose(rates, -CODE_WEIGHTS * (1 / slope).mean(dim=1, keepdim=True), rtol=1e-6)


def test_the_steps_at_an_outline_move_the_surface_by_a_fraction_of_a_pixel():
    """A plane across the view moves by the step along the direction of the code."""
    view, pixels = camera(), torch.tensor([0, 5, 14])
    steps = outline_steps(
        lambda shift: plane((0, 0, 1)).at(CODE + shift), torch.eye(3).double(),
        camera=view, pixels=pixels, shift=0.1, lipschitz=1.2,
    )  # fmt: skip
    rays = view.rays().flat()[pixels]
    distance = trace(plane((0, 0, 1)).at(CODE), rays, lipschitz=1.2, least_step=1e-3, radius=1.0).distance
    footprint = (view.intrinsics[0, 0] / distance).quantile(0.9)
    expected = 0.1 / (CODE_WEIGHTS.abs() * footprint)
    torch.testing.assert_close(steps, expected.squeeze(), rtol=1e-4, atol=0)


def test_rays_within_pixels_lie_on_a_regular_grid_about_the_pixels_own():
    # 4 rows of 6 pixels: number 7 is in row 1, column 1, and number 18 in row 3, column 0.
    view, pixels = Camera(camera_of(4).intrinsics, camera_of(4).world_to_camera, 4, 6).double(), torch.tensor([7, 18])
    rays = subrays(view, pixels, 3)
    assert rays.shape == (2, 9)
    assert torch.allclose(rays.directions[:, 4], view.rays().flat()[pixels].directions)  # the middle one of nine
    in_camera = rays.directions @ view.world_to_camera[:3, :3].T
    image = (in_camera / in_camera[..., 2:]) @ view.intrinsics.T
    inner = (torch.arange(3) + 0.5) / 3
    columns = torch.stack([1 + inner.repeat(3), 0 + inner.repeat(3)]).double()
    rows = torch.stack([1 + inner.repeat_interleave(3), 3 + inner.repeat_interleave(3)]).double()
    assert torch.allclose(image[..., 0], columns) and torch.allclose(image[..., 1], rows)
    assert torch.allclose(rays.origins, view.center.expand(2, 9, 3))
