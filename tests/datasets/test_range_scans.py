"""Range scans of a sphere: poses, depths in a camera, and incomplete folders."""

from dataclasses import replace
from math import pi
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from datasets.files.range_scans import RangeScans, smooth
from datasets.files.repair import repair
from datasets.mesh import Mesh
from datasets.scene import Split, make_scene, sample_surface
from datasets.views import ViewSampler
from renderers.checks import BadInput
from tests.looped import each
from tests.made_scans import RADIUS, TURNS, write_scans
from tests.runner.driving import SMALLEST, command, record_of

pytestmark = pytest.mark.usefixtures("few_samples")
VIEWS = ViewSampler(distance=2.5, field_of_view=50.0, azimuth=(0.0, 360.0), elevation=(15.0, 35.0), resolution=48)
EMPTY = b"ply\nformat ascii 1.0\nelement vertex 0\nproperty int x\nproperty int y\nproperty int z\nend_header\n"
PARALLEL_VIEWS = replace(VIEWS, distance=20.0, field_of_view=6.2)  # nearly parallel rays, like those of the scanner


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_scans(tmp_path_factory.mktemp("ball"))


def scans(folder: Path, truth: str | None = None) -> RangeScans:
    return RangeScans(str(folder), truth, radius=0.97)


@each("index, turn", [*enumerate(TURNS)])
def test_the_camera_has_the_direction_of_the_scanner(folder, index, turn):
    towards = scans(folder).towards_scanner(index)
    assert towards.numpy() == pytest.approx([np.sin(turn * pi / 180), 0.0, np.cos(turn * pi / 180)], abs=1e-6)
    scene = make_scene(scans(folder), VIEWS, split=Split.TEST, index=index)
    assert scene.view.camera.center.numpy() == pytest.approx(2.5 * towards.numpy(), abs=1e-5)


@each("index", range(len(TURNS)))
def test_depths_are_those_of_the_scanned_surface(folder, index):
    scene = make_scene(scans(folder), PARALLEL_VIEWS, split=Split.TEST, index=index)
    view, observed = scene.observed_view()
    exact, both = scene.observed_view(exact=True)
    assert torch.equal(observed, both) and not (observed & ~scene.view.mask).any()
    assert torch.equal(exact.depth, scene.view.depth) and torch.equal(view.mask, scene.view.mask)
    assert 0.9 * scene.view.mask.sum() < observed.sum() <= scene.view.mask.sum()
    assert torch.equal(view.depth > 0, scene.measured > 0)
    facing = -(scene.view.normals * view.camera.rays().directions).sum(dim=-1)
    off = (view.depth - exact.depth)[observed & (facing > 0.5)]
    assert float(off.abs().max()) < 2e-3  # the radius is 0.97; both surfaces are polyhedra
    assert float(off.mean()) == pytest.approx(0, abs=2e-4)


def test_noise_stays_in_the_depths_and_is_noted(tmp_path):
    scene = make_scene(scans(write_scans(tmp_path, noise=0.002)), PARALLEL_VIEWS, split=Split.TEST, index=0)
    _, both = scene.observed_view(exact=True)
    off = (scene.measured - scene.view.depth)[both].abs()
    deviation = 0.6745 * 0.002 * 0.97 / RADIUS  # half of a Gaussian is within 0.6745 standard deviations
    assert 0.4 < float(off.median()) / deviation < 1.3
    (note,) = scene.measured_depth_notes
    assert note.startswith(f"measured: {int(both.sum())} of the shape's {int(scene.view.mask.sum())} pixels")
    half, most = off.quantile(torch.tensor([0.5, 0.95])).tolist()
    assert f"within {half:.2g} scene units of the mesh, 95 % within {most:.2g};" in note and most > 2 * half
    outside_outline = int(((scene.measured > 0) & ~scene.view.mask).sum())
    assert note.endswith(f"{outside_outline} beside its outline are left out")


def test_points_across_a_gap_are_not_joined(folder):
    dataset = scans(folder)
    scan = dataset.scans[0]
    complete = scan.surface()
    points = trimesh.load(scan.file).vertices
    middle = points.mean(axis=0)
    kept = np.abs(points[:, 0] - middle[0]) > 0.04  # a strip of the sphere, 0.08 wide, is missing
    gap = replace(scan, file=scan.file.with_name("gap.txt").with_suffix(".ply"))
    trimesh.PointCloud(points[kept]).export(gap.file)
    torn = gap.surface()
    gap.file.unlink()
    edges = torn.vertices[torn.faces] - np.roll(torn.vertices[torn.faces], 1, axis=1)
    assert np.linalg.norm(edges, axis=2).max() < 0.04 and torn.area < complete.area - 0.8 * 0.08 * 2 * RADIUS


@pytest.mark.parametrize(("spoil", "message"), [
    (lambda f: (f / "ball.conf").unlink(), "must have one .conf file"),
    (lambda f: (f / "ball.conf").write_text("camera 0 0 0"), "names no scan: it needs lines 'bmesh FILE"),
    (lambda f: (f / "scan_90.ply").unlink(), "names 'scan_90.ply', which is not beside it"),
    (lambda f: (f / "ball_whole.ply").unlink(), "no mesh beside its scans"),
    (lambda f: (f / "ball.conf").write_text("bmesh scan_0.ply 0 0 0 0 0 0 0"), "line 1, must be 'bmesh FILE"),
])  # fmt: skip
def test_an_incomplete_folder_is_refused(tmp_path, spoil, message):
    spoil(write_scans(tmp_path))
    with pytest.raises(ValueError, match=message):
        scans(tmp_path)


def test_a_scan_that_is_cut_short_or_has_no_points_is_refused(tmp_path):
    scan = write_scans(tmp_path) / "scan_0.ply"
    cut = f"scan '{scan}' must be a whole .ply file, but it is truncated"
    for content, message in ((scan.read_bytes()[:9000], cut), (EMPTY, "has no points")):
        scan.write_bytes(content)
        with pytest.raises(ValueError, match=message):
            make_scene(scans(tmp_path), VIEWS, split=Split.TEST, index=0)


@each("number", [0.0, np.nan, np.inf, 1e10])
def test_points_that_are_no_measurements_are_left_out_and_noted(tmp_path_factory, number):
    """Organised clouds have them at pixels without a depth."""
    folder = write_scans(tmp_path_factory.mktemp("ball"))
    complete, points = scans(folder).scans[0].surface(), trimesh.load(folder / "scan_0.ply").vertices
    trimesh.PointCloud(np.insert(points, [50, 700, 700], number, axis=0)).export(folder / "scan_0.ply")
    assert np.array_equal(scans(folder).scans[0].surface().vertices, complete.vertices)
    assert "3 points of 'scan_0.ply' are no measurements" in scans(folder).mesh(Split.TEST, 0).repairs[-1]
    assert "measurements" not in str(scans(folder).mesh(Split.TEST, 1).repairs)


@each("spoil, message", [
    (lambda words: [*words[:5], *(str(-float(word)) for word in words[5:8]), words[8]], "negate qx, qy and qz"),
    (lambda words: [*words[:2], "0.8", *words[3:]], "moved by"),
])  # fmt: skip
def test_scans_that_do_not_lie_on_the_mesh_are_refused_with_the_cause(tmp_path_factory, spoil, message):
    folder = write_scans(tmp_path_factory.mktemp("ball"))
    *others, last = (folder / "ball.conf").read_text().splitlines()
    (folder / "ball.conf").write_text("\n".join([*others, " ".join(spoil(last.split()))]))
    with pytest.raises(BadInput, match=f"{message}.*dataset.unchecked=true"):
        scans(folder).mesh(Split.TEST, 2)
    assert "lies" in replace(scans(folder), unchecked=True).mesh(Split.TEST, 2).repairs[-1]


def test_the_ground_truth_may_be_set_and_is_noted(tmp_path):
    folder = write_scans(tmp_path)
    (folder / "ball_whole.ply").rename(folder / "small.ply")
    trimesh.creation.icosphere(subdivisions=6).export(folder / "larger.ply")
    assert scans(folder).reference.name == "larger.ply"
    assert scans(folder, "small.ply").mesh(Split.TEST, 0).repairs[0] == "the true shape is 'small.ply'"
    with pytest.raises(ValueError, match=r"dataset.truth=none.ply is not in"):
        scans(folder, "none.ply")


def test_an_index_beyond_the_scans_and_the_train_split_are_refused(folder):
    with pytest.raises(ValueError, match="index must be at most 2, the last scan"):
        scans(folder).mesh(Split.TEST, 3)
    with pytest.raises(ValueError, match="of which there is no prior: take task=completion field=auto"):
        scans(folder).mesh(Split.TRAIN, 0)


def test_a_run_uses_the_depths_of_its_setting(folder, tmp_path):
    arguments = ("dataset=scans", f"dataset.path={folder}", "index=1", "field=sphere", "view.resolution=16")
    task = ("task.points=dense", "task.depths=exact", "task.optimiser.iterations=4")
    record = record_of(command(*SMALLEST, *arguments, *task, f"results_dir={tmp_path}").out)
    assert record["scene"] == f"{folder.name} test 1"
    (note,) = [note for note in record["notes"] if note.startswith("measured: ")]
    assert record["evaluations"]["observed"] == int(note.split()[1])
    assert record["config"]["task"]["depths"] == "exact"


def handled(ball: trimesh.Trimesh, first: int, second: int) -> Mesh:
    """A sphere with two faces joined by a twisted tube, so that the surface has one side only."""
    start, end = ball.faces[first], ball.faces[second]
    sides = [(start[i], start[i - 2], end[i - 2], end[i]) for i in range(3)]
    tube = [corner for a, b, c, d in sides for corner in ([a, b, c], [a, c, d])]
    return Mesh(ball.vertices, np.concatenate([np.delete(ball.faces, [first, second], axis=0), tube]))


@pytest.mark.slow
def test_a_scan_with_a_one_sided_tube_keeps_its_surface():
    ball = trimesh.creation.icosphere(5)
    near = np.argsort(np.linalg.norm(ball.triangles_center - ball.triangles_center[0], axis=1))[31]
    tangled = handled(ball, 0, near)
    mesh = repair(Mesh(tangled.vertices, tangled.faces[:, ::-1]), smooth)
    assert mesh.watertight
    assert mesh.repairs[-1].startswith("replaced by its Poisson reconstruction, since its parts do not close")
    points = sample_surface(mesh, 2000, seed=0).points
    assert np.abs(np.linalg.norm(points, axis=1) - 1).max() < 0.01
    assert mesh.volume == pytest.approx(ball.volume, rel=1e-3)
