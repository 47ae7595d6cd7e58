"""Wrong cameras: rays of a moved camera are those of its motion, and learnt motions undo a disturbance."""

from types import SimpleNamespace

import pytest
import torch
from scipy.linalg import logm

from bench.config import load
from bench.tasks.pose import pose_error
from bench.tasks.reconstruction.cameras import MOTION_PER_PARAMETER, CameraMotions, disturbed, moved
from datasets.photographs import circle
from renderers.camera import Rays
from renderers.fields.analytic import box
from tests.tiny import CPU, camera_of

CAMERAS = circle(camera_of(8), 5)
SHOTS = [SimpleNamespace(camera=camera) for camera in CAMERAS]


def test_moved_rays_are_those_of_the_moved_camera():
    twists = torch.randn(5, 6, generator=torch.Generator().manual_seed(1)) / 5
    photograph = torch.tensor([0, 3])
    for index in photograph.tolist():
        rays = CAMERAS[index].rays().flat()
        result = moved(rays, twists, torch.full((64,), index))
        expected = CAMERAS[index].with_object_moved(twists[index]).rays().flat()
        assert torch.allclose(result.origins, expected.origins, atol=1e-5)
        assert torch.allclose(result.directions, expected.directions, atol=1e-5)
        several = Rays(rays.origins.view(16, 4, 3), rays.directions.view(16, 4, 3))
        assert torch.equal(moved(several, twists, torch.full((16,), index)).directions.view(64, 3), result.directions)


def test_a_disturbance_turns_all_cameras_but_the_first_by_its_angle(monkeypatch):
    monkeypatch.setattr(
        "bench.tasks.reconstruction.cameras.replace", lambda shot, camera: SimpleNamespace(camera=camera)
    )
    wrong = disturbed(SHOTS, 4.0, 0)
    errors = [pose_error(a.camera, b) for a, b in zip(wrong, CAMERAS, strict=True)]
    assert errors[0] == pytest.approx((0, 0), abs=1e-4)
    assert [angle for angle, _ in errors[1:]] == pytest.approx([4.0] * 4, rel=1e-3)
    motions = CameraMotions(wrong, CAMERAS, True, CPU)
    assert motions.errors()["camera_error_deg"] == pytest.approx(4.0, rel=1e-3)
    assert torch.equal(motions.twists[0], torch.zeros(6))


def test_learnt_motions_undo_a_disturbance():
    wrong = [
        SimpleNamespace(camera=CAMERAS[0]),
        *(SimpleNamespace(camera=c.moved(torch.tensor([0.05, 0, 0, 0.03, 0.02, 0]))) for c in CAMERAS[1:]),
    ]
    motions = CameraMotions(wrong, CAMERAS, True, CPU)
    for index in range(4):
        back = torch.linalg.inv(wrong[index + 1].camera.world_to_camera) @ CAMERAS[index + 1].world_to_camera
        logarithm = torch.from_numpy(logm(back.double().numpy()).real)
        twist = torch.cat([logarithm[:3, 3], torch.stack([logarithm[2, 1], logarithm[0, 2], logarithm[1, 0]])])
        with torch.no_grad():
            motions.numbers[index] = twist / MOTION_PER_PARAMETER
    assert motions.errors()["camera_error_deg"] == pytest.approx(0, abs=1e-2)


def test_the_gradient_of_distances_brings_cameras_back():
    shape, renderer = box(torch.tensor([0.5, 0.3, 0.4])), load("renderer", "idr")
    rays = [camera.rays().flat() for camera in CAMERAS]
    photograph = torch.arange(len(CAMERAS)).repeat_interleave(len(rays[0].origins))
    true = torch.cat([renderer.render(shape, each).distance for each in rays])
    hit = torch.cat([renderer.render(shape, each).hit for each in rays])
    wrong = [SimpleNamespace(camera=c.with_object_moved(torch.tensor([0, 0, 0, 0, 0.06, 0.03]))) for c in CAMERAS]
    wrong[0] = SHOTS[0]
    motions = CameraMotions(wrong, CAMERAS, True, CPU)
    flat = [shot.camera.rays().flat() for shot in wrong]
    start = Rays(torch.cat([r.origins for r in flat]), torch.cat([r.directions for r in flat]))
    optimiser = torch.optim.Adam([motions.numbers], lr=0.05)
    before = motions.errors()["camera_error_deg"]
    for _ in range(40):
        optimiser.zero_grad()
        rendering = renderer.render(shape, moved(start, motions.twists, photograph))
        compared = rendering.hit & hit
        (rendering.distance - true)[compared].abs().mean().backward()
        optimiser.step()
    assert motions.errors()["camera_error_deg"] < before / 3
