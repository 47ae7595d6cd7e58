import json
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest

from bench.records import format
from bench.records.read import read_records
from bench.report.write.html import write_index

ODD_NAME = "two words ünïcode 50% #1?"
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
        "evaluations": {"value": 1_430_000, "gradient": 999, "per_ray": 21.5},
        "seconds": {"warmup": 0.5, "forward": 10.0, "backward": 20.0, "evaluation": 1.0, "total": 31.5},
        "peak_memory_bytes": 2_500_000_000,
        "flops": 1e12,
        "gemm_fraction": None,
        "environment": {"commit": "abc1234", "dirty": False, "cpu": "Some CPU", "threads": 2, "device": "cpu"},
        "reused": False,
        **changed,
    }


def write_run(results: Path, content: dict | str, name: str, files: tuple[str, ...] = ()) -> Path:
    folder = results / "runs" / name
    folder.mkdir(parents=True)
    text = content if isinstance(content, str) else json.dumps(content)
    (folder / "record.json").write_text(text, encoding="utf-8")
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
    files = ("summary.png", "curve.png", "config.yaml", "curve.jsonl", "log.txt", "mesh.ply")
    write_run(results, record("plain", notes=["3 holes closed"]), "plain", files)
    write_run(results, record(ODD_NAME, started="2025-03-04T10:00:00+00:00"), ODD_NAME, files)
    write_run(results, crashed("broken", reason=HOSTILE, started="2025-03-03T10:00:00"), "broken", ("log.txt",))
    write_run(results, '{"schema": 1, "id": ', "damaged")
    write_run(results, record("future", schema=2), "future")
    (results / "runs" / "unfinished").mkdir()
    return results


class Page(HTMLParser):
    """The addresses, the anchors, the tags and the visible text of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links, self.anchors, self.tags, self.text = [], [], [], ""
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.links += [value for name, value in attributes if name in ("href", "src")]
        self.anchors += [value for name, value in attributes if name == "id"]

    def handle_data(self, data):
        self.text += data


def test_every_run_folder_appears(results):
    page = Page(write_index(results))
    for folder in (results / "runs").iterdir():
        assert folder.name in page.text
    assert "3 runs" in page.text and "Not read: 3 run folders." in page.text


def test_links_lead_to_existing_files_and_nowhere_else(results):
    page = Page(write_index(results))
    files = [link for link in page.links if not link.startswith("#")]
    for link in files:
        assert (results / unquote(link)).is_file(), link
        assert link.isascii() and not set(' ?#"') & set(link)
    for link in set(page.links) - set(files):
        assert unquote(link[1:]) in page.anchors
    linked = {unquote(link) for link in files}
    read = [path for name in ("plain", ODD_NAME, "broken") for path in (results / "runs" / name).iterdir()]
    assert linked == {path.relative_to(results).as_posix() for path in read}
    assert not {"script", "link", "iframe"} & set(page.tags)


def test_rows_are_newest_first_and_show_the_numbers(results):
    page = Page(write_index(results))
    table = page.text[page.text.index("Runs\n") : page.text.index("Details\n")]
    assert table.index(ODD_NAME) < table.index("broken") < table.index("plain")
    row = table[table.index("plain") :]
    for shown in ("45.6 → 1.23", "0.875", "∞", "31.5 s", "1.43M", "999", "21.5", "rotation_error_deg"):
        assert shown in row
    details = page.text[page.text.index("Details\n") :]
    for shown in ("Sum of two means.", "0.00123", "abc1234", "2.50 GB", "3 holes closed", "No definition recorded."):
        assert shown in details


def test_reason_is_shown_as_text(results):
    path = write_index(results)
    assert HOSTILE in Page(path).text
    assert "<script" not in path.read_text(encoding="utf-8")


def test_failed_run_without_a_reason_says_so(tmp_path):
    write_run(tmp_path, crashed("broken"), "broken")
    assert "no reason recorded" in Page(write_index(tmp_path)).text


@pytest.mark.parametrize(
    ("environment", "warned"),
    [
        ({"cpu": "Some CPU", "threads": 2, "device": "cpu"}, False),
        ({"cpu": "Some CPU", "threads": 4, "device": "cpu"}, True),
        ({"cpu": "Other CPU", "threads": 2, "device": "cpu"}, True),
        ({"cpu": "Some CPU", "threads": 2, "device": "Some GPU"}, True),
    ],
)
def test_times_of_different_machines_are_flagged(tmp_path, environment, warned):
    write_run(tmp_path, record("first"), "first")
    write_run(tmp_path, record("second", environment=environment), "second")
    assert ("machines" in Page(write_index(tmp_path)).anchors) is warned


@pytest.mark.parametrize(
    ("content", "why"),
    [
        ("", "not JSON"),
        ("[" * 100_000, "recursion"),
        ("[1]", "must hold an object, found list"),
        (json.dumps({"run": 1}), "must have schema 1, found None"),
        (json.dumps({"schema": 1}), "must have the field 'id'"),
        (json.dumps(record("x", metrics=None)), "metrics in record.json has the wrong type"),
        (json.dumps(record("x", started="yesterday")), "Invalid isoformat"),
    ],
)
def test_foreign_records_are_named_and_not_fatal(tmp_path, content, why):
    write_run(tmp_path, content, "foreign")
    write_run(tmp_path, record("sound"), "sound")
    records, problems = read_records(tmp_path)
    assert [found["folder"] for found in records] == ["sound"]
    assert len(problems) == 1 and problems[0].startswith("foreign: ") and why in problems[0]
    assert "foreign" in Page(write_index(tmp_path)).text


def test_record_that_is_not_text_is_not_fatal(tmp_path):
    (write_run(tmp_path, "", "binary") / "record.json").write_bytes(b"\xff\xfe\x00")
    assert read_records(tmp_path)[1][0].startswith("binary: ")


def test_records_come_with_numbers_notes_and_folder(results):
    first = read_records(results)[0][0]
    assert first["metrics"]["depth_mae"] == float("inf")
    assert (first["notes"], first["folder"]) == ([], ODD_NAME)


def test_no_runs_yet(tmp_path):
    assert "No run was read" in Page(write_index(tmp_path)).text


def command(*arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=False)


def test_command_prints_the_page_last(results):
    done = command("-m", "bench.report", f"results_dir={results}")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[-1] == str(results / "index.html")
    assert (results / "index.html").is_file()


@pytest.mark.parametrize("argument", ["results_dir=/no/such/folder", "result_dir=x", "results_dir="])
def test_command_refuses_what_it_does_not_know(argument):
    done = command("-m", "bench.report", argument)
    assert done.returncode == 1 and "results_dir" in done.stderr and "Traceback" not in done.stderr


def test_report_never_imports_torch():
    code = (
        "import pkgutil, importlib, sys, bench.report;"
        "[importlib.import_module('bench.report.' + m.name) for m in pkgutil.iter_modules(bench.report.__path__)];"
        "assert 'bench.report.write.html' in sys.modules; assert 'torch' not in sys.modules"
    )
    done = command("-c", code)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0123456, "0.0123"),
        (0.5, "0.500"),
        (9.996, "10.0"),
        (99.96, "100"),
        (1234.5, "1230"),
        (-12.34, "-12.3"),
        (0.00001234, "1.23e-5"),
        (1.5e9, "1.50e9"),
        (0, "0"),
        (None, "–"),
        (float("inf"), "∞"),
        (float("-inf"), "-∞"),
        (float("nan"), "nan"),
    ],
)
def test_number(value, text):
    assert format.number(value) == text


def test_number_scales():
    assert format.number(0.00123, 1000.0) == "1.23"
    assert format.number(None, 1000.0) == "–"


@pytest.mark.parametrize(
    ("value", "text"),
    [(0, "0"), (999, "999"), (999.6, "1.00k"), (1_430_000, "1.43M"), (999_999, "1.00M"), (3e12, "3.00T")],
)
def test_count(value, text):
    assert format.count(value) == text


def test_count_beyond_the_last_prefix_and_missing():
    assert (format.count(2e18), format.count(None), format.count(float("inf"))) == ("2000P", "–", "∞")


@pytest.mark.parametrize(("value", "text"), [(512, "512 B"), (1_430_000_000, "1.43 GB"), (None, "–")])
def test_size(value, text):
    assert format.size(value) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0, "0 s"),
        (0.0123, "12.3 ms"),
        (31.5, "31.5 s"),
        (600, "10.0 min"),
        (9000, "2.50 h"),
        (None, "–"),
        (float("inf"), "∞"),
    ],
)
def test_seconds(value, text):
    assert format.seconds(value) == text


def test_runs_that_differ_in_the_loss_of_the_mask_are_told_apart(tmp_path):
    for name, loss in (("one", {}), ("two", {"_label_": "DIST's mask loss"})):
        config = {"label": "IDR", "silhouette": loss}
        write_run(tmp_path, record(name, config=config), name)
    text = write_index(tmp_path).read_text()
    assert text.count("IDR, DIST&#39;s mask loss") == 1
    assert ">IDR<" in text
