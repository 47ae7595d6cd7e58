"""Two things that must coincide: the change of axes, units and origin that fits, and what must not be refused."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.files import coincidence
from datasets.files.coincidence import (
    DISTANCE,
    IDENTITY,
    Change,
    Comparison,
    compare_outlines,
    compare_surfaces,
    samples_of,
    settled,
    turns,
)
from datasets.files.own_photographs import read_capture
from datasets.mesh import Mesh
from datasets.scene import sample_surface
from renderers.checks import BadInput
from tests.looped import each
from tests.made_dtu import ball, solid
from tests.made_photographs import CENTRE, RADIUS, READ, nerf

FACTORS = {1.0: "", 10.0: "millimetres", 2.54: "inches", 1000.0: "millimetres", 0.01: "metres", 0.5: ""}


POINTS = samples_of(solid())


@pytest.mark.slow
@settings(max_examples=8, deadline=None, derandomize=True)
@given(st.integers(0, 47), st.sampled_from(sorted(FACTORS)), st.sampled_from([0.0, 4.0]), st.booleans())
def test_the_change_that_was_made_is_undone(rank, factor, shift, is_partial):
    if (rank, factor, shift) == (0, 1.0, 0.0):
        return
    change = Change(turns()[rank], factor, np.array([shift, 0, -shift]))
    reference = change.apply(POINTS[POINTS[:, 2] > -0.1] if is_partial else POINTS)
    comparison = compare_surfaces(POINTS, reference, is_partial=is_partial)
    assert not comparison.coincides and np.array_equal(comparison.change.turn, change.turn)
    assert comparison.change.factor == pytest.approx(factor, rel=0.03)
    moved = comparison.change.apply(POINTS) - change.apply(POINTS)
    assert np.abs(moved).max() < 0.06 * factor
    text = comparison.text("dataset.truth", "the mesh")
    assert FACTORS[factor] in text and ("times as large" in text or "smaller" in text) == (factor != 1)
    with pytest.raises(BadInput, match=r"dataset.unchecked=true"):
        settled(comparison, text, unchecked=False)
    assert settled(comparison, text, unchecked=True) == (text,)


def test_there_are_24_rotations_and_24_mirrors_and_the_commonest_is_first():
    assert len({tuple(turn.flat) for turn in turns()}) == 48 and np.array_equal(turns()[0], IDENTITY.turn)
    assert [round(np.linalg.det(turn)) for turn in turns()] == [1] * 24 + [-1] * 24
    assert all("about x (z up against y up?)" in str(Change(turns()[i], 1.0, np.zeros(3))) for i in (1, 2))


@pytest.mark.slow
@each("spoil", [
    lambda p: p + 0.05 * np.random.default_rng(1).normal(size=p.shape), lambda p: p[p[:, 0] > 0], lambda p: 0.8 * p,
    lambda p: 0.6 * p / np.linalg.norm(p, axis=1, keepdims=True), lambda p: p + 0.1, lambda p: p * (1, 1, 0.6),
])  # fmt: skip
def test_a_poor_or_partial_surface_is_no_other_frame(spoil, monkeypatch):
    monkeypatch.setattr(coincidence, "SAMPLES", (4000, 200))  # faster
    monkeypatch.setattr(coincidence, "FAST_SAMPLES", (1500, 80))
    for is_partial in (False, True):
        assert not compare_surfaces(spoil(POINTS), POINTS, is_partial=is_partial).is_other_frame
        assert not compare_surfaces(POINTS, spoil(POINTS), is_partial=is_partial).is_other_frame


def test_a_small_part_of_a_large_mesh_fits_exactly_and_no_change_is_searched(monkeypatch):
    monkeypatch.setattr(coincidence, "_search", None)
    for offset in (0.0, 4e5):  # as of maps, in metres
        floor = 6.0 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
        sphere = ball(0.1, (2.0, 1.0, 0.1))
        vertices = np.concatenate([floor, sphere.vertices]) + offset
        mesh = Mesh(vertices, np.concatenate([[[0, 1, 2], [0, 2, 3]], sphere.faces + 4]))
        seen = sample_surface(sphere, 3000, seed=1).points + offset
        for reference in (seen, seen[seen[:, 2] > offset + 0.15]):
            assert compare_surfaces(mesh, reference, is_partial=True).misfit < 1e-4


def test_the_text_names_the_radius_and_caps_the_gain():
    comparison = Comparison(DISTANCE, 0.6, Change(turns()[1], 1.0, np.zeros(3)), 0.02, True)
    text = comparison.text("the mesh", "the truth")
    assert text.startswith("the mesh lies 0.6 times the radius of the truth from it, and fits 30 times better")
    assert "fits over 100 times better" in replace(comparison, misfit=4e5).text("the mesh", "the truth")


@each("turn", [turns()[1], turns()[7], turns()[30]])
def test_a_turned_symmetrical_shape_coincides(turn):
    sphere = samples_of(ball(1.0, (0, 0, 0)))
    assert compare_surfaces(Change(turn, 1.0, np.zeros(3)).apply(sphere), sphere, is_partial=False).coincides


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photographs")
    nerf(folder)
    return read_capture(folder, READ)


def test_the_outline_of_a_truth_fits_the_masks_or_names_its_units(capture):
    points = samples_of(ball(RADIUS, CENTRE))
    for few in (1, len(points) // 400):  # also of a sparse cloud
        assert compare_outlines(points[::few], capture.shots, capture.to_world).misfit < 0.3
    for factor, words in ((0.01, "100 times as large (metres against centimetres?)"), (2.54, "2.54 times smaller")):
        comparison = compare_outlines(factor * points, capture.shots, capture.to_world)
        assert not comparison.coincides and words in comparison.text("dataset.truth", "the masks")
    shifted = compare_outlines(np.add(points, (0.3, 0, 0)), capture.shots, capture.to_world)
    assert shifted.change.shift == pytest.approx([-0.3, 0, 0], abs=0.05)
    half = compare_outlines(points[points[:, 1] > CENTRE[1]], capture.shots, capture.to_world)
    assert not half.is_other_frame


def test_a_large_background_in_the_file_of_a_truth_hides_no_fit(capture):
    truth, far = ball(RADIUS, CENTRE), ball(60.0, CENTRE + 200)
    mesh = Mesh(
        np.concatenate([truth.vertices, far.vertices]), np.concatenate([truth.faces, far.faces + len(truth.vertices)])
    )
    cloud = np.concatenate([samples_of(truth)[:2000], samples_of(far)])
    for shape in (mesh, cloud):
        comparison = compare_outlines(shape, capture.shots, capture.to_world)
        assert comparison.coincides and comparison.misfit < 0.2
    shifted = compare_outlines(replace(mesh, vertices=mesh.vertices + 0.5), capture.shots, capture.to_world)
    assert not shifted.coincides
