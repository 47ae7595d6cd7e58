import json
import subprocess
import sys
from functools import partial
from pathlib import Path
from urllib.parse import unquote

import pytest

from bench.records import format
from bench.records.read import read_records
from bench.report.__main__ import main
from bench.report.site.columns import machine
from bench.report.write import table
from bench.report.write.html import write_index
from tests.looped import each
from tests.report.page_data import Page, script

ODD_NAME = "two words ünïcode 50% #1?"
SHOWN = (format.number, format.count, table.size, format.seconds)
HOSTILE = "<script>alert('reason')</script> & \"quotes\""


def record(name: str, **changed) -> dict:
    metrics = {"chamfer_l2": 0.00123, "fscore": 0.875, "depth_mae": "inf", "rotation_error_deg": 3.25}
    return {
        "schema": 1,
        "id": name,
        "task": "completion",
        "renderer": "dist",
        "dataset": "sofa",
        "seed": 0,
        "status": "ok",
        "reason": "",
        "started": "2025-03-01T10:00:00Z",
        "config": {"task": {"name": "completion"}},
        "metrics": metrics,
        "metrics_start": {**metrics, "chamfer_l2": 0.0456},
        "definitions": {"chamfer_l2": "Sum of two means.", "fscore": "Harmonic mean."},
        "evaluations": {"value": 1_430_000, "gradient": 999, "cost": 1_431_998, "per_ray": 21.5},
        "seconds": {"warmup": 0.5, "forward": 10.0, "backward": 20.0, "evaluation": 1.0, "total": 31.5},
        "peak_memory_bytes": 2_500_000_000,
        "flops": 1e12,
        "gemm_fraction": None,
        "environment": {"commit": "abc1234", "dirty": False, "cpu": "Some CPU", "threads": 2, "device": "cpu"},
        "reused": False,
        **changed,
    }


def write_run(results: Path, content: dict | str | bytes, name: str, files: tuple[str, ...] = ()) -> Path:
    folder = results / "runs" / name
    folder.mkdir(parents=True)
    text = json.dumps(content) if isinstance(content, dict) else content
    (folder / "record.json").write_bytes(text if isinstance(text, bytes) else text.encode())
    for file in files:
        (folder / file).write_bytes(b"")
    return folder


def crashed(name: str, **changed) -> dict:
    empty = {"metrics": {}, "metrics_start": {}, "definitions": {}, "evaluations": {}, "seconds": {}}
    unknown = {"peak_memory_bytes": None, "flops": None, "environment": {}}
    return record(name, status="crashed", **empty, **unknown, **changed)


@pytest.fixture
def results(tmp_path: Path) -> Path:
    results = tmp_path / "results of a sweep"
    files = ("summary.png", "curve.png", "config.yaml", "curve.jsonl", "log.txt", "mesh.ply", "field.safetensors")
    write_run(results, record("plain", notes=["3 holes closed"]), "plain", files)
    write_run(results, record(ODD_NAME, started="2025-03-04T10:00:00+00:00"), ODD_NAME, files)
    write_run(results, crashed("broken", reason=HOSTILE, started="2025-03-03T10:00:00"), "broken", ("log.txt",))
    write_run(results, '{"schema": 1, "id": ', "damaged")
    write_run(results, record("future", schema=2), "future")
    (results / "runs" / "unfinished").mkdir()
    return results


def page_of(results: Path) -> Page:
    write_index(results)
    return Page(results)


def test_every_run_folder_appears(results):
    page = page_of(results)
    for folder in (results / "runs").iterdir():
        assert folder.name in page.folders or any(problem.startswith(folder.name) for problem in page.about["problems"])
    assert (page.runs["count"], len(page.about["problems"])) == (3, 3)


def test_links_lead_to_existing_files_and_nowhere_else(results):
    page = page_of(results)
    for link in page.shell.links:
        assert link.startswith("#") or (results / link).is_file(), link
    linked = set()
    for folder, address, thumb in zip(page.folders, page.runs["address"], page.text("thumb"), strict=True):
        details = page.run(folder)
        links = [*details["files"].values(), *(link for _, link, _ in details["pictures"])]
        assert not thumb or f"{address}{thumb}" in links
        for link in links:
            assert (results / unquote(link)).is_file(), link
            assert link.isascii() and not set(' ?#"') & set(link)
        linked |= {unquote(link) for link in links}
    read = [path for name in ("plain", ODD_NAME, "broken") for path in (results / "runs" / name).iterdir()]
    assert linked == {path.relative_to(results).as_posix() for path in read}
    assert not {"iframe", "object", "embed", "base"} & set(page.shell.tags)


def test_rows_are_newest_first_and_show_the_numbers(results):
    page = page_of(results)
    assert page.folders == [ODD_NAME, "broken", "plain"]
    metrics, numbers = page.runs["metrics"], page.runs["numbers"]
    assert (metrics["chamfer_l2"]["before"][2], metrics["chamfer_l2"]["after"][2]) == (0.0456, 0.00123)
    assert metrics["chamfer_l2"]["factor"] == 1000.0
    assert (metrics["fscore"]["after"][2], metrics["depth_mae"]["after"][2]) == (0.875, "inf")
    assert (numbers["loop"][2], numbers["total"][2], numbers["cost"][2]) == (30.0, 31.5, 1_431_998)
    assert (metrics["chamfer_l2"]["after"][1], numbers["loop"][1]) == (None, None)
    details = page.run("plain")
    assert ["chamfer_l2", 0.0456, 0.00123, "Sum of two means.", None] in details["metrics"]
    assert ["rotation_error_deg", 3.25, 3.25, "", None] in details["metrics"]
    assert details["notes"] == ["3 holes closed"] and ["commit", "abc1234"] in details["environment"]
    assert details["costs"]["peak_memory_bytes"] == 2_500_000_000


def test_reason_is_kept_as_text_and_no_script_can_come_of_it(results):
    page = page_of(results)
    place = page.folders.index("broken")
    assert page.runs["reason"][place] == page.run("broken")["reason"] == HOSTILE
    for path in (results / "page" / "data").rglob("*.js"):
        script(path)  # holds data alone, and none of < > & that could end it


@each(
    "environment, named",
    [
        ({"cpu": "Some CPU", "threads": 2, "device": "cpu"}, "Some CPU, 2 threads"),
        ({"cpu": "Some CPU", "threads": 1, "device": "Some GPU"}, "Some CPU + Some GPU, 1 thread"),
        ({}, ""),  # a run that ended in its set-up has no machine
        ({"cpu": "Other CPU", "device": "cpu"}, ""),
    ],
)
def test_a_machine_is_named_by_what_times_depend_on(environment, named):
    assert machine(record("a", environment=environment)) == named


FOREIGN = {
    "": "not JSON",
    b"\xff\xfe\x00": "not JSON in UTF-8",
    "[" * 100_000: "recursion",
    "[1]": "must hold an object, found list",
    json.dumps({"run": 1}): "must have schema 1, found None",
    json.dumps({"schema": 1}): "must have the field 'id'",
    json.dumps(record("x", metrics=None)): "metrics in record.json has the wrong type",
    json.dumps(record("x", metrics={"chamfer_l2": "0.1 mm"})): "metrics in record.json: chamfer_l2 must be a number",
    json.dumps(record("x", metrics={"own_depth_mae": [1, 2]})): "own_depth_mae must be a number, found [1, 2]",
    json.dumps(record("x", metrics_start={"accuracy": -1})): "accuracy must be at least 0, found -1",
    json.dumps(record("x", status="splendid")): "status in record.json must be one of ok, ",
    json.dumps(record("x", started="yesterday")): "Invalid isoformat",
}


def test_foreign_records_are_named_and_not_fatal(tmp_path):
    for number, content in enumerate(FOREIGN):
        write_run(tmp_path, content, f"foreign{number:02}")
    write_run(tmp_path, crashed("broken"), "broken")
    records, problems = read_records(tmp_path)
    assert [found["folder"] for found in records] == ["broken"]
    for number, (problem, why) in enumerate(zip(problems, FOREIGN.values(), strict=True)):
        assert problem.startswith(f"foreign{number:02}: ") and why in problem
    page = page_of(tmp_path)
    assert page.about["problems"] == problems and page.runs["reason"] == ["no reason recorded"]


def test_no_runs_yet(tmp_path):
    page = page_of(tmp_path)
    assert page.runs["count"] == 0 and page.runs["tasks"] == []


def test_command_prints_the_page_last(results, capsys):
    main([f"results_dir={results}"])
    said = capsys.readouterr()
    unread = [["not read", name] for name in ("damaged", "future", "unfinished")]
    assert [line.split(": ")[:2] for line in said.err.splitlines()] == unread
    assert said.out.splitlines()[-1] == str(results / "index.html") and (results / "index.html").is_file()


@each(
    "argument, named",
    [
        ("results_dir=/no/such/folder", "there is no such folder; name one that has runs, or make a run"),
        ("result_dir=x", "argument must be one of results_dir=PATH"),
        ("results_dir=", "results_dir has no value: type results_dir=PATH"),
        ("meshes=many", "a number of runs or all"),
        ("columns=Step", "columns.PAGE=HEADING,HEADING, ship=PATH, found 'columns=Step'"),
        ("columns.table1=", "columns.table1 has no value: type columns.PAGE=HEADING,HEADING"),
    ],
)
def test_command_refuses_what_it_does_not_know(argument, named, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([argument]) == 2
    assert named in capsys.readouterr().err
    assert not list(tmp_path.iterdir())  # nothing is written before all is known to be sound


def test_report_never_imports_torch():
    code = (
        "import sys, bench.report.__main__; bench.report.write.paper.studies(); "
        "assert 'bench.studies.table1' in sys.modules and 'torch' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@each(
    "show, value, text",
    [
        (format.number, 0.0123456, "0.0123"),
        (format.number, 0.5, "0.500"),
        (format.number, 9.996, "10.0"),
        (format.number, 99.96, "100"),
        (format.number, 1234.5, "1230"),
        (format.number, 1389, "1389"),
        (format.number, 1_430_000, "1.43e6"),
        (format.number, -12.34, "-12.3"),
        (format.number, 0.00001234, "1.23e-5"),
        (format.number, 1.5e9, "1.50e9"),
        (format.number, 0, "0"),
        (format.number, float("-inf"), "-∞"),
        (format.number, float("nan"), "nan"),
        (partial(format.number, scale=1000.0), 0.00123, "1.23"),
        (format.count, 0, "0"),
        (format.count, 999, "999"),
        (format.count, 999.6, "1.00k"),
        (format.count, 1_430_000, "1.43M"),
        (format.count, 999_999, "1.00M"),
        (format.count, 2e18, "2000P"),
        (table.size, 512, "512 B"),
        (table.size, 1_430_000_000, "1.43 GB"),
        (format.seconds, 0, "0 s"),
        (format.seconds, 0.0123, "12.3 ms"),
        (format.seconds, 31.5, "31.5 s"),
        (format.seconds, 600, "10.0 min"),
        (format.seconds, 9000, "2.50 h"),
        *((show, value, text) for show in SHOWN for value, text in ((None, "–"), (float("inf"), "∞"))),
    ],
)
def test_numbers_have_three_digits_and_a_unit(show, value, text):
    assert show(value) == text


def test_a_page_that_cannot_be_written_is_an_error_of_one_line(tmp_path, capsys):
    (tmp_path / "page").write_text("")
    assert main([f"results_dir={tmp_path}"]) == 2
    said = capsys.readouterr().err
    assert "set results_dir to a folder you can write" in said and len(said.splitlines()) == 1
