"""Tables and figures of one rendering, its pictures and its gradients, from run folders whose numbers are known."""

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgb

from bench.pictures import style
from bench.report import gallery
from bench.studies import benchmark, gradients
from tests.report.test_report_paper import (
    DYNAMIC,
    NAIVE,
    PARALLEL,
    ball,
    bands,
    costs,
    drawn,
    page_of,
    told,
    write_images,
    write_judged,
    write_run,
)


def test_table1_numbers_stand_in_their_rows_with_the_published_beside(tmp_path):
    write_run(tmp_path, "table1", "of ours", metrics=costs(5, step_seconds=0.5))
    write_run(tmp_path, "table1", DYNAMIC, metrics=costs(2_100_000))
    timed_out = {"status": "timeout", "reason": "64 pixels took over 60 s"}
    write_run(tmp_path, "table1", NAIVE, metrics=costs(6_100_000, size=32), **timed_out)
    write_run(tmp_path, "table1", PARALLEL, status="crashed", reason="no luck", environment={})
    page = page_of(tmp_path, "table1")
    rows = page.data.set_index("row")
    rows = rows.astype(object).where(rows.notna(), None)
    assert list(rows.index) == [NAIVE, PARALLEL, DYNAMIC, "of ours"]  # the paper's order, then others
    assert list(rows["queries"]) == [None, None, 2_100_000, 5]  # those of the asked size: as N/A in the paper
    assert list(rows["size"]) == [64, 64, 64, 64]
    assert list(rows["published_queries"]) == ["N/A", "6.06M", "1.99M", None]
    assert list(rows["published_time"]) == ["N/A", "3.39s", "1.23s", None]
    assert list(rows["published_steps"]) == ["50", "50", "50", None]
    assert list(rows["status"]) == ["timeout", "crashed", "ok", "ok"]
    assert list(rows["reason"]) == ["64 pixels took over 60 s", "no luck", "", ""]
    names = ("forward_s", "backward_s", "step_s", "step_s_low", "step_s_high", "lost", "false", "wrong")
    assert list(rows.loc[DYNAMIC, [*names, "depth_error_max"]]) == [0.5, 0.25, 0.75, 0.625, 0.875, 12, 8, 3, 0.25]
    assert page.verdict.startswith("Step runtime at 64 pixels: *500 ms* (of ours)")


def test_table1_says_to_a_reader_what_failed_and_how_it_was_measured(tmp_path):
    write_run(tmp_path, "table1", DYNAMIC, metrics=costs())
    write_run(tmp_path, "table1", NAIVE, metrics=costs(size=32), status="timeout", reason="over 60 s")
    write_run(tmp_path, "table1", PARALLEL, status="crashed", reason="no luck")
    page = page_of(tmp_path, "table1")
    assert list(page.table["Size"]) == ["32 (64: timeout)", "– (64: crashed)", "64"]
    assert page.table["Time of a step"].iloc[2] == "750 ms (625–875)"
    assert page.table["Missed / spurious / wrong depth"].iloc[2] == "12 / 8 / 3"
    said = (
        "car 0",
        "64×64 pixels",
        "4 layers of 128",
        "Some CPU",
        "2 threads",
        "5 repeats",
        "n = 3 runs",
        "GTX 1080Ti",
    )
    for words in (*said, "2 of 3 runs did not end ok: Naive sphere tracing: timeout (over 60 s); + parallel: crashed"):
        assert words in told(page)


def shown_from(results, label: str, azimuth: int, wrong: int, cost: int, **changed) -> None:
    """A run of fit_for from a camera at an azimuth; its hits are 400."""
    pixels = {"lost": wrong, "false": 0, "wrong": 0, "pixel_errors": wrong, "out_of_steps": wrong, "cost": cost}
    settings = {"view": {"resolution": 64, "azimuth": [azimuth] * 2}}
    metrics = costs() | pixels | {"gradient_error": 0.5}
    folder = write_run(results, "fit_for", label, settings=settings, **{"metrics": metrics, **changed})
    write_images(folder)


def test_the_renderer_for_a_field_is_chosen_without_the_camera_that_checks_it(tmp_path):
    shown_from(tmp_path, "E", 0, 0, cost=1)  # not from all cameras
    for azimuth, wrong in ((180, 100), (0, 4), (90, 4)):  # few wrong pixels from the first two cameras only
        shown_from(tmp_path, "A", azimuth, wrong, cost=1000)
    for azimuth in (0, 90, 180):
        shown_from(tmp_path, "B", azimuth, 2, cost=2000)
        shown_from(tmp_path, "C", azimuth, 40, cost=500)
        shown_from(tmp_path, "D", azimuth, 0, 0, metrics={}, status="unsupported", reason="needs a distance")
    page = page_of(tmp_path, "fit_for")
    assert "*A* needs the fewest field evaluations, 1.00k: 8 of 800 hit pixels are wrong. " in page.verdict
    assert "no part in the choice: 100 of 400. " in page.verdict and page.verdict.endswith(": C (10.0 %).")
    rows = page.data.set_index("renderer")
    assert list(rows["lost"])[:4] == [0, 108, 6, 120] and rows.loc["A", "fraction"] == pytest.approx(108 / 1200)
    assert rows.loc["B", "gradient_error"] == 0.5 and rows.loc["D", "reason"] == "needs a distance"
    assert [each["name"] for each in page.chart["panels"][0]["series"]] == ["E", "A", "B", "C"]
    pictures = page_of(tmp_path, "fit_for_pixels")
    assert len(pictures.runs.records) == 5  # of the first camera


def numbers(factor: float, coarse: int = 0) -> dict:
    """The numbers of a renderer that takes `factor` times what the first one does."""
    ratios = {f"{cost}_ratio": factor for cost in benchmark.COSTS}
    ends = {
        f"{cost}_ratio_{end}": factor + off for cost in benchmark.COSTS for end, off in (("low", -0.25), ("high", 0.25))
    }
    costs = {"forward_seconds": factor, "step_seconds": 2 * factor, "forward_cpu": factor, "step_cpu": factor}
    errors = {"lost": 1, "false": 2, "wrong": 3, "depth_error_median": 1e-6, "depth_error_p99": 1e-4, "hits": 9}
    return {**ratios, **ends, **costs, **errors, "queries": 1000, "coarse_queries": coarse, "work_over_bound": 5.5}


def timed(results, size: int, threads: int, factor: float = 0.5, **changed) -> None:
    metrics = {"rounds": 5}
    for name, times, coarse in (("base", 1.0, 0), ("newton", factor, 3000)):
        metrics |= {f"{name}.{key}": number for key, number in numbers(times, coarse).items()}
    settings = {"task": {"size": size, "threads": threads}}
    write_run(results, "benchmark", None, **{"task": "benchmark", "metrics": metrics, "settings": settings, **changed})


def test_a_benchmark_has_a_line_for_each_size_number_of_threads_and_renderer(tmp_path):
    for size, threads, factor in ((256, 1, 0.6), (256, 2, 0.9), (128, 2, 0.5), (128, 1, 0.75)):
        timed(tmp_path, size, threads, factor)
    timed(tmp_path, 512, 1, metrics={}, status="timeout", reason="dvr: more than 9 field values")
    page = page_of(tmp_path, "benchmark")
    ratios = {128: {1: 0.75, 2: 0.5}, 256: {1: 0.6, 2: 0.9}}
    lines = [(size, n, each) for size, own in ratios.items() for n, ratio in own.items() for each in (1.0, ratio)]
    assert list(zip(*(page.data[key] for key in ("size", "threads", "forward_ratio")), strict=True))[:-1] == lines
    assert set(page.data["renderer"][1:6:2]) == {"newton"}
    line = page.table.iloc[1]
    assert (line["Field evaluations"], line["Forward ratio"]) == ("1.00k + 3.00k coarse", "0.75 (0.50–1.00)")
    assert line["Missed / spurious / wrong depth"] == "1 / 2 / 3"
    assert list(page.table["Forward ratio"].iloc[[0, -1]]) == ["1", "–"]  # of the first renderer, and of a failed run
    assert "medians of 5 rounds" in told(page) and "timeout" in told(page)
    assert "thread" not in page.shown().caption[-40:]
    said = "Step runtime at 256 × 256 pixels, relative to dist: *0.600* (newton, 1 thread) to 0.900 (newton, 2 threads)"
    assert page.verdict == f"{said}; n = one shape."


def test_gradients_have_a_row_for_each_renderer_and_band(tmp_path):
    page = page_of(write_judged(tmp_path), "gradients")
    rows = page.data.set_index(["row", "band"])
    assert list(rows.index) == [(name, band) for name in ("dist", "dvr", "naive") for band in gradients.BANDS]
    assert rows.loc[("dvr", "oblique"), "code_scale"] == 4.0
    assert rows.loc[("dist", "grazing"), ["camera_median_error", "code_pooled_cosine"]].tolist() == pytest.approx(
        [3e-4, 0.97]
    )
    assert np.isnan(rows.loc[("dvr", "frontal"), "camera_scale"])
    assert rows.loc[("dist", "silhouette"), ["image_cosine", "pixels"]].tolist() == [0.75, 77]
    assert (rows.loc["naive", "status"] == "oom").all() and rows.loc["naive", "code_scale"].isna().all()
    assert page.table.loc[0, ["Code pooled cosine", "Code scale", "Pixels"]].tolist() == ["0.99000", "1.00", "100"]
    assert "A pooled number compares the gradients of all pixels of a band" in told(page)
    assert "0 of 3 rows reach a pooled cosine of 0.99 " in page.verdict and ": *0.97000* (dist)" in page.verdict


def test_a_renderer_without_a_number_in_a_band_has_no_least_one():
    known = [("a", band, "ok", 0.995) for band in gradients.ANGLES] + [("b", "frontal", "ok", 0.999)]
    said = gradients._verdict(pd.DataFrame(known, columns=["name", "band", "status", "code_pooled_cosine"]))
    assert said.startswith("1 of 2 rows reach a pooled cosine of 0.99 in all bands of hits, for the code: a. Cosine of")
    assert ": *0.99500* (a); " in said


def test_gradients_figure_plots_the_numbers_of_its_csv(tmp_path):
    page = page_of(write_judged(tmp_path), "gradients")
    code, camera, outline = page.figure.axes
    own = page.data[page.data["band"] == "oblique"]
    assert drawn(code, "oblique", "x")[:2] == list(own["code_median_error"])[:2] == [2e-4, 2e-4]
    assert drawn(camera, "oblique", "x") == pytest.approx([2e-4, np.nan, np.nan], nan_ok=True)
    assert drawn(outline, "cosine", "x")[:2] == [0.75, 0.75] and drawn(outline, "scale", "x")[:2] == [0.5, 1.0]
    assert [label.get_text() for label in code.get_yticklabels()] == ["dist", "dvr", "naive (oom)"]


def seen(blur: str, error: float) -> dict[str, float]:
    """The metrics at the outline, at a blur."""
    numbers = {"image_cosine": 0.9, "image_scale": 1.1, "image_error": error, "image_spread": 2.0}
    return {f"silhouette_{blur}.{name}": value for name, value in (numbers | {"values_per_ray": 30.0}).items()}


def test_what_comes_into_view_has_a_row_for_each_blur(tmp_path):
    blurred = seen("1e-03", 0.3) | seen("3e-02", 0.2)
    own = {key.replace("_1e-03", ""): value for key, value in seen("1e-03", 0.9).items()}
    write_run(tmp_path, "gradients", None, metrics=bands() | own, renderer="idr")
    write_run(tmp_path, "gradients", None, metrics=bands() | own | {"silhouette.image_cosine": 0.5}, renderer="dvr")
    write_run(tmp_path, "gradients", None, metrics=bands() | own | blurred, renderer="neus")
    write_run(tmp_path, "gradients", None, renderer="naive", status="oom", reason="8 GB")
    page = page_of(tmp_path, "gradients_visibility")
    rows = page.data.set_index("row")
    assert rows.loc["neus", "blur"].tolist() == [0.001, 0.03]
    assert rows.loc["neus", "image_error"].tolist() == [0.3, 0.2]
    assert rows.loc["idr", "image_error"] == 0.9 and np.isnan(rows.loc["idr", "blur"])
    assert rows.loc["naive", "status"] == "oom"
    cosine, scale = page.figure.axes
    assert drawn(cosine, "neus") == [0.9, 0.9] and drawn(scale, "neus", "x") == [0.001, 0.03]
    sharp = [
        line.get_ydata()[0] for line in cosine.lines if line.get_label() == "without a blur: least and most of 2 rows"
    ]
    assert sharp == [0.5, 0.9]
    assert page.verdict.startswith("neus has a cosine of *0.90* and a scale of 1.10 at a blur of 0.001 scene units. ")


def test_fig4_counts_what_the_pictures_show(tmp_path):
    write_images(write_run(tmp_path, "fig4", PARALLEL))
    write_images(write_run(tmp_path, "fig4", DYNAMIC), shift=0.1, tilt=10.0)
    write_images(write_run(tmp_path, "fig4", NAIVE, status="timeout", reason="slow"), size=8)
    write_run(tmp_path, "fig4", "+ aggressive")
    page = page_of(tmp_path, "fig4")
    rows = page.data.set_index("row")
    assert list(rows.index) == [PARALLEL, DYNAMIC, NAIVE, "+ aggressive"]
    assert list(rows["size"]) == [24, 24, 8, None]
    assert (rows.loc[PARALLEL, "lost"], rows.loc[PARALLEL, "false"], rows.loc[PARALLEL, "angle_max"]) == (0, 0, 0)
    reference, moved = ball(24, 0.0, 0.0)[1], ball(24, 0.1, 0.0)[1]
    assert rows.loc[DYNAMIC, "lost"] == (reference & ~moved).sum() > 0
    assert rows.loc[DYNAMIC, "false"] == (moved & ~reference).sum() > 0
    assert rows.loc[DYNAMIC, "hits"] == reference.sum()
    assert "No pictures of 1 run: no images.npz." in told(page)
    axis = page.figure.axes[0]
    titles = [label.get_text().replace("\n", " ") for label in axis.get_xticklabels()]
    assert titles == ["reference", PARALLEL, DYNAMIC, f"{NAIVE}, 8 px", "+ aggressive"]
    assert [text.get_text() for text in axis.texts if text.get_text()] == ["timeout", "no picture"]
    assert any("degrees" in axis.get_ylabel() for axis in page.figure.axes)
    assert page.verdict.startswith(f"Missed and spurious pixels: *0* ({PARALLEL}) to ")


def test_angles_are_degrees_where_both_hit(tmp_path):
    write_images(tmp_path, tilt=10.0)
    images = gallery.read_arrays(tmp_path, gallery.REFERENCE)[0]
    angles = gallery.angles(images)
    assert np.isnan(angles).sum() == (~images["hit"]).sum()
    within = np.abs(images["normals"][..., 1]) < 0.1  # the turn is about y
    assert np.nanmedian(angles[within]) == pytest.approx(10.0, abs=0.2)


def test_lost_and_false_pixels_have_their_colours(tmp_path):
    write_images(write_run(tmp_path, "fig4", DYNAMIC), shift=0.1)
    shown = page_of(tmp_path, "fig4").figure.axes[0].get_images()[-1].get_array()
    images = gallery.read_arrays(tmp_path / "runs" / "run000", gallery.REFERENCE)[0]
    for colour, mask, other in ((style.MISSED, "reference_hit", "hit"), (style.SPURIOUS, "hit", "reference_hit")):
        wrong = images[mask] & ~images[other]
        assert wrong.any() and ((shown == to_rgb(colour)).all(-1) == wrong).all()


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "cannot be read"),
        (b"PK\x03\x04 not a zip", "cannot be read"),
        ({"hit": np.ones((2, 2))}, "lacks an array"),
    ],
)
def test_broken_pictures_are_a_remark(tmp_path, content, why):
    path = write_run(tmp_path, "fig4", DYNAMIC) / "images.npz"
    path.write_bytes(content) if isinstance(content, bytes) else np.savez(path, **content)
    page = page_of(tmp_path, "fig4")
    assert why in told(page) and list(page.data["lost"]) == [None]


def test_fig7_is_in_order_of_epsilon_and_plots_the_shares(tmp_path):
    for epsilon, lost, false in ((5e-5, 0, 1), (5e-2, 4, 100), (5e-7, 40, 0)):
        metrics = costs(lost=lost, false=false, depth_error_median=epsilon / 2)
        write_images(write_run(tmp_path, "fig7", None, metrics=metrics, settings={"renderer": {"epsilon": epsilon}}))
    settings = {"renderer": {"epsilon": 5e-3}}
    write_run(tmp_path, "fig7", None, settings=settings, status="killed", reason="stopped", environment={})
    page = page_of(tmp_path, "fig7")
    assert list(page.data["epsilon"]) == [5e-2, 5e-3, 5e-5, 5e-7]
    assert list(page.data["lost_share"]) == [0.01, None, 0.0, 0.1]
    assert list(page.data["false_share"]) == [0.25, None, 0.0025, 0.0]
    assert list(page.data["status"]) == ["ok", "killed", "ok", "ok"]
    shown = page.table[["Epsilon", "Missed", "Spurious"]].to_numpy().tolist()
    assert shown[0] == ["0.0500", "1.00 %", "25.0 %"] and shown[1][1:] == ["–", "–"]
    assert "killed (stopped)" in told(page)
    assert "at epsilon = 5e-05 scene units: *0.250 %* of the hits. At epsilon = 0.05 they are 26.0 %" in page.verdict


def test_counts_of_wrong_pixels_within_their_noise_are_named_together(tmp_path):
    for epsilon, lost in ((5e-4, 208), (5e-5, 209), (5e-3, 425)):
        metrics = costs(lost=lost, false=0, hits=14167)
        write_images(write_run(tmp_path, "fig7", None, metrics=metrics, settings={"renderer": {"epsilon": epsilon}}))
    assert "at epsilon = 0.0005 or 5e-05 scene units: *1.47 %* of the hits." in page_of(tmp_path, "fig7").verdict


def test_pictures_are_of_one_scene(tmp_path):
    write_images(write_run(tmp_path, "fig7", None, settings={"index": 1}))
    write_images(write_run(tmp_path, "fig7", None, settings={"index": 0}))
    page = page_of(tmp_path, "fig7")
    assert list(page.data["index"]) == [0] and "Not shown: 1 run" in told(page)
