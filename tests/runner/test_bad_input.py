"""Every mistake of a user ends in one clear line with a remedy, before anything slow."""

import errno
import json
import signal
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
import trimesh
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from bench.records import folder as run_folder
from bench.records.results import write_error_message
from bench.runner.command import message_of, options_of, quote_text
from bench.runner.compose import parse_override
from bench.runner.plan import refusal_reason
from bench.setup import priors
from tests.composing import identified
from tests.conftest import pytest_configure
from tests.looped import each
from tests.runner.driving import ROOT, by_program, driver, errors, lines_of_curves, record_of, wait_for

TINY = ("scale=smoke", "view.resolution=16", "task.points=20", "evaluation.grid=16", "evaluation.points=100")


@pytest.fixture
def bench(isolated):
    """Runs a command line and its runs in this process; gives its exit status and outputs."""
    return lambda *arguments: isolated(*arguments, "isolation=off")


@pytest.fixture
def no_prior(monkeypatch):
    """Fails if a prior is looked for, which may take minutes of training: a mistake must be reported before."""

    def slow(*_):
        raise AssertionError("the slow steps began")

    monkeypatch.setattr(priors, "prior_for", slow)


def assert_one_line(err: str, *words: str) -> None:
    (line,) = errors(err)
    assert len(line) < 400 and all(word in line for word in words), (line, words)


@each("arguments, words", [
    ("stress=thin_plat", ("unknown stress 'thin_plat'", "did you mean thin_plate", "conf/README.md")),
    ("task=compleetion", ("unknown task 'compleetion'", "did you mean completion")),
    ("renderer=zzz", ("unknown renderer 'zzz'", "custom, dist, dvr, edge_sampling, idr, mesh_proxy", "and variants")),
    ("experiment=table1", ("experiment is not chosen by default", "write +experiment=NAME")),
    ("dataset=meshes/cow.obj", ("unknown dataset 'meshes/cow.obj'", "dataset=mesh dataset.path=meshes/cow.obj")),
    ("+sede=1", ("unknown key 'sede'", "did you mean seed")),
    ("dataset.index=3", ("unknown key 'dataset.index'", "did you mean index?")),
    ("hydra.launcher.n_jobs=1", ("unknown key 'hydra.launcher.n_jobs'", "hydra/launcher=workers")),
    ("xyzzy=1", ("unknown key 'xyzzy': none of ", "--cfg job shows them")),
    ("+experiment=fig10", ("unknown experiment 'fig10'", "fig10_focal", "fig10_start", "--config-dir FOLDER")),
    ("task.iterations=3", ("unknown key 'task.iterations'", "task.optimiser.iterations")),
    ("seed=x", ("seed must be a whole number, not 'x'",)),
    ("verbose=maybe", ("verbose must be true or false, not 'maybe'",)),
    ("device=gpu", ("device must be one of auto, cpu, cuda, not 'gpu'",)),
    ("evaluation.every=1.5", ("evaluation.every must be a whole number or a word or null, not '1.5'",)),
    ("renderer", ("'renderer'", "=")),
    ("newton", ("'newton' is no setting: write renderer=newton",)),
    ("renderer=dist,,dvr", ("'renderer=dist,,dvr' has a comma without a value beside it",)),
    ("--mutlirun", ("unknown option '--mutlirun'", "did you mean --multirun")),
    ("--renderer=dist", ("unknown option '--renderer=dist'", "write renderer=VALUE")),
    ("--seed", ("settings have no dashes, write seed=VALUE",)),
    ("renderer=[dist,dvr]", ("one renderer", "-m renderer=A,B")),
    ("renderer=custom renderer.steps=3", ("+renderer.steps=VALUE",)),
    ("renderer._target_=mypkg.Mine", ("packages=[mypkg]", "is renderer=custom renderer._target_=mypkg.Mine")),
    ("renderer._target_=tests.user_renderer.Mine packages=[tests]", ("has no key 'epsilon'", "is renderer=custom")),
    ("task=[1,2]", ("task=[1,2]: task is chosen by a name: write task=NAME",)),
    ("+scale=smoke", ("scale is chosen by default: write scale=NAME, without a plus",)),
    ("++renderer=dvr", ("write renderer=NAME, without a plus",)),
    ("task=multiview silhouette=hinge", ("silhouette is read only by task=capacity, completion",)),
    ("task.colour_weight=1", ("set prior=textured field=prior",)),
    ("task.colour_weight=1 prior=textured field=grid_8", ("set prior=textured field=prior",)),
])  # fmt: skip
def test_an_invalid_command_line_is_an_error_with_the_nearest_name(monkeypatch, arguments, words):
    assert_one_line(explained(monkeypatch, *arguments.split()), *words)


def explained(monkeypatch, *arguments: str) -> str:
    """The message on an invalid command line; empty for a valid one."""
    monkeypatch.setattr(sys, "argv", ["bench", *arguments])
    try:
        return refusal_reason(identified(*arguments).config)
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        return message_of(error)


@pytest.mark.parametrize(("arguments", "words"), [
    (["index=0,1"], "index has several values: add -m for a run of each, write index=[0,1]"),
    (["renderer.steps=0"], "steps must be at least 1, not 0"),
    (["-m", "index=0,-1"], "cell 2 of 2 (index=-1): index must be at least 0"),
    (["memory_limit=-1"], "memory_limit must be positive"),
])  # fmt: skip
def test_the_command_reports_a_mistake_in_one_line_and_leaves_nothing(bench, tmp_path, no_prior, arguments, words):
    code, out, err = bench(*arguments)
    assert (code, out) == (2, "")
    assert_one_line(err, "error: ", words)
    assert not list((tmp_path / "r" / "runs").glob("*"))


def test_a_long_list_of_names_has_short_lines(bench):
    code, _, err = bench("task=stability", "stress=?")
    assert code == 2 and max(map(len, err.splitlines())) <= 100
    assert {"thin_plate,", "wires,"} <= {*err.split()}


def test_unknown_kernels_are_refused_before_a_run(bench, tmp_path, no_prior, monkeypatch):
    monkeypatch.setenv("IMPLICIT_BENCH_KERNELS", "quick")
    status, _, err = bench(*TINY, f"results_dir={tmp_path / 'results'}")
    assert status == 2 and not (tmp_path / "results").exists()
    assert_one_line(err, "IMPLICIT_BENCH_KERNELS must be torch or compiled, not 'quick'")


def test_a_mistyped_key_in_a_row_of_the_users_names_its_file(bench, tmp_path, no_prior):
    (tmp_path / "my conf").mkdir()
    table = tmp_path / "my conf" / "methods.yaml"
    for key, words in (("task.depht_weight", "did you mean depth_weight?"), ("rendrer", "did you mean renderer?")):
        table.write_text(f"mine: {{renderer: idr, {key}: 3}}\n")
        code, _, err = bench("--config-dir", str(table.parent), "+method=mine")
        assert code == 2
        assert_one_line(err, f"{words} It is in {table}")


@pytest.mark.parametrize("text", ["task: {points: 20}", "defaults: [override /task: completion]"])
def test_an_experiment_without_its_first_line_is_an_error_that_names_the_line(bench, tmp_path, text):
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "mine.yaml").write_text(text)
    code, _, err = bench("--config-dir", str(tmp_path), "+experiment=mine")
    assert code == 2
    assert_one_line(err, "must begin with the line # @package _global_")


@pytest.mark.parametrize("word", ["list", "help"])
def test_a_word_lists_the_choices(bench, word):
    code, out, err = bench(word)
    assert (code, err) == (0, "")
    for name in (
        "completion",
        "newton",
        "sofa",
        *(["table1", "dist_mask", "conf/README.md"] if word == "list" else ["-m +experiment="]),
    ):
        assert name in out


@each("typed, options, overrides", [
    ("seed=0,1 -m", {"multirun": True}, ["seed=0,1"]),
    ("a=1 --config-dir mine b=-2 --multirun", {"config_dir": "mine", "multirun": True}, ["a=1", "b=-2"]),
    ("a=1 --config-dir=x --cfg job", {"config_dir": "x", "cfg": "job"}, ["a=1"]),
])  # fmt: skip
def test_options_may_stand_anywhere(typed, options, overrides):
    parsed = vars(options_of(typed.split()))
    assert parsed["overrides"] == overrides and options.items() <= parsed.items()


@each("text, label", [
    ("Nan", "Nan"), ("1e3", "1e3"), ("true", "true"), ("007", "007"), ("'1'", "1"), ("null", None), ("A b", "A b"),
    ("'a,1'", "a,1"), ("${seed}", "5"),
])  # fmt: skip
def test_a_label_is_the_text_that_was_typed(text, label):
    assert identified(quote_text(f"label={text}"), "seed=5").config["label"] == label


def test_the_command_keeps_labels_as_typed_in_a_sweep_too(bench, no_prior):
    code, out, _ = bench("-m", "label=Nan,1e3,Mine", "plan=true")
    assert code == 0 and all(f"completion, {label}, sofa" in out for label in ("Nan", "1e3", "Mine")), out


def test_a_path_is_the_text_that_was_typed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/home/me")

    def paths(text: str) -> list[str]:
        parsed = parse_override(quote_text(f"dataset.path={text}"))
        return [*parsed.sweep_iterator()] if parsed.is_sweep_override() else [parsed.value()]

    for text in ("1e5", "true", "李明.obj", "a b/chair (1).obj", "it's.obj"):
        assert paths(text) == [text]
    assert paths("null") == [None] and paths("~/chair.obj") == paths("'~/chair.obj'") == ["/home/me/chair.obj"]
    assert paths("a,b.obj") == ["a", "b.obj"]
    Path("a,b.obj").touch()
    assert paths("a,b.obj") == ["a,b.obj"]


def test_a_number_stays_one_if_the_key_takes_one():
    for argument in ("seed=1", "time_limit=1e3", "verbose=true", "renderer.label=1", "label=", "-m"):
        assert quote_text(argument) == argument


def test_a_renderer_in_place_of_a_methods_asks_for_a_name(bench, no_prior):
    code, _, err = bench("+method=dist_mask", "renderer=dvr", "plan=true")
    assert code == 2
    assert_one_line(err, "renderer=dvr beside +method=dist_mask", "'DIST with mask'", "label=NAME")
    assert bench("+method=dist_mask", "renderer=dvr", "label=mine", "plan=true")[0] == 0


@each("argument, words", [
    ("renderer=custom", ("renderer._target_ must be given", "renderer._target_=PACKAGE.CLASS")),
    ("view.azimuth=3", ("view.azimuth must be a list of 2, not 3",)),
    ("models.candidates=sphere", ("models.candidates must be a list", ": write models.candidates=[sphere]")),
    ("task.points=0", ('points must be "dense", a share', "not '0'")),
    ("split=tst", ("split must be one of train, validation, test, not 'tst'",)),
    ("index=1000000", ("index must be at most 999999, not 1000000",)),
    ("time_limit=0", ("time_limit must be positive",)),
    ("evaluation.fscore_threshold=0", ("threshold must be positive",)),
    ("dataset=mesh", ("dataset.path must be given: set dataset.path=", "a mesh file or a folder of them")),
    ("results_dir=", ("results_dir must name a folder",)),
])  # fmt: skip
def test_an_invalid_value_is_an_error_before_anything_slow(monkeypatch, no_prior, argument, words):
    assert_one_line(explained(monkeypatch, argument), *words)


@each("argument, words", [
    ("field.width=3", ("field._target_ names 'mynet.Net': type packages=[mynet]",)),
    ("packages=[torch]", ("error: field_path: there is nothing at 'none.pth'",)),
])  # fmt: skip
def test_keys_of_a_network_are_named_as_typed(bench, argument, words):
    target = "mynet.Net" if "width" in argument else "torch.nn.Identity"
    code, _, err = bench("field=file", "field_path=none.pth", f"field._target_={target}", argument)
    assert code == 2
    assert_one_line(err, *words)


def test_more_points_than_pixels_are_an_error(bench):
    code, _, err = bench(*TINY, "task.points=5000")
    assert code == 2
    assert_one_line(err, "points must be at most the", "pixels of the shape, not 5000: give fewer")


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_a_missing_gpu_is_an_error(bench, no_prior):
    code, _, err = bench("device=cuda")
    assert code == 2
    assert_one_line(err, "device=cuda", "set device=cpu")


def test_a_mesh_that_cannot_be_used_is_an_error(bench, no_prior, tmp_path):
    (tmp_path / "my shapes").mkdir()
    for name, data, words in (
        ("half.ply", trimesh.creation.icosphere(2).export(file_type="ply")[:3000], ("half.ply", "copy it again")),
        ("one.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", ("must enclose a volume", "export a closed surface")),
    ):
        path = tmp_path / "my shapes" / name
        path.write_bytes(data)
        code, _, err = bench("dataset=mesh", f"dataset.path={path}")
        assert_one_line(err, *words)
        assert code == 2 and list((tmp_path / "r" / "runs").iterdir()) == []


def test_repairs_are_reported_also_if_the_run_fails_later(bench, no_prior, tmp_path):
    ball = trimesh.creation.icosphere(2)
    half = trimesh.Trimesh(ball.vertices, ball.faces[ball.triangles_center[:, 2] > 0])
    half.export(tmp_path / "half.ply")
    code, out, err = bench(*TINY, "dataset=mesh", f"dataset.path={tmp_path / 'half.ply'}", "split=train")
    assert code == 1 and "the slow steps began" in err
    notes = [line for line in out.splitlines() if line.startswith("note: ")]
    assert any(note.startswith("note: warning: repair changed the area from ") for note in notes)
    assert "note: 1 hole closed" in notes


@each("name", ["Stühle.ply", "chair (1).ply", "a=b.ply", "a,b.ply"])
def test_a_path_that_hydra_cannot_read_bare_must_be_quoted(monkeypatch, name):
    assert_one_line(explained(monkeypatch, "dataset=mesh", f"dataset.path={name}"), "quote")


def test_a_disk_without_locks_has_its_remedy():
    assert "on a local disk" in write_error_message(OSError(errno.ENOLCK, "No locks available"), "results")
    assert "on a local disk" not in write_error_message(OSError(errno.EACCES, "Permission denied"), "results")


def test_a_results_folder_that_cannot_be_written_is_an_error(bench, tmp_path):
    (tmp_path / "file").write_text("")
    for results in (tmp_path / "file" / "results", Path("/proc/results")):
        code, out, err = bench(f"results_dir={results}")
        assert (code, out) == (1, "")
        named = f"({tmp_path / 'file'})" if results.parent.name == "file" else str(results)
        assert_one_line(err, "error: ", named, "set results_dir to a folder you can write")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_a_disk_that_fills_up_during_a_run_is_an_error(bench, monkeypatch):
    def fill_up(folder):
        for name in ("curve.jsonl", "log.txt"):
            (folder / name).symlink_to("/dev/full")

    monkeypatch.setattr(run_folder, "_reserve_bytes", fill_up)
    code, out, err = bench(*TINY, "task.optimiser.iterations=2")
    assert code == 1 and "Traceback" not in out + err
    assert_one_line(err, "No space left on device")
    record = record_of(out)
    assert record["status"] == "crashed" and f"({Path(out.splitlines()[-1])}): free space" in record["reason"]


def test_verbose_shows_the_traceback_of_a_mistake(bench, no_prior):
    _, out, err = bench("renderer.steps=0", "verbose=true")
    assert "Traceback (most recent call last)" in err and "steps must be" in err.strip().splitlines()[-1]
    _, out, err = bench("renderer.steps=0")
    assert "Traceback" not in out + err


def test_a_typo_and_help_are_answered_before_anything_slow_is_loaded(tmp_path):
    code = (
        "import sys, bench.runner.run; from bench.__main__ import main; code = main(); sys.argv = ['bench', '--help']; "
        "main(); print(*{'numpy', 'torch', 'open3d', 'pandas'} & {*sys.modules}); sys.exit(code)"
    )
    result = by_program("-c", code, "renderer.alhpa=1", f"results_dir={tmp_path}")
    *text, loaded = result.out.split("\n")[:-1]
    assert (result.code, loaded) == (2, "")
    assert_one_line(result.err, "unknown key", "did you mean renderer.alpha")
    assert all(word in "\n".join(text) for word in ("renderer", "dist", "naive", "completion", "sofa", "smoke"))


def test_help_may_be_read_partly():
    process = subprocess.run(f"{sys.executable} -m bench --help | head -n 1", shell=True, cwd=ROOT, capture_output=True)
    assert process.returncode == 0 and process.stdout.startswith(b"`python -m bench") and process.stderr == b""


def test_a_stopped_run_keeps_its_record_and_curve(tmp_path):
    arguments = (*TINY, "task.optimiser.iterations=1000000", f"results_dir={tmp_path}")
    with driver(tmp_path / "output", *arguments) as running:
        wait_for(lambda: lines_of_curves(tmp_path) > 3, running)
        stopped = running.send(signal.SIGTERM)  # SIGKILL and Ctrl-C: of sweeps, in test_launchers
    (folder,) = (tmp_path / "runs").iterdir()
    record = json.loads((folder / "record.json").read_text())
    lines = (folder / "curve.jsonl").read_text().splitlines()
    assert (stopped.code, record["status"]) == (130, "killed")
    assert_one_line(stopped.err, "stopped by SIGTERM")
    assert "stopped by SIGTERM" in record["reason"] and record["metrics_start"]
    assert [json.loads(line)["iteration"] for line in lines] == list(range(len(lines))) and len(lines) > 3
    assert record["evaluations"]["iterations"] - len(lines) in (0, 1)  # an iteration counts before its line is written


def test_the_contract_test_of_renderer_custom_needs_a_class():
    options = {"keyword": "custom", "--renderer": None}
    with pytest.raises(pytest.UsageError, match=r"add --renderer=PACKAGE\.CLASS"):
        pytest_configure(Mock(getoption=options.get))
