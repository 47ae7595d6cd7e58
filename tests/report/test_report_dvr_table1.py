"""The page of shapes from one image: medians by family and row, and ratios to the mean shape."""

import pytest

from bench.records.read import read_records
from bench.report.data.experiments import choose
from bench.report.pages import dvr_table1
from tests.report.test_report_paper import write_run

ROWS = {"RGB": "single_view", "Mean shape": "single_view_mean"}


def made(results, row, chamfer, *, dataset="car", index=0, status="ok"):
    metrics = {"iou": 1 - chamfer, "chamfer_l1": chamfer / 10, "normal_consistency": 0.9, "mask_iou": 0.8, "psnr": 20.0}
    return write_run(
        results, "dvr_table1", row, task="single_view", dataset=dataset, method=ROWS[row], renderer="newton",
        status=status, metrics=metrics if status == "ok" else {},
        settings={"dataset": {"name": dataset}, "index": index},
    )  # fmt: skip


def lines(results):
    table = dvr_table1.make(choose(read_records(results)[0], dvr_table1.READS[0], results)).table
    return {(line["Family"], line["Training"]): line for line in table.to_dict("records")}


def test_a_line_has_medians_and_the_ratio_to_the_mean_shape_over_the_same_shapes(tmp_path):
    for index, (one, mean) in enumerate(((0.1, 0.4), (0.2, 0.2), (0.3, 0.6))):
        made(tmp_path, "RGB", one, index=index)
        made(tmp_path, "Mean shape", mean, index=index)
    made(tmp_path, "RGB", 0.25, dataset="sofa")
    found = lines(tmp_path)
    rgb = found["car", "RGB"]
    assert (rgb["IoU"], rgb["Chamfer-L1"], rgb["Failed"]) == ("0.800", "20.0", "0 of 3")
    assert rgb["Over the mean shape"] == "0.500 (n = 3)"  # of 1/4, 1 and 1/2
    assert found["car", "Mean shape"]["Over the mean shape"] == ""
    assert found["sofa", "RGB"]["Chamfer-L1"] == "25.0" and found["sofa", "RGB"]["Over the mean shape"] == ""
    assert found["car", "published: DVR, RGB"]["Published"] == "0.196"
    assert found["sofa", "published: DVR, depth"]["Published"] == "0.221"


@pytest.mark.parametrize("status", ["crashed", "empty"])
def test_a_failed_run_is_the_worst(tmp_path, status):
    for index in range(2):
        made(tmp_path, "RGB", 0.1, index=index, status=status)
    made(tmp_path, "RGB", 0.1, index=2)
    line = lines(tmp_path)["car", "RGB"]
    assert (line["IoU"], line["Chamfer-L1"], line["Failed"]) == ("0", "∞", "2 of 3")


def test_its_figure_has_a_point_for_each_shape(tmp_path):
    for index in range(3):
        made(tmp_path, "RGB", 0.1 * index, index=index)
    (axis,) = dvr_table1.make(choose(read_records(tmp_path)[0], dvr_table1.READS[0], tmp_path)).figure.axes
    points, middle = axis.get_lines()
    assert sorted(points.get_ydata()) == pytest.approx([0.8, 0.9, 1.0])
    assert list(middle.get_ydata()) == pytest.approx([0.9, 0.9])
    assert [label.get_text() for label in axis.get_xticklabels()] == ["RGB"]
