"""A task does not begin with a renderer that lacks the gradient, or the kind of field, that the task needs."""

import pytest

from bench.config import build
from bench.setup.inputs import FieldChoice
from renderers.field import Kind
from renderers.rendering import Capabilities, Unsupported
from tests.composing import composed
from tests.tiny import Blind, altered, ball_prior, camera_of, icosphere, run_of, scene_of

TASKS = ("ablation", "capacity", "completion", "gradients", "multiview", "pose", "reconstruction", "single_view")


class Picky(Blind):
    """A renderer of level sets, which are no distances."""

    capabilities = Capabilities((Kind.LEVEL,), field_gradient=True, ray_gradient=True)


def execute(name: str, renderer: Blind, folder) -> None:
    task, camera = build(composed(f"task={name}", "scale=smoke").task, "task"), camera_of(12)
    run = run_of(folder, renderer, ball_prior(), camera, make_scene=lambda: scene_of(icosphere(0.5), camera))
    task.execute(altered(run, {"inputs.field": FieldChoice("grid_12", None)} if name == "reconstruction" else {}))


@pytest.mark.parametrize("name", TASKS)
def test_a_renderer_without_the_gradient_of_the_task_is_unsupported(name, tmp_path):
    with pytest.raises(Unsupported, match="Blind has no gradient towards"):
        execute(name, Blind(), tmp_path)


@pytest.mark.parametrize("name", ["ablation", "gradients", "reconstruction"])
def test_a_renderer_of_another_kind_of_field_is_unsupported(name, tmp_path):
    with pytest.raises(Unsupported, match="Picky needs a level field, not a distance field"):
        execute(name, Picky(), tmp_path)
