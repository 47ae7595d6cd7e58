"""Reconstruction from photographs on disk and of a mesh: it improves, leaves a coloured mesh, and tells mistakes."""

import json
import math
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from bench.config import load
from bench.setup.inputs import FieldChoice, RunContext
from bench.solve.optimise import OptimiserSettings
from bench.tasks.reconstruction.choice import Appearance, AutoField
from bench.tasks.reconstruction.distance_fit import DistanceFit
from bench.tasks.reconstruction.dtu import METRIC_NAMES, dtu_metrics, read_scan
from bench.tasks.reconstruction.judge import COLOURED_DEFINITIONS
from bench.tasks.reconstruction.losses import Losses
from bench.tasks.reconstruction.subject import Depths
from bench.tasks.reconstruction.symptoms import WEIGHT
from bench.tasks.reconstruction.task import Reconstruction
from datasets.files.meshes import read_mesh
from datasets.files.own_photographs import OwnPhotographs
from datasets.mesh import Mesh
from datasets.scene import Scene, sample_surface
from datasets.views import ViewSampler
from renderers.checks import BadInput
from renderers.rendering import Unsupported
from renderers.silhouette import Own
from tests.datasets.test_photographs import PHOTOGRAPHY
from tests.looped import each
from tests.made_dtu import CENTRE as DTU_CENTRE
from tests.made_dtu import ball, on_ball, write_dtu
from tests.made_photographs import CENTRE, RADIUS, nerf
from tests.tiny import altered, ball_prior, camera_of, curve_of, icosphere, run_of, scene_of

PICTURES = ("summary.png", "input.png", "strip.png", "curve.png")
SETTINGS = Reconstruction(
    images=replace(PHOTOGRAPHY, places="sphere", views=7, texture_size=1.0),
    longest=24,
    held_out=4,
    masks=True,
    depths=Depths("none", 0.0),
    guide="none",
    rays=192,
    appearance=Appearance(octaves=2, directional=False, radius=0.5),
    auto=AutoField(candidates=("network_2x16", "network_1x8"), trial=0.2, patience=1),
    losses=Losses(
        colour=1.0, colour_gradient=0.0, depth=1.0, depth_loss="depth", silhouette=Own(), silhouette_weight=0.3,
        smoothness=0.0, normals=0.0, eikonal=0.3,
    ),
    optimiser=OptimiserSettings(20, 0.02, "ramped"),
)  # fmt: skip


@pytest.fixture(scope="module")
def scene() -> Scene:
    """An ellipsoid, larger than the sphere that fields begin as."""
    made = scene_of(icosphere(1.0).moved(np.diag([0.8, 0.65, 0.6, 1.0])), camera_of(24))
    return replace(made, name="ellipsoid")  # by which photographs are drawn


def run_in(folder: Path, scene: Scene | None, *, renderer: str = "idr", field: str = "grid_12", **more) -> RunContext:
    """A run under way, of a scene or of photographs on disk, which are written first."""
    if scene is None:
        nerf(folder)
        truth = {"truth": more.pop("truth", None), "scan": more.pop("scan", None)}
        more |= {"dataset": OwnPhotographs(str(folder), more.pop("stored_masks", True), "stated", None, False, **truth)}
        more |= {"make_scene": lambda: pytest.fail("photographs have no scene")}
    else:
        more |= {"make_scene": lambda: scene}
    more |= {"field": FieldChoice(field, None)}
    fewer = {"steps": 20} if renderer == "idr" else {}  # for speed
    return run_of(folder, load("renderer", renderer, **fewer), ball_prior(), camera_of(24), **more)


def executed(run: RunContext, **changed):
    """The record of a run of the task with changed settings."""
    torch.manual_seed(0)
    altered(SETTINGS, changed).execute(run)
    return run.record


def assert_coloured_mesh(folder: Path) -> np.ndarray:
    """The colours of the mesh that a run has left, which are not all alike."""
    mesh = trimesh.load_mesh(folder / "mesh.ply", process=False)
    assert mesh.visual.kind == "vertex"
    colours = np.asarray(mesh.visual.vertex_colors[:, :3], dtype=float)
    assert len(colours) == len(mesh.vertices) > 50
    return colours


@pytest.mark.slow
def test_a_rendered_mesh_is_learnt_with_its_colours(scene, tmp_path):
    record = executed(altered(run_in(tmp_path, scene), {"inputs.evaluation.every": 10}))
    assert (record.status, record.reason) == ("ok", "")
    first, last = record.metrics_start, record.metrics
    assert set(first) == set(last) == set(COLOURED_DEFINITIONS) - set(WEIGHT) <= set(record.definitions)
    for name in ("psnr", "own_psnr"):
        assert last[name] > first[name] + 2
    assert last["mask_iou"] > first["mask_iou"] + 0.1 and last["chamfer_l1"] < 0.8 * first["chamfer_l1"]
    assert assert_coloured_mesh(tmp_path).std(axis=0).max() > 5
    for name in PICTURES:
        assert (tmp_path / name).stat().st_size > 2000, name
    assert "7 rendered photographs of 24 x 24 pixels; 2 of them are held out" in record.notes
    lines = curve_of(tmp_path)
    assert len(lines) == 20 and {"colour", "silhouette", "eikonal"} < set(lines[0]) and "depth" not in lines[0]
    checked = [line for line in lines if "psnr" in line]
    assert [line["iteration"] for line in checked] == [0, 10, 19]
    assert checked[0]["psnr"] == first["psnr"] < checked[-1]["psnr"]
    assert checked[-1]["seen_chamfer_l1"] < first["seen_chamfer_l1"]
    assert record.evaluations["rays_per_iteration"] == 192 and record.evaluations["observed"] == 0


def without_pictures(run: RunContext) -> RunContext:
    return altered(run, {"inputs.evaluation.picture": None})


@pytest.mark.parametrize(("masks", "margin"), [("not used", 0.3), ("none", 0.05)])  # behind it all is judged
def test_photographs_on_disk_are_learnt(tmp_path, masks, margin):
    run = run_in(tmp_path, None, stored_masks=masks != "none")
    run = run if masks == "none" else without_pictures(run)
    record = executed(run, masks=False, longest=32)
    assert record.status == "ok", record.reason
    assert record.metrics["psnr"] > record.metrics_start["psnr"] + margin
    assert any("without masks nothing says where the object ends" in note for note in record.notes)
    assert ("mask_iou" in record.metrics) == (masks != "none")
    assert not {"chamfer_l1", "seen_chamfer_l1"} & set(record.metrics)
    colours = assert_coloured_mesh(tmp_path)
    in_scene, back = (trimesh.load_mesh(tmp_path / f"mesh{name}.ply", process=False) for name in ("", "_world"))
    to_world = np.loadtxt(tmp_path / "to_world.txt")
    np.testing.assert_allclose(back.vertices, in_scene.vertices @ to_world[:3, :3].T + to_world[:3, 3], rtol=1e-12)
    assert (back.visual.vertex_colors == in_scene.visual.vertex_colors).all()
    assert any(", ".join(str(float(value)) for value in to_world[:3, 3]) in note for note in record.notes)
    assert masks == "none" or colours[:, 0].mean() > colours[:, 2].mean() + 15  # the ball is orange
    assert all((tmp_path / name).is_file() == (masks == "none") for name in PICTURES)
    assert any(note.endswith("3 of them are held out") for note in record.notes)


@pytest.mark.parametrize(("renderer", "field"), [
    ("dvr", "occupancy_32"), ("newton", "network_2x16"), ("newton", "hash_2x8"), ("newton", "fourier_1x16"),
])  # fmt: skip
def test_fields_of_each_kind_are_learnt_by_renderers_that_take_them(scene, tmp_path, renderer, field):
    run = without_pictures(run_in(tmp_path, scene, renderer=renderer, field=field))
    more = {
        "blur_points": 0.02,
        "losses.depth": 1.0,
        "losses.smoothness": 0.01,
        "losses.normals": 0.1,
        "losses.colour_gradient": 0.1,
    }
    record = executed(run, depths=Depths("20%", 0.001), **more, **{"optimiser.iterations": 6})
    assert record.status in ("ok", "not_reached") and "mesh.ply" in {path.name for path in tmp_path.iterdir()}
    line = curve_of(tmp_path)[0]
    terms = {"colour", "colour_gradient", "depth", "silhouette", "smoothness", "normals"}
    assert terms < set(line) and ("eikonal" in line) == (field != "occupancy_32")
    assert record.evaluations["observed"] > 100 and not list(tmp_path.glob("*.png"))


def test_a_guide_reaches_the_loss_of_occupancy(scene, tmp_path):
    run = run_in(tmp_path, scene, renderer="dvr", field="occupancy_16")
    for guide, has_guide in (("none", None), ("hull", True), ("given", True)):
        settings = replace(SETTINGS, guide=guide, depths=Depths("dense", 0.0))
        problem = settings.problem(run.inputs.field.name, settings.subject(run.inputs), run)
        stored_guide = problem.stack.pixels.guide
        assert (stored_guide is None) == (has_guide is None)
        assert stored_guide is None or 0.05 < stored_guide.isfinite().float().mean() < 0.6
    with pytest.raises(BadInput, match="the visual hull needs a mask"):
        executed(run, guide="hull", masks=False)


@each("field", ["union_3", "prior"])
def test_a_field_without_colours_is_told(scene, tmp_path, field):
    words = f"field={field} has no colours: task=reconstruction takes network_LAYERSxWIDTH, .* or grid_N"
    with pytest.raises(BadInput, match=words):
        executed(run_in(tmp_path, scene, field=field))


@each("candidates", [("network_1x8", "occupancy_16"), ("sphere",)])
def test_candidates_that_cannot_be_are_refused_before_photographs_are_taken(scene, tmp_path, monkeypatch, candidates):
    monkeypatch.setattr(Reconstruction, "subject", lambda *_: pytest.fail("photographs were taken"))
    with pytest.raises((BadInput, Unsupported), match=r"has no colours|needs a distance"):
        executed(run_in(tmp_path, scene, renderer="newton", field="auto"), **{"auto.candidates": candidates})


@pytest.mark.parametrize("kind", ["pieces", "cloud", "dtu"])
def test_a_truth_in_the_world_of_photographs_judges_them(tmp_path, kind):
    points = (on_ball(20_000, RADIUS) - DTU_CENTRE) + CENTRE
    truth = tmp_path / f"{kind}.ply"
    trimesh.PointCloud(points).export(truth)
    if kind == "pieces":
        truth = folder(tmp_path, kind)
        for index, faces in enumerate(np.array_split(ball(RADIUS, CENTRE).faces, 3)):
            Mesh(ball(RADIUS, CENTRE).vertices, faces).compact().save(truth / f"{index}.ply")
    if kind == "dtu":
        write_dtu(truth.with_suffix(""), points, plane=(0, 0, 1, 0), centre=CENTRE)
    truth = truth if kind != "dtu" else truth.with_suffix("")
    run = without_pictures(run_in(folder(tmp_path, "run"), None, truth=str(truth), scan=65))
    record = executed(altered(run, {"inputs.evaluation.points": 20_000}), **{"optimiser.iterations": 5})
    assert record.status == "ok", record.reason
    mesh = read_mesh(tmp_path / "run" / "mesh_world.ply")
    away = np.abs(np.linalg.norm(sample_surface(mesh, 4000, 0).points - CENTRE, axis=1) - RADIUS).mean()
    metrics = record.metrics
    if kind == "dtu":
        assert {name: metrics[name] for name in METRIC_NAMES} == dtu_metrics(mesh, read_scan(truth, 65), seed=0)
        assert metrics["dtu_accuracy"] == pytest.approx(away, abs=0.02 * RADIUS)
        assert set(METRIC_NAMES) < set(record.definitions) and any("DVR (RGB): 0.907" in note for note in record.notes)
        return
    unit = np.linalg.norm(np.loadtxt(tmp_path / "run" / "to_world.txt")[:3, 0])
    assert metrics["accuracy"] * unit == pytest.approx(away, abs=0.01 * RADIUS)
    assert ("seen_chamfer_l1" in metrics) == ("normal_consistency" in metrics) == (kind == "pieces")


def test_a_truth_elsewhere_and_a_scan_without_a_number_are_refused(tmp_path):
    ball(RADIUS, CENTRE + 9).save(tmp_path / "far.ply")
    with pytest.raises(BadInput, match=r"dataset.truth=.*far.ply overlaps .* by 0% .* if it is moved by \(-9, "):
        executed(run_in(folder(tmp_path, "one"), None, truth=str(tmp_path / "far.ply")))
    (tmp_path / "Points").mkdir()
    with pytest.raises(BadInput, match=r"'two' does not end in the number of a scan of DTU: set dataset.scan=65"):
        executed(run_in(folder(tmp_path, "two"), None, truth=str(tmp_path)))
    with pytest.raises(ValueError, match=r"dataset.truth=gone.ply is not there"):
        OwnPhotographs(str(tmp_path), True, "stated", None, False, "gone.ply")
    for name, number in (("scan24", 24), ("dtu_scan106_small", 106)):
        path = str(folder(tmp_path, name))
        assert OwnPhotographs(path, True, "stated", None, False, str(tmp_path)).dtu_scan == number


def folder(parent: Path, name: str) -> Path:
    (parent / name).mkdir()
    return parent / name


@pytest.mark.slow
def test_auto_is_the_run_of_the_field_that_it_ends_on(scene, tmp_path):
    run = without_pictures(run_in(folder(tmp_path, "auto"), scene, field="auto"))
    record = executed(run)
    assert record.status == "ok", record.reason
    name = record.metrics["field"]
    assert name in ("network_1x8", "network_2x16") and record.metrics["fields_tried"] == 2
    assert any(note.startswith(f"field=auto: {name}, ") for note in record.notes)
    assert record.seconds["trials"] > 0 and record.metrics["field_overhead"] > 1
    defined = {name for key in record.definitions for name in key.split(", ")}
    assert set(record.metrics) <= defined
    named = executed(without_pictures(run_in(folder(tmp_path, "named"), scene, field=name)))
    assert named.metrics["psnr"] == record.metrics["psnr"] and named.evaluations == record.evaluations


@pytest.mark.parametrize("is_compared", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_fit_to_true_distances_is_better_than_a_short_reconstruction(scene, tmp_path, is_compared):
    shared = {each.name: getattr(SETTINGS, each.name) for each in fields(Reconstruction)}
    shared["optimiser"] = OptimiserSettings(60, 0.01, "cosine")
    settings = DistanceFit(**shared, distances=3000, batch=500, surface_width=0.05)
    errors = {}
    for name, task in {"fit": settings, **({"photographs": SETTINGS} if is_compared else {})}.items():
        (tmp_path / name).mkdir()
        run = altered(run_in(tmp_path / name, scene, field="network_2x16"), {"inputs.evaluation.points": 3000})
        task.execute(run)
        assert run.record.status == "ok"
        errors[name] = run.record.metrics["seen_chamfer_l1"]
        errors["start"] = run.record.metrics_start["seen_chamfer_l1"]
    assert errors["fit"] < errors.get("photographs", math.inf) and errors["fit"] < 0.3 * errors["start"]


def test_the_block_of_pixels_divides_the_rays(scene, tmp_path):
    run = run_in(tmp_path, scene, field="network_2x16")
    subject = SETTINGS.subject(run.inputs)
    rays = {
        block: replace(SETTINGS, pixel_block=block).problem("network_2x16", subject, run).rays_per_iteration
        for block in (1, 2, 8)
    }
    assert rays == {1: 192, 2: 48, 8: 4}
    short = replace(SETTINGS.optimiser, budget=2e4)
    sampled = replace(SETTINGS, pixel_block=0, optimiser=short).problem("network_2x16", subject, run)
    assert sampled.rays_per_iteration in (4, 12, 48) and sampled.counts.cost == 0


def test_trials_need_a_number_of_iterations(scene, tmp_path):
    spending = replace(SETTINGS, optimiser=replace(SETTINGS.optimiser, budget=2e4, ends="budget"))
    spending.check(run_in(tmp_path, scene, field="network_2x16").inputs)
    with pytest.raises(BadInput, match=r"field=auto.*: remove task\.optimiser\.ends=budget, or name a field"):
        spending.check(run_in(tmp_path, scene, field="auto").inputs)


@each("masks", [255, 250, None])
def test_several_rays_of_each_pixel_are_drawn_anew_and_compared_with_fractions(scene, tmp_path, masks):
    """Of a scene, and of photographs on disk, also if the white of their masks is darker."""
    views = ViewSampler(2.5, 50.0, (0.0, 0.0), (0.0, 0.0), 24, rays_per_pixel=4)
    run = run_in(tmp_path, scene if masks is None else None, field="network_2x16", views=views)
    if masks == 250:
        for file in tmp_path.rglob("*.png"):
            image = np.array(Image.open(file))
            image[..., 3] = image[..., 3] * (masks / 255)
            Image.fromarray(image).save(file)
    subject = SETTINGS.subject(run.inputs)
    problem = replace(SETTINGS, camera_noise=2.0, cameras="refine", blur_points=0.01).problem(
        "network_2x16", subject, run
    )
    seen, render = [], problem.renderer.render
    recording = SimpleNamespace(render=lambda field, rays: seen.append(rays) or render(field, rays))
    recording.capabilities, recording.silhouette_loss = problem.renderer.capabilities, problem.renderer.silhouette_loss
    problem.renderer = recording
    terms = problem.loss(1)
    problem.loss(2)
    assert problem.rays_per_iteration == 4 * 192
    assert [tuple(rays.shape) for rays in seen] == [(192, 4)] * 2
    assert (seen[0].directions[:, :1] - seen[0].directions[:, 1:]).abs().amax(-1).min() > 0
    assert not torch.equal(seen[0].directions, seen[1].directions)
    covered = problem.stack.pixels.covered
    assert 0.05 < ((covered > 0.02) & (covered < 0.98)).float().mean() < 0.5 and (covered > 0.98).sum() > 100
    assert terms["colour"] > 0 and terms["silhouette"] > 0


def test_learnt_cameras_move_and_kept_ones_stay(tmp_path, scene):
    settings = {"camera_noise": 6.0}
    (tmp_path / "learnt").mkdir()
    kept = executed(run_in(tmp_path, scene), **settings)
    learnt = executed(run_in(tmp_path / "learnt", scene), cameras="refine", **settings)
    assert kept.metrics["camera_error_deg"] == pytest.approx(6, rel=1e-3)
    assert learnt.metrics_start["camera_error_deg"] == pytest.approx(6, rel=1e-3)
    assert abs(learnt.metrics["camera_error_deg"] - 6) > 0.01
    assert "camera_error_deg" in learnt.definitions
    (frames,) = (json.loads(file.read_text())["frames"] for file in tmp_path.rglob("transforms.json"))
    shots = SETTINGS.subject(run_in(tmp_path, scene).inputs).input_shots
    true = torch.stack([shot.camera.camera_to_world[:3, :3] for shot in shots])
    written = torch.tensor([frame["transform_matrix"] for frame in frames])[:, :3, :3] * torch.tensor([1.0, -1, -1])
    cosine = ((written @ true.mT)[1:].diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2
    assert cosine.acos().rad2deg().mean().item() == pytest.approx(learnt.metrics["camera_error_deg"], rel=1e-3)


def test_cameras_are_not_learnt_without_a_gradient_towards_rays(tmp_path, scene):
    run = run_in(tmp_path, scene)
    blind = replace(run, inputs=replace(run.inputs, renderer=_WithoutRayGradient()))
    with pytest.raises(Unsupported, match="given"):
        executed(blind, cameras="refine")


class _WithoutRayGradient:
    """A renderer that has no gradient towards rays."""

    capabilities = replace(load("renderer", "idr").capabilities, ray_gradient=False)
