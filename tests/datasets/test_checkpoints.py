"""Names of checkpoints and forms of codes, which are drawn: each is read, or its fault is named."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from torch import Tensor, nn

from datasets.files.checkpoints import WRAPPERS, fit_weights, read_codes, read_tensors
from renderers.checks import BadInput
from tests.looped import each

State = dict[str, Tensor]
LAYERS = st.lists(st.sampled_from(("net", "lin0", "lin1", "0", "module", "out")), min_size=1, max_size=3).map(".".join)
PREFIX = st.lists(st.sampled_from(("model", "state_dict", "ema", "sdf", "module", "_orig_mod")), max_size=3)
DTYPES = st.sampled_from((torch.float16, torch.bfloat16, torch.float32, torch.float64))
WAYS = ("plain", "old", "new")
NORMALISE = {"plain": lambda x: x, "old": nn.utils.weight_norm, "new": nn.utils.parametrizations.weight_norm}


def made(layers: dict[str, int], way: str) -> nn.Module:
    """A module with linear layers of these names and numbers of outputs, and a buffer."""
    module = nn.Module()
    for name, outputs in layers.items():
        parent = module
        *parents, last = name.split(".")
        for word in parents:
            if not hasattr(parent, word):
                parent.add_module(word, nn.Module())
            parent = parent.get_submodule(word)
        with pytest.warns(FutureWarning) if way == "old" else pytest.MonkeyPatch.context():
            parent.add_module(last, NORMALISE[way](nn.Linear(3, outputs)))
    module.register_buffer("steps", torch.tensor([4.0]))
    module.register_buffer("waves", torch.randn(2), persistent=False)
    return module


def written(layers: State, way: str) -> State:
    """The layers' weights in a way of writing them, and their other tensors."""
    state = {}
    for name, tensor in layers.items():
        if way == "plain" or not name.endswith(".weight"):
            state[name] = tensor
            continue
        keys = ("weight_g", "weight_v") if way == "old" else [f"parametrizations.weight.original{n}" for n in (0, 1)]
        state |= {name.removesuffix("weight") + keys[0]: tensor.norm(dim=1, keepdim=True)}
        state |= {name.removesuffix("weight") + keys[1]: 3 * tensor}
    return state


@st.composite
def files(draw: Any) -> tuple[dict[str, int], State, str]:
    """Layers of a module with their numbers of outputs, their tensors by name, and the prefix of a file."""
    names = draw(st.lists(LAYERS, min_size=1, max_size=4, unique=True))
    assume(not any(other.startswith(f"{name}.") for name in names for other in names))
    assume(len({name.replace("module.", "").replace(".module", "") for name in names} - {"module"}) == len(names))
    layers = {name: draw(st.integers(1, 3)) for name in names}
    tensors = {f"{name}.{key}": torch.randn(n, 3) if key == "weight" else torch.randn(n)
               for name, n in layers.items() for key in ("weight", "bias")}  # fmt: skip
    return layers, tensors | {"steps": torch.tensor([7.0])}, "".join(f"{word}." for word in draw(PREFIX))


def weights_of(module: nn.Module, layers: dict[str, int]) -> State:
    """The weights that the layers use, and the buffers."""
    state = {}
    for name in layers:
        layer = module.get_submodule(name)
        layer(torch.zeros(1, 3))  # weights of the older normalisation are computed in it
        state |= {f"{name}.weight": layer.weight, f"{name}.bias": layer.bias}
    return state | {"steps": module.get_buffer("steps")}


def stored(folder: Path, content: Any) -> State:
    torch.save(content, folder / "some.pth")
    return read_tensors(folder / "some.pth")


@given(file=files(), ways=st.tuples(*[st.sampled_from(WAYS)] * 2), dtype=DTYPES, data=st.data())
def test_a_state_is_read_by_any_name_type_and_normalisation(tmp_path_factory, file, ways, dtype, data):
    layers, tensors, prefix = file
    module, waves = made(layers, ways[0]), torch.tensor([5.0, 6.0])
    names = {}
    for name, tensor in written(tensors | {"waves": waves}, ways[1]).items():
        words = name.split(".")
        where = data.draw(st.integers(0, len(words) - 1)) if "module" not in name else 0
        inserted = data.draw(st.sampled_from(([], ["module"], ["_orig_mod"], ["_orig_mod", "module"])))
        names[prefix + ".".join(words[:where] + inserted + words[where:])] = tensor.to(dtype)
    assume(len(names) == len(written(tensors | {"waves": waves}, ways[1])))
    extra = {"colours.beta": torch.ones(2), "n_averaged": torch.tensor(3)} if WRAPPERS.sub("", prefix) else {}
    fit_weights(module, stored(tmp_path_factory.mktemp("file"), {"epoch": 3, **names, **extra}))
    for name, tensor in weights_of(module, layers).items():
        limit = max(4 * torch.finfo(dtype).eps, 1e-6)
        torch.testing.assert_close(tensor, tensors[name], rtol=limit, atol=limit)
    assert torch.equal(module.get_buffer("waves"), waves)


@given(file=files(), change=st.sampled_from(("missing", "unused", "size")), data=st.data())
def test_a_state_that_fits_in_part_is_refused_by_the_names(tmp_path_factory, file, change, data):
    layers, tensors, prefix = file
    module, changed = made(layers, "plain"), data.draw(st.sampled_from(sorted(tensors)))
    state = dict(tensors)
    if change == "missing":
        del state[changed]
    else:
        changed = changed if change == "size" else f"{changed.rpartition('.')[0]}.offset".lstrip(".")
        state[changed] = torch.ones(5, 7)
    before = {name: tensor.clone() for name, tensor in module.state_dict().items()}
    with pytest.raises(BadInput, match="not those of Module: ") as error:
        fit_weights(module, stored(tmp_path_factory.mktemp("file"), {prefix + name: x for name, x in state.items()}))
    shown = changed.replace("module.", "") if change == "unused" else changed
    assert shown in str(error.value) and (
        "field.NAME=VALUE" in str(error.value) or "persistent=False" in str(error.value)
    )
    assert all(torch.equal(tensor, before[name]) for name, tensor in module.state_dict().items())


def test_two_networks_of_one_file_are_named_and_an_inner_copy_is_no_other_prefix():
    layers = {"lin0": 2, "lin1": 1}
    tensors = {f"{name}.{key}": torch.ones(n, 3) if key == "weight" else torch.ones(n)
               for name, n in layers.items() for key in ("weight", "bias")} | {"steps": torch.ones(1)}  # fmt: skip
    two = {f"{prefix}.{name}": tensor for prefix in ("model", "ema") for name, tensor in tensors.items()}
    with pytest.raises(BadInput, match=r"several networks, model\., ema\.: save the state_dict\(\) of one"):
        fit_weights(made(layers, "plain"), two)
    inner = tensors | {f"refine.{name}": tensor for name, tensor in tensors.items()}
    with pytest.raises(BadInput, match=r"the class has no refine\.lin0\.weight"):
        fit_weights(made(layers, "plain"), inner)
    wrapped = {f"module.{name}": tensor for name, tensor in tensors.items()}
    fit_weights(made(layers, "plain"), wrapped | {"loss.beta": torch.ones(2), "n_averaged": torch.tensor(3)})
    wider = {f"colour.{name}": torch.ones(9, *tensor.shape[1:]) for name, tensor in tensors.items()}
    fit_weights(made(layers, "plain"), wider | {f"sdf.{name}": tensor for name, tensor in tensors.items()})


CODE_FORMS = {
    "table": lambda codes: codes,
    "under a name": lambda codes: {"latent_codes": {"weight": codes}, "epoch": 3},
    "of DeepSDF's first code": lambda codes: {"epoch": torch.tensor(3), "latent_codes": codes[:, None]},
    "list": lambda codes: [*codes],
    "list of rows": lambda codes: {"latent_codes": [*codes[:, None]]},
    "by shape": lambda codes: {f"shape{n}": code for n, code in enumerate(codes)},
    "of one shape": lambda codes: codes[0] if len(codes) == 1 else codes,
    "with others": lambda codes: {"codes": codes, "mean": torch.ones(codes.shape[1] + 1)},
}


@given(st.integers(1, 4), st.integers(1, 5), st.sampled_from(sorted(CODE_FORMS)), DTYPES)
def test_codes_are_read_in_any_form(tmp_path_factory, count, length, form, dtype):
    folder, codes = tmp_path_factory.mktemp("codes"), torch.randn(count, length).to(dtype)
    torch.save(CODE_FORMS[form](codes), folder / "codes.pth")
    assert torch.equal(read_codes(folder / "codes.pth", length), codes.float())
    for array in (codes.double().numpy(), codes.double().numpy()[:, None]):
        np.save(folder / "codes.npy", array)
        assert torch.equal(read_codes(folder / "codes.npy", length), codes.float())


@each("content, shown", [
    (torch.ones(2, 3), "tensor [2, 3]"),
    ([torch.ones(4), torch.ones(5)], "0 [4], 1 [5]"),
    ({"a": torch.ones(2, 4), "b": torch.ones(3, 4)}, "a [2, 4], b [3, 4]"),
    (torch.ones(2, 3, 4), "[2, 3, 4]"),
    ({"epoch": 3}, "no tensors"),
])  # fmt: skip
def test_codes_of_another_form_are_refused_by_their_shapes(tmp_path, content, shown):
    torch.save(content, tmp_path / "codes.pth")
    if shown == "0 [4], 1 [5]":  # the only tensor of this length
        assert read_codes(tmp_path / "codes.pth", 4).shape == (1, 4)
        return
    with pytest.raises(BadInput) as error:
        read_codes(tmp_path / "codes.pth", 4)
    for word in ("[shapes, 4]", "codes.pth has", shown, "save one such tensor"):
        assert word in str(error.value)
