"""Procedural shapes: unions of primitives with a few random parameters. World axes: y up."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import reduce
from math import inf, sqrt
from operator import or_
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from datasets.mesh import Mesh, extract, normalise
from datasets.scene import Split, seed_of
from renderers.checks import BadInput, check_at_least, check_choice, check_fraction
from renderers.field import Kind
from renderers.fields.analytic import Shape, box, capsule, cylinder, rounded_box, smooth_union, sphere, torus

VERSION = 1  # raise it when a builder changes, so that no prior of the old shapes is used for the new ones
CUBE_HALF_SIDE = 1.5  # the sampled cube is larger than any shape before it is normalised
Parameter = float | torch.Tensor  # a tensor gets gradients
SHEAR_VALUE_FACTOR = 0.8  # multiplies the values of sheared parts; fillets and the shipped priors depend on it


@dataclass(frozen=True)
class Family:
    """A seeded sampler of shapes, in three disjoint splits.

    Args:
        name: which builder, one of `BUILDERS`.
        resolution: samples per axis of the marching cubes that make the mesh.
        radius: of the sphere about the origin that contains a shape.
        ranges: least and largest value of each of the builder's parameters, drawn uniformly.
    """

    name: str
    resolution: int
    radius: float
    ranges: dict[str, Any]

    def __post_init__(self) -> None:
        check_choice("name", self.name, tuple(BUILDERS))
        for name, bounds in self.ranges.items():
            numbers = len(bounds) == 2 and all(isinstance(bound, int | float) for bound in bounds)
            if not numbers or not -inf < bounds[0] <= bounds[1] < inf:
                raise ValueError(f"dataset.ranges.{name} must be two rising numbers, not {bounds}: write [0.1, 0.2]")
        check_at_least("resolution", self.resolution, 16, "128 keeps legs and wings")
        check_fraction("dataset.radius", self.radius, "rays start on the unit sphere; 0.97 leaves a margin")

    def draw(self, split: Split, index: int) -> dict[str, float]:
        generator = np.random.default_rng(seed_of(split, index))
        return {name: float(generator.uniform(*bounds)) for name, bounds in self.ranges.items()}

    def mesh(self, split: Split, index: int) -> Mesh:
        """A shape as a closed mesh, by marching cubes."""
        shape = BUILDERS[self.name](SimpleNamespace(**self.draw(split, index)))
        mesh = extract(shape, grid=self.resolution, reach=CUBE_HALF_SIDE)
        if mesh is None:
            raise BadInput(f"{self.name} {split} {index} has no surface: check dataset.ranges")
        return normalise(mesh, self.radius)

    def identity(self) -> dict[str, Any]:
        """Plain data that determines the shapes: families with equal identity have the same shapes."""
        return {"version": VERSION, **asdict(self)}


def _all_of(parts: list[Shape]) -> Shape:
    return reduce(or_, parts)


def _mirror(shape: Shape, axis: int) -> Shape:
    """The shape and its mirror image, for a shape on the positive side of `axis`."""
    signs = torch.ones(3)
    signs[axis] = -1.0
    return shape | Shape(lambda p: shape(p * signs), shape.kind, shape.lipschitz)


def _shear(shape: Shape, *, along: int, by: int, slope: Parameter) -> Shape:
    """The shape moved along one axis by `slope` times the coordinate on another.

    The shear lengthens gradients by its largest singular value at most.
    """
    steepness = abs(torch.as_tensor(slope).item())
    stretch = (steepness + sqrt(steepness**2 + 4)) / 2

    def sheared(points: torch.Tensor) -> torch.Tensor:
        moved = points.clone()
        moved[..., along] = points[..., along] - slope * points[..., by]
        return shape(moved) * SHEAR_VALUE_FACTOR

    lipschitz = None if shape.lipschitz is None else SHEAR_VALUE_FACTOR * stretch * shape.lipschitz
    is_bound = lipschitz is not None and lipschitz <= 1 and shape.kind is not Kind.LEVEL
    return Shape(sheared, Kind.BOUND if is_bound else Kind.LEVEL, lipschitz)


def _sofa(p: SimpleNamespace) -> Shape:
    def block(width: Parameter, height: Parameter, depth: Parameter, centre: tuple[Parameter, ...]) -> Shape:
        return rounded_box((width / 2, height / 2, depth / 2), p.rounding).translate(centre)

    floor = p.leg_height
    seat = block(p.width, p.seat_height, p.depth, (0, floor + p.seat_height / 2, 0))
    back = block(p.width, p.back_height, p.back_depth, (0, floor + p.back_height / 2, -p.depth / 2 + p.back_depth / 2))
    back = _shear(back.translate((0, -floor, 0)), along=2, by=1, slope=-p.back_tilt).translate((0, floor, 0))
    arm = block(p.arm_width, p.arm_height, p.depth, (p.width / 2, floor + p.arm_height / 2, 0))
    leg = cylinder(0.045, floor / 2 + 0.05).translate((p.width / 2 - 0.08, floor / 2 + 0.05, p.depth / 2 - 0.1))
    legs = _mirror(leg, 0) | _mirror(leg.translate((0, 0, -p.depth + 0.2)), 0)
    return _all_of([seat, back, _mirror(arm, 0), legs]).translate((0, -0.4, 0))


def _plane(p: SimpleNamespace) -> Shape:
    body = capsule((0, 0, -p.length / 2), (0, 0, p.length / 2), p.body_radius)
    half = (p.span / 2, p.thickness / 2, p.chord / 2)
    wing = rounded_box(half, p.thickness * 0.45).translate((half[0], 0, 0))
    wing = _shear(_shear(wing, along=2, by=0, slope=-p.sweep), along=1, by=0, slope=p.dihedral)
    wings = _mirror(wing.translate((0, -p.body_radius * 0.4, p.wing_position)), 0)
    end = -p.length / 2
    tail = rounded_box((p.tail_span / 4, p.thickness / 2, p.chord * 0.3), p.thickness * 0.45)
    tail = _shear(tail.translate((p.tail_span / 4, 0, 0)), along=2, by=0, slope=-p.sweep)
    fin = rounded_box((p.thickness / 2, p.fin_height / 2, p.chord * 0.35), p.thickness * 0.45)
    fin = _shear(fin.translate((0, p.fin_height / 2, 0)), along=2, by=1, slope=-p.sweep)
    engine = capsule((0, 0, -0.09), (0, 0, 0.09), p.engine_radius)
    engine_z = p.wing_position + 0.1 - p.sweep * p.engine_offset
    engine_centre = (p.engine_offset, -p.body_radius * 0.4 - p.engine_radius, engine_z)
    fuselage = smooth_union(body, wings, radius=0.06)
    parts = [fuselage, _mirror(tail.translate((0, 0.03, end)), 0), fin.translate((0, 0, end))]
    return _all_of([*parts, _mirror(engine.translate(engine_centre), 0)])


def _table(p: SimpleNamespace) -> Shape:
    height, half = p.height, (p.width / 2, p.depth / 2)
    top = rounded_box((half[0], p.top_thickness / 2, half[1]), p.top_thickness * 0.4).translate((0, height, 0))
    x, z = half[0] - p.inset - p.leg / 2, half[1] - p.inset - p.leg / 2
    leg = rounded_box((p.leg / 2, height / 2, p.leg / 2), p.leg * p.leg_roundness).translate((0, height / 2, 0))
    leg = _shear(_shear(leg.translate((0, -height, 0)), along=0, by=1, slope=-p.splay), along=2, by=1, slope=-p.splay)
    legs = _mirror(_mirror(leg.translate((x, height, z)), 0), 2)
    apron = box((x, p.apron / 2, z)) - box((x - 0.03, p.apron, z - 0.03))
    shelf = rounded_box((x, p.shelf_thickness / 2, z), 0.01).translate((0, p.shelf_height * height, 0))
    apron = apron.translate((0, height - p.apron / 2, 0))
    return _all_of([top, legs, apron, shelf]).translate((0, -height / 2, 0))


def _car(p: SimpleNamespace) -> Shape:
    def slab(size: tuple[Parameter, ...], centre: tuple[Parameter, ...], radius: Parameter) -> Shape:
        return rounded_box((size[0] / 2, size[1] / 2, size[2] / 2), radius).translate(centre)

    floor = p.clearance
    lower = slab((p.width, p.body_height, p.length), (0, floor + p.body_height / 2, 0), p.rounding)
    roof = floor + p.body_height + p.cabin_height / 2
    cabin = slab((p.width * p.cabin_width, p.cabin_height * 1.4, p.cabin_length), (0, 0, 0), p.rounding)
    windscreen = _shear(cabin, along=2, by=1, slope=-p.rake).translate((0, roof, p.cabin_position))
    rear = _shear(cabin, along=2, by=1, slope=p.rake * 0.5).translate((0, roof, p.cabin_position))
    turn = torch.tensor([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    wheel = cylinder(p.wheel_radius, p.wheel_width / 2).rotate(turn)
    side = p.width / 2 - p.wheel_width / 2 + 0.02
    wheels = _all_of([_mirror(wheel.translate((side, p.wheel_radius, end * p.wheel_base / 2)), 0) for end in (-1, 1)])
    body = smooth_union(lower, windscreen & rear, radius=0.08)
    return (body | wheels).translate((0, -0.35, 0))


def _union(p: SimpleNamespace) -> Shape:
    left = box((p.half_x, p.half_y, p.half_z)).translate((-p.apart, 0, 0))
    right = sphere(p.radius).translate((p.apart, 0, 0))
    return left | right | capsule((0, -0.1, 0), (0, p.height, 0.2), p.thickness)


Builder = Callable[[SimpleNamespace], Shape]
FAMILIES: dict[str, Builder] = {"sofa": _sofa, "plane": _plane, "table": _table, "car": _car}  # priors are shipped
PRIMITIVES: dict[str, Builder] = {
    "sphere": lambda p: sphere(p.radius),
    "ellipsoid": lambda p: sphere(1.0).stretch((p.half_x, p.half_y, p.half_z)),
    "box": lambda p: box((p.half_x, p.half_y, p.half_z)),
    "rounded_box": lambda p: rounded_box((p.half_x, p.half_y, p.half_z), p.rounding),
    "capsule": lambda p: capsule((0, -p.length / 2, 0), (0, p.length / 2, 0), p.radius),
    "cylinder": lambda p: cylinder(p.radius, p.half_height),
    "torus": lambda p: torus(p.major, p.minor),
    "union": _union,
}
BUILDERS = FAMILIES | PRIMITIVES
