"""Camera pose: optimises the camera of a depth image and mask of a known shape (DIST, Sec. 4.1, Fig. 6)."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from hashlib import sha256
from math import atan2, degrees, radians, sqrt
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from bench.evaluate.evaluate import (
    IMAGE_DEFINITIONS,
    OWN_PREFIX,
    RENDERER_DEFINITIONS,
    Evaluation,
    render_view,
    view_metrics,
)
from bench.evaluate.state import REACH, State
from bench.records.record import digest
from bench.setup.inputs import RunContext, RunInputs
from bench.shape_prior import load_or_make
from bench.solve.latent_code import total
from bench.solve.observed_view import DEPTH_LOSSES, ObservedView, normal_error
from bench.solve.optimise import OptimiserSettings, Starts, StartSettings, with_affordable_rays
from bench.solve.pixel_area import random_rays
from bench.solve.pixel_draw import PixelDraw
from bench.solve.solve import solve_and_draw
from datasets.scene import Scene, View, see, see_area
from renderers.boundary import render_checked
from renderers.camera import Camera
from renderers.checks import BadInput, check_at_least, check_choice, check_positive
from renderers.field import Counts, Field, Meter, autograd_normals
from renderers.fields.grid import Grid
from renderers.rendering import Renderer, Unsupported, at_iteration
from renderers.silhouette import SilhouetteLoss

DEFINITIONS = {
    "rotation_error_deg": "angle of the rotation between the found and the true camera, in degrees",
    "translation_error": "distance between the object's origin in the coordinates of the found and of the true camera,"
    " in scene units",
    "success": "1 where both errors are at most task.success_degrees and task.success_distance, else 0",
}
TRACKED = tuple(DEFINITIONS)
MESH_VIEW_NOTE = "By exact first hits of the known mesh, the same for every method."
MESH_VIEW_DEFINITIONS = DEFINITIONS | {name: f"{text} {MESH_VIEW_NOTE}" for name, text in IMAGE_DEFINITIONS.items()}


@dataclass(frozen=True)
class PoseTask(ABC):
    """A task that finds a camera: its initial cameras, and its criteria of success.

    Args:
        degrees: rotation error of the initial camera, about a random axis through the object's origin.
        shift: translation error of the initial camera, in a random direction, in scene units.
        starts: number of starts: the initial camera, and random rotations of it.
        spread: largest angle of these rotations, in degrees.
        success_degrees, success_distance: largest errors that count as success, in degrees and scene units.
    """

    degrees: float
    shift: float
    starts: int
    spread: float
    success_degrees: float
    success_distance: float

    def __post_init__(self) -> None:
        check_at_least("task.starts", self.starts, 1, "1 is the initial camera alone, 8 avoid most failures")
        for name in ("degrees", "spread"):
            if not 0 <= getattr(self, name) <= 180:
                raise ValueError(f"task.{name} must lie between 0 and 180 degrees, not {getattr(self, name)}")
        check_at_least("task.shift", self.shift, 0, "0.1 is a tenth of the object's radius")
        check_positive("task.success_degrees", self.success_degrees, "5 is usual")
        check_positive("task.success_distance", self.success_distance, "0.05 is usual")

    @abstractmethod
    def execute(self, run: RunContext) -> None:
        """Finds the camera, and fills the run's record."""

    def cameras(self, true: Camera, seed: int) -> list[Camera]:
        """The initial cameras; the first one's errors are exactly `degrees` and `shift`."""
        generator = torch.Generator().manual_seed(seed)
        axis, direction = _directions(2, generator)
        rotated = true.with_object_moved(torch.cat([torch.zeros(3), radians(self.degrees) * axis]))
        initial = rotated.with_object_moved(torch.cat([self.shift * direction, torch.zeros(3)]))
        angles = radians(self.spread) * torch.rand(self.starts - 1, 1, generator=generator)
        turns = angles * _directions(self.starts - 1, generator)
        return [initial, *(initial.with_object_moved(torch.cat([torch.zeros(3), turn])) for turn in turns)]

    def metrics(self, estimate: Camera, true: Camera) -> dict[str, float]:
        """The metrics of `DEFINITIONS`."""
        rotation, translation = pose_error(estimate, true)
        success = rotation <= self.success_degrees and translation <= self.success_distance
        return {"rotation_error_deg": rotation, "translation_error": translation, "success": float(success)}

    def evaluate(self, estimate: Camera, scene: Scene, rendering: View | None = None) -> Evaluation:
        """The metrics of the pose and of its view; a note if the pose is wrong, which does not change the status.

        Args:
            scene: the known mesh and the observed view.
            rendering: the view of the renderer under test from the estimated camera, if any.
        """
        mesh_view, true = see(scene.raycaster, estimate), scene.view
        images = view_metrics(mesh_view, true) | (
            {} if rendering is None else view_metrics(rendering, true, OWN_PREFIX)
        )
        metrics = self.metrics(estimate, true.camera)
        rotation, distance = metrics["rotation_error_deg"], metrics["translation_error"]
        note = f"the pose was not found: it is {rotation:.1f} degrees and {distance:.3f} scene units off"
        return Evaluation(metrics | images, notes=() if metrics["success"] else (note,))


@dataclass(frozen=True)
class Pose(PoseTask):
    """Finds the camera of a depth image and a mask from a perturbed start; the shape is known.

    Args:
        degrees, shift, starts, spread, success_degrees, success_distance: see `PoseTask`.
        trial: iterations of each start if there are several; see `bench.solve.optimise.StartSettings`.
        shape: field of the known shape: "grid", distances of the mesh on a grid; "prior", the network at the scene's
            code, which must be a training shape.
        grid: samples per axis of the grid.
        depth_loss, depth_weight: over pixels on the object that hit; see `bench.tasks.completion.Completion`.
        silhouette: the silhouette loss.
        silhouette_weight: weight of the silhouette loss.
        normal_weight: weight of one minus the cosine between normals in camera axes, the mean over the same pixels. Its
            gradient rotates the normals and does not move the points.
        optimiser: iterations and learning rates.
        pixel_block: see `bench.tasks.completion.Completion`.
    """

    trial: int
    shape: str
    grid: int
    depth_loss: str
    depth_weight: float
    silhouette: SilhouetteLoss
    silhouette_weight: float
    normal_weight: float
    optimiser: OptimiserSettings
    pixel_block: int = 1

    takes_rays_per_pixel: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_at_least("task.pixel_block", self.pixel_block, 0, "2 compares a quarter of the pixels")
        check_choice("task.depth_loss", self.depth_loss, DEPTH_LOSSES)
        check_choice("task.shape", self.shape, ("grid", "prior"))
        check_at_least("task.grid", self.grid, 8, "96 keep thin parts")
        for name in ("depth_weight", "silhouette_weight", "normal_weight"):
            check_at_least(f"task.{name}", getattr(self, name), 0, "0 switches the term off")
        StartSettings(self.starts, self.trial).check(self.optimiser)
        super().__post_init__()

    def check(self, inputs: RunInputs) -> None:
        """Raises BadInput if the known shape should be a network, but none was fitted to it."""
        if inputs.views.rays_per_pixel > 1 and self.normal_weight:
            raise BadInput("normals are compared with one ray per pixel: set task.normal_weight=0")
        if self.shape == "prior":
            inputs.check_fitted()

    def execute(self, run: RunContext) -> None:
        """Optimises the pose, and evaluates it before and after.

        Raises:
            Unsupported: if the renderer has no gradient for rays, or does not support the shape's field.
        """
        inputs, view = run.inputs, run.inputs.scene.view
        if not inputs.renderer.capabilities.ray_gradient:
            name = type(inputs.renderer).__name__
            raise Unsupported(f"{name} has no gradient towards rays, so none towards a camera")
        shape_field = build_shape_field(self, inputs)
        cameras = self.cameras(view.camera, inputs.scene.seed(inputs.seed))

        def problem() -> PoseProblem:
            args = inputs.renderer, shape_field, view, cameras, inputs.device, inputs.scene.seed(inputs.seed)
            several = inputs.scene.rays_per_pixel > 1
            area = see_area(inputs.scene.raycaster, view.camera) if several else None
            more = {"rays_per_pixel": inputs.scene.rays_per_pixel, "area": area}
            return with_affordable_rays(self, lambda task: PoseProblem(task, *args, **more))

        solve_and_draw(problem, self.optimiser, run, MESH_VIEW_DEFINITIONS | RENDERER_DEFINITIONS)


def build_shape_field(settings: Pose, inputs: RunInputs) -> Field:
    """The field of the scene's shape, of the kind that `settings.shape` names; a grid is stored in the cache."""
    if settings.shape == "prior":
        fitted = inputs.fitted()
        return fitted.decoder.to(inputs.device).requires_grad_(False).at(fitted.codes[0].to(inputs.device))

    def distances() -> dict[str, Tensor]:
        return {"values": torch.from_numpy(inputs.scene.raycaster.distance_grid(settings.grid, REACH))}

    mesh = sha256(b"".join(array.tobytes() for array in (inputs.scene.mesh.vertices, inputs.scene.mesh.faces)))
    key = digest({"mesh": mesh.hexdigest(), "samples": settings.grid, "reach": REACH})
    return Grid(load_or_make(inputs.cache, f"distances-{key}", distances)["values"].to(inputs.device), REACH)


@dataclass
class PoseProblem:
    """The problem of a camera. Its parameters are a rigid motion of the object for each start."""

    settings: Pose
    renderer: Renderer
    shape_field: Field
    view: View
    cameras: list[Camera]  # one per start
    device: torch.device
    seed: int = 0
    rays_per_pixel: int = 1
    area: tuple[Tensor, Tensor] | None = None  # of several rays per pixel, see `datasets.scene.see_area`
    counts: Counts = field(default_factory=Counts)

    tracked: ClassVar[tuple[str, ...]] = TRACKED

    def __post_init__(self) -> None:
        self.cameras = [camera.to(self.device) for camera in self.cameras]
        self.parameters = [torch.zeros(6, device=self.device, requires_grad=True) for _ in self.cameras]
        self.starts = Starts(StartSettings(len(self.cameras), self.settings.trial))
        mask = self.view.mask
        self.observations = ObservedView.of(
            self.view, self.settings, self.renderer, observed=mask, mask=mask, device=self.device
        )
        self.observed = self.observations.observed
        if self.area is not None:
            covered, depth = (image.to(self.device) for image in self.area)
            depth = torch.where(self.observed, depth, 0.0)
            self.observations = replace(self.observations, depth=depth, covered=covered)
        self.draw = PixelDraw(self.observed, self.settings.pixel_block, self.seed)
        self.rays_per_iteration = self.draw.per_iteration * self.rays_per_pixel
        self.normals = in_camera_axes(self.view.normals.to(self.device), self.view.camera.to(self.device))

    def field(self) -> Field:
        """The known shape."""
        return self.shape_field

    @torch.no_grad()
    def objective(self) -> float | None:
        """The loss of all pixels, not counted as cost; None if each iteration has them and its loss is comparable."""
        if self.settings.pixel_block == 1 and self.rays_per_pixel == 1:
            return None
        return float(self._compare(self.shape_field, self.settings.optimiser.iterations, self.starts.best())["total"])

    def evaluate(self, state: State) -> Evaluation:
        """The errors of the current camera, and of its view against the given one."""
        view = render_view(self.shape_field, self.camera(), state.inputs)
        return self.settings.evaluate(view.camera, state.inputs.scene, view)

    def checkpoint(self, state: State) -> dict[str, float]:
        """The errors of the current camera."""
        return self.settings.metrics(self.camera(), self.view.camera)

    def camera(self) -> Camera:
        """The current camera, on the CPU; the initial one if the parameters are not finite."""
        best = self.starts.best()
        twist = self.parameters[best].detach()
        camera = self.cameras[best].with_object_moved(twist) if bool(twist.isfinite().all()) else self.cameras[best]
        return camera.to(torch.device("cpu"))

    def loss(self, step: int, start: int = 0) -> dict[str, Tensor]:
        """The weighted terms, and their sum."""
        return self._compare(Meter(self.shape_field, self.counts), step, start, self.draw.pixels(step))

    def _compare(self, shape: Field, step: int, start: int, pixels: Tensor | None = None) -> dict[str, Tensor]:
        """The weighted terms of a start at the pixels [n] of an image by rows, or at all, and their sum."""
        camera = self.cameras[start].with_object_moved(self.parameters[start])
        if self.area is None:
            view = replace(self.observations, rays=camera.rays())
        else:
            rays = random_rays(camera, self.rays_per_pixel, self.seed, step)
            view = replace(self.observations, rays=rays, camera=camera)
        normals = self.normals
        if pixels is not None:
            pixels = pixels.to(self.device)
            view, normals = view.flat().drawn(pixels), normals.flatten(0, 1)[pixels]
        renderer = at_iteration(self.renderer, step)
        rendering = render_checked(renderer, shape, view.rays)
        depth, compared = view.depth_term(rendering)
        terms = {"depth": depth, "silhouette": view.silhouette_term(renderer, shape, rendering)}
        if self.settings.normal_weight:
            rendered_normals = in_camera_axes(autograd_normals(shape, rendering.points[compared].detach()), camera)
            terms["normals"] = self.settings.normal_weight * normal_error(rendered_normals, normals[compared])
        return {"total": total(terms), **terms}


def in_camera_axes(normals: Float[Tensor, "*batch 3"], camera: Camera) -> Float[Tensor, "*batch 3"]:
    """Directions in world axes converted to a camera's axes; gradients flow to the camera."""
    return normals @ camera.world_to_camera[:3, :3].T


def pose_error(estimate: Camera, true: Camera) -> tuple[float, float]:
    """The rotation error (degrees) and translation error (scene units) between two cameras; see `DEFINITIONS`."""
    estimated, expected = estimate.world_to_camera.detach().double().cpu(), true.world_to_camera.double().cpu()
    difference = estimated[:3, :3] @ expected[:3, :3].T
    sine, cosine = (difference - difference.T).norm() / sqrt(8), (difference.diagonal().sum() - 1) / 2
    return degrees(atan2(sine.item(), cosine.item())), (estimated[:3, 3] - expected[:3, 3]).norm().item()


def _directions(count: int, generator: torch.Generator) -> Float[Tensor, "count 3"]:
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
