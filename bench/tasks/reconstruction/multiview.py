"""Shape from many views on the photographs of a dataset, such as those of a user."""

from dataclasses import dataclass, field, replace

import torch

from bench.pictures.run_figures import draw_curve
from bench.setup.inputs import RunContext, RunInputs
from bench.solve.latent_code import CodeProblem
from bench.solve.optimise import with_affordable_rays
from bench.solve.solve import COST_DEFINITIONS, check_field_gradient, run_optimisation
from bench.tasks.multiview import Multiview, PhotometricLoss
from bench.tasks.reconstruction.judge import COLOURED_DEFINITIONS, coloured, judge_mesh
from bench.tasks.reconstruction.pictures import note_surface
from bench.tasks.reconstruction.subject import NONE, Depths, PhotographTask, Subject, upright
from datasets.mesh import Mesh
from renderers.checks import BadInput
from renderers.field import Field
from renderers.rendering import check_kind


@dataclass(frozen=True)
class MultiviewOnPhotographs(Multiview, PhotographTask):
    """`Multiview` on the photographs of a dataset: some are held out, and the shape is evaluated on these."""

    depths: Depths = field(default=Depths(NONE, 0.0), init=False)

    def __post_init__(self) -> None:
        PhotographTask.__post_init__(self)
        Multiview.__post_init__(self)

    @property
    def _with_rotations(self) -> "MultiviewOnPhotographs":
        """The same task; with `similarity`, its starts are the mean shape in each of the rotations."""
        return replace(self, starts=self.rotations, start_scale=0.0) if self.similarity else self

    def check(self, inputs: RunInputs) -> None:
        """Raises BadInput without a prior, or for an encoder; ValueError for many rotations."""
        super().check(inputs)
        _ = self._with_rotations
        if self.encoder is not None:
            raise BadInput("an encoder learns made photographs, not yours: take +method=multiview_dist")

    def execute(self, run: RunContext) -> None:
        """Optimises the code, and evaluates the shape before and after on the held-out photographs."""
        self._with_rotations._optimise(run)

    def _optimise(self, run: RunContext) -> None:
        inputs, record = run.inputs, run.record
        check_field_gradient(inputs.renderer)
        record.definitions = COLOURED_DEFINITIONS | COST_DEFINITIONS
        subject = self.subject(inputs)
        record.notes = [*record.notes, subject.summary]

        def make(task: MultiviewOnPhotographs) -> CodeProblem:
            options = {"seed": inputs.seed, "rays_per_pixel": inputs.views.rays_per_pixel}
            shots, device = subject.input_shots, inputs.device
            loss = PhotometricLoss(task, inputs.renderer, shots, device, from_user=True, **options)
            return task.problem_of(inputs.prior, loss, torch.Generator().manual_seed(inputs.seed))

        problem = with_affordable_rays(self, make)
        check_kind(inputs.renderer, problem.field())

        def mesh() -> Mesh | None:
            return coloured(problem.field(), subject, inputs)

        def scores(iteration: int) -> dict[str, float]:
            metrics = judge_mesh(mesh(), subject, inputs).metrics
            return {name: metrics[name] for name in ("psnr", "seen_chamfer_l1") if name in metrics}

        with run.off_clock():
            record.metrics_start = judge_mesh(mesh(), subject, inputs).metrics
        history = run_optimisation(problem, self.optimiser, run, scores)
        with run.off_clock():
            note_surface(run, mesh(), subject, {}, history, problem.field())
            draw_curve(run.folder / "curve.png", history.curve)
        subject.finish(run)

    def subject(self, inputs: RunInputs) -> Subject:
        subject = super().subject(inputs)
        return upright(subject) if self.similarity else subject

    def field_metrics(self, field: Field, run: RunContext) -> dict[str, float]:
        subject = self.subject(run.inputs)
        evaluation = judge_mesh(coloured(field, subject, run.inputs), subject, run.inputs)
        return evaluation.metrics | subject.point_metrics(evaluation.mesh, run.inputs)
