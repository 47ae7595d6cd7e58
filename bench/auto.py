"""Settings of a renderer that follow from others: no more precision than a pixel, no more steps than that takes.

Each is a function of the view and of the renderer's other settings, with its equation: `renderer.epsilon=auto`. The
number of samples follows from the shape, so that it changes on the way: see `bench.thickness`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil, inf, isnan, log, radians, sin
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf

from datasets.views import ViewSampler
from renderers.checks import check_positive

AUTO = "auto"
RADIUS = 1.0  # of the unit sphere, which holds every shape
FEWEST, MOST = 16, 128  # samples a ray: the range of DVR, Sec. 3.5


@dataclass(frozen=True)
class AutoSettings:
    """What the equations leave open.

    Args:
        grazing: least angle between a ray and a surface, in degrees, at which a ray must still converge.
    """

    grazing: float

    def __post_init__(self) -> None:
        check_positive("auto.grazing", self.grazing, "10 is what DIST, A.1, reckons with")
        if self.grazing > 90:
            raise ValueError(f"auto.grazing must be at most 90 degrees, not {self.grazing}: 10")


def epsilon(view: ViewSampler, renderer: DictConfig, settings: AutoSettings) -> float:
    """See `footprint`."""
    return footprint(view.focal_length, view.distance)


def footprint(focal_length: float, distance: float) -> float:
    """Half a pixel where the shape may be nearest to the camera (DIST, Eq. 10, at theta = 0), in scene units.

    Args:
        focal_length: in pixels.
        distance: of the camera from the origin, in scene units.
    """
    check_positive("view.distance - 1", distance - RADIUS, "a pixel's size needs a camera outside of the unit sphere")
    return half_pixel(focal_length, distance - RADIUS)


def half_pixel(focal_length: float, depth: float) -> float:
    """Half a pixel's width at a depth, on the optical axis (DIST, Eq. 10, at theta = 0), in scene units."""
    return depth / (2 * focal_length)


def steps(view: ViewSampler, renderer: DictConfig, settings: AutoSettings) -> int:
    """What a ray needs from a unit away to a surface at the grazing angle or any above it (DIST, Eq. 8).

    A step leaves |1 - alpha sin(theta)| of the way, which for alpha > 1 grows again towards the head-on ray.

    Raises:
        ValueError: where there is no epsilon to reach, or no number of steps reaches it.
    """
    if "epsilon" not in renderer:
        raise ValueError(
            "renderer.steps=auto is what reaches renderer.epsilon, which this renderer has not: give a number"
        )
    alpha, epsilon = float(renderer.get("alpha", 1.0)), float(renderer.epsilon)
    check_positive("renderer.epsilon", epsilon, "renderer.epsilon=auto is half a pixel")
    left = max(abs(1 - alpha * sin(radians(settings.grazing))), alpha - 1)
    if left >= 1:
        raise ValueError(f"renderer.alpha must lie between 0 and 2, not {alpha:g}: steps of others do not converge")
    return max(ceil(log(epsilon / RADIUS) / log(left)), 1) if left > 0 else 1


def samples(thinnest: float, radius: float) -> int:
    """The least n that puts two samples into the thinnest part: 2 R / (n - 1) <= thinnest / 2, within DVR's own range.

    2 R / (n - 1) is the spacing on the longest chord of the sphere (DVR, Eq. 9), so that on no ray it is wider.

    Args:
        thinnest: thickness of the thinnest part, in scene units; infinite where none is known.
        radius: R, of the sphere that the samples lie in, in scene units.
    """
    wanted = ceil(min(4 * radius / thinnest, MOST)) + 1
    return min(max(wanted, FEWEST), MOST)


def rays_share(least: float, footprint: float, error: float) -> float:
    """The share of an image's pixels that there are where half a pixel is the error that is left.

    A pixel need be no finer than the error: DIST, Eq. 10, solved for the resolution, with whose square pixels grow.

    Args:
        least: of the shares.
        footprint: half a pixel of the whole image, in scene units.
        error: in scene units.
    """
    if not footprint or isnan(error):
        return 1.0
    return min(max((footprint / max(error, footprint)) ** 2, least), 1.0)


def first_samples(view: ViewSampler, renderer: DictConfig, settings: AutoSettings) -> int:
    """The number of samples before any part of the shape has been seen."""
    return samples(inf, RADIUS)


FORMULAS: dict[str, Callable[[ViewSampler, DictConfig, AutoSettings], Any]] = {
    "epsilon": epsilon,
    "steps": steps,
    "samples": first_samples,
}
OF_A_PIXEL = ("epsilon", "steps")  # that follow from the camera alone
CHANGING = {"samples": ("begins with", "and follows the thinnest part that is seen")}


def resolved(renderer: DictConfig, view: ViewSampler, settings: AutoSettings) -> tuple[DictConfig, list[str]]:
    """The renderer's node with a number for each `auto`, in the order of `FORMULAS`, and what they came to, in words.

    Raises:
        ValueError: for `auto` where there is no equation.
    """
    settled: Any = OmegaConf.to_container(renderer, resolve=True)
    asked = [name for name, value in settled.items() if value == AUTO]
    for name in asked:
        if name not in FORMULAS:
            known = ", ".join(FORMULAS)
            raise ValueError(f"renderer.{name}=auto has no equation: only {known} have one; give a number")
    node, notes = OmegaConf.create(settled), []
    for name in [name for name in FORMULAS if name in asked]:
        node[name] = FORMULAS[name](view, node, settings)
        seen = f"for {view.resolution} pixels from {view.distance:g} away (view)"
        seen += f", for surfaces met at {settings.grazing:g} degrees or more (auto.grazing)" if name == "steps" else ""
        verb, reason = CHANGING.get(name, ("is", seen))
        notes.append(f"renderer.{name}=auto {verb} {node[name]:.4g}, {reason}")
    return node, notes


def frugal(renderer: DictConfig) -> DictConfig:
    """The renderer's node with `auto` for all that it has of `OF_A_PIXEL`; as it is where it has no epsilon."""
    names = [name for name in OF_A_PIXEL if name in renderer and "epsilon" in renderer]
    return cast(DictConfig, OmegaConf.merge(renderer, dict.fromkeys(names, AUTO)))
