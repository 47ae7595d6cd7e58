"""Questions and verdicts: each page's from the committed results, and that they are of the numbers in its CSV."""

import json
import shutil
from importlib import import_module
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bench.report.pages.completion import crossing_gaps, scans, table2
from bench.report.pages.rendering import fig7, table1
from bench.report.pages.speed import speed
from bench.report.pages.stability import stability
from bench.report.site.papers import papers, read_shown
from bench.report.write.answer import Ranked, answered, chart_panel, excluding, ranked, series, write_answers
from bench.report.write.paper import SMOKE, page_names

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


@pytest.mark.parametrize("name", sorted(set(page_names()) - WITHOUT))
def test_every_committed_table_has_a_question_and_a_verdict_with_a_number(name):
    module, function = page_names()[name]
    answer = getattr(import_module(f"bench.report.pages.{module}"), function.replace("make", "answer"))
    if not (PAPER / f"{name}.csv").is_file():
        pytest.skip(f"results/paper has no {name}.csv")
    found = answered(answer, PAPER / name)
    if name in CHARTS:
        assert found.chart
        return
    assert found.question.endswith("?") and found.verdict.endswith(".")
    marked = found.verdict.split("*")[1::2]
    assert marked and all(any(c.isdigit() for c in part) for part in marked) and found.verdict.count("*") % 2 == 0
    assert "nan" not in found.verdict and len(found.verdict) < 400


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


def committed(name: str) -> pd.DataFrame:
    return pd.read_csv(PAPER / f"{name}.csv")


def test_verdicts_are_of_the_numbers_of_the_csv():
    costs = pd.DataFrame({"row": list("abc"), "status": ["ok", "ok", "timeout"], "step_s": [4.0, 2.0, 1.0]})
    assert table1.answer(costs, []).verdict.startswith("A step takes *2.00 s* with b and 4.00 s with a; 1 of 3 rows")
    ends = {"own_low": 1.5, "own_high": 2.5, "renderer": 0.5, "loss": 4.0}
    gaps = pd.DataFrame(
        [{"compared": "b over a", "family": f, "own": x, **ends} for f, x in (("all families", 2.0), ("car", 9.0))]
    )
    verdict = crossing_gaps.answer(gaps, []).verdict
    assert verdict == "b over a: *2.00* [1.50, 2.50] times the error; of it the renderer 0.500, the loss 4.00."
    shares = {"epsilon": [0.1, 0.01, 0.001], "status": ["ok", "ok", "nan"], "lost_share": [0.0, 0.01, 0.0]}
    verdict = fig7.answer(pd.DataFrame(shares | {"false_share": [0.2, 0.01, 0.0]}), []).verdict
    assert "epsilon = 0.01: *2 %*" in verdict and "at 0.1 they are 20 %" in verdict


def won(row: str, other: str, probability: float) -> dict:
    return {"family": "all families", "row": row, "other": other, "probability": probability, "shapes": 8}


def test_a_method_that_does_not_beat_all_others_is_not_said_to():
    beats = [won("a", "b", 0.7), won("a", "c", 0.6), won("b", "a", 0.3), won("b", "c", 0.9), won("c", "a", 0.4)]
    verdict = table2.answer_wins(pd.DataFrame([*beats, won("c", "b", 0.1)]), []).verdict
    assert verdict.startswith("a has the lower error than every other on most pairs; at least *60 %*, against c")
    circle = [won("a", "b", 0.6), won("a", "c", 0.4), won("b", "a", 0.4), won("c", "a", 0.6)]
    circle += [won("b", "c", 0.7), won("c", "b", 0.3)]
    assert table2.answer_wins(pd.DataFrame(circle), []).verdict.startswith(
        "No method has the lower error than every other"
    )


def scanned(*lines: tuple) -> pd.DataFrame:
    return pd.DataFrame(lines, columns=["row", "index", "depths", "status", "depth_mae"]).assign(seed=0)


def test_ratios_of_scans_are_over_those_that_both_have_and_a_failure_is_infinite():
    pairs = [("a", n, depths, "ok", x) for n in (0, 1) for depths, x in (("measured", 2.0), ("exact", 1.0))]
    pairs += [("b", 0, "measured", "ok", 1.0), ("b", 0, "exact", "ok", 1.0), ("b", 1, "measured", "ok", 9.0)]
    assert "*1.00* (b) to *2.00* (a)" in scans.answer(scanned(*pairs), []).verdict
    failed = [("a", 0, "measured", "nan", 2.0), *pairs[1:]]
    assert "*1.00* (b) to *∞* (a)" in scans.answer(scanned(*failed), []).verdict


def test_the_atlas_has_a_cell_for_each_run_and_the_front_a_point_for_each_setting():
    data = committed("stability")
    atlas = stability.answer(data, []).atlas
    cells = [cell for line in atlas["cells"] for cell in line if cell]
    assert len(cells) == len(data) and {cell["folder"] for cell in cells} == set(data["folder"])
    assert {cell["short"] for cell in cells if cell["shade"] == 0} == {"at once"}
    data = committed("speed_front")
    panels = speed.answer_front(data, []).chart["panels"]
    finite = np.isfinite(data["seconds"]) & np.isfinite(data["error"])
    points = [x for panel in panels for each in panel["series"] if each["name"] != "front" for x in each["x"]]
    assert len(points) == finite.sum()


def test_an_axis_is_logarithmic_where_its_values_are_positive_and_spread():
    made = chart_panel("", "x", "y", [series("a", "dist", [1, 100], [0, 5])])
    assert made["x"] == {"title": "x", "log": True} and made["y"] == {"title": "y", "log": False}
    assert made["series"][0]["colour"] == "#0072b2"


def test_a_csv_that_cannot_be_read_is_named_and_has_no_verdict(tmp_path):
    paper = tmp_path / "paper"
    paper.mkdir()
    (paper / "table1.csv").write_text("a,b\n1,2\n")
    (paper / "table1.json").write_text('{"verdict": "an older one"}')
    (paper / "fig7.csv").write_text("")
    problems = write_answers(tmp_path)
    assert [problem.split()[0] for problem in problems] == ["paper/table1.csv", "paper/fig7.csv"]
    assert not (paper / "table1.json").exists()


def test_a_verdict_of_scale_smoke_is_that_nothing_follows(tmp_path):
    paper = tmp_path / "paper"
    paper.mkdir()
    shutil.copy(PAPER / "table1.csv", paper)
    (paper / "table1.md").write_text(f"**Costs.** {SMOKE} What is plotted.\n")
    assert write_answers(tmp_path) == []
    assert papers(tmp_path)[0][0]["verdict"] == SMOKE
    assert read_shown(paper / "table1.json")["verdict"].startswith("A step takes")


@pytest.mark.parametrize("text", ["", "[1]", '{"verdict": 1, "chart": []}', "[" * 100_000])
def test_an_odd_file_beside_a_table_adds_nothing(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    assert read_shown(tmp_path / "a.json") == {}


def test_the_same_csv_gives_the_same_file(tmp_path):
    (tmp_path / "paper").mkdir()
    shutil.copy(PAPER / "fig7.csv", tmp_path / "paper")
    write_answers(tmp_path)
    first = (tmp_path / "paper" / "fig7.json").read_bytes()
    write_answers(tmp_path)
    assert (tmp_path / "paper" / "fig7.json").read_bytes() == first and json.loads(first)["question"]
