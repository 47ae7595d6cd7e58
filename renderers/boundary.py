"""Checks what a renderer returns, so that a broken contract gives one clear message.

The values are data, NaN among them, and are not checked here; those of hits are in `hits`. The check of a valid
rendering costs a few comparisons of shapes and types, and no evaluation of the field.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from renderers.camera import Rays
from renderers.checks import BrokenContract
from renderers.field import Field, Meter, carries_gradient
from renderers.hits import keep
from renderers.rendering import Guided, Observed, Renderer, Rendering
from renderers.waits import Late

PARTS = ("distance", "status", "points", "residual", "closest")
TOWARDS = {"field_gradient": "the field's parameters", "ray_gradient": "the rays"}


def rendered(renderer: Renderer, field: Field, rays: Rays) -> Rendering:
    """The renderer's rendering of the field along the rays; a Meter's counts note its hits.

    Raises:
        BrokenContract: where it is no Rendering, a part has a wrong shape, type or device for the rays, or hits carry
            no gradient although the renderer claims one and it is wanted.
    """
    rendering = renderer.render(field, rays)
    name = f"{type(renderer).__name__}.render"
    if not isinstance(rendering, Rendering):
        found = "None" if rendering is None else f"a {type(rendering).__name__}"
        raise BrokenContract(f"{name} must return a Rendering, not {found}: see renderers/rendering.py")
    for part in PARTS:
        _check_part(name, part, getattr(rendering, part), rays)
    _check_deferred(name, rendering)
    if (lacked := _lacked(renderer, field, rays, rendering.distance)) and bool(rendering.hit.any()):
        raise _no_gradient(renderer, lacked, "the distances of its hits carry")
    if isinstance(field, Meter):
        Late.add(field.counts, "hits", rendering.hit.sum())
    keep(renderer, field, rays, rendering)
    return rendering


def silhouette_loss(
    renderer: Renderer, field: Field, rays: Rays, rendering: Rendering, observed: Observed
) -> Float[Tensor, ""]:
    """The renderer's own loss between its rendering and what is observed: of a Guided one all, of others the mask.

    Raises:
        BrokenContract: where it is no scalar of floating point, or carries no gradient although it is not 0, the
            renderer claims one, and it is wanted.
    """
    if isinstance(renderer, Guided):
        loss, method = renderer.observed_loss(field, rays, rendering, observed), "observed_loss"
    else:
        loss, method = renderer.silhouette_loss(field, rays, rendering, observed.mask), "silhouette_loss"
    name = f"{type(renderer).__name__}.{method}"
    if not isinstance(loss, Tensor):
        found = "None" if loss is None else f"a {type(loss).__name__}"
        raise BrokenContract(f"{name} must return a tensor with one number, not {found}: return the mean over the rays")
    if loss.shape != () or not loss.is_floating_point():
        found = f"{_short(loss.dtype)} of shape {list(loss.shape)}"
        raise BrokenContract(f"{name} must return one floating-point number of shape [], not {found}: take its mean")
    check_loss_gradient(renderer, field, rays, loss, "its silhouette loss carries")
    return loss


def check_loss_gradient(renderer: Renderer, field: Field, rays: Rays, loss: Float[Tensor, ""], what: str) -> None:
    """Raises BrokenContract where a loss that is not 0 lacks a gradient that the renderer claims and that is wanted.

    Args:
        what: the output that the loss is made of, for the message: "its closest values carry".
    """
    if (lacked := _lacked(renderer, field, rays, loss)) and bool(loss != 0):
        raise _no_gradient(renderer, lacked, what)


def check_gradients(renderer: Renderer, towards_field: Tensor | None, towards_rays: Tensor | None) -> None:
    """Raises BrokenContract where a gradient of a hit's distance is missing (None) that the renderer claims."""
    for lacked, gradient in zip(TOWARDS, (towards_field, towards_rays), strict=True):
        if gradient is None and getattr(renderer.capabilities, lacked):
            raise _no_gradient(renderer, lacked, "the distances of its hits carry")


def _check_part(name: str, part: str, value: object, rays: Rays) -> None:
    """Raises BrokenContract unless a part of a rendering has the shape, type and device of one answer per ray."""
    if not isinstance(value, Tensor):
        raise BrokenContract(f"{name}: {part} must be a tensor, not a {type(value).__name__}")
    shape = (*rays.shape, 3) if part == "points" else tuple(rays.shape)
    if tuple(value.shape) != shape:
        what = "points of shape [*rays, 3]" if part == "points" else "one answer per ray"
        raise BrokenContract(
            f"{name}: {part} must have the shape {list(shape)}, not {list(value.shape)}: return {what}"
        )
    dtype = torch.int8 if part == "status" else rays.origins.dtype
    if value.dtype != dtype:
        whose = "a Status per ray" if part == "status" else "as the rays are"
        remedy = f"convert it with .to(torch.{_short(dtype)})"
        raise BrokenContract(f"{name}: {part} must be {_short(dtype)}, {whose}, not {_short(value.dtype)}: {remedy}")
    if value.requires_grad and not torch.is_grad_enabled():
        raise BrokenContract(
            f"{name}: {part} has a graph although gradients are off: do without torch.enable_grad, or detach it"
        )
    if value.device != rays.origins.device:
        remedy = "create tensors with device=rays.origins.device"
        raise BrokenContract(f"{name}: {part} must be on {rays.origins.device}, not on {value.device}: {remedy}")


def _check_deferred(name: str, rendering: Rendering) -> None:
    """Raises BrokenContract unless what is deferred has one answer per ray, and leaves out no hit."""
    deferred = rendering.deferred
    if deferred is None:
        return
    shape, found = tuple(rendering.status.shape), (tuple(deferred.distance.shape), tuple(deferred.left_out.shape))
    if found != (shape, shape):
        raise BrokenContract(f"{name}: the parts of deferred must have the shape {list(shape)}, not {found}")
    if bool((deferred.left_out & rendering.hit).any()):
        raise BrokenContract(f"{name}: deferred must leave out no hit: give `closest` its gradient there")


def _lacked(renderer: Renderer, field: Field, rays: Rays, output: Tensor) -> str:
    """The claimed capability whose gradient is wanted here but missing from an output; empty where none is missing."""
    if output.requires_grad or not torch.is_grad_enabled():
        return ""
    can = renderer.capabilities
    if can.ray_gradient and (rays.origins.requires_grad or rays.directions.requires_grad):
        return "ray_gradient"
    return "field_gradient" if can.field_gradient and carries_gradient(field, rays.origins) else ""


def _no_gradient(renderer: Renderer, lacked: str, what: str) -> BrokenContract:
    name = type(renderer).__name__
    return BrokenContract(
        f"{name}.capabilities.{lacked} is True, but {what} no gradient towards {TOWARDS[lacked]}: attach one "
        f"(see renderers/gradients.py), or set {lacked}=False"
    )


def _short(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")
