"""Ground truth of a mesh: exact ray hits, signed distances, and samples of its surface."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from datasets.mesh import Mesh


@dataclass(frozen=True)
class Hits:
    """First hits of rays: distances along the unit rays (inf where nothing is hit) and outward unit normals."""

    distance: Float[np.ndarray, " n"]
    normals: Float[np.ndarray, "n 3"]
    hit: Bool[np.ndarray, " n"]


class Truth:
    """Ray casting and signed distances of a mesh, on the CPU, in float32."""

    def __init__(self, mesh: Mesh, *, closed: bool = True):
        """Builds the search tree.

        Args:
            mesh: wound outward and free of overlaps, as `load_mesh` returns it.
            closed: False takes an open mesh as well, of which first hits have a meaning and signed distances have not.

        Raises:
            ValueError: the mesh is not watertight, so that inside and outside have no meaning.
        """
        import open3d

        if closed and not mesh.watertight:
            raise ValueError(
                f"mesh: must be watertight to have an inside, found {mesh.faces.shape[0]} faces that do not close; "
                "load it with datasets.meshes.load_mesh, which repairs it"
            )
        self._tensor, self._faces = open3d.core.Tensor, mesh.faces
        self._scene = open3d.t.geometry.RaycastingScene()
        vertices = self._tensor(np.ascontiguousarray(mesh.vertices, dtype=np.float32))
        self._scene.add_triangles(vertices, self._tensor(np.ascontiguousarray(mesh.faces, dtype=np.uint32)))

    def cast(self, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]) -> Hits:
        """Gives the first hit of each ray.

        Args:
            origins: starts of the rays.
            directions: of any length but zero; distances are along the unit ray.
        """
        directions = np.asarray(directions, dtype=np.float64)
        lengths = np.linalg.norm(directions, axis=-1, keepdims=True)
        if not (np.isfinite(lengths).all() and (lengths > 0).all()):
            raise ValueError("directions: must be finite and not zero, found some that are not; drop these rays")
        rays = np.concatenate([origins, directions / lengths], axis=-1, dtype=np.float32)
        answer = self._scene.cast_rays(self._tensor(rays))
        distance = answer["t_hit"].numpy()
        normals = answer["primitive_normals"].numpy()
        return Hits(distance=distance, normals=normals, hit=np.isfinite(distance))

    def corners(
        self, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n 3"]]:
        """Gives the first hit of each ray by the corners of its face: their weights, 0 without a hit, and vertices."""
        answer = self._scene.cast_rays(self._tensor(np.concatenate([origins, directions], axis=-1, dtype=np.float32)))
        along = answer["primitive_uvs"].numpy().astype(np.float64)
        hit = np.isfinite(answer["t_hit"].numpy())
        weights = np.stack([1 - along.sum(axis=1), along[:, 0], along[:, 1]], axis=1) * hit[:, None]
        return weights, self._faces[np.where(hit, answer["primitive_ids"].numpy().astype(np.int64), 0)]

    def signed_distance(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
        """Gives the distance to the surface, negative inside, with the sign by majority over five rays per point."""
        points = np.asarray(points, dtype=np.float32)
        flat = self._tensor(np.ascontiguousarray(points.reshape(-1, 3)))
        return self._scene.compute_signed_distance(flat, nsamples=5).numpy().reshape(points.shape[:-1])

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Gives the distance to the nearest point of the surface, which may be open."""
        flat = self._tensor(np.ascontiguousarray(points, dtype=np.float32))
        return self._scene.compute_distance(flat).numpy()

    def distance_grid(self, samples: int, reach: float) -> Float[np.ndarray, "n n n"]:
        """Signed distances at evenly spaced points of the cube from -reach to reach, indexed by x, y and z."""
        axis = np.linspace(-reach, reach, samples, dtype=np.float32)
        return self.signed_distance(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1))


def sample_surface(mesh: Mesh, count: int, seed: int) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Draws points evenly by area, and the unit normals of their faces."""
    if count < 0:
        raise ValueError(f"count: must be 0 or more, found {count}; ask for a positive number of points")
    generator = np.random.default_rng(seed)
    corners = mesh.vertices[mesh.faces]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(crosses, axis=1)
    chosen = generator.choice(len(areas), size=count, p=areas / areas.sum())
    root, along = np.sqrt(generator.random(count)), generator.random(count)
    weights = np.stack([1 - root, root * (1 - along), root * along], axis=1)  # even over the triangle
    return np.einsum("nk,nkd->nd", weights, corners[chosen]), crosses[chosen] / areas[chosen, None]
