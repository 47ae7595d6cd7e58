"""Questions and verdicts: those that are shipped, and that they are of the numbers in the CSV."""

from pathlib import Path

import pytest

from bench.records.read import read_records
from bench.report.write.caption import SMOKE
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
