"""A ReLU network's values by compiled code, in place of rows of PyTorch's operations."""

import ctypes
from collections.abc import Sequence
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from renderers.kernels.library import kernels

Layer = tuple[Tensor, Tensor]  # weight [out, in] and bias [out]


class _Decoder(ctypes.Structure):
    """See `Decoder` in decoder.cpp."""

    _fields_: ClassVar = [
        *((name, ctypes.c_int) for name in ("layers", "skip")),
        *((name, ctypes.c_void_p) for name in ("inputs", "outputs", "weights", "biases", "last")),
        ("last_bias", ctypes.c_float),
    ]


class CompiledDecoder:
    """The network of one code; it has copies of the numbers. All is without a graph, and by one thread."""

    def __init__(self, library: ctypes.CDLL, hidden: Sequence[Layer], last: Layer, skip: int) -> None:
        block = library.decoder_block()
        layers = [_padded(weight.detach(), bias.detach(), block) for weight, bias in hidden]
        inputs, outputs = ([weight.shape[side] for weight, _ in layers] for side in (1, 0))
        final = torch.nn.functional.pad(last[0].detach().flatten(), (0, outputs[-1] - last[0].shape[1]))
        columns = [weight.view(-1, block, weight.shape[1]).transpose(1, 2).contiguous() for weight, _ in layers]
        biases = [bias for _, bias in layers]
        tables = [(ctypes.c_int * len(layers))(*sizes) for sizes in (inputs, outputs)]
        tables += [(ctypes.c_void_p * len(layers))(*(one.data_ptr() for one in many)) for many in (columns, biases)]
        places = [ctypes.addressof(table) for table in tables]
        self.library, self.network = library, _Decoder(len(layers), skip, *places, final.data_ptr(), float(last[1]))
        self.kept = columns, biases, final, tables  # what the network points to

    def values(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """The values at points."""
        points = points.detach().contiguous()
        found = points.new_empty(len(points))
        self.library.decoder_values(ctypes.addressof(self.network), points.data_ptr(), len(points), found.data_ptr())
        return found


def compiled(hidden: Sequence[Layer], last: Layer, skip: int) -> CompiledDecoder | None:
    """The compiled network; None where there is no compiled code for it.

    Args:
        hidden: layers of one code, each followed by a ReLU.
        last: layer, with one output.
        skip: index of the hidden layer whose input ends in the point; 0 for none.
    """
    tensors = (tensor for layer in (*hidden, last) for tensor in layer)
    suits = all(tensor.dtype == torch.float32 and tensor.device.type == "cpu" for tensor in tensors)
    library = kernels().library if suits else None
    return None if library is None else CompiledDecoder(library, hidden, last, skip)


def _padded(weight: Tensor, bias: Tensor, block: int) -> Layer:
    """A layer with neurons that give 0 added to it, up to a multiple of the block."""
    more = -len(bias) % block
    return torch.nn.functional.pad(weight, (0, 0, 0, more)), torch.nn.functional.pad(bias, (0, more))
