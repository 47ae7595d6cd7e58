"""The fields with colours that a shape can be learnt as."""

from dataclasses import dataclass

from bench.setup.auto import AUTO
from bench.setup.fields import PRIOR, parsed
from renderers.checks import BadInput, check_at_least, check_positive
from renderers.fields.coloured import ColouredDistance, ColouredGrid, ColouredOccupancy

FORMS = "task=reconstruction takes network_LAYERSxWIDTH, occupancy_WIDTH or grid_N"
REACH = 1.05  # half the side of a grid's cube: the unit sphere and a margin


Learnt = ColouredDistance | ColouredOccupancy | ColouredGrid
"""Modules whose `field` is a Coloured at their current parameters."""


@dataclass(frozen=True)
class Appearance:
    """What fields with colours are made of, beside their size.

    Args:
        octaves: of the positional encoding of a distance network.
        directional: whether colours of a distance network depend on the view direction.
        radius: of the sphere that all begin as, in scene units.
    """

    octaves: int
    directional: bool
    radius: float

    def __post_init__(self) -> None:
        check_at_least("task.appearance.octaves", self.octaves, 0, "5 follow details of a pixel at 128 x 128")
        check_positive("task.appearance.radius", self.radius, "0.5 lies within most objects")

    def make(self, name: str) -> Learnt:
        """The field of that name at its start.

        Raises:
            BadInput: for a name that has no colours.
        """
        if name in (PRIOR, AUTO):
            raise BadInput(f"field={name} has no colours: {FORMS}")
        kind, sizes = parsed(name)
        if kind == "network":
            layers, width = sizes
            shape = {"layers": layers, "width": width, "octaves": self.octaves}
            return ColouredDistance(**shape, radius=self.radius, directional=self.directional)
        if kind == "occupancy":
            return ColouredOccupancy(width=sizes[0], radius=self.radius)
        if kind == "grid":
            return ColouredGrid(samples=sizes[0], radius=self.radius, reach=REACH)
        raise BadInput(f"field={name} has no colours: {FORMS}")
