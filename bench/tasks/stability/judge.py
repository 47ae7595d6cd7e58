"""Stress tests that compare a rendering and its gradient with the closed-form truth in float64."""

import torch
from jaxtyping import Float
from torch import Tensor

from bench.solve.solve import check_field_gradient
from bench.tasks.stability.scenes import StressCase
from bench.tasks.stability.solids import FirstHit, incidence_cosines
from bench.tasks.stability.trial import Conditions, Criteria, Failure, Outcome
from renderers.boundary import render_checked
from renderers.camera import Rays
from renderers.field import Meter
from renderers.rendering import Renderer

GRADIENT_SUMS = 8  # gradients of this many random sums of distances are compared
SIGN_SEED = 0
RENDERING_NUMBERS = {
    "lost": "true hits that were missed",
    "false": "spurious hits: on rays that have no true hit, or begin inside",
    "wrong": "true hits found with an error larger than the pixel's footprint: its width at the true distance, over "
    "the cosine of the angle of incidence",
    "hits": "true hits",
    "evaluations_per_ray": "field values computed, divided by rays",
}
GRADIENT_NUMBERS = {
    "gradient_cosine": "cosine between the gradients of 8 random sums of distances towards the scene's parameters, and "
    "the true ones, over true hits that were found",
    "gradient_scale": "projection of that gradient on the true one, divided by the true one's length",
    "found": "share of the true hits that were found",
}


@torch.no_grad()
def judge_rendering(exam: StressCase, renderer: Renderer, conditions: Conditions) -> Outcome:
    """Renders an exam, and compares each ray with the truth in float64.

    Raises:
        LimitReached: if the rendering exceeds its time or memory.
    """
    camera = exam.camera
    true, footprint = truth(exam)
    meter = Meter(conditions.limits.watch(exam.field, conditions.device))
    rendering = render_checked(renderer, meter, camera.rays().to(conditions.device))
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
    return Outcome(_failure_of_pixels(numbers, hit.numel(), conditions.criteria), numbers, images)


def truth(exam: StressCase) -> tuple[FirstHit, Float[Tensor, " n"]]:
    """The first hits of an exam's rays in float64, and the footprint of each pixel along its ray, in scene units."""
    camera = exam.camera.double()
    rays: Rays = camera.rays().flat()
    first = exam.truth.trace(rays)
    width = first.distance / camera.intrinsics[0, 0]
    return first, width / incidence_cosines(exam.truth.field, rays, first).clamp_min(torch.finfo(width.dtype).tiny)


def _failure_of_pixels(numbers: dict[str, float], rays: int, criteria: Criteria) -> Failure:
    """The most frequent kind of failure, if failures exceed the criteria."""
    bad = {Failure.LOST: numbers["lost"], Failure.WRONG: numbers["wrong"], Failure.NAN: numbers["nan"]}
    kinds = {}
    if sum(bad.values()) > (1 - criteria.hits) * numbers["hits"]:
        kinds |= bad
    if numbers["false"] > criteria.false_hits * (numbers["hits"] or rays):
        kinds[Failure.FALSE] = numbers["false"]
    return max(kinds, key=lambda kind: kinds[kind]) if kinds else Failure.NONE


def judge_gradient(exam: StressCase, renderer: Renderer, conditions: Conditions) -> Outcome:
    """Renders an exam with gradient, and compares the gradient with the true one.

    Raises:
        Unsupported: if the renderer has no gradient for the field.
        LimitReached: if the rendering exceeds its time or memory.
    """
    check_field_gradient(renderer)
    if exam.solid is None or exam.parameters is None:
        raise ValueError("task.stress.scene has no parameters: choose grazing_plane for measure=gradient")
    device = conditions.device
    parameters = exam.parameters.float().to(device).requires_grad_()
    watched = conditions.limits.watch(exam.solid(parameters).field, device)
    rendering = render_checked(renderer, watched, exam.camera.rays().to(device))
    exact = exam.parameters.double().requires_grad_()
    first = exam.solid(exact).trace(exam.camera.double().rays().flat())
    compared = first.hit & rendering.hit.flatten().cpu()
    found_fraction = float(compared.sum() / first.hit.sum().clamp_min(1))
    if found_fraction < conditions.criteria.hits or not rendering.distance.requires_grad:
        return Outcome(Failure.LOST, {"found": found_fraction})
    generator = torch.Generator().manual_seed(SIGN_SEED)
    signs = torch.randn(GRADIENT_SUMS, int(compared.sum()), generator=generator, dtype=torch.float64)
    distance = rendering.distance.flatten()[compared.to(device)].double()
    computed = _gradients(distance, parameters, signs.to(device)).cpu()
    true = _gradients(first.distance[compared], exact, signs)
    cosine = float((computed * true).sum() / (computed.norm() * true.norm()).clamp_min(torch.finfo(true.dtype).tiny))
    scale = float((computed * true).sum() / true.square().sum())
    numbers = {"gradient_cosine": cosine, "gradient_scale": scale, "found": found_fraction}
    return Outcome(_failure_of_gradient(cosine, scale, conditions.criteria), numbers)


def _gradients(
    distance: Float[Tensor, " n"], parameters: Float[Tensor, " m"], signs: Float[Tensor, "sums n"]
) -> Float[Tensor, "sums m"]:
    sums = (signs * distance).sum(dim=1)
    rows = [torch.autograd.grad(total, parameters, retain_graph=True)[0] for total in sums]
    return torch.stack(rows).double()


def _failure_of_gradient(cosine: float, scale: float, criteria: Criteria) -> Failure:
    if cosine != cosine:
        return Failure.NAN
    if cosine < 0:
        return Failure.SIGN
    if cosine < criteria.cosine:
        return Failure.DIRECTION
    return Failure.SCALE if abs(scale - 1) > criteria.scale else Failure.NONE
