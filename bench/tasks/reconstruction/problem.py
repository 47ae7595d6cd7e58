"""The inverse problem of learning a shape with colours from random pixels of photographs."""

from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.evaluate.colours import colours_at
from bench.evaluate.evaluate import Evaluation
from bench.evaluate.state import State
from bench.pictures.filmstrip import Shown
from bench.solve.latent_code import Terms
from bench.solve.pixel_area import SEED_OF_RAYS
from bench.solve.pixel_draw import generator_of
from bench.tasks.reconstruction.background import Background
from bench.tasks.reconstruction.blur import PointBlur
from bench.tasks.reconstruction.cameras import CameraMotions
from bench.tasks.reconstruction.judge import field_scores, judge, surface_scores
from bench.tasks.reconstruction.losses import Losses
from bench.tasks.reconstruction.pictures import draw_reconstruction
from bench.tasks.reconstruction.pixels import Pixels, Stack
from bench.tasks.reconstruction.subject import Subject
from datasets.scene import View
from renderers.boundary import render_checked
from renderers.camera import Camera
from renderers.field import Coloured, Counts, Meter
from renderers.fields.networks.coloured import ColouredDistance, ColouredEncoded, ColouredGrid, ColouredOccupancy
from renderers.rendering import Renderer, at_iteration

OBJECTIVE_PIXELS = 4096  # compared before and after the optimisation
# Modules whose `field` is a Coloured.
Learnt = ColouredDistance | ColouredEncoded | ColouredOccupancy | ColouredGrid


@dataclass
class ReconstructionProblem:
    """The problem of learning a field with colours; each of `iterations` draws new pixels."""

    subject: Subject
    stack: Stack
    model: Learnt
    losses: Losses
    renderer: Renderer
    pixels_per_iteration: int
    iterations: int
    seed: int
    motions: CameraMotions
    background: Background | None = None
    blur: PointBlur = field(default_factory=PointBlur)
    rays_per_pixel: int = 1
    counts: Counts = field(default_factory=Counts)

    @property
    def parameters(self) -> list[Tensor]:
        more = [] if self.background is None else self.background.parameters()
        return [*self.model.parameters(), *more, *([self.motions.numbers] if self.motions.learnt else [])]

    @property
    def rays_per_iteration(self) -> int:
        return self.pixels_per_iteration * self.rays_per_pixel

    @property
    def tracked(self) -> tuple[str, ...]:
        """Metrics of checkpoints: on held-out photographs and, if it is known, on the true surface."""
        return ("psnr", *(["seen_chamfer_l1"] if self.subject.truth is not None else []))

    @property
    def observed(self) -> Bool[Tensor, "1 n"]:
        """A mask of the pixels with a given depth, of all photographs, flattened."""
        distance, colours = self.stack.pixels.distance, self.stack.pixels.colours
        return (torch.zeros_like(colours[:, 0]).bool() if distance is None else distance.isfinite())[None]

    @property
    def shown(self) -> Shown:
        """The held-out photograph for the filmstrip."""
        shot = self.subject.held_out[0]
        blank = torch.zeros(shot.camera.height, shot.camera.width)
        mask = torch.ones_like(blank).bool() if shot.mask is None else shot.mask
        normals = blank[..., None].expand(-1, -1, 3) if shot.normals is None else shot.normals
        return Shown(View(shot.camera, blank, normals, mask), shot.colours, shot.mask is not None)

    def field(self) -> Coloured:
        """A copy of the field at the current parameters; it counts operations like the learnt field."""
        return deepcopy(self.model).field

    def camera(self) -> Camera:
        return self.subject.held_out[0].camera

    def evaluate(self, state: State) -> Evaluation:
        evaluation = judge(state, self.subject)
        return replace(evaluation, metrics=evaluation.metrics | self.motions.errors())

    def checkpoint(self, state: State) -> dict[str, float]:
        scores = surface_scores(state.mesh, self.subject, state.inputs)
        scores |= field_scores(state, self.subject.held_out)
        return {name: scores[name] for name in self.tracked}

    def draw(self, folder: Path, states: tuple[State, State], curve: list[dict[str, Any]], title: str) -> None:
        draw_reconstruction(folder, states[1], self.subject, curve, title)

    def loss(self, iteration: int) -> Terms:
        """The terms and their sum, over new random pixels in each iteration."""
        patches = self.losses.colour_gradient > 0
        seed = generator_of(self.seed, iteration).initial_seed()
        pixels = self.stack.draw(self.pixels_per_iteration, patches=patches, seed=seed)
        if self.rays_per_pixel > 1:
            rays = generator_of(self.seed + SEED_OF_RAYS, iteration)
            pixels = self.stack.with_rays(pixels, self.rays_per_pixel, rays)
        pixels = self.motions.apply(pixels)
        pixels = self.blur.apply(pixels, iteration, self.iterations, self.seed)
        shape = self.model.field
        renderer = at_iteration(self.renderer, iteration)
        return self.losses(renderer, shape, Meter(shape, self.counts), pixels, self.background)

    def objective(self) -> float:
        """The mean difference of colours over a fixed set of input pixels.

        The loss is not used, because it compares hits only: it falls if the surface disappears.
        """
        pixels = self.stack.draw(OBJECTIVE_PIXELS, patches=False, seed=self.seed)
        return float(self.colour_errors(self.motions.apply(pixels)).mean())

    def colour_errors(self, pixels: Pixels) -> Float[Tensor, " n"]:
        """The mean difference of the three colours of each pixel; outside of the shape the background, else black."""
        shape = self.field()
        with torch.no_grad():
            rendering = render_checked(at_iteration(self.renderer, self.iterations), shape, pixels.rays)
        true_colours = pixels.colours if pixels.mask is None else pixels.colours * pixels.mask[:, None]
        with torch.no_grad():
            behind = torch.zeros_like(true_colours) if self.background is None else self.background(pixels.rays)
        rendered_colours = behind
        points, directions = rendering.points[rendering.hit], pixels.rays.directions[rendering.hit]
        rendered_colours[rendering.hit] = colours_at(shape, points, directions, points.device).to(true_colours)
        return (rendered_colours - true_colours).abs().mean(dim=-1)
