"""What a page is, and how rows are told apart: by presets, and in older records by labels."""

import subprocess
import sys
from importlib import import_module

import pytest

from bench.pictures import style
from bench.records.read import read_records
from bench.report import pages as report_pages
from bench.report.data.experiments import choose
from bench.report.data.records import Row, base_renderer, row_of
from bench.report.pages.completion import table2
from bench.report.pages.rendering import table1
from bench.report.write import paper
from bench.report.write.paper import find_paper, page_names, write_paper
from tests.report.test_report_paper import DYNAMIC, NAIVE, costs, write_run

PAGE = """
from bench.report.data.experiments import Selection
from bench.report.write.result import Result
from bench.report.write.table import IDENTITY, metric, to_data, to_table

PLACE = {place}
PLACE_AGAIN = 7
READS = (Selection("mine", ("ablation",)),)
COLUMNS = (*IDENTITY, metric("queries", "Queries"))


def make(experiment):
    lines = experiment.records
    tables = {{"data": to_data(COLUMNS, lines), "table": to_table(COLUMNS, lines)}}
    return Result(experiment, "Mine.", "Queries.", **tables)


make_again = make
"""


def record(**changed) -> dict:
    """The parts of a record of which its row is made."""
    return {"renderer": "dist", "method": "", "dataset": "car", "config": {}, **changed}


@pytest.mark.parametrize(
    ("changed", "preset", "name"),
    [
        ({"renderer": "dist_aggressive"}, "dist_aggressive", "dist_aggressive"),
        ({"renderer": "dist_capped", "config": {"renderer": {"_label_": "capped"}}}, "dist_capped", "capped"),
        ({"config": {"label": "mine", "renderer": {"_label_": "DIST"}}}, "dist", "mine"),
        ({"method": "dist_mask", "config": {"label": "DIST with mask"}}, "dist_mask", "DIST with mask"),
        ({"method": "pose_icp_plane"}, "pose_icp_plane", "dist"),
    ],
)
def test_a_row_is_its_preset_under_a_name(changed, preset, name):
    assert row_of(record(**changed)) == Row(preset, name)


@pytest.mark.parametrize(
    ("renderer", "target", "base"),
    [
        ("dist_aggressive", "renderers.DIST", "dist"),
        ("dvr", "renderers.DVR", "dvr"),
        ("mine", "mypkg.rendering.Mine", "mine"),
        ("naive", None, "naive"),
    ],
)
def test_the_base_of_a_preset_is_its_class_or_a_users_preset(renderer, target, base):
    assert base_renderer(record(renderer=renderer, config={"renderer": {"_target_": target}})) == base


def test_another_label_changes_neither_look_nor_published_numbers(tmp_path):
    write_run(tmp_path, "table1", "quick", metrics=costs(), renderer="dist_dynamic")
    write_run(tmp_path, "table1", None, metrics=costs(), renderer="a_new_one")
    made = table1.make(choose(read_records(tmp_path)[0], table1.READS[0], tmp_path))
    assert list(made.table["Strategy"]) == ["quick", "a_new_one"]
    assert list(made.table["Published queries"]) == ["1.99M", ""]


def test_the_reference_of_table_2_is_its_preset_under_any_label(tmp_path):
    for label, preset, chamfer in (("ours", "dist_mask", 0.001), ("theirs", "naive_mask", 0.002)):
        settings = {"task": {"points": "50"}}
        metrics = {"chamfer_l2": chamfer}
        write_run(tmp_path, "table2", label, task="completion", method=preset, metrics=metrics, settings=settings)
    made = table2.make_intervals(choose(read_records(tmp_path)[0], table2.READS[0], tmp_path))
    ratios = dict(zip(made.table["Method"], made.table["Ratio to the reference"], strict=True))
    assert ratios == {"ours": "", "theirs": "2.00 (n = 1)"}


def test_two_presets_under_one_label_are_two_rows(tmp_path):
    for preset, queries in (("dist", 5), ("mine", 7)):
        write_run(tmp_path, "table1", "same", metrics=costs(queries), renderer=preset)
    made = table1.make(choose(read_records(tmp_path)[0], table1.READS[0], tmp_path))
    assert list(made.data["queries"]) == [5, 7]


def test_a_preset_that_nobody_listed_has_a_look_of_its_own():
    new = [style.look(name) for name in ("mine", "yours")]
    assert new == [style.look(name) for name in ("mine", "yours")]
    assert new[0] != new[1]


def test_a_page_is_found_by_its_file(tmp_path, monkeypatch):
    pages = tmp_path / "pages"
    (pages / "rendering").mkdir(parents=True)
    (pages / "mine.py").write_text(PAGE.format(place=5))
    (pages / "rendering" / "table1.py").write_text("PLACE = 10\n")  # in a room
    monkeypatch.setattr(paper, "PAGES", pages)
    monkeypatch.setattr(report_pages, "__path__", [str(pages), *report_pages.__path__])
    page_names.cache_clear()
    try:
        assert list(page_names()) == ["mine", "mine_again", "table1"]
        write_run(tmp_path, "table1", DYNAMIC, metrics=costs())
        write_run(tmp_path, "mine", NAIVE, metrics=costs(3))
        written = write_paper(read_records(tmp_path)[0], tmp_path)
        assert [path.name for path in written] == ["mine.csv", "mine_again.csv", "table1.csv"]
        assert [found["name"] for found in find_paper(tmp_path)] == ["mine", "mine_again", "table1"]
        (pages / "lost.py").write_text("READS = ()\n")
        page_names.cache_clear()
        with pytest.raises(ValueError, match=r"lost\.py must have a line such as PLACE = 10"):
            page_names()
    finally:
        page_names.cache_clear()


def test_every_page_has_a_place_of_its_own_and_says_what_it_reads():
    pages = {name: (import_module(f"bench.report.pages.{file}"), make) for name, (file, make) in page_names().items()}
    places = [getattr(page, make.replace("make", "PLACE").upper()) for page, make in pages.values()]
    assert len(pages) >= 23 and places == sorted(set(places))
    assert all(page.READS and callable(getattr(page, make)) for page, make in pages.values())


def test_finding_the_files_loads_no_page():
    code = (
        "import sys; from bench.report.write.paper import page_names; page_names(); print('matplotlib' in sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"
