"""Cameras and rays: axes, pixel centres, spans of the sphere, and coarser images, against closed forms."""

from math import cos, pi, sin

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.functional import normalize

from renderers.camera import Camera, Rays, distance_to_origin, rigid, sphere_span
from tests.looped import each
from tests.renderers.analytic_cases import sheet, vector

INTRINSICS = torch.tensor([[100.0, 0, 32], [0, 50, 20], [0, 0, 1]], dtype=torch.float64)


def motion(angle: float = 0.0, translation: tuple[float, ...] = (0, 0, 0)) -> torch.Tensor:
    """A rigid motion: a rotation about an oblique axis, then a translation."""
    x, y, z = axis = normalize(vector((1, 2, -2)), dim=0)
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] *= cos(angle)
    matrix[:3, :3] += sin(angle) * cross + (1 - cos(angle)) * torch.outer(axis, axis)
    matrix[:3, 3] = vector(translation)
    return matrix


def camera(world_to_camera: torch.Tensor | None = None, height: int = 40, width: int = 64) -> Camera:
    return Camera(INTRINSICS, motion() if world_to_camera is None else world_to_camera, height, width)


@settings(max_examples=5)
@given(angle=st.floats(-pi, pi), translation=st.tuples(*[st.floats(-3, 3)] * 3), seed=st.integers(0, 2**32))
def test_points_along_the_rays_project_back_to_their_pixels_and_depth_is_camera_z(angle, translation, seed):
    view = camera(motion(angle, translation))
    distance = 0.5 + torch.rand(40, 64, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    rays = view.rays()
    assert rays.image and rays.shape == (40, 64)
    points = rays.at(distance) @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]
    torch.testing.assert_close(view.depth(distance), points[..., 2], rtol=0, atol=1e-12)  # Eq. 2
    torch.testing.assert_close(view.distance(view.depth(distance)), distance)
    pixels = points @ INTRINSICS.T
    rows, columns = torch.meshgrid(torch.arange(40) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    centres = torch.stack([columns, rows], -1).double()
    torch.testing.assert_close(pixels[..., :2] / pixels[..., 2:], centres, rtol=0, atol=1e-9)
    projected, depth = view.project(rays.at(distance))
    torch.testing.assert_close(projected, centres, rtol=0, atol=1e-9)
    torch.testing.assert_close(depth, view.depth(distance), rtol=0, atol=1e-12)
    assert torch.equal(rays.origins, view.center.expand(40, 64, 3))


def test_gradients_reach_intrinsics_and_extrinsics():
    def project(intrinsics: torch.Tensor, translation: torch.Tensor) -> tuple[torch.Tensor, ...]:
        # The motion is made from its translation and from its intrinsics, so that it stays rigid under gradcheck.
        matrix = torch.cat([motion(0.7)[:3, :3], translation[:, None]], dim=1)
        matrix = torch.cat([matrix, vector((0, 0, 0, 1))[None]])
        view = Camera(intrinsics, matrix, 2, 3)
        rays = view.rays()
        return rays.origins, rays.directions, view.depth(torch.ones(2, 3, dtype=torch.float64))

    intrinsics = INTRINSICS.clone().requires_grad_(True)
    translation = vector((0.1, -0.2, 2)).requires_grad_(True)
    assert torch.autograd.gradcheck(project, (intrinsics, translation))


def test_coarser_rays_run_through_the_middles_of_their_blocks_and_repeat_the_edge():
    x, y = torch.arange(5).double() + 0.5, torch.arange(8).double() + 0.5
    coarse = sheet(x[:4], y).coarser(4)
    assert coarse.image and coarse.directions.tolist() == [[[0, 0, 1]], [[0, 0, 1]]]
    assert coarse.origins[..., :2].tolist() == [[[2, 2]], [[2, 6]]]
    # 5 columns in blocks of 4: columns 0 to 3, then 4 by itself. 3 rows: 0.5, 1.5, 2.5 and 2.5 again, mean 1.75.
    assert sheet(x, y[:3]).coarser(4).origins[..., :2].tolist() == [[[2, 1.75], [4.5, 1.75]]]


@each("origin, direction, radius, entry, leave, meets", [
    ((0, 0, -2), (0, 0, 1), 1, 1, 3, True),
    ((0.6, 0, -2), (0, 0, 1), 1, 1.2, 2.8, True),  # half a chord is (1 - 0.36)^(1/2) = 0.8
    ((0.3, 0, -2), (0, 0, 1), 0.5, 1.6, 2.4, True), ((0, 0, 0), (0, 3, 4), 1, 0, 1, True),  # from the centre
    ((0, 0, -0.5), (0, 0, 1), 1, 0, 1.5, True),  # from inside
    ((0, 0, 0.5), (0, 0, 1), 1, 0, 0.5, True),  # from inside, the centre behind
    ((0, 0, 2), (0, 0, 1), 1, None, None, False),  # behind the camera
    ((2, 0, -3), (0, 0, 1), 1, 3, 3, False),  # passes by
    ((2, 0, 3), (0, 0, 1), 1, None, None, False),  # passed by, and behind
])  # fmt: skip
def test_spans_of_the_sphere_by_closed_form(origin, direction, radius, entry, leave, meets):
    first, last, intersects = sphere_span(Rays(vector(origin), normalize(vector(direction), dim=0)), radius)
    assert intersects.item() is meets and first >= 0
    assert entry is None or (first.item(), last.item()) == pytest.approx((entry, leave))


def test_the_least_distance_to_the_origin_agrees_with_samples():
    origins, directions = torch.randn(2, 200, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    rays = Rays(origins, normalize(directions, dim=-1))
    least = distance_to_origin(rays)
    assert torch.equal(sphere_span(rays, 0.7)[2], least < 0.7)
    sampled = rays.at_each(torch.linspace(0, 8, 2000, dtype=torch.float64)).norm(dim=-1).amin(1)
    assert (least <= sampled + 1e-12).all() and (least >= sampled - 4e-3).all()  # the spacing of the samples


def test_gradients_of_spans_and_distances_are_exact_and_finite():
    origins = torch.stack([vector((0.6, 0, -2)), vector((0.1, 0.2, -0.3)), vector((2, 0.5, -3))]).requires_grad_(True)
    directions = vector((0, 0, 1)).expand(3, 3).clone().requires_grad_(True)

    def spans(origins: torch.Tensor, directions: torch.Tensor) -> tuple[torch.Tensor, ...]:
        rays = Rays(origins, normalize(directions, dim=-1))
        return (*sphere_span(rays)[:2], distance_to_origin(rays))

    assert torch.autograd.gradcheck(spans, (origins, directions))
    # On a tangent and through the centre a root or a length has no derivative. The gradient must still be finite.
    edge = torch.stack([vector((1, 0, -2)), vector((0, 0, -2)), vector((0, 0, 0))]).requires_grad_(True)
    total = sum(output.sum() for output in spans(edge, directions))
    assert torch.autograd.grad(total, edge)[0].isfinite().all()


@each("twist, origin_in_camera", [
    ((0.1, 0, 0, 0, 0, 0), (0.1, 0, 2)),  # the world moves to the right of the camera
    ((0, 0, 0.5, 0, 0, 0), (0, 0, 2.5)),  # and away from it
    ((0, 0, 0, 0, torch.pi / 2, 0), (2, 0, 0)),  # a quarter turn about y, down: from ahead to the right
    ((0, 0, 0, torch.pi / 2, 0, 0), (0, -2, 0)),
    ((0, 0, 0, 0, 0, 1.0), (0, 0, 2)),  # a rotation about the line of sight
])  # fmt: skip
def test_a_twist_moves_the_world_in_the_cameras_axes(twist, origin_in_camera):
    motion = torch.eye(4, dtype=torch.float64)
    motion[2, 3] = 2.0  # the origin lies 2 ahead
    moved = Camera(torch.eye(3, dtype=torch.float64), motion, 4, 4).moved(torch.tensor(twist, dtype=torch.float64))
    torch.testing.assert_close(
        moved.world_to_camera[:3, 3], torch.tensor(origin_in_camera, dtype=torch.float64), rtol=0, atol=1e-12
    )


def test_a_resized_camera_has_the_same_view():
    plain = camera(motion(0.4, (0.1, -0.2, 2.5)))
    fine = plain.resized(3 * 40, 3 * 64)  # the middle of a block is its pixel
    torch.testing.assert_close(fine.rays().directions[1::3, 1::3], plain.rays().directions)
    torch.testing.assert_close(fine.center, plain.center)


def test_a_moved_object_is_seen_as_by_the_camera_that_stays():
    """`with_object_moved` projects a point to where the old camera projects the moved point, also off the axis."""
    twist = torch.tensor([0.1, -0.2, 0.05, 0.3, 0.2, -0.4], dtype=torch.float64)
    old = camera(motion(0.4, (0.1, 0.2, 3.0))).double()
    point = torch.tensor([0.3, -0.2, 0.4], dtype=torch.float64)
    moved = rigid(twist) @ torch.cat([point, torch.ones(1, dtype=torch.float64)])
    for projected, expected in zip(old.with_object_moved(twist).project(point), old.project(moved[:3]), strict=True):
        torch.testing.assert_close(projected, expected)


def test_a_list_of_rays_is_no_image():
    directions = vector((0, 0, 1)).expand(7, 3)
    with pytest.raises(ValueError, match="leave image out"):
        Rays(torch.zeros_like(directions), directions, image=True)


def test_a_camera_shows_what_lies_in_front_of_it_and_within_its_image():
    camera = Camera(torch.tensor([[10.0, 0, 8], [0, 10.0, 4], [0, 0, 1]]), torch.eye(4), 8, 16)
    corners = torch.tensor([[-0.79, -0.39, 1.0], [0.79, 0.39, 1.0]])
    beyond = torch.tensor([[-0.81, 0.0, 1.0], [0.81, 0.0, 1.0], [0.0, -0.41, 1.0], [0.0, 0.41, 1.0], [0.0, 0.0, -1.0]])
    assert camera.shows(corners).all() and camera.shows(2 * corners).all() and not camera.shows(beyond).any()
