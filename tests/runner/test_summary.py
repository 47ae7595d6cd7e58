"""The last lines of a command name the next steps, also on narrow terminals and in logs."""

from itertools import count
from pathlib import Path
from types import SimpleNamespace

import pytest

from bench.clusters import Workers
from bench.records.record import Record, RunStatus
from bench.records.results import RESULTS, Plan
from bench.runner import sweep
from bench.runner.summary import log_lines, print_run_summary, print_sweep_summary
from tests.looped import each
from tests.runner.driving import ROOT, planned

CONTRIBUTING = ROOT / "CONTRIBUTING.md"


def ended(results: Path, name: str, status: str = "ok", renderer: str = "dist") -> Record:
    config = {"label": "DIST, a name that is long", "renderer": {"_target_": "mypkg.Mine"}}
    record = Record(name, "completion", renderer, "sofa", 0, config, scene="sofa test 0")
    record.status, record.reason, record.ended = RunStatus(status), "" if status == "ok" else "why", record.started
    record.metrics = record.metrics_start = {"chamfer_l2": 0.0125, "normal_consistency": 0.7}
    (results / "runs" / name).mkdir(parents=True)
    record.write(results / "runs" / name)
    return record


@pytest.mark.parametrize("width", [40, 120])
def test_a_run_ends_with_its_picture_and_the_command_for_page_and_tables(tmp_path, capsys, monkeypatch, width):
    monkeypatch.setenv("COLUMNS", str(width))
    record, folder = ended(tmp_path / "my r", "a"), tmp_path / "my r" / "runs" / "a"
    (folder / "summary.png").touch()
    (folder / "strip.png").touch()
    print_run_summary(folder, record)
    *table, picture, tables, last = capsys.readouterr().out.splitlines()
    assert [picture, last] == [f"picture: {folder}/summary.png", str(folder)]
    assert tables == f"page and tables: python -m bench.report results_dir='{tmp_path / 'my r'}'"
    assert max(map(len, table)) <= width and "12.5" in "\n".join(table)
    assert all(letter.isprintable() for line in table for letter in line)


def test_a_metric_without_an_initial_value_is_shown_too(tmp_path, capsys):
    record = ended(tmp_path, "a")
    record.metrics = {**record.metrics, "dtu_overall": 0.7}
    print_run_summary(tmp_path / "runs" / "a", record)
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "DTU overall (mm)" in line]
    assert line.split()[-3:] == ["–", "0.700", "lower"]


def test_the_best_possible_values_are_shown_where_they_are_known(tmp_path, capsys):
    record = ended(tmp_path, "a")
    print_run_summary(tmp_path / "runs" / "a", record)
    assert "best possible" not in capsys.readouterr().out
    record.metrics_best = {"chamfer_l2": 0.000133}
    print_run_summary(tmp_path / "runs" / "a", record)
    out = capsys.readouterr().out
    assert "best possible" in out
    rows = [line.split() for line in out.splitlines()]
    assert ["Chamfer", "(x1000)", "12.5", "12.5", "0.133", "lower"] in rows
    assert ["normal", "consistency", "0.700", "0.700", "–", "higher"] in rows
    assert "Chamfer (x1000): 12.5 before, 12.5 after, 0.133 best possible" in log_lines(record)


@each(
    "level, successes, status, words",
    [
        (0.5, (5, 0), "ok", "breaks at 0.0200 scene units thick"),
        (-0.1, (0, 0), "ok", "breaks at the mildest severity, 0.300 scene units thick"),
        (1.1, (5, 5), "ok", "does not break up to the severest severity, 0.00100 scene units thick"),
        (-0.1, (1, 5), "ok", "has no breakdown"),
        (-0.1, (0, 0), "crashed", ""),
    ],
)
def test_a_stress_test_begins_with_where_the_renderer_breaks(capsys, level, successes, status, words):
    sweep = {"mild": 0.3, "severe": 0.001, "log": True, "unit": "scene units thick"}
    config = {"label": "DIST", "task": {"stress": {"sweep": sweep}}}
    record = Record("a", "stability", "dist", "thin_plate", 0, config, scene="thin plate", status=RunStatus(status))
    counts = {"mild_successes": successes[0], "severe_successes": successes[1], "mild_trials": 5, "severe_trials": 5}
    record.metrics = {"level": level, "breakdown": 0.02 if 0 < level < 1 else None} | counts
    print_run_summary(Path(RESULTS) / "runs" / "a", record)
    first = capsys.readouterr().out.splitlines()[0]
    assert first.startswith(f"thin plate: DIST {words}") if words else "breaks" not in first


def contract_lines(out: str) -> list[str]:
    return [line for line in out.splitlines() if "contract" in line]


def test_the_first_run_of_a_user_renderer_names_the_contract_test(tmp_path, capsys):
    def shown(name, **changed):
        record = ended(tmp_path, name, **changed)
        print_run_summary(tmp_path / "runs" / name, record)
        return contract_lines(capsys.readouterr().out)

    assert shown("completion-dist-sofa-a") == []
    (line,) = shown("completion-custom-sofa-b", renderer="custom", status="crashed")
    remedy = "python -m pytest tests/renderers/test_renderer_contract.py -k custom --renderer=mypkg.Mine"
    assert line.endswith(f": {remedy}") and remedy in CONTRIBUTING.read_text()
    assert shown("pose-custom-sofa-c", renderer="custom") == []  # the second run


def test_a_sweep_with_the_first_runs_of_a_user_renderer_names_the_contract_test(tmp_path, capsys):
    plan = Plan("p", tmp_path, planned("a-dist-b", "a-custom-b", "b-custom-b"), asked="2026-01-01T00:00:00+00:00")
    ended(tmp_path, "a-dist-b")
    ended(tmp_path, "a-custom-b", renderer="custom")
    print_sweep_summary(plan, tmp_path / "index.html")
    assert len(contract_lines(capsys.readouterr().out)) == 1
    reused = ended(tmp_path, "b-custom-b", renderer="custom")
    reused.reused = True
    reused.write(tmp_path / "runs" / "b-custom-b")
    print_sweep_summary(plan, tmp_path / "index.html")
    assert contract_lines(capsys.readouterr().out) == []


def test_a_run_without_a_picture_in_the_usual_folder_has_shorter_lines(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    record = ended(Path(RESULTS), "a")
    print_run_summary(Path(RESULTS) / "runs" / "a", record)
    out = capsys.readouterr().out.splitlines()
    assert out[-2:] == ["page and tables: python -m bench.report", f"{RESULTS}/runs/a"]
    assert not any(line.startswith("picture") for line in out)


def test_a_sweep_ends_with_its_first_failure(tmp_path, capsys):
    plan = Plan("p", tmp_path, planned("a", "b", "c", "d"), asked="2026-01-01T00:00:00+00:00")
    for name, status in (("a", "ok"), ("b", "empty"), ("c", "crashed")):
        ended(tmp_path, name, status)
    assert print_sweep_summary(plan, tmp_path / "index.html") == ["ok", "empty", "crashed", "not_run"]
    out = capsys.readouterr().out.splitlines()
    assert out[0] == "4 planned: 1 ok, 1 empty, 1 crashed, 1 not_run"
    assert out[2] == f"first failure: {tmp_path}/runs/b (empty: why)" and out[-1] == str(plan.folder)
    print_sweep_summary(plan, tmp_path / "index.html", ["answer: A."])
    out = capsys.readouterr().out.splitlines()
    assert {"answer: A.", f"report: {tmp_path}/index.html"} <= {*out}


@each(
    "names, reused, beginnings",
    [("ab", {"a"}, ["[1/4] ok  ", "[2/4, 20.0 s left] ok  "]), ("a", {"c", "d"}, ["[1/4, 10.0 s left] ok  "])],
)
def test_a_line_of_a_sweep_estimates_the_time_left_from_cells_that_are_not_reused(
    tmp_path_factory, capsys, monkeypatch, names, reused, beginnings
):
    results = tmp_path_factory.mktemp("results")
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    monkeypatch.setattr(sweep, "time", SimpleNamespace(monotonic=count(0.0, 10.0).__next__))
    for name in names:
        ended(results, name)
    plan = Plan("p", results, planned("a", "b", "c", "d"), asked="2026-01-01T00:00:00+00:00")
    with sweep.follow_progress(plan, reused):
        pass
    lines = capsys.readouterr().out.splitlines()
    assert [line[: len(words)] for line, words in zip(lines, beginnings, strict=True)] == beginnings


@each(
    "launcher, workers",
    [({}, 1), ({"n_jobs": 3}, 3), ({"n_jobs": -1}, 7), ({"n_jobs": None}, 1), ({"array_parallelism": 256}, 256)],
)
def test_a_sweep_says_how_many_runs_a_launcher_makes_at_a_time(launcher, workers, monkeypatch):
    """-1 stands for all processors; submitit has its own limit."""
    monkeypatch.setattr("os.cpu_count", lambda: 7)
    assert Workers("workers", launcher, {}).concurrency == workers
