"""A run's metrics are computed again from its saved field."""

import json
import os
import shutil
from pathlib import Path

import pytest
import torch

import bench
from bench.records.folder import code_hash
from bench.verify import main
from datasets.saved_field import FIELD_FILE
from tests.composing import composed
from tests.runner.driving import command
from tests.tiny import inputs_from

SMALL = (
    "renderer=dist", "scale=smoke", "isolation=off", "threads=1", "evaluation.grid=24", "evaluation.points=200",
    "evaluation.every=null", "evaluation.picture=null", "view.resolution=16", "task.optimiser.iterations=3",
)  # fmt: skip
DELETED = "deleted"
PHOTOGRAPHS = ("task.images.views=6", "task.longest=16", "task.held_out=3", "task.rays=64")
RUNS = {
    "a code of the prior": ("task=completion", "task.points=20"),
    "a box": ("task=completion", "task.points=20", "field=box", "models.fit.warm_iterations=2"),
    "photographs": ("task=reconstruction", "field=grid_8", *PHOTOGRAPHS),
    "similarity": ("task=multiview", "task.similarity=true", "task.starts=1"),
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> dict[str, Path]:
    """The folders of small runs by the kind of their field."""
    results, folders = tmp_path_factory.mktemp("results"), {}
    for name, overrides in RUNS.items():
        result = command(*overrides, *SMALL, f"results_dir={results}")
        folders[name] = Path(result.out.splitlines()[-1])
        assert (folders[name] / FIELD_FILE).is_file(), result.err + (folders[name] / "record.json").read_text()
    return folders


@pytest.fixture
def copied(runs, tmp_path) -> Path:
    """A copy of one run, which may be changed."""
    return Path(shutil.copytree(runs["a code of the prior"], tmp_path / "runs" / "copy"))


def edit(folder: Path, **changed) -> None:
    """Changes values of a record."""
    record = json.loads((folder / "record.json").read_text())
    metrics = record["metrics"] | changed.pop("metrics", {})
    record["metrics"] = {name: value for name, value in metrics.items() if value != DELETED}
    (folder / "record.json").write_text(json.dumps(record | changed))


def test_runs_that_nobody_touched_agree(runs, capsys):
    assert main([str(next(iter(runs.values())).parents[1])]) == 0
    out = capsys.readouterr().out
    assert out.count("agrees: ") == len(RUNS) and f"{len(RUNS)} of {len(RUNS)} agree" in out


def scale(folder: Path, metric: str, factor: float) -> None:
    """Multiplies a metric of a record."""
    value = json.loads((folder / "record.json").read_text())["metrics"][metric]
    edit(folder, metrics={metric: factor * value})


CAUSES = ("cpu", "threads", "torch")
F = "f" * 40  # the hash of other code


@pytest.mark.parametrize("spoil, words", [
    (lambda run: edit(run, code=F), ("agrees: copy, from its field",)),  # metrics agree, so other code is not reported
    (lambda run: edit(run, metrics={"chamfer_l1": 1e-3}), ("differs: copy", "chamfer_l1 is 0.00100 in", "edited?")),
    (lambda run: edit(run, metrics={"fscore": 0.5}, code=F), ("fscore is 0.500", "the code differs: ffffffffffff")),
    (lambda run: scale(run, "chamfer_l2", 1.001), ("differs: copy", "chamfer_l2 is ", "edited?")),
    (lambda run: scale(run, "chamfer_l1", 1.00001), ("agrees: copy, from its field",)),  # sums in another order
    (lambda run: edit(run, metrics={"chamfer_l1": "nan"}), ("differs: copy", "chamfer_l1 is nan in", "edited?")),
    (lambda run: edit(run, metrics={"fscore": DELETED}), ("fscore is not there in the record, now", "edited?")),
    (lambda run: edit(run, metrics={"fscore": 0.5}, environment={}), [f"{cause} differs: None" for cause in CAUSES]),
    (lambda run: (run / FIELD_FILE).unlink(), (f"left out: copy, from its field: it has no {FIELD_FILE}",)),
    (lambda run: os.truncate(run / FIELD_FILE, 999), ("not compared: copy", "be cut short")),
    (lambda run: (run / "record.json").write_text("{"), ("not compared: copy", "record.json is not JSON")),
])  # fmt: skip
def test_an_edited_metric_is_reported_with_its_cause(copied, capsys, spoil, words):
    spoil(copied)
    code, out = main([str(copied)]), capsys.readouterr().out
    assert code == (not out.startswith("agrees")) and all(word in out for word in words), out


def test_only_the_field_of_a_run_that_is_read_decides_whether_its_reader_runs_again(copied):
    config = {"dataset": {"path": str(copied)}}
    first = code_hash(config)
    edit(copied, asked="later")
    assert code_hash(config) == first
    (copied / FIELD_FILE).write_bytes(b"other")
    assert code_hash(config) != first


def test_a_folder_without_runs_is_an_error(tmp_path, capsys):
    assert main([str(tmp_path)]) == 2
    assert "name a run's folder, or a results folder" in capsys.readouterr().err


@pytest.mark.parametrize("name", RUNS)
def test_the_field_of_a_run_can_be_a_scene(runs, name):
    folder = runs[name]
    inputs = inputs_from(composed("task=ablation", "dataset=network", f"dataset.path={folder}"))
    fitted, field = inputs.fitted(), bench.load_field(folder)
    points = torch.rand(100, 3) - 0.5
    values, field_values = fitted.decoder.at(fitted.codes[0])(points), field(points)
    torch.testing.assert_close(
        values * (field_values.sum() / values.sum()), field_values, rtol=0, atol=1e-5
    )  # a bound is scaled
