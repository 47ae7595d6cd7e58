"""The pages on shapes from photographs, made from run folders whose numbers are known."""

import json

import numpy as np
import pytest
from bench.report.pages.images import dvr_figures, dvr_table2, photos, unseen_back
from bench.report.write.shapes import history, scene_of

from bench.records.read import read_records
from bench.report.data.experiments import choose
from bench.report.write.paper import write_paper
from tests.report.test_report_galleries import cells, notes
from tests.report.test_report_paper import told, write_run

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


def made(results, row, metrics, *, dataset="sofa", experiment="dvr_table2", index=0, seconds=2.0, **changed):
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
        settings={"task": {"_target_": task}, "dataset": where, "index": index},
    )


def curve(folder, *lines):
    """Writes a curve; a line is (seconds, values, metrics), with costs after its step and metrics before it."""
    found = [
        {"iteration": number, "seconds": seconds, "value_evaluations": values, "total": 1.0, **metrics}
        for number, (seconds, values, metrics) in enumerate(lines)
    ]
    (folder / "curve.jsonl").write_text("".join(json.dumps(line) + "\n" for line in found))


def chosen(results, page=dvr_table2):
    return choose(read_records(results)[0], page.READS[0], results)


def line_of(result, row):
    return result.table.set_index("Method").loc[row]


def test_a_line_has_the_medians_over_scenes_with_failed_runs_worst(tmp_path):
    for dataset, chamfer, psnr in (("sofa", 0.02, 20.0), ("car", 0.01, 24.0), ("plane", 0.04, 22.0)):
        made(tmp_path, NEWTON, scored(chamfer, psnr), dataset=dataset, seconds=100 * chamfer)
    for dataset, status in (("sofa", "ok"), ("car", "empty"), ("plane", "crashed")):
        metrics = scored(0.03, 30.0) if status == "ok" else scored(0.001, 40.0) if status == "empty" else {}
        made(tmp_path, IDR, metrics, dataset=dataset, status=status, seconds=8.0 if status == "ok" else 100.0)
    made(tmp_path, HULL, scored(0.05), seconds=0.5)
    result = dvr_table2.make(chosen(tmp_path))
    newton = line_of(result, NEWTON)
    names = ["Accuracy", "Completeness", "Chamfer-L1, seen", "all"]
    assert newton[names].tolist() == ["10.0", "30.0", "20.0", "60.0"]
    assert newton[["PSNR", "SSIM", "Mask IoU"]].tolist() == ["22.0", "0.220", "0.900"]
    assert newton[["Failed", "Loop", "Evaluations"]].tolist() == ["0 of 3", "2.00 s", "1.00k"]
    idr = line_of(result, IDR)
    assert idr[names].tolist() == ["∞"] * 4  # also of a failed run that has numbers
    assert idr[["PSNR", "SSIM", "Mask IoU"]].tolist() == ["0", "0", "0"]
    assert idr[["Failed", "Loop", "Evaluations"]].tolist() == ["2 of 3", "8.00 s", "1.00k"]  # of runs that ended
    hull = line_of(result, HULL)
    assert hull[["Chamfer-L1, seen", "Failed", "Loop", "Evaluations"]].tolist() == ["50.0", "0 of 1", "500 ms", "none"]
    assert len(result.data) == 7 and set(result.data["status"]) == {"ok", "empty", "crashed"}
    assert result.data["seen_chamfer_l1"].tolist()[:3] == [0.02, 0.01, 0.04]
    assert "2 of 7 runs did not end ok" in result.caption


def test_a_row_that_never_ended_ok_is_worst(tmp_path):
    made(tmp_path, NEWTON, scored(0.02))
    made(tmp_path, IDR, scored(np.inf, 5.0), status="empty")
    result = dvr_table2.make(chosen(tmp_path))
    assert line_of(result, IDR)[["Chamfer-L1, seen", "PSNR", "Failed"]].tolist() == ["∞", "0", "1 of 1"]
    assert line_of(result, IDR)[["Loop", "Evaluations"]].tolist() == ["–", "–"]


def test_published_lines_are_marked_and_cost_nothing_that_is_known(tmp_path):
    made(tmp_path, NEWTON, scored(0.02))
    result = dvr_table2.make(chosen(tmp_path))
    table = result.table.set_index("Method")
    assert list(table.index) == [NEWTON, *(f"published: {name}" for name in dvr_table2.PUBLISHED)]
    dvr = table.loc["published: DVR (RGB)"]
    assert dvr[["Accuracy", "Completeness", "Chamfer-L1, seen"]].tolist() == ["1.05", "0.760", "0.907"]
    published = table.iloc[1:]
    assert (published[["all", "PSNR", "SSIM", "Mask IoU", "Failed", "Loop", "Evaluations"]] == "–").all(axis=None)
    assert set(result.data["row"]) == {NEWTON}
    assert "cannot be compared directly" in told(result)


@pytest.mark.parametrize("name", dvr_table2.PUBLISHED)
def test_published_chamfer_is_the_mean_of_both_directions(name):
    """A wrong digit would stand out; published numbers are rounded."""
    accuracy, completeness, chamfer = dvr_table2.PUBLISHED[name]
    assert chamfer == pytest.approx((accuracy + completeness) / 2, abs=1.01e-3)


@pytest.mark.parametrize(("scenes", "words"), [(["sofa"], "over 1 scene of"), (["sofa", "car"], "over 2 scenes of")])
def test_the_figure_has_a_column_per_scene(tmp_path, scenes, words):
    for scene in scenes:
        for row, chamfer in ((NEWTON, 0.02), (HULL, 0.05)):
            folder = made(tmp_path, row, scored(chamfer), dataset=scene)
            if row == NEWTON:
                curve(folder, (1.0, 400, {"seen_chamfer_l1": 0.2}), (2.0, 1000, {"seen_chamfer_l1": 0.1}))
    result = dvr_table2.make(chosen(tmp_path))
    assert words in result.caption
    axes = result.figure.axes
    assert [axis.get_title() for axis in axes] == [*(f"{scene} 0" for scene in scenes), *[""] * len(scenes)]
    assert [axis.get_xlabel() for axis in axes] == ["seconds in the loop"] * len(scenes) + ["field values"] * len(
        scenes
    )
    for axis, costs in zip(axes, [[1.0, 2.0]] * len(scenes) + [[400, 1000]] * len(scenes), strict=True):
        drawn = {line.get_label(): line for line in axis.get_lines() if not line.get_label().startswith("_")}
        assert set(drawn) == {NEWTON, HULL}
        assert drawn[NEWTON].get_xdata().tolist() == costs  # the beginning, at no cost, is not on a logarithmic axis
        assert drawn[NEWTON].get_ydata() == pytest.approx([100.0, 20.0])
        assert list(drawn[HULL].get_ydata()) == [50.0, 50.0] and list(drawn[HULL].get_xdata()) == [0, 1]
        assert (axis.get_xscale(), axis.get_yscale()) == ("log", "log")
    (legend,) = result.figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [NEWTON, HULL]


def test_a_checkpoint_has_the_costs_of_the_line_before_it(tmp_path):
    folder = made(tmp_path, NEWTON, scored(0.02))
    lines = [
        (1.0, 400, {"seen_chamfer_l1": 0.5}),
        (2.0, 900, {}),
        (4.0, 1500, {"seen_chamfer_l1": 0.25}),
        (8.0, 3000, {}),
    ]
    curve(folder, *lines)
    experiment = chosen(tmp_path)
    found = history(experiment, experiment.records[0], "seen_chamfer_l1")
    assert found == [(0.0, 0.0, 0.5), (2.0, 900.0, 0.25), (8.0, 3000.0, 0.02)]  # the last one is the end's
    assert history(experiment, experiment.records[0], "unknown") == []
    (folder / "curve.jsonl").write_text("{broken\n" + (folder / "curve.jsonl").read_text())
    assert history(experiment, experiment.records[0], "seen_chamfer_l1") == found


def test_without_a_curve_there_is_the_end_alone(tmp_path):
    made(tmp_path, NEWTON, scored(0.02))
    made(tmp_path, IDR, {}, status="crashed", evaluations={"value": None})
    experiment = chosen(tmp_path)
    assert history(experiment, experiment.records[0], "seen_chamfer_l1") == [(0.0, 0.0, 0.02)]
    assert history(experiment, experiment.records[1], "seen_chamfer_l1") == []
    figure = dvr_table2.make(experiment).figure
    assert not any(axis.get_lines() for axis in figure.axes)


def test_a_failed_row_without_a_loop_has_no_level(tmp_path):
    made(tmp_path, HULL, scored(0.05))
    made(tmp_path, STEREO, scored(0.03), status="empty")
    for axis in dvr_table2.make(chosen(tmp_path)).figure.axes:
        assert [line.get_label() for line in axis.get_lines() if line.get_label()[0] != "_"] == [HULL]


def test_a_failed_run_has_no_end(tmp_path):
    folder = made(tmp_path, NEWTON, scored(np.inf), status="empty")
    curve(folder, (1.0, 400, {"seen_chamfer_l1": 0.5}), (2.0, 900, {"seen_chamfer_l1": 0.4}))
    experiment = chosen(tmp_path)
    found = history(experiment, experiment.records[0], "seen_chamfer_l1")
    assert found == [(0.0, 0.0, 0.5), (1.0, 400.0, 0.4)]


def photographed(results, row, metrics, **changed):
    return made(results, row, metrics, experiment="photos", dataset=changed.pop("dataset", FOLDER), **changed)


def test_photographs_need_no_chamfer(tmp_path):
    for dataset, psnr in ((FOLDER, 20.0), ("photographs/lamp", 26.0)):
        folder = photographed(tmp_path, NEWTON, PHOTO_SCORES | {"psnr": psnr}, dataset=dataset)
        curve(folder, (1.0, 400, {"psnr": 10.0}), (2.0, 1000, {"psnr": 15.0}))
        photographed(tmp_path, HULL, PHOTO_SCORES | {"psnr": 12.0}, dataset=dataset, seconds=0.5)
    result = photos.make(chosen(tmp_path, photos))
    heads = ["Method", "PSNR (dB)", "SSIM", "Mask IoU", "least", "Failed", "Loop", "Evaluations"]
    assert list(result.table.columns) == heads
    assert line_of(result, NEWTON).tolist() == ["23.0", "0.500", "0.900", "0.800", "0 of 2", "2.00 s", "1.00k"]
    assert line_of(result, HULL).tolist() == ["12.0", "0.500", "0.900", "0.800", "0 of 2", "500 ms", "none"]
    axes = result.figure.axes
    assert [axis.get_title() for axis in axes[:2]] == [FOLDER, "photographs/lamp"]
    assert all((axis.get_xscale(), axis.get_yscale()) == ("log", "linear") for axis in axes)
    drawn = {line.get_label(): line for line in axes[1].get_lines()}
    assert drawn[NEWTON].get_ydata().tolist() == [15.0, 26.0] and list(drawn[HULL].get_ydata()) == [12.0, 12.0]


def test_photographs_without_masks_have_no_overlap(tmp_path):
    photographed(tmp_path, NEWTON, {"psnr": 20.0, "ssim": 0.5})
    line = line_of(photos.make(chosen(tmp_path, photos)), NEWTON)
    assert line[["PSNR (dB)", "Mask IoU", "least"]].tolist() == ["20.0", "–", "–"]


def test_a_failed_run_is_worst_in_every_score_of_photographs(tmp_path):
    photographed(tmp_path, NEWTON, PHOTO_SCORES)
    photographed(tmp_path, IDR, PHOTO_SCORES, status="diverged")
    line = line_of(photos.make(chosen(tmp_path, photos)), IDR)
    assert line[["PSNR (dB)", "SSIM", "Mask IoU", "least"]].tolist() == ["0"] * 4


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
    result = dvr_figures.make(chosen(tmp_path, dvr_figures))
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
    result = dvr_figures.make(chosen(tmp_path, dvr_figures))
    assert list(shown(result.figure)) == ["sofa 0", "car 0"] and "The first 2 of 3 scenes." in result.caption
    assert notes(result.figure) == ["no run"] * 2


def test_of_rows_that_look_alike_one_is_shown(tmp_path):
    for row in (NEWTON, IDR, HULL):
        images(made(tmp_path, row, scored(0.02)), (1.0, 0.0, 0.0))
    result = dvr_figures.make(chosen(tmp_path, dvr_figures))
    assert {column for _, column in shown(result.figure)["sofa 0"]} == {"held out", NEWTON, HULL}
    assert set(result.data["row"]) == {NEWTON, IDR, HULL}


def test_shapes_of_one_family_are_scenes_of_their_own(tmp_path):
    for index, chamfer in ((0, 0.02), (1, 0.04)):
        made(tmp_path, NEWTON, scored(chamfer), index=index)
    experiment = chosen(tmp_path)
    assert [scene_of(record) for record in experiment.records] == ["sofa 0", "sofa 1"]
    assert line_of(dvr_table2.make(experiment), NEWTON)["Chamfer-L1, seen"] == "30.0"


def test_all_three_pages_are_written(tmp_path):
    for row in (NEWTON, HULL):
        images(made(tmp_path, row, scored(0.02)), (1.0, 0.0, 0.0))
        photographed(tmp_path, row, PHOTO_SCORES)
    write_paper(read_records(tmp_path)[0], tmp_path)
    for name in ("dvr_table2", "photos", "dvr_figures"):
        for suffix in (".md", ".csv", ".png"):
            assert (tmp_path / "paper" / f"{name}{suffix}").stat().st_size > 100
    text = (tmp_path / "paper" / "dvr_table2.md").read_text(encoding="utf-8")
    assert "Shape and colour from photographs." in text and "published: DVR (RGB)" in text


def test_the_side_that_no_photograph_shows_is_judged_and_drawn_from_behind(tmp_path):
    rough = {"seen_roughness": 1.0, "unseen_roughness": 6.0}
    for row, extra in ((NEWTON, {}), (NEUS, {"own_early_weight": 0.25})):
        folder = made(tmp_path, row, scored(0.02) | rough | extra, experiment="unseen_back")
        images(folder, (1.0, 0.0, 0.0))
        with np.load(folder / "images.npz") as file:
            arrays = dict(file)
        behind = {f"back_{name}": array for name, array in arrays.items() if name != "photograph"}
        behind["back_colours"] = np.full_like(arrays["colours"], 0.25)
        np.savez(folder / "images.npz", **arrays, **behind, back_truth=np.full_like(arrays["colours"], 0.75))
    result = unseen_back.make(chosen(tmp_path, unseen_back))
    assert line_of(result, NEUS)[["unseen", "Early weight"]].tolist() == ["6.00", "25 %"]
    assert line_of(result, NEWTON)["Early weight"] == "–"
    found = shown(result.figure)["sofa 0"]
    assert [column for row, column in found if row == "normals"] == ["truth", NEWTON, NEUS]
    assert found["normals", "truth"] == (0.75,) * 3 and found["colours", NEWTON] == (0.25,) * 3  # from behind
