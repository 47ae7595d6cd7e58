"""Computes renderer settings with the value `auto`: the precision of a pixel, and the number of steps it needs.

Each follows by an equation from the view and the other settings of the renderer: `renderer.epsilon=auto`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import ceil, log, radians, sin
from typing import Any

from bench.config import AUTO
from datasets.views import ViewSampler
from renderers.checks import check_fraction, check_positive

Node = Mapping[str, Any]  # configuration of a renderer
UNIT_SPHERE_RADIUS = 1.0  # every shape lies in this sphere


@dataclass(frozen=True)
class AutoSettings:
    """Parameters of the equations.

    Args:
        grazing: smallest angle between a ray and a surface, in degrees, at which a ray must still converge.
        spurious: largest fraction of spurious hits around outlines.
        area_over_perimeter: of the narrowest silhouette that meets `spurious`, in scene units.
    """

    grazing: float
    spurious: float
    area_over_perimeter: float

    def __post_init__(self) -> None:
        check_positive("auto.grazing", self.grazing, "DIST, A.1, takes 10")
        check_fraction("auto.spurious", self.spurious, "0.01 is one hit in a hundred")
        examples = "a disc of radius 0.5 has 0.25, a plane 0.08"
        check_positive("auto.area_over_perimeter", self.area_over_perimeter, examples)
        if self.grazing > 90:
            raise ValueError(f"auto.grazing must be at most 90 degrees, not {self.grazing}: 10")

    def resolve(self, renderer: Node, view: ViewSampler) -> tuple[Node, list[str]]:
        """The renderer's node with a number for each `auto`, in the order of `FORMULAS`, and a note on each.

        Raises:
            ValueError: a setting without an equation is `auto`.
        """
        requested = [name for name, value in renderer.items() if value == AUTO]
        for name in requested:
            if name not in FORMULAS:
                names = ", ".join(FORMULAS)
                raise ValueError(f"renderer.{name}=auto has no equation: only {names} have one; give a number")
        node, notes = dict(renderer), []
        for name in [name for name in FORMULAS if name in requested]:
            node[name] = FORMULAS[name](view, node, self)
            pixels = f"for {view.resolution} pixels from {view.distance:g} away (view)"
            notes.append(f"renderer.{name}=auto is {node[name]:.4g}, {pixels}{VALIDITY_NOTES[name].format(self)}")
        return node, notes


def epsilon(view: ViewSampler, renderer: Node, settings: AutoSettings) -> float:
    """Half a pixel (`footprint`), but at most the value that adds the allowed fraction of spurious hits.

    Rays that miss by less than epsilon are hits, so an outline grows by epsilon. At any resolution, this adds a
    fraction epsilon * perimeter / area of the hits. A larger epsilon misses no hit.
    """
    return min(footprint(view.focal_length, view.distance), settings.spurious * settings.area_over_perimeter)


def footprint(focal_length: float, distance: float) -> float:
    """Half a pixel at the point of the unit sphere nearest to the camera (DIST, Eq. 10, theta = 0), in scene units.

    Args:
        focal_length: in pixels.
        distance: of the camera from the origin, in scene units.
    """
    clearance = distance - UNIT_SPHERE_RADIUS
    check_positive("view.distance - 1", clearance, "a pixel's size needs a camera outside of the unit sphere")
    return clearance / (2 * focal_length)


def steps(view: ViewSampler, renderer: Node, settings: AutoSettings) -> int:
    """Steps from distance 1 to a surface at the grazing angle or any larger angle (DIST, Eq. 8).

    A step leaves |1 - alpha sin(theta)| of the distance; for alpha > 1 this grows again towards normal incidence.

    Raises:
        ValueError: the renderer has no epsilon, or no number of steps reaches it.
    """
    if "epsilon" not in renderer:
        raise ValueError("renderer.steps=auto needs renderer.epsilon, which this renderer does not have: give a number")
    alpha, epsilon = float(renderer.get("alpha", 1.0)), float(renderer["epsilon"])
    check_positive("renderer.epsilon", epsilon, "renderer.epsilon=auto is a pixel's precision")
    remaining = max(abs(1 - alpha * sin(radians(settings.grazing))), alpha - 1)
    if remaining >= 1:
        raise ValueError(f"renderer.alpha must lie between 0 and 2, not {alpha:g}: steps of others do not converge")
    return max(ceil(log(epsilon / UNIT_SPHERE_RADIUS) / log(remaining)), 1) if remaining > 0 else 1


FORMULAS: dict[str, Callable[[ViewSampler, Node, AutoSettings], Any]] = {"epsilon": epsilon, "steps": steps}
VALIDITY_NOTES = {
    "epsilon": ", with at most {0.spurious:.0%} spurious hits around outlines (auto.spurious) of true distances whose "
    "area over perimeter is {0.area_over_perimeter:g} or more (auto.area_over_perimeter)",
    "steps": ", for surfaces met at {0.grazing:g} degrees or more (auto.grazing)",
}


def at_pixel_precision(renderer: Node) -> Node:
    """The renderer's node with `auto` for its settings in `FORMULAS`; unchanged if it has no epsilon."""
    names = [name for name in FORMULAS if name in renderer and "epsilon" in renderer]
    return {**renderer, **dict.fromkeys(names, AUTO)}
