"""Every mistake of a user's ends in one clear line that says what to do, and is told before anything slow."""

import errno
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import trimesh
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from bench.__main__ import main
from bench.config import CONF, register
from bench.records import folder as run_folder
from bench.run import cell
from bench.run.check import identified, refusal
from bench.run.command import _explain, options_first
from tests.run.driving import PATIENCE, ROOT, Outcome, driver, lines_of_curves, wait_for

TINY = ("scale=smoke", "view.resolution=16", "task.points=20", "evaluation.grid=16", "evaluation.points=100")


@pytest.fixture
def bench(monkeypatch, capsys, tmp_path):
    """A command line in this process: its exit status, its standard output and its standard error."""
    threads = torch.get_num_threads()
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")  # so that it is put back

    def run(*arguments):
        GlobalHydra.instance().clear()
        given = any(argument.startswith("results_dir=") for argument in arguments)
        monkeypatch.setattr(
            sys, "argv", ["bench", *arguments, "isolation=off", *([] if given else [f"results_dir={tmp_path / 'r'}"])]
        )
        code = main()
        return code, *capsys.readouterr()

    yield run
    torch.set_num_threads(threads)


@pytest.fixture
def no_prior(monkeypatch):
    """A mistake must be told before a prior is looked for, which may mean minutes of training."""

    def slow(*_):
        raise AssertionError("the slow steps began")

    monkeypatch.setattr(cell, "prior_for", slow)


def assert_one_line(err: str, *words: str) -> None:
    lines = err.strip().splitlines()
    assert len(lines) == 1, err
    assert len(lines[0]) < 400
    for word in words:
        assert word in lines[0]


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("task=compleetion", ("unknown task 'compleetion'", "did you mean completion")),
        ("renderer=dits", ("unknown renderer 'dits'", "did you mean dist")),
        (
            "renderer=zzz",
            ("unknown renderer 'zzz'", "custom, dist, dvr, idr, mesh_proxy, naive, neus", "and variants"),
        ),
        ("dataset=soffa", ("unknown dataset 'soffa'", "did you mean sofa")),
        ("scale=smok", ("unknown scale 'smok'", "did you mean smoke")),
        ("+experiment=unseen_bac", ("unknown experiment", "did you mean unseen_back")),
        ("experiment=table1", ("experiment is not chosen by default", "write +experiment=NAME")),
        ("dataset=/etc/passwd", ("unknown dataset '/etc/passwd'", "dataset=mesh dataset.path=/etc/passwd")),
        ("dataset=meshes/cow.obj", ("unknown dataset 'meshes/cow.obj'", "dataset=mesh dataset.path=meshes/cow.obj")),
        ("task=a/b", ("unknown task 'a/b'", "completion")),
        ("hydra/launcher=foo", ("unknown hydra/launcher 'foo'",)),
        ("method=dist_mask", ("method is not chosen by default", "write +method=NAME")),
        ("+method=dist_msk", ("unknown method 'dist_msk'", "did you mean dist_mask")),
        ("renderer=dist_agressive", ("unknown renderer 'dist_agressive'", "did you mean dist_aggressive")),
        ("+sede=1", ("unknown key 'sede'", "did you mean seed")),
        ("+experiment=speed_accuracy", ("unknown experiment 'speed_accuracy'", "table1")),
        ("+experiment=fig10", ("unknown experiment 'fig10'", "fig10_focal", "fig10_start")),
        ("task.iterations=3", ("unknown key 'task.iterations'", "task.optimiser.iterations")),
        ("renderer.alhpa=1", ("unknown key 'renderer.alhpa'", "did you mean renderer.alpha")),
        ("sed=1", ("unknown key 'sed'", "did you mean seed")),
        ("points=5", ("unknown key 'points'", "task.points")),
        ("silhouette.weight=2", ("unknown key 'silhouette.weight'",)),
        ("silhouette=hing", ("unknown silhouette 'hing'", "did you mean hinge")),
        ("seed=x", ("seed", "'x'", "Integer")),
        ("verbose=maybe", ("verbose", "'maybe'", "bool")),
        ("device=gpu", ("device", "'gpu'", "auto, cpu, cuda")),
        ("renderer", ("'renderer'", "=")),
        ("renderer=dist,,dvr", ("'renderer=dist,,dvr' has a comma without a value beside it",)),
        ("renderer=dist,", ("'renderer=dist,' has a comma without a value beside it",)),
        ("--multi", ("unknown option '--multi'", "did you mean --multirun")),
    ],
)
def test_a_command_line_that_cannot_be_is_told_with_the_nearest_name(monkeypatch, argument, words):
    assert_one_line(explained(monkeypatch, argument), *words)


def explained(monkeypatch, *arguments: str) -> str:
    """What is said of a command line that cannot be; empty where it can."""
    monkeypatch.setattr(sys, "argv", ["bench", *arguments])
    GlobalHydra.instance().clear()
    register()
    try:
        overrides = options_first([*arguments])
        with initialize_config_dir(str(CONF), version_base="1.3"):
            config = compose("config", overrides, return_hydra_config=True)
        runtime = config.hydra.runtime
        OmegaConf.set_struct(config, False)
        del config["hydra"]
        return refusal(identified(config, runtime, overrides, overrides).config)
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        return _explain(error)


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("renderer=dits", ("unknown renderer 'dits'", "did you mean dist")),
        ("renderer.alhpa=1", ("unknown key 'renderer.alhpa'", "did you mean renderer.alpha")),
        ("seed=x", ("seed", "'x'", "Integer")),
        ("renderer=dist,,dvr", ("'renderer=dist,,dvr' has a comma without a value beside it",)),
        ("renderer=dist,dvr", ("renderer has several values: add -m for a run of each, write renderer=[dist,dvr]",)),
        ("newton", ("'newton' is no setting: write renderer=newton",)),
        ("--multi", ("unknown option '--multi'", "did you mean --multirun")),
        ("renderer.steps=0", ("steps must be at least 1, not 0",)),
    ],
)
def test_the_command_says_so_in_a_line_and_leaves_nothing(bench, tmp_path, no_prior, argument, words):
    code, out, err = bench(argument)
    assert (code, out) == (2, "")
    assert_one_line(err, "error: ", *words)
    assert not list((tmp_path / "r" / "runs").glob("*"))


def test_a_results_folder_without_a_name_is_told(bench, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, _, err = bench("results_dir=")
    assert code == 2 and not list(tmp_path.iterdir())
    assert_one_line(err, "results_dir must name a folder")


@pytest.mark.parametrize("word", ["list", "help", "--help"])
def test_a_word_lists_what_there_is(bench, word):
    code, out, err = bench(word)
    assert (code, err) == (0, "")
    for name in ("completion", "newton", "sofa", *(["table1", "dist_mask"] if word == "list" else ["-m +experiment="])):
        assert name in out


@pytest.mark.parametrize(
    ("given", "arranged"),
    [
        (["seed=0,1", "-m"], ["-m", "seed=0,1"]),
        (
            ["a=1", "--config-dir", "my conf", "b=2", "--multirun"],
            ["--config-dir", "my conf", "--multirun", "a=1", "b=2"],
        ),
        (["a=1", "--config-dir=x", "--cfg", "job"], ["--config-dir=x", "--cfg", "job", "a=1"]),
        (["a=-1", "--help"], ["--help", "a=-1"]),
        (["a=1", "--info", "b=2"], ["--info", "a=1", "b=2"]),
    ],
)
def test_options_may_stand_anywhere(given, arranged):
    assert options_first(given) == arranged


@pytest.mark.parametrize("multirun", [[], ["-m"]])
def test_a_mask_loss_that_no_task_reads_is_told_before_any_run(bench, tmp_path, multirun):
    code, _, err = bench(*multirun, "task=gradients", "silhouette=hinge,own" if multirun else "silhouette=hinge")
    assert code == 2
    assert_one_line(err, "cell 1 of 2 (silhouette=hinge): " if multirun else "error: ", "silhouette is read by")
    assert not (tmp_path / "r" / "runs").exists()


@pytest.mark.parametrize("options", [(), ("-m",)])
def test_a_renderer_in_place_of_a_methods_asks_for_a_name(bench, no_prior, options):
    code, _, err = bench(*options, "+method=dist_mask", "renderer=dvr", "plan=true")
    assert code == 2
    assert_one_line(err, "renderer=dvr beside +method=dist_mask", "'DIST with mask'", "label=NAME")
    assert bench(*options, "+method=dist_mask", "renderer=dvr", "label=mine", "plan=true")[0] == 0


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("renderer.steps=abc", ("renderer.steps", "'abc'", "int")),
        ("renderer.steps=0", ("steps must be at least 1, not 0",)),
        ("renderer.epsilon=nan", ("epsilon must be positive, not nan",)),
        ("renderer.silhouette_average=some", ("silhouette_average must be one of all, violating",)),
        ("+renderer.alhpa=1", ("renderer has no key 'alhpa'", "did you mean alpha")),
        ("+renderer.samples=3", ("renderer has no key 'samples'", "n_gradient_samples")),
        ("renderer=custom", ("renderer._target_ must be given", "renderer._target_=PACKAGE.CLASS")),
        ("renderer._target_=os.system", ("'os.system'", "os is of Python's standard library")),
        ("renderer._target_=renderers.Dist", ("'renderers.Dist'", "cannot be imported")),
        ("view.resolution=-3", ("resolution must be at least 4, not -3", "resolution=64")),
        ("view.resolution=0", ("resolution must be at least 4, not 0", "resolution=64")),
        ("view.field_of_view=200", ("field_of_view must lie between 0 and 180",)),
        ("view.azimuth=3", ("view.azimuth", "tuple[float, float]")),
        ("models.candidates=sphere", ("models.candidates must be a list: write models.candidates=[sphere]",)),
        ("view.azimuth=[360,0]", ("azimuth",)),
        ("task.points=0", ("points must be positive, not '0'", "dense")),
        ("task.points=-5", ("points must be positive, not '-5'", "dense")),
        ("task.points=101%", ("points must be at most 100%", "dense")),
        ("task.points=abc", ("points must be an amount, not 'abc'", "dense")),
        ("task.optimiser.iterations=0", ("task.optimiser.iterations must be at least 1, not 0",)),
        ("split=tst", ("split must be one of train, validation, test, not 'tst'",)),
        ("index=-1", ("index must be at least 0, not -1",)),
        ("seed=-1", ("seed", "-1")),
        ("threads=0", ("threads must be at least 1, not 0",)),
        ("evaluation.grid=2", ("evaluation.grid must be at least 8, not 2",)),
        ("evaluation.points=0", ("evaluation.points must be at least 1, not 0",)),
        ("evaluation.every=0", ("evaluation.every must be at least 1, not 0",)),
        ("evaluation.picture=0", ("evaluation.picture", "0")),
        ("evaluation.fscore_threshold=0", ("threshold must be positive",)),
        ("prior.steps=0", ("prior.steps must be at least 1, not 0",)),
        ("dataset=mesh", ("dataset.path must be given: set dataset.path=",)),
    ],
)
def test_a_value_that_cannot_be_is_told_before_anything_slow(monkeypatch, no_prior, argument, words):
    assert_one_line(explained(monkeypatch, argument), *words)


def test_more_points_than_pixels_are_told(bench):
    code, _, err = bench(*TINY, "task.points=5000")
    assert code == 2
    assert_one_line(err, "points must be at most the", "pixels of the shape, not 5000: give fewer")


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_a_gpu_that_is_not_there_is_told(bench, no_prior):
    code, _, err = bench("device=cuda")
    assert code == 2
    assert_one_line(err, "device=cuda", "set device=cpu")


def box(path: Path) -> Path:
    trimesh.creation.box((1.0, 0.6, 0.4)).export(path)
    return path


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda folder: folder / "none.obj", ("found nothing at", "check the spelling")),
        (lambda folder: box(folder / "chair.ply").with_name("chiar.ply"), ("did you mean", "chair.ply")),
        (lambda folder: written(folder / "empty.obj", b""), ("empty.obj", "found 0 bytes", "export or copy it again")),
        (lambda folder: written(folder / "rubbish.ply", bytes(range(256))), ("rubbish.ply", "copy it again")),
        (lambda folder: written(folder / "rubbish.stl", b"\xff" * 300), ("rubbish.stl", "export it")),
        (
            lambda folder: written(folder / "half.ply", trimesh.creation.icosphere(2).export(file_type="ply")[:3000]),
            ("half.ply", "must be a whole .ply file, but reading failed", "copy it again"),
        ),
        (
            lambda folder: written(folder / "one.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
            ("one.obj", "must enclose a volume, found a single triangle", "export a closed surface"),
        ),
        (lambda folder: written(folder / "chair.blend", b"x"), ("must end in one of .obj", "export it")),
        (lambda folder: written(folder / "notes.txt", b"x").parent, ("must hold mesh files", "name the folder")),
        (
            lambda folder: written(folder / "nan.obj", b"v 0 0 0\nv 1 0 0\nv nan 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n"),
            ("nan.obj", "NaN", "export the mesh again"),
        ),
        (
            lambda folder: written(folder / "points.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"),
            ("points.obj", "faces", "export it"),
        ),
    ],
)  # fmt: skip
def test_a_mesh_that_cannot_be_used_is_told(bench, no_prior, tmp_path, make, words):
    (tmp_path / "my shapes").mkdir()
    path = make(tmp_path / "my shapes")
    code, _, err = bench("dataset=mesh", f"dataset.path={path}")
    assert_one_line(err, *words)
    assert code == 2
    assert list((tmp_path / "r" / "runs").iterdir()) == []


def test_what_was_repaired_is_told_where_the_run_fails_later(bench, no_prior, tmp_path):
    ball = trimesh.creation.icosphere(2)
    half = trimesh.Trimesh(ball.vertices, ball.faces[ball.triangles_center[:, 2] > 0])
    half.export(tmp_path / "half.ply")
    code, out, err = bench(*TINY, "dataset=mesh", f"dataset.path={tmp_path / 'half.ply'}", "split=train")
    assert code == 1
    assert "the slow steps began" in err
    notes = [line for line in out.splitlines() if line.startswith("note: ")]
    assert any(note.startswith("note: warning: repair changed the area from ") for note in notes)
    assert "note: 1 hole closed" in notes


def written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("name", ["Stühle.ply", "chair (1).ply", "a=b.ply", "a,b.ply"])
def test_a_path_that_hydra_cannot_read_bare_is_told_how_to_write(bench, tmp_path, name):
    code, _, err = bench("dataset=mesh", f"dataset.path={tmp_path / name}")
    assert code == 2
    assert_one_line(err, "quote")


@pytest.mark.parametrize("where", ["below a file", "where the system allows none", "in a folder without the right"])
def test_a_results_folder_that_cannot_be_written_is_told(bench, tmp_path, where):
    (tmp_path / "file").write_text("")
    (tmp_path / "locked").mkdir()
    place = {
        "below a file": tmp_path / "file" / "results",
        "where the system allows none": Path("/proc/results"),
        "in a folder without the right": tmp_path / "locked" / "results",
    }[where]
    if where == "where the system allows none" and not Path("/proc/self").exists():
        pytest.skip("this system has no /proc")
    if where == "in a folder without the right":
        (tmp_path / "locked").chmod(0o500)
        if os.access(tmp_path / "locked", os.W_OK):
            pytest.skip("this user may write anywhere")
    code, out, err = bench(f"results_dir={place}")
    assert code == 1
    assert out == ""
    told = f"({tmp_path / 'file'})" if where == "below a file" else str(place)
    assert_one_line(err, "error: ", told, "set results_dir to a folder you can write")


def test_a_disk_that_is_full_from_the_start_is_told(bench, tmp_path, monkeypatch):
    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    code, _, err = bench()
    assert code == 1
    assert_one_line(err, "error: ", f"No space left on device ({tmp_path / 'r'})", "free space")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_a_disk_that_fills_up_during_a_run_is_told(bench, monkeypatch):
    def fill_up(folder):
        for name in ("curve.jsonl", "log.txt"):
            (folder / name).symlink_to("/dev/full")

    monkeypatch.setattr(run_folder, "_reserve", fill_up)
    code, out, err = bench(*TINY, "task.optimiser.iterations=2")
    assert code == 1
    assert "Traceback" not in out + err
    assert_one_line(err, "No space left on device")
    record = json.loads((Path(out.splitlines()[-1]) / "record.json").read_text())
    assert record["status"] == "crashed" and f"({Path(out.splitlines()[-1])}): free space" in record["reason"]


@pytest.mark.parametrize(
    ("argument", "message"), [("renderer=dits", "unknown renderer"), ("renderer.steps=0", "steps must be")]
)
def test_verbose_shows_where_a_mistake_was_found(bench, no_prior, argument, message):
    _, out, err = bench(argument, "verbose=true")
    assert "Traceback (most recent call last)" in err
    assert message in err.strip().splitlines()[-1]
    _, out, err = bench(argument)
    assert "Traceback" not in out + err


def before_work(*arguments: str) -> tuple[Outcome, list[str]]:
    """A command in a Python of its own, and which of the libraries that are slow to load it had loaded at its end."""
    code = "\n".join(
        [
            "import sys",
            "from bench.__main__ import main",
            "try: code = main()",
            "except SystemExit as error: code = error.code",  # --help
            "print(*(name for name in ('torch', 'open3d', 'matplotlib') if name in sys.modules))",
            "sys.exit(code)",
        ]
    )
    program = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(program, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE, check=False)
    *out, loaded = done.stdout.splitlines()
    return Outcome(done.returncode, "\n".join(out), done.stderr), loaded.split()


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["renderer=dits"], 2, ("unknown renderer 'dits'", "did you mean dist")),
        (["renderer.alhpa=1"], 2, ("unknown key", "did you mean renderer.alpha")),
    ],
)
def test_a_typo_is_told_before_anything_slow_is_loaded(tmp_path, arguments, code, words):
    done, loaded = before_work(*arguments, f"results_dir={tmp_path}")
    assert loaded == []
    assert (done.code, done.out) == (code, "")
    assert_one_line(done.err, *words)


def test_help_is_there_before_anything_slow_is_loaded():
    done, loaded = before_work("--help")
    assert loaded == []
    assert (done.code or 0, done.err) == (0, "")
    for word in ("renderer", "dist", "naive", "completion", "sofa", "smoke"):
        assert word in done.out


def test_help_may_be_read_in_part():
    done = subprocess.run(f"{sys.executable} -m bench --help | head -n 1", shell=True, cwd=ROOT, capture_output=True)
    assert done.returncode == 0 and done.stdout.startswith(b"`python -m bench") and done.stderr == b""


def test_a_real_process_that_is_refused_ends_with_one_line_and_no_folder(tmp_path):
    with driver(tmp_path / "output", "view.resolution=-3", f"results_dir={tmp_path}") as running:
        done = running.ended()
    assert (done.code, done.out) == (2, "")
    assert_one_line(done.err, "error: ", "resolution must be at least 4, not -3")
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("name", ["SIGTERM", "SIGKILL"])
def test_a_run_that_is_stopped_keeps_what_it_had(tmp_path, name):
    arguments = (*TINY, "task.optimiser.iterations=1000000", f"results_dir={tmp_path}")
    with driver(tmp_path / "output", *arguments) as running:
        wait_for(lambda: lines_of_curves(tmp_path) > 3, running)
        stopped = running.send(getattr(signal, name))
    err = stopped.err

    (folder,) = (tmp_path / "runs").iterdir()
    record = json.loads((folder / "record.json").read_text())
    lines = (folder / "curve.jsonl").read_text().splitlines()
    assert record["status"] == "killed"
    assert record["reason"]
    assert len(lines) > 3
    assert [json.loads(line)["iteration"] for line in lines[:-1]] == list(range(len(lines) - 1))
    if name != "SIGKILL":
        by = "stopped by SIGTERM"  # of Ctrl-C: a sweep in test_launchers
        assert stopped.code == 130
        assert_one_line(err, by)
        assert by in record["reason"]
        counted = record["evaluations"]["iterations"]  # an iteration counts just before its line is written
        assert counted in (len(lines), len(lines) + 1)
        assert record["metrics_start"]
    else:
        assert stopped.code == -signal.SIGKILL
        assert "killed before it could say why" in record["reason"]
