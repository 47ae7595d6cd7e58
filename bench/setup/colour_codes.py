"""Codes of shape and colour (DIST, B.1): the settings and the loss of the colours that a prior learns."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from datasets.mesh import Mesh
from datasets.scene import Dataset, Split, Textured, sample_surface, seed_of
from datasets.textures import TEXTURES, Texture, make_texture
from renderers.checks import check_at_least, check_choice, check_positive
from renderers.fields.textured import TexturedDecoder, TexturedShape

Samples = Float[Tensor, "shapes samples 3"]  # points on surfaces, or their colours


@dataclass(frozen=True)
class ColourSettings:
    """The settings of the colours that a prior learns.

    Args:
        texture, size: of shapes whose dataset has no colours; see `datasets.textures.make_texture`.
        samples: points on the surface of each shape.
        points_per_step: number of these points per shape in a step.
        weight: of the mean absolute error of colours.
    """

    texture: str
    size: float
    samples: int
    points_per_step: int
    weight: float

    def __post_init__(self) -> None:
        check_choice("prior.colour.texture", self.texture, TEXTURES)
        check_positive("prior.colour.size", self.size, "0.3 suits shapes in the unit sphere")
        check_at_least("prior.colour.samples", self.samples, 1, "8000 work")
        check_at_least("prior.colour.points_per_step", self.points_per_step, 1, "64 work")
        check_positive("prior.colour.weight", self.weight, "0.1 works")

    def new_decoder(self, **network: Any) -> TexturedDecoder:
        """A decoder of shapes with colours; its decoder of distances is `shape`."""
        return TexturedDecoder(**network)

    def texture_of(self, dataset: Dataset, split: Split, index: int) -> Texture:
        """The colours of a shape: of its dataset if that has colours, else of the texture."""
        if isinstance(dataset, Textured):
            return dataset.texture(split, index)
        return make_texture(self.texture, self.size, seed_of(split, index))

    def sampled(self, mesh: Mesh, texture: Texture, seed: int) -> tuple[Tensor, Tensor]:
        """Points on a mesh [samples, 3] and their colours [samples, 3]."""
        surface = sample_surface(mesh, self.samples, seed)
        arrays = surface.points, texture(surface.points, surface.normals)
        points, colours = (torch.from_numpy(array.astype(np.float32)) for array in arrays)
        return points, colours

    def loss(
        self, shape: TexturedShape, surface: Samples, colours: Samples, chosen: Int[Tensor, " rows"]
    ) -> Float[Tensor, ""]:
        """The weighted mean absolute error of colours at random points on the surfaces of the chosen shapes."""
        indices = torch.randint(surface.shape[1], (len(chosen), self.points_per_step), device=chosen.device)
        predicted = shape.paint(surface[chosen[:, None], indices])
        return self.weight * (predicted - colours[chosen[:, None], indices]).abs().mean()
