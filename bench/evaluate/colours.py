"""The colours of a field where a view meets its surface."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from datasets.mesh import Mesh
from datasets.scene import Truth, View
from renderers.camera import Camera
from renderers.field import autograd_gradients
from renderers.fields.coloured import Coloured

GREY = 0.5  # of a mesh without colours
CHUNK = 16_384  # points at once


def coloured_image(field: Coloured, view: View, device: torch.device) -> Float[Tensor, "height width 3"]:
    """The field's colours where a view meets a surface; black elsewhere."""
    image = torch.zeros(*view.mask.shape, 3)
    rays = view.camera.rays()[view.mask]
    points = rays.at(view.camera.distance(view.depth)[view.mask])
    image[view.mask] = colours_at(field, points, rays.directions, device)
    return image


def painted(mesh: Mesh, truth: Truth, camera: Camera) -> Float[np.ndarray, "height width 3"]:
    """The colours of a mesh's vertices, interpolated over its faces; grey without colours, black outside of it.

    Args:
        mesh: with or without colours.
        truth: of the same mesh.
        camera: that sees it.
    """
    colours = np.full_like(mesh.vertices, GREY) if mesh.colours is None else mesh.colours
    rays = camera.rays()
    weights, corners = truth.corners(rays.flat().origins.double().numpy(), rays.flat().directions.double().numpy())
    return np.einsum("nk,nkd->nd", weights, colours[corners]).reshape(*rays.shape, 3).clip(0, 1)


def vertex_colours(field: Coloured, mesh: Mesh, device: torch.device) -> Float[np.ndarray, "v 3"]:
    """The colours of a mesh's vertices, each seen from straight above."""
    return colours_at(field, torch.from_numpy(mesh.vertices).float(), None, device).numpy()


def colours_at(
    field: Coloured, points: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"] | None, device: torch.device
) -> Float[Tensor, "n 3"]:
    """The colours of points of the surface, on the CPU; without directions each is seen from straight above."""
    found = [points.new_zeros(0, 3)]
    for start in range(0, len(points), CHUNK):
        some = points[start : start + CHUNK].to(device)
        slopes = autograd_gradients(field, some)
        above = -torch.nn.functional.normalize(slopes, dim=-1)
        towards = above if directions is None else directions[start : start + CHUNK].to(device)
        with torch.no_grad():
            found.append(field.colours(some, slopes, towards).cpu())
    return torch.cat(found)
