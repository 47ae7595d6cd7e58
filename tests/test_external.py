"""The command bench.external: a small code of others, run from its photographs to its row; its layouts and errors."""

import contextlib
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
import torch
import yaml

from bench.external import find_recipe, main, read_recipe
from bench.records.record import Record, read_record
from bench.setup.inputs import RunContext, prepare_run
from bench.tables import CONF
from bench.tasks.reconstruction.cameras import CameraMotions
from datasets.files.captures.exports import LAYOUTS, write_idr, write_pmo
from datasets.files.meshes import read_mesh
from datasets.files.own_photographs import Capture, read_capture
from tests.composing import identified
from tests.made_photographs import CENTRE, PLAIN, RADIUS, READ, idr
from tests.runner.driving import by_program, command
from tests.tiny import CPU, icosphere

GROWN = 1.2  # the code's sphere is larger than the true one by this factor
TO_SPHERE = [[0, 0, 2.0, 0.1], [2.0, 0, 0, -0.2], [0, 2.0, 0, 0.3], [0, 0, 0, 1]]  # turned, scaled and shifted
SPHERE_RADIUS = 0.5  # of the unit sphere of `idr`, in the photographs' world
CODE = f'''
"""Writes a sphere about the point where the middles of the masks meet, {GROWN} times as large as they show."""
import sys
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

work, into = map(Path, sys.argv[1:])
cameras, rows, sizes = np.load(work / "photographs/cameras_sphere.npz"), [], []
masks = [np.asarray(Image.open(path)) > 127 for path in sorted((work / "photographs/mask").glob("*.png"))]
assert len(masks) == len(list((work / "photographs/image").glob("*.png"))) == int((work / "count.txt").read_text())
for i, mask in enumerate(masks):
    p = (cameras[f"world_mat_{{i}}"] @ cameras[f"scale_mat_{{i}}"])[:3]
    v, u = np.argwhere(mask).mean(axis=0)
    rows += [u * p[2] - p[0], v * p[2] - p[1]]
    focal = np.linalg.norm(p[0, :3] - p[2, :3] * (p[0, :3] @ p[2, :3]))
    sizes.append((np.sqrt(mask.sum() / np.pi) / focal, p[2]))
rows = np.array(rows)
centre = np.linalg.lstsq(rows[:, :3], -rows[:, 3], rcond=None)[0]
radii = [np.sin(np.arctan(size)) * (axis[:3] @ centre + axis[3]) for size, axis in sizes]
sphere = trimesh.creation.icosphere(4, {GROWN} * np.mean(radii)).apply_translation(centre)
sphere.apply_transform(np.linalg.inv(np.array({TO_SPHERE})))
into.parent.mkdir(parents=True)
sphere.export(into)
print("wrote", into)
'''
RECIPE = {
    "label": "Spheres",
    "layout": "idr",
    "files": {"count.txt": "{count}"},
    "commands": [["{python}", "{code}/code.py", "{work}", "{work}/out/sphere.ply"]],
    "mesh": "out/*.ply",
    "to_sphere": TO_SPHERE,
}


@pytest.fixture(scope="module")
def code(tmp_path_factory) -> Path:
    """The git checkout of the small code, with photographs, their true surface, and the recipe, in files."""
    folder = tmp_path_factory.mktemp("code")
    (folder / "code.py").write_text(CODE)
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false", "-C", folder]
    for arguments in (["init", "-q"], ["add", "code.py"], ["commit", "-q", "-m", "first"]):
        subprocess.run([*git, *arguments], check=True)
    commit = subprocess.run([*git, "rev-parse", "HEAD"], check=True, capture_output=True, text=True).stdout.strip()
    idr(folder / "photos")
    icosphere(RADIUS, CENTRE).save(folder / "truth.ply")
    (folder / "recipe.yaml").write_text(yaml.safe_dump(RECIPE | {"commit": commit}))
    return folder


@pytest.fixture
def changed(code, tmp_path) -> Callable[..., Path]:
    """Writes the recipe with other values."""

    def write(**keys: object) -> Path:
        recipe = yaml.safe_load((code / "recipe.yaml").read_text()) | keys
        (tmp_path / "changed.yaml").write_text(yaml.safe_dump(recipe))
        return tmp_path / "changed.yaml"

    return write


def run_of(recipe: Path, code: Path, into: Path, *overrides: str) -> Record:
    """The record of a recipe's run, made in this process."""
    keys = (f"task.path={recipe}", f"task.code={code}", f"task.python={sys.executable}", *overrides)
    run = identified("task=external", "scale=smoke", "dataset=photos", f"dataset.path={code}/photos", *keys)
    task, inputs = prepare_run(run.config)
    record = Record("a", "external", "dist", "photos", 0, run.config)
    task.execute(RunContext(inputs, into, record, lambda *_: None))
    return record


def test_a_code_of_others_is_run_and_its_mesh_judged_in_the_cameras_world(code, tmp_path):
    into = tmp_path / "run"
    into.mkdir()
    record = run_of(code / "recipe.yaml", code, into, f"dataset.truth={code}/truth.ply", "evaluation.points=3000")
    assert record.status == "ok", record.reason
    expected = (GROWN - 1) * RADIUS / SPHERE_RADIUS
    assert record.metrics["chamfer_l1"] == pytest.approx(expected, abs=0.2 * expected)
    distances = np.linalg.norm(read_mesh(into / "mesh_world.ply").vertices - CENTRE, axis=1)
    assert distances == pytest.approx(GROWN * RADIUS, abs=0.02 * RADIUS)


@pytest.mark.slow
def test_a_code_of_others_has_a_row_with_a_star_and_its_commit_in_the_table(code, tmp_path):
    results, recipe = f"results_dir={tmp_path}", code / "recipe.yaml"
    shared = ["scale=smoke", "dataset=photos", f"dataset.path={code}/photos", f"dataset.truth={code}/truth.ply"]
    shared += ["evaluation.points=20000", "evaluation.picture=null", results]
    assert command("+experiment=photos", "+method=hull", "isolation=off", *shared).code == 0
    theirs = by_program("-m", "bench.external", str(recipe), f"code={code}", f"python={sys.executable}", *shared)
    assert theirs.code == 0, theirs.err
    (folder,) = (tmp_path / "runs").glob("external-*")
    record, name = read_record(folder), f"Spheres ★ {read_recipe(recipe).commit[:7]}"
    assert (record["status"], record["config"]["label"]) == ("ok", name)
    expected = (GROWN - 1) * RADIUS / SPHERE_RADIUS
    assert record["metrics"]["chamfer_l1"] == pytest.approx(expected, abs=0.1 * expected)
    points = read_mesh(folder / "mesh_world.ply").vertices
    distances = np.linalg.norm(points - CENTRE, axis=1)
    assert distances == pytest.approx(GROWN * RADIUS, abs=0.02 * RADIUS)
    assert record["metrics"]["psnr"] > 10 and record["seconds"]["forward"] > 0.1
    table = (tmp_path / "paper" / "photos.md").read_text()
    rows = [line for line in table.splitlines() if line.startswith("|")]
    assert [any(row.startswith(f"| {label} ") for row in rows) for label in (name, "Visual hull")] == [True, True], (
        table
    )
    tex = (tmp_path / "paper" / "photos.tex").read_text()
    assert r"Spheres $\star$" in tex and "★" not in tex
    escaped = json.dumps(name)[1:-1]  # as the page has it
    assert any(escaped in path.read_text() for path in (tmp_path / "page" / "data" / "paper").glob("*.js"))


FAILURES = {  # changed keys of the recipe and the command line, the status, and the reason
    "a failing command": (
        {"commands": [["{python}", "-c", "import sys; print('no GPU here'); sys.exit(5)"]]},
        "crashed",
        r"ended with status 5: correct what its output names\. .*external/output\.txt, and ends with: no GPU here",
    ),
    "no program": (
        {"commands": [["{code}/nothing"]]},
        "crashed",
        r"code\S*/nothing cannot be started .*type python=FILE",
    ),
    "no mesh": ({"mesh": "out/*.obj"}, "crashed", r"wrote no out/\*\.obj in \S+external: correct mesh of the recipe"),
    "an older mesh": (
        {"mesh": "{code}/truth.ply"},
        "crashed",
        r"wrote no \{code\}/truth\.ply in \S+: correct mesh of the recipe",
    ),
    "no faces": (
        {"commands": [["{python}", "-c", "open('mesh.ply', 'w').write('ply')"]], "mesh": "mesh.ply"},
        "crashed",
        "the mesh of the code cannot be read",
    ),
}


@pytest.mark.parametrize("name", FAILURES)
def test_a_failure_is_a_status_with_cause_and_remedy(code, changed, tmp_path, name):
    os.utime(code / "truth.ply", (0, 0))
    keys, status, reason = FAILURES[name]
    record = run_of(changed(**keys), code, tmp_path)
    assert record.status == status and re.search(reason, record.reason), record.reason
    assert record.metrics == {} and not (tmp_path / "mesh.ply").exists()


def test_a_time_limit_ends_the_code_and_its_children(code, changed, tmp_path):
    recipe = changed(commands=[["sh", "-c", "sleep 300 & echo $! > child; wait"]])
    record = run_of(recipe, code, tmp_path, "task.time_limit=1")
    assert record.status == "timeout" and record.reason.startswith("the code took more than 1 s: type time_limit=")
    child = int((tmp_path / "external" / "child").read_text())
    ended = (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)  # a process that has ended may wait for its parent
    deadline = time.monotonic() + 30
    with contextlib.suppress(psutil.NoSuchProcess):
        while psutil.Process(child).status() not in ended:  # a killed process ends when it is scheduled
            assert time.monotonic() < deadline
            time.sleep(0.05)


def test_an_unknown_recipe_and_an_unknown_key_are_named_with_the_nearest(changed, capsys):
    assert main(["neuss", "code=."]) == 2
    assert "unknown recipe 'neuss': did you mean neus?" in capsys.readouterr().err
    recipe = changed(comands=[])
    assert main([str(recipe), "code=."]) == 2
    assert f"recipe {recipe} has no key 'comands': did you mean commands?" in capsys.readouterr().err
    for keys, message in (
        ({"layout": "ird"}, "layout must be one of idr, dvr, pmo, not 'ird'"),
        ({"commit": "main"}, "commit must be 7 to 40 hexadecimal digits, not 'main': type git log -1"),
        ({"commands": [[]]}, "commands must be a list of commands"),
        ({"to_sphere": [[1, 0, 0]]}, "to_sphere must have four rows of four numbers"),
        ({"time_limit": 0}, "time_limit must be positive"),
        ({"to_sphere": [["a"] * 4] * 4}, "to_sphere must have four rows of four numbers"),
        ({"masks": "perhaps"}, "masks must be true or false"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            read_recipe(changed(**keys))


def test_arguments_of_the_code_and_defaults_are_passed_on(code, monkeypatch):
    called = []
    monkeypatch.setattr(subprocess, "call", lambda words: called.append(words[2:]) or 1)
    recipe = code / "recipe.yaml"
    assert main([str(recipe), "code=a", "time_limit=5", "results_dir=b", "seed=1"]) == 1
    (_, *words), report = called
    given = ["task.code=a", "task.time_limit=5", "results_dir=b", "seed=1", "+experiment=photos", "rerun=failed"]
    assert {*given, "task=external", "time_limit=null", f"task.path='{recipe}'"} < {*words}
    assert report == ["bench.report", "results_dir=b"]
    main([str(recipe), "rerun=all", "+experiment=fitted"])
    assert [word for word in called[2] if "rerun" in word or "experiment" in word] == [
        "rerun=all",
        "+experiment=fitted",
    ]
    monkeypatch.setattr(subprocess, "call", lambda words: called.append(words) or 2)
    assert main([str(recipe), "sede=1"]) == 2 and len(called) == 5  # a mistake: no report


def test_another_commit_a_missing_code_and_missing_masks_are_refused(code, changed, tmp_path):
    with pytest.raises(ValueError, match=r"is at commit \w{40}, .* for 1234567: type git -C \S+ checkout"):
        run_of(changed(commit="1234567"), code, tmp_path)
    with pytest.raises(ValueError, match=r"code=\S+ is no git checkout, and the recipe is for"):
        run_of(code / "recipe.yaml", code, tmp_path, f"task.code={tmp_path}")
    with pytest.raises(ValueError, match=r"a recipe and its code are needed: python -m bench\.external NAME"):
        run_of(code / "recipe.yaml", code, tmp_path, "task.path=null")
    with pytest.raises(ValueError, match="Spheres needs a mask of each photograph"):
        run_of(code / "recipe.yaml", code, tmp_path, "task.masks=false")


def test_words_of_a_container_precede_and_variables_arrive(code, changed, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "ours")
    program = "import os, sys; print(sys.argv[1:], os.environ['MINE'], os.environ.get('PYTHONPATH'))"
    recipe = changed(commands=[["{count}"]], variables={"MINE": "{code}"}, container=[sys.executable, "-c", program])
    assert run_of(recipe, code, tmp_path).reason.endswith(f"ends with: ['8'] {code} None")
    assert "echo 8" not in run_of(recipe, code, tmp_path / "b", "task.container=[echo,other]").reason
    assert (tmp_path / "b" / "external" / "output.txt").read_text() == "other 8\n"


@pytest.mark.parametrize("name", sorted(path.stem for path in (CONF / "external").glob("*.yaml")))
def test_a_shipped_recipe_is_read_and_names_its_source(name):
    recipe = read_recipe(find_recipe(name))
    text = find_recipe(name).read_text()
    assert len(recipe.commit) == 40 and recipe.row.endswith(f"★ {recipe.commit[:7]}")
    assert "https://github.com/" in text and "not run here" in text


@pytest.fixture(scope="module")
def capture(code) -> Capture:
    return read_capture(code / "photos", READ)


def offsets(capture: Capture, folder: Path) -> np.ndarray:
    """The differences in pixels between the cameras of a capture and those that are read from a written folder."""
    written = read_capture(folder, READ)
    points = 0.5 * torch.rand(20, 3, generator=torch.Generator().manual_seed(0)) - 0.25
    back = torch.from_numpy(np.linalg.inv(written.to_world)).float()
    moved = points @ back[:3, :3].T + back[:3, 3]
    pairs = zip(capture.shots, written.shots, strict=True)
    return np.array([(b.camera.project(moved)[0] - a.camera.project(points)[0]).numpy() for a, b in pairs])


@pytest.mark.parametrize("layout", ["idr", "dvr"])
def test_a_written_layout_is_read_as_the_same_photographs(capture, tmp_path, layout):
    LAYOUTS[layout](capture.shots, tmp_path, 0.0)
    assert np.abs(offsets(capture, tmp_path)).max() < 1e-3
    written = read_capture(tmp_path, READ)
    for before, after in zip(capture.shots, written.shots, strict=True):
        assert torch.equal(before.mask, after.mask) and torch.allclose(before.colours, after.colours, atol=1 / 255)
    if layout == "dvr":  # the corners of DVR's cube are within one scene unit of its faces
        with np.load(tmp_path / "cameras.npz") as cameras:
            assert np.array_equal(cameras["scale_mat_0"], np.diag([2.0, 2.0, 2.0, 1.0]))


def test_learnt_cameras_are_read_as_the_same_photographs(capture, tmp_path):
    write_idr(capture.shots, tmp_path, 0.0)
    (tmp_path / "cameras_sphere.npz").unlink()
    named = [replace(shot, name=f"image/{index:06d}.png") for index, shot in enumerate(capture.shots)]
    CameraMotions(named, None, True, CPU).save(tmp_path / "transforms.json", capture.to_world)
    result = read_capture(tmp_path, READ)
    points = torch.tensor([[0.0, 0.0, 0.0], [0.3, -0.2, 0.1]])
    pairs = zip(capture.shots, result.shots, strict=True)
    to_read = torch.from_numpy(np.linalg.inv(result.to_world) @ capture.to_world).float()
    moved = points @ to_read[:3, :3].T + to_read[:3, 3]
    assert all(torch.allclose(b.camera.project(moved)[0], a.camera.project(points)[0], atol=1e-3) for a, b in pairs)


def test_the_centre_of_the_first_pixel_moves_the_cameras(capture, tmp_path):
    write_idr(capture.shots, tmp_path, 0.5)
    assert offsets(capture, tmp_path) == pytest.approx(0.5, abs=1e-3)  # read as if it were at 0


def test_photographs_without_masks_get_white_ones(code, tmp_path):
    write_idr(read_capture(code / "photos", PLAIN).shots, tmp_path, 0.0)
    with pytest.raises(ValueError, match="the masks are white everywhere"):
        read_capture(tmp_path, READ)


def test_the_layout_of_pmo_is_what_its_reader_expects(capture, tmp_path):
    write_pmo(capture.shots, tmp_path / "data" / "02958343", 0.0)
    assert (tmp_path / "data/lists/all_test.list").read_text().split() == ["02958343", "photographs"]
    images = np.load(tmp_path / "data/sequences/02958343/photographs.npy")
    height, width = capture.shots[0].mask.shape
    assert (images.shape, images.dtype) == ((len(capture.shots), height, width, 4), np.uint8)
    assert np.array_equal(images[3, ..., 3] == 255, capture.shots[3].mask.numpy())
    cameras, point = np.load(tmp_path / "data/camera.npz"), np.array([0.1, -0.2, 0.3, 1.0])
    for shot, extrinsics in zip(capture.shots, cameras["extr"], strict=True):
        u, v, w = cameras["intr"] @ extrinsics @ point
        expected = shot.camera.project(torch.from_numpy(point[None, :3]).float())[0][0].numpy() - 0.5
        assert np.array([u / w, v / w]) == pytest.approx(expected, abs=1e-3)
    points = (tmp_path / "data/customShapeNet/02958343/ply/photographs.points.ply").read_text()
    assert len(points) > 400 + 60 * 10_002 and {len(line) for line in points.splitlines()} == {59}


def test_the_layout_of_pmo_refuses_several_cameras(capture, tmp_path):
    shots = [capture.shots[0], *(replace(shot, camera=shot.camera.zoomed(1.1)) for shot in capture.shots[1:])]
    with pytest.raises(ValueError, match="the layout pmo has one size, focal length and principal point"):
        write_pmo(shots, tmp_path / "data" / "02958343", 0.0)
