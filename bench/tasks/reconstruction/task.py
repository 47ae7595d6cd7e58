"""Shape and colour from photographs with known cameras, without a prior (DVR, Secs. 3.1 to 3.5, 4.2)."""

from dataclasses import dataclass
from typing import ClassVar
from zlib import crc32

import torch

from bench.config import AUTO
from bench.evaluate.state import State
from bench.setup.inputs import RunContext, RunInputs
from bench.solve.optimise import BUDGET, OptimiserSettings, with_affordable_rays
from bench.solve.solve import check_field_gradient, solve_and_draw
from bench.tasks.capacity.names import parse_field_name
from bench.tasks.reconstruction import background as behind
from bench.tasks.reconstruction import cameras
from bench.tasks.reconstruction.blur import BLUR_SHARE, PointBlur
from bench.tasks.reconstruction.choice import DEFINITIONS, Appearance, AutoField
from bench.tasks.reconstruction.judge import COLOURED_DEFINITIONS, judge
from bench.tasks.reconstruction.losses import Losses
from bench.tasks.reconstruction.pixels import Stack
from bench.tasks.reconstruction.problem import ReconstructionProblem
from bench.tasks.reconstruction.subject import (
    GIVEN,
    GUIDES,
    HULL,
    NONE,
    PhotographTask,
    Subject,
    given_distances,
    hull_distances,
)
from renderers.checks import BadInput, check_at_least, check_choice
from renderers.field import Field
from renderers.rendering import Unsupported, check_kind

UNMASKED_WARNING = "without masks nothing says where the object ends: expect the shape to keep what is behind it"
LEARNT_CAMERAS = "transforms.json"
COUNT_DEFINITIONS = {
    "evaluations": "those of the field, for its surface and its normals; not those of colours, one per hit on the "
    "foreground in each iteration, in a volume one per sample with a weight, nor second derivatives"
}


@dataclass(frozen=True)
class Reconstruction(PhotographTask):
    """Learns a field with colours, starting from a sphere, so that its renderings match the photographs.

    Args:
        images, longest, held_out, masks, depths: see `PhotographTask`.
        guide: distances that a silhouette loss may use, such as `silhouette=occupancy` with `occupied_at: depth` (DVR,
            Sec. 3.4): "none", "given" depths, or "hull": given depths, and at other pixels the visual hull's.
        rays: number of pixels drawn in each iteration, each with `view.rays_per_pixel` rays.
        appearance: settings of the field, except its size.
        auto: settings of `field=auto`.
        losses: losses of the renderings.
        optimiser: iterations and learning rates.
        pixel_block: its square divides `rays`; 0: the smallest divisor that the budget affords, see
            `bench.solve.optimise.with_affordable_rays`.
        cameras: "given", or "refine": a rigid motion of each camera but the first is learnt with the shape.
        camera_noise: degrees by which each input camera but the first is wrong, about a random axis through the origin.
            None: 0, and the errors of cameras are not measured.
        background: what rays see that pass the object, for photographs without masks: "none", "black", "grey", "white",
            or "sphere", which learns it; see `bench.tasks.reconstruction.background.OutsideSphere`.
        blur_points, blur_share: `start` and `share` of `bench.tasks.reconstruction.blur.PointBlur`; 0 is no blur.
    """

    guide: str
    rays: int
    appearance: Appearance
    auto: AutoField
    losses: Losses
    optimiser: OptimiserSettings
    pixel_block: int = 1
    cameras: str = cameras.GIVEN
    camera_noise: float | None = None
    background: str = behind.NONE
    blur_points: float = 0.0
    blur_share: float = BLUR_SHARE

    takes_field: ClassVar[bool] = True
    takes_rays_per_pixel: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("task.guide", self.guide, GUIDES)
        check_at_least("task.pixel_block", self.pixel_block, 0, "2 draws a quarter of task.rays")
        check_at_least("task.rays", self.rays, 4, "1024 work")
        check_choice("task.cameras", self.cameras, cameras.CHOICES)
        check_choice("task.background", self.background, behind.CHOICES)
        PointBlur(self.blur_points, self.blur_share)  # checks both
        if self.losses.normals and (self.camera_noise or self.cameras == cameras.REFINE):
            raise ValueError(
                "given normals are in world axes, which wrong cameras do not know: set task.losses.normals=0"
            )
        if self.background != behind.NONE and self.masks:
            raise ValueError(
                f"task.background={self.background} is for photographs without masks: set task.masks=false"
            )
        check_at_least("task.camera_noise", self.camera_noise or 0, 0, "0 keeps the cameras")
        if self.losses.colour_gradient and self.rays % 4:
            raise ValueError(f"task.rays must be a multiple of 4 for patches of 2 x 2 pixels, not {self.rays}: 1024")

    def check(self, inputs: RunInputs) -> None:
        """Raises ValueError for unknown candidates, trials without end, and observations of single rays."""
        if inputs.field.name == AUTO:
            for name in self.auto.candidates:
                parse_field_name(name)
            if self.optimiser.ends == BUDGET:
                reason = "field=auto tries each field for a fraction of the iterations, which a budget does not set"
                remedy = "remove task.optimiser.ends=budget, or name a field, such as field=network_4x128"
                raise BadInput(f"{reason}: {remedy}")
        if inputs.views.rays_per_pixel > 1:
            self.losses.check_rays_per_pixel(depths=self.depths.points != NONE)

    def execute(self, run: RunContext) -> None:
        name, inputs = run.inputs.field.name, run.inputs
        check_field_gradient(inputs.renderer)
        if self.cameras == cameras.REFINE and not inputs.renderer.capabilities.ray_gradient:
            raise Unsupported(f"{type(inputs.renderer).__name__} has no gradient towards rays: set task.cameras=given")
        with torch.random.fork_rng():
            candidates = self.auto.candidates if name == AUTO else (name,)
            models = {candidate: self.appearance.make(candidate) for candidate in candidates}
        for model in models.values():  # before the slow reading of photographs
            check_kind(inputs.renderer, model.field)
        of_cameras = {} if self.camera_noise is None else cameras.DEFINITIONS
        definitions = COLOURED_DEFINITIONS | of_cameras | COUNT_DEFINITIONS | (DEFINITIONS if name == AUTO else {})
        run.record.definitions = dict(definitions)
        subject = self.subject(inputs)
        unmasked = subject.input_shots[0].mask is None and self.background == behind.NONE
        warnings = [UNMASKED_WARNING] if unmasked else []
        run.record.notes = [*run.record.notes, subject.summary, *warnings]
        choice = None
        if name == AUTO:
            with torch.random.fork_rng():  # the final run is the same as a run of the chosen field alone
                sizes = {name: sum(tensor.numel() for tensor in model.parameters()) for name, model in models.items()}
                choice = self.auto.choose(lambda n, s: self.problem(n, s, run), sizes, subject, self.optimiser, run)
            run.record.notes.append(choice.note)
            name = choice.kept.candidate
        problems: list[ReconstructionProblem] = []

        def make() -> ReconstructionProblem:
            problems.append(self.problem(name, subject, run))
            return problems[-1]

        solve_and_draw(make, self.optimiser, run, definitions)
        subject.finish(run)
        if self.cameras == cameras.REFINE:
            problems[-1].motions.save(run.folder / LEARNT_CAMERAS, subject.to_world)
        if choice is not None:
            seconds = run.record.seconds
            run.record.metrics |= choice.metrics(seconds["forward"] + seconds["backward"])
            seconds["trials"] = choice.seconds

    def field_metrics(self, field: Field, run: RunContext) -> dict[str, float]:
        subject = self.subject(run.inputs)
        evaluation = judge(State(field, run.inputs), subject)
        return evaluation.metrics | subject.point_metrics(evaluation.mesh, run.inputs)

    def problem(self, name: str, subject: Subject, run: RunContext) -> ReconstructionProblem:
        inputs = run.inputs
        model = self.appearance.make(name).to(inputs.device)
        true = None if self.camera_noise is None else [shot.camera for shot in subject.input_shots]
        shots = cameras.disturbed(subject.input_shots, self.camera_noise or 0, crc32(inputs.scene_name.encode()))
        guide = {GIVEN: given_distances, HULL: hull_distances}.get(self.guide)
        stack = Stack.build(shots, guide and guide(shots), inputs.device)
        iterations, blur = self.optimiser.iterations, PointBlur(self.blur_points, self.blur_share)

        def problem(task: Reconstruction) -> ReconstructionProblem:
            pixels = max(self.rays // task.pixel_block**2, 4)
            motions = cameras.CameraMotions(shots, true, self.cameras == cameras.REFINE, inputs.device)
            background = behind.make(self.background)
            learnt_background = None if background is None else background.to(inputs.device)
            args = self.losses, inputs.renderer, pixels, iterations, inputs.seed, motions, learnt_background, blur
            return ReconstructionProblem(subject, stack, model, *args, inputs.views.rays_per_pixel)

        return with_affordable_rays(self, problem)
