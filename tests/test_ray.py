"""The command bench.ray: what it records on a ray, its sentences on shapes with known hits, its picture and errors."""

import math
import re
from dataclasses import replace
from math import cos, radians, sin
from pathlib import Path
from typing import Any

import pytest
import torch

from bench.config import load
from bench.evaluate.along_ray import Lane, Recorder, TrueRay, follow, sentences, true_ray
from bench.evaluate.ray_derivatives import Derivatives, Parameters, true_derivatives, with_renderer
from bench.pictures.ray import LanePanel, RayPicture
from bench.ray import main, window_of
from bench.records.record import read_record
from bench.report.data.runs import Runs
from bench.report.site.files import Folder
from bench.report.site.rays import MAX_RAYS, rays
from bench.studies.stability import READS, first_trials
from renderers.camera import Rays
from renderers.field import Field, Kind
from renderers.fields.analytic import Shape, box, plane, sphere
from renderers.rendering import DISTANCE_CAPABILITIES, Renderer, Rendering, Status
from tests.runner.driving import command, stored

SMALL = ("scale=smoke", "view.resolution=12", "threads=1")
PLATE = box((0.5, 0.5, 0.0125)) | sphere(0.2, (0, 0, 0.6))
DIST_WITHOUT_CAP = replace(load("renderer", "dist"), alpha=1.5, extra_step_cap=None)


def ray(*, tilt: float = 0.0, dtype: torch.dtype = torch.float32) -> Rays:
    """A ray from z = -2.5 along the axis z, tilted downwards by an angle in degrees about the origin."""
    direction = torch.tensor([[0.0, -sin(radians(tilt)), cos(radians(tilt))]], dtype=dtype)
    return Rays(-2.5 * direction, direction)


def looked_at(renderer: Renderer, field: Field, tilt: float = 0.0) -> tuple[Lane, TrueRay, str]:
    """What a renderer does on the ray, the truth, and the sentences."""
    truth = true_ray(field, ray(tilt=tilt, dtype=torch.float64), lipschitz=1.2, tolerance=3e-3)
    lane = follow("dist", "DIST", renderer, field, ray(tilt=tilt))
    return lane, truth, sentences(lane, truth)


class Altered:
    """Newton, whose gradient is multiplied by a factor; None detaches it."""

    capabilities = DISTANCE_CAPABILITIES

    def __init__(self, factor: float | None) -> None:
        self.inner, self.factor = load("renderer", "newton"), factor

    def render(self, field: Field, rays: Rays) -> Rendering:
        rendering = self.inner.render(field, rays)
        fixed = rendering.distance.detach()
        factor = self.factor
        return replace(rendering, distance=fixed if factor is None else fixed + factor * (rendering.distance - fixed))

    def silhouette_loss(self, field: Field, rays: Rays, rendering: Rendering, mask: torch.Tensor) -> torch.Tensor:
        return self.inner.silhouette_loss(field, rays, rendering, mask)


class WithoutGradient(Altered):
    """Newton without a gradient, which says so."""

    capabilities = replace(DISTANCE_CAPABILITIES, field_gradient=False)


def derivatives_on_a_sphere(renderer: Renderer, *, of_radius: bool = True, x: float = 0.3) -> Derivatives:
    """The derivatives on a ray along z that passes the centre of a sphere of radius 0.5 at a distance x."""

    def field_at(radius: torch.Tensor) -> Field:
        return sphere(radius[0])

    radius = torch.tensor([0.5], dtype=torch.float64)
    by_radius, shape = Parameters.of_field(["radius"], radius, field_at, field_at), sphere(0.5)
    parameters = by_radius if of_radius else Parameters.of_translation(shape, shape)
    rays = Rays(torch.tensor([[x, 0.0, -2.5]]), torch.tensor([[0.0, 0.0, 1.0]]))
    exact = Rays(torch.tensor([[x, 0.0, -2.5]], dtype=torch.float64), rays.directions.double())
    true = true_derivatives(parameters, exact, 2.5 - (0.25 - x**2) ** 0.5, 1.2)
    return with_renderer(true, renderer, parameters, rays)


def test_derivatives_on_a_sphere_are_the_exact_ones():
    by_radius = derivatives_on_a_sphere(load("renderer", "newton"))
    assert by_radius.true == [pytest.approx(-0.5 / 0.4, rel=1e-7)] and by_radius.verdict == "They agree within 1 %."
    assert by_radius.computed == (pytest.approx(-1.25, rel=1e-4),)
    moved = derivatives_on_a_sphere(load("renderer", "newton"), of_radius=False)
    exact = {"shift x": -0.75, "shift y": 0.0, "shift z": 1.0}  # the normal over its component along the ray
    assert dict(zip(moved.names, moved.true, strict=True)) == pytest.approx(exact, abs=1e-7)
    assert dict(zip(moved.names, moved.computed, strict=True)) == pytest.approx(exact, abs=1e-4)


def test_a_wrong_or_missing_gradient_is_stated():
    scaled = derivatives_on_a_sphere(Altered(0.5))
    assert scaled.error == pytest.approx(0.5, rel=1e-3) and scaled.pairs == ["radius -0.625 (-1.25)"]
    assert scaled.sentences.endswith("They are 0.5 times those of the reference.")
    detached = derivatives_on_a_sphere(Altered(None))
    assert detached.error == 1 and detached.verdict.endswith("towards the field, but its distance has none.")
    unable = derivatives_on_a_sphere(WithoutGradient(None))
    assert unable.pairs == ["radius – (-1.25)"] and unable.sentences == "It states no gradient towards the field."
    missed = derivatives_on_a_sphere(load("renderer", "dvr", n_ray_samples=8), x=0.4999)
    assert missed.computed == () and missed.sentences == "Without a hit, its distance has no derivative."


def test_a_hit_that_jumps_within_a_step_has_no_derivative():
    assert math.isnan(derivatives_on_a_sphere(load("renderer", "newton"), x=0.5 - 1e-8).true[0])


def test_the_truth_has_the_chord_of_a_sphere_and_the_angle_of_a_plane():
    truth = true_ray(sphere(0.5), ray(dtype=torch.float64), lipschitz=1.2, tolerance=1e-3)
    assert (truth.entry, truth.leave, truth.hit) == pytest.approx((1.5, 3.5, 2.0), abs=1e-9)
    assert truth.spans == [pytest.approx((2.0, 3.0), abs=1e-9)] and truth.angle == pytest.approx(90, abs=1e-3)
    tilted = true_ray(plane(), ray(tilt=20, dtype=torch.float64), lipschitz=1.2, tolerance=1e-3)
    assert (tilted.hit, tilted.angle) == pytest.approx((2.5, 20.0), abs=1e-6)
    assert tilted.first_span == pytest.approx((2.5, 3.5), abs=1e-9)  # inside until it leaves the sphere


def test_evaluations_on_the_ray_are_noted_in_order_and_once():
    recorder = Recorder(sphere(0.5), ray())
    recorder(ray().at(torch.tensor([1.5])))
    recorder(ray().at_each(torch.tensor([3.0, 2.0, 1.5, 2.0]))[0])
    recorder(torch.tensor([[0.0, 0.0, 0.25], [0.0, 2e-5, 0.5]]))
    assert recorder.calls == [[1.5], [3.0, 2.0], [2.75]]
    lane = Lane("dist", "", [[1.0], [3.0, 2.0, 2.5], [2.25]], 2.2, Status.HIT, 0.0, True, None)
    assert lane.samples == [2.0, 2.5, 3.0] and lane.evaluations == [1.0, 3.0, 2.0, 2.5, 2.25]


def test_a_long_step_goes_through_a_thin_plate_and_newton_hits_it():
    lane, truth, text = looked_at(DIST_WITHOUT_CAP, PLATE)
    assert truth.hit == pytest.approx(2.4875) and lane.hit is not None and lane.hit > 2.8
    step = 1.5 * 0.9875
    assert f"Step 1 went through the surface: the shape is 0.025 thick along the ray, the step {step:.2g} " in text
    assert f" It hit {2.9 - 2.4875:.2g} behind the surface." in text  # the sphere behind the plate begins at 2.9
    newton, truth, text = looked_at(load("renderer", "newton"), PLATE)
    assert newton.agrees(truth) and newton.hit == pytest.approx(2.4875, abs=1e-6) and "through" not in text


def test_samples_farther_apart_than_a_plate_is_thick_miss_it():
    lane, truth, text = looked_at(load("renderer", "dvr", n_ray_samples=16), box((0.5, 0.5, 0.004)))
    assert len(lane.samples) == 16 and lane.hit is None and not lane.agrees(truth)
    assert re.match(r"None of 16 samples, 0\.1\d* apart, fell into the shape, 0\.008 thick along the ray\.", text)
    assert text.endswith("It missed.")


def test_a_volume_spreads_its_weights_on_a_slanted_plane():
    lane, truth, text = looked_at(load("renderer", "neus"), plane(), tilt=15)
    assert lane.weights is not None and lane.agrees(truth) and "since the ray meets the surface at 15.0 degrees" in text
    frontal, truth, text = looked_at(load("renderer", "neus"), plane((0, 0, -1.0)))
    assert frontal.weights is not None and "degrees" not in text
    assert sum(lane.extent(2.5)) > 2 * sum(frontal.extent(2.5))  # over 1 / sin 15 degrees without other errors


def test_a_miss_and_a_residual_are_stated():
    text = looked_at(load("renderer", "dist"), sphere(0.3, (0, 0.5, 0)))[2]
    assert text.endswith("It missed. The reference has no hit.")
    lane, truth, text = looked_at(load("renderer", "dist", epsilon=0.01), plane(), tilt=15)
    remaining = lane.residual / sin(radians(15)) - lane.residual  # the last step is as long as the residual
    assert text.endswith(f"It hit {remaining:.2g} before the surface. Its residual is {lane.residual:.2g}.")
    assert not lane.agrees(truth)


def test_the_panels_below_the_slice_share_the_distance_and_show_the_whole_ray_if_a_renderer_is_far_off():
    lane, truth, text = looked_at(DIST_WITHOUT_CAP, PLATE)
    assert window_of([lane], truth, None) == (truth.entry, truth.leave)
    right, truth, _ = looked_at(load("renderer", "dvr"), PLATE)
    low, high = window_of([right], truth, None)
    assert low < 2.4875 < high and high - low < 0.1 and window_of([right], truth, 0) == (truth.entry, truth.leave)
    figure = RayPicture("", "", PLATE, ray(), truth, (low, high), [LanePanel(lane, text), LanePanel(right, "")]).draw()
    assert [axes.get_xlim() for axes in figure.axes[1:]] == [pytest.approx((low, high))] * 3
    assert figure.axes[0].get_xlim() == pytest.approx((1.5, 3.5))


def test_the_command_writes_a_picture_of_the_pixel_where_the_first_renderer_is_most_wrong(tmp_path):
    scene = ("task=stability", "stress=thin_plate", "task.resolution=16", "level=0.8", "threads=1")
    renderers = "renderer=dist_aggressive_unclamped,newton"
    code, out, err = command(*scene, renderers, f"into={tmp_path / 'new' / 'a.png'}", main=main)
    assert (code, err) == (0, "") and "where dist_aggressive_unclamped is off most: by 1 " in out
    assert "1 of 2 renderers right within 0.006 scene units; wrong: dist_aggressive_unclamped\n" in out
    path = Path(out.splitlines()[-1])
    assert path == tmp_path / "new" / "a.png" and path.stat().st_size > 10_000 and path.with_suffix(".pdf").is_file()


def test_the_picture_is_in_the_results_folder_unless_into_names_another_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = command(*SMALL, "dataset=torus", "pixel=6,5", "renderer=newton", "results_dir=mine", main=main)
    assert (code, err) == (0, "") and out.splitlines()[-1] == "mine/ray.png"
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_a_hit_before_a_near_surface_is_wrong_though_its_error_is_small(tmp_path):
    scene = ("task=stability", "stress=near_camera", "task.resolution=16", "level=1", "threads=1")
    code, out, _ = command(*scene, "renderer=dist", f"into={tmp_path / 'a'}", main=main)
    assert code == 0 and "0 of 1 renderer right" in out and "its residual is 1e-5" in out.lower()


@pytest.mark.parametrize(("scene", "parameter"), [
    (("dataset=torus",), "minor"), (("dataset=sofa", "split=train"), "code["), (("dataset=car",), "width"),
])  # fmt: skip
def test_the_command_draws_formulas_and_networks(tmp_path, scene, parameter):
    code, out, err = command(*SMALL, *scene, "pixel=6,5", "renderer=newton", f"into={tmp_path / 'a'}", main=main)
    assert (code, err) == (0, "") and "1 of 1 renderer right within" in out
    assert parameter in out.partition("Derivatives of the distance")[2] and "They agree within 1 %." in out


@pytest.mark.parametrize(("arguments", "message"), [
    (("renderer=newtn",), "did you mean newton?"),
    (("pixel=12,3",), "pixel=12,3 is outside the image of 12 columns and 12 rows"),
    (("pixel=0,0",), "misses the unit sphere that contains the scene: the middle is pixel=6,6"),
    (("pixel=3",), "type pixel=31,40"),
    (("dataset=torus", "pixels=worst"), "type RUN_FOLDER pixels=worst"),
    (("dataset=torus,box",), "dataset has several values"),
    (("field=torus",), "a scene's shape is dataset=torus"),
    (("task=stability", "stress=learning_rate"), "type stress=thin_plate"),
])  # fmt: skip
def test_wrong_arguments_are_one_line_with_a_remedy(arguments, message):
    code, _, err = command(*SMALL, *arguments, main=main)
    assert code == 2 and message in err and err.startswith("error: ") and err.count("\n") == 1


def test_a_run_folder_must_be_of_an_ablation(tmp_path):
    folder = stored(tmp_path, "run")
    for arguments, message in (
        ((str(folder),), "is a run of task=completion, not of task=ablation: field=file field_path="),
        ((str(folder), "renderer=idr"), "states its scene and renderer: remove renderer=idr"),
        ((str(tmp_path),), "has no record.json: name the folder of a run"),
    ):
        code, _, err = command(*arguments, main=main)
        assert code == 2 and message in err


@pytest.mark.slow
def test_a_run_of_an_ablation_is_shown_as_it_was_rendered(tmp_path):
    settings = ("task=ablation", "dataset=sofa", "split=train", "+task.size=16", "renderer=newton")
    made = command(*SMALL, *settings, "isolation=off", f"results_dir={tmp_path}")
    code, out, err = command(made.out.splitlines()[-1], f"into={tmp_path / 'a.png'}", "pixel=11,8", main=main)
    assert (code, err) == (0, "") and "sofa train 0, a network; pixel=11,8" in out and "newton" in out
    code, out, err = command(made.out.splitlines()[-1], "pixels=worst", main=main)
    drawn = rays_of(made.out.splitlines()[-1], tmp_path)
    assert code == 0 and len(drawn) == MAX_RAYS and drawn[0]["text"]


@pytest.mark.slow
def test_a_run_of_a_stress_is_shown_at_a_level(tmp_path):
    settings = ("task=stability", "stress=thin_plate", "renderer=dist")
    made = command("scale=smoke", "threads=1", *settings, "isolation=off", f"results_dir={tmp_path}")
    folder = made.out.splitlines()[-1]
    code, out, err = command(folder, "level=1", f"into={tmp_path / 'a.png'}", main=main)
    assert (code, err) == (0, "") and "thin plate at 0.000500 scene units thick" in out and "wrong: dist" in out
    assert command(folder, "level=1", "pixels=worst", main=main).code == 0 and rays_of(folder, tmp_path)
    record = read_record(Path(folder)) | {"folder": Path(folder).name}
    tried = first_trials(Runs(READS[0], tmp_path, []), record)
    assert {*tried.values()} == {True, False}
    for level in (max(level for level in tried if tried[level]), min(level for level in tried if not tried[level])):
        out = command(folder, f"level={level}", f"into={tmp_path / 'b.png'}", main=main).out
        assert ("wrong: dist" in out) is not tried[level]


def rays_of(folder: str, results: Path) -> list[dict[str, Any]]:
    """The rays of a run as its page lists them."""
    shown = rays(read_record(Path(folder)), Folder(results, Path(folder).name))
    assert shown is not None and shown["map"]
    return shown["rays"]


def test_a_field_that_a_renderer_cannot_render_is_named():
    level = Shape(sphere(0.5).function, kind=Kind.LEVEL)
    with pytest.raises(ValueError, match=r"renderer=dist: .* needs a distance or bound field"):
        follow("dist", "", load("renderer", "dist"), level, ray())


@pytest.mark.parametrize("name", ["range_analysis", "mesh_proxy_48"])
def test_evaluations_of_a_renderer_without_steps_are_not_called_steps(name):
    assert "Step" not in looked_at(load("renderer", name), PLATE)[2]
