"""A results folder of another person: its texts are not executed, and nothing leaves the folder."""

import json

import numpy as np
import pytest

from bench.report.write.html import write_index
from tests.browser import made

pytestmark = pytest.mark.browser

ATTACKS = (
    "<script>window.hacked = 1; alert(1)</script>",
    "</script><script>window.hacked = 1</script>",
    '"><img src=x onerror="window.hacked = 1">',
    "<svg/onload=window.hacked=1>",
    "javascript:window.hacked=1",
    '<a href="javascript:window.hacked=1">click</a>',
    "../../../../etc/passwd",
    "http://127.0.0.1:9/asked.png",
    "');window.hacked=1;('",
    "${window.hacked=1}`",
    "\u2028window.hacked=1\u2029",
    "<!--<script>",
    "*<b onmouseover=window.hacked=1>*",
    "__proto__",
)
FOLDERS = (
    '"><img src=x onerror="window.hacked=1">',
    "javascript:window.hacked=1",
    "a\u2028b\nc",
    "%2e%2e%2f%2e%2e%2fetc",
    "<!--",
    "__proto__",
)
MALICE = " ".join(ATTACKS)


@pytest.fixture(scope="module")
def strange(tmp_path_factory):
    """Runs in which every text is an attack, with pictures, curves, meshes and tables whose texts are, too."""
    results = tmp_path_factory.mktemp("strange") / "results"
    for number, attack in enumerate(ATTACKS):
        made.write(results, number, folder=f"status-{number}", status=attack)  # not read, and named
        folder = FOLDERS[number] if number < len(FOLDERS) else f"run-{number}"
        path = made.write(
            results,
            number,
            folder=folder,
            **{
                field: attack
                for field in ("id", "task", "renderer", "dataset", "scene", "reason", "method", "code", "config_hash")
            },
            status="ok" if number % 2 else "crashed",
            notes=[attack, MALICE],
            log=[attack],
            overrides=[f"task={attack}", attack],
            config={attack: attack, "label": attack, "experiment": attack, "task": {attack: {attack: [attack]}}},
            metrics={attack: 1.0, "chamfer_l2": 0.1, "words": attack},
            metrics_start={attack: 2.0},
            definitions={attack: attack, "chamfer_l2": attack},
            evaluations={attack: 3, "value": attack},
            seconds={attack: 1.0, "total": 2.0, "forward": attack},
            environment={attack: attack, "cpu": attack, "device": attack, "threads": attack},
        )
        line = {"iteration": 0, "seconds": 0, "total": 1.0, attack: 2.0}
        (path / "curve.jsonl").write_text(json.dumps(line) + "\n" + json.dumps(line | {"iteration": 1}) + "\n")
        (path / f"{'<img src=x onerror=window.hacked=1>'[: 20 + number % 5]}.png").write_bytes(
            (path / "curve.png").read_bytes()
        )
        (path / "rays").mkdir()
        ray = {"column": 1, "row": 1, "texts": [MALICE]}
        (path / "rays" / "rays.json").write_text(json.dumps({"width": 4, "height": 4, "map": attack, "rays": [ray]}))
        for name in ("01.png", "pixels.png"):
            (path / "rays" / name).write_bytes((path / "curve.png").read_bytes())
        content = (path / "mesh.ply").read_bytes()
        if number == 1:
            (path / "mesh.ply").write_bytes(
                content.replace(b"element vertex", f"comment {MALICE}\nelement vertex".encode())
            )
        if number == 2:
            (path / "mesh.ply").write_bytes(content[:-40])
    write_tables(results)
    write_index(results)
    return results


def write_tables(results):
    """Tables and figures whose names, captions, cells, questions, charts and atlas are attacks."""
    paper = results / "paper"
    paper.mkdir(exist_ok=True)
    series = {"name": MALICE, "colour": MALICE, "symbol": MALICE, "x": [1, 2], "y": [1, 2]}
    series |= {"text": [[MALICE], [MALICE]], "link": ["javascript:window.hacked=1", MALICE]}
    axis = {"title": MALICE, "log": False}
    chart = {
        "panels": [{"title": MALICE, "x": axis, "y": axis, "series": [series], "images": [{"source": ATTACKS[7]}]}]
    }
    cell = {"mark": MALICE, "full": MALICE, "shade": 0.5, "status": MALICE, "reason": MALICE, "folder": MALICE}
    cell["ray"] = {"command": MALICE, "breaks": 0.5, "works": MALICE}
    atlas = {
        "axes": [{name: MALICE for name in ("axis", "title", "group", "unit")}],
        "rows": [MALICE],
        "cells": [[cell]],
    }
    for name in ("table1", "stability", "stability_curves", '"><img src=x onerror=window.hacked=1>', "javascript:1"):
        (paper / f"{name}.csv").write_text(f"{MALICE!r},status\n{MALICE!r},ok\n")
        shown = {key: MALICE for key in ("title", "caption", "question", "verdict")} | {"notes": [MALICE]}
        shown |= {"columns": [MALICE, "b"], "rows": [[MALICE, "1"]], "experiments": [MALICE], "chart": chart}
        shown |= {"atlas": atlas} if name == "stability" else {}
        (paper / f"{name}.json").write_text(json.dumps(shown))


def addresses(page) -> list[str]:
    runs, papers = (
        page.evaluate(f"implicitBench.{what}")
        for what in (
            "runs.count && [...Array(implicitBench.runs.count).keys()].map((place) => implicitBench.runs.link(place))",
            "store.have('list', 'papers').map((paper) => implicitBench.address.to(['table', paper.name]))",
        )
    )
    pair = page.evaluate(
        "implicitBench.address.to(['compare', implicitBench.runs.name(0), implicitBench.runs.name(1)])"
    )
    return ["", "#/runs?task=all&view=runs", "#/runs?task=all", *runs, *papers, pair]


def test_no_text_of_a_stranger_runs_or_leads_away(strange, tab):
    first_tab = tab(strange)
    page = first_tab.open()
    for address in addresses(page):
        page = first_tab.open(address)
        page.wait_for_timeout(250)
        assert page.evaluate("window.hacked") is None, address
        assert page.evaluate("({}).polluted") is None
        assert (
            page.locator("main script, main iframe, main svg[onload], main [onerror], main [onmouseover]").count() == 0
        )
        for link in page.locator("main a[href], main img[src]").evaluate_all(
            "all => all.map((each) => each.getAttribute('href') ?? each.getAttribute('src'))"
        ):
            inside = (strange / link).resolve().is_relative_to(strange.resolve())
            assert link.startswith("#/") or (link.startswith(("runs/", "paper/")) and inside), link
    page.evaluate(
        "document.querySelectorAll('main a, main button').forEach((each) => each.dispatchEvent(new Event('mouseover')))"
    )
    assert page.evaluate("window.hacked") is None


def test_each_run_of_a_stranger_is_shown_as_text(strange, tab):
    first_tab = tab(strange)
    page = first_tab.open("#/runs?task=all&view=runs")
    assert page.locator("#board-list tbody tr").count() == len(ATTACKS)
    text = page.locator("#board-list").text_content()
    for attack in ATTACKS:
        assert attack in text
    unread = page.locator("#not-read").text_content()
    assert unread.count("status in record.json must be one of") == len(ATTACKS) and "hacked" in unread
    page = first_tab.open(page.evaluate("implicitBench.runs.link(0)"))
    page.get_by_role("heading", name="Make it again").wait_for()
    assert "hacked" in page.locator("main").text_content()


def test_a_script_within_the_page_is_refused_by_its_policy(tmp_path, tab):
    """The second protection: the browser does not execute markup that reaches the page."""
    made.write(tmp_path, 0)
    write_index(tmp_path)
    first_tab = tab(tmp_path)
    page = first_tab.open()
    page.evaluate("document.body.insertAdjacentHTML('beforeend', '<img src=x onerror=\"window.hacked=1\">')")
    page.evaluate(
        "const made = document.createElement('script'); made.textContent = 'window.hacked = 1'; "
        "document.body.append(made)"
    )
    page.evaluate("document.body.append(Object.assign(new Image(), {src: 'http://127.0.0.1:9/asked.png'}))")
    page.wait_for_timeout(300)
    assert page.evaluate("window.hacked") is None
    refused = [message for message in first_tab.wrong if "Content Security Policy" in message]
    assert len(refused) >= 3  # the handler, the script and the picture
    first_tab.wrong.clear()


def test_numbers_beyond_a_float_and_odd_meshes_are_words(tmp_path, tab):
    made.write(tmp_path, 0, metrics={"chamfer_l2": 10**400, "fscore": True, "depth_mae": "nan"}, flops=10**400)
    path = made.write(tmp_path, 1) / "mesh.ply"
    path.write_bytes(path.read_bytes().replace(b"element vertex 642", b"element vertex 4000000000"))
    np.savez(tmp_path / "runs" / "completion-0001" / "images.npz", hit=np.zeros(2))
    write_index(tmp_path)
    page = tab(tmp_path).open("#/run/completion-0001")
    page.get_by_text("PLY is unexpected length").wait_for()


def test_an_address_leads_into_the_folder_or_nowhere(tmp_path, tab):
    made.write(tmp_path, 0)
    write_index(tmp_path)
    page = tab(tmp_path).open()
    good = ["#/runs", "runs/a/summary.png", "paper/table1.csv", "page/shipped/fig5.png", "data:image/webp;base64,AAAA"]
    bad = [
        "javascript:1",
        "../a",
        "runs/../../a",
        "runs/%2e%2e/%2E%2e/a",
        "http://a/runs/",
        "//a/runs/",
        "file:///etc/passwd",
        "/etc",
        "page/data/a.js",
    ]
    bad += ["data:text/html;base64,AAAA", "data:image/svg+xml;base64,AAAA", "runs/a:b", " javascript:1", "runs/\\..\\a"]
    allowed = page.evaluate("all => all.map((each) => implicitBench.dom.safeAddress(each))", [*good, *bad])
    assert allowed == [*good, *([None] * len(bad))]
