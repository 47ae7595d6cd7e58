"""The pages on shapes from photographs, made from run folders whose numbers are known."""

import numpy as np
import pytest

from bench.records.published import DVR_TABLE2
from bench.records.read import read_records
from bench.report.data.runs import choose
from bench.report.medians import scene_of
from bench.studies import dvr_table2
from tests.looped import each
from tests.report.test_report_galleries import cells, notes
from tests.report.test_report_paper import page_of, told, write_run

NEWTON, IDR, NEUS, HULL, STEREO = "Newton, RGB", "IDR, RGB", "NeuS, RGB", "Visual hull", "Stereo, Poisson"
POISSON = "Depth, Poisson"
METHODS = {NEWTON: "rgb_newton", IDR: "rgb_idr", NEUS: "rgb_neus", HULL: "hull", STEREO: "stereo", POISSON: "poisson"}
TASKS = {HULL: "hull", STEREO: "stereo", POISSON: "poisson"}
LEVELS = (HULL, STEREO)  # rows without a loop
FOLDER = "photographs/chair"


def scored(chamfer: float, psnr: float = 20.0) -> dict[str, float]:
    """Metrics of a run with that Chamfer-L1 of what is seen."""
    seen = {f"seen_{name}": factor * chamfer for name, factor in FACTORS.items()}
    overlap = {"mask_iou": 0.9, "mask_iou_least": 0.8}
    return {**seen, "chamfer_l1": 3 * chamfer, "psnr": psnr, "ssim": psnr / 100, **overlap}


FACTORS = {"accuracy": 0.5, "completeness": 1.5, "chamfer_l1": 1.0}
PHOTO_SCORES = {"psnr": 20.0, "ssim": 0.5, "mask_iou": 0.9, "mask_iou_least": 0.8}


def made(results, row, metrics, *, dataset="sofa", experiment="dvr_table2", seconds=2.0, **changed):
    """A run of a row; it costs 1000 field values unless it has no loop."""
    task = TASKS.get(row, "reconstruction")
    values = 0 if row in LEVELS else 1000
    where = {"path": dataset} if "/" in dataset else {"name": dataset}
    evaluations = {"value": values, "gradient": values // 2} | changed.pop("evaluations", {})
    return write_run(
        results,
        experiment,
        row,
        **{"task": task, "dataset": "photos" if "/" in dataset else dataset, "method": METHODS[row]} | changed,
        metrics=metrics,
        evaluations=evaluations,
        seconds={"forward": 0.75 * seconds, "backward": 0.25 * seconds},
        settings={"task": {"_target_": task}, "dataset": where},
    )


def chosen(results, page=dvr_table2):
    return choose(read_records(results)[0], page.READS[0], results)


def line_of(result, row):
    return result.table.set_index("Method").loc[row]


def test_a_note_on_equal_settings_is_that_of_the_records(tmp_path):
    for row, rate, field in ((NEWTON, 0.01, "prior"), (IDR, 0.004, "prior"), (NEUS, 0.01, "auto")):
        task = {"_target_": "reconstruction", "optimiser": {"iterations": 400, "learning_rate": rate}}
        settings = {"task": task, "field": field}
        write_run(tmp_path, "dvr_table2", row, task="reconstruction", metrics=scored(0.01), settings=settings)
    made(tmp_path, HULL, scored(0.05))  # without an optimiser
    note = next(note for note in page_of(tmp_path, "dvr_table2").notes if "Rows share" in note)
    assert note == "Rows share: iterations 400. Rows differ in: field (auto, prior), learning rate (0.004, 0.01)."


def test_a_line_has_the_medians_over_scenes_with_failed_runs_worst(tmp_path):
    for dataset, chamfer, psnr in (("sofa", 0.02, 20.0), ("car", 0.01, 24.0), ("plane", 0.04, 22.0)):
        made(tmp_path, NEWTON, scored(chamfer, psnr), dataset=dataset, seconds=100 * chamfer)
    for dataset, status in (("sofa", "ok"), ("car", "empty"), ("plane", "crashed")):
        metrics = scored(0.03, 30.0) if status == "ok" else scored(0.001, 40.0) if status == "empty" else {}
        made(tmp_path, IDR, metrics, dataset=dataset, status=status, seconds=8.0 if status == "ok" else 100.0)
    made(tmp_path, HULL, scored(0.05), seconds=0.5)
    result = page_of(tmp_path, "dvr_table2")
    newton = line_of(result, NEWTON)
    names = ["Accuracy", "Completeness", "Chamfer-L1, seen", "all"]
    assert newton[names].tolist() == ["10.0", "30.0", "20.0", "60.0"]
    assert newton[["PSNR", "SSIM", "Mask IoU"]].tolist() == ["22.0", "0.220", "0.900"]
    assert newton[["Failed", "Runtime", "Field evaluations"]].tolist() == ["0 of 3", "2.00 s", "1.00k"]
    idr = line_of(result, IDR)
    assert idr[names].tolist() == ["∞"] * 4  # also of a failed run that has numbers
    assert idr[["PSNR", "SSIM", "Mask IoU"]].tolist() == ["0", "0", "0"]
    assert idr[["Failed", "Runtime", "Field evaluations"]].tolist() == [
        "2 of 3",
        "8.00 s",
        "1.00k",
    ]  # of runs that ended
    hull = line_of(result, HULL)
    assert hull[["Chamfer-L1, seen", "Failed", "Runtime", "Field evaluations"]].tolist() == [
        "50.0",
        "0 of 1",
        "500 ms",
        "none",
    ]
    assert len(result.data) == 7 and set(result.data["status"]) == {"ok", "empty", "crashed"}
    assert result.data["seen_chamfer_l1"].tolist()[:3] == [0.02, 0.01, 0.04]
    assert "2 of 7 runs did not end ok" in result.shown().caption


def test_published_lines_are_marked_and_cost_nothing_that_is_known(tmp_path):
    made(tmp_path, NEWTON, scored(0.02))
    result = page_of(tmp_path, "dvr_table2")
    table = result.table.set_index("Method")
    assert list(table.index) == [NEWTON, *(f"published: {name}" for name in DVR_TABLE2)]
    dvr = table.loc["published: DVR (RGB)"]
    assert dvr[["Accuracy", "Completeness", "Chamfer-L1, seen"]].tolist() == ["1.05", "0.760", "0.907"]
    published = table.iloc[1:]
    assert (published[["all", "PSNR", "SSIM", "Mask IoU", "Failed", "Runtime", "Field evaluations"]] == "–").all(
        axis=None
    )
    assert set(result.data["row"]) == {NEWTON}
    assert "cannot be compared directly" in told(result)


@each("name", [*DVR_TABLE2])
def test_published_chamfer_is_the_mean_of_both_directions(name):
    """A wrong digit would stand out; published numbers are rounded."""
    accuracy, completeness, chamfer = DVR_TABLE2[name]
    assert chamfer == pytest.approx((accuracy + completeness) / 2, abs=1.01e-3)


@pytest.mark.parametrize(("scenes", "words"), [(["sofa"], "over 1 scene on"), (["sofa", "car"], "over 2 scenes on")])
def test_the_figure_has_a_line_per_row_with_a_point_per_scene_and_their_median(tmp_path, scenes, words):
    for place, scene in enumerate(scenes):
        made(tmp_path, NEWTON, scored(0.02 + 0.02 * place), dataset=scene, seconds=3.0)
        made(tmp_path, IDR, scored(0.02), dataset=scene, status="ok" if place else "empty")
    result = page_of(tmp_path, "dvr_table2")
    assert words in result.shown().caption
    errors, seconds = result.figure.axes
    assert [label.get_text() for label in errors.get_yticklabels()] == [NEWTON, IDR]
    newton, *middle, idr, lost = [line.get_xdata().tolist() for line in errors.get_lines()]
    assert newton == pytest.approx([20, 40][: len(scenes)])
    assert middle == ([pytest.approx([30, 30])] if len(scenes) > 1 else [])
    assert len(idr) == len(scenes) - 1 and lost == pytest.approx([2 * max(newton)])  # a failed run is at the edge
    assert seconds.get_lines()[0].get_xdata().tolist() == [3.0] * len(scenes)


def test_the_figure_is_in_the_order_of_the_error_and_shows_the_field_evaluations_of_rows_that_have_any(tmp_path):
    for row, error in ((HULL, 0.03), (IDR, 0.04), (NEWTON, 0.02)):
        made(tmp_path, row, scored(error), notes=["loaded machine: it waited"])
    errors, evaluations = page_of(tmp_path, "dvr_table2").figure.axes
    assert [label.get_text() for label in errors.get_yticklabels()] == [NEWTON, HULL, IDR]
    assert "evaluations" in evaluations.get_xlabel()
    points = [line.get_xydata().tolist() for line in evaluations.get_lines()]
    assert points == [[[1000, 0]], [], [[1000, 2]]]


def photographed(results, row, metrics, **changed):
    return made(results, row, metrics, experiment="photos", dataset=changed.pop("dataset", FOLDER), **changed)


def test_photographs_need_no_chamfer(tmp_path):
    for dataset, psnr in ((FOLDER, 20.0), ("photographs/lamp", 26.0)):
        photographed(tmp_path, NEWTON, PHOTO_SCORES | {"psnr": psnr}, dataset=dataset)
        photographed(tmp_path, HULL, PHOTO_SCORES | {"psnr": 12.0}, dataset=dataset, seconds=0.5)
    result = page_of(tmp_path, "photos")
    heads = ["Method", "PSNR (dB)", "SSIM", "Mask IoU", "least", "Failed", "Runtime", "Field evaluations"]
    assert list(result.table.columns) == heads
    assert line_of(result, NEWTON).tolist() == ["23.0", "0.500", "0.900", "0.800", "0 of 2", "2.00 s", "1.00k"]
    assert line_of(result, HULL).tolist() == ["12.0", "0.500", "0.900", "0.800", "0 of 2", "500 ms", "none"]
    axis = result.figure.axes[0]
    assert axis.get_lines()[0].get_xdata().tolist() == [20.0, 26.0] and axis.get_xscale() == "linear"
    assert result.verdict.endswith(": *23.0* (Newton, RGB) to 12.0 (Visual hull); n = 2 folders.")


def test_photographs_with_a_truth_have_its_errors(tmp_path):
    photographed(tmp_path, NEWTON, PHOTO_SCORES | {"dtu_accuracy": 1.5, "dtu_completeness": 2.5, "dtu_overall": 2.0})
    photographed(tmp_path, HULL, {}, status="empty")
    table = page_of(tmp_path, "photos").table
    assert [*table.columns][1:5] == ["Accuracy (mm)", "Completeness (mm)", "Chamfer-L1 (mm)", "PSNR (dB)"]
    assert table.iloc[0, 1:4].tolist() == ["1.50", "2.50", "2.00"] and table.iloc[1, 1] == "∞"


def test_photographs_without_masks_have_no_overlap(tmp_path):
    photographed(tmp_path, NEWTON, {"psnr": 20.0, "ssim": 0.5})
    line = line_of(page_of(tmp_path, "photos"), NEWTON)
    assert line[["PSNR (dB)", "Mask IoU", "least"]].tolist() == ["20.0", "–", "–"]


def images(folder, colour, size=8, **left_out):
    """Pictures of a square in one colour, whose photograph is grey."""
    hit = np.zeros((size, size), dtype=bool)
    hit[2:6, 2:6] = True
    arrays = {
        "photograph": np.full((size, size, 3), 0.75, np.float16),
        "colours": (np.array(colour) * hit[..., None]).astype(np.float16),
        "normals": (np.array([0.0, 0.0, 1.0]) * hit[..., None]).astype(np.float16),
        "hit": hit,
    }
    np.savez(folder / "images.npz", **{name: array for name, array in arrays.items() if name not in left_out})


def shown(figure):
    """What each block shows by the name of its scene."""
    return {axis.get_title(loc="left"): cells(axis) for axis in figure.axes}


def test_pictures_stand_above_their_normals_and_missing_ones_are_noted(tmp_path):
    images(made(tmp_path, NEWTON, scored(0.02)), (1.0, 0.0, 0.0))
    made(tmp_path, NEUS, scored(0.03))
    images(made(tmp_path, HULL, scored(0.05), status="empty"), (0.0, 1.0, 0.0))
    images(made(tmp_path, POISSON, scored(0.05)), (0.0, 1.0, 0.0), normals=None)
    result = page_of(tmp_path, "dvr_figures")
    found = shown(result.figure)["sofa 0"]
    assert [column for row, column in found if row == "colours"] == ["held out", NEWTON, NEUS, HULL, POISSON]
    assert found["colours", NEWTON] == (1, 0, 0) and found["colours", HULL] == (0, 1, 0)
    assert found["colours", "held out"] == (0.75, 0.75, 0.75)
    assert found["normals", NEWTON] == found["normals", HULL] == (0.5, 0.5, 1.0)
    assert sorted(notes(result.figure)) == ["empty"] * 2 + ["no picture"] * 4
    assert "No pictures of 1 run: no images.npz." in told(result)
    assert "No pictures of 1 run: images.npz lacks an array: normals" in told(result)


def test_two_scenes_are_shown_and_a_row_without_a_run_is_noted(tmp_path):
    for scene in ("sofa", "car", "plane"):
        images(made(tmp_path, NEWTON, scored(0.02), dataset=scene), (1.0, 0.0, 0.0))
    images(made(tmp_path, HULL, scored(0.05), dataset="car"), (0.0, 1.0, 0.0))
    result = page_of(tmp_path, "dvr_figures")
    assert list(shown(result.figure)) == ["sofa 0", "car 0"] and "of 2 of 3 scenes" in result.shown().caption
    assert notes(result.figure) == ["no run"] * 2


def test_of_rows_that_look_alike_one_is_shown(tmp_path):
    for row in (NEWTON, IDR, HULL):
        images(made(tmp_path, row, scored(0.02)), (1.0, 0.0, 0.0))
    result = page_of(tmp_path, "dvr_figures")
    assert {column for _, column in shown(result.figure)["sofa 0"]} == {"held out", NEWTON, HULL}
    assert set(result.data["row"]) == {NEWTON, IDR, HULL}


def test_shapes_of_one_family_are_scenes_of_their_own(tmp_path):
    for index, chamfer in ((0, 0.02), (1, 0.04)):
        made(tmp_path, NEWTON, scored(chamfer), index=index)
    experiment = chosen(tmp_path)
    assert [scene_of(record) for record in experiment.records] == ["sofa 0", "sofa 1"]
    assert line_of(dvr_table2.make(experiment), NEWTON)["Chamfer-L1, seen"] == "30.0"
