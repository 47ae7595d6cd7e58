"""Compares the gradient of a silhouette's area with central differences, with one or several rays per pixel."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from bench.evaluate.reference import MIN_STEP, RADIUS, fingerprint, in_float64
from bench.records.record import RunStatus, digest
from bench.setup.inputs import RunContext, RunInputs
from bench.shape_prior import Prior, load_or_make
from bench.solve.pixel_area import random_rays
from bench.tasks.gradients.finite_differences import outline_steps, subrays
from renderers.boundary import render_checked
from renderers.camera import Camera, Rays
from renderers.checks import check_at_least, check_positive
from renderers.field import Counts, Field, Meter, estimate_lipschitz
from renderers.rendering import Unsupported, check_kind
from renderers.tracing.reference import trace

REMEDY = "take renderer=edge_sampling, relaxed_boundary, neus, opaque, volsdf or unisurf"
NEIGHBOURHOOD = 5  # pixels per side: its centre can change only if it has hits and misses
DEFINITIONS = {
    "area_error, area_noise": "root mean square over draws: of the length of the difference between a draw's "
    "gradient and the true one; of the difference from the mean over draws; both over the length of the true one. "
    "There is no noise without draws, with one ray per pixel",
    "area_scale, area_cosine": "component along the true gradient of the mean over draws, over the length of the true "
    "one; cosine between both",
    "evaluations": "of one draw",
}


@dataclass(frozen=True)
class AreaGradient:
    """Compares the gradient of the area that a shape covers in an image with central differences, for its code.

    The area is the sum of the pixels' mean opacities. The shape is a training shape of the prior.

    Args:
        directions: number of random orthogonal directions of the code.
        draws: of several rays per pixel. One ray goes through the centre, without a draw.
        shift: in pixels; a step of the differences moves most of the outline by so much, to either side.
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
        check_positive("task.shift", self.shift, "0.15 moves the outline within a pixel")

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
        axes = torch.randn(prior.codes.shape[1], self.directions, generator=generator, dtype=torch.float64)
        directions = torch.linalg.qr(axes).Q
        truth = self._true_gradient(prior, camera, directions, inputs.cache)
        count, gradients = inputs.scene.rays_per_pixel, []
        draws = self.draws if count > 1 else 1
        for draw in range(draws):
            run.progress("comparing gradients of the area", draw, draws)
            rays = random_rays(camera, count, inputs.seed, draw) if count > 1 else camera.rays()
            code = prior.codes[0].detach().clone().requires_grad_(True)
            field = Meter(prior.decoder.requires_grad_(False).at(code), counts)
            gradients.append(self._gradient(run, field, code, rays).double() / count @ directions)
        record.metrics = _metrics(torch.stack(gradients), truth)
        totals = {"value": counts.value, "gradient": counts.gradient, "cost": counts.cost}
        record.evaluations = {name: total / draws for name, total in totals.items()}
        record.status, record.reason = RunStatus.OK, ""

    def _gradient(self, run: RunContext, field: Field, code: Tensor, rays: Rays) -> Float[Tensor, " code_length"]:
        """The gradient of the sum of the rays' opacities for the code."""
        renderer = run.inputs.renderer
        check_kind(renderer, field)
        rendering = render_checked(renderer, field, rays)
        if rendering.volume is None:
            raise Unsupported(f"{type(renderer).__name__} has no opacity with a gradient: {REMEDY}")
        (gradient,) = torch.autograd.grad(rendering.opacity.sum(), code)
        return gradient

    def _true_gradient(
        self, prior: Prior, camera: Camera, directions: Float[Tensor, "code_length directions"], folder: Path
    ) -> Float[Tensor, " directions"]:
        """Central differences of the area along directions of the code, in float64; read from `folder` or stored."""
        exact, camera = in_float64(prior), camera.double()
        settings = [camera.intrinsics.tolist(), camera.world_to_camera.tolist(), camera.height, camera.width]
        key = digest(
            {"weights": fingerprint(prior), "camera": settings, "task": asdict(self), "at": directions.tolist()}
        )

        def field_at(shift: Tensor) -> Field:
            return exact.decoder.at(exact.codes[0] + shift)

        def make() -> dict[str, Tensor]:
            lipschitz = estimate_lipschitz(exact.decoder.at(exact.codes[0]), radius=RADIUS)
            tracing = {"lipschitz": lipschitz, "least_step": MIN_STEP, "radius": RADIUS}
            hit = trace(field_at(torch.zeros_like(exact.codes[0])), camera.rays(), **tracing).hit
            both = torch.stack([hit, ~hit])[:, None].float()
            both = torch.nn.functional.max_pool2d(both, NEIGHBOURHOOD, stride=1, padding=NEIGHBOURHOOD // 2)
            pixels = (both.amin(dim=0)[0] > 0).flatten().nonzero().squeeze(-1)
            steps = outline_steps(
                field_at, directions, camera=camera, pixels=pixels, shift=self.shift, lipschitz=lipschitz
            )
            rays, rates = subrays(camera, pixels, self.supersampling), []
            for direction, step in zip(directions.T, steps.tolist(), strict=True):
                ahead, behind = (
                    trace(field_at(sign * step * direction), rays, **tracing).hit.double() for sign in (1, -1)
                )
                rates.append((ahead - behind).mean(dim=1).sum() / (2 * step))
            return {"rates": torch.stack(rates)}

        return load_or_make(folder, f"area-{key}", make)["rates"]


def _metrics(drawn: Float[Tensor, "draws directions"], truth: Float[Tensor, " directions"]) -> dict[str, float]:
    """The metrics of `DEFINITIONS`."""
    mean, length = drawn.mean(dim=0), torch.linalg.vector_norm(truth)

    def deviation(centre: Tensor) -> float:
        return ((drawn - centre).square().sum(dim=1).mean().sqrt() / length).item()

    noise = {"area_noise": deviation(mean)} if len(drawn) > 1 else {}
    return {
        "area_error": deviation(truth),
        **noise,
        "area_scale": (mean @ truth / length.square()).item(),
        "area_cosine": torch.cosine_similarity(mean, truth, dim=0).item(),
    }
