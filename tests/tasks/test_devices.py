"""The loop of a task makes no tensor without a device: with another default device, it stays on that of the run."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bench.config import build, load
from bench.setup.inputs import FieldChoice
from bench.solve.optimise import History, Optimisable, OptimiserSettings, optimise
from bench.tasks.pose import Pose, PoseProblem
from bench.tasks.reconstruction.subject import Depths
from bench.tasks.single_view.training import Training
from datasets.scene import Scene
from renderers.fields.analytic import sphere
from tests.composing import composed
from tests.tasks.single_view.test_training import NETWORK, RGB, SETTINGS, images  # noqa: F401, a fixture
from tests.tiny import CPU, altered, ball_prior, camera_of, icosphere, run_of, scene_of, silent

CASES = {
    "completion": ("task.points=50",),
    "multiview": ("task.starts=2",),
    "deepsdf": ("task.points=50",),
    "prior_fit": ("task.distances=500", "task.batch=200"),
    "pose": ("task.starts=2", "task.normal_weight=1"),
}
ADAM = OptimiserSettings(iterations=3, learning_rate=0.01, schedule="cosine")


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A ball of radius 0.5, seen in 24 x 24 pixels."""
    return scene_of(icosphere(0.5, subdivisions=3), camera_of(24, angles=(30.0, 20.0)))


@pytest.mark.parametrize("name", CASES)  # with other renderers: tests/renderers/test_devices.py
def test_the_loop_stays_on_the_device_of_its_run(scene, name):
    config = composed(f"task={name}", "scale=smoke", "task.optimiser.iterations=50", *CASES[name])
    task, tested = build(config.task, "task"), load("renderer", "newton")
    if isinstance(task, Pose):
        problem = PoseProblem(task, tested, sphere(0.5), scene.view, task.cameras(scene.view.camera, 0), CPU)
    else:
        problem = task.problem(scene, ball_prior(radius=0.45), tested, seed=0, device=CPU)
    check(problem)


@pytest.mark.parametrize("renderer", ["dvr", "newton"])
def test_a_reconstruction_stays_on_the_device_of_its_run(scene, tmp_path, renderer):
    weights = [f"task.losses.{name}=1" for name in ("colour_gradient", "depth", "smoothness", "normals")]
    config = composed("task=reconstruction", "scale=smoke", "task.longest=24", "task.rays=64", *weights)
    task, tested = build(config.task, "task"), load("renderer", renderer)
    run = run_of(tmp_path, tested, ball_prior(), camera_of(24), make_scene=lambda: scene)
    run = altered(run, {"inputs.field": FieldChoice("network_2x16", None)})
    subject = replace(task, depths=Depths("20%", 0.01)).subject(run.inputs)
    check(task.problem(run.inputs.field.name, subject, run))


@pytest.mark.parametrize(("renderer", "reads"), [("newton", "distance"), ("dvr", "occupancy")])
def test_a_training_from_images_stays_on_its_device(images, tmp_path, renderer, reads):  # noqa: F811
    supervision = replace(RGB, hull=0.5, occupancy=1.0, losses=replace(RGB.losses, depth=1.0))
    settings, network = replace(SETTINGS, steps=4), replace(NETWORK, reads=reads)
    torch.set_default_device("meta")
    try:
        training = Training(images, supervision, load("renderer", renderer), settings, CPU)
        model, course = training.train(network, tmp_path / "state", silent)
    finally:
        torch.set_default_device(None)
    assert len(course.losses) == 4 and np.isfinite(course.losses).all()
    assert all(parameter.device == CPU and parameter.isfinite().all() for parameter in model.parameters())


def check(problem: Optimisable) -> None:
    """Optimises a problem where tensors that name no device have no data."""
    history = History()
    torch.set_default_device("meta")  # what is made on it by mistake cannot meet what the run has made
    try:
        optimise(problem, ADAM, CPU, history=history, on_step=lambda line: None)
    finally:
        torch.set_default_device(None)
    assert len(history.curve) == ADAM.iterations
    assert all(parameter.device == CPU and parameter.isfinite().all() for parameter in problem.parameters)
