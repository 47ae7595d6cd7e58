"""Compares the gradient of a silhouette's area with central differences, with one or several rays per pixel."""

from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from bench.evaluate.reference import RADIUS, fingerprint, in_float64, trace_exactly
from bench.records.record import RunStatus, digest
from bench.setup.inputs import RunContext, RunInputs
from bench.shape_prior import Prior, load_or_make
from bench.solve.pixel_area import random_rays
from bench.tasks.gradients.finite_differences import near_outline, orthogonal_directions, outline_steps
from renderers.boundary import render_checked
from renderers.camera import Camera, Rays
from renderers.checks import check_at_least, check_positive
from renderers.field import Counts, Field, Meter, estimate_lipschitz
from renderers.rendering import Renderer, Unsupported, check_kind

VERSION = 1  # raise it when the true gradients change
REACH = 0.15  # pixels: rays farther from the outline keep their hit or miss in a step
REMEDY = "take renderer=edge_sampling, relaxed_boundary, neus, opaque, volsdf or unisurf"
DEFINITIONS = {
    "area_error": "length of the difference between a draw's gradient and the true one, divided by the length of the "
    "true one; root mean square over the draws",
    "area_bias": "the same of the mean over the draws",
    "area_noise": "standard deviation of the draws from their mean, divided by the length of the true gradient; absent "
    "with one ray per pixel, where nothing is drawn",
    "area_scale": "component of the mean gradient along the true one, divided by the length of the true one",
    "area_cosine": "cosine between the mean gradient and the true one",
    "evaluations": "of one draw",
}


@dataclass(frozen=True)
class AreaGradient:
    """Compares the gradient of the area that a shape covers in an image with central differences, for its code.

    The area is the sum of the pixels' mean opacities. The shape is a training shape of the prior.

    Args:
        directions: number of random orthogonal directions of the code.
        draws: of several rays per pixel. One ray goes through the centre, without a draw.
        shift: in pixels; a step of the differences moves 90 % of the surface near the outline by less, to either side.
        supersampling: rays per side of a pixel, for the differences.
    """

    directions: int
    draws: int
    shift: float
    supersampling: int

    takes_rays_per_pixel: ClassVar[bool] = True

    def __post_init__(self) -> None:
        for name in ("directions", "draws", "supersampling"):
            check_at_least(
                f"task.{name}", getattr(self, name), 1, "conf/task/area_gradient.yaml holds values that work"
            )
        check_positive("task.shift", self.shift, "0.05 moves the outline within a pixel")

    def check(self, inputs: RunInputs) -> None:
        """Raises BadInput without a network that was fitted to the scene's shape."""
        inputs.check_fitted()

    def execute(self, run: RunContext) -> None:
        """Measures the gradient of each draw.

        Raises:
            Unsupported: the renderer's opacity has no gradient.
        """
        inputs, record, counts = run.inputs, run.record, Counts()
        record.definitions = DEFINITIONS
        prior, camera = inputs.fitted(), inputs.scene.view.camera
        generator = torch.Generator().manual_seed(inputs.seed)
        directions = orthogonal_directions(prior.codes.shape[1], self.directions, generator)
        truth = self._true_gradient(prior, camera, directions, inputs.cache)
        count, gradients = inputs.scene.rays_per_pixel, []
        draws = self.draws if count > 1 else 1
        for draw in range(draws):
            run.progress("comparing gradients of the area", draw, draws)
            rays = random_rays(camera, count, inputs.seed, draw) if count > 1 else camera.rays()
            code = prior.codes[0].detach().clone().requires_grad_(True)
            field = Meter(prior.decoder.requires_grad_(False).at(code), counts)
            gradients.append(_gradient(inputs.renderer, field, code, rays).double() / count @ directions)
        record.metrics = _metrics(torch.stack(gradients), truth)
        totals = {"value": counts.value, "gradient": counts.gradient, "cost": counts.cost}
        record.evaluations = {name: total / draws for name, total in totals.items()}
        record.status, record.reason = RunStatus.OK, ""

    def _true_gradient(
        self, prior: Prior, camera: Camera, directions: Float[Tensor, "code_length directions"], folder: Path
    ) -> Float[Tensor, " directions"]:
        """Central differences of the area along directions of the code, in float64; read from `folder` or stored."""
        exact, camera = in_float64(prior), camera.double()
        settings = [camera.intrinsics.tolist(), camera.world_to_camera.tolist(), camera.height, camera.width]
        settings += [VERSION, self.shift, self.supersampling, directions.tolist()]
        key = digest({"weights": fingerprint(prior), "settings": settings})

        def field_at(shift: Tensor) -> Field:
            return exact.decoder.at(exact.codes[0] + shift)

        def make() -> dict[str, Tensor]:
            base = exact.decoder.at(exact.codes[0])
            lipschitz, count = estimate_lipschitz(base, radius=RADIUS), self.supersampling
            hit = trace_exactly(base, camera.rays(), lipschitz).hit
            outline = near_outline(hit, 1).flatten().nonzero().squeeze(-1)
            steps = outline_steps(
                field_at, directions, camera=camera, pixels=outline, shift=self.shift, lipschitz=lipschitz
            )
            fine_hit = hit.repeat_interleave(count, 0).repeat_interleave(count, 1)
            rays = camera.resized(camera.height * count, camera.width * count).rays().flat()
            wide = near_outline(fine_hit, count).flatten().nonzero().squeeze(-1)
            fine_hit.view(-1)[wide] = trace_exactly(base, rays[wide], lipschitz).hit
            rays, rates = rays[near_outline(fine_hit, ceil(REACH * count)).flatten()], []
            for direction, step in zip(directions.T, steps.tolist(), strict=True):
                ahead, behind = (
                    trace_exactly(field_at(sign * step * direction), rays, lipschitz).hit.sum() for sign in (1, -1)
                )
                rates.append((ahead - behind).double() / count**2 / (2 * step))
            return {"rates": torch.stack(rates)}

        return load_or_make(folder, f"area-{key}", make)["rates"]


def _gradient(renderer: Renderer, field: Field, code: Tensor, rays: Rays) -> Float[Tensor, " code_length"]:
    """The gradient of the sum of the rays' opacities for the code."""
    check_kind(renderer, field)
    rendering = render_checked(renderer, field, rays)
    if rendering.volume is None:
        raise Unsupported(f"{type(renderer).__name__} has no opacity with a gradient: {REMEDY}")
    (gradient,) = torch.autograd.grad(rendering.opacity.sum(), code)
    return gradient


def _metrics(drawn: Float[Tensor, "draws directions"], truth: Float[Tensor, " directions"]) -> dict[str, float]:
    """The metrics of `DEFINITIONS`."""
    mean, length = drawn.mean(dim=0), torch.linalg.vector_norm(truth)
    noise = {"area_noise": (drawn.var(dim=0).sum().sqrt() / length).item()} if len(drawn) > 1 else {}
    return {
        "area_error": ((drawn - truth).square().sum(dim=1).mean().sqrt() / length).item(),
        "area_bias": (torch.linalg.vector_norm(mean - truth) / length).item(),
        **noise,
        "area_scale": (mean @ truth / length.square()).item(),
        "area_cosine": torch.cosine_similarity(mean, truth, dim=0).item(),
    }
