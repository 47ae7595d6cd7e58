"""Compares a renderer's gradients with central differences in float64, by angle of incidence."""

from dataclasses import dataclass, replace
from math import cos, radians
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bench.evaluate.reference import RADIUS, Reference, in_float64, reference_for
from bench.records.record import RunStatus
from bench.setup.inputs import RunContext, RunInputs
from bench.solve.solve import check_field_gradient
from bench.tasks.gradients.finite_differences import (
    Paint,
    differences,
    image_differences,
    near_outline,
    orthogonal_directions,
    outline_steps,
    subrays,
)
from renderers.boundary import check_gradients, render_checked
from renderers.camera import Camera, Rays, sphere_span
from renderers.checks import check_at_least, check_positive
from renderers.field import Counts, Field, Meter, estimate_lipschitz, gradients_at
from renderers.fields.mlp import Decoder
from renderers.rendering import Blurred, Renderer, Rendering, check_kind

BANDS = {"frontal": (0.0, 30.0), "oblique": (30.0, 70.0), "grazing": (70.0, 90.0)}  # degrees of incidence
SAME_SURFACE_DISTANCE = 0.01  # scene units: a closer hit is on the true hit's surface
POINTS_BETWEEN = 32  # for farther hits, the field is checked at these points between the hit and the true one

DEFINITIONS = {
    "BAND": "angle between ray and inward normal: frontal to 30 degrees, oblique to 70, grazing beyond; silhouette: "
    "pixels next to the outline; colour: frontal and oblique pixels, of which not distances but colours are compared, "
    "a row per pixel and channel (DVR, Eqs. 3 to 8): those of a random smooth paint of the point and the normal there",
    "pixels, excluded": "pixels evaluated; pixels drawn but not evaluated, since visibility changes there, the root is "
    "not found again, or the renderer hits nothing or another surface; a hit that is off on the same surface counts",
    "code_cosine, camera_cosine": "cosine between a pixel's gradient of distance and the true one, median over pixels; "
    "code: along task.directions orthogonal directions, camera: six rigid motions (scene units, radians)",
    "code_pooled_cosine, camera_pooled_cosine": "cosine between the concatenated gradients of all pixels of the band "
    "and the true ones: a scale that differs between pixels lowers it",
    "code_pooled_scale, camera_pooled_scale": "component of the concatenated gradients along the true ones over the "
    "length of the true ones",
    "code_scale, camera_scale": "component of the gradient along the true one over the length of the true one, median "
    "over pixels",
    "code_median_error, code_p99_error, camera_median_error, camera_p99_error": "length of the difference over the "
    "length of the true gradient: median and 99th percentile over pixels",
    "texture_cosine, texture_pooled_cosine, texture_pooled_scale, texture_scale, texture_median_error, "
    "texture_p99_error": "the same towards the weights of the paint",
    "image_cosine, image_scale, image_error": "pooled cosine, scale and relative error of the gradient of the image of "
    "distances, with the far side of the unit sphere as background, for the code, against differences of a "
    "supersampled image, in which visibility changes; a pixel is the mean over task.supersampling^2 rays",
    "image_spread": "standard deviation of that gradient between the rays of a pixel, over the length of the true one: "
    "of one ray per pixel, it is the noise",
    "values_per_ray": "field values per ray that this gradient takes",
}


@dataclass(frozen=True)
class Gradients:
    """Compares gradients of distance with central differences, at a training shape of the prior, in float64.

    Args:
        pixels: number of pixels drawn in each band of angles.
        directions: number of random orthogonal directions of the code.
        outline: number of pixels drawn next to the outline.
        outline_directions: number of directions of the code for the outline.
        outline_shift: distance in pixels by which a step of the code moves most of the outline, to either side.
        supersampling: rays per side of a pixel next to the outline.
        blurs: blurs, in scene units, at which a renderer with a blur is also compared next to the outline.
    """

    pixels: int
    directions: int
    outline: int
    outline_directions: int
    outline_shift: float
    supersampling: int
    blurs: tuple[float, ...]

    def __post_init__(self) -> None:
        for name in ("pixels", "directions", "outline", "outline_directions", "supersampling"):
            check_at_least(f"task.{name}", getattr(self, name), 1, "conf/task/gradients.yaml holds values that work")
        for blur in self.blurs:
            check_positive("task.blurs", blur, "[0.001, 0.01, 0.1]")
            if float(f"{blur:.0e}") != blur:
                raise ValueError(f"task.blurs must have one digit each, not {blur:g}: it is part of a metric's name")
        check_positive("task.outline_shift", self.outline_shift, "0.1 moves it within a pixel")

    def check(self, inputs: RunInputs) -> None:
        """Raises BadInput without a network that was fitted to the scene's shape."""
        inputs.check_fitted()

    def execute(self, run: RunContext) -> None:
        inputs, record = run.inputs, run.record
        record.definitions = DEFINITIONS
        prior = in_float64(inputs.fitted())
        reference = reference_for(inputs.fitted(), inputs.scene.view.camera, inputs.cache)
        subject = Subject(
            inputs.renderer,
            prior.decoder.requires_grad_(False),
            prior.codes[0],
            inputs.scene.view.camera.double(),
            Counts(),
        )
        check_kind(inputs.renderer, prior.decoder.at(prior.codes[0]))
        check_field_gradient(inputs.renderer)
        generator = torch.Generator().manual_seed(inputs.seed)
        directions = orthogonal_directions(len(subject.code), self.directions, generator)
        metrics: dict[str, float] = {}
        bands = _bands(reference, subject.camera)
        for number, (band, pixels) in enumerate(bands.items()):
            run.progress("comparing gradients", number, len(BANDS) + 2)
            drawn = _draw(pixels, self.pixels, generator)
            numbers = self._evaluate(subject, drawn, reference.distance.flatten()[drawn], directions)
            metrics |= {f"{band}.{name}": value for name, value in numbers.items()}
        outline = _draw(_outline(reference.hit), self.outline, generator)
        metrics |= self._evaluate_outline(subject, outline, directions[:, : self.outline_directions])
        run.progress("comparing gradients", len(BANDS) + 1, len(BANDS) + 2)
        visible = _draw(torch.cat([bands["frontal"], bands["oblique"]]), self.pixels, generator)
        paint = Paint.random(generator)
        numbers = self._evaluate(subject, visible, reference.distance.flatten()[visible], directions, paint)
        record.metrics = metrics | {f"colour.{name}": value for name, value in numbers.items()}
        record.evaluations = {"value": subject.counts.value, "gradient": subject.counts.gradient}
        record.status, record.reason = RunStatus.OK, ""

    def _evaluate(
        self,
        subject: "Subject",
        pixels: Int[Tensor, " m"],
        distance: Float[Tensor, " m"],
        directions: Float[Tensor, "code_length directions"],
        paint: Paint | None = None,
    ) -> dict[str, float]:
        """The metrics of distances in one band, or of colours at the hits."""
        if not pixels.numel():
            return _gradient_metrics({}, pixels.bool())
        truth = differences(
            subject.decoder,
            subject.code,
            directions,
            camera=subject.camera,
            pixels=pixels,
            distance=distance,
            paint=paint,
        )
        (by_code, by_camera, *by_weight), hit_distance, hit = subject.gradients(pixels, paint)
        valid = truth.valid & hit & subject.same_surface(pixels, hit_distance, distance)
        pairs = {"code": (by_code @ directions, truth.code)}
        if subject.renderer.capabilities.ray_gradient:
            pairs["camera"] = (by_camera, truth.camera)
        if by_weight:
            pairs["texture"] = (by_weight[0], truth.texture)
        return _gradient_metrics(pairs, valid)

    def _evaluate_outline(
        self, subject: "Subject", pixels: Int[Tensor, " m"], directions: Float[Tensor, "code_length directions"]
    ) -> dict[str, float]:
        """The metrics across the outline, at the renderer's blur, and at each of `blurs` if it has a blur."""
        if not pixels.numel():
            return {"silhouette.pixels": 0}
        lipschitz = estimate_lipschitz(subject.decoder.at(subject.code), radius=RADIUS)

        def field_at(shift: Tensor) -> Field:
            return subject.decoder.at(subject.code + shift)

        settings: Any = {"camera": subject.camera, "pixels": pixels, "lipschitz": lipschitz}
        steps = outline_steps(field_at, directions, shift=self.outline_shift, **settings)
        truth = image_differences(field_at, directions, steps=steps, supersampling=self.supersampling, **settings)
        rays = subrays(subject.camera, pixels, self.supersampling)
        numbers = {
            "silhouette.pixels": float(len(pixels)),
            **_image_metrics(subject, rays, directions, truth, "silhouette"),
        }
        if isinstance(subject.renderer, Blurred):
            for blur in self.blurs:
                blurred = replace(subject, renderer=subject.renderer.with_blur(blur))
                numbers |= _image_metrics(blurred, rays, directions, truth, f"silhouette_{blur:.0e}")
        return numbers


@dataclass(frozen=True)
class Subject:
    """The renderer, network, code and camera whose gradients are compared, all in float64."""

    renderer: Renderer
    decoder: Decoder
    code: Float[Tensor, " code_length"]
    camera: Camera
    counts: Counts

    def same_surface(
        self, pixels: Int[Tensor, " m"], hits: Float[Tensor, " m"], distance: Float[Tensor, " m"]
    ) -> Bool[Tensor, " m"]:
        """Whether hits are on the surface of the true ones: close, or the field's magnitude falls all along between."""
        rays = self.camera.rays().flat()[pixels]
        samples = torch.lerp(hits[:, None], distance[:, None], torch.linspace(0, 1, POINTS_BETWEEN, dtype=hits.dtype))
        with torch.no_grad():
            decreasing = (self.decoder.at(self.code)(rays.at_each(samples)).abs().diff(dim=1) <= 0).all(dim=1)
        return ((hits - distance).abs() < SAME_SURFACE_DISTANCE) | decreasing

    def gradients(
        self, pixels: Int[Tensor, " m"], paint: Paint | None
    ) -> tuple[list[Float[Tensor, "m seen _"]], Float[Tensor, " m"], Bool[Tensor, " m"]]:
        """The gradients of each pixel's outputs for code, camera and paint; the distance; whether it hits.

        The output is the distance. With a paint, the outputs are its three colours at the renderer's points and the
        field's gradients at these points, as in a reconstruction.
        """
        code = self.code.clone().requires_grad_(True)
        twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        weights = [] if paint is None else [paint.weights.clone().requires_grad_(True)]
        rays = self.camera.moved(twist).rays().flat()
        field = Meter(self.decoder.at(code), self.counts)
        rendering = render_checked(self.renderer, field, rays[pixels])
        rows = rendering.hit.nonzero().squeeze(-1)
        outputs = rendering.distance[rows, None]
        if paint is not None:
            points = rendering.points[rows]
            outputs = Paint(*weights)(points, gradients_at(field, points)) if len(rows) else outputs.expand(-1, 3)
        parameters = (code, twist, *weights)
        tables = [torch.zeros(len(pixels), outputs.shape[1], len(values), dtype=torch.float64) for values in parameters]
        for index, row in enumerate(rows.tolist()):
            for channel, output in enumerate(outputs[index]):
                gradients = torch.autograd.grad(output, parameters, retain_graph=True, allow_unused=True)
                if paint is None:
                    check_gradients(self.renderer, *gradients)
                for table, gradient in zip(tables, gradients, strict=True):
                    if gradient is not None:
                        table[row, channel] = gradient
        return tables, rendering.distance.detach(), rendering.hit

    def image_gradients(
        self, rays: Rays, directions: Float[Tensor, "code_length directions"]
    ) -> Float[Tensor, "rays directions"]:
        """The derivatives of the distance visible on each ray, along directions of the code.

        The gradient for the directions' coordinates is linear in the weights of the rays. Its derivatives with respect
        to the weights are therefore the derivatives of all rays at once.
        """
        shift = torch.zeros(directions.shape[1], dtype=torch.float64, requires_grad=True)
        field = Meter(self.decoder.at(self.code + directions @ shift), self.counts)
        rendering = render_checked(self.renderer, field, rays)
        weights = torch.ones(rays.shape, dtype=torch.float64, requires_grad=True)
        (gradient,) = torch.autograd.grad(_visible_distance(rendering, rays), shift, weights, create_graph=True)
        columns = [torch.autograd.grad(component, weights, retain_graph=True)[0] for component in gradient]
        return torch.stack(columns, dim=-1)


def _image_metrics(
    subject: Subject,
    rays: Rays,
    directions: Float[Tensor, "code_length directions"],
    truth: Float[Tensor, "pixels directions"],
    name: str,
) -> dict[str, float]:
    """The metrics of the image of distances; each pixel is the mean over a row of `rays`."""
    counted = replace(subject, counts=Counts())  # separate: these evaluations are not part of the renderer's cost
    gradients = counted.image_gradients(rays.flat(), directions).view(*rays.shape, -1)
    mean, scale = gradients.mean(dim=1), truth.square().sum()
    return {
        f"{name}.image_cosine": torch.cosine_similarity(mean.flatten(), truth.flatten(), dim=0).item(),
        f"{name}.image_scale": ((mean * truth).sum() / scale).item(),
        f"{name}.image_error": ((mean - truth).square().sum() / scale).sqrt().item(),
        f"{name}.image_spread": ((gradients - mean[:, None]).square().mean(dim=1).sum() / scale).sqrt().item(),
        f"{name}.values_per_ray": counted.counts.value / gradients[..., 0].numel(),
    }


def _visible_distance(rendering: Rendering, rays: Rays) -> Float[Tensor, "*rays"]:
    """The distance visible on each ray: to the shape, or to the far side of the unit sphere behind it."""
    exit_distance = sphere_span(rays)[1]
    if rendering.volume is None:
        return torch.where(rendering.hit, rendering.distance, exit_distance)
    relative = rendering.volume.distance - exit_distance.flatten()[rendering.volume.ray]
    return exit_distance + rendering.volume.weighted_sum(relative, exit_distance.numel()).view(exit_distance.shape)


def _gradient_metrics(
    pairs: dict[str, tuple[Float[Tensor, "m *seen _"], Float[Tensor, "m *seen _"]]], valid: Bool[Tensor, " m"]
) -> dict[str, float]:
    """The metrics of the valid pixels' computed and true gradients, and the number of valid pixels."""
    numbers: dict[str, float] = {"pixels": int(valid.sum()), "excluded": int((~valid).sum())}
    if not valid.any():
        return numbers
    for name, pair in pairs.items():
        computed, true = (gradients[valid].flatten(0, -2) for gradients in pair)
        length = torch.linalg.vector_norm(true, dim=1)
        error = torch.linalg.vector_norm(computed - true, dim=1) / length
        middle, high = error.quantile(torch.tensor([0.5, 0.99], dtype=torch.float64)).tolist()
        numbers |= {
            f"{name}_cosine": torch.cosine_similarity(computed, true, dim=1).median().item(),
            f"{name}_pooled_cosine": torch.cosine_similarity(computed.flatten(), true.flatten(), dim=0).item(),
            f"{name}_pooled_scale": ((computed * true).sum() / true.square().sum()).item(),
            f"{name}_scale": ((computed * true).sum(1) / length.square()).median().item(),
            f"{name}_median_error": middle,
            f"{name}_p99_error": high,
        }
    return numbers


def _bands(reference: Reference, camera: Camera) -> dict[str, Int[Tensor, " some"]]:
    """The hit pixels of each band of angles, as indices into the flattened image."""
    cosine = -(reference.normals * camera.rays().directions).sum(-1).clamp(min=-1)  # rounding can exceed 1
    bands = {}
    for band, (low, high) in BANDS.items():
        within = (cosine <= cos(radians(low))) & (cosine > cos(radians(high)))
        bands[band] = (within & reference.hit).flatten().nonzero().squeeze(-1)
    return bands


def _outline(hit: Bool[Tensor, "height width"]) -> Int[Tensor, " some"]:
    """Pixels whose 3 x 3 neighbourhood has both hits and misses, as indices into the flattened image."""
    return near_outline(hit, 1).flatten().nonzero().squeeze(-1)


def _draw(pixels: Int[Tensor, " some"], count: int, generator: torch.Generator) -> Int[Tensor, " few"]:
    return pixels[torch.randperm(len(pixels), generator=generator)[:count]].sort().values
