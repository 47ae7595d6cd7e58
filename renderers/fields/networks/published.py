"""Networks that others trained, from their weights by name: one function for each format of a checkpoint.

A format does not define sign, level and slope of its values. They are measured, see `network.measure_field`.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import sqrt
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from renderers.checks import BadInput
from renderers.fields.mlp import Decoder
from renderers.fields.networks.coloured import positional_encoding
from renderers.fields.networks.network import Coded, Published

SIGNED = r"(?:implicit_network|sdf_network\w*)"  # the name of IDR's, NeuS's and VolSDF's network
LAYERS = r"lin(\d+)\."  # followed by weight or bias
# Length and direction of a weight that torch normalises, in its older and its newer names.
NORMALISED = (("weight_g", "weight_v"), ("parametrizations.weight.original0", "parametrizations.weight.original1"))
SOFTPLUS_NOTE = "softplus with beta 100 between layers is assumed, as in IDR, NeuS and VolSDF"
MAX_FREQUENCIES = 12  # IDR, NeuS and VolSDF have 6
SOFTPLUS_BETA = 100  # as IDR, NeuS and VolSDF
ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    **{"relu": torch.relu, "elu": nn.functional.elu, "tanh": torch.tanh, "sin": torch.sin, "cos": torch.cos},
    **{"sigmoid": torch.sigmoid, "softplus": lambda x: nn.functional.softplus(x, beta=SOFTPLUS_BETA)},
}
Layer = tuple[Tensor, Tensor]


class Weights:
    """The float32 tensors of a checkpoint by name. Each of them must be taken once.

    Args:
        tensors: by name.
        pattern: of the prefix of the network's names, such as `model.`; tensors without the prefix are ignored.
        whose: the name of the checkpoint in error messages.

    Raises:
        BadInput: if no name matches, or if several prefixes match the same number of names.
    """

    def __init__(self, tensors: Mapping[str, Tensor], pattern: str = "", whose: str = "the network") -> None:
        prefixes = [match[0] for name in tensors if (match := re.match(pattern, name))]
        if not prefixes:
            raise BadInput(f"it has no layers of this format: it has {', '.join([*tensors][:6]) or 'no tensors'}")
        self.whose, self.prefix = whose, choose_prefix(prefixes)
        names = [name for name in tensors if name.startswith(self.prefix)]
        self.remaining = {name.removeprefix(self.prefix): tensors[name].float() for name in names}

    def has(self, name: str) -> bool:
        """Whether a tensor remains whose name is `name`, or begins with `name` and a dot."""
        return name in self.remaining or any(key.startswith(f"{name}.") for key in self.remaining)

    def take(self, name: str, *shape: int) -> Tensor:
        """Takes a tensor; -1 in `shape` is any size. Raises BadInput if it is missing or has another shape."""
        if name not in self.remaining:
            raise BadInput(f"{self.whose} lacks {self.prefix}{name}: it has {self._summary()}")
        tensor = self.remaining.pop(name)
        sizes = tensor.shape
        if shape and (len(shape) != len(sizes) or any(n not in (-1, sizes[i]) for i, n in enumerate(shape))):
            expected, actual = " x ".join("any" if n == -1 else str(n) for n in shape), " x ".join(map(str, sizes))
            raise BadInput(f"{self.whose}: {self.prefix}{name} must be {expected}, not {actual}")
        return tensor

    def layer(self, name: str, inputs: int = -1, outputs: int = -1) -> Layer:
        """Takes weight [out, in] and bias of a layer or a convolution of size 1; resolves weight normalisation."""
        for length, direction in NORMALISED:
            if f"{name}.{direction}" in self.remaining:
                weight = self.take(f"{name}.{direction}", outputs, inputs)
                weight = scale_to_length(weight, self.take(f"{name}.{length}", len(weight), 1))
                break
        else:
            full = f"{name}.weight"
            if full in self.remaining and self.remaining[full].dim() == 3:  # a convolution
                self.remaining[full] = self.remaining[full].squeeze(-1)
            weight = self.take(full, outputs, inputs)
        return weight, self.take(f"{name}.bias", len(weight))

    def count(self, pattern: str) -> int:
        """The number of layers, from the largest number in their names; raises BadInput if there is none."""
        numbers = [int(match[1]) for name in self.remaining if (match := re.match(pattern, name))]
        if not numbers:
            raise BadInput(f"{self.whose} has no layers {self.prefix}{pattern}: it has {self._summary()}")
        return max(numbers) + 1

    def finish(self) -> None:
        """Raises BadInput if tensors remain that no layer took."""
        if self.remaining:
            raise BadInput(f"{self.whose} has weights of another network: {self._summary()}")

    def _summary(self) -> str:
        shown, more = [f"{self.prefix}{name}" for name in [*self.remaining][:6]], len(self.remaining) - 6
        return ", ".join(shown) + (f" and {more} more" if more > 0 else "") or "nothing"


def choose_prefix(prefixes: Iterable[str]) -> str:
    """The prefix that occurs most often; of equals, the one that all of them begin with.

    Raises:
        BadInput: if there is none such.
    """
    counts = Counter(prefixes)
    equals = [prefix for prefix, count in counts.items() if count == max(counts.values())]
    shortest = min(equals, key=len)
    if not all(prefix.startswith(shortest) for prefix in equals):
        raise BadInput(f"it has several networks, {', '.join(equals)}: save the state_dict() of one of them")
    return shortest


def length_of(direction: Tensor, shape: Sequence[int]) -> Tensor:
    """The lengths of a weight's vectors, in a shape that has size 1 along each vector, as torch normalises weights."""
    axes = [axis for axis in range(direction.dim()) if len(shape) != direction.dim() or shape[axis] == 1]
    return torch.linalg.vector_norm(direction, dim=axes, keepdim=True) if axes else direction.abs()


def scale_to_length(direction: Tensor, length: Tensor) -> Tensor:
    """A weight from its direction, of any length, and its length."""
    return direction * (length / length_of(direction, length.shape))


class Layered(nn.Module):
    """Fully connected layers with an activation between them, and with skip connections from the input.

    Args:
        layers: weight and bias of each.
        activation: one of `ACTIVATIONS`.
        again: by index of a layer that also takes the input: True for the whole input, False for the points only.
        frequencies: of the positional encoding of the points; see `positional_encoding`.
        shrink: a factor of features and input at a skip connection.
        norms: weight and bias of a layer normalisation, by index of the layer before it.
    """

    def __init__(
        self,
        layers: Sequence[Layer],
        *,
        activation: str,
        again: Mapping[int, bool] | None = None,
        frequencies: int = 0,
        shrink: float = 1.0,
        norms: Mapping[int, Layer] | None = None,
    ) -> None:
        super().__init__()
        self.weights = nn.ParameterList(weight for weight, _ in layers)
        self.biases = nn.ParameterList(bias for _, bias in layers)
        self.activation, self.again, self.frequencies, self.shrink = activation, dict(again or {}), frequencies, shrink
        layer_norms = {str(i): _set_weights(nn.LayerNorm(len(norm[0])), norm) for i, norm in (norms or {}).items()}
        self.norms = nn.ModuleDict(layer_norms)

    def forward(self, points: Tensor, code: Tensor) -> Tensor:
        inputs = torch.cat([code.expand(len(points), -1), positional_encoding(points, self.frequencies)], dim=-1)
        features, activation = inputs, ACTIVATIONS[self.activation]
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            if index in self.again:
                features = torch.cat([features, inputs if self.again[index] else points], dim=-1) * self.shrink
            features = linear(features, weight, bias)
            if index + 1 < len(self.weights):
                features = activation(self.norms[str(index)](features) if str(index) in self.norms else features)
        return features[:, 0]


class Residual(nn.Module):
    """ResNet blocks of points and a code, as in occupancy networks and DVR; the value is the first output, a logit.

    A block is x + B relu(A relu(x)). The code is added to the features before blocks (`shifts`), or it scales and
    shifts the input of each relu by conditional batch normalisation (`norms`: two per block, and one after the last).
    """

    def __init__(
        self,
        first: Layer,
        blocks: Sequence[tuple[Layer, Layer]],
        last: Layer,
        *,
        shifts: dict[int, Layer],
        norms: list["Norm"],
    ) -> None:
        super().__init__()
        self.first, self.last = _linear(first), _linear(last)
        self.blocks = nn.ModuleList(nn.ModuleList(map(_linear, block)) for block in blocks)
        self.shifts = nn.ModuleDict({str(index): _linear(layer) for index, layer in shifts.items()})
        self.norms = nn.ModuleList(norms)

    def forward(self, points: Tensor, code: Tensor) -> Tensor:
        features = self.first(points)
        for index, block in enumerate(self.blocks):
            assert isinstance(block, nn.ModuleList)
            inner, outer = block
            if str(index) in self.shifts:
                features = features + self.shifts[str(index)](code)
            between = inner(self._activate(features, code, 2 * index))
            features = features + outer(self._activate(between, code, 2 * index + 1))
        return self.last(self._activate(features, code, 2 * len(self.blocks)))[:, 0]

    def _activate(self, features: Tensor, code: Tensor, index: int) -> Tensor:
        return (self.norms[index](features, code) if self.norms else features).relu()


class Norm(nn.Module):
    """Conditional batch normalisation in evaluation mode, with the stored mean and variance."""

    mean: Tensor
    deviation: Tensor

    def __init__(self, weights: Weights, name: str, code_length: int) -> None:
        super().__init__()
        kind = "conv" if weights.has(f"{name}.conv_gamma") else "fc"
        self.gamma, self.beta = (_linear(weights.layer(f"{name}.{kind}_{x}", code_length)) for x in ("gamma", "beta"))
        self.register_buffer("mean", weights.take(f"{name}.bn.running_mean", -1))
        self.register_buffer("deviation", (weights.take(f"{name}.bn.running_var", -1) + 1e-5).sqrt())
        weights.remaining.pop(f"{name}.bn.num_batches_tracked", None)

    def forward(self, features: Tensor, code: Tensor) -> Tensor:
        return self.gamma(code) * (features - self.mean) / self.deviation + self.beta(code)


def load_deepsdf(tensors: Mapping[str, Tensor], specs: Mapping[str, Any], *, squash: int | None = None) -> Published:
    """The decoder of DeepSDF (Park et al. 2019), as the official code builds it from specs.json, without dropout.

    Args:
        tensors: `model_state_dict`, with any prefix; weight normalisation in torch's format of 2019 or today.
        specs: specs.json, with `NetworkSpecs` and `CodeLength`.
        squash: number of tanh after the last layer. None counts one for `use_tanh`, and one that the code of 2019
            always applies; newer code, which writes `geom_dimension`, does not.
    """
    network, code_length, dims = _check_specs(specs)
    weights = Weights(tensors, rf"(?:.*\.)?(?={LAYERS})", "ModelParameters")
    again, input_size = {}, code_length + 3
    latent_in, every_layer = network.get("latent_in") or (), bool(network.get("xyz_in_all"))
    norm_layers = set(network.get("norm_layers") or ()) if not network.get("weight_norm") else set()
    layers, norms, widths = [], {}, [input_size, *dims, 1]
    for index, inputs in enumerate(widths[:-1]):
        last = index == len(dims)
        if index and (index in latent_in or every_layer):
            again[index] = index in latent_in
        joined_size = input_size if index + 1 in latent_in else 3 if every_layer and not last else 0
        layers.append(weights.layer(f"lin{index}", inputs, max(widths[index + 1] - joined_size, 0)))
        if index in norm_layers:
            norms[index] = tuple(weights.take(f"bn{index}.{name}", len(layers[-1][1])) for name in ("weight", "bias"))
    weights.finish()
    if squash is None:
        squash = bool(network.get("use_tanh")) + ("geom_dimension" not in network)
    if not norms and list(again.values()) in ([], [True]) and len(dims) not in again:
        return Published(decoder_of(layers, code_length=code_length, skip=next(iter(again), 0)), squash)
    body = Layered(layers, activation="relu", again=again, norms=norms)
    return Published(Coded(body, code_length=code_length, width=max(dims)), squash)


def _check_specs(specs: Any) -> tuple[Mapping[str, Any], int, list[int]]:
    """The `NetworkSpecs` of a specs.json, its `CodeLength` and `dims`; raises BadInput if they are invalid."""
    network = specs.get("NetworkSpecs") if isinstance(specs, dict) else None
    if not isinstance(network, dict):
        raise BadInput(f"specs.json must have NetworkSpecs, an object, not {network!r}: take that of the training")
    numbers = {key: network.get(key) or [] for key in ("dims", "latent_in", "norm_layers")}
    numbers |= {"CodeLength": [specs.get("CodeLength")], "geom_dimension": [network.get("geom_dimension", 3)]}
    wrong = [k for k, v in numbers.items() if type(v) is not list or any(type(n) is not int or n < 0 for n in v)]
    wrong += [] if numbers["dims"] else ["dims"]
    wrong += [key for key in ("xyz_in_all", "use_tanh", "weight_norm") if type(network.get(key) or False) is not bool]
    if wrong:
        shown = ", ".join(f"{key} {(specs if key == 'CodeLength' else network).get(key)!r}" for key in wrong)
        raise BadInput(
            f"specs.json has {shown}: dims, latent_in and norm_layers must be lists of whole numbers, CodeLength and "
            "geom_dimension whole numbers, the others true or false"
        )
    if (dimension := numbers["geom_dimension"][0]) != 3:
        raise BadInput(f"specs.json: the network takes points of {dimension} numbers (geom_dimension): it must take 3")
    return network, specs["CodeLength"], network["dims"]


def load_sdf_network(tensors: Mapping[str, Tensor]) -> Published:
    """The network of IDR, NeuS and VolSDF: softplus layers of encoded points; the value is the first output.

    The encoding and the skip connections follow from the widths. NeuS's `scale` is ignored, as a checkpoint does not
    contain it, and so is VolSDF's outer sphere, which is the scene's background.
    """
    weights = Weights(tensors, rf"(?:.*\.)?{SIGNED}\.(?={LAYERS})")
    layers: list[Layer] = []
    again: dict[int, bool] = {}
    for index in range(weights.count(LAYERS)):
        weight, bias = weights.layer(f"lin{index}")
        inputs = weight.shape[1]
        width = len(layers[-1][1]) if layers else inputs
        if inputs != width:
            again[index] = True
            if inputs != (joined := width + layers[0][0].shape[1]):
                raise BadInput(
                    f"{weights.prefix}lin{index} takes {inputs} numbers: it must be the {width} of lin{index - 1}, or "
                    f"these and the input, {joined}"
                )
        layers.append((weight, bias))
    weights.finish()
    inputs = layers[0][0].shape[1]
    frequencies, rest = divmod(inputs - 3, 6)
    if rest or not 0 <= frequencies <= MAX_FREQUENCIES:
        raise BadInput(
            f"{weights.prefix}lin0 takes {inputs} numbers: it must be 3, the point, and 6 for each of at most "
            f"{MAX_FREQUENCIES} frequencies of an encoding"
        )
    layers[-1] = (layers[-1][0][:1], layers[-1][1][:1])
    body = Layered(layers, activation="softplus", again=again, frequencies=frequencies, shrink=sqrt(0.5))
    coded = Coded(body, code_length=0, width=max(len(bias) for _, bias in layers))
    return Published(coded, assumption=SOFTPLUS_NOTE)


def load_occupancy_network(tensors: Mapping[str, Tensor]) -> Published:
    """The decoder of occupancy networks (Mescheder et al. 2019) and DVR (Niemeyer et al. 2020): a logit.

    The code is the encoder's output `c`. An occupancy network's latent `z` is 0, so only the bias of `fc_z` counts.
    It is added to the features of the points, or, in the decoder with CBN and `conv_p`, to the code.
    """
    if any("encoder.unet" in name or "encoder.fc_pos" in name for name in tensors):
        raise BadInput("it is a convolutional occupancy network, whose code differs from point to point: not read")
    weights = Weights(tensors, r"(?:.*\.)?(?=(?:fc|conv)_p\.)", "the decoder")
    kind = "fc" if weights.has("fc_p") else "conv"
    first = weights.layer(f"{kind}_p", 3)
    width = len(first[1])
    is_list = weights.has("blocks")
    count = weights.count(r"blocks\.(\d+)\." if is_list else r"block(\d+)\.")
    names = [f"blocks.{index}" if is_list else f"block{index}" for index in range(count)]
    if weights.has("fc_z") and kind == "fc":
        first = (first[0], first[1] + weights.layer("fc_z", outputs=width)[1])
    shift_names = {index: f"fc_c.{index}" for index in range(count)} if weights.has("fc_c.0") else {0: "fc_c"}
    shift_names = shift_names if weights.has("fc_c") else {}
    shifts = {index: weights.layer(name, outputs=width) for index, name in shift_names.items()}
    code_length = shifts[0][0].shape[1] if shifts else 0
    norms: list[Norm] = []
    if weights.has("bn"):
        gamma = next((name for name in weights.remaining if re.fullmatch(r"bn\.(conv|fc)_gamma\.weight", name)), None)
        if gamma is None:
            raise BadInput("the decoder's bn has no gamma of a code: batch normalisation without a code is not read")
        code_length = weights.remaining[gamma].shape[1]
        norm_names = [f"{name}.bn_{index}" for name in names for index in (0, 1)]
        norms = [Norm(weights, name, code_length) for name in (*norm_names, "bn")]
        if weights.has("fc_z"):
            latent = weights.layer("fc_z", outputs=code_length)[1]
            with torch.no_grad():
                for layer in (layer for norm in norms for layer in (norm.gamma, norm.beta)):
                    layer.bias.copy_(layer(latent))
    blocks = [(weights.layer(f"{name}.fc_0", width), weights.layer(f"{name}.fc_1", outputs=width)) for name in names]
    last = weights.layer(f"{kind}_out", width)
    weights.finish()
    body = Residual(first, blocks, last, shifts=shifts, norms=norms)
    return Published(Coded(body, code_length=code_length, width=width))


def load_mlp(tensors: Mapping[str, Tensor]) -> Published:
    """A fully connected network from its operations in order: `NNNN.dense.A` [in, out], `NNNN.dense.b`, `NNNN.relu._`.

    Source: the file format of neural-implicit-queries (Sharp and Jacobson 2022).
    """
    operations = dict(sorted({name.rpartition(".")[0]: None for name in tensors}.items()))
    kinds = [name.partition(".")[2] for name in operations]
    activations = {kind for kind in kinds if kind not in ("dense", "squeeze_last")}
    if unknown := activations - {*ACTIVATIONS}:
        names = [name for name in tensors if name.rpartition(".")[0].partition(".")[2] in unknown]
        raise BadInput(
            f"the network has operations that are not known: {', '.join(names[:6])}; arrays are named as 0000.dense.A, "
            f"0000.dense.b, 0001.relu._, with one of {', '.join(ACTIVATIONS)}"
        )
    shape = "".join("act " if kind in activations else f"{kind} " for kind in kinds)
    if len(activations) != 1 or re.fullmatch(r"(dense act )+dense (squeeze_last )?", shape) is None:
        raise BadInput(f"the network must be dense layers with one activation between them, not {', '.join(kinds)}")
    weights, layers = Weights(tensors), []
    for name in operations:
        if name.endswith("dense"):
            weight = weights.take(f"{name}.A", len(layers[-1][1]) if layers else 3, -1).T
            layers.append((weight, weights.take(f"{name}.b", len(weight))))
        else:
            weights.take(f"{name}._")
    weights.finish()
    if len(layers[-1][1]) != 1:
        raise BadInput(f"the network's last layer must give 1 number, not {len(layers[-1][1])}")
    if activations == {"relu"}:
        return Published(decoder_of(layers, code_length=0, skip=0))
    body = Layered(layers, activation=activations.pop())
    return Published(Coded(body, code_length=0, width=max(len(bias) for _, bias in layers)))


def decoder_of(layers: Sequence[Layer], *, code_length: int, skip: int) -> Decoder:
    """A decoder with these weights and biases, the output layer last; widths may differ.

    With `code_length` 0 the code is the position of the shape: a translation by three numbers.
    """
    *hidden, last = layers
    decoder = Decoder(layers=len(hidden), width=1, code_length=code_length or 3, skip=skip, narrow=False)
    decoder.width, decoder.code_is_position = max(len(bias) for _, bias in hidden), code_length == 0
    for index, (weight, bias) in enumerate(hidden):
        if not code_length and index in (0, skip):
            weight = torch.cat([weight[:, :-3], -weight[:, -3:], weight[:, -3:]], dim=1)
        decoder.hidden[index] = _linear((weight, bias))
    decoder.last = _linear(last)
    return decoder


def _linear(values: Layer) -> nn.Linear:
    return _set_weights(nn.Linear(values[0].shape[1], len(values[0])), values)


def _set_weights(layer: Any, values: Layer) -> Any:
    layer.weight, layer.bias = map(nn.Parameter, values)
    return layer
