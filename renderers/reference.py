"""The reference tracer: hits of a field in float64, exact up to a stated bound. Slow, for ground truth; no gradient."""

import torch

from renderers.bracket import Bracket, narrow, refine
from renderers.camera import Rays, sphere_span
from renderers.checks import check_positive
from renderers.field import Field
from renderers.rendering import Rendering, Status, assemble

BISECTIONS, SECANTS = 12, 8  # steps that narrow a bracket: bisection is safe, the secant exact for a linear field


@torch.no_grad()
def trace(field: Field, rays: Rays, *, lipschitz: float, least_step: float, radius: float) -> Rendering:
    """The first hit of every ray in the sphere, by steps that cross no surface, and a bracketed root.

    A step is |field| / lipschitz, which is safe where that bounds the gradient (Hart 1996), but at least
    `least_step`: what is thinner along the ray than that, and nearer than lipschitz * least_step, may be missed.

    Args:
        field: evaluated as it is; give it in float64.
        rays: in float64.
        lipschitz: bound on the length of the field's gradient; see `field.steepest`.
        least_step: in scene units.
        radius: of the sphere about the origin that holds the shape.

    Raises:
        ValueError: where a number is not positive, or the rays are not in float64.
    """
    check_positive("lipschitz", lipschitz, "steepest() measures one")
    check_positive("least_step", least_step, "2e-4 finds all that a pixel shows")
    if rays.origins.dtype is not torch.float64:
        raise ValueError(f"rays must be in float64, not {rays.origins.dtype}: convert the camera by .double()")
    flat = rays.flat()
    entry, leave, meets = sphere_span(flat, radius)
    status = torch.where(meets, Status.OUT_OF_STEPS, Status.MISS).to(torch.int8)
    near, far = entry.clone(), leave.clone()
    near_value, far_value = torch.full_like(entry, torch.inf), torch.full_like(entry, torch.inf)
    least = near_value.clone()
    at, active = entry.clone(), meets.nonzero().squeeze(-1)
    while active.numel():
        value = field(flat[active].at(at[active]))
        occupied, first = value <= 0, near_value[active].isinf()
        least[active] = torch.minimum(least[active], value)
        status[active[occupied & ~first]] = Status.HIT
        status[active[occupied & first]] = Status.STARTED_INSIDE
        far[active[occupied]], far_value[active[occupied]] = at[active[occupied]], value[occupied]
        active, value = active[~occupied], value[~occupied]
        near[active], near_value[active] = at[active], value
        status[active[at[active] >= leave[active]]] = Status.MISS
        moved = at[active] + (value / lipschitz).clamp_min(least_step)
        going = at[active] < leave[active]
        at[active] = torch.minimum(moved, leave[active])
        active = active[going]
    hit = (status == Status.HIT).nonzero().squeeze(-1)
    bracket = Bracket(near[hit], far[hit], near_value[hit], far_value[hit])
    bracket = narrow(field, flat[hit], bracket, method="bisection", steps=BISECTIONS)
    distance, remaining = refine(field, flat[hit], bracket, method="secant", steps=SECANTS)
    residual = torch.where(least.isfinite(), least, 0.0).index_put((hit,), remaining)
    queried = meets.nonzero().squeeze(-1)
    return assemble(
        rays,
        radius,
        distance=torch.where(status == Status.MISS, leave, at).index_put((hit,), distance),
        status=status,
        residual=residual,
        closest=(queried, residual[queried]),
    )
