"""Tanks and Temples' protocol (Knapitsch et al. 2017): precision, recall and F-score at a scene's threshold.

Files, thresholds and stages are those of its published Python script (`python_toolbox/evaluation`).
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from math import acos, degrees
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from bench.evaluate.distances import COLOUR_END, Distances
from bench.tasks.reconstruction.dtu import sample_mesh
from datasets.files.meshes import read_points
from datasets.mesh import Mesh
from renderers.checks import BadInput

# Distance below which a point counts, in metres; of the seven scenes with a public truth.
THRESHOLDS = {
    "Barn": 0.01, "Caterpillar": 0.005, "Church": 0.025, "Courthouse": 0.025, "Ignatius": 0.003, "Meetingroom": 0.01,
    "Truck": 0.005,
}  # fmt: skip
# Voxel side and reach of the stages of ICP, as multiples of the threshold; the last takes every point.
ICP_STAGES = ((1.0, 80.0), (0.5, 20.0), (None, 2.0))
# The script passes its limit of 20 iterations as the change of the RMSE below which ICP may stop, in metres. So the
# fitness alone stops it, and the limit is Open3D's default.
ICP_FITNESS_CHANGE, ICP_RMSE_CHANGE, ICP_ITERATIONS = 1e-6, 20.0, 30
MAX_LAST_STAGE_POINTS = 4_000_000

# Points are averaged in voxels of this side, as a fraction of the threshold, before they are compared.
VOXEL_FRACTION = 0.5
MAX_CAMERA_SHIFT_METRES = 0.2  # between a camera and its pair, if it agrees with an alignment
CAMERAS_PER_ATTEMPT, ALIGNMENT_ATTEMPTS = 6, 100_000
VIDEO_FRAMES = 1600  # a longer trajectory is that of a video, with a mapping to the images
SIMILARITY_TOLERANCE = 1e-3  # relative difference of the scales in any two directions
TRUST_FRACTION = 0.1  # below it, few of the mesh's points have a true point near them after ICP
METRIC_NAMES = ("tnt_precision", "tnt_recall", "tnt_fscore")
_COUNTED = "closer than the scene's threshold, in its crop volume, after averaging in voxels of half the threshold"
DEFINITIONS = {
    "tnt_precision": f"Share of the mesh's points that have a point of the scan {_COUNTED}, from 0 to 1.",
    "tnt_recall": f"Share of the scan's points that have a point of the mesh {_COUNTED}, from 0 to 1.",
    "tnt_fscore": "Harmonic mean of tnt_precision and tnt_recall, the F-score of tables on Tanks and Temples.",
}
WORST = dict.fromkeys(METRIC_NAMES, 0.0)


@dataclass(frozen=True)
class TanksScene:
    """The ground truth of a scene, in metres.

    Args:
        name: such as Barn.
        folder: with the files of the scene.
        crop: Open3D's volume in which points count.
        box: of the volume.
        up: axis across which the polygon of the volume lies.
        truth: Open3D's cloud of the scan's points in the volume.
    """

    name: str
    folder: Path
    crop: Any
    box: Float[np.ndarray, "2 3"]
    up: Float[np.ndarray, "3"]
    truth: Any

    @property
    def threshold(self) -> float:
        return THRESHOLDS[self.name]

    def file(self, ending: str, use: str) -> Path:
        return _file(self.folder, self.name + ending, use)


@dataclass(frozen=True)
class TanksSettings:
    """How a mesh is compared.

    Args:
        align: file of the similarity from the mesh's world to the scan's: 4 x 4 numbers; or a trajectory, .log, of the
            cameras in the mesh's world, which is aligned with the scene's; None for a mesh in the scan's world.
        refine: whether ICP refines the alignment, with its scale.
        surface: whether a mesh is compared by a point in each cell of its faces as large as a voxel, too. The published
            script takes the vertices alone.
    """

    align: Path | None = None
    refine: bool = True
    surface: bool = False


PUBLISHED = TanksSettings()


def scene_name(text: str) -> str:
    """The scene that a text, such as the name of a mesh, contains.

    Raises:
        BadInput: if it contains none.
    """
    for name in THRESHOLDS:
        if name.lower() in text.lower():
            return name
    names = ", ".join(THRESHOLDS)
    raise BadInput(f"'{text}' names no scene of Tanks and Temples with a public truth: --scene must be one of {names}")


def read_scene(folder: Path, name: str) -> TanksScene:
    """Reads the scan and the crop volume of a scene: `Barn.ply` and `Barn.json`, in the folder or in its folder `Barn`.

    Raises:
        BadInput: if a file is missing or does not have the format; the message names it.
    """
    folder = folder / name if (folder / name).is_dir() else folder
    scan, volume = _file(folder, f"{name}.ply", "the scan"), _file(folder, f"{name}.json", "its crop volume")
    crop, box, up = _read_volume(volume)
    points = read_points(scan)
    if points is None:
        raise BadInput(f"{scan} must be the points of a scan, found a mesh: copy it again from the training data")
    truth = crop.crop_point_cloud(_cloud(points))
    if not len(truth.points):
        raise BadInput(f"no point of {scan} lies in the crop volume {volume}: copy both again from one archive")
    return TanksScene(name, folder, crop, box, up, truth)


def tanks_distances(
    shape: Mesh | Float[np.ndarray, "n 3"], scene: TanksScene, settings: TanksSettings, *, seed: int
) -> tuple[Distances, list[str]]:
    """The distances that count, between the voxels of a mesh and those of the scan in the crop volume, and notes.

    Args:
        shape: a mesh, or points.
        seed: of the alignment of trajectories.

    Raises:
        BadInput: if the alignment cannot be read, or nothing of the mesh lies in the crop volume.
    """
    alignment, notes = _read_alignment(scene, settings.align, seed)
    side = VOXEL_FRACTION * scene.threshold
    if isinstance(shape, Mesh) and settings.surface:
        margin = scene.threshold * ICP_STAGES[0][1]
        box = scene.box + np.array([[-margin], [margin]])
        points, alignment = np.concatenate([*sample_mesh(shape.moved(alignment), box, side)]), np.eye(4)
    elif isinstance(shape, Mesh):
        points, notes = shape.vertices, notes + _sparse_warnings(shape.moved(alignment), scene.threshold)
    else:
        points = shape
    cloud = _cloud(points)
    if settings.refine:
        alignment, more = _refined(cloud, scene, alignment)
        notes = [*notes, *more]
    measured, truth = _cropped(cloud, scene, alignment).voxel_down_sample(side), scene.truth.voxel_down_sample(side)
    pairs = ((measured, truth), (truth, measured))
    to_truth, to_measured = (np.asarray(first.compute_point_cloud_distance(second)) for first, second in pairs)
    clouds = (np.asarray(measured.points), to_truth, np.asarray(truth.points), to_measured)
    return Distances(*clouds, "m", scene.threshold, scene.up, COLOUR_END * scene.threshold), notes


def tanks_metrics(distances: Distances, threshold: float) -> dict[str, float]:
    """The metrics of `DEFINITIONS`."""
    shares = distances.shares(np.array([threshold]))
    return {name: float(share[0]) for name, share in zip(METRIC_NAMES, shares, strict=True)}


def protocol(scene: TanksScene, settings: TanksSettings) -> str:
    """How the metrics are computed, as text."""
    samples = "the mesh's vertices and points of its faces" if settings.surface else "the mesh's vertices"
    alignment = f"aligned by {'nothing' if settings.align is None else settings.align.name}"
    icp = "refined by ICP" if settings.refine else "not refined by ICP"
    return (
        f"{samples}, {alignment}, {icp}, cut by the crop volume and averaged in voxels "
        f"of {VOXEL_FRACTION * scene.threshold:g} m, as the scan; shares of points closer than {scene.threshold:g} m"
    )


def _read_alignment(scene: TanksScene, file: Path | None, seed: int) -> tuple[Float[np.ndarray, "4 4"], list[str]]:
    """The similarity from a mesh's world to the scan's, before ICP, and notes on it."""
    if file is None:
        return np.eye(4), []
    return _align_trajectory(scene, file, seed) if file.suffix.lower() == ".log" else (_read_matrix(file), [])


def _sparse_warnings(mesh: Mesh, threshold: float) -> list[str]:
    """A warning if vertices alone do not represent the surface."""
    ends = mesh.vertices[mesh.faces[:, :2]]
    length = float(np.median(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)))
    if length <= threshold:
        return []
    return [
        f"warning: half of the mesh's edges are longer than {length:.3g} m, and the threshold is {threshold:g} m: its "
        "vertices alone do not cover its faces. --surface samples these too"
    ]


def _refined(cloud: Any, scene: TanksScene, alignment: Float[np.ndarray, "4 4"]) -> tuple[Any, list[str]]:
    """The alignment after the stages of ICP, and notes on how far it moved the points."""
    from open3d.pipelines import registration

    initial, result = alignment, registration.RegistrationResult()
    estimation = registration.TransformationEstimationPointToPoint(True)
    criteria = registration.ICPConvergenceCriteria(ICP_FITNESS_CHANGE, ICP_RMSE_CHANGE, ICP_ITERATIONS)
    for voxel, reach in ICP_STAGES:
        thin: Callable[[Any], Any] = _at_most if voxel is None else _voxels(voxel * scene.threshold)
        source, target = thin(_cropped(cloud, scene, alignment)), thin(scene.truth)
        result = registration.registration_icp(source, target, reach * scene.threshold, np.eye(4), estimation, criteria)
        alignment = result.transformation @ alignment
    motion = alignment @ np.linalg.inv(initial)
    scale = float(np.cbrt(np.linalg.det(motion[:3, :3])))
    angle = degrees(acos(np.clip((np.trace(motion[:3, :3]) / scale - 1) / 2, -1, 1)))
    centre = np.append(scene.box.mean(axis=0), 1)
    shift = float(np.linalg.norm((motion @ centre - centre)[:3]))
    notes = [
        f"ICP moved the mesh by {shift:.3g} m at the scene's centre, {angle:.3g} degrees and a scale of {scale:.4g}"
    ]
    if result.fitness < TRUST_FRACTION:
        notes.append(
            f"warning: after ICP, {result.fitness:.1%} of its points lie within {ICP_STAGES[-1][1]:g} thresholds of "
            "the scan: is the mesh aligned? --align takes a matrix, or the .log of its cameras"
        )
    return alignment, notes


def _voxels(side: float) -> Callable[[Any], Any]:
    return lambda cloud: cloud.voxel_down_sample(side)


def _at_most(cloud: Any) -> Any:
    """Every k-th point of a large cloud, so that about `MAX_LAST_STAGE_POINTS` remain."""
    count = len(cloud.points)
    return cloud.uniform_down_sample(round(count / MAX_LAST_STAGE_POINTS)) if count > MAX_LAST_STAGE_POINTS else cloud


def _cropped(cloud: Any, scene: TanksScene, alignment: Float[np.ndarray, "4 4"]) -> Any:
    """The moved points in the crop volume."""
    import open3d

    cropped = scene.crop.crop_point_cloud(open3d.geometry.PointCloud(cloud).transform(alignment))
    if not len(cropped.points):
        raise BadInput(
            f"no point of the mesh lies in the crop volume of {scene.name}: it must be in the scan's world, in metres. "
            f"--align takes a 4 x 4 matrix to it (for {scene.name}'s own cameras: {scene.name}_trans.txt), or the .log "
            "of the mesh's cameras"
        )
    return cropped


def _cloud(points: Float[np.ndarray, "n 3"]) -> Any:
    import open3d

    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))


def _align_trajectory(scene: TanksScene, file: Path, seed: int) -> tuple[Float[np.ndarray, "4 4"], list[str]]:
    """The similarity that moves the centres of cameras to those of the scene, by RANSAC over pairs of equal index."""
    import open3d
    from open3d.pipelines import registration

    reference = scene.file("_COLMAP_SfM.log", "its cameras")
    to_scan = _read_matrix(scene.file("_trans.txt", "the matrix from its cameras to the scan"))
    true_centres, centres = _read_centres(reference), _read_centres(file)
    if len(centres) > VIDEO_FRAMES:
        centres = centres[_read_mapping(scene, len(centres))]
    if len(centres) != len(true_centres):
        raise BadInput(
            f"{file} must have a camera per image, as {reference.name} has, in its order: found {len(centres)} cameras "
            f"and {len(true_centres)}. Write any pose for an image without a camera: outliers are left out"
        )
    pairs = open3d.utility.Vector2iVector(np.arange(len(centres))[:, None].repeat(2, axis=1))
    open3d.utility.random.seed(seed)
    result = registration.registration_ransac_based_on_correspondence(
        _cloud(centres),
        _cloud(true_centres).transform(to_scan),
        pairs,
        MAX_CAMERA_SHIFT_METRES,
        registration.TransformationEstimationPointToPoint(True),
        CAMERAS_PER_ATTEMPT,
        criteria=registration.RANSACConvergenceCriteria(ALIGNMENT_ATTEMPTS),
    )
    agreeing = len(result.correspondence_set)
    if agreeing < CAMERAS_PER_ATTEMPT:
        raise BadInput(
            f"{file} cannot be aligned with {reference.name}: {agreeing} cameras agree within "
            f"{MAX_CAMERA_SHIFT_METRES} m. Poses must be 4 x 4 from camera to world, in the order of the images"
        )
    doubt = "warning: " if agreeing < len(centres) / 2 else ""
    share = f"{agreeing} of {len(centres)} cameras agree within {MAX_CAMERA_SHIFT_METRES} m"
    return result.transformation, [f"{doubt}trajectory: {share}, with an RMSE of {result.inlier_rmse:.3g} m"]


def _read_matrix(file: Path) -> Float[np.ndarray, "4 4"]:
    try:
        matrix = np.loadtxt(file)
    except (OSError, ValueError) as error:
        raise BadInput(f"{file} cannot be read as 4 x 4 numbers ({error}); a trajectory must end in .log") from None
    linear = matrix[:3, :3] if matrix.shape == (4, 4) else np.zeros((3, 3))
    if not np.isfinite(matrix).all() or np.linalg.det(linear) <= 0 or not np.allclose(matrix[3], (0, 0, 0, 1)):
        raise BadInput(
            f"{file} must be a similarity, 4 x 4 numbers whose last row is 0 0 0 1, without a reflection, found shape "
            f"{list(matrix.shape)}: from the mesh's world to the scan's"
        )
    scales = np.linalg.svd(linear, compute_uv=False)
    if scales[0] > (1 + SIMILARITY_TOLERANCE) * scales[-1]:
        raise BadInput(
            f"{file} must be a similarity, a rotation times one scale, found scales from {scales[-1]:.5g} to "
            f"{scales[0]:.5g}, depending on the direction: align again with one scale for all axes"
        )
    return matrix


def _read_centres(file: Path) -> Float[np.ndarray, "n 3"]:
    """The camera centres of a trajectory: per image a line of three indices, then a matrix from camera to world."""
    try:
        lines = [line.split() for line in file.read_text().splitlines() if line.strip()]
        poses = np.array([line for index, line in enumerate(lines) if index % 5], dtype=float).reshape(-1, 4, 4)
    except (OSError, ValueError) as error:
        raise BadInput(
            f"{file} cannot be read as a trajectory ({error}): per image, a line `index index 0` and four lines of a "
            "matrix from camera to world"
        ) from None
    if not len(poses) or len(lines) % 5 or not np.isfinite(poses).all():
        raise BadInput(f"{file} must have five lines per image, with numbers that are finite, found {len(lines)} lines")
    return poses[:, :3, 3]


def _read_mapping(scene: TanksScene, frames: int) -> Int[np.ndarray, " n"]:
    """The indices of the images among the frames of a video; the file counts frames from 1."""
    file = scene.file("_mapping_reference.txt", "the frames of its images, for the trajectory of a video")
    try:
        numbers = np.array(file.read_text().split(), dtype=int)
        indices = numbers[2:].reshape(-1, 2)[: numbers[0], 1] - 1
    except (OSError, ValueError, LookupError) as error:
        raise BadInput(f"{file} cannot be read as a mapping of images to frames ({error}): copy it again") from None
    if not len(indices) or indices.min() < 0 or indices.max() >= frames:
        raise BadInput(
            f"a trajectory of {frames} cameras must be that of the video, of {numbers[1]} frames by {file.name}, or "
            "have a camera per image"
        )
    return indices


def _read_volume(file: Path) -> tuple[Any, Float[np.ndarray, "2 3"], Float[np.ndarray, "3"]]:
    """Open3D's crop volume, its box, and the axis across its polygon."""
    import open3d

    try:
        volume = json.loads(file.read_text())
        axis = "XYZ".index(volume["orthogonal_axis"])
        polygon = np.array(volume["bounding_polygon"], dtype=float).reshape(-1, 3)
        box = np.stack([polygon.min(axis=0), polygon.max(axis=0)])
        box[:, axis] = volume["axis_min"], volume["axis_max"]
        is_volume = len(polygon) > 2 and np.isfinite(box).all() and (box[0] < box[1]).all()
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise BadInput(f"{file} cannot be read as a crop volume of Open3D ({error}): copy it again") from None
    if not is_volume:
        raise BadInput(f"{file} must be a crop volume with three corners or more, found {volume}: copy it again")
    return open3d.visualization.read_selection_polygon_volume(str(file)), box, np.eye(3)[axis]


def _file(folder: Path, name: str, use: str) -> Path:
    if not (folder / name).is_file():
        raise BadInput(
            f"{folder} has no {name}, {use}: give the folder of the training data with the folders "
            f"{', '.join(THRESHOLDS)}, or that of one scene"
        )
    return folder / name
