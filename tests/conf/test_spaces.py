"""Search spaces: every tuned method has one, and a draw is the same Sobol point for all methods."""

from math import log

import numpy as np
import pytest
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import InterpolationResolutionError

from bench.config import build
from bench.setup.spaces import SOBOL_DIMENSIONS, SOBOL_DRAWS, sobol_points
from bench.tables import choice, names, register_resolvers
from tests.composing import composed
from tests.looped import each

SPACES = names("method/space")


def ranges(space: str) -> dict[str, tuple[int, float, float]]:
    """The drawn keys of a space and of all spaces: the dimension, and the ends of the range."""
    drawn = {}

    def walk(node, prefix=""):
        for key, value in node.items():
            if isinstance(value, dict):
                walk(value, f"{prefix}{key}.")
            elif str(value).startswith("${drawn:"):
                dimension, least, most = str(value)[len("${drawn:") : -1].split(",")
                drawn[f"{prefix}{key}"] = (int(dimension), float(least), float(most))

    walk(choice("method", "_drawn"))
    walk(choice("method/space", space))
    return drawn


def test_the_points_fill_the_cube_evenly():
    points = np.array(sobol_points())
    assert points.shape == (SOBOL_DRAWS, SOBOL_DIMENSIONS)
    for dimension in range(SOBOL_DIMENSIONS):  # the first sixteen points are in different sixteenths
        assert sorted((16 * points[:16, dimension]).astype(int)) == list(range(16))


def test_no_two_settings_are_drawn_alike():
    used = max(len(ranges(space)) for space in SPACES)
    correlation = np.abs(np.corrcoef(np.array(sobol_points())[:16, :used].T) - np.eye(used))
    assert correlation.max() < 0.1  # else the effects of two settings could be confused


@each("space", SPACES)
def test_a_space_has_its_own_dimension_for_each_setting_and_contains_the_default(space):
    drawn = ranges(space)
    assert sorted(dimension for dimension, *_ in drawn.values()) == list(range(len(drawn)))
    assert "task.optimiser.learning_rate" in drawn and "task.silhouette_weight" in drawn
    default = composed(f"+method={space}")
    for key, (_, least, most) in drawn.items():
        fraction = log(OmegaConf.select(default, key) / least) / log(most / least)
        assert 0.35 <= fraction <= 0.65, key  # as many draws below as above it


@each("space, draw", [("newton_mask", 31), ("newton_mask", SOBOL_DRAWS - 1), *((space, 0) for space in SPACES)])
def test_a_draw_is_its_sobol_point_even_in_the_logarithm(space, draw):
    config = composed(f"+method=space/{space}", f"draw={draw}")
    for key, (dimension, least, most) in ranges(space).items():
        value = OmegaConf.select(config, key)
        fraction = log(value / least) / log(most / least)
        rounded = 0.5 / value if isinstance(value, int) else 0.005  # the largest change of the logarithm by rounding
        point, tolerance = sobol_points()[draw][dimension], 1.02 * rounded / log(most / least)
        assert fraction == pytest.approx(point, abs=tolerance)
    build(config.renderer, "renderer")
    assert config.label == composed(f"+method={space}").label


def test_shared_settings_have_the_same_values_in_a_draw():
    shared = set.intersection(*(set(ranges(space)) for space in SPACES))
    assert shared == {"task.silhouette_weight", "task.code.weight", "task.optimiser.learning_rate"}
    for key in shared:
        assert len({ranges(space)[key] for space in SPACES}) == 1
        assert len({OmegaConf.select(composed(f"+method=space/{space}", "draw=0"), key) for space in SPACES}) == 1


def test_an_invalid_draw_or_range_is_an_error():
    for draw in ("null", "64"):
        with pytest.raises((InterpolationResolutionError, HydraException), match="needs draw=0 to draw=63"):
            OmegaConf.to_container(composed("+method=space/dist_mask", f"draw={draw}"), resolve=True)
    for bad in ("0,0.0,1.0", "8,1.0,2.0"):
        node = OmegaConf.create({"draw": 0, "x": f"${{drawn:{bad}}}"})
        with pytest.raises(InterpolationResolutionError, match="must have a dimension from 0 to 7 and ends above 0"):
            OmegaConf.to_container(node, resolve=True)


def test_a_whole_range_gives_whole_numbers():
    register_resolvers()
    values = [OmegaConf.create({"draw": draw, "x": "${drawn:3,25,100}"}).x for draw in range(16)]
    assert all(isinstance(value, int) and 25 <= value <= 100 for value in values) and len({*values}) > 8
    assert np.ptp(values) > 50
