"""Search spaces: every method of the tuning has one, and a draw is the same Sobol point for all of them."""

from math import log

import numpy as np
import pytest
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import InterpolationResolutionError

from bench.config import build
from bench.runner.compose import register
from bench.tables import SOBOL_DIMENSIONS, SOBOL_DRAWS, choice, names, sobol_points
from tests.composing import composed
from tests.looped import each

SPACES = names("method/space")


def ranges(space: str) -> dict[str, tuple[int, float, float]]:
    """The drawn keys of a space's file, and of what all share: dimension and ends."""
    found = {}

    def walk(node, prefix=""):
        for key, value in node.items():
            if isinstance(value, dict):
                walk(value, f"{prefix}{key}.")
            elif str(value).startswith("${drawn:"):
                dimension, least, most = str(value)[len("${drawn:") : -1].split(",")
                found[f"{prefix}{key}"] = (int(dimension), float(least), float(most))

    walk(choice("method", "_drawn"))
    walk(choice("method/space", space))
    return found


def test_the_points_fill_the_cube_evenly():
    points = np.array(sobol_points())
    assert points.shape == (SOBOL_DRAWS, SOBOL_DIMENSIONS)
    for dimension in range(SOBOL_DIMENSIONS):  # a point in each sixteenth, also of the first sixteen alone
        assert sorted((16 * points[:16, dimension]).astype(int)) == list(range(16))


def test_no_two_settings_are_drawn_alike():
    used = max(len(ranges(space)) for space in SPACES)
    alike = np.abs(np.corrcoef(np.array(sobol_points())[:16, :used].T) - np.eye(used))
    assert alike.max() < 0.1  # else the effect of the one would be taken for that of the other


@each("space", SPACES)
def test_a_space_has_its_own_dimension_for_each_setting_and_contains_the_default(space):
    known = ranges(space)
    assert sorted(dimension for dimension, *_ in known.values()) == list(range(len(known)))
    assert "task.optimiser.learning_rate" in known and "task.silhouette_weight" in known
    default = composed(f"+method={space}")
    for key, (_, least, most) in known.items():
        place = log(OmegaConf.select(default, key) / least) / log(most / least)
        assert 0.35 <= place <= 0.65, key  # as many draws below as above it


@each("space, draw", [("newton_mask", 31), ("newton_mask", SOBOL_DRAWS - 1), *((space, 0) for space in SPACES)])
def test_a_draw_is_its_sobol_point_even_in_the_logarithm(space, draw):
    config = composed(f"+method=space/{space}", f"draw={draw}")
    for key, (dimension, least, most) in ranges(space).items():
        value = OmegaConf.select(config, key)
        share = log(value / least) / log(most / least)
        rounded = 0.5 / value if isinstance(value, int) else 0.005  # the most by which rounding changes a logarithm
        assert share == pytest.approx(np.array(sobol_points())[draw, dimension], abs=1.02 * rounded / log(most / least))
    build(config.renderer, "renderer")
    assert config.label == composed(f"+method={space}").label


def test_settings_that_all_methods_have_get_the_same_values_in_a_draw():
    shared = set.intersection(*(set(ranges(space)) for space in SPACES))
    assert shared == {"task.silhouette_weight", "task.code.weight", "task.optimiser.learning_rate"}
    for key in shared:
        assert len({ranges(space)[key] for space in SPACES}) == 1
        assert len({OmegaConf.select(composed(f"+method=space/{space}", "draw=0"), key) for space in SPACES}) == 1


def test_a_draw_or_a_range_that_is_none_is_an_error():
    for draw in ("null", "64"):
        with pytest.raises((InterpolationResolutionError, HydraException), match="needs draw=0 to draw=63"):
            OmegaConf.to_container(composed("+method=space/dist_mask", f"draw={draw}"), resolve=True)
    for bad in ("0,0.0,1.0", "8,1.0,2.0"):
        node = OmegaConf.create({"draw": 0, "x": f"${{drawn:{bad}}}"})
        with pytest.raises(InterpolationResolutionError, match="must have a dimension from 0 to 7 and ends above 0"):
            OmegaConf.to_container(node, resolve=True)


def test_a_whole_range_gives_whole_numbers():
    register()
    values = [OmegaConf.create({"draw": draw, "x": "${drawn:3,25,100}"}).x for draw in range(16)]
    assert all(isinstance(value, int) and 25 <= value <= 100 for value in values) and len({*values}) > 8
    assert np.ptp(values) > 50
