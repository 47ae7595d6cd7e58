"""Fields with colours: of one shape, learnt from images and beginning as a sphere; or of a code."""

from dataclasses import dataclass
from itertools import pairwise
from math import pi, sqrt
from typing import ClassVar, Protocol, cast, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import softplus

from renderers.checks import check_at_least, check_positive
from renderers.field import Bounds, Field, Flops, Kind, OccupancyField, Wrapper, field_bounds
from renderers.fields.grid import FLOPS, Grid
from renderers.fields.mlp import BoundDecoder, Decoder, flops_of, passes
from renderers.fields.occupancy import BoundOccupancy, OccupancyNetwork

SHARPNESS = 100.0  # of softplus, as IDR has it: nearly a ReLU, with a second derivative
AROUND = 256  # points on the sphere that it begins as, where its mean value is made 0
DIRECTION_OCTAVES = 2  # of the encoding of view directions
LOGIT_WIDTH = 0.1  # scene units over which a logit of occupancy changes by 1 at its start
THRESHOLD = 0.5  # of occupancy: DVR's tau
COLOUR_SCALE = 20.0  # of a grid's logits of colours: Adam's steps have the size of those of distances
Vectors = Float[Tensor, "*batch 3"]


@runtime_checkable
class Coloured(Field, Protocol):
    """A field whose surface has colours."""

    def colours(self, points: Vectors, normals: Vectors, directions: Vectors) -> Vectors:
        """Red, green and blue from 0 to 1.

        Args:
            points: on the surface.
            normals: the field's gradients there; their graph leads colours to the shape.
            directions: of the rays that see the points, unit.
        """
        ...


class ColouredDistance(nn.Module):
    """A network of distance, and one of colour that takes its features, the point, and the normal and view direction.

    It begins as a sphere about the origin: the encoding has no weight yet, and the other weights are drawn so that
    values grow by one per unit (Atzmon and Lipman 2020, "SAL", Theorem 1; IDR, Sec. 4).

    Source: IDR (Yariv et al. 2020), Sec. 3.2 and its supplement: softplus, positional encoding; colours of point,
        normal, direction and features.
    Deviates: narrower; no skip; the features are a linear map of the last hidden layer.

    Args:
        layers: hidden layers of the distance, at least 1.
        width: neurons per hidden layer, and of each of the two hidden layers of the colour.
        octaves: of the encoding of points: sine and cosine of 1, 2, 4, ... times each coordinate.
        radius: of the sphere that it begins as, in scene units.
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
        seen = 3 + 6 * DIRECTION_OCTAVES if directional else 0
        sizes = [width + 6 + seen, width, width, 3]
        self.colour = nn.ModuleList(nn.Linear(*pair) for pair in pairwise(sizes))
        self._begin_as_sphere(radius)

    @torch.no_grad()
    def _begin_as_sphere(self, radius: float) -> None:
        for index, layer in enumerate(self.hidden):
            assert isinstance(layer, nn.Linear)
            layer.weight.normal_(0.0, sqrt(2 / len(layer.weight)))
            layer.bias.zero_()
            if index == 0:
                layer.weight[:, 3:] = 0.0
        self.last.weight.normal_(sqrt(pi / self.last.in_features), 1e-4)
        self.last.bias.zero_()
        around = radius * torch.nn.functional.normalize(torch.randn(AROUND, 3), dim=-1)
        self.last.bias.fill_(-self(around).mean())  # softplus is a little more than a ReLU

    @property
    def field(self) -> "ColouredDistance":
        """Itself; near enough to a distance where an eikonal term keeps it so."""
        return self

    @property
    def flops(self) -> Flops:
        """Of a distance; see `flops_of`."""
        return flops_of(nn.ModuleList([*self.hidden, self.last]))

    def forward(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """The distances."""
        flat = points.reshape(-1, 3)
        chunks = [flat] if torch.is_grad_enabled() else passes(flat, self.last.in_features)
        return torch.cat([self.last(self._hidden(chunk)) for chunk in chunks]).view(points.shape[:-1])

    def colours(self, points: Vectors, normals: Vectors, directions: Vectors) -> Vectors:
        """See `Coloured`; directions are unused unless `directional`."""
        seen = [encoded(directions, DIRECTION_OCTAVES)] if self.directional else []
        features = torch.cat([self.features(self._hidden(points)), points, normals, *seen], dim=-1)
        *layers, last = self.colour
        for layer in layers:
            features = layer(features).relu_()
        return torch.sigmoid(last(features))

    def _hidden(self, points: Tensor) -> Tensor:
        features = encoded(points, self.octaves)
        for layer in self.hidden:
            features = softplus(layer(features), beta=SHARPNESS)
        return features


class ColouredOccupancy(nn.Module):
    """DVR's network of one shape. Its colours are those of points alone, whatever normals and directions.

    It begins as a sphere: its blocks add nothing yet, and a sum of many ReLUs of random directions grows with the
    distance from the origin (Atzmon and Lipman 2020, "SAL", Theorem 1).

    Source: DVR (Niemeyer et al. 2020), Secs. 3.1 and 3.5.
    Deviates: see `OccupancyNetwork`; the paper does not say how it begins.

    Args:
        width: neurons per layer.
        radius: of the sphere that it begins as, in scene units.
    """

    def __init__(self, *, width: int, radius: float) -> None:
        super().__init__()
        check_positive("radius", radius, "0.5 lies within most objects")
        self.network = OccupancyNetwork(width=width, code_length=0)
        begin_as_sphere(self.network, radius)

    @property
    def field(self) -> "OccupancyOf":
        """The level set at the current weights."""
        return OccupancyOf(self.network.at(self.network.first.weight.new_empty(0)))


@torch.no_grad()
def begin_as_sphere(network: OccupancyNetwork, radius: float) -> None:
    """Sets the weights so that the shape is a sphere whatever the code; see `ColouredOccupancy`."""
    width = network.width
    half = torch.randn(width - width // 2, 3)
    network.first.weight.copy_(torch.cat([half, -half])[:width])
    network.first.bias.zero_()
    for added in (*network.shifts, *(block.outer for block in network.blocks)):
        for weights in added.parameters():  # pyright: ignore[reportAttributeAccessIssue, reportCallIssue]
            weights.zero_()
    head = network.occupancy_head
    head.weight.fill_(-1.0)
    head.bias.zero_()
    around = radius * torch.nn.functional.normalize(torch.randn(AROUND, 3), dim=-1)
    shape = OccupancyOf(network.at(head.weight.new_zeros(network.code_length)))
    head.weight.mul_(radius / LOGIT_WIDTH / shape(around).mean())
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
        return OccupancyField(self.bound.logits, THRESHOLD)(points)

    def colours(self, points: Vectors, normals: Vectors, directions: Vectors) -> Vectors:
        return self.bound.colours(points)


@dataclass(frozen=True)
class ScaledOccupancyOf(OccupancyOf):
    """The same network read as a distance, for renderers of distances: an eikonal term makes it one."""

    kind: ClassVar[Kind] = Kind.DISTANCE

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return -LOGIT_WIDTH * self.bound.logits(points)


class ColouredGrid(nn.Module):
    """Distances and colours on a grid, interpolated linearly; it begins as a sphere.

    Args:
        samples: per axis.
        radius: of the sphere, in scene units.
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
        places = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
        self.distances = nn.Parameter(torch.linalg.vector_norm(places, dim=-1) - radius)
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
        places = (points.flip(-1) / self.reach).reshape(1, -1, 1, 1, 3)  # it takes z, y and x
        sampled = torch.nn.functional.grid_sample(self.logits[None], places, padding_mode="border", align_corners=True)
        return torch.sigmoid(COLOUR_SCALE * sampled.reshape(3, -1).T.reshape(points.shape))


class TexturedDecoder(nn.Module):
    """A decoder of distance, of the first half of a code, and one of colour, of the whole code.

    Source: DIST, B.1: a shape code and a texture code of 256 each; the texture network takes both.
    Deviates: colours are a sigmoid of its outputs; it has no narrowed layer before the skip, which needs a width above
        the code's length.

    Args:
        layers, width, skip: of both; see `Decoder`.
        code_length: of both codes together, even.
        narrow: of the decoder of distance.
    """

    def __init__(self, *, layers: int, width: int, code_length: int, skip: int, narrow: bool) -> None:
        super().__init__()
        if code_length % 2:
            raise ValueError(f"code_length must be even, not {code_length}: a half of it is the shape's")
        self.code_length, self.width = code_length, width
        self.shape = Decoder(layers=layers, width=width, code_length=code_length // 2, skip=skip, narrow=narrow)
        self.texture = Decoder(layers=layers, width=width, code_length=code_length, skip=skip, narrow=False, outputs=3)

    def at(self, code: Float[Tensor, "*shapes code_length"]) -> "TexturedShape":
        """The field of one code, or of a batch of codes."""
        shape = self.shape.at(code[..., : self.code_length // 2])
        return TexturedShape(cast(Field, shape), self.texture.at(code))


@dataclass(frozen=True)
class TexturedShape(Wrapper):
    """The field of a `TexturedDecoder` at one code, whose colours are those of points alone, and not counted."""

    inner: Field
    texture: BoundDecoder

    @property
    def bounds(self) -> Bounds | None:
        """See `BoundDecoder`."""
        return field_bounds(self.inner)

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return self.inner(points)

    def paint(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """The colours of points."""
        return torch.sigmoid(self.texture.outputs(points))

    def colours(self, points: Vectors, normals: Vectors, directions: Vectors) -> Vectors:
        return self.paint(points)


def encoded(vectors: Float[Tensor, "*batch 3"], octaves: int) -> Float[Tensor, "*batch encoding"]:
    """The vectors, and sine and cosine of 1, 2, 4, ... times each coordinate (NeRF, Eq. 4, without pi)."""
    scaled = [2.0**octave * vectors for octave in range(octaves)]
    return torch.cat([vectors, *(wave(each) for each in scaled for wave in (torch.sin, torch.cos))], dim=-1)
