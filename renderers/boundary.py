"""Checks what a renderer returns, so that a broken contract gives one clear message.

Whether values are finite is not checked here; `hits` checks the distances of hits. The check of a valid rendering
costs a few comparisons of shapes and types, and no field evaluation.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from renderers.camera import Rays
from renderers.checks import BrokenContract
from renderers.field import Field, Meter, carries_gradient
from renderers.hits import record_hits
from renderers.rendering import RayObservation, Renderer, Rendering, UsesDistances

RENDERING_TENSORS = ("distance", "status", "points", "residual", "closest")
GRADIENT_TARGETS = {"field_gradient": "the field's parameters", "ray_gradient": "the rays"}


def render_checked(renderer: Renderer, field: Field, rays: Rays) -> Rendering:
    """Renders the field along the rays and checks the rendering; the counts of a Meter include its hits.

    Raises:
        BrokenContract: if it is no Rendering, if a tensor has a wrong shape, type or device for the rays, or if hits
            have no gradient although gradients are on and the renderer claims one.
    """
    rendering = renderer.render(field, rays)
    name = f"{type(renderer).__name__}.render"
    if not isinstance(rendering, Rendering):
        raise BrokenContract(f"{name} must return a Rendering, not {_type_of(rendering)}: see renderers/rendering.py")
    for tensor_name in RENDERING_TENSORS:
        _check_tensor(name, tensor_name, getattr(rendering, tensor_name), rays)
    _check_deferred(name, rendering)
    if (capability := _missing_gradient(renderer, field, rays, rendering.distance)) and bool(rendering.hit.any()):
        raise _missing_gradient_error(renderer, capability, "the distances of its hits carry")
    if isinstance(field, Meter):
        field.counts.add("hits", rendering.hit.sum())
    record_hits(renderer, field, rays, rendering)
    return rendering


def silhouette_loss(
    renderer: Renderer, field: Field, rays: Rays, rendering: Rendering, observed: RayObservation
) -> Float[Tensor, ""]:
    """The renderer's loss between its rendering and the mask, with the observed distances if it `UsesDistances`.

    Raises:
        BrokenContract: if it is no floating-point scalar, or if it is not 0 and has no gradient although gradients are
            on and the renderer claims one.
    """
    if isinstance(renderer, UsesDistances):
        loss, method = renderer.observed_loss(field, rays, rendering, observed), "observed_loss"
    else:
        loss, method = renderer.silhouette_loss(field, rays, rendering, observed.mask), "silhouette_loss"
    name = f"{type(renderer).__name__}.{method}"
    if not isinstance(loss, Tensor):
        remedy = "return the mean over the rays"
        raise BrokenContract(f"{name} must return a tensor with one number, not {_type_of(loss)}: {remedy}")
    if loss.shape != () or not loss.is_floating_point():
        returned = f"{_dtype_name(loss.dtype)} of shape {list(loss.shape)}"
        raise BrokenContract(f"{name} must return one floating-point number of shape [], not {returned}: take its mean")
    check_loss_gradient(renderer, field, rays, loss, "its silhouette loss carries")
    return loss


def check_loss_gradient(renderer: Renderer, field: Field, rays: Rays, loss: Float[Tensor, ""], subject: str) -> None:
    """Raises BrokenContract if a loss that is not 0 lacks a gradient, gradients are on and the renderer claims it.

    Args:
        subject: of the message, with its verb: "its closest values carry".
    """
    if (capability := _missing_gradient(renderer, field, rays, loss)) and bool(loss != 0):
        raise _missing_gradient_error(renderer, capability, subject)


def check_gradients(renderer: Renderer, towards_field: Tensor | None, towards_rays: Tensor | None) -> None:
    """Raises BrokenContract if a gradient of a hit's distance is missing (None) that the renderer claims."""
    for capability, gradient in zip(GRADIENT_TARGETS, (towards_field, towards_rays), strict=True):
        if gradient is None and getattr(renderer.capabilities, capability):
            raise _missing_gradient_error(renderer, capability, "the distances of its hits carry")


def _check_tensor(name: str, tensor_name: str, value: object, rays: Rays) -> None:
    """Raises BrokenContract unless a tensor of a rendering has one entry per ray, and the rays' type and device."""
    name = f"{name}: {tensor_name}"
    if not isinstance(value, Tensor):
        raise BrokenContract(f"{name} must be a tensor, not a {type(value).__name__}")
    shape = (*rays.shape, 3) if tensor_name == "points" else tuple(rays.shape)
    if tuple(value.shape) != shape:
        remedy = "points of shape [*rays, 3]" if tensor_name == "points" else "one answer per ray"
        raise BrokenContract(f"{name} must have the shape {list(shape)}, not {list(value.shape)}: return {remedy}")
    dtype = torch.int8 if tensor_name == "status" else rays.origins.dtype
    if value.dtype != dtype:
        expected = f"{_dtype_name(dtype)}, {'a Status per ray' if tensor_name == 'status' else 'as the rays are'}"
        remedy = f"convert it with .to(torch.{_dtype_name(dtype)})"
        raise BrokenContract(f"{name} must be {expected}, not {_dtype_name(value.dtype)}: {remedy}")
    if value.requires_grad and not torch.is_grad_enabled():
        raise BrokenContract(
            f"{name} has a graph although gradients are off: do without torch.enable_grad, or detach it"
        )
    if value.device != rays.origins.device:
        remedy = "create tensors with device=rays.origins.device"
        raise BrokenContract(f"{name} must be on {rays.origins.device}, not on {value.device}: {remedy}")


def _check_deferred(name: str, rendering: Rendering) -> None:
    """Raises BrokenContract unless `deferred` has one entry per ray and defers the gradient of no hit."""
    deferred = rendering.deferred
    if deferred is None:
        return
    shape, shapes = tuple(rendering.status.shape), (tuple(deferred.distance.shape), tuple(deferred.left_out.shape))
    if shapes != (shape, shape):
        raise BrokenContract(f"{name}: the parts of deferred must have the shape {list(shape)}, not {shapes}")
    if bool((deferred.left_out & rendering.hit).any()):
        raise BrokenContract(f"{name}: deferred must leave out no hit: give `closest` its gradient there")


def _missing_gradient(renderer: Renderer, field: Field, rays: Rays, output: Tensor) -> str:
    """The claimed capability whose gradient is possible here but missing from an output; empty if none is missing."""
    if output.requires_grad or not torch.is_grad_enabled():
        return ""
    can = renderer.capabilities
    if can.ray_gradient and (rays.origins.requires_grad or rays.directions.requires_grad):
        return "ray_gradient"
    return "field_gradient" if can.field_gradient and carries_gradient(field, rays.origins) else ""


def _missing_gradient_error(renderer: Renderer, capability: str, subject: str) -> BrokenContract:
    return BrokenContract(
        f"{type(renderer).__name__}.capabilities.{capability} is True, but {subject} no gradient towards "
        f"{GRADIENT_TARGETS[capability]}: attach one (see renderers/gradients.py), or set {capability}=False"
    )


def _type_of(value: object) -> str:
    return "None" if value is None else f"a {type(value).__name__}"


def _dtype_name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")
