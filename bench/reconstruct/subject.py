"""What is reconstructed: photographs, some of them held out, and the true surface where there is one."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from bench.evaluate.dtu import DEFINITIONS as DTU_DEFINITIONS
from bench.evaluate.dtu import DtuScan, dtu_metrics, published_results, read_scan
from bench.evaluate.evaluate import cloud_metrics, subsample
from bench.setup.inputs import RunContext, RunInputs
from bench.solve.solve import save_in_world
from datasets.captures.hull import hull_mesh
from datasets.mesh import Mesh, fit_in_sphere
from datasets.meshes import read_pieces, read_points
from datasets.own_photographs import Photographed
from datasets.photographs import Photography
from datasets.scene import Surface, Truth, sample_surface, see
from datasets.shot import Shot
from datasets.views import observed_pixels
from renderers.checks import BadInput, check_at_least

FEWEST = 3  # given photographs
NO_HULL = "the visual hull needs a mask of each photograph: leave out dataset.masks=false and task.masks=false"
NONE, GIVEN, HULL = "none", "given", "hull"  # where distances are known; see `Depths`
GUIDES = (NONE, GIVEN, HULL)
HULL_SAMPLES = 96  # per axis
TILTED = 0.1  # weight of the cameras' y axes beside the x axes, which alone leave the vertical open from one side
HULL_RADIUS = 0.75  # scene units, of the sphere about the hull from which a prior's shape is moved: see `upright`
ON_SURFACE = 0.01  # scene units that a point may lie behind the first hit of its ray, on its side, and be seen


@dataclass(frozen=True)
class Depths:
    """Which depths are given, and how true they are.

    Args:
        points: "none"; or the amount in each photograph, see `datasets.views.observed_pixels`.
        noise: standard deviation of a depth, in scene units.
    """

    points: str
    noise: float

    def __post_init__(self) -> None:
        check_at_least("task.depths.noise", self.noise, 0, "0 gives true depths")

    def of(self, shot: Shot, seed: tuple[int, int]) -> Shot:
        """The photograph with the depths that are given of it, 0 elsewhere; the seed is of the scene, then of it."""
        if self.points == NONE:
            return replace(shot, depth=None)
        if shot.depth is None or shot.mask is None:
            raise BadInput("these photographs have no depths: set task.depths.points=none, or take task=stereo")
        first, second = np.random.default_rng(seed).integers(2**62, size=2).tolist()
        chosen = observed_pixels(shot.mask, self.points, first)
        noise = self.noise * torch.randn(shot.depth.shape, generator=torch.Generator().manual_seed(second))
        return replace(shot, depth=torch.where(chosen & (shot.depth > 0), shot.depth + noise, 0.0))


@dataclass(frozen=True)
class Subject:
    """Photographs of one object in the unit sphere.

    Args:
        given: that a shape is learnt from, with the masks and depths that may be used.
        held_out: that it is judged by.
        truth: the true surface, where it is known.
        found: what there is, in words.
        to_world: from the unit sphere's world into that of the file; None of a scene.
        points: that the final mesh is judged by: a scan of DTU in the file's world, or a cloud in the unit sphere.
    """

    given: tuple[Shot, ...]
    held_out: tuple[Shot, ...]
    truth: Mesh | None
    found: str
    to_world: Float[np.ndarray, "4 4"] | None = None
    points: DtuScan | Float[np.ndarray, "n 3"] | None = None
    known: dict[tuple[int, int], tuple[Surface, Bool[np.ndarray, " n"]]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def finish(self, run: RunContext) -> None:
        """Writes the mesh in the file's world, see `save_in_world`; where there are points, it is judged by them."""
        if self.to_world is None:
            return
        mesh = save_in_world(run.folder, self.to_world)
        with run.off_clock():
            run.record.metrics |= self.judged(mesh, run.inputs)
        run.record.definitions |= DTU_DEFINITIONS if isinstance(self.points, DtuScan) else {}

    def judged(self, mesh: Mesh | None, inputs: RunInputs) -> dict[str, float]:
        """The metrics of a mesh in the unit sphere against the points; none where there are none."""
        if self.points is None:
            return {}
        if isinstance(self.points, DtuScan):
            return dtu_metrics(mesh and mesh.moved(self.to_world), self.points, seed=inputs.seed)
        count, threshold = inputs.evaluation.points, inputs.evaluation.fscore_threshold
        found = None if mesh is None else sample_surface(mesh, count, inputs.seed + 1)
        return cloud_metrics(found, subsample(self.points, count, inputs.seed), threshold=threshold)

    def true_surface(self, count: int, seed: int) -> tuple[Surface, Bool[np.ndarray, " n"]]:
        """Samples of the true surface, and which of them a given photograph sees; drawn once."""
        if (count, seed) not in self.known:
            sampled = sample_surface(self.truth, count, seed)
            self.known[count, seed] = sampled, self.seen(self.truth, sampled)
        return self.known[count, seed]

    def seen(self, mesh: Mesh, sampled: Surface) -> Bool[np.ndarray, " n"]:
        """Which points of a mesh's surface at least one given photograph sees; see `visible`."""
        scene = Truth(mesh, closed=False)
        return np.any([visible(scene, shot, sampled) for shot in self.given], axis=0)


def upright(subject: Subject) -> Subject:
    """The subject in a world whose y is the cameras' vertical, with the masks' hull about its origin.

    Cameras are taken to be held level: the vertical is the direction to which their x is at right angles, and their y
    is not. Without masks the unit sphere stays where it is.
    """
    axes = torch.stack([shot.camera.world_to_camera[:2, :3] for shot in subject.given]).double().numpy()
    across, down = np.einsum("nki,nkj->kij", axes, axes)
    up = np.linalg.eigh(across - TILTED * down)[1][:, 0]
    up = up if (axes[:, 1] @ up).sum() < 0 else -up
    to_old, radius = np.eye(4), 1.0
    if (hull := _hull(subject.given)) is not None:
        to_old[:3, 3], shrunk = fit_in_sphere(hull.used, HULL_RADIUS)
        radius = 1 / shrunk
    to_old[:3, :3] = radius * Rotation.align_vectors([up], [[0.0, 1.0, 0.0]])[0].as_matrix()
    return replace(
        subject,
        given=tuple(shot.within(to_old) for shot in subject.given),
        held_out=tuple(shot.within(to_old) for shot in subject.held_out),
        truth=None if subject.truth is None else subject.truth.moved(np.linalg.inv(to_old)).cut_off(),
        found=f"{subject.found}; set upright for the prior, its unit sphere {radius:.3g} times as large",
        to_world=None if subject.to_world is None else subject.to_world @ to_old,
        points=within(subject.points, to_old) if isinstance(subject.points, np.ndarray) else subject.points,
    )


def _hull(shots: Sequence[Shot]) -> Mesh | None:
    """The visual hull; None where it is empty, or a mask is not known."""
    return hull_mesh(shots, HULL_SAMPLES) if all(shot.mask is not None for shot in shots) else None


def visible(scene: Truth, shot: Shot, sampled: Surface) -> Bool[np.ndarray, " n"]:
    """Which points of a surface a photograph sees: within it, in front of all else, on the side that is hit first.

    The first hit may lie `ON_SURFACE` in front of a point; where its normal is opposed, it is the near side of a plate.
    """
    points, centre = sampled.points, shot.camera.center.double().numpy()
    inside = shot.camera.shows(torch.from_numpy(points).float()).numpy()
    hits = scene.cast(np.broadcast_to(centre, points.shape), points - centre)
    near = hits.distance > np.linalg.norm(points - centre, axis=1) - ON_SURFACE
    return inside & near & ((hits.normals * sampled.normals).sum(axis=1) >= 0)


@dataclass(frozen=True)
class PhotographTask(ABC):
    """A task whose subject are photographs of a folder, or those that are taken of the scene's mesh.

    Args:
        images: settings of photographs that are taken.
        longest: most pixels along the longer side of a photograph.
        held_out: of so many photographs one is held out.
        masks: whether those that are given have their masks. The unit sphere may have been found by masks anyway, those
            of photographs that are held out not among them.
        depths: that are given; photographs of one's own have none but in DVR's layout.
    """

    images: Photography
    longest: int
    held_out: int
    masks: bool
    depths: Depths

    def __post_init__(self) -> None:
        check_at_least("task.longest", self.longest, 8, "96 shows what there is")
        check_at_least("task.held_out", self.held_out, 2, "8 holds out an eighth")

    @abstractmethod
    def execute(self, run: RunContext) -> None:
        """Finds the shape of the photographs, and judges it by those that are held out."""

    def subject(self, inputs: RunInputs) -> Subject:
        """The photographs, and the true surface where there is one.

        Raises:
            BadInput: where photographs are missing, too few, or do not fit.
        """
        if inputs.photographed is not None:
            capture = inputs.photographed.capture(self.longest, self.held_out)
            shots, seed, to_world = capture.shots, inputs.seed, capture.to_world
            truth, points, told = truth_of(inputs.photographed, to_world)
            found = "; ".join([capture.summary, *capture.notes])
        else:
            scene = inputs.scene
            camera = scene.view.camera.resized(self.longest, self.longest)
            seed, truth, to_world, points, told = scene.seed(inputs.seed), scene.mesh, None, None, []
            shots = tuple(self.images.take(Truth(truth), camera, seed=seed))
            found = f"{len(shots)} rendered photographs of {self.longest} x {self.longest} pixels"
        every = self.held_out
        held_out, given = shots[::every], tuple(shot for place, shot in enumerate(shots) if place % every)
        if len(given) < FEWEST:
            raise BadInput(f"{len(shots)} photographs with every {every}th held out leave {len(given)}: give more")
        given = tuple(self.depths.of(shot, (seed, place)) for place, shot in enumerate(given))
        given = given if self.masks else tuple(replace(shot, mask=None) for shot in given)
        found += f"; {len(held_out)} of them {'is' if len(held_out) == 1 else 'are'} held out"
        found = "; ".join([found, *told])
        return Subject(given, held_out, truth, found, to_world, points)


def truth_of(
    dataset: Photographed, to_world: Float[np.ndarray, "4 4"]
) -> tuple[Mesh | None, DtuScan | Float[np.ndarray, "n 3"] | None, list[str]]:
    """The surface in the unit sphere, or the points, that the file or folder `dataset.truth` has; and notes.

    Raises:
        BadInput: where it cannot be read, or nothing of it lies in the unit sphere.
    """
    if dataset.truth is None:
        return None, None, []
    if (number := dataset.dtu_scan) is not None:
        return None, read_scan(Path(dataset.truth), number), published_results(number)
    mesh, points = None, None if Path(dataset.truth).is_dir() else read_points(dataset.truth)
    if points is None:
        whole = read_pieces(dataset.truth).moved(np.linalg.inv(to_world))
        mesh = whole.cut_off()
        share = mesh.area / whole.area if mesh else 0.0
    else:
        given, points = len(points), within(points, to_world)
        share = len(points) / given
    if not share:
        raise BadInput(
            f"nothing of dataset.truth={dataset.truth} lies in the unit sphere of the photographs: it must be in the "
            "world of their cameras"
        )
    told = f"{share:.0%} of {dataset.truth} lies in the unit sphere, and is the truth"
    return mesh, points, [told] if share < 1 else []


def within(points: Float[np.ndarray, "n 3"], to_world: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "m 3"]:
    """Those points of the file's world that lie in the unit sphere, in its world."""
    to_sphere = np.linalg.inv(to_world)
    moved = points @ to_sphere[:3, :3].T + to_sphere[:3, 3]
    return moved[np.linalg.norm(moved, axis=1) <= 1]


def given_distances(shots: Sequence[Shot]) -> list[Float[torch.Tensor, "_ _"]]:
    """The given distances along each pixel's ray; NaN where there is none."""
    blank = [torch.full((shot.camera.height, shot.camera.width), torch.nan) for shot in shots]
    return [
        unknown if shot.depth is None else torch.where(shot.depth > 0, shot.camera.distance(shot.depth), torch.nan)
        for shot, unknown in zip(shots, blank, strict=True)
    ]


def hull_distances(shots: Sequence[Shot]) -> list[Float[torch.Tensor, "_ _"]]:
    """The given distances and, where there are none, those to the visual hull; NaN beside it.

    Raises:
        BadInput: without masks, or where their hull is empty.
    """
    if (hull := _hull(shots)) is None:
        raise BadInput(f"{NO_HULL}, or set task.guide=none")
    scene = Truth(hull, closed=False)
    views = [see(scene, shot.camera) for shot in shots]
    behind = [torch.where(view.mask, view.camera.distance(view.depth), torch.nan) for view in views]
    return [torch.where(g.isfinite(), g, h) for g, h in zip(given_distances(shots), behind, strict=True)]
