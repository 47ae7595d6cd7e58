"""Shape completion: optimises a latent code to match a sparse depth image and a mask (DIST, Sec. 4.2.1)."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import torch

from bench.config import extension
from bench.setup.inputs import RunContext, RunInputs
from bench.shape_prior import Prior
from bench.solve.latent_code import CodePenalty, CodeProblem, initial_rotations, total
from bench.solve.observed_view import DEPTH_LOSSES, ObservedView
from bench.solve.optimise import HELD_OUT, OptimiserSettings, StartSettings, with_affordable_rays
from bench.solve.pixel_draw import PixelDraw
from bench.solve.solve import check_field_gradient, save_in_world, solve_task
from datasets.scene import OneView, Scanned, Scene, unshaded_image
from datasets.views import observed_pixels, parse_amount
from renderers.checks import BadInput, check_at_least, check_choice, check_positive
from renderers.rendering import Renderer
from renderers.silhouette import SilhouetteLoss

MEASURED, EXACT = "measured", "exact"


@dataclass(frozen=True)
class Completion:
    """Shape from one sparse depth image, with or without its mask, and shape and colour from a colour image.

    Args:
        points: amount of given depth; see `datasets.views.observed_pixels`. Dense depth implies the mask.
        depths: "measured": the scanner's depths if the dataset has them; "exact": the mesh's depths at the same pixels.
        mask: whether the mask is given.
        depth_loss: mean over observed pixels that hit, of "depth", the error of the camera's depth (DIST, B.3), or of
            "points", the distance in space between the points (DVR's official code).
        depth_weight: weight of the depth loss.
        normal_weight: weight of 1 minus the cosine between the normals of the rendered surface and the true ones, the
            mean over the same pixels (DIST, B.3). Above 0, the normals of these pixels are given too.
        normal_width: width of the finite differences for the rendered surface's normals, in scene units; see
            `bench.solve.observed_view.central_differences`.
        colour_weight: weight of the mean absolute error of colours over pixels on the shape that hit (DIST, B.3).
            Above 0, the colours of these pixels are given, and the prior must have colours.
        silhouette: the silhouette loss.
        silhouette_weight: weight of the silhouette loss.
        code: penalty on the code.
        similarity: whether a shift, a rotation and a size of the prior's shape are also optimised.
        rotations: number of initial rotations of the similarity, about the vertical axis.
        trial: iterations of each start; see `bench.solve.optimise.StartSettings`.
        optimiser: iterations and learning rates.
        pixel_block: pixels per side of a block of which each iteration compares one random pixel; 1 compares all; 0:
            the smallest block that the budget affords, see `bench.solve.optimise.with_affordable_rays`.
    """

    points: str
    depths: str
    mask: bool
    depth_loss: str
    depth_weight: float
    normal_weight: float
    normal_width: float
    colour_weight: float
    silhouette: SilhouetteLoss
    silhouette_weight: float
    code: CodePenalty
    similarity: bool
    rotations: int
    trial: int
    optimiser: OptimiserSettings
    pixel_block: int = 1

    takes_field: ClassVar[bool] = True
    takes_one_view: ClassVar[bool] = True
    takes_rays_per_pixel: ClassVar[bool] = True
    problem_class: ClassVar[type[CodeProblem]] = CodeProblem
    fractions: ClassVar[bool | None] = None

    def __post_init__(self) -> None:
        parse_amount(self.points)
        check_choice("task.depths", self.depths, (MEASURED, EXACT))
        check_choice("task.depth_loss", self.depth_loss, DEPTH_LOSSES)
        for name in ("depth_weight", "normal_weight", "colour_weight", "silhouette_weight"):
            check_at_least(f"task.{name}", getattr(self, name), 0, "0 switches the term off")
        check_positive("task.normal_width", self.normal_width, "0.02 is two thirds of a pixel at 64 x 64")
        check_at_least("task.pixel_block", self.pixel_block, 0, "2 compares a quarter of the pixels")
        check_at_least("task.rotations", self.rotations, 1, "12 are 30 degrees apart")
        if self.similarity:
            StartSettings(self.rotations, self.trial).check(self.optimiser)

    def check(self, inputs: RunInputs) -> None:
        """Raises BadInput if the settings need a prior, or one with colours, and there is none."""
        if inputs.field.of_prior:
            inputs.check_prior()
        if inputs.views.rays_per_pixel > 1 and (
            self.normal_weight or self.colour_weight or not inputs.field.of_prior or isinstance(inputs.dataset, OneView)
        ):
            raise BadInput(
                "several rays per pixel compare depths and masks of a true mesh by field=prior: remove "
                "view.rays_per_pixel, or set task.normal_weight=0 task.colour_weight=0 field=prior"
            )
        if inputs.views.rays_per_pixel > 1 and isinstance(inputs.dataset, Scanned) and self.depths == MEASURED:
            raise BadInput(
                "a scanner measures no area of a pixel: remove view.rays_per_pixel, or set task.depths=exact"
            )
        if self.colour_weight and not (inputs.prior_choice.coloured and inputs.field.of_prior):
            raise BadInput("task.colour_weight needs codes of shape and colour: set prior=textured field=prior")
        if self.colour_weight and (self.similarity or isinstance(inputs.dataset, OneView)):
            raise BadInput("colours are compared of shapes that stand as the prior's do: set task.colour_weight=0")

    def execute(self, run: RunContext) -> None:
        """Optimises the code, or the requested field, and evaluates the shape before and after."""
        run.record.notes = [*run.record.notes, *run.inputs.scene.measured_depth_notes]
        inputs = run.inputs
        if inputs.field.of_prior:
            state = solve_task(self, run)
            if self.colour_weight:
                extension("colours")(run, state)
        else:
            check_field_gradient(inputs.renderer)
            view = self._observed_view(inputs.scene, inputs.renderer, seed=inputs.seed, device=inputs.device)
            true_view, _ = inputs.scene.observed_view(exact=self.depths == EXACT)
            extension("fit")(view, true_view, run, iterations=self.optimiser.iterations)
        if inputs.scene.to_world is not None:
            save_in_world(run.folder, inputs.scene.to_world)

    def problem(
        self, scene: Scene, prior: Prior, renderer: Renderer, *, seed: int, device: torch.device
    ) -> CodeProblem:
        """The problem of a scene; it starts from code zero, the mean shape, in each rotation."""
        check_field_gradient(renderer)
        if not self.pixel_block:
            of_scene = {"seed": seed, "device": device}
            return with_affordable_rays(self, lambda task: task.problem(scene, prior, renderer, **of_scene))
        observed_view = self._observed_view(scene, renderer, seed=seed, device=device)
        compared = observed_view.observed & (self.depth_weight > 0)
        holds_out, last = self.optimiser.ends == HELD_OUT, self.optimiser.iterations
        draw = PixelDraw(observed_view.observed, self.pixel_block, scene.seed(seed), holds_out=holds_out)
        compare = partial(observed_view.compare_drawn, draw)
        options: dict[str, Any] = {"draw": draw, "mask": observed_view.mask is not None}
        options["coloured"] = self.colour_weight > 0
        if holds_out or self.pixel_block > 1 or scene.rays_per_pixel > 1:
            options["progress_measure"] = lambda field: float(total(observed_view.compare(field, last)))
        if holds_out:
            held_out = observed_view.flat().drawn(draw.held_out.to(device))
            options["held_out"] = lambda field: held_out.compare(field, last)
        if self.similarity:
            options["initial"] = torch.zeros(self.rotations, prior.decoder.code_length)
            options |= {"initial_similarities": initial_rotations(self.rotations), "trial": self.trial}
        rays = scene.rays_per_pixel
        return self.problem_class(prior, self.code, compare, compared, rays, device, **options)

    def _observed_view(self, scene: Scene, renderer: Renderer, *, seed: int, device: torch.device) -> ObservedView:
        """The observed part of a scene's view."""
        view, measured = scene.observed_view(exact=self.depths == EXACT)
        observed = observed_pixels(measured, self.points, seed)
        mask = view.mask if self.mask or self.points == "dense" else None
        observed_view = ObservedView.of(view, self, renderer, observed=observed, mask=mask, device=device)
        if self.normal_weight:
            normal_settings = {"normal_weight": self.normal_weight, "normal_width": self.normal_width}
            observed_view = replace(observed_view, normals=view.normals.to(device), **normal_settings)
        if self.colour_weight:
            image = unshaded_image(view, scene.texture).where(view.mask[..., None], torch.nan)
            observed_view = replace(observed_view, colours=image.to(device), colour_weight=self.colour_weight)
        return observed_view.with_area(scene, view.camera, scene.seed(seed), self.fractions)
