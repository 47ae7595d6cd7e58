"""The strip and the film of a run: frames in their order, and none where pictures are off."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from matplotlib.figure import Figure
from PIL import Image

from bench.config import load
from bench.pictures.filmstrip import MOST, Filmstrip
from datasets.mesh import Mesh
from datasets.scene import Scene, see
from datasets.truth import Truth
from renderers.fields.analytic import sphere
from tests.tiny import ball_prior, camera_of, run_of

CAMERA = camera_of(16)


@pytest.fixture
def inputs(tmp_path):
    made = trimesh.creation.icosphere(subdivisions=3, radius=0.6)
    mesh = Mesh(np.array(made.vertices), np.array(made.faces))
    scene = Scene("ball", mesh, see(Truth(mesh), CAMERA))
    inputs = run_of(tmp_path, load("renderer", "dist"), ball_prior(), CAMERA, make_scene=lambda: scene).inputs
    return replace(inputs, evaluation=replace(inputs.evaluation, picture=24))


@pytest.mark.parametrize("suffix", ["gif", "webp"])
def test_an_animation_has_a_frame_per_checkpoint_and_a_longer_last_one(inputs, tmp_path, suffix):
    filmstrip = Filmstrip(replace(inputs, evaluation=replace(inputs.evaluation, film=suffix)))
    for iteration, radius in enumerate((0.3, 0.45, 0.6)):
        filmstrip.add(iteration, sphere(radius), CAMERA)
    filmstrip.save(tmp_path, "a ball")
    with Image.open(tmp_path / f"film.{suffix}") as moving:
        assert moving.n_frames == 3
        assert moving.size == (48, 24)
        moving.seek(0)
        first = np.asarray(moving.convert("RGB"), dtype=float)
        moving.seek(2)
        last = np.asarray(moving.convert("RGB"), dtype=float)
    red = lambda image: ((image[:, 24:, 0] > 180) & (image[:, 24:, 1] < 90)).sum()  # noqa: E731
    assert red(first) > 20 > red(last)  # what is lost of the silhouette
    assert (tmp_path / "strip.png").is_file()


def test_a_strip_alone_is_the_default(inputs, tmp_path):
    filmstrip = Filmstrip(inputs)
    for iteration in range(3 * MOST):
        filmstrip.add(iteration, sphere(0.5), CAMERA)
    filmstrip.save(tmp_path, "a ball")
    assert [path.name for path in tmp_path.glob("*.*")] == ["strip.png"]
    with Image.open(tmp_path / "strip.png") as strip:
        assert strip.width < 1.35 * 110 * (MOST + 1)


@pytest.mark.parametrize("own", [1, 9, 3 * MOST - 2, 0])
def test_the_chosen_frame_is_shown_with_its_name_in_bold(inputs, tmp_path, monkeypatch, own):
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    filmstrip = Filmstrip(inputs, "by rung")
    for name in range(3 * MOST):
        filmstrip.add(f"rung_{name}", sphere(0.5), CAMERA)
    filmstrip.save(tmp_path, "a ball", f"rung_{own}")
    labels = [tick.label2 for tick in drawn[0].axes[0].xaxis.get_major_ticks()]  # those at the top
    names = [label.get_text() for label in labels]
    assert len(names) == MOST + 1
    assert (names[0], names[-2], names[-1]) == ("rung 0", f"rung {3 * MOST - 1}", "truth")
    assert [label.get_text() for label in labels if label.get_fontweight() == "bold"] == [f"rung {own}"]
    assert sorted(names[:-1], key=lambda name: int(name.split()[1])) == names[:-1]


def test_nothing_is_drawn_where_pictures_are_off(inputs, tmp_path):
    filmstrip = Filmstrip(replace(inputs, evaluation=replace(inputs.evaluation, picture=None, film="gif")))
    filmstrip.add(0, sphere(0.5), CAMERA)
    filmstrip.save(tmp_path, "a ball")
    assert not list(tmp_path.glob("*.*"))
