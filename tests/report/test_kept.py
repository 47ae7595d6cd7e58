"""Shipped tables are drawn anew from their rows, without run folders, and grow by later runs."""

import gzip
import shutil
from pathlib import Path

import pandas as pd
import pytest

from bench.records.read import read_records
from bench.records.record import read_record
from bench.report.__main__ import main
from bench.report.data.kept import FROM_RUNS_CSV, LOCAL_FIELDS, join, read_rows, write_rows
from bench.report.data.records import family
from tests.report.test_report_paper import DYNAMIC, NAIVE, PARALLEL, bands, costs, write_curve, write_run

pytestmark = pytest.mark.usefixtures("undrawn")


def ship(results: Path, into: Path) -> dict[str, str]:
    """The shipped tables, after the runs of a results folder were added and the folder was deleted."""
    results.mkdir(exist_ok=True)
    assert main([f"results_dir={results}", f"ship={into}"]) == 0
    shutil.rmtree(results)
    paths = sorted((into / "paper").glob("*.[cjm]*"))
    return {path.name: text_of(path) for path in paths}


def text_of(path: Path) -> str:
    content = path.read_bytes()
    return (gzip.decompress(content) if path.suffix == ".gz" else content).decode()


def test_a_table_is_drawn_anew_without_its_runs_and_grows_by_later_ones(tmp_path):
    own, into = tmp_path / "own", tmp_path / "shipped"
    for label in (PARALLEL, DYNAMIC, NAIVE):
        write_run(own, "table1", label, metrics=costs())
    failed = {"status": "oom", "reason": 'said "no", twice', "minute": 5}
    write_run(own, "table1", "DIST with mask", id="a", **failed)
    first = ship(own, into)
    assert first["table1.runs.csv.gz"].count("\n") == 5 and str(tmp_path) not in "".join(first.values())
    assert {name for name in first if name.startswith("table1")} == {
        f"table1.{kind}" for kind in ("csv", "json", "md", "runs.csv.gz")
    }
    (into / "paper" / "table1.csv").unlink()
    rows = (into / "paper" / "table1.runs.csv.gz").read_bytes()
    assert ship(own, into) == first  # nothing but the rows
    assert (into / "paper" / "table1.runs.csv.gz").read_bytes() == rows  # without a date

    write_run(own, "table1", "DIST with mask", id="a", metrics=costs(), minute=6)  # that failed at first
    for number in range(2):
        write_run(own, "table1", f"Mine {number}", id=f"mine{number}", metrics=costs(), minute=10 + number)
    grown = ship(own, into)
    assert grown["table1.csv"].count("\n") == first["table1.csv"].count("\n") + 2 and "oom" not in grown["table1.csv"]
    assert "n = 6 runs" in grown["table1.md"]


def test_a_page_that_needs_run_folders_stays_until_there_are_some(tmp_path):
    own, into = tmp_path / "own", tmp_path / "shipped"
    write_curve(write_run(own, "fig5", PARALLEL, id="a"), [4, 3, 2, 1], {0: 0.4, 2: 0.1})
    first = ship(own, into)
    stayed = ship(own, into)
    assert {name for name in first if stayed[name] != first[name]} == {"fig5.json", "fig5.md"}
    head, _, rest = stayed["fig5.md"].partition("\n\n")
    assert head.startswith("Drawn by version unknown, with its statistics") and rest == first["fig5.md"]
    assert "(drawn by unknown)" in (into / "README.md").read_text() and ship(own, into) == stayed
    for run, minute in (("b", 5), ("c", 6), ("d", 7)):
        write_curve(write_run(own, "fig5", DYNAMIC, id=run, minute=minute), [8, 6, 4, 2], {0: 0.4, 2: 0.2})
    later = ship(own, into)
    assert PARALLEL in later["fig5.runs.csv.gz"] and PARALLEL not in later["fig5.csv"] and DYNAMIC in later["fig5.csv"]
    assert "Drawn by version" not in later["fig5.md"]
    write_curve(write_run(own, "fig5", NAIVE, id="e", minute=9), [8, 6, 4, 2], {0: 0.4, 2: 0.2})
    last = ship(own, into)  # one run says less than those that the page shows
    assert NAIVE in last["fig5.runs.csv.gz"] and last["fig5.csv"] == later["fig5.csv"]


def test_rows_are_the_records_but_for_what_is_of_the_machine(tmp_path):
    settings = {"dataset": {"path": "/home/me/chair.obj"}, "stress": None, "ranges": {"a": [1, 2.5]}, "empty": {}}
    settings |= {"label": "-", "name": "", "points": "20", "of": 'a "b", c', "field": "NaN", "far": "inf"}
    write_run(tmp_path, "gradients", None, id="a", metrics=bands() | {"error": "inf"}, settings=settings)
    write_run(tmp_path, "gradients", None, id="b", settings={"stress": {"name": "dent"}}, notes=["a", "b"])
    write_run(tmp_path, "gradients", None, id="c", status="killed")
    before = read_records(tmp_path)[0]
    write_rows(before, ["gradients", "table1"], tmp_path / "paper")
    after = read_rows(tmp_path / "paper")
    assert [path.name for path in (tmp_path / "paper").iterdir()] == ["gradients.runs.csv.gz"]
    assert [one["id"] for one in after] == ["a", "b"] and family(after[0]) == family(before[-1]) == "me/chair.obj"
    assert str(tmp_path) not in text_of(tmp_path / "paper" / "gradients.runs.csv.gz")
    for record in after:
        (other,) = (one for one in before if one["id"] == record["id"])
        assert record.keys() - {FROM_RUNS_CSV} == other.keys() | {"log"}
        for part in record.keys() - {*LOCAL_FIELDS, "config"}:
            assert record[part] == other[part], part
        assert list(record["metrics"]) == list(other["metrics"])
        own = {key: value for key, value in other["config"].items() if key not in ("results_dir", "dataset")}
        assert {key: record["config"][key] for key in own} == own


def test_pandas_reads_the_rows_cell_by_cell(tmp_path):
    settings = {"label": "Mine, with a comma", "stress": None, "points": 20}
    write_run(tmp_path, "gradients", None, id="a", metrics=bands() | {"error": "inf"}, settings=settings)
    write_run(tmp_path, "gradients", None, id="b", minute=1, status="oom", settings={"stress": {"name": "dent"}})
    write_rows(read_records(tmp_path)[0], ["gradients"], tmp_path / "paper")
    table = pd.read_csv(tmp_path / "paper" / "gradients.runs.csv.gz")
    assert list(table.id) == ["a", "b"] and list(table.status) == ["ok", "oom"] and table.reused.dtype == bool
    assert table["metrics.error"].tolist()[0] == float("inf")
    assert table["config.points"].tolist()[0] == 20 and pd.isna(table["config.points"][1])
    assert table["config.label"][0] == settings["label"] and table["config.stress.name"][1] == "dent"


def test_of_the_records_of_a_run_the_newest_that_measured_counts(tmp_path):
    def record(status: str, minute: int, **more):
        folder = write_run(tmp_path, "table1", None, id="a", status=status, minute=minute)
        return read_record(folder) | more

    kept, planned, newer = record("ok", 5) | {FROM_RUNS_CSV: True}, record("killed", 7), record("oom", 6)
    assert join([planned], [kept]) == [kept] and join([newer, planned], [kept]) == [newer]
    own = {key: value for key, value in kept.items() if key != FROM_RUNS_CSV}
    assert join([own], [kept]) == [own]  # with its folder
    assert join([planned], []) == [planned]


TEXTS = ["id,started\n1\n", 'id\n"""a"""\n', 'id,started\n"""a""","""today"""\n']
DAMAGED = [gzip.compress(text.encode(), mtime=0) for text in TEXTS] + [
    b"id,started\n1\n",
    gzip.compress(bytes(99), mtime=0)[:-9],
]


@pytest.mark.parametrize("content", DAMAGED)
def test_rows_that_cannot_be_read_are_told_and_not_lost(tmp_path, capsys, content):
    path = tmp_path / "paper" / "table1.runs.csv.gz"
    path.parent.mkdir()
    path.write_bytes(content)
    write_run(tmp_path / "own", "table1", NAIVE, metrics=costs())
    assert main([f"results_dir={tmp_path / 'own'}", f"ship={tmp_path}"]) == 2
    assert "table1.runs.csv.gz cannot be read, mend it or move it away" in capsys.readouterr().err
    assert path.read_bytes() == content and not (tmp_path / "paper" / "table1.csv").exists()
