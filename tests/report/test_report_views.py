"""Shape from many views and camera pose, as tables and figures made from run folders whose numbers are known."""

from scipy import stats

from bench.report.data.records import ONE_WAY
from bench.studies import fig10
from tests.report.test_report_paper import page_of, told, write_run

ENDS = ONE_WAY


def found(results, experiment, label, chamfer, *, start=8.0, renderer="dist", method="", **task):
    """A run of shape from many views; None as its Chamfer distance x 1000 is a run that failed."""
    return write_run(
        results,
        experiment,
        label,
        task="multiview",
        renderer=renderer,
        method=method,
        status="ok" if chamfer is not None else "not_reached",
        metrics={} if chamfer is None else {ENDS: chamfer / 1000},
        metrics_start={ENDS: start / 1000},
        seconds={"forward": 2.0, "backward": 1.0},
        evaluations={"value": 5000},
        index=task.pop("index", 0),
        settings={"task": {"focal": 1.0, "start_scale": 1.0, **task}},
    )


def posed(results, label, degrees, success, *, task="pose", dataset=None, starts=1, **changed):
    """A run of camera pose; None as its success is a run that failed, though its pose is right."""
    return write_run(
        results,
        "fig6",
        label,
        task=task,
        status="ok" if success is not None else "nan",
        metrics={"success": 1.0 if success is None else float(success)},
        seconds={"forward": 1.5, "backward": 0.5} if task == "pose" else {"forward": 0.25, "backward": 0.0},
        settings={
            "task": {"degrees": degrees, "shift": 0.1, "starts": starts}
            | {"success_degrees": 5.0, "success_distance": 0.05},
            "dataset": dataset or {"name": "car"},
        },
        **changed,
    )


def row(result, method):
    return result.table[result.table["Method"] == method].iloc[0]


def test_table_3_has_medians_ratios_and_published_numbers(tmp_path):
    for index, (end, start) in enumerate(((1.0, 8.0), (2.0, 4.0), (4.0, 40.0))):
        found(tmp_path, "table3", "DIST", end, index=index, start=start, method="multiview_dist")
        found(tmp_path, "table3", "IDR", 2 * end, index=index, start=start, method="multiview_idr")
    result = page_of(tmp_path, "table3")
    ours, idr = row(result, "DIST"), row(result, "IDR")
    assert (ours["Median"], ours["Median over shapes"], ours["Failed"]) == ("2.00", "2.00 (n = 3)", "0 of 3")
    assert (ours["Ratio to DIST"], idr["Ratio to DIST"]) == ("", "2.00 (n = 3); 0 of 3")
    assert (ours["Runtime"], ours["Field evaluations"]) == ("3.00 s", "5.00k")
    assert row(result, "initial error, random")["Median"] == "8.00"
    assert row(result, "published: DIST, random start")["Median"] == "0.919"
    assert row(result, "published: PMO, random start")["Median"] == "1.187"  # as the paper prints it
    assert "does not say whether it has means or medians" in told(result)
    assert "cannot be compared directly" in told(result)
    assert "PMO (Lin et al. 2019)" not in told(result)  # there is no mesh row


def test_published_numbers_of_pmo_stand_beside_the_mesh_row(tmp_path):
    found(tmp_path, "table3", "DIST", 1.0)
    found(tmp_path, "table3", "Mesh, 48³", 2.0, renderer="mesh_proxy", method="multiview_mesh")
    result = page_of(tmp_path, "table3")
    ends = dict(zip(result.table["Method"], result.table["Median"], strict=True))
    assert list(ends.items()) == [
        *(("initial error, random", "8.00"), ("DIST", "1.00"), ("Mesh, 48³", "2.00")),
        *(("published: PMO", "0.661"), ("published: PMO, random start", "1.187")),
        ("published: DIST, random start", "0.919"),
    ]
    assert list(result.data["row"]) == ["DIST", "Mesh, 48³"]  # the CSV has measured rows alone
    assert "“Mesh, 48³” has gradients" in told(result) and "counterpart is “published: PMO, random" in told(result)


def test_an_encoders_start_is_a_line_of_its_own(tmp_path):
    found(tmp_path, "table3", "DIST", 1.0, start=8.0)
    found(tmp_path, "table3", "DIST, encoder's start", 0.5, start=2.0, encoder={"batch": 16})
    result = page_of(tmp_path, "table3")
    assert row(result, "initial error, random")["Median"] == "8.00"
    assert row(result, "initial error, encoder")["Median"] == "2.00"


def test_rows_may_have_images_of_their_own_size(tmp_path):
    found(tmp_path, "table3", "DIST", 1.0)
    write_run(
        *(tmp_path, "table3", "Naive, 32 x 32"),
        task="multiview",
        metrics={ENDS: 0.002},
        metrics_start={ENDS: 0.004},
        settings={"task": {"focal": 1.0}, "view": {"resolution": 32}},
    )
    result = page_of(tmp_path, "table3")
    assert row(result, "DIST")["Median"] == "1.00"
    assert row(result, "Naive, 32 x 32")["Median"] == "2.00"
    assert "Not shown" not in told(result)


def test_figure_10_varies_one_condition_at_a_time(tmp_path):
    found(tmp_path, "fig10", "DIST", 1.0)
    found(tmp_path, "fig10", "DIST", 3.0, focal=0.5)
    found(tmp_path, "fig10", "DIST", 5.0, start_scale=2.0)
    found(tmp_path, "fig10", "DIST", 9.0, focal=0.5, start_scale=2.0)  # both: in neither panel
    result = page_of(tmp_path, "fig10")
    medians = dict(zip(result.table["Condition"], result.table["Median"], strict=True))
    focal, noise = (one.label for one in fig10.CONDITIONS)
    shown = {f"{focal}: 0.5": 3, f"{focal}: 1": 1, f"{noise}: 1": 1, f"{noise}: 2": 5}
    assert medians == {condition: f"{value}.00 (n = 1)" for condition, value in shown.items()}
    assert len(result.data) == 4


def test_figure_10_shows_what_a_condition_changes_on_the_same_shapes(tmp_path):
    for index, (usual, changed) in enumerate(((1.0, 2.0), (10.0, 40.0), (3.0, 30.0))):
        found(tmp_path, "fig10", "DIST", usual, index=index)
        found(tmp_path, "fig10", "DIST", changed, index=index, focal=0.5)
    found(tmp_path, "fig10", "DIST", 9.0, index=7, focal=0.5)  # without a run at 1
    focal, noise = page_of(tmp_path, "fig10").figure.axes
    median, shapes = focal.lines
    assert list(zip(*median.get_data(), strict=True)) == [(0.5, 4.0), (1.0, 1.0)]
    assert sorted(zip(*shapes.get_data(), strict=True))[:3] == [(0.5, 2.0), (0.5, 4.0), (0.5, 10.0)]
    assert list(zip(*noise.lines[0].get_data(), strict=True)) == [(1.0, 1.0)]


def test_figure_12_counts_successes_over_how_far_the_shape_was_misplaced(tmp_path):
    placed = {"shift": 0.0, "degrees": 0.0, "scale": 1.0}
    for index, chamfer in enumerate((0.5, 0.99, 1.01, None)):
        found(tmp_path, "fig12", "DIST", chamfer, index=index, **placed | {"degrees": 20.0})
    found(tmp_path, "fig12", "DIST", 0.2, **placed | {"similarity": True})
    found(tmp_path, "fig12", "DIST", 4.0, **placed)  # its place is known: another problem, in no panel
    found(tmp_path, "fig12", "DIST", 0.2, **placed | {"degrees": 20.0, "shift": 0.1})  # two: in no panel
    result = page_of(tmp_path, "fig12")
    table = result.table.set_index("Condition")
    assert table.loc["rotation (degrees): 20", "Success"] == "2 of 4 (n = 4)"  # a failed run is no success
    assert table.loc["rotation (degrees): 20", "Median"] == "1.00 (n = 4)"
    neutral = ["shift (scene units): 0", "rotation (degrees): 0", "size / true size: 1"]
    assert table.loc[neutral, "Success"].tolist() == ["1 of 1 (n = 1)"] * 3
    assert table.loc["place known", "Median"] == "4.00 (n = 1)"
    assert len(table) == 5
    assert not any(4.0 in line.get_ydata() for axis in result.figure.axes for line in axis.lines)
    assert all(1.0 in line.get_ydata() for axis in result.figure.axes for line in axis.lines[-1:])


def test_poses_found_are_counted_at_each_angle(tmp_path):
    for seed, success in enumerate((1, 1, 0, None)):
        posed(tmp_path, "DIST", 30, success, seed=seed)
        posed(tmp_path, "ICP, point to plane", 30, 1, seed=seed, task="pose_icp")
    posed(tmp_path, "DIST", 90, 0)
    result = page_of(tmp_path, "fig6")
    mine, theirs = row(result, "DIST"), row(result, "ICP, point to plane")
    assert mine["30°"] == "2 of 4 (n = 1)"  # a failed run is a pose that was not found; one shape, no interval
    assert mine["90°"] == "0 of 1 (n = 1)"
    assert theirs["30°"] == "4 of 4 (n = 1)"
    assert "fewer than six shapes: a small point per shape, no interval" in result.caption
    assert theirs["90°"] == ""
    assert (mine["Runtime"], theirs["Runtime"]) == ("2.00 s", "250 ms")
    assert "1 of 9 runs did not end ok: DIST, 30 degrees, seed 3: nan (" in result.caption
    assert "5 degrees and 0.05 scene units" in result.caption


def test_views_of_one_mesh_are_one_shape(tmp_path):
    for index in range(8):
        posed(tmp_path, "DIST", 30, 1, dataset={"path": "/meshes/fandisk.obj", "strength": 0.0}, index=index)
    result = page_of(tmp_path, "fig6")
    assert row(result, "DIST")["30°"] == "8 of 8 (n = 1)"
    assert "n = 8 runs (1 shape, 8 views, 1 seed)" in result.caption


def test_six_shapes_have_an_interval_that_does_not_count_their_views(tmp_path):
    for shape in range(6):
        for index in range(2):
            mesh = {"path": f"/meshes/{shape}.obj", "strength": 0.0}
            posed(tmp_path, "DIST", 30, int(shape > 0), dataset=mesh, index=index)
    result = page_of(tmp_path, "fig6")
    low, high = stats.binomtest(5, 6).proportion_ci(method="exact")  # as one trial per shape
    assert row(result, "DIST")["30°"] == f"10 of 12 [{100 * low:.1f}, {100 * high:.1f}] %"
    assert "95 % intervals over shapes (Clopper and Pearson)" in result.caption


def test_cameras_are_compared_at_one_number_of_starts(tmp_path):
    for label, starts, success in (("DIST", 1, 0), ("ICP", 1, 1), ("ICP, 16 starts", 16, 1)):
        posed(tmp_path, label, 90, success, starts=starts)
    verdict = page_of(tmp_path, "fig6").verdict
    assert "by 1 start: *100 %* (ICP) to 0 % (DIST)" in verdict and "by 16 starts: *100 %* (ICP, 16" in verdict


def test_runs_that_begin_in_place_are_no_successes_of_misplaced_ones(tmp_path):
    placed = {"shift": 0.0, "degrees": 0.0, "scale": 1.0, "similarity": True}
    found(tmp_path, "fig12", "DIST", 0.2, **placed)
    for index, chamfer in enumerate((0.5, 2.0)):
        found(tmp_path, "fig12", "DIST", chamfer, index=index, **placed | {"degrees": 20.0})
    assert "below 1: *50 %* (DIST)" in page_of(tmp_path, "fig12").verdict


def test_a_row_of_another_resolution_is_in_no_headline(tmp_path):
    for index in range(6):
        for label, error in (("DIST", 2.0), ("IDR", 1.0)):
            found(tmp_path, "table3", label, error, index=index, method=f"multiview_{label.lower()}")
        small = {"metrics": {ENDS: 5e-4}, "seconds": {"forward": 0.5, "backward": 0.1}, "index": index}
        view = {"view": {"resolution": 32}, "task": {"focal": 1.0, "start_scale": 1.0}}
        write_run(tmp_path, "table3", "DVR", task="multiview", method="multiview_dvr", settings=view, **small)
    result = page_of(tmp_path, "table3")
    assert "DVR" not in result.verdict and "*1.00* (IDR" in result.verdict
    assert row(result, "DVR")["Median"] == "0.500" and "do not compare rows with different values" in told(result)


def test_a_single_run_of_one_condition_has_a_page(tmp_path):
    found(tmp_path, "fig12", "DIST", 0.5, shift=0.2, degrees=0.0, scale=1.0, similarity=True)
    result = page_of(tmp_path, "fig12")
    assert [len(axis.lines) for axis in result.figure.axes] == [3, 0, 0] and len(result.table) == 1
