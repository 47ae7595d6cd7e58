"""The gradient of a silhouette's area: near the truth where a renderer has it, and refused where it has none."""

from dataclasses import replace

import pytest
import torch

from bench.config import load
from bench.records.record import RunStatus
from bench.tasks.gradients.area import AreaGradient, _metrics
from bench.tasks.gradients.finite_differences import near_outline
from renderers.rendering import Unsupported
from tests.looped import each
from tests.tiny import ball_prior, camera_of, run_of

TASK = AreaGradient(directions=3, draws=6, shift=0.05, supersampling=24)
CAMERA = camera_of(24, angles=(70.0, 20.0))


def metrics_of(folder, renderer: str, rays: int) -> dict[str, float]:
    run = run_of(folder, load("renderer", renderer), ball_prior(), CAMERA)
    scene = replace(run.inputs.scene, rays_per_pixel=rays)
    run = replace(run, inputs=replace(run.inputs, make_scene=lambda: scene))
    TASK.execute(run)
    assert run.record.status is RunStatus.OK
    assert run.record.evaluations["value"] > 24 * 24
    return run.record.metrics


@each("rays, error", [(1, 0.06), (4, 0.03)])
def test_edge_sampling_has_the_gradient_of_the_area(tmp_path, rays, error):
    metrics = metrics_of(tmp_path, "edge_sampling", rays)
    assert metrics["area_scale"] == pytest.approx(1, abs=error)
    assert metrics["area_bias"] <= 1.5 * error and metrics["area_cosine"] > 0.99
    assert ("area_noise" in metrics) == (rays > 1)


def test_a_band_has_more_noise_than_split_cells(tmp_path):
    noise = {name: metrics_of(tmp_path, name, 4)["area_noise"] for name in ("relaxed_boundary", "edge_sampling")}
    assert noise["relaxed_boundary"] > 5 * noise["edge_sampling"] > 0


def test_metrics_of_two_draws_worked_out_by_hand():
    """The draws (3, 1) and (5, -1) have the mean (4, 0), off the true (0, 4) by (4, -4)."""
    metrics = _metrics(torch.tensor([[3.0, 1.0], [5.0, -1.0]]), torch.tensor([0.0, 4.0]))
    expected = {"area_error": 34**0.5 / 4, "area_bias": 2**0.5, "area_noise": 0.5, "area_scale": 0, "area_cosine": 0}
    assert metrics == pytest.approx(expected)


def test_rays_near_an_outline_are_at_most_so_many_rows_and_columns_away():
    hit = torch.zeros(7, 7, dtype=torch.bool)
    hit[3, 3] = True
    expected = torch.zeros_like(hit)
    expected[1:6, 1:6] = True
    assert torch.equal(near_outline(hit, 2), expected)


def test_a_renderer_without_such_a_gradient_is_unsupported(tmp_path):
    with pytest.raises(Unsupported, match="take renderer=edge_sampling"):
        metrics_of(tmp_path, "idr", 1)
