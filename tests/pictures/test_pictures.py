"""Pictures of runs: the strip and the film, what galleries are made of, legends that stay within their figure."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from bench.config import load
from bench.evaluate.evaluate import view_metrics
from bench.evaluate.state import State
from bench.pictures.figure_style import legend_below
from bench.pictures.filmstrip import MAX_STRIP_COLUMNS, SILHOUETTE_ROW, Filmstrip, Shown
from bench.pictures.run_figures import InputView, ViewPair, _show_depth, draw_curve, draw_run, enlarged, save_gallery
from bench.report.site.files import PICTURE_TEXTS
from bench.tasks.pose import TRACKED
from bench.tasks.reconstruction.problem import ReconstructionProblem
from datasets.mesh import Mesh
from datasets.scene import Truth, View, see
from renderers.fields.analytic import sphere
from tests.runner.driving import command, record_of
from tests.tasks.reconstruction.test_losses import ball, cast, shot_of
from tests.tiny import ball_prior, camera_of, icosphere, run_of, scene_of

CAMERA = camera_of(16)


@pytest.fixture
def drawn(monkeypatch) -> list[Figure]:
    """The figures that are saved, in place of their files."""
    figures: list[Figure] = []
    monkeypatch.setattr(FigureCanvasAgg, "print_png", lambda canvas, *_, **__: figures.append(canvas.figure))
    return figures


@pytest.fixture
def inputs(tmp_path):
    scene = scene_of(icosphere(0.6, subdivisions=3), CAMERA)
    inputs = run_of(tmp_path, load("renderer", "dist"), ball_prior(), CAMERA, make_scene=lambda: scene).inputs
    return replace(inputs, evaluation=replace(inputs.evaluation, picture=24, grid=48))


@pytest.mark.parametrize("suffix", ["gif", "webp"])
def test_an_animation_has_a_frame_per_checkpoint_and_a_longer_last_one(inputs, tmp_path, suffix):
    filmstrip = Filmstrip(replace(inputs, evaluation=replace(inputs.evaluation, film=suffix)))
    for iteration, radius in enumerate((0.3, 0.45, 0.6)):
        filmstrip.add(iteration, State(sphere(radius), inputs), CAMERA)
    filmstrip.save(tmp_path, "a ball")
    assert f"film.{suffix}" in PICTURE_TEXTS
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
    for iteration in range(3 * MAX_STRIP_COLUMNS):
        filmstrip.add(iteration, State(sphere(0.5), inputs), CAMERA)
    filmstrip.save(tmp_path, "a ball")
    assert [path.name for path in tmp_path.glob("*.*")] == ["strip.png"]
    with Image.open(tmp_path / "strip.png") as strip:
        assert strip.width < 1.35 * 110 * (MAX_STRIP_COLUMNS + 1)


def test_the_chosen_frame_is_shown_with_its_name_in_bold(inputs, tmp_path, drawn):
    filmstrip = Filmstrip(inputs, "by rung")
    for name in range(3 * MAX_STRIP_COLUMNS):
        filmstrip.add(f"rung_{name}", State(sphere(0.5), inputs), CAMERA)
    for own in (0, 1):
        filmstrip.save(tmp_path, "a ball", f"rung_{own}")
        labels = [tick.label2 for tick in drawn[-1].axes[0].xaxis.get_major_ticks()]  # those at the top
        names = [label.get_text() for label in labels]
        assert len(names) == MAX_STRIP_COLUMNS + 1
        assert (names[0], names[-2], names[-1]) == ("rung 0", f"rung {3 * MAX_STRIP_COLUMNS - 1}", "truth")
        assert [label.get_text() for label in labels if label.get_fontweight() == "bold"] == [f"rung {own}"]
        assert sorted(names[:-1], key=lambda name: int(name.split()[1])) == names[:-1]


def test_a_part_of_the_surface_is_called_measured(inputs, tmp_path, drawn):
    filmstrip = Filmstrip(replace(inputs, make_scene=lambda: replace(inputs.scene, is_partial=True)))
    filmstrip.add(0, State(sphere(0.5), inputs), CAMERA)
    filmstrip.save(tmp_path, "a ball")
    assert [tick.label2.get_text() for tick in drawn[-1].axes[0].xaxis.get_major_ticks()] == ["0", "measured"]


def test_nothing_is_drawn_where_pictures_are_off(inputs, tmp_path):
    filmstrip = Filmstrip(replace(inputs, evaluation=replace(inputs.evaluation, picture=None, film="gif")))
    filmstrip.add(0, State(sphere(0.5), inputs), CAMERA)
    filmstrip.save(tmp_path, "a ball")
    assert not list(tmp_path.glob("*.*"))


def photograph(height: int, width: int, *, masked: bool = True) -> Shown:
    """A coloured ball, photographed in another size than that of pictures."""
    shot = shot_of(ball(0.7, (0.0, 0.0, 0.0)), camera_of(16).resized(height, width))
    mask = shot.mask if masked else torch.ones_like(shot.mask)
    return Shown(View(shot.camera, shot.depth, shot.normals, mask), shot.colours, masked)


@pytest.mark.parametrize(("size", "masked"), [((10, 20), True), ((24, 15), False)])
def test_coloured_frames_have_rows_of_what_the_photograph_knows(inputs, tmp_path, drawn, size, masked):
    true = photograph(*size, masked=masked)
    filmstrip = Filmstrip(replace(inputs, evaluation=replace(inputs.evaluation, picture=32)))
    for iteration, radius in enumerate((0.3, 0.7)):
        filmstrip.add(iteration, State(cast(ball(radius, (0.0, 0.0, 0.0)), torch.float32), inputs), true.view.camera)
    filmstrip.save(tmp_path, "a ball", truth=true)
    (figure,) = drawn
    axis = figure.axes[0]
    rows = [label.get_text() for label in axis.get_yticklabels()]
    assert rows == ["colours", "normals", *([SILHOUETTE_ROW] if masked else [])]
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
    assert small.colours is not None and small.colours.shape == (5, 10, 3) and small.has_mask


def test_frames_without_colours_have_no_row_of_them(inputs, tmp_path, drawn):
    for true in (None, photograph(16, 16)):
        filmstrip = Filmstrip(inputs)
        filmstrip.add(0, State(sphere(0.5), inputs), CAMERA)
        filmstrip.save(tmp_path, "a ball", truth=true)
        labels = [label.get_text() for label in drawn[-1].axes[0].get_yticklabels()]
        assert labels == ["normals", SILHOUETTE_ROW]


def half_ball(radius: float) -> Mesh:
    """A ball of which the half towards the camera, at z above 0, is there."""
    whole = icosphere(radius, subdivisions=3)
    return replace(whole, faces=whole.faces[(whole.vertices[whole.faces][..., 2] >= 0).all(axis=1)]).compact()


def test_shapes_are_seen_by_two_cameras_and_depths_where_they_are_given(inputs, tmp_path):
    inputs = replace(inputs, evaluation=replace(inputs.evaluation, gallery=24))
    scene = inputs.scene
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
    pair = ViewPair("truth", view, view, view.mask)
    image = _show_depth(Figure().subplots(), pair, (pair,))
    known = view.depth[view.mask]
    assert image.get_clim() == (known.min(), known.max()) and known.min() < known.max()


def test_a_picture_and_the_metric_compare_silhouettes_alike_where_the_mesh_is_what_is_seen(inputs, tmp_path, drawn):
    """The mesh of a depth image joins the centres of pixels: it is half a pixel smaller than the mask all around."""
    scene = inputs.scene
    unmeasured = torch.arange(256).view(16, 16) == 8 * 16 + 8
    part = replace(scene, mesh=half_ball(0.5), is_partial=True, measured=scene.view.depth.where(~unmeasured, 0.0))
    inputs = replace(inputs, make_scene=lambda: part)
    states = State(sphere(0.3), inputs), State(sphere(0.65), inputs)
    draw_run(tmp_path, states, InputView(scene.view, scene.view.mask.numpy()), [], "a depth image")
    summary = drawn[0].axes[:12]
    for state, axis in zip(states, summary[2:8:4], strict=True):
        missed, spurious = (float(text.get_text().split()[1]) / 100 for text in axis.texts)
        overlap = view_metrics(state.view_from(scene.view.camera), part.view)["mask_iou"]
        assert (1 - missed) / (1 + spurious) == pytest.approx(overlap, abs=0.001)
    assert [axis.axison for axis in summary[8:]] == [True, False, True, False]  # no normals, and no view from behind
    (measured,) = summary[8].get_images()
    given = enlarged(replace(scene.view, mask=scene.view.mask & ~unmeasured), CAMERA.resized(24, 24)).mask
    assert np.isfinite(np.ma.filled(measured.get_array(), np.nan)).sum() == given.sum()
    assert np.isfinite(measured.get_clim()).all()


def test_a_run_writes_them_where_they_are_asked_for(tmp_path):
    small = ("scale=smoke", "evaluation.picture=null", "evaluation.grid=24", "evaluation.points=100", "isolation=off")
    small += ("task.optimiser.iterations=2", "evaluation.gallery=12", f"results_dir={tmp_path}")
    code, out, _ = command("task=deepsdf", *small)
    assert code == 0
    with np.load(f"{out.splitlines()[-1]}/images.npz") as images:
        assert np.isfinite(images["given"]).sum() == record_of(out)["evaluations"]["observed"]
        assert all(images[f"{kind}_hit"].any() for kind in ("start", "found", "true"))


def test_a_legend_wider_than_the_figure_takes_fewer_columns():
    for length, columns in ((3, 4), (30, 2), (300, 1)):
        figure = Figure(figsize=(7, 3), layout="constrained")
        axes = figure.subplots()
        for name in range(8):
            axes.plot([0, 1], [name, name], label=f"{name}".ljust(length, "x"))
        legend_below(figure, axes)
        (legend,) = figure.legends
        assert legend._ncols == columns
        assert legend.get_window_extent().width <= figure.bbox.width or columns == 1


def test_a_curve_has_the_terms_of_the_loss_and_the_first_error_of_checkpoints(drawn, tmp_path):
    known = SimpleNamespace(subject=SimpleNamespace(truth=object()))
    errors = dict.fromkeys((*TRACKED, *ReconstructionProblem.tracked.fget(known)), 1.0)  # type: ignore[misc]
    line = {"iteration": 0, "seconds": 0.1, "value_evaluations": 9, "total": 2.0, "depth": 1.5}
    draw_curve(tmp_path / "curve.png", [line | errors, line | {"iteration": 1}])
    losses, at_checkpoints = drawn[0].axes
    assert [shown.get_label() for shown in losses.lines] == ["total", "depth"]
    assert [shown.get_xydata().tolist() for shown in at_checkpoints.lines] == [[[0.1, 1000.0]]]
    assert at_checkpoints.get_ylabel() == "Chamfer-L1 of what is seen (x1000) at checkpoints"
    draw_curve(tmp_path / "curve.png", [line])
    assert len(drawn[1].axes) == 1
