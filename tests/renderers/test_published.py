"""Networks of other people's formats against their forward passes, each written once more in plain torch."""

from math import sqrt
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn.functional import batch_norm, layer_norm, linear, softplus

from renderers.checks import BadInput
from renderers.field import Coarse, Kind, coarse_version, points_in_sphere
from renderers.fields.analytic import Shape
from renderers.fields.mlp import BoundDecoder
from renderers.fields.networks import published
from renderers.fields.networks.network import Adjusted
from renderers.later.affine import field_bounds
from tests.looped import each

POINTS = points_in_sphere(64, torch.zeros(()))
State = dict[str, Tensor]


def drawn(*shape: int) -> Tensor:
    return torch.randn(*shape) / sqrt(shape[-1])


def as_of_2019(weight: Tensor) -> State:
    """A weight by length and direction, as torch named them in 2019; the direction has any length."""
    length = weight.norm(dim=1, keepdim=True)
    return {"weight_g": length, "weight_v": weight / length * torch.rand(len(weight), 1).add(0.5)}


def as_of_today(weight: Tensor) -> State:
    old = as_of_2019(weight)
    return {f"parametrizations.weight.original{n}": old[key] for n, key in enumerate(("weight_g", "weight_v"))}


def directly(weight: Tensor) -> State:
    return {"weight": weight}


def named(prefix: str, layers: dict[str, tuple[Tensor, Tensor]], written: Any) -> State:
    """The state of layers by name."""
    parts = {name: written(weight) | {"bias": bias} for name, (weight, bias) in layers.items()}
    return {f"{prefix}{name}.{key}": value for name, layer in parts.items() for key, value in layer.items()}


SPECS = {"dims": [16, 12, 16], "norm_layers": [0, 1, 2], "latent_in": [2], "weight_norm": True, "dropout": [0, 1]}
CODE = torch.tensor([0.3, -0.2])


def deepsdf(specs: dict[str, Any], written: Any, prefix: str) -> tuple[State, dict[str, Any], Tensor]:
    """The state of a DeepSDF decoder of 2 code numbers, its specs, and its values, as its own code computes them."""
    widths, inputs = [5, *specs["dims"], 1], torch.cat([CODE.expand(len(POINTS), -1), POINTS], dim=1)
    again, every, norm = specs.get("latent_in", []), specs.get("xyz_in_all", False), not specs.get("weight_norm")
    layers, extra, x = {}, {}, inputs
    for n in range(len(widths) - 1):
        if n in again:
            x = torch.cat([x, inputs], dim=1)
        elif n and every:
            x = torch.cat([x, POINTS], dim=1)
        outputs = widths[n + 1] - (5 if n + 1 in again else 3 if every and n < len(widths) - 2 else 0)
        layers[f"lin{n}"] = weight, bias = drawn(outputs, widths[n]), drawn(outputs)
        x = linear(x, weight, bias)
        if n == len(widths) - 2:
            break
        if norm and n in specs["norm_layers"]:
            scale, shift = torch.rand(outputs), drawn(outputs)
            extra |= {f"{prefix}bn{n}.weight": scale, f"{prefix}bn{n}.bias": shift}
            x = layer_norm(x, (outputs,), scale, shift)
        x = x.relu()
    x = x.tanh() if specs.get("use_tanh") else x
    x = x if "geom_dimension" in specs else x.tanh()
    return named(prefix, layers, written) | extra, {"NetworkSpecs": specs, "CodeLength": 2}, x[:, 0]


@each("specs, written, prefix, plain", [
    (SPECS | {"geom_dimension": 3}, as_of_today, "module.", True),
    (SPECS, as_of_2019, "", False),
    (SPECS | {"use_tanh": True}, as_of_2019, "module.", False),
    (SPECS | {"weight_norm": False}, directly, "", False),
    (SPECS | {"xyz_in_all": True, "latent_in": []}, as_of_2019, "", False),
    (SPECS | {"xyz_in_all": True}, as_of_today, "", False),
    (SPECS | {"latent_in": [1, 2], "geom_dimension": 3}, as_of_2019, "", False),
    (SPECS | {"latent_in": [3], "dims": [16, 16, 16]}, as_of_2019, "", False),
    (SPECS | {"latent_in": [], "geom_dimension": 3}, as_of_2019, "", True),
])  # fmt: skip
def test_a_deepsdf_decoder_has_the_values_of_its_own_code(specs, written, prefix, plain):
    torch.manual_seed(0)
    state, settings, values = deepsdf(specs, written, prefix)
    network = published.load_deepsdf(state, settings)
    torch.testing.assert_close(network.at(CODE)(POINTS), values, rtol=0, atol=1e-6)
    assert isinstance(network.inner.at(CODE), BoundDecoder) or not plain


def test_a_tanh_keeps_what_a_decoder_offers():
    torch.manual_seed(0)
    state, settings, _ = deepsdf(SPECS | {"use_tanh": True}, as_of_2019, "")
    network = published.load_deepsdf(state, settings)
    network.factor.fill_(-2.0)
    network.level.fill_(0.1)
    field, half = network.at(CODE), 0.1 * POINTS.flip(0)
    low, high = field_bounds(field)(POINTS, half)
    for t in (-1.0, 0.0, 0.3, 1.0):
        values = field(POINTS + t * half)
        assert ((low <= values) & (values <= high)).all()
    assert (high - low).max() < 4 and field.flops == network.inner.at(CODE).flops
    assert coarse_version(field) is None  # a narrow one has none


def test_an_adjusted_field_has_coarse_values_and_bounds_that_are_adjusted_as_its_values():
    class Inner(Shape):
        coarse = Coarse(lambda points: points[..., 0] + 0.01, 0.01)

        def bounds(self, middle: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
            return middle[..., 0] - half[..., 0].abs(), middle[..., 0] + half[..., 0].abs()

    for factor in (3.0, -3.0):
        inner = Inner(lambda points: points[..., 0], Kind.LEVEL, None)
        field = Adjusted(inner, 0, torch.tensor(factor), torch.tensor(0.2), Kind.LEVEL, None)
        coarse = coarse_version(field)
        assert coarse is not None
        assert coarse.error == pytest.approx(0.03)
        torch.testing.assert_close(coarse.values(POINTS), factor * (POINTS[:, 0] + 0.01 - 0.2))
        assert ((coarse.values(POINTS) - field(POINTS)).abs() <= coarse.error + 1e-6).all()
        low, high = field_bounds(field)(POINTS, 0.1 * POINTS.flip(0))
        for t in (-1.0, 0.0, 0.5, 1.0):
            values = field(POINTS + t * 0.1 * POINTS.flip(0))
            assert ((low - 1e-6 <= values) & (values <= high + 1e-6)).all()


def implicit(prefix: str, frequencies: int, written: Any) -> tuple[State, Tensor]:
    """The state of IDR's network, four layers of 40 with a skip at the third and 7 outputs, and its values."""
    waves = [wave(POINTS * 2**n) for n in range(frequencies) for wave in (torch.sin, torch.cos)]
    encoded = torch.cat([POINTS, *waves], dim=1)
    inputs, layers, x = encoded.shape[1], {}, encoded
    for n, (width, outputs) in enumerate([(inputs, 40), (40, 40 - inputs), (40, 40), (40, 7)]):
        x = torch.cat([x, encoded], dim=1) / sqrt(2) if n == 2 else x
        layers[f"lin{n}"] = weight, bias = drawn(outputs, width), drawn(outputs)
        x = linear(x, weight, bias)
        x = softplus(x, beta=100) if n < 3 else x
    return named(prefix, layers, written), x[:, 0]


@each("prefix, frequencies, written", [
    ("model_state_dict.implicit_network.", 0, as_of_2019),
    ("implicit_network.", 3, as_of_today),
    ("sdf_network_fine.", 6, as_of_2019),
    ("model.sdf_network.", 2, directly),
])  # fmt: skip
def test_a_network_of_idr_neus_or_volsdf_has_the_values_of_its_own_code(prefix, frequencies, written):
    torch.manual_seed(0)
    state, values = implicit(prefix, frequencies, written)
    others = {"rendering_network.lin0.weight": drawn(4, 9), "variance_network_fine.variance": torch.ones(())}
    network = published.load_sdf_network(others | state)
    torch.testing.assert_close(network.at(torch.zeros(3))(POINTS), values, rtol=0, atol=1e-6)


def occupancy(kind: str) -> tuple[State, Tensor]:
    """The state of an occupancy network of two blocks of 8, and its logits at the code: dvr, shift, cbn or cbn2."""
    state, width, prefix = {}, 8, "decoder."
    cbn, code = kind in ("cbn", "cbn2"), CODE

    def layer(key: str, outputs: int, inputs: int, *rest: int) -> tuple[Tensor, Tensor]:
        weight, bias = drawn(outputs, inputs), drawn(outputs)
        state.update({f"{prefix}{key}.weight": weight.view(outputs, inputs, *rest), f"{prefix}{key}.bias": bias})
        return weight, bias

    def normed(key: str, x: Tensor) -> Tensor:
        gamma, beta = (linear(code, *layer(f"{key}.conv_{name}", width, 2, 1)) for name in ("gamma", "beta"))
        mean, variance = drawn(width), torch.rand(width)
        stored = {"running_mean": mean, "running_var": variance, "num_batches_tracked": torch.tensor(7)}
        state.update({f"{prefix}{key}.bn.{name}": value for name, value in stored.items()})
        return gamma * batch_norm(x, mean, variance) + beta

    kernel, letters = (1,) if cbn else (), "conv" if kind == "cbn2" else "fc"
    x = linear(POINTS, *layer(f"{letters}_p", width, 3, *kernel))
    if kind == "cbn2":
        code = CODE + layer("fc_z", 2, 4)[1]
    elif kind != "dvr":
        x = x + layer("fc_z", width, 4)[1]
    if kind == "shift":
        x = x + linear(CODE, *layer("fc_c", width, 2))
    for n in range(2):
        block = f"blocks.{n}" if kind in ("dvr", "cbn2") else f"block{n}"
        if kind == "dvr":
            x = x + linear(CODE, *layer(f"fc_c.{n}", width, 2))
        inner = normed(f"{block}.bn_0", x) if cbn else x
        inner = linear(inner.relu(), *layer(f"{block}.fc_0", width, width, *kernel))
        inner = normed(f"{block}.bn_1", inner) if cbn else inner
        x = x + linear(inner.relu(), *layer(f"{block}.fc_1", width, width, *kernel))
    x = normed("bn", x) if cbn else x
    x = linear(x.relu(), *layer(f"{letters}_out", 4 if kind == "dvr" else 1, width, *kernel))
    return state, x[:, 0]


@each("kind", ["dvr", "shift", "cbn", "cbn2"])
def test_an_occupancy_network_has_the_logits_of_its_own_code(kind):
    torch.manual_seed(0)
    state, logits = occupancy(kind)
    network = published.load_occupancy_network({"encoder.conv1.weight": drawn(4, 4)} | state)
    torch.testing.assert_close(network.at(CODE)(POINTS), logits, rtol=0, atol=1e-6)


def plain(activation: str) -> tuple[State, Tensor]:
    """The operations of a network of two layers of 8, in any order, and its values."""
    state, x = {}, POINTS
    for n, (inputs, outputs) in enumerate([(3, 8), (8, 8), (8, 1)]):
        weight, bias = drawn(inputs, outputs), drawn(outputs)
        state |= {f"{2 * n:04d}.dense.A": weight, f"{2 * n:04d}.dense.b": bias}
        x = x @ weight + bias
        if n < 2:
            state[f"{2 * n + 1:04d}.{activation}._"] = torch.zeros(0)
            x = {"relu": torch.relu, "elu": torch.nn.functional.elu, "tanh": torch.tanh}[activation](x)
    return dict(reversed(state.items())) | {"0005.squeeze_last._": torch.zeros(0)}, x[:, 0]


@each("activation", ["relu", "elu", "tanh"])
def test_a_plain_network_has_the_values_of_its_operations(activation):
    torch.manual_seed(0)
    state, values = plain(activation)
    field = published.load_mlp(state).at(torch.zeros(3))
    torch.testing.assert_close(field(POINTS), values, rtol=0, atol=1e-6)
    assert isinstance(field.inner, BoundDecoder) == (activation == "relu")


def without(state: State, key: str) -> State:
    return {name: value for name, value in state.items() if name != key}


def deepsdf_with(state: Any, **changed: Any) -> Any:
    """Reads a DeepSDF decoder whose state is changed by a function, and its specs."""
    weights, settings, _ = deepsdf(SPECS, as_of_2019, "")
    return published.load_deepsdf(state(weights), settings | {"NetworkSpecs": SPECS | changed})


def implicit_with(changed: State) -> Any:
    state = implicit("sdf_network.", 0, directly)[0]
    return published.load_sdf_network(state | {f"sdf_network.{key}": weight for key, weight in changed.items()})


def cbn_with(state: Any) -> Any:
    return published.load_occupancy_network(state(occupancy("cbn")[0]))


def plain_with(state: Any) -> Any:
    return published.load_mlp(state(plain("relu")[0]))


@each("read, words", [
    (lambda: deepsdf_with(lambda s: without(s, "lin1.bias")), ("ModelParameters lacks lin1.bias",)),
    (lambda: deepsdf_with(lambda s: s | {"lin1.weight_v": drawn(9, 16)}), ("lin1.weight_v must be 7 x 16", "9 x 16")),
    (lambda: deepsdf_with(lambda s: s | {"lin9.bias": drawn(2)}), ("weights of another network: lin9.bias",)),
    (lambda: deepsdf_with(lambda s: s, geom_dimension=2), ("points of 2 numbers",)),
    (lambda: deepsdf_with(lambda s: s, dims="16", latent_in=2), ("dims '16', latent_in 2: dims", "of whole numbers")),
    (lambda: deepsdf_with(lambda s: s, norm_layers=[0, "1"]), ("norm_layers [0, '1']",)),
    (lambda: deepsdf_with(lambda s: s, use_tanh="false"), ("use_tanh 'false'", "true or false")),
    (lambda: published.load_deepsdf({}, {"NetworkSpecs": SPECS, "CodeLength": "2"}), ("CodeLength '2'",)),
    (lambda: published.load_deepsdf({}, {"NetworkSpecs": [3]}), ("must have NetworkSpecs, an object, not [3]",)),
    (lambda: deepsdf_with(lambda _: {"conv.weight": drawn(2, 2)}), ("no layers of this format", "conv.weight")),
    (lambda: implicit_with({"lin0.weight": drawn(40, 2), "lin2.weight": drawn(40, 39)}), ("lin0 takes 2", "be 3")),
    (lambda: implicit_with({"lin0.weight": drawn(40, 81), "lin2.weight": drawn(40, 118)}), ("takes 81", "at most 12")),
    (lambda: implicit_with({"lin2.weight": drawn(40, 39)}), ("lin2 takes 39",)),
    (
        lambda: published.load_sdf_network(implicit("module.", 0, directly)[0]),
        ("no layers of this format", "module.lin0"),
    ),
    (
        lambda: published.load_sdf_network({
            **implicit("model.sdf_network.", 0, directly)[0], **implicit("ema.sdf_network.", 0, directly)[0]
        }),
        ("several networks, model.sdf_network., ema.sdf_network.", "save the state_dict() of one"),
    ),
    (lambda: cbn_with(lambda s: s | {"decoder.fc_p.weight": drawn(8, 2, 1)}), ("fc_p.weight must be any x 3",)),
    (lambda: cbn_with(lambda s: without(s, "decoder.bn.bn.running_var")), ("lacks decoder.bn.bn.running_var",)),
    (lambda: plain_with(lambda s: s | {"0000.dense.A": drawn(2, 8)}), ("0000.dense.A must be 3 x any", "2 x 8")),
    (lambda: plain_with(lambda s: s | {"0001.spin._": drawn(1)}), ("not known: 0001.spin._",)),
    (lambda: plain_with(lambda s: {"arr_0": drawn(1)}), ("not known: arr_0; arrays are named as 0000.dense.A",)),
    (lambda: plain_with(lambda s: without(s, "0001.relu._")), ("dense layers with one activation between",)),
])  # fmt: skip
def test_a_network_of_another_shape_is_refused_by_the_names_of_its_weights(read, words):
    torch.manual_seed(0)
    with pytest.raises(BadInput) as error:
        read()
    for word in words:
        assert word in str(error.value)
