"""Stress tests of a rendering, compared with the closed-form truth."""

import torch
from jaxtyping import Float
from torch import Tensor

from bench.stress.trial import Conditions, Criteria, Failure, Outcome
from datasets.stress import Exam, FirstHit
from datasets.stress.solids import incidence_cosines
from renderers.boundary import rendered
from renderers.camera import Rays
from renderers.field import Meter
from renderers.rendering import Renderer

DEFINITIONS = {
    "lost": "true hits that were missed",
    "false": "spurious hits: on rays that have no true hit, or begin inside",
    "wrong": "true hits found with an error larger than the pixel's footprint: its width at the true distance, over "
    "the cosine of the angle of incidence",
    "hits": "true hits",
    "evaluations_per_ray": "field values computed, divided by rays",
}


@torch.no_grad()
def judge_rendering(exam: Exam, renderer: Renderer, conditions: Conditions) -> Outcome:
    """Renders an exam, and compares each ray with the truth in float64.

    Raises:
        LimitReached: where the rendering exceeds its time or memory.
    """
    camera = exam.camera
    true, footprint = truth(exam)
    meter = Meter(conditions.limits.watch(exam.field, conditions.device))
    rendering = rendered(renderer, meter, camera.rays().to(conditions.device))
    hit = rendering.hit.flatten().cpu()
    distance = rendering.distance.flatten().cpu().double()
    finite = distance.isfinite()
    both = hit & true.hit & finite
    error = (distance - true.distance).abs()
    missed, spurious = true.hit & ~hit, hit & ~true.hit
    wrong = both & (error > footprint)
    nan = hit & ~finite
    counts = {"lost": missed, "false": spurious, "wrong": wrong, "nan": nan, "hits": true.hit}
    numbers = {name: float(which.sum()) for name, which in counts.items()}
    numbers["evaluations_per_ray"] = meter.counts.value / max(hit.numel(), 1)
    kinds = torch.zeros(hit.shape, dtype=torch.uint8)  # 1 correct hit, 2 missed, 3 spurious, 4 wrong
    for kind, which in enumerate((both, missed, spurious, wrong | nan), start=1):
        kinds[which] = kind
    shape = camera.height, camera.width
    images = {
        "kinds": kinds.view(shape).numpy(),
        "distance": torch.where(hit, distance, torch.nan).view(shape).float().numpy(),
        "true_distance": torch.where(true.hit, true.distance, torch.nan).view(shape).float().numpy(),
    }
    return Outcome(_failure(numbers, hit.numel(), conditions.criteria), numbers, images)


def truth(exam: Exam) -> tuple[FirstHit, Float[Tensor, " n"]]:
    """The first hits of an exam's rays in float64, and the footprint of each pixel along its ray, in scene units."""
    camera = exam.camera.double()
    rays: Rays = camera.rays().flat()
    first = exam.truth.trace(rays)
    width = first.distance / camera.intrinsics[0, 0]
    return first, width / incidence_cosines(exam.truth.field, rays, first).clamp_min(torch.finfo(width.dtype).tiny)


def _failure(numbers: dict[str, float], rays: int, criteria: Criteria) -> Failure:
    """The most frequent kind of failure, where failures exceed the criteria."""
    bad = {Failure.LOST: numbers["lost"], Failure.WRONG: numbers["wrong"], Failure.NAN: numbers["nan"]}
    kinds = {}
    if sum(bad.values()) > (1 - criteria.hits) * numbers["hits"]:
        kinds |= bad
    if numbers["false"] > criteria.false_hits * (numbers["hits"] or rays):
        kinds[Failure.FALSE] = numbers["false"]
    return max(kinds, key=lambda kind: kinds[kind]) if kinds else Failure.NONE
