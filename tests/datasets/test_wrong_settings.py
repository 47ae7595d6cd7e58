"""Every value that cannot be ends in an error that names its key."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from bench.config import load
from datasets.files.deform import Deformation
from datasets.mesh import Mesh, normalise
from datasets.scene import SPLIT_STRIDE, Split, Truth, sample_surface, seed_of
from datasets.views import look_at, observed_pixels
from tests.datasets.test_photographs import PHOTOGRAPHY
from tests.datasets.test_views import MASK, VIEWS
from tests.looped import each
from tests.tiny import TRIANGLE, icosphere

NAN = float("nan")
BALL = icosphere(0.5, subdivisions=1)
view, photography, family = (partial(replace, settings) for settings in (VIEWS, PHOTOGRAPHY, load("dataset", "sofa")))
mesh, pixels = partial(Mesh, np.eye(3)), partial(observed_pixels, MASK, seed=0)


def moved(number: float) -> np.ndarray:
    """The corners of a triangle, of which one has this coordinate."""
    vertices = np.zeros((3, 3))
    vertices[1, 2] = number
    return vertices


WRONG: list[tuple[str, Callable, dict]] = [  # words of the error, what is built, and its settings
    ("view.distance must be positive, not nan", view, {"distance": NAN}),
    ("resolution must be at least 4, not 3: set", view, {"resolution": 3}),
    ("view.field_of_view must lie between 0 and 180 degrees, not 180", view, {"field_of_view": 180.0}),
    ("view.elevation must rise within -90 to 90 degrees", view, {"elevation": (0.0, 90.0)}),
    ("view.elevation must rise within -90 to 90 degrees", view, {"elevation": (35.0, 15.0)}),
    *((r"eye must not lie on, above or below target.*lower the elevation", look_at,
       {"eye": torch.tensor([0.0, height, 0.0]), "target": torch.zeros(3)}) for height in (2.0, -2.0, 0.0)),
    *((f'points must be "dense", a share up to "100%", or a .*, not .{points}', pixels, {"points": points})
      for points in (0, "101%", "abc", "5.5", "nan%")),
    ("at most the 200 pixels of the shape, not 201: give fewer", pixels, {"points": 201}),
    ("views must be at least 2", photography, {"views": 1}),
    ("places must be one of circle, arc, sphere", photography, {"places": "cube"}),
    ("texture_size must be positive", photography, {"texture_size": 0.0}),
    ("blur must be at least 0", photography, {"blur": NAN}),
    *((r"vertices: must be numbers below 1e\+12.* with 1 NaN, infinite or too large", Mesh,
       {"vertices": moved(number), "faces": np.array([[0, 1, 2]])}) for number in (NAN, np.inf, 1e30)),
    ("faces: must index the 3 vertices from 0, found 0 to 3", mesh, {"faces": np.array([[0, 1, 3]])}),
    ("faces: must index the 3 vertices from 0, found -1 to 2", mesh, {"faces": np.array([[-1, 1, 2]])}),
    ("faces: must be one or more triangles", mesh, {"faces": np.zeros((0, 3), dtype=int)}),
    *(("radius: must be positive", partial(normalise, BALL), {"radius": radius}) for radius in (0.0, -1.0, NAN)),
    *(("strength: must be from 0 to 1", partial(Deformation.draw, 0), {"strength": x}) for x in (-0.1, 1.5, NAN)),
    (r"name must be one of .*sofa.*, not 'lamp'", family, {"name": "lamp"}),
    (r"radius must be above 0 and at most 1, not 1.5: rays start on the unit", family, {"radius": 1.5}),
    (f"index must lie between 0 and {SPLIT_STRIDE - 1}, not {SPLIT_STRIDE}", partial(seed_of, Split.TEST),
     {"index": SPLIT_STRIDE}),
    ("mesh: must be watertight", Truth, {"mesh": TRIANGLE}),
    ("directions: must be finite and not zero", Truth(BALL).cast,
     {"origins": np.zeros((1, 3)), "directions": np.zeros((1, 3))}),
    ("count: must be 0 or more, found -1", partial(sample_surface, BALL), {"count": -1, "seed": 0}),
]  # fmt: skip


@each("words, build, settings", WRONG)
def test_a_wrong_value_is_an_error_that_names_its_key(words, build, settings):
    with pytest.raises(ValueError, match=words):
        build(**settings)
