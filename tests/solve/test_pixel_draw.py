"""The pixels that an iteration compares, those held out, and the end of a loop by their loss."""

from dataclasses import replace

import pytest
import torch

from bench.solve.optimise import (
    FINAL_ITERATIONS,
    HELD_OUT,
    HELD_OUT_INTERVAL,
    History,
    OptimiserSettings,
    StartSettings,
    optimise,
    with_affordable_rays,
)
from bench.solve.pixel_draw import PixelDraw
from renderers.checks import BadInput
from renderers.field import Counts
from tests.runner.driving import record_of
from tests.solve.test_optimise import Sampled

CPU = torch.device("cpu")


def test_all_pixels_are_compared_without_blocks_and_without_held_out_ones():
    draw = PixelDraw(torch.ones(6, 5, dtype=torch.bool), 1, 0, holds_out=False)
    assert draw.pixels(0) is None and draw.per_iteration == 30 and not draw.refine()


def test_held_out_pixels_are_never_compared_and_blocks_shrink_to_all_others():
    observed = torch.zeros(40, 20, dtype=torch.bool)
    observed[:10] = True
    draw = PixelDraw(observed, 1, 3, holds_out=True)
    assert observed.flatten()[draw.held_out].sum() == 20 and len(draw.held_out) == 80  # a tenth of each kind
    counts = []
    while True:
        pixels = draw.pixels(len(counts))
        assert not set(pixels.tolist()) & set(draw.held_out.tolist())
        counts.append(len(pixels))
        if not draw.refine():
            break
    draw.release()
    assert draw.pixels(9) is None
    assert 35 <= counts[0] <= 50 and 160 <= counts[1] <= 200 and counts[2] == 720
    assert draw.per_iteration == round((sum(counts) + 800) / 4)


class Falling:
    """A problem whose held-out loss falls over the first `falls` measurements of each block."""

    def __init__(self, falls: int, constant: float | None = None) -> None:
        self.parameters, self.counts = [torch.ones(1, requires_grad=True)], Counts()
        self.falls, self.measured, self.refined, self.released = falls, 0, 0, 0
        self.draw, self.constant = self, constant

    def loss(self, iteration: int) -> dict[str, torch.Tensor]:
        self.counts.value += 10
        return {"total": self.parameters[0].square().sum()}

    def held_out_loss(self) -> float:
        self.counts.value += 1
        self.measured += 1
        if self.constant is not None:
            return self.constant
        return 0.1**self.refined / min(self.measured, self.falls)

    def refine(self) -> bool:
        self.measured, self.refined = 0, self.refined + 1
        return self.refined < 3

    def release(self) -> None:
        self.released = self.counts.value


def test_a_loop_ends_when_the_held_out_loss_stops_falling_at_each_block():
    problem, history = Falling(falls=3), History()
    settings = OptimiserSettings(1000, 1e-3, "constant", ends=HELD_OUT)
    optimise(problem, settings, CPU, history=history, on_step=lambda line: None)
    measurements = 3 * (3 + 2)  # for each size of blocks, three that fall and two that do not
    assert len(history.curve) == measurements * HELD_OUT_INTERVAL + FINAL_ITERATIONS and problem.refined == 3
    assert history.counts.value == 10 * len(history.curve) + measurements  # the measurements are counted
    short, problem = History(), Falling(falls=3)
    optimise(problem, replace(settings, iterations=20), CPU, history=short, on_step=lambda line: None)
    assert len(short.curve) == 20 and problem.released == short.counts.value - 10 * (FINAL_ITERATIONS - 1)


def test_several_starts_share_a_fixed_number_of_iterations():
    with pytest.raises(ValueError, match=r"set task\.optimiser\.ends=iterations"):
        StartSettings(4, 5).check(OptimiserSettings(100, 1e-2, "constant", ends=HELD_OUT))


@pytest.mark.parametrize("constant", [0.0, float("inf"), float("nan")])
def test_a_held_out_loss_that_cannot_fall_ends_each_block(constant):
    problem, history = Falling(1, constant), History()
    settings = OptimiserSettings(1000, 1e-3, "constant", ends=HELD_OUT)
    optimise(problem, settings, CPU, history=history, on_step=lambda line: None)
    assert problem.refined == 3 and len(history.curve) < 100


def test_observations_of_which_no_tenth_can_be_held_out_are_refused():
    observed = torch.zeros(20, 20, dtype=torch.bool)
    observed[0, :9] = True
    with pytest.raises(BadInput, match="9 pixels with depth have no tenth to hold out"):
        PixelDraw(observed, 1, 0, holds_out=True)


class Drawn(Falling):
    """A problem in which a pixel of 32 x 32 costs one field evaluation."""

    def __init__(self, task: Sampled) -> None:
        super().__init__(falls=3)
        holds_out = task.optimiser.ends == HELD_OUT
        self.draw = PixelDraw(torch.ones(32, 32, dtype=torch.bool), task.pixel_block, 0, holds_out=holds_out)

    def loss(self, iteration: int) -> dict[str, torch.Tensor]:
        pixels = self.draw.pixels(iteration)
        self.counts.value += 32 * 32 if pixels is None else len(pixels)
        return {"total": self.parameters[0].square().sum()}


def test_the_budget_pays_for_the_last_blocks_not_only_for_the_larger_first_ones():
    task = Sampled(OptimiserSettings(100, 1e-3, "constant", 40 * 16**2, HELD_OUT))
    assert with_affordable_rays(task, Drawn).draw.blocks == [4, 2]


SMOKE = ("task=completion", "dataset=sofa", "scale=smoke", "evaluation.grid=16", "evaluation.picture=null")


@pytest.mark.slow
def test_a_completion_with_no_more_effort_than_needed(isolated):
    """Half a pixel, fewer rays, and the same errors before; a typed precision stays."""
    changes = (), ("effort=needed",), ("effort=needed", "renderer.epsilon=1e-5")
    outputs = [isolated(*SMOKE, *change, "task.optimiser.iterations=12") for change in changes]
    assert [code for code, *_ in outputs] == [0, 0, 0]
    full, needed, typed = (record_of(out) for _, out, _ in outputs)
    assert any("renderer.epsilon=auto is 0.0007" in note for note in needed["notes"])
    assert not any("auto" in note for note in full["notes"] + typed["notes"])
    assert needed["metrics_start"]["chamfer_l2"] == full["metrics_start"]["chamfer_l2"]
    assert needed["evaluations"]["rays_per_iteration"] < full["evaluations"]["rays_per_iteration"]
    assert needed["evaluations"]["cost"] < full["evaluations"]["cost"]


@pytest.mark.parametrize("changes", [("task=pose",), ("task=multiview",), ("field=grid_8",)])
def test_effort_is_refused_where_nothing_is_held_out(isolated, changes):
    code, _, err = isolated(*SMOKE, *changes, "effort=needed", "task.optimiser.schedule=constant")
    assert code == 2 and "effort=needed is only for task=completion with field=prior: set effort=full" in err


def test_a_schedule_that_needs_all_iterations_is_refused_with_the_remedy(isolated):
    code, _, err = isolated(*SMOKE, "task=pose", "effort=needed")
    assert code == 2 and "with task.optimiser.schedule=constant: set effort=full" in err
