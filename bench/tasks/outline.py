"""Shape from the outline in one view alone: which silhouette losses fit it, with how many rays per pixel."""

from dataclasses import dataclass, replace
from typing import ClassVar

from bench.evaluate.evaluate import Evaluation
from bench.evaluate.state import State
from bench.setup.inputs import RunContext
from bench.solve.latent_code import CodeProblem
from bench.tasks.completion import Completion
from datasets.scene import see_area

DEFINITIONS = {
    "area_error": "Sum over pixels of the absolute difference between the fractions that the extracted mesh and the "
    "true one cover, in pixels. A fraction is the mean over 8 x 8 rays. Infinite without a surface."
}


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
    """Completion with the metric `area_error`; its YAML gives the mask alone."""

    problem_class: ClassVar[type[CodeProblem]] = OutlineProblem

    def execute(self, run: RunContext) -> None:
        """Optimises the code, and evaluates the shape and its outline before and after."""
        try:
            super().execute(run)
        finally:
            run.record.definitions = run.record.definitions | DEFINITIONS


def area_error(state: State) -> dict[str, float]:
    """The metric of `DEFINITIONS`."""
    if state.raycaster is None:
        return {"area_error": float("inf")}
    camera = state.inputs.scene.view.camera
    shown, true = (see_area(mesh, camera)[0] for mesh in (state.raycaster, state.inputs.scene.raycaster))
    return {"area_error": float((shown - true).abs().sum())}
