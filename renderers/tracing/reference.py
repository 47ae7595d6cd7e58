"""The reference tracer: hits of a field in float64, exact up to a stated bound. Slow, for ground truth; no gradient."""

import torch

from renderers.camera import Rays, sphere_span
from renderers.checks import check_positive
from renderers.field import Field
from renderers.rendering import Rendering, Status, assemble
from renderers.tracing.bracket import Bracket, narrow, refine

BISECTION_STEPS, SECANT_STEPS = 12, 8  # bisection is safe, the secant method is exact for a linear field


@torch.no_grad()
def trace(field: Field, rays: Rays, *, lipschitz: float, least_step: float, radius: float) -> Rendering:
    """The first hit of every ray in the sphere, by steps that cross no surface, and a bracketed root.

    A step is |field| / lipschitz, which is safe if `lipschitz` bounds the gradient (Hart 1996), but at least
    `least_step`. A part thinner along the ray than that may be missed if the field is below lipschitz * least_step.

    Args:
        field: evaluated as it is; pass it in float64.
        rays: in float64.
        lipschitz: bound on the length of the field's gradient; see `field.estimate_lipschitz`.
        least_step: in scene units.
        radius: of the sphere about the origin that contains the shape.

    Raises:
        ValueError: if a number is not positive, or the rays are not in float64.
    """
    check_positive("lipschitz", lipschitz, "estimate_lipschitz() measures one")
    check_positive("least_step", least_step, "2e-4 finds all that a pixel shows")
    if rays.origins.dtype is not torch.float64:
        raise ValueError(f"rays must be in float64, not {rays.origins.dtype}: convert the camera by .double()")
    flat = rays.flat()
    entry, leave, intersects = sphere_span(flat, radius)
    status = torch.where(intersects, Status.OUT_OF_STEPS, Status.MISS).to(torch.int8)
    near, far = entry.clone(), leave.clone()
    near_value, far_value = torch.full_like(entry, torch.inf), torch.full_like(entry, torch.inf)
    least = near_value.clone()
    distance, active = entry.clone(), intersects.nonzero().squeeze(-1)
    while active.numel():
        value = field(flat[active].at(distance[active]))
        occupied, first = value <= 0, near_value[active].isinf()
        least[active] = torch.minimum(least[active], value)
        status[active[occupied & ~first]] = Status.HIT
        status[active[occupied & first]] = Status.STARTED_INSIDE
        far[active[occupied]], far_value[active[occupied]] = distance[active[occupied]], value[occupied]
        active, value = active[~occupied], value[~occupied]
        near[active], near_value[active] = distance[active], value
        status[active[distance[active] >= leave[active]]] = Status.MISS
        moved = distance[active] + (value / lipschitz).clamp_min(least_step)
        going = distance[active] < leave[active]
        distance[active] = torch.minimum(moved, leave[active])
        active = active[going]
    hit = (status == Status.HIT).nonzero().squeeze(-1)
    bracket = Bracket(near[hit], far[hit], near_value[hit], far_value[hit])
    bracket = narrow(field, flat[hit], bracket, method="bisection", steps=BISECTION_STEPS)
    root, remaining = refine(field, flat[hit], bracket, method="secant", steps=SECANT_STEPS)
    residual = torch.where(least.isfinite(), least, 0.0).index_put((hit,), remaining)
    queried = intersects.nonzero().squeeze(-1)
    return assemble(
        rays,
        radius,
        distance=torch.where(status == Status.MISS, leave, distance).index_put((hit,), root),
        status=status,
        residual=residual,
        closest=(queried, residual[queried]),
    )
