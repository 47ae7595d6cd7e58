"""Derivatives of distance towards code and camera by central differences in float64: the truth for gradients."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderers.bracket import equally_spaced
from renderers.camera import Camera, Rays, sphere_span
from renderers.field import Field, autograd_gradients
from renderers.fields.mlp import Decoder
from renderers.fields.network import Published
from renderers.reference import trace

NEURONS = 16  # of the paint
JUMP = 1e-9  # of a colour within a step: smooth ones have a second difference of about 1e-12
STEP = 1e-6  # of a central difference, in units of the parameter: a network has few kinks within so short a step
ROOT_STEPS = 6  # of the secant method, from the undisturbed root
RESIDUAL = 1e-12  # |field| above which the secant method has not converged
CLEAR = 1e-3  # scene units before the hit within which the ray may be near the surface
BEFORE = 256  # samples of the ray up to there


@dataclass(frozen=True)
class Paint:
    """Smooth colours of points and normals, of a small network with given weights, in float64.

    Args:
        weights: all of them in one row, see `size`.
    """

    weights: Float[Tensor, " n"]

    size: ClassVar[int] = (6 + 3) * NEURONS

    @staticmethod
    def drawn(generator: torch.Generator) -> "Paint":
        """Random colours that change over a fraction of a unit."""
        return Paint(torch.randn(Paint.size, generator=generator, dtype=torch.float64))

    def __call__(
        self, points: Float[Tensor, "*batch 3"], normals: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch 3"]:
        first, second = self.weights.split([6 * NEURONS, 3 * NEURONS])
        hidden = torch.sin(torch.cat([points, normals], dim=-1) @ first.view(6, NEURONS))
        return torch.sigmoid(hidden @ second.view(NEURONS, 3))


@dataclass(frozen=True)
class Differences:
    """Derivatives of what m pixels see, a distance or three colours, and where they hold.

    They hold where visibility does not change and, of colours, where normals do not jump.
    """

    code: Float[Tensor, "m seen directions"]
    camera: Float[Tensor, "m seen 6"]
    texture: Float[Tensor, "m seen weights"] | None
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
    """Central differences of the distance to the surface that the rays of some pixels hit, or of the colours there.

    Args:
        decoder, code: in float64.
        directions: of the code, as unit columns.
        camera: in float64; its six derivatives are towards `Camera.moved`'s twist.
        pixels: indices into the flattened image.
        distance: to the hits.
        paint: of the surface, whose colours move and turn with the code and the camera; None for distances.
    """
    rays, still = camera.rays().flat()[pixels], _Row((decoder.at(code),))
    moved = _Row(tuple(map(decoder.at, code + STEP * torch.cat([directions.T, -directions.T]))))

    def seen(field: _Row, rays: Rays, distance: Float[Tensor, "codes m"]) -> Float[Tensor, "codes m seen"]:
        return distance[..., None] if paint is None else paint(*_hits(field, rays, distance))

    def smooth(ahead: Float[Tensor, "codes m seen"], behind: Float[Tensor, "codes m seen"]) -> Bool[Tensor, " m"]:
        """Which normals do not jump within the step, as those of a network of ReLUs do at its kinks."""
        return ((ahead + behind - 2 * here).abs() < JUMP).all(-1).all(0) | (paint is None)

    here = seen(still, rays, distance[None])
    roots, found = _roots(moved, rays, distance)
    ahead, behind = seen(moved, rays, roots).chunk(2)
    by_code = (ahead - behind) / (2 * STEP)
    hits = rays.at(distance)
    change = moved(hits.expand(len(roots), -1, -1)) - decoder.at(code)(hits)
    margin = 4 * change.abs().max()  # of the field, not of the distance, which moves far near grazing
    valid = found.all(dim=0) & smooth(ahead, behind) & _clear(decoder.at(code), rays, distance, margin=margin)
    by_camera = []
    for twist in STEP * torch.eye(6, dtype=torch.float64):
        ends = []
        for sign in (1, -1):
            turned = camera.moved(sign * twist).rays().flat()[pixels]
            roots, found = _roots(still, turned, distance)
            ends.append(seen(still, turned, roots))
            valid &= found[0]
        by_camera.append((ends[0] - ends[1])[0] / (2 * STEP))
        valid &= smooth(*ends)
    texture = None if paint is None else _by_weight(paint, *_hits(still, rays, distance[None]))
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

    A pixel is the mean over supersampling^2 rays of the distance to the surface or, without a hit, to where the ray
    leaves the unit sphere. What comes into view or leaves it counts here.

    Args:
        field_at: the field at a shift of the code.
        directions: of the code, as unit columns.
        camera: in float64.
        pixels: indices into the flattened image.
        steps: of the differences, see `outline_steps`.
        supersampling: S of S x S rays per pixel; the fewer, the larger the noise of a small step.
        lipschitz: bound on the gradient of the field, for the tracer.
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
    """The step along each direction of the code that moves the surface of most of some pixels by `shift` pixels.

    Args:
        field_at, directions, camera, pixels, lipschitz: see `image_differences`.
        shift: in pixels; for nine pixels in ten the surface moves by less.

    Raises:
        ValueError: where no ray through the middle of a pixel hits.
    """
    rays, still = camera.rays().flat()[pixels], field_at(torch.zeros_like(directions[:, 0]))
    hits = trace(still, rays, lipschitz=lipschitz, least_step=1e-3, radius=1.0)
    if not bool(hits.hit.any()):
        raise ValueError("no pixel of the outline hits at its middle: draw more by task.outline")
    points, distance = hits.points[hits.hit], hits.distance[hits.hit]
    slopes = torch.linalg.vector_norm(autograd_gradients(still, points), dim=-1)
    footprints = distance / camera.intrinsics[0, 0]
    found = []
    for direction in directions.T:
        with torch.no_grad():
            ahead, behind = (field_at(sign * STEP * direction)(points) for sign in (1, -1))
        moved = (ahead - behind).abs() / (2 * STEP) / slopes / footprints
        found.append(shift / moved.quantile(0.9).clamp_min(1e-12))
    return torch.stack(found)


def subrays(camera: Camera, pixels: Int[Tensor, " m"], count: int) -> Rays:
    """The rays [m, count^2] through a regular grid in each of some pixels."""
    fine = camera.resized(camera.height * count, camera.width * count).rays()
    rows, columns = pixels // camera.width, pixels % camera.width
    inner = torch.arange(count)
    down = (rows[:, None] * count + inner)[:, :, None].expand(-1, count, count).reshape(len(pixels), -1)
    across = (columns[:, None] * count + inner)[:, None, :].expand(-1, count, count).reshape(len(pixels), -1)
    return Rays(fine.origins[down, across], fine.directions[down, across])


@dataclass(frozen=True)
class _Row:
    """Fields of several codes, of points [codes, m, 3] a row each; not all networks take codes by the batch."""

    fields: tuple[Field, ...]

    def __call__(self, points: Float[Tensor, "codes m 3"]) -> Float[Tensor, "codes m"]:
        return torch.stack([field(some) for field, some in zip(self.fields, points, strict=True)])


def _roots(field: _Row, rays: Rays, start: Float[Tensor, " m"]) -> tuple[Tensor, Tensor]:
    """Roots of a batch of fields, a row each, along m rays near known roots; and which of them were found."""

    def values(distance: Tensor) -> Tensor:
        return field(rays.origins + distance[..., None] * rays.directions)

    first = start.expand(len(field.fields), -1)
    second = first + 10 * STEP
    first_value, second_value = values(first), values(second)
    for _ in range(ROOT_STEPS):
        still = (second_value == first_value) | (second_value == 0)
        change = torch.where(still, 1.0, second_value - first_value)
        third = second - second_value * (second - first) / change
        first, first_value, second = second, second_value, torch.where(still, second, third)
        second_value = values(second)
    return second, (second_value.abs() < RESIDUAL) & ((second - start).abs() < CLEAR)


def _hits(
    field: _Row, rays: Rays, distance: Float[Tensor, "codes m"]
) -> tuple[Float[Tensor, "codes m 3"], Float[Tensor, "codes m 3"]]:
    """The points at distances along m rays, and the gradients there of a batch of fields."""
    points = rays.origins + distance[..., None] * rays.directions
    return points.detach(), autograd_gradients(cast(Field, field), points)


def _by_weight(
    paint: Paint, points: Float[Tensor, "1 m 3"], normals: Float[Tensor, "1 m 3"]
) -> Float[Tensor, "m 3 weights"]:
    """Central differences of colours towards the weights of the paint."""
    columns = []
    for weight in STEP * torch.eye(Paint.size, dtype=torch.float64):
        ahead, behind = (Paint(paint.weights + sign * weight)(points, normals)[0] for sign in (1, -1))
        columns.append((ahead - behind) / (2 * STEP))
    return torch.stack(columns, dim=-1)


def _clear(field: Field, rays: Rays, distance: Float[Tensor, " m"], *, margin: Tensor) -> Bool[Tensor, " m"]:
    """Whether the field stays above a margin along the ray up to the hit."""
    entry, _, _ = sphere_span(rays)
    return (field(rays.at_each(equally_spaced(entry, distance - CLEAR, BEFORE))) > margin).all(dim=1)
