"""Shape from one image from the command line: trained, inferred, judged, and the rows that need no network."""

import json
import sys
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch
import trimesh
from hydra.core.global_hydra import GlobalHydra

from bench.records.read import read_records
from bench.single_view.baselines import best_shape, mean_shape, most_alike
from bench.tasks.single_view import DEFINITIONS, Inside
from bench.train.__main__ import main
from datasets.dataset import Split
from datasets.truth import Truth
from tests.run.driving import command, record_of
from tests.single_view.test_training import IMAGING, Balls, images  # noqa: F401, a fixture
from tests.tiny import silent

TINY = (
    "+method=single_view", "dataset=sphere", "scale=smoke", "isolation=off", "threads=1", "task.training.shapes=3",
    "task.training.steps=4", "task.training.shapes_per_step=2", "task.training.rays=16", "task.images.views=3",
    "task.image_pixels=16", "evaluation.grid=24", "evaluation.points=200", "evaluation.picture=32",
)  # fmt: skip


def trained(capsys, *arguments: str) -> tuple[int, str, str]:
    """The exit status and the outputs of `python -m bench.train`."""
    GlobalHydra.instance().clear()
    with mock.patch.object(sys, "argv", ["bench.train", *arguments]):
        code = main()
    return code, *capsys.readouterr()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("results")


@pytest.fixture
def network(folder, capsys) -> Path:
    code, out, err = trained(capsys, *TINY, f"results_dir={folder}")
    assert code == 0, err
    return Path(out.splitlines()[-1])


def test_it_is_trained_and_gives_a_shape_with_colours(folder, network):
    assert network.parent == folder / "priors" and network.is_file()
    done = command(*TINY, f"results_dir={folder}")
    assert done.code == 0, done.err
    record, run = record_of(done.out), Path(done.out.splitlines()[-1])
    known = {part for key in DEFINITIONS for part in key.split(", ")}
    assert {"iou", "chamfer_l1", "normal_consistency", "mask_iou", "psnr"} < set(record["metrics"]) <= known
    assert set(record["metrics_start"]) == set(record["metrics"])
    assert any(note.startswith("the network was trained on 3 shapes of sphere for 4 steps") for note in record["notes"])
    assert 0 < record["seconds"]["forward"] < record["seconds"]["total"]
    mesh = trimesh.load_mesh(run / "mesh.ply", process=False)
    assert mesh.visual.kind == "vertex"
    for name in ("summary.png", "input.png"):
        assert (run / name).stat().st_size > 1000


def test_colours_are_not_judged_where_the_training_knew_none(folder, capsys):
    volume = ("supervision=occupancy", f"results_dir={folder}", "evaluation.picture=null")
    assert trained(capsys, *TINY, *volume)[0] == 0
    record = record_of(command(*TINY, *volume).out)
    assert {"iou", "chamfer_l1", "own_mask_iou"} < set(record["metrics"])
    assert not {"psnr", "ssim", "own_psnr", "own_ssim"} & {*record["metrics"], *record["metrics_start"]}


def test_without_its_network_it_names_the_command(tmp_path):
    done = command(*TINY, f"results_dir={tmp_path}")
    assert done.code != 0
    assert "no network was trained for these settings: give the same command to `python -m bench.train`" in done.err


def test_another_renderer_or_setting_is_another_network(folder, network):
    done = command(*TINY, "task.network.width=16", f"results_dir={folder}")
    assert "no network was trained" in done.err
    done = command(*TINY, "renderer.steps=7", f"results_dir={folder}")
    assert "no network was trained" in done.err


def test_only_this_task_has_a_network_to_train(capsys):
    code, _, err = trained(capsys, "task=completion")
    assert code == 2
    assert "bench.train trains the network of task=single_view" in err


@pytest.mark.parametrize("method", ["mean", "nearest", "best"])
def test_rows_without_a_network_are_judged_alike(tmp_path, method):
    small = [one for one in TINY[1:] if not one.startswith("task.training.s")]
    done = command(f"+method=single_view_{method}", *small, "task.training.shapes=3", f"results_dir={tmp_path}")
    assert done.code == 0, done.err
    record = record_of(done.out)
    assert {"iou", "chamfer_l1", "mask_iou", "psnr"} < set(record["metrics"])
    assert 0 < record["metrics"]["iou"] <= 1
    assert "no network and no renderer took part" in record["notes"]
    assert any(note.startswith("training shape ") for note in record["notes"]) == (method != "mean")
    assert read_records(tmp_path)[1] == []


def test_the_nearest_image_is_that_of_the_same_shape(images):  # noqa: F811
    for place, one in enumerate(images):
        assert most_alike(one.image(1), images) == place
        assert most_alike((one.image(2) + 0.01).clamp(0, 1), images) == place


def test_the_best_shape_is_the_nearest_in_size():
    assert [best_shape(Balls().mesh(Split.TEST, place), Balls(), 3) for place in range(3)] == [0, 1, 2]


def test_the_mean_shape_has_the_mean_distance(tmp_path):
    mesh = mean_shape(Balls(), 3, tmp_path, silent)
    assert mesh is not None
    radii = np.linalg.norm(mesh.vertices, axis=1)
    assert radii.mean() == pytest.approx((0.35 + 0.55 + 0.8) / 3, abs=0.01)
    (kept,) = tmp_path.glob("mean-*.safetensors")
    changed = kept.stat().st_mtime_ns
    mean_shape(Balls(), 3, tmp_path, silent)
    assert kept.stat().st_mtime_ns == changed
    mean_shape(Balls(), 2, tmp_path, silent)
    assert len(list(tmp_path.glob("mean-*.safetensors"))) == 2


def test_inside_of_a_mesh_is_negative():
    inside = Inside(Truth(Balls().mesh(Split.TEST, 1)))
    assert inside(torch.tensor([[0.0, 0, 0], [0.9, 0, 0]])).sign().tolist() == [-1, 1]


def test_the_given_image_is_one_of_those_there_are(tmp_path):
    done = command(*TINY, "task.given=3", f"results_dir={tmp_path}")
    assert done.code != 0
    assert "task.given must be one of the 3 images, not 3: 0" in done.err


def test_its_record_is_that_of_the_training(network):
    record = json.loads(network.with_suffix(".json").read_text())
    assert record["settings"]["training"]["steps"] == 4 and record["settings"]["renderer"]["_target_"].endswith(
        "Newton"
    )
    assert record["dataset"]["name"] == "sphere" and record["environment"]["torch"]
