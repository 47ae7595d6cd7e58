"""plan=true of bench.prior and bench.train says what would be trained and how long, and trains nothing."""

import json
import sys
from pathlib import Path

import pytest
import torch

from bench.machine.processor import cpu_name
from bench.prior import main as prior_main
from bench.run import trainings
from bench.run.trainings import NETWORK, PRIOR, Training, records
from bench.shape_prior import store as priors
from bench.single_view import store as networks
from bench.train import main as train_main

SMALL = ("scale=smoke", "threads=1", "device=cpu")
CPU = torch.device("cpu")
OF_PRIOR = (prior_main, *SMALL)
OF_NETWORK = (train_main, "+method=single_view", "task.training.steps=7", "task.shapes=3", *SMALL)


@pytest.fixture
def planned(tmp_path, monkeypatch, capsys):
    """The exit status and the outputs of a command with plan=true, in which nothing can be trained."""

    def never(*_, **__):
        raise AssertionError("it trains")

    monkeypatch.setattr(priors, "train", never)
    monkeypatch.setattr(priors, "distance_samples", never)
    monkeypatch.setattr(networks, "train", never)
    monkeypatch.setattr(networks.Imaging, "images", never)

    def run(main, *arguments: str) -> tuple[int, list[str], str]:
        monkeypatch.setattr(sys, "argv", ["bench", "plan=true", f"results_dir={tmp_path / 'r'}", *arguments])
        code = main()
        done = capsys.readouterr()
        return code, done.out.splitlines(), done.err

    return run


def write(one: Training, number: int, seconds: float, dataset: str = "", **machine) -> Path:
    """Writes the record of a training that is like this one, but for what is given."""
    path = one.folders[-1] / f"{'single_view-' * (one.kind == NETWORK)}made-{number}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    here = {"cpu": cpu_name(), "device": "cpu", "threads": torch.get_num_threads()}
    record = {"dataset": {"name": dataset or one.dataset}, "settings": one.settings, "environment": here | machine}
    path.write_text(json.dumps(record | {"seconds": {"sampling": 1.0, "training": seconds - 1.0}}))
    return path


def training(folder: Path, kind: str = PRIOR, **settings) -> Training:
    """A training of spheres that is planned."""
    return Training(kind, "sphere", {"steps": 5, "seed": 0} | settings, "it", None, False, CPU, (folder / "p",))


@pytest.mark.parametrize(("command", "what"), [
    (OF_PRIOR, "prior of sphere: 24 shapes, 500 steps"),
    (OF_NETWORK, "network of sphere: 3 shapes, 24 images each, 7 steps"),
])  # fmt: skip
def test_it_says_what_would_be_trained_and_leaves_nothing(planned, tmp_path, command, what):
    assert planned(*command, "dataset=sphere") == (0, [f"{what}  no like training on record"], "")
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize("kind", [PRIOR, NETWORK])
def test_the_estimate_is_from_records_of_like_trainings(tmp_path, kind):
    one = training(tmp_path, kind)
    assert one.told() == "it  no like training on record"
    write(one, 0, 900.0, cpu="another")
    assert one.told() == "it  about 15.0 min (1 training on other machines or threads)"
    write(one, 1, 300.0, dataset="box")
    assert one.told() == "it  about 5.00 min (1 training on other shapes)"
    write(one, 2, 20.0)
    assert one.told() == "it  about 20.0 s (1 like training)"
    write(training(tmp_path, kind, seed=4, learning_rate=0.5), 3, 40.0)  # neither changes the time
    assert one.told() == "it  about 30.0 s (2 like trainings, 20.0 s to 40.0 s)"
    assert "no like training" in training(tmp_path, kind, steps=6).told()  # nothing says how the time would scale
    assert "no like training" in training(tmp_path, NETWORK if kind == PRIOR else PRIOR).told()


def test_a_record_that_cannot_be_read_or_never_ended_is_none(tmp_path):
    path = write(training(tmp_path), 0, 20.0)
    path.write_text(json.dumps({"status": "nan"}))
    path.with_name("broken.json").write_text("{")
    path.with_name("list.json").write_text("[1]")
    assert records([path.parent]) == []


def test_what_is_there_is_not_trained(planned):
    assert "there already: " in planned(prior_main, "dataset=sofa")[1][0]
    assert "there already: " in planned(train_main, "+method=single_view", "dataset=sofa")[1][0]


def test_a_stopped_training_goes_on(planned, monkeypatch):
    known = []
    monkeypatch.setattr(networks.Recipe, "find", lambda self, cache: known.append((self, cache)))
    planned(*OF_NETWORK, "dataset=sphere")
    (recipe, cache), *_ = known
    cache.mkdir(parents=True)
    (cache / f"{recipe.stem}.state").write_text("")
    assert planned(*OF_NETWORK, "dataset=sphere")[1][0].endswith("; one was stopped, and goes on where it was")


def test_a_sweep_is_listed_with_its_sum(planned, tmp_path, monkeypatch):
    monkeypatch.setattr(trainings, "records", lambda _: [like])
    like = training(tmp_path).planned | {"seconds": {"total": 30.0}, "environment": {"cpu": cpu_name()}}
    monkeypatch.setattr(trainings, "_with_work", lambda _: {"steps": 5})
    code, lines, err = planned(*OF_PRIOR, "-m", "dataset=sofa,sphere", "seed=0,1")
    assert (code, err, len(lines)) == (0, "", 3)  # seeds of a run share a prior
    assert lines[2] == "2 planned: 1 to train, 1 there already; about 30.0 s (n = 1 each), 1 at a time"
    assert not (tmp_path / "r" / "sweeps").exists()


def test_the_cells_of_a_sweep_are_no_runs(tmp_path, monkeypatch, capsys):
    where = f"results_dir={tmp_path / 'r'}"
    monkeypatch.setattr(sys, "argv", ["bench", "-m", "dataset=sofa,plane", where])
    assert prior_main() == 0
    assert [Path(line).name.split("-")[0] for line in capsys.readouterr().out.splitlines()] == ["sofa", "plane"]
    assert not list((tmp_path / "r").rglob("plan.json"))


def test_a_sweep_that_cannot_be_has_no_sum(planned):
    code, lines, err = planned(*OF_PRIOR, "-m", "dataset=sofa,plane,mesh")
    assert code == 2 and "dataset.path" in err and not any("planned" in line for line in lines)


@pytest.mark.parametrize("command", [OF_PRIOR, OF_NETWORK])
def test_what_cannot_be_is_told(planned, command):
    code, out, err = planned(*command, "dataset=mesh", "dataset.path=none.ply")
    assert (code, out) == (2, []) and "none.ply" in err and len(err.splitlines()) == 1
