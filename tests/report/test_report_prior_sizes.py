"""The page on sizes of priors: the number of weights, and a verdict that follows the runs."""

import numpy as np

from bench.report.compare import Gap
from bench.report.data.statistics import ratio
from bench.studies.prior_sizes import _verdict, weights
from renderers.fields.mlp import Decoder
from tests.looped import each


@each("skip, narrow", [(0, False), (2, False), (2, True)])
def test_weights_are_those_of_the_network(skip, narrow):
    network = {"layers": 4, "width": 32, "code_length": 8, "skip": skip, "narrow": narrow}
    assert weights(**network) == sum(parameter.numel() for parameter in Decoder(**network).parameters())


def line(row: str, errors: list[float], flops: float) -> dict:
    largest = [np.array([1.0])] * len(errors)
    return {"row": row, "flops": flops, "ratio": Gap(ratio([np.array([e]) for e in errors], largest), 0, len(errors))}


def test_the_verdict_names_the_cheapest_prior_whose_error_does_not_differ():
    alike, worse = [0.9, 1.1] * 8, [1.5, 1.6] * 8
    largest = {"row": "large", "flops": 100.0, "ratio": None}
    text = _verdict([line("small", worse, 10.0), line("middle", alike, 50.0), largest])
    assert "*1 of 2* ratios of errors, to large, differ significantly from 1: small" in text
    assert "middle needs the fewest FLOPs: 50 %" in text
    assert "fewest FLOPs: 10 %" in _verdict([line("small", alike, 10.0), line("middle", alike, 50.0), largest])
    assert "fewest" not in _verdict([line("small", worse, 10.0), largest])
