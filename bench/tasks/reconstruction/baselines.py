"""Surfaces from photographs without a renderer: baselines for `reconstruction`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.setup.inputs import RunContext, RunInputs
from bench.solve.solve import COST_DEFINITIONS
from bench.tasks.reconstruction.judge import COLOURED_DEFINITIONS
from bench.tasks.reconstruction.pictures import note_surface
from bench.tasks.reconstruction.stereo import Cloud, Matching, stereo_clouds
from bench.tasks.reconstruction.subject import NO_HULL, PhotographTask, Subject
from bench.tasks.reconstruction.surfaces import fuse_clouds, given_clouds, measured_clouds, poisson, with_colours
from datasets.files.captures.hull import hull_mesh
from datasets.mesh import Mesh
from renderers.checks import BadInput, check_at_least


@dataclass(frozen=True)
class _Surface(PhotographTask):
    """A task whose method `surface` computes a mesh of a subject's input photographs; None if there is none."""

    def execute(self, run: RunContext) -> None:
        """Computes the surface of the input photographs with their colours, and evaluates it on the held-out ones."""
        subject = self.subject(run.inputs)
        note_baseline(run, subject, lambda: self.surface(subject))
        subject.finish(run)


def note_baseline(run: RunContext, subject: Subject, surface: Callable[[], Mesh | None]) -> None:
    """Times a surface that no renderer computes, and evaluates it with the colours of the input photographs.

    Args:
        surface: computes the surface in the unit sphere; None if there is none.
    """
    record = run.record
    record.definitions = COLOURED_DEFINITIONS | COST_DEFINITIONS
    record.notes = [*record.notes, subject.summary, "no renderer took part"]
    with run.on_clock():
        mesh = surface()
        mesh = None if mesh is None else mesh.cut_off()
        mesh = None if mesh is None else with_colours(mesh, subject.input_shots)
    record.evaluations = {"value": 0, "gradient": 0}
    with run.off_clock():
        note_surface(run, mesh, subject, {})


@dataclass(frozen=True)
class Fusing:
    """Settings of the surface from points; see `bench.tasks.reconstruction.surfaces.poisson`."""

    octree: int
    trim: float

    def __post_init__(self) -> None:
        check_at_least("task.fusing.octree", self.octree, 2, "8 has 256 cells per axis")
        check_at_least("task.fusing.trim", self.trim, 0, "0 trims nothing; DVR has 5 and 7 as well")

    def surface(self, clouds: Sequence[Cloud]) -> Mesh | None:
        return poisson(*fuse_clouds(clouds), depth=self.octree, trim=self.trim)


@dataclass(frozen=True)
class Hull(_Surface):
    """The visual hull of the masks (Laurentini 1994).

    Args:
        samples: samples per axis.
    """

    samples: int

    def __post_init__(self) -> None:
        check_at_least("task.samples", self.samples, 8, "96 are as fine as a pixel at 96 x 96")
        super().__post_init__()

    def surface(self, subject: Subject) -> Mesh | None:
        if any(shot.mask is None for shot in subject.input_shots):
            raise BadInput(f"{NO_HULL}, or set task=stereo")
        return hull_mesh(subject.input_shots, self.samples)


@dataclass(frozen=True)
class Poisson(_Surface):
    """Given depths or a given point cloud, fused by screened Poisson reconstruction.

    Args:
        fusing: settings of the surface.
        cloud: a file of points in the cameras' world, for example from multi-view stereo; None: the given depths.
    """

    fusing: Fusing
    cloud: str | None = None

    def check(self, inputs: RunInputs) -> None:
        if self.cloud is not None and not Path(self.cloud).is_file():
            raise BadInput(f"task.cloud={self.cloud} is no file: check the path")

    def surface(self, subject: Subject) -> Mesh | None:
        if self.cloud is not None:
            return self.fusing.surface(measured_clouds(self.cloud, subject))
        if all(shot.depth is None for shot in subject.input_shots):
            raise BadInput("screened Poisson needs depths: set task.depths.points=dense, or task.cloud=POINTS.ply")
        return self.fusing.surface(given_clouds(subject.input_shots))


@dataclass(frozen=True)
class Stereo(_Surface):
    """Points on which neighbouring photographs agree, fused by screened Poisson reconstruction.

    Args:
        matching: choice of matched photographs.
        fusing: settings of the surface.
    """

    matching: Matching
    fusing: Fusing

    def surface(self, subject: Subject) -> Mesh | None:
        return self.fusing.surface(stereo_clouds(subject.input_shots, self.matching))
