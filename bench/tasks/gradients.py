"""Compares a renderer's gradients with central differences in float64, by angle of incidence."""

from dataclasses import dataclass
from math import cos, radians

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bench.evaluate.finite_differences import (
    Differences,
    Paint,
    colour_differences,
    differences,
    image_differences,
)
from bench.evaluate.reference import RADIUS, Reference, in_float64, reference_for
from bench.reconstruct.losses import slopes_at
from bench.records.record import RunStatus
from bench.setup.inputs import RunContext
from bench.solve.problem import check_field_gradient, check_kind
from renderers.boundary import check_gradients, rendered
from renderers.camera import Camera
from renderers.checks import check_at_least, check_positive
from renderers.field import Counts, Meter, steepest
from renderers.fields.mlp import Decoder
from renderers.rendering import Renderer

BANDS = {"frontal": (0.0, 30.0), "oblique": (30.0, 70.0), "grazing": (70.0, 90.0)}  # degrees of incidence
OTHER_SURFACE = 0.01  # scene units: a hit further from the true one is on another surface, and is not evaluated

DEFINITIONS = {
    "BAND": "angle between ray and inward normal: frontal to 30 degrees, oblique to 70, grazing beyond; silhouette: "
    "pixels next to the outline; colour: frontal and oblique pixels, of which not distances but colours are compared, "
    "a row per pixel and channel (DVR, Eqs. 3 to 8): those of a random smooth paint of the point and the normal there",
    "pixels, excluded": "pixels evaluated; pixels drawn but not evaluated, since visibility changes there, the root is "
    "not found again, or the renderer does not hit that surface",
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
    "image_cosine, image_scale": "pooled cosine and scale of the gradient of the image of distances, with the far side "
    "of the unit sphere as background, for the code, against differences of a supersampled image, in which visibility "
    "changes",
}


@dataclass(frozen=True)
class Gradients:
    """Compares gradients of distance with central differences, at a training shape of the prior, in float64.

    Args:
        pixels: number drawn in each band of angles.
        directions: number of random orthogonal directions of the code.
        outline: number of pixels drawn next to the outline.
        outline_directions: number of directions of the code for these.
        outline_step: length of the step of the code for these.
        supersampling: rays per side of a pixel for these.
    """

    pixels: int
    directions: int
    outline: int
    outline_directions: int
    outline_step: float
    supersampling: int

    def __post_init__(self) -> None:
        for name in ("pixels", "directions", "outline", "outline_directions", "supersampling"):
            check_at_least(f"task.{name}", getattr(self, name), 1, "conf/task/gradients.yaml holds values that work")
        check_positive("task.outline_step", self.outline_step, "conf/task/gradients.yaml holds one that works")

    def execute(self, run: RunContext) -> None:
        """Compares the gradients, and fills the record."""
        inputs, record = run.inputs, run.record
        record.definitions = DEFINITIONS
        twin = in_float64(inputs.fitted())
        reference = reference_for(inputs.fitted(), inputs.scene.view.camera, inputs.cache)
        subject = Subject(
            inputs.renderer,
            twin.decoder.requires_grad_(False),
            twin.codes[0],
            inputs.scene.view.camera.double(),
            Counts(),
        )
        subject.check()
        generator = torch.Generator().manual_seed(inputs.seed)
        axes = torch.randn(len(subject.code), self.directions, generator=generator, dtype=torch.float64)
        directions = torch.linalg.qr(axes).Q
        metrics: dict[str, float] = {}
        bands = _bands(reference, subject.camera)
        for number, (band, pixels) in enumerate(bands.items()):
            run.progress("comparing gradients", number, len(BANDS) + 2)
            drawn = _draw(pixels, self.pixels, generator)
            numbers = self._evaluate(subject, drawn, reference.distance.flatten()[drawn], directions)
            metrics |= {f"{band}.{name}": value for name, value in numbers.items()}
        outline = _draw(_outline(reference.hit), self.outline, generator)
        numbers = self._evaluate_outline(subject, outline, directions[:, : self.outline_directions])
        metrics |= {f"silhouette.{name}": value for name, value in numbers.items()}
        run.progress("comparing gradients", len(BANDS) + 1, len(BANDS) + 2)
        seen = _draw(torch.cat([bands["frontal"], bands["oblique"]]), self.pixels, generator)
        numbers = self._evaluate_colours(subject, seen, reference.distance.flatten()[seen], directions, generator)
        record.metrics = metrics | {f"colour.{name}": value for name, value in numbers.items()}
        record.evaluations = {"value": subject.counts.value, "gradient": subject.counts.gradient}
        record.status, record.reason = RunStatus.OK, ""

    def _evaluate(
        self,
        subject: "Subject",
        pixels: Int[Tensor, " m"],
        distance: Float[Tensor, " m"],
        directions: Float[Tensor, "code_length directions"],
    ) -> dict[str, float]:
        """The metrics of one band."""
        if not pixels.numel():
            return {"pixels": 0, "excluded": 0}
        truth: Differences = differences(
            subject.decoder, subject.code, directions, camera=subject.camera, pixels=pixels, distance=distance
        )
        by_code, by_camera, found, hit = subject.gradients(pixels)
        valid = truth.valid & hit & ((found - distance).abs() < OTHER_SURFACE)
        numbers: dict[str, float] = {"pixels": int(valid.sum()), "excluded": int((~valid).sum())}
        if valid.any():
            numbers |= _compare((by_code @ directions)[valid], truth.code[valid], "code")
            if subject.renderer.capabilities.ray_gradient:
                numbers |= _compare(by_camera[valid], truth.camera[valid], "camera")
        return numbers

    def _evaluate_colours(
        self,
        subject: "Subject",
        pixels: Int[Tensor, " m"],
        distance: Float[Tensor, " m"],
        directions: Float[Tensor, "code_length directions"],
        generator: torch.Generator,
    ) -> dict[str, float]:
        """The metrics of colours at the hits."""
        if not pixels.numel():
            return {"pixels": 0, "excluded": 0}
        paint = Paint.drawn(generator)
        truth = colour_differences(
            subject.decoder, subject.code, directions, paint, camera=subject.camera, pixels=pixels, distance=distance
        )
        by_code, by_camera, by_weight, found, hit = subject.colour_gradients(pixels, paint)
        valid = truth.valid & hit & ((found - distance).abs() < OTHER_SURFACE)
        numbers: dict[str, float] = {"pixels": int(valid.sum()), "excluded": int((~valid).sum())}
        if valid.any():
            numbers |= _compare((by_code @ directions)[valid].flatten(0, 1), truth.code[valid].flatten(0, 1), "code")
            numbers |= _compare(by_weight[valid].flatten(0, 1), truth.texture[valid].flatten(0, 1), "texture")
            if subject.renderer.capabilities.ray_gradient:
                numbers |= _compare(by_camera[valid].flatten(0, 1), truth.camera[valid].flatten(0, 1), "camera")
        return numbers

    def _evaluate_outline(
        self, subject: "Subject", pixels: Int[Tensor, " m"], directions: Float[Tensor, "code_length directions"]
    ) -> dict[str, float]:
        """The metrics across the silhouette."""
        if not pixels.numel():
            return {"pixels": 0}
        lipschitz = steepest(subject.decoder.at(subject.code), radius=RADIUS)
        truth = image_differences(
            lambda shift: subject.decoder.at(subject.code + shift),
            directions,
            camera=subject.camera,
            pixels=pixels,
            step=self.outline_step,
            supersampling=self.supersampling,
            lipschitz=lipschitz,
        )
        by_code, _, _, hit = subject.gradients(pixels)
        image = (by_code @ directions) * hit[:, None]  # the background does not move
        numbers: dict[str, float] = {"pixels": len(pixels)}
        numbers["image_cosine"] = torch.cosine_similarity(image.flatten(), truth.flatten(), dim=0).item()
        numbers["image_scale"] = ((image * truth).sum() / truth.square().sum()).item()
        return numbers


@dataclass(frozen=True)
class Subject:
    """The renderer, network, code and camera whose gradients are compared, all in float64."""

    renderer: Renderer
    decoder: Decoder
    code: Float[Tensor, " code_length"]
    camera: Camera
    counts: Counts

    def check(self) -> None:
        """Raises Unsupported where the renderer cannot do this."""
        check_kind(self.renderer, self.decoder.at(self.code))
        check_field_gradient(self.renderer)

    def gradients(
        self, pixels: Int[Tensor, " m"]
    ) -> tuple[Float[Tensor, "m code_length"], Float[Tensor, "m 6"], Float[Tensor, " m"], Bool[Tensor, " m"]]:
        """For each pixel the gradients of its distance for code and camera, the distance, and whether it hits."""
        code = self.code.clone().requires_grad_(True)
        twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        rays = self.camera.moved(twist).rays().flat()
        rendering = rendered(self.renderer, Meter(self.decoder.at(code), self.counts), rays[pixels])
        by_code = torch.zeros(len(pixels), len(code), dtype=torch.float64)
        by_camera = torch.zeros(len(pixels), 6, dtype=torch.float64)
        for row in rendering.hit.nonzero().squeeze(-1).tolist():
            found = torch.autograd.grad(rendering.distance[row], (code, twist), retain_graph=True, allow_unused=True)
            check_gradients(self.renderer, *found)
            for table, gradient in zip((by_code, by_camera), found, strict=True):
                if gradient is not None:
                    table[row] = gradient
        return by_code, by_camera, rendering.distance.detach(), rendering.hit

    def colour_gradients(
        self, pixels: Int[Tensor, " m"], paint: Paint
    ) -> tuple[
        Float[Tensor, "m 3 code_length"],
        Float[Tensor, "m 3 6"],
        Float[Tensor, "m 3 weights"],
        Float[Tensor, " m"],
        Bool[Tensor, " m"],
    ]:
        """For each pixel the gradients of its colours for code, camera and paint, the distance, and whether it hits.

        The colours are those of the paint at the renderer's points, by the field's gradients there, as a
        reconstruction asks for them.
        """
        code, weights = (one.clone().requires_grad_(True) for one in (self.code, paint.weights))
        twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        rays = self.camera.moved(twist).rays().flat()
        field = Meter(self.decoder.at(code), self.counts)
        rendering = rendered(self.renderer, field, rays[pixels])
        tables = [torch.zeros(len(pixels), 3, len(one), dtype=torch.float64) for one in (code, twist, weights)]
        rows = rendering.hit.nonzero().squeeze(-1)
        points = rendering.points[rows]
        if len(rows):
            normals = slopes_at(field, points)
            colours = Paint(weights)(points, normals)
            for place, row in enumerate(rows.tolist()):
                for channel in range(3):
                    found = torch.autograd.grad(
                        colours[place, channel], (code, twist, weights), retain_graph=True, allow_unused=True
                    )
                    for table, gradient in zip(tables, found, strict=True):
                        if gradient is not None:
                            table[row, channel] = gradient
        return *tables, rendering.distance.detach(), rendering.hit


def _compare(found: Float[Tensor, "m n"], true: Float[Tensor, "m n"], name: str) -> dict[str, float]:
    length = torch.linalg.vector_norm(true, dim=1)
    error = torch.linalg.vector_norm(found - true, dim=1) / length
    middle, high = error.quantile(torch.tensor([0.5, 0.99], dtype=torch.float64)).tolist()
    return {
        f"{name}_cosine": torch.cosine_similarity(found, true, dim=1).median().item(),
        f"{name}_pooled_cosine": torch.cosine_similarity(found.flatten(), true.flatten(), dim=0).item(),
        f"{name}_pooled_scale": ((found * true).sum() / true.square().sum()).item(),
        f"{name}_scale": ((found * true).sum(1) / length.square()).median().item(),
        f"{name}_median_error": middle,
        f"{name}_p99_error": high,
    }


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
    around = torch.nn.functional.max_pool2d(torch.stack([hit, ~hit])[:, None].float(), 3, stride=1, padding=1)
    return (around.amin(dim=0)[0] > 0).flatten().nonzero().squeeze(-1)


def _draw(pixels: Int[Tensor, " some"], count: int, generator: torch.Generator) -> Int[Tensor, " few"]:
    return pixels[torch.randperm(len(pixels), generator=generator)[:count]].sort().values
