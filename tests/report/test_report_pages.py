"""What a page is, and how rows are told apart: by presets, and in older records by labels."""

import math
import os
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import bench.studies
from bench.records.read import read_records
from bench.report.data.records import Row, base_renderer, row_of
from bench.report.data.runs import Selection, choose
from bench.report.write import html, paper, table
from bench.report.write.caption import SMOKE_WARNING
from bench.report.write.paper import find_paper, papers, studies, write_paper
from bench.report.write.result import Result, Shown, read_shown
from bench.studies import table1
from tests.looped import each
from tests.report.test_report_paper import DYNAMIC, NAIVE, costs, write_run

STUDY = """
from bench.report.study import Result, Selection, table

PLACE = {place}
READS = (Selection("mine"),)
COLUMNS = (*table.IDENTITY, table.metric("queries", "Queries"))


def make(runs):
    return Result(runs, "Mine.", "Queries.", columns=COLUMNS, lines=runs.records)


PAGES = {{"mine": make, "mine_again": make}}
"""


def record(**changed) -> dict:
    """The parts of a record of which its row is made."""
    return {"renderer": "dist", "method": "", "dataset": "car", "config": {}, **changed}


@each(
    "changed, preset, name",
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


@each(
    "renderer, target, base",
    [
        ("dist_aggressive", "renderers.DIST", "dist"),
        ("dvr", "renderers.DVR", "dvr"),
        ("mine", "mypkg.rendering.Mine", "mine"),
        ("naive", None, "naive"),
    ],
)
def test_the_base_of_a_preset_is_its_class_or_a_users_preset(renderer, target, base):
    assert base_renderer(record(renderer=renderer, config={"renderer": {"_target_": target}})) == base


def test_two_presets_under_one_label_are_two_rows(tmp_path):
    for preset, queries in (("dist", 5), ("mine", 7)):
        write_run(tmp_path, "table1", "same", metrics=costs(queries), renderer=preset)
    made = table1.make(choose(read_records(tmp_path)[0], table1.READS[0], tmp_path), None)
    assert list(made.data["queries"]) == [5, 7] and list(made.data["row"]) == ["same, dist", "same, mine"]


def test_a_mistyped_metric_is_an_error_with_the_nearest_name(tmp_path):
    write_run(tmp_path, "mine", "A", metrics={"hits": 3})
    runs = choose(read_records(tmp_path)[0], Selection("mine"), tmp_path)
    with pytest.raises(ValueError, match=r"no run of the experiment mine has a metric 'hist': did you mean hits\?"):
        runs.number("hist")
    with pytest.raises(ValueError, match=r"has a setting 'task\.pionts'"):
        runs.number("config.task.pionts")
    with pytest.raises(ValueError, match=r"did you mean hits\?"):
        Result(runs, "T.", "P.", columns=[table.metric("hist", "Pixels")], lines=runs.records)


def test_a_mistyped_experiment_is_a_problem_with_the_nearest_name(tmp_path, monkeypatch):
    mine = paper.Study(1, (Selection("tabel2"),), {"mine": lambda runs: runs})
    monkeypatch.setattr(paper, "studies", lambda: (mine,))
    problems: list[str] = []
    assert write_paper([], tmp_path, problems=problems) == []
    (problem,) = problems
    assert "mine (ValueError: no run and no file of conf/experiment has experiment: tabel2: did you mean" in problem


def test_a_study_is_found_by_its_file_and_one_that_cannot_be_read_costs_no_other(tmp_path, monkeypatch):
    folder = tmp_path / "studies"
    folder.mkdir()
    (folder / "mine.py").write_text(STUDY.format(place=5))
    (folder / "broken.py").write_text("import nonsense_module\n")
    (folder / "twice.py").write_text(STUDY.format(place=6))
    monkeypatch.setattr(paper, "STUDIES", folder)
    monkeypatch.setattr(bench.studies, "__path__", [str(folder)])
    studies.cache_clear()
    try:
        write_run(tmp_path, "mine", NAIVE, metrics=costs(3))
        problems: list[str] = []
        written = [path.name for path in write_paper(read_records(tmp_path)[0], tmp_path, problems=problems)]
        assert written == ["mine.csv", "mine_again.csv"] and len(problems) == 2
        assert problems[0].startswith("not made: bench/studies/broken.py (ModuleNotFoundError: ")
        assert problems[1].startswith("not made: bench/studies/twice.py (ValueError: another study has a page mine: ")
        assert [found.name for found in find_paper(tmp_path) if not found.shipped] == ["mine", "mine_again"]
    finally:
        studies.cache_clear()
        for name in ("mine", "twice"):
            sys.modules.pop(f"bench.studies.{name}", None)


@pytest.mark.parametrize("caption", [False, True])
def test_a_study_that_cannot_be_made_costs_no_other_table(tmp_path, monkeypatch, caption):
    write_run(tmp_path, "table1", NAIVE, metrics=costs(3))
    write_run(tmp_path, "fig4", NAIVE, metrics=costs(3))
    broken = next(study for study in studies() if "fig4" in study.pages)
    made = broken.pages["fig4"]
    late = lambda runs: replace(made(runs), estimates=map({}.__getitem__, ["lost"]), interval="one")  # noqa: E731
    monkeypatch.setitem(broken.pages, "fig4", late if caption else lambda runs: {}["lost"])
    problems: list[str] = []
    written = [path.name for path in write_paper(read_records(tmp_path)[0], tmp_path, problems=problems)]
    assert written == ["table1.csv"] and problems == ["not made: fig4 (KeyError: 'lost')"]


def test_shipped_rows_stand_below_ones_own_where_the_columns_are_alike(tmp_path, monkeypatch):
    own, shipped = tmp_path / "own" / "paper", tmp_path / "shipped" / "paper"
    monkeypatch.setattr(paper, "SHIPPED", shipped.parent)
    for folder, row in ((own, "mine"), (shipped, "ours")):
        folder.mkdir(parents=True)
        for name, last in (("alike", "Error"), ("other", f"Error of {row}")):
            shown = Shown(title="T.", columns=["Row", last], rows=[[row, "1"]])
            (folder / f"{name}.json").write_text(shown.to_json())
    entries, wholes, _ = papers(own.parent)
    rows = {entry["name"]: wholes[entry["key"]]["rows"] for entry in entries}
    assert rows == {"alike": [["mine", "1"], ["shipped: ours", "1"]], "other": [["mine", "1"]]}


def test_a_page_of_a_sweep_of_the_user_has_the_time_of_its_request(tmp_path, monkeypatch):
    own, shipped = tmp_path / "own", tmp_path / "shipped"
    monkeypatch.setattr(paper, "SHIPPED", shipped)
    for folder, name in ((own, "asked"), (own, "old"), (shipped, "theirs")):
        (folder / "paper").mkdir(parents=True, exist_ok=True)
        shown = Shown(title="T.", experiments=["table1"] if name != "old" else ["fig4"])
        (folder / "paper" / f"{name}.json").write_text(shown.to_json())
    for plan, seconds in (("table1-0abc", 10), ("table1-1abc", 20), ("other-2abc", 30)):
        (own / "sweeps" / plan).mkdir(parents=True)
        (own / "sweeps" / plan / "plan.json").write_text("{}")
        os.utime(own / "sweeps" / plan / "plan.json", (seconds, seconds))
    (own / "sweeps" / "other-2abc" / "table.json").write_text(Shown(title="T.").to_json())
    times = {entry["name"]: entry["asked"] for entry in papers(own)[0]}
    assert times == {"asked": 20, "old": 0, "theirs": 0, "other-2abc": 30}


def test_shipped_pages_without_a_chart_have_a_copy_of_their_picture(tmp_path, monkeypatch):
    own, shipped = tmp_path / "own", tmp_path / "shipped"
    monkeypatch.setattr(paper, "SHIPPED", shipped)
    own.mkdir()
    (shipped / "paper").mkdir(parents=True)
    for name, chart in (("drawn", None), ("charted", {"panels": []})):
        (shipped / "paper" / f"{name}.json").write_text(Shown(title="T.", chart=chart).to_json())
        (shipped / "paper" / f"{name}.png").write_bytes(name.encode())
    (own / "page" / "shipped").mkdir(parents=True)
    (own / "page" / "shipped" / "former.png").write_bytes(b"")
    html.write_index(own)
    pictures = {page.name: page.picture for page in find_paper(own)}
    assert pictures == {"drawn": "page/shipped/drawn.png", "charted": None}
    assert [path.read_bytes() for path in (own / "page" / "shipped").iterdir()] == [b"drawn"]


def test_every_study_can_be_read_and_has_pages_of_its_own():
    assert [study.problem for study in studies() if study.problem or not study.reads] == []
    assert sum(len(study.pages) for study in studies()) >= 23


@each("conditions, resolutions", [((), [32]), (("view.resolution",), [16, 32])])
def test_sizes_are_cells_of_a_row_if_the_study_says_so(tmp_path, conditions, resolutions):
    for minute, resolution in enumerate((16, 32)):
        settings = {"view": {"resolution": resolution}}
        write_run(tmp_path, "sizes", DYNAMIC, metrics=costs(), minute=minute, settings=settings)
    runs = choose(read_records(tmp_path)[0], Selection("sizes", conditions), tmp_path)
    assert sorted(record["config"]["view"]["resolution"] for record in runs.records) == resolutions


def test_a_run_that_failed_stays_a_row_and_the_newest_of_a_cell_counts(tmp_path):
    write_run(tmp_path, "table1", DYNAMIC, metrics=costs(5), minute=1)
    write_run(tmp_path, "table1", DYNAMIC, metrics=costs(7), minute=2)
    write_run(tmp_path, "table1", NAIVE, status="timeout", reason="too slow", minute=1)
    smoke = {"scale": {"name": "smoke"}}
    write_run(tmp_path, "table1", NAIVE, metrics=costs(1), settings=smoke, minute=0)
    runs = choose(read_records(tmp_path)[0], table1.READS[0], tmp_path)
    assert list(runs.frame.row) == [DYNAMIC, NAIVE] and list(runs.frame.status) == ["ok", "timeout"]
    assert list(runs.error("queries", 1.0)) == [7.0, math.inf] and runs.left_out.total() == 2


PAPER = Path(__file__).parents[2] / "results" / "paper"
PICTURES = {
    *("single_view_figures", "completion_gallery", "misplaced_gallery", "stability_curves"),
}


def test_every_shipped_page_has_a_question_and_a_verdict_with_a_number():
    for path in PAPER.glob("*.json"):
        shown, name = read_shown(path), path.stem
        assert shown.title.endswith(".") and shown.caption and (shown.rows or shown.drawn or shown.chart), name
        assert all(len(row) == len(shown.columns) for row in shown.rows), name
        if name in PICTURES:
            continue
        assert shown.question.endswith("?") and shown.verdict.endswith("."), name
        marked = shown.verdict.split("*")[1::2]
        assert marked and all(any(c.isdigit() for c in part) for part in marked), name
        assert shown.verdict.count("*") % 2 == 0 and "nan" not in shown.verdict and len(shown.verdict) < 400, name


def test_a_verdict_of_scale_smoke_is_that_nothing_follows(tmp_path):
    for label in ("quick", "slow"):
        write_run(tmp_path, "table1", label, metrics=costs(), settings={"scale": {"name": "smoke"}})
    write_paper(read_records(tmp_path)[0], tmp_path)
    shown = read_shown(tmp_path / "paper" / "table1.json")
    assert (
        shown.verdict == SMOKE_WARNING
        and shown.question.endswith("?")
        and shown.experiments == ["table1", "table1_large"]
    )


@each("text", ["", "[1]", '{"verdict": 1, "chart": []}', "[" * 100_000])
def test_an_odd_file_beside_a_table_adds_nothing(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    assert read_shown(tmp_path / "a.json") == Shown()
