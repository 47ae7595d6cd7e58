"""Scenes of growing severity, from easy to impossible, in the unit sphere; each makes an Exam at a severity.

Severities are in the units of conf/stresses.yaml. Random turns and places depend on the generator alone, so that every
renderer gets the same exams.
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

from datasets.stress import distortions
from datasets.stress.distortions import CUBE, THINNEST
from datasets.stress.solids import ReferenceTruth, Solid, Truth, box, half_space, rod, sphere_solid
from datasets.views import ViewSampler
from renderers.camera import Camera
from renderers.field import Field, Kind, estimate_lipschitz, points_in_sphere
from renderers.fields.analytic import Shape
from renderers.fields.mlp import Decoder
from renderers.fields.network import Published

DISTANCE = 2.5  # of the camera from the origin, scene units
ALL_AROUND = (0.0, 360.0)
CORNER = {"azimuth": (37.0, 53.0), "elevation": (27.0, 43.0)}  # three sides of a cube, none of them grazing
ABOVE = (15.0, 35.0)  # degrees of elevation, from which networks are seen, as in conf/config.yaml
REDRAWN, SEEN, LEAST = 20, 4096, 0.01  # draws of a disturbed network at most; points, and the share that must be inside
CUBE_VIEW = 44.0  # degrees: it fills the picture
GRAZING_SHARE = 0.1  # of `grazing_plane`: half the picture's height over its distance, divided by the angle's sine
GRAZING_SHIFT, GRAZING_ROLL = 0.1, 10.0  # of its camera: along the plane, in scene units; about its axis, in degrees
SLIT_DEPTH, SLIT_SHARE = 0.1, 3.0  # of `gap`: how deep, and how many slits the picture is wide

CUBE_VIEWS: dict[str, Callable[[float], dict[str, float]]] = {
    # from a distance, with a field of view that keeps the size of its image
    "far_camera": lambda distance: {"distance": distance, "field_of_view": 2 * degrees(atan(1.0 / distance))},
    "wide_view": lambda angle: {"distance": 1.8, "field_of_view": angle},
    "narrow_view": lambda angle: {"field_of_view": angle},
    "cube": lambda setting: {},  # for a severity that is a renderer's setting
}


@dataclass(frozen=True)
class Exam:
    """One rendering with its truth.

    Args:
        field: that the renderer gets; its stated kind may be wrong on purpose.
        camera: of the rendering.
        truth: of the field: where a disturbance moves its surface, the moved one.
        solid: gives the solid of parameters, where gradients towards them are tested; else None.
        parameters: at which these gradients are taken.
    """

    field: Field
    camera: Camera
    truth: Truth
    solid: Callable[[Tensor], Solid] | None = None
    parameters: Float[Tensor, " n"] | None = None


Scene = Callable[[float, np.random.Generator, int], Exam]  # of severity, random generator, and W of W x W pixels


def thin_plate(severity: float, draw: np.random.Generator, resolution: int) -> Exam:
    """A plate of a thickness, wider than the picture, seen within 5 degrees of its normal."""
    plate = box((0.6, 0.6, severity / 2))
    return _seen(plate, draw, resolution, azimuth=(-5, 5), elevation=(-5, 5), field_of_view=20.0)


def wires(severity: float, draw: np.random.Generator, resolution: int) -> Exam:
    """Seven parallel wires of a radius."""
    fence = _seven(lambda place: rod(severity, 0.6).moved((0.18 * place - 0.54, 0.0, 0.0)))
    tilted = fence.turned(_about_z(draw.uniform(-45, 45)))
    return _seen(tilted, draw, resolution, azimuth=(-20, 20), elevation=(-20, 20))


def nested_shells(severity: float, draw: np.random.Generator, resolution: int) -> Exam:
    """Three nested boxes whose walls have a thickness, cut open at the corner towards the camera."""
    shells = box((0.15,) * 3) - box((0.15 - severity,) * 3)
    for half in (0.32, 0.5):
        shells |= box((half,) * 3) - box((half - severity,) * 3)
    return _seen(shells - box((0.5,) * 3).moved((0.5, 0.5, 0.5)), draw, resolution, **CORNER)


def bumps(severity: float, draw: np.random.Generator, resolution: int) -> Exam:
    """A wavy sheet, 0.03 high, of a frequency in radians per scene unit; its slope makes its distance wrong."""

    def value(points: Tensor) -> Tensor:
        return points[..., 2] - 0.03 * torch.sin(severity * points[..., :2]).prod(dim=-1)

    wavy = Shape(value, Kind.DISTANCE)
    slope = (1 + (0.03 * severity) ** 2) ** 0.5  # the product of two sines has a slope of at most its frequency
    camera = _camera(draw, resolution, azimuth=(-20, 20), elevation=(-20, 20), field_of_view=20.0)
    return Exam(wavy, camera, ReferenceTruth(wavy, lipschitz=slope, thinnest=min(0.01, 0.2 / severity)))


def tiny_objects(severity: float, draw: np.random.Generator, resolution: int) -> Exam:
    """49 cubes of half a side length, 0.16 apart, corners to the camera; pixels are 0.036 wide at 64 x 64."""
    cube = box((severity,) * 3).turned(_corner_to_z())
    row = _seven(lambda place: cube.moved((0.16 * place - 0.48, 0.0, 0.0)))
    sheet = _seven(lambda place: row.moved((0.0, 0.16 * place - 0.48, 0.0)))
    placed = sheet.turned(_about_z(draw.uniform(-45, 45))).moved(tuple(draw.uniform(-0.02, 0.02, 3)))
    return _seen(placed, draw, resolution, azimuth=(-8, 8), elevation=(-8, 8))


def gap(severity: float, draw: np.random.Generator, resolution: int) -> Exam:
    """A slit of a width between two blocks 0.1 deep, with a wall behind; the picture is three slits wide."""
    blocks = [box((0.3, 0.5, SLIT_DEPTH / 2)).moved((side * (0.3 + severity / 2), 0.0, 0.0)) for side in (-1, 1)]
    scene = blocks[0] | blocks[1] | box((0.6, 0.5, 0.05)).moved((0.0, 0.0, -0.2))
    distance = 8.0  # so that few rays meet the sides of the slit
    field_of_view = 2 * degrees(atan(0.5 * SLIT_SHARE * severity / distance))
    aside = scene.moved((severity * draw.uniform(-0.2, 0.2), 0.0, 0.0))
    return _seen(
        aside, draw, resolution, azimuth=(0, 0), elevation=(0, 0), distance=distance, field_of_view=field_of_view
    )


def csg_difference(severity: float, draw: np.random.Generator, resolution: int) -> Exam:
    """Three walls of a thickness: a cube minus a shifted one, whose field is only a bound; from inside or outside."""
    walls = box((0.4,) * 3) - box((0.4,) * 3).moved((severity,) * 3)
    side = 180.0 * draw.integers(2)
    azimuth, elevation = CORNER["azimuth"], CORNER["elevation"]
    if side:
        elevation = (-elevation[1], -elevation[0])
    return _seen(walls, draw, resolution, azimuth=(azimuth[0] + side, azimuth[1] + side), elevation=elevation)


def grazing_plane(severity: float, draw: np.random.Generator, resolution: int) -> Exam:
    """A plane seen at an angle, in degrees, the same share of it at each. Its parameters: an offset and two tilts.

    The camera is moved along the plane, so that rays enter the unit sphere elsewhere, and turned about its axis.
    """

    def solid(parameters: Tensor) -> Solid:
        offset, right, forward = parameters
        return half_space(torch.stack([right, torch.ones_like(right), forward]), offset)

    field_of_view = 2 * degrees(atan(GRAZING_SHARE * sin(radians(severity))))
    camera = _camera(draw, resolution, elevation=(severity, severity), field_of_view=field_of_view)
    right, forward = draw.uniform(-GRAZING_SHIFT, GRAZING_SHIFT, 2)
    camera = camera.with_object_moved(torch.tensor([right, 0.0, forward, 0.0, 0.0, 0.0], dtype=torch.float32))
    camera = _turned(camera, roll=draw.uniform(-GRAZING_ROLL, GRAZING_ROLL))
    none = torch.zeros(3, dtype=torch.float64)
    return Exam(solid(none).field, camera, solid(none), solid, none)


def near_camera(severity: float, draw: np.random.Generator, resolution: int) -> Exam:
    """A sphere from a camera at a distance from its surface; below 0.5 the camera is within the unit sphere.

    The camera looks past the middle by a random angle, at which the sphere still fills the picture.
    """
    camera = _camera(draw, resolution, distance=0.5 + severity, field_of_view=20.0)
    outline = degrees(asin(0.5 / (0.5 + severity)))
    aside, way = draw.uniform(0.0, min(max(outline - 20.0, 0.0), 30.0)), draw.uniform(0.0, 2 * pi)
    sphere = sphere_solid(0.5)
    return Exam(sphere.field, _turned(camera, down=aside * cos(way), right=aside * sin(way)), sphere)


def camera_inside(severity: float, draw: np.random.Generator, resolution: int) -> Exam:
    """A camera within a sphere, at a depth below its surface: no ray has a first hit."""
    return _seen(sphere_solid(0.5), draw, resolution, distance=0.5 - severity, field_of_view=60.0)


def empty_scene(severity: float, draw: np.random.Generator, resolution: int) -> Exam:
    """A field without a surface, whose least value, on a sheet across the view, is the severity.

    The sheet's place and the view differ between repeats, and with them the steps that come near the sheet.
    """
    sheet = half_space((0.0, 0.0, 1.0), draw.uniform(-0.2, 0.2))
    field = Shape(lambda points: sheet.field(points).abs() + severity, Kind.BOUND)
    camera = _camera(draw, resolution, azimuth=(-30, 30), elevation=(-30, 30))
    return Exam(field, camera, sphere_solid(0.0))


def _distorted(distortion: distortions.Distortion) -> Scene:
    """The cube with a distorted field, compared with the surface of that field."""

    def scene(severity: float, draw: np.random.Generator, resolution: int) -> Exam:
        cube = box((CUBE,) * 3)
        camera = _cube(draw, resolution).camera
        field, surface = distortion(cube, severity, draw)
        return Exam(field, camera, surface)

    return scene


def of_network(name: str, network: Decoder | Published, codes: Float[Tensor, "shapes code_length"]) -> Scene:
    """A trained network at one of its codes, disturbed; the truth is the disturbed network in float64.

    What has lost its shape is drawn again.

    Args:
        name: of `distortions.OF_NETWORKS`.
        codes: of the training.
    """

    @torch.no_grad()
    def scene(severity: float, draw: np.random.Generator, resolution: int) -> Exam:
        for _ in range(REDRAWN):
            changed = deepcopy(network)
            code = distortions.OF_NETWORKS[name](changed, codes[draw.integers(len(codes))], severity, draw)
            exact = deepcopy(changed).cpu().double().at(code.cpu().double())
            if (exact(points_in_sphere(SEEN)) < 0).double().mean() > LEAST:
                break
        truth = ReferenceTruth(exact, estimate_lipschitz(exact, radius=1.0), THINNEST)
        return Exam(changed.at(code), _camera(draw, resolution, elevation=ABOVE), truth)

    return scene


def _cube_seen(view: Callable[[float], dict[str, float]]) -> Scene:
    """The cube, with a view that depends on the severity."""
    return lambda severity, draw, resolution: _cube(draw, resolution, **view(severity))


def nan_region(severity: float, draw: np.random.Generator, resolution: int) -> Exam:
    """A smaller cube behind a sphere of a radius, up to 0.1, in which the field is NaN."""
    cube = box((0.42,) * 3)
    exam = _seen(cube, draw, resolution, field_of_view=38.0, **CORNER)
    center = 0.87 * torch.nn.functional.normalize(exam.camera.center, dim=0)  # the cube's corner lies at 0.73
    hole = sphere_solid(severity).moved(center).field

    def value(points: Tensor) -> Tensor:
        return torch.where(hole(points) < 0, torch.nan, exam.field(points))

    return Exam(Shape(value, Kind.DISTANCE), exam.camera, exam.truth)


def floaters(severity: float, draw: np.random.Generator, resolution: int) -> Exam:
    """A dip of a width in the distance in front of a smaller cube, as in a network; it is a third of the picture wide.

    The dip is a Gaussian half as deep again as the distance there: a small ball of its own, in a field that far from it
    is the cube's distance.
    """
    cube, away = box((0.42,) * 3), 0.81
    wide = 3 * 1.8 * severity  # the ball's radius is .9 of the Gaussian's
    exam = _seen(cube, draw, resolution, field_of_view=2 * degrees(atan(wide / 2 / (DISTANCE - away))), **CORNER)
    center = away * torch.nn.functional.normalize(exam.camera.center, dim=0)
    depth = 1.5 * float(cube.field(center))

    def value(points: Tensor) -> Tensor:
        square = (points - center.to(points)).square().sum(dim=-1)
        return cube.field(points) - depth * torch.exp(-square / (2 * severity**2))

    steepest = 1 + depth / severity * exp(-0.5)
    return Exam(Shape(value), exam.camera, ReferenceTruth(Shape(value), steepest, min(0.01, severity / 5)))


SCENES: dict[str, Scene] = {
    scene.__name__: scene
    for scene in (
        thin_plate, wires, nested_shells, bumps, tiny_objects, gap, csg_difference, grazing_plane, near_camera,
        camera_inside, empty_scene, nan_region, floaters,
    )
}  # fmt: skip
SCENES |= {name: _distorted(distortion) for name, distortion in distortions.DISTORTIONS.items()}
SCENES |= {name: _cube_seen(view) for name, view in CUBE_VIEWS.items()}


def _cube(draw: np.random.Generator, resolution: int, **view: float) -> Exam:
    return _seen(box((CUBE,) * 3), draw, resolution, **{**CORNER, "field_of_view": CUBE_VIEW, **view})


def _seven(part: Callable[[int], Solid]) -> Solid:
    """The union of the parts at places 0 to 6."""
    return reduce(or_, map(part, range(7)))


def _seen(solid: Solid, draw: np.random.Generator, resolution: int, **view) -> Exam:
    return Exam(solid.field, _camera(draw, resolution, **view), solid)


def _camera(
    draw: np.random.Generator,
    resolution: int,
    *,
    azimuth: tuple[float, float] = ALL_AROUND,
    elevation: tuple[float, float] = (-35.0, 35.0),
    distance: float = DISTANCE,
    field_of_view: float = 50.0,
) -> Camera:
    sampler = ViewSampler(distance, field_of_view, azimuth, elevation, resolution)
    return sampler.camera(draw.uniform(*azimuth), draw.uniform(*elevation))


def _turned(camera: Camera, *, down: float = 0.0, right: float = 0.0, roll: float = 0.0) -> Camera:
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
