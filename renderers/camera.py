"""Cameras and rays. Axes: x right, y down, z forward (OpenCV); the centre of pixel (column, row) is at +0.5."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isqrt

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Rays:
    """Half lines from `origins` [*rays, 3] along unit `directions` [*rays, 3].

    With `image`, the last two leading dimensions are the rows and columns of an image, so that neighbours in the tensor
    are neighbours in the view.

    Args:
        cells: of rays [*batch, height, width, k * k] in pixels of k x k equal cells, column by column, with a ray
            anywhere in each cell: the image [*batch, height * k, width * k] of rays through the cells' centres, with
            the same gradient. `bench.solve.pixel_area.random_rays` makes both.
    """

    origins: Float[Tensor, "*rays 3"]
    directions: Float[Tensor, "*rays 3"]
    image: bool = False
    cells: "Rays | None" = None

    def __post_init__(self) -> None:
        if self.origins.shape != self.directions.shape or self.origins.shape[-1:] != (3,):
            raise ValueError(
                f"origins and directions must both have shape [*rays, 3], not {tuple(self.origins.shape)} and "
                f"{tuple(self.directions.shape)}: expand one to the other"
            )
        if not bool(torch.isfinite(self.origins).all()):
            raise ValueError("origins must be finite, not NaN or infinite: check the camera")
        length = torch.linalg.vector_norm(self.directions.detach(), dim=-1)
        if length.numel() and not bool(((length - 1).abs() < 1e-3).all()):
            raise ValueError("directions must have unit length: pass them through torch.nn.functional.normalize")
        if self.image and len(self.shape) < 2:
            raise ValueError(
                f"rays of shape {list(self.shape)} are no image, which has rows and columns: leave image out"
            )
        if self.cells is not None:
            self._check_cells(self.cells)

    def _check_cells(self, cells: "Rays") -> None:
        *batch, height, width, count = self.shape if len(self.shape) >= 3 else (0, 0, 0)
        side = isqrt(count)
        if self.image or not cells.image:
            raise ValueError("only rays that are no image have cells, and the cells are an image: set image=")
        if count != side**2 or (*cells.shape,) != (*batch, height * side, width * side):
            raise ValueError(
                f"rays {list(self.shape)} cannot have cells {list(cells.shape)}: rays [*batch, height, width, k * k] "
                "have cells [*batch, height * k, width * k]; leave cells out"
            )
        if cells.origins.dtype != self.origins.dtype or cells.origins.device != self.origins.device:
            raise ValueError(
                f"rays in {self.origins.dtype} on {self.origins.device} cannot have cells in {cells.origins.dtype} on "
                f"{cells.origins.device}: make both from one camera"
            )

    @property
    def shape(self) -> torch.Size:
        """The leading shape."""
        return self.origins.shape[:-1]

    def flat(self) -> "Rays":
        """The same rays with one leading dimension, [n, 3]."""
        return _rays_unchecked(self.origins.reshape(-1, 3), self.directions.reshape(-1, 3))

    def at(self, distance: Float[Tensor, "*rays"]) -> Float[Tensor, "*rays 3"]:
        """The points at `distance` along the rays."""
        return self.origins + distance[..., None] * self.directions

    def at_each(self, distances: Float[Tensor, "... samples"]) -> Float[Tensor, "*rays samples 3"]:
        """The points at several distances along each ray; distances [samples] apply to all rays."""
        return self.origins[..., None, :] + distances[..., None] * self.directions[..., None, :]

    def __getitem__(self, index: Bool[Tensor, "*rays"] | Int[Tensor, " n"]) -> "Rays":
        if index.dtype == torch.bool:
            return _rays_unchecked(self.origins[index], self.directions[index])
        return _rays_unchecked(self.origins.index_select(0, index), self.directions.index_select(0, index))

    def to(self, device: torch.device) -> "Rays":
        """The same rays on a device."""
        cells = None if self.cells is None else self.cells.to(device)
        return _rays_unchecked(self.origins.to(device), self.directions.to(device), self.image, cells)

    def coarser(self, factor: int) -> "Rays":
        """One ray for each block of factor x factor pixels, through the middle of the block; image rays only.

        The last row and column of blocks are padded by repeating the image's edge.
        """
        return _rays_unchecked(
            _block_mean(self.origins, factor),
            torch.nn.functional.normalize(_block_mean(self.directions, factor), dim=-1),
            image=True,
        )


def stacked(rays: Sequence[Rays]) -> Rays:
    """Rays of one shape as [n, *rays], without their cells."""
    origins, directions = (torch.stack([getattr(each, name) for each in rays]) for name in ("origins", "directions"))
    return _rays_unchecked(origins, directions, rays[0].image)


def _rays_unchecked(origins: Tensor, directions: Tensor, image: bool = False, cells: Rays | None = None) -> Rays:
    """Builds Rays without validation, only from parts of Rays that were already validated."""
    rays = object.__new__(Rays)
    for name, value in (("origins", origins), ("directions", directions), ("image", image), ("cells", cells)):
        object.__setattr__(rays, name, value)
    return rays


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Args:
        intrinsics: [3, 3] in pixels: focal lengths on the diagonal, principal point in the last column.
        world_to_camera: [4, 4] rigid motion.
        height, width: of the image, in pixels.
    """

    intrinsics: Float[Tensor, "3 3"]
    world_to_camera: Float[Tensor, "4 4"]
    height: int
    width: int

    def __post_init__(self) -> None:
        shapes = tuple(self.intrinsics.shape), tuple(self.world_to_camera.shape)
        if shapes != ((3, 3), (4, 4)):
            raise ValueError(f"intrinsics must have shape [3, 3] and world_to_camera [4, 4], not {shapes}")
        focal = self.intrinsics.detach().diagonal()[:2]
        if not bool((focal > 0).all()) or not bool(torch.isfinite(self.intrinsics).all()):
            raise ValueError(f"focal lengths must be positive and finite, not {focal.tolist()}: check intrinsics")
        if self.height < 1 or self.width < 1:
            raise ValueError(f"height and width must be at least 1 pixel, not {self.height} x {self.width}")
        rotation = self.world_to_camera.detach()[:3, :3]
        if not bool(torch.isfinite(self.world_to_camera).all()):
            raise ValueError("world_to_camera must hold finite numbers, not NaN or infinity: check the pose")
        identity = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
        if not torch.allclose(rotation @ rotation.T, identity, atol=1e-4) or torch.linalg.det(rotation) < 0:
            raise ValueError("world_to_camera must hold a rotation (orthogonal, determinant +1) in its top left 3 x 3")

    @property
    def camera_to_world(self) -> Float[Tensor, "4 4"]:
        """The inverse rigid motion; its last column is the camera's centre."""
        return torch.linalg.inv(self.world_to_camera)

    @property
    def center(self) -> Float[Tensor, "3"]:
        """The position of the camera, in world coordinates."""
        return self.camera_to_world[:3, 3]

    def resized(self, height: int, width: int) -> "Camera":
        """The same view at another resolution."""
        intrinsics = self.intrinsics.clone()
        intrinsics[0] *= width / self.width
        intrinsics[1] *= height / self.height
        return Camera(intrinsics, self.world_to_camera, height, width)

    def zoomed(self, factor: float) -> "Camera":
        """The camera with the same position and pixels, and focal lengths multiplied by `factor`."""
        intrinsics = self.intrinsics.clone()
        intrinsics[0, 0] *= factor
        intrinsics[1, 1] *= factor
        return Camera(intrinsics, self.world_to_camera, self.height, self.width)

    def moved(self, twist: Float[Tensor, "6"]) -> "Camera":
        """The camera after a rigid motion in camera axes; gradients flow to the twist.

        Args:
            twist: element of se(3): translation in scene units, then rotation vector in radians. World points in the
                camera's coordinates go through its matrix exponential.
        """
        return Camera(self.intrinsics, rigid(twist) @ self.world_to_camera, self.height, self.width)

    def with_object_moved(self, twist: Float[Tensor, "6"]) -> "Camera":
        """The camera whose view of the object equals this camera's view of the moved object.

        Gradients flow to the twist. The motion is about the object's origin, so that a rotation keeps it in the image.

        Args:
            twist: see `rigid`.
        """
        return Camera(self.intrinsics, self.world_to_camera @ rigid(twist), self.height, self.width)

    def to(self, device: torch.device) -> "Camera":
        """The same camera on a device."""
        return Camera(self.intrinsics.to(device), self.world_to_camera.to(device), self.height, self.width)

    def double(self) -> "Camera":
        """The same camera in float64."""
        return Camera(self.intrinsics.double(), self.world_to_camera.double(), self.height, self.width)

    def rays(self, offsets: Float[Tensor, "height width n 2"] | None = None) -> Rays:
        """The rays [height, width] through the pixel centres; gradients flow to both matrices.

        Args:
            offsets: of several rays [height, width, n] from the centre of their pixel, right and down, in pixels.
        """
        in_camera = self._pixel_directions(offsets) @ self.camera_to_world[:3, :3].T
        directions = torch.nn.functional.normalize(in_camera, dim=-1)
        return Rays(self.center.expand_as(directions), directions, image=offsets is None)

    def cosine(self, rays: Rays) -> Float[Tensor, "*rays"]:
        """Between rays and the camera's axis: camera z of the points at distance 1."""
        return rays.directions @ self.world_to_camera[2, :3]

    def depth(self, distance: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
        """Camera z of the points at `distance` along each pixel's ray (DIST, Eq. 2)."""
        return distance / torch.linalg.vector_norm(self._pixel_directions(), dim=-1)

    def distance(self, depth: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
        """The distance along each pixel's ray of the points at camera z `depth`."""
        return depth * torch.linalg.vector_norm(self._pixel_directions(), dim=-1)

    def project(self, points: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch"]]:
        """Projects points in world coordinates to the image.

        Returns:
            pixels: column and row; the first pixel's centre is (0.5, 0.5). Meaningless behind the camera.
            depth: camera z, in scene units; 0 or less behind the camera.
        """
        motion = self.world_to_camera
        in_camera = points @ motion[:3, :3].T + motion[:3, 3]
        depth = in_camera[..., 2]
        plane = in_camera / torch.where(depth > 0, depth, 1.0)[..., None]
        return (plane @ self.intrinsics.T)[..., :2], depth

    def shows(self, points: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"]:
        """Which points in world coordinates lie in front of the camera and within its image, occluded or not."""
        pixels, depth = self.project(points)
        size = torch.tensor([self.width, self.height], device=points.device)
        return (depth > 0) & (pixels >= 0).all(-1) & (pixels <= size).all(-1)

    def _pixel_directions(self, offsets: Float[Tensor, "height width n 2"] | None = None) -> Float[Tensor, "*rays 3"]:
        """Camera coordinates of the pixel centres, or of points at offsets from them, on the plane z = 1."""
        like = {"dtype": self.intrinsics.dtype, "device": self.intrinsics.device}
        rows, columns = torch.meshgrid(
            torch.arange(self.height, **like) + 0.5, torch.arange(self.width, **like) + 0.5, indexing="ij"
        )
        pixels = torch.stack([columns, rows, torch.ones_like(rows)], dim=-1)
        if offsets is not None:
            pixels = pixels[..., None, :] + torch.nn.functional.pad(offsets, (0, 1))
        return pixels @ torch.linalg.inv(self.intrinsics).T


def rigid(twist: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 4 4"]:
    """The matrix exponential of elements of se(3): translation in scene units, then rotation vector in radians."""
    x, y, z = twist[..., 3:].unbind(-1)
    zero = torch.zeros_like(x)
    turn = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    rows = torch.cat([turn, twist[..., :3, None]], dim=-1)
    return torch.linalg.matrix_exp(torch.cat([rows, torch.zeros_like(rows[..., :1, :])], dim=-2))


def sphere_span(
    rays: Rays, radius: float = 1.0
) -> tuple[Float[Tensor, "*rays"], Float[Tensor, "*rays"], Bool[Tensor, "*rays"]]:
    """Where rays enter and leave the sphere of `radius` about the origin.

    Returns:
        entry, leave: distances along the ray. Entry is 0 if the ray starts inside. If it misses, leave is the
            distance of the closest approach, and entry is the same but at least 0. Gradients flow to the rays.
        intersects: false if the ray misses the sphere, or the sphere lies behind the ray's origin.
    """
    approach = -(rays.origins * rays.directions).sum(-1)
    closest_point = rays.origins + approach[..., None] * rays.directions
    half_chord_squared = radius**2 - closest_point.square().sum(-1)
    crosses = half_chord_squared > 0
    half_chord = torch.where(crosses, half_chord_squared, 1.0).sqrt() * crosses
    entry, leave = (approach - half_chord).clamp_min(0), approach + half_chord
    return entry, leave, crosses & (leave > 0)


def distance_to_origin(rays: Rays) -> Float[Tensor, "*rays"]:
    """The smallest distance from the origin to each ray."""
    approach = -(rays.origins * rays.directions).sum(-1).clamp_max(0)
    return torch.linalg.vector_norm(rays.at(approach), dim=-1)


def _block_mean(image: Float[Tensor, "*rays 3"], factor: int) -> Float[Tensor, "*coarse 3"]:
    rows, columns = image.shape[-3:-1]
    down, across = -rows % factor, -columns % factor
    stacked = image.reshape(-1, rows, columns, 3).permute(0, 3, 1, 2)
    padded = torch.nn.functional.pad(stacked, (0, across, 0, down), mode="replicate")
    mean = torch.nn.functional.avg_pool2d(padded, factor).permute(0, 2, 3, 1)
    return mean.reshape(*image.shape[:-3], *mean.shape[1:])
