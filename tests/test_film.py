"""The strip and the film of a run: frames in their order, and none where pictures are off."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from matplotlib.figure import Figure
from PIL import Image

from bench.config import load
from bench.film import MOST, Film
from datasets.mesh import Mesh
from datasets.scene import Scene, see
from datasets.truth import Truth
from renderers.fields.analytic import sphere
from tests.tiny import ball_prior, camera_of, cell_of

CAMERA = camera_of(16)


@pytest.fixture
def stage(tmp_path):
    made = trimesh.creation.icosphere(subdivisions=3, radius=0.6)
    mesh = Mesh(np.array(made.vertices), np.array(made.faces))
    scene = Scene("ball", mesh, see(Truth(mesh), CAMERA))
    stage = cell_of(tmp_path, load("renderer", "dist"), ball_prior(), CAMERA, make_scene=lambda: scene).stage
    return replace(stage, evaluation=replace(stage.evaluation, picture=24))


@pytest.mark.parametrize("suffix", ["gif", "webp"])
def test_a_film_has_a_frame_a_look_and_its_end_stays(stage, tmp_path, suffix):
    film = Film(replace(stage, evaluation=replace(stage.evaluation, film=suffix)))
    for iteration, radius in enumerate((0.3, 0.45, 0.6)):
        film.shoot(iteration, sphere(radius), CAMERA)
    film.save(tmp_path, "a ball")
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


def test_a_strip_alone_is_the_default(stage, tmp_path):
    film = Film(stage)
    for iteration in range(3 * MOST):
        film.shoot(iteration, sphere(0.5), CAMERA)
    film.save(tmp_path, "a ball")
    assert [path.name for path in tmp_path.glob("*.*")] == ["strip.png"]
    with Image.open(tmp_path / "strip.png") as strip:
        assert strip.width < 1.35 * 110 * (MOST + 1)


@pytest.mark.parametrize("own", [1, 9, 3 * MOST - 2, 0])
def test_the_frame_that_a_run_comes_to_is_among_those_that_are_shown_in_bold(stage, tmp_path, monkeypatch, own):
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    film = Film(stage, "by rung")
    for name in range(3 * MOST):
        film.shoot(f"rung_{name}", sphere(0.5), CAMERA)
    film.save(tmp_path, "a ball", f"rung_{own}")
    labels = [tick.label2 for tick in drawn[0].axes[0].xaxis.get_major_ticks()]  # those at the top
    names = [label.get_text() for label in labels]
    assert len(names) == MOST + 1
    assert (names[0], names[-2], names[-1]) == ("rung 0", f"rung {3 * MOST - 1}", "truth")
    assert [label.get_text() for label in labels if label.get_fontweight() == "bold"] == [f"rung {own}"]
    assert sorted(names[:-1], key=lambda name: int(name.split()[1])) == names[:-1]


def test_nothing_is_drawn_where_pictures_are_off(stage, tmp_path):
    film = Film(replace(stage, evaluation=replace(stage.evaluation, picture=None, film="gif")))
    film.shoot(0, sphere(0.5), CAMERA)
    film.save(tmp_path, "a ball")
    assert not list(tmp_path.glob("*.*"))
