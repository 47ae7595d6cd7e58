"""Networks that others trained, from their weights by name: one function for each format of a checkpoint.

A format says nothing about what its values mean: sign, level and slope are measured, see `network.measured`.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from math import sqrt
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from renderers.checks import BadInput
from renderers.fields.coloured import encoded
from renderers.fields.mlp import Decoder
from renderers.fields.network import Coded, Published

SIGNED = r"(?:implicit_network|sdf_network\w*)"  # the name of IDR's, NeuS's and VolSDF's network
LAYERS = r"lin(\d+)\."  # and what follows: weight, bias
OUTER = r"(?:(?:module|model|model_state_dict|state_dict|decoder)\.)*"  # what may stand before a network's own names
NORMALISED = (("weight_g", "weight_v"), ("parametrizations.weight.original0", "parametrizations.weight.original1"))
MOST_FREQUENCIES = 12  # of an encoding; IDR, NeuS and VolSDF have 6
SHARPNESS = 100  # of the softplus of IDR, NeuS and VolSDF
ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    **{"relu": torch.relu, "elu": nn.functional.elu, "tanh": torch.tanh, "sin": torch.sin, "cos": torch.cos},
    **{"sigmoid": torch.sigmoid, "softplus": lambda x: nn.functional.softplus(x, beta=SHARPNESS)},
}
Layer = tuple[Tensor, Tensor]


class Weights:
    """The tensors of a checkpoint by name, each of which is to be taken; in float32.

    Args:
        tensors: by name.
        pattern: of what stands before the names of the network's layers, such as `module.`; other names are left alone.
        whose: what an error calls the checkpoint.

    Raises:
        BadInput: where no name fits.
    """

    def __init__(self, tensors: Mapping[str, Tensor], pattern: str = "", whose: str = "the network") -> None:
        found = next(filter(None, (re.match(pattern, name) for name in tensors)), None)
        if found is None:
            raise BadInput(f"it has no layers of this format: it has {', '.join([*tensors][:6]) or 'no tensors'}")
        self.whose, self.prefix = whose, found[0]
        names = [name for name in tensors if name.startswith(self.prefix)]
        self.left = {name.removeprefix(self.prefix): tensors[name].float() for name in names}

    def has(self, name: str) -> bool:
        """Whether a tensor of this name is left, or one that begins with it and a dot."""
        return name in self.left or any(key.startswith(f"{name}.") for key in self.left)

    def take(self, name: str, *shape: int) -> Tensor:
        """A tensor; raises BadInput where it is not there, or has another shape; -1 stands for any number."""
        if name not in self.left:
            raise BadInput(f"{self.whose} lacks {self.prefix}{name}: it has {self._named()}")
        found = self.left.pop(name)
        if shape and (len(shape) != found.dim() or any(n not in (-1, found.shape[at]) for at, n in enumerate(shape))):
            wanted, has = " x ".join("any" if n == -1 else str(n) for n in shape), " x ".join(map(str, found.shape))
            raise BadInput(f"{self.whose}: {self.prefix}{name} must be {wanted}, not {has}")
        return found

    def layer(self, name: str, inputs: int = -1, outputs: int = -1) -> Layer:
        """Weight [out, in] and bias of a layer, or of a convolution of size 1, without its weight normalisation."""
        for length, direction in NORMALISED:
            if f"{name}.{direction}" in self.left:
                weight = self.take(f"{name}.{direction}", outputs, inputs)
                scale = self.take(f"{name}.{length}", len(weight), 1)
                weight = weight * (scale / torch.linalg.vector_norm(weight, dim=1, keepdim=True))
                break
        else:
            full = f"{name}.weight"
            if full in self.left and self.left[full].dim() == 3:  # a convolution
                self.left[full] = self.left[full].squeeze(-1)
            weight = self.take(full, outputs, inputs)
        return weight, self.take(f"{name}.bias", len(weight))

    def count(self, pattern: str) -> int:
        """How many layers there are, by the largest number in their names; raises BadInput where there is none."""
        numbers = [int(found[1]) for name in self.left if (found := re.match(pattern, name))]
        if not numbers:
            raise BadInput(f"{self.whose} has no layers {self.prefix}{pattern}: it has {self._named()}")
        return max(numbers) + 1

    def finish(self) -> None:
        """Raises BadInput where tensors are left that no layer took."""
        if self.left:
            raise BadInput(f"{self.whose} has weights of another network: {self._named()}")

    def _named(self) -> str:
        shown, more = [f"{self.prefix}{name}" for name in [*self.left][:6]], len(self.left) - 6
        return ", ".join(shown) + (f" and {more} more" if more > 0 else "") or "nothing"


class Layered(nn.Module):
    """Fully connected layers with an activation between them; some take the input again.

    Args:
        layers: weight and bias of each.
        activation: one of `ACTIVATIONS`.
        again: by the layer's number, whether it takes the whole input again, or the points alone (False).
        frequencies: of a positional encoding of the points: sin and cos of 1, 2, 4, ... times these, behind them.
        shrink: what is multiplied with features and input where these are joined.
        norms: weight and bias of a layer normalisation behind a layer, by its number.
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
        self.norms = nn.ModuleDict({str(at): _of(nn.LayerNorm(len(of[0])), of) for at, of in (norms or {}).items()})

    def forward(self, points: Tensor, code: Tensor) -> Tensor:
        whole = torch.cat([code.expand(len(points), -1), encoded(points, self.frequencies)], dim=-1)
        features, activation = whole, ACTIVATIONS[self.activation]
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            if index in self.again:
                features = torch.cat([features, whole if self.again[index] else points], dim=-1) * self.shrink
            features = linear(features, weight, bias)
            if index + 1 < len(self.weights):
                features = activation(self.norms[str(index)](features) if str(index) in self.norms else features)
        return features[:, 0]


class Residual(nn.Module):
    """ResNet blocks of points and a code: occupancy networks and DVR; of their outputs the first, a logit.

    A block is x + B relu(A relu(x)). The code moves the features before blocks (`shifts`), or scales and moves what
    each relu gets, by conditional batch normalisation (`norms`: two a block and one behind).
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
        self.shifts = nn.ModuleDict({str(at): _linear(layer) for at, layer in shifts.items()})
        self.norms = nn.ModuleList(norms)

    def forward(self, points: Tensor, code: Tensor) -> Tensor:
        features = self.first(points)
        for index, block in enumerate(self.blocks):
            assert isinstance(block, nn.ModuleList)
            inner, outer = block
            if str(index) in self.shifts:
                features = features + self.shifts[str(index)](code)
            between = inner(self._opened(features, code, 2 * index))
            features = features + outer(self._opened(between, code, 2 * index + 1))
        return self.last(self._opened(features, code, 2 * len(self.blocks)))[:, 0]

    def _opened(self, features: Tensor, code: Tensor, place: int) -> Tensor:
        return (self.norms[place](features, code) if self.norms else features).relu()


class Norm(nn.Module):
    """Conditional batch normalisation, as when it does not learn: by the mean and variance that it has stored."""

    mean: Tensor
    deviation: Tensor

    def __init__(self, weights: Weights, name: str, code_length: int) -> None:
        super().__init__()
        kind = "conv" if weights.has(f"{name}.conv_gamma") else "fc"
        self.gamma, self.beta = (_linear(weights.layer(f"{name}.{kind}_{x}", code_length)) for x in ("gamma", "beta"))
        self.register_buffer("mean", weights.take(f"{name}.bn.running_mean", -1))
        self.register_buffer("deviation", (weights.take(f"{name}.bn.running_var", -1) + 1e-5).sqrt())
        weights.left.pop(f"{name}.bn.num_batches_tracked", None)

    def forward(self, features: Tensor, code: Tensor) -> Tensor:
        return self.gamma(code) * (features - self.mean) / self.deviation + self.beta(code)


def deepsdf(tensors: Mapping[str, Tensor], specs: Mapping[str, Any], *, squash: int | None = None) -> Published:
    """The decoder of DeepSDF (Park et al. 2019), as its code builds it from a specs.json; dropout is no part of it.

    Args:
        tensors: `model_state_dict`, with or without `module.`; weights normalised as torch did in 2019, or does now.
        specs: its `NetworkSpecs` and `CodeLength`.
        squash: how many tanh follow the last layer; None: one for `use_tanh`, and the one that the code of 2019 always
            has. Code that states `geom_dimension` has not.
    """
    network, code_length, dims = _checked(specs)
    weights = Weights(tensors, f"{OUTER}(?={LAYERS})", "ModelParameters")
    again, given = {}, code_length + 3
    latent_in, everywhere = network.get("latent_in") or (), bool(network.get("xyz_in_all"))
    normed = set(network.get("norm_layers") or ()) if not network.get("weight_norm") else set()
    layers, norms, widths = [], {}, [given, *dims, 1]
    for index, inputs in enumerate(widths[:-1]):
        last = index == len(dims)
        if index and (index in latent_in or everywhere):
            again[index] = index in latent_in
        less = given if index + 1 in latent_in else 3 if everywhere and not last else 0
        layers.append(weights.layer(f"lin{index}", inputs, max(widths[index + 1] - less, 0)))
        if index in normed:
            norms[index] = tuple(weights.take(f"bn{index}.{part}", len(layers[-1][1])) for part in ("weight", "bias"))
    weights.finish()
    if squash is None:
        squash = bool(network.get("use_tanh")) + ("geom_dimension" not in network)
    if not norms and list(again.values()) in ([], [True]) and len(dims) not in again:
        return Published(Decoder.of(layers, code_length=code_length, skip=next(iter(again), 0)), squash)
    body = Layered(layers, activation="relu", again=again, norms=norms)
    return Published(Coded(body, code_length=code_length, width=max(dims)), squash)


def _checked(specs: Any) -> tuple[Mapping[str, Any], int, list[int]]:
    """The `NetworkSpecs` of a specs.json, its `CodeLength` and `dims`; raises BadInput where they are not."""
    network = specs.get("NetworkSpecs") if isinstance(specs, dict) else None
    if not isinstance(network, dict):
        raise BadInput(f"specs.json must have NetworkSpecs, an object, not {network!r}: take that of the training")
    numbers = {key: network.get(key) or [] for key in ("dims", "latent_in", "norm_layers")}
    numbers |= {"CodeLength": [specs.get("CodeLength")], "geom_dimension": [network.get("geom_dimension", 3)]}
    wrong = [key for key, of in numbers.items() if type(of) is not list or any(type(n) is not int or n < 0 for n in of)]
    wrong += [] if numbers["dims"] else ["dims"]
    wrong += [key for key in ("xyz_in_all", "use_tanh", "weight_norm") if type(network.get(key) or False) is not bool]
    if wrong:
        named = ", ".join(f"{key} {(specs if key == 'CodeLength' else network).get(key)!r}" for key in wrong)
        raise BadInput(
            f"specs.json has {named}: dims, latent_in and norm_layers must be lists of whole numbers, CodeLength and "
            "geom_dimension whole numbers, the others true or false"
        )
    if (dimension := numbers["geom_dimension"][0]) != 3:
        raise BadInput(f"specs.json: the network takes points of {dimension} numbers (geom_dimension): it must take 3")
    return network, specs["CodeLength"], network["dims"]


def implicit(tensors: Mapping[str, Tensor]) -> Published:
    """The network of IDR, NeuS and VolSDF: softplus layers of encoded points, of whose outputs the first is the value.

    Its encoding, and the layers that take it again, follow from the widths. NeuS's `scale`, which a checkpoint does not
    hold, is left out; so is VolSDF's outer sphere, which is the scene's background.
    """
    weights = Weights(tensors, rf"(?:.*\.)?{SIGNED}\.(?={LAYERS})")
    layers: list[Layer] = []
    again: dict[int, bool] = {}
    for index in range(weights.count(LAYERS)):
        weight, bias = weights.layer(f"lin{index}")
        takes = weight.shape[1]
        width = len(layers[-1][1]) if layers else takes
        if takes != width:
            again[index] = True
            if takes != (joined := width + layers[0][0].shape[1]):
                raise BadInput(
                    f"{weights.prefix}lin{index} takes {takes} numbers: it must be the {width} of lin{index - 1}, or "
                    f"these and the input, {joined}"
                )
        layers.append((weight, bias))
    weights.finish()
    inputs = layers[0][0].shape[1]
    frequencies, rest = divmod(inputs - 3, 6)
    if rest or not 0 <= frequencies <= MOST_FREQUENCIES:
        raise BadInput(
            f"{weights.prefix}lin0 takes {inputs} numbers: it must be 3, the point, and 6 for each of at most "
            f"{MOST_FREQUENCIES} frequencies of an encoding"
        )
    layers[-1] = (layers[-1][0][:1], layers[-1][1][:1])
    body = Layered(layers, activation="softplus", again=again, frequencies=frequencies, shrink=sqrt(0.5))
    return Published(Coded(body, code_length=0, width=max(len(bias) for _, bias in layers)))


def occupancy(tensors: Mapping[str, Tensor]) -> Published:
    """The decoder of occupancy networks (Mescheder et al. 2019) and DVR (Niemeyer et al. 2020): a logit.

    The code is the one that an encoder gives, `c`; of an occupancy network's latent `z`, zeros are taken. `fc_z` is
    added to the features of the points, but in the decoder with `conv_p`, their second with CBN, to the code.
    """
    if any("encoder.unet" in name or "encoder.fc_pos" in name for name in tensors):
        raise BadInput("it is a convolutional occupancy network, whose code differs from point to point: not read")
    weights = Weights(tensors, rf"(?:{OUTER}|.*\.decoder\.)(?=(?:fc|conv)_p\.)", "the decoder")
    kind = "fc" if weights.has("fc_p") else "conv"
    first = weights.layer(f"{kind}_p", 3)
    width = len(first[1])
    listed = weights.has("blocks")
    count = weights.count(r"blocks\.(\d+)\." if listed else r"block(\d+)\.")
    names = [f"blocks.{at}" if listed else f"block{at}" for at in range(count)]
    if weights.has("fc_z") and kind == "fc":
        first = (first[0], first[1] + weights.layer("fc_z", outputs=width)[1])
    moved = {at: f"fc_c.{at}" for at in range(count)} if weights.has("fc_c.0") else {0: "fc_c"}
    shifts = {at: weights.layer(name, outputs=width) for at, name in moved.items()} if weights.has("fc_c") else {}
    code_length = shifts[0][0].shape[1] if shifts else 0
    norms: list[Norm] = []
    if weights.has("bn"):
        gamma = next((name for name in weights.left if re.fullmatch(r"bn\.(conv|fc)_gamma\.weight", name)), None)
        if gamma is None:
            raise BadInput("the decoder's bn has no gamma of a code: batch normalisation without a code is not read")
        code_length = weights.left[gamma].shape[1]
        places = [f"{name}.bn_{at}" for name in names for at in (0, 1)]
        norms = [Norm(weights, place, code_length) for place in (*places, "bn")]
        if weights.has("fc_z"):
            latent = weights.layer("fc_z", outputs=code_length)[1]
            with torch.no_grad():
                for layer in (one for norm in norms for one in (norm.gamma, norm.beta)):
                    layer.bias.copy_(layer(latent))
    blocks = [(weights.layer(f"{name}.fc_0", width), weights.layer(f"{name}.fc_1", outputs=width)) for name in names]
    last = weights.layer(f"{kind}_out", width)
    weights.finish()
    body = Residual(first, blocks, last, shifts=shifts, norms=norms)
    return Published(Coded(body, code_length=code_length, width=width))


def plain(tensors: Mapping[str, Tensor]) -> Published:
    """A fully connected network by its operations in order, `NNNN.dense.A` [in, out], `NNNN.dense.b`, `NNNN.relu._`.

    Source: neural-implicit-queries (Sharp and Jacobson 2022), which stores networks so.
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
        return Published(Decoder.of(layers, code_length=0, skip=0))
    body = Layered(layers, activation=activations.pop())
    return Published(Coded(body, code_length=0, width=max(len(bias) for _, bias in layers)))


def _linear(values: Layer) -> nn.Linear:
    return _of(nn.Linear(values[0].shape[1], len(values[0])), values)


def _of(layer: Any, values: Layer) -> Any:
    layer.weight, layer.bias = map(nn.Parameter, values)
    return layer
