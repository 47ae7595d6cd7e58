"""`python -m bench.judge MESH --truth TRUTH`, or `--dtu FOLDER --scan 65`: judges a mesh that anything made.

Meshes are compared as they stand: nothing is aligned or scaled, but with --unit-sphere or --to-world. Results are in
the units of the truth's file, with --unit-sphere in scene units, with --dtu in mm. The metrics are those of runs;
bench/README.md defines them under "Which Chamfer is it?".
"""

import argparse
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bench.evaluate import dtu
from bench.evaluate.evaluate import DEFINITIONS, WORST_SURFACE, cloud_metrics, subsample, surface_metrics
from bench.records.read import check_links
from bench.records.record import Record, RunStatus, digest, is_plain_name, now, read_record
from bench.report.write.html import write_index
from bench.tables import choice
from datasets.mesh import Mesh, fit_in_sphere
from datasets.meshes import find_meshes, read_mesh, read_points
from datasets.own_photographs import Capture, Reading, read_capture, scan_number
from datasets.scene import sample_surface
from renderers.checks import BadInput

POINTS = choice("scale", "desk")["points"]  # sampled on each surface, as in runs
RADIUS = choice("dataset", "mesh")["radius"]  # of the sphere into which runs move a mesh
THRESHOLD = "1%"  # of F, of the truth's extent: in runs 0.02, of shapes about 2 across
LIKE_A_SCAN = (10.0, 0.0)  # of a mesh, which may have more than what was scanned; see `_unlike`
LIKE_A_SHAPE = (1.2, 0.5)  # of a mesh of the same shape
FLAT = 0.02  # of the diagonal: boxes are enlarged by it on each side, so that those of plates have a volume
LONGEST = 800  # pixels of a photograph whose mask culls a mesh
POWERS = {"chamfer_l2": "²", "chamfer_gt_to_pred": "²", "fscore": None, "normal_consistency": None}  # of the unit
WORLD = "mesh_world.ply"  # of a run on photographs, in the world of their cameras
TASK = "judge"  # of rows, where no run is named that they are like


@dataclass(frozen=True)
class Item:
    """A mesh and the file or the number of the scan that judge it; without a mesh none has the truth's name."""

    name: str
    mesh: Path | None
    truth: Path | int


@dataclass(frozen=True)
class Verdict:
    """What a mesh is worth, and notes; `failure` says why it could not be judged, and has the worst metrics."""

    name: str
    metrics: dict[str, float]
    notes: Sequence[str] = ()
    failure: str = ""
    mesh: Mesh | None = None


@dataclass(frozen=True)
class Judge:
    """How meshes are judged.

    Args:
        folder: of DTU; None for surfaces.
        threshold: of F, in units or, with %, per cent of the truth's extent.
        points: that are sampled on each surface.
        seed: of what is drawn.
        unit_sphere: whether both are moved as runs move a mesh: the truth's box to the origin, into a sphere of
            `RADIUS`.
        to_world: photographs from whose unit sphere meshes are moved into the world of their cameras.
        cull: photographs whose masks cull meshes.
    """

    folder: Path | None
    threshold: str
    points: int
    seed: int
    unit_sphere: bool
    to_world: Path | None
    cull: Path | None

    def __post_init__(self) -> None:
        if self.folder is not None and self.unit_sphere:
            raise ValueError("--unit-sphere is for --truth, and DTU's distances are in mm: leave it out")
        if self.points < 1:
            raise ValueError(f"--points must be at least 1, found {self.points}")
        if not re.fullmatch(r"[\d.eE+-]+%?", self.threshold) or not float(self.threshold.rstrip("%")) > 0:
            raise ValueError(f"--threshold must be a positive number, or one with %, found {self.threshold}: 1%")

    def verdict(self, item: Item) -> Verdict:
        """Judges a mesh.

        Raises:
            ValueError, OSError: where files cannot be read, or nothing can be compared.
        """
        if item.mesh is None:
            raise ValueError(f"no mesh is named '{item.name}', as {item.truth} is")
        mesh = self.prepared(read_mesh(item.mesh))
        if isinstance(item.truth, Path):
            return self._by_surface(item.name, mesh, item.truth)
        scan = dtu.read_scan(self.folder or Path(), item.truth)
        notes = [*_unlike(mesh, scan.points_above_plane(), *LIKE_A_SCAN), *dtu.published_results(item.truth)]
        metrics = dtu.dtu_metrics(mesh, scan, seed=self.seed)
        if metrics["dtu_accuracy"] == inf:
            raise BadInput(
                f"'{item.mesh}': nothing of the mesh lies within {dtu.MAX_DISTANCE_MM:g} mm of scan {item.truth} "
                "where it was observed: it must be in DTU's world, in mm; --to-world PHOTOS moves it there from their "
                "unit sphere"
            )
        return Verdict(item.name, metrics, notes, mesh=mesh)

    def prepared(self, mesh: Mesh) -> Mesh:
        """The mesh in the world of the cameras, culled, where that is asked for."""
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
        """The surface metrics against a file with a mesh or a cloud of points."""
        cloud = read_points(truth)
        surface = None if cloud is not None else read_mesh(truth)
        places = surface.used if surface is not None else cloud
        notes = _unlike(mesh, places, *LIKE_A_SHAPE)
        if self.unit_sphere:
            centre, factor = fit_in_sphere(places, RADIUS)
            mesh, surface = (one and replace(one, vertices=(one.vertices - centre) * factor) for one in (mesh, surface))
            places = (places - centre) * factor
        extent = float(np.linalg.norm(np.ptp(places, axis=0)))
        threshold = float(self.threshold.rstrip("%")) * (extent / 100 if self.threshold.endswith("%") else 1)
        at = f"{threshold:.4g}, {threshold / extent:.2%} of the truth's extent"
        notes.append(f"{self.points} points of each; F at {at}")
        found = sample_surface(mesh, self.points, self.seed + 1)
        if surface is None:
            metrics = cloud_metrics(found, subsample(places, self.points, self.seed), threshold=threshold)
            return Verdict(name, metrics, notes, mesh=mesh)
        true, again = (sample_surface(surface, self.points, self.seed + more) for more in (0, 2))
        floor = surface_metrics(again, true, threshold=threshold)
        notes.append(f"two samplings of the truth have chamfer_l1 {floor['chamfer_l1']:.4g}")
        return Verdict(name, surface_metrics(found, true, threshold=threshold), notes, mesh=mesh)


@cache
def _photographs(folder: Path) -> Capture:
    return read_capture(folder, Reading(LONGEST, unchecked=True))


def _unlike(mesh: Mesh, places: Float[np.ndarray, "n 3"], most: float, least: float) -> list[str]:
    """A warning about a mesh that is probably in another world or in other units than its truth.

    Args:
        most: times as large as the truth, or as small, without a warning.
        least: overlap of their boxes without a warning, as a share of the volume that both fill.
    """
    extent = float(np.linalg.norm(np.ptp(places, axis=0)))
    ratio, slack = mesh.diagonal / max(extent, 1e-300), FLAT * max(mesh.diagonal, extent)
    boxes = [(points.min(axis=0) - slack, points.max(axis=0) + slack) for points in (mesh.used, places)]
    low, high = np.stack(boxes, axis=1)
    shared = (high.min(axis=0) - low.max(axis=0)).clip(0).prod()
    overlap = shared / ((high - low).prod(axis=1).sum() - shared)
    if 1 / most <= ratio <= most and overlap >= least:
        return []
    return [
        f"warning: the mesh is {ratio:.3g} times as large as the truth, and their boxes overlap by {overlap:.0%}: are "
        "both in the same world and units? The mesh of a run is in its unit sphere"
    ]


def items_of(mesh: Path, truth: Path | None, scan: int | None) -> list[Item]:
    """What is judged: a mesh, a run's mesh, or one of a folder for each truth of the same name, or number of a scan.

    Raises:
        ValueError: where the two do not fit.
    """
    name = mesh.stem
    if (mesh / "record.json").is_file():
        name, mesh = mesh.name, mesh / (WORLD if (mesh / WORLD).is_file() else "mesh.ply")
    meshes = {file.stem: file for file in find_meshes(mesh)} if mesh.is_dir() else {name: mesh}
    if truth is None:
        return [Item(name, file, scan_number(file.stem) if scan is None else scan) for name, file in meshes.items()]
    if mesh.is_dir() and not truth.is_dir():
        raise ValueError(f"{mesh} is a folder and --truth {truth} is none: give a folder with files of equal names")
    if truth.is_dir() and not mesh.is_dir():
        raise ValueError(f"--truth {truth} is a folder, and {mesh} is one mesh: name the file")
    truths = {file.stem: file for file in find_meshes(truth)} if truth.is_dir() else {name: truth}
    if unknown := sorted(meshes.keys() - truths.keys()):
        raise ValueError(f"{meshes[unknown[0]]} has no truth: name it as a file of {truth}, such as {min(truths)}")
    return [Item(name, meshes.get(name), file) for name, file in truths.items()]


def units(judge: Judge) -> dict[str, str]:
    """The unit of each metric."""
    if judge.folder is not None:
        return dict.fromkeys(dtu.METRIC_NAMES, "mm")
    unit = "scene unit" if judge.unit_sphere else "unit"
    powers = {name: POWERS.get(name, "") for name in WORST_SURFACE}
    return {name: "" if power is None else unit + power for name, power in powers.items()}


def show(verdicts: Sequence[Verdict], known: dict[str, str]) -> None:
    """Prints a line per mesh, medians of several, and notes."""
    rows = [(verdict.name, verdict.metrics) for verdict in verdicts]
    names = [name for name in known if any(name in metrics for _, metrics in rows)]
    if len(rows) > 1:
        worst = {name: [metrics.get(name, np.nan) for _, metrics in rows] for name in names}
        rows.append(("median", {name: float(np.median(values)) for name, values in worst.items()}))
    width, columns = max(len(name) for name, _ in rows), [max(len(name), len(known[name]), 10) for name in names]
    for head in (names, [known[name] for name in names]):
        print(" " * width, *(f"{text:>{size}}" for text, size in zip(head, columns, strict=True)), sep="  ")
    for name, metrics in rows:
        values = (f"{metrics.get(one, np.nan):>{size}.4g}" for one, size in zip(names, columns, strict=True))
        print(f"{name:<{width}}", *values, sep="  ")
    told = {note: [v.name for v in verdicts if note in v.notes] for v in verdicts for note in v.notes}
    for note, of in told.items():
        print(note if len(of) == len(verdicts) else f"{', '.join(of)}: {note}")
    for verdict in verdicts:
        if verdict.failure:
            print(f"{verdict.name}: {verdict.failure}", file=sys.stderr)


def write_row(verdict: Verdict, item: Item, place: int, judge: Judge, given: argparse.Namespace) -> None:
    """Writes a verdict as the record of a run, which tables and page show beside renderers' runs.

    Args:
        place: of the mesh in its folder.
        given: the command line: `into`, `method`, and `like`, a run whose problem the meshes answer.
    """
    words = re.sub(r"[^a-z0-9]+", "_", given.method.lower()).strip("_")
    if given.like is not None:
        like = read_record(given.like)
        fields: dict[str, Any] = {name: like[name] for name in ("task", "dataset", "seed", "scene", "config")}
    else:
        where = str(given.truth or given.dtu)
        config = {"task": {"points": judge.points}, "dataset": {"path": where}, "index": place, "split": "test"}
        fields = {"task": TASK, "dataset": TASK, "seed": judge.seed, "scene": item.name, "config": config}
    fields["config"] |= {"label": given.method, "renderer": {}, "silhouette": None, "results_dir": str(given.into)}
    key = digest([words, fields["task"], fields["config"], fields["seed"], item.name])
    record = Record(f"{fields['task']}-{words}-{key}", renderer=words, **fields)
    record.status, record.reason = (RunStatus.EMPTY, verdict.failure) if verdict.failure else (RunStatus.OK, "")
    record.metrics, record.notes = dict(verdict.metrics), [f"judged from {item.mesh}", *verdict.notes]
    unit = "scene units" if judge.unit_sphere else "units of the truth's file"
    known = {name: text.replace("scene units", unit) for name, text in DEFINITIONS.items()} | dtu.DEFINITIONS
    record.definitions = {name: known[name] for name in verdict.metrics}
    record.ended = now()
    folder = given.into / "runs" / record.id
    folder.mkdir(parents=True, exist_ok=True)
    if verdict.mesh is not None:
        verdict.mesh.save(folder / "mesh.ply")
    record.write(folder)


def parsed(arguments: list[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m bench.judge", description=__doc__)
    parser.add_argument("mesh", type=Path, metavar="MESH", help="a mesh with faces, a run folder, or a folder of these")
    truth = parser.add_mutually_exclusive_group(required=True)
    truth.add_argument("--truth", type=Path, help="the true mesh, or points on it; a folder where MESH is one")
    truth.add_argument("--dtu", type=Path, metavar="FOLDER", help="DTU's, with Points/stl and ObsMask")
    parser.add_argument("--scan", type=int, help="of DTU (default: the number in the mesh's name)")
    threshold = "of F, in units or %% of the truth's extent (default: %(default)s)"
    parser.add_argument("--threshold", default=THRESHOLD, help=threshold)
    parser.add_argument("--points", type=int, default=POINTS, help="sampled on each surface (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the samples (default: %(default)s)")
    parser.add_argument("--unit-sphere", action="store_true", help="move both as runs move a mesh: scene units")
    parser.add_argument("--to-world", type=Path, metavar="PHOTOS", help="move the mesh out of their unit sphere")
    parser.add_argument("--cull", type=Path, metavar="PHOTOS", help="cut off what their masks exclude, as NeuS does")
    parser.add_argument("--into", type=Path, metavar="RESULTS", help="write rows into a results folder")
    parser.add_argument("--method", help="the name of these rows")
    parser.add_argument("--like", type=Path, metavar="RUN", help="a run whose problem the meshes answer")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Reads the command line; 0 where all meshes were judged, 1 where some could not be, 2 where none could."""
    given = parsed(arguments)
    try:
        judge = Judge(
            given.dtu, given.threshold, given.points, given.seed, given.unit_sphere, given.to_world, given.cull
        )
        if given.into is not None and not (given.method and is_plain_name(given.method)):
            raise ValueError("--into writes rows of a method: add --method NAME")
        if given.like is not None and given.mesh.is_dir() and not (given.mesh / "record.json").is_file():
            raise ValueError(f"--like names the problem of one run, and {given.mesh} is a folder: name one mesh")
        if given.like is not None and not given.unit_sphere and read_record(given.like)["dataset"] != "photos":
            raise ValueError("--like names a run, whose metrics are in scene units: add --unit-sphere, and its truth")
        items, verdicts = items_of(given.mesh, given.truth, given.scan), list[Verdict]()
        for item in items:
            try:
                verdicts.append(judge.verdict(item))
            except (OSError, ValueError) as error:
                if len(items) == 1:
                    raise
                worst = WORST_SURFACE if given.dtu is None else dtu.WORST
                verdicts.append(Verdict(item.name, dict(worst), failure=" ".join(str(error).split())))
        show(verdicts, units(judge))
        if given.into is not None:
            check_links(given.into)
            for place, (item, verdict) in enumerate(zip(items, verdicts, strict=True)):
                write_row(verdict, item, place, judge, given)
            print(write_index(given.into))
    except (OSError, ValueError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 1 if any(verdict.failure for verdict in verdicts) else 0


if __name__ == "__main__":
    sys.exit(main())
