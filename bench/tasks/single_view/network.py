"""A network from an image to a code, and from a code to a shape with colours (DVR, Secs. 3.1, 3.5)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from renderers.checks import check_at_least, check_choice, check_positive
from renderers.fields.networks.coloured import OccupancyOf, ScaledOccupancyOf, initialise_to_sphere
from renderers.fields.networks.occupancy import OccupancyNetwork

OCCUPANCY, DISTANCE = "occupancy", "distance"
FIELD_CLASSES = {OCCUPANCY: OccupancyOf, DISTANCE: ScaledOccupancyOf}
FEATURE_GRID_SIDE = 4  # the encoder's last features are averaged to so many rows and columns
CODE_STD = 0.3  # standard deviation within a code
NORM_GROUPS = 8  # the channels of a group are normalised together


@dataclass(frozen=True)
class SingleViewNetwork:
    """The sizes of a `SingleView`.

    Args:
        channels: of each stage of the encoder, a multiple of 8.
        blocks: residual blocks in each stage.
        code_length: numbers in a code.
        width: of the decoder.
        reads: the decoder's values as "occupancy", for DVR, or as "distance", for every renderer.
        radius: of the initial sphere of all shapes, in scene units.
    """

    channels: tuple[int, ...]
    blocks: int
    code_length: int
    width: int
    reads: str
    radius: float

    def __post_init__(self) -> None:
        check_at_least("the length of task.network.channels", len(self.channels), 1, "[16, 32, 64, 128]")
        if any(count < NORM_GROUPS or count % NORM_GROUPS for count in self.channels):
            raise ValueError(f"task.network.channels must be multiples of {NORM_GROUPS}, not {list(self.channels)}")
        for name in ("blocks", "code_length", "width"):
            check_at_least(f"task.network.{name}", getattr(self, name), 1, "conf/scale has values that work")
        check_choice("task.network.reads", self.reads, tuple(FIELD_CLASSES))
        check_positive("task.network.radius", self.radius, "0.5 lies within most objects")


class SingleView(nn.Module):
    """An encoder of images and a decoder of codes.

    Source: DVR (Niemeyer et al. 2020), Sec. 3.5: a ResNet-18 whose last layer gives a code of 256, and the network of
        `OccupancyNetwork`.
    Deviates: the ResNet is not pre-trained; the mask is an input too; groups of channels are normalised, not batches,
        since a step has few images, and before each convolution; nothing is pooled after the first convolution; the
        last features keep 4 x 4 positions, and a code is normalised; at desk scale it has one block in each of four
        narrow stages; the initial shape is a sphere.
    """

    def __init__(self, settings: SingleViewNetwork) -> None:
        super().__init__()
        self.settings = settings
        self.stages, self.code = encoder(4, settings.channels, settings.blocks, settings.code_length)
        self.decoder = OccupancyNetwork(width=settings.width, code_length=settings.code_length)
        initialise_to_sphere(self.decoder, settings.radius)

    def forward(self, images: Float[Tensor, "batch 4 height width"]) -> Float[Tensor, "batch code_length"]:
        """The codes of images; see `bench.tasks.single_view.images.as_input`."""
        code = self.code(self.stages(2 * images - 1))
        return CODE_STD * torch.nn.functional.layer_norm(code, code.shape[-1:])

    def at(self, code: Float[Tensor, " code_length"]) -> OccupancyOf:
        return FIELD_CLASSES[self.settings.reads](self.decoder.at(code))


def encoder(inputs: int, channels: Sequence[int], blocks: int, code_length: int) -> tuple[nn.Sequential, nn.Linear]:
    """A residual network from images [batch, inputs, height, width] to features, and a last layer to codes."""
    stages: list[nn.Module] = [nn.Conv2d(inputs, channels[0], 7, stride=2, padding=3, bias=False)]
    in_channels = channels[0]
    for stage, width in enumerate(channels):
        for block in range(blocks):
            stages.append(_Residual(in_channels, width, 2 if stage and not block else 1))
            in_channels = width
    features = nn.Sequential(*stages, nn.ReLU(), nn.AdaptiveAvgPool2d(FEATURE_GRID_SIDE), nn.Flatten())
    return features, nn.Linear(in_channels * FEATURE_GRID_SIDE**2, code_length)


class _Residual(nn.Module):
    """Two convolutions, each after a normalisation, with a skip connection (He et al. 2016)."""

    def __init__(self, in_channels: int, channels: int, stride: int) -> None:
        super().__init__()
        self.first_norm, self.second_norm = nn.GroupNorm(NORM_GROUPS, in_channels), nn.GroupNorm(NORM_GROUPS, channels)
        self.first = nn.Conv2d(in_channels, channels, 3, stride=stride, padding=1, bias=False)
        self.second = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        is_same_shape = in_channels == channels and stride == 1
        self.skip = nn.Identity() if is_same_shape else nn.Conv2d(in_channels, channels, 1, stride=stride, bias=False)

    def forward(self, features: Tensor) -> Tensor:
        active = torch.relu(self.first_norm(features))
        return self.skip(features) + self.second(torch.relu(self.second_norm(self.first(active))))
