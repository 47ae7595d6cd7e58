"""Kept references: right, found again, and never those of something else."""

import re
from dataclasses import replace

import pytest
import torch

from bench.evaluate import reference as reference_store
from bench.evaluate.reference import in_float64, make_reference, reference_for
from bench.shape_prior.autodecoder import Prior
from renderers.field import Kind
from renderers.fields.analytic import Shape
from tests.tiny import ball_prior, camera_of

PRIOR = ball_prior()
CAMERA = camera_of(12, angles=(70.0, 20.0))


def never(*_: object) -> None:
    raise AssertionError("a reference was made although there is one")


def test_the_reference_agrees_with_dense_sampling():
    field = in_float64(PRIOR).decoder.at(PRIOR.codes[0].double())
    reference = make_reference(field, CAMERA)
    rays, t = CAMERA.double().rays(), torch.linspace(1.4, 3.6, 4401, dtype=torch.float64)
    inside = field(rays.origins[..., None, :] + t[:, None] * rays.directions[..., None, :]) <= 0
    assert reference.hit.sum() > 20
    assert torch.equal(reference.hit, inside.any(-1))
    sampled = t[inside.int().argmax(-1)][reference.hit]
    found = reference.distance[reference.hit]
    assert ((sampled - found >= 0) & (sampled - found <= 5.1e-4)).all()
    points = rays.at(reference.distance)[reference.hit]
    assert field(points).abs().max() < 1e-12
    assert (reference.normals[reference.hit].norm(dim=-1) - 1).abs().max() < 1e-12
    outwards = torch.nn.functional.normalize(points - PRIOR.codes[0, :3].double(), dim=-1)
    assert (reference.normals[reference.hit] * outwards).sum(-1).min() > 0.98
    assert (reference.distance[~reference.hit] == 0).all()
    assert (reference.normals[~reference.hit] == 0).all()


def test_a_thin_plate_is_not_stepped_over():
    """A plate 1e-3 thick across the whole view."""
    plate = Shape(lambda points: points[..., 2].abs() - 5e-4, Kind.DISTANCE)
    reference = make_reference(plate, camera_of(8, field_of_view=20.0))
    assert reference.hit.all()
    assert reference.distance.min().item() == pytest.approx(2.5 - 5e-4, abs=0.01)


def test_it_is_kept_and_found_again(tmp_path, monkeypatch):
    folder = tmp_path / "a cache"
    first = reference_for(PRIOR, CAMERA, folder)
    (path,) = folder.glob("[!.]*")
    assert re.fullmatch(r"reference-[0-9a-f]{12}\.safetensors", path.name)
    monkeypatch.setattr(reference_store, "make_reference", never)
    again = reference_for(PRIOR, CAMERA, folder)
    for name in ("distance", "normals", "hit"):
        assert torch.equal(getattr(again, name), getattr(first, name))
    assert (again.distance.dtype, again.normals.dtype, again.hit.dtype) == (torch.float64, torch.float64, torch.bool)


def other_weights() -> Prior:
    prior = ball_prior()
    prior.decoder.hidden[0].weight[3, 5] += 1e-4
    return prior


def other_code(row: int) -> Prior:
    codes = PRIOR.codes.clone()
    codes[row, 1] += 1e-4
    return Prior(PRIOR.decoder, codes)


@pytest.mark.parametrize(
    ("prior", "camera", "new"),
    [
        (other_weights(), CAMERA, True),
        (ball_prior(radius=0.4), CAMERA, True),
        (other_code(0), CAMERA, True),
        (other_code(1), CAMERA, False),  # it is the first shape's
        (PRIOR, CAMERA.resized(13, 12), True),
        (PRIOR, CAMERA.resized(12, 13), True),
        (PRIOR, replace(CAMERA, height=13), True),
        (PRIOR, replace(CAMERA, width=13), True),
        (PRIOR, camera_of(12, angles=(70.1, 20.0)), True),
        (PRIOR, camera_of(12, angles=(70.0, 20.0), field_of_view=49.0), True),
        (PRIOR, camera_of(12, angles=(70.0, 20.0)), False),
        (ball_prior(), CAMERA, False),
    ],
)
def test_the_key_depends_on_weights_and_camera(tmp_path, prior, camera, new):
    reference_for(PRIOR, CAMERA, tmp_path)
    reference_for(prior, camera, tmp_path)
    assert len(list(tmp_path.glob("[!.]*"))) == (2 if new else 1)


def test_another_version_has_another_key(tmp_path, monkeypatch):
    reference_for(PRIOR, CAMERA, tmp_path)
    monkeypatch.setattr(reference_store, "VERSION", reference_store.VERSION + 1)
    reference_for(PRIOR, CAMERA, tmp_path)
    assert len(list(tmp_path.glob("[!.]*"))) == 2


def test_the_prior_stays_as_it_is(tmp_path):
    prior = ball_prior()
    reference_for(prior, CAMERA, tmp_path)
    assert prior.codes.dtype is torch.float32
    assert {p.dtype for p in prior.decoder.parameters()} == {torch.float32}
    twin = in_float64(prior)
    assert {p.dtype for p in twin.decoder.parameters()} == {twin.codes.dtype} == {torch.float64}
    assert torch.equal(twin.codes.float(), prior.codes)


@pytest.mark.parametrize("cut", [0, 100, -8])
def test_one_that_was_being_written_when_its_process_was_killed_is_made_anew(tmp_path, monkeypatch, cut):
    def killed(tensors, path):
        save_file(tensors, path)
        path.write_bytes(path.read_bytes()[:cut])
        raise KeyboardInterrupt

    save_file = reference_store.save_file
    monkeypatch.setattr(reference_store, "save_file", killed)
    with pytest.raises(KeyboardInterrupt):
        reference_for(PRIOR, CAMERA, tmp_path)
    assert list(tmp_path.glob("*.safetensors")) == []
    monkeypatch.setattr(reference_store, "save_file", save_file)
    expected = make_reference(in_float64(PRIOR).decoder.at(PRIOR.codes[0].double()), CAMERA)
    assert torch.equal(reference_for(PRIOR, CAMERA, tmp_path).distance, expected.distance)


def test_two_processes_that_make_the_same_one_do_not_meet(tmp_path, monkeypatch):
    written, save_file = [], reference_store.save_file
    monkeypatch.setattr(reference_store, "save_file", lambda t, path: (written.append(path), save_file(t, path)))
    for process in (11, 12):
        monkeypatch.setattr(reference_store.os, "getpid", lambda process=process: process)
        reference_for(PRIOR, CAMERA, tmp_path)
        next(tmp_path.glob("*.safetensors")).unlink()
    assert len(set(written)) == 2


@pytest.mark.parametrize("data", [b"", b"\xff" * 1000])
def test_a_damaged_file_is_an_error_with_a_remedy(tmp_path, data):
    reference_for(PRIOR, CAMERA, tmp_path)
    (path,) = tmp_path.glob("[!.]*")
    path.write_bytes(data)
    with pytest.raises(ValueError, match=rf"the reference .*{path.name} cannot be read .*: delete it, and it is made"):
        reference_for(PRIOR, CAMERA, tmp_path)


def test_the_camera_may_be_in_any_precision():
    field = in_float64(PRIOR).decoder.at(PRIOR.codes[0].double())
    single, double = make_reference(field, CAMERA), make_reference(field, CAMERA.double())
    assert torch.equal(single.distance, double.distance)
