"""Kept references: right, found again, and never those of something else."""

import re

import pytest
import torch

from bench.evaluate import reference as reference_store
from bench.evaluate.reference import Reference, in_float64, make_reference, reference_for
from bench.shape_prior import Prior
from renderers.camera import Camera
from renderers.field import Kind
from renderers.fields.analytic import Shape
from tests.looped import each
from tests.tiny import ball_prior, camera_of

PRIOR = ball_prior()
CAMERA = camera_of(12, angles=(70.0, 20.0))
BLANK = Reference(torch.zeros(1, 1).double(), torch.zeros(1, 1, 3).double(), torch.zeros(1, 1).bool())


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
    traced = reference.distance[reference.hit]
    assert ((sampled - traced >= 0) & (sampled - traced <= 5.1e-4)).all()
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
    monkeypatch.undo()
    path.write_bytes(path.read_bytes()[:100])  # cut short, so that it is made anew
    assert torch.equal(reference_for(PRIOR, CAMERA, folder).distance, first.distance)
    monkeypatch.setattr(reference_store, "VERSION", reference_store.VERSION + 1)
    reference_for(PRIOR, CAMERA, folder)
    assert len([*folder.glob("[!.]*")]) == 2


def other_weights() -> Prior:
    prior = ball_prior()
    prior.decoder.hidden[0].weight[3, 5] += 1e-4
    return prior


def other_code(row: int) -> Prior:
    codes = PRIOR.codes.clone()
    codes[row, 1] += 1e-4
    return Prior(PRIOR.decoder, codes)


@each("prior, camera, new", [
    (other_weights(), CAMERA, True), (other_code(0), CAMERA, True),
    (other_code(1), CAMERA, False),  # it is the first shape's
    (PRIOR, CAMERA.resized(13, 12), True),
    (PRIOR, Camera(CAMERA.intrinsics, CAMERA.world_to_camera, 12, 13), True),  # the same rays, and one more column
    (PRIOR, camera_of(12, angles=(70.1, 20.0)), True),
    (PRIOR, camera_of(12, angles=(70.0, 20.0), field_of_view=49.0), True),
    (ball_prior(), camera_of(12, angles=(70.0, 20.0)), False),
])  # fmt: skip
def test_the_key_depends_on_weights_and_camera(monkeypatch, tmp_path_factory, prior, camera, new):
    monkeypatch.setattr(reference_store, "make_reference", lambda field, camera: BLANK)
    folder = tmp_path_factory.mktemp("cache")
    for fitted, seen in ((PRIOR, CAMERA), (prior, camera)):
        reference_for(fitted, seen, folder)
    assert len(list(folder.glob("[!.]*"))) == (2 if new else 1)
