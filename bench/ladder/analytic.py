"""Rungs with a formula: one part, or a union of several. All parts are turned and moved, and sizes are logarithms."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bench.ladder.model import Model, Seen
from renderers.camera import rigid
from renderers.checks import check_at_least
from renderers.field import Flops, Kind
from renderers.fields.analytic import Shape, sphere, superquadric
from renderers.fields.analytic import box as exact_box

LEARNING_RATE = 0.01  # scene units, radians or a share of a size: what a step of Adam may change
LEAST = 0.01  # scene units: half size of a part at its start
AROUND, OF_CLUSTER = 3000, 200  # points that parts are found among, and the box of one cluster about, at most
CORNER = 0.3  # scene units: of a cube that stands for points where none are known
STARTS = 6  # clusterings
WORST = 0.75  # share of the points that a smaller union shows better than those where new parts begin
ROUND, EDGED = 0.0, -1.5  # how a rounded box begins: its radius is that logistic share of its least half size
EXPONENTS = (1.0, 20.0)  # of a superquadric: from an octahedron to nearly a box


def ball(numbers: Float[Tensor, "4"]) -> Shape:
    """Centre and logarithm of the radius."""
    return sphere(numbers[3].exp(), numbers[:3])


def ellipsoid(numbers: Float[Tensor, "9"]) -> Shape:
    """Where it is, see `_placed`, and its half axes."""
    return _placed(sphere(1.0).stretch(numbers[6:9].exp()), numbers)


def box(numbers: Float[Tensor, "9"]) -> Shape:
    """Where it is and its half sizes."""
    return _placed(exact_box(numbers[6:9].exp()), numbers)


def rounded(numbers: Float[Tensor, "10"]) -> Shape:
    """As a box; then what share of its least half size the radius of its edges is: with all of it, a capsule."""
    return union(numbers[None])


def union(numbers: Float[Tensor, "parts 10"]) -> Shape:
    """Rounded boxes, all at once: a loop over them takes as many times as long."""
    sizes = numbers[:, 6:9].exp()
    radii = torch.sigmoid(numbers[:, 9]) * sizes.amin(-1)
    turns = _turn(numbers)
    cores = exact_box(sizes - radii[:, None])

    def bound(points: Tensor) -> Tensor:
        own = torch.einsum("...pi,pij->...pj", points[..., None, :] - numbers[:, :3], turns)
        return (cores(own) - radii).amin(-1)

    return Shape(bound, Kind.DISTANCE if len(numbers) == 1 else Kind.BOUND)


def quadric(numbers: Float[Tensor, "11"]) -> Shape:
    """As an ellipsoid; then its two exponents, between `EXPONENTS`, as logistic shares of the way in logarithms."""
    low, high = EXPONENTS
    powers = low * (high / low) ** torch.sigmoid(numbers[9:11])
    return _placed(superquadric(numbers[6:9].exp(), powers), numbers)


@dataclass(frozen=True)
class Part:
    """A shape of a formula: its field, the numbers that follow its placing at the start, and its cost a value."""

    shape: Callable[[Tensor], Shape]
    extra: tuple[float, ...]
    flops: int


PARTS = {
    "sphere": Part(ball, (), 10),
    "ellipsoid": Part(ellipsoid, (), 50),
    "box": Part(box, (), 50),
    "rounded_box": Part(rounded, (ROUND,), 55),
    "superquadric": Part(quadric, (0.0, 0.0), 110),
}


@dataclass(frozen=True)
class OnePart:
    """A part of `PARTS`, begun as the smallest box about the observed points."""

    name: str
    follows: ClassVar[bool] = False
    tries: ClassVar[int] = 1

    @property
    def flops(self) -> int:
        """An estimate: a power counts as 20."""
        return PARTS[self.name].flops

    def starts(self, seen: Seen) -> list[Model]:
        """The ball about the points' middle, or the part in their oriented box."""
        part = PARTS[self.name]
        around = _thinned(seen.points)
        if self.name == "sphere":
            middle = (around.amax(0) + around.amin(0)) / 2
            radius = torch.linalg.vector_norm(around - middle, dim=-1).mean()
            numbers = torch.cat([middle, radius.log()[None]])
        else:
            numbers = torch.cat([_fitting_box(around), torch.tensor(part.extra)])
        return [_model(self.name, numbers, lambda free: part.shape(free[0]), self.flops, seen)]


@dataclass(frozen=True)
class UnionOf:
    """A union of rounded boxes.

    Some starts have a part about each of so many clusters of the observed points. One keeps the parts of a smaller
    union, and new ones begin about clusters of the points that it is furthest from.
    """

    count: int
    follows: ClassVar[bool] = False
    tries: ClassVar[int] = STARTS + 1

    def __post_init__(self) -> None:
        check_at_least("K of union_K", self.count, 2, "union_2 is the least")

    @property
    def name(self) -> str:
        return f"union_{self.count}"

    @property
    def flops(self) -> int:
        return self.count * PARTS["rounded_box"].flops

    def starts(self, seen: Seen) -> list[Model]:
        """Of several clusterings, and after the union that was before, if there is one."""
        old = [] if seen.previous is None else _parts_of(seen.previous)
        kept = old if len(old) < self.count else []
        if not len(seen.points):
            choices = [[*kept, *_anywhere(self.count - len(kept), seen.seed)]]
        else:
            points = _thinned(seen.points)
            choices = [_clustered(points, self.count, seen.seed + start) for start in range(STARTS)]
            if kept:
                error = seen.ask(points).abs()
                missed = points[error >= error.quantile(WORST)]
                choices.append([*kept, *_clustered(missed, self.count - len(kept), seen.seed)])
        return [
            _model(self.name, torch.stack(parts), lambda free: union(free[0]), self.flops, seen) for parts in choices
        ]


def _model(name: str, numbers: Tensor, shape: Callable[[list[Tensor]], Shape], flops: int, seen: Seen) -> Model:
    free = numbers.float().to(seen.device).requires_grad_()
    return Model(
        name, [free], lambda numbers: replace(shape(numbers), flops=Flops(flops, 2 * flops)), LEARNING_RATE, metric=True
    )


def _placed(shape: Shape, numbers: Float[Tensor, " n"]) -> Shape:
    """The shape turned by a rotation vector, numbers 3 to 5, and moved to a place, the first three."""
    return shape.rotate(_turn(numbers)).translate(numbers[:3])


def _turn(numbers: Float[Tensor, "*parts n"]) -> Float[Tensor, "*parts 3 3"]:
    """The rotation matrices of the rotation vectors, numbers 3 to 5."""
    vector = numbers[..., 3:6]
    return rigid(torch.cat([torch.zeros_like(vector), vector], dim=-1))[..., :3, :3]


def _thinned(points: Float[Tensor, "n 3"]) -> Float[Tensor, "m 3"]:
    """The points, some of many; the corners of a cube in the middle of the scene where there are too few for a box."""
    if len(points) < 4:
        return CORNER * torch.tensor([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    every = max(len(points) // AROUND, 1)
    return points[::every].cpu()


def _fitting_box(points: Float[Tensor, "n 3"]) -> Float[Tensor, "9"]:
    """Placing and logarithmic half sizes of the smallest box about the points."""
    import trimesh  # here: most runs do without it, and it takes a second

    to_box, extents = trimesh.bounds.oriented_bounds(points.numpy() + _jitter(len(points)))
    place = np.linalg.inv(to_box)
    angle, axis, _ = trimesh.transformations.rotation_from_matrix(place)
    sizes = np.log(np.maximum(extents / 2, LEAST))
    return torch.from_numpy(np.concatenate([place[:3, 3], angle * np.array(axis), sizes])).float()


def _jitter(count: int) -> Float[np.ndarray, "n 3"]:
    """A little noise, so that points on a plane have a box."""
    return 1e-4 * np.random.default_rng(0).standard_normal((count, 3))


def _clustered(points: Float[Tensor, "n 3"], count: int, seed: int) -> list[Float[Tensor, "10"]]:
    """A rounded box about each of so many clusters of the points (k-means)."""
    from scipy.cluster.vq import kmeans2

    _, labels = kmeans2(points.numpy().astype(np.float64), count, minit="++", rng=np.random.default_rng(seed))
    clusters = [points[torch.from_numpy(labels == label)] for label in range(count)]
    return [torch.cat([_around(cluster, points), torch.tensor([EDGED])]) for cluster in clusters]


def _around(cluster: Float[Tensor, "n 3"], points: Float[Tensor, "m 3"]) -> Float[Tensor, "9"]:
    """The smallest box about a cluster; a small one in its middle where it has too few points for a box."""
    if len(cluster) >= 4:
        return _fitting_box(cluster[:: -(-len(cluster) // OF_CLUSTER)])
    middle = cluster.mean(0) if len(cluster) else points.mean(0)
    return torch.cat([middle, torch.zeros(3), torch.full((3,), LEAST).log()])


def _anywhere(count: int, seed: int) -> list[Float[Tensor, "10"]]:
    """Rounded boxes in places of their own, where no point is known."""
    draw = torch.Generator().manual_seed(seed)
    sizes = torch.full((3,), CORNER).log()
    places = CORNER * (2 * torch.rand(count, 3, generator=draw) - 1)
    return [torch.cat([place, torch.zeros(3), sizes, torch.tensor([EDGED])]) for place in places]


def _parts_of(model: Model) -> list[Float[Tensor, "10"]]:
    """The parts of a union; none of another model."""
    return list(model.parameters[0].detach().cpu()) if model.rung.startswith("union_") else []
