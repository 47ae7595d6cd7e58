"""Table 2 and the priors' page, made from run folders whose numbers are known."""

import math

import numpy as np
import pytest

from bench.report import compare
from tests.report.test_report_paper import page_of, told, write_run

REFERENCE, OTHER = "DIST with mask", "Naive with mask"


def completed(results, label, chamfer, **changed):
    """A run of Table 2; `points` as named."""
    points, task, failed = changed.pop("points", "100"), changed.pop("task", "completion"), chamfer is None
    return write_run(
        results,
        "table2",
        label,
        **{"task": task, "dataset": "sofa", "status": "diverged" if failed else "ok"} | changed,
        metrics={} if failed else {"chamfer_l2": chamfer / 1000},
        settings={"task": {"points": points, "_target_": task}},
    )


def cell(result, method, column):
    row = result.table[result.table["Method"] == method]
    return row[column].iloc[0]


def test_a_cell_is_the_median_over_shapes_and_a_failure_is_infinite(tmp_path):
    for index, value in enumerate((1.0, 2.0, 4.0)):
        completed(tmp_path, REFERENCE, value, index=index)
    for index, value in enumerate((1.0, None, None)):
        completed(tmp_path, OTHER, value, index=index)
    result = page_of(tmp_path, "table2")
    assert cell(result, REFERENCE, "100 pts") == "2.00"
    assert cell(result, OTHER, "100 pts") == "∞"
    assert cell(result, REFERENCE, "Failed") == "0 of 3"
    assert cell(result, OTHER, "Failed") == "2 of 3"
    assert len(result.data) == 6  # no run disappears
    assert f"2 of 6 runs did not end ok: {OTHER}, 100 points, shape 1: diverged" in result.caption


def test_columns_stand_as_in_the_paper_and_published_numbers_are_marked(tmp_path):
    for points in ("7", "20", "10%", "dense"):
        completed(tmp_path, REFERENCE, 1.0, points=points)
    result = page_of(tmp_path, "table2")
    assert list(result.table.columns) == [
        *(
            "Family",
            "Method",
            "dense",
            "10%",
            "20 pts",
            "7 pts",
            "Median over shapes",
            "Ratio to DIST with mask",
            "Failed",
        )
    ]
    assert cell(result, "published: DIST with mask", "20 pts") == "4.94"
    assert cell(result, "published: DeepSDF", "dense") == "5.37"
    assert cell(result, "published: DIST", "7 pts") == "–"
    assert "do not compare with the measured ones" in told(result)


def test_another_setting_of_the_shared_parts_is_told(tmp_path):
    completed(tmp_path, REFERENCE, 1.0)
    write_run(
        tmp_path, "table2", OTHER, task="completion", dataset="sofa", settings={"view": {"resolution": 8}}, minute=0
    )
    assert "Runs differ in view.resolution: do not compare rows " in told(page_of(tmp_path, "table2"))


@pytest.mark.parametrize("odd", [{"renderer": {"epsilon": 1.0}}, {"silhouette": {"weight": 9}}, {"task": {"code": 1}}])
def test_another_setting_under_the_same_name_is_no_part_of_the_row(tmp_path, odd):
    for index in range(3):
        completed(tmp_path, REFERENCE, 2.0, index=index, minute=10 + index)
    task = {"points": "100", "_target_": "completion"} | odd.get("task", {})
    run = {"task": "completion", "dataset": "sofa", "metrics": {"chamfer_l2": 1}, "settings": odd | {"task": task}}
    write_run(tmp_path, "table2", REFERENCE, minute=1, **run)
    result = page_of(tmp_path, "table2")
    assert cell(result, REFERENCE, "100 pts") == "2.00" and "Not shown: 1 run" in told(result)
    write_run(tmp_path, "table2", REFERENCE, minute=50, **run)
    assert cell(page_of(tmp_path, "table2"), REFERENCE, "Failed") == "0 of 1"  # the newest setting, alone


def test_families_and_both_tasks_share_a_table(tmp_path):
    completed(tmp_path, REFERENCE, 1.0)
    completed(tmp_path, "DeepSDF samples", 2.0, task="deepsdf")
    task = {"points": "100", "_target_": "completion"}
    folder = {"task": task, "dataset": {"path": "/some/where/chairs"}}
    write_run(
        tmp_path, "table2", REFERENCE, task="completion", dataset="mesh", metrics={"chamfer_l2": 0.005}, settings=folder
    )
    table = page_of(tmp_path, "table2").table
    own = table[~table["Method"].str.startswith("published") & (table["Family"] != "all families")]
    assert own[["Family", "Method", "100 pts"]].to_numpy().tolist() == [
        ["sofa", REFERENCE, "1.00"],
        ["sofa", "DeepSDF samples", "2.00"],
        ["where/chairs", REFERENCE, "5.00"],
        ["where/chairs", "DeepSDF samples", "–"],
    ]


def test_a_class_of_shapenet_has_the_published_numbers_of_its_family(tmp_path):
    settings = {"task": {"points": "20", "_target_": "completion"}}
    settings["dataset"] = {"path": "/some/where/ShapeNetCore.v2", "synset": "sofa"}
    run = {"task": "completion", "dataset": "shapenet", "metrics": {"chamfer_l2": 0.005}, "settings": settings}
    write_run(tmp_path, "table2", REFERENCE, **run)
    result = page_of(tmp_path, "table2")
    assert cell(result, REFERENCE, "20 pts") == "5.00" and set(result.table["Family"]) == {"shapenet_sofa"}
    assert cell(result, "published: DIST with mask", "20 pts") == "4.94"


def test_captions_name_what_varies_and_a_try_at_smoke(tmp_path):
    def caption(results=tmp_path):
        return page_of(results, "table2").caption

    def write(index, seed, results=tmp_path, **more):
        settings = {"task": {"points": "100", "_target_": "completion"}, **more}
        write_run(results, "table2", REFERENCE, task="completion", dataset="sofa", metrics={"chamfer_l2": 0.001},
                  settings=settings, index=index, seed=seed)  # fmt: skip

    write(0, 0)
    assert "Median error over one shape for each" in caption()
    write(0, 1)
    assert "Median error over seeds of one shape for each" in caption()
    write(1, 0)
    assert "Median error over shapes and seeds for each" in caption()
    assert "do not interpret" not in caption()
    write(0, 0, scale={"name": "smoke"})
    assert "do not interpret" not in caption()  # it has runs of a larger scale
    write(0, 0, tmp_path / "tries", scale={"name": "smoke"})
    tried = caption(tmp_path / "tries")
    assert tried.startswith("Made at scale=smoke, to try things out: do not interpret these numbers.")
    assert "Median error over one shape for each" in tried


def test_the_oracle_is_of_all_of_the_tables_shapes(tmp_path):
    for index in (3, 4):
        completed(tmp_path, REFERENCE, 1.0, index=index)
    fitted(tmp_path, 0.25, index=3)
    assert compare.ORACLE not in page_of(tmp_path, "table2").table["Method"].tolist()
    for index, value in ((4, 0.75), (5, 9.0)):
        fitted(tmp_path, value, index=index)
    assert cell(page_of(tmp_path, "table2"), compare.ORACLE, "100 pts") == "0.500"


@pytest.mark.parametrize("changed", [{"evaluation": {"grid": 8}}, {"split": "validation"}, {"prior": {"shapes": 1}}])
def test_an_oracle_that_was_judged_otherwise_is_not_shown(tmp_path, changed):
    completed(tmp_path, REFERENCE, 1.0)
    fitted(tmp_path, 0.1, settings=changed)
    assert compare.ORACLE not in page_of(tmp_path, "table2").table["Method"].tolist()


def test_the_figure_has_a_panel_a_family_and_a_line_a_row(tmp_path):
    for points in ("dense", "20"):
        completed(tmp_path, REFERENCE, 1.0, points=points)
        completed(tmp_path, OTHER, None, points=points)
    fitted(tmp_path, 0.2)
    figure = page_of(tmp_path, "table2").figure
    (axis,) = [axis for axis in figure.axes if axis.axison]
    lines = {line.get_label(): line.get_ydata() for line in axis.lines}
    assert list(lines[REFERENCE]) == [1.0, 1.0]
    assert all(math.isnan(y) for y in lines[OTHER])
    assert lines["1.5 times the oracle"][0] == pytest.approx(0.3)
    assert axis.get_title() == "sofa"


def fitted(results, chamfer, **changed):
    """A run of the experiment of priors."""
    metrics = {"chamfer_l2": chamfer / 1000, "floor_chamfer_l2": 2e-4, "slope_median": 0.98, "slope_p99": 1.2}
    metrics["distance_error"] = 1e-3
    return write_run(results, "priors", None, task="prior_fit", dataset="sofa", metrics=metrics, **changed)


def test_a_prior_is_shown_beside_its_floor(tmp_path):
    for index, value in enumerate((0.2, 0.24, 0.5)):
        folder = fitted(tmp_path, value, index=index)
    normals, hit = np.zeros((8, 8, 3)), np.ones((8, 8), dtype=bool)
    images = {"normals": normals, "reference_normals": normals, "hit": hit, "reference_hit": hit}
    np.savez(folder / "images.npz", **images)
    result = page_of(tmp_path, "priors")
    row = result.table.iloc[0]
    assert (row["Fit"], row["Floor"], row["Fit / floor"], row["largest"]) == ("0.240", "0.200", "1.20", "2.50")
    assert row["|gradient|"] == "0.980"
    (axis,) = result.figure.axes
    titles = [label.get_text().replace("\n", " ") for label in axis.get_xticklabels()]
    assert titles == ["truth", "fit: 1.00 × floor", "truth", "fit: 1.20 × floor", "truth", "fit: 2.50 × floor"]
    assert result.data["ratio"].tolist() == pytest.approx([1.0, 1.2, 2.5])
