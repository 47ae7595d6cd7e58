"""The input of a reconstruction: photographs, of which some are held out, and the true surface if it is known."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from bench.evaluate.distances import cloud_metrics, subsample
from bench.setup.inputs import RunContext, RunInputs
from bench.solve.solve import save_in_world
from bench.tasks.reconstruction.dtu import DEFINITIONS as DTU_DEFINITIONS
from bench.tasks.reconstruction.dtu import DtuScan, dtu_metrics, published_results, read_scan
from datasets.files.captures.hull import hull_mesh
from datasets.files.captures.sphere import in_world
from datasets.files.coincidence import compare_outlines, points_in_sphere, settled
from datasets.files.meshes import read_pieces, read_points
from datasets.mesh import Mesh, fit_in_sphere
from datasets.photographs import Photography
from datasets.scene import Photographed, Surface, Truth, sample_surface, see
from datasets.shot import Shot
from datasets.views import observed_pixels
from renderers.checks import BadInput, check_at_least

MIN_INPUT_PHOTOGRAPHS = 3
NO_HULL = "the visual hull needs a mask of each photograph: leave out dataset.masks=false and task.masks=false"
NONE, GIVEN, HULL = "none", "given", "hull"  # the source of distances; see `Depths`
GUIDES = (NONE, GIVEN, HULL)
HULL_SAMPLES = 96  # per axis
TILT_WEIGHT = 0.1  # if all cameras are on one side, their x axes alone do not fix the vertical: y axes get this weight
HULL_RADIUS = 0.75  # scene units: `upright` scales the sphere around the hull to this radius
VISIBILITY_TOLERANCE = 0.01  # scene units: a visible point may lie this far behind the first hit of its ray


@dataclass(frozen=True)
class Depths:
    """The depths given with the photographs, and their noise.

    Args:
        points: "none", or the amount in each photograph; see `datasets.views.observed_pixels`.
        noise: standard deviation of a depth, in scene units.
    """

    points: str
    noise: float

    def __post_init__(self) -> None:
        check_at_least("task.depths.noise", self.noise, 0, "0 gives true depths")

    def apply(self, shot: Shot, seed: tuple[int, int]) -> Shot:
        """The photograph with its given depths, 0 at other pixels. `seed` is the scene's, then the photograph's."""
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
        input_shots: photographs that a shape is learnt from, with the masks and depths that may be used.
        held_out: photographs for the evaluation.
        truth: the true surface, if it is known.
        summary: text about the photographs and the truth, for the record.
        to_world: transforms the unit sphere's world into the file's; None for a scene.
        points: the true points for the final mesh: a scan of DTU in the file's world, or a cloud in the unit sphere.
    """

    input_shots: tuple[Shot, ...]
    held_out: tuple[Shot, ...]
    truth: Mesh | None
    summary: str
    to_world: Float[np.ndarray, "4 4"] | None = None
    points: DtuScan | Float[np.ndarray, "n 3"] | None = None
    sample_cache: dict[tuple[int, int], tuple[Surface, Bool[np.ndarray, " n"]]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def finish(self, run: RunContext) -> None:
        """Writes the mesh in the file's world, see `save_in_world`, and compares it with `points`, if any."""
        if self.to_world is None:
            return
        mesh = save_in_world(run.folder, self.to_world)
        with run.off_clock():
            run.record.metrics |= self.point_metrics(mesh, run.inputs)
        run.record.definitions |= DTU_DEFINITIONS if isinstance(self.points, DtuScan) else {}

    def point_metrics(self, mesh: Mesh | None, inputs: RunInputs) -> dict[str, float]:
        """The metrics of a mesh in the unit sphere against `points`; an empty dictionary without these."""
        if self.points is None:
            return {}
        if isinstance(self.points, DtuScan):
            return dtu_metrics(mesh and mesh.moved(self.to_world), self.points, seed=inputs.seed)
        count, threshold = inputs.evaluation.points, inputs.evaluation.fscore_threshold
        predicted = None if mesh is None else sample_surface(mesh, count, inputs.seed + 1)
        return cloud_metrics(predicted, subsample(self.points, count, inputs.seed), threshold=threshold)

    def true_surface(self, count: int, seed: int) -> tuple[Surface, Bool[np.ndarray, " n"]]:
        """Samples of the true surface, and a mask of those visible in an input photograph; drawn once."""
        if (count, seed) not in self.sample_cache:
            sampled = sample_surface(self.truth, count, seed)
            self.sample_cache[count, seed] = sampled, self.visible_points(self.truth, sampled)
        return self.sample_cache[count, seed]

    def visible_points(self, mesh: Mesh, sampled: Surface) -> Bool[np.ndarray, " n"]:
        """A mask of the points of a mesh's surface that are visible in an input photograph; see `visible`."""
        scene = Truth(mesh, closed=False)
        return np.any([visible(scene, shot, sampled) for shot in self.input_shots], axis=0)


def upright(subject: Subject) -> Subject:
    """The subject in a world whose y axis is the cameras' vertical and whose origin is the centre of the visual hull.

    Cameras are assumed level: the vertical is perpendicular to their x axes, but not to their y axes. Without masks
    the unit sphere is unchanged.
    """
    axes = torch.stack([shot.camera.world_to_camera[:2, :3] for shot in subject.input_shots]).double().numpy()
    x_scatter, y_scatter = np.einsum("nki,nkj->kij", axes, axes)
    up = np.linalg.eigh(x_scatter - TILT_WEIGHT * y_scatter)[1][:, 0]
    up = up if (axes[:, 1] @ up).sum() < 0 else -up
    to_old, radius = np.eye(4), 1.0
    if (hull := _hull(subject.input_shots)) is not None:
        to_old[:3, 3], scale = fit_in_sphere(hull.used_vertices, HULL_RADIUS)
        radius = 1 / scale
    to_old[:3, :3] = radius * Rotation.align_vectors([up], [[0.0, 1.0, 0.0]])[0].as_matrix()
    return replace(
        subject,
        input_shots=tuple(in_world(shot, to_old) for shot in subject.input_shots),
        held_out=tuple(in_world(shot, to_old) for shot in subject.held_out),
        truth=None if subject.truth is None else subject.truth.moved(np.linalg.inv(to_old)).cut_off(),
        summary=f"{subject.summary}; set upright for the prior, its unit sphere {radius:.3g} times as large",
        to_world=None if subject.to_world is None else subject.to_world @ to_old,
        points=points_in_sphere(subject.points, to_old) if isinstance(subject.points, np.ndarray) else subject.points,
    )


def _hull(shots: Sequence[Shot]) -> Mesh | None:
    """The visual hull; None if it is empty or a mask is missing."""
    return hull_mesh(shots, HULL_SAMPLES) if all(shot.mask is not None for shot in shots) else None


def visible(scene: Truth, shot: Shot, sampled: Surface) -> Bool[np.ndarray, " n"]:
    """Which points of a surface a photograph sees: within it, in front of all else, on the side that is hit first.

    The first hit may lie `ON_SURFACE` in front of a point; where its normal is opposed, it is the near side of a plate.
    """
    points, centre = sampled.points, shot.camera.center.double().numpy()
    inside = shot.camera.shows(torch.from_numpy(points).float()).numpy()
    hits = scene.cast(np.broadcast_to(centre, points.shape), points - centre)
    in_front = hits.distance > np.linalg.norm(points - centre, axis=1) - VISIBILITY_TOLERANCE
    return inside & in_front & ((hits.normals * sampled.normals).sum(axis=1) >= 0)


@dataclass(frozen=True)
class PhotographTask:
    """A task on photographs from a folder, or rendered from the scene's mesh.

    Args:
        images: settings of rendered photographs.
        longest: maximum pixels along the longer side of a photograph.
        held_out: every so many photographs, one is held out.
        masks: whether the input photographs keep their masks. Even without, these masks may have been used to find the
            unit sphere; masks of held-out photographs never are.
        depths: the given depths. The user's own photographs have depths in DVR's layout only.
    """

    images: Photography
    longest: int
    held_out: int
    masks: bool
    depths: Depths

    def __post_init__(self) -> None:
        check_at_least("task.longest", self.longest, 8, "96 shows what there is")
        check_at_least("task.held_out", self.held_out, 2, "8 holds out an eighth")

    def subject(self, inputs: RunInputs) -> Subject:
        """The photographs, and the true surface if it is known.

        Raises:
            BadInput: if photographs are missing, too few, or do not fit.
        """
        if inputs.photographed is not None:
            capture = inputs.photographed.capture(self.longest, self.held_out)
            shots, seed, to_world = capture.shots, inputs.seed, capture.to_world
            truth, points, truth_notes = load_truth(inputs.photographed, shots, to_world)
            summary = "; ".join([capture.summary, *capture.notes])
        else:
            scene = inputs.scene
            camera = scene.view.camera.resized(self.longest, self.longest)
            seed, truth, to_world, points, truth_notes = scene.seed(inputs.seed), scene.mesh, None, None, []
            areas = self.masks and inputs.views.rays_per_pixel > 1
            shots = tuple(self.images.take(scene.raycaster, camera, seed=seed, areas=areas))
            summary = f"{len(shots)} rendered photographs of {self.longest} x {self.longest} pixels"
        step = self.held_out
        held_out, input_shots = shots[::step], tuple(shot for index, shot in enumerate(shots) if index % step)
        if len(input_shots) < MIN_INPUT_PHOTOGRAPHS:
            raise BadInput(f"{len(shots)} photographs with every {step}th held out leave {len(input_shots)}: give more")
        input_shots = tuple(self.depths.apply(shot, (seed, index)) for index, shot in enumerate(input_shots))
        if not self.masks:
            input_shots = tuple(replace(shot, mask=None, covered=None) for shot in input_shots)
        summary += f"; {len(held_out)} of them {'is' if len(held_out) == 1 else 'are'} held out"
        summary = "; ".join([summary, *truth_notes])
        return Subject(input_shots, held_out, truth, summary, to_world, points)


def load_truth(
    dataset: Photographed, shots: Sequence[Shot], to_world: Float[np.ndarray, "4 4"]
) -> tuple[Mesh | None, DtuScan | Float[np.ndarray, "n 3"] | None, list[str]]:
    """Reads the surface in the unit sphere or the points from the file or folder `dataset.truth`; also gives notes.

    Raises:
        BadInput: if it cannot be read, lies completely outside of the unit sphere, or does not fit the masks.
    """
    if dataset.truth is None:
        return None, None, []
    if (number := dataset.dtu_scan) is not None:
        scan = read_scan(Path(dataset.truth), number)
        notes = outline_notes(dataset, scan.points_above_plane(), shots, to_world)
        return None, scan, [*notes, *published_results(number)]
    mesh, points = None, None if Path(dataset.truth).is_dir() else read_points(dataset.truth)
    full_mesh = read_pieces(dataset.truth) if points is None else None
    notes = outline_notes(dataset, points if full_mesh is None else full_mesh, shots, to_world)
    if full_mesh is not None:
        mesh = full_mesh.moved(np.linalg.inv(to_world)).cut_off()
        fraction = mesh.moved(to_world).area / full_mesh.area if mesh else 0.0
    else:
        point_count, points = len(points), points_in_sphere(points, to_world)
        fraction = len(points) / point_count
    if not fraction:
        raise BadInput(
            f"nothing of dataset.truth={dataset.truth} lies in the unit sphere of the photographs: it must be in the "
            "world of their cameras"
        )
    note = f"{fraction:.0%} of {dataset.truth} lies in the unit sphere, and is the truth"
    return mesh, points, [*notes, note] if fraction < 1 else notes


def outline_notes(
    dataset: Photographed,
    shape: Mesh | Float[np.ndarray, "n 3"],
    shots: Sequence[Shot],
    to_world: Float[np.ndarray, "4 4"],
) -> list[str]:
    """A note on a true surface whose outline does not fit the masks; raises BadInput without `dataset.unchecked`."""
    if any(shot.mask is None for shot in shots):
        return []
    comparison = compare_outlines(shape, shots, to_world)
    doubt = (
        f"{comparison.text(f'dataset.truth={dataset.truth}', 'the masks')}: give the object alone, in the world and "
        "the units of the cameras"
    )
    return [*settled(comparison, doubt, unchecked=dataset.unchecked)]


def given_distances(shots: Sequence[Shot]) -> list[Float[torch.Tensor, "_ _"]]:
    """The given distances along each pixel's ray; NaN at pixels without one."""
    blank = [torch.full((shot.camera.height, shot.camera.width), torch.nan) for shot in shots]
    return [
        unknown if shot.depth is None else torch.where(shot.depth > 0, shot.camera.distance(shot.depth), torch.nan)
        for shot, unknown in zip(shots, blank, strict=True)
    ]


def hull_distances(shots: Sequence[Shot]) -> list[Float[torch.Tensor, "_ _"]]:
    """The given distances, at other pixels the distances to the visual hull; NaN at pixels outside of the hull.

    Raises:
        BadInput: without masks, or if their hull is empty.
    """
    if (hull := _hull(shots)) is None:
        raise BadInput(f"{NO_HULL}, or set task.guide=none")
    scene = Truth(hull, closed=False)
    views = [see(scene, shot.camera) for shot in shots]
    distances = [torch.where(view.mask, view.camera.distance(view.depth), torch.nan) for view in views]
    return [torch.where(d.isfinite(), d, hull) for d, hull in zip(given_distances(shots), distances, strict=True)]
