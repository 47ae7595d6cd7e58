"""Shape priors: a small one learns, they are cached, and the shipped ones match this code."""

import json
from dataclasses import dataclass, replace

import pytest
import torch
import trimesh

from bench import shape_prior as prior_store
from bench.evaluate import prior_errors
from bench.evaluate.prior_errors import fit_error
from bench.setup.colour_codes import ColourSettings
from bench.shape_prior import (
    SHIPPED,
    DistanceSamples,
    NetworkSettings,
    PriorSettings,
    distance_samples,
    find_prior,
    make_prior,
    prior_for,
    prior_key,
    probe,
    train,
)
from datasets.families import FAMILIES
from datasets.scene import Split
from tests.tiny import CPU, inputs_from, mesh_of, silent

SETTINGS = PriorSettings(
    network=NetworkSettings(layers=3, width=48, code_length=4, skip=1, narrow=False),
    shapes=3, samples=600, steps=400, shapes_per_step=3, points_per_step=256, learning_rate=5e-3, beta2=0.99,
    code_sigma=0.1, code_penalty=1e-4, surface_width=0.05, seed=0,
)  # fmt: skip


@dataclass(frozen=True)
class Boxes:
    """Boxes from flat to tall; held-out heights are between those of training."""

    name: str = "boxes"
    widest: float = 0.5

    def mesh(self, split, index):
        height = [0.2, 0.5, 0.8][index % 3] + (0.0 if split is Split.TRAIN else 0.05)
        return mesh_of(trimesh.creation.box((2 * self.widest, 2 * height, 0.6)))

    def identity(self):
        return {"name": self.name, "widest": self.widest}


@pytest.fixture(scope="module")
def cached_prior(tmp_path_factory):
    """A folder with a prior that was trained once, and the prior."""
    folder = tmp_path_factory.mktemp("a cache") / "priors"
    return folder, prior_for(Boxes(), SETTINGS, folder, CPU, silent)


def never(*_, **__):
    raise AssertionError("a prior was trained although there is one")


def test_a_prior_learns_its_shapes(cached_prior):
    _, prior = cached_prior
    samples = distance_samples(Boxes(), Split.TRAIN, replace(SETTINGS, seed=9), 3, silent)
    fitted, mean_shape = fit_error(prior.decoder, samples, None), fit_error(prior.decoder, samples, None, steps=0)
    assert mean_shape > 0.05 and fitted < 0.25 * mean_shape
    with torch.no_grad():
        fields = [prior.decoder.at(code)(samples.points) for code in (prior.codes, torch.zeros(3, 4))]
    errors, mean_errors = ((field - samples.distances).abs() for field in fields)
    assert errors.mean() < 0.35 * mean_errors.mean()  # far from the surface too: a field that is zero near it fails
    assert errors[samples.distances.abs() < 0.02].mean() < 0.25 * mean_shape


def test_samples_are_signed_distances_of_the_mesh():
    samples = distance_samples(Boxes(), Split.TRAIN, SETTINGS, 2, silent)
    half = torch.tensor([[0.5, 0.2, 0.3], [0.5, 0.5, 0.3]])
    beyond = samples.points.abs() - half[:, None]
    exact = beyond.clamp_min(0).norm(dim=-1) + beyond.amax(-1).clamp_max(0)
    assert samples.points.shape == (2, 600, 3) and torch.allclose(samples.distances, exact, atol=1e-5)
    near = (samples.distances.abs() < 0.03).float().mean()
    assert 0.5 < near < 0.8  # half of the samples lie close to the surface, a third around it


def test_training_follows_its_seed():
    short = replace(SETTINGS, steps=3, samples=200)
    samples = distance_samples(Boxes(), Split.TRAIN, short, 3, silent)
    first, again, other = (train(samples, replace(short, seed=seed), CPU, silent) for seed in (0, 0, 1))
    assert torch.equal(first.codes, again.codes)
    assert torch.equal(first.decoder.last.weight, again.decoder.last.weight)
    assert not torch.equal(first.codes, other.codes)


def test_beyond_its_truncation_a_prior_is_not_constrained():
    points = 2 * torch.nn.functional.normalize(torch.randn(3, 64, 3), dim=-1)

    def trained(distance: float, truncation: float | None):
        """A network that begins as a sphere of radius 0.5, after steps at points far outside it."""
        settings = replace(SETTINGS, steps=3, points_per_step=8, truncation=truncation, code_penalty=0.0)
        samples = DistanceSamples(points, torch.full((3, 64), distance))
        return train(samples, settings, CPU, silent).decoder.state_dict()

    def equal(first: dict, other: dict) -> bool:
        return all(torch.equal(first[name], other[name]) for name in first)

    truncated = trained(0.9, 0.1)
    assert equal(truncated, trained(0.2, 0.1))  # both 0.9 and 0.2 are beyond 0.1
    assert not equal(truncated, trained(0.9, None))
    with pytest.raises(ValueError, match=r"prior\.truncation must be positive.*null compares distances everywhere"):
        replace(SETTINGS, truncation=0.0)


def test_a_prior_is_kept_with_its_record(cached_prior):
    folder, prior = cached_prior
    key = prior_key(Boxes(), SETTINGS)
    assert sorted(path.name for path in folder.glob("[!.]*")) == [f"boxes-{key}.json", f"boxes-{key}.safetensors"]
    record = json.loads((folder / f"boxes-{key}.json").read_text())
    assert record["key"] == key
    assert (record["dataset"], record["settings"]) == (Boxes().identity(), SETTINGS.identity)
    assert record["surface_error"]["validation"] < record["surface_error"]["mean_shape"]
    assert record["parameters"] == sum(p.numel() for p in prior.decoder.parameters())
    assert prior.codes.shape == (3, 4)


def test_a_prior_of_one_shape_is_evaluated_on_that_shape_at_its_code(tmp_path, monkeypatch):
    monkeypatch.setattr(prior_errors, "fit_error", never)
    settings = replace(SETTINGS, shapes=1, shapes_per_step=1)
    path = make_prior(Boxes(), settings, tmp_path, CPU, silent)
    record = json.loads(path.with_suffix(".json").read_text())
    assert set(record["surface_error"]) == {"training"}
    prior = prior_for(Boxes(), settings, tmp_path, CPU, silent)
    assert prior.codes.shape == (1, 4)
    samples = distance_samples(Boxes(), Split.TRAIN, settings, 1, silent)
    near = samples.distances[0].abs() < 0.02
    with torch.no_grad():
        error = (prior.decoder.at(prior.codes[0])(samples.points[0]) - samples.distances[0]).abs()
    assert record["surface_error"]["training"] == pytest.approx(error[near].mean().item(), rel=1e-4)
    assert record["surface_error"]["training"] < 0.02


def test_a_kept_prior_is_loaded_and_not_trained_again(cached_prior, monkeypatch):
    folder, prior = cached_prior
    monkeypatch.setattr(prior_store, "train", never)
    again = prior_for(Boxes(), SETTINGS, folder, CPU, silent)
    points = torch.rand(100, 3)
    code = torch.full((4,), 0.1)
    assert torch.equal(again.decoder.at(code)(points), prior.decoder.at(code)(points))
    assert torch.equal(again.codes, prior.codes)


def test_a_prior_of_colours_learns_them_and_is_kept(tmp_path):
    colour = ColourSettings("banded", size=0.8, samples=500, points_per_step=128, weight=0.3)
    settings = replace(SETTINGS, network=replace(SETTINGS.network, code_length=8), steps=300, colour=colour)
    prior = prior_for(Boxes(), settings, tmp_path, CPU, silent)
    samples = distance_samples(Boxes(), Split.TRAIN, replace(settings, seed=9), 3, silent)
    with torch.no_grad():
        shapes = prior.decoder.at(prior.codes)
        wrong = (shapes.paint(samples.surface) - samples.colours).abs().mean()
        plain = (samples.colours.mean(dim=1, keepdim=True) - samples.colours).abs().mean()
        assert wrong < 0.4 * plain and shapes(samples.surface).abs().mean() < 0.03
        half = prior.codes[0] * torch.tensor([1.0] * 4 + [-1.0] * 4)  # the same shape with another texture
        points, other = samples.surface[0], prior.decoder.at(half)
        assert torch.equal(other(points), prior.decoder.at(prior.codes[0])(points))
        assert (other.paint(points) - shapes.paint(samples.surface)[0]).abs().max() > 0.01
    assert find_prior(Boxes(), replace(settings, colour=replace(colour, size=0.5)), tmp_path) is None


def test_another_dataset_or_setting_has_another_key(cached_prior, monkeypatch):
    folder, _ = cached_prior
    changes = ({"steps": 401}, {"seed": 1}, {"network": replace(SETTINGS.network, width=47)})
    assert all(find_prior(Boxes(), replace(SETTINGS, **change), folder) is None for change in changes)
    assert find_prior(Boxes(widest=0.6), SETTINGS, folder) is None
    assert find_prior(Boxes(), SETTINGS, folder) is not None
    monkeypatch.setattr(prior_store, "VERSION", prior_store.VERSION + 1)
    assert find_prior(Boxes(), SETTINGS, folder) is None


def test_a_damaged_prior_is_an_error_with_a_remedy(cached_prior, tmp_path):
    path = find_prior(Boxes(), SETTINGS, cached_prior[0])
    (tmp_path / path.name).write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match=rf"the prior .*{path.name} cannot be read .*: delete it, and it is trained"):
        prior_for(Boxes(), SETTINGS, tmp_path, CPU, silent)


def shipped_records() -> list[dict]:
    return [json.loads(path.read_text()) for path in sorted(SHIPPED.glob("*.json"))]


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_the_shipped_priors_match_the_configuration(family, compose_config, tmp_path, monkeypatch):
    monkeypatch.setattr(prior_store, "train", never)
    probes = []
    for truncation in ("null", 0.1):
        desk = inputs_from(compose_config(f"dataset={family}", "scale=desk", f"prior.truncation={truncation}"))
        dataset, settings = desk.dataset, desk.prior_choice.source
        (record,) = (record for record in shipped_records() if record["key"] == prior_key(dataset, settings))
        assert (record["dataset"]["name"], record["settings"]) == (family, settings.identity)
        error = record["surface_error"]
        assert max(error["validation"], error["training"]) < 0.003 and error["mean_shape"] > 5 * error["validation"]
        path = find_prior(dataset, settings, tmp_path)
        assert path == SHIPPED / f"{dataset.name}-{record['key']}.safetensors" and path.stat().st_size < 1_000_000
        prior = prior_for(dataset, settings, tmp_path, CPU, silent)
        assert prior.codes.shape == (settings.shapes, settings.network.code_length)
        probes.append(record["probe"])
    assert probes == [pytest.approx(probe(dataset), rel=1e-4)] * 2  # the family has not changed
    assert list(tmp_path.iterdir()) == []


def test_every_shipped_file_belongs_to_a_family_and_serves_both_scales(compose_config):
    desk, smoke = (inputs_from(compose_config("dataset=sofa", f"scale={scale}")) for scale in ("desk", "smoke"))
    assert desk.prior_choice == smoke.prior_choice
    keys = {f"{record['dataset']['name']}-{record['key']}" for record in shipped_records()}
    names = {path.name for path in SHIPPED.iterdir()}
    assert names == {f"{key}.{suffix}" for key in keys for suffix in ("json", "safetensors")}
    assert len(keys) == 2 * len(FAMILIES)  # with truncated distances, and without
