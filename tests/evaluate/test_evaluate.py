"""What a field is worth against a scene whose truth is known."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from bench.config import load
from bench.evaluate import colours as colours_module
from bench.evaluate.colours import (
    DEFAULT_VERTEX_COLOUR,
    coloured_image,
    colours_at,
    render_image,
    render_vertex_colours,
)
from bench.evaluate.evaluate import (
    DEFINITIONS,
    WORST_SURFACE,
    chamfer_only,
    depth_gap_note,
    evaluate,
    missed_parts_note,
    render_view,
)
from bench.evaluate.refined import newton_step, refined_view
from bench.evaluate.state import REACH, State
from bench.setup.inputs import RunInputs
from bench.solve.solve import note_result
from datasets.scene import Truth, sample_surface
from renderers.camera import Rays
from renderers.field import Kind, Meter
from renderers.fields.analytic import Shape, sphere
from tests.looped import each
from tests.tiny import ball_prior, camera_of, icosphere, run_of, scene_of

RADIUS = 0.6


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> RunInputs:
    """A sphere as the truth, judged with 3,000 samples."""
    camera = camera_of(24, angles=(30.0, 20.0))
    scene = scene_of(icosphere(RADIUS), camera)
    renderer = load("renderer", "naive", steps=40, epsilon=1e-4)
    result = run_of(tmp_path_factory.mktemp("run"), renderer, ball_prior(), camera, make_scene=lambda: scene).inputs
    return replace(result, evaluation=replace(result.evaluation, grid=48, points=3000, fscore_threshold=0.05))


def test_the_truth_itself_scores_best(inputs):
    judgement = evaluate(State(sphere(RADIUS), inputs))
    metrics = judgement.metrics
    assert set(metrics) == set(DEFINITIONS)
    floor = 0.5 * (4 * np.pi * RADIUS**2 / 3000) ** 0.5  # mean distance to the nearest of so many even samples
    assert metrics["accuracy"] == pytest.approx(floor, rel=0.15)
    assert metrics["completeness"] == pytest.approx(floor, rel=0.15)
    assert metrics["fscore"] > 0.99
    assert metrics["normal_consistency"] > 0.99
    assert metrics["depth_mae"] < 3e-3
    assert metrics["mask_iou"] > 0.98
    assert np.linalg.norm(judgement.mesh.vertices, axis=1) == pytest.approx(RADIUS, abs=2e-3)


def test_a_part_of_the_truth_only_judges_whether_it_is_in_the_prediction(inputs):
    whole = inputs.scene.mesh
    half = replace(whole, faces=whole.faces[(whole.vertices[whole.faces][..., 2] > 0).all(axis=1)])
    scene = replace(inputs.scene, mesh=half, is_partial=True)
    state = State(sphere(RADIUS), replace(inputs, make_scene=lambda: scene))
    metrics = evaluate(state).metrics
    assert metrics.keys() & WORST_SURFACE.keys() == {"completeness", "chamfer_gt_to_pred"} and chamfer_only(state) == {}
    assert metrics["completeness"] == pytest.approx(0.5 * (4 * np.pi * RADIUS**2 / 3000) ** 0.5, rel=0.15)


def test_samples_of_the_field_are_one_spacing_apart(inputs):
    state = State(sphere(RADIUS), inputs)
    steps = (state.mesh.vertices + REACH) / state.spacing
    on_samples = np.abs(steps - steps.round()) < 1e-3
    assert (on_samples.sum(axis=1) >= 2).all()  # a vertex of marching cubes lies on an edge between two samples


@dataclass(frozen=True)
class Painted(Shape):
    """A shape whose red is x of the view direction, and whose green is y of the place; both lie in -1 to 1."""

    def colours(self, points, normals, directions):
        return torch.stack([directions[:, 0], points[:, 1], torch.zeros(len(points))], dim=-1) / 2 + 0.5


def test_colours_are_those_seen_along_each_ray_or_from_straight_above(monkeypatch):
    monkeypatch.setattr(colours_module, "POINTS_PER_BATCH", 4)
    points = torch.nn.functional.normalize(torch.randn(10, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    field, device = Painted(sphere(1.0).function), torch.device("cpu")
    for directions in (points.roll(1, dims=0), None):
        seen = -points if directions is None else directions  # from above: inwards
        expected = torch.stack([seen[:, 0], points[:, 1], torch.zeros(10)], dim=-1) / 2 + 0.5
        torch.testing.assert_close(colours_at(field, points, directions, device), expected)


def test_a_volume_shows_the_colours_of_its_surface_where_they_are(inputs):
    field, camera = Painted(sphere(RADIUS).function), inputs.scene.view.camera
    view, image = render_image(field, camera, replace(inputs, renderer=load("renderer", "neus")))
    apart = (image - coloured_image(field, view, torch.device("cpu")))[view.mask].abs()
    assert view.mask.sum() > 50 and apart.mean() < 0.05


def test_a_painted_mesh_has_the_colours_of_its_vertices_and_is_grey_without(inputs):
    mesh, view = inputs.scene.mesh, inputs.scene.view
    image = render_vertex_colours(replace(mesh, colours=mesh.vertices / 2 + 0.5), Truth(mesh), view.camera)
    mask, points = view.mask.numpy(), view.camera.rays().at(view.camera.distance(view.depth)).numpy()
    assert image[mask] == pytest.approx(points[mask] / 2 + 0.5, abs=1e-5) and not image[~mask].any()
    assert (render_vertex_colours(mesh, Truth(mesh), view.camera)[mask] == DEFAULT_VERTEX_COLOUR).all()


def test_the_colour_error_is_the_mean_absolute_difference_over_the_true_surface(inputs):
    scene = replace(inputs.scene, texture=lambda points, normals: np.full_like(points, 0.5))
    painted = Painted(sphere(RADIUS).function)
    error = evaluate(State(painted, replace(inputs, make_scene=lambda: scene))).metrics["colour_error"]
    assert error == pytest.approx((1 / 4 + RADIUS / 4) / 3, rel=0.05)  # |x| of a unit sphere has the mean 1/2


def test_no_renderer_judges_itself(inputs):
    """One that sees a fattened outline, as a large epsilon does, changes its own metrics and no other."""
    fat = replace(inputs, renderer=load("renderer", "idr", epsilon=0.05))
    thin, result = evaluate(State(sphere(RADIUS), inputs)).metrics, evaluate(State(sphere(RADIUS), fat)).metrics
    differing = {name for name in thin if result[name] != thin[name]}
    assert differing == {"own_mask_iou", "own_depth_mae", "own_depth_bias"}
    assert result["own_mask_iou"] < 0.95 < thin["own_mask_iou"]


def test_a_field_is_not_evaluated_outside_the_unit_sphere(inputs):
    corner = sphere(0.3, (1.0, 1.0, 1.0))
    spoilt = evaluate(State(sphere(RADIUS) | corner, inputs))
    assert spoilt.metrics == pytest.approx(evaluate(State(sphere(RADIUS), inputs)).metrics)
    assert np.linalg.norm(spoilt.mesh.vertices, axis=1).max() < 1.0


@each("value", [1.0, float("nan")])
def test_a_field_without_a_surface_scores_worst(inputs, value):
    field = Shape(lambda p: torch.full_like(p[..., 0], value) + 0 * p.sum(-1))
    judgement = evaluate(State(field, inputs))
    assert judgement.mesh is None
    assert judgement.metrics["chamfer_l2"] == judgement.metrics["depth_mae"] == np.inf
    assert judgement.metrics["fscore"] == judgement.metrics["mask_iou"] == 0.0


def test_a_field_that_is_nan_in_a_corner_is_judged_and_noted(inputs, tmp_path):
    corner = Shape(lambda p: torch.where((p > 0.8).all(-1), torch.nan, sphere(RADIUS)(p)))
    judged = evaluate(State(corner, inputs))
    assert judged.metrics == pytest.approx(evaluate(State(sphere(RADIUS), inputs)).metrics)
    run = run_of(tmp_path, inputs.renderer, ball_prior(), camera_of(24))
    note_result(run, judged)
    assert run.record.notes[-1].startswith("warning: the field is NaN at ")


def test_a_state_is_extracted_once_and_its_pictures_ask_for_a_value_per_hit(inputs):
    meter = Meter(sphere(RADIUS))
    state = State(meter, inputs)
    evaluate(state)
    asked = meter.counts.value
    view = refined_view(state, inputs.scene.view.camera)
    assert meter.counts.value - asked == view.mask.sum() == inputs.scene.view.mask.sum()


def test_the_truth_is_sampled_once_in_a_run(inputs, monkeypatch):
    fresh, draws = replace(inputs), []
    monkeypatch.setattr("bench.setup.inputs.sample_surface", lambda *args: draws.append(args) or sample_surface(*args))
    scores = [chamfer_only(State(sphere(radius), fresh))["chamfer_l2"] for radius in (0.5, 0.55, RADIUS)]
    assert len(draws) == 1 and scores == sorted(scores, reverse=True)
    assert scores[2] == evaluate(State(sphere(RADIUS), inputs)).metrics["chamfer_l2"]


@each("scale", [0.1, 1.0, 10.0])
def test_pictures_are_of_the_fields_own_surface_also_where_it_is_no_distance(inputs, scale):
    squares = Shape(lambda p: scale * (p.square().sum(-1) - RADIUS**2), Kind.LEVEL)
    camera = inputs.scene.view.camera
    view, on_mesh = refined_view(State(squares, inputs), camera), State(squares, inputs).view_from(camera)
    points = camera.rays().at(camera.distance(view.depth))[view.mask]
    off = [
        (camera.rays().at(camera.distance(seen.depth))[seen.mask].norm(dim=-1) - RADIUS).abs()
        for seen in (view, on_mesh)
    ]
    assert off[0].median() < 1e-5 < 1e-4 < off[1].median()
    assert off[0].max() < 0.01
    normals = (view.normals[view.mask] * torch.nn.functional.normalize(points, dim=-1)).sum(-1)
    assert normals.min() > 0.99
    assert view.normals[~view.mask].abs().sum() == 0


def dipped(middle: tuple[float, float, float], width: float) -> Shape:
    """The distance to a sphere, with a local dip: a small surface floats where the rest of the field says far."""
    rest = sphere(RADIUS)

    def value(points: torch.Tensor) -> torch.Tensor:
        squares = (points - torch.tensor(middle)).square().sum(-1)
        return rest(points) - 0.5 * torch.exp(-squares / (2 * width**2))

    return Shape(value, lipschitz=None)


def test_a_part_that_the_renderer_misses_is_in_the_picture_and_in_the_record(inputs):
    fine = replace(inputs, renderer=load("renderer", "newton"), evaluation=replace(inputs.evaluation, grid=96))
    camera = camera_of(128)
    scene = replace(inputs.scene, view=State(sphere(RADIUS), fine).view_from(camera))
    fine = replace(fine, make_scene=lambda: scene)
    state = State(dipped((0.8, 0.3, 0.1), 0.03), fine)
    result = evaluate(state)
    assert state.mesh.parts.max() == 1
    floating = refined_view(state, camera).mask & ~scene.view.mask
    assert floating.sum() > 8
    assert not (render_view(state.field, camera, fine).mask & floating).any()
    (note,) = result.notes
    rays = int((state.view_from(camera).mask & ~scene.view.mask).sum())
    assert "misses 1 part of the mesh, at most 0.1" in note and f"{rays} of its rays" in note
    assert evaluate(State(sphere(RADIUS) | sphere(0.1, (0.8, 0.3, 0.1)), fine)).notes == ()


@each("of_renderer, error, noted", [
    (3.95, 0.126, True), (np.inf, 0.126, True), (0.31, 0.1, True), (0.29, 0.1, False),
    (0.0094, 0.003, False),  # of a plane by a shipped renderer: less than a pixel decides it
    (0.5, 0.0, True), (np.inf, np.inf, False),
])  # fmt: skip
def test_a_renderers_own_image_that_shows_another_surface_is_noted(of_renderer, error, noted):
    notes = depth_gap_note({"depth_mae": error, "own_depth_mae": of_renderer, "own_mask_iou": 0.1, "mask_iou": 0.9})
    both = f"is {of_renderer:.3g}, and that of the mesh is {error:.3g} scene units. The renderer does not"
    assert [note.startswith(f"the depth error of the renderer's own image {both}") for note in notes] == [True] * noted
    assert depth_gap_note({"psnr": 20.0, "own_psnr": 3.0}) == depth_gap_note({}) == ()


def test_a_part_that_lies_just_before_another_is_missed_where_the_renderer_sees_the_other(inputs):
    camera = inputs.scene.view.camera
    towards = torch.nn.functional.normalize(camera.center, dim=0)
    state = State(sphere(RADIUS) | sphere(0.1, tuple((0.85 * towards).tolist())), inputs)
    assert missed_parts_note(state, [state.view_from(camera)]) == ()
    (note,) = missed_parts_note(state, [State(sphere(RADIUS), inputs).view_from(camera)])  # 0.15 to 0.35 behind
    assert "misses 1 part of the mesh" in note
    seen = state.view_from(camera)
    odd = seen.mask & (torch.arange(seen.mask.numel()).view_as(seen.mask) % 2 == 1)
    assert missed_parts_note(state, [replace(seen, mask=odd)]) == ()  # of each part some rays hit


@each("scale", [0.01, 1.0, 100.0])
def test_a_hit_moves_to_the_surface_at_most_the_longest_step_but_where_it_grazes(scale):
    plane = Shape(lambda points: scale * points[..., 2], Kind.LEVEL)
    directions = torch.nn.functional.normalize(torch.tensor([[0, 0, -1.0], [1, 0, -1], [1, 0, -0.04]]), dim=-1)
    for off in (0.05, -0.05, 2.0, -2.0):  # before the surface or behind it
        rays = Rays(-3 * directions, directions)
        moved, gradients = newton_step(plane, rays, torch.full((3,), 3.0 - off), longest=0.1)
        step = min(max(off, -0.1), 0.1)
        torch.testing.assert_close(moved - (3.0 - off), torch.tensor([step, step, 0.0]), rtol=0, atol=2e-6)
    torch.testing.assert_close(gradients, scale * torch.tensor([[0.0, 0, 1]]).expand(3, 3))
