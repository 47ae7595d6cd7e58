"""`python -m bench.turntable RUN_OR_MESH`: writes an animation of a shape that turns once about its axis y."""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib import colormaps
from PIL import Image
from torch import Tensor

from bench.evaluate.colours import render_vertex_colours
from bench.pictures.run_figures import normals_image, shaded
from bench.records.record import is_outside, read_record
from datasets.files.meshes import SUFFIXES, read_mesh
from datasets.mesh import Mesh, normalise
from datasets.scene import Truth, View, see
from datasets.views import ViewSampler

DISTANCE, FIELD_OF_VIEW_DEGREES = 2.5, 50.0  # scene units: the unit sphere fills the picture
ELEVATION_DEGREES = 20.0
SUPERSAMPLES = 2  # rendered pixels along each side of a written pixel
MIN_PIXELS, MAX_PIXELS = 16, 1024
MAX_FRAMES = 720
MIN_DEPTH_RANGE = 1e-6  # scene units
IMAGE_SUFFIXES = (".webp", ".gif")
WEBP_QUALITY = 90  # with the default of 80, edges leave traces on the white of later frames
TURN_MILLISECONDS = 3600
RADIUS_TOLERANCE = 1e-6  # files round coordinates
UPRIGHT = {  # rotations of an axis to the vertical axis y
    "x": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "-x": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}


def turntable_views(truth: Truth, frames: int, size: int) -> Iterator[View]:
    """The supersampled views of a full turn; all normals face the camera, because a mesh may be wound inward."""
    elevations = (ELEVATION_DEGREES, ELEVATION_DEGREES)
    sampler = ViewSampler(DISTANCE, FIELD_OF_VIEW_DEGREES, (0.0, 360.0), elevations, SUPERSAMPLES * size)
    for frame in range(frames):
        view = see(truth, sampler.camera(360.0 * frame / frames, ELEVATION_DEGREES))
        away = (view.normals * view.camera.rays().directions).sum(-1, keepdim=True) > 0
        yield replace(view, normals=torch.where(away, -view.normals, view.normals))


def turntable(mesh: Mesh, frames: int, size: int) -> list[UInt8[np.ndarray, "height width 3"]]:
    """The frames of a full turn of a mesh: colours or grey, normals and depth side by side; raises ValueError."""
    if not 2 <= frames <= MAX_FRAMES:
        raise ValueError(f"--frames must be 2 to {MAX_FRAMES}, found {frames}; 36 is a good number")
    if not MIN_PIXELS <= size <= MAX_PIXELS:
        raise ValueError(f"--size must be {MIN_PIXELS} to {MAX_PIXELS} pixels, found {size}; 256 is a good size")
    truth = Truth(mesh, closed=False)
    parts, depths = [], []
    for view in turntable_views(truth, frames, size):
        shown = (
            np.repeat(shaded(view)[..., None], 3, -1)
            if mesh.colours is None
            else render_vertex_colours(mesh, truth, view.camera)
        )
        parts.append([_downsample(np.where(view.mask[..., None], shown, 1.0)), _downsample(normals_image(view))])
        depths.append(torch.where(view.mask, view.depth, torch.nan))
    if not any(bool(depth.isfinite().any()) for depth in depths):
        raise ValueError(f"the mesh must be large enough to be seen, found {mesh.diagonal:.3g} across; scale it to 1")
    return [np.concatenate([*pair, depth], axis=1) for pair, depth in zip(parts, _depth_images(depths), strict=True)]


def _depth_images(depths: list[Float[Tensor, "fine_height fine_width"]]) -> list[UInt8[np.ndarray, "height width 3"]]:
    """Depths as colours on one scale: near yellow, far violet, background (nan) white."""
    finite = [depth[depth.isfinite()] for depth in depths]
    low = min(float(depth.min()) for depth in finite if depth.numel())
    high = max(float(depth.max()) for depth in finite if depth.numel())
    colours = colormaps["viridis_r"].with_extremes(bad="white")
    scale = max(high - low, MIN_DEPTH_RANGE)
    return [_downsample(colours(((depth - low) / scale).numpy())[..., :3]) for depth in depths]


def _downsample(image: Float[np.ndarray, "fine_height fine_width 3"]) -> UInt8[np.ndarray, "height width 3"]:
    height, width = image.shape[0] // SUPERSAMPLES, image.shape[1] // SUPERSAMPLES
    squares = image.reshape(height, SUPERSAMPLES, width, SUPERSAMPLES, 3)
    return (255 * squares.mean(axis=(1, 3))).round().astype(np.uint8)


def mesh_of_run(folder: Path) -> Path:
    """The mesh of a run folder; raises ValueError if the run has none."""
    if (folder / "mesh.ply").is_file():
        return folder / "mesh.ply"
    try:
        record = read_record(folder)
    except (OSError, ValueError, RecursionError):
        suffixes = " ".join(SUFFIXES)
        raise ValueError(
            f"{folder} has no mesh.ply: name a run folder that has one, or a mesh file ({suffixes})"
        ) from None
    reason = ": ".join(str(record[key]) for key in ("status", "reason") if record.get(key))
    raise ValueError(f"{folder} has no mesh.ply: the run has no mesh ({reason}); name another run, or a mesh file")


def make_upright(mesh: Mesh, up: str) -> Mesh:
    """Rotates the axis `up` of a mesh to y; moves and scales the mesh into the unit sphere if it lies outside."""
    turntable_views = replace(mesh, vertices=mesh.vertices @ np.array(UPRIGHT[up], dtype=float).T)
    radius = np.linalg.norm(turntable_views.used_vertices, axis=1).max()
    return turntable_views if radius <= 1 + RADIUS_TOLERANCE else normalise(turntable_views, 1.0)


def main(arguments: list[str] | None = None) -> int:
    """Writes the animation and prints its path last; returns the exit status, 2 for an error."""
    parser = argparse.ArgumentParser(prog="python -m bench.turntable", description=__doc__)
    parser.add_argument("shape", type=Path, metavar="RUN_OR_MESH", help=f"a run folder, or a file {' '.join(SUFFIXES)}")
    into = "a .webp or .gif file (default: turntable.webp in the run folder; for a mesh file, in the current folder)"
    parser.add_argument("--into", type=Path, metavar="FILE", help=into)
    parser.add_argument("--frames", type=int, default=36, help="of the turn (default: %(default)s)")
    parser.add_argument("--size", type=int, default=256, help="pixels of each part's side (default: %(default)s)")
    up = "the mesh's axis up, such as --up=-y (default: %(default)s)"
    parser.add_argument("--up", choices=tuple(UPRIGHT), default="y", help=up)
    options = parser.parse_args(arguments)
    try:
        is_run = options.shape.is_dir()
        into = options.into or (options.shape if is_run else Path()) / "turntable.webp"
        if into.suffix.lower() not in IMAGE_SUFFIXES:
            suggestion = into.parent / f"{into.stem or 'turn'}.webp"
            raise ValueError(f"--into must end in .webp or .gif, found '{into}'; type --into {suggestion}")
        for file in (into, options.shape / "mesh.ply"):
            if is_run and file.parent == options.shape and is_outside(file, options.shape):
                raise ValueError(f"{file} is a link out of the run folder: remove it")
        mesh = read_mesh(mesh_of_run(options.shape) if is_run else options.shape)
        frames = [*map(Image.fromarray, turntable(make_upright(mesh, options.up), options.frames, options.size))]
        into.parent.mkdir(parents=True, exist_ok=True)
        duration = round(TURN_MILLISECONDS / options.frames)
        frames[0].save(into, save_all=True, append_images=frames[1:], duration=duration, loop=0, quality=WEBP_QUALITY)
    except (OSError, ValueError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    for note in mesh.repairs:
        print(f"note: {note}")
    print(into)
    return 0


if __name__ == "__main__":
    sys.exit(main())
