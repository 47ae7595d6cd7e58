"""The candidates: parts with a formula, unions of them, networks of one shape, and grids fitted near the surface.

Every part has a pose; sizes are logarithms.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bench.evaluate.state import REACH
from bench.models.model import FLOAT, Candidate, Model, Seen
from bench.setup.fields import FREE, parse_field_name
from bench.shape_prior import initialise_to_sphere
from renderers.checks import BadInput
from renderers.field import Flops
from renderers.fields.analytic import Shape
from renderers.fields.grid import FLOPS, Grid
from renderers.fields.mlp import BoundDecoder, Decoder
from renderers.fields.parts import formula

LEARNING_RATE = 0.01  # of Adam: what one step may change, in scene units, radians or shares of a size
MIN_HALF_SIZE = 0.01  # scene units: least half size of a part at its start
MAX_POINTS, MAX_CLUSTER_POINTS = 3000, 200  # most points that are clustered, and most of one cluster for its box
CLUSTERINGS = 6  # each is a start of a union
MISSED_QUANTILE = 0.75  # of the errors of a smaller union: new parts begin at the points above it
ROUND_LOGIT, EDGED_LOGIT = 0.0, -1.5  # initial rounding of a box: logit of radius over least half size
DEEP = 8  # layers from which on a skip connection feeds the points in again half-way, as in DeepSDF
MAX_RATE, RATE_OF_WIDTH = 2e-3, 0.4  # Adam's rate: at most 2e-3, inversely as the width (Yang et al. 2021)
START_RADIUS = 0.5  # of the sphere that a network is initialised to, in scene units
BAND = 2.0  # cells to both sides of the surface whose samples are fitted
GRID_RATE = 2e-3  # scene units


@dataclass(frozen=True)
class Part:
    """A shape with a formula, see `renderers.fields.parts`.

    Its initial parameters after pose and sizes, how many parameters it has, and its operations per value.
    """

    extra: tuple[float, ...]
    size: int
    flops: int


PARTS = {
    "sphere": Part((), 4, 10),
    "ellipsoid": Part((), 9, 50),
    "box": Part((), 9, 50),
    "rounded_box": Part((ROUND_LOGIT,), 10, 55),
    "superquadric": Part((0.0, 0.0), 11, 110),
}


def one_part(name: str) -> Candidate:
    """A part of `PARTS` that begins in the smallest box about the observed points, a sphere about their middle."""
    part = PARTS[name]

    def starts(seen: Seen) -> list[Model]:
        around = _subsampled(seen.points)
        if name == "sphere":
            middle = (around.amax(0) + around.amin(0)) / 2
            radius = torch.linalg.vector_norm(around - middle, dim=-1).mean()
            parameters = torch.cat([middle, radius.log()[None]])
        else:
            parameters = torch.cat([_fitting_box(around), torch.tensor(part.extra)])
        return [_model(name, parameters, name, part.flops, seen)]

    return Candidate(name, part.size, part.flops, starts)


def union_of(name: str, count: int) -> Candidate:
    """A union of rounded boxes.

    Some starts have one part about each of `count` clusters of the observed points. One start keeps the parts of a
    smaller union, if there is one, and adds parts about clusters of the points that this union is furthest from.
    """
    flops = count * PARTS["rounded_box"].flops

    def starts(seen: Seen) -> list[Model]:
        of_union = seen.previous is not None and seen.previous.candidate.startswith("union_")
        old = list(seen.previous.parameters[0].detach().cpu()) if of_union else []
        kept = old if len(old) < count else []
        points = _subsampled(seen.points)
        choices = [_cluster_boxes(points, count, seen.seed + start) for start in range(CLUSTERINGS)]
        if kept:
            error = seen.previous_values(points).abs()
            missed = points[error >= error.quantile(MISSED_QUANTILE)]
            choices.append([*kept, *_cluster_boxes(missed, count - len(kept), seen.seed)])
        return [_model(name, torch.stack(parts), "union", flops, seen) for parts in choices]

    return Candidate(name, count * PARTS["rounded_box"].size, flops, starts, tries=CLUSTERINGS + 1)


def network(name: str, layers: int, width: int) -> Candidate:
    """Fully connected ReLU layers from a point to a distance (see `renderers.fields.mlp.Decoder`, without a code).

    It is initialised near the distance of a sphere; the warm start then fits it to the previous field.
    """
    skip = layers // 2 if layers >= DEEP else 0

    def decoder() -> Decoder:
        return Decoder(layers=layers, width=width, code_length=0, skip=skip, narrow=True)

    def bound(free: list[Tensor]) -> BoundDecoder:
        pairs = list(zip(free[::2], free[1::2], strict=True))
        return BoundDecoder(tuple(pairs[:-1]), pairs[-1], skip)

    def starts(seen: Seen) -> list[Model]:
        with torch.random.fork_rng():
            torch.manual_seed(seen.seed)
            begun = decoder()
        initialise_to_sphere(begun, START_RADIUS)
        parameters = [parameter.detach().to(seen.device).requires_grad_() for parameter in begun.parameters()]
        return [Model(name, parameters, bound, min(MAX_RATE, RATE_OF_WIDTH / width), metric=False)]

    with torch.device("meta"):  # sizes alone
        parameters = list(decoder().parameters())
    stored = sum(parameter.numel() for parameter in parameters)
    return Candidate(name, stored, bound(parameters).flops.value, starts, follows=True)


def narrow_band(name: str, resolution: int) -> Candidate:
    """A grid of distances: those near the surface are fitted, the others keep the values of the previous field."""
    stored = resolution**3  # all samples: those that are not fitted are evaluated as well

    @torch.no_grad()
    def starts(seen: Seen) -> list[Model]:
        """The previous field's values; fitted are those near its surface or near the observed points."""
        axis = torch.linspace(-REACH, REACH, resolution, device=seen.device)
        corners = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
        values = seen.previous_values(corners.view(-1, 3)).to(seen.device)
        cell = 2 * REACH / (resolution - 1)
        near = values.abs() < BAND * cell
        near[_near_points(seen.points.to(seen.device), cell, resolution)] = True
        band = near.nonzero().squeeze(-1)

        def grid(free: list[Tensor]) -> Grid:
            return Grid(values.index_put((band,), free[0]).view(resolution, resolution, resolution), REACH)

        free = values[band].clone().requires_grad_()
        # The fitted samples, a bit per sample that tells which they are, and the field whose values the others are.
        sparse = FLOAT * len(free) + -(-stored // 8) + seen.previous.size.bytes
        return [Model(name, [free], grid, GRID_RATE, metric=False, held=stored - len(free), sparse_bytes=sparse)]

    return Candidate(name, stored, FLOPS.value, starts, follows=True)


SIZED: dict[str, Callable[..., Candidate]] = {"union": union_of, "network": network, "grid": narrow_band}
PAPERS = "network_8x512"  # that of DeepSDF and DIST, without a code


def candidate(name: str) -> Candidate:
    """The candidate of a name.

    Raises:
        ValueError: where no candidate has this name.
        BadInput: for a field that is learnt from images alone.
    """
    kind, sizes = parse_field_name(name)
    if sizes and kind not in SIZED:
        raise BadInput(f"field={name} is learnt from images alone: set task=reconstruction, or another field")
    return SIZED[kind](name, *sizes) if sizes else one_part(name)


def by_size(names: tuple[str, ...], measure: str) -> list[Candidate]:
    """The candidates of these names, the smallest first.

    Args:
        names: in the order of their free numbers, and of any others that are as large as each other.
        measure: of `models.size`. By free numbers the order is kept: those of a grid are known at its start only.
    """
    listed = [candidate(name) for name in names]
    return listed if measure == FREE else sorted(listed, key=lambda one: one.stored)


def _model(name: str, parameters: Tensor, of: str, flops: int, seen: Seen) -> Model:
    def field(free: list[Tensor]) -> Shape:
        return formula(of, free[0], Flops(flops, 2 * flops))

    return Model(name, [parameters.float().to(seen.device).requires_grad_()], field, LEARNING_RATE, metric=True)


def _subsampled(points: Float[Tensor, "n 3"]) -> Float[Tensor, "m 3"]:
    """At most about `MAX_POINTS` of the points."""
    return points[:: max(len(points) // MAX_POINTS, 1)].cpu()


def _fitting_box(points: Float[Tensor, "n 3"]) -> Float[Tensor, "9"]:
    """Pose and logarithmic half sizes of the smallest box about the points."""
    import trimesh  # here, since it takes a second and most runs do not need it

    jitter = 1e-4 * np.random.default_rng(0).standard_normal(points.shape)  # points on a plane have a box with a volume
    to_box, extents = trimesh.bounds.oriented_bounds(points.numpy() + jitter)
    place = np.linalg.inv(to_box)
    angle, axis, _ = trimesh.transformations.rotation_from_matrix(place)
    sizes = np.log(np.maximum(extents / 2, MIN_HALF_SIZE))
    return torch.from_numpy(np.concatenate([place[:3, 3], angle * np.array(axis), sizes])).float()


def _cluster_boxes(points: Float[Tensor, "n 3"], count: int, seed: int) -> list[Float[Tensor, "10"]]:
    """A rounded box about each of `count` clusters of the points (k-means)."""
    from scipy.cluster.vq import kmeans2

    _, labels = kmeans2(points.numpy().astype(np.float64), count, minit="++", rng=np.random.default_rng(seed))
    clusters = [points[torch.from_numpy(labels == label)] for label in range(count)]
    return [torch.cat([_cluster_box(cluster, points), torch.tensor([EDGED_LOGIT])]) for cluster in clusters]


def _cluster_box(cluster: Float[Tensor, "n 3"], points: Float[Tensor, "m 3"]) -> Float[Tensor, "9"]:
    """The smallest box about a cluster; a small one in its middle where it has too few points for a box."""
    if len(cluster) >= 4:
        return _fitting_box(cluster[:: -(-len(cluster) // MAX_CLUSTER_POINTS)])
    middle = cluster.mean(0) if len(cluster) else points.mean(0)
    return torch.cat([middle, torch.zeros(3), torch.full((3,), MIN_HALF_SIZE).log()])


def _near_points(points: Float[Tensor, "n 3"], cell: float, resolution: int) -> Int[Tensor, " m"]:
    """Indices of a grid's samples within `BAND` cells of a point, along each axis."""
    reach = int(BAND)
    steps = torch.arange(1 - reach, reach + 1, device=points.device)
    offsets = torch.cartesian_prod(steps, steps, steps)
    low = ((points + REACH) / cell).floor().long()
    corners = (low[:, None] + offsets).clamp(0, resolution - 1).reshape(-1, 3)
    place = (corners[:, 0] * resolution + corners[:, 1]) * resolution + corners[:, 2]
    return place.unique()
