"""Shape from one image from the command line: trained, inferred, judged, and the rows that need no network."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from bench.config import load
from bench.evaluate.state import State
from bench.records.read import read_records
from bench.solve.latent_code import CodePenalty
from bench.solve.optimise import OptimiserSettings
from bench.solve.solve import failure_of, run_optimisation
from bench.tasks.single_view import baselines, store
from bench.tasks.single_view import task as single_view
from bench.tasks.single_view.baselines import MaskSearch, best_shape, mean_shape, most_similar_shape
from bench.tasks.single_view.own_image import best_view, filled_fraction, read_picture
from bench.tasks.single_view.task import DEFINITIONS
from bench.train import main
from datasets.mesh import Mesh
from datasets.scene import Split, Truth, see
from renderers.checks import BadInput
from renderers.silhouette import Own
from tests.looped import each
from tests.runner.driving import CommandResult, command, record_of
from tests.tasks.reconstruction.test_losses import PAINT, Ball, shot_of
from tests.tasks.single_view.test_training import SAMPLER, Spheres, images  # noqa: F401, a fixture
from tests.tiny import ball_prior, camera_of, curve_of, run_of, silent

TINY = (
    "+method=single_view", "dataset=sphere", "scale=smoke", "isolation=off", "threads=1", "task.shapes=3",
    "task.training.steps=4", "task.training.shapes_per_step=2", "task.training.rays=16", "task.images.views=3",
    "task.views=3", "task.image_pixels=16", "evaluation.grid=24", "evaluation.points=200", "evaluation.picture=32",
)  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def fewer():
    """Fewer validation shapes, samples of a mean shape, and views in the search for that of a picture."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store, "VALIDATION_SHAPES", 1)
        patch.setattr(baselines, "GRID_SAMPLES", 32)
        patch.setattr(single_view, "SEARCHED_VIEWS", 20)
        yield


def trained(*arguments: str) -> CommandResult:
    """What `python -m bench.train` left."""
    return command(*arguments, main=main)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("results")


@pytest.fixture(scope="module")
def network(folder) -> Path:
    result = trained(*TINY, f"results_dir={folder}")
    assert result.code == 0, result.err
    return Path(result.out.splitlines()[-1])


def test_it_is_trained_and_gives_a_shape_with_colours(folder, network):
    assert network.parent == folder / "priors" and network.is_file()
    result = command(*TINY, f"results_dir={folder}")
    assert result.code == 0, result.err
    record, run = record_of(result.out), Path(result.out.splitlines()[-1])
    defined = {name for key in DEFINITIONS for name in key.split(", ")}
    assert {"iou", "chamfer_l1", "normal_consistency", "mask_iou", "psnr"} < set(record["metrics"]) <= defined
    assert set(record["metrics_start"]) == set(record["metrics"])
    assert any(
        note.startswith("the network was trained on 3 shapes of sphere, 3 images each, for 4 steps")
        for note in record["notes"]
    )
    assert 0 < record["seconds"]["forward"] < record["seconds"]["total"]
    mesh = trimesh.load_mesh(run / "mesh.ply", process=False)
    assert mesh.visual.kind == "vertex"
    for name in ("summary.png", "input.png"):
        assert (run / name).stat().st_size > 1000


def test_a_run_trains_its_network_where_it_is_asked_to_and_judges_no_colours_that_it_did_not_know(folder, network):
    volume = ("supervision=occupancy", "task.train=true", f"results_dir={folder}", "evaluation.picture=null")
    record = record_of(command(*TINY, *volume).out)
    assert len(list((folder / "priors").glob("single_view-*.safetensors"))) == 2
    assert record["seconds"]["evaluation"] > record["seconds"]["forward"]
    assert {"iou", "chamfer_l1", "own_mask_iou"} < set(record["metrics"])
    assert not {"psnr", "ssim", "own_psnr", "own_ssim"} & {*record["metrics"], *record["metrics_start"]}


def test_without_its_network_it_names_the_command(tmp_path):
    result = command(*TINY, f"results_dir={tmp_path}")
    assert result.code == 2
    assert "no network was trained for sphere with these settings: add task.train=true" in result.err
    assert not list((tmp_path / "runs").glob("*"))


def test_the_code_of_the_prior_is_found_by_the_mask(tmp_path):
    small = [override for override in TINY[1:] if not override.startswith(("task.training", "dataset"))]
    small += ["dataset=sofa", "task.search.optimiser.iterations=8", f"results_dir={tmp_path}"]
    result = command("+method=single_view_code", *small)
    assert result.code == 0, result.err
    record = record_of(result.out)
    assert 0 < record["metrics"]["iou"] <= 1 and record["evaluations"]["value"] > 0
    assert len(curve_of(Path(result.out.splitlines()[-1]))) == 8


@each("factor, radius", [(0.8, 0.4), (1.25, 0.625)])
def test_a_search_has_succeeded_where_its_silhouette_is_nearer_to_the_mask_though_its_loss_rose(
    factor, radius, tmp_path
):
    prior, camera = ball_prior(0.5), camera_of(48)
    run = run_of(tmp_path, load("renderer", "dist"), prior, camera)
    search = MaskSearch(Own(), 10.0, CodePenalty(1.0, "sum"), OptimiserSettings(30, 0.02, "constant"))
    shot = shot_of(Ball(torch.tensor(factor * 0.5), torch.zeros(3), PAINT), camera)
    problem = search.problem(shot, run.inputs)
    history = run_optimisation(
        problem, search.optimiser, run, lambda iteration: {}, least_reference=search.least_reference
    )
    assert failure_of(history, problem.evaluate(State(problem.field(), run.inputs))) is None
    first, last = history.objectives
    assert first == pytest.approx(abs(covered(radius) - covered(0.5)), abs=0.02) and last < 0.3 * first
    losses = [line["total"] for line in history.curve]
    assert (losses[-1] > losses[0]) == (factor < 1)  # hits beside the mask weigh next to nothing


def covered(radius: float) -> float:
    """The share of an image of `camera_of` that a sphere about the origin covers."""
    tangent = radius / (2.5**2 - radius**2) ** 0.5
    return np.pi * (tangent / np.tan(np.radians(25))) ** 2 / 4


@pytest.fixture(scope="module")
def picture(images, tmp_path_factory) -> Path:  # noqa: F811
    """A large ball left of the middle of 120 x 80 pixels, with an alpha channel."""
    rows, columns = np.mgrid[:80, :120]
    inside = (rows - 40) ** 2 + (columns - 35) ** 2 < 25**2
    pixels = np.stack([200 * inside, 90 * inside, 30 * inside, 255 * inside], axis=-1).astype(np.uint8)
    path = tmp_path_factory.mktemp("picture") / "ball.png"
    Image.fromarray(pixels).save(path)
    Image.fromarray(pixels[..., :3]).save(path.with_name("opaque.png"))
    Image.fromarray(pixels[..., 3]).save(path.with_name("mask.png"))
    Image.fromarray(pixels[:40, :, 3]).save(path.with_name("half.png"))
    Image.fromarray(np.full((80, 120), 255, np.uint8)).save(path.with_name("white.png"))
    Image.fromarray(255 - pixels[..., 3]).save(path.with_name("inverted.png"))
    Image.fromarray(pixels[:, 30:]).save(path.with_name("cut.png"))
    Image.fromarray(np.zeros((80, 120), np.uint8)).save(path.with_name("black.png"))
    return path


def test_a_picture_of_ones_own_has_a_shape(folder, network, picture):
    files = (f"task.image_path={picture.with_name('opaque.png')}", f"task.mask_path={picture.with_name('mask.png')}")
    result = command(*TINY, *files, f"results_dir={folder}")
    assert result.code == 0, result.err
    record, run = record_of(result.out), Path(result.out.splitlines()[-1])
    assert record["scene"] == "opaque.png" and set(record["metrics"]) == {"fitted_mask_iou"}
    assert record["metrics"]["fitted_mask_iou"] > 0.7  # of 16 x 16 pixels
    assert "the network was trained on 3 shapes of sphere" in " ".join(record["notes"])
    assert (run / "mesh.ply").is_file() and (run / "summary.png").stat().st_size > 1000


def test_a_picture_that_changed_is_seen_anew(folder, network, picture, tmp_path):
    picture = Path(shutil.copy(picture, tmp_path))
    files = (f"task.image_path={picture}", f"results_dir={folder}", "evaluation.picture=null")
    assert not record_of(command(*TINY, *files).out)["reused"]
    Image.open(picture).rotate(90).save(picture)
    assert not record_of(command(*TINY, *files).out)["reused"]


@each("image, mask, says", [
    ("opaque", None, "opaque.png has no mask: give task.mask_path=FILE"),
    ("opaque", "half", "has 120 x 40 pixels, its image 120 x 80"),
    ("opaque", "white", "is white everywhere: make it black beside the object"),
    ("opaque", "black", "shows no object of 16 pixels"),
    ("opaque", "inverted", "is white along the border, as an inverted one"),
])  # fmt: skip
def test_a_picture_that_cannot_be_is_told(picture, image, mask, says):
    with pytest.raises(BadInput, match=says):
        read_picture(picture.with_name(f"{image}.png"), mask and picture.with_name(f"{mask}.png"), 32, 0.5)


def test_a_picture_is_framed_as_the_images_are(picture, images):  # noqa: F811
    filled = filled_fraction(torch.cat([shape.masks for shape in images]))
    sides = [max(np.ptp(np.flatnonzero(m.any(0))), np.ptp(np.flatnonzero(m.any(1)))) + 1 for m in images[1].masks]
    assert filled == pytest.approx(np.median(sides) / 16, abs=1 / 16)
    framed, doubts = read_picture(picture, None, 32, 0.5)
    assert doubts == []
    assert read_picture(picture.with_name("cut.png"), None, 32, 0.5)[1] == [
        "the object touches the border (left): the network knows whole ones"
    ]
    rows, columns = framed[3].nonzero().T
    for indices in (rows, columns):
        assert (indices.min() + indices.max()) / 2 == pytest.approx(15.5, abs=1)
        assert np.ptp(indices.numpy()) + 1 == pytest.approx(16, abs=1)
    assert framed[:3, 16, 16].numpy() == pytest.approx(np.array([200, 90, 30]) / 255, abs=0.01)
    assert framed[:3, 0, 0].tolist() == [0.5] * 3


def test_the_view_that_is_most_alike_is_that_of_the_mask():
    mesh = Mesh(Spheres().mesh(Split.TEST, 1).vertices * [1.5, 0.5, 0.8], Spheres().mesh(Split.TEST, 1).faces)
    cameras = [SAMPLER.draw(seed) for seed in range(6)]
    mask = see(Truth(mesh), cameras[4]).mask
    filled = filled_fraction(mask[None])
    camera, overlapping = best_view(mesh, cameras, mask, filled)
    assert torch.equal(camera.world_to_camera, cameras[4].world_to_camera) and overlapping > 0.9


@pytest.mark.parametrize("method", ["mean", "nearest"])
def test_rows_without_a_network_are_judged_alike(folder, method):
    small = [override for override in TINY[1:] if not override.startswith(("task.training", "task.shapes"))]
    few = ("task.shapes=3", "evaluation.picture=null", f"results_dir={folder}")
    result = command(f"+method=single_view_{method}", *small, *few)
    assert result.code == 0, result.err
    record = record_of(result.out)
    assert {"iou", "chamfer_l1", "mask_iou", "psnr"} < set(record["metrics"])
    assert 0 < record["metrics"]["iou"] <= 1 and "no network and no renderer took part" in record["notes"]
    assert any(note.startswith("training shape ") for note in record["notes"]) == (method != "mean")
    assert read_records(folder)[1] == []


def test_the_nearest_image_and_the_best_shape_are_those_of_the_same_shape(images):  # noqa: F811
    for index, shape in enumerate(images):
        assert most_similar_shape(shape.image(1), images) == index
        assert most_similar_shape((shape.image(2) + 0.01).clamp(0, 1), images) == index
        assert best_shape(Spheres().mesh(Split.TEST, index), Spheres(), 3) == index


def test_the_nearest_image_is_one_image_and_no_mean_over_a_shape(images):  # noqa: F811
    """The first shape has the exact image among different ones. All images of the second differ slightly."""
    shape = images[0]
    image, colours = shape.image(0), shape.colours[:1]
    same = replace(shape, masks=shape.masks[:1].repeat(3, 1, 1))
    very = replace(same, colours=torch.cat([colours, torch.zeros_like(colours), torch.zeros_like(colours)]))
    near = (colours.int() + 20).clamp(0, 255).to(torch.uint8)
    all_near = replace(same, colours=near.repeat(3, 1, 1, 1))
    assert most_similar_shape(image, [all_near, very]) == 1


def test_the_mean_shape_has_the_mean_distance(tmp_path):
    mesh = mean_shape(Spheres(), 3, tmp_path, silent)
    assert mesh is not None
    radii = np.linalg.norm(mesh.vertices, axis=1)
    assert radii.mean() == pytest.approx((0.35 + 0.55 + 0.8) / 3, abs=0.02)
    (kept,) = tmp_path.glob("mean-*.safetensors")
    changed = kept.stat().st_mtime_ns
    mean_shape(Spheres(), 3, tmp_path, silent)
    assert kept.stat().st_mtime_ns == changed
    mean_shape(Spheres(), 2, tmp_path, silent)
    assert len(list(tmp_path.glob("mean-*.safetensors"))) == 2
