"""Free numbers, stored numbers and bytes of a field, and the choice by one of them."""

import pytest

from bench.models.candidates import by_size, candidate
from bench.models.model import Size
from bench.models.study import choose
from bench.pictures.size_chart import AXES
from bench.setup.fields import SIZE_WORDS, ModelSettings
from bench.studies.parsimony import SIZES
from tests.models.test_models import FIT, GROWTH, VIEWS, an_error, evidence_of

# On fandisk, both are under half a pixel: the grid has fewer free numbers, the network fewer stored ones.
GRID, NETWORK = Size(free=4_427, stored=32_768, sparse_bytes=40_000), Size(free=12_801, stored=12_801)


@pytest.mark.parametrize(
    ("measure", "chosen"), [("free", "grid_32"), ("stored", "network_4x64"), ("bytes", "network_4x64")]
)
@pytest.mark.parametrize("turned", [False, True])
def test_free_and_stored_numbers_disagree_and_the_measure_decides(measure, chosen, turned):
    fits = [evidence_of("grid_32", GRID, an_error(0.008)), evidence_of("network_4x64", NETWORK, an_error(0.009))]
    choice = choose(fits[::-1] if turned else fits, 0.01, measure)
    assert (choice.chosen.candidate, choice.measure, choice.best.candidate) == (chosen, measure, "grid_32")


def test_sizes_in_words():
    assert str(GRID) == "32,768 numbers, 4,427 of them free"
    assert str(NETWORK) == "12,801 numbers"
    assert (GRID.bytes, NETWORK.bytes) == (131_072, 51_204)


def test_candidates_are_tried_in_the_order_of_the_measure(compose_config):
    names = ("sphere", "ellipsoid", "box", "network_2x64", "grid_32", "network_4x64", "network_4x128")
    by_stored = (*names[:4], "network_4x64", "grid_32", "network_4x128")
    assert [one.name for one in by_size(names, "free")] == list(names)
    for measure in ("stored", "bytes"):
        assert [one.name for one in by_size(names, measure)] == list(by_stored)
    for scale in ("smoke", "desk", "paper"):
        shipped = tuple(compose_config(f"scale={scale}").models.candidates)
        sizes = [one.stored for one in by_size(shipped, "stored")]
        assert sizes == sorted(sizes)
        free = [candidate(name).stored for name in shipped if not name.startswith("grid_")]
        assert free == sorted(free)  # all numbers of the others are free


def test_an_unknown_measure_of_size_is_an_error():
    with pytest.raises(ValueError, match=r"models\.size must be one of stored, free, bytes, not 'parameters'"):
        ModelSettings(("sphere",), "parameters", FIT, GROWTH, VIEWS)


def test_pages_have_the_same_measures_under_the_same_words():
    assert set(SIZES) == set(SIZE_WORDS)
    assert {measure: AXES[measure] for measure in SIZES} == SIZE_WORDS
