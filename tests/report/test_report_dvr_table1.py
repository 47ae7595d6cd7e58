"""The page of shapes from one image: medians by family and row, and ratios to the mean shape."""

from itertools import product

import numpy as np
import pytest

from bench.records.read import read_records
from bench.report.write.paper import write_paper
from tests.report.test_report_galleries import cells, notes
from tests.report.test_report_paper import page_of, write_run
from tests.report.test_report_shapes import images

ROWS = {
    "RGB": "single_view",
    "Mean shape": "single_view_mean",
    "Nearest image": "single_view_nearest",
    "Depth": "single_view_depth",
    "Occupancy": "single_view_occupancy",
    "Longer": "single_view_dvr_long",
}


def made(results, row, chamfer, *, status="ok", **more):
    metrics = {"iou": 1 - chamfer, "chamfer_l1": chamfer / 10, "normal_consistency": 0.9, "mask_iou": 0.8, "psnr": 20.0}
    return write_run(
        results, "dvr_table1", row, task="single_view", method=ROWS[row], status=status,
        metrics=metrics if status == "ok" else {}, **{"renderer": "newton"} | more,
    )  # fmt: skip


def lines(results):
    table = page_of(results, "dvr_table1").table
    return {(line["Family"], line["Training"]): line for line in table.to_dict("records")}


def test_a_line_has_medians_costs_and_ratios_to_both_baselines_over_the_same_shapes(tmp_path):
    for index, (one, other, spent) in enumerate(((0.1, 0.4, 0.5), (0.2, 0.2, 0.7), (0.3, 0.6, 0.6))):
        made(tmp_path, "RGB", one, index=index, seconds={"forward": spent, "backward": 0.0, "training": 90.0})
        made(tmp_path, "Mean shape", other, index=index)
        made(tmp_path, "Nearest image", 2 * other, index=index)
    made(tmp_path, "RGB", 0.25, dataset="sofa")
    found = lines(tmp_path)
    rgb, mean = found["car", "RGB"], found["car", "Mean shape"]
    assert (rgb["IoU"], rgb["Chamfer-L1"], rgb["Failed"]) == ("0.800", "20.0", "0 of 3")
    assert (rgb["Training of a family"], rgb["Inference, with mesh"]) == ("90.0 s", "600 ms")
    assert (mean["Training of a family"], mean["Inference, with mesh"]) == ("–", "–")
    assert rgb["Over the mean shape"] == "0.500 (n = 3)"  # of 1/4, 1 and 1/2
    assert rgb["Over the nearest image"] == "0.250 (n = 3)"
    assert (mean["Over the mean shape"], mean["Over the nearest image"]) == ("", "0.500 (n = 3)")
    assert found["sofa", "RGB"]["Chamfer-L1"] == "25.0" and found["sofa", "RGB"]["Over the mean shape"] == ""
    assert found["car", "published: DVR, RGB"]["Published"] == "0.196"
    assert found["sofa", "published: DVR, depth"]["Published"] == "0.221"


def test_several_trainings_of_a_row_are_one_row(tmp_path):
    for seed, index in product(range(3), range(2)):
        made(tmp_path, "RGB", 0.1 * (1 + seed), index=index, seed=seed, settings={"task": {"training": {"seed": seed}}})
    made(tmp_path, "Mean shape", 0.4, index=0, settings={"task": {"training": {"seed": 0}}})
    rgb = lines(tmp_path)["car", "RGB"]
    assert (rgb["Chamfer-L1"], rgb["Failed"], rgb["Over the mean shape"]) == ("20.0", "0 of 6", "0.250 (n = 1)")


def test_a_verdict_counts_the_shapes_that_it_is_of(tmp_path):
    for index in range(5):
        made(tmp_path, "Mean shape", 0.3, index=index)
    for index, row in product(range(3), ("RGB", "Depth", "Occupancy")):
        made(tmp_path, row, 0.2, index=index, seconds={"forward": 1.0, "backward": 0.0, "training": 90.0})
    assert "n = 3 " in page_of(tmp_path, "dvr_table1").verdict


def test_a_failed_run_is_infinite_in_the_ratio(tmp_path):
    for index in range(3):
        made(tmp_path, "RGB", 0.3, index=index, status="ok" if index else "empty")
        made(tmp_path, "Mean shape", 0.2, index=index)
    rgb = lines(tmp_path)["car", "RGB"]
    assert (rgb["Over the mean shape"], rgb["Failed"]) == ("1.50 (n = 3)", "1 of 3")


def test_a_ratio_to_a_row_that_failed_alone_says_nothing(tmp_path):
    for index in range(2):
        made(tmp_path, "Mean shape", 0.2, index=index, status="ok" if index else "empty")
        made(tmp_path, "RGB", 0.3, index=index, status="empty" if index == 1 else "ok")
        made(tmp_path, "Nearest image", 0.1, index=index)
    found = lines(tmp_path)
    ratios = [found["car", row]["Over the mean shape"] for row in ("RGB", "Mean shape", "Nearest image")]
    assert ratios == ["– (n = 2)", "", "0 (n = 2)"]


def test_pictures_are_of_the_best_and_the_worst_shape(tmp_path):
    for index, chamfer in enumerate((0.3, 0.1, 0.4, 0.2)):
        folder = made(tmp_path, "RGB", chamfer, index=index)
        images(folder, (1.0, 0.0, 0.0))
        with np.load(folder / "images.npz") as file:
            np.savez(folder / "images.npz", **file, given=np.full((4, 4, 3), index / 4))
        made(tmp_path, "Mean shape", 0.5 - chamfer, index=index)
    result = page_of(tmp_path, "single_view_figures")
    found = cells(result.figure.axes[0])
    assert list(dict.fromkeys(row for row, _ in found)) == ["car 1, best", "car 2, worst"]
    assert found["car 1, best", "given"] == (0.25,) * 3 and found["car 2, worst", "given"] == (0.5,) * 3
    assert found["car 1, best", "another image"] == (0.75,) * 3 and found["car 1, best", "RGB"] == (0.5, 0.5, 1.0)
    assert notes(result.figure) == ["no picture"] * 2
    assert "No pictures of 2 runs: no images.npz." in result.shown().notes


def test_its_figure_has_a_point_for_each_shape(tmp_path):
    for index in range(3):
        made(tmp_path, "RGB", 0.1 * index, index=index)
    (axis,) = page_of(tmp_path, "dvr_table1").figure.axes
    points, middle = axis.get_lines()
    assert sorted(points.get_xdata()) == pytest.approx([0.8, 0.9, 1.0])
    assert list(middle.get_xdata()) == pytest.approx([0.9, 0.9])
    assert [label.get_text() for label in axis.get_yticklabels()] == ["RGB"]


@pytest.mark.usefixtures("undrawn")
def test_a_page_that_shows_none_of_the_runs_is_not_written(tmp_path):
    made(tmp_path, "RGB", 0.1)
    names = [path.stem for path in write_paper(read_records(tmp_path)[0], tmp_path, only="dvr_length")]
    assert "dvr_table1" in names and "dvr_length" not in names
    made(tmp_path, "Longer", 0.1)
    assert "dvr_length" in [path.stem for path in write_paper(read_records(tmp_path)[0], tmp_path, only="dvr_length")]
