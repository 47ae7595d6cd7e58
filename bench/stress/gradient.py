"""Stress tests of a renderer's gradient, compared with that of closed-form distances in float64."""

import torch
from jaxtyping import Float
from torch import Tensor

from bench.solve.solve import check_field_gradient
from bench.stress.trial import Conditions, Criteria, Failure, Outcome
from datasets.stress import Exam
from renderers.boundary import rendered
from renderers.rendering import Renderer

SUMS = 8  # random sums of distances, whose gradients are compared
SEED = 0
DEFINITIONS = {
    "gradient_cosine": "cosine between the gradients of 8 random sums of distances towards the scene's parameters, and "
    "the true ones, over true hits that were found",
    "gradient_scale": "projection of that gradient on the true one, divided by the true one's length",
    "found": "share of the true hits that were found",
}


def judge_gradient(exam: Exam, renderer: Renderer, conditions: Conditions) -> Outcome:
    """Renders an exam with gradient, and compares the gradient with the true one.

    Raises:
        Unsupported: where the renderer has no gradient towards the field.
        LimitReached: where the rendering exceeds its time or memory.
    """
    check_field_gradient(renderer)
    if exam.solid is None or exam.parameters is None:
        raise ValueError("task.stress.scene has no parameters: choose grazing_plane for measure=gradient")
    device = conditions.device
    free = exam.parameters.float().to(device).requires_grad_()
    watched = conditions.limits.watch(exam.solid(free).field, device)
    found = rendered(renderer, watched, exam.camera.rays().to(device))
    exact = exam.parameters.double().requires_grad_()
    first = exam.solid(exact).trace(exam.camera.double().rays().flat())
    compared = first.hit & found.hit.flatten().cpu()
    share = float(compared.sum() / first.hit.sum().clamp_min(1))
    if share < conditions.criteria.hits or not found.distance.requires_grad:
        return Outcome(Failure.LOST, {"found": share})
    signs = torch.randn(SUMS, int(compared.sum()), generator=torch.Generator().manual_seed(SEED), dtype=torch.float64)
    computed = _gradients(found.distance.flatten()[compared.to(device)].double(), free, signs.to(device)).cpu()
    true = _gradients(first.distance[compared], exact, signs)
    cosine = float((computed * true).sum() / (computed.norm() * true.norm()).clamp_min(torch.finfo(true.dtype).tiny))
    scale = float((computed * true).sum() / true.square().sum())
    numbers = {"gradient_cosine": cosine, "gradient_scale": scale, "found": share}
    return Outcome(_failure(cosine, scale, conditions.criteria), numbers)


def _gradients(
    distance: Float[Tensor, " n"], parameters: Float[Tensor, " m"], signs: Float[Tensor, "sums n"]
) -> Float[Tensor, "sums m"]:
    sums = (signs * distance).sum(dim=1)
    rows = [torch.autograd.grad(total, parameters, retain_graph=True)[0] for total in sums]
    return torch.stack(rows).double()


def _failure(cosine: float, scale: float, criteria: Criteria) -> Failure:
    if cosine != cosine:
        return Failure.NAN
    if cosine < 0:
        return Failure.SIGN
    if cosine < criteria.cosine:
        return Failure.DIRECTION
    return Failure.SCALE if abs(scale - 1) > criteria.scale else Failure.NONE
