"""Settings of a renderer with the value `auto`: the precision of a pixel, and the number of steps that it takes.

Each follows by an equation from the view and the renderer's other settings: `renderer.epsilon=auto`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import ceil, isnan, log, radians, sin
from typing import Any

from datasets.views import ViewSampler
from renderers.checks import check_fraction, check_positive

AUTO = "auto"
Node = Mapping[str, Any]  # of the renderer
RADIUS = 1.0  # of the unit sphere, which holds every shape


@dataclass(frozen=True)
class AutoSettings:
    """Parameters of the equations.

    Args:
        grazing: least angle between a ray and a surface, in degrees, at which a ray must still converge.
        spurious: largest share of the hits that may be added around outlines.
        area_over_perimeter: of the narrowest silhouette for which that holds, in scene units.
    """

    grazing: float
    spurious: float
    area_over_perimeter: float

    def __post_init__(self) -> None:
        check_positive("auto.grazing", self.grazing, "DIST, A.1, takes 10")
        check_fraction("auto.spurious", self.spurious, "0.01 is one hit in a hundred")
        check_positive(
            "auto.area_over_perimeter", self.area_over_perimeter, "a disc of radius 0.5 has 0.25, a plane 0.08"
        )
        if self.grazing > 90:
            raise ValueError(f"auto.grazing must be at most 90 degrees, not {self.grazing}: 10")


def epsilon(view: ViewSampler, renderer: Node, settings: AutoSettings) -> float:
    """Half a pixel (`footprint`), but no more than adds a given share of spurious hits.

    Rays that pass by within epsilon are hits, so that an outline grows by epsilon: by epsilon * perimeter / area of the
    hits, whatever the resolution. No hit is missed for a larger epsilon.
    """
    return min(footprint(view.focal_length, view.distance), settings.spurious * settings.area_over_perimeter)


def footprint(focal_length: float, distance: float) -> float:
    """Half a pixel where the shape may be nearest to the camera (DIST, Eq. 10, at theta = 0), in scene units.

    Args:
        focal_length: in pixels.
        distance: of the camera from the origin, in scene units.
    """
    check_positive("view.distance - 1", distance - RADIUS, "a pixel's size needs a camera outside of the unit sphere")
    return (distance - RADIUS) / (2 * focal_length)


def steps(view: ViewSampler, renderer: Node, settings: AutoSettings) -> int:
    """Steps from a unit away to a surface that is met at the grazing angle or any larger one (DIST, Eq. 8).

    A step leaves |1 - alpha sin(theta)| of the distance; for alpha > 1 that grows again towards normal incidence.

    Raises:
        ValueError: where there is no epsilon to reach, or no number of steps reaches it.
    """
    if "epsilon" not in renderer:
        raise ValueError("renderer.steps=auto needs renderer.epsilon, which this renderer does not have: give a number")
    alpha, epsilon = float(renderer.get("alpha", 1.0)), float(renderer["epsilon"])
    check_positive("renderer.epsilon", epsilon, "renderer.epsilon=auto is a pixel's precision")
    left = max(abs(1 - alpha * sin(radians(settings.grazing))), alpha - 1)
    if left >= 1:
        raise ValueError(f"renderer.alpha must lie between 0 and 2, not {alpha:g}: steps of others do not converge")
    return max(ceil(log(epsilon / RADIUS) / log(left)), 1) if left > 0 else 1


def rays_share(least: float, footprint: float, error: float) -> float:
    """The share of an image's pixels at the resolution whose half pixel equals the current error.

    Pixels need be no finer than the error: DIST, Eq. 10, solved for the resolution, whose square is their number.

    Args:
        footprint: half a pixel of the whole image, in scene units.
        error: in scene units.
    """
    if not footprint or isnan(error):
        return 1.0
    return min(max((footprint / max(error, footprint)) ** 2, least), 1.0)


FORMULAS: dict[str, Callable[[ViewSampler, Node, AutoSettings], Any]] = {"epsilon": epsilon, "steps": steps}
LIMITED = {  # what a value holds for
    "epsilon": ", with at most {0.spurious:.0%} spurious hits around outlines (auto.spurious) of true distances whose "
    "area over perimeter is {0.area_over_perimeter:g} or more (auto.area_over_perimeter)",
    "steps": ", for surfaces met at {0.grazing:g} degrees or more (auto.grazing)",
}


def resolved(renderer: Node, view: ViewSampler, settings: AutoSettings) -> tuple[Node, list[str]]:
    """The renderer's node with a number for each `auto`, in the order of `FORMULAS`, and a note on each.

    Raises:
        ValueError: for `auto` where there is no equation.
    """
    requested = [name for name, value in renderer.items() if value == AUTO]
    for name in requested:
        if name not in FORMULAS:
            known = ", ".join(FORMULAS)
            raise ValueError(f"renderer.{name}=auto has no equation: only {known} have one; give a number")
    node, notes = dict(renderer), []
    for name in [name for name in FORMULAS if name in requested]:
        node[name] = FORMULAS[name](view, node, settings)
        seen = f"for {view.resolution} pixels from {view.distance:g} away (view){LIMITED[name].format(settings)}"
        notes.append(f"renderer.{name}=auto is {node[name]:.4g}, {seen}")
    return node, notes


def at_pixel_precision(renderer: Node) -> Node:
    """The renderer's node with `auto` for its settings in `FORMULAS`; unchanged where it has no epsilon."""
    names = [name for name in FORMULAS if name in renderer and "epsilon" in renderer]
    return {**renderer, **dict.fromkeys(names, AUTO)}
