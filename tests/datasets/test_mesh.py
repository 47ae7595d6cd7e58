"""The mesh type: measures against closed forms, checks, saving and normalising."""

import numpy as np
import pytest
import trimesh

from datasets.files.meshes import concatenate_meshes
from datasets.files.repair import count_holes
from datasets.mesh import Mesh, normalise
from tests.looped import each
from tests.tiny import mesh_of


def box(extents=(1.0, 2.0, 3.0)) -> Mesh:
    return mesh_of(trimesh.creation.box(extents))


def test_a_box_has_its_closed_form_measures():
    mesh = box()
    assert mesh.watertight and mesh.volume == pytest.approx(6)
    assert mesh.area == pytest.approx(22) and mesh.diagonal == pytest.approx(np.sqrt(14))


def test_volume_is_negative_inside_out_and_does_not_move_with_the_mesh():
    mesh = box()
    assert Mesh(mesh.vertices + 100, mesh.faces[:, ::-1]).volume == pytest.approx(-6)


def test_two_boxes_are_two_parts():
    mesh = box((1, 1, 1))
    both = concatenate_meshes([mesh, Mesh(2 * mesh.vertices + 9, mesh.faces)])
    assert both.parts.tolist() == [0] * 12 + [1] * 12 and both.part_volumes == pytest.approx([1, 8])


@each("spoil", [lambda f: f[1:], lambda f: np.concatenate([f[:1, ::-1], f[1:]])])
def test_a_rim_or_a_wrong_winding_is_not_watertight(spoil):
    mesh = box()
    spoilt = Mesh(mesh.vertices, spoil(mesh.faces))
    assert not spoilt.watertight and 0 < spoilt.open_faces.sum() <= 4


def test_holes_are_counted_by_their_rims():
    mesh = box()
    assert count_holes(mesh) == 0 and count_holes(Mesh(mesh.vertices, mesh.faces[1:])) == 1
    opposite = np.abs(mesh.vertices[mesh.faces].mean(axis=1)[:, 0]) < 0.49  # without the two sides across x
    assert count_holes(Mesh(mesh.vertices, mesh.faces[opposite])) == 2


def coloured(mesh: Mesh) -> Mesh:
    """The mesh with a different colour for each vertex."""
    fractions = np.linspace(0, 1, len(mesh.vertices))
    return Mesh(mesh.vertices, mesh.faces, colours=np.stack([fractions, 1 - fractions, fractions**2], axis=1))


def test_other_libraries_read_saved_meshes_and_their_colours(tmp_path):
    mesh = coloured(box())
    assert mesh.colours is not None
    with pytest.raises(ValueError, match=r"name it 'a\.ply'"):
        mesh.save(tmp_path / "a.obj")
    mesh.save(tmp_path / "a böx.ply")
    read = trimesh.load_mesh(tmp_path / "a böx.ply", process=False)
    assert np.array_equal(read.vertices, mesh.vertices) and np.array_equal(read.faces, mesh.faces)
    assert read.visual.kind == "vertex"
    assert np.array_equal(read.visual.vertex_colors[:, :3], np.round(255 * mesh.colours))
    assert (read.visual.vertex_colors[:, 3] == 255).all()
    beyond = Mesh(mesh.vertices, mesh.faces, colours=3 * mesh.colours - 1)
    beyond.save(tmp_path / "b.ply")
    saved_colours = trimesh.load_mesh(tmp_path / "b.ply", process=False).visual.vertex_colors[:, :3]
    assert np.array_equal(saved_colours, np.round(255 * (3 * mesh.colours - 1).clip(0, 1)))
    box().save(tmp_path / "c.ply")
    assert trimesh.load_mesh(tmp_path / "c.ply", process=False).visual.kind is None


def test_compact_keeps_colours_with_their_vertices():
    mesh = coloured(box())
    order = np.array([5, 0, 7, 2, 4, 1, 3, 6])
    assert mesh.colours is not None
    padded = Mesh(
        np.concatenate([[[9.0, 9.0, 9.0]], mesh.vertices[order], [[8.0, 8.0, 8.0]]]),
        np.argsort(order)[mesh.faces] + 1,
        colours=np.concatenate([[[0.3, 0.3, 0.3]], mesh.colours[order], [[0.4, 0.4, 0.4]]]),
    )
    small = padded.compact()
    assert small.colours is not None and small.colours.shape == (8, 3)
    by_vertex = {tuple(vertex): tuple(colour) for vertex, colour in zip(mesh.vertices, mesh.colours, strict=True)}
    assert {tuple(v): tuple(c) for v, c in zip(small.vertices, small.colours, strict=True)} == by_vertex
    assert box().compact().colours is None


def test_normalise_centres_the_box_and_reaches_the_radius():
    mesh = box()
    moved = normalise(Mesh(5 * mesh.vertices + [7, 8, 9], mesh.faces, repairs=("1 hole closed",)), 0.9)
    assert np.linalg.norm(moved.vertices, axis=1).max() == pytest.approx(0.9)
    assert moved.vertices.min(axis=0) == pytest.approx(-moved.vertices.max(axis=0))
    assert moved.repairs == ("1 hole closed",)
