"""Scenes of growing severity, from easy to impossible, in the unit sphere; each makes a StressCase at a severity.

Severities are in the units of conf/stresses.yaml. Random rotations and positions depend only on the generator, so that
every renderer gets the same cases.
"""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from functools import reduce
from math import asin, atan, cos, degrees, exp, pi, radians, sin
from operator import or_

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bench.tasks.stability import distortions
from bench.tasks.stability.distortions import CUBE_HALF_SIDE, MIN_RESOLVED_THICKNESS
from bench.tasks.stability.solids import ReferenceTruth, Solid, Truth, box, half_space, rod, sphere_solid
from datasets.views import ViewSampler
from renderers.camera import Camera
from renderers.field import Field, Kind, estimate_lipschitz, points_in_sphere
from renderers.fields.analytic import Shape
from renderers.fields.mlp import Decoder
from renderers.fields.networks.network import Published

CAMERA_DISTANCE = 2.5  # scene units from the origin
ALL_AROUND = (0.0, 360.0)
CORNER_VIEW = {"azimuth": (37.0, 53.0), "elevation": (27.0, 43.0)}  # three sides of a cube, none of them grazing
NETWORK_ELEVATION_DEGREES = (15.0, 35.0)  # as in conf/config.yaml
# A network with a smaller fraction of these points inside has lost its shape, and is drawn again.
MAX_NETWORK_DRAWS, INSIDE_TEST_POINTS, MIN_INSIDE_FRACTION = 20, 1024, 0.01
NETWORK_SLOPE_POINTS = 4096
# A network costs much per ray: its pictures have a quarter of the pixels per side, and show the middle of the shape.
NETWORK_PICTURE_SHARE, NETWORK_FIELD_OF_VIEW_DEGREES = 4, 30.0
CUBE_FIELD_OF_VIEW_DEGREES = 44.0  # the cube fills the picture
GRAZING_VIEW_RATIO = 0.1  # half the picture's height over its distance, divided by the sine of the angle
GRAZING_SHIFT, GRAZING_ROLL_DEGREES = 0.1, 10.0  # largest shift along the plane, in scene units, and largest roll
SLIT_DEPTH, SLITS_PER_PICTURE = 0.1, 3.0  # scene units; width of the picture divided by the slit's width

CUBE_VIEWS: dict[str, Callable[[float], dict[str, float]]] = {
    # the field of view keeps the size of the cube's image
    "far_camera": lambda distance: {"distance": distance, "field_of_view": 2 * degrees(atan(1.0 / distance))},
    "wide_view": lambda angle: {"distance": 1.8, "field_of_view": angle},
    "narrow_view": lambda angle: {"field_of_view": angle},
    "cube": lambda setting: {},  # for a severity that is a renderer's setting
}


@dataclass(frozen=True)
class StressCase:
    """One rendering with its truth.

    Args:
        field: the input of the renderer; its stated kind may be wrong on purpose.
        camera: of the rendering.
        truth: of the field; if a disturbance moves its surface, the moved surface.
        solid: makes a solid from parameters, to test gradients towards them; None without this test.
        parameters: at which these gradients are taken.
    """

    field: Field
    camera: Camera
    truth: Truth
    solid: Callable[[Tensor], Solid] | None = None
    parameters: Float[Tensor, " n"] | None = None


Scene = Callable[[float, np.random.Generator, int], StressCase]  # of severity, random generator, and W of W x W pixels


def thin_plate(severity: float, draw: np.random.Generator, resolution: int) -> StressCase:
    """A plate, wider than the picture, seen within 5 degrees of its normal; the severity is its thickness."""
    plate = box((0.6, 0.6, severity / 2))
    return _solid_case(plate, draw, resolution, azimuth=(-5, 5), elevation=(-5, 5), field_of_view=20.0)


def wires(severity: float, draw: np.random.Generator, resolution: int) -> StressCase:
    """Seven parallel wires; the severity is their radius."""
    fence = _union_of_seven(lambda index: rod(severity, 0.6).moved((0.18 * index - 0.54, 0.0, 0.0)))
    tilted = fence.turned(_about_z(draw.uniform(-45, 45)))
    return _solid_case(tilted, draw, resolution, azimuth=(-20, 20), elevation=(-20, 20))


def nested_shells(severity: float, draw: np.random.Generator, resolution: int) -> StressCase:
    """Three nested boxes, cut open at the corner towards the camera; the severity is the thickness of their walls."""
    shells = box((0.15,) * 3) - box((0.15 - severity,) * 3)
    for half in (0.32, 0.5):
        shells |= box((half,) * 3) - box((half - severity,) * 3)
    return _solid_case(shells - box((0.5,) * 3).moved((0.5, 0.5, 0.5)), draw, resolution, **CORNER_VIEW)


def bumps(severity: float, draw: np.random.Generator, resolution: int) -> StressCase:
    """A wavy sheet, 0.03 high; the severity is its frequency, in radians per scene unit. Its distances are wrong."""

    def value(points: Tensor) -> Tensor:
        return points[..., 2] - 0.03 * torch.sin(severity * points[..., :2]).prod(dim=-1)

    wavy = Shape(value, Kind.DISTANCE)
    slope = (1 + (0.03 * severity) ** 2) ** 0.5  # the product of two sines has a slope of at most its frequency
    camera = _draw_camera(draw, resolution, azimuth=(-20, 20), elevation=(-20, 20), field_of_view=20.0)
    return StressCase(wavy, camera, ReferenceTruth(wavy, lipschitz=slope, thinnest=min(0.01, 0.2 / severity)))


def tiny_objects(severity: float, draw: np.random.Generator, resolution: int) -> StressCase:
    """49 cubes, 0.16 apart, corners to the camera; the severity is half a side. Pixels are 0.036 wide at 64 x 64."""
    cube = box((severity,) * 3).turned(_corner_to_z())
    row = _union_of_seven(lambda index: cube.moved((0.16 * index - 0.48, 0.0, 0.0)))
    sheet = _union_of_seven(lambda index: row.moved((0.0, 0.16 * index - 0.48, 0.0)))
    shifted = sheet.turned(_about_z(draw.uniform(-45, 45))).moved(tuple(draw.uniform(-0.02, 0.02, 3)))
    return _solid_case(shifted, draw, resolution, azimuth=(-8, 8), elevation=(-8, 8))


def gap(severity: float, draw: np.random.Generator, resolution: int) -> StressCase:
    """A slit between two blocks, 0.1 deep, with a wall behind; the severity is its width, a third of the picture."""
    blocks = [box((0.3, 0.5, SLIT_DEPTH / 2)).moved((side * (0.3 + severity / 2), 0.0, 0.0)) for side in (-1, 1)]
    scene = blocks[0] | blocks[1] | box((0.6, 0.5, 0.05)).moved((0.0, 0.0, -0.2))
    distance = 8.0  # so that few rays meet the sides of the slit
    field_of_view = 2 * degrees(atan(0.5 * SLITS_PER_PICTURE * severity / distance))
    shifted = scene.moved((severity * draw.uniform(-0.2, 0.2), 0.0, 0.0))
    return _solid_case(
        shifted, draw, resolution, azimuth=(0, 0), elevation=(0, 0), distance=distance, field_of_view=field_of_view
    )


def csg_difference(severity: float, draw: np.random.Generator, resolution: int) -> StressCase:
    """Three walls, a cube minus a shifted cube, from inside or outside; only a bound. The severity is the thickness."""
    walls = box((0.4,) * 3) - box((0.4,) * 3).moved((severity,) * 3)
    side = 180.0 * draw.integers(2)
    azimuth, elevation = CORNER_VIEW["azimuth"], CORNER_VIEW["elevation"]
    if side:
        elevation = (-elevation[1], -elevation[0])
    return _solid_case(walls, draw, resolution, azimuth=(azimuth[0] + side, azimuth[1] + side), elevation=elevation)


def grazing_plane(severity: float, draw: np.random.Generator, resolution: int) -> StressCase:
    """A plane seen at an angle, in degrees, with the same visible part at each. Parameters: an offset and two tilts.

    The camera is moved along the plane, so that rays enter the unit sphere at other points, and turned about its axis.
    """

    def solid(parameters: Tensor) -> Solid:
        offset, right, forward = parameters
        return half_space(torch.stack([right, torch.ones_like(right), forward]), offset)

    field_of_view = 2 * degrees(atan(GRAZING_VIEW_RATIO * sin(radians(severity))))
    camera = _draw_camera(draw, resolution, elevation=(severity, severity), field_of_view=field_of_view)
    right, forward = draw.uniform(-GRAZING_SHIFT, GRAZING_SHIFT, 2)
    camera = camera.with_object_moved(torch.tensor([right, 0.0, forward, 0.0, 0.0, 0.0], dtype=torch.float32))
    camera = _turn_camera(camera, roll=draw.uniform(-GRAZING_ROLL_DEGREES, GRAZING_ROLL_DEGREES))
    zeros = torch.zeros(3, dtype=torch.float64)
    return StressCase(solid(zeros).field, camera, solid(zeros), solid, zeros)


def near_camera(severity: float, draw: np.random.Generator, resolution: int) -> StressCase:
    """A sphere; the severity is the camera's distance from its surface, below 0.5 within the unit sphere.

    The camera looks past the middle by a random angle, at which the sphere still fills the picture.
    """
    camera = _draw_camera(draw, resolution, distance=0.5 + severity, field_of_view=20.0)
    outline_angle = degrees(asin(0.5 / (0.5 + severity)))
    angle, direction = draw.uniform(0.0, min(max(outline_angle - 20.0, 0.0), 30.0)), draw.uniform(0.0, 2 * pi)
    sphere = sphere_solid(0.5)
    camera = _turn_camera(camera, down=angle * cos(direction), right=angle * sin(direction))
    return StressCase(sphere.field, camera, sphere)


def camera_inside(severity: float, draw: np.random.Generator, resolution: int) -> StressCase:
    """A camera inside a sphere, so that no ray has a first hit; the severity is its depth below the surface."""
    return _solid_case(sphere_solid(0.5), draw, resolution, distance=0.5 - severity, field_of_view=60.0)


def empty_scene(severity: float, draw: np.random.Generator, resolution: int) -> StressCase:
    """A field without a surface, whose smallest value, on a sheet across the view, is the severity.

    The sheet's position and the view differ between repeats, so that different steps come near the sheet.
    """
    sheet = half_space((0.0, 0.0, 1.0), draw.uniform(-0.2, 0.2))
    field = Shape(lambda points: sheet.field(points).abs() + severity, Kind.BOUND)
    camera = _draw_camera(draw, resolution, azimuth=(-30, 30), elevation=(-30, 30))
    return StressCase(field, camera, sphere_solid(0.0))


def _distortion_scene(distortion: distortions.Distortion) -> Scene:
    """The cube with a distorted field, compared with the surface of that field."""

    def scene(severity: float, draw: np.random.Generator, resolution: int) -> StressCase:
        cube = box((CUBE_HALF_SIDE,) * 3)
        camera = _cube_case(draw, resolution).camera
        field, surface = distortion(cube, severity, draw)
        return StressCase(field, camera, surface)

    return scene


def network_scene(name: str, network: Decoder | Published, codes: Float[Tensor, "shapes code_length"]) -> Scene:
    """A trained network at one of its codes, distorted; the truth is the distorted network, traced by safe steps.

    The truth is traced in float32. Its rounding of about 1e-6 is far below the footprint of a pixel.

    Args:
        name: of `distortions.NETWORK_DISTORTIONS`.
        codes: of the training shapes.
    """

    @torch.no_grad()
    def scene(severity: float, draw: np.random.Generator, resolution: int) -> StressCase:
        for _ in range(MAX_NETWORK_DRAWS):
            changed = deepcopy(network)
            code = distortions.NETWORK_DISTORTIONS[name](changed, codes[draw.integers(len(codes))], severity, draw)
            rounded = deepcopy(changed).cpu().at(code.cpu())
            if (rounded(test_points) < 0).float().mean() > MIN_INSIDE_FRACTION:
                break
        exact = deepcopy(changed).cpu().double().at(code.cpu().double())
        with torch.enable_grad():
            slope = estimate_lipschitz(rounded, radius=1.0, samples=NETWORK_SLOPE_POINTS, like=test_points)
        change = distortions.CHANGES_OF_VALUES.get(name)
        # A change of values keeps the surface, so the truth is the unchanged network.
        truth = ReferenceTruth(exact, slope, MIN_RESOLVED_THICKNESS, rounded)
        field = changed.at(code)
        view = {"elevation": NETWORK_ELEVATION_DEGREES, "field_of_view": NETWORK_FIELD_OF_VIEW_DEGREES}
        camera = _draw_camera(draw, max(resolution // NETWORK_PICTURE_SHARE, 8), **view)
        if change is not None:
            return StressCase(Shape(lambda x: change(field(x), severity), field.kind, field.lipschitz), camera, truth)
        return StressCase(field, camera, truth)

    test_points = points_in_sphere(INSIDE_TEST_POINTS).float()
    return scene


def _cube_view_scene(view: Callable[[float], dict[str, float]]) -> Scene:
    """The cube, with a view that depends on the severity."""
    return lambda severity, draw, resolution: _cube_case(draw, resolution, **view(severity))


def nan_region(severity: float, draw: np.random.Generator, resolution: int) -> StressCase:
    """A smaller cube behind a sphere in which the field is NaN; the severity is the sphere's radius, up to 0.1."""
    cube = box((0.42,) * 3)
    case = _solid_case(cube, draw, resolution, field_of_view=38.0, **CORNER_VIEW)
    center = 0.87 * torch.nn.functional.normalize(case.camera.center, dim=0)  # the cube's corner lies at 0.73
    hole = sphere_solid(severity).moved(center).field

    def value(points: Tensor) -> Tensor:
        return torch.where(hole(points) < 0, torch.nan, case.field(points))

    return StressCase(Shape(value, Kind.DISTANCE), case.camera, case.truth)


def floaters(severity: float, draw: np.random.Generator, resolution: int) -> StressCase:
    """A small false sphere in front of a smaller cube, as in a network's field; it takes a third of the picture.

    A Gaussian with the severity as its width is subtracted from the cube's distance. Its depth is 1.5 times the
    distance at its centre. Far from it, the field is the cube's distance.
    """
    cube, distance = box((0.42,) * 3), 0.81
    picture_width = 3 * 1.8 * severity  # the sphere's radius is 0.9 of the Gaussian's
    field_of_view = 2 * degrees(atan(picture_width / 2 / (CAMERA_DISTANCE - distance)))
    case = _solid_case(cube, draw, resolution, field_of_view=field_of_view, **CORNER_VIEW)
    center = distance * torch.nn.functional.normalize(case.camera.center, dim=0)
    depth = 1.5 * float(cube.field(center))

    def value(points: Tensor) -> Tensor:
        square = (points - center.to(points)).square().sum(dim=-1)
        return cube.field(points) - depth * torch.exp(-square / (2 * severity**2))

    lipschitz = 1 + depth / severity * exp(-0.5)
    return StressCase(Shape(value), case.camera, ReferenceTruth(Shape(value), lipschitz, min(0.01, severity / 5)))


SCENES: dict[str, Scene] = {
    scene.__name__: scene
    for scene in (
        thin_plate, wires, nested_shells, bumps, tiny_objects, gap, csg_difference, grazing_plane, near_camera,
        camera_inside, empty_scene, nan_region, floaters,
    )
}  # fmt: skip
SCENES |= {name: _distortion_scene(distortion) for name, distortion in distortions.DISTORTIONS.items()}
SCENES |= {name: _cube_view_scene(view) for name, view in CUBE_VIEWS.items()}


def _cube_case(draw: np.random.Generator, resolution: int, **view: float) -> StressCase:
    settings = {**CORNER_VIEW, "field_of_view": CUBE_FIELD_OF_VIEW_DEGREES, **view}
    return _solid_case(box((CUBE_HALF_SIDE,) * 3), draw, resolution, **settings)


def _union_of_seven(make_solid: Callable[[int], Solid]) -> Solid:
    return reduce(or_, map(make_solid, range(7)))


def _solid_case(solid: Solid, draw: np.random.Generator, resolution: int, **view) -> StressCase:
    return StressCase(solid.field, _draw_camera(draw, resolution, **view), solid)


def _draw_camera(
    draw: np.random.Generator,
    resolution: int,
    *,
    azimuth: tuple[float, float] = ALL_AROUND,
    elevation: tuple[float, float] = (-35.0, 35.0),
    distance: float = CAMERA_DISTANCE,
    field_of_view: float = 50.0,
) -> Camera:
    sampler = ViewSampler(distance, field_of_view, azimuth, elevation, resolution)
    return sampler.camera(draw.uniform(*azimuth), draw.uniform(*elevation))


def _turn_camera(camera: Camera, *, down: float = 0.0, right: float = 0.0, roll: float = 0.0) -> Camera:
    """The camera turned about its centre by angles in degrees, small or about one axis."""
    turn = [0.0, 0.0, 0.0, radians(down), radians(right), radians(roll)]
    return camera.moved(torch.tensor(turn, dtype=torch.float32))


def _about_z(angle: float) -> Float[Tensor, "3 3"]:
    """A rotation about the z axis by an angle in degrees."""
    c, s = cos(radians(angle)), sin(radians(angle))
    return torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def _corner_to_z() -> Float[Tensor, "3 3"]:
    """A rotation that turns a cube's corner to the z axis."""
    z = torch.ones(3, dtype=torch.float64) / 3**0.5
    x = torch.tensor([1.0, -1.0, 0.0], dtype=torch.float64) / 2**0.5
    return torch.stack([x, torch.linalg.cross(z, x), z])
