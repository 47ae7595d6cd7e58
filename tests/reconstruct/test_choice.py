"""What `field=auto` ends on, with candidates whose errors are set by hand."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import torch

from bench.models.growth import _is_better
from bench.models.model import Evidence, Size
from bench.models.observations import TILES_PER_SIDE
from bench.reconstruct.choice import AutoField, Choice, tiled
from bench.reconstruct.subject import Subject
from bench.solve.optimise import OptimiserSettings
from datasets.shot import Shot
from renderers import IDR
from renderers.field import Counts
from tests.tiny import ball_prior, camera_of, run_of

SETTINGS = OptimiserSettings(40, 0.1, "constant")


@dataclass
class Known:
    """A problem with that many parameters, whose errors on photographs set aside are known; it notes its loss calls."""

    free: int
    wrong: float
    failing: bool = False
    counts: Counts = field(default_factory=Counts)
    asked: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.parameters = [torch.zeros(self.free, requires_grad=True)]

    def loss(self, iteration: int) -> dict[str, torch.Tensor]:
        self.asked.append(iteration)
        self.counts.value += 10
        return {"total": self.parameters[0].square().sum() + (torch.nan if self.failing else 1.0)}

    def colour_errors(self, pixels: Any) -> torch.Tensor:
        return torch.full((len(pixels.depth_per_distance),), self.wrong)


def shot(name: str) -> Shot:
    camera = camera_of(16)
    return Shot(name, camera, torch.zeros(16, 16, 3), torch.ones(16, 16, dtype=torch.bool), None, None)


def ended_on(known: dict[str, Known], folder, *, patience: int = 2, given: int = 9) -> tuple[Choice, list[Subject]]:
    shots, seen = tuple(shot(str(place)) for place in range(given)), []
    subject = Subject(shots, (shot("held out"),), None, "")

    def make(name: str, part: Subject):
        seen.append(part)
        return known[name]

    run = run_of(folder, IDR, ball_prior(), camera_of(16))
    auto = AutoField(tuple(known), 0.25, patience)
    sizes = {name: problem.free for name, problem in known.items()}
    return auto.choose(make, sizes, subject, SETTINGS, run), seen


def test_the_smallest_that_no_larger_one_improves_on_is_kept(tmp_path):
    known = {"large": Known(30, 0.1), "small": Known(3, 0.3), "middle": Known(10, 0.1)}
    choice, seen = ended_on(known, tmp_path)
    assert [trial.candidate for trial in choice.trials.tried] == ["small", "middle", "large"]
    assert choice.kept.candidate == "middle"
    assert len(seen) == 3
    for part in seen:  # photographs 0 and 8 are set aside, those that are held out are not there
        assert [one.name for one in part.input_shots] == ["1", "2", "3", "4", "5", "6", "7"]
    assert choice.validation_count == 2
    for problem in known.values():
        assert problem.asked == [0, *range(10)]  # one to warm up, then a quarter of 40
    assert "field=auto: middle, 10 numbers; error of colours on 2 photographs set aside" in choice.note
    assert "small 0.3, middle 0.1, large 0.1" in choice.note
    metrics = choice.metrics(runtime=2 * choice.seconds)
    assert metrics["field_overhead"] == pytest.approx(1.5)
    assert (metrics["field"], metrics["field_free"], metrics["field_bytes"], metrics["fields_tried"]) == (
        "middle", 10, 40, 3,
    )  # fmt: skip
    assert metrics["field_error"] == pytest.approx(0.1)


def test_it_looks_past_those_that_are_no_better_until_patience_ends(tmp_path):
    known = {"a": Known(1, 0.3), "b": Known(2, 0.4), "c": Known(3, 0.4), "d": Known(4, 0.1)}
    assert ended_on(known, tmp_path, patience=3)[0].kept.candidate == "d"
    choice, _ = ended_on(known, tmp_path, patience=2)
    assert choice.kept.candidate == "a"
    assert [trial.candidate for trial in choice.trials.tried] == ["a", "b", "c"]


def test_one_that_fails_is_worse_than_any(tmp_path):
    known = {"a": Known(1, 0.3, failing=True), "b": Known(2, 0.9), "c": Known(3, 0.1, failing=True)}
    choice, _ = ended_on(known, tmp_path)
    assert choice.kept.candidate == "b"
    assert "no trial ended well" not in choice.note
    none, _ = ended_on({"a": Known(1, 0.3, failing=True)}, tmp_path)
    assert "no trial ended well: lower task.optimiser.learning_rate" in none.note
    assert choice.trials.tried[0].error is None and np.isinf(choice.trials.tried[0].mean)


def of_tiles(errors: np.ndarray) -> Evidence:
    """A trial on one photograph whose tiles, of 4 x 4 pixels, have these errors; pixels of a tile differ."""
    pixels = np.kron(errors.reshape(TILES_PER_SIDE, TILES_PER_SIDE), np.ones((4, 4))) + np.tile(
        [[0.05, -0.05]], (16, 8)
    )
    return Evidence("one", Size(1, 1), error=tiled(torch.from_numpy(pixels.flatten()), [shot("0")]))


def test_the_noise_is_that_of_tiles_not_of_pixels():
    tiles = np.repeat([0.1, 0.5], 8)
    one = of_tiles(tiles)
    assert one.mean == pytest.approx(0.3)
    assert _is_better(of_tiles(tiles - 0.01), one)  # by as much everywhere
    apart = np.tile([0.3, -0.25], 8)
    assert not _is_better(of_tiles(tiles - apart), one)  # .025 on average, with a standard error of .07
    for share, better in ((0.9, False), (1.1, True)):
        gain = share * apart.std(ddof=1) / 4 - apart.mean()
        assert _is_better(of_tiles(tiles - apart - gain), one) is better
    assert _is_better(of_tiles(tiles - apart - 0.1), one)
