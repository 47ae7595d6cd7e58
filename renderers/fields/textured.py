"""A decoder of shapes with colours, and its field at one code."""

from dataclasses import dataclass
from typing import ClassVar, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from renderers.field import Field, Vectors, Wrapper
from renderers.fields.mlp import BoundDecoder, Decoder


class TexturedDecoder(nn.Module):
    """A distance decoder of the first half of a code, and a colour decoder of the whole code.

    Source: DIST, B.1: a shape code and a texture code of 256 each; the texture network takes both.
    Deviates: colours are a sigmoid of the outputs. The colour decoder has no narrowed layer before the skip, which
        needs a width above the code's length.

    Args:
        layers, width, skip: of both decoders; see `Decoder`.
        code_length: of both codes together, even.
        narrow: of the distance decoder.
    """

    def __init__(self, *, layers: int, width: int, code_length: int, skip: int, narrow: bool) -> None:
        super().__init__()
        if code_length % 2:
            raise ValueError(f"code_length must be even, not {code_length}: a half of it is the shape's")
        self.code_length, self.width, self.code_is_position = code_length, width, False
        self.shape = Decoder(layers=layers, width=width, code_length=code_length // 2, skip=skip, narrow=narrow)
        self.texture = Decoder(layers=layers, width=width, code_length=code_length, skip=skip, narrow=False, outputs=3)

    def at(self, code: Float[Tensor, "*shapes code_length"]) -> "TexturedShape":
        """The field of one code, or of a batch of codes."""
        shape = self.shape.at(code[..., : self.code_length // 2])
        return TexturedShape(cast(Field, shape), self.texture.at(code))


@dataclass(frozen=True)
class TexturedShape(Wrapper):
    """The field of a `TexturedDecoder` at one code. Colours depend on points alone and are not counted as cost."""

    inner: Field
    texture: BoundDecoder
    keeps_values: ClassVar[bool] = True

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return self.inner(points)

    def paint(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """The colours of points."""
        return torch.sigmoid(self.texture.outputs(points))

    def colours(self, points: Vectors, normals: Vectors, directions: Vectors) -> Vectors:
        return self.paint(points)
