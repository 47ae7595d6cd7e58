"""A record of a run is complete whatever happens, and its code depends on what the run reads."""

import errno
import json
import math
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from bench.records.folder import code_hash, config_hash
from bench.records.metrics import metric_fault
from bench.records.read import read_records
from bench.records.record import Record, RunStatus, digest, to_json, write_text
from tests.looped import each


def new_folder(results: Path) -> Path:
    folder = results / "runs" / "run"
    folder.mkdir(parents=True)
    return folder


def make_record(**changed) -> Record:
    return Record("completion-dist-sofa", "completion", "dist", "sofa", seed=0, config={"seed": 0}, **changed)


def test_a_notebook_shows_a_record_with_its_picture(tmp_path):
    shown = Record("a", "completion", "dist", "sofa", 0, {"results_dir": str(tmp_path)}, reason="1 < 2")
    assert "&lt;run " in shown._repr_html_() and "1 &lt; 2" in shown._repr_html_()
    assert "<img" not in shown._repr_html_()
    shown.folder.mkdir(parents=True)
    (shown.folder / "summary.png").write_bytes(b"picture")
    assert 'src="data:image/png;base64,cGljdHVyZQ=="' in shown._repr_html_()


def test_a_new_record_says_killed_until_the_run_ends(tmp_path):
    folder = new_folder(tmp_path)
    record = make_record()
    record.write(folder)
    (read,), problems = read_records(tmp_path)
    assert (read["status"], read["folder"], problems) == ("killed", "run", []) and read["reason"]
    record.status, record.reason = RunStatus.OK, ""
    record.write(folder)
    assert json.loads((folder / "record.json").read_text())["status"] == "ok"
    assert [path.name for path in folder.iterdir()] == ["record.json"]


def test_records_and_plans_without_a_method_are_read(tmp_path):
    folder = tmp_path / "sweeps/old"
    folder.mkdir(parents=True)
    (tmp_path / "runs").mkdir()
    cell = {"id": "a", "overrides": [], "task": "pose", "renderer": "dist", "dataset": "car", "seed": 0, "config": {}}
    write_text(folder / "plan.json", to_json({"schema": 1, "name": "old", "asked": "2026-01-01", "cells": [cell]}))
    planned, problems = read_records(tmp_path)
    assert ([record["method"] for record in planned], problems) == ([""], [])
    assert Record.of({key: value for key, value in make_record().__dict__.items() if key != "method"}).method == ""


def test_a_record_is_named_by_its_silhouette_loss_unless_it_has_no_masks():
    config = {"label": "Newton, RGB", "silhouette": {"_label_": "IDR's mask loss"}, "task": {"masks": False}}
    assert Record("a", "reconstruction", "newton", "car", 0, config).name == "Newton, RGB, without masks"
    unmasked = config | {"label": "NeuS, no masks"}
    assert Record("a", "reconstruction", "neus", "car", 0, unmasked).name == "NeuS, no masks"
    config["task"]["masks"] = True
    assert Record("a", "reconstruction", "newton", "car", 0, config).name == "Newton, RGB, IDR's mask loss"


@pytest.mark.parametrize("function", ["fsync", "replace"])
def test_a_write_that_fails_leaves_the_old_record(tmp_path, monkeypatch, function):
    folder = new_folder(tmp_path)
    record = make_record()
    record.write(folder)
    before = (folder / "record.json").read_bytes()
    record.status = RunStatus.OK

    def fail(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(*((os, "fsync") if function == "fsync" else (Path, "replace")), fail)
    with pytest.raises(OSError, match="No space left"):
        record.write(folder)
    monkeypatch.undo()
    assert (folder / "record.json").read_bytes() == before
    record.write(folder)
    assert json.loads((folder / "record.json").read_text())["status"] == "ok"


def test_a_reader_never_reads_half_of_a_record(tmp_path):
    path = tmp_path / "record.json"
    texts = [to_json({"number": number, "filler": "x" * 20_000 * number}) for number in (1, 2)]
    write_text(path, texts[0])
    with ThreadPoolExecutor(1) as pool:
        writing = pool.submit(lambda: [write_text(path, texts[turn % 2]) for turn in range(60)])
        contents = {path.read_text() for _ in iter(lambda: writing.done(), True)}
        writing.result()
    assert contents <= set(texts)


def test_numbers_that_json_lacks_come_back_as_they_were(tmp_path):
    odd = {"chamfer_l2": math.inf, "depth_mae": math.nan, "psnr": -math.inf, "fscore": 0.5}
    record = make_record(metrics=odd, metrics_start=dict(odd), flops=None, gemm_fraction=math.nan)
    record.seconds = {"total": 1.5}
    folder = new_folder(tmp_path)
    record.write(folder)
    written = json.loads((folder / "record.json").read_text(), parse_constant=pytest.fail)
    assert written["metrics"] == {"chamfer_l2": "inf", "depth_mae": "nan", "psnr": "-inf", "fscore": 0.5}
    (read,), problems = read_records(tmp_path)
    assert problems == []
    assert str([read["metrics"], read["metrics_start"]]) == str([odd, odd])  # nan is equal to nan as text
    assert math.isnan(read["gemm_fraction"]) and read["flops"] is None


def test_a_logarithm_and_a_word_may_be_metrics():
    metrics = {"seen_roughness": -2.8, "psnr": -1.0, "chosen": "grid_8", "accuracy": None, "depth_mae": 0}
    assert metric_fault(metrics) == ""


@each("metrics, words", [
    ({"mask_iou": 1.2}, "mask_iou must be at most 1"), ({"own_mask_iou": 9.0}, "must be at most 1"),
    ({"seen_chamfer_l1": -1e-9}, "seen_chamfer_l1 must be at least 0"), ({"iou": True}, "iou must be a number"),
])  # fmt: skip
def test_a_metric_out_of_its_range_is_named(metrics, words):
    assert words in metric_fault({"psnr": 40.0, "fscore": 1.0, **metrics})


@each("key", ["path", "image_path", "mask_path"])
def test_a_run_is_another_one_if_a_file_that_it_reads_has_changed(tmp_path, key):
    file, other = tmp_path / "file", tmp_path / "other"
    file.write_text("before")
    other.write_text("before")

    def code() -> str:
        return code_hash({"task": {key: str(file), "not_read": str(other)}})

    before = code()
    other.write_text("after")
    assert code() == before
    file.write_text("after")
    assert code() != before


def test_a_run_is_another_one_if_a_photograph_in_a_folder_of_its_dataset_has_changed(tmp_path):
    photograph = tmp_path / "image" / "a.png"
    photograph.parent.mkdir()

    def code(text: str) -> str:
        photograph.write_text(text)
        return code_hash({"dataset": {"path": str(tmp_path)}})

    assert code("before") == code("before") != code("after")


def test_runs_of_one_command_read_a_photograph_once(tmp_path, monkeypatch):
    (tmp_path / "a.png").write_bytes(b"photograph")
    first = code_hash({"dataset": {"path": str(tmp_path)}, "seed": 0})
    monkeypatch.setattr(Path, "read_bytes", pytest.fail)
    assert code_hash({"dataset": {"path": str(tmp_path)}, "seed": 1}) == first


def test_the_network_of_a_prior_counts_beside_a_folder_of_shapenet(tmp_path):
    weights = tmp_path / "deepsdf" / "ModelParameters" / "latest.pth"
    weights.parent.mkdir(parents=True)
    config = {
        "dataset": {"path": str(tmp_path / "shapes"), "synset": "sofa"},
        "prior": {"path": str(tmp_path / "deepsdf")},
    }

    def code(text: str) -> str:
        weights.write_text(text)
        return code_hash(config)

    assert code("before") == code("before") != code("after")


def test_a_package_is_in_the_identity_of_runs_with_a_class_of_the_user():
    def identity(target: str, *packages: str) -> tuple[str, str]:
        config = {"renderer": {"_target_": target}, "packages": [*packages]}
        return config_hash(config), code_hash(config)

    shipped, users = "renderers.dist.Dist", "tests.user_renderer.Mine"
    assert identity(shipped, "tests") == identity(shipped)
    for ours, theirs in zip(identity(users, "tests"), identity(users, "tests", "hydra"), strict=True):
        assert ours != theirs


def test_a_digest_knows_data_and_not_the_order_of_its_keys():
    data = {"a": 1, "b": {"c": [1, 2.5, None], "d": "x"}}
    assert digest(data) == digest({"b": {"d": "x", "c": [1, 2.5, None]}, "a": 1})
    others = [{**data, "a": 2}, {**data, "b": {"c": [2.5, 1, None], "d": "x"}}, {**data, "e": 0}, {"a": 1}]
    assert len({digest(data), *(digest(other) for other in others)}) == 5
