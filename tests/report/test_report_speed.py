"""Speed against accuracy, made from run folders whose numbers are known."""

import json
import math

import numpy as np
import pandas as pd
import pytest

from bench.studies import speed_curves
from tests.report.test_report_paper import page_of, told, write_curve, write_run


def completed(results, label, errors, **changed):
    """A completion whose looks have these errors x 1000, at 1, 2, 3, ... seconds; the last is that of its end."""
    steps = len(errors) - 1
    folder = write_run(
        results,
        "speed_completion",
        label,
        task="completion",
        dataset="sofa",
        metrics={"chamfer_l2": errors[-1] / 1000},
        seconds={"forward": 0.75 * steps, "backward": 0.25 * steps},
        evaluations={"value": 100 * steps},
        settings={"task": {"points": "50"}, "renderer": {"steps": 50}, "split": "test"},
        **{"notes": []} | changed,
    )
    seen = {i: error / 1000 for i, error in enumerate(errors[:-1])}
    write_curve(folder, [5.0 - i for i in seen], seen, seconds=1.0)
    return folder


def rendered(results, label, seconds, error, *, size=64, queries=1000, **changed):
    """A rendering."""
    metrics = {"forward_seconds": seconds, "error_p95": error, "queries": queries}
    settings = {"view": {"resolution": size}, "split": "train"}
    known = {"task": "ablation", "dataset": "sofa", "metrics": metrics, "settings": settings}
    write_run(results, "speed_rendering", label, **known, **changed)


@pytest.fixture
def three(tmp_path):
    """A fast one, a good one, and one that is worse than both in everything; a fourth fails on two shapes of three."""
    for index in range(3):
        completed(tmp_path, "fast", [9, 6 + index], index=index)
        completed(tmp_path, "good", [9, 5, 3, 0.5 + index / 10], index=index)
        completed(tmp_path, "bad", [9, 8, 8, 8, 8], index=index)
        completed(tmp_path, "broken", [9, 1], index=index, status="ok" if index == 0 else "nan", renderer="idr")
    return tmp_path


def test_the_front_is_of_those_that_none_beats_and_the_others_stay(three):
    page = page_of(three, "speed_front")
    data = page.data.set_index("setting")
    assert data["dominated"].to_dict() == {"fast": False, "good": False, "bad": True, "broken": True}
    chance = 7 / 27  # that at least two of three draws are the shape that it did not fail on; then it beats "fast"
    expected = {"fast": 1 - chance, "good": 1.0, "bad": 0.0, "broken": chance}
    assert data["on_front"].to_dict() == pytest.approx(expected, abs=0.03)
    assert data.loc["good", ["seconds", "error"]].tolist() == pytest.approx([3.0, 0.6])
    assert data.loc["broken", ["failed", "runs"]].tolist() == [2, 3] and math.isinf(data.loc["broken", "error"])
    ends = "*1.00 s* for an error × 1000 of 7.00 (fast) to *3.00 s* for an error × 1000 of 0.600 (good)."
    assert "2 of 4 settings are on this front, 1 of them in 90 %" in page.verdict
    assert page.verdict.endswith("; n = 3 shapes.") and f": {ends}" in page.verdict


def test_dominated_points_are_hollow_and_the_front_is_numbered(three):
    axis = page_of(three, "speed_front").figure.axes[0]
    drawn = {line.get_markerfacecolor() == "none": line for line in axis.lines if line.get_label() == "fast"}
    solid, hollow = ([*zip(*drawn[each].get_data(), strict=True)] for each in (False, True))
    assert solid == [(1.0, 7.0), (3.0, 0.6)] and hollow == [(4.0, 8.0)]  # the infinite one is in the table alone
    assert {text.get_text(): text.xy for text in axis.texts} == {"1": (1.0, 7.0), "2": pytest.approx((3.0, 0.6))}
    assert [text.get_text()[:6] for text in axis.get_legend().get_texts()] == ["1 fast", "2 good"]


def test_one_draw_has_no_probability(tmp_path):
    for label, errors in (("fast", [9, 6]), ("good", [9, 5, 1])):
        completed(tmp_path, label, errors)
    result = page_of(tmp_path, "speed_front")
    assert result.table["P(on the front)"].tolist() == ["–", "–"]
    assert result.data["on_front"].isna().all() and result.data["error_low"].isna().all()
    assert "One shape and one seed are one draw" in told(result)
    assert [text.get_text() for text in result.figure.axes[0].get_legend().get_texts()] == ["1 fast", "2 good"]


def test_equal_settings_have_equal_rows_whatever_noise_their_times_have(tmp_path):
    for index, (mine, other) in enumerate(((1.0, 1.2), (1.5, 1.1), (1.0, 1.4))):
        rendered(tmp_path, "dist", mine, 0.01 + index / 1000, index=index)
        rendered(tmp_path, "dist, K 3", other, 0.01 + index / 1000, index=index)
        rendered(tmp_path, "dist, 20 steps", 0.9, 0.03, index=index, queries=500)
    data = page_of(tmp_path, "speed_front").data.set_index("setting")
    columns = ["seconds", "error", "evaluations", "on_front", "dominated"]
    assert data.loc["dist", columns].tolist() == data.loc["dist, K 3", columns].tolist()
    assert data.loc["dist", "seconds"] == pytest.approx(1.2)  # of 1.1, 1.3 and 1.2, the shapes' medians
    assert data.loc["dist", "on_front"] == 1.0 and data.loc["dist, 20 steps", "seconds"] == 0.9


def test_the_charts_of_the_page_have_the_numbers_and_lead_to_the_runs(three):
    page = page_of(three, "speed_front")
    shown = [x for series in page.chart["panels"][0]["series"] if series["name"] != "front" for x in series["x"]]
    assert sorted(shown) == sorted(page.data["seconds"][np.isfinite(page.data["seconds"].astype(float))])
    page = page_of(three, "speed_curves")
    curves = page.chart["panels"][0]["series"]
    line = next(series for series in curves if series["name"] == "good")
    assert line["y"] == [5, 3, 0.6] and "3.00 s" in line["text"][-1][-1] and line["link"][0].endswith("q=good")


def test_a_look_costs_what_was_spent_before_it(three):
    data = page_of(three, "speed_curves").data
    good = data[(data["row"] == "good") & (data["index"] == 0)]
    assert good["error"].tolist() == [9, 5, 3, 0.5]
    assert good["seconds"].tolist() == [0, 1, 2, 3]
    assert good["value_evaluations"].tolist() == [0, 100, 200, 300]
    assert good["loss"].tolist()[:3] == [5, 4, 3] and math.isnan(good["loss"].iloc[3])


def test_the_time_to_the_target_is_infinite_for_what_did_not_reach_it(three):
    assert speed_curves.TARGET_ERROR == 1e-3
    page = page_of(three, "speed_curves")
    table = page.table.set_index("Setting")
    assert table.loc["good"].tolist() == ["3", "3", "3.00 s", "1.00"]
    assert table.loc["bad"].tolist() == ["3", "0", "∞", "0.775"]  # the last is the rank correlation of loss and error
    assert table.loc["broken"].tolist() == ["3", "1", "∞", "–"]  # failed runs did not, whatever they scored
    assert page.verdict.endswith("*3.00 s* (good); n = 3 runs per setting; 1 of 4 settings reach it in most runs.")


def test_the_time_to_the_target_is_that_of_the_first_checkpoint_there():
    history = pd.DataFrame({"seconds": [0.0, 1.0, 2.0], "error": [9.0, 1.0, 0.5]})
    assert speed_curves.time_to(history, {"status": "ok"}) == 1.0


def test_where_every_median_is_infinite_the_figure_is_drawn_and_there_is_no_verdict(tmp_path):
    for index in range(3):
        completed(tmp_path, "dist", [9, 8], index=index, status="nan")
    page = page_of(tmp_path, "speed_curves")
    page.figure.draw_without_rendering()
    assert page.verdict == ""


def test_a_missing_run_is_told_and_counts_as_infinite(tmp_path):
    for index in range(2):
        completed(tmp_path, "dist", [9, 1], index=index)
    completed(tmp_path, "idr", [9, 1], renderer="idr")
    row = page_of(tmp_path, "speed_front").table.set_index("Setting").loc["idr"]
    assert row["Failed"] == "0 of 1, 1 missing"
    assert (row["Time"], row["Error × 1000"], row["Field evaluations"]) == ("∞", "∞", "∞")


def test_a_cost_that_is_not_a_number_is_infinite(tmp_path):
    folder = completed(tmp_path, "dist", [9, 1])
    record = json.loads((folder / "record.json").read_text())
    record["seconds"]["forward"] = math.nan
    (folder / "record.json").write_text(json.dumps(record))
    assert math.isinf(page_of(tmp_path, "speed_front").data["seconds"].iloc[0])


def test_a_validation_shape_is_not_taken_for_a_test_shape(tmp_path):
    completed(tmp_path, "dist", [9, 1])
    settings = {"index": 0, "task": {"points": "50"}, "renderer": {"steps": 50}, "split": "validation"}
    write_run(tmp_path, "speed_completion", "dist", task="completion", dataset="sofa", metrics={"chamfer_l2": 9},
              settings=settings, minute=0)  # fmt: skip
    result = page_of(tmp_path, "speed_front")
    assert result.data["error"].tolist() == [1.0]
    assert "Not shown: 1 run" in told(result)


def test_renderings_of_another_size_are_not_compared(tmp_path):
    rendered(tmp_path, "dist", 1.0, 0.01)
    rendered(tmp_path, "dist, 20 steps", 0.5, 0.02)
    rendered(tmp_path, "dist, half", 0.1, 0.001, size=32)
    rendered(tmp_path, "dist", 1.0, 0.01)
    result = page_of(tmp_path, "speed_front")
    assert "Not shown: 2 runs of " in told(result)
    assert result.data["setting"].tolist() == ["dist", "dist, 20 steps"]
    assert result.data["dominated"].tolist() == [False, False]
    assert result.data["evaluations"].tolist() == [1000, 1000]


def test_a_run_that_left_no_curve_is_a_row_all_the_same(tmp_path):
    completed(tmp_path, "dist", [9, 5, 1])
    folder = completed(tmp_path, "idr", [9, 5, 1], status="timeout", renderer="idr")
    (folder / "curve.jsonl").unlink()
    for name in ("speed_front", "speed_curves"):
        assert "idr" in page_of(tmp_path, name).table.to_string()


@pytest.mark.parametrize(("loaded", "axes"), [(5, ["time (seconds)", "field evaluations"]), (6, ["field evaluations"])])
def test_where_half_of_the_times_are_doubtful_a_chart_shows_field_values_alone(three, loaded, axes):
    for folder in sorted((three / "runs").iterdir())[:loaded]:  # of twelve
        record = json.loads((folder / "record.json").read_text())
        (folder / "record.json").write_text(json.dumps(record | {"notes": ["loaded machine: it waited"]}))
    panels = page_of(three, "speed_curves").chart["panels"]
    assert [panel["x"]["title"] for panel in panels] == axes
