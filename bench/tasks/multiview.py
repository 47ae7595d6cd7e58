"""Shape from many views: optimises the code for photometric consistency between views (DIST, Sec. 4.2.2)."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import radians
from typing import ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bench.setup.inputs import RunContext, RunInputs
from bench.shape_prior import Prior
from bench.solve.latent_code import CodePenalty, CodeProblem, Terms, initial_rotations, total
from bench.solve.optimise import CannotContinue, OptimiserSettings, StartSettings, with_affordable_rays
from bench.solve.pixel_area import observation_of, random_rays_of
from bench.solve.pixel_draw import PixelDraw
from bench.solve.solve import check_field_gradient, metric_definitions, solve_and_draw
from datasets.photographs import Photography
from datasets.scene import Scene
from datasets.shot import Shot
from renderers.boundary import render_checked
from renderers.camera import Rays, stacked
from renderers.checks import BadInput, check_at_least, check_positive
from renderers.field import Field
from renderers.rendering import RayObservation, Renderer, Rendering, at_iteration
from renderers.schedule import schedule_position
from renderers.silhouette import SilhouetteLoss

MIN_SCALE, MAX_SHIFT = 0.8, 0.2
MIN_INTERPOLATION_WEIGHT = 0.999  # a depth is interpolated only if pixels on the shape have this weight
MAX_NEIGHBOUR_DEGREES = 60.0  # above this angle between compared photographs, the record has a note


@runtime_checkable
class CodeEncoder(Protocol):
    """Gives the code from which the optimisation starts."""

    def start(
        self, run: RunContext, photography: Photography, photographs: Float[Tensor, "views height width 3"]
    ) -> Float[Tensor, " code_length"]:
        """The mean code of the photographs, which `photography` took."""


@dataclass(frozen=True)
class Multiview:
    """Shape from photographs whose cameras are known. The photographs are rendered from the scene's mesh.

    Args:
        images: settings of the photographs.
        longest, held_out, masks: of the user's photographs; see `PhotographTask`.
        focal: focal length of the photographs' cameras over that of the scene's camera (DIST, Fig. 10 a).
        views_per_step: number of views in an iteration, evenly spaced; they shift by one with each iteration.
        neighbour: a view is compared with the view that follows by this many.
        visible: squared difference of depths below which both views see a point, in squared scene units (DIST, B.3).
        photometric_weight: weight of the mean absolute difference of colours (Eq. 6).
        code: penalty on the code.
        start_scale: standard deviation of the random initial code, relative to the prior's training codes; 0 is the
            mean shape.
        starts, trial: see `bench.solve.optimise.StartSettings`.
        coarse_blur: standard deviation of the initial Gaussian blur of the images, as a fraction of their height; it
            falls to 0 over the first half of a start's iterations.
        rotations: number of initial rotations about the vertical axis, for a similarity on the user's photographs.
        silhouette, silhouette_weight: the silhouette loss and its weight; 0 switches it off. Eq. 6 is a mean over
            pixels that the shape covers: without this loss, pixels of the object that it does not cover cost nothing.
        scale, degrees, shift: scale (ratio), rotation (degrees) and shift (scene units) of the initial shape relative
            to the true one. If one is not neutral, a similarity transform is optimised too (DIST, Fig. 12).
        similarity: whether a similarity transform is optimised in any case.
        optimiser: iterations and learning rates.
        pixel_block: see `bench.tasks.completion.Completion`; of each compared view.
        encoder: gives the mean of the initial codes, averaged over the photographs; None: zero, the mean shape.
        fractions: whether the silhouette loss compares fractions of pixels that the shape covers, with random rays, or
            masks of their centres. None: fractions with several rays per pixel.
    """

    images: Photography
    longest: int
    held_out: int
    masks: bool
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
    rotations: int
    silhouette: SilhouetteLoss
    silhouette_weight: float
    optimiser: OptimiserSettings
    pixel_block: int = 1
    encoder: CodeEncoder | None = None
    fractions: bool | None = None

    takes_rays_per_pixel: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_at_least("task.views_per_step", self.views_per_step, 1, "the paper uses 8")
        check_at_least("task.neighbour", self.neighbour, 1, "1 is the closest next view")
        if self.neighbour % self.images.views == 0:
            reason = f"task.neighbour={self.neighbour} compares each of {self.images.views} views with itself"
            raise ValueError(f"{reason}: set task.neighbour=1")
        check_at_least("task.pixel_block", self.pixel_block, 0, "2 compares a quarter of the pixels")
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
        check_at_least("task.rotations", self.rotations, 1, "12 are 30 degrees apart")
        check_at_least("task.silhouette_weight", self.silhouette_weight, 0, "0 switches the term off")
        self.start_settings.check(self.optimiser)

    @property
    def start_settings(self) -> StartSettings:
        """The number of starts, and the iterations of each start's trial."""
        return StartSettings(self.starts, self.trial)

    def compares_fractions(self, rays_per_pixel: int) -> bool:
        """Whether the silhouette loss compares fractions of pixels."""
        return rays_per_pixel > 1 if self.fractions is None else self.fractions

    def check(self, inputs: RunInputs) -> None:
        """Raises BadInput without a prior."""
        inputs.check_prior()

    def execute(self, run: RunContext) -> None:
        """Optimises the code, and evaluates the shape before and after."""
        angle = 360 / self.images.views * min(self.neighbour, self.images.views - self.neighbour)
        if angle > MAX_NEIGHBOUR_DEGREES:
            note = f"compared photographs are {angle:.0f} degrees apart and share little: task.images.views=24 has 15"
            run.record.notes = [*run.record.notes, note]
        inputs = run.inputs

        def problem() -> CodeProblem:
            built = self.problem(inputs.scene, inputs.prior, inputs.renderer, seed=inputs.seed, device=inputs.device)
            if self.encoder is not None and built.photographs is not None:
                mean_code = self.encoder.start(run, self.images, torch.from_numpy(built.photographs))
                for code in built.codes:
                    code.data += mean_code.to(code)
            return built

        solve_and_draw(problem, self.optimiser, run, metric_definitions(inputs), gallery=True)

    def problem(
        self, scene: Scene, prior: Prior, renderer: Renderer, *, seed: int, device: torch.device
    ) -> CodeProblem:
        """The problem of a scene: the code and, if the initial shape is misplaced, a similarity transform."""
        check_field_gradient(renderer)
        if not self.pixel_block:
            of_scene = {"seed": seed, "device": device}
            return with_affordable_rays(self, lambda task: task.problem(scene, prior, renderer, **of_scene))
        scene_seed = scene.seed(seed)  # so that each shape has another texture and other codes
        generator = torch.Generator().manual_seed(scene_seed)
        rays, camera = scene.rays_per_pixel, scene.view.camera.zoomed(self.focal)
        areas = self.compares_fractions(rays) and self.silhouette_weight > 0
        photographs = self.images.take(scene.raycaster, camera, seed=scene_seed, areas=areas)
        loss = PhotometricLoss(self, renderer, photographs, device, seed=scene_seed, rays_per_pixel=rays)
        return self.problem_of(prior, loss, generator)

    def problem_of(self, prior: Prior, photometric_loss: "PhotometricLoss", generator: torch.Generator) -> CodeProblem:
        """The problem of a loss; `generator` draws the initial codes."""
        if len(prior.codes) < 2:
            raise BadInput("a prior of one shape has no spread from which to draw codes: set prior.shapes=96")
        code_std = self.start_scale * prior.codes.std(0)
        codes = code_std * torch.randn(self.starts, prior.decoder.code_length, generator=generator)
        similarities = None
        if self.similarity or self.scale != 1 or self.degrees > 0 or self.shift > 0:
            axis, direction = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator), dim=1)
            numbers = [self.shift * direction, radians(self.degrees) * axis, torch.tensor([self.scale]).log()]
            similarities = torch.cat(numbers).expand(self.starts, -1)
        if photometric_loss.from_user and self.similarity:
            similarities = initial_rotations(self.starts)
        observed = torch.zeros(photometric_loss.colours.shape[1:3], dtype=torch.bool, device="cpu")
        last = self.optimiser.iterations  # when images are no longer blurred
        return CodeProblem(
            prior,
            self.code,
            photometric_loss.compare,
            observed,
            (photometric_loss.rays_per_pixel + 1) * photometric_loss.per_step,
            photometric_loss.colours.device,
            initial=codes,
            initial_similarities=similarities,
            trial=self.trial,
            photographs=photometric_loss.colours.cpu().numpy(),
            progress_measure=lambda field: float(total(photometric_loss.compare_at(field, last))),
            draw=photometric_loss.draw,
        )


class PhotometricLoss:
    """Compares photographs: `compare` renders a field's depths and warps the photographs by them.

    A pixel with several rays is compared if all of them hit and the neighbour sees at least half of their points, by
    the mean of their colours there. The silhouette loss compares covered fractions; see `bench.solve.pixel_area`.
    """

    def __init__(
        self,
        settings: Multiview,
        renderer: Renderer,
        photographs: Sequence[Shot],
        device: torch.device,
        *,
        from_user: bool = False,
        seed: int = 0,
        rays_per_pixel: int = 1,
    ):
        """Stores the photographs. The user's photographs have any order: neighbours are chosen by distance.

        Args:
            seed: of the pixels that iterations compare, and of their rays.
            rays_per_pixel: see `datasets.views.ViewSampler`; the neighbours have one.

        Raises:
            BadInput: if photographs differ in size.
        """
        self.settings, self.renderer, self.from_user, self.seed = settings, renderer, from_user, seed
        self.rays_per_pixel, fractions = rays_per_pixel, settings.compares_fractions(rays_per_pixel)
        self.random_rays = rays_per_pixel > 1 or fractions  # else they go through the centres of pixels
        if len({photograph.colours.shape for photograph in photographs}) > 1:
            raise BadInput("task=multiview compares photographs of one size, and these differ: leave others out")
        self.cameras = [photograph.camera.to(device) for photograph in photographs]
        self.rays = [camera.rays() for camera in self.cameras]
        self.colours = torch.stack([photograph.colours for photograph in photographs]).to(device)
        self.per_step = min(settings.views_per_step, len(photographs))
        count = len(photographs)
        masks = [
            shot.covered if fractions else shot.mask
            for shot in photographs
            if settings.silhouette_weight and shot.mask is not None
        ]
        self.neighbours = [(view + settings.neighbour) % count for view in range(count)]
        if from_user:
            centres = torch.stack([camera.center for camera in self.cameras])
            nearest = torch.cdist(centres, centres).argsort(dim=1)  # the first is the view itself
            self.neighbours = nearest[:, min(settings.neighbour, count - 1)].tolist()
        self.masks = torch.stack(masks).to(device) if masks else None  # or fractions
        pixels = torch.ones(self.colours.shape[1:3], dtype=torch.bool)
        self.draw = PixelDraw(pixels, settings.pixel_block, seed)  # the same in each view

    def pairs(self, iteration: int) -> list[tuple[int, int]]:
        """The views that an iteration compares, evenly spaced, each paired with its neighbour; they shift by one."""
        count = len(self.cameras)
        views = [(iteration + round(k * count / self.per_step)) % count for k in range(self.per_step)]
        return [(view, self.neighbours[view]) for view in views]

    def compare(self, field: Field, iteration: int) -> Terms:
        """The terms of the pixels that an iteration draws; see `compare_at`."""
        return self.compare_at(field, iteration, self.draw.pixels(iteration))

    def compare_at(self, field: Field, iteration: int, drawn: Int[Tensor, " n"] | None = None) -> Terms:
        """The weighted mean absolute difference of colours over the pixels that both views see (Eq. 6).

        Of drawn pixels, it is 0 if both views see none of them.

        Args:
            drawn: pixels of each view, by rows; None: all.

        Raises:
            CannotContinue: if no pixel is visible in both views, of all pixels.
        """
        renderer, images = at_iteration(self.renderer, iteration), self.images_at(iteration)
        views, neighbours = map(list, zip(*self.pairs(iteration), strict=True))
        observed = images[views]
        if self.random_rays:
            rays = random_rays_of([self.cameras[view] for view in views], self.rays_per_pixel, self.seed, iteration)
        else:
            rays = self._stack_rays(views)
        is_drawn = drawn is not None
        if is_drawn:
            drawn = drawn.to(self.colours.device)
            rays = Rays(rays.origins.flatten(1, 2)[:, drawn], rays.directions.flatten(1, 2)[:, drawn])
            observed = observed.flatten(1, 2)[:, drawn]
        rendering = render_checked(renderer, field, rays)
        visible = self._visible(renderer, field, rendering, neighbours, is_drawn)
        differences = []
        for k, other in enumerate(neighbours):
            shown = compared = visible[k]
            if self.random_rays:
                shown = rendering.hit[k].all(-1) & (2 * visible[k].sum(-1) >= self.rays_per_pixel)
                compared = visible[k] & shown[..., None]
            pixels, _ = self.cameras[other].project(rendering.points[k][compared])
            warped, inside = sample(images[other], pixels)
            if self.random_rays and len(warped):  # the neighbour sees these points, so they are inside
                warped, inside = torch.segment_reduce(warped, "mean", lengths=compared[shown].sum(-1)), slice(None)
            differences.append((warped - observed[k][shown])[inside].abs().mean(-1))
        errors = torch.cat(differences)
        if not len(errors) and not is_drawn:
            raise CannotContinue(f"no point of the shape is seen by two neighbouring views at iteration {iteration}")
        photometric = errors.mean() if len(errors) else errors.sum()  # of a draw without such a point: 0
        terms = {"photometric": self.settings.photometric_weight * photometric}
        if self.masks is not None:
            masks = self.masks[views].flatten(1)[:, drawn] if is_drawn else self.masks[views]
            unknown = torch.full_like(masks, torch.nan, dtype=rendering.distance.dtype)
            if self.random_rays:
                observation = observation_of(masks.to(unknown), unknown, rendering)
            else:
                observation = RayObservation(masks, unknown)
            silhouette = self.settings.silhouette(renderer, field, rays, rendering, observation)
            terms["silhouette"] = self.settings.silhouette_weight * silhouette
        return terms

    @torch.no_grad()
    def _visible(
        self, renderer: Renderer, field: Field, rendering: Rendering, neighbours: list[int], is_drawn: bool
    ) -> Bool[Tensor, "views ..."]:
        """Whether the hits of views are seen by the neighbours. Of drawn pixels, only the needed ones are rendered."""
        projected = [self.cameras[other].project(rendering.points[k]) for k, other in enumerate(neighbours)]
        rays = self._stack_rays(neighbours)
        if not is_drawn:
            neighbour = render_checked(renderer, field, rays)
            distance, hit = neighbour.distance, neighbour.hit
        else:
            positions = [pixels[rendering.hit[k]] for k, (pixels, _) in enumerate(projected)]
            needed = torch.stack([pixels_around(centres, *self.colours.shape[1:3]) for centres in positions])
            neighbour = render_checked(renderer, field, rays[needed])
            distance = torch.zeros_like(needed, dtype=neighbour.distance.dtype)
            distance = distance.masked_scatter(needed, neighbour.distance)
            hit = needed.clone().masked_scatter(needed, neighbour.hit)
        agree = []
        for k, (pixels, expected) in enumerate(projected):  # the neighbour's depth agrees with that of the point (B.3)
            depth = self.cameras[neighbours[k]].depth(distance[k])
            interpolated, inside = sample(torch.stack([depth * hit[k], hit[k].to(depth.dtype)], dim=-1), pixels)
            close = (interpolated[..., 0] - expected).square() < self.settings.visible
            agree.append(inside & close & (interpolated[..., 1] > MIN_INTERPOLATION_WEIGHT))
        return rendering.hit & torch.stack(agree)

    def _stack_rays(self, views: list[int]) -> Rays:
        return stacked([self.rays[view] for view in views])

    def images_at(self, iteration: int) -> Float[Tensor, "views height width 3"]:
        """The images at an iteration; `coarse_blur` blurs them in the first half."""
        iterations = self.settings.start_settings.iterations_of_last(self.settings.optimiser.iterations)
        sigma = self.settings.coarse_blur * self.colours.shape[1] * (1 - 2 * schedule_position(iteration) / iterations)
        return self.colours if sigma <= 0 else blur(self.colours, sigma)


def blur(images: Float[Tensor, "views height width 3"], sigma: float) -> Float[Tensor, "views height width 3"]:
    """Images convolved with a Gaussian of standard deviation `sigma` in pixels; mirrored at their edges."""
    radius = min(int(3 * sigma) + 1, images.shape[1] - 1, images.shape[2] - 1)
    offsets = torch.arange(-radius, radius + 1, dtype=images.dtype, device=images.device)
    weights = torch.softmax(-0.5 * (offsets / sigma).square(), dim=0)
    channels = images.permute(0, 3, 1, 2).reshape(-1, 1, *images.shape[1:3])
    padded = torch.nn.functional.pad(channels, (radius, radius, radius, radius), mode="reflect")
    horizontal = torch.nn.functional.conv2d(padded, weights.view(1, 1, 1, -1))
    smoothed = torch.nn.functional.conv2d(horizontal, weights.view(1, 1, -1, 1))
    return smoothed.view(len(images), 3, *images.shape[1:3]).permute(0, 2, 3, 1)


def pixels_around(positions: Float[Tensor, "n 2"], height: int, width: int) -> Bool[Tensor, "height width"]:
    """The pixels between whose centres `sample` interpolates at these positions (column, row)."""
    around = torch.zeros(height, width, dtype=torch.bool, device=positions.device)
    for shift in torch.cartesian_prod(torch.arange(2), torch.arange(2)).to(positions.device):
        column, row = ((positions - 0.5).floor().long() + shift).unbind(-1)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        around[row[inside], column[inside]] = True
    return around


def sample(
    image: Float[Tensor, "height width channels"], pixels: Float[Tensor, "*batch 2"]
) -> tuple[Float[Tensor, "*batch channels"], Bool[Tensor, "*batch"]]:
    """Interpolates an image bilinearly between the centres of its pixels.

    Returns:
        colours: 0 where `pixels` lie beyond the outermost centres, so that nothing is extrapolated.
        inside: false there.
    """
    height, width, _ = image.shape
    inside = (pixels >= 0.5).all(-1) & (pixels[..., 0] <= width - 0.5) & (pixels[..., 1] <= height - 0.5)
    position = torch.where(inside[..., None], pixels, 0.5) - 0.5
    last = torch.tensor([max(width - 2, 0), max(height - 2, 0)], dtype=position.dtype, device=position.device)
    corner = torch.minimum(position.detach().floor(), last)
    right_weight, lower_weight = (position - corner)[..., :1], (position - corner)[..., 1:]
    column, row = corner.long().unbind(-1)
    right, below = (column + 1).clamp_max(width - 1), (row + 1).clamp_max(height - 1)
    upper = image[row, column] * (1 - right_weight) + image[row, right] * right_weight
    lower = image[below, column] * (1 - right_weight) + image[below, right] * right_weight
    return (upper * (1 - lower_weight) + lower * lower_weight) * inside[..., None], inside
