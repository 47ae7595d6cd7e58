"""Training of a network over shapes: learning, resuming after a stop, and the record of a failure."""

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from bench.config import load
from bench.tasks.reconstruction.losses import Losses
from bench.tasks.single_view.images import NEAR_SURFACE_STD, OCCUPANCY_POINTS, Imaging
from bench.tasks.single_view.network import SingleView, SingleViewNetwork
from bench.tasks.single_view.store import Recipe, overlap
from bench.tasks.single_view.training import Supervision, Training, TrainingFailed, TrainingSettings
from datasets.scene import Split
from datasets.views import ViewSampler
from renderers.checks import BadInput
from renderers.field import Counts
from renderers.silhouette import CrossEntropy, Occupancy
from tests.datasets.test_photographs import PHOTOGRAPHY
from tests.looped import each
from tests.tiny import CPU, icosphere, silent

SAMPLER = ViewSampler(distance=2.5, field_of_view=50.0, azimuth=(0.0, 360.0), elevation=(10.0, 40.0), resolution=16)
IMAGING = Imaging(replace(PHOTOGRAPHY, views=3, texture_size=1.0), SAMPLER)
NETWORK = SingleViewNetwork(channels=(8, 8), blocks=1, code_length=6, width=16, reads="distance", radius=0.5)
LOSSES = Losses(
    colour=1.0, colour_gradient=0.0, depth=0.0, depth_loss="depth", silhouette=CrossEntropy(sharpness=30.0, weight=1.0),
    silhouette_weight=0.3, smoothness=0.0, normals=0.0, eikonal=0.1,
)  # fmt: skip
RGB = Supervision(LOSSES, occupancy=0.0, hull=0.0, points=64)
VOLUME = Supervision(replace(LOSSES, colour=0.0, silhouette_weight=0.0), occupancy=1.0, hull=0.0, points=256)
SETTINGS = TrainingSettings(
    steps=6, shapes_per_step=2, rays=32, learning_rate=5e-3, schedule="cosine", keep_every=2, seed=0
)  # fmt: skip


@dataclass(frozen=True)
class Spheres:
    """Spheres of three sizes."""

    name: str = "balls"

    def mesh(self, split, index):
        return icosphere((0.35, 0.55, 0.8)[index % 3], subdivisions=3)

    def identity(self):
        return {"name": self.name}


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    return IMAGING.images(Spheres(), Split.TRAIN, 3, tmp_path_factory.mktemp("images"), silent)


@pytest.fixture(scope="module")
def renderer():
    return load("renderer", "newton", warm=False)


def trained(images, renderer, state, supervision=RGB, progress=silent, network=NETWORK, **changed):
    return Training(images, supervision, renderer, replace(SETTINGS, **changed), CPU).train(network, state, progress)


def weights(model: SingleView) -> torch.Tensor:
    return torch.cat([parameter.flatten() for parameter in model.parameters()])


def test_images_have_different_cameras_and_points_are_inside_or_outside(images):
    assert len(images) == 3
    radii = [0.35, 0.55, 0.8]
    for shape, radius in zip(images, radii, strict=True):
        assert shape.colours.shape == (3, 16, 16, 3) and shape.masks.shape == shape.depths.shape == (3, 16, 16)
        centres = torch.stack([camera.center for camera in shape.cameras])
        assert torch.pdist(centres).min() > 0.05 and bool((shape.masks == (shape.depths > 0)).all())
        nearest = torch.stack([depth[mask].min() for depth, mask in zip(shape.depths, shape.masks, strict=True)])
        assert nearest.numpy() == pytest.approx(2.5 - radius, abs=0.05)
        length = shape.points.norm(dim=1)
        clear = (length - radius).abs() > 0.02  # the faces lie slightly inside the sphere
        assert torch.equal(shape.inside[clear], (length < radius)[clear])
        near = (length[OCCUPANCY_POINTS // 2 :] - radius).abs()
        assert float(near.median()) == pytest.approx(0.6745 * NEAR_SURFACE_STD, rel=0.15)
        assert float(shape.points[: OCCUPANCY_POINTS // 2].abs().max()) <= 1
    cameras = torch.stack([torch.stack([camera.center for camera in shape.cameras]) for shape in images])
    assert not torch.allclose(cameras[0], cameras[1])


def test_the_input_of_an_encoder_has_colours_on_the_shape_and_the_mask(images):
    shape = images[2]
    shown = shape.image(1)
    assert torch.equal(shown[3] > 0, shape.masks[1]) and set(shown[3].unique().tolist()) == {0.0, 1.0}
    assert torch.equal(shown[:3].permute(1, 2, 0)[shape.masks[1]], shape.colours[1][shape.masks[1]].float() / 255)
    assert bool((shown[:3, ~shape.masks[1]] == 0.5).all())


def test_images_are_rendered_once(tmp_path, images, monkeypatch):
    first = IMAGING.images(Spheres(), Split.TRAIN, 2, tmp_path, silent)
    monkeypatch.setattr(Imaging, "shape_images", lambda *_: pytest.fail("made again"))
    cached = IMAGING.images(Spheres(), Split.TRAIN, 2, tmp_path, silent)
    for shape, reread, full in zip(first, cached, images, strict=False):
        assert torch.equal(shape.colours, reread.colours) and torch.equal(shape.colours, full.colours)
        assert torch.equal(shape.cameras[2].world_to_camera, reread.cameras[2].world_to_camera)
    (file,) = tmp_path.glob("images-*.safetensors")
    file.write_bytes(b"cut short")
    with pytest.raises(pytest.fail.Exception, match="made again"):
        IMAGING.images(Spheres(), Split.TRAIN, 2, tmp_path, silent)


def test_pixels_are_those_of_the_image(images):
    pixels = images[1].pixels(2, 50, torch.Generator().manual_seed(0), CPU)
    camera = images[1].cameras[2]
    positions, _ = camera.project(pixels.rays.at(torch.full((50,), 2.0)))
    column, row = positions.floor().long().T
    assert torch.equal(pixels.colours, images[1].colours[2][row, column].float() / 255)
    assert torch.equal(pixels.mask, images[1].masks[2][row, column])
    observed = pixels.distance.isfinite()
    assert torch.equal(observed, pixels.mask)
    radii = pixels.rays.at(pixels.distance.nan_to_num())[observed].norm(dim=1)
    assert radii.numpy() == pytest.approx(0.55, abs=0.01)
    torch.testing.assert_close(pixels.guide, pixels.distance, equal_nan=True)
    behind = images[1].pixels(2, 50, torch.Generator().manual_seed(0), CPU, hull=True).guide
    both = behind.isfinite() & observed
    assert both.sum() > 0.9 * observed.sum() and bool((behind < pixels.distance + 0.05)[both].all())
    assert float((pixels.distance - behind)[both].max()) > 0.02  # the hull of three masks is larger than the sphere


def test_the_visual_hull_replaces_an_unknown_depth():
    masks = Occupancy(width=0.02, weight=1.0, sphere_radius=1.0, occupied_at="depth")
    by_mask = replace(RGB, losses=replace(LOSSES, silhouette=masks))
    assert by_mask.needs_hull_depth and not RGB.needs_hull_depth
    assert not replace(by_mask, losses=replace(by_mask.losses, depth=1.0)).needs_hull_depth


def test_a_network_learns_which_sphere_an_image_shows(images, renderer, tmp_path):
    model, course = trained(images, renderer, tmp_path / "s", VOLUME, steps=150, shapes_per_step=3, keep_every=1000)
    assert np.mean(course.losses[-10:]) < 0.5 * course.losses[0]
    codes = [model(shape.image(0)[None])[0] for shape in images]
    right = [overlap(model.at(code), shape, CPU) for code, shape in zip(codes, images, strict=True)]
    wrong = [overlap(model.at(codes[2 - index]), shape, CPU) for index, shape in enumerate(images) if index != 1]
    assert min(right) > 0.6 and min(right[0], right[2]) > max(wrong) + 0.2


def test_a_step_over_more_shapes_has_no_larger_loss_and_gradient(images, renderer):
    """The loss is a mean: three equal shapes give the same loss as one."""
    results = []
    for count in (1, 3):
        settings = replace(SETTINGS, shapes_per_step=count)
        training = Training([images[2]] * 3, replace(VOLUME, points=4096), renderer, settings, CPU)
        torch.manual_seed(0)
        model = SingleView(NETWORK)
        loss = training.accumulate_gradients(model, 0, Counts())
        slopes = [parameter.grad for parameter in model.parameters() if parameter.grad is not None]
        results.append((loss, torch.cat([g.flatten() for g in slopes])))
    (once, slope), (thrice, other) = results
    assert thrice == pytest.approx(once, rel=0.1) and other.norm() == pytest.approx(slope.norm().item(), rel=0.3)


@pytest.mark.slow
def test_a_network_learns_from_the_visual_hull_which_sphere_an_image_shows(images, renderer, tmp_path):
    masks = replace(VOLUME, occupancy=0.0, hull=1.0)
    assert not masks.renders
    model, course = trained(images, renderer, tmp_path / "s", masks, steps=150, shapes_per_step=3, keep_every=1000)
    assert course.counts.value == 0
    codes, hulls = [model(shape.image(0)[None])[0] for shape in images], [shape.hull_samples(1) for shape in images]

    def right(code: torch.Tensor, hull: tuple[torch.Tensor, torch.Tensor]) -> float:
        return float(((model.at(code)(hull[0]) < 0) == hull[1]).float().mean())

    assert min(map(right, codes, hulls)) > 0.85
    assert max(right(codes[2], hulls[0]), right(codes[0], hulls[2])) < 0.75


def test_the_hull_comes_first_and_the_renderer_after_it(images, renderer, tmp_path, monkeypatch):
    events = []
    occupancy_loss = Training._occupancy_loss
    monkeypatch.setattr(
        Training, "_occupancy_loss", lambda self, *arguments: events.append("hull") or occupancy_loss(self, *arguments)
    )
    _, course = trained(
        images, renderer, tmp_path / "s", replace(RGB, hull=0.5), progress=lambda *report: events.append(report[1])
    )
    assert events == ["hull", "hull", 1, "hull", "hull", 2, "hull", "hull", 3, 4, 5, 6]
    assert course.counts.value > 0


@pytest.mark.parametrize(("name", "reads"), [("newton", "distance"), ("dvr", "occupancy")])
def test_renderings_train_the_encoder_too(images, name, reads, tmp_path):
    network = replace(NETWORK, reads=reads)
    model, course = trained(images, load("renderer", name), tmp_path / "s", network=network)
    assert len(course.losses) == 6 and np.isfinite(course.losses).all()
    assert course.counts.value > 0 and course.counts.gradient > 0 and course.seconds > 0
    torch.manual_seed(0)
    before = SingleView(network)
    for name_of_weight in ("stages.0.weight", "code.weight", "decoder.first.weight", "decoder.texture_head.weight"):
        assert not torch.equal(model.state_dict()[name_of_weight], before.state_dict()[name_of_weight]), name_of_weight


class Stopped(Exception):
    """Stops a training as a signal would."""


def test_a_stopped_training_ends_with_the_same_weights(images, renderer, tmp_path):
    complete, course = trained(images, renderer, tmp_path / "whole.state")

    def stop(phase: str, step: int, total: int, loss: float | None = None) -> None:
        if step == 5:
            raise Stopped

    state = tmp_path / "stopped.state"
    with pytest.raises(Stopped):
        trained(images, renderer, state, progress=stop)
    steps = []
    again, more = trained(images, renderer, state, progress=lambda phase, step, *rest: steps.append(step))
    assert steps[0] == 5  # the state is saved after the report of each second step
    assert torch.equal(weights(again), weights(complete)) and more.losses == course.losses
    assert more.counts == course.counts
    ended, _ = trained(images, renderer, state, progress=lambda *rest: pytest.fail("trained again"))
    assert torch.equal(weights(ended), weights(complete))  # the state stays until the network is stored
    state.write_bytes(state.read_bytes()[:1000])
    assert torch.equal(weights(trained(images, renderer, state)[0]), weights(complete))


def recipe(renderer, **changed) -> Recipe:
    settings = replace(SETTINGS, steps=4, **changed)
    return Recipe(Spheres(), 3, 3, IMAGING, NETWORK, RGB, settings, renderer, {"training": {"steps": settings.steps}})


def test_a_training_resumes_without_the_gpu_that_it_began_on(images, renderer, tmp_path, monkeypatch):
    state, steps = tmp_path / "begun.state", []
    with monkeypatch.context() as patch:
        patch.setattr("torch.serialization.location_tag", lambda storage: "cuda:0")
        trained(images, renderer, state, steps=2)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    trained(images, renderer, state, progress=lambda phase, step, *rest: steps.append(step))
    assert steps[0] == 3


def test_a_step_that_is_nan_keeps_the_last_state_and_has_a_record(renderer, tmp_path, monkeypatch):
    give = Training.accumulate_gradients

    def spoilt(self, model, step, counts):
        loss = give(self, model, step, counts)
        return float("nan") if step == 3 else loss

    monkeypatch.setattr(Training, "accumulate_gradients", spoilt)
    prepared = recipe(renderer)
    with pytest.raises(TrainingFailed, match=r"at step 3; the state after 2 steps is in .*: lower task\.training"):
        prepared.make(tmp_path, CPU, silent)
    assert list(tmp_path.glob("single_view-*.state")) and prepared.find(tmp_path) is None
    (path,) = tmp_path.glob("single_view-*.json")
    record = json.loads(path.read_text())
    assert record["status"] == "nan" and "not a number at step 3" in record["reason"]


def test_a_network_is_stored_with_its_record_and_found_again(renderer, tmp_path, monkeypatch):
    prepared = recipe(renderer)
    assert prepared.find(tmp_path) is None
    path = prepared.make(tmp_path, CPU, silent)
    assert prepared.find(tmp_path) == path and path.name.startswith("single_view-balls-")
    record = json.loads(path.with_suffix(".json").read_text())
    assert record["status"] == "ok" and record["key"] == prepared.key and record["settings"] == prepared.settings
    assert set(record["validation"]) == {"iou_network", "iou_mean_code"} and 0 < record["validation"]["iou_network"] < 1
    assert record["seconds"]["training"] > 0 and len(record["mean_code"]) == 6
    model, _ = prepared.load(path)
    image = torch.rand(1, 4, 16, 16)
    assert torch.equal(model(image), prepared.load(path)[0](image))
    monkeypatch.setattr("bench.tasks.single_view.store.Training.train", lambda *_: pytest.fail("trained again"))
    assert prepared.make(tmp_path, CPU, silent) == path and not list(tmp_path.glob("*.state"))


def test_a_training_that_is_stopped_after_its_last_step_is_not_lost(renderer, tmp_path, monkeypatch):
    def stop(*_) -> None:
        raise Stopped

    prepared = recipe(renderer)
    with monkeypatch.context() as patched, pytest.raises(Stopped):
        patched.setattr("bench.tasks.single_view.store._training_results", stop)
        prepared.make(tmp_path, CPU, silent)
    monkeypatch.setattr(Training, "accumulate_gradients", lambda *_: pytest.fail("trained again"))
    assert prepared.make(tmp_path, CPU, silent).exists()


def test_neither_training_nor_loading_changes_later_draws(renderer, tmp_path):
    drawn = []
    for _ in range(2):  # the first is trained, and the second is loaded
        torch.manual_seed(5)
        recipe(renderer).load(recipe(renderer).make(tmp_path, CPU, silent))
        drawn.append(torch.rand(1).item())
    torch.manual_seed(5)
    assert drawn == [torch.rand(1).item()] * 2


def test_a_damaged_network_is_refused(renderer, tmp_path):
    prepared = recipe(renderer)
    path = prepared.make(tmp_path, CPU, silent)
    refused = pytest.raises(BadInput, match=r"cannot be read \(.*\): delete it, and train it again")
    with refused:
        replace(prepared, network=replace(NETWORK, width=8)).load(path)
    record = path.with_suffix(".json").read_text()
    path.with_suffix(".json").write_text(record.replace('"filled"', '"other"'))
    with refused:
        prepared.load(path)
    path.with_suffix(".json").write_text(record)
    path.write_bytes(path.read_bytes()[:100])
    with refused:
        prepared.load(path)


def test_the_overlap_is_that_of_volumes(images):
    torch.manual_seed(0)
    model = SingleView(replace(NETWORK, width=128))
    volume = 8 * float((model.at(torch.zeros(6))(images[2].points[: OCCUPANCY_POINTS // 2]) < 0).float().mean())
    radius = (volume * 3 / (4 * np.pi)) ** (1 / 3)
    for shape, true in zip(images, (0.35, 0.55, 0.8), strict=True):
        expected = (min(radius, true) / max(radius, true)) ** 3
        assert overlap(model.at(torch.zeros(6)), shape, CPU) == pytest.approx(expected, abs=0.1)


@each("kind, changed, message", [
    (NETWORK, {"channels": (12,)}, "task.network.channels must be multiples of 8"),
    (NETWORK, {"reads": "density"}, "task.network.reads must be one of occupancy, distance"),
    (RGB, {"hull": 1.5}, "supervision.hull must be a share of the steps, 0 to 1, not 1.5"),
    (RGB, {"losses": replace(LOSSES, colour_gradient=1.0)}, "colour_gradient must be 0: no patches are drawn"),
    (VOLUME, {"occupancy": 0.0}, "supervision has no term after the hull's steps: give a weight"),
])  # fmt: skip
def test_invalid_settings_are_refused(kind, changed, message):
    with pytest.raises(ValueError, match=message):
        replace(kind, **changed)
