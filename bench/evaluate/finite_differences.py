"""Derivatives of distance towards code and camera by central differences in float64: the truth for gradients."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderers.camera import Camera, Rays, sphere_span
from renderers.field import Field, autograd_gradients
from renderers.fields.mlp import BoundDecoder, Decoder
from renderers.reference import trace

NEURONS = 16  # of the paint
JUMP = 1e-9  # of a colour within a step: smooth ones have a second difference of about 1e-12
STEP = 1e-6  # of a central difference, in units of the parameter: a network has few kinks within so short a step
ROOT_STEPS = 6  # of the secant method, from the undisturbed root
RESIDUAL = 1e-12  # |field| above which the secant method has not converged
CLEAR = 1e-3  # scene units before the hit within which the ray may be near the surface
BEFORE = 256  # samples of the ray up to there


@dataclass(frozen=True)
class Differences:
    """Derivatives of the distance along m rays, and where they hold: where visibility does not change."""

    code: Float[Tensor, "m directions"]
    camera: Float[Tensor, "m 6"]
    valid: Bool[Tensor, " m"]


def differences(
    decoder: Decoder,
    code: Float[Tensor, " code_length"],
    directions: Float[Tensor, "code_length directions"],
    *,
    camera: Camera,
    pixels: Int[Tensor, " m"],
    distance: Float[Tensor, " m"],
) -> Differences:
    """Central differences of the distance to the surface that the rays of some pixels hit.

    Args:
        decoder, code: in float64.
        directions: of the code, as unit columns.
        camera: in float64; its six derivatives are towards `Camera.moved`'s twist.
        pixels: indices into the flattened image.
        distance: to the hits.
    """
    rays = camera.rays().flat()[pixels]
    with torch.no_grad():
        shifts = STEP * torch.cat([directions.T, -directions.T])
        moved, found = _roots(decoder.at(code + shifts), rays, distance)
        by_code = ((moved[: len(shifts) // 2] - moved[len(shifts) // 2 :]) / (2 * STEP)).T
        hits = rays.at(distance)
        change = decoder.at(code + shifts)(hits.expand(len(shifts), -1, -1)) - decoder.at(code)(hits)
        margin = 4 * change.abs().max()  # of the field, not of the distance, which moves far near grazing
        valid = found.all(dim=0) & _clear(decoder.at(code), rays, distance, margin=margin)
        columns = []
        for twist in STEP * torch.eye(6, dtype=torch.float64):
            (ahead, ok), (behind, ok_too) = (
                _roots(decoder.at(code[None]), camera.moved(sign * twist).rays().flat()[pixels], distance)
                for sign in (1, -1)
            )
            columns.append((ahead - behind)[0] / (2 * STEP))
            valid &= ok[0] & ok_too[0]
    return Differences(by_code, torch.stack(columns, dim=1), valid)


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
class ColourDifferences:
    """Derivatives of the three colours of m pixels, a row for each, and which pixels they hold for."""

    code: Float[Tensor, "m 3 directions"]
    camera: Float[Tensor, "m 3 6"]
    texture: Float[Tensor, "m 3 weights"]
    valid: Bool[Tensor, " m"]


def colour_differences(
    decoder: Decoder,
    code: Float[Tensor, " code_length"],
    directions: Float[Tensor, "code_length directions"],
    paint: Paint,
    *,
    camera: Camera,
    pixels: Int[Tensor, " m"],
    distance: Float[Tensor, " m"],
) -> ColourDifferences:
    """Central differences of the colours at the hits, which move and turn with the code and the camera.

    Args:
        decoder, code, directions, camera, pixels, distance: see `differences`.
        paint: of the surface.
    """
    rays = camera.rays().flat()[pixels]
    truth = differences(decoder, code, directions, camera=camera, pixels=pixels, distance=distance)
    shifts = STEP * torch.cat([directions.T, -directions.T])
    moved, _ = _roots(decoder.at(code + shifts), rays, distance)
    seen = paint(*_hits(decoder.at(code + shifts), rays, moved))
    hits = _hits(decoder.at(code[None]), rays, distance[None])
    here = paint(*hits)
    ahead, behind = seen[: len(shifts) // 2], seen[len(shifts) // 2 :]
    by_code, smooth = (ahead - behind) / (2 * STEP), _smooth(ahead, here, behind)
    by_camera = []
    for twist in STEP * torch.eye(6, dtype=torch.float64):
        ends = []
        for sign in (1, -1):
            turned = camera.moved(sign * twist).rays().flat()[pixels]
            found, _ = _roots(decoder.at(code[None]), turned, distance)
            ends.append(paint(*_hits(decoder.at(code[None]), turned, found))[0])
        by_camera.append((ends[0] - ends[1]) / (2 * STEP))
        smooth &= _smooth(ends[0][None], here, ends[1][None])
    by_weight = []
    for weight in STEP * torch.eye(Paint.size, dtype=torch.float64):
        ends = [Paint(paint.weights + sign * weight)(*hits)[0] for sign in (1, -1)]
        by_weight.append((ends[0] - ends[1]) / (2 * STEP))
    columns = (by_code.permute(1, 2, 0), *(torch.stack(by, dim=-1) for by in (by_camera, by_weight)))
    return ColourDifferences(*columns, truth.valid & smooth)


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


def _roots(field: BoundDecoder, rays: Rays, start: Float[Tensor, " m"]) -> tuple[Tensor, Tensor]:
    """Roots of a batch of fields, a row each, along m rays near known roots; and which of them were found."""

    def values(distance: Tensor) -> Tensor:
        return field(rays.origins + distance[..., None] * rays.directions)

    codes = len(field.hidden[0][1])
    first = start.expand(codes, -1)
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
    field: BoundDecoder, rays: Rays, distance: Float[Tensor, "codes m"]
) -> tuple[Float[Tensor, "codes m 3"], Float[Tensor, "codes m 3"]]:
    """The points at distances along m rays, and the gradients there of a batch of fields."""
    points = rays.origins + distance[..., None] * rays.directions
    return points.detach(), autograd_gradients(field, points)


def _smooth(
    ahead: Float[Tensor, "codes m 3"], here: Float[Tensor, "1 m 3"], behind: Float[Tensor, "codes m 3"]
) -> Bool[Tensor, " m"]:
    """Which pixels' normals do not jump within the step, as those of a network of ReLUs do at its kinks."""
    return ((ahead + behind - 2 * here).abs() < JUMP).all(-1).all(0)


def _clear(field: BoundDecoder, rays: Rays, distance: Float[Tensor, " m"], *, margin: Tensor) -> Bool[Tensor, " m"]:
    """Whether the field stays above a margin along the ray up to the hit."""
    entry, _, _ = sphere_span(rays)
    shares = torch.linspace(0, 1, BEFORE, dtype=distance.dtype)
    along = entry[:, None] + shares * (distance - CLEAR - entry)[:, None]
    values = field(rays.origins[:, None] + along[..., None] * rays.directions[:, None])
    return (values > margin).all(dim=1)
