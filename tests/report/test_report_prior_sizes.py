"""The page on sizes of priors: the number of weights, and a verdict that follows the runs."""

import numpy as np

from bench.report.compare import Gap
from bench.report.data.statistics import ratio
from bench.studies.prior_sizes import _verdict, weights
from renderers.fields.mlp import Decoder
from tests.looped import each
from tests.report.test_report_paper import page_of, write_run

ALIKE, WORSE, BETTER = [0.9, 1.1] * 8, [1.5, 1.6] * 8, [0.4, 0.5] * 8
SIZES = {"small": (64, 8), "large": (128, 64)}


@each("skip, narrow", [(0, False), (2, False), (2, True)])
def test_weights_are_those_of_the_network(skip, narrow):
    network = {"layers": 4, "width": 32, "code_length": 8, "skip": skip, "narrow": narrow}
    assert weights(**network) == sum(parameter.numel() for parameter in Decoder(**network).parameters())


def line(row: str, errors: list[float], weights: int) -> dict:
    largest = [np.array([1.0])] * len(errors)
    return {
        "row": row,
        "flops": 1.0,
        "weights": weights,
        "ratio": Gap(ratio([np.array([e]) for e in errors], largest), 0, len(errors)),
    }


@each("small, middle, answer, count", [
    (WORSE, ALIKE, "*middle* (layers × width) is the smallest prior", "*1 of 2* smaller priors have a larger error."),
    (ALIKE, ALIKE, "*small* (layers × width) is the smallest prior", "*0 of 2* smaller priors have a larger error."),
    (BETTER, ALIKE, "*small* (layers × width) is the smallest prior", "*0 of 2* smaller priors have a larger error."),
    (WORSE, WORSE, "No smaller prior is as good as *large*", "*2 of 2* smaller priors have a larger error."),
])  # fmt: skip
def test_the_verdict_names_the_smallest_prior_without_a_larger_error(small, middle, answer, count):
    largest = {"row": "large", "flops": 1.0, "weights": 100, "ratio": None}
    text = _verdict([line("small", small, 10), line("middle", middle, 50), largest])
    too_few_shapes = [line(name, [1.1] * 6, 10) for name in "abc"]
    assert "smallest" not in _verdict([*too_few_shapes, largest])
    assert answer in text and text.endswith(count)


def test_priors_are_compared_within_a_renderer_and_a_failed_prior_has_no_ratio(tmp_path):
    for renderer, factor in (("dist", 1.0), ("dvr", 3.0)):
        for name, (width, code) in SIZES.items():
            network = {"layers": 2, "width": width, "code_length": code, "skip": 0, "narrow": False}
            for index in range(6):
                failed = renderer == "dvr" and name == "small"
                write_run(
                    tmp_path, "prior_sizes", f"{name}, {renderer}", renderer=renderer, index=index,
                    metrics={"chamfer_l2": factor * width}, settings={"prior": {"network": network}},
                    scene=f"car {index}", flops=factor * width, status="crashed" if failed else "ok",
                )  # fmt: skip
    lines = page_of(tmp_path, "prior_sizes").data.set_index("row")
    assert lines.loc["small, dist", "ratio"].startswith("0.500") and lines.loc["small, dvr", "ratio"] == ""
    assert lines.loc["large, dist", "ratio"] == lines.loc["large, dvr", "ratio"] == ""


def test_a_failed_run_is_named_by_its_label_without_its_sizes(tmp_path):
    for layers, (name, (width, code)) in zip((2, 4), SIZES.items(), strict=True):
        network = {"layers": layers, "width": width, "code_length": code, "skip": layers - 2, "narrow": False}
        status, settings = "crashed" if name == "small" else "ok", {"prior": {"network": network}}
        write_run(
            tmp_path, "prior_sizes", name, renderer="dist", metrics={"chamfer_l2": 1.0}, settings=settings,
            flops=1.0, status=status, reason="why",
        )  # fmt: skip
    assert "1 of 2 runs did not end ok: small: crashed (why)" in page_of(tmp_path, "prior_sizes").caption
