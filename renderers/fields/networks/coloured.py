"""Fields with colours: networks and grids of one shape, initialised to a sphere."""

from dataclasses import dataclass
from itertools import pairwise
from math import pi, sqrt
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import softplus

from renderers.checks import check_at_least, check_positive
from renderers.field import Flops, Kind, Vectors
from renderers.fields.grid import FLOPS, Grid
from renderers.fields.mlp import split_into_passes
from renderers.fields.networks.encoded import EncodedNetwork, Encoding, FourierFeatures, HashGrid
from renderers.fields.networks.network import flops_of
from renderers.fields.networks.occupancy import BoundOccupancy, OccupancyField, OccupancyNetwork

SOFTPLUS_BETA = 100.0  # as in IDR: nearly a ReLU, with a second derivative
INIT_SPHERE_POINTS = 256  # points of the initial sphere; the bias is set so that the mean value there is 0
DIRECTION_OCTAVES = 2  # see `positional_encoding`
LOGIT_WIDTH = 0.1  # scene units over which the initial occupancy logit changes by 1
OCCUPANCY_THRESHOLD = 0.5  # tau in DVR
COLOUR_LOGIT_SCALE = 20.0  # makes one step size of Adam suit the colours and the distances of a grid


def _colour_network(features: int, width: int, *, directional: bool) -> nn.ModuleList:
    """The layers from features, point, normal and, if directional, encoded direction to a colour."""
    direction_inputs = 3 + 6 * DIRECTION_OCTAVES if directional else 0
    return nn.ModuleList(nn.Linear(*pair) for pair in pairwise([features + 6 + direction_inputs, width, width, 3]))


def _colours(
    network: nn.ModuleList, features: Tensor, points: Vectors, normals: Vectors, directions: Vectors | None
) -> Vectors:
    """The colours by the layers of `_colour_network`; None for one that is not directional."""
    encoded = [] if directions is None else [positional_encoding(directions, DIRECTION_OCTAVES)]
    hidden = torch.cat([features, points, normals, *encoded], dim=-1)
    *layers, last = network
    for layer in layers:
        hidden = layer(hidden).relu_()
    return torch.sigmoid(last(hidden))


class ColouredDistance(nn.Module):
    """A distance network, and a colour network that takes its features, the point, the normal and the view direction.

    It is initialised to a sphere about the origin. The encoding has zero weights, and the other weights are drawn so
    that the slope is about 1 (Atzmon and Lipman 2020, "SAL", Theorem 1; IDR, Sec. 4).

    Source: IDR (Yariv et al. 2020), Sec. 3.2 and its supplement: softplus, positional encoding; colours of point,
        normal, direction and features.
    Deviates: narrower; no skip; the features are a linear map of the last hidden layer.

    Args:
        layers: hidden layers of the distance network, at least 1.
        width: neurons per hidden layer; the colour network has two hidden layers.
        octaves: of the encoding of points: sine and cosine of 1, 2, 4, ... times each coordinate.
        radius: of the initial sphere, in scene units.
        directional: whether colours depend on the view direction.
    """

    kind: ClassVar[Kind] = Kind.DISTANCE
    lipschitz: ClassVar[None] = None

    def __init__(self, *, layers: int, width: int, octaves: int, radius: float, directional: bool) -> None:
        super().__init__()
        check_at_least("layers", layers, 1, "4 suit one shape")
        check_at_least("width", width, 8, "128 suit one shape")
        check_at_least("octaves", octaves, 0, "5 follow details of a pixel at 128 x 128")
        check_positive("radius", radius, "0.5 lies within most objects")
        self.octaves, self.directional = octaves, directional
        inputs = [3 + 6 * octaves] + [width] * (layers - 1)
        self.hidden = nn.ModuleList(nn.Linear(size, width) for size in inputs)
        self.last, self.features = nn.Linear(width, 1), nn.Linear(width, width)
        self.colour = _colour_network(width, width, directional=directional)
        self._initialise_to_sphere(radius)

    @torch.no_grad()
    def _initialise_to_sphere(self, radius: float) -> None:
        for index, layer in enumerate(self.hidden):
            assert isinstance(layer, nn.Linear)
            layer.weight.normal_(0.0, sqrt(2 / len(layer.weight)))
            layer.bias.zero_()
            if index == 0:
                layer.weight[:, 3:] = 0.0
        self.last.weight.normal_(sqrt(pi / self.last.in_features), 1e-4)
        self.last.bias.zero_()
        sphere_points = radius * torch.nn.functional.normalize(torch.randn(INIT_SPHERE_POINTS, 3), dim=-1)
        self.last.bias.fill_(-self(sphere_points).mean())  # softplus is slightly above a ReLU

    @property
    def field(self) -> "ColouredDistance":
        """Itself; close to a distance if the loss has an eikonal term."""
        return self

    @property
    def flops(self) -> Flops:
        """Of one distance; see `flops_of`."""
        return flops_of(nn.ModuleList([*self.hidden, self.last]))

    def forward(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """The distances."""
        flat = points.reshape(-1, 3)
        chunks = [flat] if torch.is_grad_enabled() else split_into_passes(flat, self.last.in_features)
        return torch.cat([self.last(self._hidden(chunk)) for chunk in chunks]).view(points.shape[:-1])

    def colours(self, points: Vectors, normals: Vectors, directions: Vectors) -> Vectors:
        """See `Coloured`; directions are unused unless `directional`."""
        features = self.features(self._hidden(points))
        return _colours(self.colour, features, points, normals, directions if self.directional else None)

    def _hidden(self, points: Tensor) -> Tensor:
        features = positional_encoding(points, self.octaves)
        for layer in self.hidden:
            features = softplus(layer(features), beta=SOFTPLUS_BETA)
        return features


class ColouredEncoded(nn.Module):
    """A hash grid or Fourier features with a ReLU network of distances, and a colour network that takes them too.

    It is initialised to a sphere about the origin, see `ColouredDistance`; the encoding has zero weights.

    Source: `encoded.EncodedNetwork` for distances; colours of point, normal, direction and features as in IDR.
    Deviates: distances and colours share one encoding; the colours' features are those of the encoding.

    Args:
        encoding: its initial numbers. The tables of a hash grid are learnt, the frequencies of Fourier features not.
        layers: hidden layers of the distance network, at least 1.
        width: neurons per hidden layer; the colour network has two hidden layers.
        radius: of the initial sphere, in scene units.
        directional: whether colours depend on the view direction.
        slope_width: of central differences, in scene units, as gradients in losses and for colours (Neuralangelo, Li et
            al. 2023, Sec. 3.2; there it falls from a coarse to a fine grid's cell); 0: automatic differentiation.
    """

    kind: ClassVar[Kind] = Kind.DISTANCE
    lipschitz: ClassVar[None] = None

    def __init__(
        self,
        encoding: HashGrid | FourierFeatures,
        *,
        layers: int,
        width: int,
        radius: float,
        directional: bool,
        slope_width: float = 0.0,
    ) -> None:
        super().__init__()
        check_at_least("layers", layers, 1, "1 suits a hash grid, 4 suit Fourier features")
        check_positive("radius", radius, "0.5 lies within most objects")
        self.directional, self.slope_width = directional, slope_width
        if isinstance(encoding, HashGrid):
            self.cells, self.reach = encoding.cells, encoding.reach
            self.tables = nn.Parameter(encoding.tables)
        else:
            self.register_buffer("frequencies", encoding.frequencies)
        features = self.encoding(torch.zeros(1, 3)).shape[1]
        self.distance = nn.ModuleList(nn.Linear(*pair) for pair in pairwise([3 + features, *[width] * layers, 1]))
        self.colour = _colour_network(features, width, directional=directional)
        self._initialise_to_sphere(radius)

    @torch.no_grad()
    def _initialise_to_sphere(self, radius: float) -> None:
        layers = self._distance_layers
        for weight, bias in layers:
            weight.normal_(0.0, sqrt(2 / len(weight)))
            bias.zero_()
        layers[0][0][:, 3:] = 0.0
        last_weight, last_bias = layers[-1]
        last_weight.fill_(sqrt(pi / last_weight.shape[1]))
        sphere_points = radius * torch.nn.functional.normalize(torch.randn(INIT_SPHERE_POINTS, 3), dim=-1)
        last_bias.fill_(-self(sphere_points).mean())

    @property
    def _distance_layers(self) -> tuple[tuple[Tensor, Tensor], ...]:
        """The weight and the bias of each layer of the distance network."""
        return tuple((layer.weight, layer.bias) for layer in self.distance if isinstance(layer, nn.Linear))

    @property
    def encoding(self) -> Encoding:
        """The encoding with its current numbers."""
        if hasattr(self, "tables"):
            return HashGrid(self.tables, self.cells, self.reach)
        return FourierFeatures(self.get_buffer("frequencies"))

    @property
    def network(self) -> EncodedNetwork:
        """The field without colours."""
        return EncodedNetwork(self.encoding, self._distance_layers)

    @property
    def field(self) -> "ColouredEncoded":
        """Itself; close to a distance if the loss has an eikonal term."""
        return self

    @property
    def flops(self) -> Flops:
        """Of one distance."""
        return self.network.flops

    def forward(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """The distances."""
        return self.network(points)

    def colours(self, points: Vectors, normals: Vectors, directions: Vectors) -> Vectors:
        """See `Coloured`; directions are unused unless `directional`."""
        directions_used = directions if self.directional else None
        return _colours(self.colour, self.encoding(points), points, normals, directions_used)


class ColouredOccupancy(nn.Module):
    """DVR's network of one shape. Its colours depend on points alone, not on normals or directions.

    It is initialised to a sphere. Its blocks add 0, and a sum of many ReLUs of random directions grows with the
    distance from the origin (Atzmon and Lipman 2020, "SAL", Theorem 1).

    Source: DVR (Niemeyer et al. 2020), Secs. 3.1 and 3.5.
    Deviates: see `OccupancyNetwork`; the paper does not describe the initialisation.

    Args:
        width: neurons per layer.
        radius: of the initial sphere, in scene units.
    """

    def __init__(self, *, width: int, radius: float) -> None:
        super().__init__()
        check_positive("radius", radius, "0.5 lies within most objects")
        self.network = OccupancyNetwork(width=width, code_length=0)
        initialise_to_sphere(self.network, radius)

    @property
    def field(self) -> "OccupancyOf":
        """The level set at the current weights."""
        return OccupancyOf(self.network.at(self.network.first.weight.new_empty(0)))


@torch.no_grad()
def initialise_to_sphere(network: OccupancyNetwork, radius: float) -> None:
    """Sets the weights so that the shape is a sphere for every code; see `ColouredOccupancy`."""
    width = network.width
    half = torch.randn(width - width // 2, 3)
    network.first.weight.copy_(torch.cat([half, -half])[:width])
    network.first.bias.zero_()
    for layer in (*network.shifts, *(block.outer for block in network.blocks)):
        for weights in layer.parameters():  # pyright: ignore[reportAttributeAccessIssue, reportCallIssue]
            weights.zero_()
    head = network.occupancy_head
    head.weight.fill_(-1.0)
    head.bias.zero_()
    sphere_points = radius * torch.nn.functional.normalize(torch.randn(INIT_SPHERE_POINTS, 3), dim=-1)
    shape = OccupancyOf(network.at(head.weight.new_zeros(network.code_length)))
    head.weight.mul_(radius / LOGIT_WIDTH / shape(sphere_points).mean())
    head.bias.fill_(radius / LOGIT_WIDTH)


@dataclass(frozen=True)
class OccupancyOf:
    """The level set p = 1/2 of an occupancy network at one code (DVR, Sec. 3.1)."""

    bound: BoundOccupancy

    kind: ClassVar[Kind] = Kind.LEVEL
    lipschitz: ClassVar[None] = None

    @property
    def flops(self) -> Flops:
        """See `BoundOccupancy`."""
        return self.bound.flops

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return OccupancyField(self.bound.logits, OCCUPANCY_THRESHOLD)(points)

    def colours(self, points: Vectors, normals: Vectors, directions: Vectors) -> Vectors:
        return self.bound.colours(points)


@dataclass(frozen=True)
class ScaledOccupancyOf(OccupancyOf):
    """The scaled logits as a distance, for renderers that need one; training with an eikonal term makes it one."""

    kind: ClassVar[Kind] = Kind.DISTANCE

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return -LOGIT_WIDTH * self.bound.logits(points)


class ColouredGrid(nn.Module):
    """Distances and colours on a grid, interpolated linearly; initialised to a sphere.

    Args:
        samples: per axis.
        radius: of the initial sphere, in scene units.
        reach: half the cube's side, in scene units.
    """

    kind: ClassVar[Kind] = Kind.DISTANCE
    lipschitz: ClassVar[None] = None
    flops: ClassVar[Flops] = FLOPS

    def __init__(self, *, samples: int, radius: float, reach: float) -> None:
        super().__init__()
        check_at_least("samples", samples, 2, "48 suit one shape")
        check_positive("radius", radius, "0.5 lies within most objects")
        axis = torch.linspace(-reach, reach, samples)
        grid_points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
        self.distances = nn.Parameter(torch.linalg.vector_norm(grid_points, dim=-1) - radius)
        self.logits = nn.Parameter(torch.zeros(3, samples, samples, samples))
        self.reach = reach

    @property
    def field(self) -> "ColouredGrid":
        """Itself."""
        return self

    def forward(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """The distances."""
        return Grid(self.distances, self.reach)(points)

    def colours(self, points: Vectors, normals: Vectors, directions: Vectors) -> Vectors:
        zyx = (points.flip(-1) / self.reach).reshape(1, -1, 1, 1, 3)  # the order of `grid_sample`
        sampled = torch.nn.functional.grid_sample(self.logits[None], zyx, padding_mode="border", align_corners=True)
        return torch.sigmoid(COLOUR_LOGIT_SCALE * sampled.reshape(3, -1).T.reshape(points.shape))


def positional_encoding(vectors: Float[Tensor, "*batch 3"], octaves: int) -> Float[Tensor, "*batch encoding"]:
    """The vectors, and sine and cosine of 1, 2, 4, ... times each coordinate (NeRF, Eq. 4, without pi)."""
    scaled = [2.0**octave * vectors for octave in range(octaves)]
    return torch.cat([vectors, *(wave(x) for x in scaled for wave in (torch.sin, torch.cos))], dim=-1)
