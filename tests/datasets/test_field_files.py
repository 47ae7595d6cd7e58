"""The saved field of a run is the same after reading, and its file cannot have other effects."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

import bench
from bench.records.results import RESULTS
from bench.tasks.capacity.candidates import PRIMITIVES
from datasets import saved_field
from datasets.files.field_files import _read, load_field, load_network
from datasets.saved_field import FIELD_FILE, VERSION, save_field
from renderers.checks import BadInput
from renderers.field import Field, Flops, Kind, Moved
from renderers.fields.analytic import sphere
from renderers.fields.grid import Grid
from renderers.fields.mlp import Decoder
from renderers.fields.networks.coloured import (
    ColouredDistance,
    ColouredEncoded,
    ColouredGrid,
    ColouredOccupancy,
    ScaledOccupancyOf,
)
from renderers.fields.networks.encoded import EncodedNetwork, FourierFeatures, HashGrid
from renderers.fields.networks.lipschitz import LipschitzNetwork
from renderers.fields.networks.network import Coded, Published
from renderers.fields.networks.occupancy import OccupancyNetwork
from renderers.fields.networks.published import Layered
from renderers.fields.parts import FORMULAS, formula
from renderers.fields.textured import TexturedDecoder

POINTS = torch.rand(1000, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1


def numbers(*shape: int) -> torch.Tensor:
    return 0.3 * torch.randn(*shape, generator=torch.Generator().manual_seed(1))


def decoder() -> Field:
    network = Decoder(layers=3, width=16, code_length=4, skip=2, narrow=False)
    network.kind, network.lipschitz = Kind.BOUND, 1.0
    return network.at(numbers(4).requires_grad_())


def published() -> Field:
    layers = [(numbers(8, 9), numbers(8)), (numbers(8, 17), numbers(8)), (numbers(1, 8), numbers(1))]
    body = Layered(layers, activation="softplus", again={1: True}, frequencies=1, norms={0: (numbers(8), numbers(8))})
    return Published(Coded(body, code_length=0, width=8), 2).at(numbers(3))


FIELDS = {
    "decoder": decoder,
    "moved": lambda: Moved(decoder(), numbers(7)),
    "published": published,
    "grid": lambda: Grid(numbers(6, 6, 6).permute(2, 1, 0), 1.05),
    "coloured": lambda: ColouredDistance(layers=2, width=8, octaves=1, radius=0.5, directional=True),
    "fourier": lambda: EncodedNetwork(
        FourierFeatures(numbers(4, 3)), ((numbers(5, 11), numbers(5)), (numbers(1, 5), numbers(1)))
    ),
    "hash": lambda: EncodedNetwork(
        HashGrid(numbers(2, 16, 2), (2, 4), 1.05), ((numbers(5, 7), numbers(5)), (numbers(1, 5), numbers(1)))
    ),
    "lipschitz": lambda: LipschitzNetwork.new(2, 6, seed=1),
    "textured": lambda: TexturedDecoder(layers=2, width=8, code_length=4, skip=1, narrow=False).at(numbers(4)),
    "coloured_hash": lambda: ColouredEncoded(
        HashGrid(numbers(2, 16, 2), (2, 4), 1.05), layers=1, width=8, radius=0.5, directional=True
    ),
    "coloured_fourier": lambda: ColouredEncoded(
        FourierFeatures(numbers(4, 3)), layers=2, width=8, radius=0.5, directional=False
    ),
    "coloured_grid": lambda: ColouredGrid(samples=6, radius=0.5, reach=1.05),
    "occupancy": lambda: ColouredOccupancy(width=8, radius=0.5).field,
    "occupancy_at_code": lambda: ScaledOccupancyOf(OccupancyNetwork(width=8, code_length=3).at(numbers(3))),
    **{
        name: lambda n=name: formula(n, numbers(PRIMITIVES[n].size), Flops(1, 2))
        for name in sorted({*FORMULAS} - {"union"})
    },
    "union": lambda: formula("union", numbers(3, 10), Flops(3, 6)),
}


@pytest.mark.parametrize("name", FIELDS)
def test_a_loaded_field_has_the_same_values_and_attributes(name, tmp_path):
    field = FIELDS[name]()
    assert save_field(field, tmp_path / FIELD_FILE) is None
    loaded = bench.load_field(tmp_path)
    assert type(loaded) is type(field)
    torch.testing.assert_close(loaded(POINTS), field(POINTS).detach(), rtol=0, atol=1e-6)
    assert (loaded.kind, loaded.lipschitz) == (field.kind, field.lipschitz) and not loaded(POINTS).requires_grad
    if hasattr(field, "colours"):
        inputs = POINTS, nn.functional.normalize(POINTS, dim=-1), nn.functional.normalize(POINTS, dim=-1)
        torch.testing.assert_close(loaded.colours(*inputs), field.colours(*inputs).detach(), rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["decoder", "coloured", "union"])
def test_a_loaded_network_has_a_translation_as_its_code(name, tmp_path):
    field = FIELDS[name]()
    save_field(field, tmp_path / FIELD_FILE)
    network = load_network(tmp_path)
    code = torch.tensor([0.1, 0.0, -0.1])
    torch.testing.assert_close(network.at(code)(POINTS), field(POINTS - code).detach(), rtol=0, atol=1e-5)


class UserField(nn.Module):
    kind, lipschitz, flops = Kind.DISTANCE, 1.0, None

    def forward(self, points):
        return points.norm(dim=-1) - 0.5


@pytest.mark.parametrize("field, words", [
    (UserField(), "test_field_files.UserField is no class"),
    (sphere(0.5), "function is no class"),
    (FIELDS["coloured"](), "0 MB are the most"),
])  # fmt: skip
def test_a_user_class_or_a_large_field_is_not_saved_with_a_reason(field, words, tmp_path, monkeypatch):
    monkeypatch.setattr(saved_field, "MAX_FIELD_BYTES", 1000)
    assert words in (save_field(field, tmp_path / FIELD_FILE) or "") and not [*tmp_path.iterdir()]


def changed(path: Path, old: str, new: str) -> None:
    """Replaces a text in the field description of a file."""
    tree = json.dumps(_read(path)[0])
    assert old in tree
    save_file(load_file(path), path, {"version": VERSION, "field": tree.replace(old, new)})


def test_the_name_of_a_run_is_enough_in_the_default_results_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = Path(RESULTS, "runs", "one")
    folder.mkdir(parents=True)
    save_field(FIELDS["decoder"](), folder / FIELD_FILE)
    assert torch.equal(load_field("one")(POINTS), load_field(folder)(POINTS))


@pytest.mark.parametrize("spoil, words", [
    (lambda path: path.write_bytes(path.read_bytes()[:-100]), "may be cut short"),
    (lambda path: path.write_bytes(b""), "may be cut short"),
    (Path.unlink, f"has no {FIELD_FILE}: a task that looks for no field, such as ablation"),
    (lambda path: shutil.rmtree(path.parent), "there is nothing at .*: give the folder of a run"),
    (lambda path: save_file(load_file(path), path), "version None of fields"),
    (lambda path: changed(path, "Linear", "Popen"), "'Popen', which is none of ours"),
    (lambda path: changed(path, '"octaves"', '"forward"'), "no attribute 'forward' that a file may set"),
    (lambda path: changed(path, '"octaves"', '"_forward_hooks"'), "no attribute '_forward_hooks'"),
    (lambda path: changed(path, '"octaves": 1', '"octaves": 2'), "its parts do not fit"),
    (lambda path: changed(path, '"t0"', '"t99"'), "its parts do not fit"),
])  # fmt: skip
def test_an_invalid_file_is_refused_with_the_cause(spoil, words, tmp_path):
    save_field(FIELDS["coloured"](), tmp_path / FIELD_FILE)
    spoil(tmp_path / FIELD_FILE)
    with pytest.raises(BadInput, match=words):
        load_field(tmp_path)
