"""The evaluation of a reconstruction, for a coloured sphere and for errors of known size."""

from dataclasses import replace
from math import inf, log10

import numpy as np
import pytest
import torch

from bench.config import load
from bench.evaluate.colours import render_image
from bench.evaluate.state import State, empty_view
from bench.records.record import RunStatus
from bench.tasks.reconstruction.judge import COLOURED_DEFINITIONS, OWN_PREFIX, image_scores, judge, surface_scores
from bench.tasks.reconstruction.subject import Subject
from bench.tasks.reconstruction.symptoms import (
    ROUGHNESS,
    WEIGHT,
    early_weight,
    floater_scores,
    roughness,
    roughness_scores,
)
from datasets.mesh import Mesh
from datasets.photographs import around
from datasets.scene import Surface, Truth, View, sample_surface, see
from datasets.shot import Shot
from renderers.boundary import render_checked
from renderers.camera import sphere_span
from renderers.field import Meter
from tests.tasks.reconstruction.test_losses import Ball, ball, cast, shot_of
from tests.tiny import ball_prior, camera_of, icosphere, run_of

CENTRE = (0.1, -0.05, 0.15)
MASK_IOU = ("mask_iou", "mask_iou_least")
OF_HITS = set(COLOURED_DEFINITIONS) - set(WEIGHT)  # the metrics of a renderer that sees hits alone


def painted(*, red: float = 0.0, radius: float = 0.6) -> Ball:
    """A sphere whose colours change with the position, with red larger by `red`."""
    paint = torch.zeros(3, 10)
    paint[0, 9], paint[1, 1], paint[2, 0] = torch.tensor(0.5 + red).logit(), 2.0, 2.0
    return cast(ball(radius, CENTRE, paint), torch.float32)


@pytest.fixture(scope="module")
def subject() -> Subject:
    """Photographs of a sphere from all around."""
    shots = [shot_of(painted(), camera, str(number)) for number, camera in enumerate(around(camera_of(24), 8))]
    return Subject(tuple(shots[1:7]), (shots[0], shots[7]), icosphere(0.6, CENTRE), "a sphere")


@pytest.fixture
def inputs(tmp_path):
    inputs = run_of(tmp_path, load("renderer", "idr", steps=300), ball_prior(), camera_of(24)).inputs
    return replace(inputs, evaluation=replace(inputs.evaluation, grid=48, points=2000))


def test_the_truth_scores_high(subject, inputs):
    evaluation = judge(State(painted(), inputs), subject)
    assert evaluation.failure is None and set(evaluation.metrics) == OF_HITS
    metrics = evaluation.metrics
    assert metrics["own_psnr"] > 60 and metrics["own_ssim"] > 0.9999 and metrics["own_mask_iou"] == 1.0
    assert metrics["psnr"] > 25 and metrics["ssim"] > 0.95 and metrics["mask_iou_least"] > 0.94
    assert metrics["mask_iou_least"] <= metrics["mask_iou"] <= 1.0
    assert metrics["chamfer_l1"] < 0.03 and metrics["seen_chamfer_l1"] < 0.03
    assert metrics["normal_consistency"] > 0.99 and metrics["fscore"] > 0.4
    assert evaluation.mesh is not None and evaluation.mesh.colours is not None
    with torch.no_grad():
        metered = Meter(painted())
        rays = [shot.camera.rays() for shot in subject.held_out]
        hits = sum(int(inputs.renderer.render(metered, each_view).hit.sum()) for each_view in rays)
    assert metrics["own_evaluations"] == metered.counts.value / (2 * 24**2) > 2 * hits / (2 * 24**2)


def test_vertices_have_the_fields_colours_seen_from_straight_above(subject, inputs):
    shape = cast(ball(0.6, CENTRE), torch.float32)  # its colours change with the direction
    mesh = judge(State(shape, inputs), subject).mesh
    assert mesh is not None and mesh.colours is not None
    points = torch.from_numpy(mesh.vertices).float()
    normals = torch.nn.functional.normalize(points - shape.centre, dim=-1)
    expected = shape.colours(points, normals, -normals).numpy()
    np.testing.assert_allclose(mesh.colours, expected, atol=1e-4)


def test_a_wrong_colour_has_the_psnr_of_its_size(subject, inputs):
    metrics = judge(State(painted(red=0.2), inputs), subject).metrics
    shares = [shot.mask.float().mean().item() for shot in subject.held_out]
    assert metrics["own_psnr"] == pytest.approx(-10 * log10(0.2**2 / 3), abs=0.01)  # one of three channels is wrong
    expected = np.mean([-10 * log10(0.2**2 * share / 3) for share in shares])
    assert metrics["own_psnr_image"] == pytest.approx(expected, abs=0.01)
    assert metrics["own_ssim"] < 0.999 and metrics["own_mask_iou"] == 1.0


def test_the_seen_part_is_judged_alone(subject, inputs):
    """Photographs from one side do not show a dent on the other side."""
    side = tuple(shot_of(painted(), camera_of(24, angles=(across, 0.0))) for across in (-30.0, 0.0, 30.0))
    vertices = subject.truth.vertices.copy()
    vertices[vertices[:, 2] < CENTRE[2], 2] -= 0.2
    metrics = surface_scores(replace(subject.truth, vertices=vertices), replace(subject, input_shots=side), inputs)
    assert metrics["seen_chamfer_l1"] < 0.75 * metrics["chamfer_l1"]


def test_no_surface_is_empty_and_scores_worst(subject, inputs):
    evaluation = judge(State(painted(radius=-0.5), inputs), subject)
    assert evaluation.mesh is None and evaluation.failure is not None and evaluation.failure[0] is RunStatus.EMPTY
    metrics = evaluation.metrics
    assert set(metrics) == OF_HITS and all(metrics[name] == inf for name in ROUGHNESS)
    assert metrics["chamfer_l1"] == metrics["seen_chamfer_l1"] == inf and metrics["fscore"] == 0.0
    assert [metrics[prefix + name] for prefix in ("", OWN_PREFIX) for name in MASK_IOU] == [0.0] * 4
    assert 0 < metrics["psnr"] < 15 and metrics["psnr"] == pytest.approx(metrics["own_psnr"])


def test_images_are_compared_black_outside_of_their_masks():
    mask = torch.zeros(2, 4, dtype=torch.bool)
    mask[:, :2] = True
    covered = mask.roll(1, 1)  # half of the mask
    image = 0.6 * covered[..., None].float().expand(-1, -1, 3)
    larger = [array.repeat_interleave(4, 0).repeat_interleave(4, 1) for array in (mask, covered, image)]
    camera = camera_of(16).resized(8, 16)
    shot = Shot("0", camera, torch.full((8, 16, 3), 0.8), larger[0])
    view = View(camera, torch.zeros(8, 16), torch.zeros(8, 16, 3), larger[1])
    missed, both, spurious = 0.8**2, 0.2**2, 0.6**2  # a quarter of the pixels each
    scores = image_scores([view], [larger[2]], [shot])
    assert scores["psnr"] == pytest.approx(-10 * log10((missed + both) / 2), abs=1e-4)
    assert scores["psnr_image"] == pytest.approx(-10 * log10((missed + both + spurious) / 4), abs=1e-4)
    assert scores["mask_iou"] == pytest.approx(1 / 3)
    blind = image_scores([view], [larger[2]], [replace(shot, mask=None)])
    assert set(blind) == {"psnr", "ssim"}
    meets = sphere_span(camera.rays())[2]
    wrong = ((larger[2] - 0.8) ** 2)[meets].mean().item()  # pixels without the shape are black, and wrong too
    assert meets.any() and not meets.all() and blind["psnr"] == pytest.approx(-10 * log10(wrong), abs=1e-4)


def _view(shot) -> View:
    return View(shot.camera, shot.depth, shot.normals, shot.mask)


def test_means_and_the_least_are_over_photographs_of_any_size():
    shots = [shot_of(painted(), camera) for camera in (camera_of(16), camera_of(24).resized(12, 24))]
    views = [_view(shots[0]), replace(_view(shots[1]), mask=torch.zeros(12, 24, dtype=torch.bool))]
    images = [shots[0].colours * shots[0].mask[..., None], torch.zeros(12, 24, 3)]
    images[0] = images[0] + 0.1
    for _ in range(5):  # type checks sample the elements
        scores = image_scores(views, images, shots)
    lost = (shots[1].colours[shots[1].mask] ** 2).mean().item()
    assert scores["psnr"] == pytest.approx((20.0 - 10 * log10(lost)) / 2, abs=1e-4)
    assert (scores["mask_iou"], scores["mask_iou_least"]) == (0.5, 0.0)


def test_a_volume_is_judged_by_the_weighted_sum_that_it_shows(inputs):
    """For one colour the sum is the colour times the opacity. At the mean depth it would be the colour itself."""
    plain = cast(ball(0.6, CENTRE, torch.zeros(3, 10)), torch.float32)  # grey, 1/2
    volume = replace(inputs, renderer=load("renderer", "neus", sharpness=10.0))
    view, image = render_image(plain, camera_of(24), volume)
    with torch.no_grad():
        rendering = render_checked(volume.renderer, plain, camera_of(24).rays())
    assert rendering.volume is not None
    opacity = rendering.volume.weighted_sum(torch.ones_like(rendering.volume.weight), 24 * 24).view(24, 24)
    assert bool((view.mask & (opacity < 0.9)).any())
    torch.testing.assert_close(image, (opacity / 2)[..., None].expand(-1, -1, 3))


def plane(tilt: float, *, count: int = 2000, side: float = 1.0) -> Surface:
    """Points of a plane whose normals lean by `tilt` degrees to alternating sides."""
    points = np.random.default_rng(0).uniform(0, side, (count, 3)) * (1, 1, 0)
    lean = np.radians(tilt) * np.where(np.arange(count) % 2, 1, -1)
    return Surface(points, np.stack([np.sin(lean), 0 * lean, np.cos(lean)], axis=1))


def test_roughness_is_the_mean_angle_of_neighbours():
    assert roughness(plane(0)) == 0
    assert roughness(plane(5)) == pytest.approx(5, rel=0.05)  # half of the pairs are 10 degrees apart
    flipped = replace(plane(0), normals=plane(0).normals * np.where(np.arange(2000) % 3, 1, -1)[:, None])
    assert roughness(flipped) == 0
    assert roughness(plane(5, count=20, side=100.0)) is None  # no neighbours
    assert roughness(plane(5, count=1)) is None


def test_roughness_is_over_the_seen_and_the_unseen_part_and_less_that_of_the_truth():
    bumpy, smooth = plane(8), plane(2)
    visible = bumpy.points[:, 0] < 0.5
    normals = np.where(visible[:, None], smooth.normals, bumpy.normals)
    scores = roughness_scores((replace(bumpy, normals=normals), visible), (smooth, visible))
    assert scores["seen_roughness"] == pytest.approx(0, abs=1e-9)
    assert scores["unseen_roughness"] == pytest.approx(6, rel=0.05)
    all_seen = np.ones_like(visible)  # without an unseen side
    assert roughness_scores((smooth, all_seen), (smooth, visible))["unseen_roughness"] == np.inf
    assert roughness_scores((smooth, all_seen), (smooth, all_seen))["unseen_roughness"] == 0
    assert roughness_scores(None, (smooth, visible)) == {"seen_roughness": np.inf, "unseen_roughness": np.inf}


@pytest.mark.parametrize(("sharpness", "least", "most"), [(400.0, 0.0, 0.01), (20.0, 0.2, 0.6)])
def test_a_wide_blur_has_weight_before_the_surface(subject: Subject, inputs, sharpness, least, most):
    views = [see(Truth(subject.truth), subject.held_out[0].camera)]
    neus = load("renderer", "neus", sharpness=sharpness, sharpening=0)
    scores = early_weight(painted(), views, replace(inputs, renderer=neus))
    assert least <= scores["own_early_weight"] < most


def test_a_renderer_of_hits_has_no_weight_before_the_surface(subject: Subject, inputs):
    assert early_weight(painted(), [see(Truth(subject.truth), subject.held_out[0].camera)], inputs) == {}
    assert early_weight(painted(), [empty_view(shot.camera) for shot in subject.held_out], inputs) == {}


def test_floaters_are_the_area_of_parts_away_from_the_true_surface():
    ball = icosphere(0.5)
    truth = sample_surface(ball, 5000, 0)

    def beside(radius: float, x: float) -> Mesh:
        """The ball, with another of a radius at x."""
        other = icosphere(radius).moved(np.array([[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
        vertices = np.concatenate([ball.vertices, other.vertices])
        return Mesh(vertices, np.concatenate([ball.faces, other.faces + len(ball.vertices)]))

    assert floater_scores(ball, truth) == {"floaters": 0.0}
    assert floater_scores(beside(0.1, 0.8), truth)["floaters"] == pytest.approx(0.04 / 1.04, rel=1e-6)
    assert floater_scores(beside(0.1, 0.64), truth)["floaters"] == 0  # it comes within 0.04 of the surface
    assert floater_scores(beside(0.1, 0.0), truth)["floaters"] == pytest.approx(0.04 / 1.04, rel=1e-6)  # a part within
    assert floater_scores(None, truth)["floaters"] == np.inf
