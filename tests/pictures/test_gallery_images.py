"""What runs write for galleries: given depths, and shapes as the scene's camera sees them and from behind."""

import json
from dataclasses import replace

import numpy as np
import torch
import trimesh
from matplotlib.figure import Figure

from bench.config import load
from bench.pictures.run_figures import ViewPair, _show_depth, save_gallery
from datasets.mesh import Mesh
from datasets.scene import Scene, Truth, see
from tests.tiny import ball_prior, camera_of, run_of

CAMERA = camera_of(16)


def half_ball(radius: float) -> Mesh:
    """A ball of which the half towards the camera, at z above 0, is there."""
    made = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    vertices, faces = np.array(made.vertices), np.array(made.faces)
    return Mesh(vertices, faces[(vertices[faces][..., 2] >= 0).all(axis=1)]).compact()


def test_shapes_are_seen_by_two_cameras_and_depths_where_they_are_given(tmp_path):
    made = trimesh.creation.icosphere(subdivisions=3, radius=0.6)
    mesh = Mesh(np.array(made.vertices), np.array(made.faces))
    scene = Scene("ball", mesh, see(Truth(mesh), CAMERA))
    inputs = run_of(tmp_path, load("renderer", "dist"), ball_prior(), CAMERA, make_scene=lambda: scene).inputs
    inputs = replace(inputs, evaluation=replace(inputs.evaluation, gallery=24))
    observed = scene.view.mask & (torch.arange(256).view(16, 16) % 5 == 0)
    save_gallery(tmp_path, inputs, observed, {"start": None, "found": half_ball(0.4)})
    with np.load(tmp_path / "images.npz") as images:
        found = dict(images)
    assert np.array_equal(np.isfinite(found["given"]), observed.numpy())
    given = scene.view.depth.numpy()[observed.numpy()]
    np.testing.assert_allclose(found["given"][observed.numpy()], given, atol=2e-3)
    assert {name: array.shape for name, array in found.items() if name != "given"} == {
        f"{kind}_{part}": (2, 24, 24, *more)
        for kind in ("start", "found", "true")
        for part, more in (("normals", (3,)), ("hit", ()))
    }
    front, behind = found["true_hit"]
    assert front.sum() > 60 and np.array_equal(front, front[:, ::-1]) and abs(int(behind.sum()) - int(front.sum())) < 20
    assert found["true_normals"][0, 12, 12, 2] > 0.9  # towards the camera
    assert 0 < found["found_hit"][0].sum() < 0.6 * front.sum()  # the smaller ball
    assert (found["found_normals"][1][found["found_hit"][1]][:, 2] < 0).mean() > 0.5  # its inside, from behind
    assert not found["start_hit"].any()


def test_depths_are_coloured_from_the_nearest_to_the_farthest():
    view = see(Truth(half_ball(0.6), closed=False), CAMERA)
    pair = ViewPair("truth", view, view)
    image = _show_depth(Figure().subplots(), pair, (pair,))
    known = view.depth[view.mask]
    assert image.get_clim() == (known.min(), known.max()) and known.min() < known.max()


def test_a_run_writes_them_where_they_are_asked_for(isolated, tmp_path):
    small = ("scale=smoke", "evaluation.picture=null", "evaluation.grid=24", "evaluation.points=100", "isolation=off")
    code, out, _ = isolated("task=deepsdf", *small, "task.optimiser.iterations=2", "evaluation.gallery=12")
    assert code == 0
    folder = tmp_path / "r" / "runs" / out.split("/")[-1].strip()
    with np.load(folder / "images.npz") as images:
        record = json.loads((folder / "record.json").read_text())
        assert np.isfinite(images["given"]).sum() == record["evaluations"]["observed"]
        assert all(images[f"{kind}_hit"].any() for kind in ("start", "found", "true"))
