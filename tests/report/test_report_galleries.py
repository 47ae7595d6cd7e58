"""The galleries, from run folders whose pictures are known."""

import numpy as np
import pytest

from bench.report.gallery import Block, Cell, draw
from bench.studies import fig8
from tests.report.test_report_paper import page_of, told, write_run

UP, RIGHT, TOWARDS = (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
COLOURS = {normal: tuple(np.array(normal) / 2 + 0.5) for normal in (UP, RIGHT, TOWARDS)}
NAMES = {"DeepSDF samples": "deepsdf", "DIST": "dist_depth", "DIST with mask": "dist_mask", "IDR with mask": "idr_mask"}
SQUARE = np.zeros((8, 8), dtype=bool)
SQUARE[2:6, 2:6] = True


def saved(folder, found):
    """Writes squares with one normal each; None is a shape that nothing shows."""
    arrays = {"given": np.where(SQUARE, 2.0, np.nan).astype(np.float16)}
    for name, normal in (("found", found), ("start", RIGHT), ("true", TOWARDS)):
        hit = np.stack([SQUARE, SQUARE]) & (normal is not None)
        arrays |= {f"{name}_hit": hit, f"{name}_normals": (hit[..., None] * np.array(normal or UP)).astype(np.float16)}
    np.savez(folder / "images.npz", **arrays)


def completed(results, row, points, found=UP, *, pictures=True, **changed):
    task = "deepsdf" if row.startswith("DeepSDF") else "completion"
    known = {"task": task, "method": NAMES[row], "dataset": "sofa", "settings": {"task": {"points": points}}}
    folder = write_run(results, "table2", row, **known | changed)
    if pictures:
        saved(folder, found)


def many_views(results, experiment, row, found, *, index=0, status="ok", **task):
    folder = write_run(
        results,
        experiment,
        row,
        **{"task": "multiview", "status": status, "method": f"multiview_{row[:4].lower()}"},
        index=index,
        settings={"task": {"shift": 0.0, "degrees": 0.0, "scale": 1.0, **task}},
    )
    saved(folder, found)


def cells(axis, across=1):
    """The colour in the middle of the first picture of each cell; white without one; the names of rows and columns."""
    rows = [label.get_text().replace("\n", " ") for label in axis.get_yticklabels()]
    columns = [label.get_text().replace("\n", " ") for label in axis.get_xticklabels()]
    found = {(row, column): (1.0, 1.0, 1.0) for row in rows for column in columns}
    for image in reversed(axis.get_images()):
        box = axis.transData.inverted().transform_bbox(image.get_clip_box())
        (x, y), (left, right, bottom, top) = (box.p0 + box.p1) / 2, image.get_extent()
        picture = image.get_array()
        place = (int((y - top) / (bottom - top) * len(picture)), int((x - left) / (right - left) * picture.shape[1]))
        found[rows[int(y)], columns[int(x // across)]] = tuple(picture[place].tolist())
    return found


def notes(figure):
    return [text.get_text() for axis in figure.axes for text in axis.texts if text.get_text()]


def test_completed_shapes_stand_over_the_points_with_the_truth_behind(tmp_path):
    for row, normal in (("DeepSDF samples", UP), ("DIST", RIGHT), ("DIST with mask", UP), ("IDR with mask", UP)):
        for points in ("dense", "20"):
            completed(tmp_path, row, points, found=normal)
    result = page_of(tmp_path, "completion_gallery")
    found = cells(result.figure.axes[0], across=2)
    assert [column for row, column in found if row == "DIST"] == ["dense", "20 pts", "truth"]
    assert list(dict.fromkeys(row for row, _ in found)) == ["given depths", *list(NAMES)[:3]]
    assert found["DIST", "20 pts"] == COLOURS[RIGHT] and found["DIST with mask", "dense"] == COLOURS[UP]
    assert found["given depths", "truth"] == COLOURS[TOWARDS] and found["DIST", "truth"] == (1, 1, 1)
    assert notes(result.figure) == [] and "No pictures" not in told(result)
    assert "n = 6 runs (1 shape, 1 seed)" in result.caption and len(result.data) == 6


def test_the_first_shape_of_each_family_and_the_first_seed_are_shown(tmp_path):
    for dataset in ("sofa", "plane"):
        for index in (3, 1):
            for seed in (1, 0):
                completed(tmp_path, "DIST", "20", dataset=dataset, index=index, seed=seed)
    result = page_of(tmp_path, "completion_gallery")
    assert [axis.get_title(loc="left") for axis in result.figure.axes] == ["sofa", "plane"]
    assert result.data[["index", "seed"]].to_numpy().tolist() == [[1, 0], [1, 0]]
    assert "Not shown: 6 runs" in told(result)


def test_a_run_that_failed_is_shown_as_such_with_its_picture_or_without(tmp_path):
    completed(tmp_path, "DeepSDF samples", "20")
    completed(tmp_path, "DIST", "20", status="not_reached", found=RIGHT)
    completed(tmp_path, "DIST with mask", "20", status="crashed", pictures=False)
    completed(tmp_path, "DIST with mask", "50", status="empty", found=None)
    completed(tmp_path, "DIST", "50", pictures=False)
    result = page_of(tmp_path, "completion_gallery")
    assert sorted(notes(result.figure)) == sorted(["not_reached", "crashed", "empty", "no picture", "no run"])
    assert cells(result.figure.axes[0], across=2)["DIST", "20 pts"] == COLOURS[RIGHT]
    assert "3 of 5 runs did not end ok" in result.caption
    assert "No pictures of 2 runs: no images.npz." in told(result)


def test_shapes_from_many_views_stand_beside_the_truth_and_the_start(tmp_path):
    for index in range(6):
        many_views(tmp_path, "table3", "DIST", UP, index=index)
        many_views(tmp_path, "table3", "Mesh, 48³", RIGHT, index=index, status="ok" if index else "diverged")
    result = page_of(tmp_path, "multiview_gallery")
    found = cells(result.figure.axes[0])
    assert list(dict.fromkeys(row for row, _ in found)) == [f"car {index}" for index in range(4)]
    assert [found["car 0", column] for column in ("truth", "start", "DIST", "Mesh, 48³")] == [
        COLOURS[normal] for normal in (TOWARDS, RIGHT, UP, RIGHT)
    ]
    assert notes(result.figure) == ["diverged"]
    assert "n = 8 runs (4 shapes, 1 seed)" in result.caption


def test_misplaced_shapes_stand_over_the_displacement(tmp_path):
    for task in ({"degrees": 20.0}, {}, {"similarity": True}, {"shift": 0.1}, {"scale": 0.8}):
        many_views(tmp_path, "fig12", "DIST", UP if task else RIGHT, **task)
    result = page_of(tmp_path, "misplaced_gallery")
    found = cells(result.figure.axes[0])
    columns = [column for row, column in found if row == "DIST"]
    assert columns == ["0.8 times as large", "in place", "known place", "turned by 20°", "shifted by 0.1", "truth"]
    assert [found["DIST", column] for column in columns[:3]] == [COLOURS[UP], COLOURS[UP], COLOURS[RIGHT]]
    assert {found["start", column] for column in columns[:-1]} == {COLOURS[RIGHT]}
    assert found["start", "truth"] == COLOURS[TOWARDS]


def rendered(results, split, *, dataset="sofa", status="ok", kinds=()):
    folder = write_run(
        results,
        "fig8",
        "DIST, one colour image",
        **{"task": "completion", "dataset": dataset, "method": "dist_colour", "status": status},
        **({"metrics": dict(zip(fig8.SIZES, (256, 3000, 500, 9000), strict=True))} if kinds else {}),
        settings={"task": {"_target_": "completion"}, "split": split},
    )
    arrays = {"photograph": np.ones((8, 8, 3), np.float16)}
    for prefix, length in (("size_0_", 2), ("size_1_", 4), ("size_2_", 8), ("turned_0_", 8), ("turned_1_", 8)):
        for kind, shade in kinds:
            hit, name = np.ones((length, length), dtype=bool), kind + prefix
            arrays |= {f"{name}hit": hit, f"{name}colours": np.full((length, length, 3), shade, np.float16)}
            arrays[f"{name}normals"] = np.broadcast_to(np.array(RIGHT, np.float16), (length, length, 3))
    if kinds:
        np.savez(folder / "images.npz", **arrays)


def test_codes_of_shape_and_colour_are_shown_beside_the_mesh_and_its_bytes(tmp_path):
    rendered(tmp_path, "train", kinds=(("", 0.8), ("trained_", 0.6), ("true_", 0.4)))
    rendered(tmp_path, "test", kinds=(("", 0.8), ("true_", 0.4)))
    rendered(tmp_path, "test", dataset="car", status="crashed")
    result = page_of(tmp_path, "rerendering")
    known, unseen, failed = (cells(axis) for axis in result.figure.axes)
    assert {row for row, _ in known} == {"mesh", "code of training", "code of the image"}
    assert {row for row, _ in unseen} == {"mesh", "code of the image"}
    sizes, lights = list(fig8.SIDES), list(fig8.LIGHTS)
    assert [column for row, column in known if row == "mesh"] == ["given", *sizes, *lights]
    for row, shade in (("mesh", 0.4), ("code of training", 0.6), ("code of the image", 0.8)):
        assert all(known[row, column] == pytest.approx((shade,) * 3, abs=1e-3) for column in sizes)
    left, above, right = (known["code of the image", name][0] for name in lights)
    assert left == pytest.approx(above) == pytest.approx(0.8 * fig8.AMBIENT, abs=1e-3)  # normals to the right
    cosine = 0.8 / np.sqrt(0.8**2 + 0.3**2 + 0.5**2)
    assert right == pytest.approx(0.8 * (fig8.AMBIENT + (1 - fig8.AMBIENT) * cosine), abs=1e-3)
    assert set(notes(result.figure)) == {"crashed"} and failed
    assert "A code has 256 bytes" in result.verdict and "mesh and texture 4 kB" in result.verdict
    assert "No pictures of 1 run: no images.npz." in told(result)
    assert "1 of 3 runs did not end ok" in result.caption


def test_a_picture_fills_its_cell_with_the_part_in_the_window_and_is_cut_there():
    picture = np.arange(16.0).reshape(4, 4, 1).repeat(3, axis=2) / 16
    axis = draw([Block("", ["a", "b"], {"c": [Cell(), Cell([(picture, (0.25, 0.5, 0.5))])]})]).axes[0]
    (image,) = axis.get_images()
    assert image.get_extent() == [0.0, 2.0, 1.5, -0.5]  # the pixels at rows 1 and 2, columns 2 and 3, fill x 1 to 2
    box = axis.transData.inverted().transform_bbox(image.get_clip_box())
    assert [box.x0, box.x1, *sorted((box.y0, box.y1))] == pytest.approx([1, 2, 0, 1], abs=0.02)


def test_without_a_window_all_of_a_picture_is_in_the_middle_of_its_cell():
    (image,) = draw([Block("", ["a"], {"b": [Cell([(np.ones((2, 4, 3)), None)])]})]).axes[0].get_images()
    assert image.get_extent() == [0.0, 1.0, 0.75, 0.25]


def test_a_large_picture_is_averaged_so_that_single_pixels_stay_visible():
    figure = draw([Block("", ["a", "b"], {"c": [Cell([(np.ones((size, size, 3)), None)]) for size in (16, 1024)]})])
    assert [image.get_interpolation() for image in figure.axes[0].get_images()] == ["nearest", "auto"]


@pytest.mark.parametrize("row", ["a name of a row that is long", "DeepSDF samples"])
def test_names_of_narrow_columns_are_wrapped_and_do_not_touch_the_edge_of_the_figure(row):
    names = ["DIST, paper's, 72 views, 180 iterations", *(f"row {number}" for number in range(10))]
    rows = {row: [Cell([(np.ones((8, 8, 3)), None)])] * len(names)}
    figure = draw([Block("car", names, rows)])
    figure.draw_without_rendering()
    axis = figure.axes[0]
    boxes = [label.get_window_extent() for label in (*axis.get_xticklabels(), *axis.get_yticklabels())]
    inner = figure.bbox.padded(-0.04 * figure.dpi)  # inches
    assert all(box.x0 >= inner.x0 and box.x1 <= inner.x1 and box.y1 <= inner.y1 for box in boxes)
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])
