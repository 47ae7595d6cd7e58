"""The candidates: primitives with a formula, unions of them, networks of points or of their encoding, and grids.

Every primitive has a pose; sizes are logarithms.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from math import pi, sqrt

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bench.evaluate.state import REACH
from bench.shape_prior import initialise_to_sphere
from bench.tasks.capacity.model import FLOAT_BYTES, Candidate, Model, StartInputs
from bench.tasks.capacity.names import parse_field_name
from bench.tasks.capacity.settings import FREE
from renderers.checks import BadInput
from renderers.field import Flops
from renderers.fields.analytic import Shape
from renderers.fields.grid import FLOPS, Grid
from renderers.fields.mlp import BoundDecoder, Decoder
from renderers.fields.networks.encoded import EncodedNetwork, Encoding, FourierFeatures, HashGrid
from renderers.fields.parts import formula

PRIMITIVE_RATE = 0.01  # Adam's rate: the change per step in scene units, radians or fractions of a size
MIN_HALF_SIZE = 0.01  # scene units, at the start
MAX_POINTS, MAX_CLUSTER_POINTS = 3000, 200  # for the clustering, and for the box of one cluster
CLUSTERINGS = 6  # each is a start of a union
MISSED_ERROR_QUANTILE = 0.75  # new primitives start at points where a smaller union has larger errors
ROUND_LOGIT, EDGED_LOGIT = 0.0, -1.5  # initial rounding of a box: logit of radius over smallest half size
MIN_SKIP_LAYERS = 8  # deeper networks feed the points in again half-way, as DeepSDF does
MAX_RATE, RATE_TIMES_WIDTH = 2e-3, 0.4  # Adam's rate: at most 2e-3, inversely as the width (Yang et al. 2021)
INITIAL_SPHERE_RADIUS = 0.5  # scene units: a network is initialised to this sphere
FOURIER_STD = 1.0  # cycles per scene unit, of each coordinate of the random frequencies
HASH_FEATURES, HASH_LAYERS, HASH_WIDTH = 2, 1, 32  # numbers of an entry; the network of its features
HASH_COARSEST, HASH_FINEST = 4, 64  # cells per axis of the first and the last level
HASH_INITIAL = 1e-4  # features are drawn between -1e-4 and 1e-4 (Mueller et al. 2022)
BAND_CELLS = 2.0  # grid samples within so many cells of the surface are fitted
GRID_RATE = 2e-3  # scene units


@dataclass(frozen=True)
class Primitive:
    """A shape with a formula, see `renderers.fields.parts`.

    It has the initial parameters after pose and sizes, the number of parameters, and the operations per evaluation.
    """

    extra: tuple[float, ...]
    size: int
    flops: int


PRIMITIVES = {
    "sphere": Primitive((), 4, 10),
    "ellipsoid": Primitive((), 9, 50),
    "box": Primitive((), 9, 50),
    "rounded_box": Primitive((ROUND_LOGIT,), 10, 55),
    "superquadric": Primitive((0.0, 0.0), 11, 110),
}


def primitive_candidate(name: str) -> Candidate:
    """A primitive that starts as the smallest box about the observed points, or as a sphere about their middle."""
    primitive = PRIMITIVES[name]

    def starts(inputs: StartInputs) -> list[Model]:
        points = _subsampled(inputs.points)
        if name == "sphere":
            middle = (points.amax(0) + points.amin(0)) / 2
            radius = torch.linalg.vector_norm(points - middle, dim=-1).mean()
            parameters = torch.cat([middle, radius.log()[None]])
        else:
            parameters = torch.cat([_fitting_box(points), torch.tensor(primitive.extra)])
        return [_model(name, parameters, name, primitive.flops, inputs)]

    return Candidate(name, primitive.size, primitive.flops, starts)


def union_candidate(name: str, count: int) -> Candidate:
    """A union of rounded boxes.

    Most starts have one box about each of `count` clusters of the observed points. If there is a smaller union, one
    start keeps its boxes and adds boxes about clusters of the points farthest from it.
    """
    flops = count * PRIMITIVES["rounded_box"].flops

    def starts(inputs: StartInputs) -> list[Model]:
        is_union = inputs.previous is not None and inputs.previous.candidate.startswith("union_")
        previous = list(inputs.previous.parameters[0].detach().cpu()) if is_union else []
        kept = previous if len(previous) < count else []
        points = _subsampled(inputs.points)
        choices = [_cluster_boxes(points, count, inputs.seed + start) for start in range(CLUSTERINGS)]
        if kept:
            error = inputs.previous_values(points).abs()
            missed = points[error >= error.quantile(MISSED_ERROR_QUANTILE)]
            choices.append([*kept, *_cluster_boxes(missed, count - len(kept), inputs.seed)])
        return [_model(name, torch.stack(parts), "union", flops, inputs) for parts in choices]

    return Candidate(name, count * PRIMITIVES["rounded_box"].size, flops, starts, tries=CLUSTERINGS + 1)


def network(name: str, layers: int, width: int) -> Candidate:
    """Fully connected ReLU layers from a point to a distance (see `renderers.fields.mlp.Decoder`, without a code).

    It is initialised near the distance of a sphere; the warm start then fits it to the previous field.
    """
    skip = layers // 2 if layers >= MIN_SKIP_LAYERS else 0

    def new_decoder() -> Decoder:
        return Decoder(layers=layers, width=width, code_length=0, skip=skip, narrow=True)

    def bound(free: list[Tensor]) -> BoundDecoder:
        pairs = list(zip(free[::2], free[1::2], strict=True))
        return BoundDecoder(tuple(pairs[:-1]), pairs[-1], skip)

    def starts(inputs: StartInputs) -> list[Model]:
        with torch.random.fork_rng():
            torch.manual_seed(inputs.seed)
            decoder = new_decoder()
        initialise_to_sphere(decoder, INITIAL_SPHERE_RADIUS)
        parameters = [parameter.detach().to(inputs.device).requires_grad_() for parameter in decoder.parameters()]
        return [Model(name, parameters, bound, min(MAX_RATE, RATE_TIMES_WIDTH / width), metric=False)]

    with torch.device("meta"):  # sizes alone
        parameters = list(new_decoder().parameters())
    stored = sum(parameter.numel() for parameter in parameters)
    return Candidate(name, stored, bound(parameters).flops.value, starts, follows=True)


def initial_fourier(count: int, draw: torch.Generator | None = None) -> FourierFeatures:
    """Fourier features of `count` random frequencies; None draws from PyTorch's default generator."""
    return FourierFeatures(FOURIER_STD * torch.randn(count, 3, generator=draw))


def initial_hash_grid(levels: int, log2_entries: int, draw: torch.Generator | None = None) -> HashGrid:
    """A hash grid of random features; the cells of its levels grow geometrically."""
    ratio = (HASH_FINEST / HASH_COARSEST) ** (1 / (levels - 1))
    cells = tuple(round(HASH_COARSEST * ratio**level) for level in range(levels))
    drawn = torch.rand(levels, 2**log2_entries, HASH_FEATURES, generator=draw)
    return HashGrid(HASH_INITIAL * (2 * drawn - 1), cells, REACH)


def fourier(name: str, layers: int, width: int) -> Candidate:
    """A network of Fourier features, as many as a layer has neurons; the frequencies are drawn, and not fitted."""

    def encoding(draw: torch.Generator) -> tuple[list[Tensor], Callable[[list[Tensor]], Encoding]]:
        frequencies = initial_fourier(width // 2, draw).frequencies
        return [], lambda free: FourierFeatures(frequencies.to(free[0].device))

    return _encoded(name, encoding, [3 + 2 * (width // 2), *[width] * layers], fixed_count=3 * (width // 2))


def hash_grid(name: str, levels: int, log2_entries: int) -> Candidate:
    """A hash grid with a small network."""

    def encoding(draw: torch.Generator) -> tuple[list[Tensor], Callable[[list[Tensor]], Encoding]]:
        initial = initial_hash_grid(levels, log2_entries, draw)
        return [initial.tables], lambda free: HashGrid(free[0], initial.cells, initial.reach)

    return _encoded(name, encoding, [3 + HASH_FEATURES * levels, *[HASH_WIDTH] * HASH_LAYERS])


def _encoded(
    name: str,
    encoding: Callable[[torch.Generator], tuple[list[Tensor], Callable[[list[Tensor]], Encoding]]],
    sizes: list[int],
    fixed_count: int = 0,
) -> Candidate:
    """A network of encoded points, initialised near the distance of a sphere (SAL, Atzmon and Lipman 2020).

    Args:
        encoding: draws the free numbers of the encoding, and returns them with a function that makes it of all of them.
        sizes: inputs of each layer; the first are the point and its features.
        fixed_count: numbers of the encoding that are stored and not fitted.
    """

    def new(seed: int) -> tuple[list[Tensor], Callable[[list[Tensor]], EncodedNetwork]]:
        draw = torch.Generator().manual_seed(seed)
        encoded, make = encoding(draw)
        weights = [torch.randn(o, i, generator=draw) * sqrt(2 / o) for i, o in pairwise(sizes)]
        if not encoded:  # features of a hash grid are about 0 at the start
            weights[0][:, 3:] = 0.0
        last = torch.full((1, sizes[-1]), sqrt(pi / sizes[-1])), torch.full((1,), -INITIAL_SPHERE_RADIUS)
        layers = [tensor for weight in weights for tensor in (weight, torch.zeros(len(weight)))]

        def field(free: list[Tensor]) -> EncodedNetwork:
            of_layers = free[len(encoded) :]
            return EncodedNetwork(make(free), tuple(zip(of_layers[::2], of_layers[1::2], strict=True)))

        return [*encoded, *layers, *last], field

    def starts(inputs: StartInputs) -> list[Model]:
        numbers, field = new(inputs.seed)
        free = [tensor.to(inputs.device).requires_grad_() for tensor in numbers]
        return [
            Model(name, free, field, min(MAX_RATE, RATE_TIMES_WIDTH / sizes[-1]), metric=False, fixed_count=fixed_count)
        ]

    numbers, field = new(0)
    stored = fixed_count + sum(tensor.numel() for tensor in numbers)
    return Candidate(name, stored, field(numbers).flops.value, starts, follows=True)


def narrow_band(name: str, resolution: int) -> Candidate:
    """A grid of distances: samples near the surface are fitted, the others keep the values of the previous field."""
    stored = resolution**3  # samples that are not fitted are stored too

    @torch.no_grad()
    def starts(inputs: StartInputs) -> list[Model]:
        """The previous field's values; samples near its surface or near the observed points are fitted."""
        axis = torch.linspace(-REACH, REACH, resolution, device=inputs.device)
        corners = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
        values = inputs.previous_values(corners.view(-1, 3)).to(inputs.device)
        cell = 2 * REACH / (resolution - 1)
        near = values.abs() < BAND_CELLS * cell
        near[_near_points(inputs.points.to(inputs.device), cell, resolution)] = True
        band = near.nonzero().squeeze(-1)

        def grid(free: list[Tensor]) -> Grid:
            return Grid(values.index_put((band,), free[0]).view(resolution, resolution, resolution), REACH)

        free = values[band].clone().requires_grad_()
        # The fitted samples, one bit per sample that marks them, and the previous field, which gives the others.
        sparse = FLOAT_BYTES * len(free) + -(-stored // 8) + inputs.previous.size.bytes
        return [Model(name, [free], grid, GRID_RATE, metric=False, fixed_count=stored - len(free), sparse_bytes=sparse)]

    return Candidate(name, stored, FLOPS.value, starts, follows=True)


BUILDERS: dict[str, Callable[..., Candidate]] = {
    **{"union": union_candidate, "network": network, "fourier": fourier, "hash": hash_grid, "grid": narrow_band}
}
PAPER_NETWORK = "network_8x512"  # the network of DeepSDF and DIST without a code


def candidate(name: str) -> Candidate:
    """The candidate with this name.

    Raises:
        ValueError: no candidate has this name.
        BadInput: the field can only be learnt from images.
    """
    kind, sizes = parse_field_name(name)
    if sizes and kind not in BUILDERS:
        raise BadInput(f"field={name} is learnt from images alone: set task=reconstruction, or another field")
    return BUILDERS[kind](name, *sizes) if sizes else primitive_candidate(name)


def by_size(names: tuple[str, ...], measure: str) -> list[Candidate]:
    """The candidates of these names, the smallest first.

    Args:
        names: in the order of their free numbers; also the order of candidates of equal size.
        measure: of `models.size`. For free numbers the order is kept, since a grid's number is not known in advance.
    """
    listed = [candidate(name) for name in names]
    return listed if measure == FREE else sorted(listed, key=lambda entry: entry.stored)


def _model(name: str, parameters: Tensor, kind: str, flops: int, inputs: StartInputs) -> Model:
    def field(free: list[Tensor]) -> Shape:
        return formula(kind, free[0], Flops(flops, 2 * flops))

    return Model(name, [parameters.float().to(inputs.device).requires_grad_()], field, PRIMITIVE_RATE, metric=True)


def _subsampled(points: Float[Tensor, "n 3"]) -> Float[Tensor, "m 3"]:
    """At most about `MAX_POINTS` of the points."""
    return points[:: max(len(points) // MAX_POINTS, 1)].cpu()


def _fitting_box(points: Float[Tensor, "n 3"]) -> Float[Tensor, "9"]:
    """Pose and logarithmic half sizes of the smallest box about the points."""
    import trimesh  # here, since it takes a second and most runs do not need it

    jitter = 1e-4 * np.random.default_rng(0).standard_normal(points.shape)  # points on a plane have a box with a volume
    to_box, extents = trimesh.bounds.oriented_bounds(points.numpy() + jitter)
    from_box = np.linalg.inv(to_box)
    angle, axis, _ = trimesh.transformations.rotation_from_matrix(from_box)
    sizes = np.log(np.maximum(extents / 2, MIN_HALF_SIZE))
    return torch.from_numpy(np.concatenate([from_box[:3, 3], angle * np.array(axis), sizes])).float()


def _cluster_boxes(points: Float[Tensor, "n 3"], count: int, seed: int) -> list[Float[Tensor, "10"]]:
    """Rounded boxes about `count` clusters of the points (k-means)."""
    from scipy.cluster.vq import kmeans2

    _, labels = kmeans2(points.numpy().astype(np.float64), count, minit="++", rng=np.random.default_rng(seed))
    clusters = [points[torch.from_numpy(labels == label)] for label in range(count)]
    return [torch.cat([_cluster_box(cluster, points), torch.tensor([EDGED_LOGIT])]) for cluster in clusters]


def _cluster_box(cluster: Float[Tensor, "n 3"], points: Float[Tensor, "m 3"]) -> Float[Tensor, "9"]:
    """The smallest box about a cluster; a small box in its middle if it has too few points."""
    if len(cluster) >= 4:
        return _fitting_box(cluster[:: -(-len(cluster) // MAX_CLUSTER_POINTS)])
    middle = cluster.mean(0) if len(cluster) else points.mean(0)
    return torch.cat([middle, torch.zeros(3), torch.full((3,), MIN_HALF_SIZE).log()])


def _near_points(points: Float[Tensor, "n 3"], cell: float, resolution: int) -> Int[Tensor, " m"]:
    """Indices of a grid's samples within `BAND_CELLS` cells of a point, along each axis."""
    reach = int(BAND_CELLS)
    steps = torch.arange(1 - reach, reach + 1, device=points.device)
    offsets = torch.cartesian_prod(steps, steps, steps)
    nearest = ((points + REACH) / cell).floor().long()
    corners = (nearest[:, None] + offsets).clamp(0, resolution - 1).reshape(-1, 3)
    indices = (corners[:, 0] * resolution + corners[:, 1]) * resolution + corners[:, 2]
    return indices.unique()
