"""The page of completions from a scanner's depths: pairs of runs that differ in their depths alone."""

import pytest

from bench.studies import scans
from tests.report.test_report_paper import page_of, write_run

DRAGON, BUNNY = "scans/dragon", "scans/bunny"


def made(results, depths, error, *, folder=DRAGON, status="ok", renderer="newton", **changed):
    """A run whose three errors are `error`, twice and three times that, in thousandths."""
    metrics = {name: place * error / 1000 for place, name in enumerate(scans.METRICS, 1)}
    return write_run(
        results, "scans", renderer, task="completion", dataset="scans", method="", renderer=renderer, status=status,
        metrics=metrics if status == "ok" else {}, **changed,
        settings={"task": {"depths": depths}, "dataset": {"path": folder}},
    )  # fmt: skip


def row(results) -> dict[str, str]:
    (line,) = page_of(results, "scans").table.to_dict("records")
    return line


def test_ratios_are_of_pairs_of_one_scan(tmp_path):
    for index, exact, measured in ((0, 1.0, 2.0), (1, 4.0, 2.0), (2, 9.0, 72.0)):
        made(tmp_path, "exact", exact, index=index)
        made(tmp_path, "measured", measured, index=index)
    made(tmp_path, "exact", 1000.0, index=3)  # without a partner
    line = row(tmp_path)
    assert (line["Chamfer, exact"], line["Chamfer, measured"]) == ("4.00", "2.00")  # medians
    assert line["Chamfer, ratio"] == "2.00"  # of 2, 1/2 and 8
    assert line["Depth error, exact"] == "12.0" and line["Truth to prediction, exact"] == "8.00"
    assert line["Failed"] == "0 of 7"


def test_scans_of_two_objects_are_not_mixed(tmp_path):
    for folder, exact, measured in ((DRAGON, 1.0, 2.0), (BUNNY, 100.0, 800.0)):
        made(tmp_path, "exact", exact, folder=folder)
        made(tmp_path, "measured", measured, folder=folder)
    assert row(tmp_path)["Depth error, ratio"] == "4.00"  # of 2 and 8


@pytest.mark.parametrize(
    ("status", "measured", "ratio", "failed"), [("diverged", "∞", "∞", "1 of 4"), ("refused", "2.00", "2.00", "0 of 3")]
)
def test_a_failure_is_infinite_and_a_refusal_does_not_count(tmp_path, status, measured, ratio, failed):
    made(tmp_path, "exact", 1.0)
    made(tmp_path, "measured", 2.0)
    made(tmp_path, "exact", 1.0, index=1)
    made(tmp_path, "measured", 2.0, index=1, status=status)
    line, result = row(tmp_path), page_of(tmp_path, "scans")
    assert (f": *{ratio}* (newton); n = " in result.verdict) is (status == "refused")
    assert (line["Chamfer, measured"], line["Chamfer, ratio"]) == (measured, ratio)
    assert line["Failed"] == failed
    assert status in result.data["status"].tolist()


def test_without_a_pair_there_is_no_ratio(tmp_path):
    made(tmp_path, "exact", 1.0)
    assert row(tmp_path)["Depth error, ratio"] == "–" and page_of(tmp_path, "scans").verdict == ""


def test_where_each_failed_alone_the_ratio_is_unknown_and_not_in_the_verdict(tmp_path):
    for index, depths in enumerate(("exact", "measured")):
        for other in ("exact", "measured"):
            made(tmp_path, other, 1.0, index=index, status="ok" if other == depths else "diverged")
            made(tmp_path, other, 2.0 if other == "exact" else 3.0, index=index, renderer="dist")
    assert [line["Depth error, ratio"] for line in page_of(tmp_path, "scans").table.to_dict("records")] == ["–", "1.50"]
    assert page_of(tmp_path, "scans").verdict.endswith(": *1.50* (dist); n = 2 scans of 1 object, without an interval.")
