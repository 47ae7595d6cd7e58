"""A network's file as a dataset: what is measured of it, and what is refused; the files are made here."""

import os
import pickle
import warnings
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from bench.config import load
from bench.setup.inputs import RunInputs
from datasets.files.field_files import expand_field_file
from datasets.files.network_files import NetworkFile
from datasets.scene import Split
from renderers.checks import BadInput
from renderers.field import LIPSCHITZ_SAFETY_FACTOR, Field, Kind, autograd_gradients, points_in_sphere
from renderers.fields.networks.network import from_module, measure_field
from tests.composing import composed
from tests.documentation import code_of
from tests.looped import each
from tests.made_networks import RADIUS, arrays, deepsdf_folder, npz, octahedron
from tests.renderers.test_published import CODE, directly, implicit, occupancy
from tests.tiny import inputs_from

NET = """
import torch

class Net(torch.nn.Module):
    def __init__(self, scale):
        super().__init__()
        self.inner, self.scale, self.drop = torch.nn.Linear(3, 1), scale, torch.nn.Dropout(0.5)

    def forward(self, points):
        return self.drop(self.inner(points)) * self.scale / 2
"""
POINTS = points_in_sphere(64, torch.zeros(()))


def checkpoint(folder: Path, state: Any, name: str = "shape.pth") -> NetworkFile:
    torch.save(state, folder / name)
    return load("dataset", "network", path=str(folder / name))


def field_of(file: NetworkFile, index: int = 0) -> Field:
    network = file.network(index)
    return network.decoder.at(network.codes[index])


def near(values: Tensor, expected: Tensor, most: float = 1e-6) -> None:
    torch.testing.assert_close(values, expected, rtol=0, atol=most)


def test_a_distance_is_found_to_be_one_and_its_values_stay(tmp_path):
    file = npz(tmp_path, arrays())
    field = field_of(file)
    assert (field.kind, field.lipschitz) == (Kind.DISTANCE, None)
    near(field(POINTS), octahedron(POINTS))
    facts = measure_field(field, POINTS).statistics
    assert facts.sphere_fraction_inside == 0 and 0.99 < facts.min_slope <= facts.max_slope < 1.01
    assert facts.fraction_inside == pytest.approx(2 * 3**0.5 * RADIUS**3 * 2 / (4 / 3 * np.pi), abs=0.02)
    assert list(facts.extent) == pytest.approx([2 * 3**0.5 * RADIUS] * 3, abs=0.3)
    (note,) = file.network(0).notes
    for word in ("shape: values are negative inside", "level 0", "slopes from 1 to 1", "taken as a distance"):
        assert word in note


@each("factor, level, inside, kind, divided", [
    (-1.0, 0.0, "positive", Kind.DISTANCE, 1.0),
    (20.0, 0.0, "negative", Kind.BOUND, 24.0),
    (-20.0, 0.0, "positive", Kind.BOUND, 24.0),
    (-0.4, 0.4, "positive", Kind.BOUND, 0.48),
])  # fmt: skip
def test_sign_level_and_slope_are_measured(tmp_path, factor, level, inside, kind, divided):
    file = replace(npz(tmp_path, arrays(factor, level)), level=level)
    field = field_of(file)
    assert field.kind is kind and f"values are {inside} inside" in file.network(0).notes[0]
    near(field(POINTS) * divided, abs(factor) * octahedron(POINTS), 1e-4)


def test_values_between_0_and_1_are_probabilities_only_where_that_is_said(tmp_path):
    file = npz(tmp_path, arrays(0.5, 0.5))  # from 0.25 to 0.81
    with pytest.raises(BadInput, match=r"level 0 is not among them: set dataset.level \(0.5 where they are prob"):
        file.network(0)
    file = replace(file, level=0.5)
    assert torch.equal(field_of(file)(POINTS) < 0, octahedron(POINTS) < 0)
    assert "at the level 0.5" in file.network(0).notes[0]


def test_a_network_of_a_code_needs_its_codes_and_states_its_level(tmp_path):
    torch.manual_seed(0)
    path = tmp_path / "code.npy"
    state, logits = occupancy("shift")
    for name, moved in (("weight", 0.0), ("bias", logits.median())):  # so that logits are about 0
        state[f"decoder.fc_out.{name}"] = 4 * (state[f"decoder.fc_out.{name}"] - moved)
    file = checkpoint(tmp_path, state)
    with pytest.raises(BadInput, match=r"a code of 2 numbers, which it does not hold: set dataset.codes=FILE"):
        file.network(0)
    np.save(path, CODE.double().numpy()[None])
    for level, probability in ((0.0, 0.5), (-1.386, 0.2)):
        note = replace(file, codes=str(path), level=level).network(0).notes[0]
        assert f"level {level:g} of the logits, a probability of {probability} (" in note
        assert "dataset.level=-1.386" in note


def test_what_is_said_of_a_network_goes_before_what_is_measured(tmp_path):
    field = field_of(replace(npz(tmp_path, arrays(20.0)), kind="level", inside="positive", scale=0.5))
    assert field.kind is Kind.LEVEL
    near(field(0.5 * POINTS), -10 * octahedron(POINTS), 1e-4)


def test_the_surface_is_the_true_mesh_closed_where_it_leaves_the_sphere(tmp_path):
    file = replace(npz(tmp_path, arrays()), resolution=48)
    mesh = file.mesh(Split.TEST, 0)
    assert mesh.watertight and octahedron(torch.from_numpy(mesh.vertices.copy())).abs().max() < 0.02
    large = replace(file, scale=1.4)
    mesh, network = large.mesh(Split.TRAIN, 0), large.network(0)
    assert mesh.watertight and np.linalg.norm(mesh.vertices, axis=1).max() < 1.01
    assert "of the unit sphere's surface is inside" in network.notes[0]


@each("codes, dtype, most", [
    (torch.tensor([[0.1], [-0.2]]), torch.float32, 1e-6),
    ({"weight": torch.tensor([[0.1], [-0.2]])}, torch.float32, 1e-6),
    (torch.tensor([[[0.1]], [[-0.2]]]), torch.float16, 1e-3),
])  # fmt: skip
def test_a_deepsdf_folder_has_a_shape_for_each_code(tmp_path_factory, codes, dtype, most):
    file = deepsdf_folder(tmp_path_factory.mktemp("folder"), codes, dtype)
    for index, code in enumerate((0.1, -0.2)):
        near(field_of(file, index)(POINTS), octahedron(POINTS) + code, most)
    with pytest.raises(BadInput, match="it has 2 codes, and index=2 is none of them: set index=0 to 1"):
        file.network(2)


def test_sign_and_bound_are_those_of_the_network_at_several_codes(tmp_path):
    codes = torch.tensor([[0.1], [-0.2], [-0.45]])  # the last reaches through most of the unit sphere
    near(field_of(deepsdf_folder(tmp_path, codes), 2)(POINTS), octahedron(POINTS) - 0.45)
    bound = measure_field(octahedron, POINTS, kind=Kind.BOUND, others=[lambda points: 3 * octahedron(points)])
    assert bound.divisor == pytest.approx(3 * measure_field(octahedron, POINTS, kind=Kind.BOUND).divisor)


def test_a_bound_that_is_scaled_has_no_slope_above_1_at_the_steepest_code():
    steep = lambda points: 3 * octahedron(points)  # noqa: E731
    bound = measure_field(octahedron, POINTS, kind=Kind.BOUND, scale=3.0, others=[octahedron, steep])
    slopes = autograd_gradients(lambda points: bound.factor * steep(points), POINTS).norm(dim=-1)
    assert bound.lipschitz == 1.0 and slopes.max() == pytest.approx(1 / LIPSCHITZ_SAFETY_FACTOR, rel=1e-3)


def test_a_changed_file_is_read_again_and_is_another_dataset(tmp_path):
    file = npz(tmp_path, arrays())
    before = file.network(0).notes, file.identity()
    with pytest.raises(BadInput, match=r"it has one code: set index=0$"):
        file.network(3)
    npz(tmp_path, arrays(3.0))
    assert file.network(0).notes != before[0]
    assert file.identity() != before[1]


class Command:
    """A pickle of it would run a command."""

    def __reduce__(self) -> Any:
        return os.mkdir, ("was_run",)


def scripted(folder: Path) -> NetworkFile:
    with warnings.catch_warnings(action="ignore"):  # newer versions say that it is old
        torch.jit.script(torch.nn.Linear(3, 1)).save(folder / "shape.pt")
    return load("dataset", "network", path=str(folder / "shape.pt"))


def holding(folder: Path, content: bytes) -> NetworkFile:
    (folder / "shape.obj").write_bytes(content)
    return load("dataset", "network", path=str(folder / "shape.obj"))


def cut(file: NetworkFile) -> NetworkFile:
    content = Path(file.path).read_bytes()
    Path(file.path).write_bytes(content[: len(content) // 2])
    return file


def lacking(folder: Path, name: str) -> NetworkFile:
    file = deepsdf_folder(folder, torch.zeros(1, 1))
    (folder / name).unlink()
    return file


@each("make, words", [
    (lambda d: checkpoint(d, {"model": Command()}), ("shape.pth", "more than weights, which is not run", "mkdir")),
    (lambda d: checkpoint(d, {"a.weight": torch.ones(2)}), ("no format that is read", "IDR, NeuS", "a.weight")),
    (lambda d: checkpoint(d, {"module.lin0.bias": torch.ones(2)}), ("DeepSDF (name the folder with its specs.json)",)),
    (lambda d: scripted(d), ("TorchScript, a program, which is not run: save its state_dict()",)),
    (lambda d: checkpoint(d, {"epoch": 3}), ("no format that is read", "by field._target_=PACKAGE.CLASS", "no ten")),
    (lambda d: holding(d, b"v 0 0 0"), ("shape.obj is no network file, or is broken: name a checkpoint",)),
    (lambda d: holding(d, b"a mesh"), ("shape.obj is no network file",)),  # "a" is an instruction of pickle
    (lambda d: holding(d, pickle.dumps(Command(), protocol=2)), ("not run",)),
    (lambda d: cut(npz(d, arrays())), ("npz: it cannot be read",)),
    (lambda d: cut(checkpoint(d, {"x": torch.ones(9999)})), ("cannot be read: it may be cut short, copy it again",)),
    (lambda d: lacking(d, "specs.json"), ("the folder has no specs.json",)),
    (lambda d: lacking(d, "ModelParameters/latest.pth"), ("the folder has no ModelParameters/latest.pth",)),
    (lambda d: npz(d, arrays() | {"0001.relu._": np.array([object()])}), ("cannot be read", "allow_pickle")),
    (lambda d: npz(d, arrays(level=9.0)), ("between 8.5", "and the surface at the level 0", "dataset.level")),
    (lambda d: npz(d, arrays() | {"0002.dense.b": np.array([np.nan])}), ("not finite at 16384 of 16384",)),
])  # fmt: skip
def test_a_file_that_will_not_do_is_refused_with_the_cause(tmp_path_factory, monkeypatch, make, words):
    folder = tmp_path_factory.mktemp("wrong")
    monkeypatch.chdir(folder)
    file = make(folder)
    with pytest.raises(BadInput) as error:
        file.network(0)
    for word in (file.path, *words):
        assert word in str(error.value)
    assert not (folder / "was_run").exists()


@each("settings, words", [
    ({"path": "nowhere.npz"}, "there is nothing at 'nowhere.npz'"),
    ({"scale": 0.0}, "dataset.scale must be positive"),
    ({"inside": "left"}, "dataset.inside must be one of auto, negative, positive"),
    ({"kind": "exact"}, "dataset.kind must be one of auto, distance, bound, level"),
])  # fmt: skip
def test_settings_are_checked(tmp_path_factory, settings, words):
    file = npz(tmp_path_factory.mktemp("file"), arrays())
    with pytest.raises(ValueError, match=words):
        replace(file, **settings)


def test_a_module_whose_values_are_no_shape_is_refused_and_half_floats_are_rendered():
    for wrong in (lambda points: 0.5 - points.norm(dim=-1), lambda points: octahedron(points).sigmoid()):
        with pytest.raises(BadInput, match="negate them, subtract the level of the surface"):
            from_module(wrong)
    plane = torch.nn.Linear(3, 1, bias=False).half()  # through the origin, whatever is drawn
    assert from_module(plane)(POINTS).dtype == POINTS.dtype == torch.float32


def test_a_module_that_is_no_distance_becomes_a_bound_by_its_slope():
    module = torch.nn.Linear(3, 1)
    torch.nn.init.constant_(module.weight, 2.0)  # a slope of 2 sqrt(3), which no distance has
    field = from_module(module)
    steepest = 1.2 * module.weight.norm()
    assert (field.kind, field.lipschitz) == (Kind.BOUND, 1.0)
    torch.testing.assert_close(field(POINTS), module(POINTS)[:, 0] / steepest)
    assert from_module(module, kind=Kind.LEVEL).kind is Kind.LEVEL


@each("overrides, composed", [
    (["field=file", "field_path=a.npz", "index=3"], ["dataset=network", "dataset.path=a.npz", "index=3"]),
    (["-m", "field=sphere", "dataset=sofa"], ["-m", "field=sphere", "dataset=sofa"]),
])  # fmt: skip
def test_a_file_as_the_field_is_a_dataset(overrides, composed):
    assert expand_field_file(overrides) == composed


@each("overrides, words", [
    (["field=file"], "field=file field_path=PATH"),
    (["field_path=a.npz"], "field=file field_path=PATH"),
    (["field=file", "field_path=a.npz", "dataset=sofa"], "remove dataset"),
])  # fmt: skip
def test_half_of_the_two_is_refused(overrides, words):
    with pytest.raises(ValueError, match=words):
        expand_field_file(overrides)


def composed_inputs(*overrides: str) -> RunInputs:
    return inputs_from(composed(*overrides, "scale=smoke"))


def test_its_field_is_that_of_the_scene_and_its_codes_are_the_prior(tmp_path):
    file = deepsdf_folder(tmp_path, torch.tensor([[0.1], [-0.2]]))
    inputs = composed_inputs("task=ablation", "dataset=network", f"dataset.path={file.path}", "index=1")
    fitted = inputs.fitted()
    assert len(inputs.prior.codes) == 2 and inputs.notes[-1] == file.network(1).notes[0]
    near(fitted.decoder.at(fitted.codes[0])(POINTS), octahedron(POINTS) - 0.2)


def test_its_codes_are_the_prior_of_another_dataset(tmp_path):
    file = deepsdf_folder(tmp_path, torch.tensor([[0.1], [-0.2]]))
    inputs = composed_inputs("dataset=sphere", "prior=deepsdf", f"prior.path={file.path}", "split=train")
    assert inputs.prior.codes.tolist() == file.network(0).codes.tolist() and inputs.prior_choice.scene_code is None
    near(inputs.prior.decoder.at(torch.tensor([0.3]))(POINTS), octahedron(POINTS) + 0.3)


@each("wrong, words", [
    ("prior.path={path}/none", "prior.path: there is nothing at"),
    ("prior.scale=-1", "prior.scale must be positive"),
    ("prior.level=9", r"the network {path}: .*: set prior.level \(.*, or prior.scale$"),
])  # fmt: skip
def test_keys_of_a_prior_are_named_as_its_own(tmp_path_factory, wrong, words):
    path = deepsdf_folder(tmp_path_factory.mktemp("dataset.path"), torch.zeros(1, 1)).path
    with pytest.raises(ValueError, match=words.format(path=path)):
        composed_inputs("dataset=sphere", "prior=deepsdf", f"prior.path='{path}'", wrong.format(path=path))


def test_a_network_of_a_class_of_the_users_is_read_by_its_state(tmp_path, monkeypatch):
    (tmp_path / "mynet.py").write_text(NET)
    monkeypatch.syspath_prepend(tmp_path)
    state = {"weight": torch.tensor([[0.6, 0.0, 0.8]]), "bias": torch.tensor([0.25])}
    torch.save({"model": {f"net.inner.{key}": value for key, value in state.items()}, "step": 3}, tmp_path / "a.pth")
    overrides = expand_field_file(
        ["field=file", f"field_path={tmp_path}/a.pth", "field._target_=mynet.Net", "field.scale=2"]
    )
    inputs = composed_inputs(*overrides, "task=ablation", "packages=[mynet]")
    near(inputs.prior.decoder.at(inputs.prior.codes[0])(POINTS), POINTS @ state["weight"][0] + 0.25)
    several = {f"{name}.inner.{key}": value for name in "ab" for key, value in state.items()}
    for wrong, words in (
        (several, r"it has several networks, a\., b\.: save the state_dict"),
        ({"net.inner.bias": state["bias"]}, r"not those of Net: it lacks inner\.weight: .* by field\."),
    ):
        torch.save(wrong, tmp_path / "a.pth")
        with pytest.raises(BadInput, match=words):
            composed_inputs(*overrides, "task=ablation", "packages=[mynet]")
    with pytest.raises(ValueError, match=r"type packages=\[mynet\] if you trust it"):
        composed_inputs(*overrides, "task=ablation")


OUTPUTS = """
import torch
from torch import nn

class Box(nn.Module):
    def __init__(self, output, dtype="float32", norm=False):
        super().__init__()
        self.inner, self.output = nn.Linear(3, 6, dtype=getattr(torch, dtype)), output
        self.inner = nn.utils.weight_norm(self.inner) if norm else self.inner

    def forward(self, points):
        values = self.inner(points.double() if self.output == "double" else points).relu().sum(-1) / 3**0.5 - 0.5
        if self.output == "in place":
            points *= 0
        return {
            "tuple": (values, points), "table": {"sdf": values}, "columns": points * 0 + values[:, None],
            "unsigned": values.abs(), "probability": (-9 * values).sigmoid(), "density": (points, 9 * (-values).relu()),
        }.get(self.output, values)
"""


def box(folder: Path, monkeypatch: pytest.MonkeyPatch, *keys: str) -> RunInputs:
    """A run's inputs whose field is the octahedron, in a class of the user with these keys."""
    (folder / "boxes.py").write_text(OUTPUTS)
    monkeypatch.syspath_prepend(folder)
    layers = arrays()
    state = {"weight": torch.tensor(layers["0000.dense.A"].T), "bias": torch.tensor(layers["0000.dense.b"])}
    torch.save({f"_orig_mod.inner.{key}": value for key, value in state.items()}, folder / "a.pth")
    field = ["field=file", f"field_path={folder}/a.pth", "field._target_=boxes.Box", *keys]
    return composed_inputs(*expand_field_file(field), "task=ablation", "packages=[boxes]")


@each("keys, note", [
    (["field.output=tuple"], "values are '0' of the output of Box.forward"),
    (["field.output=table"], "values are 'sdf' of the output of Box.forward"),
    (["field.output=in place"], "level 0; slopes"),
    (["field.output=plain", "field.norm=true"], "level 0; slopes"),
    (["field.output=plain", "field.dtype=float16"], "level 0; slopes"),
    (["field.output=plain", "field.dtype=float64"], "level 0; slopes"),
    (["field.output=double", "field.dtype=float64"], "level 0; slopes"),
])  # fmt: skip
@pytest.mark.filterwarnings("ignore::FutureWarning")  # of the older normalisation of weights
def test_a_users_class_is_converted_where_it_can_be(tmp_path, monkeypatch, keys, note):
    inputs = box(tmp_path, monkeypatch, *keys)
    field = inputs.prior.decoder.at(inputs.prior.codes[0])
    near(field(POINTS), octahedron(POINTS), 1e-6)
    assert note in inputs.notes[-1] and field(POINTS).dtype == torch.float32


@each("output, remedy", [
    ("unsigned", r"dataset\.level \(0\.05 for a shell, as unsigned distances have no inside\)"),
    ("probability", r"dataset\.level \(0\.5 where they are probabilities\)"),
    ("density", r"dataset\.level \(such as 2\.\d where they are densities\)"),
    ("columns", r"Box\.forward gives a Tensor of float32 \[n, 3\]: .*return the values alone"),
])  # fmt: skip
def test_a_users_class_is_refused_with_file_cause_and_remedy(tmp_path, monkeypatch, output, remedy):
    with pytest.raises(BadInput, match=rf"the network {tmp_path}/a\.pth: .*{remedy}"):
        box(tmp_path, monkeypatch, f"field.output={output}")


@each("output, level, inside", [
    ("unsigned", 0.05, lambda values: values.abs() < 0.05),
    ("probability", 0.5, lambda values: values < 0),
    ("density", 2.25, lambda values: values < -0.25),
])  # fmt: skip
def test_the_remedies_for_values_of_one_sign_hold(tmp_path, monkeypatch, output, level, inside):
    inputs = box(tmp_path, monkeypatch, f"field.output={output}", f"dataset.level={level}")
    assert torch.equal(inputs.prior.decoder.at(inputs.prior.codes[0])(POINTS) < 0, inside(octahedron(POINTS)))


def test_the_activation_of_neus_is_named_as_an_assumption(tmp_path):
    torch.manual_seed(0)
    state, values = implicit("implicit_network._orig_mod.", 0, directly)
    for shift in (-values.median(), 99.0):
        last = "implicit_network._orig_mod.lin3.bias"
        file = checkpoint(tmp_path, state | {last: state[last] + shift})
        with nullcontext() if shift < 99 else pytest.raises(BadInput) as error:
            shown = file.network(0).notes[0]
        shown = shown if shift < 99 else str(error.value)
        assert "softplus" in shown and "field._target_=PACKAGE.CLASS" in shown


def test_a_stress_that_a_network_has_no_part_in_is_refused(tmp_path):
    overrides = ("task=stability", "dataset=network", f"dataset.path={npz(tmp_path, arrays()).path}")
    with pytest.raises(BadInput, match="the stress gap renders no network: remove field=file, or set stress="):
        composed_inputs(*overrides, "stress=gap")
    with pytest.raises(BadInput, match="no code that the stress far_code could change: set stress=noisy_weights"):
        composed_inputs(*overrides, "stress=far_code")
    composed_inputs(*overrides, "stress=noisy_weights")


def test_a_network_of_ones_own_is_trained_and_read_as_the_page_says(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (code,) = code_of("datasets/README.md", "python")
    exec(compile(code, "datasets/README.md", "exec"), {})
    mesh = replace(load("dataset", "network", path="mine.npz"), resolution=48).mesh(Split.TEST, 0)
    assert mesh.watertight and mesh.vertices.max(axis=0) == pytest.approx([0.6] * 3, abs=0.1)
