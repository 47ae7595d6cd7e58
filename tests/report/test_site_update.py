"""A run that ends writes its part of the page, which is then as if all had been written anew."""

import json
import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from bench.records.read import Plan, PlannedCell
from bench.report.site import known
from bench.report.write import runs
from bench.report.write.html import update_index, write_index
from tests.browser import made
from tests.report.page_data import Page


@pytest.fixture
def results(tmp_path):
    """Three runs with a page, and a sweep of which a cell is planned."""
    folder = tmp_path / "results"
    for number in range(3):
        made.write(folder, number)
    cell = PlannedCell("planned", [], "completion", "dvr", "plane", 0, {"seed": 0, "index": 0})
    Plan("sweep", folder, [cell], asked="2025-03-03T10:00:00Z").write()
    write_index(folder)
    return folder


@pytest.fixture
def read(monkeypatch):
    """The names of what is read: folders of runs, and plans."""
    names: list[str] = []
    for function in ("read_run", "read_plan"):
        original = getattr(runs, function)
        noted = lambda path, results_dir, of=original: (names.append(path.name), of(path, results_dir))[1]  # noqa: E731
        monkeypatch.setattr(runs, function, noted)
    return names


def content(results: Path) -> dict[str, bytes]:
    """All files of the page but the one that is not shown."""
    files = [path for path in (results / "page").rglob("*") if path.is_file() and path.name != known.FILE]
    return {path.relative_to(results).as_posix(): path.read_bytes() for path in files}


def assert_as_anew(results: Path) -> None:
    """The page is that which is written of all runs."""
    shown = content(results)
    write_index(results)
    assert shown == content(results)


def test_a_run_that_ends_is_read_alone(results, read):
    made.write(results, 3, config={"renderer": {"_label_": "NEWTON", "steps": 20}, "seed": 1})
    update_index(results)
    assert read == ["completion-0003"]
    assert set(Page(results).folders) == {*(f"completion-{n:04}" for n in range(4)), "planned"}
    assert "vertices" in Page(results).read("mesh", Page(results).runs["key"][0])
    assert_as_anew(results)


def test_nothing_is_read_where_nothing_has_changed(results, read):
    update_index(results)
    update_index(results)
    assert read == []
    assert_as_anew(results)


def test_a_name_follows_from_runs_that_came_later(results):
    swept = {"task": {"name": "completion"}, "renderer": {"_label_": "DIST", "steps": 20}}
    made.write(results, 5, config=swept)
    update_index(results)
    page = Page(results)
    assert page.text("name")[page.folders.index("completion-0000")] == "DIST, steps 50"
    assert_as_anew(results)


def test_what_has_changed_or_is_gone_is_read_again(results, read):
    changed, gone, pictured = (results / "runs" / f"completion-{n:04}" for n in range(3))
    record = json.loads((changed / "record.json").read_text()) | {"status": "timeout", "reason": "too long"}
    (changed / "record.json").write_text(json.dumps(record))
    shutil.rmtree(gone)
    (pictured / "summary.png").unlink()
    update_index(results)
    assert sorted(read) == [changed.name, pictured.name]
    page = Page(results)
    assert page.folders == ["completion-0002", "planned", "completion-0000"]
    assert page.text("status")[2] == "timeout" and page.text("thumb")[0] == ""
    assert_as_anew(results)


def test_a_planned_cell_that_runs_has_one_entry_and_one_that_is_planned_anew_is_there(results, read):
    made.write(results, 7, folder="planned")
    cells = [PlannedCell(name, [], "completion", "dvr", "plane", 0, {"seed": 0}) for name in ("planned", "next")]
    Plan("sweep", results, cells, asked="2025-03-04T10:00:00Z").write()
    update_index(results)
    assert sorted(read) == ["plan.json", "planned"]
    assert sorted(Page(results).folders) == [*(f"completion-{n:04}" for n in range(3)), "next", "planned"]
    assert_as_anew(results)


def test_a_script_that_another_put_there_is_written_anew_whatever_its_times(results):
    script = results / "page" / "data" / "run" / f"{Page(results).runs['key'][0]}.js"
    mesh = results / "page" / "data" / "mesh" / script.name
    for path in (script, mesh):
        before = path.stat()
        path.write_bytes(b"evil();".ljust(before.st_size))
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    update_index(results)
    assert b"evil" not in script.read_bytes() + mesh.read_bytes()
    assert_as_anew(results)


def test_a_folder_that_was_copied_is_read_anew(results, read, tmp_path):
    copied = shutil.copytree(results, tmp_path / "copied")
    (script,) = (copied / "page" / "data" / "run").glob(f"{Page(results).runs['key'][0]}.js")
    script.write_text("evil();")
    line = json.dumps({"code": known._code(), "results_dir": copied.as_posix()})
    kept = (copied / "page" / known.FILE).read_text().split("\n", 1)[1]
    (copied / "page" / known.FILE).write_text(f"{line}\n{kept}")  # as one would forge it
    update_index(copied)
    assert len(read) == 4 and "evil" not in script.read_text()


def test_a_link_in_the_place_of_a_script_is_replaced_though_it_leads_to_the_same(results, tmp_path):
    folder, name = results / "page" / "data", f"{Page(results).runs['key'][0]}.js"
    for part in ("run", "mesh"):
        (folder / part / name).rename(tmp_path / part)
        (folder / part / name).symlink_to(tmp_path / part)
    update_index(results)
    for part in ("run", "mesh"):
        (tmp_path / part).write_text("evil();")
        assert not (folder / part / name).is_symlink()
    update_index(results)
    assert "evil" not in "".join((folder / part / name).read_text() for part in ("run", "mesh"))


@pytest.mark.parametrize("name", ["curve.jsonl", "mesh.ply"])
def test_a_file_that_grows_in_its_place_is_read_again(results, read, name):
    folder = results / "runs" / "completion-0001"
    text = (folder / name).read_bytes()
    (folder / name).write_bytes(text + text.splitlines(keepends=True)[-1])
    update_index(results)
    assert read == [folder.name]


def test_cells_that_two_plans_share_are_read_once(results, read):
    cell = PlannedCell("planned", [], "completion", "dvr", "plane", 0, {"seed": 0, "index": 0})
    Plan("sweep-again", results, [cell], asked="2025-03-05T10:00:00Z").write()
    update_index(results)
    read.clear()
    update_index(results)
    assert read == []


@pytest.mark.parametrize("line", [{"kind": "run", "name": "completion-0000"}, {"kind": "other", "name": ""}, 3])
def test_lines_of_another_form_are_not_believed(results, read, line):
    path = results / "page" / known.FILE
    with path.open("a") as file:
        file.write(json.dumps(line) + "\n")
    update_index(results)
    assert len(read) == 4
    assert_as_anew(results)


@pytest.mark.parametrize("spoilt", [lambda text: text[:-20], lambda text: "", lambda text: text.replace("kind", "x")])
def test_what_is_known_may_be_spoilt(results, read, spoilt):
    path = results / "page" / known.FILE
    path.write_text(spoilt(path.read_text()))
    update_index(results)
    assert len(read) == 4
    assert_as_anew(results)
    read.clear()
    update_index(results)
    assert read == []


def test_it_is_not_written_through_a_link(results, tmp_path):
    path, outside = results / "page" / known.FILE, tmp_path / "outside"
    path.rename(outside)
    path.symlink_to(outside)
    before = outside.read_bytes()
    made.write(results, 4)
    update_index(results)
    assert outside.read_bytes() == before and not path.is_symlink()


def test_what_is_known_does_not_grow_without_end(results, monkeypatch):
    monkeypatch.setattr(known, "FEW", 0)
    path = results / "page" / known.FILE
    record = results / "runs" / "completion-0000" / "record.json"
    lines = []
    for _ in range(20):
        record.write_text(record.read_text() + " ")
        update_index(results)
        lines.append(path.read_text().count("\n"))
    assert max(lines) <= 2 * min(lines) and lines != sorted(lines)


def test_runs_that_end_at_the_same_time_are_both_there(results):
    def end(number: int) -> None:
        made.write(results, number)
        update_index(results)

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(end, range(10, 14)))
    assert {f"completion-{n:04}" for n in range(10, 14)} <= set(Page(results).folders)
    assert_as_anew(results)
