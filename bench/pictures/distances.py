"""Pictures of the distances between a mesh and its truth: as colours on both, and shares of points over distance."""

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from scipy.ndimage import distance_transform_edt, gaussian_filter, median_filter
from scipy.spatial import cKDTree

from bench.evaluate.distances import Distances
from bench.pictures.style import SCREEN, bare, save

PIXELS = 420  # side of a view
MAX_POINTS_PER_SURFACE = 400_000
FRAME_MARGIN = 1.1  # the frame is larger than the truth by this factor
VIEWS = ((35.0, "one side"), (215.0, "the other side"))  # degrees about the upright axis, from the truth's widest side
ELEVATION_DEGREES = 25.0
MAX_SPOT_PIXELS = 12  # radius of a point
SPACING_PERCENTILE, SPACING_QUERIES = 95, 2000  # the spacing is the distance to the nearest other point
GAP_WINDOW_RADII, MAX_GAP_WINDOW_PIXELS, GAP_DEPTH_PIXELS = 5, 19, 6.0
BACKGROUND_DEPTH_PIXELS = 10.0 * PIXELS
SHADE_STEPS_PIXELS, MAX_SHADE_SLOPE, SHADE_STRENGTH = (1, 2, 4), 5.0, 0.035
CURVE_STEPS = 300
COLOUR_POWER = 0.5  # small distances have more colours than large ones
COLOUR_TICKS = (0, 0.02, 0.1, 0.33, 0.66, 1)  # fractions of the last colour's distance
COLOURS = colormaps["turbo"].with_extremes(over="#5a5a5a")


@rc_context(SCREEN)
def draw_distances(distances: Distances, title: str, path: Path, dense: Distances | None = None) -> None:
    """Writes a picture and its curves, also as .csv; `dense`, of more points, is coloured in place of `distances`."""
    figure = Figure(figsize=(10.2, 6.6), layout="constrained")
    figure.suptitle(title)
    grid = figure.add_gridspec(2, 3, width_ratios=(1, 1, 1.25))
    views = [[bare(figure.add_subplot(grid[row, column])) for column in range(2)] for row in range(2)]
    norm, drawn = PowerNorm(COLOUR_POWER, 0, distances.colour_end), dense or distances
    labels = ("mesh: distance to the truth", "truth: distance to the mesh")
    for axes, label, image_pair in zip(views, labels, _images(drawn, norm), strict=True):
        axes[0].set_ylabel(label)
        for axis, image in zip(axes, image_pair, strict=True):
            axis.imshow(image, interpolation="nearest")
    for axis, (_, side) in zip(views[0], VIEWS, strict=True):
        axis.set_title(side)
    ticks = distances.colour_end * np.array(COLOUR_TICKS)
    bar_place = {"ax": [*views[0], *views[1]], "location": "bottom", "aspect": 45, "pad": 0.02}
    bar = figure.colorbar(ScalarMappable(norm, COLOURS), extend="max", ticks=ticks, **bar_place)
    bar.ax.set_xticklabels([f"{tick:.3g}\n{tick / distances.extent:.2%}" for tick in ticks])
    bar.set_label(f"distance in {distances.unit}, and in % of the truth's extent; grey: larger")
    _draw_curves(figure.add_subplot(grid[:, 2]), distances)
    save(figure, path)
    limits = _curve_limits(distances)
    with path.with_suffix(".csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([f"distance_{distances.unit.replace(' ', '_')}", "precision", "recall", "fscore"])
        writer.writerows(zip(limits.tolist(), *(share.tolist() for share in distances.shares(limits)), strict=True))


def _curve_limits(distances: Distances) -> Float[np.ndarray, " k"]:
    return distances.colour_end * np.arange(1, CURVE_STEPS + 1) / CURVE_STEPS


def _draw_curves(axis: Axes, distances: Distances) -> None:
    limits = _curve_limits(distances)
    precision, recall, _ = distances.shares(limits)
    axis.plot(limits, 100 * precision, color="#c1121f", label="mesh to truth (precision)")
    axis.plot(limits, 100 * recall, color="#1f77b4", label="truth to mesh (recall)")
    if distances.threshold is not None:
        scores = [float(share[0]) for share in distances.shares(np.array([distances.threshold]))]
        axis.axvline(distances.threshold, color="#333333", linestyle="--", linewidth=1)
        axis.set_title(
            f"closer than {distances.threshold:.3g} {distances.unit} (dashed):\n"
            "precision {:.1%}, recall {:.1%}, F {:.3f}".format(*scores)
        )
    axis.set(xlim=(0, distances.colour_end), ylim=(0, 101))
    axis.set_xlabel(f"distance in {distances.unit}, of {len(distances.mesh):,} and {len(distances.truth):,} points")
    axis.set_ylabel("points that are closer (%)")
    axis.grid(color="#e3e3e3", linewidth=0.5)
    axis.legend(loc="lower right", framealpha=1, edgecolor="none")


def _images(distances: Distances, norm: PowerNorm) -> Iterator[list[Float[np.ndarray, "height width 3"]]]:
    """The pictures of the mesh, then of the truth, from all sides, in parallel projection, framed by the truth."""
    for surface in ((distances.mesh, distances.mesh_to_truth), (distances.truth, distances.truth_to_mesh)):
        points, values = surface
        if len(points) > MAX_POINTS_PER_SURFACE:
            chosen = np.random.default_rng(0).choice(len(points), MAX_POINTS_PER_SURFACE, replace=False)
            points, values = points[chosen], values[chosen]
        colours, images = COLOURS(norm(np.minimum(values, 2 * distances.colour_end)))[:, :3], []
        for azimuth, _ in VIEWS:
            axes = _camera_axes(distances, azimuth)
            projected = distances.truth @ axes
            middle = (projected.min(axis=0) + projected.max(axis=0)) / 2
            side = FRAME_MARGIN * float(np.ptp(projected[:, :2], axis=0).max()) or 1.0
            index, depth = _splat((points @ axes - middle) / side * PIXELS)
            shown = np.append(colours, [[1.0, 1.0, 1.0]], axis=0)[index]  # index -1 is the white background
            images.append(shown * np.where(index < 0, 1.0, _brightness(depth))[..., None])
        yield images


def _camera_axes(distances: Distances, azimuth_degrees: float) -> Float[np.ndarray, "3 3"]:
    """Columns right, down and away of a camera that turns about the upright axis."""
    up = distances.up / max(float(np.linalg.norm(distances.up)), 1e-12)
    level = distances.truth - distances.truth.mean(axis=0)
    level = level - (level @ up)[:, None] * up
    widest = np.linalg.eigh(level.T @ level)[1][:, 2]  # horizontal: across the upright axis the variance is 0
    azimuth, elevation = np.radians(azimuth_degrees), np.radians(ELEVATION_DEGREES)
    depth_axis = np.cross(up, widest)
    flat = np.cos(azimuth) * depth_axis + np.sin(azimuth) * widest
    away = np.cos(elevation) * flat - np.sin(elevation) * up
    right = np.cross(away, up) / np.cos(elevation)
    return np.stack([right, np.cross(away, right), away], axis=1)


def _splat(
    pixels: Float[np.ndarray, "n 3"],
) -> tuple[Int[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """The index of the nearest point in each pixel, -1 without one, and its depth. Points are disks."""
    index, depth = np.full((PIXELS, PIXELS), -1), np.full((PIXELS, PIXELS), np.inf)
    order = np.argsort(-pixels[:, 2])  # of points on one pixel, the last one written remains: the nearest
    column, row = np.floor(pixels[order, :2] + PIXELS / 2).astype(np.int64).T
    radius = _spot_radius(pixels)
    for x, y in np.ndindex(2 * radius + 1, 2 * radius + 1):
        if (x - radius) ** 2 + (y - radius) ** 2 > (radius + 0.3) ** 2:
            continue
        shifted = np.stack([row + y - radius, column + x - radius])
        visible = ((shifted >= 0) & (shifted < PIXELS)).all(axis=0)
        candidate = np.full((PIXELS, PIXELS), -1)
        candidate[tuple(shifted[:, visible])] = order[visible]
        nearer = (candidate >= 0) & (np.append(pixels[:, 2], np.inf)[candidate] < depth)
        index[nearer], depth[nearer] = candidate[nearer], pixels[candidate[nearer], 2]
    return _without_gaps(index, depth, min(GAP_WINDOW_RADII * radius + 2, MAX_GAP_WINDOW_PIXELS))


def _without_gaps(
    index: Int[np.ndarray, "height width"], depth: Float[np.ndarray, "height width"], window_pixels: int
) -> tuple[Int[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """Pixels far behind most of their neighbours, seen between the disks, become as the nearest other pixel."""
    bounded = np.minimum(depth, BACKGROUND_DEPTH_PIXELS)
    gap = bounded - median_filter(bounded, window_pixels) > GAP_DEPTH_PIXELS
    nearest = tuple(distance_transform_edt(gap, return_distances=False, return_indices=True))
    return index[nearest], depth[nearest]


def _spot_radius(pixels: Float[np.ndarray, "n 3"]) -> int:
    """The radius of disks that nearly close the gaps between points."""
    if len(pixels) < 2:
        return MAX_SPOT_PIXELS
    queries = np.random.default_rng(0).choice(pixels, min(SPACING_QUERIES, len(pixels)), replace=False)
    spacing = np.percentile(cKDTree(pixels).query(queries, k=2)[0][:, 1], SPACING_PERCENTILE)
    return int(np.clip(np.ceil(0.8 * spacing), 1, MAX_SPOT_PIXELS))


def _brightness(depth: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """The brightness of pixels: those behind their neighbours are darker, so that edges and folds are visible."""
    hit = np.isfinite(depth)
    weights = np.maximum(gaussian_filter(hit.astype(float), 1.0), 1e-9)
    smooth = np.where(hit, gaussian_filter(np.where(hit, depth, 0.0), 1.0) / weights, BACKGROUND_DEPTH_PIXELS)
    behind = np.zeros_like(depth)
    for step in SHADE_STEPS_PIXELS:
        for shift in ((0, step), (0, -step), (step, 0), (-step, 0)):
            slope = (smooth - np.roll(smooth, shift, (0, 1))) / step
            behind += slope.clip(0, MAX_SHADE_SLOPE)
    return np.exp(-SHADE_STRENGTH * behind)
