"""Float64 renderings of a network in a view, cached by a hash of weights and camera."""

import hashlib
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.progress import notice
from bench.records.record import digest
from bench.shape_prior import Prior, load_or_make
from renderers.camera import Camera, Rays
from renderers.field import Field, autograd_normals, estimate_lipschitz
from renderers.rendering import Rendering
from renderers.tracing.reference import trace

VERSION = 1  # raise it when the reference changes
MIN_STEP = 2e-4  # scene units: thinner parts along a ray may be missed; a pixel at 512 x 512 is 4.6e-3 wide
RADIUS = 1.0  # scene units; rays start on this sphere


@dataclass(frozen=True)
class Reference:
    """A rendering of a field in float64, on the CPU; distance and normals are 0 without a hit."""

    distance: Float[Tensor, "height width"]
    normals: Float[Tensor, "height width 3"]
    hit: Bool[Tensor, "height width"]


def in_float64(prior: Prior) -> Prior:
    """A copy of a prior in float64, on the CPU."""
    return Prior(deepcopy(prior.decoder).cpu().double(), prior.codes.cpu().double())


def reference_for(prior: Prior, camera: Camera, folder: Path) -> Reference:
    """The reference of a prior's first shape in a view: read from `folder`, or rendered and stored there."""

    def render() -> dict[str, Tensor]:
        size = f"{camera.height} x {camera.width}"
        notice(f"rendering the {size} pixels of the reference in float64, once; it is stored in {folder}")
        exact = in_float64(prior)
        return vars(make_reference(exact.decoder.at(exact.codes[0]), camera))

    camera_settings = [camera.intrinsics.tolist(), camera.world_to_camera.tolist(), camera.height, camera.width]
    weights = fingerprint(Prior(prior.decoder, prior.codes[:1]))
    key = digest({"version": VERSION, "weights": weights, "camera": camera_settings})
    return Reference(**load_or_make(folder, f"reference-{key}", render))


def make_reference(field: Field, camera: Camera) -> Reference:
    """Traces a float64 field along the rays through all pixel centres."""
    rays = camera.double().rays()
    lipschitz = estimate_lipschitz(field, radius=RADIUS)
    rendering = trace_exactly(field, rays, lipschitz)
    normals = torch.zeros_like(rendering.points)
    normals[rendering.hit] = autograd_normals(field, rendering.points[rendering.hit])
    return Reference(rendering.distance * rendering.hit, normals, rendering.hit)


def trace_exactly(field: Field, rays: Rays, lipschitz: float) -> Rendering:
    """The float64 hits of a float64 field in the unit sphere, given its Lipschitz constant."""
    return trace(field, rays, lipschitz=lipschitz, least_step=MIN_STEP, radius=RADIUS)


def fingerprint(prior: Prior) -> str:
    weights = hashlib.sha256()
    for tensor in (*prior.decoder.state_dict().values(), prior.codes):
        weights.update(tensor.cpu().contiguous().numpy().tobytes())
    return weights.hexdigest()
