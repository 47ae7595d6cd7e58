"""A mesh in place of the field: marching cubes, exact ray casting, and gradients through the mesh's vertices."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from renderers.camera import Rays, sphere_span
from renderers.checks import check_at_least
from renderers.field import Field, carries_gradient
from renderers.gradients import zero_with_gradient
from renderers.rendering import LEVEL_SET_CAPABILITIES, NON_FINITE_VALUE, Capabilities, Rendering, Status, assemble
from renderers.silhouette import SurfaceRenderer
from renderers.tracing.bracket import SAMPLES_PER_BATCH, equally_spaced

MIN_COSINE = 1e-3  # between a ray and a triangle's normal: gradients are divided by the cosine, but at least by this


@dataclass(frozen=True)
class MeshProxy(SurfaceRenderer):
    """Marching cubes in each rendering; a ray's hit is where it crosses a triangle.

    Source: MeshSDF (Remelli et al. 2020, arXiv 2006.03997), Theorem 1: a vertex moves by -n / |grad f| times the change
        of the field there; marching cubes (Lewiner et al. 2003) of scikit-image, ray casting of Open3D.
    Differentiable in: field parameters, through the vertices of the triangles that are hit; rays, on these triangles'
        planes. The gradient of `distance` lacks the visibility gradient; the mask loss (IDR's) has it.
    Needs: any level set. Parts thinner than the grid's spacing may be missed, and edges are cut off by as much.
    Deviates from the paper: each rendering has a new grid, not refined; triangles are ray cast, not rasterised.

    Args:
        grid: samples on each side of the cube about the sphere.
        ray_samples: samples of the grid's values along a ray without a hit, to find its closest point.
        least_slope: minimum length of the field's gradient at a vertex, in field units per scene unit.
        mask_sharpness, mask_weight, sphere_radius: see `silhouette.SurfaceRenderer`.
    """

    grid: int
    ray_samples: int

    capabilities: ClassVar[Capabilities] = LEVEL_SET_CAPABILITIES

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least("grid", self.grid, 4, "96 has cells of .02 scene units")
        check_at_least("ray_samples", self.ray_samples, 2, "64 are a sample a cell and a half")

    @property
    def accuracy(self) -> float:
        """The error of a hit times the cosine of its incidence, in scene units: the grid's spacing; for tests."""
        return 2 * self.sphere_radius / (self.grid - 1)

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Makes the mesh without a graph, casts the rays, then attaches the gradient of the triangles."""
        flat = rays.flat()
        entry, leave, intersects = (tensor.detach() for tensor in sphere_span(flat, self.sphere_radius))
        queried = intersects.nonzero().squeeze(-1)
        with torch.no_grad():
            values = self._values(field, flat.origins)
            first = torch.zeros_like(entry).index_put((queried,), field(flat[queried].at(entry[queried])))
            inside = intersects & (first < 0)
            mesh = _Mesh.of(values, self.sphere_radius)
            mesh_distance, triangle = mesh.cast(flat, entry)
            hit = (intersects & ~inside & (triangle >= 0) & (mesh_distance < leave)).nonzero().squeeze(-1)
            closest = self._closest(values, flat[queried], entry[queried], leave[queried])
        hit_distance = self._intersect_planes(field, flat[hit], mesh, triangle[hit], mesh_distance[hit])
        distance = entry.index_put((hit,), hit_distance)
        closest = entry.index_put((queried,), closest).index_put((hit,), hit_distance.detach())
        least = field(flat[queried].at(closest[queried]))
        status = torch.full_like(intersects, Status.MISS, dtype=torch.int8)
        status[inside], status[hit] = Status.STARTED_INSIDE, Status.HIT
        return assemble(
            rays,
            self.sphere_radius,
            distance=torch.where(status == Status.MISS, leave, distance),
            status=status,
            residual=torch.zeros_like(entry).index_put((queried,), least.detach()),
            closest=(queried, least),
        )

    def _values(self, field: Field, like: Tensor) -> Float[Tensor, "side side side"]:
        """The field on the grid, indexed by x, y, z."""
        axis = torch.linspace(-self.sphere_radius, self.sphere_radius, self.grid, dtype=like.dtype, device=like.device)
        points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
        values = torch.cat([field(plane.view(-1, 3)) for plane in points])
        return torch.where(values.isfinite(), values, NON_FINITE_VALUE).view(points.shape[:-1])

    def _closest(self, values: Tensor, rays: Rays, entry: Tensor, leave: Tensor) -> Float[Tensor, " n"]:
        """The distance along each ray at which the grid's values have the smallest magnitude."""
        batches = torch.arange(len(entry), device=entry.device).split(SAMPLES_PER_BATCH // self.ray_samples)
        return torch.cat([self._closest_in(values, rays[batch], entry[batch], leave[batch]) for batch in batches])

    def _closest_in(self, values: Tensor, rays: Rays, entry: Tensor, leave: Tensor) -> Float[Tensor, " n"]:
        distance = equally_spaced(entry, leave, self.ray_samples)
        points = rays.at_each(distance).view(1, -1, 1, 1, 3).flip(-1) / self.sphere_radius  # grid_sample takes z first
        sampled = torch.nn.functional.grid_sample(values[None, None], points, align_corners=True, padding_mode="border")
        index = sampled.view(distance.shape).abs().argmin(dim=1, keepdim=True)
        return distance.gather(1, index).squeeze(1)

    def _intersect_planes(
        self, field: Field, rays: Rays, mesh: "_Mesh", triangle: Int[Tensor, " n"], distance: Float[Tensor, " n"]
    ) -> Float[Tensor, " n"]:
        """The distances at which rays cross triangles, with the derivative of the planes, which move with the field."""
        used, corner = mesh.triangles[triangle].unique(return_inverse=True)
        vertices = self._attach_vertex_gradient(field, mesh.vertices[used])
        first, second, third = vertices[corner].unbind(dim=1)
        normal = torch.linalg.cross(second - first, third - first)
        normal = normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True).clamp_min(
            torch.finfo(normal.dtype).tiny
        )
        cosine = (normal * rays.directions).sum(-1)
        cosine = torch.where(cosine < 0, cosine.clamp_max(-MIN_COSINE), cosine.clamp_min(MIN_COSINE))
        change = ((first - rays.at(distance)) * normal).sum(-1)
        return distance + (change - change.detach()) / cosine

    def _attach_vertex_gradient(self, field: Field, vertices: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """The vertices, with the derivative of Theorem 1 of MeshSDF."""
        if not (torch.is_grad_enabled() and carries_gradient(field, vertices)):
            return vertices
        with torch.enable_grad():
            leaf = vertices.detach().requires_grad_(True)
            value = field(leaf)
            (gradient,) = torch.autograd.grad(value.sum(), leaf, retain_graph=True)
        gradient = gradient.nan_to_num(0.0)
        square = gradient.square().sum(-1, keepdim=True).clamp_min(self.least_slope**2)
        return vertices - zero_with_gradient(value)[:, None] * gradient / square


@dataclass(frozen=True)
class _Mesh:
    vertices: Float[Tensor, "vertices 3"]
    triangles: Int[Tensor, "triangles 3"]

    @staticmethod
    def of(values: Float[Tensor, "side side side"], radius: float) -> "_Mesh":
        """The zero set of values on a grid; without triangles if all values have one sign."""
        if not float(values.min()) < 0 < float(values.max()):
            return _Mesh(values.new_zeros(0, 3), torch.zeros(0, 3, dtype=torch.int64, device=values.device))
        from skimage.measure import marching_cubes  # here and in `cast`, as these imports take more than a second

        spacing = 2 * radius / (len(values) - 1)
        vertices, triangles, _, _ = marching_cubes(values.cpu().numpy(), 0.0, spacing=(spacing,) * 3)
        return _Mesh(
            torch.from_numpy(vertices.copy()).to(values) - radius,
            torch.from_numpy(triangles.astype(np.int64)).to(values.device),
        )

    def cast(self, rays: Rays, start: Float[Tensor, " n"]) -> tuple[Float[Tensor, " n"], Int[Tensor, " n"]]:
        """The distance of each ray's first crossing after `start`, or infinity, and its triangle, or -1."""
        if not len(self.triangles) or not len(start):
            return torch.full_like(start, torch.inf), torch.full_like(start, -1, dtype=torch.int64)
        import open3d

        scene = open3d.t.geometry.RaycastingScene()
        scene.add_triangles(
            open3d.core.Tensor.from_numpy(self.vertices.cpu().float().numpy()),
            open3d.core.Tensor.from_numpy(self.triangles.cpu().numpy().astype(np.uint32)),
        )
        table = torch.cat([rays.at(start), rays.directions], dim=-1).detach().cpu().float().numpy()
        hits = scene.cast_rays(open3d.core.Tensor.from_numpy(np.ascontiguousarray(table)))
        distance = start + torch.from_numpy(hits["t_hit"].numpy()).to(start)
        triangle = torch.from_numpy(hits["primitive_ids"].numpy().astype(np.int64)).to(start.device)
        return distance, torch.where(distance.isfinite(), triangle, -1)
