"""Derivatives of the hit distance on one ray: by a renderer's gradient, and by central differences of the reference."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, isfinite, nan

import torch
from jaxtyping import Float
from torch import Tensor

from bench.evaluate.reference import trace_exactly
from renderers.camera import Rays
from renderers.field import Field
from renderers.rendering import Renderer, Unsupported, with_empty_memory

STEP = 1e-6  # units of the parameter: roots are exact to 1e-15, so rounding and curvature stay below 1e-8
ROUNDING = 1e-8  # derivatives of a smaller magnitude are shown as 0
MAX_CHANGE = 1e-3  # scene units: a hit that moves farther within a step is on another surface
SHOWN_PARAMETERS = 3
AGREEMENT = 0.01  # relative error up to which derivatives agree
TARGETS = {"field_gradient": "gradient towards the field", "ray_gradient": "gradient towards the rays"}
PARALLEL = 0.02  # relative error, after scaling, up to which derivatives differ by a factor alone


@dataclass(frozen=True)
class Parameters:
    """Numbers of a scene on which the distances of hits depend.

    Args:
        names: of the parameters.
        values: in float64.
        rendered, exact: from values and rays, the field and the rays of a renderer and of the reference.
        capability: the attribute of `Capabilities` that states a renderer's gradient towards them.
    """

    names: tuple[str, ...]
    values: Float[Tensor, " n"]
    rendered: Callable[[Tensor, Rays], tuple[Field, Rays]]
    exact: Callable[[Tensor, Rays], tuple[Field, Rays]]
    capability: str = "field_gradient"

    @staticmethod
    def of_translation(field: Field, exact: Field) -> "Parameters":
        """The object's translation along the world axes: the rays move the other way."""

        def moved(field: Field) -> Callable[[Tensor, Rays], tuple[Field, Rays]]:
            return lambda shift, rays: (field, Rays(rays.origins - shift.to(rays.origins), rays.directions))

        zero = torch.zeros(3, dtype=torch.float64)
        return Parameters(("shift x", "shift y", "shift z"), zero, moved(field), moved(exact), "ray_gradient")

    @staticmethod
    def of_field(
        names: Sequence[str], values: Tensor, field_at: Callable[[Tensor], Field], exact_at: Callable[[Tensor], Field]
    ) -> "Parameters":
        """Parameters of the field, such as a code; `field_at` and `exact_at` get them in float64."""
        return Parameters(
            tuple(names),
            values.detach().double(),
            lambda values, rays: (field_at(values), rays),
            lambda values, rays: (exact_at(values), rays),
        )


@dataclass(frozen=True)
class Derivatives:
    """Derivatives of the hit distance towards the most sensitive parameters, per unit of the parameter.

    Args:
        true: by central differences of the reference; nan where the hit jumps within a step.
        computed: by the renderer's gradient; empty without one.
    """

    indices: list[int]
    names: list[str]
    true: list[float]
    computed: tuple[float, ...] = ()
    missing: str = ""

    @property
    def pairs(self) -> list[str]:
        """For each parameter, its name with the renderer's derivative and the reference's in brackets."""
        computed = self.computed or [nan] * len(self.true)
        rows = zip(self.names, computed, self.true, strict=True)
        return [f"{name} {_number(derivative)} ({_number(true)})" for name, derivative, true in rows]

    @property
    def error(self) -> float:
        """The relative error of the renderer's derivatives; nan without both."""
        if not self.computed or not all(map(isfinite, self.true)):
            return nan
        true = torch.tensor(self.true, dtype=torch.float64)
        return float((torch.tensor(self.computed, dtype=torch.float64) - true).norm() / true.norm())

    @property
    def verdict(self) -> str:
        """Whether the renderer's derivatives agree with the reference, in words; empty if that is undecided."""
        if self.missing or not isfinite(self.error):
            return self.missing
        if self.error <= AGREEMENT:
            return f"They agree within {100 * AGREEMENT:g} %."
        computed, true = (torch.tensor(each, dtype=torch.float64) for each in (self.computed, self.true))
        factor = float(computed @ true / true.square().sum())
        rest = float((computed - factor * true).norm() / true.norm())
        if factor and rest <= PARALLEL * abs(factor):
            return f"They are {factor:.3g} times those of the reference."
        return f"Their relative error is {100 * self.error:.0f} %."

    @property
    def sentences(self) -> str:
        if not self.computed:
            return self.missing
        return f"Derivatives of the distance (of the reference): {', '.join(self.pairs)}. {self.verdict}".strip()


def true_derivatives(parameters: Parameters, rays: Rays, hit: float, lipschitz: float) -> Derivatives:
    """The derivatives of the true distance on one float64 ray [1, 3], without those of a renderer.

    The parameters that change the field most at the hit are chosen.
    """
    values = parameters.values.clone().requires_grad_(True)
    field, moved = parameters.exact(values, rays)
    distance = torch.tensor([hit], dtype=torch.float64)
    (slopes,) = torch.autograd.grad(field(moved.at(distance)).sum(), values)
    indices = slopes.abs().argsort(descending=True)[:SHOWN_PARAMETERS].tolist()

    def distance_at(values: Tensor) -> float:
        rendering = trace_exactly(*parameters.exact(values, rays), lipschitz)
        return float(rendering.distance) if bool(rendering.hit) else inf

    true = []
    for index in indices:
        step = STEP * torch.eye(len(values), dtype=torch.float64)[index]
        ahead, behind = (distance_at(parameters.values + sign * step) for sign in (1, -1))
        is_same_surface = max(abs(ahead - hit), abs(behind - hit)) < MAX_CHANGE
        true.append((ahead - behind) / (2 * STEP) if is_same_surface else nan)
    return Derivatives(indices, [parameters.names[index] for index in indices], true)


def with_renderer(true: Derivatives, renderer: Renderer, parameters: Parameters, rays: Rays) -> Derivatives:
    """The derivatives with those of a renderer, by its gradient on one ray [1, 3] alone."""

    def result(missing: str = "", computed: tuple[float, ...] = ()) -> Derivatives:
        return Derivatives(true.indices, true.names, true.true, computed, missing)

    if not getattr(renderer.capabilities, parameters.capability):
        return result(f"It states no {TARGETS[parameters.capability]}.")
    values = parameters.values.clone().requires_grad_(True)
    try:
        rendering = with_empty_memory(renderer).render(*parameters.rendered(values, rays))
    except Unsupported as error:
        return result(f"It has no derivative: {error}.")
    if not bool(rendering.hit.all()):
        return result("Without a hit, its distance has no derivative.")
    if not rendering.distance.requires_grad:
        missing = f"It states a {TARGETS[parameters.capability]}, but its distance has none."
        return result(missing, (0.0,) * len(true.indices))
    (gradient,) = torch.autograd.grad(rendering.distance.sum(), values, allow_unused=True, materialize_grads=True)
    return result(computed=tuple(gradient[true.indices].tolist()))


def _number(derivative: float) -> str:
    """A derivative as people write it; a dash if there is none."""
    if not isfinite(derivative):
        return "–"
    return f"{float(f'{derivative:.3g}'):g}" if abs(derivative) > ROUNDING else "0"
