"""Datasets of shapes, the ground truth of a shape, and a scene: one shape, one camera, and its true view."""

from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Any, Protocol, runtime_checkable
from zlib import crc32

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from datasets.mesh import Mesh
from datasets.textures import Texture
from datasets.views import ViewSampler
from renderers.camera import Camera
from renderers.checks import BadInput
from renderers.field import LatentDecoder

SPLIT_STRIDE = 1_000_000  # difference between the first seeds of two splits; a split has fewer shapes
Corners = tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n 3"]]  # barycentric weights and vertex indices of points


class Split(StrEnum):
    """Training is for priors, validation for tuning settings, test for results only."""

    TRAIN = "train"
    VALIDATION = "validation"
    TEST = "test"


@runtime_checkable
class Dataset(Protocol):
    """Numbered shapes, each a closed mesh in the unit sphere."""

    name: str

    def mesh(self, split: Split, index: int) -> Mesh:
        """Shape number `index` of a split; always the same one."""
        ...

    def identity(self) -> dict[str, Any]:
        """Plain data that determines the shapes: datasets with equal identity have the same shapes."""
        ...


@runtime_checkable
class Textured(Protocol):
    """A dataset whose shapes have colours."""

    def texture(self, split: Split, index: int) -> Texture:
        """The colours of shape number `index` of a split; raises ValueError if it has none."""
        ...


def seed_of(split: Split, index: int) -> int:
    """The seed of a shape; no two splits share one."""
    if not 0 <= index < SPLIT_STRIDE:
        raise ValueError(f"index must lie between 0 and {SPLIT_STRIDE - 1}, not {index}")
    return list(Split).index(split) * SPLIT_STRIDE + index


@dataclass(frozen=True)
class Hits:
    """First hits of rays: distances along the unit rays (inf for a miss), outward unit normals, and faces.

    `face` is the index of the face that is hit, without meaning for a miss.
    """

    distance: Float[np.ndarray, " n"]
    normals: Float[np.ndarray, "n 3"]
    hit: Bool[np.ndarray, " n"]
    face: Int[np.ndarray, " n"]


@dataclass(frozen=True)
class Surface:
    """Points sampled on a surface with their normals; only the direction of a normal counts."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]

    @cached_property
    def tree(self) -> cKDTree:
        """Search tree for the nearest points."""
        return cKDTree(self.points)

    def select(self, kept: Bool[np.ndarray, " n"]) -> "Surface":
        """The samples that are kept."""
        return Surface(self.points[kept], self.normals[kept])


class Truth:
    """Ray casting and signed distances of a mesh, on the CPU, in float32."""

    def __init__(self, mesh: Mesh, *, closed: bool = True):
        """Builds the search tree.

        Args:
            mesh: wound outward and free of overlaps, as `load_mesh` returns it.
            closed: False also accepts an open mesh, whose first hits have a meaning but whose signed distances do not.

        Raises:
            ValueError: the mesh is not watertight, so that inside and outside have no meaning.
        """
        import open3d

        if closed and not mesh.watertight:
            raise ValueError(
                f"mesh: must be watertight to have an inside, found {mesh.faces.shape[0]} faces that do not close; "
                "load it with datasets.files.meshes.load_mesh, which repairs it"
            )
        self._tensor, self._faces = open3d.core.Tensor, mesh.faces
        self._scene = open3d.t.geometry.RaycastingScene()
        vertices = self._tensor(np.ascontiguousarray(mesh.vertices, dtype=np.float32))
        self._scene.add_triangles(vertices, self._tensor(np.ascontiguousarray(mesh.faces, dtype=np.uint32)))

    def cast(self, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]) -> Hits:
        """Returns the first hit of each ray.

        Args:
            directions: of any positive length; distances are along the unit ray.
        """
        directions = np.asarray(directions, dtype=np.float64)
        lengths = np.linalg.norm(directions, axis=-1, keepdims=True)
        if not (np.isfinite(lengths).all() and (lengths > 0).all()):
            raise ValueError("directions: must be finite and not zero, found some that are not; drop these rays")
        rays = np.concatenate([origins, directions / lengths], axis=-1, dtype=np.float32)
        hits = self._scene.cast_rays(self._tensor(rays))
        distance, normals = hits["t_hit"].numpy(), hits["primitive_normals"].numpy()
        face = hits["primitive_ids"].numpy().astype(np.int64)
        return Hits(distance=distance, normals=normals, hit=np.isfinite(distance), face=face)

    def corners(self, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]) -> Corners:
        """Returns the first hit of each ray as weights of the corners of its face, 0 for a miss, and their indices."""
        rays = np.concatenate([origins, directions], axis=-1, dtype=np.float32)
        hits = self._scene.cast_rays(self._tensor(rays))
        return self._face_corners(hits, np.isfinite(hits["t_hit"].numpy()))

    def nearest(self, points: Float[np.ndarray, "n 3"]) -> Corners:
        """Returns the nearest surface point of each point as weights of the corners of its face, and their indices."""
        closest = self._scene.compute_closest_points(self._tensor(np.ascontiguousarray(points, dtype=np.float32)))
        return self._face_corners(closest, np.ones(len(points), dtype=bool))

    def _face_corners(self, answer: Any, hit: Bool[np.ndarray, " n"]) -> Corners:
        coordinates = answer["primitive_uvs"].numpy().astype(np.float64)
        weights = np.stack([1 - coordinates.sum(axis=1), coordinates[:, 0], coordinates[:, 1]], axis=1) * hit[:, None]
        return weights, self._faces[np.where(hit, answer["primitive_ids"].numpy().astype(np.int64), 0)]

    def signed_distance(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
        """Returns the distance to the surface, negative inside; the sign is the majority of five rays per point."""
        points = np.asarray(points, dtype=np.float32)
        flat = self._tensor(np.ascontiguousarray(points.reshape(-1, 3)))
        return self._scene.compute_signed_distance(flat, nsamples=5).numpy().reshape(points.shape[:-1])

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Returns the distance to the nearest point of the surface, which may be open."""
        flat = self._tensor(np.ascontiguousarray(points, dtype=np.float32))
        return self._scene.compute_distance(flat).numpy()

    def distance_grid(self, samples: int, reach: float) -> Float[np.ndarray, "n n n"]:
        """Signed distances at evenly spaced points of the cube from -reach to reach, indexed by x, y and z."""
        axis = np.linspace(-reach, reach, samples, dtype=np.float32)
        return self.signed_distance(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1))


def sample_surface(mesh: Mesh, count: int, seed: int) -> Surface:
    """Draws points uniformly by area, with the unit normals of their faces."""
    if count < 0:
        raise ValueError(f"count: must be 0 or more, found {count}; ask for a positive number of points")
    generator = np.random.default_rng(seed)
    corners, area_normals = mesh.vertices[mesh.faces], mesh.area_normals
    areas = np.linalg.norm(area_normals, axis=1)
    chosen = generator.choice(len(areas), size=count, p=areas / areas.sum())
    root, along = np.sqrt(generator.random(count)), generator.random(count)
    weights = np.stack([1 - root, root * (1 - along), root * along], axis=1)  # uniform over the triangle
    return Surface(np.einsum("nk,nkd->nd", weights, corners[chosen]), area_normals[chosen] / areas[chosen, None])


@dataclass(frozen=True)
class View:
    """A camera and its true images.

    Args:
        camera: has the resolution of the images.
        depth: camera z, in scene units; 0 on the background.
        normals: unit, in world coordinates; 0 on the background.
        mask: true on the foreground.
    """

    camera: Camera
    depth: Float[Tensor, "height width"]
    normals: Float[Tensor, "height width 3"]
    mask: Bool[Tensor, "height width"]


@dataclass(frozen=True)
class Scene:
    """A true shape and one view of it.

    Args:
        name: of the dataset and the shape.
        mesh: the true shape.
        view: its true images.
        measured: camera z measured by a scanner at the view's pixels, 0 without a measurement; None without a scanner.
        to_world: the similarity from the scene's world to the world of a file; None if no file defines one.
        is_partial: whether `mesh` is an open surface: the part of an unknown shape that the view shows.
        texture: the colours of the shape; None without colours.
        rays_per_pixel: see `datasets.views.ViewSampler`.
    """

    name: str
    mesh: Mesh
    view: View
    measured: Float[Tensor, "height width"] | None = None
    to_world: Float[np.ndarray, "4 4"] | None = None
    is_partial: bool = False
    texture: Texture | None = None
    rays_per_pixel: int = 1

    @cached_property
    def raycaster(self) -> Truth:
        """The true shape, for ray casting and signed distances."""
        return Truth(self.mesh, closed=not self.is_partial)

    def observed_view(self, *, exact: bool = False) -> tuple[View, Bool[Tensor, "height width"]]:
        """The view whose depths a task may observe, and the pixels with a depth.

        Args:
            exact: True for the mesh's depths in place of a scanner's, at the same pixels.
        """
        if self.measured is None:
            return self.view, self.view.mask
        observed = self.view.mask & (self.measured > 0)
        return self.view if exact else replace(self.view, depth=self.measured), observed

    @property
    def measured_depth_notes(self) -> list[str]:
        """Notes on the number and the errors of a scanner's depths; empty without a scanner."""
        if self.measured is None or self.is_partial:
            return []
        compared = self.view.mask & (self.measured > 0)
        errors = (self.measured - self.view.depth)[compared].abs()
        outside_mask = int((self.measured > 0).sum()) - len(errors)
        note = f"measured: {len(errors)} of the shape's {int(self.view.mask.sum())} pixels"
        if len(errors):
            median, upper = errors.quantile(torch.tensor([0.5, 0.95])).tolist()
            note += f"; half of their depths are within {median:.2g} scene units of the mesh, 95 % within {upper:.2g}"
        return [f"{note}; {outside_mask} beside its outline are left out"]

    def seed(self, seed: int) -> int:
        """Combines a run's seed with the scene's name, so that draws for different scenes are independent."""
        return crc32(self.name.encode()) ^ seed


@runtime_checkable
class Scanned(Protocol):
    """A dataset of one object whose depths were measured from several sides."""

    def towards_scanner(self, index: int) -> Float[Tensor, "3"]:
        """The direction from the object to the scanner of scan number `index`."""
        ...

    def seen(self, index: int) -> Mesh:
        """The open surface measured by scan number `index`."""
        ...


@runtime_checkable
class OneView(Protocol):
    """A dataset of one object, observed in one view, perhaps with a mesh; its position in the world is unknown."""

    def placed(self, resolution: int) -> Scene:
        """The scene, y up, with the visible surface within the unit sphere.

        Args:
            resolution: largest number of pixels of the view's longer side.
        """
        ...


@dataclass(frozen=True)
class SceneNetwork:
    """A network whose codes are shapes: the field of a scene, and its prior.

    Args:
        decoder: `at(code)` is a field, negative inside.
        codes: of all its shapes.
        notes: measurements of the network and conversions, in words.
    """

    decoder: LatentDecoder
    codes: Float[Tensor, "shapes code_length"]
    notes: tuple[str, ...]


@runtime_checkable
class HasNetwork(Protocol):
    """A dataset whose shapes are codes of a network: the network is the field of its scenes and their prior."""

    def network(self, index: int) -> SceneNetwork:
        """The network, with notes on its field at code number `index`."""
        ...


@runtime_checkable
class Photographed(Protocol):
    """A dataset of one object with photographs, and perhaps a file of its surface, `truth`; see `OwnPhotographs`."""

    truth: str | None
    unchecked: bool

    @property
    def dtu_scan(self) -> int | None:
        """The number of DTU's scan; see `OwnPhotographs`."""
        ...

    def capture(self, longest: int, held_out: int) -> Any:
        """Reads a `datasets.files.own_photographs.Capture`.

        Args:
            longest: largest number of pixels per side.
            held_out: every n-th photograph is held out, and does not influence the sphere.
        """
        ...


def make_scene(dataset: Dataset, views: ViewSampler, *, split: Split, index: int) -> Scene:
    """The scene of shape number `index` of a split, with the camera of the same number."""
    if isinstance(dataset, OneView):
        return dataset.placed(views.resolution)
    mesh = dataset.mesh(split, index)
    scanned = dataset if isinstance(dataset, Scanned) else None
    camera = views.towards(scanned.towards_scanner(index)) if scanned else views.draw(seed_of(split, index))
    view = see(Truth(mesh), camera)
    if not bool(view.mask.any()):
        repaired = f" (repaired: {'; '.join(mesh.repairs)})" if mesh.repairs else ""
        problem = f"the camera sees nothing of {dataset.name} {index}{repaired}"
        raise BadInput(f"{problem}: widen view.field_of_view or distance")
    measured = see(Truth(scanned.seen(index), closed=False), camera).depth if scanned else None
    name = scene_name(dataset, split, index)
    return Scene(name, mesh, view, measured, rays_per_pixel=views.rays_per_pixel)


def scene_name(dataset: Dataset, split: Split, index: int) -> str:
    """The name of a dataset's shape."""
    return f"{dataset.name} {split} {index}"


def see(truth: Truth, camera: Camera) -> View:
    """The true images of a mesh, by casting a ray through each pixel's centre."""
    rays = camera.rays()
    flat = rays.flat()
    hits = truth.cast(flat.origins.numpy().astype(np.float64), flat.directions.numpy().astype(np.float64))
    mask = torch.from_numpy(hits.hit).view(rays.shape)
    distance = torch.from_numpy(np.where(hits.hit, hits.distance, 0.0).astype(np.float32)).view(rays.shape)
    normals = torch.from_numpy(np.where(hits.hit[:, None], hits.normals, 0.0).astype(np.float32))
    return View(camera, camera.depth(distance), normals.view(*rays.shape, 3), mask)


def see_area(
    truth: Truth, camera: Camera, side: int = 8
) -> tuple[Float[Tensor, "height width"], Float[Tensor, "height width"]]:
    """The fraction of each pixel that a mesh covers, and its mean camera z there; 0 without any.

    Args:
        side: of the regular grid of rays in each pixel.
    """
    offsets = torch.cartesian_prod(*[(torch.arange(side) + 0.5) / side - 0.5] * 2)
    rays = camera.rays(offsets.expand(camera.height, camera.width, -1, 2))
    flat = rays.flat()
    hits = truth.cast(flat.origins.double().numpy(), flat.directions.double().numpy())
    hit = torch.from_numpy(hits.hit).view(rays.shape)
    distance = torch.from_numpy(hits.distance).view(rays.shape).where(hit, 0.0)
    return hit.float().mean(-1), (distance * camera.cosine(rays)).sum(-1) / hit.sum(-1).clamp_min(1)


def unshaded_image(view: View, texture: Texture) -> Float[Tensor, "height width 3"]:
    """The image of a view's surface colours without light; 0 on the background."""
    rays = view.camera.rays()
    points = rays.at(view.camera.distance(view.depth))[view.mask].numpy().astype(np.float64)
    colours = texture(points, view.normals[view.mask].numpy().astype(np.float64))
    image = torch.zeros(*view.mask.shape, 3)
    image[view.mask] = torch.from_numpy(colours.astype(np.float32))
    return image
