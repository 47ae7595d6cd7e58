"""Derivatives of distances with respect to code and camera, by central differences in float64: the ground truth."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderers.camera import Camera, Rays, sphere_span
from renderers.field import Field, autograd_gradients
from renderers.fields.mlp import Decoder
from renderers.fields.networks.network import Published
from renderers.tracing.bracket import equally_spaced
from renderers.tracing.reference import trace

PAINT_NEURONS = 16
MAX_SECOND_DIFFERENCE = 1e-9  # smooth colours have about 1e-12
STEP = 1e-6  # units of the parameter: a network has few kinks within such a short step
SECANT_STEPS = 6
MAX_RESIDUAL = 1e-12  # |field| above which the secant method has not converged
EXCLUDED_BEFORE_HIT = 1e-3  # scene units: this close to its hit, a ray may be near the surface
CLEARANCE_SAMPLES = 256  # on the rest of the ray


@dataclass(frozen=True)
class Paint:
    """Smooth colours of points and normals by a small network, in float64.

    Args:
        weights: all weights in one row of `size` numbers.
    """

    weights: Float[Tensor, " n"]

    size: ClassVar[int] = (6 + 3) * PAINT_NEURONS

    @staticmethod
    def random(generator: torch.Generator) -> "Paint":
        """Random colours that vary within a fraction of a scene unit."""
        return Paint(torch.randn(Paint.size, generator=generator, dtype=torch.float64))

    def __call__(
        self, points: Float[Tensor, "*batch 3"], normals: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch 3"]:
        first, second = self.weights.split([6 * PAINT_NEURONS, 3 * PAINT_NEURONS])
        hidden = torch.sin(torch.cat([points, normals], dim=-1) @ first.view(6, PAINT_NEURONS))
        return torch.sigmoid(hidden @ second.view(PAINT_NEURONS, 3))


@dataclass(frozen=True)
class Differences:
    """Derivatives of the distance or the three colours in m pixels, and where they are valid.

    They are valid where visibility does not change and, for colours, where normals do not jump.
    """

    code: Float[Tensor, "m c directions"]
    camera: Float[Tensor, "m c 6"]
    texture: Float[Tensor, "m c weights"] | None
    valid: Bool[Tensor, " m"]


def differences(
    decoder: Decoder | Published,
    code: Float[Tensor, " code_length"],
    directions: Float[Tensor, "code_length directions"],
    *,
    camera: Camera,
    pixels: Int[Tensor, " m"],
    distance: Float[Tensor, " m"],
    paint: Paint | None = None,
) -> Differences:
    """Central differences of the distances of the hits in some pixels, or of the colours at the hits.

    Args:
        decoder, code: in float64.
        directions: of the code, as unit columns.
        camera: in float64; its six derivatives are those of the twist of `Camera.moved`.
        pixels: indices into the flattened image.
        distance: to the hits.
        paint: gives the colours, which depend on code and camera through points and normals; None for distances.
    """
    rays, base = camera.rays().flat()[pixels], _FieldBatch((decoder.at(code),))
    shifted = _FieldBatch(tuple(map(decoder.at, code + STEP * torch.cat([directions.T, -directions.T]))))

    def observe(field: _FieldBatch, rays: Rays, distance: Float[Tensor, "codes m"]) -> Float[Tensor, "codes m c"]:
        return distance[..., None] if paint is None else paint(*_hits(field, rays, distance))

    def is_smooth(ahead: Float[Tensor, "codes m c"], behind: Float[Tensor, "codes m c"]) -> Bool[Tensor, " m"]:
        """Whether normals do not jump within the step; those of a ReLU network jump at its kinks."""
        return ((ahead + behind - 2 * base_values).abs() < MAX_SECOND_DIFFERENCE).all(-1).all(0) | (paint is None)

    base_values = observe(base, rays, distance[None])
    roots, converged = _roots(shifted, rays, distance)
    ahead, behind = observe(shifted, rays, roots).chunk(2)
    by_code = (ahead - behind) / (2 * STEP)
    hits = rays.at(distance)
    values = shifted(hits.expand(len(roots), -1, -1)) - decoder.at(code)(hits)
    margin = 4 * values.abs().max()  # in units of the field, as distances of grazing rays change a lot
    valid = converged.all(dim=0) & is_smooth(ahead, behind) & _clear(decoder.at(code), rays, distance, margin=margin)
    by_camera = []
    for twist in STEP * torch.eye(6, dtype=torch.float64):
        both_ends = []
        for sign in (1, -1):
            moved_rays = camera.moved(sign * twist).rays().flat()[pixels]
            roots, converged = _roots(base, moved_rays, distance)
            both_ends.append(observe(base, moved_rays, roots))
            valid &= converged[0]
        by_camera.append((both_ends[0] - both_ends[1])[0] / (2 * STEP))
        valid &= is_smooth(*both_ends)
    texture = None if paint is None else _by_weight(paint, *_hits(base, rays, distance[None]))
    return Differences(by_code.permute(1, 2, 0), torch.stack(by_camera, dim=-1), texture, valid)


def image_differences(
    field_at: Callable[[Tensor], Field],
    directions: Float[Tensor, "code_length directions"],
    *,
    camera: Camera,
    pixels: Int[Tensor, " m"],
    steps: Float[Tensor, " directions"],
    supersampling: int,
    lipschitz: float,
) -> Float[Tensor, "m directions"]:
    """Central differences of a supersampled image of distances, across the silhouette.

    A pixel is the mean distance over supersampling^2 rays: to the surface or, without a hit, to the exit from the unit
    sphere. The visibility gradient is included.

    Args:
        field_at: returns the field at a shift of the code.
        directions: of the code, as unit columns.
        camera: in float64.
        pixels: indices into the flattened image.
        steps: of the differences, see `outline_steps`.
        supersampling: S of S x S rays per pixel; fewer rays mean more noise at a small step.
        lipschitz: Lipschitz constant of the field, for the tracer.
    """
    rays = subrays(camera, pixels, supersampling)
    columns = []
    for direction, step in zip(directions.T, steps.tolist(), strict=True):
        ahead, behind = (
            trace(field_at(sign * step * direction), rays, lipschitz=lipschitz, least_step=1e-3, radius=1.0).distance
            for sign in (1, -1)
        )
        columns.append((ahead - behind).mean(dim=1) / (2 * step))
    return torch.stack(columns, dim=1)


def outline_steps(
    field_at: Callable[[Tensor], Field],
    directions: Float[Tensor, "code_length directions"],
    *,
    camera: Camera,
    pixels: Int[Tensor, " m"],
    shift: float,
    lipschitz: float,
) -> Float[Tensor, " directions"]:
    """The steps along the directions of the code that move the surface by about `shift` pixels.

    Args:
        field_at, directions, camera, pixels, lipschitz: see `image_differences`.
        shift: in pixels; in 90 % of the pixels the surface moves by less.

    Raises:
        ValueError: if no ray through the centre of a pixel hits.
    """
    rays, base_field = camera.rays().flat()[pixels], field_at(torch.zeros_like(directions[:, 0]))
    hits = trace(base_field, rays, lipschitz=lipschitz, least_step=1e-3, radius=1.0)
    if not bool(hits.hit.any()):
        raise ValueError(
            "no pixel of the outline hits at its middle: raise view.resolution, or task.outline of task=gradients"
        )
    points, distance = hits.points[hits.hit], hits.distance[hits.hit]
    slopes = torch.linalg.vector_norm(autograd_gradients(base_field, points), dim=-1)
    footprints = distance / camera.intrinsics[0, 0]
    steps = []
    for direction in directions.T:
        with torch.no_grad():
            ahead, behind = (field_at(sign * STEP * direction)(points) for sign in (1, -1))
        pixel_shifts = (ahead - behind).abs() / (2 * STEP) / slopes / footprints
        steps.append(shift / pixel_shifts.quantile(0.9).clamp_min(1e-12))
    return torch.stack(steps)


def orthogonal_directions(
    length: int, count: int, generator: torch.Generator
) -> Float[Tensor, "code_length directions"]:
    """Random orthogonal directions of a code, as unit columns in float64."""
    return torch.linalg.qr(torch.randn(length, count, generator=generator, dtype=torch.float64)).Q


def near_outline(hit: Bool[Tensor, "height width"], reach: int) -> Bool[Tensor, "height width"]:
    """Rays of an image with both hits and misses among the rays that are at most `reach` rows and columns away."""
    both = torch.stack([hit, ~hit])[:, None].float()
    for size in ((2 * reach + 1, 1), (1, 2 * reach + 1)):  # one dimension after the other takes less time
        both = torch.nn.functional.max_pool2d(both, size, stride=1, padding=(size[0] // 2, size[1] // 2))
    return both.amin(dim=0)[0] > 0


def subrays(camera: Camera, pixels: Int[Tensor, " m"], count: int) -> Rays:
    """The rays [m, count^2] through a regular grid in each of some pixels."""
    fine = camera.resized(camera.height * count, camera.width * count).rays()
    rows, columns = pixels // camera.width, pixels % camera.width
    inner = torch.arange(count)
    down = (rows[:, None] * count + inner)[:, :, None].expand(-1, count, count).reshape(len(pixels), -1)
    across = (columns[:, None] * count + inner)[:, None, :].expand(-1, count, count).reshape(len(pixels), -1)
    return Rays(fine.origins[down, across], fine.directions[down, across])


@dataclass(frozen=True)
class _FieldBatch:
    """Fields of several codes; points [codes, m, 3] have a row per field. Not all networks take batches of codes."""

    fields: tuple[Field, ...]

    def __call__(self, points: Float[Tensor, "codes m 3"]) -> Float[Tensor, "codes m"]:
        return torch.stack([field(batch) for field, batch in zip(self.fields, points, strict=True)])


def _roots(field: _FieldBatch, rays: Rays, start: Float[Tensor, " m"]) -> tuple[Tensor, Tensor]:
    """Roots of a batch of fields along m rays, a row per field, near the roots `start`; and which converged."""

    def values(distance: Tensor) -> Tensor:
        return field(rays.origins + distance[..., None] * rays.directions)

    first = start.expand(len(field.fields), -1)
    second = first + 10 * STEP
    first_value, second_value = values(first), values(second)
    for _ in range(SECANT_STEPS):
        is_done = (second_value == first_value) | (second_value == 0)
        change = torch.where(is_done, 1.0, second_value - first_value)
        third = second - second_value * (second - first) / change
        first, first_value, second = second, second_value, torch.where(is_done, second, third)
        second_value = values(second)
    return second, (second_value.abs() < MAX_RESIDUAL) & ((second - start).abs() < EXCLUDED_BEFORE_HIT)


def _hits(
    field: _FieldBatch, rays: Rays, distance: Float[Tensor, "codes m"]
) -> tuple[Float[Tensor, "codes m 3"], Float[Tensor, "codes m 3"]]:
    """The points at distances along m rays, and the gradients of a batch of fields there."""
    points = rays.origins + distance[..., None] * rays.directions
    return points.detach(), autograd_gradients(cast(Field, field), points)


def _by_weight(
    paint: Paint, points: Float[Tensor, "1 m 3"], normals: Float[Tensor, "1 m 3"]
) -> Float[Tensor, "m 3 weights"]:
    """Central differences of colours with respect to the weights of the paint."""
    columns = []
    for weight in STEP * torch.eye(Paint.size, dtype=torch.float64):
        ahead, behind = (Paint(paint.weights + sign * weight)(points, normals)[0] for sign in (1, -1))
        columns.append((ahead - behind) / (2 * STEP))
    return torch.stack(columns, dim=-1)


def _clear(field: Field, rays: Rays, distance: Float[Tensor, " m"], *, margin: Tensor) -> Bool[Tensor, " m"]:
    """Whether the field stays above `margin` along the ray until shortly before the hit."""
    entry, _, _ = sphere_span(rays)
    samples = equally_spaced(entry, distance - EXCLUDED_BEFORE_HIT, CLEARANCE_SAMPLES)
    return (field(rays.at_each(samples)) > margin).all(dim=1)
