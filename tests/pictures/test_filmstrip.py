"""The strip and the film of a run: frames in their order, and none where pictures are off."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from matplotlib.figure import Figure
from PIL import Image

from bench.config import load
from bench.pictures.filmstrip import MOST, SILHOUETTE, Filmstrip, Shown
from datasets.mesh import Mesh
from datasets.scene import Scene, Truth, View, see
from renderers.fields.analytic import sphere
from tests.reconstruct.test_losses import ball, cast, shot_of
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


@pytest.mark.parametrize("own", [0, 1])
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


def photograph(height: int, width: int, *, masked: bool = True) -> Shown:
    """A coloured ball, photographed in another size than that of pictures."""
    shot = shot_of(ball(0.7, (0.0, 0.0, 0.0)), camera_of(16).resized(height, width))
    mask = shot.mask if masked else torch.ones_like(shot.mask)
    return Shown(View(shot.camera, shot.depth, shot.normals, mask), shot.colours, masked)


def drawn_strip(inputs, tmp_path, monkeypatch, true: Shown) -> Figure:
    """The figure of a strip of two coloured frames, seen by the photograph's camera."""
    drawn, pictures = [], replace(inputs, evaluation=replace(inputs.evaluation, picture=32))
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    filmstrip = Filmstrip(pictures, true=true)
    for iteration, radius in enumerate((0.3, 0.7)):
        filmstrip.add(iteration, cast(ball(radius, (0.0, 0.0, 0.0)), torch.float32), true.view.camera)
    filmstrip.save(tmp_path, "a ball")
    return drawn[0]


@pytest.mark.parametrize(("size", "masked"), [((10, 20), True), ((24, 15), False)])
def test_coloured_frames_have_rows_of_what_the_photograph_knows(inputs, tmp_path, monkeypatch, size, masked):
    figure = drawn_strip(inputs, tmp_path, monkeypatch, photograph(*size, masked=masked))
    axis = figure.axes[0]
    rows = [label.get_text() for label in axis.get_yticklabels()]
    assert rows == ["colours", "normals", *([SILHOUETTE] if masked else [])]
    assert ("red missed" in figure.get_suptitle()) == masked
    montage = np.asarray(axis.get_images()[0].get_array())
    height, width = montage.shape[0] / len(rows), montage.shape[1] / 3
    assert height == int(height) and width == int(width)
    labels = [tick.label2.get_text() for tick in axis.xaxis.get_major_ticks()]
    assert labels == ["0", "1", "truth"]
    assert axis.get_xticks() == pytest.approx([width * (place + 0.5) for place in range(3)])
    assert axis.get_yticks() == pytest.approx([height * (place + 0.5) for place in range(len(rows))])
    cells = montage[: int(height)].reshape(int(height), 3, int(width), 3).transpose(1, 0, 2, 3)
    middle = int(height) // 2, int(width) // 2
    assert (cells[0, 2, 2] == 1.0).all() and cells[2, 2, 2] == pytest.approx(0.5)  # on white, and as it was taken
    assert np.abs(cells[1] - cells[2])[middle] == pytest.approx(0.0, abs=0.1)
    if masked:
        errors = montage[2 * int(height) :].reshape(int(height), 3, int(width), 3).transpose(1, 0, 2, 3)
        missed = [((error[..., 0] > 0.7) & (error[..., 1] < 0.4)).sum() for error in errors]
        assert missed[0] > 20 and missed[0] > 5 * max(missed[1:])


def test_a_photograph_is_enlarged_with_its_parts_in_place():
    true = photograph(10, 20)
    large = true.enlarged(true.view.camera.resized(30, 60))
    assert large.colours is not None and true.colours is not None
    assert torch.equal(large.colours[1::3, 1::3], true.colours)
    assert torch.equal(large.view.mask[::3, 2::3], true.view.mask)
    assert torch.equal(large.view.normals[2::3, ::3], true.view.normals)
    assert torch.equal(large.view.depth[2::3, ::3], true.view.depth)
    small = true.enlarged(true.view.camera.resized(5, 10))
    assert small.colours is not None and small.colours.shape == (5, 10, 3) and small.masked


def test_frames_without_colours_have_no_row_of_them(inputs, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    for true in (None, photograph(16, 16)):
        filmstrip = Filmstrip(inputs, true=true)
        filmstrip.add(0, sphere(0.5), CAMERA)
        filmstrip.save(tmp_path, "a ball")
        labels = [label.get_text() for label in drawn[-1].axes[0].get_yticklabels()]
        assert labels == ["normals", SILHOUETTE]
