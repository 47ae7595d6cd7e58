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

from bench.evaluate.state import render_vertex_colours
from bench.pictures.run_figures import normals_image, shaded
from bench.records.record import leads_out, read_record
from datasets.mesh import Mesh, normalise
from datasets.meshes import SUFFIXES, read_mesh
from datasets.scene import Truth, View, see
from datasets.views import ViewSampler

DISTANCE, FIELD_OF_VIEW = 2.5, 50.0  # scene units, degrees: the whole unit sphere is in the picture
ELEVATION = 20.0  # degrees, of the camera
FINER = 2  # pixels that are rendered, along each side of one that is written
SMALLEST, LARGEST = 16, 1024  # pixels of a part's side
MOST = 720  # frames
THINNEST = 1e-6  # scene units of depth that the scale spans at least
ENDINGS = (".webp", ".gif")
QUALITY = 90  # of WebP, of 100: at the usual 80 edges leave traces on the white of later frames
TURN_MILLISECONDS = 3600
SLACK = 1e-6  # of the unit sphere, since files round
UPRIGHT = {  # rotations that make an axis the vertical one, y
    "x": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "-x": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}


def turned(truth: Truth, frames: int, size: int) -> Iterator[View]:
    """The views of a full turn, finer than written; a mesh may be wound inward, so all normals face the camera."""
    sampler = ViewSampler(DISTANCE, FIELD_OF_VIEW, (0.0, 360.0), (ELEVATION, ELEVATION), FINER * size)
    for frame in range(frames):
        view = see(truth, sampler.camera(360.0 * frame / frames, ELEVATION))
        away = (view.normals * view.camera.rays().directions).sum(-1, keepdim=True) > 0
        yield replace(view, normals=torch.where(away, -view.normals, view.normals))


def turntable(mesh: Mesh, frames: int, size: int) -> list[UInt8[np.ndarray, "height width 3"]]:
    """The frames of a full turn of a mesh in the unit sphere: colours, normals and depth side by side.

    Args:
        mesh: without colours, it is grey.
        size: of each part, in pixels.

    Raises:
        ValueError: where a number is out of range, or the mesh is too small to be seen.
    """
    if not 2 <= frames <= MOST:
        raise ValueError(f"--frames must be 2 to {MOST}, found {frames}; 36 is a good number")
    if not SMALLEST <= size <= LARGEST:
        raise ValueError(f"--size must be {SMALLEST} to {LARGEST} pixels, found {size}; 256 is a good size")
    truth = Truth(mesh, closed=False)
    parts, depths = [], []
    for view in turned(truth, frames, size):
        grey = np.repeat(shaded(view)[..., None], 3, -1)
        shown = grey if mesh.colours is None else render_vertex_colours(mesh, truth, view.camera)
        parts.append([_written(np.where(view.mask[..., None], shown, 1.0)), _written(normals_image(view))])
        depths.append(torch.where(view.mask, view.depth, torch.nan))
    if not any(bool(depth.isfinite().any()) for depth in depths):
        raise ValueError(f"the mesh must be large enough to be seen, found {mesh.diagonal:.3g} across; scale it to 1")
    return [np.concatenate([*two, depth], axis=1) for two, depth in zip(parts, _depth_images(depths), strict=True)]


def _depth_images(depths: list[Float[Tensor, "fine_height fine_width"]]) -> list[UInt8[np.ndarray, "height width 3"]]:
    """Depths, nan where nothing is seen, as colours on one scale: near yellow, far violet, nothing white."""
    known = [depth[depth.isfinite()] for depth in depths]
    low = min(float(depth.min()) for depth in known if depth.numel())
    high = max(float(depth.max()) for depth in known if depth.numel())
    colours = colormaps["viridis_r"].with_extremes(bad="white")
    return [_written(colours(((depth - low) / max(high - low, THINNEST)).numpy())[..., :3]) for depth in depths]


def _written(image: Float[np.ndarray, "fine_height fine_width 3"]) -> UInt8[np.ndarray, "height width 3"]:
    """The mean of each square of pixels."""
    height, width = image.shape[0] // FINER, image.shape[1] // FINER
    return (255 * image.reshape(height, FINER, width, FINER, 3).mean(axis=(1, 3))).round().astype(np.uint8)


def mesh_of_run(folder: Path) -> Path:
    """The mesh of a run folder.

    Raises:
        ValueError: there is none; the message has the run's status and reason.
    """
    if (folder / "mesh.ply").is_file():
        return folder / "mesh.ply"
    try:
        record = read_record(folder)
    except (OSError, ValueError, RecursionError):
        known = " ".join(SUFFIXES)
        raise ValueError(
            f"{folder} has no mesh.ply: name a run folder that has one, or a mesh file ({known})"
        ) from None
    why = ": ".join(str(record[key]) for key in ("status", "reason") if record.get(key))
    raise ValueError(f"{folder} has no mesh.ply: the run has no mesh ({why}); name another run, or a mesh file")


def stand(mesh: Mesh, up: str) -> Mesh:
    """A mesh turned until the axis `up` is y, and moved and scaled into the unit sphere where it does not lie in it."""
    turned = replace(mesh, vertices=mesh.vertices @ np.array(UPRIGHT[up], dtype=float).T)
    reach = np.linalg.norm(turned.used, axis=1).max()
    return turned if reach <= 1 + SLACK else normalise(turned, 1.0)


def main(arguments: list[str] | None = None) -> int:
    """Reads the command line, writes the animation and prints its path last; 2 where it cannot."""
    parser = argparse.ArgumentParser(prog="python -m bench.turntable", description=__doc__)
    parser.add_argument("shape", type=Path, metavar="RUN_OR_MESH", help=f"a run folder, or a file {' '.join(SUFFIXES)}")
    into = "a .webp or .gif file (default: turntable.webp in the run folder; for a mesh file, in the current folder)"
    parser.add_argument("--into", type=Path, metavar="FILE", help=into)
    parser.add_argument("--frames", type=int, default=36, help="of the turn (default: %(default)s)")
    parser.add_argument("--size", type=int, default=256, help="pixels of each part's side (default: %(default)s)")
    up = "the mesh's axis up, such as --up=-y (default: %(default)s)"
    parser.add_argument("--up", choices=tuple(UPRIGHT), default="y", help=up)
    given = parser.parse_args(arguments)
    try:
        run = given.shape.is_dir()
        into = given.into or (given.shape if run else Path()) / "turntable.webp"
        if into.suffix.lower() not in ENDINGS:
            better = into.parent / f"{into.stem or 'turn'}.webp"
            raise ValueError(f"--into must end in .webp or .gif, found '{into}'; type --into {better}")
        for file in (into, given.shape / "mesh.ply"):
            if run and file.parent == given.shape and leads_out(file, given.shape):
                raise ValueError(f"{file} is a link out of the run folder: remove it")
        mesh = read_mesh(mesh_of_run(given.shape) if run else given.shape)
        frames = [Image.fromarray(frame) for frame in turntable(stand(mesh, given.up), given.frames, given.size)]
        into.parent.mkdir(parents=True, exist_ok=True)
        lasting = round(TURN_MILLISECONDS / given.frames)
        frames[0].save(into, save_all=True, append_images=frames[1:], duration=lasting, loop=0, quality=QUALITY)
    except (OSError, ValueError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    for doubt in mesh.repairs:
        print(f"note: {doubt}")
    print(into)
    return 0


if __name__ == "__main__":
    sys.exit(main())
