"""Colours of mesh files: textures, materials and vertices, on the shape and on its deformations."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from bench.records.folder import code_hash
from datasets.files.colours import FileColours
from datasets.files.local import LocalMeshes
from datasets.files.meshes import read_mesh
from datasets.scene import Split, sample_surface
from renderers.checks import BadInput
from tests.looped import each

RAMP = np.linspace(0, 255, 256).round().astype(np.uint8)


def textured(folder: Path, suffix: str) -> Path:
    """A box whose texture is red by u, which is x, and green by v, which is y. Vertices are split as at a seam."""
    box = trimesh.creation.box((1.0, 0.8, 0.6))
    corners = np.asarray(box.vertices)[np.asarray(box.faces)].reshape(-1, 3)
    image = np.zeros((256, 256, 3), np.uint8)
    image[..., 0], image[..., 1] = RAMP, RAMP[::-1, None]
    uv = corners[:, :2] / (1.0, 0.8) + 0.5
    visual = trimesh.visual.TextureVisuals(uv=uv, image=Image.fromarray(image))
    faces = np.arange(len(corners)).reshape(-1, 3)
    trimesh.Trimesh(corners, faces, process=False, visual=visual).export(folder / f"box.{suffix}")
    return folder / f"box.{suffix}"


def shapes(path: Path) -> LocalMeshes:
    return LocalMeshes(str(path), radius=0.97, strength=1.0)


@each("suffix", ["obj", "glb"])
def test_a_texture_follows_the_shape_and_its_deformations(tmp_path, suffix):
    dataset = shapes(textured(tmp_path, suffix))
    rest = dataset.mesh(Split.TRAIN, 0)
    surface = sample_surface(rest, 300, seed=0)
    texture = dataset.texture(Split.TRAIN, 0)
    colours = texture(surface.points, surface.normals)
    across = surface.points[:, :2] / np.ptp(rest.vertices, axis=0)[:2] + 0.5
    assert np.abs(colours[:, :2] - across).max() < 0.01 and not colours[:, 2].any()
    assert texture.texels == 256 * 256
    bent = dataset.mesh(Split.TEST, 3)
    centres, moved = (mesh.vertices[mesh.faces].mean(axis=1) for mesh in (rest, bent))
    bent_colours = dataset.texture(Split.TEST, 3)(moved, moved)
    assert np.abs(bent_colours - texture(centres, centres)).max() < 0.01
    assert np.abs(moved - centres).max() > 0.02


def test_without_an_image_the_colours_are_those_of_vertices_or_of_the_material(tmp_path):
    box = trimesh.creation.box()
    box.export(tmp_path / "material.obj")
    text = (tmp_path / "material.obj").read_text()
    (tmp_path / "material.obj").write_text("mtllib paints.mtl\nusemtl red\n" + text)
    (tmp_path / "paints.mtl").write_text("newmtl red\nKd 1.0 0.2 0.0\n")
    box.visual.vertex_colors = np.tile([255, 51, 0, 255], (8, 1))
    for name in ("vertices.ply", "vertices.glb"):
        box.export(tmp_path / name)
    for name in ("vertices.ply", "vertices.glb", "material.obj"):
        texture = shapes(tmp_path / name).texture(Split.TRAIN, 0)
        assert texture(np.eye(3), np.eye(3)) == pytest.approx(np.tile([1.0, 0.2, 0.0], (3, 1)), abs=0.01)
        assert texture.texels == 0


def test_each_face_of_an_obj_has_its_material_also_concave_polygons(tmp_path):
    image = np.zeros((256, 256, 3), np.uint8)
    image[..., 0], image[..., 1] = RAMP, RAMP[::-1, None]
    Image.fromarray(image).save(tmp_path / "map #1.png")
    (tmp_path / "a.mtl").write_text("newmtl Paint #1\nKd 0 1 0\nnewmtl Paint #2\nKd 0 0 0\nmap_Kd map #1.png\n")
    (tmp_path / "b.mtl").write_text("newmtl blue\nKd 0 0 1\n")
    arrow = "v 0 0 0\nv 1 1 0\nv 0 .25 0\nv -1 1 0\n"  # concave at its third corner
    pinned = "vt .5 0\nvt 1 1\nvt .5 .25\nvt 0 1\n"
    lines = ["mtllib a.mtl", "mtllib b.mtl", arrow, pinned, "usemtl Paint #2", "f -4/-4 -3/-3 -2/-2 -1/-1"]
    lines += ["vt 0 0"]  # negative numbers count back from the last line before
    for number, name in enumerate(("Paint #1", "blue", "Paint #2")):  # the last face has no texture coordinates
        lines += [arrow.replace(" 0\n", f" {number + 1}\n"), f"usemtl {name}", "f -4 -3 -2 -1"]
    path = tmp_path / "arrows.obj"
    path.write_text("\n".join(lines))
    mesh = read_mesh(path)
    texture = FileColours(path, mesh, mesh)
    points = np.array([(0.0, 0.1, 0), (0.5, 0.6, 0), (-0.5, 0.6, 0), (-0.9, 0.92, 0)])
    across = np.c_[points[:, 0] / 2 + 0.5, points[:, 1], np.zeros(4)]
    assert texture(points, points) == pytest.approx(across, abs=0.005)
    for height, colour in enumerate([(0, 1, 0), (0, 0, 1), (1, 1, 1)], start=1):
        assert texture(points + np.array([0, 0, height]), points) == pytest.approx(np.tile(colour, (4, 1)))
    assert texture.texels == 256 * 256


def test_missing_colours_and_missing_files_are_errors(tmp_path):
    trimesh.creation.box().export(tmp_path / "plain.ply")
    with pytest.raises(BadInput, match=r"plain.ply' has no colours.* export it with its materials"):
        shapes(tmp_path / "plain.ply").texture(Split.TRAIN, 0)
    path = textured(tmp_path, "obj")
    identity = shapes(path).identity()
    (image,) = tmp_path.glob("*.png")
    content = image.read_bytes()
    image.write_bytes(content[:100])
    with pytest.raises(BadInput, match=r"image '.*' of mesh file '.*box\.obj' cannot be read"):
        shapes(path).texture(Split.TRAIN, 0)
    image.write_bytes(content)
    image.rename(tmp_path / "elsewhere")
    with pytest.raises(BadInput, match=f"names '{image.name}', which is not there: put it at"):
        shapes(path).texture(Split.TRAIN, 0)
    assert shapes(path).identity() != identity


def test_a_changed_texture_is_another_run(tmp_path):
    cube = tmp_path / "cube.obj"
    cube.write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "a.mtl").write_text("newmtl a\nmap_Kd t.png\n")
    (tmp_path / "t.png").write_bytes(b"red")
    before = code_hash({"dataset": {"path": str(cube)}})
    assert code_hash({"dataset": {"path": str(cube)}}) == before
    (tmp_path / "t.png").write_bytes(b"blue")
    assert code_hash({"dataset": {"path": str(cube)}}) != before
