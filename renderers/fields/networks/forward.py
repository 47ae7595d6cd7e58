"""Checks the forward pass of a user's network, so that a wrong one gives one clear message.

Types, shapes and containers are converted, and the network gets a copy of the points. All else is refused, by
evaluations at few points before the network is used.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from dataclasses import fields, is_dataclass
from itertools import chain
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from renderers.checks import BadInput
from renderers.field import points_in_sphere

CHECKED_POINTS = 127  # no usual width or batch size of a network
WANTED = "forward must take points [n, 3] and give one value per point, [n] or [n, 1]"
# What code of a user raises. Out of memory is a RuntimeError, but not at so few points.
ERRORS = (RuntimeError, TypeError, ValueError, LookupError, AttributeError, AssertionError, ArithmeticError)
# Most that a value may differ between two evaluations of a point, as a fraction of the range of the values.
MAX_REPEAT_DIFFERENCE = 0.01
# Gradients are compared with differences of values where the differences of two steps agree.
DIFFERENCE_STEPS = (1e-2, 5e-3)
MAX_DIFFERENCE_CHANGE, MIN_COMPARED_POINTS = 0.05, 10
GRADIENT_SHARE = (0.75, 1.25)  # least and greatest part of the differences that the gradients may explain


class CheckedForward(nn.Module):
    """A network as a function from points [n, 3] to values [n] of the points' type, on their device.

    Args:
        network: an nn.Module, or any function of points.
        batched: whether it takes points [1, n, 3].
        key: of the values in what it gives, such as "0" of a tuple; "" if it gives a tensor.
        note: on the key and on coarse types; empty if there is nothing to note.

    Attributes:
        keeps_types: whether `double`, `half` and such leave the network's types, as its forward pass needs them.
    """

    def __init__(self, network: Callable[..., Any], *, batched: bool, key: str = "", note: str = "") -> None:
        super().__init__()
        self.network, self.batched, self.key, self.note = network, batched, key, note
        self.keeps_types = False

    def forward(self, points: Float[Tensor, "n 3"], code: Tensor | None = None) -> Float[Tensor, " n"]:
        if not len(points):
            return points[:, 0]
        values = dict(tensors_in(self.output(points))).get(self.key)
        if values is None or not _has_value_per_point(values, len(points)):
            what = "nothing" if values is None else _describe(values, len(points))
            raise BadInput(f"{name_of(self.network)} gives {what} for n = {len(points)} points: {WANTED}")
        return values.reshape(len(points)).to(points)

    def output(self, points: Float[Tensor, "n 3"]) -> Any:
        """What the network gives at a copy of the points, in the type of its weights."""
        copied = points.to(self._dtype(points), copy=True)
        return self.network(copied[None] if self.batched else copied)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "CheckedForward":
        return super()._apply((lambda tensor: fn(tensor).to(tensor.dtype)) if self.keeps_types else fn, recurse)

    def __deepcopy__(self, memo: dict[int, Any]) -> "CheckedForward":
        network = self.network
        network = copy_module(network, memo) if isinstance(network, nn.Module) else network
        copied = CheckedForward(network, batched=self.batched, key=self.key, note=self.note)
        copied.keeps_types = self.keeps_types
        return copied.train(self.training)

    def _dtype(self, points: Tensor) -> torch.dtype:
        tensors = chain(self.parameters(), self.buffers())
        return next((tensor.dtype for tensor in tensors if tensor.is_floating_point()), points.dtype)


def check_forward(network: Callable[..., Any], like: Tensor) -> CheckedForward:
    """The network as a function with one value per point and a gradient towards the points, checked at few points.

    Args:
        like: a tensor with the dtype and the device of the evaluations.

    Raises:
        BadInput: it fails, gives something else, or has no such gradient. The message names the class and the remedy.
    """
    points = points_in_sphere(CHECKED_POINTS, like)
    _check_arguments(network)
    batched, output = _call(network, points)
    key, dtype = _key_and_dtype(network, output)
    notes = [f"values are {key!r} of the output of {name_of(network)}"] if key else []
    notes += [f"values come in {_name(dtype)}, which is coarse"] if dtype.itemsize < torch.float32.itemsize else []
    checked = CheckedForward(network, batched=batched, key=key, note="; ".join(notes))
    with torch.no_grad():
        values, again, few = checked(points), checked(points), checked(points[: CHECKED_POINTS // 2])
    limit = MAX_REPEAT_DIFFERENCE * (values.max() - values.min())
    for changed, cause in (
        (again, "differ between two calls at the same points: call eval(), and draw nothing at random in it"),
        (few, "at a point depend on the other points of the call: call eval(), and normalise by constants"),
    ):
        if bool(((changed - values[: len(changed)]).abs() > limit).any()):
            raise BadInput(f"the values of {name_of(network)} {cause}")
    _check_gradient(checked, points)
    return checked


def check_module(module: nn.Module) -> CheckedForward:
    """As `check_forward`, in float32 on the CPU, or in the module's types if its forward pass needs them."""
    like = torch.zeros(())
    try:
        checked = check_forward(copy_module(module).float(), like)
    except BadInput:
        checked = check_forward(module, like)
        checked.keeps_types = True
        return checked
    try:
        with torch.no_grad():
            deepcopy(checked).double()(points_in_sphere(CHECKED_POINTS))  # as for references
    except ERRORS:
        checked.keeps_types = True
    return checked


def copy_module(module: nn.Module, memo: dict[int, Any] | None = None) -> nn.Module:
    """A deep copy, in which computed attributes, such as weights of torch's older normalisation, have no graph."""
    values = (value for layer in module.modules() for value in vars(layer).values())
    computed = [value for value in values if isinstance(value, Tensor) and not value.is_leaf]
    memo = {} if memo is None else memo
    memo |= {id(value): value.detach() for value in computed}
    return deepcopy(module, memo)


def name_of(network: Callable[..., Any]) -> str:
    """The name of a network's class with its method, or of a function."""
    is_module = isinstance(network, nn.Module)
    return f"{type(network).__name__}.forward" if is_module else getattr(network, "__qualname__", repr(network))


def tensors_in(output: Any, prefix: str = "") -> Iterator[tuple[str, Tensor]]:
    """The tensors in what a forward pass gives, with dotted names: keys, indices or attributes; "" for a tensor."""
    if isinstance(output, Tensor):
        yield prefix.removesuffix("."), output
        return
    if isinstance(output, Mapping):
        items = output.items()
    elif isinstance(output, list | tuple):
        items = enumerate(output)
    else:
        items = [(field.name, getattr(output, field.name)) for field in fields(output)] if is_dataclass(output) else []
    for key, inner in items:
        yield from tensors_in(inner, f"{prefix}{key}.")


def _check_arguments(network: Callable[..., Any]) -> None:
    """Raises BadInput if a forward pass wants more than the points, such as a latent code."""
    try:
        signature = inspect.signature(network.forward if isinstance(network, nn.Module) else network)
    except (TypeError, ValueError):  # a built-in function
        return
    kinds = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    required = [key for key, x in signature.parameters.items() if x.default is x.empty and x.kind not in kinds]
    if len(required) > 1:
        raise BadInput(
            f"{name_of(network)} wants {', '.join(required)}: it gets points [n, 3] alone. Give the others a default, "
            "such as the code of one shape"
        )


def _call(network: Callable[..., Any], points: Tensor) -> tuple[bool, Any]:
    """Whether the network takes points [1, n, 3], which are tried after [n, 3], and what it gives."""
    errors = []
    for batched in (False, True):
        try:
            with torch.no_grad():
                return batched, CheckedForward(network, batched=batched).output(points)
        except ERRORS as error:
            errors.append(error)
    where = f"points [n, 3], n = {len(points)}, where gradients are off"
    raise BadInput(f"{name_of(network)} fails at {where}: {_cause(errors[0])}: {WANTED}") from errors[0]


def _key_and_dtype(network: Callable[..., Any], output: Any) -> tuple[str, torch.dtype]:
    """Name and type of the only tensor with one value per point; raises BadInput if there is none, or several."""
    tensors = dict(tensors_in(output))
    keys = [key for key, tensor in tensors.items() if _has_value_per_point(tensor, CHECKED_POINTS)]
    if len(keys) == 1:
        return keys[0], tensors[keys[0]].dtype
    what = "None" if output is None else f"a {type(output).__name__}"
    if tensors:
        shown = (f"{key}: " * bool(key) + _describe(tensor, CHECKED_POINTS) for key, tensor in [*tensors.items()][:6])
        what = f"{what} of {', '.join(shown)}"
    remedy = "return one of them" if keys else "return the values alone, such as values[:, :1] of several columns"
    raise BadInput(f"{name_of(network)} gives {what}: {WANTED}; {remedy}")


def _has_value_per_point(tensor: Tensor, count: int) -> bool:
    return tensor.is_floating_point() and tensor.numel() == count and max(tensor.shape, default=1) == count


def _describe(tensor: Tensor, count: int) -> str:
    sizes = ", ".join("n" if size == count else str(size) for size in tensor.shape)
    return f"{_name(tensor.dtype)} [{sizes}]"


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def _cause(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:240]}"


def _check_gradient(checked: CheckedForward, points: Tensor) -> None:
    """Raises BadInput unless the values have the gradient towards the points that their differences show."""
    name = name_of(checked.network)
    cut = "remove detach, .data, no_grad and inference_mode from it, and make no new leaf of the points"
    with torch.enable_grad():
        leaf = points.clone().requires_grad_(True)
        try:
            values = checked(leaf)
            total = values.sum()
            gradient = torch.autograd.grad(total, leaf, allow_unused=True)[0] if total.requires_grad else None
        except ERRORS as error:
            remedy = "use no in-place operation in it"
            raise BadInput(f"{name} has no gradient towards the points: {_cause(error)}: {remedy}") from error
    if gradient is None:
        raise BadInput(f"the values of {name} have no gradient towards the points: {cut}")
    share = _share_of_differences(checked, points, gradient)
    if share is not None and (share < GRADIENT_SHARE[0] or share > GRADIENT_SHARE[1]):
        message = f"the gradient of {name} towards the points is {share:.2g} times the change of its values"
        raise BadInput(f"{message}: {cut}")
    if not bool(gradient.any()):
        remedy = "return values before sign, round or a threshold, and trained weights"
        raise BadInput(f"the gradient of {name} is 0 at all of {len(points)} points: {remedy}")


@torch.no_grad()
def _share_of_differences(checked: CheckedForward, points: Tensor, gradient: Tensor) -> float | None:
    """The part of the values' central differences that the gradient explains, 1 if it is right.

    None if too few points have differences that do not depend on the step, as in coarse types and grids.
    """
    axes = torch.eye(3).to(points)
    wide, narrow = (
        torch.stack([checked(points + step * axis) - checked(points - step * axis) for axis in axes], -1) / (2 * step)
        for step in DIFFERENCE_STEPS
    )
    length = narrow.norm(dim=-1)
    usable = ((wide - narrow).norm(dim=-1) <= MAX_DIFFERENCE_CHANGE * length) & (length > 0)
    if int(usable.sum()) < MIN_COMPARED_POINTS:
        return None
    narrow = narrow[usable]
    return float((gradient[usable] * narrow).sum() / (narrow * narrow).sum())
