"""The results of several machines become one folder, in any order, also repeatedly."""

import json
from itertools import permutations
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st

from bench.merge import main, merge
from bench.records.read import read_records
from bench.records.results import Plan
from bench.report.__main__ import main as report
from bench.report.suite.attempts import attempts_folder
from tests.looped import each
from tests.runner.driving import planned, stored

CELLS = ("completion-dist-sofa-1", "completion-dist-sofa-2", "completion-dvr-car-3")


def write_run(
    results: Path, cell: str, status: str = "ok", started: str = "2026-01-01T00:00:00+00:00", **changed
) -> Path:
    folder = stored(results, cell, status, **{"started": started, "asked": started} | changed)
    (folder / "curve.jsonl").write_text(f'{{"iteration": 0, "total": {len(started)}}}\n')
    return folder


def content(results: Path) -> dict[str, bytes]:
    """All files, except the page, which contains the name of its folder, and locks."""
    return {
        str(path.relative_to(results)): path.read_bytes()
        for path in results.rglob("*")
        if path.is_file() and path.name != "index.html" and not {".locks", "page"} & set(path.parts)
    }


def test_runs_of_different_cells_are_joined(tmp_path, capsys):
    for name, cell in zip("abc", CELLS, strict=True):
        write_run(tmp_path / name, cell)
    assert main([*(str(tmp_path / name) for name in "abc"), "--into", str(tmp_path / "d")]) == 0
    assert capsys.readouterr().out.splitlines() == [str(tmp_path / "d" / "index.html")]
    records, problems = read_records(tmp_path / "d")
    assert problems == [] and {record["id"] for record in records} == set(CELLS)
    for name, cell in zip("abc", CELLS, strict=True):
        assert content(tmp_path / name / "runs" / cell) == content(tmp_path / "d" / "runs" / cell)


@st.composite
def machines(draw):
    """Three machines with two cells each: no run, or a run with one of a few statuses and times."""
    ends = st.sampled_from(["ok", "timeout", "killed", "crashed", "refused"])
    times = st.sampled_from(["2026-01-01T00:00:00+00:00", "2026-01-02T00:00:00+00:00"])
    run = st.none() | st.tuples(ends, times, st.sampled_from([1.0, 2.0]))
    return [[draw(run) for _ in range(2)] for _ in range(3)]


@settings(max_examples=10)  # each example merges in all orders, twice
@given(machines())
def test_the_order_does_not_matter_and_a_second_time_changes_nothing(tmp_path_factory, cells_of_machines):
    base = tmp_path_factory.mktemp("merge")
    for name, cells in zip("abc", cells_of_machines, strict=True):
        (base / name / "runs").mkdir(parents=True)
        for cell, run in zip(CELLS, cells, strict=False):
            if run is not None:
                write_run(base / name, cell, run[0], run[1], metrics={"chamfer_l2": run[2]})
    results = []
    for order in permutations("abc"):
        into = base / f"into-{''.join(order)}"
        merge([base / name for name in order], into)
        results.append(content(into))
        merge([base / name for name in order], into)
        assert content(into) == results[-1]
    stepwise = base / "stepwise"
    for name in "cab":
        merge([base / name], stepwise)
    assert all(result == results[0] for result in [*results, content(stepwise)])
    for number, cell in enumerate(CELLS[:2]):
        runs = {cells[number] for cells in cells_of_machines if cells[number] is not None}
        assert len([name for name in results[0] if name.endswith("record.json") and cell in name]) == len(runs)
        for ends in ({"ok"}, {"ok", "timeout"}):  # finished runs rank above others
            if any(run[0] in ends for run in runs):
                assert json.loads(results[0][f"runs/{cell}/record.json"])["status"] in ends


def test_a_cell_that_was_run_twice_is_reported_and_both_are_kept(tmp_path, capsys):
    write_run(tmp_path / "a", CELLS[0], "timeout", "2026-01-02T00:00:00+00:00")
    write_run(tmp_path / "b", CELLS[0], "ok", "2026-01-01T00:00:00+00:00")
    main([str(tmp_path / "a"), str(tmp_path / "b"), "--into", str(tmp_path / "d")])
    (line, _) = capsys.readouterr().out.splitlines()
    assert line.startswith(f"{CELLS[0]}: kept ok of 2026-01-01")
    assert "set aside in earlier: timeout of 2026-01-02" in line
    assert len(list((tmp_path / "d" / "earlier").iterdir())) == 1
    assert merge([tmp_path / "d"], tmp_path / "e") == ([], []) and content(tmp_path / "e") == content(tmp_path / "d")


def test_the_later_of_two_runs_with_one_status_is_kept(tmp_path):
    for name, day in (("a", 1), ("b", 2), ("c", 3)):
        write_run(tmp_path / name, CELLS[0], "ok", f"2026-01-0{day}T00:00:00+00:00", metrics={"chamfer_l2": float(day)})
    for order in permutations("abc"):
        into = tmp_path / "".join(order)
        merge([tmp_path / name for name in order], into)
        (record,) = read_records(into)[0]
        assert record["metrics"] == {"chamfer_l2": 3.0}


def test_plans_are_joined_so_that_cells_of_no_machine_show(tmp_path):
    Plan("table-1", tmp_path / "a", planned(*CELLS), "2026-01-01T00:00:00+00:00").write()
    write_run(tmp_path / "a", CELLS[0])
    write_run(tmp_path / "b", CELLS[1])
    merge([tmp_path / "a", tmp_path / "b"], tmp_path / "d")
    statuses = {record["id"]: record["status"] for record in read_records(tmp_path / "d")[0]}
    assert statuses == {CELLS[0]: "ok", CELLS[1]: "ok", CELLS[2]: "not_run"}


def test_the_later_of_two_requests_of_one_run_or_sweep_is_kept(tmp_path):
    for name, day in (("a", 1), ("b", 2)):
        requested = f"2026-02-0{day}T00:00:00+00:00"
        write_run(tmp_path / name, CELLS[0], asked=requested)
        Plan("table-1", tmp_path / name, planned(CELLS[0]), requested).write()
    for into, order in (("ab", "ab"), ("ba", "ba")):
        merge([tmp_path / name for name in order], tmp_path / into)
        paths = [*(tmp_path / into).glob("*/*/record.json"), *(tmp_path / into).glob("*/*/plan.json")]
        assert [json.loads(path.read_text())["asked"] for path in paths] == ["2026-02-02T00:00:00+00:00"] * 2


def test_a_damaged_record_is_kept_but_never_before_a_complete_one(tmp_path):
    for number, damage in enumerate(("", "{", "[1]", '{"schema": 99}')):
        folder_of_case = tmp_path / str(number)
        folder = write_run(folder_of_case / "a", CELLS[0])
        (folder / "record.json").write_text(damage)
        write_run(folder_of_case / "b", CELLS[0], "killed")
        merge([folder_of_case / "a", folder_of_case / "b"], folder_of_case / "d")
        assert [record["status"] for record in read_records(folder_of_case / "d")[0]] == ["killed"]
        (earlier,) = (folder_of_case / "d" / "earlier").iterdir()
        assert (earlier / "record.json").read_text() == damage


@each("damage, words", [
    ("", "record.json is not JSON"),
    ('{"metrics": {"chamfer_l2": "0.1 mm"}}', "chamfer_l2 must be a number, found '0.1 mm'"),
    ('{"metrics": {"chamfer_l2": -1}}', "chamfer_l2 must be at least 0, found -1"),
])  # fmt: skip
def test_a_run_that_cannot_be_read_is_named_and_is_in_no_table(tmp_path_factory, capsys, damage, words):
    results = tmp_path_factory.mktemp("results")
    write_run(results / "a", CELLS[0])
    path = write_run(results / "a", CELLS[1]) / "record.json"
    path.write_text(damage and json.dumps(json.loads(path.read_text()) | json.loads(damage)))
    Plan("table-1", results / "a", planned(*CELLS)).write()
    (results / "a" / "sweeps" / "table-1" / "plan.json").write_text("{")
    assert main([str(results / "a"), "--into", str(results / "b")]) == 1
    run, plan = capsys.readouterr().err.splitlines()
    assert run.startswith(f"warning: {results / 'a'}: not read: ")
    assert CELLS[1] in run and words in run
    assert "sweeps/table-1/plan.json" in plan
    assert [record["folder"] for record in read_records(results / "b")[0]] == [CELLS[0]]
    if not damage:  # the report has the same words and exit status
        assert report([f"results_dir={results / 'b'}"]) == 1
        assert capsys.readouterr().err.splitlines()[0] in run


def test_a_run_or_a_plan_that_is_a_link_out_of_its_folder_is_not_read(tmp_path):
    outside = write_run(tmp_path / "other", CELLS[0])
    Plan("table-1", tmp_path / "other", planned(*CELLS), "2026-01-01T00:00:00+00:00").write()
    for folder in ("runs", "sweeps"):
        (tmp_path / "a" / folder).mkdir(parents=True)
    (tmp_path / "a/runs" / outside.name).symlink_to(outside)
    (tmp_path / "a/sweeps/table-1").symlink_to(tmp_path / "other/sweeps/table-1")
    _, (line, plan) = merge([tmp_path / "a"], tmp_path / "d")
    assert "this plan cannot be read: sweeps/table-1/plan.json" in plan
    assert "not copied, since" in line and "is a link out of its results folder" in line
    assert content(tmp_path / "d") == {}


def test_attempts_at_the_suite_that_cannot_be_read_are_named(tmp_path):
    folder = attempts_folder(tmp_path / "a")
    folder.mkdir(parents=True)
    (folder / "newton.csv").write_text("set,problem\ncomplete,a sofa\n")
    _, (problem,) = merge([tmp_path / "a"], tmp_path / "d")
    assert problem.startswith(f"{tmp_path / 'a'}: not copied: newton.csv: ")


def test_a_folder_that_cannot_be_joined_is_an_error_and_changes_nothing(tmp_path, capsys):
    assert main([str(tmp_path), "--into", str(tmp_path / "d")]) == 2
    assert "is not a results folder" in capsys.readouterr().err
    write_run(tmp_path / "a", CELLS[0])
    before = content(tmp_path / "a")
    for into in (tmp_path / "a", tmp_path / "a" / "runs" / "x"):
        assert main([str(tmp_path / "a"), "--into", str(into)]) == 2
        assert "--into must be another folder" in capsys.readouterr().err
    assert content(tmp_path / "a") == before
