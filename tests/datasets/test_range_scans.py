"""Range scans of a made sphere: their poses, their depths in a camera, and folders that lack something."""

from math import pi
from pathlib import Path

import numpy as np
import pytest
import torch

from datasets.dataset import Split
from datasets.local import LocalMeshes
from datasets.range_scans import HIDDEN, RangeScans, nearest_to_pixels
from datasets.scene import make_scene
from datasets.views import ViewSampler
from tests.made_scans import RADIUS, TURNS, write_scans
from tests.run.driving import command, record_of

VIEWS = ViewSampler(distance=2.5, field_of_view=50.0, azimuth=(0.0, 360.0), elevation=(15.0, 35.0), resolution=48)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_scans(tmp_path_factory.mktemp("ball"))


def scans(folder: Path) -> RangeScans:
    return RangeScans(str(folder), radius=0.97)


@pytest.mark.parametrize(("index", "turn"), list(enumerate(TURNS)))
def test_the_camera_stands_where_the_scanner_did(folder, index, turn):
    towards = scans(folder).towards_scanner(index)
    assert towards.numpy() == pytest.approx([np.sin(turn * pi / 180), 0.0, np.cos(turn * pi / 180)], abs=1e-6)
    scene = make_scene(scans(folder), VIEWS, split=Split.TEST, index=index)
    assert scene.view.camera.center.numpy() == pytest.approx(2.5 * towards.numpy(), abs=1e-5)


@pytest.mark.parametrize("index", range(len(TURNS)))
def test_depths_are_those_of_the_surface_to_a_quarter_of_a_pixel(folder, index):
    scene = make_scene(scans(folder), VIEWS, split=Split.TEST, index=index)
    view, known = scene.given()
    exact, both = scene.given(exact=True)
    assert both.sum() > 0.6 * scene.view.mask.sum()
    assert not (both & ~scene.view.mask).any()
    assert torch.equal(exact.depth, scene.view.depth)
    facing = -(scene.view.normals * view.camera.rays().directions).sum(dim=-1)
    steep = both & (facing > 0.5)  # there a pixel's width changes depth by less than twice its size
    pixel = 2.5 / VIEWS.focal_length
    assert float((view.depth - exact.depth)[steep].abs().max()) < 2 * 0.25 * 2**0.5 * pixel
    assert float((view.depth - exact.depth)[steep].mean()) == pytest.approx(0, abs=0.02 * pixel)
    assert bool(view.mask[known].all())
    assert not view.depth[~known].any()


def test_noise_stays_in_the_depths_and_is_told(tmp_path):
    scene = make_scene(scans(write_scans(tmp_path, noise=0.004)), VIEWS, split=Split.TEST, index=0)
    _, both = scene.given(exact=True)
    off = (scene.measured - scene.view.depth)[both].abs().median()
    assert 0.5 < float(off) / (0.6745 * 0.004 * 0.97 / RADIUS) < 1.5  # half of a Gaussian lies within .6745 deviations
    (note,) = scene.notes
    assert note.startswith(f"measured: {int(both.sum())} of the shape's {int(scene.view.mask.sum())} pixels")
    assert f"within {float(off):.2g} scene units" in note


def test_a_point_of_a_hidden_surface_is_no_depth():
    camera = VIEWS.camera(0.0, 0.0)
    ray = camera.rays()
    at = ray.origins[20, 20] + torch.tensor([[2.0], [2.0 + 2 * HIDDEN]]) * ray.directions[20, 20]
    beside = at[:1] + torch.tensor([[0.2 * 2.0 / VIEWS.focal_length, 0.0, 0.0]])  # in front, farther from the centre
    image = nearest_to_pixels(torch.cat([at[1:], beside]), camera)
    assert image.count_nonzero() == 1
    assert float(image[20, 20]) == pytest.approx(float(camera.project(beside)[1]), abs=1e-6)
    assert nearest_to_pixels(at[1:], camera)[20, 20] > image[20, 20]


def test_a_point_far_from_every_pixel_centre_is_no_depth():
    camera = VIEWS.camera(0.0, 0.0)
    rays = camera.rays()
    corner = torch.nn.functional.normalize(rays.directions[20, 20] + rays.directions[21, 21], dim=0)
    assert not nearest_to_pixels((rays.origins[0, 0] + 2 * corner)[None], camera).any()
    assert not nearest_to_pixels(torch.zeros(0, 3), camera).any()


def test_other_datasets_give_their_exact_depths(folder):
    dataset = LocalMeshes(str(folder / "ball_whole.ply"), radius=0.97, strength=0.0)
    scene = make_scene(dataset, VIEWS, split=Split.TEST, index=0)
    for exact in (False, True):
        view, known = scene.given(exact=exact)
        assert view is scene.view
        assert torch.equal(known, scene.view.mask)
    assert scene.notes == scene.mesh.repairs


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda f: (f / "ball.conf").unlink(), "must have one .conf file"),
        (lambda f: (f / "other.conf").write_text(""), "must have one .conf file"),
        (lambda f: (f / "ball.conf").write_text("camera 0 0 0"), "names no scan: it needs lines 'bmesh FILE"),
        (lambda f: (f / "scan_90.ply").unlink(), "names 'scan_90.ply', which is not beside it"),
        (lambda f: (f / "ball_whole.ply").unlink(), "no mesh beside its scans"),
        (lambda f: (f / "ball.conf").write_text("bmesh scan_0.ply 0 0 0 0 0 0"), "line 1, must be 'bmesh FILE"),
        (lambda f: (f / "ball.conf").write_text("bmesh scan_0.ply 0 0 x 0 0 0 1"), "line 1, must be 'bmesh FILE"),
        (lambda f: (f / "ball.conf").write_text("bmesh scan_0.ply 0 0 0 0 0 0 0"), "line 1, must be 'bmesh FILE"),
    ],
)
def test_a_folder_that_lacks_something_is_refused(tmp_path, spoil, says):
    spoil(write_scans(tmp_path))
    with pytest.raises(ValueError, match=says):
        scans(tmp_path)


def test_a_scan_without_points_is_refused(tmp_path):
    (write_scans(tmp_path) / "scan_0.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nend_header\n")
    with pytest.raises(ValueError, match="has no points"):
        make_scene(scans(tmp_path), VIEWS, split=Split.TEST, index=0)


def test_it_has_as_many_numbers_as_scans_and_no_prior(folder):
    with pytest.raises(ValueError, match="index must be at most 2, the last scan"):
        scans(folder).mesh(Split.TEST, 3)
    with pytest.raises(ValueError, match="no prior can be trained: set field=auto"):
        scans(folder).mesh(Split.TRAIN, 0)


def test_no_folder_is_refused(tmp_path):
    with pytest.raises(ValueError, match="is no folder"):
        scans(tmp_path / "none")


@pytest.mark.parametrize("depths", ["measured", "exact"])
def test_a_run_takes_the_depths_that_it_is_told(folder, tmp_path, depths):
    arguments = ("dataset=scans", f"dataset.path={folder}", "index=1", "field=sphere", "scale=smoke", "threads=1")
    small = ("view.resolution=16", "evaluation.grid=16", "evaluation.points=100", "evaluation.every=null")
    given = ("task.points=dense", f"task.depths={depths}", "task.optimiser.iterations=4", "evaluation.picture=null")
    done = command(*arguments, *small, *given, "isolation=off", f"results_dir={tmp_path}")
    record = record_of(done.out)
    assert record["scene"] == f"{folder.name} test 1"
    (note,) = [note for note in record["notes"] if note.startswith("measured: ")]
    shown, beside = int(note.split()[1]), int(note.split(" pixels, ")[1].split()[0])
    assert record["evaluations"]["observed"] == shown + (beside if depths == "measured" else 0)
