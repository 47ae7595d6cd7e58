"""Colour images of a textured mesh from several cameras, with noise, blur and exposure of a real camera."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from datasets.scene import Truth, see, see_area
from datasets.shot import Shot
from datasets.textures import ONE_COLOUR, TEXTURES, Texture, make_texture
from datasets.views import look_at
from renderers.camera import Camera, sphere_span
from renderers.checks import BadInput, check_at_least, check_choice, check_positive

SUPERSAMPLING = 2  # rays per pixel and axis
LIGHT_DIRECTION = (0.4, 0.8, 0.45)  # towards the light, in world axes
AMBIENT_FRACTION = 0.4  # the rest of the light comes from LIGHT_DIRECTION
BACKGROUND_GREY = 0.5
ROOM_RADIUS, ROOM_TEXTURE_SIZE = 4.0, 1.5  # scene units
ROOM_SEED = 0
MAX_ELEVATION_DEGREES = 60.0
ARC_HALF_ANGLE_DEGREES = 45.0
MIN_COLOUR_SPREAD = 1e-3  # interquartile range of a surface's colours; images of fewer colours cannot be matched


@dataclass(frozen=True)
class Photography:
    """Settings of photographs.

    Args:
        views: number of cameras.
        places: "circle": evenly spaced about the vertical axis, starting at the scene's camera. "arc": on this circle,
            at most `ARC_HALF_ANGLE_DEGREES` from the scene's camera. "sphere": on all sides, at the same distance,
            at elevations of at most `MAX_ELEVATION_DEGREES` up and down.
        texture: one of `datasets.textures.TEXTURES`.
        texture_size: of the texture's largest parts, in scene units; see `datasets.textures.make_texture`.
        shading: "unlit": the texture's colours; "lambertian": under a fixed light.
        background: "grey"; "noise" that differs between views; or "room", a texture on a sphere around the cameras.
        noise: standard deviation of each colour's noise.
        blur: standard deviation of a Gaussian, in pixels.
        exposure: standard deviation of the logarithm of each view's exposure.
    """

    views: int
    places: str
    texture: str
    texture_size: float
    shading: str
    background: str
    noise: float
    blur: float
    exposure: float

    def __post_init__(self) -> None:
        check_at_least("views", self.views, 2, "views are compared with their neighbours: 24 work")
        check_choice("places", self.places, tuple(CAMERA_LAYOUTS))
        check_choice("texture", self.texture, TEXTURES)
        check_positive("texture_size", self.texture_size, "0.3 works for noise, 2 for a photograph")
        check_choice("shading", self.shading, ("unlit", "lambertian"))
        check_choice("background", self.background, ("grey", "noise", "room"))
        if self.texture in ONE_COLOUR and self.shading == "unlit":
            raise ValueError("a texture of one colour without shading has nothing to compare: set shading=lambertian")
        for name in ("noise", "blur", "exposure"):
            check_at_least(name, getattr(self, name), 0, f"{name}=0 switches it off")

    def take(self, truth: Truth, first: Camera, *, seed: int, areas: bool = False) -> list[Shot]:
        """Takes the photographs of a mesh; with `areas`, also the fraction of each pixel that the mesh covers.

        Raises:
            ValueError: a camera does not see the mesh, or its surface has one colour.
        """
        taken = self.take_from(truth, CAMERA_LAYOUTS[self.places](first, self.views), seed=seed)
        return [replace(shot, covered=see_area(truth, shot.camera)[0]) for shot in taken] if areas else taken

    def take_from(self, truth: Truth, cameras: Sequence[Camera], *, seed: int) -> list[Shot]:
        generator = np.random.default_rng([seed, 2])
        texture = make_texture(self.texture, self.texture_size, seed)
        taken = [self._take_one(str(index), truth, texture, camera, generator) for index, camera in enumerate(cameras)]
        for shot in taken:
            if shot.mask is None or not bool(shot.mask.any()):
                raise BadInput(f"camera {shot.name} sees nothing of the shape: widen view.field_of_view or distance")
        ends = torch.tensor([0.25, 0.75])  # outline pixels mixed with the background are ignored
        quartiles = [shot.colours[shot.mask].quantile(ends, dim=0) for shot in taken]
        if max(float((upper - lower).max()) for lower, upper in quartiles) < MIN_COLOUR_SPREAD:
            raise BadInput("the surface has one colour in all images: choose another texture or shading")
        return taken

    def _take_one(
        self, name: str, truth: Truth, texture: Texture, camera: Camera, generator: np.random.Generator
    ) -> Shot:
        fine = camera.resized(SUPERSAMPLING * camera.height, SUPERSAMPLING * camera.width)
        rays = fine.rays().flat()
        origins, directions = rays.origins.numpy().astype(float), rays.directions.numpy().astype(float)
        hits = truth.cast(origins, directions)
        colours = np.full((len(origins), 3), BACKGROUND_GREY)
        if self.background == "noise":
            colours = generator.random((len(origins), 3))
        if self.background == "room":
            walls = rays.at(sphere_span(rays, ROOM_RADIUS)[1]).numpy().astype(float)
            colours = make_texture("noise", ROOM_TEXTURE_SIZE, ROOM_SEED)(walls, -walls / ROOM_RADIUS)
        points = origins[hits.hit] + hits.distance[hits.hit, None] * directions[hits.hit]
        normals = hits.normals[hits.hit].astype(float)
        light = np.array(LIGHT_DIRECTION) / np.linalg.norm(LIGHT_DIRECTION)
        diffuse = (1 - AMBIENT_FRACTION) * (normals @ light).clip(0)[:, None]
        shade = 1.0 if self.shading == "unlit" else AMBIENT_FRACTION + diffuse
        colours[hits.hit] = shade * texture(points, normals)
        image = colours.reshape(camera.height, SUPERSAMPLING, camera.width, SUPERSAMPLING, 3).mean(axis=(1, 3))
        image = image * np.exp(self.exposure * generator.standard_normal())
        if self.blur:
            image = gaussian_filter(image, (self.blur, self.blur, 0))
        image = image + self.noise * generator.standard_normal(image.shape)
        colours, view = torch.from_numpy(image.clip(0, 1).astype(np.float32)), see(truth, camera)
        return Shot(name, camera, colours, view.mask, view.depth, view.normals)


def circle(first: Camera, count: int) -> list[Camera]:
    """Cameras evenly spaced on a circle about the vertical axis."""
    return [turned(first, 2 * np.pi * index / count) for index in range(count)]


def arc(first: Camera, count: int) -> list[Camera]:
    """Cameras evenly spaced on an arc of that circle, with `first` in the middle."""
    angles = np.radians(np.linspace(-ARC_HALF_ANGLE_DEGREES, ARC_HALF_ANGLE_DEGREES, count))
    return [turned(first, float(angle)) for angle in angles]


def around(first: Camera, count: int) -> list[Camera]:
    """Cameras that look at the origin from evenly spaced positions (a spiral of the golden angle)."""
    heights = np.sin(np.radians(MAX_ELEVATION_DEGREES)) * (1 - (2 * np.arange(count) + 1) / count)
    turns = np.pi * (3 - 5**0.5) * np.arange(count)
    radii = np.sqrt(1 - heights**2)
    positions = np.stack([radii * np.sin(turns), heights, radii * np.cos(turns)], axis=1) * float(first.center.norm())
    poses = [look_at(torch.from_numpy(position).float(), torch.zeros(3)) for position in positions]
    return [Camera(first.intrinsics, motion, first.height, first.width) for motion in poses]


def turned(camera: Camera, angle: float) -> Camera:
    """The camera after a rotation about the world's vertical axis, by an angle in radians."""
    c, s = np.cos(angle), np.sin(angle)
    turn = torch.eye(4, dtype=camera.world_to_camera.dtype)
    turn[0, 0], turn[0, 2], turn[2, 0], turn[2, 2] = c, s, -s, c
    return Camera(camera.intrinsics, camera.world_to_camera @ turn, camera.height, camera.width)


CAMERA_LAYOUTS = {"circle": circle, "arc": arc, "sphere": around}
