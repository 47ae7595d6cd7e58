"""The choice of `field=auto`, with candidates whose errors are set by the test."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
import torch

from bench.solve.optimise import OptimiserSettings
from bench.tasks.capacity.growth import Trials, _is_better, climb
from bench.tasks.capacity.model import Evidence, Size
from bench.tasks.capacity.observations import TILES_PER_SIDE
from bench.tasks.reconstruction.choice import AutoField, Choice, tiled
from bench.tasks.reconstruction.subject import Subject
from datasets.shot import Shot
from renderers import IDR
from renderers.field import Counts
from tests.tiny import ball_prior, camera_of, run_of

SETTINGS = OptimiserSettings(320, 0.1, "constant")


@dataclass
class FixedError:
    """A problem with `free` parameters and a fixed error on validation photographs; it records its loss calls.

    Half-way through the 80 iterations of a trial, the error is larger by `falls`.
    """

    free: int
    wrong: float
    failing: bool = False
    falls: float = 0.0
    counts: Counts = field(default_factory=Counts)
    calls: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.parameters = [torch.zeros(self.free, requires_grad=True)]

    def loss(self, iteration: int) -> dict[str, torch.Tensor]:
        self.calls.append(iteration)
        self.counts.value += 10
        return {"total": self.parameters[0].square().sum() + (torch.nan if self.failing else 1.0)}

    def colour_errors(self, pixels: Any) -> torch.Tensor:
        error = self.wrong + (self.falls if len(self.calls) < 60 else 0.0)
        return torch.full((len(pixels.depth_per_distance),), error)


def shot(name: str) -> Shot:
    camera = camera_of(16)
    return Shot(name, camera, torch.zeros(16, 16, 3), torch.ones(16, 16, dtype=torch.bool), None, None)


def chosen(
    problems: dict[str, FixedError], folder, *, patience: int = 2, photographs: int = 9, settings=SETTINGS
) -> tuple[Choice, list[Subject]]:
    shots, subjects = tuple(shot(str(number)) for number in range(photographs)), []
    subject = Subject(shots, (shot("held out"),), None, "")

    def make(name: str, fitted: Subject):
        subjects.append(fitted)
        return problems[name]

    run = run_of(folder, IDR, ball_prior(), camera_of(16))
    auto = AutoField(tuple(problems), 0.25, patience)
    sizes = {name: problem.free for name, problem in problems.items()}
    return auto.choose(make, sizes, subject, settings, run), subjects


def test_the_smallest_candidate_that_no_larger_one_improves_on_is_chosen(tmp_path):
    problems = {"large": FixedError(30, 0.1), "small": FixedError(3, 0.3), "middle": FixedError(10, 0.1)}
    choice, subjects = chosen(problems, tmp_path)
    assert [trial.candidate for trial in choice.trials.tried] == ["small", "middle", "large"]
    assert choice.kept.candidate == "middle" and len(subjects) == 3
    for fitted in subjects:  # photographs 0 and 8 are for validation, and held-out photographs are absent
        assert [photograph.name for photograph in fitted.input_shots] == ["1", "2", "3", "4", "5", "6", "7"]
    assert choice.validation_count == 2
    for problem in problems.values():
        assert problem.calls == [0, *range(80)]  # one warm-up, then a quarter of 320
    assert "field=auto: middle, 10 numbers; error of colours on 2 photographs set aside" in choice.note
    assert "small 0.3, middle 0.1, large 0.1" in choice.note
    metrics = choice.metrics(runtime=2 * choice.seconds)
    assert metrics["field_overhead"] == pytest.approx(1.5)
    names = ("field", "field_free", "field_bytes", "fields_tried", "field_evaluations")
    assert [metrics[name] for name in names] == ["middle", 10, 40, 3, choice.evaluations] and choice.evaluations > 0
    assert metrics["field_error"] == pytest.approx(0.1)


def test_the_least_error_is_chosen_while_it_still_falls(tmp_path):
    noisy = {"a": of_tiles(np.full(16, 0.3)), "b": of_tiles(np.tile([0.1, 0.49], 8))}
    trials = Trials([*noisy.values()], [noisy["a"]])
    assert Choice(trials, 1).kept is noisy["a"]  # "b" is better, but within the noise
    noisy["b"].falling = True
    assert Choice(trials, 1).kept is noisy["b"]


@pytest.mark.parametrize(("iterations", "trial"), [(400, 100), (200, 80), (40, 40)])
def test_trials_are_long_enough_to_show_an_order(tmp_path, iterations, trial):
    problem = FixedError(3, 0.3)
    chosen({"a": problem}, tmp_path, settings=OptimiserSettings(iterations, 0.1, "constant"))
    assert len(problem.calls) == 1 + trial


def test_a_trial_has_its_share_of_a_budget_also_if_it_is_lengthened(tmp_path):
    problem = FixedError(3, 0.3, falls=-1.0)  # its error rises
    settings = OptimiserSettings(160, 0.1, "constant", budget=160 * 10)  # a loss costs 10
    chosen({"a": problem}, tmp_path, settings=settings)
    assert len(problem.calls) in (80, 81)
    stopped = replace(settings, budget=400)  # before half of the trial
    choice, _ = chosen({"a": FixedError(3, 0.3)}, tmp_path, settings=stopped)
    assert choice.trials.tried[0].falling


def test_candidates_that_are_no_better_are_skipped_until_patience_ends(tmp_path):
    problems = {"a": FixedError(1, 0.3), "b": FixedError(2, 0.4), "c": FixedError(3, 0.4), "d": FixedError(4, 0.1)}
    assert chosen(problems, tmp_path, patience=3)[0].kept.candidate == "d"
    choice, _ = chosen(problems, tmp_path, patience=2)
    assert choice.kept.candidate == "a"
    assert [trial.candidate for trial in choice.trials.tried] == ["a", "b", "c"]


def test_the_search_does_not_end_while_the_error_falls(tmp_path):
    """Neither where a trial ends before the fit does, nor at the candidate with the least error so far."""
    problems = {"a": FixedError(1, 0.3), "b": FixedError(2, 0.4, falls=0.1), "c": FixedError(3, 0.4, falls=0.1)}
    problems |= {"d": FixedError(4, 0.35), "e": FixedError(5, 0.1)}
    assert chosen(problems, tmp_path)[0].kept.candidate == "e"
    means = (np.repeat([0.1, 0.5], 8), np.repeat([0.2, 0.5], 8), np.tile([0.05, 0.54], 8), np.tile([0.2, 0.5], 8))
    noisy = [replace(of_tiles(mean), candidate=str(n)) for n, mean in enumerate((*means, np.full(16, 0.1)))]
    trials = climb(range(5), lambda n, _: noisy[n], patience=2)
    assert [trial.candidate for trial in trials.kept] == ["0", "4"]  # the third one is better, but within the noise


def test_a_failed_trial_is_worse_than_any_error(tmp_path):
    problems = {"a": FixedError(1, 0.3, failing=True), "b": FixedError(2, 0.9), "c": FixedError(3, 0.1, failing=True)}
    choice, _ = chosen(problems, tmp_path)
    assert choice.kept.candidate == "b" and "no trial ended well" not in choice.note
    failed, _ = chosen({"a": FixedError(1, 0.3, failing=True)}, tmp_path)
    assert "no trial ended well: lower task.optimiser.learning_rate" in failed.note
    assert choice.trials.tried[0].error is None and np.isinf(choice.trials.tried[0].mean)


def of_tiles(errors: np.ndarray) -> Evidence:
    """A trial on one photograph whose tiles of 4 x 4 pixels have these errors, with different pixels in a tile."""
    pixels = np.kron(errors.reshape(TILES_PER_SIDE, TILES_PER_SIDE), np.ones((4, 4)))
    pixels += np.tile([[0.05, -0.05]], (16, 8))
    return Evidence("one", Size(1, 1), error=tiled(torch.from_numpy(pixels.flatten()), [shot("0")]))


def test_the_noise_is_that_of_tiles_not_of_pixels():
    tiles = np.repeat([0.1, 0.5], 8)
    reference = of_tiles(tiles)
    assert reference.mean == pytest.approx(0.3)
    assert _is_better(of_tiles(tiles - 0.01), reference)  # better by 0.01 in each tile
    differences = np.tile([0.3, -0.25], 8)
    assert not _is_better(of_tiles(tiles - differences), reference)  # 0.025 on average, with a standard error of 0.07
    for factor, better in ((0.9, False), (1.1, True)):
        gain = factor * differences.std(ddof=1) / 4 - differences.mean()
        assert _is_better(of_tiles(tiles - differences - gain), reference) is better
    assert _is_better(of_tiles(tiles - differences - 0.1), reference)
