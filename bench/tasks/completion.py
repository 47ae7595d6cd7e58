"""Shape completion: find the code whose shape agrees with a sparse depth image and a mask (DIST, Sec. 4.2.1)."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.autodecoder import Prior
from bench.solve import solve
from bench.stage import Cell
from bench.tasks.problem import OptimiserSettings, Unsupported
from datasets.observe import observed_pixels, parse_amount
from datasets.scene import Scene
from renderers.camera import Rays
from renderers.checks import check_at_least, check_choice, check_positive
from renderers.field import Counts, Field, Meter
from renderers.fields.mlp import Decoder
from renderers.rendering import Renderer, at_iteration


@dataclass(frozen=True)
class Completion:
    """Shape from one sparse depth image, with or without its mask.

    Args:
        points: how much of the depth is given; see `datasets.observe.observed_pixels`. Dense depth implies the mask.
        mask: whether the silhouette is given.
        depth_weight: of the mean absolute depth error over pixels that are observed and hit (DIST, B.3).
        silhouette_weight: of the renderer's own silhouette loss.
        code_weight, code_average: of the squared code, "sum" or "mean" over its numbers.
        samples: K; read by renderers that have it, through their configuration.
        iterations, learning_rate: of Adam.
    """

    points: str
    mask: bool
    depth_weight: float
    silhouette_weight: float
    code_weight: float
    code_average: str
    samples: int
    iterations: int
    learning_rate: float

    def __post_init__(self) -> None:
        parse_amount(self.points)
        check_choice("task.code_average", self.code_average, ("sum", "mean"))
        check_at_least("task.iterations", self.iterations, 1, "the paper uses 100")
        check_positive("task.learning_rate", self.learning_rate, "the paper uses 1e-2")
        for name in ("depth_weight", "silhouette_weight", "code_weight"):
            check_at_least(f"task.{name}", getattr(self, name), 0, "0 switches the term off")

    @property
    def optimiser(self) -> OptimiserSettings:
        """For how long and how fast."""
        return OptimiserSettings(self.iterations, self.learning_rate)

    def execute(self, cell: Cell) -> None:
        """Optimises the code, and judges the shape before and after."""
        solve(self, cell)

    def problem(
        self, scene: Scene, prior: Prior, renderer: Renderer, *, seed: int, device: torch.device
    ) -> "CompletionProblem":
        """The problem of a scene, from the mean shape, code zero."""
        if not renderer.capabilities.field_gradient:
            raise Unsupported(f"{type(renderer).__name__} has no gradient towards the field")
        view, decoder = scene.view, prior.decoder.to(device).requires_grad_(False)
        return CompletionProblem(
            settings=self,
            observed=observed_pixels(view, self.points, seed).to(device),
            mask=view.mask.to(device) if self.mask or self.points == "dense" else None,
            depth=view.depth.to(device),
            depth_of_distance=view.camera.depth(torch.ones(view.depth.shape)).to(device),
            rays=view.camera.rays().to(device),
            renderer=renderer,
            decoder=decoder,
            code=torch.zeros(decoder.code_length, device=device, requires_grad=True),
        )


@dataclass
class CompletionProblem:
    """A code to be found; `loss` renders its shape and compares."""

    settings: Completion
    observed: Bool[Tensor, "height width"]
    mask: Bool[Tensor, "height width"] | None
    depth: Float[Tensor, "height width"]
    depth_of_distance: Float[Tensor, "height width"]  # depth of a point at distance 1, the cosine of Eq. 2
    rays: Rays
    renderer: Renderer
    decoder: Decoder
    code: Float[Tensor, "code_length"]
    counts: Counts = field(default_factory=Counts)

    @property
    def parameters(self) -> list[Tensor]:
        """The code."""
        return [self.code]

    @property
    def rays_per_iteration(self) -> int:
        """One for each pixel."""
        return self.rays.shape.numel()

    def field(self) -> Field:
        """The shape as it stands."""
        return self.decoder.at(self.code.detach())

    def loss(self, iteration: int) -> dict[str, Tensor]:
        """DIST, Eq. 5, with the weights and the regulariser of B.4."""
        metered = Meter(self.decoder.at(self.code), self.counts)
        renderer = at_iteration(self.renderer, iteration)
        rendering = renderer.render(metered, self.rays)
        compared = self.observed & rendering.hit
        error = (rendering.distance * self.depth_of_distance - self.depth).abs()
        squares = self.code.square()
        terms = {
            "depth": self.settings.depth_weight * (error * compared).sum() / compared.sum().clamp_min(1),
            "code": self.settings.code_weight
            * (squares.sum() if self.settings.code_average == "sum" else squares.mean()),
        }
        if self.mask is not None:
            silhouette = renderer.silhouette_loss(metered, self.rays, rendering, self.mask)
            terms["silhouette"] = self.settings.silhouette_weight * silhouette
        return {"total": torch.stack(list(terms.values())).sum(), **terms}
