"""The judge on Tanks and Temples against a second implementation on a made scene, its alignments, and its errors."""

import json
import re
import shutil

import numpy as np
import pytest
import trimesh
from matplotlib.path import Path as Polygon
from scipy.spatial import cKDTree

from bench.judge import main
from bench.tasks.reconstruction.tanks import TanksSettings, read_scene, tanks_distances, tanks_metrics
from datasets.mesh import Mesh
from renderers.checks import BadInput
from tests.made_tanks import (
    HEIGHTS,
    MESH_TO_SCAN,
    NAME,
    POLYGON,
    THRESHOLD,
    centres,
    estimated_centres,
    faulty,
    moved,
    write_log,
    write_scene,
)

EXACT = TanksSettings(refine=False)
TO_MESH = np.linalg.inv(MESH_TO_SCAN)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("tanks"))


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return faulty()


def metrics_of(shape, folder, settings: TanksSettings) -> list[float]:
    scene = read_scene(folder, NAME)
    return [*tanks_metrics(tanks_distances(shape, scene, settings, seed=0)[0], scene.threshold).values()]


def cropped(points: np.ndarray) -> np.ndarray:
    kept = Polygon(POLYGON).contains_points(points[:, [0, 2]])
    return points[kept & (points[:, 1] >= HEIGHTS[0]) & (points[:, 1] <= HEIGHTS[1])]


def averaged(points: np.ndarray, side: float) -> np.ndarray:
    """The mean of the points in each voxel; voxels begin half a side before the points."""
    voxels = np.floor((points - points.min(axis=0)) / side + 0.5).astype(int)
    _, voxel, counts = np.unique(voxels, axis=0, return_inverse=True, return_counts=True)
    return np.stack([np.bincount(voxel.ravel(), axis) for axis in points.T], axis=1) / counts[:, None]


def icp(source: np.ndarray, target: np.ndarray, reach: float) -> np.ndarray:
    """Similarity by Umeyama's closed form on the nearest pairs, until their number changes by less than 1e-6."""
    total, fitness, tree = np.eye(4), None, cKDTree(target)
    for _ in range(31):
        distance, nearest = tree.query(source)
        near = distance <= reach
        if fitness is not None and abs(near.mean() - fitness) < 1e-6:
            break
        fitness = near.mean()
        a, b = source[near], target[nearest[near]]
        u, spread, vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)) / len(a))
        signs = np.array([1, 1, np.linalg.det(u) * np.linalg.det(vt)])
        step = np.eye(4)
        step[:3, :3] = (spread @ signs) / a.var(axis=0).sum() * (u * signs) @ vt
        step[:3, 3] = b.mean(0) - step[:3, :3] @ a.mean(0)
        source, total = moved(source, step), step @ total
    return total


def expected(points: np.ndarray, scan: np.ndarray, *, refine: bool) -> list[float]:
    """Precision, recall and F-score from the description of the protocol, with NumPy and SciPy alone."""
    for voxel, reach in ((1, 80), (0.5, 20), (None, 2)) if refine else ():
        clouds = (cropped(points), cropped(scan))
        source, target = (cloud if voxel is None else averaged(cloud, voxel * THRESHOLD) for cloud in clouds)
        points = moved(points, icp(source, target, reach * THRESHOLD))
    measured, truth = (averaged(cropped(cloud), THRESHOLD / 2) for cloud in (points, scan))
    precision, recall = (
        float((cKDTree(b).query(a)[0] < THRESHOLD).mean()) for a, b in ((measured, truth), (truth, measured))
    )
    return [precision, recall, 2 * precision * recall / (precision + recall)]


@pytest.mark.parametrize("refine", [False, True])
def test_metrics_are_those_of_a_second_implementation(folder, mesh, refine):
    """The published script gives the same numbers, digit for digit, if it runs on Open3D 0.20."""
    scan = np.asarray(trimesh.load(folder / f"{NAME}.ply").vertices)
    reference = expected(mesh.vertices, scan, refine=refine)
    assert 0.3 < reference[0] < 0.95 and 0.7 < reference[1] < 0.97  # noise costs precision, the hole recall
    assert metrics_of(mesh, folder, TanksSettings(refine=refine)) == pytest.approx(reference, abs=1e-9)


def test_a_mesh_of_another_world_is_aligned_by_a_matrix_or_by_its_cameras(folder, mesh, tmp_path):
    reference, away = metrics_of(mesh, folder, TanksSettings()), mesh.moved(TO_MESH)
    np.savetxt(tmp_path / "matrix.txt", MESH_TO_SCAN)
    assert metrics_of(away, folder, TanksSettings(tmp_path / "matrix.txt")) == pytest.approx(reference, abs=1e-3)
    write_log(tmp_path / "exact.log", moved(centres(), TO_MESH))
    exact = metrics_of(mesh, folder, EXACT)
    assert metrics_of(away, folder, TanksSettings(tmp_path / "exact.log", refine=False)) == pytest.approx(
        exact, abs=1e-3
    )
    write_log(tmp_path / "estimated.log", estimated_centres())  # three are outliers
    settings, scene = TanksSettings(tmp_path / "estimated.log"), read_scene(folder, NAME)
    distances, notes = tanks_distances(away, scene, settings, seed=0)
    assert [*tanks_metrics(distances, THRESHOLD).values()] == pytest.approx(reference, abs=0.01)
    assert notes[0].startswith("trajectory: 21 of 24 cameras agree within 0.2 m")
    assert any(
        re.match(r"ICP moved the mesh by 0\.01\d* m at the scene's centre, [\d.]+ degrees", note) for note in notes
    )
    with pytest.raises(BadInput, match="no point of the mesh lies in the crop volume of Barn: it must be in"):
        metrics_of(away, folder, EXACT)


def test_the_trajectory_of_a_video_is_mapped_to_the_images(folder, mesh, tmp_path):
    copy, frames = shutil.copytree(folder, tmp_path / NAME), 1700
    indices = np.linspace(5, frames - 5, len(centres())).astype(int)
    positions = np.zeros((frames, 3))
    positions[indices] = centres()
    write_log(tmp_path / "video.log", positions)
    mapping = copy / f"{NAME}_mapping_reference.txt"
    with pytest.raises(BadInput, match=r"Barn_mapping_reference\.txt, the frames of its images"):
        metrics_of(mesh, copy, TanksSettings(tmp_path / "video.log"))
    rows = "\n".join(f"{image + 1} {frame + 1}" for image, frame in enumerate(indices))
    mapping.write_text(f"{len(indices)}\n{frames}\n{rows}\n")
    settings = TanksSettings(tmp_path / "video.log", refine=False)
    assert metrics_of(mesh, copy, settings) == pytest.approx(metrics_of(mesh, copy, EXACT), abs=1e-6)
    mapping.write_text(mapping.read_text().replace(f" {indices[-1] + 1}\n", " 1801\n"))
    with pytest.raises(BadInput, match="a trajectory of 1700 cameras must be that of the video, of 1700 frames"):
        metrics_of(mesh, copy, settings)


def test_a_matrix_with_a_shear_or_with_several_scales_is_no_alignment(folder, mesh, tmp_path):
    shear = np.eye(4)
    shear[0, 1] = 0.01
    for matrix in (np.diag([1.0, 1, 2, 1]), shear):
        np.savetxt(tmp_path / "matrix.txt", matrix)
        with pytest.raises(BadInput, match=r"a similarity, a rotation times one scale, found .*: align again with one"):
            metrics_of(mesh, folder, TanksSettings(tmp_path / "matrix.txt"))
    np.savetxt(tmp_path / "matrix.txt", MESH_TO_SCAN, fmt="%.4f")  # rounded
    metrics_of(mesh.moved(TO_MESH), folder, TanksSettings(tmp_path / "matrix.txt", refine=False))


def test_points_of_faces_count_where_vertices_are_sparse(folder):
    coarse, scene = faulty(3), read_scene(folder, NAME)
    notes = tanks_distances(coarse, scene, EXACT, seed=0)[1]
    assert "vertices alone do not cover its faces. --surface samples these too" in notes[0]
    alone, more = (
        metrics_of(coarse, folder, TanksSettings(refine=False, surface=surface)) for surface in (False, True)
    )
    assert more[1] > 2 * alone[1]
    assert metrics_of(coarse.vertices, folder, EXACT) == alone


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        (
            "Barn.ply",
            None,
            "has no Barn.ply, the scan: give the folder of the training data with the folders Barn, Cat",
        ),
        ("Barn.json", None, "has no Barn.json, its crop volume"),
        ("Barn.json", "{}", "cannot be read as a crop volume of Open3D ('orthogonal_axis'): copy it again"),
        ("Barn.json", ("bounding_polygon", [[0, 0, 0]]), "must be a crop volume with three corners or more"),
        ("Barn.json", ("axis_min", 5), "must be a crop volume with three corners or more"),
        ("Barn.json", ("axis_min", 0.45), "lies in the crop volume"),
        ("Barn_trans.txt", None, "has no Barn_trans.txt, the matrix from its cameras to the scan"),
        ("Barn_trans.txt", "1 2\n3 4", "must be a similarity, 4 x 4 numbers whose last row is 0 0 0 1"),
        ("Barn_COLMAP_SfM.log", None, "has no Barn_COLMAP_SfM.log, its cameras"),
        ("Barn_COLMAP_SfM.log", "0 0 0\n1 0 0 x\n", "cannot be read as a trajectory"),
        ("Barn_COLMAP_SfM.log", "0 0 0\n" * 3, "cannot be read as a trajectory"),
        (
            "own.log",
            23,
            "must have a camera per image, as Barn_COLMAP_SfM.log has, in its order: found 23 cameras and 24",
        ),
        ("own.log", 1650, "has no Barn_mapping_reference.txt"),
        ("own.log", "", "must have five lines per image, with numbers that are finite, found 0 lines"),
        ("own.log", None, "own.log cannot be read as a trajectory"),
        ("own.log", 24, "cannot be aligned with Barn_COLMAP_SfM.log: "),
    ],
)
def test_an_error_names_its_cause(folder, tmp_path, mesh, name, content, words):
    copy = shutil.copytree(folder, tmp_path / NAME)
    file = copy / name
    write_log(copy / "own.log", centres())
    if content is None:
        file.unlink()
    elif isinstance(content, str):
        file.write_text(content)
    elif isinstance(content, int):
        write_log(file, np.random.default_rng(2).uniform(-9, 9, (content, 3)) ** 3)
    else:
        file.write_text(json.dumps(json.loads(file.read_text()) | dict([content])))
    with pytest.raises(BadInput, match=re.escape(words)):
        metrics_of(mesh, copy, TanksSettings(copy / "own.log", refine=False))


@pytest.mark.slow
def test_the_command_writes_a_picture_and_a_row(folder, mesh, tmp_path, capsys):
    mesh.save(tmp_path / "my barn.ply")
    command = [str(tmp_path / "my barn.ply"), "--tnt", str(folder.parent)]
    assert main([*command, "--picture", str(tmp_path / "barn.png")]) == 0
    printed = [float(value) for value in capsys.readouterr().out.splitlines()[2].split()[-3:]]
    curves = np.loadtxt(tmp_path / "barn.csv", delimiter=",", skiprows=1)
    assert curves[np.isclose(curves[:, 0], THRESHOLD), 1:][0] == pytest.approx(printed, abs=1e-4)
    assert (tmp_path / "barn.png").stat().st_size > 20_000
    row = ("--into", str(tmp_path / "results"), "--method", "Mine")
    assert main([*command, *row, "--picture", str(tmp_path / "barn.png")]) == 0
    (run,) = (tmp_path / "results/runs").iterdir()
    assert {file.name for file in run.iterdir()} >= {"record.json", "mesh.ply", "distances.png"}


def test_the_command_judges_and_refuses_what_does_not_fit(folder, mesh, tmp_path, capsys):
    mesh.save(tmp_path / "my barn.ply")
    command = [str(tmp_path / "my barn.ply"), "--tnt", str(folder.parent)]
    assert main(command) == 0
    names, _, row, *notes = capsys.readouterr().out.splitlines()
    assert names.split() == ["tnt_precision", "tnt_recall", "tnt_fscore"] and notes[-1].startswith("how: the mesh's")
    assert all(0 <= float(value) <= 1 for value in row.split()[-3:])
    for more, words in (
        (
            ["--scene", "Family"],
            "'Family' names no scene of Tanks and Temples with a public truth: --scene must be one of",
        ),
        (["--unit-sphere"], "--unit-sphere and --threshold are for --truth"),
        (["--picture", str(tmp_path)], "--picture must name a file that ends in .png"),
    ):
        assert main([*command, *more]) == 2
        assert words in capsys.readouterr().err
    assert main([command[0], "--truth", command[0], "--no-icp"]) == 2
    assert "--align, --no-icp and --surface are for --tnt" in capsys.readouterr().err
