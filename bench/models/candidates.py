"""The candidates: parts with a formula, unions of them, networks of one shape, and grids fitted near the surface.

Every part has a pose; sizes are logarithms.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bench.models.model import FLOAT, Candidate, Model, Seen
from bench.setup.fields import FREE, parsed
from bench.shape_prior import initialise_to_sphere
from renderers.camera import rigid
from renderers.checks import BadInput
from renderers.field import Flops, Kind
from renderers.fields.analytic import Shape, sphere, superquadric
from renderers.fields.analytic import box as exact_box
from renderers.fields.grid import FLOPS, Grid
from renderers.fields.mlp import BoundDecoder, Decoder

LEARNING_RATE = 0.01  # of Adam: what one step may change, in scene units, radians or shares of a size
MIN_HALF_SIZE = 0.01  # scene units: least half size of a part at its start
MAX_POINTS, MAX_CLUSTER_POINTS = 3000, 200  # most points that are clustered, and most of one cluster for its box
CLUSTERINGS = 6  # each is a start of a union
MISSED_QUANTILE = 0.75  # of the errors of a smaller union: new parts begin at the points above it
ROUND_LOGIT, EDGED_LOGIT = 0.0, -1.5  # initial rounding of a box: logit of radius over least half size
EXPONENTS = (1.0, 20.0)  # of a superquadric: 1 is an octahedron, 20 nearly a box
DEEP = 8  # layers from which on a skip connection feeds the points in again half-way, as in DeepSDF
MAX_RATE, RATE_OF_WIDTH = 2e-3, 0.4  # Adam's rate: at most 2e-3, inversely as the width (Yang et al. 2021)
START_RADIUS = 0.5  # of the sphere that a network is initialised to, in scene units
REACH = 1.05  # half the side of the sampled cube: the unit sphere and a margin
BAND = 2.0  # cells to both sides of the surface whose samples are fitted
GRID_RATE = 2e-3  # scene units


def union(parameters: Float[Tensor, "parts 10"]) -> Shape:
    """A union of rounded boxes, computed as one batch: a loop over them takes as many times as long.

    Each has its pose, see `_placed`, the logarithms of its half sizes, and the logit of its edges' radius over the
    least of these; at 1 it is a capsule.
    """
    sizes = parameters[:, 6:9].exp()
    radii = torch.sigmoid(parameters[:, 9]) * sizes.amin(-1)
    turns = _turn(parameters)
    cores = exact_box(sizes - radii[:, None])

    def bound(points: Tensor) -> Tensor:
        local = torch.einsum("...pi,pij->...pj", points[..., None, :] - parameters[:, :3], turns)
        return (cores(local) - radii).amin(-1)

    return Shape(bound, Kind.DISTANCE if len(parameters) == 1 else Kind.BOUND)


def quadric(parameters: Float[Tensor, "11"]) -> Shape:
    """A superquadric: as an ellipsoid, then the logits of two exponents between `EXPONENTS`, on a logarithmic scale."""
    low, high = EXPONENTS
    powers = low * (high / low) ** torch.sigmoid(parameters[9:11])
    return _placed(superquadric(parameters[6:9].exp(), powers), parameters)


@dataclass(frozen=True)
class Part:
    """A shape with a formula.

    Its field, its initial parameters after pose and sizes, how many parameters it has, and its operations per value.
    """

    shape: Callable[[Tensor], Shape]
    extra: tuple[float, ...]
    size: int
    flops: int


PARTS = {  # all but a sphere begin with their pose, see `_placed`, and the logarithms of three half sizes
    "sphere": Part(lambda p: sphere(p[3].exp(), p[:3]), (), 4, 10),  # centre, logarithm of the radius
    "ellipsoid": Part(lambda p: _placed(sphere(1.0).stretch(p[6:9].exp()), p), (), 9, 50),
    "box": Part(lambda p: _placed(exact_box(p[6:9].exp()), p), (), 9, 50),
    "rounded_box": Part(lambda p: union(p[None]), (ROUND_LOGIT,), 10, 55),
    "superquadric": Part(quadric, (0.0, 0.0), 11, 110),
}


@dataclass(frozen=True)
class OnePart:
    """A part of `PARTS` that begins in the smallest box about the observed points."""

    name: str
    follows: ClassVar[bool] = False
    tries: ClassVar[int] = 1

    @property
    def stored(self) -> int:
        return PARTS[self.name].size

    @property
    def flops(self) -> int:
        """An estimate: a power counts as 20."""
        return PARTS[self.name].flops

    def starts(self, seen: Seen) -> list[Model]:
        """A sphere about the points' middle, or the part in their oriented box."""
        part = PARTS[self.name]
        around = _subsampled(seen.points)
        if self.name == "sphere":
            middle = (around.amax(0) + around.amin(0)) / 2
            radius = torch.linalg.vector_norm(around - middle, dim=-1).mean()
            parameters = torch.cat([middle, radius.log()[None]])
        else:
            parameters = torch.cat([_fitting_box(around), torch.tensor(part.extra)])
        return [_model(self.name, parameters, lambda tensors: part.shape(tensors[0]), self.flops, seen)]


@dataclass(frozen=True)
class UnionOf:
    """A union of rounded boxes.

    Some starts have one part about each of `count` clusters of the observed points. One start keeps the parts of a
    smaller union, and adds parts about clusters of the points that this union is furthest from.
    """

    name: str
    count: int
    follows: ClassVar[bool] = False
    tries: ClassVar[int] = CLUSTERINGS + 1

    @property
    def stored(self) -> int:
        return self.count * PARTS["rounded_box"].size

    @property
    def flops(self) -> int:
        return self.count * PARTS["rounded_box"].flops

    def starts(self, seen: Seen) -> list[Model]:
        """One start for each clustering, and one from the previous union, if there is one."""
        old = [] if seen.previous is None else _parts_of(seen.previous)
        kept = old if len(old) < self.count else []
        points = _subsampled(seen.points)
        choices = [_cluster_boxes(points, self.count, seen.seed + start) for start in range(CLUSTERINGS)]
        if kept:
            error = seen.previous_values(points).abs()
            missed = points[error >= error.quantile(MISSED_QUANTILE)]
            choices.append([*kept, *_cluster_boxes(missed, self.count - len(kept), seen.seed)])
        return [
            _model(self.name, torch.stack(parts), lambda parameters: union(parameters[0]), self.flops, seen)
            for parts in choices
        ]


@dataclass(frozen=True)
class Network:
    """Fully connected ReLU layers from a point to a distance (see `renderers.fields.mlp.Decoder`, without a code)."""

    name: str
    layers: int
    width: int
    follows: ClassVar[bool] = True
    tries: ClassVar[int] = 1

    @cached_property
    def stored(self) -> int:
        return sum(parameter.numel() for parameter in self._decoder(0).parameters())

    @cached_property
    def flops(self) -> int:
        return self._bound(list(self._decoder(0).parameters())).flops.value

    def starts(self, seen: Seen) -> list[Model]:
        """Initialised near the distance of a sphere; the warm start then fits it to the previous field."""
        decoder = self._decoder(seen.seed)
        initialise_to_sphere(decoder, START_RADIUS)
        parameters = [parameter.detach().to(seen.device).requires_grad_() for parameter in decoder.parameters()]
        return [Model(self.name, parameters, self._bound, min(MAX_RATE, RATE_OF_WIDTH / self.width), metric=False)]

    def _decoder(self, seed: int) -> Decoder:
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            return Decoder(layers=self.layers, width=self.width, code_length=0, skip=self._skip, narrow=True)

    @property
    def _skip(self) -> int:
        return self.layers // 2 if self.layers >= DEEP else 0

    def _bound(self, free: list[Tensor]) -> BoundDecoder:
        pairs = list(zip(free[::2], free[1::2], strict=True))
        return BoundDecoder(tuple(pairs[:-1]), pairs[-1], self._skip)


@dataclass(frozen=True)
class NarrowBand:
    """A grid of distances: those near the surface are fitted, the others keep the values of the previous field."""

    name: str
    resolution: int
    follows: ClassVar[bool] = True
    tries: ClassVar[int] = 1

    @property
    def stored(self) -> int:
        """All samples: those that are not fitted are evaluated as well."""
        return self.resolution**3

    @property
    def flops(self) -> int:
        return FLOPS.value

    @torch.no_grad()
    def starts(self, seen: Seen) -> list[Model]:
        """The previous field's values; fitted are those near its surface or near the observed points."""
        axis = torch.linspace(-REACH, REACH, self.resolution, device=seen.device)
        corners = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
        values = seen.previous_values(corners.view(-1, 3)).to(seen.device)
        cell = 2 * REACH / (self.resolution - 1)
        near = values.abs() < BAND * cell
        near[self._near_points(seen.points.to(seen.device), cell)] = True
        band = near.nonzero().squeeze(-1)

        def grid(free: list[Tensor]) -> Grid:
            kept = values.index_put((band,), free[0])
            return Grid(kept.view(self.resolution, self.resolution, self.resolution), REACH)

        free = values[band].clone().requires_grad_()
        sparse = self._sparse_bytes(len(free), seen)
        held = len(values) - len(free)
        return [Model(self.name, [free], grid, GRID_RATE, metric=False, held=held, sparse_bytes=sparse)]

    def _sparse_bytes(self, fitted: int, seen: Seen) -> int:
        """Of a file with the fitted samples, a bit per sample that tells which they are, and the previous field.

        The other samples are values of that field, so that the same grid can be computed from it.
        """
        assert seen.previous is not None
        return FLOAT * fitted + -(-self.stored // 8) + seen.previous.size.bytes

    def _near_points(self, points: Float[Tensor, "n 3"], cell: float) -> Int[Tensor, " m"]:
        """Indices of the samples within `BAND` cells of a point, along each axis."""
        reach = int(BAND)
        steps = torch.arange(1 - reach, reach + 1, device=points.device)
        offsets = torch.cartesian_prod(steps, steps, steps)
        low = ((points + REACH) / cell).floor().long()
        corners = (low[:, None] + offsets).clamp(0, self.resolution - 1).reshape(-1, 3)
        place = (corners[:, 0] * self.resolution + corners[:, 1]) * self.resolution + corners[:, 2]
        return place.unique()


SIZED: dict[str, Callable[..., Candidate]] = {"union": UnionOf, "network": Network, "grid": NarrowBand}
PAPERS = Network("network_8x512", 8, 512)  # that of DeepSDF and DIST, without a code


def candidate(name: str) -> Candidate:
    """The candidate of a name.

    Raises:
        ValueError: where no candidate has this name.
        BadInput: for a field that is learnt from images alone.
    """
    kind, sizes = parsed(name)
    if sizes and kind not in SIZED:
        raise BadInput(f"field={name} is learnt from images alone: set task=reconstruction, or another field")
    return SIZED[kind](name, *sizes) if sizes else OnePart(name)


def by_size(names: tuple[str, ...], measure: str) -> list[Candidate]:
    """The candidates of these names, the smallest first.

    Args:
        names: in the order of their free numbers, and of any others that are as large as each other.
        measure: of `models.size`. By free numbers the order is kept: those of a grid are known at its start only.
    """
    listed = [candidate(name) for name in names]
    return listed if measure == FREE else sorted(listed, key=lambda one: one.stored)


def _model(name: str, parameters: Tensor, shape: Callable[[list[Tensor]], Shape], flops: int, seen: Seen) -> Model:
    free = parameters.float().to(seen.device).requires_grad_()
    return Model(
        name,
        [free],
        lambda parameters: replace(shape(parameters), flops=Flops(flops, 2 * flops)),
        LEARNING_RATE,
        metric=True,
    )


def _placed(shape: Shape, parameters: Float[Tensor, " n"]) -> Shape:
    """The shape turned by the rotation vector, parameters 3 to 5, and moved by the translation, the first three."""
    return shape.rotate(_turn(parameters)).translate(parameters[:3])


def _turn(parameters: Float[Tensor, "*parts n"]) -> Float[Tensor, "*parts 3 3"]:
    """Rotation matrices of the rotation vectors, parameters 3 to 5."""
    vector = parameters[..., 3:6]
    return rigid(torch.cat([torch.zeros_like(vector), vector], dim=-1))[..., :3, :3]


def _subsampled(points: Float[Tensor, "n 3"]) -> Float[Tensor, "m 3"]:
    """At most about `MAX_POINTS` of the points."""
    return points[:: max(len(points) // MAX_POINTS, 1)].cpu()


def _fitting_box(points: Float[Tensor, "n 3"]) -> Float[Tensor, "9"]:
    """Pose and logarithmic half sizes of the smallest box about the points."""
    import trimesh  # here, since it takes a second and most runs do not need it

    to_box, extents = trimesh.bounds.oriented_bounds(points.numpy() + _jitter(len(points)))
    place = np.linalg.inv(to_box)
    angle, axis, _ = trimesh.transformations.rotation_from_matrix(place)
    sizes = np.log(np.maximum(extents / 2, MIN_HALF_SIZE))
    return torch.from_numpy(np.concatenate([place[:3, 3], angle * np.array(axis), sizes])).float()


def _jitter(count: int) -> Float[np.ndarray, "n 3"]:
    """A little noise, so that points on a plane have a box with a volume."""
    return 1e-4 * np.random.default_rng(0).standard_normal((count, 3))


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


def _parts_of(model: Model) -> list[Float[Tensor, "10"]]:
    """The parts of a union; none of another model."""
    return list(model.parameters[0].detach().cpu()) if model.candidate.startswith("union_") else []
