"""Sphere tracing with the gradient of the silhouette from points on the outline (IRON, CVPR 2022)."""

from dataclasses import dataclass, replace
from math import isqrt

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from renderers.camera import Rays, sphere_span
from renderers.checks import check_at_least, check_positive
from renderers.field import Field, values_and_gradients
from renderers.gradients import implicit_rendering
from renderers.later.relaxed_boundary import march_past_near_misses
from renderers.rendering import Rendering, Status, Volume, check_kind
from renderers.silhouette import SurfaceRenderer

STEPS_TO_CLOSEST_POINT = 4  # along the ray, from a near miss
# Of the way from a near miss to its edge point: on a sharp edge itself, derivatives are those of one face alone.
APPROACH = 0.95


@dataclass(frozen=True)
class EdgeSampling(SurfaceRenderer):
    """Sphere tracing that splits the pixels on the outline.

    The outline next to a ray is the line through an edge point, a point of the surface whose normal is perpendicular to
    the ray. A ray that misses reaches it from its near miss, the first local minimum of the field within a pixel. A ray
    that hits takes the line of a neighbour that misses. A pixel is covered by 1/2 minus its centre's distance from the
    line over the pixel's width. The derivative of this distance is that of the edge point along its normal. With
    several rays per pixel, the cell of each ray is split as a pixel is, wherever the ray is in it (`Rays.cells`).

    Source: IRON (Zhang et al. 2022, arXiv 2204.02232), Sec. 3.3: edge points, and pixels that they split.
    Differentiable in: field parameters and rays. Hits by the implicit rule, exactly, up to `epsilon`. In images and
        with cells, the derivative of a silhouette's area has no bias from a band, except where the outline bends, or
        two parts of it lie, within a cell.
    Needs: a distance or a bound inside the sphere; near misses are searched within a cell's width, or two
        if rays are not through centres, in field units.
    Deviates from the paper: an edge point is projected from a near miss, not walked to along the surface; neighbours
        share it; the split does not depend on the outline's direction in the pixel; only the first surface within a
        pixel counts. Rays without an image or cells have no neighbours: a near miss within `width` has the weight 0,
        and the derivative as in `RelaxedBoundary`, at the edge point. The mask loss is IDR's.

    Args:
        steps: maximum marching steps per ray.
        epsilon: a ray has converged if the field's magnitude is below this, in scene units.
        width: of the band of rays without an image or cells, in field units.
        least_slope, mask_sharpness, mask_weight, sphere_radius: see `silhouette.SurfaceRenderer`.
    """

    steps: int
    epsilon: float
    width: float

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least("steps", self.steps, 1, "400 converges, also next to an outline")
        check_positive("epsilon", self.epsilon, "5e-5 is a four-hundredth of a pixel at 64 x 64")
        check_positive("width", self.width, "0.01 is a third of a pixel at 64 x 64")

    @property
    def blur(self) -> float:
        """The width, in scene units if the field is a distance; images and cells have no blur, except the cells."""
        return self.width

    def with_blur(self, blur: float) -> "EdgeSampling":
        return replace(self, width=blur)

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Marches without a graph, then attaches the gradients of hits and of edge points."""
        check_kind(self, field)
        flat, cells = rays.flat(), CellGrid.of(rays)
        with torch.no_grad():
            band = self.width if cells is None else cells.reach(sphere_span(flat, self.sphere_radius)[1])
            front, near_distance, near_value = march_past_near_misses(self, field, flat, band)
        rendering = implicit_rendering(field, rays, front, least_slope=self.least_slope, radius=self.sphere_radius)
        near = near_value.isfinite().nonzero().squeeze(-1)
        lines = OutlineLines.next_to(field, flat[near], near_distance[near])
        is_valid = lines.gap.detach().isfinite()
        near, lines = near[is_valid], lines.select(is_valid)
        hit, distance = front.status == Status.HIT, rendering.distance.view(-1)
        hit_weight = torch.ones_like(distance)
        if cells is None:
            band_gap = self.width * lines.gap.detach() / near_value[near]  # the width in scene units
            weight, split = (lines.gap.detach() - lines.gap) / band_gap, torch.ones_like(near).bool()
        else:
            weight = cells.covered_share(near, lines)
            split = weight.detach() > 0
        outer, outer_weight = near[split], weight[split]
        hit_weight = hit_weight.index_put((outer,), 1 - outer_weight)
        samples = [(outer, lines.distance[split], outer_weight)]
        if cells is not None:
            line, inner, inner_weight = cells.hits_beside(lines, near, hit & (hit_weight == 1))
            hit_weight = hit_weight.index_put((inner,), inner_weight)
            has_behind = hit[near[line]]
            behind = distance[near[line[has_behind]]]
            samples.append((inner[has_behind], behind, 1 - inner_weight[has_behind]))
        hits = hit.nonzero().squeeze(-1)
        samples.append((hits, distance[hits], hit_weight[hits]))
        return replace(rendering, volume=Volume(*map(torch.cat, zip(*samples, strict=True))))


@dataclass(frozen=True)
class OutlineLines:
    """The outline next to m rays that miss.

    Args:
        distance, points: of the near misses, along the rays and in space.
        normal: unit, perpendicular to the ray, away from the surface.
        gap: distance of the near miss from the outline, in scene units; the derivative is that of outline and ray.
    """

    distance: Float[Tensor, " m"]
    points: Float[Tensor, "m 3"]
    normal: Float[Tensor, "m 3"]
    gap: Float[Tensor, " m"]

    @staticmethod
    def next_to(field: Field, rays: Rays, distance: Float[Tensor, " m"]) -> "OutlineLines":
        """The lines through the edge points of near misses at distances along m rays."""
        direction = rays.directions.detach()
        for _ in range(STEPS_TO_CLOSEST_POINT):
            distance = distance + (_towards_surface(field, rays.at(distance)) * direction).sum(-1)
        points = rays.at(distance)
        approached = points.detach() + APPROACH * _towards_surface(field, points)
        value, gradient = values_and_gradients(field, approached)
        slope = torch.linalg.vector_norm(gradient, dim=-1)
        normal = normalize(gradient - (gradient * direction).sum(-1, keepdim=True) * direction, dim=-1)
        value = field(approached) if torch.is_grad_enabled() else value
        gap = (normal * (points - approached)).sum(-1) + value / slope
        return OutlineLines(distance, points, normal, gap)

    def select(self, index: Bool[Tensor, " m"] | Int[Tensor, " k"]) -> "OutlineLines":
        """The lines at `index`."""
        return OutlineLines(self.distance[index], self.points[index], self.normal[index], self.gap[index])


def _towards_surface(field: Field, points: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
    """The Newton step to the surface, without a graph."""
    value, gradient = values_and_gradients(field, points)
    return -(value / gradient.square().sum(-1))[:, None] * gradient


@dataclass(frozen=True)
class CellGrid:
    """The cells of n flattened rays: the pixels of an image, or the parts of its pixels in `Rays.cells`.

    Args:
        centres: the rays through the centres of the cells.
        through_centres: whether these are the rays themselves.
        steps: from a centre to the next one, to the right and down, of origins and directions.
        pairs: the indices of two neighbours, in both orders.
    """

    centres: Rays
    through_centres: bool
    steps: Float[Tensor, "2 2 n 3"]
    pairs: Int[Tensor, "2 p"]

    @staticmethod
    def of(rays: Rays) -> "CellGrid | None":
        """The grid of an image or of `Rays.cells`; None for other rays, and for a single row or column."""
        image = rays if rays.image else rays.cells
        if image is None or min(image.shape[-2:]) < 2 or not image.shape.numel():
            return None
        index = torch.arange(image.shape.numel(), device=rays.origins.device)
        if rays.image:
            index = index.view(rays.shape)
        else:  # from [*batch, height, width, column, row] in a pixel
            side = isqrt(rays.shape[-1])
            index = index.view(*rays.shape[:-1], side, side).movedim(-1, -3).reshape(image.shape)
        order = index.flatten().argsort()
        vectors = [tensor.detach() for tensor in (image.origins, image.directions)]
        steps = [_step(tensor, dim).reshape(-1, 3)[order] for dim in (-2, -3) for tensor in vectors]
        first = torch.cat([index[..., 1:].flatten(), index[..., 1:, :].flatten()])
        second = torch.cat([index[..., :-1].flatten(), index[..., :-1, :].flatten()])
        if not rays.image:  # a line may cross a cell and yet leave the rays of its four neighbours on one side
            first = torch.cat([first, index[..., 1:, 1:].flatten(), index[..., 1:, :-1].flatten()])
            second = torch.cat([second, index[..., :-1, :-1].flatten(), index[..., :-1, 1:].flatten()])
        pairs = torch.stack([torch.cat([first, second]), torch.cat([second, first])])
        return CellGrid(image.flat()[order], rays.image, torch.stack(steps).unflatten(0, (2, 2)), pairs)

    def reach(self, distance: Float[Tensor, " n"]) -> Float[Tensor, ""]:
        """The largest distance from a ray to an outline that can split its cell or a neighbour's, in scene units.

        It is a cell's longer side, at a distance along the ray, or twice that if the ray is anywhere in its cell.
        """
        widths = torch.linalg.vector_norm(self.steps[:, 0] + distance[:, None] * self.steps[:, 1], dim=-1)
        return (1 if self.through_centres else 2) * widths.max()

    def covered_share(self, ray: Int[Tensor, " m"], lines: OutlineLines) -> Float[Tensor, " m"]:
        """The share of each ray's cell inside of its line, from 0 to 1.

        Of all cells in an image's row or column that the line crosses, exactly one has its centre within half of the
        step to the next centre.
        """
        steps = self.steps[:, 0, ray] + lines.distance[:, None] * self.steps[:, 1, ray]
        spacing = (steps * lines.normal).sum(-1).abs().amax(dim=0)
        to_centre = self.centres[ray].at(lines.distance) - lines.points
        return (0.5 - (lines.gap + (lines.normal * to_centre).sum(-1)) / spacing).clamp(0, 1)

    def hits_beside(
        self,
        lines: OutlineLines,
        near: Int[Tensor, " m"],
        is_candidate: Bool[Tensor, " n"],
    ) -> tuple[Int[Tensor, " k"], Int[Tensor, " k"], Float[Tensor, " k"]]:
        """Candidates whose cell is split by the line of a neighbour, the nearest one: line, ray, and covered share."""
        row = torch.full_like(is_candidate, -1, dtype=near.dtype).index_put(
            (near,), torch.arange(len(near), device=near.device, dtype=near.dtype)
        )
        inside, outside = self.pairs
        used = is_candidate[inside] & (row[outside] >= 0)
        ray, line = inside[used], row[outside[used]]
        weight = self.covered_share(ray, lines.select(line))
        order = weight.detach().argsort(stable=True)
        order = order[(weight.detach()[order] > (0.5 if self.through_centres else 0)) & (weight.detach()[order] < 1)]
        rank = torch.arange(len(order), device=order.device)
        first = torch.full_like(row, len(order)).scatter_reduce(0, ray[order], rank, "amin")
        chosen = order[first[first < len(order)]]
        return line[chosen], ray[chosen], weight[chosen]


def _step(vectors: Float[Tensor, "*image 3"], dim: int) -> Float[Tensor, "*image 3"]:
    """The differences to the next vectors along a dimension; the last one is repeated."""
    steps = vectors.diff(dim=dim)
    return torch.cat([steps, steps.narrow(dim, -1, 1)], dim=dim)
