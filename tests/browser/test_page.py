"""The page in Chromium: tables, filters, links, charts and the 3D view; the address, the keyboard, two runs, phones."""

import io
import json
import shutil
from dataclasses import replace

import pytest
import trimesh
from PIL import Image

from bench.records import format
from bench.records.read import read_records
from bench.report.__main__ import main
from bench.report.suite.attempts import attempts_of, write_attempts
from bench.report.write import paper
from bench.report.write.html import write_index
from tests.browser import made
from tests.report.test_report import crashed
from tests.report.test_report_sweeps import cell, ran, swept
from tests.report.test_suite import attempt, write_completion

pytestmark = pytest.mark.browser

RUNS = 7
SOLVED = [attempt("Dist", f"car test {n}", {0: 0.8, 2e5: 0.1, 4e5: 0.001}, preset="dist") for n in (0, 1)]
NUMBERS = (
    0.0123456,
    0.5,
    9.996,
    99.96,
    1234.5,
    -12.34,
    1.234e-5,
    1.5e9,
    0.0,
    999.6,
    1.43e6,
    3e12,
    7201.0,
    0.0123,
    None,
)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Seven runs of one task, one of them without a place among the machines; a table with a chart, and an atlas."""
    folder = tmp_path_factory.mktemp("browser")
    for number in range(RUNS):
        made.write(folder, number)
    empty = crashed("broken", scene="sofa test 3", seed=0)
    made.write(
        folder, 90, folder="broken", **{key: empty[key] for key in ("status", "metrics", "environment", "seconds")}
    )
    write_tables(folder)
    write_index(folder)
    return folder


DOT = "data:image/png;base64,iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJ"  # a picture of one pixel
DOT += "AAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="


def write_tables(results):
    """`speed_front` with a chart, and the atlas with its curves, one cell of which leads to a run."""
    folder = results / "paper"
    folder.mkdir()
    points = {"name": "dist", "colour": "#0072b2", "symbol": "s", "x": [1.0, 10.0], "y": [2.0, 0.5]}
    points |= {"text": [["slow"], ["fast"]], "link": ["#/run/completion-0000", "#/run/completion-0001"]}
    other = {"name": "dvr", "colour": "#d1495b", "symbol": "^", "x": [3.0], "y": [1.0]}
    panel = {"title": "one", "x": {"title": "time", "log": True}, "y": {"title": "error", "log": True}}
    chart = {"panels": [panel | {"series": [points, other]}]}
    front = {"place": 1, "title": "Error over time.", "caption": "What is plotted.", "notes": ["A note."]}
    front |= {"question": "What does accuracy cost?", "verdict": "The least error is *0.5*."}
    front |= {"columns": ["Setting", "Time", "Words"], "chart": chart}
    front |= {"rows": [["slow", "12.0 s", "b"], ["fast", "300 ms", "a"], ["none", "–", "c"]]}
    (folder / "speed_front.json").write_text(json.dumps(front))
    (folder / "speed_front.csv").write_text("setting,time\nslow,12\n")
    axes = [{"axis": name, "title": name, "group": "geometry", "unit": "units"} for name in ("wires", "gap")]
    cell = {"mark": "", "full": "0.1 (0.05 to 0.2)", "shade": 0.4, "status": "ok", "reason": ""}
    ray = {"command": "python -m bench.ray task=stability stress=wires renderer=dist", "breaks": 0.5, "works": None}
    cell |= {"folder": "completion-0002", "ray": ray, "pictures": {"breaks": DOT, "breaks_text": "fails at 0.2"}}
    lost = cell | {"mark": "–", "shade": None, "status": "unsupported", "folder": "gone"}
    lost |= {"reason": "no alpha"}
    atlas = {"axes": axes, "rows": ["dist", "dvr"], "cells": [[cell, lost], [cell, None]]}
    where = {"place": 2, "title": "Where it breaks.", "columns": ["Axis", "dist"], "rows": [["wires", "0.1"]]}
    where |= {"question": "Where?", "verdict": "At *0.1*.", "atlas": atlas}
    (folder / "stability.json").write_text(json.dumps(where))
    curves = {"panels": [panel | {"title": "wires", "axis": "wires", "series": [points, other]}]}
    (folder / "stability_curves.json").write_text(json.dumps({"title": "Curves.", "chart": curves}))


def rows_of(page):
    return page.locator("#board-list tbody tr")


def names_of(page):
    return page.locator("#board-list tbody th a").all_inner_texts()


def test_the_first_screen_answers_with_the_suite_and_has_no_other_table(tmp_path, tab):
    write_tables(tmp_path)
    for number in range(2):
        made.write(tmp_path, number)
    lost = [replace(solved, row="Other", status="nan", reason="lost") for solved in SOLVED]
    write_attempts([*SOLVED, *lost], tmp_path)
    assert main([f"results_dir={tmp_path}"]) == 0
    page = tab(tmp_path).open()
    assert page.locator("h1").inner_text() == "Which renderer makes the most progress, at the same cost?"
    assert "2 scenes cannot decide between 2 renderers" in page.locator(".answer").inner_text()
    page.locator(".scatterlayer .trace").first.wait_for()
    assert page.locator(".panel").count() == 1
    page.get_by_role("group", name="Set of problems").get_by_role("button", name="complete").click()
    page.get_by_role("group", name="complete", exact=True).wait_for()
    assert "accuracy" not in page.locator("main").inner_text()  # what the other tables answer
    assert set(names_of(page)) == {"DIST", "DVR"}
    page.get_by_role("link", name="Tables").click()
    page.get_by_role("link", name="What does accuracy cost?").wait_for()
    assert page.locator(".answers strong").all_inner_texts()[:2] == ["0.5", "0.1"]
    page.get_by_role("link", name="What does accuracy cost?").click()
    page.get_by_role("heading", level=1, name="What does accuracy cost?").wait_for()
    page.get_by_role("link", name="Suite").click()
    page.get_by_role("link", name="Other", exact=True).click()
    page.get_by_text("It fails in 2 of 2 runs.").wait_for()
    text = page.locator("main").inner_text()
    assert "complete: car test 0, 20 points, 1 unit: lost." in text and "python -m bench.suite" in text
    assert page.locator("table.list tbody tr").count() == 2 and "2 of 2 at 1 unit" in text
    page.get_by_role("link", name="Suite").first.click()
    page.get_by_role("link", name="Dist", exact=True).click()
    page.get_by_text("No renderer makes more progress in any of 2 runs.").wait_for()


def test_a_renderer_of_a_run_has_the_picture_of_its_first_failure(tmp_path, tab):
    folder = write_completion(tmp_path, [0.8, 0.4, 0.05], status="diverged", reason="the loss rose")
    Image.new("RGB", (40, 30)).save(folder / "failure.png")
    (mine,) = attempts_of(read_records(tmp_path)[0], tmp_path)
    write_attempts([replace(solved, settings=mine.settings) for solved in SOLVED], tmp_path)
    assert main([f"results_dir={tmp_path}"]) == 0
    page = tab(tmp_path).open("#/renderer/Mine")
    page.get_by_text("It fails in 1 of 1 run.").wait_for()
    assert page.locator("main img").get_attribute("src").endswith("/failure.png")
    assert "car test 0, 20 points, 1 unit: the loss rose." in page.locator("main").inner_text()


def test_a_sweep_stands_on_the_first_screen_with_its_verdict_and_its_chart(tmp_path, tab):
    cells = [cell(renderer, dataset=dataset) for renderer in ("dist", "dvr") for dataset in ("sofa", "plane")]
    swept(tmp_path, cells)
    for number, planned in enumerate(cells):
        ran(tmp_path, planned, 0.001 * (1 + number))
    assert main([f"results_dir={tmp_path}"]) == 0
    page = tab(tmp_path).open()
    assert page.locator("h1").inner_text() == "Which has the lowest Chamfer?"
    assert "Median Chamfer (x1000): 1.50 (DIST) to 3.50 (DVR)" in page.locator(".answer").inner_text()
    page.locator(".scatterlayer .point").first.wait_for()
    assert page.locator(".panel").count() == 4 and "DVR" in page.locator(".legend").inner_text()
    assert page.locator("table.list td strong").first.inner_text() == "1.00"
    assert "python -m bench -m renderer=dist,dvr" in page.locator("main").inner_text()
    page.get_by_role("link", name="DVR").first.click()
    page.get_by_role("button", name="Remove the filter 2 runs").wait_for()
    assert {*page.locator("#board-list tbody th a").all_inner_texts()} == {"DVR"}


def test_a_table_that_is_shipped_is_marked(tmp_path, tab, monkeypatch):
    shipped = tmp_path / "shipped"
    (shipped / "paper").mkdir(parents=True)
    content = {"title": "Ours.", "question": "Whose?", "verdict": "*1* of 1."}
    (shipped / "paper" / "ours.json").write_text(json.dumps(content))
    monkeypatch.setattr(paper, "SHIPPED", shipped)
    made.write(tmp_path, 0)
    write_index(tmp_path)
    page = tab(tmp_path).open("#/tables")
    assert page.locator(".answers small").inner_text() == "Ours · shipped"
    page.get_by_role("link", name="Whose?").click()
    assert "not of the runs on this page" in page.locator("main").inner_text()


def test_methods_count_failures_as_worst_and_are_ranked_on_the_same_scenes_alone(results, tab):
    page = tab(results).open("#/runs?renderer=dist")
    row = rows_of(page).first
    assert "1 of 3" in row.inner_text()  # completion-0000, -0005, and broken
    page = tab(results).open("#/runs")
    assert "5 methods without a scene in common: no ranks" in page.locator("#board-list").inner_text()
    assert set(page.locator("#board-list td.rank").all_inner_texts()) == {"–"}


def test_methods_are_ranked_within_a_scale_on_the_scenes_that_all_have(tmp_path, tab):
    """Two methods at two scales, the better one on one scene more; a third one elsewhere, and a run that was killed."""
    planned = [("dist", 0), ("dist", 1), ("dvr", 0), ("idr", 2)]
    for scale in ("smoke", "desk"):
        for number, (renderer, index) in enumerate(planned):
            config = {"renderer": {"_label_": renderer.upper()}, "index": index, "scale": {"name": scale}}
            changed = {"renderer": renderer, "config": config, "dataset": "sofa", "seed": 0}
            metrics = {"chamfer_l2": 0.9 if (renderer, index) == ("dist", 1) else 0.001 * (1 + number)}
            made.write(tmp_path, number, folder=f"{scale}-{renderer}-{index}", metrics=metrics, **changed)
    made.write(tmp_path, 0, folder="late", status="killed", renderer="dvr", dataset="sofa", seed=0, metrics={},
               config={"renderer": {"_label_": "DVR"}, "index": 0, "scale": {"name": "desk"}})  # fmt: skip
    write_index(tmp_path)
    page = tab(tmp_path).open("#/runs")
    assert page.locator(".count").inner_text() == "9 runs, none failed, 1 not run, killed or refused."
    titles = page.locator("#board-list h3").all_inner_texts()
    assert sorted(titles) == sorted(
        f"scale={scale}: {words}"
        for scale in ("smoke", "desk")
        for words in ("2 methods on the 1 scene (shape, view, seed, what is given) that all share", "1 method alone")
    )
    assert page.locator("#board-list td.rank").all_inner_texts() == ["1", "2", "–"] * 2
    assert names_of(page)[:2] == ["DIST", "DVR"]
    assert "0 of 1" in rows_of(page).nth(1).inner_text() and "1.00" in rows_of(page).first.inner_text()
    page.get_by_label("Scale", exact=True).select_option("smoke")
    assert page.locator("#board-list h3").count() == 2


def test_filters_sorting_and_search_stand_in_the_address_and_come_back(results, tab):
    first_tab = tab(results)
    page = first_tab.open("#/runs?view=runs")
    assert rows_of(page).count() == RUNS + 1
    page.get_by_label("Shapes", exact=True).select_option("plane")
    assert rows_of(page).count() == 2
    page.locator('#board-list [data-key="loop"]').click()
    page.locator('#board-list [data-key="loop"]').click()
    assert names_of(page) == ["NAIVE", "DVR"]
    assert page.locator('th[aria-sort="descending"]').inner_text().startswith("Optimisation")
    page.get_by_label("Search", exact=True).fill("NAI")
    assert names_of(page) == ["NAIVE"]
    address = page.evaluate("location.hash")
    again = first_tab.open(address)
    assert names_of(again) == ["NAIVE"] and again.get_by_label("Search", exact=True).input_value() == "NAI"
    assert again.get_by_label("Shapes", exact=True).input_value() == "plane"
    again.get_by_role("button", name="Clear all").click()
    assert rows_of(again).count() == RUNS + 1


def test_a_failed_run_stands_last_with_its_status_in_words(results, tab):
    page = tab(results).open("#/runs?view=runs")
    last = rows_of(page).last.inner_text()
    assert "crashed" in last and "no reason recorded" in last
    page.get_by_label("Status", exact=True).select_option("crashed")
    assert rows_of(page).count() == 1
    assert page.locator("#machines").count() == 0  # it has no machine, which is not another one
    page.locator("#board-list tbody th a").click()
    page.get_by_text("What helps:").wait_for()
    assert "An error ended it." in page.locator(".happened").inner_text()


def test_metrics_without_a_better_direction_rank_nothing(tmp_path, tab):
    for number in range(4):
        metrics = {"breakdown": 0.1 * number, "trials": 5 + number}
        made.write(tmp_path, number, task="stability", metrics=metrics, metrics_start={})
    write_index(tmp_path)
    page = tab(tmp_path).open()
    assert rows_of(page).count() == 4 and names_of(page) == sorted(names_of(page))
    assert set(page.locator("#board-list td.rank").all_inner_texts()) == {"–"}
    page.get_by_label("Renderer", exact=True).select_option("dvr")
    assert names_of(page) == ["DVR"]


def test_times_of_several_machines_are_flagged(tmp_path, tab):
    for number, threads in enumerate((1, 2)):
        made.write(tmp_path, number, environment={"cpu": "Some CPU", "threads": threads, "device": "cpu"})
    write_index(tmp_path)
    page = tab(tmp_path).open("#/runs?view=runs")
    assert "Some CPU, 1 thread: 1 run" in page.locator("#machines").inner_text()
    page.get_by_label("Machine", exact=True).select_option("Some CPU, 2 threads")
    assert page.locator("#machines").count() == 0 and rows_of(page).count() == 1


def test_a_run_has_its_page_with_the_result_first_scaled_as_in_tables(results, tab):
    page = tab(results).open("#/runs?view=runs")
    page.locator("#board-list tbody th a").first.press("Enter")
    page.get_by_role("heading", name="Make it again").wait_for()
    text = page.locator("main").inner_text()
    for words in ("It ended as planned.", "python -m bench task=completion", "of optimisation"):
        assert words in text
    titles = page.locator("main h2").all_inner_texts()
    assert titles[0] == "Result" and titles.index("Costs") > titles.index("Curve")
    row = page.get_by_role("row").filter(has=page.get_by_text("Chamfer × 1000", exact=True))
    assert row.locator("td").all_inner_texts() == ["45.6", "1.00", "lower"]
    page.get_by_text("metrics, with definitions").click()
    assert "Sum of two means." in page.locator("main").inner_text()
    assert page.locator("main img").count() == len(made.PICTURES)
    assert all(page.locator("main img").evaluate_all("all => all.map((each) => each.alt.length > 5)"))
    page.locator(".chart .scatterlayer .trace").first.wait_for()
    assert page.locator(".chart .panel").count() == 2
    page.get_by_role("button", name="Seconds").click()
    page.get_by_text("seconds of optimisation").first.wait_for()


def test_the_most_wrong_pixels_are_marks_that_open_their_rays(tmp_path, tab):
    folder = made.write(tmp_path, 0, folder="drawn", task="ablation")
    for picture in made.write_rays(folder, [(3, 1), (7, 3)]).glob("*.png"):
        shutil.copy(folder / "summary.png", picture)
    made.write(tmp_path, 1, folder="plain", task="ablation")
    write_index(tmp_path)
    opened = tab(tmp_path)
    page = opened.open("#/run/drawn")
    marks = page.locator(".marked .mark")
    assert marks.all_text_contents() == ["1", "2"] and page.locator(".rays li").count() == 2
    assert marks.nth(1).get_attribute("href") == "runs/drawn/rays/02.png"
    image, box = page.locator(".marked img").bounding_box(), marks.nth(0).bounding_box()
    assert box["x"] + box["width"] / 2 == pytest.approx(image["x"] + 0.4375 * image["width"], abs=2)
    assert "bench.ray" in opened.open("#/run/plain").locator("main").text_content()


def test_the_mesh_turns_under_the_mouse_and_the_keys(results, tab):
    page = tab(results).open("#/run/completion-0000")
    plot = drawn(page).first
    before = plot.screenshot()
    drag(page, plot)
    turned = plot.screenshot()
    assert turned != before
    for key in ("ArrowLeft", "+"):
        last = plot.screenshot()
        plot.press(key)
        page.wait_for_timeout(300)
        assert plot.screenshot() != last
    plot.press("Home")
    plot.evaluate("(plot) => plot.blur()")  # whose outline is part of the picture
    page.wait_for_timeout(300)
    assert plot.screenshot() == before
    page.mouse.wheel(0, -200)
    page.wait_for_timeout(300)
    assert plot.screenshot() != before
    assert "642 vertices, 1,280 triangles" in page.locator(".mesh").inner_text()


def test_a_mesh_is_shown_in_its_colours_or_in_grey(tmp_path, tab):
    ball = trimesh.creation.icosphere(2)
    ball.visual.vertex_colors = [[200, 30, 30, 255]] * len(ball.vertices)
    (made.write(tmp_path, 0) / "mesh.ply").write_bytes(ball.export(file_type="ply"))
    write_index(tmp_path)
    page = tab(tmp_path).open("#/run/completion-0000")
    plot = drawn(page).first
    red, _, blue = middle(plot)
    assert red > 2 * blue
    page.get_by_role("button", name="Grey").click()
    page.wait_for_timeout(300)
    red, green, blue = middle(plot)
    assert max(red, green, blue) < 1.2 * min(red, green, blue)


def drawn(page):
    """The meshes of a page, when they are there."""
    page.locator(".plot canvas").first.wait_for()
    page.locator(".plot").first.scroll_into_view_if_needed()
    page.wait_for_timeout(500)
    return page.locator(".plot")


def drag(page, plot):
    box = plot.bounding_box()
    page.mouse.move(box["x"] + 200, box["y"] + 100)
    page.mouse.down()
    page.mouse.move(box["x"] + 210, box["y"] + 105, steps=4)
    page.mouse.up()
    page.wait_for_timeout(500)


def middle(plot):
    """The colour of the pixel in the middle."""
    picture = Image.open(io.BytesIO(plot.screenshot())).convert("RGB")
    return picture.getpixel((picture.width // 2, picture.height // 2))


def test_a_table_sorts_and_its_chart_answers_the_mouse(results, tab):
    page = tab(results).open("#/table/speed_front")
    first = page.locator("table.list tbody th")
    assert first.all_inner_texts() == ["slow", "fast", "none"]
    page.locator('table.list [data-key="1"]').click()
    assert first.all_inner_texts() == ["fast", "slow", "none"]  # 300 ms, 12.0 s, missing last
    page.locator(".scatterlayer .point").first.wait_for()
    assert page.locator(".scatterlayer .trace").count() == 2
    page.get_by_role("button", name="dvr").click()
    page.wait_for_function("document.querySelectorAll('.scatterlayer .trace').length === 1")
    point = page.locator(".scatterlayer .point").first.bounding_box()
    page.mouse.move(point["x"] + 4, point["y"] + 4)
    page.locator(".hoverlayer .hovertext").wait_for()
    assert "slow" in page.locator(".hoverlayer").text_content()
    page.mouse.click(point["x"] + 4, point["y"] + 4)
    page.get_by_role("heading", name="DIST, sofa test 0").wait_for()


def test_a_cell_of_the_atlas_opens_its_curve_and_its_run(results, tab):
    page = tab(results).open("#/table/stability")
    page.get_by_role("button", name="wires, dist: 0.1 (0.05 to 0.2)").click()
    page.locator(".opened .scatterlayer .trace").first.wait_for()
    assert "Breakdown: 0.1 (0.05 to 0.2). The run" in page.locator(".opened").inner_text()
    assert page.locator(".opened a").get_attribute("href") == "#/run/completion-0002"
    command = "python -m bench.ray task=stability stress=wires renderer=dist level=0.5"
    assert page.locator(".opened .code pre").all_text_contents() == [command]
    assert page.locator(".thumbnails figcaption").all_inner_texts() == ["fails at 0.2"]
    assert page.locator(".thumbnails img").evaluate("image => image.naturalWidth") == 1
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Enter")
    assert "no alpha Its run is not among these results." in page.locator(".opened").inner_text()


def test_two_runs_are_compared(results, tab):
    page = tab(results).open("#/runs?view=runs")
    page.get_by_label("Compare DIST, sofa test 0").check()
    assert "Pick another run" in page.locator("#picks").inner_text()
    page.get_by_label("Compare DVR, plane test 1").check()
    page.locator("#picks a").click()
    page.get_by_role("heading", name="Settings that differ").wait_for()
    text = page.locator("main").inner_text()
    assert "renderer._label_" in text and "Not only the renderer differs: " in text and "index" in text
    row = page.get_by_role("row").filter(has=page.get_by_text("Chamfer × 1000", exact=True))
    assert row.locator("td").all_inner_texts() == ["1.00", "2.00", "2.00", "A"]
    plots = drawn(page)
    before = [plot.screenshot() for plot in plots.all()]
    drag(page, plots.first)  # both turn together
    after = [plot.screenshot() for plot in plots.all()]
    cameras = plots.evaluate_all("all => all.map((plot) => JSON.stringify(plot.layout.scene.camera.eye))")
    assert len(before) == 2 and all(a != b for a, b in zip(before, after, strict=True)) and cameras[0] == cameras[1]
    address = page.evaluate("location.hash")
    page.get_by_role("link", name="Swap").click()
    page.get_by_role("heading", name="Settings that differ").wait_for()
    assert page.evaluate("location.hash") != address


def test_the_keyboard_reaches_all_and_the_focus_is_seen(results, tab):
    page = tab(results).open("#/runs?view=runs")
    focused = set()
    for _ in range(45):
        page.keyboard.press("Tab")
        focused.add(page.evaluate("document.activeElement.tagName + '.' + (document.activeElement.type || '')"))
        outline = page.evaluate("getComputedStyle(document.activeElement).outlineStyle")
        assert outline != "none" or page.evaluate("document.activeElement === document.body")  # after the last one
    assert {"A.", "BUTTON.button", "SELECT.select-one", "INPUT.search", "INPUT.checkbox"} <= focused
    links = page.locator("#board-list tbody th a")
    links.nth(0).focus()
    page.keyboard.press("ArrowDown")
    assert page.evaluate("document.activeElement.textContent") == links.nth(1).inner_text()
    page.keyboard.press("Enter")
    page.get_by_role("heading", name="Make it again").wait_for()


def test_the_colours_are_chosen_and_kept(results, tab):
    page = tab(results, dark=True).open()
    assert page.evaluate("document.documentElement.dataset.theme") == "dark"
    page.get_by_role("button", name="Colours: as the system").click()
    assert page.evaluate("document.documentElement.dataset.theme") == "light"


def test_every_link_leads_somewhere_and_a_phone_scrolls_down_alone(results, tab):
    first_tab, phone = tab(results), tab(results, width=420, height=800)
    tables = ("#/tables", "#/table/speed_front", "#/table/stability")
    for address in ("", "#/runs", "#/runs?view=runs", "#/run/completion-0001", *tables):
        page, small = first_tab.open(address), phone.open(address)
        page.wait_for_timeout(800)
        links = page.locator("a[href]").evaluate_all("all => all.map((each) => each.getAttribute('href'))")
        assert links
        for link in links:
            assert link.startswith("#/") or link == "#main" or (results / link).is_file(), link
        assert small.evaluate("document.documentElement.scrollWidth") <= 420, address


def test_numbers_are_written_as_in_tables(results, tab):
    page = tab(results).open()
    integers = [value for value in NUMBERS if value is None or float(value).is_integer()]
    for name, values in {"number": NUMBERS, "seconds": NUMBERS, "count": integers}.items():
        wanted = [getattr(format, name)(value) for value in values]
        shown = page.evaluate(f"values => values.map((value) => implicitBench.format.{name}(value))", list(values))
        assert shown == wanted
    assert page.evaluate("[Infinity, -Infinity, NaN].map((x) => implicitBench.format.number(x))") == ["∞", "-∞", "nan"]


def test_many_runs_are_a_hundred_rows_at_a_time(tmp_path, tab):
    made.write_many(tmp_path, 3000)
    write_index(tmp_path)
    size = (tmp_path / "page" / "data" / "list" / "runs.js").stat().st_size
    page = tab(tmp_path).open("#/runs?task=all&view=runs")
    assert rows_of(page).count() == 100 and page.evaluate("document.getElementsByTagName('*').length") < 6000
    assert size < 1_500_000 and (tmp_path / "index.html").stat().st_size < 10_000
    page.locator('[data-column="renderer"]').select_option("idr")
    assert rows_of(page).count() == 100 and "of 3,000" in page.locator(".count").inner_text()
    page.get_by_role("button", name="Last »").click()
    assert 0 < rows_of(page).count() <= 100
