"""Every value that cannot be ends in an error that names its key."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from jaxtyping import TypeCheckError

from bench.config import load
from renderers.camera import Rays
from renderers.field import occupancy_logits
from renderers.fields.analytic import Shape, sphere
from renderers.fields.grid import Grid
from renderers.fields.mlp import Decoder
from renderers.fields.networks.coloured import ColouredDistance, ColouredEncoded, ColouredGrid, ColouredOccupancy
from renderers.fields.networks.encoded import FourierFeatures
from renderers.fields.networks.occupancy import OccupancyField, OccupancyNetwork
from renderers.rendering import RayObservation
from renderers.tracing.reference import trace
from tests.looped import each
from tests.renderers.analytic_cases import along_z, vector
from tests.renderers.test_camera import camera, motion

NAN, INF = float("nan"), float("inf")
RAYS, AHEAD, FOCAL = along_z(0.0), vector((0, 0, 1)), camera().intrinsics
LEVEL = Shape(lambda p: p.norm(dim=-1) - 0.5)
renderer, silhouette, view = partial(load, "renderer"), partial(load, "silhouette"), partial(replace, camera())
decoder = partial(Decoder, **{"layers": 4, "width": 8, "code_length": 4, "skip": 2, "narrow": False})
traced = partial(trace, sphere(0.5), radius=1.0, **{"lipschitz": 1.0, "least_step": 2e-4})
VOLUMES = {
    "neus": "sharpness",
    "opaque": "sharpness",
    "volsdf": "error",
    "unisurf": "interval",
    "relaxed_boundary": "band",
    "edge_sampling": "width",
}


def unchecked(kind: type, **values) -> None:
    """The checks of a class, without the type checker, which only tests have."""
    kind.__post_init__(SimpleNamespace(**values))


WRONG: list[tuple[str, Callable, dict]] = [  # words of the error, what is built, and its settings
    ("average must be one of all, violating", partial(silhouette, "hinge"), {"average": "some"}),
    ("sharpness must be positive, not -1", partial(silhouette, "cross_entropy"), {"sharpness": -1.0}),
    ("weight must be at least 0, not -1", partial(silhouette, "occupancy"), {"weight": -1.0}),
    ("occupied_at must be one of random, depth", partial(silhouette, "occupancy"), {"occupied_at": "hull"}),
    *((f"{key} must be positive, not 0", partial(renderer, name), {key: 0.0})
      for name, own in VOLUMES.items() for key in (own, "sphere_radius")),
    *(("anisotropy must lie between 0", partial(renderer, "opaque"), {"anisotropy": wrong})
      for wrong in (-0.1, 1.1, NAN)),
    ("relaxation needs step_back=true", partial(renderer, "dist"), {"relaxation": 0.3}),
    ("relaxation must lie between 0", partial(renderer, "dist"), {"relaxation": 1.3, "step_back": True}),
    *(("doublings must be rising iterations from 0", partial(renderer, "dvr"), {"doublings": wrong})
      for wrong in ([3, 3], [5, 2], [-1])),
    ("lipschitz must be positive, not 0", partial(traced, RAYS), {"lipschitz": 0.0}),
    ("least_step must be positive, not -1", partial(traced, RAYS), {"least_step": -1.0}),
    (r"rays must be in float64, not torch\.float32", traced,
     {"rays": Rays(RAYS.origins.float(), RAYS.directions.float())}),
    (r"skip must lie between 0 .* layers - 1 = 3, not 4", decoder, {"skip": 4}),
    (r"width must exceed code_length \+ 3 = 7 .*, not 7", decoder, {"width": 7, "narrow": True}),
    ("layers must be at least 1, not 0", decoder, {"layers": 0, "skip": 0}),
    ("code must end in 4 numbers, not 3", decoder().at, {"code": torch.zeros(3)}),
    ("width must be at least 1, not 0: 128 suits", OccupancyNetwork, {"width": 0, "code_length": 4}),
    ("code_length must be at least 0, not -1", OccupancyNetwork, {"width": 8, "code_length": -1}),
    ("code must end in 4 numbers, not 3", OccupancyNetwork(width=8, code_length=4).at, {"code": torch.zeros(3)}),
    *(("threshold must lie between 0 and 1", OccupancyField, {"logits": LEVEL, "threshold": wrong})
      for wrong in (0.0, 1.0, NAN)),
    *((rf"width must be positive, not {width}: 0\.02 suits", partial(occupancy_logits, field, torch.zeros(3)),
       {"width": width}) for field in (sphere(), LEVEL) for width in (0.0, NAN)),
    (r"layers must be .*4 suit", partial(ColouredDistance, width=8, octaves=2, radius=0.5, directional=True),
     {"layers": 0}),
    (r"radius must be .*0\.5 lies", ColouredOccupancy, {"width": 8, "radius": 0.0}),
    (r"layers must be .*1 suits", partial(ColouredEncoded, FourierFeatures(torch.zeros(4, 3)), width=8, radius=0.5,
                                          directional=True), {"layers": 0}),
    (r"radius must be .*0\.5 lies", ColouredGrid, {"samples": 8, "reach": 1.0, "radius": 0.0}),
    (r"samples must be .*48 suit", ColouredGrid, {"samples": 1, "reach": 1.0, "radius": 0.5}),
    *(("values", partial(Grid, torch.zeros(shape)), {"reach": 1.0}) for shape in ((3, 3, 4), (3, 3), (1, 1, 1))),
    ("focal lengths must be positive and", view, {"intrinsics": FOCAL - torch.diag(vector((100, 0, 0)))}),
    ("focal lengths must be positive and finite", view, {"intrinsics": FOCAL * torch.inf}),
    ("world_to_camera must hold a rotation", view, {"world_to_camera": 2 * motion()}),
    ("world_to_camera must hold a rotation", view, {"world_to_camera": motion() * vector((1, 1, -1, 1))}),
    ("world_to_camera must hold finite numbers", view, {"world_to_camera": motion(0.0, (0, NAN, 0))}),
    ("height and width must be at least 1 pixel", view, {"height": 0}),
    ("height and width must be at least 1 pixel", view, {"width": -1}),
    (r"must both have shape \[\*rays, 3\]", partial(unchecked, Rays),
     {"origins": torch.zeros(2, 3), "directions": torch.zeros(3, 3)}),
    *(("directions must have unit length", partial(Rays, torch.zeros(2, 3)),
       {"directions": torch.stack([AHEAD, scale * AHEAD])}) for scale in (0.5, NAN)),
    ("origins must be finite", Rays, {"origins": vector((0, INF, 0)), "directions": AHEAD}),
    (r"mask must be boolean, not torch\.float32: compare a picture with", partial(unchecked, RayObservation),
     {"mask": torch.ones(8, 8), "distance": None}),
    (r"distance must have the mask's shape \[8, 8\], not \[3\]: give NaN where no", partial(unchecked, RayObservation),
     {"mask": torch.ones(8, 8).bool(), "distance": torch.ones(3)}),
]  # fmt: skip


@each("words, build, settings", WRONG)
def test_a_wrong_value_is_an_error_that_names_its_key(words, build, settings):
    with pytest.raises((ValueError, TypeCheckError), match=words):
        build(**settings)


def test_no_rays_are_fine():
    Rays(torch.zeros(0, 3), torch.zeros(0, 3))
