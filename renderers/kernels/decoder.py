"""The values of a ReLU network and their gradients, by compiled code instead of PyTorch's operations."""

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
        *((name, ctypes.c_void_p) for name in ("inputs", "outputs", "weights", "biases")),
        *((name, ctypes.c_void_p) for name in ("transposed", "point_weights", "last")),
        ("last_bias", ctypes.c_float),
    ]


class CompiledDecoder:
    """The decoder at one code, with copies of its weights. It runs without a graph, on one thread."""

    def __init__(self, library: ctypes.CDLL, hidden: Sequence[Layer], last: Layer, skip: int) -> None:
        block = library.decoder_block()
        layers = [_pad(weight.detach(), bias.detach(), block) for weight, bias in hidden]
        weights, biases = zip(*layers, strict=True)
        inputs, outputs = ([weight.shape[side] for weight in weights] for side in (1, 0))
        final = torch.nn.functional.pad(last[0].detach().flatten(), (0, outputs[-1] - last[0].shape[1]))
        columns = [weight.view(-1, block, weight.shape[1]).transpose(1, 2).contiguous() for weight in weights]
        self.widths, self.padded_widths = [len(bias) for _, bias in hidden], outputs
        pairs = zip(weights[1:], self.widths, outputs, strict=False)
        transposed = [None, *(_transpose(weight[:, :width], padded, block) for weight, width, padded in pairs)]
        point_weights = [w[:, -3:].T.contiguous() if index in (0, skip) else None for index, w in enumerate(weights)]
        tables = [(ctypes.c_int * len(layers))(*sizes) for sizes in (inputs, outputs)]
        tables += [_addresses(tensors) for tensors in (columns, biases, transposed, point_weights)]
        pointers = [ctypes.addressof(table) for table in tables]
        self.library, self.network = library, _Decoder(len(layers), skip, *pointers, final.data_ptr(), float(last[1]))
        self.referenced = columns, biases, transposed, point_weights, final, tables  # what the network points to

    def values(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """The values at points."""
        points = points.detach().contiguous()
        values = points.new_empty(len(points))
        self.library.decoder_values(ctypes.addressof(self.network), points.data_ptr(), len(points), values.data_ptr())
        return values

    def gradients(
        self, points: Float[Tensor, "n 3"], to_values: Float[Tensor, " n"], wanted: Sequence[bool]
    ) -> tuple[Float[Tensor, "n 3"], list[Float[Tensor, " width"] | None]]:
        """From the gradients of the values at points to those of the points, and of the biases of `wanted` layers."""
        points, to_values = points.detach().contiguous(), to_values.contiguous()
        to_points = torch.zeros_like(points)
        widths = zip(self.padded_widths, wanted, strict=True)
        sums = [points.new_zeros(width) if is_wanted else None for width, is_wanted in widths]
        arguments = points.data_ptr(), len(points), to_values.data_ptr(), to_points.data_ptr(), _addresses(sums)
        self.library.decoder_gradients(ctypes.addressof(self.network), *arguments)
        return to_points, [None if s is None else s[:n] for s, n in zip(sums, self.widths, strict=True)]


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


def _transpose(weight: Tensor, padded_width: int, block: int) -> Tensor:
    """A layer's weights of the features before it: [padded width / block][outputs][block]."""
    columns = torch.nn.functional.pad(weight, (0, padded_width - weight.shape[1]))
    return columns.view(len(weight), -1, block).transpose(0, 1).contiguous()


def _addresses(tensors: Sequence[Tensor | None]) -> ctypes.Array[ctypes.c_void_p]:
    """Where the tensors' numbers are; null for None."""
    return (ctypes.c_void_p * len(tensors))(*(None if tensor is None else tensor.data_ptr() for tensor in tensors))
