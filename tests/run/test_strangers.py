"""Somebody else's configurations and results run nothing, and lead to no file outside of the results folder."""

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import trimesh
from omegaconf import DictConfig, OmegaConf

from bench.config import build, load
from bench.merge import merge
from bench.records import folder as run_folder
from bench.records.read import Plan, PlannedCell, check_links, read_plans, read_records
from bench.records.record import SCHEMA, Record, RunStatus
from bench.report.write.html import write_index
from bench.targets import check_targets, find_class
from bench.turntable import main as turntable
from tests.run.driving import command

MODULE = """
from pathlib import Path
Path({mark!r}).touch()
class Renderer:
    def __init__(self, *_, **__): Path({made!r}).touch()
    def render(self, field, rays): ...
    def silhouette_loss(self, field, rays, rendering, mask): ...
class Other:
    def __init__(self, *_, **__): Path({made!r}).touch()
class Borrowed(Renderer): __module__ = "elsewhere.renderers"
def call(*_, **__): Path({made!r}).touch()
"""


@pytest.fixture
def stranger(tmp_path, monkeypatch):
    """A module that leaves a mark when it is imported, and another when something of it is called."""
    name = f"strange_{tmp_path.name}"
    text = MODULE.format(mark=str(tmp_path / "imported"), made=str(tmp_path / "made"))
    (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    yield name
    sys.modules.pop(name, None)


def attacks(name: str, mark: Path) -> dict[str, tuple[str, ...]]:
    touch = ("touch", str(mark))
    program, shell = f"+renderer.args=[{','.join(touch)}]", f"+renderer.command='{' '.join(touch)}'"
    return {
        "a program": ("renderer._target_=subprocess.Popen", program),
        "a program, as a renderer of one's own": ("renderer=custom", "renderer._target_=subprocess.Popen", program),
        "a program with leave": ("packages=[subprocess]", "renderer._target_=subprocess.Popen", program),
        "a shell": ("renderer._target_=os.system", shell),
        "a shell, as a renderer of one's own": ("renderer=custom", "renderer._target_=os.system", shell),
        "a built-in": ("renderer._target_=builtins.eval", "+renderer.source='1'"),
        "a module behind ours": ("renderer._target_=bench.records.folder.os.system", shell),
        "a class behind ours": ("renderer._target_=bench.run.process.multiprocessing.context.Process",),
        "a function behind ours": ("renderer._target_=renderers.camera.torch.load", f"+renderer.f={mark}"),
        "a function of ours": ("renderer._target_=bench.config.build",),
        "a class of ours that is no renderer": ("renderer._target_=bench.records.record.Record",),
        "a class of another package behind ours": ("renderer._target_=bench.records.folder.Path",),
        "a task as a tracker": ("tracker._target_=bench.tasks.completion.Completion",),
        "a tracker": (f"tracker._target_={name}.Other",),
        "a prior": (f"+prior._target_={name}.Other",),
        "a setting of a view": (f"+view._target_={name}.Other",),
        "a nested node": (f"+task.code._target_={name}.Other",),
        "a nested loss": (f"task.silhouette={{_target_:{name}.Other}}",),
        "a package smuggled in": (f"renderer._target_={name}.Renderer", f"+renderer._package_={name}"),
        "a package smuggled into a task": (f"task._target_={name}.Other", f"+task._package_={name}"),
        "a package under another's name": (
            "renderer=custom", "renderer._target_=renderers.IDR", f"renderer._package_={name}",
        ),
        "no path": ("renderer._target_=Popen",),
        "no text": ("renderer._target_=[os,system]",),
        "an empty part": ("renderer._target_=renderers..IDR",),
    }  # fmt: skip


PARTS = {"prior": "bench.shape_prior.autodecoder.PriorSettings", "view": "datasets.views.ViewSampler"}


BEHIND_OURS = {  # their package is ours: what they name must be looked at
    *("a module behind ours", "a class behind ours", "a function behind ours", "a function of ours"),
    *("a class of ours that is no renderer", "a class of another package behind ours", "a task as a tracker"),
}
SMUGGLED = {"a package smuggled in", "a package under another's name"}


@pytest.mark.parametrize("how", attacks("", Path()))
def test_nothing_runs_before_it_is_refused(compose_config, stranger, tmp_path, how):
    overrides = attacks(stranger, tmp_path / "made")[how]
    config = plain(compose_config(*overrides))
    first = refusals([lambda: check_targets(config, overrides, "custom" if "renderer=custom" in overrides else "dist")])
    assert bool(first) is (how not in BEHIND_OURS)
    if how in SMUGGLED:  # only the first guard knows the command line
        return
    parts = ("renderer", "task", "tracker", *PARTS)
    second = refusals([lambda p=p: build(config[p], p, config["packages"], PARTS.get(p, "")) for p in parts])
    assert len(second) == 1
    assert "\n" not in second[0]
    assert not (tmp_path / "made").exists()
    assert not (tmp_path / "imported").exists()
    assert stranger not in sys.modules


def plain(config: DictConfig) -> dict[str, Any]:
    """A configuration as a run's identity has it."""
    found: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=False)
    return found


def refusals(calls: Sequence[Callable[[], object]]) -> list[str]:
    found = []
    for call in calls:
        try:
            call()
        except ValueError as error:
            found.append(str(error))
    return found


@pytest.mark.parametrize("how", ["a program, as a renderer of one's own", "a package smuggled in", "a tracker"])
@pytest.mark.parametrize("multirun", [(), ("-m",)], ids=["one run", "a sweep"])
def test_the_command_refuses_before_anything_runs(stranger, tmp_path, how, multirun):
    overrides = attacks(stranger, tmp_path / "made")[how]
    done = command(*multirun, *overrides, "isolation=off", "scale=smoke", f"results_dir={tmp_path / 'r'}")
    assert (done.code, done.out) == (2, "")
    assert done.err.startswith("error: ") and len(done.err.splitlines()) == 1
    assert not (tmp_path / "made").exists() and not (tmp_path / "imported").exists()
    assert stranger not in sys.modules
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize("text", [
    "# @package _global_\npackages: [{name}]\nrenderer:\n  _target_: {name}.Renderer\n",
    "# @package _global_\ndefaults:\n  - override /renderer: custom\nrenderer:\n  _target_: {name}.Renderer\n",
    "# @package _global_\nhydra:\n  sweeper:\n    params:\n      packages: '[{name}]'\n"
    "      renderer._target_: {name}.Renderer\n",
    "# @package _global_\nrenderer:\n  _target_: {name}.Renderer\n  _package_: {name}\n",
])  # fmt: skip
def test_a_yaml_of_a_stranger_grants_no_leave(stranger, tmp_path, text):
    (tmp_path / "conf" / "experiment").mkdir(parents=True)
    (tmp_path / "conf" / "experiment" / "theirs.yaml").write_text(text.format(name=stranger))
    options = ("-m", "--config-dir", str(tmp_path / "conf"), "+experiment=theirs", "seed=0,1", "isolation=off")
    done = command(*options, f"results_dir={tmp_path / 'r'}")
    assert done.code == 2, done
    assert stranger in done.err
    assert not (tmp_path / "made").exists() and not (tmp_path / "imported").exists()
    assert not (tmp_path / "r").exists()


def test_a_package_that_the_user_names_is_used(compose_config, stranger, tmp_path):
    overrides = ("renderer=custom", f"renderer._target_={stranger}.Renderer")
    config = plain(compose_config(*overrides))
    check_targets(config, overrides, "custom")
    assert type(build(config["renderer"], "renderer")).__name__ == "Renderer"
    assert type(load("renderer", "custom", _target_=f"{stranger}.Renderer")).__name__ == "Renderer"
    (tmp_path / "made").unlink()
    for wrong, words in (
        ("Borrowed", "a class of elsewhere: add its package"),
        ("Other", "no Renderer: it lacks render, silhouette_loss"),
        ("call", "which is no class"),
    ):
        with pytest.raises(ValueError, match=words):
            find_class(f"{stranger}.{wrong}", "renderer", [stranger], None)
    assert not (tmp_path / "made").exists()


def test_each_target_of_a_sweep_may_be_typed(compose_config, stranger):
    typed = ("renderer=custom", f"renderer._target_={stranger}.Renderer,renderers.IDR")
    config = plain(compose_config("renderer=custom", f"renderer._target_={stranger}.Renderer"))
    check_targets(config, typed, "custom")
    with pytest.raises(ValueError, match="gives no leave"):
        check_targets(config, ("renderer=custom", "renderer._target_=renderers.IDR"), "custom")


def write_run(results: Path, name: str) -> Path:
    folder = results / "runs" / name
    folder.mkdir(parents=True)
    record = Record(name, "completion", "dist", "sofa", 0, {"seed": 0}, ended="2026-01-01T00:00:00+00:00")
    record.status = RunStatus.OK
    record.write(folder)
    return folder


@pytest.fixture
def theirs(tmp_path) -> Path:
    """A results folder of somebody else's with a sound run, and beside it a folder that is none of theirs."""
    write_run(tmp_path / "theirs", "sound")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "secret.png").write_text("secret")
    return tmp_path / "theirs"


@pytest.mark.parametrize("what", ["a file", "a folder within", "the run folder"])
def test_a_run_with_a_link_that_leads_out_is_neither_read_nor_copied(theirs, tmp_path, what):
    outside = tmp_path / "mine"
    if what == "the run folder":
        write_run(outside, "linked")
        (theirs / "runs" / "linked").symlink_to(outside / "runs" / "linked")
    else:
        folder = write_run(theirs, "linked")
        (folder / "link.png").symlink_to(outside if what == "a folder within" else outside / "secret.png")
    records, problems = read_records(theirs)
    assert [record["folder"] for record in records] == ["sound"]
    assert len(problems) == 1 and problems[0].startswith("linked: not read, since l")
    lines = merge([theirs], tmp_path / "joined")
    assert len(lines) == 1 and "not copied" in lines[0]
    assert [path.name for path in (tmp_path / "joined" / "runs").iterdir()] == ["sound"]
    assert "secret" not in write_index(theirs).read_text().replace("secret.png is a link", "")


def test_a_link_within_the_results_folder_is_followed(theirs):
    (theirs / "runs" / "sound" / "same.png").symlink_to("summary.png")
    (theirs / "runs" / "again").symlink_to("sound")
    assert len(read_records(theirs)[0]) == 2


@pytest.mark.parametrize(
    "name", ["runs", "paper", "sweeps", "earlier", ".locks", "index.html", "paper/table1.csv", "sweeps/p/table.csv"]
)
def test_nothing_is_written_through_a_link(theirs, tmp_path, name):
    outside = tmp_path / "mine"
    if name == "runs":
        (theirs / "runs").rename(tmp_path / "mine" / "runs")
    (theirs / name).parent.mkdir(exist_ok=True, parents=True)
    (theirs / name).symlink_to(outside / ("secret.png" if "." in name[1:] else ""))
    before = sorted(path.name for path in outside.rglob("*"))
    cell = PlannedCell("completion-1", [], "completion", "dist", "sofa", 0, {})
    for write in (lambda: write_index(theirs), lambda: Plan("p", theirs, [cell]).write(), lambda: merge([], theirs)):
        with pytest.raises(ValueError, match="is a link out of the results folder: remove it"):
            write()
    assert sorted(path.name for path in outside.rglob("*")) == before
    assert (outside / "secret.png").read_text() == "secret"
    with pytest.raises(ValueError, match="link out"):
        check_links(theirs)


@pytest.mark.parametrize("place", ["runs/{}", ".locks/{}", "runs/{}/record.json"])
def test_a_run_is_not_resumed_through_a_link(theirs, tmp_path, place):
    identity = run_folder.Identity({"task": "completion", "renderer": "dist", "dataset": "sofa"}, {"seed": 0})
    link = theirs / place.format(identity.name)
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(tmp_path / "mine" / ("" if place == "runs/{}" else "secret.png"))
    with (
        pytest.raises(ValueError, match="is a link out of the results folder"),
        run_folder.claimed(theirs, identity, run_folder.Rerun.none),
    ):
        raise AssertionError("it was claimed")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["secret.png"]
    assert (tmp_path / "mine" / "secret.png").read_text() == "secret"


@pytest.mark.parametrize("name", ["../../mine", "/etc", "..", ".hidden", "a/b", 3, None])
def test_a_planned_cell_has_the_name_of_a_folder(theirs, name):
    cell = {"id": name, "overrides": [], "task": "t", "renderer": "r", "dataset": "d", "seed": 0, "config": {}}
    plan = {"schema": SCHEMA, "name": "p", "asked": "2026-01-01T00:00:00+00:00", "cells": [cell]}
    (theirs / "sweeps" / "p").mkdir(parents=True)
    (theirs / "sweeps" / "p" / "plan.json").write_text(json.dumps(plan))
    assert read_plans(theirs)[0] == []
    assert [record["folder"] for record in read_records(theirs)[0]] == ["sound"]
    (theirs / "sweeps" / "p" / "plan.json").write_text(json.dumps(plan | {"cells": [cell | {"id": "sound-2"}]}))
    assert len(read_plans(theirs)[0]) == 1


@pytest.mark.parametrize("name", ["../../mine", "/etc", "other", 5, None])
def test_a_plan_has_the_name_of_its_folder(theirs, name):
    cell = {"id": "sound-2", "overrides": [], "task": "t", "renderer": "r", "dataset": "d", "seed": 0, "config": {}}
    plan = {"schema": SCHEMA, "name": name, "asked": "2026-01-01T00:00:00+00:00", "cells": [cell]}
    (theirs / "sweeps" / "p").mkdir(parents=True)
    (theirs / "sweeps" / "p" / "plan.json").write_text(json.dumps(plan))
    plans, problems = read_plans(theirs)
    assert plans == [] and "its name must be that of its folder" in problems[0]


def test_a_configuration_in_a_run_folder_is_only_text(theirs, stranger, tmp_path):
    folder = theirs / "runs" / "sound"
    (folder / "config.yaml").write_text(f"renderer:\n  _target_: {stranger}.Renderer\n")
    record = json.loads((folder / "record.json").read_text())
    record["config"] = {"renderer": {"_target_": f"{stranger}.call", "_package_": stranger}, "packages": [stranger]}
    (folder / "record.json").write_text(json.dumps(record))
    write_index(theirs)
    merge([theirs], tmp_path / "joined")
    assert turntable([str(folder)]) == 2
    assert not (tmp_path / "imported").exists()


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
