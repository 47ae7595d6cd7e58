"""What of a run or a page is of an earlier version is said where it is shown."""

import subprocess
from pathlib import Path

import pytest

from bench.report.data.age import COMPILED_SINCE, UNKNOWN, drawn_by, head, notes, removed_settings
from bench.report.data.kept import read_rows
from bench.report.write.paper import SHIPPED

DVR = {"_target_": "renderers.DVR", "_label_": "DVR", "least_slope": 0.001}
HERE = {"cpu": "AMD", "device": "cpu", "threads": 1}


def record(renderer: dict | None = None, environment: dict | None = None, **more) -> dict:
    return {"config": {"renderer": renderer}, "renderer": "dvr", "environment": environment or {}, **more}


def test_a_recorded_setting_that_no_renderer_has_any_more_makes_a_row_old():
    assert removed_settings(record(DVR)) == removed_settings(record()) == []
    assert removed_settings(record(DVR | {"keep_slope_sign": True})) == []  # what this version does
    assert removed_settings(record(DVR | {"n_of_old": 3})) == ["n_of_old=3"]
    assert removed_settings(record({"_target_": "mypkg.Mine", "mine": 1})) == []
    (note,) = notes([record(DVR | {"keep_slope_sign": False})] * 2 + [record(DVR)])
    assert note.startswith("Old rows, with settings that this version does not have: DVR (2 runs with keep_slope_sign=")


def test_the_rows_of_dvr_have_the_setting_that_they_were_made_with():
    rows = read_rows(SHIPPED / "paper", "dvr_table2")
    recorded = [row["config"]["renderer"].get("keep_slope_sign") for row in rows]
    assert (recorded.count(False), recorded.count(True)) == (0, 8)
    assert not [row for row in rows if removed_settings(row)]


def test_times_of_before_the_default_engine_changed_have_a_note():
    before, after = record(environment=HERE), record(environment=HERE | {"kernels": "compiled"})
    assert notes([after]) == notes([record(environment=HERE | {"threads": 2})]) == []
    (note,) = notes([before, after])
    assert note.startswith(
        "Times of 1 of 2 runs are of earlier versions. Before 2026-11-26, PyTorch computed all field values"
    )
    assert notes([before])[0].startswith("Times are of earlier versions")


def test_restored_rows_name_the_page_that_they_are_of():
    (note,) = notes([record(restored="results/paper/tuned.csv of 98b24d7f")] * 2)
    assert note.startswith("Rows are restored from results/paper/tuned.csv of 98b24d7f, as their run folders are gone")


def test_the_version_of_a_page_is_the_commit_that_changed_it_last(tmp_path: Path):
    page = tmp_path / "page.csv"
    page.write_text("a\n")
    assert drawn_by(page) == UNKNOWN
    named = ("-c", "user.name=a", "-c", "user.email=a@example.com", "-c", "commit.gpgsign=false")
    for command in (("init", "-q"), ("add", "page.csv"), ("commit", "-qm", "page")):
        subprocess.run(["git", *named, *command], cwd=tmp_path, check=True)
    commit, _, day = drawn_by(page).partition(" of ")
    assert len(commit) >= 7 and len(day) == len(COMPILED_SINCE)


@pytest.mark.parametrize(
    ("version", "engine"), [("a of 2026-11-25", True), (f"a of {COMPILED_SINCE}", False), (UNKNOWN, False)]
)
def test_the_head_of_a_page_names_its_version_and_its_engine(version: str, engine: bool):
    assert head(version).startswith(f"Drawn by version {version}, with its statistics")
    assert ("PyTorch" in head(version)) == engine
    assert head("") == ""
