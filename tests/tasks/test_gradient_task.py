"""How true gradients are said to be, where the answer is known: exact rules, the bias of DIST, and what is left out."""

from dataclasses import dataclass, replace
from math import cos, radians, sqrt
from typing import Any

import pytest
import torch

from bench.config import load
from bench.evaluate.reference import Reference, in_float64
from bench.records.record import RunStatus
from bench.setup.inputs import RunContext
from bench.shape_prior import Prior
from bench.tasks.gradients.task import (
    BANDS,
    DEFINITIONS,
    SAME_SURFACE_DISTANCE,
    Gradients,
    Subject,
    _bands,
    _draw,
    _outline,
)
from renderers.camera import Camera, Rays
from renderers.field import Counts, Kind
from renderers.rendering import Capabilities, Renderer, Rendering
from tests.looped import each
from tests.tiny import ball_prior, camera_of, plane_decoder, run_of

BLURS = (0.003, 0.03)
SETTINGS = Gradients(
    pixels=12, directions=4, outline=10, outline_directions=2, outline_shift=0.1, supersampling=4, blurs=BLURS
)
PRIOR = ball_prior()
SIZE = 24
ALPHA = 1.5
EXACT = {
    "idr": load("renderer", "idr", epsilon=1e-10, steps=400),
    "dvr": load("renderer", "dvr", n_ray_samples=400, refinement_steps=12),
}
HITS = ("frontal", "oblique", "grazing")


def judged(folder: Any, renderer: Any, prior: Prior = PRIOR, camera: Camera | None = None) -> RunContext:
    run = run_of(folder, renderer, prior, camera or camera_of(SIZE, angles=(70.0, 20.0)))
    SETTINGS.execute(run)
    return run


@pytest.fixture(scope="module", params=EXACT)
def exact(request, tmp_path_factory) -> RunContext:
    return judged(tmp_path_factory.mktemp("run"), EXACT[request.param])


def test_an_exact_rule_is_found_exact(exact):
    metrics = exact.record.metrics
    assert exact.record.status is RunStatus.OK
    for band in HITS:
        assert metrics[f"{band}.pixels"] + metrics[f"{band}.excluded"] == SETTINGS.pixels
        assert metrics[f"{band}.pixels"] >= SETTINGS.pixels - 3
        for variable in ("code", "camera"):
            assert metrics[f"{band}.{variable}_cosine"] == pytest.approx(1, abs=1e-9)
            assert metrics[f"{band}.{variable}_pooled_cosine"] == pytest.approx(1, abs=1e-9)
            assert metrics[f"{band}.{variable}_scale"] == pytest.approx(1, abs=1e-6)
            assert metrics[f"{band}.{variable}_pooled_scale"] == pytest.approx(1, abs=1e-6)
            assert metrics[f"{band}.{variable}_median_error"] < 1e-6
            assert metrics[f"{band}.{variable}_p99_error"] < 1e-5


def test_the_gradient_of_colours_is_exact_towards_shape_camera_and_texture(exact):
    metrics = exact.record.metrics
    assert metrics["colour.pixels"] >= SETTINGS.pixels - 3
    for variable in ("code", "camera", "texture"):
        assert metrics[f"colour.{variable}_pooled_cosine"] == pytest.approx(1, abs=1e-6)
        assert metrics[f"colour.{variable}_pooled_scale"] == pytest.approx(1, abs=1e-5)
        assert metrics[f"colour.{variable}_median_error"] < 1e-5


def test_away_from_the_outline_the_gradient_of_hits_is_that_of_the_image():
    prior, camera = plane_prior(50.0, 1.0), camera_of(8, field_of_view=0.5).double()
    numbers = {}
    for name, renderer in (("idr", EXACT["idr"]), ("dist", load("renderer", "dist", epsilon=1e-9, steps=600))):
        subject = Subject(renderer, prior.decoder, prior.codes[0], camera, Counts())
        result = SETTINGS._evaluate_outline(subject, torch.arange(5, 40), torch.eye(3).double())
        numbers[name] = {key.removeprefix("silhouette."): value for key, value in result.items()}
    assert numbers["idr"]["image_cosine"] == pytest.approx(1, abs=1e-6)
    assert numbers["idr"]["image_scale"] == pytest.approx(1, abs=1e-3)
    assert numbers["idr"]["image_error"] < 1e-3
    assert numbers["dist"]["image_cosine"] == pytest.approx(1, abs=1e-4)
    assert numbers["dist"]["image_scale"] == pytest.approx(ALPHA * cos(radians(50)), rel=0.03)


def outline_numbers(renderer: Renderer, supersampling: int) -> dict[str, float]:
    """The metrics at the outline of a ball."""
    settings = replace(SETTINGS, supersampling=supersampling)
    twin = in_float64(PRIOR)
    decoder, code = twin.decoder.requires_grad_(False), twin.codes[0]
    subject = Subject(renderer, decoder, code, camera_of(16, field_of_view=45.0).double(), Counts())
    rays = subject.camera.rays()
    hit = renderer.render(subject.decoder.at(subject.code), rays).hit
    directions = torch.eye(len(code)).double()[:, :2]
    return settings._evaluate_outline(subject, _outline(hit), directions)


def test_a_band_carries_the_gradient_of_the_image_at_the_outline_and_hits_do_not():
    """With many rays per pixel; the narrower band has less bias and more noise in each ray."""
    band = outline_numbers(load("renderer", "relaxed_boundary", band=0.03), 8)
    assert band["silhouette_3e-02.image_cosine"] == band["silhouette.image_cosine"] > 0.95
    assert 0.8 < band["silhouette.image_scale"] < 1.2
    assert band["silhouette_3e-03.image_spread"] > 2 * band["silhouette_3e-02.image_spread"]
    hits = outline_numbers(EXACT["idr"], 8)
    assert hits["silhouette.image_cosine"] < 0.9
    assert hits["silhouette.image_error"] > 2 * band["silhouette.image_error"]
    assert "silhouette_3e-02.image_cosine" not in hits


def test_every_number_has_a_definition_and_every_definition_a_number(exact):
    assert exact.record.definitions == DEFINITIONS
    names = {name.partition(".")[::2] for name in exact.record.metrics}
    defined = [name for key in DEFINITIONS for name in key.split(", ")]
    assert {band for band, _ in names} == {*BANDS, "silhouette", "colour"}
    assert all(band in DEFINITIONS["BAND"] for band, _ in names)
    assert {number for _, number in names} == {*defined} - {"BAND"} and len(defined) == len(set(defined))
    evaluations = exact.record.evaluations
    assert evaluations["value"] > 10 * evaluations["gradient"] > 0
    assert exact.record.metrics["frontal.pixels"] <= evaluations["gradient"] <= 200


def plane_prior(angle: float, slope: float) -> Prior:
    """A plane through the origin, seen at this angle in degrees, whose field rises by `slope` a scene unit."""
    normal = slope * torch.tensor([sqrt(1 - cos(radians(angle)) ** 2), 0.0, cos(radians(angle))])
    weights = slope * torch.tensor([0.3, -0.2, 0.5])
    return Prior(plane_decoder(normal.tolist(), weights.tolist(), 0.0), torch.zeros(1, 3).double())


@each("slope, angle, band", [(0.8, 10.0, "frontal"), (1.0, 50.0, "oblique"), (0.8, 80.0, "grazing")])
def test_the_scale_of_dist_is_alpha_times_the_cosine_times_the_slope(tmp_path, angle, band, slope):
    dist = load("renderer", "dist", alpha=ALPHA, extra_step_cap=None, epsilon=1e-9, steps=600)
    metrics = judged(tmp_path, dist, plane_prior(angle, slope), camera_of(8, field_of_view=0.5)).record.metrics
    assert metrics[f"{band}.pixels"] == SETTINGS.pixels
    for variable in ("code", "camera"):
        expected = ALPHA * cos(radians(angle)) * slope
        assert metrics[f"{band}.{variable}_scale"] == pytest.approx(expected, rel=0.03)  # the angle differs by pixel
        assert metrics[f"{band}.{variable}_median_error"] == pytest.approx(abs(1 - expected), abs=0.02)
        assert metrics[f"{band}.{variable}_cosine"] == pytest.approx(1, abs=1e-6)
    if band == "oblique":  # a plane's normals do not turn with its code: colours move as far as the points do
        assert metrics["colour.code_pooled_scale"] == pytest.approx(ALPHA * cos(radians(angle)), rel=0.03)
        assert metrics["colour.texture_pooled_scale"] == pytest.approx(1, abs=1e-5)


@dataclass
class Changed:
    """A renderer that answers as another one does, but for what is changed."""

    inner: Renderer
    capabilities: Capabilities
    shift: float = 0.0  # of the distance on every other ray

    def render(self, field: Any, rays: Rays) -> Rendering:
        result = self.inner.render(field, rays)
        every_other = torch.arange(rays.shape.numel()) % 2
        return replace(result, distance=result.distance + self.shift * every_other)

    def silhouette_loss(self, *arguments: Any) -> Any:
        return self.inner.silhouette_loss(*arguments)


def test_a_renderer_without_a_gradient_for_rays_has_no_camera_numbers(tmp_path):
    able = Capabilities((Kind.DISTANCE,), field_gradient=True, ray_gradient=False)
    metrics = judged(tmp_path, Changed(EXACT["idr"], able)).record.metrics
    assert "oblique.code_cosine" in metrics and not [name for name in metrics if "camera" in name]


@pytest.mark.slow
def test_pixels_whose_hit_lies_on_another_surface_are_excluded_and_counted(tmp_path):
    metrics = judged(tmp_path, Changed(EXACT["idr"], EXACT["idr"].capabilities, 2.0)).record.metrics
    for band in HITS:
        assert metrics[f"{band}.pixels"] <= SETTINGS.pixels / 2 <= metrics[f"{band}.excluded"]
        assert metrics[f"{band}.pixels"] + metrics[f"{band}.excluded"] == SETTINGS.pixels
        assert metrics[f"{band}.code_median_error"] < 1e-6
    # A bias on the same surface is an error of the renderer, and compared.
    off = judged(tmp_path, Changed(EXACT["idr"], EXACT["idr"].capabilities, -2 * SAME_SURFACE_DISTANCE)).record.metrics
    assert min(off[f"{band}.pixels"] for band in HITS) >= SETTINGS.pixels - 3


def test_bands_are_of_the_angle_between_ray_and_inward_normal():
    camera = camera_of(6).resized(3, 3).double()
    angles = torch.tensor([[0.0, 29.9, 30.1], [69.9, 70.1, 89.9], [90.1, 10.0, 120.0]], dtype=torch.float64).deg2rad()
    directions = camera.rays().directions
    aside = torch.nn.functional.normalize(
        torch.linalg.cross(directions, torch.tensor([0.0, 1.0, 0.0]).double().expand(3, 3, 3)), dim=-1
    )
    normals = -angles.cos()[..., None] * directions + angles.sin()[..., None] * aside
    normals[0, 0] *= 1 + 1e-15  # as rounding may leave it
    hit = torch.ones(3, 3, dtype=torch.bool)
    hit[2, 1] = False
    result = _bands(Reference(torch.ones(3, 3).double(), normals, hit), camera)
    assert {band: pixels.tolist() for band, pixels in result.items()} == {
        "frontal": [0, 1], "oblique": [2, 3], "grazing": [4, 5],
    }  # fmt: skip


def test_the_outline_is_beside_the_outline():
    hit = torch.zeros(5, 6, dtype=torch.bool)
    hit[:, 3:] = True
    assert _outline(hit).tolist() == [6 * row + column for row in range(5) for column in (2, 3)]
    assert _outline(torch.ones(5, 6).bool()).tolist() == _outline(torch.zeros(5, 6).bool()).tolist() == []


def test_pixels_are_drawn_without_repetition_and_by_the_seed():
    pixels = torch.arange(100, 200)
    first, again, other = (_draw(pixels, 30, torch.Generator().manual_seed(seed)).tolist() for seed in (0, 0, 1))
    assert first == again != other and first == sorted(set(first)) and len(first) == 30
    assert _draw(pixels[:5], 30, torch.Generator()).tolist() == pixels[:5].tolist()
