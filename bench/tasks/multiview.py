"""Shape from many views: optimise the code for photometric consistency between views (DIST, Sec. 4.2.2)."""

from dataclasses import dataclass
from math import radians

import torch
from jaxtyping import Float
from torch import Tensor

from bench.setup.inputs import RunContext
from bench.shape_prior.autodecoder import Prior
from bench.solve.latent_code import CodePenalty, CodeProblem
from bench.solve.optimise import StartSettings
from bench.solve.problem import OptimiserSettings, check_field_gradient
from bench.solve.solve import solve_task
from bench.tasks.photographs import GivenPhotographs
from datasets.photographs import Photography
from datasets.scene import Scene
from datasets.truth import Truth
from renderers.checks import BadInput, check_at_least, check_positive
from renderers.rendering import Renderer

MIN_SCALE, MAX_SHIFT = 0.8, 0.2
FAR_APART = 60.0  # degrees between compared photographs, above which the record has a note


@dataclass(frozen=True)
class Multiview:
    """Shape from photographs whose cameras are known; no mask is used.

    Args:
        images: settings of the photographs.
        focal: focal length of the photographs' cameras over that of the scene's camera (DIST, Fig. 10 a).
        views_per_step: views that an iteration compares, evenly spaced; they shift by one with each iteration.
        neighbour: a view is compared with the one that is this many views further.
        visible: squared difference of depths below which both views see a point, in squared scene units (DIST, B.3).
        photometric_weight: of the mean absolute difference of colours (Eq. 6).
        code: penalty on the code.
        start_scale: standard deviation of the random initial code over that of the prior's training codes; 0 is the
            mean shape.
        starts, trial: see `bench.solve.optimise.StartSettings`.
        coarse_blur: standard deviation of the initial Gaussian blur of the images, as a share of their height; it falls
            to 0 over the first half of a start's iterations.
        scale, degrees, shift: scale, rotation and shift of the initial shape against the true one; where one is not
            neutral, a similarity transform is optimised as well (DIST, Fig. 12). Ratio, degrees, scene units.
        optimiser: iterations and learning rates.
    """

    images: Photography
    focal: float
    views_per_step: int
    neighbour: int
    visible: float
    photometric_weight: float
    code: CodePenalty
    start_scale: float
    starts: int
    trial: int
    coarse_blur: float
    scale: float
    degrees: float
    shift: float
    similarity: bool
    optimiser: OptimiserSettings

    def __post_init__(self) -> None:
        check_at_least("task.views_per_step", self.views_per_step, 1, "the paper uses 8")
        check_at_least("task.neighbour", self.neighbour, 1, "1 is the closest next view")
        if self.neighbour % self.images.views == 0:
            both = f"task.neighbour={self.neighbour} compares each of {self.images.views} views with itself"
            raise ValueError(f"{both}: set task.neighbour=1")
        check_positive("task.visible", self.visible, "the paper uses 0.001")
        check_positive("task.focal", self.focal, "1 is the scene's; from 1.07 on shapes may leave the image")
        check_positive("task.scale", self.scale, "1 is the true size")
        check_positive("task.photometric_weight", self.photometric_weight, "the paper uses 5")
        for name in ("start_scale", "coarse_blur", "degrees", "shift"):
            check_at_least(f"task.{name}", getattr(self, name), 0, f"task.{name}=0 is the smallest value")
        if not (MIN_SCALE <= self.scale <= 1 / MIN_SCALE and self.shift <= MAX_SHIFT):
            raise ValueError(
                f"task.scale must lie between {MIN_SCALE} and {1 / MIN_SCALE}, and task.shift be {MAX_SHIFT} at "
                f"most, not {self.scale} and {self.shift}: priors are not trained outside of this range"
            )
        self.turns.check(self.optimiser.iterations)

    @property
    def turns(self) -> StartSettings:
        """The number of starts, and the iterations of each one's trial."""
        return StartSettings(self.starts, self.trial)

    @property
    def sought(self) -> bool:
        """Whether a similarity is optimised as well."""
        return self.similarity or self.scale != 1 or self.degrees > 0 or self.shift > 0

    def execute(self, run: RunContext) -> None:
        """Optimises the code, and evaluates the shape before and after."""
        apart = 360 / self.images.views * min(self.neighbour, self.images.views - self.neighbour)
        if apart > FAR_APART:
            note = f"compared photographs are {apart:.0f} degrees apart and share little: task.images.views=24 has 15"
            run.record.notes = [*run.record.notes, note]
        solve_task(self, run)

    def problem(
        self, scene: Scene, prior: Prior, renderer: Renderer, *, seed: int, device: torch.device
    ) -> CodeProblem:
        """The problem of a scene: the code, and where it is misplaced at the start a similarity transform."""
        check_field_gradient(renderer)
        scene_seed = scene.seed(seed)  # so that each shape has another texture and other codes
        generator = torch.Generator().manual_seed(scene_seed)
        photographs = self.images.take(Truth(scene.mesh), scene.view.camera.zoomed(self.focal), seed=scene_seed)
        given = GivenPhotographs(self, renderer, photographs, device)
        if len(prior.codes) < 2:
            raise BadInput("a prior of one shape has no spread from which to draw codes: set prior.shapes=96")
        spread = self.start_scale * prior.codes.std(0)
        codes = spread * torch.randn(self.starts, prior.decoder.code_length, generator=generator)
        return CodeProblem(
            prior,
            self.code,
            given.compare,
            torch.zeros_like(scene.view.mask),
            2 * given.per_step * scene.view.mask.numel(),
            device,
            initial=codes,
            misplaced=self._misplaced(generator) if self.sought else None,
            trial=self.trial,
            photographs=given.colours.cpu().numpy(),
            compared_at=self.optimiser.iterations,  # where images are no longer blurred
        )

    def _misplaced(self, generator: torch.Generator) -> Float[Tensor, "starts 7"]:
        """A similarity transform of the given size in random directions, the same for all starts."""
        axis, direction = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator), dim=1)
        similarity = torch.cat([self.shift * direction, radians(self.degrees) * axis, torch.tensor([self.scale]).log()])
        return similarity.expand(self.starts, -1)
