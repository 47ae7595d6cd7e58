"""The gradient of a silhouette's area: near the truth where a renderer has it, and refused where it has none."""

from dataclasses import replace

import pytest

from bench.config import load
from bench.records.record import RunStatus
from bench.tasks.gradients.area import AreaGradient
from renderers.rendering import Unsupported
from tests.looped import each
from tests.tiny import ball_prior, camera_of, run_of

TASK = AreaGradient(directions=3, draws=6, shift=0.15, supersampling=12)
CAMERA = camera_of(24, angles=(70.0, 20.0))


def metrics_of(folder, renderer: str, rays: int) -> dict[str, float]:
    run = run_of(folder, load("renderer", renderer), ball_prior(), CAMERA)
    scene = replace(run.inputs.scene, rays_per_pixel=rays)
    run = replace(run, inputs=replace(run.inputs, make_scene=lambda: scene))
    TASK.execute(run)
    assert run.record.status is RunStatus.OK
    assert run.record.evaluations["value"] > 24 * 24
    return run.record.metrics


@each("rays, error", [(1, 0.05), (4, 0.03)])
def test_edge_sampling_has_the_gradient_of_the_area(tmp_path, rays, error):
    """Up to the error of the differences, about 0.02."""
    metrics = metrics_of(tmp_path, "edge_sampling", rays)
    assert metrics["area_scale"] == pytest.approx(1, abs=error)
    assert metrics["area_error"] < 2 * error
    assert metrics["area_cosine"] > 0.99
    assert ("area_noise" in metrics) == (rays > 1)


def test_a_band_has_more_noise_and_the_error_contains_it(tmp_path):
    metrics = metrics_of(tmp_path, "relaxed_boundary", 4)
    bias = metrics["area_error"] ** 2 - metrics["area_noise"] ** 2
    assert 0.05 < metrics["area_noise"] <= metrics["area_error"]
    assert bias == pytest.approx(0, abs=0.05)


def test_a_renderer_without_such_a_gradient_is_unsupported(tmp_path):
    with pytest.raises(Unsupported, match="take renderer=edge_sampling"):
        metrics_of(tmp_path, "idr", 1)
