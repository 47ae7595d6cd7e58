"""Configurations and results of others run no code, and open no file outside the results folder."""

import json
import sys
from pathlib import Path

import pytest
import trimesh

from bench.config import build, find_class, load
from bench.merge import merge
from bench.records.folder import locked_folder
from bench.records.read import read_plans, read_records
from bench.records.record import SCHEMA
from bench.records.results import Plan, PlannedRun, check_links
from bench.report.write.html import write_index
from bench.turntable import main as turntable
from tests.looped import each
from tests.runner.driving import command, errors, planned, stored

MODULE = """
from pathlib import Path
Path({mark!r}).touch()
class Renderer:
    def __init__(self, *_, **__): pass
    def render(self, field, rays): ...
    def silhouette_loss(self, field, rays, rendering, mask): ...
class Other: ...
def call(*_, **__): ...
"""
PARTS = {"prior": "bench.shape_prior.PriorSettings", "view": "datasets.views.ViewSampler"}


@pytest.fixture
def stranger(tmp_path, monkeypatch):
    """A module that leaves a mark when it is imported."""
    name = f"strange_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(MODULE.format(mark=str(tmp_path / "imported")))
    monkeypatch.syspath_prepend(tmp_path)
    yield name
    sys.modules.pop(name, None)


@each("node, key", [
    ("renderer", "renderer._target_"), ("task", "task._target_"), ("prior", "+prior._target_"),
    ("view", "+view._target_"), ("task", "+task.code._target_"), ("tracker", "tracker._target_"),
])  # fmt: skip
def test_a_package_that_is_not_named_is_not_imported(compose_config, stranger, tmp_path, node, key):
    config = compose_config(f"{key}={stranger}.Renderer")
    with pytest.raises(ValueError, match=rf"_target_ names '{stranger}.Renderer': type packages=\[{stranger}\]"):
        build(config[node], node, [], PARTS.get(node, ""))
    assert not (tmp_path / "imported").exists() and stranger not in sys.modules


def test_the_command_refuses_an_unnamed_package_before_anything_runs(stranger, tmp_path):
    for multirun in ((), ("-m",)):
        result = command(
            *multirun, f"renderer._target_={stranger}.Renderer", "scale=smoke", f"results_dir={tmp_path}/r"
        )
        assert (result.code, result.out) == (2, "") and len(errors(result.err)) == 1
        assert "if you trust it" in result.err and not (tmp_path / "imported").exists()
        assert not (tmp_path / "r").exists()


def test_a_class_of_a_named_package_must_be_of_the_kind_of_its_node(compose_config, stranger):
    config = compose_config("renderer=custom", f"renderer._target_={stranger}.Renderer")
    assert type(build(config.renderer, "renderer")).__name__ == "Renderer"
    assert type(load("renderer", "custom", _target_=f"{stranger}.Renderer")).__name__ == "Renderer"
    for wrong, words in (("Other", "no Renderer: it lacks render, silhouette_loss"), ("call", "which is no class")):
        with pytest.raises(ValueError, match=words):
            find_class(f"{stranger}.{wrong}", "renderer", [stranger], None)
    with pytest.raises(ValueError, match=r"no ViewSampler: name a class that extends datasets\.views"):
        build({"_target_": f"{stranger}.Other"}, "view", [stranger], PARTS["view"])
    with pytest.raises(ValueError, match=r"no HasNetwork: it lacks network"):
        build({"_target_": f"{stranger}.Other"}, "prior", [stranger], PARTS["prior"])


@pytest.fixture
def theirs(tmp_path) -> Path:
    """The results folder of another user with a valid run, and a folder of this user."""
    stored(tmp_path / "theirs", "sound")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "secret.png").write_text("secret")
    return tmp_path / "theirs"


@pytest.mark.parametrize("what", ["a file", "a folder within", "the run folder"])
def test_a_run_with_a_link_that_leads_out_is_neither_read_nor_copied(theirs, tmp_path, what):
    outside = tmp_path / "mine"
    if what == "the run folder":
        stored(outside, "linked")
        (theirs / "runs" / "linked").symlink_to(outside / "runs" / "linked")
    else:
        folder = stored(theirs, "linked")
        (folder / "link.png").symlink_to(outside if what == "a folder within" else outside / "secret.png")
    records, problems = read_records(theirs)
    assert [record["folder"] for record in records] == ["sound"]
    assert len(problems) == 1 and problems[0].startswith("linked: not read, since l")
    lines, (problem,) = merge([theirs], tmp_path / "joined")
    assert lines == [] and "not copied" in problem
    assert [path.name for path in (tmp_path / "joined" / "runs").iterdir()] == ["sound"]
    assert "secret" not in write_index(theirs).read_text().replace("secret.png is a link", "")


def test_a_link_within_the_results_folder_is_followed(theirs):
    (theirs / "runs" / "sound" / "same.png").symlink_to("summary.png")
    (theirs / "runs" / "again").symlink_to("sound")
    assert len(read_records(theirs)[0]) == 2


@pytest.mark.parametrize("name", [
    "runs", "paper", "sweeps", "earlier", ".locks", "page", "page/data/run", "index.html", "paper/table1.csv",
    "sweeps/p/table.csv",
])  # fmt: skip
def test_nothing_is_written_through_a_link(theirs, tmp_path, name):
    outside = tmp_path / "mine"
    if name == "runs":
        (theirs / "runs").rename(tmp_path / "mine" / "runs")
    (theirs / name).parent.mkdir(exist_ok=True, parents=True)
    (theirs / name).symlink_to(outside / ("secret.png" if "." in name[1:] else ""))
    before = sorted(path.name for path in outside.rglob("*"))
    plan = Plan("p", theirs, planned("completion-1"))
    for write in (lambda: write_index(theirs), plan.write, lambda: merge([], theirs)):
        with pytest.raises(ValueError, match="is a link out of the results folder: remove it"):
            write()
    assert sorted(path.name for path in outside.rglob("*")) == before
    assert (outside / "secret.png").read_text() == "secret"
    with pytest.raises(ValueError, match="link out"):
        check_links(theirs)


@pytest.mark.parametrize("pattern", ["runs/{}", ".locks/{}", "runs/{}/record.json"])
def test_a_run_is_not_resumed_through_a_link(theirs, tmp_path, pattern):
    config = {"seed": 0, "results_dir": str(theirs), "rerun": "none"}
    run = PlannedRun("completion-dist-sofa-1", [], "completion", "dist", "sofa", 0, config)
    link = theirs / pattern.format(run.id)
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(tmp_path / "mine" / ("" if pattern == "runs/{}" else "secret.png"))
    with (
        pytest.raises(ValueError, match="is a link out of the results folder"),
        locked_folder(run),
    ):
        raise AssertionError("it was claimed")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["secret.png"]
    assert (tmp_path / "mine" / "secret.png").read_text() == "secret"


def test_a_plan_and_its_cells_have_names_of_folders(theirs):
    cell = {"id": "sound-2", "overrides": [], "task": "t", "renderer": "r", "dataset": "d", "seed": 0, "config": {}}
    plan = {"schema": SCHEMA, "name": "p", "asked": "2026-01-01T00:00:00+00:00", "cells": [cell]}
    path = theirs / "sweeps" / "p" / "plan.json"
    path.parent.mkdir(parents=True)
    for name in ("../../mine", "/etc", "..", ".hidden", "a/b", 3, None):
        path.write_text(json.dumps(plan | {"cells": [cell | {"id": name}]}))
        assert read_plans(theirs)[0] == [], name
        assert [record["folder"] for record in read_records(theirs)[0]] == ["sound"]
        path.write_text(json.dumps(plan | {"name": name}))
        plans, problems = read_plans(theirs)
        assert plans == [] and "its name must be that of its folder" in problems[0]
    path.write_text(json.dumps(plan))
    assert len(read_plans(theirs)[0]) == 1


def test_a_configuration_in_a_run_folder_is_only_text(theirs, stranger, tmp_path):
    folder = theirs / "runs" / "sound"
    (folder / "config.yaml").write_text(f"renderer:\n  _target_: {stranger}.Renderer\n")
    record = json.loads((folder / "record.json").read_text())
    record["config"] = {"renderer": {"_target_": f"{stranger}.call", "_package_": stranger}, "packages": [stranger]}
    (folder / "record.json").write_text(json.dumps(record))
    write_index(theirs)
    merge([theirs], tmp_path / "joined")
    assert turntable([str(folder)]) == 2 and not (tmp_path / "imported").exists()


@pytest.mark.parametrize("name", ["turntable.webp", "mesh.ply"])
def test_a_turntable_follows_no_link_of_a_run(theirs, tmp_path, capsys, name):
    folder = theirs / "runs" / "sound"
    trimesh.creation.box().export(folder / "mesh.ply")
    (tmp_path / "mine" / "mesh.ply").write_bytes((folder / "mesh.ply").read_bytes())
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(tmp_path / "mine" / ("secret.png" if name == "turntable.webp" else "mesh.ply"))
    assert turntable([str(folder), "--size", "32", "--frames", "2"]) == 2
    assert "is a link out of the run folder: remove it" in capsys.readouterr().err
    assert (tmp_path / "mine" / "secret.png").read_text() == "secret"
