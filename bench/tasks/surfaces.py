"""The surface of photographs without a renderer: what a user would run instead, as rows beside `reconstruction`."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.reconstruct.judge import COLOURED_DEFINITIONS
from bench.reconstruct.pictures import note_surface
from bench.reconstruct.stereo import Cloud, Matching, stereo_clouds
from bench.reconstruct.subject import NO_HULL, PhotographTask, Subject
from bench.reconstruct.surfaces import fused, given_clouds, measured_clouds, poisson, with_colours
from bench.setup.inputs import RunContext, RunInputs
from bench.solve.solve import COST_DEFINITIONS
from datasets.captures.hull import hull_mesh
from datasets.mesh import Mesh
from renderers.checks import BadInput, check_at_least


@dataclass(frozen=True)
class _Surface(PhotographTask):
    """A task that makes a surface in one go."""

    @abstractmethod
    def surface(self, subject: Subject) -> Mesh | None:
        """The surface of the given photographs."""

    def execute(self, run: RunContext) -> None:
        """Makes a surface of the given photographs, gives it their colours, and judges it by the others."""
        record = run.record
        record.definitions = COLOURED_DEFINITIONS | COST_DEFINITIONS
        subject = self.subject(run.inputs)
        record.notes = [*record.notes, subject.found, "no renderer took part"]
        with run.on_clock():
            surface = self.surface(subject)
            mesh = None if surface is None else surface.cut_off()
            mesh = None if mesh is None else with_colours(mesh, subject.given)
        record.evaluations = {"value": 0, "gradient": 0}
        with run.off_clock():
            note_surface(run, mesh, subject, {})
        subject.finish(run)


@dataclass(frozen=True)
class Fusing:
    """How points become a surface; see `bench.reconstruct.surfaces.poisson`."""

    octree: int
    trim: float

    def __post_init__(self) -> None:
        check_at_least("task.fusing.octree", self.octree, 2, "8 has 256 cells per axis")
        check_at_least("task.fusing.trim", self.trim, 0, "0 trims nothing; DVR has 5 and 7 as well")

    def surface(self, clouds: Sequence[Cloud]) -> Mesh | None:
        """The surface of all points."""
        return poisson(*fused(clouds), depth=self.octree, trim=self.trim)


@dataclass(frozen=True)
class Hull(_Surface):
    """The visual hull of the masks (Laurentini 1994).

    Args:
        samples: per axis.
    """

    samples: int

    def __post_init__(self) -> None:
        check_at_least("task.samples", self.samples, 8, "96 are as fine as a pixel at 96 x 96")
        super().__post_init__()

    def surface(self, subject: Subject) -> Mesh | None:
        """The hull, carved."""
        if any(shot.mask is None for shot in subject.given):
            raise BadInput(f"{NO_HULL}, or set task=stereo")
        return hull_mesh(subject.given, self.samples)


@dataclass(frozen=True)
class Poisson(_Surface):
    """Given depths, or points that something else made of the photographs, fused by screened Poisson reconstruction.

    Args:
        fusing: of their points.
        cloud: a file of points in the cameras' world, such as a multi-view stereo's; None takes the given depths.
    """

    fusing: Fusing
    cloud: str | None = None

    def check(self, inputs: RunInputs) -> None:
        """Raises BadInput where there is no such file."""
        if self.cloud is not None and not Path(self.cloud).is_file():
            raise BadInput(f"task.cloud={self.cloud} is no file: check the path")

    def surface(self, subject: Subject) -> Mesh | None:
        """The fused points."""
        if self.cloud is not None:
            return self.fusing.surface(measured_clouds(self.cloud, subject))
        if all(shot.depth is None for shot in subject.given):
            raise BadInput("screened Poisson needs depths: set task.depths.points=dense, or task.cloud=POINTS.ply")
        return self.fusing.surface(given_clouds(subject.given))


@dataclass(frozen=True)
class Stereo(_Surface):
    """Points that neighbouring photographs agree on, fused by screened Poisson reconstruction.

    Args:
        matching: of neighbouring photographs.
        fusing: of the points.
    """

    matching: Matching
    fusing: Fusing

    def surface(self, subject: Subject) -> Mesh | None:
        """The fused points that the photographs agree on."""
        return self.fusing.surface(stereo_clouds(subject.given, self.matching))
