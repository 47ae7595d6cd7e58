"""Questions and verdicts: those that are shipped, and that they are of the numbers in the CSV."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bench.records.read import read_records
from bench.report.write.answer import Ranked, excluding, ranked
from bench.report.write.caption import SMOKE
from bench.report.write.chart import panel_data, series
from bench.report.write.paper import write_paper
from bench.report.write.result import Shown, read_shown
from tests.report.test_report_paper import costs, write_run

PAPER = Path(__file__).parents[2] / "results" / "paper"
WITHOUT = {
    "single_view_figures",
    "dvr_figures",
    "completion_gallery",
    "misplaced_gallery",
    "multiview_gallery",
    "rerendering",
}
CHARTS = {"stability_curves"}  # pages whose answer is a chart alone


@pytest.mark.parametrize("name", sorted(path.stem for path in PAPER.glob("*.json")))
def test_every_shipped_page_has_a_question_and_a_verdict_with_a_number(name):
    shown = read_shown(PAPER / f"{name}.json")
    assert shown.title.endswith(".") and shown.caption and (shown.rows or shown.drawn or shown.chart)
    assert all(len(row) == len(shown.columns) for row in shown.rows)
    if name in WITHOUT or (name in CHARTS and shown.chart):
        return
    assert shown.question.endswith("?") and shown.verdict.endswith(".")
    marked = shown.verdict.split("*")[1::2]
    assert marked and all(any(c.isdigit() for c in part) for part in marked) and shown.verdict.count("*") % 2 == 0
    assert "nan" not in shown.verdict and len(shown.verdict) < 400


def runs(*lines: tuple) -> pd.DataFrame:
    return pd.DataFrame(lines, columns=["family", "index", "row", "status", "error"])


def test_a_row_is_ranked_by_its_median_in_which_a_failure_is_the_worst():
    good = [("sofa", n, "good", "ok", 2.0) for n in range(3)]
    lucky = [("sofa", 0, "lucky", "ok", 1.0), *(("sofa", n, "lucky", "nan", 1.0) for n in (1, 2))]
    fewer = [("sofa", 0, "fewer", "ok", 0.1)]
    found = ranked(runs(*good, *lucky, *fewer), "error")
    assert found == Ranked([("good", 2.0), ("lucky", np.inf)], 3)
    assert found.said("error") == "The lowest median error: *2.00* (good), then ∞ (lucky); n = 3 shapes."
    assert ranked(runs(*good, *lucky), "error", better="higher").rows[0] == ("good", 2.0)


def test_nothing_is_said_of_one_row_or_where_all_failed():
    failed = [("sofa", n, row, "nan", 1.0) for n in range(2) for row in ("a", "b")]
    assert ranked(runs(*failed), "error").said("error") == ""
    assert Ranked([("alone", 1.0)], 1).said("error") == ""


def test_ratios_whose_interval_excludes_one_are_counted():
    data = pd.DataFrame(
        {"a_low": [0.5, 1.1, np.nan], "a_high": [0.9, 1.3, np.nan], "b_low": [0.9] * 3, "b_high": [1.2] * 3}
    )
    assert excluding(data, ["a", "b"]) == (2, 5)


def test_an_axis_is_logarithmic_where_its_values_are_positive_and_spread():
    made = panel_data("", "x", "y", [series("a", "dist", [1, 100], [0, 5])])
    assert made["x"] == {"title": "x", "log": True} and made["y"] == {"title": "y", "log": False}
    assert made["series"][0]["colour"] == "#0072b2"


def test_a_verdict_of_scale_smoke_is_that_nothing_follows(tmp_path):
    for label in ("quick", "slow"):
        write_run(tmp_path, "table1", label, metrics=costs(), settings={"scale": {"name": "smoke"}})
    write_paper(read_records(tmp_path)[0], tmp_path)
    shown = read_shown(tmp_path / "paper" / "table1.json")
    assert shown.verdict == SMOKE and shown.question.endswith("?") and shown.experiments == ["table1"]


@pytest.mark.parametrize("text", ["", "[1]", '{"verdict": 1, "chart": []}', "[" * 100_000])
def test_an_odd_file_beside_a_table_adds_nothing(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    assert read_shown(tmp_path / "a.json") == Shown()
