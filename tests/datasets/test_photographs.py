"""Textures and photographs of a sphere: a point has one colour in all views, and invalid settings are errors."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bench.tasks.multiview import sample
from datasets.photographs import MAX_ELEVATION_DEGREES, Photography, around
from datasets.scene import Truth
from datasets.textures import ONE_COLOUR, SKIMAGE_PHOTOGRAPHS, TEXTURES, make_texture
from tests.looped import each
from tests.tiny import camera_of, icosphere

PHOTOGRAPHY = Photography(
    views=8,
    places="circle",
    texture="noise",
    texture_size=0.5,
    shading="unlit",
    background="grey",
    noise=0.0,
    blur=0.0,
    exposure=0.0,
)
CAMERA = camera_of(32, angles=(0.0, 20.0))


@pytest.fixture(scope="module")
def ball() -> Truth:
    return Truth(icosphere(0.7))


@each("name", TEXTURES)
def test_colours_lie_between_0_and_1_and_depend_on_the_position(name):
    generator = np.random.default_rng(0)
    points = generator.uniform(-1, 1, (300, 3))
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    texture = make_texture(name, 0.5, seed=3)
    colours = texture(points, normals)
    assert colours.shape == (300, 3) and colours.min() >= 0 and colours.max() <= 1
    assert np.array_equal(colours, make_texture(name, 0.5, seed=3)(points, normals))
    other = make_texture(name, 0.5, seed=4)(points, normals)
    assert (np.abs(other - colours).mean() > 0.1) == (name in ("noise", "banded", "painted"))
    nearby = texture(points + 1e-5, normals)
    assert np.abs(nearby - colours).max() < 0.02  # no jump
    assert (colours.std(axis=0).max() > 0.05) == (name not in ONE_COLOUR)


def test_each_axis_has_a_separate_projection():
    texture = make_texture(SKIMAGE_PHOTOGRAPHS[0], 1.0, seed=0)
    along = np.array([[0.9, 0.2, 0.3], [0.1, 0.2, 0.3]])  # the two points differ only in x, the viewing direction
    colours = texture(along, np.array([[1.0, 0, 0], [1, 0, 0]]))
    assert colours[0] == pytest.approx(colours[1])
    assert np.abs(texture(along[:1], np.array([[0, 1.0, 0]])) - colours[0]).max() > 0.01


@each("count", [7, 40])
def test_cameras_all_around_look_at_the_origin_from_above_and_below(count):
    cameras = around(CAMERA, count)
    centres = torch.stack([camera.center for camera in cameras])
    torch.testing.assert_close(centres.norm(dim=-1), torch.full((count,), 2.5), rtol=1e-5, atol=0)
    for camera in cameras:
        pixels, depth = camera.project(torch.zeros(1, 3))
        assert pixels[0].tolist() == pytest.approx([16.0, 16.0], abs=1e-3) and depth.item() == pytest.approx(2.5)
        assert camera.project(torch.tensor([[0.0, 0.1, 0.0]]))[0][0, 1] < 16  # y is up
        assert torch.equal(camera.intrinsics, CAMERA.intrinsics) and (camera.height, camera.width) == (32, 32)
    heights = centres[:, 1] / 2.5
    highest = np.sin(np.radians(MAX_ELEVATION_DEGREES))
    assert heights.abs().max() <= highest and heights.sum().item() == pytest.approx(0.0, abs=1e-4)
    assert heights.max().item() == pytest.approx(highest * (1 - 1 / count), abs=1e-4)
    apart = torch.cdist(centres, centres) + 9 * torch.eye(count)
    assert apart.min() > 2.5 * 1.5 / count**0.5  # evenly spaced, no two close to each other
    sides = {(bool(x > 0), bool(z > 0)) for x, _, z in centres.tolist()}
    assert len(sides) == 4


def test_an_arc_has_the_first_camera_in_its_middle(ball):
    shots = replace(PHOTOGRAPHY, places="arc", views=5).take(ball, CAMERA, seed=0)
    centres = torch.stack([shot.camera.center for shot in shots])
    assert torch.allclose(centres[2], CAMERA.center) and torch.allclose(centres.norm(dim=1), CAMERA.center.norm())
    flat = torch.nn.functional.normalize(centres[:, [0, 2]], dim=1)
    angles = torch.rad2deg(torch.arccos((flat @ flat[2]).clamp(-1, 1)))
    assert angles.tolist() == pytest.approx([45, 22.5, 0, 22.5, 45], abs=0.1)
    assert (flat[0] @ flat[4]).item() == pytest.approx(0, abs=1e-5)


@each("texture", ["noise", "astronaut"])
def test_a_point_that_two_views_see_has_one_colour(ball, texture):
    size = 1.0 if texture == "noise" else 4.0
    first, second, *_ = replace(PHOTOGRAPHY, texture=texture, texture_size=size).take(ball, CAMERA, seed=0)
    points = first.camera.rays().at(first.depth / first.camera.depth(torch.ones(32, 32)))
    pixels, depth = second.camera.project(points)
    sampled_depth, _ = sample(second.depth[..., None], pixels)
    both = first.mask & ((sampled_depth[..., 0] - depth).abs() < 0.01)
    colours, _ = sample(second.colours, pixels)
    right = (colours - first.colours)[both].abs().mean()
    wrong = (second.colours - first.colours)[both].abs().mean()
    assert both.sum() > 100 and right < 0.4 * wrong


def test_the_background_is_grey_or_differs_from_view_to_view(ball):
    first, second, *_ = PHOTOGRAPHY.take(ball, CAMERA, seed=0)
    outside = ~(first.mask | second.mask)
    outside[1:-1, 1:-1] &= False  # the frame of the image, without pixels of the sphere
    assert (first.colours[outside] == 0.5).all()
    first, second, *_ = replace(PHOTOGRAPHY, background="noise").take(ball, CAMERA, seed=0)
    assert (first.colours - second.colours)[outside].abs().mean() > 0.1


def test_noise_blur_and_exposure_change_colours_by_their_amounts(ball):
    plain = PHOTOGRAPHY.take(ball, CAMERA, seed=0)
    noisy = replace(PHOTOGRAPHY, noise=0.03).take(ball, CAMERA, seed=0)
    background = ~plain[0].mask
    assert (noisy[0].colours - plain[0].colours)[background].std().item() == pytest.approx(0.03, rel=0.2)
    exposed = replace(PHOTOGRAPHY, exposure=0.2).take(ball, CAMERA, seed=0)
    ratios = [(a.colours[0, 0, 0] / b.colours[0, 0, 0]).log().item() for a, b in zip(exposed, plain, strict=True)]
    assert 0.05 < np.std(ratios) < 0.5
    soft = replace(PHOTOGRAPHY, blur=2.0).take(ball, CAMERA, seed=0)
    assert soft[0].colours.diff(dim=0).abs().mean() < 0.7 * plain[0].colours.diff(dim=0).abs().mean()


def test_lambertian_light_is_fixed(ball):
    lit = replace(PHOTOGRAPHY, texture="plain", shading="lambertian").take(ball, CAMERA, seed=0)
    bright = [photograph.colours[photograph.mask].mean().item() for photograph in lit]
    assert max(bright) > 1.2 * min(bright)  # some cameras see the dark side of the sphere
    inner = [photograph.colours[12:20, 12:20] for photograph in lit]  # no outline pixels, which mix with the background
    assert min(patch.min() for patch in inner) > 0.38 * max(
        patch.max() for patch in inner
    )  # the dark side is not black


def test_a_surface_of_one_colour_is_refused(ball):
    with pytest.raises(ValueError, match=r"has nothing to compare: set shading=lambertian"):
        replace(PHOTOGRAPHY, texture="plain")
    with pytest.raises(ValueError, match=r"one colour in all images: choose another texture"):
        replace(PHOTOGRAPHY, texture_size=1e9).take(ball, CAMERA, seed=0)


def test_a_camera_that_sees_nothing_is_refused(ball):
    away = replace(CAMERA, world_to_camera=torch.diag(torch.tensor([-1.0, 1, -1, 1])) @ CAMERA.world_to_camera)
    with pytest.raises(ValueError, match="camera 0 sees nothing of the shape"):
        PHOTOGRAPHY.take(ball, away, seed=0)
