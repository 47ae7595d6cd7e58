"""Which runs a study reads, and what their table holds."""

import math

import pytest

from bench.records.read import read_records
from bench.report.data.runs import Runs, Selection, choose, merge_runs
from bench.report.write.caption import warnings
from tests.report.test_report_paper import write_run


def read(results, experiment: str = "mine", **selection) -> Runs:
    runs = choose(read_records(results)[0], Selection(experiment, **selection), results)
    assert runs is not None
    return runs


def test_the_table_has_all_field_values_and_the_seconds_of_the_loop(tmp_path):
    seconds = {"forward": 2.0, "backward": 3.0, "total": 9.0}
    write_run(tmp_path, "mine", "A", evaluations={"value": 100, "coarse": 30}, seconds=seconds)
    write_run(tmp_path, "mine", "B", evaluations={"value": 100})
    frame = read(tmp_path).frame
    assert frame["values"].tolist() == [130, 100] and frame["loop"][0] == 5 and math.isnan(frame["loop"][1])


def test_an_error_is_infinite_where_a_run_failed_or_lacks_it(tmp_path):
    metrics = {"chamfer_l1": 0.5}
    write_run(tmp_path, "mine", "A", metrics=metrics)
    write_run(tmp_path, "mine", "B", metrics=metrics, status="diverged")
    write_run(tmp_path, "mine", "C", metrics={"chamfer_l1": "nan"})
    write_run(tmp_path, "mine", "D", metrics={})
    assert read(tmp_path).error("chamfer_l1", scale=10).tolist() == [5, math.inf, math.inf, math.inf]


def test_times_count_where_those_of_fewer_than_half_are_doubtful(tmp_path):
    for name, notes in (("A", ["loaded machine: 30 %"]), ("B", []), ("C", [])):
        write_run(tmp_path, "mine", name, notes=notes)
    runs = read(tmp_path)
    assert runs.timed and not runs.where(runs.frame["row"] != "C").timed


def test_a_row_has_the_setting_that_was_requested_last_not_the_one_that_ran_last(tmp_path):
    for day, epsilon in ((9, 1e-3), (1, 1e-4)):  # the first was reused later
        renderer = {"renderer": {"epsilon": epsilon}}
        for index in (0, 1):
            write_run(tmp_path, "mine", "A", index=index, asked=f"2025-04-0{day}T10:00:00+00:00", settings=renderer)
    runs = read(tmp_path)
    assert [record["config"]["renderer"]["epsilon"] for record in runs.records] == [1e-3, 1e-3]
    assert runs.left_out.total() == 2


@pytest.mark.parametrize("strength, solids, views", [(0.0, [None, None], [0, 1]), (1.0, [0, 1], [0, 0])])
def test_each_view_or_deformation_of_a_mesh_file_is_a_cell(tmp_path, strength, solids, views):
    for index in (0, 1, 1):  # the last is the same cell once more
        dataset = {"dataset": {"name": "mesh", "path": "cow.ply", "strength": strength}}
        write_run(tmp_path, "mine", "A", index=index, settings=dataset)
    runs = read(tmp_path)
    assert runs.frame["solid"].tolist() == [*map(str, solids)] and runs.frame["view"].tolist() == views
    assert runs.left_out.total() == 1


def test_runs_of_several_experiments_together_leave_out_what_each_leaves_out(tmp_path):
    for experiment in ("mine", "other", "mine", "other", "other"):
        write_run(tmp_path, experiment, "A")
    both = merge_runs(read(tmp_path), None, read(tmp_path, "other"))
    assert (len(both.records), both.left_out) == (2, {"mine": 1, "other": 2})
    assert [record["config"]["experiment"] for record in both.records] == ["mine", "other"]
    assert any(note.startswith("Not shown: 1 run of mine, 2 runs of other at") for note in warnings(both))


def test_settings_that_share_a_label_are_named(tmp_path):
    for steps in (40, 50, 50):
        write_run(tmp_path, "mine", "same", settings={"renderer": {"steps": steps}})
    notes = " ".join(warnings(read(tmp_path)))
    assert "Several settings have the same label: same (renderer.steps)." in notes and "label=NAME" in notes
    assert warnings(read(tmp_path, conditions=("renderer.steps",))) == [
        "Not shown: 1 run of mine at another scale or on another scene, or replaced by newer ones."
    ]


def test_only_the_split_of_the_run_requested_last_is_read_unless_it_is_a_condition(tmp_path):
    for split in ("validation", "test"):
        write_run(tmp_path, "mine", "A", settings={"split": split})
    assert [record["config"]["split"] for record in read(tmp_path).records] == ["test"]
    assert len(read(tmp_path, conditions=("split",)).records) == 2


def test_a_trial_at_smoke_replaces_no_run_of_a_larger_scale(tmp_path):
    for size in ("smoke", "paper", "desk", "smoke"):
        write_run(tmp_path, "mine", "A", settings={"scale": {"name": size}})
        shown = [record["config"]["scale"]["name"] for record in read(tmp_path).records]
        assert shown == ["desk" if size == "smoke" and len(list(tmp_path.glob("runs/*"))) > 1 else size]


def test_the_newest_scene_is_one_shape_at_one_seed(tmp_path):
    for index, seed in ((0, 1), (1, 0), (1, 1), (0, 0), (1, 1)):
        write_run(tmp_path, "mine", f"A {index} {seed} {len(list(tmp_path.glob('runs/*')))}", index=index, seed=seed)
    newest = read(tmp_path).of_newest_scene()
    assert [(record["config"]["index"], record["seed"]) for record in newest.records] == [(1, 1), (1, 1)]
    assert newest.left_out.total() == 3


def test_runs_of_other_processors_threads_or_engines_are_of_other_machines(tmp_path):
    base = {"cpu": "One", "device": "cpu", "threads": 1, "kernels": "compiled"}
    for name, changed in (("A", {}), ("B", {"commit": "x"}), ("C", {"threads": 2}), ("D", {"kernels": "PyTorch"})):
        write_run(tmp_path, "mine", name, environment=base | changed)
    assert [*read(tmp_path).machines().values()] == [["A", "B"], ["C"], ["D"]]
