"""Where theory has a renderer fail, in the severities of conf/stress: a few lines each, from its own settings.

A renderer that lacks the settings that a formula is made of has no prediction.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from math import asin, degrees, log, radians, sin, sqrt, tan
from typing import Any

from bench.stress.outcome import Criteria
from datasets.stress import scenes
from renderers.field import STEEPEST_MARGIN

FRONT = 1.0  # distance from the unit sphere to its middle, along a ray through that
# Of the cosines of incidence on the cube's sides 1 % are below the first, and 1 % above the second.
FLATTEST, STEEPEST = 0.29, 0.64


@dataclass(frozen=True)
class Prediction:
    """A severity from which on a renderer should fail, and the formula that says so."""

    severity: float
    formula: str


Theory = Callable[[Any, int, Criteria], list[Prediction]]
THEORIES: dict[str, Theory] = {}


def needs(*settings: str) -> Callable[[Theory], Theory]:
    """Makes a function a theory of renderers that have these settings; of others it predicts nothing.

    Nor does it where its formula has no answer, such as a sine above 1.
    """

    def known(theory: Theory) -> Theory:
        @wraps(theory)
        def predict(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
            if not all(hasattr(renderer, name) for name in settings):
                return []
            try:
                return theory(renderer, resolution, criteria)
            except (ValueError, ZeroDivisionError, OverflowError):
                return []

        THEORIES[theory.__name__] = predict
        return predict

    return known


@needs()
def thin_plate(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """What the first long step overshoots; or DVR's spacing (Eq. 9) on the longest ray."""
    if hasattr(renderer, "refinement"):
        return [Prediction(2 * FRONT / (renderer.samples - 1), "spacing 2 / (n - 1) of DVR's samples (Eq. 9)")]
    extra = _alpha(renderer) - 1
    reach = min(FRONT, getattr(renderer, "step_clamp", None) or FRONT)
    overshoot = min(extra * reach, getattr(renderer, "extra_step_cap", None) or extra * reach)
    if getattr(renderer, "step_back", False) or overshoot <= 0:
        return []
    return [Prediction(overshoot, "overshoot (alpha - 1) d of a step, within its cap or clamp")]


@needs("steps", "epsilon")
def grazing_plane(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """The angle at which the steps of Eq. 8 are all that there are."""
    alpha, steps = _alpha(renderer), renderer.steps
    published = degrees(asin((1 - (renderer.epsilon / FRONT) ** (1 / steps)) / alpha))
    angle = published
    for _ in range(50):  # the field there is not d but d sin(theta)
        shrunk = min(renderer.epsilon / FRONT / sin(radians(angle)), 1.0)
        angle = degrees(asin(min((1 - shrunk ** (1 / steps)) / alpha, 1.0)))
    return [
        Prediction(angle, "as many steps as Eq. 8 asks for, with the field's value d sin(theta) for d"),
        Prediction(published, "as many steps as DIST, Eq. 8, asks for"),
    ]


@needs()
def grazing_gradient(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """Where DIST's scale alpha K sin(theta) leaves its tolerance, the slope falls below its least, or Eq. 8 ends."""
    lost = grazing_plane(renderer, resolution, criteria)[:1]
    if hasattr(renderer, "alpha"):
        shrunk = (1 - criteria.scale) / (renderer.alpha * getattr(renderer, "samples", 1))
        lost.append(Prediction(degrees(asin(min(shrunk, 1.0))), "scale alpha K sin(theta) of Eq. 4"))
    elif hasattr(renderer, "least_slope"):
        share = 1 - criteria.scale if getattr(renderer, "keep_slope_sign", True) else 1.0
        lost.append(Prediction(degrees(asin(share * renderer.least_slope)), "slope sin(theta) below least_slope"))
    return sorted(lost, key=lambda prediction: -prediction.severity)


@needs("epsilon")
def epsilon(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """The ring by which epsilon widens a cube's outline, a regular hexagon; and Eq. 10."""
    around = scenes.CUBE * 2 * sqrt(2 / 3)  # radius through the hexagon's corners
    focal = resolution / 2 / tan(radians(scenes.CUBE_VIEW / 2))
    nearest = scenes.DISTANCE - scenes.CUBE * sqrt(3)
    return [
        Prediction(criteria.false_hits * sqrt(3) / 4 * around, "a ring as wide as epsilon has 1 % of the cube's area"),
        Prediction(nearest / (2 * focal), "half a pixel: DIST, Eq. 10, at theta = 0"),
    ]


@needs("epsilon")
def within_epsilon(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """What comes nearer than epsilon counts as a surface."""
    return [Prediction(renderer.epsilon, "epsilon")]


@needs("steps", "epsilon")
def truncated(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """The way to the cube in steps of the truncated value, and what Eq. 8 asks for behind them."""
    alpha, way = _alpha(renderer), FRONT
    left = renderer.steps
    for _ in range(20):  # what is truncated further away, Eq. 8 takes over
        cut = way / alpha / left
        left = max(renderer.steps - log(renderer.epsilon / cut) / log(abs(1 - alpha * FLATTEST)), 1.0)
    return [Prediction(way / alpha / left, "way over alpha k, less the steps of DIST, Eq. 8, from there on")]


@needs("steps", "epsilon")
def few_steps(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """Eq. 8 at the cube's sides."""
    needed = log(renderer.epsilon / FRONT) / log(abs(1 - _alpha(renderer) * FLATTEST))
    return [Prediction(needed, "DIST, Eq. 8, at the cube's sides")]


@needs("steps", "epsilon")
def weak_distance(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """Eq. 8 at the cube's sides, with steps shortened by the factor."""
    shrunk = 1 - (renderer.epsilon / FRONT) ** (1 / renderer.steps)
    return [
        Prediction(shrunk / _alpha(renderer) / FLATTEST, "as many steps as DIST, Eq. 8, asks for at the cube's sides")
    ]


@needs("steps")
def strong_distance(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """Steps do not converge where alpha times factor times cos(theta) exceeds 2."""
    return [Prediction(2 / _alpha(renderer) / STEEPEST, "alpha times factor times cos(theta) is 2: no convergence")]


@needs("epsilon")
def float_spacing(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """Where neighbouring float32 numbers of the camera's distance lie further apart than epsilon."""
    return [Prediction(renderer.epsilon * 2**24, "float32's spacing is epsilon")]


@needs("steps")
def gap(renderer: Any, resolution: int, criteria: Criteria) -> list[Prediction]:
    """Rays as near to a side of the slit as its depth over the steps are lost: two of them a slit."""
    lost = 2 * scenes.SLIT_DEPTH / renderer.steps / _alpha(renderer)
    return [Prediction(lost / scenes.SLIT_SHARE / (1 - criteria.hits), "rays within depth / k of a side are lost")]


def _alpha(renderer: Any) -> float:
    """The factor of a step, with what a slope bound, found on a true distance, takes off it."""
    bounded = getattr(renderer, "slope_samples", 0)
    return getattr(renderer, "alpha", 1.0) / (STEEPEST_MARGIN if bounded else 1.0)
