"""Claims of the papers, aggressive marching over alpha, and DIST one change at a time, from runs of known numbers."""

import re
from math import inf, nan
from pathlib import Path

import pytest

from bench.config import names
from bench.report.claims import NO_LARGER, NO_RUNS, SMALLER, Claim, verdict_of
from bench.report.data.statistics import Interval
from bench.studies import claims, later_claims
from tests.looped import each
from tests.report.test_report_paper import page_of, write_curve, write_run

SHAPES = tuple(range(6))
CLAIMS = (*claims.CLAIMS, *later_claims.CLAIMS)


@each(
    "expected, published, low, value, high, verdict",
    [
        (SMALLER, 0.5, 0.5, 0.8, 0.9, "holds"),  # half of the effect is 0.71
        (SMALLER, 0.5, 0.75, 0.8, 0.9, "weaker"),
        (SMALLER, 0.5, 0.75, 0.8, 1.1, "less than half the effect"),
        (SMALLER, None, 0.5, 0.8, 0.9, "holds"),
        (SMALLER, 0.5, 0.5, 0.6, 1.1, "not decided"),
        (SMALLER, 0.5, 1.1, 1.2, 1.3, "does not hold"),
        (NO_LARGER, None, 1.01, 1.1, 1.4, "larger (size not decided)"),
        (NO_LARGER, None, 0.5, 0.6, 0.7, "holds"),
        (NO_LARGER, None, 0.5, 1.0, 1.3, "not decided"),
        (NO_LARGER, None, 1.3, 1.4, 1.5, "does not hold"),
        (SMALLER, 0.5, nan, 0.6, nan, "as claimed, 4 shapes"),
        (SMALLER, 0.5, nan, 1.6, nan, "against the claim, 4 shapes"),
        (NO_LARGER, None, nan, 1.3, nan, "against the claim, 4 shapes"),
    ],
)
def test_a_verdict_follows_the_rule(expected, published, low, value, high, verdict):
    claim = Claim("a paper", "a claim", published and (lambda: published), expected=expected)
    assert verdict_of(claim, Interval(value, low, high, (value,) * 4)) == verdict


def test_every_claim_names_rows_and_tests_that_exist_or_says_what_it_needs():
    rows = {*names("renderer"), *names("method")}
    for claim in CLAIMS:
        if claim.experiment:
            assert {claim.top, claim.bottom or claim.top} <= rows and (claim.command or claim.experiment) in names(
                "experiment"
            ), claim
        elif not claim.test:
            assert claim.why.startswith("needs"), claim
    tests = "".join(path.read_text() for path in Path(__file__).parents[1].rglob("test_*.py"))
    assert all(f"def {claim.test}(" in tests for claim in CLAIMS if claim.test)


def dense(results, method, errors, **changed):
    """Completions of sofas from dense depth."""
    for index, error in zip(SHAPES, errors, strict=True):
        known = {"task": "completion", "dataset": "sofa", "method": method, "index": index} | changed
        settings = {"task": {"points": "dense"}, "split": "test"} | known.pop("settings", {})
        write_run(
            results,
            known.pop("experiment", "table2_claims"),
            method,
            settings=settings,
            **known,
            metrics={"chamfer_l2": error},
        )


def test_claims_are_measured_on_shapes_that_both_rows_have(tmp_path):
    dense(tmp_path, "deepsdf_official", [1.0] * 6)
    dense(tmp_path, "dist_mask_official", [0.3, 0.4, 0.5, 0.6, 0.7, 9.0])
    dense(tmp_path, "dist_mask_paper", [2.0, 3.0, 4.0, 5.0, 6.0, 7.0])
    dense(tmp_path, "dist_mask_paper", [0.1] * 6, dataset="car")  # the paper has no cars
    page = page_of(tmp_path, "claims")
    lines = {line["claim"]: line for line in page.lines if line["shapes"]}
    assert {name: line["shapes"] for name, line in lines.items()} == dict.fromkeys(lines, 6) and len(lines) == 2
    printed, official = lines.values()
    assert printed["ratio"].value == pytest.approx(20**0.5) and printed["verdict"] == "does not hold"
    assert printed["why"].startswith("likely the mask loss") and printed["families"] == "sofa"
    assert official["ratio"].value == pytest.approx(0.3**0.5) and official["verdict"] == "not decided"  # 1 of 6 against
    assert page.verdict.startswith("*0* of 2 measured comparisons hold. Verdicts of the others: “does not hold” 1, ")
    assert "“not decided” 1." in page.verdict and re.search(r"and \d+ are not tested\.$", page.verdict)


def test_what_failed_in_both_rows_says_nothing_and_a_failure_in_one_counts(tmp_path):
    dense(tmp_path, "deepsdf_official", [1.0] * 5 + [2.0])
    dense(tmp_path, "dist_mask_paper", [0.1] * 6, status="nan")
    (line,) = [line for line in page_of(tmp_path, "claims").lines if line["shapes"]]
    assert line["ratio"].value == inf and line["verdict"] == "does not hold"
    dense(tmp_path, "deepsdf_official", [1.0] * 6, status="nan", minute=30)
    assert not [line for line in page_of(tmp_path, "claims").lines if line["shapes"]]


def test_a_claim_is_not_tested_by_runs_of_other_settings_than_it_names(tmp_path):
    for preset, queries in {"dist_dynamic": 100, "dist_aggressive": 70}.items():
        for clamp in (None, 0.1) if preset == "dist_dynamic" else (None,):
            settings = {"renderer": {"step_clamp": clamp}, "view": {"resolution": 64}}
            about = {"renderer": preset, "settings": settings, "metrics": {"queries": queries}}
            write_run(tmp_path, "table1_large", preset, **about)
    (line,) = [
        line for line in page_of(tmp_path, "claims").lines if line["claim"].startswith("aggressive marching saves")
    ]
    assert (line["verdict"], line["why"]) == ("not tested", NO_RUNS)


def test_loss_and_error_are_compared_by_the_rank_correlation_of_each_run(tmp_path):
    for index in SHAPES:
        folder = write_run(tmp_path, "fig5", "dist_coarse_to_fine", renderer="dist_coarse_to_fine", index=index)
        write_curve(folder, [5, 4, 3, 2, 1], {0: 5.0, 1: 4.0, 2: 3.0, 3: 1.0, 4: 2.0} if index else {0: 1.0})
    (line,) = [line for line in page_of(tmp_path, "claims").lines if line["shapes"]]
    assert (line["shapes"], line["verdict"], line["why"]) == (5, "as claimed, 5 shapes", "")
    assert line["ratio"].value == pytest.approx(0.1)  # ρ is 0.9


def test_a_claim_is_not_tested_by_runs_that_are_only_planned(tmp_path):
    dense(tmp_path, "deepsdf_official", [1.0] * 6)
    dense(tmp_path, "dist_mask_paper", [2.0] * 6, status="not_run")
    assert not any(line["shapes"] for line in page_of(tmp_path, "claims").lines)


def marched(results, alpha, *, truncation, clamp, wrong, queries):
    for index in SHAPES:
        settings = {"renderer": {"alpha": alpha, "step_clamp": clamp}, "prior": {"truncation": truncation}}
        metrics = {"lost": wrong, "false": 0, "wrong": 0, "hits": 100, "queries": queries}
        write_run(results, "truncation", f"{alpha}", index=index, dataset="sofa", settings=settings, metrics=metrics)


def test_aggressive_marching_is_measured_over_plain_marching_of_distances(tmp_path):
    marched(tmp_path, 1.0, truncation=None, clamp=None, wrong=1, queries=1000)
    marched(tmp_path, 1.5, truncation=None, clamp=None, wrong=30, queries=700)
    marched(tmp_path, 1.0, truncation=None, clamp=0.1, wrong=1, queries=2000)
    marched(tmp_path, 1.5, truncation=None, clamp=0.1, wrong=1, queries=1400)
    marched(tmp_path, 1.0, truncation=0.1, clamp=0.1, wrong=1, queries=3000)
    marched(tmp_path, 1.5, truncation=0.1, clamp=0.1, wrong=2, queries=2100)
    page = page_of(tmp_path, "truncation")
    found = {(line["kind"], line["alpha"]): (line["wrong"], line["cost"]) for line in page.lines}
    assert found[(False, False), 1.5] == (0.3, 0.7)
    assert found[(True, True), 1.5] == (0.02, 2.1)
    assert "*30.0 %* on distances" in page.verdict and "0.70, 1.40 and 2.10." in page.verdict
    assert page.figure is not None


def test_each_change_is_divided_by_the_setting_that_it_changes(tmp_path):
    errors = {"deepsdf_truncated": 2.0, "as_printed_clamp": 3.0, "as_printed": 4.0, "default_k": 0.5, "dist_mask": 1.0}
    for method, error in errors.items():
        dense(tmp_path, method, [error] * 6, experiment="as_printed")
    for name, reference, expected in (
        ("as_printed", "the paper's setting", {"deepsdf_truncated": 0.5, "as_printed_clamp": 0.75, "dist_mask": 0.25}),
        ("as_default", "our default", {"deepsdf_truncated": 2.0, "default_k": 0.5}),
    ):
        page = page_of(tmp_path, name)
        ratios = {line["preset"]: line["ratio"].ratio.value for line in page.lines if line["ratio"]}
        assert ratios == pytest.approx(expected)
        assert f"Ratio to {reference}" in [column.heading for column in page.columns]
