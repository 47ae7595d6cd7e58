"""Formulas that predict the severity at which a renderer fails, in the units of conf/stress, from its settings.

A renderer without the settings that a formula needs has no prediction.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from math import asin, degrees, log, sqrt
from typing import Any

from bench.setup.auto import half_pixel
from bench.stress.trial import Criteria
from datasets.stress import scenes
from datasets.views import ViewSampler
from renderers.field import STEEPEST_MARGIN

FRONT = 1.0  # distance from the unit sphere to its centre
FLATTEST = 0.29  # cosine of incidence below which 1 % of the hits on the cube's sides are


@dataclass(frozen=True)
class Prediction:
    """A severity from which on a renderer should fail, and its formula in words."""

    severity: float
    formula: str


Theory = Callable[[Any, int, Criteria], list[Prediction]]
THEORIES: dict[str, Theory] = {}


def needs(*settings: str) -> Callable[[Theory], Theory]:
    """Registers a function as a theory of renderers that have these settings; for others it predicts nothing.

    It predicts nothing either where its formula has no solution, such as a sine above 1, or a setting is not a number.
    """

    def known(theory: Theory) -> Theory:
        @wraps(theory)
        def predict(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
            if not all(hasattr(renderer, name) for name in settings):
                return []
            try:
                return theory(renderer, resolution, criteria)
            except (ValueError, ZeroDivisionError, OverflowError, TypeError, AttributeError):
                return []

        THEORIES[theory.__name__] = predict
        return predict

    return known


@needs()
def thin_plate(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """The overshoot of the first long step, or of Newton's last; or DVR's sample spacing (Eq. 9) on the longest ray."""
    if hasattr(renderer, "n_ray_samples"):
        return [Prediction(2 * FRONT / (renderer.n_ray_samples - 1), "spacing 2 / (n - 1) of DVR's samples (Eq. 9)")]
    if hasattr(renderer, "unseen"):
        return [Prediction(renderer.unseen / 2, "overshoot of Newton's last step at normal incidence, unseen / 2")]
    bounded = getattr(renderer, "slope_samples", 0)
    extra = getattr(renderer, "alpha", 1.0) / (STEEPEST_MARGIN if bounded else 1.0) - 1
    reach = min(FRONT, getattr(renderer, "step_clamp", None) or FRONT)
    overshoot = min(extra * reach, getattr(renderer, "extra_step_cap", None) or extra * reach)
    if getattr(renderer, "step_back", False) or overshoot <= 0:
        return []
    return [Prediction(overshoot, "overshoot (alpha - 1) d of a step, within its cap or clamp")]


@needs("steps", "epsilon")
def grazing_plane(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """The angle at which Eq. 8 needs all steps at the far edge of the picture."""
    edge = 1 - scenes.GRAZING_SHARE  # of the sine at the middle; rays at the edge are longer by that factor
    way = FRONT + scenes.DISTANCE * (1 / edge - 1)
    sine = _least(lambda sine: _queries(renderer, edge * sine, way) <= renderer.steps)
    published = (1 - (renderer.epsilon / FRONT) ** (1 / renderer.steps)) / _alpha(renderer)
    return [
        Prediction(degrees(asin(sine)), "the queries of Eq. 8 at the far edge, of a field d sin(theta)"),
        Prediction(degrees(asin(published)), "the steps of DIST, Eq. 8"),
    ]


@needs()
def grazing_gradient(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """Where DIST's scale alpha K sin(theta) leaves its tolerance, the slope falls below its least, or Eq. 8 ends."""
    found = grazing_plane(renderer, resolution, criteria)[:1]
    if hasattr(renderer, "alpha"):
        longest = renderer.alpha * getattr(renderer, "n_gradient_samples", 1)
        sine = 1.0 if longest > 1 + criteria.scale else min((1 - criteria.scale) / longest, 1.0)
        found.append(Prediction(degrees(asin(sine)), "scale alpha K sin(theta) of DIST's Eq. 4, too long or too short"))
    elif hasattr(renderer, "least_slope"):
        share = 1 - criteria.scale if getattr(renderer, "keep_slope_sign", True) else 1.0
        found.append(Prediction(degrees(asin(share * renderer.least_slope)), "slope sin(theta) below least_slope"))
    return sorted(found, key=lambda prediction: -prediction.severity)


@needs("epsilon")
def epsilon(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """The ring by which epsilon dilates a cube's outline, a regular hexagon; and Eq. 10."""
    around = scenes.CUBE * 2 * sqrt(2 / 3)  # radius through the hexagon's corners
    view = ViewSampler(scenes.DISTANCE, scenes.CUBE_VIEW, **scenes.CORNER, resolution=resolution)
    nearest = scenes.DISTANCE - scenes.CUBE * sqrt(3)
    return [
        Prediction(criteria.false_hits * sqrt(3) / 4 * around, "a ring as wide as epsilon has 1 % of the cube's area"),
        Prediction(half_pixel(view.focal_length, nearest), "half a pixel: DIST, Eq. 10, at theta = 0"),
    ]


@needs("epsilon")
def within_epsilon(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """Rays that pass closer than epsilon count as hits."""
    return [Prediction(renderer.epsilon, "epsilon")]


@needs("epsilon", "steps")
def sheet(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """Rays that pass closer than epsilon count as hits, unless a step jumps over the sheet."""
    return [Prediction(renderer.epsilon, "epsilon")] if _alpha(renderer) == 1 else []


@needs("steps", "epsilon")
def truncated(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """The distance to the cube in steps of the truncated value, and the queries of Eq. 8 from there on."""
    cut = _least(lambda value: FRONT / _alpha(renderer) / value + _queries(renderer, FLATTEST, value) <= renderer.steps)
    return [Prediction(cut, "distance / (alpha k), and the queries of DIST, Eq. 8, from there on")]


@needs("steps", "epsilon")
def few_steps(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """Eq. 8 at the cube's flattest side."""
    return [Prediction(_queries(renderer, FLATTEST), "the queries of DIST, Eq. 8, at the cube's flattest side")]


@needs("steps", "epsilon")
def weak_distance(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """Eq. 8 at the cube's flattest side, with values and steps shortened by the factor."""
    factor = _least(lambda factor: _queries(renderer, factor * FLATTEST) <= renderer.steps)
    return [Prediction(factor, "the queries of DIST, Eq. 8, at the cube's flattest side")]


@needs("epsilon")
def float_spacing(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """The camera distance at which neighbouring float32 numbers are one to two epsilon apart."""
    return [Prediction(renderer.epsilon * 2**24, "float32's numbers there lie one to two epsilon apart")]


@needs("steps")
def gap(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """Rays closer to a side of the slit than its depth over the steps are missed: two such strips per slit."""
    missed = 2 * scenes.SLIT_DEPTH / renderer.steps / _alpha(renderer)
    return [Prediction(missed / scenes.SLIT_SHARE / (1 - criteria.hits), "rays within depth / k of a side are missed")]


def _alpha(renderer: Any) -> float:
    """The over-relaxation factor of a step.

    Raises:
        ValueError: where a safeguard changes steps, which these formulas do not cover.
    """
    if getattr(renderer, "slope_samples", 0) or getattr(renderer, "least_step", 0) or getattr(renderer, "step_back", 0):
        raise ValueError("a guarded march has other steps")
    if hasattr(renderer, "unseen"):
        raise ValueError("steps follow slopes")
    return getattr(renderer, "alpha", 1.0)


def _queries(renderer: Any, slope: float, distance: float = FRONT) -> float:
    """Queries until a field of this slope along the ray is below epsilon, from a distance (DIST, Eqs. 7 and 8)."""
    value, shrinks = slope * distance, abs(1 - _alpha(renderer) * slope)
    return 1 + max(log(renderer.epsilon / value) / log(shrinks), 0.0)


def _least(enough: Callable[[float], bool]) -> float:
    """The least number, up to 0.6, from which on `enough` holds: beyond, an alpha of 1.5 oscillates and needs more."""
    low, high = 1e-6, 0.6
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high
