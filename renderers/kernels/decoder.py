"""The values of a ReLU network by compiled code instead of PyTorch's operations."""

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
    """The decoder at one code, with copies of its weights. It runs without a graph, on one thread."""

    def __init__(self, library: ctypes.CDLL, hidden: Sequence[Layer], last: Layer, skip: int) -> None:
        block = library.decoder_block()
        layers = [_pad(weight.detach(), bias.detach(), block) for weight, bias in hidden]
        inputs, outputs = ([weight.shape[side] for weight, _ in layers] for side in (1, 0))
        final = torch.nn.functional.pad(last[0].detach().flatten(), (0, outputs[-1] - last[0].shape[1]))
        columns = [weight.view(-1, block, weight.shape[1]).transpose(1, 2).contiguous() for weight, _ in layers]
        biases = [bias for _, bias in layers]
        tables = [(ctypes.c_int * len(layers))(*sizes) for sizes in (inputs, outputs)]
        tables += [(ctypes.c_void_p * len(layers))(*(t.data_ptr() for t in tensors)) for tensors in (columns, biases)]
        addresses = [ctypes.addressof(table) for table in tables]
        self.library, self.network = library, _Decoder(len(layers), skip, *addresses, final.data_ptr(), float(last[1]))
        self.referenced = columns, biases, final, tables  # keeps alive what the network points to

    def values(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """The values at points."""
        points = points.detach().contiguous()
        values = points.new_empty(len(points))
        self.library.decoder_values(ctypes.addressof(self.network), points.data_ptr(), len(points), values.data_ptr())
        return values


def compile_decoder(hidden: Sequence[Layer], last: Layer, skip: int) -> CompiledDecoder | None:
    """The compiled decoder; None if there is no compiled code for it.

    Args:
        hidden: layers at one code, each followed by a ReLU.
        last: the layer with one output.
        skip: index of the hidden layer whose input ends with the point; 0 for none.
    """
    tensors = (tensor for layer in (*hidden, last) for tensor in layer)
    is_supported = all(tensor.dtype == torch.float32 and tensor.device.type == "cpu" for tensor in tensors)
    library = kernels().library if is_supported else None
    return None if library is None else CompiledDecoder(library, hidden, last, skip)


def _pad(weight: Tensor, bias: Tensor, block: int) -> Layer:
    """Adds neurons with output 0 to a layer, up to a multiple of `block`."""
    missing = -len(bias) % block
    return torch.nn.functional.pad(weight, (0, 0, 0, missing)), torch.nn.functional.pad(bias, (0, missing))
