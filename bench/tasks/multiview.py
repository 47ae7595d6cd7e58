"""Shape from many views: find the code whose depths carry each view's colours onto the next (DIST, Sec. 4.2.2)."""

from dataclasses import dataclass
from math import radians

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.autodecoder import Prior
from bench.solve import solve
from bench.stage import Cell
from bench.starts import StartSettings
from bench.tasks.code import CodePenalty, CodeProblem, Terms, code_problem
from bench.tasks.problem import NotReached, OptimiserSettings, check_field_gradient
from bench.warp import project, sample
from datasets.photographs import Photograph, Photography
from datasets.scene import Scene
from datasets.truth import Truth
from renderers.camera import Rays
from renderers.checks import check_at_least, check_positive
from renderers.field import Field
from renderers.rendering import Renderer, at_iteration

LEAST_SCALE, MOST_SHIFT = 0.8, 0.2
FAR_APART = 60.0  # degrees between two photographs that a note is made of
SURE = 0.999  # of the weight of a pixel's neighbours must be on the shape for a depth between them


@dataclass(frozen=True)
class Multiview:
    """Shape from photographs whose cameras are known; no mask is used.

    Args:
        images: how the photographs are taken.
        focal: of the photographs' cameras, times that of the scene's camera (DIST, Fig. 10 a).
        views_per_step: views that an iteration compares, evenly spaced; they move on from one iteration to the next.
        neighbour: how many views further on the one is that a view is compared with.
        visible: squared difference of depths below which both views see a point, in squared scene units (DIST, B.3).
        photometric_weight: of the mean absolute difference of colours (Eq. 6).
        code_weight, code_average: see `bench.tasks.code.CodePenalty`.
        start_scale: of the random code at the start, in standard deviations of the prior's training codes; 0 is the
            mean shape.
        starts, trial: see `bench.starts.StartSettings`.
        coarse_blur: standard deviation of the Gaussian that the images begin with, as a share of their height; it falls
            to 0 over the first half of a start's iterations.
        scale, degrees, shift: by how much the shape is too large, turned and shifted at the start; where one is not
            neutral the similarity is optimised, too (DIST, Fig. 12). Degrees, scene units.
        iterations, learning_rate, schedule: see `bench.tasks.problem.OptimiserSettings`.
    """

    images: Photography
    focal: float
    views_per_step: int
    neighbour: int
    visible: float
    photometric_weight: float
    code_weight: float
    code_average: str
    start_scale: float
    starts: int
    trial: int
    coarse_blur: float
    scale: float
    degrees: float
    shift: float
    iterations: int
    learning_rate: float
    schedule: str

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
            check_at_least(f"task.{name}", getattr(self, name), 0, f"task.{name}=0 is the least")
        if not (LEAST_SCALE <= self.scale <= 1 / LEAST_SCALE and self.shift <= MOST_SHIFT):
            raise ValueError(
                f"task.scale must lie between {LEAST_SCALE} and {1 / LEAST_SCALE}, and task.shift be {MOST_SHIFT} at "
                f"most, not {self.scale} and {self.shift}: further off, a shape leaves the space priors are trained in"
            )
        self.turns.check(self.iterations)
        _ = self.optimiser, self.penalty

    @property
    def turns(self) -> StartSettings:
        """How the random codes share the iterations."""
        return StartSettings(self.starts, self.trial)

    @property
    def optimiser(self) -> OptimiserSettings:
        """For how long and how fast."""
        return OptimiserSettings(self.iterations, self.learning_rate, self.schedule)

    @property
    def penalty(self) -> CodePenalty:
        """What the code costs."""
        return CodePenalty(self.code_weight, self.code_average)

    def execute(self, cell: Cell) -> None:
        """Optimises the code, and judges the shape before and after."""
        apart = 360 / self.images.views * min(self.neighbour, self.images.views - self.neighbour)
        if apart > FAR_APART:
            told = f"compared photographs are {apart:.0f} degrees apart and share little: task.images.views=24 has 15"
            cell.record.notes = [*cell.record.notes, told]
        solve(self, cell)

    def problem(
        self, scene: Scene, prior: Prior, renderer: Renderer, *, seed: int, device: torch.device
    ) -> CodeProblem:
        """The problem of a scene's mesh."""
        check_field_gradient(renderer)
        own = scene.seed(seed)  # another texture and other codes for each shape
        generator = torch.Generator().manual_seed(own)
        photographs = self.images.take(Truth(scene.mesh), scene.view.camera.zoomed(self.focal), seed=own)
        given = GivenPhotographs(self, renderer, photographs, device)
        if len(prior.codes) < 2:
            raise ValueError("a prior of one shape has no spread to draw a code from: set scale.shapes=96")
        spread = self.start_scale * prior.codes.std(0)
        codes = spread * torch.randn(self.starts, prior.decoder.code_length, generator=generator)
        problem = code_problem(
            prior,
            self.penalty,
            given.compare,
            observed=torch.zeros_like(scene.view.mask),
            rays=2 * given.per_step * scene.view.mask.numel(),
            device=device,
            codes=codes,
            similarities=self._misplaced(generator) if self.scale != 1 or self.degrees or self.shift else None,
            trial=self.trial,
        )
        problem.photographs = given.colours.cpu().numpy()
        problem.judged_at = self.iterations  # the images are not blurred any more
        return problem

    def _misplaced(self, generator: torch.Generator) -> Float[Tensor, "starts 7"]:
        """A similarity of the given size in random directions, the same for all starts: it is what is known."""
        axis, direction = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator), dim=1)
        similarity = torch.cat([self.shift * direction, radians(self.degrees) * axis, torch.tensor([self.scale]).log()])
        return similarity.expand(self.starts, -1)


class GivenPhotographs:
    """The photographs; `compare` renders a field's depths and warps by them."""

    def __init__(self, settings: Multiview, renderer: Renderer, photographs: list[Photograph], device: torch.device):
        self.settings, self.renderer = settings, renderer
        self.cameras = [photograph.view.camera.to(device) for photograph in photographs]
        self.rays = [camera.rays() for camera in self.cameras]
        self.colours = torch.stack([photograph.colours for photograph in photographs]).to(device)
        self.per_step = min(settings.views_per_step, len(photographs))

    def pairs(self, iteration: int) -> list[tuple[int, int]]:
        """The views that an iteration compares, each with its neighbour."""
        count = len(self.cameras)
        views = [(iteration + round(k * count / self.per_step)) % count for k in range(self.per_step)]
        return [(view, (view + self.settings.neighbour) % count) for view in views]

    def compare(self, field: Field, iteration: int) -> Terms:
        """The weighted mean absolute difference of colours over the pixels that both views see (Eq. 6).

        Raises:
            NotReached: where there is no such pixel.
        """
        renderer = at_iteration(self.renderer, iteration)
        pairs = self.pairs(iteration)
        mine = renderer.render(field, self._together([pair[0] for pair in pairs]))
        with torch.no_grad():
            others = renderer.render(field, self._together([pair[1] for pair in pairs]))
        colours = self._blurred(iteration)
        differences = []
        for k, (view, other) in enumerate(pairs):
            pixels, depth = project(self.cameras[other], mine.points[k])
            with torch.no_grad():
                there = self.cameras[other].depth(others.distance[k])
                seen = mine.hit[k] & self._sees(there, others.hit[k], pixels, depth)
            warped, _ = sample(colours[other], pixels[seen])
            differences.append((warped - colours[view][seen]).abs().mean(-1))
        together = torch.cat(differences)
        if not len(together):
            raise NotReached(f"no point of the shape is seen by two neighbouring views at iteration {iteration}")
        return {"photometric": self.settings.photometric_weight * together.mean()}

    def _sees(
        self,
        depth: Float[Tensor, "height width"],
        hit: Bool[Tensor, "height width"],
        pixels: Float[Tensor, "height width 2"],
        expected: Float[Tensor, "height width"],
    ) -> Bool[Tensor, "height width"]:
        """Where a view's own depth agrees with that of the points that fall on `pixels` (DIST, B.3)."""
        both = torch.stack([depth * hit, hit.to(depth.dtype)], dim=-1)
        known, inside = sample(both, pixels)
        close = (known[..., 0] - expected).square() < self.settings.visible
        return inside & close & (known[..., 1] > SURE)

    def _together(self, views: list[int]) -> Rays:
        chosen = [self.rays[view] for view in views]
        origins = torch.stack([rays.origins for rays in chosen])
        return Rays(origins, torch.stack([rays.directions for rays in chosen]), image=True)

    def _blurred(self, iteration: int) -> Float[Tensor, "views height width 3"]:
        """The images at an iteration: coarse ones first, where that is asked for."""
        own = self.settings.turns.own(self.settings.iterations)
        sigma = self.settings.coarse_blur * self.colours.shape[1] * (1 - 2 * iteration / own)
        return self.colours if sigma <= 0 else blurred(self.colours, sigma)


def blurred(images: Float[Tensor, "views height width 3"], sigma: float) -> Float[Tensor, "views height width 3"]:
    """Images under a Gaussian whose standard deviation is in pixels; at their edges they are mirrored."""
    reach = min(int(3 * sigma) + 1, images.shape[1] - 1, images.shape[2] - 1)
    offsets = torch.arange(-reach, reach + 1, dtype=images.dtype, device=images.device)
    weights = torch.softmax(-0.5 * (offsets / sigma).square(), dim=0)
    flat = images.permute(0, 3, 1, 2).reshape(-1, 1, *images.shape[1:3])
    padded = torch.nn.functional.pad(flat, (reach, reach, reach, reach), mode="reflect")
    across = torch.nn.functional.conv2d(padded, weights.view(1, 1, 1, -1))
    both = torch.nn.functional.conv2d(across, weights.view(1, 1, -1, 1))
    return both.view(len(images), 3, *images.shape[1:3]).permute(0, 2, 3, 1)
