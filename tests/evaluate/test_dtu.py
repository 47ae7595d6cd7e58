"""DTU's protocol: closed forms, an independent brute force, culling by masks, and what is said of missing files."""

import math

import numpy as np
import pytest
import torch
from scipy.io import loadmat, savemat
from scipy.spatial.distance import cdist

from bench.tasks.reconstruction.dtu import (
    MASK_DILATION_FRACTION,
    METRIC_NAMES,
    WORST,
    DtuScan,
    culled,
    dtu_metrics,
    published_results,
    read_scan,
)
from datasets.mesh import Mesh
from datasets.shot import Shot
from renderers.camera import Camera
from renderers.checks import BadInput
from tests.made_dtu import CENTRE, NUMBER, ball, on_ball, write_dtu
from tests.tiny import camera_of


@pytest.fixture
def folder(tmp_path):
    write_dtu(tmp_path, on_ball(40_000))
    return tmp_path


def brute_force(mesh: Mesh, folder, seed: int) -> list[float]:
    """The protocol once more, face by face and point by point, from its description."""
    points = [*mesh.vertices]
    for a, b, c in mesh.vertices[mesh.faces]:
        u, v = b - a, c - a
        sine = np.linalg.norm(np.cross(u, v)) / np.linalg.norm(u) / np.linalg.norm(v)
        n, m = (int(np.linalg.norm(side) * math.sqrt(sine) / 0.2) for side in (u, v))
        places = [((i + 0.5) / n, (j + 0.5) / m) for i in range(n) for j in range(m)]
        points += [a + s * u + t * v for s, t in places if s + t < 1]
    grid, plane = (loadmat(folder / "ObsMask" / name) for name in (f"ObsMask{NUMBER}_10.mat", f"Plane{NUMBER}.mat"))
    low, high = grid["BB"]
    points = np.array([p for p in points if (p >= low - 60.2).all() and (p <= high + 120.2).all()])  # order, not result
    np.random.default_rng(seed).shuffle(points, axis=0)
    left, kept = points, []
    while len(left):
        kept.append(left[0])
        left = left[np.linalg.norm(left - left[0], axis=1) > 0.2]
    near = np.array([p for p in kept if (p >= low - 60).all() and (p < high + 120).all()])
    judged = []
    for point in near:
        cell = np.rint((point - low) / grid["Res"].item()).astype(int)
        if (cell >= 0).all() and (cell < grid["ObsMask"].shape).all() and grid["ObsMask"][tuple(cell)]:
            judged.append(point)
    stored = read_scan(folder, NUMBER).points
    above = [p for p in stored if (plane["P"][:3, 0] @ p) + plane["P"][3, 0] > 0]
    results = [cdist(np.array(first), second).min(axis=1) for first, second in ((judged, stored), (above, near))]
    means = [distances[distances < 20].mean() for distances in results]
    return [*means, sum(means) / 2]


def test_a_scan_with_all_of_it_equals_a_brute_force(tmp_path):
    # A plate through the scan: parts beyond what was observed, beyond the box, and farther than 20 mm from all points;
    # a point of the scan below the plane, and one that is far from the mesh.
    plate = (
        np.array([[-8.0, -3, 0], [6, -4, 1], [5, 5, -1], [-7, 4, 0], [30, 30, 4], [30, 31, 4], [31, 30, 4]]) + CENTRE
    )
    far = np.array([[-91.0, 0, 0], [-92, 1, 0], [-90.5, 0, 1]]) + CENTRE
    mesh = Mesh(np.concatenate([plate, far]), np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [7, 8, 9]]))
    cloud = np.concatenate([on_ball(400, 9.0), np.array([[0.0, 0, -15], [0, 0, 60]]) + CENTRE])
    write_dtu(tmp_path, cloud, reach=7.0, plane=(0.0, 0.1, 1.0, -590.0))
    results = dtu_metrics(mesh, read_scan(tmp_path, NUMBER), seed=3)
    assert tuple(results) == METRIC_NAMES
    assert [*results.values()] == pytest.approx(brute_force(mesh, tmp_path, 3), abs=1e-9)


def test_the_box_reaches_60_mm_before_the_grid_and_120_mm_beyond_it():
    grid = np.array([[0.0, 0, 0], [10, 10, 10]])
    for axis in range(3):
        for height, counts in ((-61.0, False), (-59.0, True), (129.0, True), (131.0, False)):
            position = np.full(3, 5.0)
            position[axis] = height
            scan = DtuScan(position[None], np.array([0.0, 0, 0, 1]), np.ones((6, 6, 6), dtype=bool), grid, 2.0)
            speck = Mesh(position + 0.01 * np.eye(3), np.array([[0, 1, 2]]))
            completeness = dtu_metrics(speck, scan, seed=0)["dtu_completeness"]
            assert completeness == (pytest.approx(0.01) if counts else math.inf)


def test_without_a_mesh_or_far_from_the_scan_it_is_infinitely_wrong(folder):
    scan = read_scan(folder, NUMBER)
    assert dtu_metrics(None, scan, seed=0) == WORST == dtu_metrics(ball(centre=-CENTRE), scan, seed=0)
    with pytest.raises(BadInput, match=r"too much for points 0\.2 apart: is it in the scan's"):
        dtu_metrics(ball(2e4, np.array([0, 0, 2e4]) + CENTRE, subdivisions=1), scan, seed=0)


def test_culling_takes_the_faces_that_a_mask_excludes_but_for_its_dilation():
    """A row of triangles to the right of a camera's axis, whose mask is the left half of an image of 40 x 64 pixels."""
    square = camera_of(64, angles=(0.0, 0.0))
    pinhole = square.intrinsics - torch.tensor([[0, 0, 0], [0, 0, 12], [0, 0, 0]])
    camera = Camera(pinhole, square.world_to_camera, 40, 64)
    right = camera.camera_to_world[:3, 0].double().numpy()
    up = camera.camera_to_world[:3, 1].double().numpy()
    steps = np.linspace(-1.2, 1.2, 97)
    corners = steps[:, None, None] * right + 0.01 * np.stack([0 * up, up, right])
    mesh = Mesh(corners.reshape(-1, 3), np.arange(len(steps) * 3).reshape(-1, 3))
    half = torch.arange(64).expand(40, 64) < 32
    colours = torch.zeros(40, 64, 3)
    kept = culled(mesh, [Shot("half", camera, colours, half), Shot("all", camera, colours, torch.ones_like(half))])
    assert kept is not None
    pixels = camera.project(torch.from_numpy(kept.vertices).float())[0][:, 0].numpy()
    assert pixels[pixels <= 64].max() == pytest.approx(32 + 64 * MASK_DILATION_FRACTION, abs=1) and pixels.min() < 1
    shown = camera.shows(torch.from_numpy(mesh.vertices).float()).numpy().reshape(-1, 3)
    assert not shown[-1].any() and (kept.vertices @ right).max() == pytest.approx(1.21)  # beyond the image: kept
    assert culled(mesh, [Shot("none", camera, colours, torch.zeros_like(half))]) is not None
    across = Mesh(np.stack([-0.5 * right, 0.5 * right, 0.1 * up - 0.5 * right]), np.array([[0, 1, 2]]))
    assert culled(across, [Shot("half", camera, colours, half)]) is None  # one corner is outside
    seen = Mesh(mesh.vertices, mesh.faces[shown.all(axis=1)])
    assert culled(seen, [Shot("none", camera, colours, torch.zeros_like(half))]) is None
    with pytest.raises(BadInput, match="culling needs a mask of each photograph, and bare has none"):
        culled(mesh, [Shot("bare", camera, colours, None)])


def test_files_may_lie_as_the_archives_have_them_and_broken_ones_are_named(folder):
    (folder / "SampleSet").mkdir()
    (folder / "ObsMask").rename(folder / "SampleSet" / "ObsMask")
    with pytest.raises(BadInput, match=r"has no ObsMask/ObsMask65_10.mat: give the folder .* \(SampleSet.zip has it\)"):
        read_scan(folder, NUMBER)
    (folder / "SampleSet" / "MVS Data").mkdir()
    (folder / "SampleSet" / "ObsMask").rename(folder / "SampleSet" / "MVS Data" / "ObsMask")
    assert len(read_scan(folder, NUMBER).points) == 40_000
    with pytest.raises(BadInput, match=r"has no Points/stl/stl066_total\.ply"):
        read_scan(folder, 66)
    plane = folder / "SampleSet" / "MVS Data" / "ObsMask" / "Plane65.mat"
    savemat(plane, {"P": np.zeros((3, 1))})
    with pytest.raises(BadInput, match=r"must have ObsMask \[x, y, z\], BB \[2, 3\], a number Res and P \[4\], found"):
        read_scan(folder, NUMBER)
    savemat(plane, {"Q": np.zeros((4, 1))})
    with pytest.raises(BadInput, match=r"Plane65\.mat has no P, found"):
        read_scan(folder, NUMBER)
    plane.write_bytes(b"<html>")
    with pytest.raises(BadInput, match=r"Plane65.mat cannot be read as a .mat file"):
        read_scan(folder, NUMBER)
    ball().save(folder / "Points/stl/stl065_total.ply")
    with pytest.raises(BadInput, match="must be the points of a scan, found a mesh"):
        read_scan(folder, NUMBER)


def test_published_numbers_are_of_the_scans_that_dvr_has():
    assert published_results(24) == [] and "DVR (RGB): 0.907" in published_results(65)[0]
