"""One ray under several renderers: their field evaluations on it, where they end, and sentences by rule on both."""

from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import asin, degrees
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bench.evaluate.reference import RADIUS, trace_exactly
from bench.records.format import plural
from renderers.boundary import render_checked
from renderers.camera import Rays, sphere_span
from renderers.field import Coarse, Field, Wrapper, autograd_normals, coarse_version
from renderers.rendering import Renderer, Status, Unsupported

ON_RAY_TOLERANCE = 1e-5  # scene units: a point within this distance of the ray is on it
ROUNDING = 5e-7  # scene units: float32 resolves no shorter length at a distance of 2.5
DENSE_SAMPLES = 40_001  # on the ray, for the thickness of the shape along it
MIN_SAMPLES = 3  # a call with so many points of the ray is sampling; a step evaluates one point, or both of its ends
WEIGHT_TAILS = (0.05, 0.95)  # nine tenths of a volume's weight lie between
FRONTAL_DEGREES = 20.0  # above this angle between ray and surface, the angle does not explain the spread of weights


@dataclass
class Recorder(Wrapper):
    """A Field that notes its evaluations on one ray: distances along the ray, call by call, each position once."""

    inner: Field
    rays: Rays
    calls: list[list[float]] = field(default_factory=list)
    positions: set[float] = field(default_factory=set)
    keeps_values: ClassVar[bool] = True

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        self._note(points)
        return self.inner(points)

    @property
    def coarse(self) -> Coarse | None:
        """The coarse values of the field, noted like the others."""
        coarse = coarse_version(self.inner)
        return coarse and replace(coarse, values=lambda points: (self._note(points), coarse.values(points))[1])

    def _note(self, points: Tensor) -> None:
        offsets = (points.detach() - self.rays.origins[0]).double().reshape(-1, 3)
        direction = self.rays.directions[0].double()
        along = offsets @ direction
        across = torch.linalg.vector_norm(offsets - along[:, None] * direction, dim=-1)
        call = [x for x in dict.fromkeys(along[across < ON_RAY_TOLERANCE].tolist()) if x not in self.positions]
        self.positions.update(call)
        self.calls += [call] if call else []


@dataclass(frozen=True)
class TrueRay:
    """The truth on a ray, from the float64 reference; distances are along the ray, in scene units.

    Args:
        entry, leave: of the unit sphere.
        hit: of the surface; None for a miss, and if the ray starts inside the shape.
        spans: where the ray is inside the shape, from and to.
        angle: between ray and surface at the hit, in degrees.
        tolerance: a hit within it of the true one is right.
    """

    entry: float
    leave: float
    hit: float | None
    spans: list[tuple[float, float]]
    angle: float
    tolerance: float

    @property
    def first_span(self) -> tuple[float, float] | None:
        """The span that begins at the hit; None without a hit, and for a part too thin for the dense samples."""
        hit = np.inf if self.hit is None else self.hit
        return next((span for span in self.spans if abs(span[0] - hit) < self.tolerance), None)


@dataclass(frozen=True)
class Lane:
    """What one renderer does on a ray; all distances are along the ray, in scene units.

    Args:
        residual: the last field value.
        marches: whether it has a number of steps; the evaluations of other renderers are no steps.
        weights: sorted distances of a volume's samples, and their weights; None if it sums nothing.
    """

    name: str
    title: str
    calls: list[list[float]]
    end: float
    status: Status
    residual: float
    marches: bool
    weights: tuple[np.ndarray, np.ndarray] | None

    @property
    def evaluations(self) -> list[float]:
        return [distance for call in self.calls for distance in call]

    @property
    def samples(self) -> list[float]:
        """The sorted points of the first call that evaluates many points of the ray; empty if it only takes steps."""
        return sorted(next((call for call in self.calls if len(call) >= MIN_SAMPLES), []))

    @property
    def hit(self) -> float | None:
        return self.end if self.status is Status.HIT else None

    def agrees(self, truth: TrueRay) -> bool:
        """Whether it hits and misses like the reference, within the tolerance."""
        if truth.hit is None or self.hit is None:
            return truth.hit is self.hit
        return abs(self.hit - truth.hit) < truth.tolerance

    def extent(self, hit: float) -> tuple[float, float]:
        """The lengths before and behind the true hit in which the renderer decides: of weights, samples or a step."""
        if self.weights is not None:
            share = np.cumsum(self.weights[1]) / max(self.weights[1].sum(), 1e-30)
            low, high = self.weights[0][np.searchsorted(share, WEIGHT_TAILS).clip(max=len(share) - 1)]
            return hit - low, high - hit
        if self.samples:
            spacing = (self.samples[-1] - self.samples[0]) / (len(self.samples) - 1)
            return spacing, spacing
        return 0.0, max(0.0, max(self.evaluations, default=hit) - hit)


def true_ray(exact: Field, rays: Rays, *, lipschitz: float, tolerance: float) -> TrueRay:
    """The truth on one float64 ray [1, 3] that meets the unit sphere, of a float64 field.

    Args:
        tolerance: a hit within this fraction of the true distance is right.
    """
    entry, leave = (float(ends[0]) for ends in sphere_span(rays, RADIUS)[:2])
    reference = trace_exactly(exact, rays, lipschitz)
    distances = torch.linspace(entry, leave, DENSE_SAMPLES, dtype=torch.float64)
    with torch.no_grad():
        values = torch.cat([exact(points) for points in rays.at_each(distances)[0].split(4096)]).numpy()
    before = np.flatnonzero(np.diff(values < 0))
    fractions = values[before] / (values[before] - values[before + 1])
    ends = (entry + (leave - entry) / (DENSE_SAMPLES - 1) * (before + fractions)).tolist()
    ends = [*([entry] if values[0] < 0 else []), *ends, *([leave] if values[-1] < 0 else [])]
    hit = float(reference.distance[0]) if bool(reference.hit[0]) else None
    cosine = float((autograd_normals(exact, reference.points) * rays.directions).sum().abs())
    spans = [*zip(ends[::2], ends[1::2], strict=True)]
    angle = degrees(asin(min(cosine, 1.0)))
    return TrueRay(entry, leave, hit, spans, angle, tolerance * (leave if hit is None else hit))


@torch.no_grad()
def follow(name: str, title: str, renderer: Renderer, field: Field, rays: Rays) -> Lane:
    """Renders one ray [1, 3] alone, so without the coarse rays of an image, and notes what the renderer does.

    Raises:
        ValueError: if the renderer cannot render the field.
    """
    recorder = Recorder(field, rays)
    try:
        rendering = render_checked(renderer, recorder, rays)
    except Unsupported as error:
        raise ValueError(f"renderer={name}: {error}") from error
    weights = None
    if (volume := rendering.volume) is not None and len(volume.weight) >= MIN_SAMPLES:
        order = volume.distance.argsort()
        weights = volume.distance[order].double().numpy(), volume.weight[order].double().numpy()
    end, residual, status = (float(x[0]) for x in (rendering.distance, rendering.residual, rendering.status))
    marches = getattr(renderer, "steps", None) is not None
    return Lane(name, title, recorder.calls, end, Status(int(status)), residual, marches, weights)


def sentences(lane: Lane, truth: TrueRay) -> str:
    """What a renderer did on the ray, in one to three sentences."""
    count, agrees = f"It evaluated {plural(len(lane.evaluations), 'point')} of the ray", lane.agrees(truth)
    if truth.hit is None or not lane.evaluations:
        inside = ", since the ray starts inside the shape" if truth.spans and truth.spans[0][0] == truth.entry else ""
        reference = f" The reference has no hit{inside}." if truth.hit is None else ""
        is_marched_hit = lane.hit is not None and lane.weights is None
        residual = f" Its residual is {_length(lane.residual)}." if is_marched_hit else ""
        return f"{count}. {_ending(lane, truth)}{residual}{reference}"
    if not agrees and (cause := _step_through(lane, truth) or _missed_between_samples(lane, truth)):
        text = cause
    elif lane.weights is not None:
        text = _on_weights(lane, truth, truth.hit)
    elif lane.samples:
        text = _on_samples(lane, truth, truth.hit)
    else:
        text = _on_steps(lane, truth.hit) if agrees and lane.marches else f"{count}."
    if lane.hit and abs(lane.residual) > ROUNDING < abs(lane.hit - truth.hit) and lane.weights is None:
        return f"{text} {_ending(lane, truth)} Its residual is {_length(lane.residual)}."
    return f"{text} {_ending(lane, truth)}"


def _step_through(lane: Lane, truth: TrueRay) -> str:
    """The sentence on the first step that begins before the surface and ends beyond it; empty without one."""
    steps, span = [call for call in lane.calls if len(call) < MIN_SAMPLES], truth.first_span
    ends = [distance for call in steps for distance in call] + [lane.end] * (not lane.samples)
    for number, (start, stop) in enumerate(pairwise(ends if lane.marches else []), 1):
        if span is not None and start < span[0] and stop > span[1]:
            cause = f"the shape is {_length(span[1] - span[0])} thick along the ray"
            return f"Step {number} went through the surface: {cause}, the step {_length(stop - start)} long."
    return ""


def _missed_between_samples(lane: Lane, truth: TrueRay) -> str:
    """The sentence on samples none of which lies inside the surface; empty for others."""
    samples, span = np.array(lane.samples), truth.first_span
    if not len(samples) or span is None or ((samples >= span[0]) & (samples <= span[1])).any():
        return ""
    return f"None of {_samples(lane)} fell into the shape, {_length(span[1] - span[0])} thick along the ray."


def _on_samples(lane: Lane, truth: TrueRay, hit: float) -> str:
    samples, others = lane.samples, len(lane.evaluations) - len(lane.samples)
    more = f" It evaluated {plural(others, 'other point')}." if others else ""
    if lane.agrees(truth) and samples[-1] >= hit:
        pair = "two" if samples[0] < hit else "the first one and an earlier point"
        return f"Of {_samples(lane)} {pair} enclose the surface.{more}"
    return f"It has {_samples(lane).rstrip(',')}.{more}"


def _samples(lane: Lane) -> str:
    gaps = np.diff(lane.samples)
    average = " on average" if np.ptp(gaps) > gaps.mean() else ""
    return f"{len(lane.samples)} samples, {_length(gaps.mean())} apart{average},"


def _on_steps(lane: Lane, hit: float) -> str:
    """The sentence on the steps of a renderer that hits rightly: the step that went behind the surface, or the last."""
    points = lane.evaluations
    index, overshoot = int(np.argmax(points)), max(points) - hit
    if index and overshoot > 10 * ROUNDING and index < len(points) - 1:
        more = plural(len(points) - 1 - index, "more evaluation")
        return f"Step {index} went {_length(overshoot)} behind the surface. Its negative value led to {more}."
    last = f", the last step {_length(lane.end - points[-1])} long" if lane.end != points[-1] else ""
    return f"{plural(len(points), 'evaluation')}{last}."


def _on_weights(lane: Lane, truth: TrueRay, hit: float) -> str:
    distance, weight = lane.weights or (np.zeros(1), np.zeros(1))
    if not weight.sum() > 0:
        return f"{plural(len(lane.evaluations), 'evaluation')} and no weight: the samples passed the surface."
    mean, (before, behind) = float((distance * weight).sum() / weight.sum()), lane.extent(hit)
    slant = f", since the ray meets the surface at {truth.angle:.1f} degrees" if truth.angle < FRONTAL_DEGREES else ""
    spread = f"Nine tenths of its weight lie on {_length(before + behind)} of the ray{slant}"
    opacity = f" The weights sum to {weight.sum():.2g}." if weight.sum() < WEIGHT_TAILS[1] else ""
    return f"{spread}; their mean is {_offset(mean - hit)}.{opacity}"


def _ending(lane: Lane, truth: TrueRay) -> str:
    where = f"at {lane.end:.4g}" if truth.hit is None else _offset(lane.end - truth.hit)
    if lane.status is Status.MISS:
        return "It missed."
    verb = {Status.HIT: "hit", Status.OUT_OF_STEPS: "ran out of steps"}.get(lane.status, "starts inside the shape")
    return f"It {verb} {where}."


def _offset(offset: float) -> str:
    """How far a distance is from that of the true hit."""
    if abs(offset) < ROUNDING:
        return "at the surface, up to rounding"
    return f"{_length(offset)} {'behind' if offset > 0 else 'before'} the surface"


def _length(length: float) -> str:
    """A length as people write it: 0.31, 0.0042, 3e-7."""
    return f"{float(f'{abs(length):.2g}'):g}".replace("e-0", "e-")
