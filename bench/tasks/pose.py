"""Camera pose: find the camera that saw a known shape, from its depth image and silhouette (DIST, Sec. 4.1, Fig. 6)."""

import time
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.film import Film
from bench.judge import look
from bench.ladder.known import grown_shape
from bench.ladder.settings import PRIOR
from bench.pictures import draw_curve
from bench.poses import JUDGED, PoseStart, of_moved_object
from bench.solve import COSTS, descend, verdict
from bench.stage import Cell, Stage
from bench.starts import Starts, StartSettings
from bench.tasks.problem import OptimiserSettings, Unsupported, check_kind
from datasets.scene import View
from datasets.truth import Truth
from renderers.camera import Camera
from renderers.checks import check_at_least, check_choice
from renderers.field import Counts, Field, Meter, autograd_normals
from renderers.fields.grid import Grid
from renderers.rendering import Renderer, at_iteration

REACH = 1.05  # half the side of the cube that holds the samples of a known shape: the unit sphere and a little more


@dataclass(frozen=True)
class Pose:
    """The camera of a depth image and a silhouette, from a perturbed start; the shape is known.

    Args:
        degrees, shift, starts, spread, success_degrees, success_distance: see `bench.poses.PoseStart`.
        trial: iterations of each start, where there are several; see `bench.starts.StartSettings`.
        shape: how the shape is known: "grid", distances of the mesh on a grid; "prior", the network at the scene's own
            code, of which it must be a training shape; "formula", that of a procedural family.
        grid: its samples an axis.
        depth_weight: of the mean absolute depth error over pixels that both hit.
        silhouette_weight: of the renderer's own silhouette loss.
        normal_weight: of the mean of one minus the cosine between normals there, in camera axes; its gradient turns the
            normals and leaves the points where they are.
        iterations, learning_rate, schedule: see `bench.tasks.problem.OptimiserSettings`.
    """

    degrees: float
    shift: float
    starts: int
    spread: float
    success_degrees: float
    success_distance: float
    trial: int
    shape: str
    grid: int
    depth_weight: float
    silhouette_weight: float
    normal_weight: float
    iterations: int
    learning_rate: float
    schedule: str

    takes_field: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_choice("task.shape", self.shape, ("grid", "prior", "formula"))
        check_at_least("task.grid", self.grid, 8, "96 keep thin parts")
        for name in ("depth_weight", "silhouette_weight", "normal_weight"):
            check_at_least(f"task.{name}", getattr(self, name), 0, "0 switches the term off")
        StartSettings(self.starts, self.trial).check(self.iterations)
        _ = self.optimiser, self.start

    @property
    def start(self) -> PoseStart:
        """Where it starts, and what counts as found."""
        return PoseStart(
            self.degrees, self.shift, self.starts, self.spread, self.success_degrees, self.success_distance
        )

    @property
    def optimiser(self) -> OptimiserSettings:
        """For how long and how fast."""
        return OptimiserSettings(self.iterations, self.learning_rate, self.schedule)

    def execute(self, cell: Cell) -> None:
        """Optimises the pose, and judges it before and after.

        Raises:
            Unsupported: where the renderer has no gradient towards rays, or is not meant for the shape's field.
        """
        stage, record, view = cell.stage, cell.record, cell.stage.scene.view
        if not stage.renderer.capabilities.ray_gradient:
            raise Unsupported(f"{type(stage.renderer).__name__} has no gradient towards rays, so none towards a camera")
        known = known_shape(self, stage) if stage.field == PRIOR else grown_shape(cell, self)
        check_kind(stage.renderer, known)
        record.definitions = JUDGED | COSTS
        cameras = self.start.cameras(view.camera, stage.scene.seed(stage.seed))
        problem = PoseProblem(self, stage.renderer, known, view, cameras, stage.device)
        film = Film(stage)

        def errors_at(iteration: int) -> dict[str, float]:
            film.shoot(iteration, known, problem.camera())
            return self.start.metrics(problem.camera(), view.camera)

        record.metrics_start = self.start.judge(look(known, problem.camera(), stage), view)
        course = descend(problem, self.optimiser, cell, errors_at)
        clock = time.perf_counter()
        record.metrics = self.start.judge(look(known, problem.camera(), stage), view)
        record.status, record.reason = verdict(course)
        record.notes = [*record.notes, *self.start.remarks(record.metrics)]
        film.shoot(len(course.curve), known, problem.camera())
        if stage.evaluation.picture is not None:
            draw_curve(cell.folder / "curve.png", course.curve)
        film.save(cell.folder, f"{record.task}, {record.name}, {record.scene}: {record.status}")
        record.seconds["evaluation"] += time.perf_counter() - clock


def known_shape(settings: Pose, stage: Stage) -> Field:
    """The field of the scene's shape, in the way that is asked for.

    Raises:
        ValueError: where there is none.
    """
    if settings.shape == "prior":
        fitted = stage.fitted()
        return fitted.decoder.to(stage.device).requires_grad_(False).at(fitted.codes[0].to(stage.device))
    if settings.shape == "formula":
        if stage.scene.formula is None:
            raise ValueError(f"{stage.scene.name} has no formula: set task.shape=grid")
        return stage.scene.formula()
    values = Truth(stage.scene.mesh).distance_grid(settings.grid, REACH)
    return Grid(torch.from_numpy(values).to(stage.device), REACH)


@dataclass
class PoseProblem:
    """A camera to be found, as a rigid motion of the object from each start."""

    settings: Pose
    renderer: Renderer
    known: Field
    view: View
    cameras: list[Camera]  # one a start
    device: torch.device
    photographs: None = None
    counts: Counts = field(default_factory=Counts)

    def __post_init__(self) -> None:
        self.cameras = [camera.to(self.device) for camera in self.cameras]
        self.parameters = [torch.zeros(6, device=self.device, requires_grad=True) for _ in self.cameras]
        self.starts = Starts(StartSettings(len(self.cameras), self.settings.trial))
        self.depth, self.mask = self.view.depth.to(self.device), self.view.mask.to(self.device)
        self.normals = in_camera_axes(self.view.normals.to(self.device), self.view.camera.to(self.device))

    @property
    def observed(self) -> Bool[Tensor, "height width"]:
        """Depth is given wherever there is any."""
        return self.mask

    @property
    def rays_per_iteration(self) -> int:
        """A ray a pixel."""
        return self.mask.numel()

    def field(self) -> Field:
        """The known shape."""
        return self.known

    def objective(self) -> None:
        """The loss of any two iterations is comparable."""

    def camera(self) -> Camera:
        """The camera as it stands, on the CPU; where its numbers are none any more, the one that it started from."""
        best = self.starts.best()
        twist = self.parameters[best].detach()
        found = of_moved_object(self.cameras[best], twist) if bool(twist.isfinite().all()) else self.cameras[best]
        return found.to(torch.device("cpu"))

    def loss(self, iteration: int) -> dict[str, Tensor]:
        """The weighted terms, and their sum."""
        start, own = self.starts.turn(iteration)
        camera = of_moved_object(self.cameras[start], self.parameters[start])
        renderer, rays, metered = at_iteration(self.renderer, own), camera.rays(), Meter(self.known, self.counts)
        rendering = renderer.render(metered, rays)
        compared = self.mask & rendering.hit
        count = compared.sum().clamp_min(1)
        error = (camera.depth(rendering.distance) - self.depth).abs()
        silhouette = renderer.silhouette_loss(metered, rays, rendering, self.mask)
        terms = {
            "depth": self.settings.depth_weight * (error * compared).sum() / count,
            "silhouette": self.settings.silhouette_weight * silhouette,
        }
        if self.settings.normal_weight:
            found = in_camera_axes(autograd_normals(metered, rendering.points[compared].detach()), camera)
            difference = 1 - (found * self.normals[compared]).sum(-1)
            terms["normals"] = self.settings.normal_weight * difference.sum() / count
        total = torch.stack(list(terms.values())).sum()
        self.starts.note(start, own, total)
        return {"total": total, **terms}


def in_camera_axes(normals: Float[Tensor, "*batch 3"], camera: Camera) -> Float[Tensor, "*batch 3"]:
    """Directions of the world as a camera has them; gradients flow to the camera."""
    return normals @ camera.world_to_camera[:3, :3].T
