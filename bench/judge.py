"""`python -m bench.judge MESH --truth TRUTH`, `--dtu FOLDER --scan 65` or `--tnt FOLDER --scene Barn`: judges a mesh.

Meshes are neither aligned nor scaled, except with --unit-sphere, --to-world or --tnt. Results are in the units of the
truth's file, with --unit-sphere in scene units, with --dtu in mm. The metrics are those of runs; bench/README.md
defines them under "Which Chamfer is it?".
"""

import argparse
import re
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bench.evaluate.distances import cloud_metrics, measure_distances, subsample, surface_protocol
from bench.evaluate.evaluate import DEFINITIONS, WORST_SURFACE, surface_metrics
from bench.pictures.distances import draw_distances
from bench.records.read import is_plain_name
from bench.records.record import Record, RunStatus, digest, now, read_record
from bench.records.results import check_links
from bench.report.write.html import write_index
from bench.tables import choice
from bench.tasks.reconstruction import dtu, tanks
from datasets.files import coincidence
from datasets.files.meshes import find_meshes, read_mesh, read_points
from datasets.files.own_photographs import Capture, ReadSettings, read_capture, scan_number
from datasets.mesh import Mesh, fit_in_sphere
from datasets.scene import sample_surface
from renderers.checks import BadInput

SURFACE_POINTS = choice("scale", "desk")["points"]  # as in runs
SPHERE_RADIUS = choice("dataset", "mesh")["radius"]  # runs move a mesh into this sphere
DEFAULT_THRESHOLD = "1%"  # runs have 0.02, for shapes about 2 across
MAX_CULLING_PIXELS = 800  # longer side of a photograph whose mask culls a mesh
UNIT_SUFFIXES = {"chamfer_l2": "²", "chamfer_gt_to_pred": "²", "fscore": None, "normal_consistency": None}
WORLD_MESH_FILE = "mesh_world.ply"  # the mesh of a run on photographs, in the world of their cameras
ROW_PICTURE_FILE = "distances.png"
PICTURE_POINTS = 150_000  # per surface, so that the samples are not seen in the picture
JUDGE_TASK = "judge"  # the task of rows without --like


@dataclass(frozen=True)
class Item:
    """A mesh, None if none has the truth's name; and the truth: a file, the number of a scan or the name of a scene."""

    name: str
    mesh: Path | None
    truth: Path | int | str


@dataclass(frozen=True)
class Verdict:
    """The metrics of a mesh, and notes. If judging failed, `failure` is the reason, with the worst metrics.

    `draw` writes a picture of the distances, with a title, to a path. `is_other_frame`: the mesh fits its truth far
    better after a change of axes, units or origin.
    """

    name: str
    metrics: dict[str, float]
    notes: Sequence[str] = ()
    failure: str = ""
    mesh: Mesh | None = None
    draw: Callable[[str, Path], None] | None = None
    is_other_frame: bool = False


@dataclass(frozen=True)
class Judge:
    """The settings for judging meshes."""

    dtu_folder: Path | None  # None for other truths
    threshold: str  # of the F-score, in units or, with %, in per cent of the truth's extent
    points: int  # sampled on each surface
    seed: int
    unit_sphere: bool  # move both like the mesh of a run: the box's centre to the origin, scaled into `SPHERE_RADIUS`
    to_world: Path | None  # photographs; meshes are moved from their unit sphere into the world of their cameras
    cull: Path | None  # photographs whose masks cull meshes
    tanks_folder: Path | None = None  # None for other truths
    tanks_settings: tanks.TanksSettings = tanks.PUBLISHED

    def __post_init__(self) -> None:
        if self.dtu_folder is not None and (self.unit_sphere or self.threshold != DEFAULT_THRESHOLD):
            raise ValueError("--unit-sphere and --threshold are for --truth: --dtu has mm and no F-score")
        if self.tanks_folder is not None and (self.unit_sphere or self.threshold != DEFAULT_THRESHOLD):
            raise ValueError("--unit-sphere and --threshold are for --truth: --tnt has metres and a scene's threshold")
        if self.tanks_folder is None and self.tanks_settings != tanks.PUBLISHED:
            raise ValueError("--align, --no-icp and --surface are for --tnt: add --tnt FOLDER --scene Barn")
        if self.points < 1:
            raise ValueError(f"--points must be at least 1, found {self.points}")
        if self.seed < 0:
            raise ValueError(f"--seed must be at least 0, found {self.seed}")
        if not re.fullmatch(r"[\d.eE+-]+%?", self.threshold) or not float(self.threshold.rstrip("%")) > 0:
            raise ValueError(f"--threshold must be a positive number, such as 0.02 or 1%, not {self.threshold}")

    def verdict(self, item: Item) -> Verdict:
        """Judges a mesh; raises ValueError or OSError if files cannot be read, or nothing can be compared."""
        if item.mesh is None:
            raise ValueError(f"no mesh is named '{item.name}', as {item.truth} is")
        if isinstance(item.truth, str):
            return self._by_scene(item.name, item.mesh, item.truth)
        mesh = self.prepare(read_mesh(item.mesh))
        if isinstance(item.truth, Path):
            return self._by_surface(item.name, mesh, item.truth)
        scan = dtu.read_scan(self.dtu_folder or Path(), item.truth)
        notes, is_other_frame = _frame_check(mesh, scan.points_above_plane(), is_partial=True)
        notes += dtu.published_results(item.truth)
        distances = dtu.dtu_distances(mesh, scan, seed=self.seed)
        metrics = dtu.metrics_of(distances)
        if metrics["dtu_accuracy"] == inf:
            raise BadInput(
                f"'{item.mesh}': nothing of the mesh lies within {dtu.MAX_DISTANCE_MM:g} mm of scan {item.truth} "
                "where it was observed: it must be in DTU's world, in mm; --to-world PHOTOS moves it there from their "
                "unit sphere"
            )
        notes.append(f"how: {dtu.PROTOCOL}")
        return Verdict(
            item.name, metrics, notes, mesh=mesh, draw=partial(draw_distances, distances), is_other_frame=is_other_frame
        )

    def _by_scene(self, name: str, file: Path, scene_name: str) -> Verdict:
        """The metrics of Tanks and Temples. The file may have points only, as results there do."""
        points = read_points(file)
        if points is not None and (self.to_world or self.cull):
            raise BadInput(f"'{file}' has no faces, and --to-world and --cull move and cut meshes: leave them out")
        mesh = None if points is not None else self.prepare(read_mesh(file))
        scene = tanks.read_scene(self.tanks_folder or Path(), scene_name)
        settings = self.tanks_settings
        distances, notes = tanks.tanks_distances(mesh or points, scene, settings, seed=self.seed)
        notes = [*notes, f"how: {tanks.protocol(scene, settings)}"]
        metrics = tanks.tanks_metrics(distances, scene.threshold)
        return Verdict(name, metrics, notes, mesh=mesh, draw=partial(draw_distances, distances))

    def row_settings(self, truth: Path | int | str) -> dict[str, Any]:
        """The settings on which the metrics of a mesh depend, except the seed, and the name of its truth."""
        settings = {"points": self.points, "threshold": self.threshold, "unit_sphere": self.unit_sphere}
        settings |= {"truth": truth.name if isinstance(truth, Path) else truth, "to_world": self.to_world}
        settings |= {"cull": self.cull} | vars(self.tanks_settings)
        return {name: str(value) if isinstance(value, Path) else value for name, value in settings.items()}

    def prepare(self, mesh: Mesh) -> Mesh:
        """The mesh after the movement and the culling of the settings."""
        if self.to_world is not None:
            mesh = mesh.moved(_photographs(self.to_world).to_world)
        if self.cull is None:
            return mesh
        capture = _photographs(self.cull)
        kept = dtu.culled(mesh.moved(np.linalg.inv(capture.to_world)), capture.shots)
        if kept is None:
            raise BadInput(f"the masks of {self.cull} leave nothing of the mesh: is it in the world of their cameras?")
        return kept.moved(capture.to_world)

    def _by_surface(self, name: str, mesh: Mesh, truth: Path) -> Verdict:
        cloud = read_points(truth)
        surface = None if cloud is not None else read_mesh(truth)
        truth_points = surface.used_vertices if surface is not None else cloud
        all_points = truth_points if surface is None else coincidence.samples_of(surface)
        if not np.ptp(truth_points, axis=0).any():
            raise BadInput(f"'{truth}': points must differ, found {len(truth_points)} at one place: export it again")
        notes, is_other_frame = _frame_check(mesh, all_points, is_partial=False)
        if self.unit_sphere:
            centre, factor = fit_in_sphere(truth_points, SPHERE_RADIUS)
            mesh, surface = (old and replace(old, vertices=(old.vertices - centre) * factor) for old in (mesh, surface))
            truth_points = (truth_points - centre) * factor
        extent = float(np.linalg.norm(np.ptp(truth_points, axis=0)))
        threshold = float(self.threshold.rstrip("%")) * (extent / 100 if self.threshold.endswith("%") else 1)
        threshold_text = f"{threshold:.4g}, {threshold / extent:.2%} of the truth's extent"
        protocol = surface_protocol(self.points, threshold_text, has_faces=surface is not None)
        notes += [f"how: {text}" for text in protocol]
        predicted_samples = sample_surface(mesh, self.points, self.seed + 1)
        unit = "scene units" if self.unit_sphere else "units"

        def draw(title: str, path: Path) -> None:
            pair = mesh, truth_points if surface is None else surface
            settings = {"seed": self.seed, "threshold": threshold, "unit": unit}
            measured = measure_distances(*pair, count=self.points, **settings)
            count, limit = max(self.points, PICTURE_POINTS), 1.01 * measured.colour_end  # larger ones have one colour
            dense = measure_distances(*pair, count=count, limit=limit, **settings)
            draw_distances(measured, title, path, dense)

        if surface is None:
            true_points = subsample(truth_points, self.points, self.seed)
            metrics = cloud_metrics(predicted_samples, true_points, threshold=threshold)
        else:
            true_samples, repeated = (sample_surface(surface, self.points, self.seed + offset) for offset in (0, 2))
            sampling_error = surface_metrics(repeated, true_samples, threshold=threshold)
            notes.append(f"two samplings of the truth have chamfer_l1 {sampling_error['chamfer_l1']:.4g}")
            metrics = surface_metrics(predicted_samples, true_samples, threshold=threshold)
        return Verdict(name, metrics, notes, mesh=mesh, draw=draw, is_other_frame=is_other_frame)


@cache
def _photographs(folder: Path) -> Capture:
    return read_capture(folder, ReadSettings(MAX_CULLING_PIXELS, unchecked=True))


def _frame_check(mesh: Mesh, truth: Float[np.ndarray, "n 3"], *, is_partial: bool) -> tuple[list[str], bool]:
    """A warning if a mesh, or a part of it, is probably in other units or another world; whether a change fits."""
    comparison = coincidence.compare_surfaces(mesh, truth, is_partial=is_partial)
    warning = (
        f"warning: {comparison.text('the mesh', 'the truth')}: are both in the same world and units? The mesh of a run "
        "is in its unit sphere"
    )
    return [] if comparison.coincides else [warning], comparison.is_other_frame


def items_of(mesh: Path, truth: Path | None, truth_of: Callable[[str], int | str]) -> list[Item]:
    """The meshes of a file, run or folder, with truths of their names; raises ValueError if these do not fit."""
    name = mesh.stem
    if (mesh / "record.json").is_file():
        name, mesh = mesh.name, mesh / (WORLD_MESH_FILE if (mesh / WORLD_MESH_FILE).is_file() else "mesh.ply")
    meshes = {file.stem: file for file in find_meshes(mesh)} if mesh.is_dir() else {name: mesh}
    if truth is None:
        return [Item(name, file, truth_of(file.stem)) for name, file in meshes.items()]
    if mesh.is_dir() and not truth.is_dir():
        raise ValueError(f"{mesh} is a folder and --truth {truth} is none: give a folder with files of equal names")
    if truth.is_dir() and not mesh.is_dir():
        raise ValueError(f"--truth {truth} is a folder, and {mesh} is one mesh: name the file")
    truths = {file.stem: file for file in find_meshes(truth)} if truth.is_dir() else {name: truth}
    if unknown := sorted(meshes.keys() - truths.keys()):
        raise ValueError(f"{meshes[unknown[0]]} has no truth: name it as a file of {truth}, such as {min(truths)}")
    return [Item(name, meshes.get(name), file) for name, file in truths.items()]


def metric_units(judge: Judge) -> dict[str, str]:
    if judge.dtu_folder is not None:
        return dict.fromkeys(dtu.METRIC_NAMES, "mm")
    if judge.tanks_folder is not None:
        return dict.fromkeys(tanks.METRIC_NAMES, "")
    unit = "scene unit" if judge.unit_sphere else "unit"
    powers = {name: UNIT_SUFFIXES.get(name, "") for name in WORST_SURFACE}
    return {name: "" if power is None else unit + power for name, power in powers.items()}


def print_verdicts(verdicts: Sequence[Verdict], units: dict[str, str]) -> None:
    rows = [(verdict.name, verdict.metrics) for verdict in verdicts]
    names = [name for name in units if any(name in metrics for _, metrics in rows)]
    if len(rows) > 1:
        values_by_name = {name: [metrics.get(name, np.nan) for _, metrics in rows] for name in names}
        rows.append(("median", {name: float(np.median(values)) for name, values in values_by_name.items()}))
    width, columns = max(len(name) for name, _ in rows), [max(len(name), len(units[name]), 10) for name in names]
    for heads in (names, [units[name] for name in names]):
        print(" " * width, *(f"{text:>{size}}" for text, size in zip(heads, columns, strict=True)), sep="  ")
    for name, metrics in rows:
        values = (f"{metrics.get(metric, np.nan):>{size}.4g}" for metric, size in zip(names, columns, strict=True))
        print(f"{name:<{width}}", *values, sep="  ")
    names_by_note = {note: [v.name for v in verdicts if note in v.notes] for v in verdicts for note in v.notes}
    for note, mesh_names in names_by_note.items():
        print(note if len(mesh_names) == len(verdicts) else f"{', '.join(mesh_names)}: {note}")
    for verdict in verdicts:
        if verdict.failure:
            print(f"{verdict.name}: {verdict.failure}", file=sys.stderr)


def write_row(verdict: Verdict, item: Item, index: int, judge: Judge, options: argparse.Namespace) -> None:
    """Writes a verdict as the record of a run, which tables and the page show with the runs of renderers."""
    method = re.sub(r"[^a-z0-9]+", "_", options.method.lower()).strip("_")
    settings = judge.row_settings(item.truth)
    if options.like is not None:
        like = read_record(options.like)
        fields: dict[str, Any] = {name: like[name] for name in ("task", "dataset", "seed", "scene", "config")}
    else:
        scene = f"scan{item.truth}" if isinstance(item.truth, int) else item.truth
        path, scene = (options.truth, item.name) if options.truth else ((options.dtu or options.tnt) / scene, scene)
        config = {"task": settings, "dataset": {"path": str(path)}, "index": index, "split": "test"}
        fields = {"task": JUDGE_TASK, "dataset": JUDGE_TASK, "seed": judge.seed, "scene": scene, "config": config}
    fields["config"] |= {"label": options.method, "renderer": {}, "silhouette": None, "results_dir": str(options.into)}
    key = digest([method, fields["task"], fields["config"], fields["seed"], item.name, settings])
    record = Record(f"{fields['task']}-{method}-{key}", renderer=method, **fields)
    record.status, record.reason = (RunStatus.EMPTY, verdict.failure) if verdict.failure else (RunStatus.OK, "")
    record.metrics, record.notes = dict(verdict.metrics), [f"judged from {item.mesh}", *verdict.notes]
    unit = "scene units" if judge.unit_sphere else "units of the truth's file"
    definitions = {name: text.replace("scene units", unit) for name, text in DEFINITIONS.items()}
    definitions |= dtu.DEFINITIONS | tanks.DEFINITIONS
    record.definitions = {name: definitions[name] for name in verdict.metrics}
    record.ended = now()
    folder = options.into / "runs" / record.id
    folder.mkdir(parents=True, exist_ok=True)
    if verdict.mesh is not None:
        verdict.mesh.save(folder / "mesh.ply")
    picture = picture_path(options.picture, item)
    if picture is not None and verdict.draw is not None:
        shutil.copy(picture, folder / ROW_PICTURE_FILE)
    record.write(folder)


def parse_arguments(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m bench.judge", description=__doc__)
    parser.add_argument("mesh", type=Path, metavar="MESH", help="a mesh with faces, a run folder, or a folder of these")
    truth = parser.add_mutually_exclusive_group(required=True)
    truth.add_argument("--truth", type=Path, help="the true mesh, or points on it; a folder where MESH is one")
    truth.add_argument("--dtu", type=Path, metavar="FOLDER", help="DTU's, with Points/stl and ObsMask")
    truth.add_argument("--tnt", type=Path, metavar="FOLDER", help="Tanks and Temples', with Barn/Barn.ply, Barn.json")
    parser.add_argument("--scan", type=int, help="of DTU (default: the number in the mesh's name)")
    parser.add_argument("--scene", help="of Tanks and Temples (default: the scene in the mesh's name)")
    parser.add_argument("--align", type=Path, metavar="FILE", help="of --tnt: 4 x 4 numbers, or .log of the cameras")
    parser.add_argument("--no-icp", dest="icp", action="store_false", help="of --tnt: do not refine the alignment")
    parser.add_argument("--surface", action="store_true", help="of --tnt: points of faces too, not only vertices")
    threshold = "of F, in units or %% of the truth's extent (default: %(default)s)"
    parser.add_argument("--threshold", default=DEFAULT_THRESHOLD, help=threshold)
    points = "sampled on each surface (default: %(default)s)"
    parser.add_argument("--points", type=int, default=SURFACE_POINTS, help=points)
    parser.add_argument("--seed", type=int, default=0, help="of the samples (default: %(default)s)")
    parser.add_argument("--unit-sphere", action="store_true", help="move both as runs move a mesh: scene units")
    parser.add_argument("--to-world", type=Path, metavar="PHOTOS", help="move the mesh out of their unit sphere")
    parser.add_argument("--cull", type=Path, metavar="PHOTOS", help="cut off what their masks exclude, as NeuS does")
    picture = "mesh and truth coloured by distance, with curves as .csv; a folder where MESH is one"
    parser.add_argument("--picture", type=Path, metavar="PNG", help=picture)
    parser.add_argument("--into", type=Path, metavar="RESULTS", help="write rows into a results folder")
    parser.add_argument("--method", help="the name of these rows")
    parser.add_argument("--unchecked", action="store_true", help="write rows although another frame fits far better")
    parser.add_argument("--like", type=Path, metavar="RUN", help="a run whose problem the meshes answer")
    return parser.parse_args(arguments)


def check_options(options: argparse.Namespace) -> None:
    """Raises ValueError for options that do not fit each other, with what to type instead."""
    is_folder = options.mesh.is_dir() and not (options.mesh / "record.json").is_file()
    if options.into is not None and not (options.method and is_plain_name(options.method)):
        raise ValueError("--into writes rows of a method: add --method NAME")
    if options.like is not None and is_folder:
        raise ValueError(f"--like names the problem of one run, and {options.mesh} is a folder: name one mesh")
    if options.like is not None and not options.unit_sphere and read_record(options.like)["dataset"] != "photos":
        raise ValueError("--like names a run, whose metrics are in scene units: add --unit-sphere, and its truth")
    if options.picture is not None and (options.picture.suffix.lower() == ".png") is is_folder:
        wanted = "a folder" if is_folder else "a file that ends in .png"
        raise ValueError(f"--picture must name {wanted} for {options.mesh}, found {options.picture}")
    if options.scene is not None and options.tnt is None:
        raise ValueError("--scene is of Tanks and Temples: add --tnt FOLDER")
    if options.into is not None:
        check_links(options.into)


def picture_path(picture: Path | None, item: Item) -> Path | None:
    is_file = picture is None or picture.suffix.lower() == ".png"
    return picture if is_file else picture / f"{item.name}.png"


def truth_of(options: argparse.Namespace, name: str) -> int | str:
    """The scan or the scene of a mesh, from the command line or from its name."""
    if options.tnt is not None:
        return tanks.scene_name(options.scene or name)
    return scan_number(name) if options.scan is None else options.scan


def main(arguments: list[str] | None = None) -> int:
    """Judges the meshes of the command line; returns 0 for success, 1 if some could not be judged, 2 if none could."""
    options, items, verdicts = parse_arguments(arguments), list[Item](), list[Verdict]()
    rows = list[tuple[Verdict, Item, int]]()  # they wait for a mesh in its truth's frame
    try:
        judge = Judge(
            *(options.dtu, options.threshold, options.points, options.seed),
            *(options.unit_sphere, options.to_world, options.cull),
            *(options.tnt, tanks.TanksSettings(options.align, options.icp, options.surface)),
        )
        check_options(options)
        items = items_of(options.mesh, options.truth, partial(truth_of, options))
        fits = options.unchecked
        for index, item in enumerate(items):
            try:
                verdict = judge.verdict(item)
            except (OSError, ValueError) as error:
                if len(items) == 1:
                    raise
                worst = WORST_SURFACE if options.truth else dtu.WORST if options.dtu else tanks.WORST
                verdict = Verdict(item.name, dict(worst), failure=" ".join(str(error).split()))
            picture = picture_path(options.picture, item) if verdict.draw is not None else None
            if picture is not None:
                picture.parent.mkdir(parents=True, exist_ok=True)
                verdict.draw(f"{item.name}: distance of each point to the other surface", picture)
            fits = fits or not (verdict.failure or verdict.is_other_frame)
            if options.into is not None:
                rows.append((verdict, item, index))
            while fits and rows:
                write_row(*rows.pop(0), judge, options)
            verdicts.append(replace(verdict, mesh=None, draw=None))  # a folder may have many
        print_verdicts(verdicts, metric_units(judge))
        if options.into is not None:
            if any(verdict.is_other_frame for verdict, _, _ in rows):
                raise ValueError(
                    "no row is written, since no mesh is in its truth's frame (see above): add --unchecked"
                )
            for row in rows:
                write_row(*row, judge, options)
            print(write_index(options.into))
    except KeyboardInterrupt:
        written = f", rows of {max(len(verdicts) - len(rows), 0)} written" if options.into else ""
        print(f"interrupted: {len(verdicts)} of {len(items)} judged{written}", file=sys.stderr)
        return 130
    except (OSError, ValueError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 1 if any(verdict.failure for verdict in verdicts) else 0


if __name__ == "__main__":
    sys.exit(main())
