"""Every mistake of a user's ends in one clear line that says what to do, and is told before anything slow."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import trimesh
from hydra.core.global_hydra import GlobalHydra

from bench import run_folder, stage
from bench.__main__ import main

ROOT = Path(__file__).parent.parent
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

    monkeypatch.setattr(stage, "prior_for", slow)


def assert_one_line(err: str, *words: str) -> None:
    lines = err.strip().splitlines()
    assert len(lines) == 1, err
    assert len(lines[0]) < 400
    for word in words:
        assert word in lines[0]


def process(*arguments, **options):
    return subprocess.run(
        [sys.executable, "-m", "bench", *arguments],
        cwd=ROOT, capture_output=True, text=True, timeout=60, check=False, **options,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("task=compleetion", ("unknown task 'compleetion'", "did you mean completion")),
        ("renderer=dits", ("unknown renderer 'dits'", "did you mean dist")),
        ("renderer=zzz", ("unknown renderer 'zzz'", "custom, dist, dvr, idr, naive")),
        ("dataset=soffa", ("unknown dataset 'soffa'", "did you mean sofa")),
        ("scale=smok", ("unknown scale 'smok'", "did you mean smoke")),
        ("+experiment=completion_papper", ("unknown experiment", "did you mean completion_paper")),
        ("experiment=table1", ("experiment is not chosen by default", "write +experiment=NAME")),
        ("strategy=dist", ("strategy is not chosen by default", "write +strategy=NAME")),
        ("+strategy=dits", ("unknown strategy 'dits'", "did you mean dist")),
        ("renderer.alhpa=1", ("unknown key 'renderer.alhpa'", "did you mean renderer.alpha")),
        ("sed=1", ("unknown key 'sed'", "did you mean seed")),
        ("points=5", ("unknown key 'points'", "task.points")),
        ("seed=x", ("seed", "'x'", "Integer")),
        ("verbose=maybe", ("verbose", "'maybe'", "bool")),
        ("device=gpu", ("device", "'gpu'", "auto, cpu, cuda")),
        ("renderer", ("'renderer'", "=")),
    ],
)
def test_a_command_line_that_cannot_be_is_told_with_the_nearest_name(bench, tmp_path, argument, words):
    code, out, err = bench(argument)
    assert code == 2
    assert_one_line(err, "error: ", *words)
    assert out == ""
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("renderer.steps=abc", ("renderer.steps", "'abc'", "int")),
        ("renderer.steps=0", ("steps must be at least 1, not 0",)),
        ("renderer.epsilon=nan", ("epsilon must be positive, not nan",)),
        ("renderer.silhouette_average=some", ("silhouette_average must be one of all, violating",)),
        ("+renderer.alhpa=1", ("renderer has no key 'alhpa'", "did you mean alpha")),
        ("renderer=custom", ("renderer._target_ must be given", "renderer._target_=PACKAGE.CLASS")),
        ("renderer._target_=os.system", ("'os.system'", "packages=[os]")),
        ("renderer._target_=renderers.Dist", ("'renderers.Dist'", "cannot be imported")),
        ("view.resolution=-3", ("resolution must be at least 4, not -3", "resolution=64")),
        ("view.resolution=0", ("resolution must be at least 4, not 0", "resolution=64")),
        ("view.field_of_view=200", ("field_of_view must lie between 0 and 180",)),
        ("view.azimuth=3", ("view.azimuth", "tuple[float, float]")),
        ("view.azimuth=[360,0]", ("azimuth",)),
        ("task.points=0", ("points must be positive, not '0'", "dense")),
        ("task.points=-5", ("points must be positive, not '-5'", "dense")),
        ("task.points=101%", ("points must be at most 100%", "dense")),
        ("task.points=abc", ("points must be an amount, not 'abc'", "dense")),
        ("task.iterations=0", ("task.iterations must be at least 1, not 0",)),
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
def test_a_value_that_cannot_be_is_told_before_anything_slow(bench, no_prior, argument, words):
    code, out, err = bench(argument)
    assert code == 1
    assert_one_line(err, *words)
    folder = Path(out.splitlines()[-1])
    record = json.loads((folder / "record.json").read_text())
    assert record["status"] == "crashed"
    assert record["reason"] in err
    assert folder.name in (folder.parent.parent / "index.html").read_text()


def test_more_points_than_pixels_are_told(bench):
    code, _, err = bench(*TINY, "task.points=5000")
    assert code == 1
    assert_one_line(err, "points must be at most the", "pixels of the shape, not 5000: raise resolution")


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_a_gpu_that_is_not_there_is_told(bench, no_prior):
    code, _, err = bench("device=cuda")
    assert code == 1
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
    assert code == 1
    assert_one_line(err, *words)


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
    assert_one_line(err, "error: ", str(place), "set results_dir to a folder you can write")


def test_a_disk_that_is_full_from_the_start_is_told(bench, monkeypatch):
    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    code, _, err = bench()
    assert code == 1
    assert_one_line(err, "error: ", "No space left on device", "free space")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_a_disk_that_fills_up_during_a_run_is_told(bench, monkeypatch):
    def fill_up(folder):
        for name in ("curve.jsonl", "log.txt"):
            (folder / name).symlink_to("/dev/full")

    monkeypatch.setattr(run_folder, "_reserve", fill_up)
    code, out, err = bench(*TINY, "task.iterations=2")
    assert code == 1
    assert "Traceback" not in out + err
    assert_one_line(err, "No space left on device")
    record = json.loads((Path(out.splitlines()[-1]) / "record.json").read_text())
    assert (record["status"], record["reason"]) == ("crashed", "[Errno 28] No space left on device")


@pytest.mark.parametrize(
    ("argument", "message"), [("renderer=dits", "unknown renderer"), ("renderer.steps=0", "steps must be")]
)
def test_verbose_shows_where_a_mistake_was_found(bench, no_prior, argument, message):
    _, out, err = bench(argument, "verbose=true")
    assert "Traceback (most recent call last)" in err
    assert message in err.strip().splitlines()[-1]
    _, out, err = bench(argument)
    assert "Traceback" not in out + err


@pytest.mark.parametrize("arguments", [["--help"], ["renderer=dits"], ["renderer.alhpa=1"]])
def test_nothing_heavy_is_imported_before_the_command_line_is_sound(arguments):
    code = (
        "import sys\nfrom bench.__main__ import main\ntry: main()\n"
        "finally: print('loaded:', [name for name in ('torch', 'open3d', 'matplotlib') if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.splitlines()[-1] == "loaded: []"


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["renderer=dits"], 2, ("unknown renderer 'dits'", "did you mean dist")),
        (["renderer.alhpa=1"], 2, ("unknown key", "did you mean renderer.alpha")),
    ],
)
def test_a_typo_is_told_at_once(tmp_path, arguments, code, words):
    start = time.perf_counter()
    done = process(*arguments, f"results_dir={tmp_path}")
    assert time.perf_counter() - start < 4
    assert done.returncode == code
    assert_one_line(done.stderr, *words)
    assert done.stdout == ""


def test_help_is_there_at_once():
    start = time.perf_counter()
    done = process("--help")
    assert time.perf_counter() - start < 4
    assert done.returncode == 0
    assert done.stderr == ""
    for word in ("renderer", "dist", "naive", "completion", "sofa", "smoke"):
        assert word in done.stdout


def test_a_real_process_ends_with_one_line_and_its_folder(tmp_path):
    done = process("view.resolution=-3", f"results_dir={tmp_path}")
    assert done.returncode == 1
    assert_one_line(done.stderr, "resolution must be at least 4, not -3")
    assert (Path(done.stdout.splitlines()[-1]) / "record.json").is_file()


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGKILL"])
def test_a_run_that_is_stopped_keeps_what_it_had(tmp_path, name):
    # A shell that starts the tests in the background has them ignore Ctrl-C, and their children with them.
    start = "import runpy, signal; signal.signal(signal.SIGINT, signal.default_int_handler);"
    start += "runpy.run_module('bench', run_name='__main__', alter_sys=True)"
    running = subprocess.Popen(
        [sys.executable, "-c", start, *TINY, "task.iterations=1000000", f"results_dir={tmp_path}"],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        until = time.monotonic() + 60
        while not any(path.read_bytes().count(b"\n") > 3 for path in tmp_path.glob("runs/*/curve.jsonl")):
            assert running.poll() is None, running.communicate()
            assert time.monotonic() < until
            time.sleep(0.05)
        running.send_signal(getattr(signal, name))
        _, err = running.communicate(timeout=30)
    finally:
        running.kill()
        running.communicate()

    (folder,) = (tmp_path / "runs").iterdir()
    record = json.loads((folder / "record.json").read_text())
    lines = (folder / "curve.jsonl").read_text().splitlines()
    assert record["status"] == "killed"
    assert record["reason"]
    assert len(lines) > 3
    assert [json.loads(line)["iteration"] for line in lines[:-1]] == list(range(len(lines) - 1))
    if name != "SIGKILL":
        by = "stopped by Ctrl-C" if name == "SIGINT" else "stopped by SIGTERM"
        assert running.returncode == 130
        assert_one_line(err, by)
        assert by in record["reason"]
        counted = record["evaluations"]["iterations"]  # an iteration counts just before its line is written
        assert counted in (len(lines), len(lines) + 1)
        assert record["metrics_start"]
        assert folder.name in (tmp_path / "index.html").read_text()
    else:
        assert running.returncode == -signal.SIGKILL
        assert "killed before it could say why" in record["reason"]
