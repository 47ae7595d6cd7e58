"""`plan=true` of `bench.prior` and `bench.train`: what would be trained, with the time that like trainings took.

A training leaves a record beside its weights. Like trainings have the same shapes and settings, on the same processor
and threads; those of other sizes are never like, since nothing says how their time would scale.
"""

import json
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from bench.machine.environment import device_name
from bench.machine.processor import cpu_name
from bench.records.expected import Expected, Model, Record, Remaining
from bench.records.files import digest
from bench.run.plan import Words, told, total
from bench.shape_prior import store as priors
from bench.shape_prior.autodecoder import PriorSettings
from bench.single_view import store as networks
from datasets.dataset import Dataset

PRIOR, NETWORK = "prior", "single_view"
WORDS = Words("training", "train", "there already", "like training on record")
LADDER = (
    ((), "like trainings"),
    (("dataset",), "trainings on other shapes"),
    (("dataset", "machine"), "trainings on other machines or threads"),
)
# Settings that do not change how long a training takes.
TIMELESS = ("seed", "learning_rate", "beta2", "code_sigma", "code_penalty", "surface_width", "keep_every")


@dataclass(frozen=True)
class Training:
    """A training that a command asks for.

    Args:
        kind: of what is trained, `PRIOR` or `NETWORK`.
        dataset: the name of the dataset.
        settings: that decide what is trained, as plain data.
        what: of it, in words.
        found: the file of an earlier training of the same; None where it would be trained.
        begun: whether one was stopped, and would go on.
        device: on which it would be trained.
        folders: in which earlier trainings have left their records.
    """

    kind: str
    dataset: str
    settings: dict[str, Any]
    what: str
    found: Path | None
    begun: bool
    device: torch.device
    folders: tuple[Path, ...]

    @property
    def planned(self) -> Record:
        """What a record of it would say before it starts."""
        machine = {"device": device_name(self.device), "threads": torch.get_num_threads()}
        return _as_run(self.kind, self.dataset, self.settings, machine)

    def told(self) -> str:
        """What would be trained and how long it would take, or where it is, in a line."""
        if self.found is not None:
            return f"{self.what}  {WORDS.done}: {self.found}"
        goes_on = "; one was stopped, and goes on where it was" if self.begun else ""
        return f"{self.what}  {told(expected(self), WORDS)}{goes_on}"


def prior_training(dataset: Dataset, settings: PriorSettings, folder: Path, device: torch.device) -> Training:
    """The training of a dataset's prior, whose weights go to a folder."""
    found = priors.find(dataset, settings, folder)
    what = f"prior of {dataset.name}: {_counted(settings.shapes, 'shape')}, {_counted(settings.steps, 'step')}"
    folders = (priors.SHIPPED, folder)
    return Training(PRIOR, dataset.name, asdict(settings), what, found, begun=False, device=device, folders=folders)


def network_training(recipe: networks.Recipe, cache: Path, device: torch.device) -> Training:
    """The training of a network for one image, whose weights go to a folder."""
    name, steps = recipe.dataset.name, _counted(recipe.training.steps, "step")
    what = f"network of {name}: {_counted(recipe.shapes, 'shape')}, {_counted(recipe.views, 'image')} each, {steps}"
    begun = (cache / f"{recipe.stem}.state").exists()
    folders = (networks.SHIPPED, cache)
    return Training(NETWORK, name, recipe.settings, what, recipe.find(cache), begun, device, folders)


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")


def expected(training: Training) -> Expected | None:
    """What a training will take by the records of its folders; None where there is no like one."""
    return Model(records(training.folders), cpu_name(), ladder=LADDER, sizes=("settings",)).of(training.planned)


def show_training(training: Training, planned: list[Training]) -> None:
    """Prints a training, as soon as it is known, and adds it to those that are planned; cells may share one."""
    if training not in planned:
        planned.append(training)
        print(training.told(), flush=True)


def show_total(planned: Sequence[Training]) -> None:
    """Prints the sum over the trainings of a sweep; one training is its own sum."""
    if len(planned) < 2:
        return
    left = {str(place): expected(one) for place, one in enumerate(planned) if one.found is None}
    print(total(len(planned), Remaining(left, 1), WORDS))


def records(folders: Iterable[Path]) -> list[Record]:
    """The records of trainings that ended, in the form that records of runs have."""
    found = []
    for path in sorted(path for folder in folders for path in folder.glob("*.json")):
        with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):  # no record of a training of ours
            record = json.loads(path.read_text())
            kind = NETWORK if path.name.startswith(f"{NETWORK}-") else PRIOR
            run = _as_run(kind, str(record["dataset"]["name"]), record["settings"], record["environment"])
            taken = sum(float(spent) for spent in record["seconds"].values())
            found.append(run | {"seconds": {"total": taken}, "environment": dict(record["environment"])})
    return found


def _as_run(kind: str, dataset: str, settings: dict[str, Any], machine: dict[str, Any]) -> Record:
    """A training as the record of a run, whose one size are its settings."""
    return {
        "task": kind,
        "renderer": "",
        "dataset": dataset,
        "status": "ok",
        "config": {
            "task": {"settings": digest(_with_work(settings))},
            "device": machine["device"],
            "threads": machine["threads"],
        },
    }


def _with_work(settings: Any) -> Any:
    """Settings without those that do not change how long a training takes."""
    if not isinstance(settings, dict):
        return settings
    return {key: _with_work(value) for key, value in settings.items() if key not in TIMELESS}
