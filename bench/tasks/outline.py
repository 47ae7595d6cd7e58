"""Shape from the outline in one view alone: which silhouette losses fit it, with how many rays per pixel."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import torch
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.figure import Figure
from torch import Tensor

from bench.evaluate.evaluate import Evaluation
from bench.evaluate.state import State
from bench.pictures.style import SCREEN, bare, save
from bench.setup.inputs import RunContext
from bench.solve.latent_code import CodeProblem
from bench.tasks.completion import Completion
from datasets.mesh import Mesh
from datasets.scene import Scene, Truth, see_area

DEFINITIONS = {
    "area_error": "Sum over pixels of the absolute difference between the fractions that the extracted mesh and the "
    "true one cover, in pixels. A fraction is the mean over 8 x 8 rays. Infinite without a surface."
}
PICTURE = "outline.png"


@dataclass
class OutlineProblem(CodeProblem):
    """A code whose shape should cover each pixel as the true shape does."""

    tracked: ClassVar[tuple[str, ...]] = (*CodeProblem.tracked, "area_error")

    def evaluate(self, state: State) -> Evaluation:
        """The errors of the current shape, and of the area that it covers."""
        evaluation = super().evaluate(state)
        return replace(evaluation, metrics=evaluation.metrics | area_error(state))

    def checkpoint(self, state: State) -> dict[str, float]:
        """The Chamfer distances and the error of the area."""
        return super().checkpoint(state) | area_error(state)


@dataclass(frozen=True)
class Outline(Completion):
    """Completion with the metric `area_error`, and a picture of it; its YAML gives the mask alone.

    Args:
        fractions: see `bench.solve.observed_view.ObservedView.with_area`.
    """

    fractions: bool | None = None

    problem_class: ClassVar[type[CodeProblem]] = OutlineProblem

    def execute(self, run: RunContext) -> None:
        """Optimises the code, and evaluates the shape and its outline before and after."""
        try:
            super().execute(run)
        finally:
            run.record.definitions = run.record.definitions | DEFINITIONS
        mesh_file = run.folder / "mesh.ply"
        if run.inputs.evaluation.picture is not None and mesh_file.is_file():
            with run.off_clock():
                shown = covered(Truth(Mesh.load(mesh_file), closed=False), run.inputs.scene)
                draw(run.folder / PICTURE, shown, covered(run.inputs.scene.raycaster, run.inputs.scene))


def covered(mesh: Truth, scene: Scene) -> Float[Tensor, "height width"]:
    """The fraction of each pixel of the scene's view that a mesh covers."""
    return see_area(mesh, scene.view.camera)[0]


def area_error(state: State) -> dict[str, float]:
    """The metric of `DEFINITIONS`."""
    if state.raycaster is None:
        return {"area_error": float("inf")}
    scene = state.inputs.scene
    return {"area_error": float((covered(state.raycaster, scene) - covered(scene.raycaster, scene)).abs().sum())}


@rc_context(SCREEN)
def draw(path: Path, shown: Float[Tensor, "height width"], true: Float[Tensor, "height width"]) -> None:
    """Draws the fractions of pixels that the final and the true shape cover, and their difference."""
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    axes, error = figure.subplots(1, 3), shown - true
    for axis, image, title in zip(axes, (shown, true), ("after", "truth"), strict=False):
        drawn = bare(axis).imshow(image, cmap="Greys", vmin=0, vmax=1, interpolation="nearest")
        axis.set_title(title)
    figure.colorbar(drawn, ax=axes[:2], label="covered fraction of the pixel", shrink=0.8)
    drawn = bare(axes[2]).imshow(error, cmap="RdBu_r", vmin=-1, vmax=1, interpolation="nearest")
    axes[2].set_title(f"after - truth: {torch.sum(error.abs()):.1f} pixels")
    figure.colorbar(drawn, ax=axes[2], label="blue: too small, red: too large", shrink=0.8)
    save(figure, path)
