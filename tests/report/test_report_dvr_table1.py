"""The page of shapes from one image: medians by family and row, and ratios to the mean shape."""

from itertools import product

import numpy as np
import pytest

from tests.report.test_report_galleries import cells, notes
from tests.report.test_report_paper import page_of, write_run
from tests.report.test_report_shapes import images

ROWS = {
    "RGB": "single_view",
    "Mean shape": "single_view_mean",
    "Nearest image": "single_view_nearest",
    "Newton": "single_view_by_newton",
    "IDR": "single_view_by_idr",
}


def made(results, row, chamfer, *, status="ok", experiment="dvr_table1", **more):
    metrics = {"iou": 1 - chamfer, "chamfer_l1": chamfer / 10, "normal_consistency": 0.9, "mask_iou": 0.8, "psnr": 20.0}
    return write_run(
        results, experiment, row, task="single_view", method=ROWS[row], status=status,
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
    assert (rgb["Trained in"], rgb["Inference"]) == ("90.0 s", "600 ms")
    assert (mean["Trained in"], mean["Inference"]) == ("–", "–")
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


def test_renderers_that_teach_are_compared_with_newton_and_with_retrieval(tmp_path):
    teaches = {"experiment": "single_view_renderers"}
    for index in range(3):
        cost = {"evaluations": {"training": 2e6}, "seconds": {"forward": 1.0, "backward": 0.0, "training": 90.0}}
        made(tmp_path, "Newton", 0.2, index=index, **teaches, **cost)
        made(tmp_path, "IDR", 0.3, index=index, **teaches, status="ok" if index else "empty")
        made(tmp_path, "Nearest image", 0.1, index=index, **teaches)
    table = page_of(tmp_path, "single_view_renderers").table.set_index("Renderer")
    assert table.loc["Newton", ["Trained in", "Field values"]].tolist() == ["90.0 s", "2.00M"]
    assert table.loc["Newton", "Over the nearest image"] == "2.00 (n = 3)"
    assert table["Over Newton"].tolist() == ["", "1.50 (n = 3)", "0.500 (n = 3)"]
    assert table.loc["IDR", "Failed"] == "1 of 3"


def test_the_verdict_on_renderers_that_teach_is_per_family(tmp_path):
    for index in range(3):
        for family, factor in (("car", 1.5), ("sofa", 0.5)):
            more = {"index": index, "dataset": family, "experiment": "single_view_renderers"}
            made(tmp_path, "Mean shape", 0.01, **more, renderer="dist")
            made(tmp_path, "IDR", 0.2 * factor, **more, renderer="idr")
            if index == 0 and family == "car":
                assert page_of(tmp_path, "single_view_renderers").verdict == ""  # without a row of Newton
            made(tmp_path, "Newton", 0.2, **more)
    verdict = page_of(tmp_path, "single_view_renderers").verdict
    assert "car: *1.50* (IDR); n = 3 unseen shapes. " in verdict and "sofa: *0.500* (IDR); n = 3" in verdict


@pytest.mark.parametrize("study", ["dvr_table1", "single_view_renderers"])
def test_a_verdict_counts_the_shapes_that_it_is_of(tmp_path, study):
    for index in range(5):
        made(tmp_path, "Mean shape", 0.3, index=index, experiment=study)
    for index, row in product(range(3), ("RGB", "Newton", "IDR")):
        seconds = {"forward": 1.0, "backward": 0.0, "training": 90.0}
        made(tmp_path, row, 0.2, index=index, experiment=study, seconds=seconds)
    assert "n = 3 " in page_of(tmp_path, study).verdict


def test_a_ratio_to_a_row_that_failed_alone_says_nothing(tmp_path):
    for index in range(2):
        more = {"index": index, "experiment": "single_view_renderers"}
        made(tmp_path, "Newton", 0.2, **more, status="ok" if index else "empty")
        made(tmp_path, "IDR", 0.3, **more, status="empty" if index == 1 else "ok")
        made(tmp_path, "Nearest image", 0.1, **more)
    result = page_of(tmp_path, "single_view_renderers")
    assert result.verdict == "" and result.table["Over Newton"].tolist() == ["", "– (n = 2)", "0 (n = 2)"]


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
