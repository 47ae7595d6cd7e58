"""The pictures of a run: of its frames, its result and its input; see `bench.solve.solve.Pictures`."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from bench.evaluate.state import State
from bench.pictures.filmstrip import Filmstrip, Shown
from bench.pictures.run_figures import InputView, draw_against, draw_curve, draw_run, save_gallery, save_images
from bench.records.format import values_in_words
from bench.setup.inputs import RunContext
from bench.solve.latent_code import CodeProblem
from bench.solve.solve import Solution
from datasets.scene import View


@runtime_checkable
class DrawsItself(Protocol):
    """A problem that draws its own pictures, and has the reference of the filmstrip's frames."""

    @property
    def shown(self) -> Shown: ...

    def draw(self, folder: Path, states: tuple[State, State], curve: list[dict[str, Any]], title: str) -> None:
        """Writes the pictures of the run, from the states before and after it, into its folder."""
        ...


class RunPictures(Filmstrip):
    def draw(self, run: RunContext, solution: Solution, *, gallery: bool) -> None:
        """Writes the pictures of a solved problem: its filmstrip, summary.png and curve.png, and images.npz."""
        problem, states, curve = solution.problem, solution.states, solution.curve
        draws_itself = problem if isinstance(problem, DrawsItself) else None

        def draw_pictures(title: str) -> None:
            if draws_itself is not None:
                draws_itself.draw(run.folder, states, curve, title)
            elif isinstance(problem, CodeProblem):
                view, observed = self.inputs.scene.observed_view()[0], problem.observed.cpu().numpy()
                observations = InputView(view, observed, problem.photographs, problem.mask, problem.coloured)
                draw_run(run.folder, states, observations, curve, title)
            else:
                draw_curve(run.folder / "curve.png", curve)

        draw(run, draw_pictures, self, truth=draws_itself and draws_itself.shown)
        if gallery and self.inputs.evaluation.gallery is not None:
            before, after = solution.meshes
            save_gallery(run.folder, self.inputs, problem.observed, {"start": before, "found": after})

    def compare(self, folder: Path, view: View, reference: View, *, title: str) -> None:
        """Writes images.npz, and summary.png, of a rendering and its reference."""
        save_images(folder, view, reference)
        draw_against(folder / "summary.png", view, reference, title=title)


def draw(
    run: RunContext, draw_pictures: Callable[[str], None], filmstrip: Filmstrip, truth: Shown | None = None
) -> None:
    """Writes filmstrip and pictures, by a function of their title, of a run whose result is in the record."""
    title, compared = run.record.outcome, run.record.compared()
    if run.inputs.evaluation.picture is not None:
        errors = [f"{label}: {values_in_words(values)}" for label, values, _ in compared[:1]]
        draw_pictures("\n".join([title, *errors]))
    filmstrip.save(run.folder, title, truth=truth)
