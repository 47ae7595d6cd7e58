"""`python -m bench.turntable RUN_OR_MESH`: writes an animation of a shape that turns once about its vertical axis."""

import argparse
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib import colormaps
from PIL import Image
from torch import Tensor

from bench.evaluate.colours import painted
from bench.pictures.run_figures import LIGHT, normals_image, picture_normals
from bench.records.files import leads_out
from bench.records.record import read_record
from datasets.mesh import Mesh, normalise
from datasets.meshes import FLAT, READ_ERRORS, SUFFIXES, check_whole, find_meshes
from datasets.scene import View, see
from datasets.truth import Truth
from datasets.views import ViewSampler

PARTS = ("colours", "normals", "depth")  # of a frame
DISTANCE, FIELD_OF_VIEW = 2.5, 50.0  # scene units, degrees: the whole unit sphere is in the picture
FINER = 2  # pixels that are rendered, along each side of one that is written
SMALLEST, LARGEST = 16, 1024  # pixels of a part's side
MOST = 720  # frames
STEEPEST = 89  # degrees of elevation: a camera that looks straight down has no upper edge
THINNEST = 1e-6  # scene units of depth that the scale spans at least
ENDINGS = (".webp", ".gif")
QUALITY = 90  # of WebP, of 100: at the usual 80 edges leave traces on the white of later frames
TURN_MILLISECONDS = 3600
SLACK = 1e-6  # of the unit sphere, since files round
GREY = 0.7  # of parts without colours beside parts that have some
UPRIGHT = {  # rotations that make an axis the vertical one, y
    "x": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "-x": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}


@dataclass(frozen=True)
class Turn:
    """How a shape is shown.

    Args:
        frames: of a full turn.
        size: of each part, in pixels.
        elevation: of the camera, in degrees.
        show: parts of a frame, from left to right.
    """

    frames: int
    size: int
    elevation: float
    show: tuple[str, ...]

    def __post_init__(self) -> None:
        if not 2 <= self.frames <= MOST:
            raise ValueError(f"--frames must be 2 to {MOST}, found {self.frames}; 36 is a good number")
        if not SMALLEST <= self.size <= LARGEST:
            raise ValueError(f"--size must be {SMALLEST} to {LARGEST} pixels, found {self.size}; 256 is a good size")
        if not -STEEPEST <= self.elevation <= STEEPEST:
            raise ValueError(
                f"--elevation must be {-STEEPEST} to {STEEPEST} degrees, found {self.elevation:g}; 20 is a good angle"
            )
        wrong = [part for part in self.show if part not in PARTS]
        if wrong or len(set(self.show)) < len(self.show):
            raise ValueError(
                f"--show must be some of {','.join(PARTS)}, each once, found '{','.join(self.show)}'; "
                "type for example --show colours,normals"
            )

    def views(self, truth: Truth) -> Iterator[View]:
        """The views of a full turn, finer than written; a mesh may be wound inward, so all normals face the camera."""
        level = (self.elevation, self.elevation)
        sampler = ViewSampler(DISTANCE, FIELD_OF_VIEW, (0.0, 360.0), level, FINER * self.size)
        for frame in range(self.frames):
            view = see(truth, sampler.camera(360.0 * frame / self.frames, self.elevation))
            away = (view.normals * view.camera.rays().directions).sum(-1, keepdim=True) > 0
            yield replace(view, normals=torch.where(away, -view.normals, view.normals))


def turntable(mesh: Mesh, turn: Turn) -> list[UInt8[np.ndarray, "height width 3"]]:
    """The frames of a full turn of a mesh in the unit sphere: its parts side by side.

    Raises:
        ValueError: where the mesh is too small to be seen.
    """
    truth = Truth(mesh, closed=False)
    columns: dict[str, list[UInt8[np.ndarray, "height width 3"]]] = {part: [] for part in turn.show}
    depths: list[Float[Tensor, "fine_height fine_width"]] = []
    seen = False
    for view in turn.views(truth):
        seen = seen or bool(view.mask.any())
        if "colours" in columns:
            shown = _shaded(view) if mesh.colours is None else painted(mesh, truth, view.camera)
            columns["colours"].append(_written(np.where(view.mask[..., None], shown, 1.0)))
        if "normals" in columns:
            columns["normals"].append(_written(normals_image(view)))
        if "depth" in columns:
            depths.append(torch.where(view.mask, view.depth, torch.nan))
    if not seen:
        raise ValueError(f"the mesh must be large enough to be seen, found {mesh.diagonal:.3g} across; scale it to 1")
    if "depth" in columns:
        columns["depth"] = _depth_images(depths)
    return [np.concatenate(parts, axis=1) for parts in zip(*columns.values(), strict=True)]


def _depth_images(depths: list[Float[Tensor, "fine_height fine_width"]]) -> list[UInt8[np.ndarray, "height width 3"]]:
    """Depths, nan where nothing is seen, as colours on one scale: near yellow, far violet, nothing white."""
    known = [depth[depth.isfinite()] for depth in depths]
    low = min(float(depth.min()) for depth in known if depth.numel())
    high = max(float(depth.max()) for depth in known if depth.numel())
    colours = colormaps["viridis_r"].with_extremes(bad="white")
    return [_written(colours(((depth - low) / max(high - low, THINNEST)).numpy())[..., :3]) for depth in depths]


def _shaded(view: View) -> Float[np.ndarray, "height width 3"]:
    shade = 0.25 + 0.75 * (picture_normals(view).numpy() @ (LIGHT / np.linalg.norm(LIGHT))).clip(0, 1)
    return np.repeat(shade[..., None], 3, axis=-1)


def _written(image: Float[np.ndarray, "fine_height fine_width 3"]) -> UInt8[np.ndarray, "height width 3"]:
    """The mean of each square of pixels."""
    height, width = image.shape[0] // FINER, image.shape[1] // FINER
    return (255 * image.reshape(height, FINER, width, FINER, 3).mean(axis=(1, 3))).round().astype(np.uint8)


def read_surface(path: Path) -> tuple[Mesh, tuple[str, ...]]:
    """All triangles of a file, open or closed and not repaired, with their colours, and doubts about the file.

    Raises:
        ValueError: the file is missing, empty, truncated or broken, or holds no surface.
    """
    import trimesh

    (path,) = find_meshes(path)
    try:
        if path.stat().st_size == 0:
            raise ValueError("must hold a mesh, found 0 bytes; export or copy it again")
        doubts = check_whole(path)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a broken file makes numpy warn; its numbers are checked below
                scene = trimesh.load_scene(path, process=False)
                parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
                colours = [_vertex_colours(part) for part in parts]
        except READ_ERRORS as error:
            raise ValueError(f"cannot be read ({type(error).__name__}: {error}); export or copy it again") from None
        if not parts:
            raise ValueError("must have faces, found none; export it as a surface of triangles")
        mesh = _joined(parts, colours)
        if mesh.area <= FLAT * mesh.diagonal**2:
            raise ValueError(f"must have an area, found {mesh.area:.3g}; export it again")
    except ValueError as error:
        raise ValueError(f"mesh file '{path}': {error}") from None
    return mesh, doubts


def _joined(parts: list[Any], colours: list[Float[np.ndarray, "_ 3"] | None]) -> Mesh:
    """One mesh of all parts; it has colours if any part has some."""
    starts = np.cumsum([0] + [len(part.vertices) for part in parts])
    vertices = np.concatenate([np.asarray(part.vertices) for part in parts])
    faces = np.concatenate([np.asarray(part.faces) + start for part, start in zip(parts, starts, strict=False)])
    if all(known is None for known in colours):
        return Mesh(vertices, faces)
    painted = np.full(vertices.shape, GREY)
    for start, known in zip(starts, colours, strict=False):
        if known is not None:
            painted[start : start + len(known)] = known
    return Mesh(vertices, faces, colours=painted)


def _vertex_colours(part: Any) -> Float[np.ndarray, "v 3"] | None:
    """RGB of a trimesh.Trimesh from 0 to 1; None where its vertices and faces have none. Textures are not read."""
    from trimesh.visual.color import to_rgba

    colours = part.visual.vertex_colors if part.visual.kind in ("vertex", "face") else None
    if part.visual.kind == "texture":  # then trimesh keeps the colours of the vertices in one of two places
        colours = {**part.visual.vertex_attributes, **part.vertex_attributes}.get("color")
    return None if colours is None else to_rgba(colours)[:, :3] / 255


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
    reach = np.linalg.norm(turned.vertices[np.unique(turned.faces)], axis=1).max()
    return turned if reach <= 1 + SLACK else normalise(turned, 1.0)


def _arguments(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m bench.turntable", description=__doc__)
    parser.add_argument("shape", type=Path, metavar="RUN_OR_MESH", help=f"a run folder, or a file {' '.join(SUFFIXES)}")
    into = "a .webp or .gif file (default: turntable.webp in the run folder; for a mesh file, in the current folder)"
    parser.add_argument("--into", type=Path, metavar="FILE", help=into)
    parser.add_argument("--frames", type=int, default=36, help="of the turn (default: %(default)s)")
    parser.add_argument("--size", type=int, default=256, help="pixels of each part's side (default: %(default)s)")
    parser.add_argument("--elevation", type=float, default=20.0, help="of the camera, degrees (default: %(default)g)")
    show = "parts, from the left (default: %(default)s); without vertex colours in the file, colours is a grey surface"
    parser.add_argument("--show", default=",".join(PARTS), help=show)
    parser.add_argument("--up", choices=tuple(UPRIGHT), default="y", help="the mesh's axis up (default: %(default)s)")
    joined: list[str] = []
    for word in arguments:  # argparse would take the -y of `--up -y` for an option
        if joined and joined[-1] == "--up" and word in UPRIGHT:
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return parser.parse_args(joined)


def main(arguments: list[str] | None = None) -> int:
    """Reads the command line, writes the animation and prints its path last; 2 where it cannot."""
    given = _arguments(sys.argv[1:] if arguments is None else arguments)
    try:
        run = given.shape.is_dir()
        into = given.into or (given.shape if run else Path()) / "turntable.webp"
        if into.suffix.lower() not in ENDINGS:
            better = into.parent / f"{into.stem or 'turn'}.webp"
            raise ValueError(f"--into must end in .webp or .gif, found '{into}'; type --into {better}")
        turn = Turn(given.frames, given.size, given.elevation, tuple(word.strip() for word in given.show.split(",")))
        for file in (into, given.shape / "mesh.ply"):
            if run and file.parent == given.shape and leads_out(file, given.shape):
                raise ValueError(f"{file} is a link out of the run folder: remove it")
        mesh, doubts = read_surface(mesh_of_run(given.shape) if run else given.shape)
        frames = [Image.fromarray(frame) for frame in turntable(stand(mesh, given.up), turn)]
        into.parent.mkdir(parents=True, exist_ok=True)
        lasting = round(TURN_MILLISECONDS / turn.frames)
        frames[0].save(into, save_all=True, append_images=frames[1:], duration=lasting, loop=0, quality=QUALITY)
    except (OSError, ValueError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    for doubt in doubts:
        print(f"note: {doubt}")
    print(into)
    return 0


if __name__ == "__main__":
    sys.exit(main())
