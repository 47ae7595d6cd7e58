"""Views of a mesh, against closed forms, and scenes whose camera depends on the shape."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
import trimesh

from datasets.scene import Split, Truth, make_scene, see
from datasets.views import ViewSampler, look_at
from renderers.camera import Camera
from tests.tiny import mesh_of

VIEWS = ViewSampler(distance=2.5, field_of_view=50.0, azimuth=(0.0, 360.0), elevation=(15.0, 35.0), resolution=40)


@dataclass(frozen=True)
class Boxes:
    """Boxes of different lengths, moved upward."""

    moved: float = 0.0
    name: str = "box"
    repairs: tuple[str, ...] = ()

    def mesh(self, split, index):
        solid = trimesh.creation.box((0.4 + 0.05 * index, 0.3, 0.3))
        return replace(mesh_of(solid.apply_translation((0, self.moved, 0))), repairs=self.repairs)

    def identity(self):
        return {"moved": self.moved}


def test_a_sphere_off_the_axis_in_an_oblong_image_has_its_closed_form_depth():
    radius, centre = 0.6, np.array([0.3, 0.2, -0.1])
    mesh = mesh_of(trimesh.creation.icosphere(subdivisions=5, radius=radius).apply_translation(centre))
    motion = look_at(torch.tensor([1.0, 1.5, 2.0]), torch.zeros(3))
    camera = Camera(torch.tensor([[30.0, 0, 20], [0, 30, 12], [0, 0, 1]]), motion, height=24, width=40)
    view = see(Truth(mesh), camera)
    assert (view.depth.dtype, view.normals.dtype, view.mask.dtype) == (torch.float32, torch.float32, torch.bool)
    rows, columns = np.mgrid[:24, :40] + 0.5
    along = np.stack([(columns - 20) / 30, (rows - 12) / 30, np.ones((24, 40))], axis=-1)  # of the pixels, at z = 1
    middle = motion.numpy().astype(float)[:3, :3] @ centre + motion.numpy()[:3, 3]
    half, square = along @ middle, (along**2).sum(-1)
    chord = half**2 - square * (middle @ middle - radius**2)
    sure = np.abs(chord) > 0.02  # the outline of the polyhedron lies slightly inside that of the sphere
    hit = chord > 0
    depth = (half - np.sqrt(np.where(hit, chord, 0))) / square  # along the bearing, whose z is 1
    assert view.mask.shape == (24, 40) and np.array_equal(view.mask.numpy()[sure], hit[sure])
    both = sure & hit
    assert both.sum() > 100 and view.depth.numpy()[both] == pytest.approx(depth[both], abs=2e-3)
    outward = (depth[..., None] * along - middle) @ motion.numpy()[:3, :3] / radius  # back to world axes
    assert (view.normals.numpy()[both] * outward[both]).sum(-1).min() > 0.995
    background = ~view.mask
    assert view.depth[background].abs().sum() == 0 and view.normals[background].abs().sum() == 0


def test_a_scene_is_always_the_same_and_its_camera_belongs_to_the_shape():
    scene = make_scene(Boxes(), VIEWS, split=Split.TEST, index=3)
    again = make_scene(Boxes(), VIEWS, split=Split.TEST, index=3)
    assert scene.name == "box test 3" and torch.equal(scene.view.depth, again.view.depth)
    assert np.array_equal(scene.mesh.vertices, again.mesh.vertices)
    others = [(Split.TEST, 4), (Split.TRAIN, 3), (Split.VALIDATION, 3)]
    for split, index in others:
        other = make_scene(Boxes(), VIEWS, split=split, index=index).view.camera
        assert not torch.allclose(other.world_to_camera, scene.view.camera.world_to_camera)


def test_a_camera_that_sees_nothing_is_refused():
    narrow = replace(VIEWS, field_of_view=5.0)
    with pytest.raises(ValueError, match=r"sees nothing of box 0 \(repaired: 1 hole closed\): widen view"):
        make_scene(Boxes(moved=0.8, repairs=("1 hole closed",)), narrow, split=Split.TEST, index=0)
    with pytest.raises(ValueError, match=r"the camera sees nothing of box 0: widen view.field_of_view or distance"):
        make_scene(Boxes(moved=0.8), narrow, split=Split.TEST, index=0)
